"""Gripper pose that improves the calibration most, within reach and with an image that is likely to register."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.requirement import Proposals
from jcr.calibration.robot_errors import RobotErrors, errors_of
from jcr.estimation.inverse_kinematics import FITS, inverse_kinematics, reach_toward
from jcr.estimation.kinematics import Arm, forward_kinematics
from jcr.estimation.next_poses import median_distance
from jcr.estimation.prediction import Assumptions, assumed, typical_camera
from jcr.geometry import inverse, rotation_angle
from jcr.records import Capture, HandEye

PROPOSALS = 12
"""Number of poses that are compared; the first that the arm reaches is proposed."""
ALIKE, ELSEWHERE_M = np.radians(25.0), 0.06
"""Largest angle between the lines of sight of a proposed image and the nearest that registered, and least distance (m)
of its camera from where an image did not register or was refused."""
AIMED = 0.1, np.radians(5.0)
"""Largest standard deviations (m, rad) of a rejected calibration by which cameras can still be aimed at the scene."""
APART = np.radians(15.0)
"""Least rotation between a proposed gripper pose and those of the images, while the rotation limits the accuracy."""


@dataclass(frozen=True)
class Reach:
    """Limits of the gripper poses that can be proposed."""

    arm: Arm | None = None
    """Arm within whose joint limits the poses are."""
    box: Float[ndarray, "2 3"] | None = None
    """Lower and upper corner (m, base frame) of gripper positions."""


@dataclass(frozen=True)
class Attempts:
    """Gripper poses at which images were taken, and which of these images registered."""

    capture: Capture
    registered: Int[ndarray, " m"]
    """Rows of the capture; with fewer than two, all images count as registered."""
    refused: tuple[Float[ndarray, "4 4"], ...] = ()
    """Gripper poses (base_from_gripper) at which no image was kept since the last one that was."""

    @property
    def is_registered(self) -> Bool[ndarray, " n"]:
        """Whether each image of the capture registered."""
        rows = np.arange(len(self.capture))
        return np.isin(rows, self.registered) if len(self.registered) >= 2 else np.ones(len(rows), bool)

    def is_likely(self, added: Float[ndarray, "c 4 4"], x: Float[ndarray, "4 4"]) -> Bool[ndarray, " c"]:
        """Test which gripper poses are likely to give an image that registers, by gripper_from_camera `x`.

        The camera looks along nearly the same line as in an image that registered, and is not where an image did not.
        After an image that did not register `x` may be wrong; then the rotation of the gripper is compared.
        """
        poses, there = self.capture.base_from_gripper, self.is_registered
        known, failed = poses[there], np.concatenate([poses[~there], np.reshape(self.refused, (-1, 4, 4))])
        if len(self.refused) or not there[-1]:
            angle = _least_rotation(added, known)
        else:
            cosine = (added @ x)[:, :3, 2] @ (known @ x)[:, :3, 2].T
            angle = np.arccos(np.clip(cosine, -1, 1)).min(1)
        between = (added @ x)[:, None, :3, 3] - (failed @ x)[:, :3, 3]
        return (angle < ALIKE) & (np.linalg.norm(between, axis=2).min(1, initial=np.inf) > ELSEWHERE_M)

    def is_apart(self, added: Float[ndarray, "c 4 4"]) -> Bool[ndarray, " c"]:
        """Test which gripper poses are rotated by APART or more from those of all images."""
        return _least_rotation(added, self.capture.base_from_gripper) >= APART


def propose_before_calibration(
    attempts: Attempts, reach: Reach, hand_eye: HandEye | None = None
) -> dict[str, Any]:
    """Return the next pose as fields of Progress, assuming a usual robot and usual images; empty below two images.

    The camera is assumed where a rejected calibration puts it, if that is exact enough to aim by, else at the gripper.
    """
    capture = attempts.capture
    if len(capture) < 2:
        return {}
    there = np.flatnonzero(attempts.is_registered)
    poses = capture.base_from_gripper[there]
    camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
    assumptions = assumed(poses, camera)
    if hand_eye is not None:
        std, x = np.sqrt(np.diag(hand_eye.covariance)), hand_eye.gripper_from_camera
        if std[:3].max() < AIMED[0] and std[3:6].max() < AIMED[1]:
            assumptions = replace(assumptions, gripper_from_camera=x, distance_m=median_distance(poses @ x))
    return _best(assumptions, poses, errors_of(poses), attempts, there, reach, is_limited_by_rotation=True)


def propose(
    case: Case,
    hand_eye: HandEye,
    robot: RobotErrors,
    assumptions: Assumptions,
    reach: Reach,
    attempts: Attempts,
) -> dict[str, Any]:
    """Return the next pose as fields of Progress, with the errors that the calibration found."""
    if not hand_eye.is_sound:
        return propose_before_calibration(attempts, reach, hand_eye)
    used, required = case.used, hand_eye.requirement
    rows, poses = case.reconstruction.image_index[used], case.base_from_gripper[used]
    limited = False
    if hand_eye.next_poses:
        pose = hand_eye.next_poses[0]
        limited = required is not None and required.reached_deg > required.rotation_deg
        first = pose.base_from_gripper[None]
        is_free = reach.arm is None and reach.box is None and (not limited or attempts.is_apart(first)[0])
        if is_free and attempts.is_likely(first, hand_eye.gripper_from_camera)[0]:
            return {"next_pose": pose, "next_like": attempts.capture.images[rows[pose.like]]}
    return _best(assumptions, poses, robot.of(used), attempts, rows, reach, limited)


def _least_rotation(added: Float[ndarray, "c 4 4"], known: Float[ndarray, "k 4 4"]) -> Float[ndarray, " c"]:
    """Return the smallest rotation (rad) between each added pose and the known ones."""
    relative = np.swapaxes(known[:, :3, :3], 1, 2) @ added[:, None, :3, :3]
    return np.asarray(rotation_angle(relative)).min(1)


def _best(
    assumptions: Assumptions,
    poses: Float[ndarray, "m 4 4"],
    robot: RobotErrors,
    attempts: Attempts,
    rows: Int[ndarray, " m"],
    reach: Reach,
    is_limited_by_rotation: bool,
) -> dict[str, Any]:
    """Return the best pose that the arm reaches within its joint limits with its joint angles, or else the best pose.

    `poses` are those of the capture's `rows`, to which the pose is added.
    """
    capture, joints = attempts.capture, None

    def is_wanted(added: Float[ndarray, "c 4 4"]) -> Bool[ndarray, " c"]:
        """Test which poses are likely to register and, if that is needed, rotated enough."""
        likely = attempts.is_likely(added, assumptions.gripper_from_camera)
        wanted = likely & attempts.is_apart(added) if is_limited_by_rotation else likely
        return wanted if wanted.any() else likely

    count = 1 if reach.arm is None else PROPOSALS
    proposals = Proposals.of(assumptions, poses, robot, count, reach.box, is_likely=is_wanted)
    recorded = None if capture.joints is None else capture.joints[rows]
    for pose in proposals.added if reach.arm is not None else ():
        if reach.arm is not None and (joints := joints_at(reach.arm, poses, recorded, pose)) is not None:
            proposals = replace(proposals, added=pose[None])
            break
    best = proposals.next_poses(1)[0]
    return {"next_pose": best, "next_joints": joints, "next_like": capture.images[rows[best.like]]}


def joints_at(
    arm: Arm,
    base_from_gripper: Float[ndarray, "n 4 4"],
    joints: Float[ndarray, "n dof"] | None,
    goal: Float[ndarray, "4 4"],
) -> Float[ndarray, " dof"] | None:
    """Return joint angles (rad) within the limits that reach `goal`; None where none do.

    `base_from_gripper` and `joints` (rad, None where not recorded) are those of the images. With recorded angles the
    tool follows from them and their pose, and the answer is of the branch that the arm is in.
    """
    if joints is not None:
        now = joints[-1:]
        flange_from_tool = (inverse(forward_kinematics(arm, now)) @ base_from_gripper[-1:])[0]
        flange = (goal @ inverse(flange_from_tool))[None]
        found = reach_toward(arm, flange, now, steps=60)
        off = inverse(forward_kinematics(arm, found)) @ flange
        if np.linalg.norm(off[0, :3, 3]) < FITS[0] and float(rotation_angle(off[0, :3, :3])) < FITS[1]:
            return found[0]
        return None
    posture = inverse_kinematics(arm, np.concatenate([base_from_gripper, goal[None]]))
    reached = bool((posture.misfit[-1] < FITS).all())
    return posture.joints[-1] if reached else None
