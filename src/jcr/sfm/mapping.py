"""Structure from motion with pycolmap: matching, mapping, bundle adjustment, alignment of the observations.

COLMAP has the centre of the top-left pixel at (0.5, 0.5); this file is the border where that half pixel,
the working size and COLMAP's camera models are converted.
Method: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

import math
import os
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.allocator import give_back
from jcr.camera import HALF_PIXEL, fold_distance_px, resized
from jcr.errors import RejectedError
from jcr.features.matchers import Matcher, write_matches
from jcr.features.sift import SiftFeatures, grey_of
from jcr.features.stage import Matched, match_with_robot
from jcr.progress import Progress
from jcr.records import Intrinsics, Reconstruction, Tracks
from jcr.sfm.missing_images import poses_of, rows_of, with_missing_images
from jcr.sfm.options import ColmapOptions
from jcr.sfm.track_refinement import align_tracks

_MIN_REGISTERED = 3
_MANY, _GROWN = 40, 1.3
"""Number of images above which COLMAP adjusts all only after growth by the second (its default is 1.1)."""
_ENOUGH = 1e-6
"""Relative change of a cost that ends an adjustment: with COLMAP's 0 it takes three times as long, and cameras come out
1e-5 of their distance elsewhere."""
_ROUGHLY = 1e-3
"""Relative change of the cost that ends an adjustment before the last one."""
_MOST_OBSERVATIONS = 60_000
"""Largest number of observations of a map; the robot's errors limit what more could add."""
_SIFT_THREADS = 8
"""Largest number of images whose features are found at once; each takes 240 bytes a pixel while it is worked on."""
_FEW_FEATURES = 1000
"""Per image; textured tabletops give 1500 to 5000, a chessboard before a plain background 400."""


def structure_from_motion(
    images: Sequence[UInt8[ndarray, "h w 3"]],
    all_intrinsics: Sequence[Intrinsics],
    known: bool,
    options: ColmapOptions,
    report: Progress,
    base_from_gripper: Float[ndarray, "n 4 4"],
    names: Sequence[str],
) -> Reconstruction:
    """Reconstruct camera poses and tracks of images of one camera; one seed gives one result, bit for bit.

    The gripper poses check the matches (`features.stage`); `names` are those of the images, for notes.

    `known` intrinsics are the only ones of `all_intrinsics`, do not fold over, and stay fixed; unknown ones are starting
    points, tried in turn, for a focal length and two radial coefficients. Raises RejectedError when fewer than three
    images register.
    """
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        database = Path(folder) / "database.db"
        cameras = enter(database, len(images), all_intrinsics, known, options.working_size_px)
        matcher = matcher_of(options, images, cameras[0], known, report)
        matched = matched_pairs(
            database, matcher, base_from_gripper, all_intrinsics[0], cameras, names, report
        )
        model = map_of_pairs(database, matcher, matched, cameras, base_from_gripper, report)
        if model is None or model.num_reg_images() < _MIN_REGISTERED:
            raise _not_registered(database, len(images), model)
        _thin(model, options.seed)
        adjust_robustly(model, known, _ROUGHLY)
        std_px = _align_observations(model, images, intrinsics_of(model.camera(1), all_intrinsics[0], known))
        adjust_robustly(model, fix_intrinsics=known)
        intrinsics, notes = intrinsics_of(model.camera(1), all_intrinsics[0], known), matched.notes
        if not known and fold_distance_px(intrinsics) is not None:
            notes += ("the views do not determine the distortion: it is taken as zero",)
            model.camera(1).params = [*model.camera(1).params[:3], 0.0, 0.0]
            adjust_robustly(model, fix_intrinsics=True)
            intrinsics = intrinsics_of(model.camera(1), intrinsics, known)
    report("mapping", 1.0)
    made = reconstruction_of(model, rows_of(model), intrinsics)
    tracks = replace(made.tracks, std_px=std_px)
    return replace(made, tracks=tracks, notes=notes, warnings=matched.warnings)


def reconstruction_of(
    model: pycolmap.Reconstruction, rows: Sequence[int], intrinsics: Intrinsics
) -> Reconstruction:
    """Return the cameras and tracks of a model's images at `rows`."""
    return Reconstruction(
        image_index=np.array(rows),
        recon_from_camera=poses_of(model, rows),
        intrinsics=intrinsics,
        tracks=tracks_of(model, [row + 1 for row in rows], (intrinsics.width, intrinsics.height)),
        backend="colmap",
    )


