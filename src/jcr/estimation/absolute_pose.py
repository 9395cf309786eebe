"""Absolute camera pose from points and their pixels (PnP): RANSAC with SQPNP or planar IPPE, then robust least squares.

Terzakis and Lourakis, "A Consistently Fast and Globally Optimal Solution to the Perspective-n-Point Problem", ECCV 2020;
Collins and Bartoli, "Infinitesimal Plane-Based Pose Estimation", IJCV 2014.
"""

from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.camera import by_point, project, unproject, zoomed
from jcr.estimation.pixel_noise import LOSS_SCALE
from jcr.geometry import apply, inverse, retract, rotation_angle, rotation_exp, skew, step_between, transform
from jcr.least_squares import minimise
from jcr.records import Intrinsics

MIN_POINTS = {False: 6, True: 4}
"""Smallest number of points that agree with a pose, for general and for planar points."""
FOCAL_FACTORS = np.geomspace(0.4, 2.5, 14)
"""Factors on the given focal length that are tried as initial values of a free focal length."""
MEDIAN = 2 * np.log(2.0)
"""Median of the squared length of a whitened residual of two components."""
INEFFICIENCY = 1.09
"""Variance of the estimate with the Cauchy loss over that of least squares, for normal errors (Huber 1981)."""
LEAST_STD_PX = 0.05
"""Lower bound of the estimated pixel noise."""
POSE_ROUNDS, POSE_SETTLED = 10, 1e-2
"""Largest number of rounds of noise estimate and least squares, and the step (in σ) that ends them."""
BEHIND_PX = 1e4
"""Assumed residual (px) of a point behind the camera."""
AMBIGUOUS = 1.5
"""Ratio of the rms errors of the two poses of a plane, up to which they are ambiguous."""
POSES_APART = np.radians(5.0)
"""Smallest angle (rad) between the two poses of a plane that counts as an ambiguity."""


@dataclass(frozen=True, kw_only=True)
class CameraPose:
    """Result of `absolute_pose`: a_from_camera (a: frame of the points), its covariance, intrinsics and inliers."""

    a_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "p p"]
    """Covariance of a step of the pose (geometry.retract; unit of the points, rad), and of log focal length if free."""
    camera: Intrinsics
    """Intrinsics, with the estimated focal length if free."""
    inlier: Bool[ndarray, " k"]
    """Mask of the points that agree with the pose."""
    std_px: float
    """Estimated standard deviation of one pixel coordinate."""
    rms_px: float
    """Root mean square reprojection error of the inliers."""
    rival: Float[ndarray, "4 4"] | None = None
    """Second pose of planar points that fits nearly as well; None: there is none."""


