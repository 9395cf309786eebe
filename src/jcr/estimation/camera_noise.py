"""Errors of given camera poses: components of their covariance, selected by evidence, with estimated sizes.

Images determine a camera's pose relative to the scene worst in two ways: a rotation about the scene, and a translation
along the optical axis. Visual odometry and SLAM add up errors along the sequence. Each of these components enters the
covariance of the camera poses if the poses of gripper and camera together show it.
"""

from dataclasses import replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.linalg import block_diag

from jcr.estimation.pose_equations import pose_by_pose, pose_equations, reported_poses
from jcr.estimation.problem import ROTATION, SCALE, TRANSLATION, PoseModel, Start, pose_problem
from jcr.estimation.robot_noise import (
    MOST_FOR_SIZES,
    OF_ARM,
    Equations,
    LogSizes,
    log_evidence,
    most_likely,
    solve_equations,
)
from jcr.geometry import Poses, by_similarity, nearest_to_lines

MIN_TESTED_POSES = 8
"""Smallest number of poses for a test of camera errors. More than MOST_FOR_SIZES are sampled evenly."""
CLEAR_GAIN = 3.0
"""Gain of the log evidence from which a component is included: odds of 20 to 1."""
COARSELY_SETTLED = 0.03
"""Step of the log sizes at which the search of their mode ends; the log evidence changed by at most 0.011 beyond,
in 42 searches."""
TYPICAL_M, TYPICAL_RAD, TYPICAL_WALK_M = 1e-3, 1e-3, 3e-4
"""Typical sizes of camera pose errors: position (m), rotation (rad; also relative scale), growth of position (m)."""
Part = Literal[
    "rotation about the origin",
    "rotation about the scene",
    "depth",
    "depth from a fixed camera",
    "walk of position",
    "walk of rotation",
    "walk of scale",
]
"""Part of the camera pose errors. A board is at the origin of its frame; the scene is the point nearest to all optical
axes. Depth is along the optical axis, for a fixed camera that observes a moving board along z of its frame."""
INDEPENDENT: list[tuple[Part, ...]] = [
    ("rotation about the origin",),
    ("rotation about the scene",),
    ("depth",),
    ("depth from a fixed camera",),
]
"""Components of errors that are independent from image to image."""
ADDING_UP: list[tuple[Part, ...]] = [("walk of position", "walk of rotation"), ("walk of scale",)]
"""Components of errors that add up along the sequence."""
WALKS = {
    "walk of position": (TRANSLATION, TYPICAL_WALK_M),
    "walk of rotation": (ROTATION, TYPICAL_RAD),
    "walk of scale": (SCALE, TYPICAL_RAD),
}
"""Columns of a similarity (translation, rotation, log scale) and typical growth per image of each random walk."""


def camera_error_covariance(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    fit: Start,
    used: Bool[ndarray, " n"],
    model: PoseModel,
    adding_up: bool,
) -> Float[ndarray, "s s"] | None:
    """Return the estimated covariance (6n,6n) of the errors of n camera poses; None if the poses show none.

    Rows are the steps of each pose (geometry.retract; recon axes and unit, rad). Components are added one by one, each
    with the largest log evidence of the `used` poses, while the gain exceeds CLEAR_GAIN. Fewer than MIN_TESTED_POSES
    used poses give None. `fit` is the estimate of (gripper_from_camera, scale, base_from_recon) without such errors.
    `model` is that of the pairs with exact camera poses. `adding_up`: errors that accumulate along the images are
    tested too.
    """
    rows = np.flatnonzero(used)
    if len(rows) < MIN_TESTED_POSES:
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), MOST_FOR_SIZES)).round().astype(int))]
    problem, state = pose_problem(
        base_from_gripper[rows],
        recon_from_camera[rows],
        fit,
        model.of(rows),
    )
    by_camera = reported_poses(problem, state)[2]
    components: dict[tuple[Part, ...], list[Float[ndarray, "s s"]]] = {}
    # The scale of metric poses does not drift; where a camera hardly moves, its drift would explain any error.
    is_metric = any(prior.row[SCALE].item() for prior in model.priors)
    for parts in [*INDEPENDENT, *(ADDING_UP[: 1 if is_metric else 2] if adding_up else ())]:
        of_cameras = (camera_error_part(part, recon_from_camera, fit[1], rows) for part in parts)
        components[parts] = [pose_by_pose(by_camera, pose_by_pose(by_camera, one).T) for one in of_cameras]
    equations, adopted = pose_equations(problem, state, None).equations, list[Part]()
    sizes, information = most_likely(equations)
    best = log_evidence(equations, solve_equations(equations, sizes), information)
    while True:
        found: list[tuple[float, Equations, LogSizes, tuple[Part, ...]]] = []
        for parts, covariances in components.items():
            tried = replace(equations, camera_errors=(*equations.camera_errors, *covariances))
            at, information = most_likely(tried, np.r_[sizes, np.zeros(len(covariances))], COARSELY_SETTLED)
            found.append((log_evidence(tried, solve_equations(tried, at), information), tried, at, parts))
        likeliest = max(found, key=lambda one: one[0], default=None)
        if likeliest is None or likeliest[0] < best + CLEAR_GAIN:
            break
        best, equations, sizes, parts = likeliest
        adopted += parts
        del components[parts]
    every, out = np.arange(len(recon_from_camera)), None
    for part, variance in zip(adopted, equations.variances(sizes)[OF_ARM:], strict=True):
        covariance = variance * camera_error_part(part, recon_from_camera, fit[1], every)
        out = covariance if out is None else out + covariance
    return out


def camera_error_part(
    part: Part, recon_from_camera: Poses, scale: float, rows: Int[ndarray, " m"]
) -> Float[ndarray, "s s"]:
    """Return the covariance (6m,6m) of the errors of camera poses `rows` by one part, for its typical size.

    The errors are steps of the poses (geometry.retract; recon axes and unit, rad), pose by pose; `rows` are indices of
    poses. `scale` is in metres per unit of the reconstruction; random walks run over all n poses of
    `recon_from_camera`.
    """
    n, position, axis = len(recon_from_camera), recon_from_camera[:, :3, 3], recon_from_camera[:, :3, 2]
    if part in WALKS:
        moves = np.zeros((len(rows), n - 1, 6, 7))
        # Rotations are about each camera's centre; a scale error changes the translation from the previous camera.
        moves[:, :, :3] = by_similarity(position[rows, None] - position[1:])
        moves[:, :, :3, 6] = position[rows, None] - position[:-1]
        moves[:, :, 3:, 3:6] = np.eye(3)
        moves *= (rows[:, None] > np.arange(n - 1))[..., None, None]
        columns, size = WALKS[part]
        half = moves[..., columns].swapaxes(1, 2).reshape(6 * len(rows), -1)
        return (size / scale if part == "walk of position" else size) ** 2 * half @ half.T
    halves = np.zeros((len(rows), 6, 3))
    if part == "depth":
        halves[:, :3, 0] = TYPICAL_M / scale * axis[rows]
    elif part == "depth from a fixed camera":
        halves[:, 2, 0] = TYPICAL_M / scale
    else:
        centre = np.zeros(3) if part == "rotation about the origin" else nearest_to_lines(position, axis)
        halves[:, :3] = TYPICAL_RAD * by_similarity(position[rows] - centre)[:, :, ROTATION]
        halves[:, 3:] = TYPICAL_RAD * np.eye(3)
    return np.asarray(block_diag(*(halves @ halves.swapaxes(1, 2))))