def map_of_pairs(
    database: Path,
    matcher: Matcher,
    matched: Matched,
    cameras: list[pycolmap.Camera],
    base_from_gripper: Float[ndarray, "n 4 4"],
    report: Progress,
    begun: pycolmap.Reconstruction | None = None,
) -> pycolmap.Reconstruction | None:
    """Return the map of the matched pairs by COLMAP's mapper, then by the predicted cameras of the images it left out.

    A map that is `begun` is continued with the images that it lacks and that match others.
    """
    count, model = len(base_from_gripper), begun
    matching = len({row for key in matched.geometries for row in key})

    def adjust(made: pycolmap.Reconstruction, scale_px: float) -> None:
        adjust_robustly(made, matcher.known, _ROUGHLY, scale_px)

    if model is None or model.num_reg_images() < matching:
        some = cameras if model is None else [model.camera(1)]
        model = map_incrementally(database, count, some, matcher.known, matcher.seed, report, model)
    if model is not None and model.num_reg_images() < matching:
        model = with_missing_images(database, model, base_from_gripper, matcher, adjust)
    return model


def enter(
    database: Path, count: int, all_intrinsics: Sequence[Intrinsics], known: bool, working_size_px: int
) -> list[pycolmap.Camera]:
    """Create a database of `count` images without features, and return COLMAP's cameras at the working size."""
    cameras = working_cameras(all_intrinsics, known, working_size_px)
    with closing(pycolmap.Database.open(database)) as db:
        db.write_camera(cameras[0], use_camera_id=True)
        rig = pycolmap.Rig(rig_id=1)
        rig.add_ref_sensor(cameras[0].sensor_id)
        db.write_rig(rig, use_rig_id=True)
        for row in range(count):
            image = pycolmap.Image(name=f"{row:05d}", camera_id=1, image_id=row + 1)
            db.write_image(image, use_image_id=True)
            frame = pycolmap.Frame(frame_id=row + 1, rig_id=1)
            frame.add_data_id(image.data_id)
            db.write_frame(frame, use_frame_id=True)
    return cameras


def working_cameras(
    all_intrinsics: Sequence[Intrinsics], known: bool, working_size_px: int
) -> list[pycolmap.Camera]:
    """Return COLMAP's cameras at the working size, whose long side is at most `working_size_px`."""
    width, height = all_intrinsics[0].width, all_intrinsics[0].height
    scale = min(1.0, working_size_px / max(width, height))
    size = round(width * scale), round(height * scale)
    return [camera_of(resized(intrinsics, *size), known) for intrinsics in all_intrinsics]


def matcher_of(
    options: ColmapOptions,
    images: Sequence[UInt8[ndarray, "h w 3"]],
    camera: pycolmap.Camera,
    known: bool,
    report: Progress,
) -> Matcher:
    """Return the matcher of some kind of features; SIFT is found here, networks find theirs when they match."""
    if options.features == "sift":
        return Matcher(sift_features(images, camera, report), np.ones(2), camera, known, options.seed)
    from jcr.features.xfeat import LearnedFeatures

    height, width = images[0].shape[:2]
    scale = np.array([camera.width / width, camera.height / height])
    return Matcher(LearnedFeatures(images, report), scale, camera, known, options.seed)


def sift_features(
    images: Sequence[UInt8[ndarray, "h w 3"]],
    camera: pycolmap.Camera,
    report: Progress,
) -> SiftFeatures:
    """Return the SIFT features of images at the size of a camera."""
    give_back()
    threads = min(os.cpu_count() or 1, _SIFT_THREADS)
    found = SiftFeatures(images, (camera.width, camera.height), threads, report)
    give_back()
    return found


def matched_pairs(
    database: Path,
    matcher: Matcher,
    base_from_gripper: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    cameras: list[pycolmap.Camera],
    names: Sequence[str],
    report: Progress,
) -> Matched:
    """Match, write the pairs for the mapper into the database, and put intrinsics from the gripper's angles first."""
    report("matching", 0.0)
    working = resized(intrinsics, cameras[0].width, cameras[0].height)
    matched = match_with_robot(
        matcher,
        base_from_gripper,
        working,
        names,
        (intrinsics.width, intrinsics.height),
        lambda fraction: report("matching", fraction),
    )
    write_matches(database, matcher.x_px, matched.geometries)
    if matched.intrinsics != working:
        cameras.insert(0, camera_of(matched.intrinsics, matcher.known))
    report("matching", 1.0)
    return matched


