"""What the place of a further camera shows against it: an image that contradicts it, a large ±, crowded points."""

from dataclasses import replace

import numpy as np

from jcr.cell.found import CameraFound
from jcr.cell.localise import LEAST_SPREAD, spread
from jcr.cell.rigs import Member
from jcr.estimation.hand_eye import MAX_STD
from jcr.findings import Finding, FindingKind

MEDIAN_PX = 3.0
"""Images of a camera that miss by more, of one 1600 px wide, do not fit one place."""
FAR_FROM_GRIPPER = 0.5
"""m: the camera of a gripper that is farther from its frame is likely to be another's."""


def with_faults(found: CameraFound, member: Member, faults: tuple[Finding, ...]) -> CameraFound:
    """A camera with what its images show against it, and with the shifts of that in its covariance.

    Such a fault explains a rejection, and rejects where its shift makes the place too uncertain.
    """
    assert found.covariance is not None
    for fault in faults:
        found = replace(found, covariance=found.covariance + fault.covariance[:6, :6])
        if not found.converged or place_uncertain(found, member) is not None:
            fault = replace(fault, severity="rejects")
        found = found.with_findings(fault)
    return found


def contradicting_image(found: CameraFound, member: Member) -> Finding | None:
    """That an image contradicts the place that fits all of the camera's together."""
    worst = max(found.images, key=lambda image: image.reprojection_px or 0.0)
    px = worst.reprojection_px or 0.0
    if px <= MEDIAN_PX * max(1.0, member.camera.image_size[0] / 1600):
        return None
    return Finding.of(FindingKind.IMAGE_MISSES, "rejects", "mount", worst.image, value=px, mount=found.mount)


def place_uncertain(found: CameraFound, member: Member) -> Finding | None:
    """That the camera's place is known too little; of unknown intrinsics with how well the focal length is known."""
    assert found.covariance is not None and found.intrinsics is not None and found.intrinsics_std is not None
    metres, radians = np.sqrt(np.diag(found.covariance)).reshape(2, 3).max(1).tolist()
    if metres <= MAX_STD[0] and radians <= MAX_STD[1]:
        return None
    details, unknown = {"rotation": radians}, member.camera.intrinsics is None
    if unknown:
        details["focal_std"] = float(found.intrinsics_std[0] / found.intrinsics.fx)
    return Finding.of(
        FindingKind.PLACE_UNCERTAIN, "rejects", "intrinsics" if unknown else "images", value=metres, **details
    )


def crowded_points(member: Member) -> Finding | None:
    """That the points span little of every image."""
    widest = max(spread(one) for one in member.seen.shared if one is not None)
    if widest >= LEAST_SPREAD:
        return None
    return Finding.of(FindingKind.POINTS_CROWDED, "warns", "images", value=widest)


def far_from_gripper(found: CameraFound) -> Finding | None:
    """That a camera said to be on a gripper is far from it."""
    assert found.parent_from_camera is not None
    away = float(np.linalg.norm(found.parent_from_camera[:3, 3]))
    if found.mount == "base" or away <= FAR_FROM_GRIPPER:
        return None
    return Finding.of(FindingKind.FAR_FROM_GRIPPER, "warns", "mount", value=away)
