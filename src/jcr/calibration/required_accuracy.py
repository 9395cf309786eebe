"""Required and reached accuracy of a calibration, and the number of images to add until the required one is reached."""

from collections.abc import Sequence
from dataclasses import replace
from math import ceil

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.estimation.point_uncertainty import seen_points
from jcr.estimation.prediction import median_distance
from jcr.findings import Concerns, Finding, FindingKind, verdict_of
from jcr.geometry import Transform
from jcr.records import Requirement, SceneUncertainty, Uncertainty

MOST_MORE_IMAGES = 12
"""Largest number of images to add that is stated as the remedy of a missed accuracy."""
IMAGES_FIRST = 5
"""Number of images to add before the advice of another camera or robot, if the bound may be reached with images."""
FORECAST_IMAGES = 8
"""Least number of used images for a forecast from how much of their error is random: with k images that size is known
to a factor of about 1 ± 1/√(2k), 25 % for eight. With fewer images the remedy is to take as many."""

BELOW_USE = 1 / 3
"""Share of a point's 95 % below which a motion during the capture is information and no warning. The motion is part of
that bound, and makes it 5 % larger than without it (1 % larger with half the share, 12 % with one and a half times)."""


def advised(
    hand_eye: Calibration,
    gripper: Float[ndarray, "m 4 4"],
    options: CalibrateOptions,
    distance_m: float | None = None,
    scene: SceneUncertainty | None = None,
) -> Calibration:
    """Return the calibration with its point uncertainty and, unless none is required, the required accuracy.

    A missed accuracy is also added as a finding. `gripper` are the gripper poses of the registered images
    (base_from_gripper; gripper_from_base for a fixed camera).
    `distance_m` is the distance of the scene; None: that of the point nearest to all optical axes. `scene` is None for
    a calibration from camera poses.
    """
    x, uncertainty = hand_eye.parent_from_camera, hand_eye.uncertainty
    if distance_m is None:
        distance_m = median_distance(gripper[hand_eye.inliers] @ x)
    seen = seen_points(x, uncertainty, hand_eye.intrinsics, distance_m)
    uncertainty = replace(uncertainty, seen=seen, scene=scene)
    findings = tuple(
        _as_remark(one, distance_m, 1e-3 * seen.within_95_mm)
        for one in hand_eye.findings
        if one.kind is not FindingKind.NOT_EXACT_ENOUGH
    )
    arm_known = hand_eye.joint_offsets is not None
    required, missed = requirement_of(x, uncertainty, findings, hand_eye.images_used, options, arm_known)
    made = replace(hand_eye, uncertainty=uncertainty, requirement=required, findings=findings)
    return made.with_findings(*missed)


def _as_remark(found: Finding, distance_m: float, within_95_m: float) -> Finding:
    """Return the finding of a motion that moves a point by less than BELOW_USE of its 95 % as one that informs.

    `distance_m` is the distance of the point from the camera. Other findings are returned unchanged.
    """
    if found.severity != "warns" or found.kind.row.group != "order" or "rotation" not in found.details:
        return found
    moved_m = (found.value or 0.0) + float(found.details["rotation"]) * distance_m
    return replace(found, severity="informs") if moved_m < BELOW_USE * within_95_m else found


def requirement_of(
    x: Transform,
    uncertainty: Uncertainty,
    findings: Sequence[Finding],
    images: int,
    options: CalibrateOptions,
    arm_known: bool = False,
) -> tuple[Requirement | None, tuple[Finding, ...]]:
    """Return the required and reached accuracy, and a finding if it is missed by a calibration that nothing rejects.

    `x` is gripper_from_camera, `uncertainty` has the uncertainty of points (`seen`), and `findings` are those of the
    calibration. `images` is the number of used images, `arm_known` whether the arm's joints are modelled. The
    first is None if no accuracy is required or it is unknown.
    """
    seen = uncertainty.seen
    if options.require == "none" or seen is None:
        return None, ()
    required = Requirement(
        translation_mm=options.require[0],
        rotation_deg=options.require[1],
        distance_mm=seen.distance_mm,
        reached_mm=seen.within_95_mm,
        reached_deg=seen.rotation_95_deg,
    )
    if verdict_of(findings) == "rejected":
        return required, ()
    if required.met:
        return replace(required, more_images=0), ()
    more = max(FORECAST_IMAGES - images, 0) or _more_images(x, uncertainty, findings, images, required)
    required = replace(required, more_images=more)
    main_part = None if uncertainty.budget is None else uncertainty.budget.main_part
    concerns: Concerns = "images" if more is not None else "none"
    warned = [one for one in findings if one.severity == "warns" and one.kind.row.group == "order"]
    if more is None and any(one.shift is not None for one in warned):
        concerns = "mount"
    elif more is None and main_part == "robot_systematic" and not arm_known:
        concerns = "robot"
    elif more is None and main_part == "intrinsics":
        concerns = "intrinsics"
    elif more is None:
        # The size of the errors is known to 1 ± 1/√(2k); the estimated one may be too large by one standard deviation.
        factor = 1 / (1 - 1 / np.sqrt(2 * images))
        in_mm, in_deg = factor * required.translation_mm, factor * required.rotation_deg
        eased = replace(required, translation_mm=in_mm, rotation_deg=in_deg)
        if _more_images(x, uncertainty, findings, images, eased) is not None:
            required, concerns = replace(required, more_images=IMAGES_FIRST), "images"
    size = 1e-3 * required.reached_mm
    return required, (
        Finding.of(FindingKind.NOT_EXACT_ENOUGH, "warns", concerns, value=size, **required.details),
    )


def _more_images(
    x: Transform,
    uncertainty: Uncertainty,
    findings: Sequence[Finding],
    images: int,
    required: Requirement,
) -> int | None:
    """Return the number of images to add until a missed accuracy is reached; None above MOST_MORE_IMAGES.

    Random errors fall with one over the square root of the number of images. With k images more than the n used ones,
    the bound b on 95 % of the errors is expected to become b(k), where b(k)² = s² + (b² - s²) n / (n + k). The part s
    does not fall. It is the bound of the errors of the intrinsics and of robot errors that depend on the reach, as
    findings state them, and of the systematic robot errors in the uncertainty budget. The equation is solved for the
    required bounds of translation and rotation, and the larger k counts. The arguments are those of `requirement_of`.
    """
    lasting = [
        one.covariance for one in findings if one.concerns == "intrinsics" or one.kind.row.group == "strain"
    ]
    if (budget := uncertainty.budget) is not None:
        lasting.append(budget.robot_systematic)
    of_lasting = Uncertainty(covariance=sum(lasting, start=np.zeros((7, 7))))
    left = seen_points(x, of_lasting, None, 1e-3 * required.distance_mm)
    more = 0
    for bound, limit, least in (
        (required.reached_mm, required.translation_mm, left.within_95_mm),
        (required.reached_deg, required.rotation_deg, left.rotation_95_deg),
    ):
        if bound > limit:
            if limit <= least:
                return None
            share = (bound**2 - limit**2) / (limit**2 - least**2)
            more = max(more, ceil(images * share))
    return more if more <= MOST_MORE_IMAGES else None
