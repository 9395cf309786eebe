"""What was found before the calibration and is to be known with it: of the capture, its arm, its reconstruction."""

from dataclasses import replace

from jcr.calibration.case import Case
from jcr.calibration.checks.checked import Checked
from jcr.capture.checks import how_rotated
from jcr.handeye.observability import observability
from jcr.records import Finding, Kind


def check_registered(case: Case) -> Checked:
    """That too few images are used where the motions of all would do and those of these alone do not.

    What is unobservable is then no fault of the motions, and moving otherwise no remedy.
    """
    hand_eye, capture = case.hand_eye, case.capture
    every = len(case.used) == len(capture)
    if every or hand_eye.observability.observable or not observability(capture.base_from_gripper).observable:
        return Checked()
    few = Finding(
        kind=Kind.FEW_USED,
        severity="rejects",
        mend="reconstruction",
        value=float(len(case.used)),
        details={"of": float(len(capture))},
    )
    findings = tuple(
        replace(one, mend="reconstruction") if one.kind is Kind.UNOBSERVABLE else one
        for one in hand_eye.findings
    )
    return Checked((few,), replace(hand_eye, findings=findings))


def check_arm(case: Case) -> Checked:
    """Why the arm that the capture names is not used."""
    return Checked(() if case.robot.unused is None else (case.robot.unused,))


def check_images(case: Case) -> Checked:
    """That the images were rotated to be read."""
    rotated = how_rotated(case.capture)
    return Checked(() if rotated is None else (rotated,))


def check_reconstruction(case: Case) -> Checked:
    """What the back end warned of."""
    return Checked(
        tuple(
            Finding(kind=Kind.RECONSTRUCTION, severity="warns", details={"text": text})
            for text in case.reconstruction.warnings
        )
    )
