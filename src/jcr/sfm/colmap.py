"""The back end `colmap`: matching, incremental mapping, bundle adjustment and least-squares matching of observations.

Method: Schönberger and Frahm, "Structure-from-Motion Revisited", CVPR 2016.
"""

import math
import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float, UInt8
from numpy import ndarray
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from jcr.camera import (
    HALF_PIXEL,
    USUAL_FOCAL,
    fold_distance_px,
    guessed_intrinsics,
    resized,
    usable_intrinsics,
    without_distortion,
)
from jcr.capture.images import read_image
from jcr.errors import RejectedError, first_few
from jcr.extras import extra
from jcr.features.matchers import FeatureName, Geometries, Matcher
from jcr.features.pair_search import MatchedPairs, match_alone, match_with_robot
from jcr.features.sift import WORKING_SIZE_PX, SiftFeatures, grey_of
from jcr.memory import give_back
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction
from jcr.sfm.missing_images import ROUGHLY, model_near_cameras, nearer_to_robot, with_missing_images
from jcr.sfm.model import (
    COST_TOLERANCE,
    adjust_robustly,
    colmap_camera,
    intrinsics_of,
    observations,
    poses_of,
    quiet_colmap,
    reconstruction_of,
    rows_of,
    tracks_of,
    working_cameras,
    write_database,
)

_START_FOCALS = (USUAL_FOCAL, 0.5, 1.2)
"""Initial focal lengths for unknown intrinsics, as multiples of the long side. COLMAP's 1.2 alone fails on two of three
real wrist cameras (true values 0.5 to 0.7); from 0.8 all three converge."""
_MIN_REGISTERED = 3
_MADE_AGAIN = (
    "objects seem to have moved while the images were taken: the first map contradicted the gripper poses, and the map "
    "was made again without the matches that contradict them; keep everything in view at rest and take the images "
    "again, or do not use the map near these objects"
)
"""Warning about a map that was replaced by one near the cameras that the gripper poses predict."""
_MANY, _GROWN = 40, 1.3
"""Number of images above which COLMAP adjusts the whole map only after growth by a factor _GROWN (its default: 1.1)."""
_MOST_OBSERVATIONS = 60_000
"""Largest number of observations of a map; more would not help, because the robot's errors limit the accuracy."""
_MOST_MATCHED = 120_000
"""Largest number of matched keypoints that are mapped; adjusting a point costs the square of its number of images."""
MOST_ALONE = 40
"""Largest number of images that are reconstructed without poses; all pairs are matched, 780 of forty images."""
_SIFT_THREADS = 8
"""Largest number of images whose features are found at once; each takes 240 bytes per pixel meanwhile."""
_FEW_FEATURES = 1000
"""Number of features per image below which texture is too scarce; textured tabletops give 1500 to 5000, a chessboard
before a plain background 400."""

POOR_PX = 1.0
"""Mean reprojection error (px, at the working size) above which given intrinsics are compared with estimated ones. Eight
real captures have 0.3 to 0.8 px; focal lengths that are wrong by 25 % or more give 1.0 to 1.3 px. With 0.5, five of the
eight are mapped twice for nothing; with 1.5, none is noticed, because COLMAP leaves worse points out."""


