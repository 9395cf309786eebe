"""Next gripper pose of a live capture: it reduces the uncertainty most, is within reach, and is likely to register."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.record import Calibration
from jcr.calibration.requirement import assumptions_of, better_poses, next_poses, predictions
from jcr.calibration.robot_errors import errors_of
from jcr.estimation.inverse_kinematics import FITS, inverse_kinematics, reach_toward
from jcr.estimation.kinematics import Arm, forward_kinematics
from jcr.estimation.prediction import Assumptions, assumed, median_distance, typical_camera
from jcr.geometry import inverse, rotation_angle
from jcr.records import Capture

PROPOSALS = 12
"""Number of poses, best first, of which the first that the arm can reach is proposed."""
ALIKE, ELSEWHERE_M = np.radians(25.0), 0.06
"""Largest angle (rad) between the optical axes of a proposed image and the closest registered one, and least distance
(m) of its camera from the cameras of images that did not register or were refused."""
AIMED = 0.1, np.radians(5.0)
"""Largest standard deviations (m, rad) of a rejected gripper_from_camera with which poses are still proposed."""
APART = np.radians(15.0)
"""Least rotation (rad) of a proposed gripper pose from that of every image, while the rotation limits the accuracy."""
Poses = Float[ndarray, "k 4 4"]


def propose(
    capture: Capture,
    registered: Int[ndarray, " m"],
    hand_eye: Calibration | None = None,
    case: Case | None = None,
    *,
    arm: Arm | None = None,
    box: Float[ndarray, "2 3"] | None = None,
    refused: Sequence[Float[ndarray, "4 4"]] = (),
) -> dict[str, Any]:
    """Return the gripper pose that improves the calibration most: the fields `next_pose` and `next_joints` of Progress.

    `registered` are the indices of the images with a camera pose. The expected errors of robot and images are those of
    `case`, the last calibration if accepted, else typical ones; `hand_eye` may be a rejected calibration. The pose is
    within the joint limits of `arm` and in the `box` (lower, upper corner; m, base frame). If possible, its camera is
    more than 0.06 m from the cameras at the gripper poses `refused`, at which no image could be kept. The result is
    empty for fewer than two images.
    """
    if len(capture) < 2:
        return {}
    poses, rows = capture.base_from_gripper, registered if len(registered) >= 2 else np.arange(len(capture))
    has_camera, is_limited_by_rotation, best = np.isin(np.arange(len(capture)), rows), True, None
    if case is not None and case.hand_eye.is_sound:
        rows, required = registered[case.used], case.hand_eye.requirement
        assumptions, robot = assumptions_of(case), case.robot.of(case.used)
        best = next(iter(case.hand_eye.next_poses), None)
        is_limited_by_rotation = bool(best and required and required.reached_deg > required.rotation_deg)
    else:
        assumptions, robot = _assumed(capture, poses[rows], hand_eye), errors_of(poses[rows])
    x, known = assumptions.gripper_from_camera, poses[has_camera]
    failed = np.concatenate([poses[~has_camera], np.reshape(refused, (-1, 4, 4))])

    def wanted(added: Poses, *, or_likely: bool = False) -> Bool[ndarray, " k"]:
        """Return True for each of k gripper poses `added` whose image will likely register and is rotated enough.

        An image will likely register if its optical axis is within 25° of a registered image's axis, and its camera
        is not near that of an image that failed. After a failure, gripper rotations are compared instead of axes.
        Rotated enough: by 15° from all images. `or_likely`: if no pose passes both tests, apply only the first one.
        """
        angle = np.arccos(np.clip((added @ x)[:, :3, 2] @ (known @ x)[:, :3, 2].T, -1, 1)).min(1)
        if len(refused) or not has_camera[-1]:
            angle = _least_rotation(added, known)
        between = (added @ x)[:, None, :3, 3] - (failed @ x)[:, :3, 3]
        likely = (angle < ALIKE) & (np.linalg.norm(between, axis=2).min(1, initial=np.inf) > ELSEWHERE_M)
        found = likely & (_least_rotation(added, poses) >= APART) if is_limited_by_rotation else likely
        return found if found.any() or not or_likely else likely

    if best is not None and arm is None and box is None and wanted(best.base_from_gripper[None])[0]:
        return {"next_pose": best}
    count, joints, is_likely = 1 if arm is None else PROPOSALS, None, partial(wanted, or_likely=True)
    added = better_poses(assumptions, poses[rows], robot, count, box, is_likely=is_likely)
    if arm is not None:
        recorded = None if capture.joints is None else capture.joints[rows]
        for pose in added:
            if (joints := joints_at(arm, poses[rows], recorded, pose)) is not None:
                added = pose[None]
                break
    predicted = predictions(assumptions, poses[rows], robot, added)
    names = [capture.images[row] for row in rows]
    return {"next_pose": next_poses(poses[rows], names, added[:1], predicted)[0], "next_joints": joints}


def _assumed(capture: Capture, poses: Float[ndarray, "m 4 4"], hand_eye: Calibration | None) -> Assumptions:
    """Return the assumptions for the prediction of uncertainties without an accepted calibration: typical errors.

    `poses` are the m gripper poses of the registered images. gripper_from_camera is that of `hand_eye` if its standard
    deviations are below 0.1 m and 5°, else a guess from the gripper poses.
    """
    camera = typical_camera(capture.intrinsics, capture.image_size, capture.intrinsics_std)
    assumptions = assumed(poses, camera)
    if hand_eye is not None:
        std, x = np.sqrt(np.diag(hand_eye.covariance)), hand_eye.gripper_from_camera
        if std[:3].max() < AIMED[0] and std[3:6].max() < AIMED[1]:
            return replace(assumptions, gripper_from_camera=x, distance_m=median_distance(poses @ x))
    return assumptions


def _least_rotation(added: Poses, known: Float[ndarray, "n 4 4"]) -> Float[ndarray, " k"]:
    """Return the smallest rotation angle (rad) between each pose in `added` (k,4,4) and the n poses in `known`."""
    return np.asarray(rotation_angle(np.swapaxes(known[:, :3, :3], 1, 2) @ added[:, None, :3, :3])).min(1)


def joints_at(
    arm: Arm,
    base_from_gripper: Float[ndarray, "n 4 4"],
    joints: Float[ndarray, "n dof"] | None,
    goal: Float[ndarray, "4 4"],
) -> Float[ndarray, " dof"] | None:
    """Return joint angles (rad) within the limits of `arm` that move the gripper to the pose `goal`; None if impossible.

    `goal` is a base_from_gripper. `base_from_gripper` and `joints` (rad) are those of the n images; `joints` is None if
    they were not recorded. The last recorded joints determine the pose of the tool on the flange, and the result keeps
    their configuration (elbow up or down, …).
    """
    if joints is not None:
        now = joints[-1:]
        flange_from_tool = (inverse(forward_kinematics(arm, now)) @ base_from_gripper[-1:])[0]
        flange = (goal @ inverse(flange_from_tool))[None]
        found = reach_toward(arm, flange, now)
        off = inverse(forward_kinematics(arm, found)) @ flange
        if np.linalg.norm(off[0, :3, 3]) < FITS[0] and float(rotation_angle(off[0, :3, :3])) < FITS[1]:
            return found[0]
        return None
    posture = inverse_kinematics(arm, np.concatenate([base_from_gripper, goal[None]]))
    return posture.joints[-1] if (posture.misfit[-1] < FITS).all() else None
