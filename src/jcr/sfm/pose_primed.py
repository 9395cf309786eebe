"""Pose-primed mapping: all points triangulated from cameras that the gripper poses predict, then adjusted without them.

X from confirmed pairs of images (features/epipolar.py), or from the cameras of a map, and the gripper poses put every
camera to some millimetres and tenths of a degree; the same points came from an X that was 12 mm and 1° off. COLMAP's
incremental mapper adjusts the map again and again while it grows, and loses images that few points tie to the others.
"""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.closed_form import motions
from jcr.estimation.robust import robust_fit
from jcr.features.epipolar import translation_of_x
from jcr.features.gate import Gate
from jcr.features.matchers import Matcher
from jcr.features.verify import Geometries
from jcr.geometry import inverse, transform
from jcr.sfm.completion import complete_images

PASSES = ((32.0, 1, 4.0), (8.0, 1, 1.0), (4.0, 5, 0.5))
"""Largest reprojection error of a point (px), refinements of each triangulation, and scale (px) of the loss of the
adjustment after it."""
LEAST_POINTS = 15
"""Least number of points of an image, and of those that tie it to the images with most points."""
LEAST_SHARE = 0.3
"""Least share of the keypoints with a match that must end in points; with wrong poses fewer do."""
LEAST_MAPPED = 4
"""Least number of mapped cameras from which others are predicted."""

Adjust = Callable[[pycolmap.Reconstruction, float], None]
"""Bundle adjustment of a model, free of the gripper poses, with the scale of the loss (px)."""
Cameras = dict[int, Float[ndarray, "4 4"]]
"""recon_from_camera by row of the image."""


def map_from_gripper_poses(
    database: Path,
    camera: pycolmap.Camera,
    found: Gate,
    geometries: Geometries,
    base_from_gripper: Float[ndarray, "n 4 4"],
    adjust: Adjust,
) -> pycolmap.Reconstruction | None:
    """Return a model of the images that are where the gripper poses put them; None where most matches contradict these.

    `geometries` are those in the database.
    """
    x = translation_of_x(found, motions(base_from_gripper))
    if x is None:
        return None
    model = map_from_cameras(database, camera, dict(enumerate(base_from_gripper @ x)), adjust)
    if model.compute_num_observations() < LEAST_SHARE * _matching_keypoints(geometries):
        return None
    return model


def with_missing_images(
    database: Path,
    model: pycolmap.Reconstruction,
    base_from_gripper: Float[ndarray, "n 4 4"],
    matcher: Matcher,
    adjust: Adjust,
) -> pycolmap.Reconstruction:
    """Return the model with the images that it lacks, where points confirm the cameras that its own X predicts.

    The mapper left them out because few matches tie them to the others; more points are searched in them.
    """
    rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
    mapped = dict(zip(rows, poses_of(model, rows), strict=True))
    predicted = predicted_cameras(mapped, base_from_gripper)
    if predicted is None:
        return model
    larger = map_from_cameras(database, model.camera(1), predicted | mapped, adjust)
    if larger.num_reg_images() <= len(rows):
        return model
    added = {image_id - 1 for image_id in larger.reg_image_ids()} - set(rows)
    complete_images(larger, added, matcher, lambda made: adjust(made, PASSES[-1][2]))
    return larger


def predicted_cameras(mapped: Cameras, base_from_gripper: Float[ndarray, "n 4 4"]) -> Cameras | None:
    """Return the cameras of all images by the X of mapped ones; None where these are too few or show no scale."""
    if len(mapped) < LEAST_MAPPED:
        return None
    rows = sorted(mapped)
    fit = robust_fit(base_from_gripper[rows], np.stack([mapped[row] for row in rows]))
    agree, state = fit.problem.used, fit.state
    assert agree is not None
    if state.scale <= 0 or agree.sum() < LEAST_MAPPED - 1:
        return None
    predicted = inverse(state.z[0]) @ base_from_gripper @ state.x[0]
    predicted[:, :3, 3] /= state.scale
    return dict(enumerate(predicted))