def reconstruct_colmap(
    capture: Capture,
    features: FeatureName = "sift",
    seed: int = 0,
    progress: Progress = silent,
    working_size_px: int = WORKING_SIZE_PX,
) -> Reconstruction:
    """Reconstruct camera poses and tracks of a capture; frame and unit are arbitrary, and a seed fixes every bit.

    The gripper poses check the matches (features/pair_search.py). The images are reduced to a long side of
    `working_size_px`. Known intrinsics are held, unknown ones are estimated. Known ones with which fewer than half of
    the images register, or points are more than POOR_PX off, are estimated too, if more images register then, or
    points are half as far off. Raises RejectedError when fewer than three images register, with their number, the
    likely reason and a remedy.
    """
    images = [read_image(capture.folder / name) for name in capture.images]
    all_intrinsics, known, warnings = starting_intrinsics(capture)
    with quiet_colmap():
        camera = working_cameras(all_intrinsics, known, working_size_px)[0]
        matcher = matcher_of(images, camera, known, features, seed, progress)

        def mapped(
            start: list[Intrinsics], matcher: Matcher
        ) -> tuple[MatchedPairs, pycolmap.Reconstruction | None]:
            """Match and map the images with the intrinsics `start`, which are tried in turn."""
            cameras = working_cameras(start, matcher.known, working_size_px)
            return map_images(matcher, capture.base_from_gripper, start[0], cameras, capture.images, progress)

        matched, model = mapped(all_intrinsics, matcher)
        like, registered = all_intrinsics[0], 0 if model is None else model.num_reg_images()
        error_px = 0.0 if model is None else model.compute_mean_reprojection_error()
        if known and (2 * registered < len(images) or error_px > POOR_PX):
            # Wrong intrinsics spoil the matches' verification and the map; their focal length is nearly right mostly.
            start = [without_distortion(like), *starting_intrinsics(replace(capture, intrinsics=None))[0]]
            free = Matcher(matcher.features, working_cameras(start, False, working_size_px)[0], False, seed)
            others, other = mapped(start, free)
            count = 0 if other is None else other.num_reg_images()
            left_px = 0.0 if other is None else other.compute_mean_reprojection_error()
            found = None
            if (hindering := registered_with(registered, count, len(images))) is not None:
                found = hindering
            elif count >= max(registered, _MIN_REGISTERED) and left_px < error_px / 2:
                found = f"the points are {error_px:.1f} px off, with estimated ones {left_px:.1f} px"
            if found is not None:
                matched, model, matcher, like, known = others, other, free, start[0], False
                warnings = (intrinsics_not_used(found),)
        if model is None or model.num_reg_images() < _MIN_REGISTERED:
            raise _not_registered(matcher, matched, model).with_more(*warnings)
        made = _adjusted(model, images, like, known, seed)
    progress("mapping", 1.0)
    notes = matched.notes + made.notes
    if missing := [name for row, name in enumerate(capture.images) if row not in made.image_index]:
        notes += (f"{len(made.image_index)} of {len(capture)} images registered; not {first_few(missing)}",)
    return replace(made, notes=notes, warnings=(*warnings, *matched.warnings))


