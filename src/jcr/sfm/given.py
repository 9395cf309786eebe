"""The back end `given`: camera poses of a COLMAP model, with its own points or with triangulated features."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from jcr.capture.images import read_image
from jcr.capture.intrinsics import COLMAP_MODELS, entry_of_colmap, intrinsics_entry
from jcr.errors import InputError, RejectedError
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction
from jcr.sfm.colmap import matched_database
from jcr.sfm.model import poses_of, quiet_colmap, tracks_of, triangulated_model

MODEL_POINTS = 50
"""Least number of points of a reconstruction; with fewer in the model, features are triangulated."""


def reconstruct_given(
    capture: Capture, cameras: Path, seed: int = 0, progress: Progress = silent
) -> Reconstruction:
    """Reconstruct those images of a capture whose camera poses a COLMAP model (folder `cameras`) gives; hold the poses.

    Images are identified by their names, with folders where the file name alone is ambiguous. The points are those of
    the model, or with fewer than MODEL_POINTS are triangulated from SIFT matches. Raises InputError when the model
    contains fewer than three of the images, RejectedError when too few points can be triangulated.
    """
    model = read_model(cameras)
    names = {model.image(image_id).name: image_id for image_id in sorted(model.reg_image_ids())}
    found = _images_of(names, capture.images, str(cameras))
    known, ids = list(found), list(found.values())
    if len(known) < 3:
        raise InputError(f"{cameras}: knows {len(known)} of the capture's images; at least 3 are needed")
    recon_from_camera = poses_of(model, [image_id - 1 for image_id in ids])
    intrinsics = capture.intrinsics or shared_intrinsics(model, ids, capture.image_size, str(cameras))
    tracks = tracks_of(model, ids, capture.image_size)
    if len(tracks.points_in_recon) < MODEL_POINTS:
        some = capture.of_rows(np.array(known))
        images = [read_image(some.folder / name) for name in some.images]
        with matched_database(some, images, intrinsics, True, "sift", seed, progress) as (database, camera):
            model = triangulated_model(database, camera, dict(enumerate(recon_from_camera)))
            tracks = tracks_of(model, range(1, len(images) + 1), capture.image_size)
    if len(tracks.points_in_recon) < MODEL_POINTS:
        raise RejectedError(
            f"{cameras}: with its camera poses only {len(tracks.points_in_recon)} points can be triangulated",
            "check that it belongs to these images, or leave it out (--backend colmap)",
        )
    missing = [name for k, name in enumerate(capture.images) if k not in known]
    notes = (f"no camera pose is given for {', '.join(missing)}",) if missing else ()
    return Reconstruction(
        image_index=np.array(known),
        recon_from_camera=recon_from_camera,
        intrinsics=intrinsics,
        tracks=tracks,
        backend="given",
        notes=notes,
    )


def _images_of(names: Mapping[str, int], images: Sequence[str], where: str) -> dict[int, int]:
    """Return the id of the model's image for each image of the capture that the model has, by index in the capture.

    `names` are the ids of the model's images by name. The longest name that is the end of an image's path is its own;
    otherwise an image and a name with the same file name belong together.
    """
    by_path = {Path(name).parts: name for name in names}
    if len(by_path) < len(names):
        raise InputError(f"{where}: two of its images have one path; name them differently")
    chosen = dict[int, str]()
    for k, parts in enumerate(Path(image).parts for image in images):
        if name := next((by_path[parts[j:]] for j in range(len(parts)) if parts[j:] in by_path), None):
            chosen[k] = name
    by_file = dict[str, list[str]]()
    for name in names.keys() - set(chosen.values()):
        by_file.setdefault(Path(name).name, []).append(name)
    for k in range(len(images)):
        like = sorted(by_file.get(Path(images[k]).name, ()) if k not in chosen else ())
        if len(like) > 1:
            raise InputError(f"{where}: {like[0]} and {like[1]} may both be {images[k]}; name them by folder")
        if like:
            chosen[k] = like[0]
    owners = dict[str, int]()
    for k, name in sorted(chosen.items()):
        if (owner := owners.setdefault(name, k)) != k:
            raise InputError(f"{where}: {name} could be {images[owner]} or {images[k]}; name them by folder")
    return {k: names[name] for k, name in sorted(chosen.items())}


def read_model(folder: Path) -> pycolmap.Reconstruction:
    """Read a COLMAP model; raise InputError if it cannot be read."""
    with quiet_colmap():
        try:
            return pycolmap.Reconstruction(folder)
        except Exception as error:  # pycolmap passes on C++ exceptions of many types
            reason = str(error).strip().splitlines()[-1:] or ["damaged"]
            raise InputError(f"{folder}: no readable COLMAP model ({reason[0]}); export it again") from None


def shared_intrinsics(
    model: pycolmap.Reconstruction, image_ids: Iterable[int], size: tuple[int, int], where: str
) -> Intrinsics:
    """Return the intrinsics that the images of a COLMAP model with these ids share.

    Pixel (0, 0) is the centre of the top-left pixel, unlike in the model. Raises InputError if intrinsics differ, are
    for images of another size than `size` (width, height), or have a distortion model that jcr does not support.
    """
    cameras = [model.camera(model.image(image_id).camera_id) for image_id in image_ids]
    kinds = {(c.model.name, *map(float, (c.width, c.height, *c.params))) for c in cameras}
    if len(kinds) != 1:
        raise InputError(
            f"{where}: {len(kinds)} different cameras; reconstruct with --ImageReader.single_camera"
        )
    ((name, *numbers),) = kinds
    if name not in COLMAP_MODELS:
        raise InputError(f"{where}: unknown camera model {name}; run colmap image_undistorter")
    return intrinsics_entry(entry_of_colmap(name, numbers), where).record(size, where)
