"""The COLMAP back end: SIFT, exhaustive matching, incremental mapping, then dense pointmaps by plane sweep.

COLMAP has the centre of the top-left pixel at (0.5, 0.5); this file is the border where that half pixel,
the working size and COLMAP's camera models are converted.
"""

import math
import tempfile
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import ExifTags, Image

from jcr.capture.images import read_image
from jcr.errors import NotTrustedError
from jcr.geometry import inverse, transform
from jcr.reconstruct.lens import NO_DISTORTION, fold_distance_px, pinhole_inside, resized, undistort_image
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks

if TYPE_CHECKING:
    import pycolmap

HALF_PIXEL = 0.5
FILM_DIAGONAL_MM = 43.27
MIN_REGISTERED = 3
FEW_FEATURES = 1000
"""Per image; textured tabletops give 1500 to 5000, a chessboard before a plain background 400."""

Progress = Callable[[str, float], None]
"""Told the stage's name and the fraction of it that is done."""


@dataclass(frozen=True)
class ColmapOptions:
    """Structure from motion and dense pointmaps without a network."""

    working_size_px: int = 1600
    """Images whose long side is larger are reduced to this before features are extracted."""
    pointmap_size_px: int = 320
    """Long side of the dense pointmaps."""
    seed: int = 0
    """Same seed, same result, bit for bit."""
    device: str = "cpu"
    """Where the plane sweep runs: cpu or cuda."""
    verbose: bool = False
    """Let COLMAP's own log through."""


def reconstruct(
    capture: Capture, options: ColmapOptions | None = None, progress: Progress | None = None
) -> Reconstruction:
    """Camera poses, tracks and dense pointmaps of a capture, up to one similarity.

    Known intrinsics are held, unknown ones are estimated. Raises NotTrustedError when fewer than three images
    register (Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016; pycolmap's documentation).
    """
    options = options or ColmapOptions()
    report = progress or (lambda stage, fraction: None)
    images = [read_image(capture.folder / name) for name in capture.images]
    lens, notes = _usable_lens(capture.intrinsics)
    with _log_level(options.verbose), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        database = Path(folder) / "database.db"
        _write_database(database, images, lens or _guessed_lens(capture), lens is not None, options)
        _match(database, options)
        model = _map_incrementally(database, len(capture), lens is not None, options, report)
        if model is None:
            raise NotTrustedError(_why_not_registered(database, capture, notes))
    rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
    if missing := [name for row, name in enumerate(capture.images) if row not in rows]:
        notes.append(f"{len(rows)} of {len(capture)} images registered; not {', '.join(missing)}")
    if lens is None:
        lens = resized(_lens_of(model.camera(1)), *capture.image_size)
    recon_from_camera = inverse(np.stack([_rigid(model.image(row + 1).cam_from_world()) for row in rows]))
    tracks = _tracks(model, rows, lens)
    pinhole = pinhole_inside(lens, options.pointmap_size_px)
    colors = np.stack([undistort_image(images[row], lens, pinhole) for row in rows])
    shape = (len(rows), pinhole.height, pinhole.width)
    return Reconstruction(
        image_index=np.array(rows),
        recon_from_camera=recon_from_camera,
        intrinsics=lens,
        pointmap_intrinsics=pinhole,
        points_in_recon=np.zeros((*shape, 3)),
        confidence=np.zeros(shape),
        colors=colors,
        tracks=tracks,
        backend="colmap",
        notes=tuple(notes),
    )


def _usable_lens(lens: Intrinsics | None) -> tuple[Intrinsics | None, list[str]]:
    """The given intrinsics, without a distortion that has no inverse: with it, images do not register."""
    if lens is None or (fold := fold_distance_px(lens)) is None:
        return lens, []
    note = (
        f"the stored distortion folds over at {fold:.0f} px from the centre: not used; "
        "calibrate the lens again with points out to the corners, or give zero distortion"
    )
    return replace(lens, distortion=NO_DISTORTION), [note]


def _guessed_lens(capture: Capture) -> Intrinsics:
    """A starting point for unknown intrinsics: EXIF's 35 mm focal length, else 1.2 times the long side."""
    width, height = capture.image_size
    with Image.open(capture.folder / capture.images[0]) as opened:
        focal_35mm = opened.getexif().get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLengthIn35mmFilm, 0)
    focal = focal_35mm / FILM_DIAGONAL_MM * math.hypot(width, height) or 1.2 * max(width, height)
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)