def map_incrementally(
    database: Path,
    n_images: int,
    cameras: list[pycolmap.Camera],
    known: bool,
    seed: int,
    report: Progress,
    begun: pycolmap.Reconstruction | None = None,
) -> pycolmap.Reconstruction | None:
    """Return the model with most images over all initial cameras, with relaxed thresholds if it has fewer than three.

    A model that is `begun` is resumed with the images that it lacks. The share of images in the model is reported; it
    falls back where another start is tried.
    """
    pipeline = pipeline_options(known, seed)
    if n_images > _MANY:
        pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = _GROWN
    mapper, folder = pipeline.mapper, database.parent
    best, registered, done = None, 0, 0
    if begun is not None:
        (folder / "begun").mkdir(exist_ok=True)
        begun.write(folder / "begun")

    def add(count: int) -> None:
        nonlocal done
        done += count
        report("mapping", min(done / n_images, 1.0))  # COLMAP may begin again with another pair

    for init_inliers, init_angle_deg, inliers in ((100, 16.0, 30), (50, 8.0, 15)):
        mapper.init_min_num_inliers, mapper.init_min_tri_angle = init_inliers, init_angle_deg
        mapper.abs_pose_min_num_inliers = inliers
        for camera in cameras:
            with closing(pycolmap.Database.open(database)) as db:
                db.update_camera(camera)
            done = 0
            add(0 if begun is None else begun.num_reg_images())
            models = pycolmap.incremental_mapping(
                database,
                folder,
                folder,
                pipeline,
                "" if begun is None else folder / "begun",
                initial_image_pair_callback=lambda: add(2),
                next_image_callback=lambda: add(1),
            )
            for model in models.values():
                if model.num_reg_images() > registered:
                    best, registered = model, model.num_reg_images()
            if registered == n_images:
                return best
        if registered >= _MIN_REGISTERED:
            return best
    return best


def pipeline_options(known: bool, seed: int) -> pycolmap.IncrementalPipelineOptions:
    """Return the options of COLMAP's incremental mapping; one seed gives one result."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    mapper = pipeline.mapper
    pipeline.min_model_size = 2
    pipeline.extract_colors = False
    # A first pair may bend unknown intrinsics until no third image fits: others are tried, the largest model counts.
    pipeline.multiple_models, pipeline.max_num_models = not known, 3
    pipeline.random_seed = mapper.random_seed = pipeline.triangulation.random_seed = seed
    pipeline.num_threads = mapper.num_threads = 1  # sums over threads differ in the last bits
    pipeline.ba_global_function_tolerance = pipeline.ba_local_function_tolerance = _ENOUGH
    if known:
        pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = False
        mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    return pipeline


def adjust_robustly(
    model: pycolmap.Reconstruction, fix_intrinsics: bool, enough: float = _ENOUGH, scale_px: float = 0.5
) -> None:
    """Adjust all cameras and points under a Cauchy loss of this scale, for COLMAP's least squares lets mismatches pull.

    It halves the error of the camera centres (0.20 to 0.11 mm rms over 12 simulated views). A relative change of the
    cost of less than `enough` ends it.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_extra_params = not fix_intrinsics
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = scale_px
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.function_tolerance = enough
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # pycolmap.bundle_adjustment() does the same, but enables the log again.
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _thin(model: pycolmap.Reconstruction, seed: int) -> None:
    """Delete points at random until the model has at most _MOST_OBSERVATIONS observations."""
    points = sorted(model.point3D_ids())
    if model.compute_num_observations() <= _MOST_OBSERVATIONS:
        return
    order = np.random.default_rng(seed).permutation(points)
    count = np.cumsum([model.point3D(int(point)).track.length() for point in order])
    for point in order[count > _MOST_OBSERVATIONS]:
        model.delete_point3D(int(point))


def _align_observations(
    model: pycolmap.Reconstruction, images: Sequence[UInt8[ndarray, "h w 3"]], intrinsics: Intrinsics
) -> Float[ndarray, " k"] | None:
    """Align the model's observations by least-squares matching, in the images that features were found in.

    The standard deviation of each is returned in pixels of the original images, in the order of `tracks_of`.
    """
    camera, rows = model.camera(1), rows_of(model)
    size, image_ids = (camera.width, camera.height), [row + 1 for row in rows]
    poses = poses_of(model, rows)
    greys = np.stack([grey_of(images[row], size) for row in rows])
    aligned = align_tracks(greys, tracks_of(model, image_ids, size), poses, resized(intrinsics, *size))
    for (row, index, _), x_px in zip(_observations(model, image_ids), aligned.x_px, strict=True):
        model.image(image_ids[row]).point2D(index).xy = x_px + HALF_PIXEL
    return None if aligned.std_px is None else intrinsics.width / camera.width * aligned.std_px


