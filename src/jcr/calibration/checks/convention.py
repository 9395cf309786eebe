"""Do the poses of a rejected fit, read by another convention, fit the cameras?"""

from jcr.calibration.case import Case
from jcr.calibration.checks.checked import Checked
from jcr.capture.names import paired_by_name
from jcr.handeye.conventions import better_reading, convention_finding


def check_convention(case: Case) -> Checked:
    """The convention by which the gripper poses fit, where there is one.

    Of degenerate motions another may fit by chance: what is missing comes first.
    """
    rows, capture = case.reconstruction.image_index, case.capture
    by_name = paired_by_name(capture.images, capture.base_from_gripper)
    found = better_reading(
        case.base_from_gripper,
        case.recon_from_camera,
        {by_number: poses[rows] for by_number, poses in by_name.items()},
    )
    if found is None:
        return Checked()
    observable = case.hand_eye.observability.observable
    return Checked((convention_finding(found, "rejects" if observable else "warns"),))
