"""The back end `given`: camera poses of a COLMAP model, with its own points or with triangulated features."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from jcr.capture.formats import colmap
from jcr.capture.images import read_image
from jcr.errors import InputError, RejectedError
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction, Tracks
from jcr.sfm.colmap import matched_database
from jcr.sfm.model import tracks_of, triangulated_model

MIN_POINTS = 50
"""Least number of points of a reconstruction; with fewer in the model, features are triangulated."""


def reconstruct_given(
    capture: Capture, cameras: Path, seed: int = 0, progress: Progress | None = None
) -> Reconstruction:
    """Reconstruct those images of a capture whose camera poses a COLMAP model (folder `cameras`) gives; hold the poses.

    Raises InputError when the model contains fewer than three, RejectedError when too few points can be triangulated.
    """
    report = progress or silent
    names, recon_from_camera = colmap.read_registered_cameras(cameras)
    row_of = _rows(names)
    known = [k for k, name in enumerate(capture.images) if row_of(name) is not None]
    if len(known) < 3:
        raise InputError(
            f"{cameras}: knows {len(known)} of the capture's images by name; at least 3 are needed"
        )
    rows = [row for k in known if (row := row_of(capture.images[k])) is not None]
    recon_from_camera = recon_from_camera[rows]
    intrinsics = capture.intrinsics or colmap.read_intrinsics(cameras, capture.image_size)
    tracks = _own_tracks(cameras, [names[row] for row in rows], capture.image_size)
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


def _rows(names: Sequence[str]) -> Callable[[str], int | None]:
    """Return a function from an image's path to the row of its name in `names`, or None.

    A name with folders matches the end of the path; otherwise the file name alone must match.
    """
    by_path = {Path(name).parts: row for row, name in enumerate(names)}
    by_name = {Path(name).name: row for row, name in enumerate(names)}

    def row_of(image: str) -> int | None:
        parts = Path(image).parts
        exact = (by_path[parts[k:]] for k in range(len(parts)) if parts[k:] in by_path)
        return next(exact, by_name.get(parts[-1]))

    return row_of


def _own_tracks(cameras: Path, names: Sequence[str], size: tuple[int, int]) -> Tracks:
    """Return the tracks of the COLMAP model at path `cameras` in the images `names`, in pixels of images of `size`.

    The size is (width, height).
    """
    model = colmap.read_model(cameras)
    id_of = {model.image(image_id).name: image_id for image_id in model.reg_image_ids()}
    return tracks_of(model, [id_of[name] for name in names], size)
