"""The checks of a calibration, a row each, in the order in which they are made.

Causes before consequences. Poses of another convention fit nothing, so they come first where the fit was rejected. What
is wrong with the camera looks like a bent robot or a slip too: the camera is tested first, then the robot, then the
order of the images, each only where what comes before is sound. These are tests of rejected calibrations as well, for
they explain the rejection.
"""

from collections.abc import Callable, Collection
from dataclasses import dataclass

from jcr.calibration.case import Case, Checked
from jcr.calibration.checks.bent import check_bent
from jcr.calibration.checks.boards import check_boards
from jcr.calibration.checks.camera import check_camera
from jcr.calibration.checks.capture import (
    check_arm,
    check_convention,
    check_images,
    check_reconstruction,
    check_registered,
)
from jcr.calibration.checks.lengths import check_lengths
from jcr.calibration.checks.robot import check_robot
from jcr.calibration.checks.sequence import MIN_IMAGES, check_sequence
from jcr.records import BENT, CAMERA, Kind


@dataclass(frozen=True)
class Check:
    """A check, and the cases that it is made of."""

    run: Callable[[Case], Checked]
    needs: Callable[[Case], bool] = lambda case: True


def _is_observable(case: Case) -> bool:
    return case.hand_eye.observability.observable


def _fit_was_rejected(case: Case) -> bool:
    """By the poses themselves, and not because a board contradicts them."""
    sized = _has(case, {Kind.BOARD_SIZE})
    return not case.hand_eye.converged and case.hand_eye.before is None and not sized


def _has(case: Case, kinds: Collection[Kind]) -> bool:
    return any(finding.kind in kinds for finding in case.hand_eye.findings)


CHECKS = (
    Check(check_registered),
    Check(check_convention, _fit_was_rejected),
    Check(check_camera, lambda case: case.shows_camera and case.adjusted is not None),
    Check(
        check_bent, lambda case: case.shows_camera and case.adjusted is not None and not _has(case, CAMERA)
    ),
    Check(check_boards, lambda case: case.reconstruction.tracks.boards is not None),
    Check(check_lengths),
    Check(check_robot, _is_observable),
    Check(check_arm),
    Check(
        check_sequence,
        lambda case: _is_observable(case) and len(case.names) >= MIN_IMAGES and not _has(case, CAMERA | BENT),
    ),
    Check(check_images),
    Check(check_reconstruction),
)