def map_from_cameras(
    database: Path,
    camera: pycolmap.Camera,
    recon_from_camera: Cameras,
    adjust: Adjust,
    passes: Sequence[tuple[float, int, float]] = PASSES,
) -> pycolmap.Reconstruction:
    """Return a model of rough cameras after triangulation of all verified matches and adjustment, in turn.

    Images with few points, and those that few points tie to the rest, are left out: gripper poses alone would hold them.
    The model has no image where fewer than two remain.
    """
    poses, model = recon_from_camera, pycolmap.Reconstruction()
    for largest_px, refinements, scale_px in passes:
        if len(poses) < 2:
            return pycolmap.Reconstruction()
        model = triangulated(database, camera, poses, largest_px, refinements)
        for row in poses.keys() - _tied(model):
            model.deregister_frame(model.image(row + 1).frame_id)
        adjust(model, scale_px)
        rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
        poses, camera = dict(zip(rows, poses_of(model, rows), strict=True)), model.camera(1)
    return model


def triangulated(
    database: Path,
    camera: pycolmap.Camera,
    recon_from_camera: Cameras,
    largest_px: float = 4.0,
    refinements: int = 5,
) -> pycolmap.Reconstruction:
    """Return a model of fixed cameras with points from all verified matches; the same, bit for bit, for the same input.

    Points with a reprojection error above `largest_px` are left out.
    """
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = options.mapper.num_threads = 1
    options.ba_global_max_refinements = refinements
    options.random_seed = options.triangulation.random_seed = 0
    options.mapper.filter_max_reproj_error = largest_px
    options.triangulation.merge_max_reproj_error = largest_px
    options.triangulation.complete_max_reproj_error = largest_px
    model = model_of(database, camera, recon_from_camera)
    with tempfile.TemporaryDirectory(prefix="jcr-points-") as folder:
        return pycolmap.triangulate_points(
            model, database, folder, Path(folder), refine_intrinsics=False, options=options
        )


def poses_of(model: pycolmap.Reconstruction, rows: Sequence[int]) -> Float[ndarray, "m 4 4"]:
    """Return recon_from_camera of mapped images."""
    mapped = [model.image(row + 1).cam_from_world() for row in rows]
    if not mapped:
        return np.zeros((0, 4, 4))
    return inverse(np.stack([transform(m.rotation.matrix(), m.translation) for m in mapped]))


def model_of(database: Path, camera: pycolmap.Camera, recon_from_camera: Cameras) -> pycolmap.Reconstruction:
    """Return a model of cameras with the keypoints that a database has of their images, and no point yet."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with closing(pycolmap.Database.open(database)) as db:
        for row, pose in sorted(recon_from_camera.items()):
            image = db.read_image(row + 1)
            keypoints = [pycolmap.Point2D(xy) for xy in db.read_keypoints(row + 1)[:, :2]]
            image.points2D = pycolmap.Point2DList(keypoints)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(pose)[:3]))
    return model


def _tied(model: pycolmap.Reconstruction) -> set[int]:
    """Return the rows of the images that LEAST_POINTS points or more tie to the image with most points, over others."""
    ids = sorted(model.reg_image_ids())
    place = {image_id: k for k, image_id in enumerate(ids)}
    sees = np.zeros((len(model.points3D), len(ids)), bool)
    for row, point in enumerate(model.points3D.values()):
        sees[row, [place[element.image_id] for element in point.track.elements]] = True
    group = np.zeros(len(ids), bool)
    group[int(sees.sum(0).argmax())] = True
    while True:
        larger = group | (sees[sees[:, group].any(1)].sum(0) >= LEAST_POINTS)
        if (larger == group).all():
            return {ids[k] - 1 for k in np.flatnonzero(group)}
        group = larger


def _matching_keypoints(geometries: Geometries) -> int:
    """Return the number of keypoints that match in some other image, of all images together."""
    matching: dict[int, set[int]] = {}
    for key, geometry in geometries.items():
        rows = np.asarray(geometry.inlier_matches, dtype=int).reshape(-1, 2)
        for image, of_image in zip(key, rows.T, strict=True):
            matching.setdefault(image, set()).update(of_image.tolist())
    return sum(map(len, matching.values()))