def _not_registered(database: Path, n_images: int, model: pycolmap.Reconstruction | None) -> RejectedError:
    """Return the error: number of registered images, likely reason and remedy."""
    with closing(pycolmap.Database.open(database)) as db:
        features = int(np.median([db.num_keypoints_for_image(row + 1) for row in range(n_images)]))
        matched = db.num_verified_image_pairs()
    if features < _FEW_FEATURES:
        reason = f"too little texture, {features} features in the median image where {_FEW_FEATURES} are few"
    elif matched < n_images - 1:
        reason = f"only {matched} of {math.comb(n_images, 2)} pairs of images share features"
    else:
        reason = (
            "the matches agree on no common scene: a repeated pattern, things that moved, or wrong intrinsics"
        )
    return RejectedError(
        f"structure from motion registered {model.num_reg_images() if model else 0} of {n_images} images ({reason})",
        "put textured objects or a newspaper on the table, let the views overlap more, or use a foundation-model back "
        "end or a marker",
        despite_texture=features >= _FEW_FEATURES,
    )


def tracks_of(model: pycolmap.Reconstruction, image_ids: Sequence[int], size: tuple[int, int]) -> Tracks:
    """Return all observations of the points by images `image_ids`, in pixels of images of `size`."""
    camera = model.camera(model.image(image_ids[0]).camera_id)
    original_from_working = np.array([size[0] / camera.width, size[1] / camera.height])
    seen = _observations(model, image_ids)
    image, _, point = zip(*seen, strict=True) if seen else ((), (), ())
    x_px = [model.image(image_ids[row]).point2D(index).xy for row, index, _ in seen]
    return Tracks(
        image=np.array(image, dtype=int),
        x_px=np.reshape(x_px, (-1, 2)) * original_from_working - HALF_PIXEL,
        point=np.array(point, dtype=int),
        points_in_recon=np.reshape(
            [model.point3D(point_id).xyz for point_id in sorted(model.point3D_ids())], (-1, 3)
        ),
    )


def _observations(model: pycolmap.Reconstruction, image_ids: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return (row of `image_ids`, row of the image's keypoints, row of the points by id) of each observation."""
    row_of = {image_id: row for row, image_id in enumerate(image_ids)}
    return [
        (row_of[element.image_id], element.point2D_idx, point)
        for point, point_id in enumerate(sorted(model.point3D_ids()))
        for element in model.point3D(point_id).track.elements
        if element.image_id in row_of
    ]


def camera_of(intrinsics: Intrinsics, known: bool) -> pycolmap.Camera:
    """Return COLMAP's camera: the given intrinsics, or a focal length and two radial coefficients to refine."""
    centre = [intrinsics.cx + HALF_PIXEL, intrinsics.cy + HALF_PIXEL]
    if not known:
        name, params = "RADIAL", [intrinsics.fx, *centre, 0.0, 0.0]
    elif intrinsics.model == "fisheye":
        name, params = "OPENCV_FISHEYE", [intrinsics.fx, intrinsics.fy, *centre, *intrinsics.distortion]
    elif any(intrinsics.distortion):
        eight = [*intrinsics.distortion, 0.0, 0.0, 0.0][:8]
        name, params = "FULL_OPENCV", [intrinsics.fx, intrinsics.fy, *centre, *eight]
    else:
        name, params = "PINHOLE", [intrinsics.fx, intrinsics.fy, *centre]
    camera = pycolmap.Camera(
        model=name, width=intrinsics.width, height=intrinsics.height, params=params, camera_id=1
    )
    camera.has_prior_focal_length = known
    return camera


def intrinsics_of(camera: pycolmap.Camera, like: Intrinsics, known: bool) -> Intrinsics:
    """Return the intrinsics of a camera of `camera_of` for images of the size of `like`, which are the known ones."""
    if known:
        return like
    focal, cx, cy, k1, k2 = (float(p) for p in camera.params)
    distortion = (k1, k2, 0.0, 0.0, 0.0)
    centre = cx - HALF_PIXEL, cy - HALF_PIXEL
    intrinsics = Intrinsics(focal, focal, *centre, camera.width, camera.height, distortion)
    return resized(intrinsics, like.width, like.height)


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Silence COLMAP's log, which it writes to stderr through glog, but for fatal errors.

    Importing pycolmap replaces what SIGTERM does by glog's handler, which prints a page of C++ frames. Python does not
    know of it: what Python has for the signal is set again, and glog's handler is gone for good.
    """
    on_termination = signal.getsignal(signal.SIGTERM)
    # Python sets signals in its main thread alone, and none that a host program in C handled before it.
    if on_termination is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, on_termination)
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before
