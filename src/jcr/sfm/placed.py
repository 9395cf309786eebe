"""Images that the mapper left out, placed by the robot: smaller models joined, single images resectioned.

The cameras that are mapped give X and the scale; these predict where every other camera is, in the frame of the map. A
prediction is a start and a check: what is kept was seen in the images, and triangulated with the rest.
"""

import tempfile
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float
from numpy import ndarray

from jcr.estimation.robust import robust_fit
from jcr.geometry import inverse, nearest_rotation, rotation_angle, transform

LEAST_MAPPED = 4
"""Cameras from which another one can be predicted."""
LARGEST_ROTATION = np.radians(4)
"""Largest rotation between a resectioned camera and its prediction."""
LARGEST_MOVE = 0.15
"""The same of its position, as a share of the distance to the scene."""
MIN_INLIERS = 15
MAX_ERROR_PX = 6.0
REFINEMENTS = (1, 5)
"""Of the points, their cameras fixed, after they are triangulated the first and the second time; COLMAP's is 5, which
takes twice as long as 1."""
LEAST_SHARED = 15
"""Points that a joined model must share with the map; with fewer only the robot would tie the two."""


def predicted_cameras(
    model: pycolmap.Reconstruction, base_from_gripper: Float[ndarray, "n 4 4"]
) -> Float[ndarray, "n 4 4"] | None:
    """recon_from_camera of all images, from those mapped; None where these are too few or show no scale."""
    rows = sorted(image_id - 1 for image_id in model.reg_image_ids())
    if len(rows) < LEAST_MAPPED:
        return None
    fit = robust_fit(base_from_gripper[rows], poses_of(model, rows))
    agree, state = fit.problem.used, fit.state
    assert agree is not None
    if state.scale <= 0 or agree.sum() < LEAST_MAPPED - 1:
        return None
    base_from_camera = base_from_gripper @ state.x[0]
    recon_from_camera = inverse(state.z[0]) @ base_from_camera
    recon_from_camera[:, :3, 3] /= state.scale
    return recon_from_camera


def poses_of(model: pycolmap.Reconstruction, rows: Sequence[int]) -> Float[ndarray, "m 4 4"]:
    """recon_from_camera of mapped images."""
    motions = [model.image(row + 1).cam_from_world() for row in rows]
    return inverse(np.stack([transform(m.rotation.matrix(), m.translation) for m in motions]))


def joined(
    other: pycolmap.Reconstruction, predicted: Float[ndarray, "n 4 4"]
) -> dict[int, Float[ndarray, "4 4"]]:
    """Cameras of another model, with a scale and frame of its own, in the map; empty where the robot contradicts."""
    rows = sorted(image_id - 1 for image_id in other.reg_image_ids())
    own, want = poses_of(other, rows), predicted[rows]
    rotation = nearest_rotation((want[:, :3, :3] @ np.swapaxes(own[:, :3, :3], 1, 2)).sum(0))
    center, target = own[:, :3, 3] @ rotation.T, want[:, :3, 3]
    from_mean, to_mean = center - center.mean(0), target - target.mean(0)
    spread = float((from_mean**2).sum())
    scale = float((from_mean * to_mean).sum()) / spread if spread > 0 else 0.0
    if scale <= 0:
        return {}
    in_map = transform(rotation @ own[:, :3, :3], scale * from_mean + target.mean(0))
    rotated_by = rotation_angle(np.swapaxes(in_map[:, :3, :3], 1, 2) @ want[:, :3, :3])
    away = np.linalg.norm(in_map[:, :3, 3] - target, axis=1) / np.sqrt((to_mean**2).sum(1).mean())
    if np.median(rotated_by) > LARGEST_ROTATION or np.median(away) > 2 * LARGEST_MOVE:
        return {}
    return dict(zip(rows, in_map, strict=True))


def resectioned(
    database: Path, model: pycolmap.Reconstruction, row: int, predicted: Float[ndarray, "4 4"]
) -> Float[ndarray, "4 4"] | None:
    """recon_from_camera of an image from verified matches with mapped points, near its prediction; None without."""
    camera = model.camera(1)
    with closing(pycolmap.Database.open(database)) as db:
        x_px = np.asarray(db.read_keypoints(row + 1)[:, :2], dtype=float)
        points: dict[tuple[int, int], ndarray] = {}
        for image_id in model.reg_image_ids():
            if not db.exists_two_view_geometry(row + 1, image_id):
                continue
            matches = np.asarray(db.read_two_view_geometry(row + 1, image_id).inlier_matches, dtype=int)
            seen = model.image(image_id).points2D
            for mine, other in matches:
                if seen[int(other)].has_point3D():
                    point = seen[int(other)].point3D_id
                    points[int(mine), point] = model.point3D(point).xyz
    if len(points) < MIN_INLIERS:
        return None
    at = x_px[[mine for mine, _ in points]]
    xyz = np.stack(list(points.values()))
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = MAX_ERROR_PX
    options.ransac.random_seed = 0
    found = pycolmap.estimate_and_refine_absolute_pose(at, xyz, camera, options)
    if found is None or found["num_inliers"] < MIN_INLIERS:
        return None
    motion = found["cam_from_world"]
    pose = inverse(transform(motion.rotation.matrix(), motion.translation))
    depth = float(np.median(np.linalg.norm(xyz - predicted[:3, 3], axis=1)))
    rotated_by = float(rotation_angle(pose[:3, :3].T @ predicted[:3, :3]))
    away = float(np.linalg.norm(pose[:3, 3] - predicted[:3, 3])) / depth
    return pose if rotated_by < LARGEST_ROTATION and away < LARGEST_MOVE else None


def retriangulated(
    database: Path,
    camera: pycolmap.Camera,
    recon_from_camera: dict[int, Float[ndarray, "4 4"]],
    adjust: Callable[[pycolmap.Reconstruction], None],
) -> pycolmap.Reconstruction:
    """A model of these cameras, its points triangulated from all verified matches, adjusted, and triangulated again."""
    with tempfile.TemporaryDirectory(prefix="jcr-placed-") as folder:
        poses = recon_from_camera
        model = None
        for refinements in REFINEMENTS:
            if model is not None:
                adjust(model)
                poses = dict(zip(sorted(poses), poses_of(model, sorted(poses)), strict=True))
            model = model_of(database, camera, poses)
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads = options.mapper.num_threads = 1
            options.ba_global_max_refinements = refinements
            options.random_seed = options.triangulation.random_seed = 0
            model = pycolmap.triangulate_points(
                model, database, folder, Path(folder), refine_intrinsics=False, options=options
            )
        assert model is not None
        return model


def model_of(
    database: Path, camera: pycolmap.Camera, recon_from_camera: dict[int, Float[ndarray, "4 4"]]
) -> pycolmap.Reconstruction:
    """A model of cameras by row, with the keypoints that a database has of their images, and no point yet."""
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)
    with closing(pycolmap.Database.open(database)) as db:
        for row, pose in sorted(recon_from_camera.items()):
            image = db.read_image(row + 1)
            keypoints = [pycolmap.Point2D(xy) for xy in db.read_keypoints(row + 1)[:, :2]]
            image.points2D = pycolmap.Point2DList(keypoints)
            model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(pose)[:3]))
    return model


def shared_points(model: pycolmap.Reconstruction, some: set[int]) -> int:
    """Points seen both by images of `some` rows and by others."""
    count = 0
    for point in model.points3D.values():
        rows = {element.image_id - 1 for element in point.track.elements}
        count += bool(rows & some) and bool(rows - some)
    return count
