"""The checks of a calibration, a row each, in the order in which they are made.

Causes come before consequences. Poses of another convention fit nothing, so the convention is tested first where the
fit was rejected. Effects on camera and robot compete in one test (effects.py), of rejected calibrations as well, since
they explain the rejection.
"""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case
from jcr.calibration.checks.capture import check_convention, check_pieces, check_registered, check_remarks
from jcr.calibration.checks.effects import check_effects
from jcr.calibration.checks.left_out import check_pairing
from jcr.calibration.checks.lengths import check_boards, check_lengths
from jcr.estimation.hypotheses import joint_offsets
from jcr.estimation.intrinsics_prior import MEASURED, camera_with_prior
from jcr.estimation.pose_equations import pose_equations
from jcr.estimation.problem import pose_problem
from jcr.findings import Finding, FindingKind, is_explained

OF_NETWORK = 1.64
"""Standard deviations between a network's focal length and the given one; a tenth of the networks is farther off."""
MIN_EXAMINED = 4
"""Fewest images from which joint offsets are estimated."""
SURE = 2.5
"""Standard deviations from which a joint's offset is named."""


def check_predicted_focal(case: Case) -> Case:
    """Report that a network's focal length contradicts the one that was given; their difference is uncertainty."""
    given, predicted = case.capture.intrinsics, case.reconstruction.predicted_focal
    if given is None or predicted is None:
        return case
    focal, relative_std = predicted
    off = focal / given.fx - 1
    if abs(off) < OF_NETWORK * np.hypot(relative_std, MEASURED["f"]):
        return case
    size = {"focal": focal, "focal_std": focal * relative_std, "focal_given": given.fx}
    by_focal = camera_with_prior(case.reconstruction.intrinsics, {"f": abs(off)})
    moved = tuple((by_focal.directions @ by_focal.std).tolist())
    found = Finding.of(FindingKind.INTRINSICS, "warns", "intrinsics", **size)
    return case.after((replace(found, shift=(0.0,) * 7, intrinsics_shift=moved),))


def check_robot(case: Case) -> Case:
    """Estimate the offsets of a known arm's joints from the fit to poses, and name those that are surely off.

    A camera that is not as its model has it changes the cameras' poses: then no joint is named.
    """
    used, arm, joints, hand_eye = case.used, case.robot.arm, case.robot.joints, case.hand_eye
    if len(used) < MIN_EXAMINED or arm is None or joints is None:
        return case
    fit = case.pose_fit
    problem, state = pose_problem(
        case.base_from_gripper[used],
        case.recon_from_camera[used],
        (fit.gripper_from_camera, fit.scale, fit.base_from_recon.rigid),
        error_covariance=case.systematic,
        noise_floor=fit.robot_noise.given,
    )
    found = joint_offsets(pose_equations(problem, state, None), arm, joints[used])
    hand_eye = replace(hand_eye, joint_offsets=found)
    off = np.flatnonzero(np.abs(found.offset) > SURE * found.std).tolist()
    if not off or any(one.kind.row.group == "camera" for one in hand_eye.findings):
        return replace(case, hand_eye=hand_eye)
    sizes = {f"joint_{k + 1}": float(found.offset[k]) for k in off}
    stds = {f"joint_{k + 1}_std": float(found.std[k]) for k in off}
    value = float(np.abs(found.offset[off]).max())
    finding = Finding.of(FindingKind.JOINT_OFFSETS, "informs", "robot", value=value, **sizes, **stds)
    return case.after((replace(finding, joints=tuple(k + 1 for k in off)),), hand_eye)


def _fit_was_rejected(case: Case) -> bool:
    """Return whether the poses themselves are rejected, with and without the images, and not because of a board."""
    fit = case.pose_fit
    by_board = any(finding.kind is FindingKind.BOARD_SIZE for finding in case.hand_eye.findings)
    return not case.hand_eye.converged and not fit.converged and not by_board


def _is_open(case: Case) -> bool:
    """Return whether the motions are observable and no cause rejects the calibration yet."""
    return case.hand_eye.observability.observable and not is_explained(case.hand_eye.findings)


def _has_left_out(case: Case) -> bool:
    """Return whether two or more images are left out, and the others agree on one observable calibration."""
    kinds = {one.kind for one in case.hand_eye.findings}
    agree = not kinds & {FindingKind.FEW_AGREE, FindingKind.POSES_CONTRADICT_IMAGES}
    agree = agree and not case.hand_eye.observability.findings
    return agree and len(case.capture) - len(case.used) >= 2


def _always(_case: Case) -> bool:
    return True


CHECKS = (
    (check_registered, _always),
    (check_convention, _fit_was_rejected),
    (check_pairing, _has_left_out),
    (check_effects, _is_open),
    (check_pieces, _is_open),
    (check_predicted_focal, _always),
    (check_boards, lambda case: case.reconstruction.tracks.boards is not None),
    (check_lengths, _always),
    (check_robot, _is_open),
    (check_remarks, _always),
)
"""Checks, and the cases that each is made of."""
