"""The back end `given`: camera poses of a COLMAP model, with its own points or with triangulated features."""

from pathlib import Path

import numpy as np

from jcr.capture.formats import colmap
from jcr.capture.images import read_image
from jcr.errors import InputError, RejectedError
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction
from jcr.sfm.colmap import matched_database
from jcr.sfm.model import tracks_of, triangulated_model

MIN_POINTS = 50
"""Least number of points of a reconstruction; with fewer in the model, features are triangulated."""


def reconstruct_given(
    capture: Capture, cameras: Path, seed: int = 0, progress: Progress | None = None
) -> Reconstruction:
    """Reconstruct those images of a capture whose camera poses a COLMAP model (folder `cameras`) gives; hold the poses.

    Images are identified by their names. The points are those of the model, or with fewer than MIN_POINTS are
    triangulated from SIFT matches. Raises InputError when the model contains fewer than three of the images,
    RejectedError when too few points can be triangulated.
    """
    report = progress or silent
    names, recon_from_camera = colmap.read_registered_cameras(cameras)
    # An image's name with folders matches the end of its path; otherwise the file name alone must match.
    by_path = {Path(name).parts: row for row, name in enumerate(names)}
    by_file = {Path(name).name: row for row, name in enumerate(names)}
    known, rows = list[int](), list[int]()
    for k, parts in enumerate(Path(image).parts for image in capture.images):
        ends = (by_path[parts[j:]] for j in range(len(parts)) if parts[j:] in by_path)
        if (row := next(ends, by_file.get(parts[-1]))) is not None:
            known.append(k)
            rows.append(row)
    if len(known) < 3:
        raise InputError(f"{cameras}: knows {len(known)} of the capture's images; at least 3 are needed")
    recon_from_camera = recon_from_camera[rows]
    intrinsics = capture.intrinsics or colmap.read_intrinsics(cameras, capture.image_size)
    model = colmap.read_model(cameras)
    id_of = {model.image(image_id).name: image_id for image_id in model.reg_image_ids()}
    tracks = tracks_of(model, [id_of[names[row]] for row in rows], capture.image_size)
    if len(tracks.points_in_recon) < MIN_POINTS:
        some = capture.of_rows(np.array(known))
        images = [read_image(some.folder / name) for name in some.images]
        with matched_database(some, images, intrinsics, True, "sift", seed, report) as (database, camera):
            model = triangulated_model(database, camera, dict(enumerate(recon_from_camera)))
            tracks = tracks_of(model, range(1, len(images) + 1), capture.image_size)
    if len(tracks.points_in_recon) < MIN_POINTS:
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
