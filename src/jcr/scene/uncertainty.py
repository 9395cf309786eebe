"""Uncertainty of a map's surface along the gradient of the distance, from the calibration and from the depth."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.record import Calibration
from jcr.camera import NORMALIZED
from jcr.estimation.point_uncertainty import point_covariance
from jcr.records import COVARIANCE_ORDER, PointCloud
from jcr.records.field_checks import require_fields, require_finite
from jcr.records.json_fields import Positive, Spread

if TYPE_CHECKING:
    from jcr.scene.scene_map import SceneMap

BLOCK = 4
"""Side (map cells) of the blocks in which the depth's standard deviation is constant."""
BLOCK_POINTS = 20
"""Least number of points of a block for a value of its own; others have that of all points."""


@dataclass(frozen=True, kw_only=True, eq=False)
class MapUncertainty:
    """Covariance of the calibration that a map was made with, and standard deviation of its surface by the depth."""

    order: tuple[str, ...]
    """Names of the rows of `joint`: COVARIANCE_ORDER, and the intrinsics if they were estimated."""
    joint: Float[ndarray, "j j"]
    """Joint covariance of transform, scale and intrinsics."""
    middle: Float[ndarray, "3"]
    """Centre of the scene (m, base frame)."""
    similarity: Float[ndarray, "7 7"]
    """Covariance of the scene's similarity about `middle` (SceneUncertainty), the part common to all points."""
    shape_m: Spread
    """Standard deviation per axis of a point's remaining error by the calibration (m)."""
    look_std_m: Spread
    """Standard deviation per axis (m) of a point that the robot locates by pixel and exact depth in another image: by
    transform, intrinsics and the error of that gripper pose. It changes with the pose, and is no part of the map's
    errors."""
    lower: Float[ndarray, "3"]
    """Lower corner (m) of the first block; the sides of a block are `block_m`."""
    block_m: Positive
    depth_std: Float[ndarray, "z y x"]
    """Standard deviation (m) of the surface's position along its normal by depth and map, per block."""

    def __post_init__(self) -> None:
        """Raise InputError unless all numbers are finite and all arrays have their shapes, as in a map file."""
        require_fields(self)
        arrays = "joint", "middle", "similarity", "lower", "depth_std"
        require_finite("MapUncertainty", **{name: getattr(self, name) for name in arrays})

    def surface_std(
        self, x_in_base: Float[ndarray, "n 3"], normal: Float[ndarray, "n 3"]
    ) -> Float[ndarray, " n"]:
        """Return the standard deviation (m) of surface points (m) along unit normals, by calibration and depth."""
        p = x_in_base - self.middle
        along = np.concatenate([normal, np.cross(p, normal), (p * normal).sum(1, keepdims=True)], axis=1)
        variance = ((along @ self.similarity) * along).sum(1) + self.shape_m**2
        index = ((x_in_base - self.lower) / self.block_m).astype(int)[:, ::-1]
        index = np.clip(index, 0, np.array(self.depth_std.shape) - 1)
        return np.sqrt(variance + self.depth_std[tuple(index.T)] ** 2)


def map_uncertainty(scene: "SceneMap", cloud: PointCloud, hand_eye: Calibration) -> MapUncertainty:
    """Return the uncertainty of a map that was built from `cloud` and a calibration.

    Without adjusted images, the points' standard deviations in their worst directions are used in all directions.
    """
    uncertainty, noise = hand_eye.uncertainty, hand_eye.robot_noise.together
    reach = np.linalg.norm(cloud.points_in_base - cloud.camera_centers_in_base[cloud.image], axis=1)
    camera, distance = hand_eye.intrinsics or NORMALIZED, float(np.median(reach))
    middle_px = np.array([camera.width - 1.0, camera.height - 1.0]) / 2
    seen = point_covariance(hand_eye.gripper_from_camera, uncertainty, camera, middle_px, distance)
    # A rotation moves a point across the lever alone, that is along two of three axes.
    look = np.trace(seen) / 3 + noise[0] ** 2 + 2 / 3 * (noise[1] * distance) ** 2
    margin = 0.0 if cloud.margin is None else float(np.sqrt((cloud.margin**2).mean()))
    placed = uncertainty.scene
    return MapUncertainty(
        order=COVARIANCE_ORDER if uncertainty.joint is None else uncertainty.joint.order,
        joint=uncertainty.whole,
        middle=np.zeros(3) if placed is None else np.asarray(placed.middle_in_base, float),
        similarity=np.zeros((7, 7)) if placed is None else placed.covariance,
        shape_m=margin if placed is None else placed.shape_m,
        look_std_m=float(np.sqrt(look)),
        lower=scene.box[0],
        block_m=BLOCK * scene.cell,
        depth_std=_depth_std(scene, cloud),
    )


def _depth_std(scene: "SceneMap", cloud: PointCloud) -> Float[ndarray, "z y x"]:
    """Return the standard deviation (m) of the surface along its normal by depth and map, in blocks of the workspace.

    It is the distance from the map's surface that 90 % of the cloud's points in a block do not exceed, over 1.645. The
    stated errors of the depth, if known, are a lower bound of it.
    """
    (low, high), side = scene.box, BLOCK * scene.cell
    inside = np.flatnonzero(((cloud.points_in_base > low) & (cloud.points_in_base < high)).all(1))
    x = cloud.points_in_base[inside]
    sample, stated = scene.query(x, unknown="free"), np.zeros(len(x))
    off = np.abs(sample.distance)
    if cloud.depth_std is not None:
        ray = x - cloud.camera_centers_in_base[cloud.image[inside]]
        cosine = (ray * sample.gradient).sum(1) / np.linalg.norm(ray, axis=1)
        stated = cloud.depth_std[inside] * np.minimum(np.abs(cosine), 1.0)
    shape = tuple(np.maximum(np.ceil((high - low) / side - 1e-6).astype(int), 1)[::-1])
    index = tuple(((x - low) / side).astype(int)[:, ::-1].T)
    block = np.asarray(np.ravel_multi_index(index, shape, mode="clip"))
    order = np.lexsort((off, block))
    block, off, stated = block[order], off[order], stated[order]
    first = np.flatnonzero(np.diff(block, prepend=-1))
    count = np.diff(np.r_[first, len(block)])
    spread = off[first + (0.9 * (count - 1)).astype(int)] / 1.645
    own = np.maximum(spread, np.sqrt(np.add.reduceat(stated**2, first) / count))
    anywhere = max(float(np.quantile(off, 0.9)) / 1.645, float(np.sqrt((stated**2).mean())))
    found = np.full(int(np.prod(shape)), anywhere)
    found[block[first]] = np.where(count >= BLOCK_POINTS, own, anywhere)
    return found.reshape(shape)
