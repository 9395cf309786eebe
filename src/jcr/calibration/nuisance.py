"""What else the images could say: nuisance parameters beside those of the bundle adjustment, tested after it.

At the optimum of the adjustment its normal equations are written once more, with columns for what it holds fixed: every
parameter of the camera, a shear of the image, and a focal length and a shear for each image by itself. A hypothesis
is a few combinations of these columns. How much freeing them would lower the cost, at one Gauss-Newton step, over the
dispersion of the residuals, is Rao's score test (Rao, Proc. Cambridge Phil. Soc. 44, 1948), here beside F, for the
robot pose noise was estimated from few residuals. The same step says how large they are and how far X would move.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.stats import f as f_distribution

from jcr.adjust.elimination import Derivatives, with_points_held, without_points
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
    """The normal equations of every column that may be freed; points and the adjustment's own unknowns eliminated."""

    hessian: Float[ndarray, "e e"]
    right: Float[ndarray, " e"]
    x_covariance: Float[ndarray, "6 6"]
    """Of X where nothing is freed."""
    x_by_extra: Float[ndarray, "6 e"]
    """How far X moves with each column."""
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
        return len(self.right)

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
    units = np.array([used.fx, used.fy, used.width, used.width, *[1.0] * (len(names) - 4)])
    sheared = np.zeros((len(image), 2, 1))
    sheared[:, 0, 0] = camera.fx * (x_px[:, 1] - camera.cy) / camera.height
    turned = np.cross(by_base, np.einsum("kij,kj->ki", gripper[:, :3, :3], in_gripper)[:, None])
    at_x = np.cross(by_gripper, (in_gripper - x_offset)[:, None])
    common = np.concatenate([-by_gripper, at_x, by_camera @ lens, by_camera * units, sheared], axis=2)
    own = np.concatenate([-by_base, turned, (x_px - [camera.cx, camera.cy])[..., None], sheared], axis=2)

    root = np.sqrt(weight)[:, None, None]
    weighted = Derivatives(common * root, own * root, by_base * root, residual * root[..., 0])
    normal = without_points(*with_points_held(weighted, problem.seen), weighted, problem.seen)
    each = common.shape[2] + own.shape[2] * np.arange(m)
    poses_of_images = (each[:, None] + np.arange(6)).ravel()
    order = np.r_[0 : 6 + c, poses_of_images, 6 + c : common.shape[2], each + 6, each + 7]
    hessian, right = normal.hessian[np.ix_(order, order)], normal.right[order]
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
    return Nuisance(*_without_adjusted(hessian, right, base), m, spread, names, units, distance)


def nuisance_columns(camera: Intrinsics, images: int) -> int:
    """How many columns there are beside those of the adjustment."""
    return len(parameter_names(camera)) + 1 + 2 * images


def _without_adjusted(
    hessian: Float[ndarray, "d d"], right: Float[ndarray, " d"], base: int
) -> tuple[
    Float[ndarray, "e e"],
    Float[ndarray, " e"],
    Float[ndarray, "6 6"],
    Float[ndarray, "6 e"],
]:
    """The equations of what may be freed, and X: its covariance and its derivative by that."""
    inverse = np.linalg.inv(hessian[:base, :base])
    by_extra = inverse @ hessian[:base, base:]
    return (
        hessian[base:, base:] - hessian[base:, :base] @ by_extra,
        right[base:] - by_extra.T @ right[:base],
        inverse[:6, :6],
        -by_extra[:6],
    )


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
    spread, p = equations.dispersion, max(more.shape[1] - fewer.shape[1], 1)
    to_value, to_x = np.linalg.pinv(both)[q:] @ more, equations.x_by_extra @ more
    return Tested(
        float(f_distribution.logsf(max(gain - gain_without, 0.0) / spread / p, p, equations.freedom)),
        to_value @ step,
        spread * to_value @ covariance @ to_value.T,
        to_x @ step - equations.x_by_extra @ fewer @ without,
        equations.x_covariance + to_x @ covariance @ to_x.T,
    )


def _freed(
    equations: Nuisance, free: Float[ndarray, "e r"]
) -> tuple[Float[ndarray, " r"], float, Float[ndarray, "r r"]]:
    """How far these combinations go where they are free, what it gains, and the covariance."""
    covariance = np.linalg.inv(free.T @ equations.hessian @ free)
    right = free.T @ equations.right
    step = covariance @ right
    return step, float(right @ step), covariance
