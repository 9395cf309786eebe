"""The back end `given`: camera poses of a COLMAP model, with its points or with triangulated features."""

import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.formats import colmap
from jcr.capture.images import read_image
from jcr.errors import InputError, RejectedError
from jcr.features.pairs import all_pairs
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks
from jcr.sfm.colmap import matcher_of
from jcr.sfm.model import quiet_colmap, tracks_of, triangulated_model, working_cameras, write_database

MIN_POINTS = 50


def reconstruct_given(
    capture: Capture, cameras: Path, seed: int = 0, progress: Progress | None = None
) -> Reconstruction:
    """Reconstruct the images that the model at `cameras` contains, with its poses fixed.

    Raises InputError when the model knows fewer than three, RejectedError when nothing can be triangulated.
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
        images = [read_image(capture.folder / capture.images[k]) for k in known]
        tracks = _triangulated(images, intrinsics, recon_from_camera, seed, report)
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
    """Return a function from an image's path to the row of that name, with its folders where stated, or None."""
    by_path = {Path(name).parts: row for row, name in enumerate(names)}
    by_name = {Path(name).name: row for row, name in enumerate(names)}

    def row_of(image: str) -> int | None:
        parts = Path(image).parts
        exact = (by_path[parts[k:]] for k in range(len(parts)) if parts[k:] in by_path)
        return next(exact, by_name.get(parts[-1]))

    return row_of


def _own_tracks(cameras: Path, names: Sequence[str], size: tuple[int, int]) -> Tracks:
    """Return the observations that a COLMAP model holds."""
    model = colmap.read_model(cameras)
    id_of = {model.image(image_id).name: image_id for image_id in model.reg_image_ids()}
    return tracks_of(model, [id_of[name] for name in names], size)


def _triangulated(
    images: Sequence[UInt8[ndarray, "h w 3"]],
    intrinsics: Intrinsics,
    recon_from_camera: Float[ndarray, "m 4 4"],
    seed: int,
    report: Progress,
) -> Tracks:
    """Triangulate points of matched features, with intrinsics and cameras fixed."""
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        (camera,) = working_cameras([intrinsics], True)
        matcher = matcher_of(images, camera, True, "sift", seed, report)
        report("matching", 0.0)
        pairs, none = all_pairs(len(images)), np.zeros((len(images), len(images)), bool)
        geometries = matcher.geometries(pairs, np.zeros((len(pairs), 2)), repeats=none)
        database = write_database(Path(folder), camera, matcher.x_px, geometries)
        model = triangulated_model(database, camera, dict(enumerate(recon_from_camera)))
        return tracks_of(model, range(1, len(images) + 1), (intrinsics.width, intrinsics.height))
