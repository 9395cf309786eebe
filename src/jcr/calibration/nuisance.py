"""What else the images could say: nuisance parameters beside those of the bundle adjustment, tested after it.

At the optimum of the adjustment its normal equations are written once more, with columns for what it holds fixed: every
parameter of the camera, a shear of the image, and a focal length and a shear for each image by itself. A hypothesis
is a few combinations of these columns. How much freeing them would lower the cost, at one Gauss-Newton step, over the
dispersion of the residuals, is Rao's score test (Rao, Proc. Cambridge Phil. Soc. 44, 1948), here beside F, for the
robot's noise was estimated from few residuals. The same step says how large they are and how far X would move.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.stats import f as f_distribution

from jcr.calibration.bundle import Adjusted
from jcr.camera import by_parameters, by_point, parameter_names, parameters, project
from jcr.geometry import step_between
from jcr.records import Intrinsics

LOSS_SCALE = 2.0
"""Cauchy loss, as in the adjustment."""
CELLS = 8
"""Across the width of an image: in one of them features share errors."""
WEAK = {"fx": 0.3, "fy": 0.3, "cx": 0.2, "cy": 0.2}
"""Standard deviations that only keep finite what the images cannot see: focal lengths relative, centre per width."""
WEAK_DISTORTION, WEAK_SHEAR, WEAK_FOCAL = 1.0, 0.3, 0.05
SHEAR = "shear"


@dataclass(frozen=True)
class Nuisance:
    """The normal equations with every column that may be freed, points eliminated."""

    hessian: Float[ndarray, "d d"]
    right: Float[ndarray, " d"]
    base: int
    """Columns of the adjustment itself: X (6), its free intrinsics, the grippers."""
    images: int
    dispersion: float
    """Variance of what pulls at a parameter, over what the weights say."""
    names: tuple[str, ...]
    """Of the camera's parameters."""
    units: Float[ndarray, " q"]
    """What each of them counts in: focal lengths in themselves, the centre in widths."""
    distance: Float[ndarray, " m"]
    """Median depth of the points of each image (m)."""

    def of_camera(self, names: tuple[str, ...]) -> Float[ndarray, "e p"]:
        """Combinations: parameters of the camera (relative to the focal length or the width), or its shear."""
        known = (*self.names, SHEAR)
        return np.eye(self.extra)[:, [known.index(name) for name in names]]

    def common_focal(self) -> Float[ndarray, "e 1"]:
        """Combination: both focal lengths by one factor."""
        return self.of_camera(("fx", "fy")).sum(1, keepdims=True)

    def focal_of_images(self, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Combinations: the log of each image's focal length moves by its share."""
        return self._of_images(0, shares)

    def shear_of_images(self, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        """Combinations: x of each image moves by its share of the focal length over its height."""
        return self._of_images(1, shares)

    @property
    def freedom(self) -> int:
        """Of the robot's residuals, by which its noise was estimated: fewer than the images have by far."""
        return max(6 * self.images - 13, 1)

    @property
    def extra(self) -> int:
        """Columns that may be freed."""
        return len(self.right) - self.base

    def _of_images(self, block: int, shares: Float[ndarray, "m p"]) -> Float[ndarray, "e p"]:
        out = np.zeros((self.extra, shares.shape[1]))
        first = len(self.names) + 1 + block * self.images
        out[first : first + self.images] = shares
        return out


@dataclass(frozen=True)
class Tested:
    """What freeing some combinations would do."""

    log_p: float
    """Of a gain like this or larger where there is nothing."""
    value: Float[ndarray, " p"]
    covariance: Float[ndarray, "p p"]
    shift: Float[ndarray, "6"]
    """The step of X that comes with it, gripper axes."""
    shift_covariance: Float[ndarray, "6 6"]
    """Of X with the combinations free."""


def nuisance(adjusted: Adjusted, used: Intrinsics) -> Nuisance:
    """The columns and equations of an adjustment; parameters of the camera count in units of those of `used`."""
    problem, bundle = adjusted.problem, adjusted.bundle
    image, point, x_px = problem.image, problem.point, problem.x_px
    points = bundle.points_in_base
    m, camera, gripper = len(bundle.base_from_gripper), bundle.camera, bundle.base_from_gripper[image]
    x_rotation, x_offset = bundle.gripper_from_camera[:3, :3], bundle.gripper_from_camera[:3, 3]
    in_gripper = np.einsum("kji,kj->ki", gripper[:, :3, :3], points[point] - gripper[:, :3, 3])
    in_camera = (in_gripper - x_offset) @ x_rotation
    residual = project(camera, in_camera) - x_px
    pixels = adjusted.pixels
    squared = (residual**2).sum(1) / pixels.sigma_px**2
    weight = (in_camera[:, 2] > 1e-6) / (1 + squared / LOSS_SCALE**2) / pixels.sigma_px**2 / pixels.inflation

    lens, lens_std = problem.free.directions, problem.free.std
    by_gripper = by_point(camera, in_camera) @ x_rotation.T
    by_base = np.einsum("kai,kji->kaj", by_gripper, gripper[:, :3, :3])
    by_camera = by_parameters(camera, in_camera)
    names = parameter_names(camera)
    c, base = len(lens_std), 6 + len(lens_std) + 6 * m
    j = np.zeros((len(image), 2, base + nuisance_columns(camera, m)), np.float32)
    each = np.arange(len(image))
    j[:, :, :3] = -by_gripper
    j[:, :, 3:6] = np.cross(by_gripper, (in_gripper - x_offset)[:, None])
    j[:, :, 6 : 6 + c] = by_camera @ lens
    for axis in range(3):
        j[each, :, 6 + c + 6 * image + axis] = -by_base[:, :, axis]
    turned = np.cross(by_base, np.einsum("kij,kj->ki", gripper[:, :3, :3], in_gripper)[:, None])
    for axis in range(3):
        j[each, :, 6 + c + 6 * image + 3 + axis] = turned[:, :, axis]
    units = np.array([used.fx, used.fy, used.width, used.width, *[1.0] * (len(names) - 4)])
    j[:, :, base : base + len(names)] = by_camera * units
    at = base + len(names)
    row = (x_px[:, 1] - camera.cy) / camera.height
    j[:, 0, at] = camera.fx * row
    j[each, :, at + 1 + image] = (x_px - [camera.cx, camera.cy]).astype(np.float32)
    j[each, 0, at + 1 + m + image] = camera.fx * row

    hessian, right = _eliminated(j, by_base, residual, weight, point, len(points))
    told = step_between(problem.reported, bundle.base_from_gripper).ravel()
    poses = slice(6 + c, base)
    hessian[poses, poses] += adjusted.precision
    right[poses] -= adjusted.precision @ told
    moved = np.linalg.pinv(lens) @ (parameters(camera) - parameters(problem.intrinsics))
    hessian[range(6, 6 + c), range(6, 6 + c)] += lens_std**-2.0
    right[6 : 6 + c] -= moved / lens_std**2
    weak = [WEAK.get(name, WEAK_DISTORTION) for name in names]
    weak += [WEAK_SHEAR, *[WEAK_FOCAL] * m, *[WEAK_SHEAR] * m]
    hessian[range(base, len(hessian)), range(base, len(hessian))] += np.square(weak) ** -1.0
    distance = np.array(
        [np.median(in_camera[image == k, 2]) if (image == k).any() else np.nan for k in range(m)]
    )
    distance = np.where(np.isfinite(distance), distance, np.nanmedian(distance))
    spread = _dispersion(residual, weight, image, x_px, camera.width, len(points), m)
    return Nuisance(hessian, right, base, m, spread, names, units, distance)


def nuisance_columns(camera: Intrinsics, images: int) -> int:
    """How many columns there are beside those of the adjustment."""
    return len(parameter_names(camera)) + 1 + 2 * images


def _eliminated(
    j: Float[ndarray, "k 2 d"],
    by_point: Float[ndarray, "k 2 3"],
    residual: Float[ndarray, "k 2"],
    weight: Float[ndarray, " k"],
    point: Int[ndarray, " k"],
    count: int,
) -> tuple[Float[ndarray, "d d"], Float[ndarray, " d"]]:
    """Hessian and right side after the points: Schur's complement."""
    root = np.sqrt(weight)[:, None]
    d = j.shape[2]
    flat = (j * root[..., None]).reshape(-1, d).astype(np.float64)
    scaled = residual * root
    hessian, right = flat.T @ flat, -(flat.T @ scaled.ravel())
    to_point = by_point * root[..., None]
    v = np.zeros((count, 3, 3))
    np.add.at(v, point, np.swapaxes(to_point, 1, 2) @ to_point)
    v += (1e-9 * np.trace(v, axis1=1, axis2=2)[:, None, None] + 1e-12) * np.eye(3)
    order = np.argsort(point, kind="stable")
    starts = np.searchsorted(point[order], np.arange(count))
    pull = np.concatenate([flat.reshape(-1, 2, d), scaled[..., None]], axis=2)[order]
    w = np.add.reduceat(np.swapaxes(to_point[order], 1, 2) @ pull, starts)
    half = np.linalg.solve(np.linalg.cholesky(v), w).reshape(3 * count, d + 1)
    hessian -= half[:, :d].T @ half[:, :d]
    right += half[:, :d].T @ half[:, d]
    return hessian, right


def _dispersion(
    residual: Float[ndarray, "k 2"],
    weight: Float[ndarray, " k"],
    image: Int[ndarray, " k"],
    x_px: Float[ndarray, "k 2"],
    width: int,
    points: int,
    images: int,
) -> float:
    """Of the weighted residuals, and no less than that of their sums over cells of the images (cluster sampling;
    Liang and Zeger, Biometrika 73, 1986)."""
    pull = weight[:, None] * residual
    share = max(1 - (3 * points + 6 * images) / (2 * len(residual)), 0.1)
    single = float((pull**2).sum() / (2 * weight.sum() * share))
    column, row = (CELLS * x_px / width).astype(int).T
    _, cell = np.unique(np.stack([image, row, column]), axis=1, return_inverse=True)
    clustered = float(
        sum((np.bincount(cell, along) ** 2).sum() for along in pull.T) / (2 * weight.sum() * share)
    )
    return max(single, clustered)


def spanned(combinations: Float[ndarray, "e p"]) -> Float[ndarray, "e r"]:
    """An orthonormal basis of what the combinations free; some may say the same."""
    u, size, _ = np.linalg.svd(combinations, full_matrices=False)
    return u[:, size > 1e-9 * size.max(initial=1e-300)]


def tested(
    equations: Nuisance, free: Float[ndarray, "e p"], beside: Float[ndarray, "e q"] | None = None
) -> Tested:
    """The test of freeing the combinations `free`, with those of `beside` free under both hypotheses."""
    beside = np.zeros((equations.extra, 0)) if beside is None else beside
    q, both = beside.shape[1], np.concatenate([beside, free], axis=1)
    fewer, more = spanned(beside), spanned(both)
    without, gain_without, _ = _freed(equations, fewer)
    step, gain, covariance = _freed(equations, more)
    base, spread, p = equations.base, equations.dispersion, max(more.shape[1] - fewer.shape[1], 1)
    to_value = np.linalg.pinv(both)[q:] @ more
    return Tested(
        float(f_distribution.logsf(max(gain - gain_without, 0.0) / spread / p, p, equations.freedom)),
        to_value @ step[base:],
        spread * to_value @ covariance[base:, base:] @ to_value.T,
        step[:6] - without[:6],
        covariance[:6, :6],
    )


def _freed(
    equations: Nuisance, free: Float[ndarray, "e r"]
) -> tuple[Float[ndarray, " s"], float, Float[ndarray, "s s"]]:
    """The step with these columns free, what it gains, and the inverse of the equations."""
    base, r = equations.base, free.shape[1]
    to_all = np.zeros((len(equations.right), base + r))
    to_all[:base, :base], to_all[base:, base:] = np.eye(base), free
    covariance = np.linalg.inv(to_all.T @ equations.hessian @ to_all)
    right = to_all.T @ equations.right
    step = covariance @ right
    return step, float(right @ step), covariance