def absolute_pose(
    x_px: Float[ndarray, "k 2"],
    points: Float[ndarray, "k 3"],
    camera: Intrinsics,
    point_covariance: Float[ndarray, "k 3 3"] | None = None,
    gate_px: float = 2.0,
    focal: Literal["given", "free"] = "given",
    planar: bool = False,
) -> CameraPose | None:
    """Return the camera pose in the frame of k points from their pixels; None if fewer than six (planar: four) agree.

    `x_px` are pixels of the distorted image. The pose has the most points with a reprojection error below `gate_px`.
    `planar`: the points are detected corners in a plane, without wrong matches; both possible poses are refined by
    linear least squares, and the one with the smaller reprojection error is returned. `point_covariance` is in the
    frame of the points; None: exact points; pixel noise is estimated in any case. `focal` "free": the focal length is
    estimated; `camera` has its initial value.
    """
    p = 7 if focal == "free" else 6
    spread = np.zeros((len(points), 3, 3)) if point_covariance is None else point_covariance
    if len(points) < MIN_POINTS[planar]:
        return None
    starts = list[_Start]()
    for factor in FOCAL_FACTORS if focal == "free" else (1.0,):
        scaled = zoomed(camera, factor)
        ideal_px = scaled.fx * unproject(scaled, x_px)[:, :2]
        if planar:
            # Both poses of the plane, with all points.
            matrix, every = np.diag([scaled.fx, scaled.fx, 1.0]), np.ones(len(points), bool)
            _, turns, shifts, _ = cv2.solvePnPGeneric(points, ideal_px, matrix, None, flags=cv2.SOLVEPNP_IPPE)
            poses = [
                transform(rotation_exp(r.ravel()), t.ravel()) for r, t in zip(turns, shifts, strict=True)
            ]
            ahead = (pose for pose in poses if (apply(pose, points)[:, 2] > 0).all())
            starts.extend((inverse(pose), scaled, every) for pose in ahead)
        elif (agreed := ransac_pose(ideal_px, points, scaled.fx, gate_px)) is not None:
            starts.append((agreed[0], scaled, agreed[1]))
    most = max((int(inlier.sum()) for _, _, inlier in starts), default=0)
    starts = [start for start in starts if start[2].sum() == most >= MIN_POINTS[planar]]
    refined = (_refined(x_px, points, spread, start, gate_px, p, planar) for start in starts)
    best, *others = sorted(filter(None, refined), key=lambda one: one.rms_px) or (None,)
    for other in others:
        assert best is not None
        apart = float(rotation_angle(best.a_from_camera[:3, :3].T @ other.a_from_camera[:3, :3]))
        if planar and apart > POSES_APART and other.rms_px < AMBIGUOUS * best.rms_px + 0.05:
            return replace(best, rival=other.a_from_camera)
    return best


_Start = tuple[Float[ndarray, "4 4"], Intrinsics, Bool[ndarray, " k"]]
"""Initial estimate: pose a_from_camera, intrinsics, and mask of the points that agree."""