def _write_database(
    database: Path,
    images: list[UInt8[ndarray, "h w 3"]],
    lens: Intrinsics,
    known: bool,
    options: ColmapOptions,
) -> None:
    """Features of every image, reduced to the working size, in a new database beside the reduced images."""
    import pycolmap

    scale = min(1.0, options.working_size_px / max(lens.width, lens.height))
    small = resized(lens, round(lens.width * scale), round(lens.height * scale))
    camera = _camera_of(small, known)
    names = [f"{row:05d}.png" for row in range(len(images))]
    # Images are entered beforehand: extraction threads would number them in the order in which they finish.
    with closing(pycolmap.Database.open(database)) as db:
        db.write_camera(camera, use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(camera.sensor_id)
        db.write_rig(rig, use_rig_id=True)
        for row, (name, pixels) in enumerate(zip(names, images, strict=True)):
            grey = Image.fromarray(pixels).convert("L")
            grey.resize((small.width, small.height), Image.Resampling.BOX).save(
                database.parent / name, compress_level=1
            )
            image = pycolmap.Image(name=name, camera_id=1, image_id=row + 1)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
    extraction = pycolmap.FeatureExtractionOptions()
    extraction.use_gpu = False
    pycolmap.extract_features(
        database,
        database.parent,
        names,
        pycolmap.CameraMode.SINGLE,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def _match(database: Path, options: ColmapOptions) -> None:
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    # The gripper's fingers, and text drawn over a picture, stay at the same pixels while the scene moves.
    verification.filter_stationary_matches = True
    pycolmap.match_exhaustive(
        database, matching, verification_options=verification, device=pycolmap.Device.cpu
    )


def _map_incrementally(
    database: Path, n_images: int, known: bool, options: ColmapOptions, report: Progress
) -> "pycolmap.Reconstruction | None":
    """The largest model with at least three images, else None."""
    import pycolmap

    pipeline = pycolmap.IncrementalPipelineOptions()
    pipeline.min_model_size = MIN_REGISTERED
    pipeline.multiple_models = False
    pipeline.extract_colors = False
    for seeded in (pipeline, pipeline.mapper, pipeline.triangulation):
        seeded.random_seed = options.seed
    pipeline.num_threads = pipeline.mapper.num_threads = 1  # sums in threads differ in the last bits
    if known:
        pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = False
        pipeline.mapper.abs_pose_refine_focal_length = pipeline.mapper.abs_pose_refine_extra_params = False
    registered = 2

    def count() -> None:
        nonlocal registered
        registered += 1
        report("mapping", min(registered / n_images, 1.0))

    models = pycolmap.incremental_mapping(
        database, database.parent, database.parent, pipeline, next_image_callback=count
    )
    large = [model for model in models.values() if model.num_reg_images() >= MIN_REGISTERED]
    return max(large, key=lambda model: model.num_reg_images(), default=None)


def _why_not_registered(database: Path, capture: Capture, notes: list[str]) -> str:
    """One line: how many registered, the likely reason, what to do instead."""
    import pycolmap

    with closing(pycolmap.Database.open(database)) as db:
        features = [db.num_keypoints_for_image(row + 1) for row in range(len(capture))]
        matched = db.num_verified_image_pairs()
    pairs = len(capture) * (len(capture) - 1) // 2
    median = int(np.median(features))
    if median < FEW_FEATURES:
        reason = (
            f"the images have little texture ({median} features in the median image, {FEW_FEATURES} are few)"
        )
    elif matched < len(capture) - 1:
        reason = f"images hardly overlap ({matched} of {pairs} pairs match)"
    else:
        reason = (
            f"{matched} of {pairs} pairs match, but agree on no common scene "
            "(a repeated pattern, something that moved, or wrong intrinsics)"
        )
    return (
        f"structure from motion registered none of {len(capture)} images: {'; '.join([reason, *notes])}; "
        "put textured objects or a newspaper on the table, overlap the views more, "
        "or take a foundation-model or marker back end"
    )


def _tracks(model: "pycolmap.Reconstruction", rows: list[int], lens: Intrinsics) -> Tracks:
    """Every observation of every triangulated point, in pixels of the original images."""
    row_of_image = {row + 1: position for position, row in enumerate(rows)}
    camera = model.camera(1)
    per_original_px = np.array([lens.width / camera.width, lens.height / camera.height])
    point_ids = sorted(model.point3D_ids())
    image, x_px, point = [], [], []
    for position, point_id in enumerate(point_ids):
        for element in model.point3D(point_id).track.elements:
            image.append(row_of_image[element.image_id])
            x_px.append(model.image(element.image_id).point2D(element.point2D_idx).xy)
            point.append(position)
    return Tracks(
        image=np.array(image),
        x_px=np.array(x_px) * per_original_px - HALF_PIXEL,
        point=np.array(point),
        points_in_recon=np.array([model.point3D(point_id).xyz for point_id in point_ids]),
    )


def _camera_of(lens: Intrinsics, known: bool) -> "pycolmap.Camera":
    """COLMAP's one camera: the given lens, or a focal length and two radial coefficients to refine."""
    import pycolmap

    centre = [lens.cx + HALF_PIXEL, lens.cy + HALF_PIXEL]
    if not known:
        name, params = "RADIAL", [lens.fx, *centre, 0.0, 0.0]
    elif any(lens.distortion):
        name, params = "FULL_OPENCV", [lens.fx, lens.fy, *centre, *lens.distortion, 0.0, 0.0, 0.0]
    else:
        name, params = "PINHOLE", [lens.fx, lens.fy, *centre]
    camera = pycolmap.Camera(model=name, width=lens.width, height=lens.height, params=params, camera_id=1)
    camera.has_prior_focal_length = known
    return camera


def _lens_of(camera: "pycolmap.Camera") -> Intrinsics:
    """Of a camera that `_camera_of` made for unknown intrinsics."""
    focal, cx, cy, k1, k2 = camera.params
    distortion = (k1, k2, 0.0, 0.0, 0.0)
    return Intrinsics(focal, focal, cx - HALF_PIXEL, cy - HALF_PIXEL, camera.width, camera.height, distortion)


def _rigid(a_from_b: "pycolmap.Rigid3d") -> Float[ndarray, "4 4"]:
    return transform(a_from_b.rotation.matrix(), a_from_b.translation)


@contextmanager
def _log_level(verbose: bool) -> Iterator[None]:
    """COLMAP writes its log to stderr through glog; only fatal errors unless `verbose`."""
    import pycolmap

    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = (pycolmap.logging.INFO if verbose else pycolmap.logging.FATAL).value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
