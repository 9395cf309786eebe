"""What capture, arm and reconstruction show by themselves: too few images used, the pose convention, warnings."""

from dataclasses import replace

from jcr.calibration.case import Case, Checked
from jcr.calibration.conventions import better_reading, convention_finding
from jcr.capture.checks import how_rotated
from jcr.capture.pairing import paired_by_name
from jcr.estimation.observability import observability
from jcr.findings import Finding, FindingKind


def check_registered(case: Case) -> Checked:
    """Report that too few images are used: the motions of all would be observable, those of the used images are not.

    The motions are then not the cause, and other motions are no remedy.
    """
    hand_eye, capture = case.hand_eye, case.capture
    every = len(case.used) == len(capture)
    if every or not hand_eye.observability.findings or observability(capture.base_from_gripper).findings:
        return Checked()
    rejected = any(one.severity == "rejects" for one in hand_eye.findings)
    counts = {"value": float(len(case.used)), "of": float(len(capture))}
    few = Finding.of(FindingKind.FEW_USED, "rejects" if rejected else "warns", "reconstruction", **counts)
    findings = tuple(
        replace(one, concerns="reconstruction") if one.kind is FindingKind.UNOBSERVABLE else one
        for one in hand_eye.findings
    )
    return Checked((few,), replace(hand_eye, findings=findings))


def check_convention(case: Case) -> Checked:
    """The convention by which the gripper poses fit, where there is one.

    Of degenerate motions another may fit by chance: what is missing comes first.
    """
    rows, capture = case.reconstruction.image_index, case.capture
    by_name = paired_by_name(capture.images, capture.base_from_gripper)
    by_name = {by_number: poses[rows] for by_number, poses in by_name.items()}
    # Of other readings neither noise nor cues are known, nor are their camera poses weighed.
    alone = not case.priors and case.reconstruction.evidence is None
    fit = case.hand_eye.before or case.hand_eye
    solved = fit if alone and fit.robot_noise.given is None else None
    found = better_reading(case.base_from_gripper, case.recon_from_camera, by_name, solved)
    if found is None:
        return Checked()
    observable = case.hand_eye.observability.observable
    return Checked((convention_finding(found, "rejects" if observable else "warns"),))


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
            Finding.of(FindingKind.RECONSTRUCTION, "warns", text=text)
            for text in case.reconstruction.warnings
        )
    )
