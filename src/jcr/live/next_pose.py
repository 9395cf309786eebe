"""The gripper pose that helps the calibration most, within reach and with an image that is likely to register."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.expected import Ahead, Assumptions, assumed, scene_distance, typical_camera
from jcr.calibration.robot_errors import RobotErrors, errors_of
from jcr.estimation.kinematics import Arm
from jcr.geometry import rotation_angle
from jcr.live.arm_words import Path, joints_at
from jcr.records import Capture, HandEye

PROPOSALS = 12
"""Poses that are compared; the first that the arm reaches is proposed."""
ALIKE, ELSEWHERE_M = np.radians(25.0), 0.06
"""Largest angle between the lines of sight of a proposed image and the nearest that registered, and least distance (m)
of its camera from where an image did not register or was refused."""
AIMED = 0.1, np.radians(5.0)
"""Largest standard deviations (m, rad) of a rejected calibration by which cameras can still be aimed at the scene."""


@dataclass(frozen=True)
class Reach:
    """Which gripper poses can be proposed."""

    arm: Arm | None = None
    """Poses within its joint limits."""
    box: Float[ndarray, "2 3"] | None = None
    """Lower and upper corner (m, base frame) of gripper positions."""


@dataclass(frozen=True)
class Tried:
    """Where images were taken, and which of them help to say where the next one will register."""

    capture: Capture
    registered: Int[ndarray, " m"]
    """Rows of the capture; of fewer than two, all images count as if they had registered."""
    refused: tuple[Float[ndarray, "4 4"], ...] = ()
    """Gripper poses (base_from_gripper) at which no image was kept since the last one that was."""

    @property
    def is_registered(self) -> Bool[ndarray, " n"]:
        """Of every image of the capture."""
        rows = np.arange(len(self.capture))
        return np.isin(rows, self.registered) if len(self.registered) >= 2 else np.ones(len(rows), bool)

    def likely(self, added: Float[ndarray, "c 4 4"], x: Float[ndarray, "4 4"]) -> Bool[ndarray, " c"]:
        """Which gripper poses are likely to give an image that registers, by gripper_from_camera `x`.

        It looks along nearly the same line as an image that registered, and not from where one did not. After an image
        that did not, the camera may look elsewhere than `x` shows: then the gripper is rotated as little.
        """
        poses, there = self.capture.base_from_gripper, self.is_registered
        known, failed = poses[there], np.concatenate([poses[~there], np.reshape(self.refused, (-1, 4, 4))])
        if len(self.refused) or not there[-1]:
            relative = np.swapaxes(known[:, :3, :3], 1, 2) @ added[:, None, :3, :3]
            angle = np.asarray(rotation_angle(relative)).min(1)
        else:
            cosine = (added @ x)[:, :3, 2] @ (known @ x)[:, :3, 2].T
            angle = np.arccos(np.clip(cosine, -1, 1)).min(1)
        between = (added @ x)[:, None, :3, 3] - (failed @ x)[:, :3, 3]
        return (angle < ALIKE) & (np.linalg.norm(between, axis=2).min(1, initial=np.inf) > ELSEWHERE_M)


def before_calibration(tried: Tried, reach: Reach, hand_eye: HandEye | None = None) -> dict[str, Any]:
    """The next pose by a usual robot and usual images, as fields of Progress; none below two images.

    The camera is where a rejected calibration puts it, if that is exact enough to aim by, else at the gripper.
    """
    capture = tried.capture
    if len(capture) < 2:
        return {}
    there = np.flatnonzero(tried.is_registered)
    poses = capture.base_from_gripper[there]
    camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
    assumptions = assumed(poses, camera)
    if hand_eye is not None and _is_aimed(hand_eye):
        x = hand_eye.gripper_from_camera
        assumptions = replace(assumptions, gripper_from_camera=x, distance_m=scene_distance(poses @ x))
    return _best(assumptions, poses, errors_of(poses), tried, there, reach)


def proposed(
    case: Case, hand_eye: HandEye, robot: RobotErrors, assumptions: Assumptions, reach: Reach, tried: Tried
) -> dict[str, Any]:
    """The next pose by what the calibration knows of robot and images, as fields of Progress."""
    if not hand_eye.is_sound:
        return before_calibration(tried, reach, hand_eye)
    used, pose = case.used, hand_eye.next_poses[0]
    rows = case.reconstruction.image_index[used]
    is_free = reach.arm is None and reach.box is None
    if is_free and tried.likely(pose.base_from_gripper[None], hand_eye.gripper_from_camera)[0]:
        return {"next_pose": pose, "next_like": tried.capture.images[rows[pose.like]]}
    return _best(assumptions, case.base_from_gripper[used], robot.of(used), tried, rows, reach)


def _is_aimed(hand_eye: HandEye) -> bool:
    std = np.sqrt(np.diag(hand_eye.covariance))
    return bool(std[:3].max() < AIMED[0] and std[3:6].max() < AIMED[1])


def _best(
    assumptions: Assumptions,
    poses: Float[ndarray, "m 4 4"],
    robot: RobotErrors,
    tried: Tried,
    rows: Int[ndarray, " m"],
    reach: Reach,
) -> dict[str, Any]:
    """The best pose to add to those of the capture's `rows` that the arm reaches within its joint limits, and the angles
    there; else the best, without."""
    capture, joints = tried.capture, None
    ahead = Ahead.of(
        assumptions,
        poses,
        robot,
        1 if reach.arm is None else PROPOSALS,
        reach.box,
        is_likely=lambda added: tried.likely(added, assumptions.gripper_from_camera),
    )
    path = Path(poses, None if capture.joints is None else capture.joints[rows])
    for k, pose in enumerate(ahead.added if reach.arm is not None else ()):
        if reach.arm is not None and (joints := joints_at(reach.arm, path, pose)) is not None:
            ahead = replace(ahead, added=ahead.added[k : k + 1])
            break
    best = ahead.next_pose(1, ahead.expected(1))
    return {"next_pose": best, "next_joints": joints, "next_like": capture.images[rows[best.like]]}