def ransac_pose(
    x_px: Float[ndarray, "k 2"], points: Float[ndarray, "k 3"], focal_px: float, gate_px: float
) -> tuple[Float[ndarray, "4 4"], Bool[ndarray, " k"]] | None:
    """Return a_from_camera by SQPNP in RANSAC, and the mask of agreeing points; None if no pose is found.

    Frame a is that of `points`. `x_px` are undistorted pixels relative to the principal point. Points agree with a
    reprojection error below `gate_px`.
    """
    done, rotation, shift, rows = cv2.solvePnPRansac(
        points, x_px, np.diag([focal_px, focal_px, 1.0]), None,
        iterationsCount=2000, reprojectionError=gate_px, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not done or rows is None:
        return None
    pose = inverse(transform(rotation_exp(rotation.ravel()), shift.ravel()))
    return pose, np.isin(np.arange(len(points)), np.ravel(rows))


def _refined(
    x_px: Float[ndarray, "k 2"],
    points: Float[ndarray, "k 3"],
    spread: Float[ndarray, "k 3 3"],
    start: _Start,
    gate_px: float,
    p: int,
    planar: bool,
) -> CameraPose | None:
    """Return the pose with the least robust reprojection error, by iteration from `start`; None if it has few inliers.

    Pixel noise and inliers are estimated anew in each round. Inliers have whitened residuals times pixel noise below
    `gate_px`. `spread` is the covariance of each point, `p` the number of unknowns (6, or 7 with the focal length).
    `planar` is that of `absolute_pose`.
    """
    loss, scale, inefficiency = ("linear", 1.0, 1.0) if planar else ("cauchy", LOSS_SCALE, INEFFICIENCY)
    (pose, camera, inlier), found = start, None
    for _ in range(POSE_ROUNDS):
        residual, jacobian = _reprojection(x_px, points, pose, camera, p)
        # The derivative by a point is minus the derivative by the camera's translation.
        added = jacobian[..., :3] @ spread @ np.swapaxes(jacobian[..., :3], 1, 2)
        std_px = _noise(residual[inlier], added[inlier], p)
        root = np.linalg.inv(np.linalg.cholesky(std_px**2 * np.eye(2) + added))
        agreed, inlier = inlier, std_px * np.linalg.norm(root @ residual[..., None], axis=(1, 2)) < gate_px
        if inlier.sum() < MIN_POINTS[planar]:
            return None
        white, seen = root[inlier], (x_px[inlier], points[inlier])

        def whitened(
            state: tuple[ndarray, Intrinsics], white: ndarray = white, seen: tuple[ndarray, ndarray] = seen
        ) -> tuple[ndarray, ndarray]:
            residual, jacobian = _reprojection(*seen, *state, p)
            return (white @ residual[..., None])[..., 0] / scale, white @ jacobian / scale

        def moved(state: tuple[ndarray, Intrinsics], step: ndarray) -> tuple[ndarray, Intrinsics]:
            return retract(state[0], step[:6]), zoomed(state[1], float(np.exp(step[6:].sum())))

        before = pose
        pose, camera = minimise(whitened, (pose, camera), moved, loss).unknowns
        residual, jacobian = _reprojection(*seen, pose, camera, p)
        rows = (white @ jacobian).reshape(-1, p)
        if np.linalg.matrix_rank(rows) < p:  # points that no pose fits can drive it to infinity
            return None
        found = CameraPose(
            a_from_camera=pose,
            covariance=inefficiency * np.linalg.inv(rows.T @ rows),
            camera=camera,
            inlier=inlier,
            std_px=std_px,
            rms_px=float(np.sqrt((residual**2).sum(1).mean())),
        )
        moved_by = step_between(before, pose) / np.sqrt(found.covariance.diagonal()[:6])
        if (inlier == agreed).all() and np.abs(moved_by).max() < POSE_SETTLED:
            break
    return found


def _noise(residual: Float[ndarray, "k 2"], added: Float[ndarray, "k 2 2"], p: int) -> float:
    """Return the pixel noise (px) for which the whitened residuals have the median length of normal errors.

    `added` is the part (px²) of each residual's covariance that comes from its point's error. `p` is the number of
    unknowns that were fitted to the residuals.
    """
    values, axes = np.linalg.eigh(added)
    squared = np.einsum("kij,ki->kj", axes, residual) ** 2
    low, high = LEAST_STD_PX, max(float(np.sqrt(squared.sum(1).max())), 2 * LEAST_STD_PX)
    for _ in range(30):
        middle = np.sqrt(low * high)
        is_small = np.median((squared / (middle**2 + np.maximum(values, 0))).sum(1)) > MEDIAN
        low, high = (middle, high) if is_small else (low, middle)
    # The pose has taken p of the 2k components of the residuals.
    return float(high * np.sqrt(2 * len(residual) / max(2 * len(residual) - p, 1)))


def _reprojection(
    x_px: Float[ndarray, "k 2"],
    points: Float[ndarray, "k 3"],
    pose: Float[ndarray, "4 4"],
    camera: Intrinsics,
    p: int,
) -> tuple[Float[ndarray, "k 2"], Float[ndarray, "k 2 p"]]:
    """Return projected minus observed pixels, and their derivative by a pose step and (if p is 7) the log focal length.

    `pose` is a_from_camera, `points` are in frame a. A step is translation, then rotation vector, in axes of a. Points
    behind the camera have the residual BEHIND_PX.
    """
    arm = points - pose[:3, 3]
    x_in_camera = arm @ pose[:3, :3]
    x_in_camera[x_in_camera[:, 2] <= 0] = np.nan  # a point behind the camera has no pixel
    projected, rotated = project(camera, x_in_camera), by_point(camera, x_in_camera) @ pose[:3, :3].T
    by_focal = (projected - [camera.cx, camera.cy])[..., None]
    jacobian = np.concatenate([-rotated, rotated @ skew(arm), by_focal], axis=2)
    return np.nan_to_num(projected - x_px, nan=BEHIND_PX), np.nan_to_num(jacobian[..., :p])