def registered_with(given: int, estimated: int, images: int) -> str | None:
    """Return how many of the `images` register with `given` and with `estimated` intrinsics, in words.

    None unless with estimated ones half of the images and twice as many register, so that the given ones are wrong.
    """
    if estimated <= max(2 * given, images // 2):
        return None
    return f"{given} of {images} images register, with estimated ones {estimated}"


def intrinsics_not_used(found: str) -> str:
    """Return the warning that the given intrinsics are not used, because of what was `found` with them."""
    remedy = "calibrate the camera again at this resolution, or leave them out"
    return f"the given intrinsics are not used: with them {found}; {remedy}"


def reconstruct_alone(capture: Capture, seed: int = 0, progress: Progress = silent) -> Reconstruction:
    """Reconstruct camera poses and tracks of a capture from its images alone, without its gripper poses.

    More images than MOST_ALONE are reconstructed in part: that many, spread over their order. The rest is as in
    `reconstruct_colmap`.
    """
    rows = np.unique(np.linspace(0, len(capture) - 1, min(len(capture), MOST_ALONE)).round().astype(int))
    images = [read_image(capture.folder / capture.images[row]) for row in rows]
    all_intrinsics, known, warnings = starting_intrinsics(capture)
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        cameras = working_cameras(all_intrinsics, known)
        matcher = matcher_of(images, cameras[0], known, "sift", seed, progress)
        working = resized(all_intrinsics[0], cameras[0].width, cameras[0].height)
        matched = match_alone(matcher, working, len(images), progress)
        matched = replace(matched, geometries=_thinned(matched.geometries, len(images), seed))
        database = write_database(Path(folder), cameras[0], matcher.features.x_px, matched.geometries)
        model = _map_incrementally(database, cameras, matcher, progress, None)
        if model is None or model.num_reg_images() < _MIN_REGISTERED:
            raise _not_registered(matcher, matched, model).with_more(*warnings)
        made = _adjusted(model, images, all_intrinsics[0], known, seed)
    progress("mapping", 1.0)
    return replace(made, image_index=rows[made.image_index], warnings=warnings)


def reconstruct_near_cameras(
    capture: Capture,
    recon_from_camera: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    known: bool,
    features: FeatureName,
    report: Progress = silent,
) -> Reconstruction | None:
    """Return cameras and tracks adjusted from predicted poses of all images, by matches of the images.

    The result is None where an image has too few points (missing_images.LEAST_SHARED). `intrinsics` are held if
    `known`, and otherwise are the initial estimate.
    """
    images = [read_image(capture.folder / name) for name in capture.images]
    with matched_database(capture, images, intrinsics, known, features, 0, report) as (database, camera):
        model = model_near_cameras(database, camera, dict(enumerate(recon_from_camera)), known)
        if model.num_reg_images() < len(images):
            return None
        return _adjusted(model, images, intrinsics, known, 0)


@contextmanager
def matched_database(
    capture: Capture,
    images: Sequence[UInt8[ndarray, "h w 3"]],
    intrinsics: Intrinsics,
    known: bool,
    features: FeatureName,
    seed: int,
    report: Progress,
) -> Iterator[tuple[Path, pycolmap.Camera]]:
    """Match a capture's images; yield the path of a COLMAP database of the verified matches, and its camera.

    The camera is for images of the working size (`working_cameras`). The database exists, and COLMAP's log is silent,
    within the context. `intrinsics` are given if `known`, else an initial estimate.
    """
    with quiet_colmap(), tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        (camera,) = working_cameras([intrinsics], known)
        matcher = matcher_of(images, camera, known, features, seed, report)
        working = resized(intrinsics, camera.width, camera.height)
        matched = match_with_robot(matcher, capture.base_from_gripper, working, capture.images, report)
        yield write_database(Path(folder), camera, matcher.features.x_px, matched.geometries), camera


def _adjusted(
    model: pycolmap.Reconstruction,
    images: Sequence[UInt8[ndarray, "h w 3"]],
    like: Intrinsics,
    known: bool,
    seed: int,
) -> Reconstruction:
    """Return the reconstruction of COLMAP's model after its observations are refined by least-squares matching.

    All cameras and points are adjusted before and after; `model` is changed. Points beyond _MOST_OBSERVATIONS, chosen
    at random by `seed`, are deleted first. `like` are the intrinsics at the images' size, held if `known`.
    """
    if model.compute_num_observations() > _MOST_OBSERVATIONS:
        order = np.random.default_rng(seed).permutation(sorted(model.point3D_ids()))
        count = np.cumsum([model.point3D(int(point)).track.length() for point in order])
        for point in order[count > _MOST_OBSERVATIONS]:
            model.delete_point3D(int(point))
    adjust_robustly(model, known, ROUGHLY)
    camera, rows, intrinsics = model.camera(1), rows_of(model), intrinsics_of(model.camera(1), like, known)
    size, image_ids = (camera.width, camera.height), [row + 1 for row in rows]
    greys = np.stack([grey_of(images[row], size) for row in rows])
    tracks = tracks_of(model, image_ids, size)
    from jcr.sfm.track_refinement import align_tracks  # its loops take a second to load

    aligned = align_tracks(greys, tracks, poses_of(model, rows), resized(intrinsics, *size))
    for (row, index, _), x_px in zip(observations(model, image_ids), aligned.x_px, strict=True):
        model.image(image_ids[row]).point2D(index).xy = x_px + HALF_PIXEL
    adjust_robustly(model, known)
    intrinsics, notes = intrinsics_of(model.camera(1), like, known), ()
    if not known and fold_distance_px(intrinsics) is not None:
        notes = ("the views do not determine the distortion: it is taken as zero",)
        model.camera(1).params = [*model.camera(1).params[:3], 0.0, 0.0]
        adjust_robustly(model, fix_intrinsics=True)
        intrinsics = intrinsics_of(model.camera(1), intrinsics, known)
    made = reconstruction_of(model, rows, intrinsics)
    std_px = None if aligned.std_px is None else like.width / size[0] * aligned.std_px
    return replace(made, tracks=replace(made.tracks, std_px=std_px), notes=notes)


def starting_intrinsics(capture: Capture) -> tuple[list[Intrinsics], bool, tuple[str, ...]]:
    """Return the initial intrinsics to try in turn, true if they are given rather than guessed, and warnings.

    Usable intrinsics of the capture are the only ones; otherwise each has a guessed focal length and no distortion.
    """
    given, warnings = usable_intrinsics(capture.intrinsics)
    if given:
        return [given], True, warnings
    return [guessed_intrinsics(capture.image_size, focal) for focal in _START_FOCALS], False, warnings


def map_images(
    matcher: Matcher,
    base_from_gripper: Float[ndarray, "n 4 4"],
    intrinsics: Intrinsics,
    cameras: Sequence[pycolmap.Camera],
    names: Sequence[str],
    report: Progress,
    begun: pycolmap.Reconstruction | None = None,
) -> tuple[MatchedPairs, pycolmap.Reconstruction | None]:
    """Match the images and map the verified pairs by COLMAP's mapper; return the matches and the model.

    The model is None if no pair could be mapped. `intrinsics` are the initial estimate at the original size, `cameras`
    COLMAP's initial cameras at the working size, and `names` the images' names for messages. The mapper tries the
    cameras in turn, after intrinsics estimated from the gripper's angles if there are any. A model `begun` is continued
    with the images that it lacks. Images that the mapper leaves out are added near cameras predicted from the gripper
    poses.
    """
    working = resized(intrinsics, cameras[0].width, cameras[0].height)
    found = match_with_robot(matcher, base_from_gripper, working, names, report)
    matched = replace(found, geometries=_thinned(found.geometries, len(names), matcher.seed))
    if matched.intrinsics != working:
        cameras = [colmap_camera(matched.intrinsics, matcher.known), *cameras]
    model, matching = begun, len({row for key in matched.geometries for row in key})
    with tempfile.TemporaryDirectory(prefix="jcr-colmap-") as folder:
        database = write_database(Path(folder), cameras[0], matcher.features.x_px, matched.geometries)
        if model is None or model.num_reg_images() < matching:
            some = cameras if model is None else [model.camera(1)]
            model = _map_incrementally(database, some, matcher, report, model)
        if model is not None and model.num_reg_images() < matching:
            model = with_missing_images(database, model, base_from_gripper, matcher)
        if model is not None and matched.x is not None:
            nearer = nearer_to_robot(database, model, base_from_gripper, matched.x, matcher)
            if nearer is not model:
                model, matched = nearer, replace(matched, warnings=(*matched.warnings, _MADE_AGAIN))
    return matched, model


def matcher_of(
    images: Sequence[UInt8[ndarray, "h w 3"]],
    camera: pycolmap.Camera,
    known: bool,
    features: FeatureName,
    seed: int,
    report: Progress,
) -> Matcher:
    """Return a matcher of the images by SIFT or XFeat (`features`); SIFT keypoints are found now, XFeat's later.

    `camera` is COLMAP's camera of the images at the size of matching; its intrinsics are given if `known`.
    """
    size = camera.width, camera.height
    if features != "xfeat":
        give_back()
        found = SiftFeatures(images, size, min(os.cpu_count() or 1, _SIFT_THREADS), report)
        give_back()
        return Matcher(found, camera, known, seed)
    extra("torch", "match", f"features {features}")
    from jcr.features.xfeat import LearnedFeatures

    return Matcher(LearnedFeatures(images, size, report), camera, known, seed)


def _thinned(geometries: Geometries, images: int, seed: int) -> Geometries:
    """Return the matches of features chosen at random by `seed`, so that at most _MOST_MATCHED keypoints remain.

    A feature is a set of keypoints that matches connect; either all its matches are kept or none.
    """
    rows = [np.asarray(one.inlier_matches, dtype=np.int64).reshape(-1, 2) for one in geometries.values()]
    ends = [of_pair * images + key for key, of_pair in zip(geometries, rows, strict=True)]
    keypoints, joined = np.unique(np.concatenate([np.zeros((0, 2), np.int64), *ends]), return_inverse=True)
    count, joined = len(keypoints), joined.reshape(-1, 2)
    if count <= _MOST_MATCHED:
        return geometries
    links = csr_array((np.ones(len(joined)), joined.T), (count, count))
    _, feature = connected_components(links, directed=False)
    size = np.minimum(np.bincount(feature), images)
    order, kept = np.random.default_rng(seed).permutation(len(size)), np.zeros(len(size), bool)
    kept[order[np.cumsum(size[order]) <= _MOST_MATCHED]] = True
    of_pairs = np.split(kept[feature[joined[:, 0]]], np.cumsum([len(one) for one in rows])[:-1])
    thinned = {key: deepcopy(one) for key, one in geometries.items()}
    for one, of_pair, some in zip(thinned.values(), rows, of_pairs, strict=True):
        one.inlier_matches = of_pair[some].astype(np.uint32)
    return thinned


def _incremental_options(matcher: Matcher) -> pycolmap.IncrementalPipelineOptions:
    """Return COLMAP's options of the incremental mapping; `matcher` has the seed and whether intrinsics are known."""
    pipeline = pycolmap.IncrementalPipelineOptions()
    mapper = pipeline.mapper
    pipeline.min_model_size = 2
    pipeline.extract_colors = False
    # A first pair may distort unknown intrinsics so that no third image fits; other pairs are then tried.
    pipeline.multiple_models, pipeline.max_num_models = not matcher.known, 3
    # With one thread a seed fixes the result; the order of sums over threads changes the last bits.
    pipeline.random_seed = mapper.random_seed = pipeline.triangulation.random_seed = matcher.seed
    pipeline.num_threads = mapper.num_threads = 1
    pipeline.ba_global_function_tolerance = pipeline.ba_local_function_tolerance = COST_TOLERANCE
    refine = not matcher.known
    pipeline.ba_refine_focal_length = pipeline.ba_refine_extra_params = refine
    mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = refine
    if len(matcher.features.x_px) > _MANY:
        pipeline.ba_global_frames_ratio = pipeline.ba_global_points_ratio = _GROWN
    return pipeline


def _map_incrementally(
    database: Path,
    cameras: Sequence[pycolmap.Camera],
    matcher: Matcher,
    report: Progress,
    begun: pycolmap.Reconstruction | None,
) -> pycolmap.Reconstruction | None:
    """Map the images once with each initial camera; return the model with most images, or None if there is none.

    COLMAP's thresholds are relaxed if the model lacks more than half of the images. A model `begun` is continued with
    the images that it lacks. The progress is the share of images in the model; it falls when another camera is tried.
    """
    n_images, folder = len(matcher.features.x_px), database.parent
    pipeline = _incremental_options(matcher)
    mapper = pipeline.mapper
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
        if 2 * registered >= n_images:
            return best
    return best


def _not_registered(
    matcher: Matcher, matched: MatchedPairs, model: pycolmap.Reconstruction | None
) -> RejectedError:
    """Return the error that too few images have a camera pose, with their number, the likely reason and a remedy."""
    x_px, pairs = matcher.features.x_px, len(matched.geometries)
    features = int(np.median([len(x) for x in x_px]))
    if features < _FEW_FEATURES:
        reason = f"too little texture, {features} features in the median image where {_FEW_FEATURES} are few"
    elif pairs < len(x_px) - 1:
        reason = f"only {pairs} of {math.comb(len(x_px), 2)} pairs of images share features"
    else:
        reason = "the matches agree on no common scene: a repeated pattern, motion, or wrong intrinsics"
    registered = model.num_reg_images() if model else 0
    return RejectedError(
        f"structure from motion registered {registered} of {len(x_px)} images ({reason})",
        "put textured objects or a newspaper on the table, let the views overlap more, or use a foundation-model back "
        "end or a marker",
        despite_texture=features >= _FEW_FEATURES,
    )
