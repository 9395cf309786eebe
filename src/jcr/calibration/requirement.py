"""What a calibration is needed for: how exact it must be, how exact it is, and how many more images reach that."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.distributions import chi2
from jcr.geometry import skew
from jcr.handeye.equation import ASSUMED_NOISE, PRIOR_STD, pose_information
from jcr.handeye.next_poses import looked_at, next_poses
from jcr.handeye.observability import excitation
from jcr.records import Budget, Finding, HandEye, Kind, Mend, NextPose, Plan, Requirement

GRASPING = (5.0, 1.0)
"""mm, degrees: a parallel gripper that opens 10 mm wider than its object has 5 mm to either side, and a degree moves the
tip of a finger of 100 mm by 2 mm."""
PROPOSED = 2
"""Gripper poses proposed after a calibration, if that is enough."""
MOST = 12
"""Poses that are proposed to reach what is required; of more, no number is given."""


def advised(
    hand_eye: HandEye,
    gripper: Float[ndarray, "m 4 4"],
    options: CalibrateOptions,
    scale_std: float | None = None,
) -> HandEye:
    """With what the motions show of each direction, the requirement, and the gripper poses to add.

    `gripper` are the poses that the solver was given, in its order; `scale_std` is how well the scale was
    known beforehand (relative).
    """
    used = gripper[hand_eye.inliers]
    required = _required(hand_eye, used, options)
    if hand_eye.converged:
        reach, proposed = _worthwhile(hand_eye, used, required, scale_std)
        required = replace(required, more_images=reach)
    else:
        # An X that is not trusted is not used, nor a robot that is worse than assumed promised away.
        metres, radians = hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation
        at_least = max(metres, ASSUMED_NOISE[0]), max(radians, ASSUMED_NOISE[1])
        _, proposed = next_poses(used, PROPOSED, noise=at_least)
        by_lens = np.sqrt(np.diag(_by_intrinsics(hand_eye)))
        proposed = [replace(pose, expected_std=np.hypot(pose.expected_std, by_lens)) for pose in proposed]
    seen = excitation(used, hand_eye.gripper_from_camera) if len(used) > 1 else None
    earlier = tuple(one for one in hand_eye.findings if one.kind is not Kind.NOT_EXACT_ENOUGH)
    hand_eye = replace(hand_eye, plan=Plan(seen, tuple(proposed), required), findings=earlier)
    short = not_exact_enough(required, mostly_systematic(hand_eye.budget))
    return hand_eye if short is None or not hand_eye.converged else hand_eye.with_findings(short)


def not_exact_enough(required: Requirement, systematic: bool) -> Finding | None:
    """That a calibration is not as exact as is required; `systematic`: mostly by systematic errors of the robot."""
    if required.is_met:
        return None
    mend: Mend = "images" if required.more_images is not None else "robot" if systematic else "none"
    numbers = {name: float(value) for name, value in vars(required).items() if value is not None}
    return Finding(
        kind=Kind.NOT_EXACT_ENOUGH,
        severity="warns",
        mend=mend,
        value=1e-3 * required.reached_mm,
        details=numbers,
    )


def mostly_systematic(budget: Budget | None) -> bool:
    """Whether most of the uncertainty is systematic errors of the robot, which images of the same region leave."""
    if budget is None:
        return False
    others = budget.robot_random, budget.intrinsics, budget.images, budget.faults
    return bool(np.trace(budget.robot_systematic[:3, :3]) >= sum(np.trace(part[:3, :3]) for part in others))


def within_95(covariance: Float[ndarray, "3 3"]) -> float:
    """The length that 95 % of normal errors of this covariance stay below, to 1 % (Imhof 1961, Pearson's moments)."""
    spread = np.maximum(np.linalg.eigvalsh(covariance), 0.0)
    mean, second, third = (float((spread**power).sum()) for power in (1, 2, 3))
    if third <= 0:
        return 0.0
    freedom = second**3 / third**2
    return float(np.sqrt(mean + (chi2.ppf(0.95, freedom) - freedom) * np.sqrt(second / freedom)))


def _required(hand_eye: HandEye, used: Float[ndarray, "k 4 4"], options: CalibrateOptions) -> Requirement:
    distance = 0.0
    if options.require_at == "scene":
        distance = float(np.median(looked_at(used @ hand_eye.gripper_from_camera)[1]))
    reached = _reached(hand_eye.covariance, hand_eye.gripper_from_camera, distance)
    return Requirement(*(options.require or GRASPING), options.require is not None, 1e3 * distance, *reached)


def _reached(
    covariance: Float[ndarray, "7 7"], x: Float[ndarray, "4 4"], distance: float
) -> tuple[float, float]:
    """mm, degrees: 95 % of the errors of a point so far (m) ahead of the camera, and of the rotation."""
    # geometry.retract: the origin moves by v, a point p from it by v + w × p.
    ahead = np.hstack([np.eye(3), -skew(distance * x[:3, 2])])
    moved = ahead @ covariance[:6, :6] @ ahead.T
    return 1e3 * within_95(moved), float(np.degrees(within_95(covariance[3:6, 3:6])))


def _worthwhile(
    hand_eye: HandEye, used: Float[ndarray, "k 4 4"], required: Requirement, scale_std: float | None
) -> tuple[int | None, list[NextPose]]:
    """How many poses would reach what is required, and those poses, which shrink the reported uncertainty most.

    What they leave is the reported covariance, less by the share by which their information shrinks that expected of
    the poses alone: bundle adjustment, intrinsics and correlated errors make the two differ. No views make up for
    given intrinsics that are
    wrong, nor for systematic errors of the robot where they are most of it; a smaller part may be that
    their size is hardly known, and more views tell it.
    """
    x, noise = hand_eye.gripper_from_camera, (hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation)
    stays = _by_intrinsics(hand_eye)
    systematic = None if hand_eye.budget is None else hand_eye.budget.robot_systematic
    if systematic is not None and 2 * np.trace(systematic[:3, :3]) > np.trace(hand_eye.covariance[:3, :3]):
        stays = stays + systematic
    _, proposed = next_poses(used, PROPOSED if required.is_met else MOST, x, noise)
    added = np.stack([pose.base_from_gripper for pose in proposed])
    information = np.cumsum(
        np.concatenate([pose_information(used, x, noise).sum(0)[None], pose_information(added, x, noise)]), 0
    )
    information[:, range(7), range(7)] += PRIOR_STD**-2.0
    if scale_std is not None:
        information[:, 6, 6] += scale_std**-2.0
    expected = np.linalg.inv(information)[:, :7, :7]
    shrinks = np.sqrt(np.maximum(np.diag(hand_eye.covariance - stays), 0.0))
    share = shrinks / np.sqrt(np.diag(expected[0]))
    left = expected[1:] * np.outer(share, share) + stays
    proposed = [
        replace(pose, expected_std=np.sqrt(np.diag(then))) for pose, then in zip(proposed, left, strict=True)
    ]
    if required.is_met:
        return 0, proposed
    for count, then in enumerate(left, start=1):
        millimetres, degrees = _reached(then, x, 1e-3 * required.distance_mm)
        if replace(required, reached_mm=millimetres, reached_deg=degrees).is_met:
            return count, proposed[: max(PROPOSED, count)]
    return None, proposed[:PROPOSED]


def _by_intrinsics(hand_eye: HandEye) -> Float[ndarray, "7 7"]:
    """What wrong intrinsics add to the covariance."""
    return sum(
        (one.covariance for one in hand_eye.findings if one.mend == "intrinsics"), start=np.zeros((7, 7))
    )
