"""The gripper pose that helps the calibration most, within reach and with an image that is likely to register."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.expected import Ahead, Assumptions, assumed, typical_camera
from jcr.calibration.robot_errors import RobotErrors, errors_of
from jcr.handeye.robots import Arm
from jcr.live.arm_words import Path, joints_at
from jcr.records import Capture, HandEye

PROPOSALS = 12
"""Poses that are compared; the first that the arm reaches and whose image is likely to register is proposed."""
ALIKE, ELSEWHERE_M = np.radians(25.0), 0.06
"""Largest angle between the lines of sight of a proposed image and the nearest that registered, and least distance (m)
of its camera from where an image did not register."""


@dataclass(frozen=True)
class Reach:
    """Which gripper poses can be proposed."""

    arm: Arm | None = None
    """Poses within its joint limits."""
    box: Float[ndarray, "2 3"] | None = None
    """Lower and upper corner (m, base frame) of gripper positions."""


def before_calibration(capture: Capture | None, reach: Reach) -> dict[str, Any]:
    """The next pose by a usual robot and usual images, as fields of Progress; none below two images."""
    if capture is None or len(capture) < 2:
        return {}
    poses = capture.base_from_gripper
    camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
    count = 1 if reach.arm is None else PROPOSALS
    ahead = Ahead.of(assumed(poses, camera), poses, errors_of(poses), count, reach.box)
    return _first_reached(ahead, Path(poses, capture.joints), reach.arm, capture.images)


def proposed(
    case: Case, hand_eye: HandEye, robot: RobotErrors, assumptions: Assumptions, reach: Reach
) -> dict[str, Any]:
    """The next pose by what the calibration knows of robot and images, as fields of Progress."""
    if not hand_eye.is_sound:
        return before_calibration(case.capture, reach)
    used, pose = case.used, hand_eye.next_poses[0]
    poses, names = case.base_from_gripper[used], tuple(case.names[row] for row in used)
    is_free = reach.arm is None and reach.box is None
    if is_free and _registers(case, pose.base_from_gripper[None])[0]:
        return {"next_pose": pose, "next_like": names[pose.like]}
    ahead = Ahead.of(assumptions, poses, robot.of(used), PROPOSALS, reach.box)
    likely = _registers(case, ahead.added)
    ahead = replace(ahead, added=ahead.added[likely if likely.any() else slice(None)])
    angles = case.capture.joints
    of_used = None if angles is None else angles[case.reconstruction.image_index[used]]
    return _first_reached(ahead, Path(poses, of_used), reach.arm, names)


def _first_reached(ahead: Ahead, path: Path, arm: Arm | None, names: tuple[str, ...]) -> dict[str, Any]:
    """The first of the poses that the arm reaches within its joint limits, and the angles; else the first, without."""
    row, joints = 0, None
    for k, pose in enumerate(ahead.added if arm is not None else ()):
        if arm is not None and (joints := joints_at(arm, path, pose)) is not None:
            row = k
            break
    ahead = replace(ahead, added=ahead.added[row : row + 1])
    best = ahead.next_pose(1, ahead.expected(1))
    return {"next_pose": best, "next_joints": joints, "next_like": names[best.like]}


def _registers(case: Case, added: Float[ndarray, "c 4 4"]) -> Bool[ndarray, " c"]:
    """Which gripper poses are likely to give an image that registers: one that looks along nearly the same line as
    an image that registered, and not from where one did not."""
    x, capture = case.hand_eye.gripper_from_camera, case.capture
    there = np.isin(np.arange(len(capture)), case.reconstruction.image_index)
    camera, known = added @ x, capture.base_from_gripper[there] @ x
    angle = np.arccos(np.clip(camera[:, :3, 2] @ known[:, :3, 2].T, -1, 1)).min(1)
    failed = capture.base_from_gripper[~there] @ x
    away = np.linalg.norm(camera[:, None, :3, 3] - failed[:, :3, 3], axis=2).min(1, initial=np.inf)
    return (angle < ALIKE) & (away > ELSEWHERE_M)
