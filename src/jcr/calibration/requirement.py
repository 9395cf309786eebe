"""What a calibration is needed for: how exact it must be, how exact it is, and how many more images reach that."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.seen import Scene, in_use, within_95
from jcr.handeye.equation import ASSUMED_NOISE, expected_covariance, point_ahead, pose_information
from jcr.handeye.next_poses import looked_at, next_poses
from jcr.handeye.observability import excitation
from jcr.records import BENT, Budget, Finding, HandEye, Kind, Mend, NextPose, Plan, Requirement

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
    scene: Scene | None = None,
) -> HandEye:
    """With what the motions show of each direction, how exact it is in use, the requirement, and the poses to add.

    `gripper` are the poses that the solver was given, in its order; `scale_std` is how well the scale was known
    beforehand (relative); `scene` is what the camera sees, where images were adjusted.
    """
    used = gripper[hand_eye.inliers]
    if scene is None:
        scene = Scene(float(np.median(looked_at(used @ hand_eye.gripper_from_camera)[1])))
    hand_eye = replace(hand_eye, in_use=in_use(hand_eye.estimate, scene))
    required = _required(hand_eye, options)
    if hand_eye.converged:
        reach, proposed = _worthwhile(hand_eye, used, required, scale_std)
        required = replace(required, more_images=reach)
    else:
        # An X that is not trusted is not used, nor a robot that is worse than assumed promised away.
        metres, radians = hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation
        at_least = max(metres, ASSUMED_NOISE[0]), max(radians, ASSUMED_NOISE[1])
        _, proposed = next_poses(used, PROPOSED, noise=at_least, distance_m=1e-3 * required.distance_mm)
        lasting = np.sqrt(np.diag(_by_lasting_faults(hand_eye)))
        proposed = [replace(pose, expected_std=np.hypot(pose.expected_std, lasting)) for pose in proposed]
    seen = excitation(used, hand_eye.gripper_from_camera) if len(used) > 1 else None
    earlier = tuple(one for one in hand_eye.findings if one.kind is not Kind.NOT_EXACT_ENOUGH)
    hand_eye = replace(hand_eye, plan=Plan(seen, tuple(proposed), required), findings=earlier)
    short = not_exact_enough(required, mostly_systematic(hand_eye.budget))
    return hand_eye if short is None or not hand_eye.converged else hand_eye.with_findings(short)


def not_exact_enough(required: Requirement, systematic: bool) -> Finding | None:
    """That a calibration is not as exact as is required, which rejects it where a user asked for it.

    `systematic`: mostly by systematic errors of the robot.
    """
    if required.met:
        return None
    mend: Mend = "images" if required.more_images is not None else "robot" if systematic else "none"
    numbers = {
        name: value if isinstance(value, str) else float(value)
        for name, value in vars(required).items()
        if value is not None
    }
    return Finding(
        kind=Kind.NOT_EXACT_ENOUGH,
        severity="rejects" if required.asked else "warns",
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


def _required(hand_eye: HandEye, options: CalibrateOptions) -> Requirement:
    found, at = hand_eye.in_use, options.require_at
    assert found is not None
    seen = found.seen
    if at == "camera":
        covariance = hand_eye.covariance
        distance_mm, reached_mm = 0.0, 1e3 * within_95(covariance[:3, :3])
        reached_deg = float(np.degrees(within_95(covariance[3:6, 3:6])))
    else:
        distance_mm, reached_mm, reached_deg = seen.distance_mm, seen.within_95_mm, seen.rotation_95_deg
    # Of camera poses that were given there is no scene but the point ahead.
    if at == "scene" and found.scene is not None:
        reached_mm = 1e3 * found.scene.within_95_m
        reached_deg = float(np.degrees(within_95(found.scene.covariance[3:6, 3:6])))
    asked = options.require is not None
    return Requirement(*(options.require or GRASPING), asked, distance_mm, reached_mm, reached_deg, at=at)


def _worthwhile(
    hand_eye: HandEye, used: Float[ndarray, "k 4 4"], required: Requirement, scale_std: float | None
) -> tuple[int | None, list[NextPose]]:
    """How many poses would reach what is required, and those poses, which shrink the reported uncertainty most.

    Errors shrink by the share by which the expected ones of the poses alone do: images, intrinsics and correlated errors
    make the two differ. No views make up for given intrinsics that are wrong, for a robot that is bent, or for errors
    of it that are systematic where they are most; a smaller part may be that their size is hardly known, and more views
    tell it.
    """
    x, noise = hand_eye.gripper_from_camera, (hand_eye.robot_noise.translation, hand_eye.robot_noise.rotation)
    stays = _by_lasting_faults(hand_eye)
    systematic = None if hand_eye.budget is None else hand_eye.budget.robot_systematic
    if systematic is not None and 2 * np.trace(systematic[:3, :3]) > np.trace(hand_eye.covariance[:3, :3]):
        stays = stays + systematic
    distance = 1e-3 * required.distance_mm
    _, proposed = next_poses(used, PROPOSED if required.met else MOST, x, noise, distance_m=distance)
    added = np.stack([pose.base_from_gripper for pose in proposed])
    information = np.cumsum(
        np.concatenate([pose_information(used, x, noise).sum(0)[None], pose_information(added, x, noise)]), 0
    )
    if scale_std is not None:
        information[:, 6, 6] += scale_std**-2.0
    expected = expected_covariance(information)
    shrinks = np.sqrt(np.maximum(np.diag(hand_eye.covariance - stays), 0.0))
    share = shrinks / np.sqrt(np.diag(expected[0]))
    left = expected[1:] * np.outer(share, share) + stays
    proposed = [
        replace(pose, expected_std=np.sqrt(np.diag(then))) for pose, then in zip(proposed, left, strict=True)
    ]
    if required.met:
        return 0, proposed
    point = point_ahead(x, distance)
    mm = _shrunk(required.reached_mm, 1e3 * within_95(point @ stays @ point.T), point @ expected @ point.T)
    deg_stays = np.degrees(within_95(stays[3:6, 3:6]))
    deg = _shrunk(required.reached_deg, float(deg_stays), expected[:, 3:6, 3:6])
    for count, (millimetres, degrees) in enumerate(zip(mm, deg, strict=True), start=1):
        if replace(required, reached_mm=float(millimetres), reached_deg=float(degrees)).met:
            return count, proposed[: max(PROPOSED, count)]
    return None, proposed[:PROPOSED]


def _shrunk(now: float, stays: float, expected: Float[ndarray, "k n n"]) -> Float[ndarray, " j"]:
    """An error with each number of further poses, j = k - 1: of its square what does not stay shrinks as expected."""
    variance = np.trace(expected, axis1=1, axis2=2)
    stays = min(stays, now)
    return np.sqrt(stays**2 + (now**2 - stays**2) * variance[1:] / variance[0])


def _by_lasting_faults(hand_eye: HandEye) -> Float[ndarray, "7 7"]:
    """What wrong intrinsics and a bent robot add to the covariance."""
    lasting = (one for one in hand_eye.findings if one.mend == "intrinsics" or one.kind in BENT)
    return sum((one.covariance for one in lasting), start=np.zeros((7, 7)))
