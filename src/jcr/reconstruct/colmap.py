"""The COLMAP back end: SIFT, exhaustive matching, incremental mapping, then dense pointmaps by plane sweep.

COLMAP has the centre of the top-left pixel at (0.5, 0.5); this file is the border where that half pixel,
the working size and COLMAP's camera models are converted.
"""

import math
import tempfile
from collections.abc import Iterator
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
from jcr.progress import Progress
from jcr.reconstruct.lens import (
    NO_DISTORTION,
    fold_distance_px,
    pinhole_inside,
    rays,
    resized,
    undistort_image,
)
from jcr.records import Capture, Intrinsics, Reconstruction, Tracks

if TYPE_CHECKING:
    import pycolmap

_HALF_PIXEL = 0.5
_FILM_DIAGONAL_MM = 43.27
_MIN_REGISTERED = 3
_FEW_FEATURES = 1000
"""Per image; textured tabletops give 1500 to 5000, a chessboard before a plain background 400."""
_START_FOCALS = (0.8, 0.5, 1.2)
"""In long sides, for a camera of which nothing is known. COLMAP's 1.2 alone fails on two of three real wrist
cameras (true values 0.5 to 0.7); from 0.8 all three converge."""


@dataclass(frozen=True)
class ColmapOptions:
    """Structure from motion and dense pointmaps without a network."""

    working_size_px: int = 1600
    """Images whose long side is larger are reduced to this before features are extracted."""
    pointmap_size_px: int = 400
    """Long side of the dense pointmaps."""
    neighbours: int = 5
    """Other images that each is compared with for its pointmap."""
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
    given, notes = _usable_lens(capture.intrinsics)
    starts = [given] if given else _guessed_lenses(capture)
    with _log_level(options.verbose), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        database = Path(folder) / "database.db"
        report("features", 0.0)
        cameras = _extract(database, images, starts, given is not None, options)
        report("matching", 0.0)
        _match(database, options)
        report("mapping", 0.0)
        model = _map_incrementally(database, len(images), cameras, given is not None, options)
        if model is None or model.num_reg_images() < _MIN_REGISTERED:
            raise NotTrustedError(_why_not_registered(database, len(images), model, notes))
        _adjust_robustly(model, given is not None)
    report("mapping", 1.0)
    rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
    if missing := [name for row, name in enumerate(capture.images) if row not in rows]:
        notes.append(f"{len(rows)} of {len(capture)} images registered; not {', '.join(missing)}")
    lens = given or resized(_lens_of(model.camera(1)), *capture.image_size)
    camera_from_recon = [model.image(row + 1).cam_from_world() for row in rows]
    recon_from_camera = inverse(
        np.stack([transform(motion.rotation.matrix(), motion.translation) for motion in camera_from_recon])
    )
    pinhole = pinhole_inside(lens, options.pointmap_size_px)
    colors = np.stack([undistort_image(images[row], lens, pinhole) for row in rows])
    tracks = _tracks(model, rows, lens)
    points, confidence = _pointmaps(colors, recon_from_camera, pinhole, tracks, options, report)
    return Reconstruction(
        image_index=np.array(rows),
        recon_from_camera=recon_from_camera,
        intrinsics=lens,
        pointmap_intrinsics=pinhole,
        points_in_recon=points,
        confidence=confidence,
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


def _guessed_lenses(capture: Capture) -> list[Intrinsics]:
    """Starting points for unknown intrinsics: EXIF's 35 mm focal length if there is one, then a ladder."""
    width, height = capture.image_size
    with Image.open(capture.folder / capture.images[0]) as opened:
        exif = opened.getexif().get_ifd(ExifTags.IFD.Exif)
    focal_35mm = exif.get(ExifTags.Base.FocalLengthIn35mmFilm)
    focals = [focal_35mm / _FILM_DIAGONAL_MM * math.hypot(width, height)] if focal_35mm else []
    focals += [factor * max(width, height) for factor in _START_FOCALS]
    return [Intrinsics(f, f, (width - 1) / 2, (height - 1) / 2, width, height) for f in focals]


def _extract(
    database: Path,
    images: list[UInt8[ndarray, "h w 3"]],
    lenses: list[Intrinsics],
    known: bool,
    options: ColmapOptions,
) -> "list[pycolmap.Camera]":
    """Features of every image, at the working size, in a new database; and the lenses as COLMAP's cameras."""
    import pycolmap

    scale = min(1.0, options.working_size_px / max(lenses[0].width, lenses[0].height))
    size = round(lenses[0].width * scale), round(lenses[0].height * scale)
    cameras = [_camera_of(resized(lens, *size), known) for lens in lenses]
    names = [f"{row:05d}.png" for row in range(len(images))]
    # Images are entered beforehand: extraction threads would number them in the order in which they finish.
    with closing(pycolmap.Database.open(database)) as db:
        db.write_camera(cameras[0], use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(cameras[0].sensor_id)
        db.write_rig(rig, use_rig_id=True)
        for row, (name, pixels) in enumerate(zip(names, images, strict=True)):
            grey = Image.fromarray(pixels).convert("L").resize(size, Image.Resampling.BOX)
            grey.save(database.parent / name, compress_level=1)
            image = pycolmap.Image(name=name, camera_id=1, image_id=row + 1)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
    pycolmap.extract_features(
        database, database.parent, names, pycolmap.CameraMode.SINGLE, device=pycolmap.Device.cpu
    )
    return cameras


def _match(database: Path, options: ColmapOptions) -> None:
    import pycolmap

    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = options.seed
    # With COLMAP's 15, views of a board were registered by its repeated squares, 30 cm from their place.
    verification.min_num_inliers = 25
    # The gripper's fingers, or text drawn into the pictures, keep their pixels while the scene moves.
    verification.filter_stationary_matches = True
    pycolmap.match_exhaustive(database, verification_options=verification, device=pycolmap.Device.cpu)


def _map_incrementally(
    database: Path, n_images: int, cameras: "list[pycolmap.Camera]", known: bool, options: ColmapOptions
) -> "pycolmap.Reconstruction | None":
    """The model with most images over all starting cameras; with relaxed demands if that is below three."""
    import pycolmap

    best = None
    for relaxed in (False, True):
        pipeline = pycolmap.IncrementalPipelineOptions()
        pipeline.min_model_size = 2
        pipeline.multiple_models = False
        pipeline.extract_colors = False
        for seeded in (pipeline, pipeline.mapper, pipeline.triangulation):
            seeded.random_seed = options.seed
        pipeline.num_threads = pipeline.mapper.num_threads = 1  # sums over threads differ in the last bits
        if known:
            pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = False
            pipeline.mapper.abs_pose_refine_focal_length = False
            pipeline.mapper.abs_pose_refine_extra_params = False
        if relaxed:
            pipeline.mapper.init_min_num_inliers = 50
            pipeline.mapper.init_min_tri_angle = 8.0
            pipeline.mapper.abs_pose_min_num_inliers = 15
        for camera in cameras:
            with closing(pycolmap.Database.open(database)) as db:
                db.update_camera(camera)
            models = pycolmap.incremental_mapping(database, database.parent, database.parent, pipeline)
            for model in models.values():
                if best is None or model.num_reg_images() > best.num_reg_images():
                    best = model
            if best and best.num_reg_images() == n_images:
                return best
        if best and best.num_reg_images() >= _MIN_REGISTERED:
            return best
    return best


def _adjust_robustly(model: "pycolmap.Reconstruction", known: bool) -> None:
    """One more bundle adjustment under a Cauchy loss: COLMAP's own is least squares, which mismatches pull.

    On 12 simulated views it halves the error of the camera centres (0.20 to 0.11 mm rms).
    """
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not known
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 0.5
    options.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment() does the same, but turns the log back on.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _why_not_registered(
    database: Path, n_images: int, model: "pycolmap.Reconstruction | None", notes: list[str]
) -> str:
    """One line: how many registered, the likely reason, what to do instead."""
    import pycolmap

    with closing(pycolmap.Database.open(database)) as db:
        features = int(np.median([db.num_keypoints_for_image(row + 1) for row in range(n_images)]))
        matched = db.num_verified_image_pairs()
    if features < _FEW_FEATURES:
        reason = f"too little texture, {features} features in the median image where {_FEW_FEATURES} are few"
    elif matched < n_images - 1:
        reason = f"only {matched} of {math.comb(n_images, 2)} pairs of images share features"
    else:
        reason = (
            "the matches agree on no common scene: a repeated pattern, things that moved, or a wrong lens"
        )
    return (
        f"structure from motion registered {model.num_reg_images() if model else 0} of {n_images} images "
        f"({'; '.join([reason, *notes])}); put textured objects or a newspaper on the table, "
        "let the views overlap more, or use a foundation-model back end or a marker"
    )


def _pointmaps(
    colors: UInt8[ndarray, "m h w 3"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    pinhole: Intrinsics,
    tracks: Tracks,
    options: ColmapOptions,
    report: Progress,
) -> tuple[Float[ndarray, "m h w 3"], Float[ndarray, "m h w"]]:
    from jcr.reconstruct.planesweep import PlaneSweepOptions, choose_neighbours, plane_sweep, sweep_planes

    depth, confidence = plane_sweep(
        colors,
        recon_from_camera,
        pinhole,
        choose_neighbours(tracks, recon_from_camera, options.neighbours),
        sweep_planes(tracks, recon_from_camera),
        PlaneSweepOptions(device=options.device),
        lambda fraction: report("dense depth", fraction),
    )
    x_in_camera = depth[..., None] * rays(pinhole)
    x_in_recon = np.einsum("mij,mhwj->mhwi", recon_from_camera[:, :3, :3], x_in_camera)
    return x_in_recon + recon_from_camera[:, None, None, :3, 3], confidence


def _tracks(model: "pycolmap.Reconstruction", rows: list[int], lens: Intrinsics) -> Tracks:
    """Every observation of every triangulated point, in pixels of the original images."""
    camera = model.camera(1)
    original_from_working = np.array([lens.width / camera.width, lens.height / camera.height])
    point_ids = sorted(model.point3D_ids())
    seen = [
        (
            rows.index(element.image_id - 1),
            model.image(element.image_id).point2D(element.point2D_idx).xy,
            point,
        )
        for point, point_id in enumerate(point_ids)
        for element in model.point3D(point_id).track.elements
    ]
    image, x_px, point = zip(*seen, strict=True)
    return Tracks(
        image=np.array(image),
        x_px=np.array(x_px) * original_from_working - _HALF_PIXEL,
        point=np.array(point),
        points_in_recon=np.array([model.point3D(point_id).xyz for point_id in point_ids]),
    )


def _camera_of(lens: Intrinsics, known: bool) -> "pycolmap.Camera":
    """COLMAP's one camera: the given lens, or a focal length and two radial coefficients to refine."""
    import pycolmap

    centre = [lens.cx + _HALF_PIXEL, lens.cy + _HALF_PIXEL]
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
    focal, cx, cy, k1, k2 = (float(p) for p in camera.params)
    distortion = (k1, k2, 0.0, 0.0, 0.0)
    return Intrinsics(
        focal, focal, cx - _HALF_PIXEL, cy - _HALF_PIXEL, camera.width, camera.height, distortion
    )


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
