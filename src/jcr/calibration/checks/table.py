"""The checks of a calibration, a row each, in the order in which they are made.

Causes come before consequences. Poses of another convention fit nothing, so the convention is tested first where the
fit was rejected. Effects on camera and robot compete in one test (effects.py), of rejected calibrations as well, since
they explain the rejection.
"""

from jcr.calibration.case import Case
from jcr.calibration.checks.boards import check_boards
from jcr.calibration.checks.capture import check_pieces, check_registered, check_remarks
from jcr.calibration.checks.convention import check_convention
from jcr.calibration.checks.effects import check_effects
from jcr.calibration.checks.left_out import check_pairing
from jcr.calibration.checks.lengths import check_lengths
from jcr.calibration.checks.predicted_focal import check_predicted_focal
from jcr.calibration.checks.robot import check_robot
from jcr.findings import FindingKind, is_explained


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
