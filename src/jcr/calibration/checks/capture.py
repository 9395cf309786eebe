"""What was found before the calibration and is to be known with it: of the capture, its arm, its reconstruction."""

from jcr.calibration.case import Case
from jcr.calibration.checks.checked import Checked
from jcr.capture.checks import how_turned
from jcr.records import Finding, Kind


def check_arm(case: Case) -> Checked:
    """Why the arm that the capture names is not used."""
    return Checked(() if case.robot.unused is None else (case.robot.unused,))


def check_images(case: Case) -> Checked:
    """That the images were rotated to be read."""
    rotated = how_turned(case.capture)
    return Checked(() if rotated is None else (rotated,))


def check_reconstruction(case: Case) -> Checked:
    """What the back end warned of."""
    return Checked(
        tuple(
            Finding(kind=Kind.RECONSTRUCTION, severity="warns", details={"text": text})
            for text in case.reconstruction.warnings
        )
    )
