"""Required and reached accuracy of a calibration, and the number of images to add until the required one is reached."""

from dataclasses import replace
from math import ceil

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import GRASPING, CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.estimation.point_uncertainty import seen_points
from jcr.estimation.prediction import median_distance
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import Requirement, SceneUncertainty, Uncertainty

MOST_MORE_IMAGES = 12
"""Largest number of images to add that is stated as the remedy of a missed accuracy."""


def advised(
    hand_eye: Calibration,
    gripper: Float[ndarray, "m 4 4"],
    options: CalibrateOptions,
    distance_m: float | None = None,
    scene: SceneUncertainty | None = None,
) -> Calibration:
    """Return the calibration with its point uncertainty and the required accuracy.

    A missed accuracy is also added as a finding. `gripper` (base_from_gripper) are the poses of the registered images.
    `distance_m` is the distance of the scene; None: that of the point nearest to all optical axes. `scene` is None for
    a calibration from camera poses.
    """
    x, uncertainty = hand_eye.gripper_from_camera, hand_eye.uncertainty
    if distance_m is None:
        distance_m = median_distance(gripper[hand_eye.inliers] @ x)
    seen = seen_points(x, uncertainty, hand_eye.intrinsics, distance_m)
    hand_eye = replace(hand_eye, uncertainty=replace(uncertainty, seen=seen, scene=scene))
    translation_mm, rotation_deg = options.require or GRASPING
    required = Requirement(
        translation_mm=translation_mm,
        rotation_deg=rotation_deg,
        asked=options.require is not None,
        distance_mm=seen.distance_mm,
        reached_mm=seen.within_95_mm,
        reached_deg=seen.rotation_95_deg,
    )
    is_open = hand_eye.converged and not required.met
    more = None
    if hand_eye.converged:
        more = _more_images(hand_eye, required, distance_m) if is_open else 0
    required = replace(required, more_images=more)
    findings = tuple(one for one in hand_eye.findings if one.kind is not FindingKind.NOT_EXACT_ENOUGH)
    hand_eye = replace(hand_eye, requirement=required, findings=findings)
    if not is_open:
        return hand_eye
    systematic = uncertainty.budget is not None and uncertainty.budget.mostly_systematic
    concerns: Concerns = "images" if more is not None else "robot" if systematic else "none"
    severity, size = "rejects" if required.asked else "warns", 1e-3 * required.reached_mm
    short = Finding.of(FindingKind.NOT_EXACT_ENOUGH, severity, concerns, value=size, **required.details)
    return hand_eye.with_findings(short)


def _more_images(hand_eye: Calibration, required: Requirement, distance_m: float) -> int | None:
    """Return the number of images to add until a missed accuracy is reached; None above MOST_MORE_IMAGES.

    Random errors fall with one over the square root of the number of images. With k images more than the n used ones,
    the bound b on 95 % of the errors is expected to become b(k), where b(k)² = s² + (b² - s²) n / (n + k). The part s
    does not fall. It is the bound of the errors of the intrinsics and of robot errors that depend on the reach, as
    findings state them, and of the systematic robot errors in the uncertainty budget. The equation is solved for the
    required bounds of translation and rotation, and the larger k counts. `distance_m` is that of the point whose
    uncertainty is required.
    """
    lasting = [
        one.covariance
        for one in hand_eye.findings
        if one.concerns == "intrinsics" or one.kind.row.group == "strain"
    ]
    if (budget := hand_eye.uncertainty.budget) is not None:
        lasting.append(budget.robot_systematic)
    of_lasting = Uncertainty(covariance=sum(lasting, start=np.zeros((7, 7))))
    left = seen_points(hand_eye.gripper_from_camera, of_lasting, None, distance_m)
    more = 0
    for bound, limit, least in (
        (required.reached_mm, required.translation_mm, left.within_95_mm),
        (required.reached_deg, required.rotation_deg, left.rotation_95_deg),
    ):
        if bound > limit:
            if limit <= least:
                return None
            share = (bound**2 - limit**2) / (limit**2 - least**2)
            more = max(more, ceil(hand_eye.images_used * share))
    return more if more <= MOST_MORE_IMAGES else None
