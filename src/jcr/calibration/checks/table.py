"""The checks of a calibration, a row each, in the order in which they are made.

Causes come before consequences. Poses of another convention fit nothing, so the convention is tested first where the
fit was rejected. Effects on camera and robot compete in one test (effects.py), of rejected calibrations as well, since
they explain the rejection.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from jcr.calibration.case import Case, CheckResult
from jcr.calibration.checks.boards import check_boards
from jcr.calibration.checks.capture import (
    check_arm,
    check_convention,
    check_images,
    check_pieces,
    check_reconstruction,
    check_registered,
)
from jcr.calibration.checks.effects import check_effects
from jcr.calibration.checks.lengths import check_lengths
from jcr.calibration.checks.predicted_focal import check_predicted_focal
from jcr.calibration.checks.robot import check_robot
from jcr.findings import FindingKind, is_explained


@dataclass(frozen=True)
class Check:
    """A check, and the cases that it is made of."""

    run: Callable[[Case], CheckResult]
    needs: Callable[[Case], bool] = lambda case: True


def _is_observable(case: Case) -> bool:
    return case.hand_eye.observability.observable


def _fit_was_rejected(case: Case) -> bool:
    """Return whether the poses themselves are rejected, with and without the images, and not because of a board."""
    fit = case.hand_eye.before or case.hand_eye
    return not case.hand_eye.converged and not fit.converged and not _has(case, {FindingKind.BOARD_SIZE})


def _is_open(case: Case) -> bool:
    """Return whether the motions are observable and no cause rejects the calibration yet."""
    return _is_observable(case) and not is_explained(case.hand_eye.findings)


def _has(case: Case, kinds: Collection[FindingKind]) -> bool:
    return any(finding.kind in kinds for finding in case.hand_eye.findings)


CHECKS = (
    Check(check_registered),
    Check(check_convention, _fit_was_rejected),
    Check(check_effects, _is_open),
    Check(check_pieces, _is_open),
    Check(check_predicted_focal),
    Check(check_boards, lambda case: case.reconstruction.tracks.boards is not None),
    Check(check_lengths),
    Check(check_robot, _is_open),
    Check(check_arm),
    Check(check_images),
    Check(check_reconstruction),
)
