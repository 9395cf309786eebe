"""What a calibration is needed for: how exact it must be, how exact it is, and how many more images reach that."""

from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.expected import Ahead, Assumptions, typical_noise, worse_of
from jcr.calibration.options import MOST_POSES, CalibrateOptions
from jcr.calibration.robot_errors import RobotErrors
from jcr.calibration.seen import Scene, in_use, within_95
from jcr.estimation.next_poses import assumed_camera
from jcr.estimation.observability import excitation
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import HandEye, NextPose, Plan, Requirement, Where

GRASPING = (5.0, 1.0)
"""mm, degrees: a parallel gripper that opens 10 mm wider than its object has 5 mm to either side, and a degree moves the
tip of a finger of 100 mm by 2 mm."""
PROPOSED = 2
"""Gripper poses proposed after a calibration, if that is enough."""


def advised(
    hand_eye: HandEye,
    gripper: Float[ndarray, "m 4 4"],
    options: CalibrateOptions,
    robot: RobotErrors,
    assumptions: Assumptions,
    scene: Scene | None = None,
) -> HandEye:
    """Return the calibration with its excitation, its accuracy in use, the requirement, and the poses to add.

    Poses are proposed where the requirement is not met or the user asks: the prediction takes a third of a calibration.
    `gripper` are the poses that the solver was given, in its order, `robot` is of these; `assumptions` are those of the
    calibration, `scene` is what the camera sees, where images were adjusted.
    """
    used, robot = gripper[hand_eye.inliers], robot.of(np.flatnonzero(hand_eye.inliers))
    hand_eye = replace(hand_eye, in_use=in_use(hand_eye.estimate, scene or Scene(assumptions.distance_m)))
    required = _required(hand_eye, options)
    # Wrong intrinsics and a bent robot stay what they are with further images.
    lasting = [
        one.covariance
        for one in hand_eye.findings
        if one.concerns == "intrinsics" or one.kind.row.group == "strain"
    ]
    assumptions = replace(assumptions, faults=sum(lasting, start=np.zeros((7, 7))))
    proposed = list[NextPose]()
    if hand_eye.converged and required.met and not options.next_poses:
        required = replace(required, more_images=0)
    elif hand_eye.converged:
        count = options.next_poses if required.met else max(PROPOSED, options.next_poses)
        reach, proposed = _worthwhile(hand_eye, used, required, assumptions, robot, count)
        required = replace(required, more_images=reach)
    else:
        # A rejected X is not used, and a robot that is worse than usual is not expected to improve.
        noise = worse_of(hand_eye.robot_noise, typical_noise())
        assumptions = replace(assumptions, gripper_from_camera=assumed_camera(used), noise=noise, camera=None)
        ahead = Ahead.of(assumptions, used, robot, PROPOSED)
        proposed = [ahead.next_pose(count, ahead.expected(count)) for count in range(1, PROPOSED + 1)]
    seen = excitation(used, hand_eye.gripper_from_camera) if len(used) > 1 else None
    earlier = tuple(one for one in hand_eye.findings if one.kind is not FindingKind.NOT_EXACT_ENOUGH)
    hand_eye = replace(hand_eye, plan=Plan(seen, tuple(proposed), required), findings=earlier)
    short = not_exact_enough(required, hand_eye.budget is not None and hand_eye.budget.mostly_systematic)
    return hand_eye if short is None or not hand_eye.converged else hand_eye.with_findings(short)


def not_exact_enough(required: Requirement, systematic: bool) -> Finding | None:
    """That a calibration is not as exact as is required, which rejects it where a user asked for it.

    `systematic`: mostly by systematic errors of the robot.
    """
    if required.met:
        return None
    concerns: Concerns = "images" if required.more_images is not None else "robot" if systematic else "none"
    numbers = {
        name: value if isinstance(value, str) else float(value)
        for name, value in vars(required).items()
        if value is not None
    }
    finding = Finding.of(FindingKind.NOT_EXACT_ENOUGH, "rejects" if required.asked else "warns", concerns)
    return replace(finding, value=1e-3 * required.reached_mm, details=numbers)


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
    translation_mm, rotation_deg = options.require or GRASPING
    return Requirement(
        translation_mm=translation_mm,
        rotation_deg=rotation_deg,
        asked=options.require is not None,
        distance_mm=distance_mm,
        reached_mm=reached_mm,
        reached_deg=reached_deg,
        at=at,
    )


def _worthwhile(
    hand_eye: HandEye,
    used: Float[ndarray, "k 4 4"],
    required: Requirement,
    assumptions: Assumptions,
    robot: RobotErrors,
    least: int,
) -> tuple[int | None, list[NextPose]]:
    """Return how many poses would reach the requirement, and those poses or `least`, the best first.

    The reported uncertainty shrinks by the ratio by which the predicted one does: images and robot may be better or
    worse than predicted.
    """
    ahead = Ahead.of(assumptions, used, robot, least if required.met else MOST_POSES)
    now, expected = ahead.expected(0), cache(ahead.expected)

    def shrunk(count: int, at: Where, mm: float, deg: float) -> tuple[float, float]:
        (now_mm, now_deg), (then_mm, then_deg) = now.reached(at), expected(count).reached(at)
        return mm * then_mm / now_mm, deg * then_deg / now_deg

    def is_met(count: int) -> bool:
        mm, deg = shrunk(count, required.at, required.reached_mm, required.reached_deg)
        return replace(required, reached_mm=mm, reached_deg=deg).met

    reach = 0 if required.met else None
    if not required.met and is_met(MOST_POSES):
        reach = next(count for count in range(1, MOST_POSES + 1) if is_met(count))
    found, std = hand_eye.in_use, np.sqrt(np.diag(hand_eye.covariance))
    assert found is not None
    proposed = []
    for count in range(1, max(least, reach or 0) + 1):
        then = expected(count)
        mm, deg = shrunk(count, "seen", found.seen.within_95_mm, found.seen.rotation_95_deg)
        proposed.append(
            replace(
                ahead.next_pose(count, then),
                expected_std=std * then.std / now.std,
                within_95_mm=mm,
                rotation_95_deg=deg,
            )
        )
    return reach, proposed
