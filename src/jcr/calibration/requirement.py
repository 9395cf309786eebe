"""Required and reached accuracy of a calibration, and the number of images to add until the required one is reached."""

from dataclasses import replace
from math import ceil

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.options import GRASPING, CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.estimation.point_uncertainty import seen_points, valid_radius_px, within_95
from jcr.estimation.prediction import median_distance
from jcr.findings import Concerns, Finding, FindingKind
from jcr.records import Requirement, SceneUncertainty, Uncertainty, Where

MOST_MORE_IMAGES = 12
"""Largest number of images to add that is stated as the remedy of a missed accuracy."""


def reached(uncertainty: Uncertainty, at: Where) -> tuple[float, float]:
    """Return the bounds on 95 % of the translation errors (mm) and rotation errors (degrees) that `at` selects.

    The value "seen" selects a point seen by the camera, "camera" the camera's pose. The value "scene" selects mapped
    points, or a seen point if the uncertainty has no scene.
    """
    covariance, scene, seen = uncertainty.covariance, uncertainty.scene, uncertainty.seen
    if at == "camera":
        metres = within_95(covariance[:3, :3])
    elif at == "scene" and scene is not None:
        covariance, metres = scene.covariance, scene.within_95_m
    else:
        assert seen is not None
        return seen.within_95_mm, seen.rotation_95_deg
    return 1e3 * metres, float(np.degrees(within_95(covariance[3:6, 3:6])))


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
    uncertainty = replace(uncertainty, seen=seen, scene=scene)
    hand_eye = replace(hand_eye, uncertainty=uncertainty)
    required = _required(hand_eye, options, distance_m)
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
    left = Uncertainty(covariance=sum(lasting, start=np.zeros((7, 7))))
    left = replace(left, seen=seen_points(hand_eye.gripper_from_camera, left, None, distance_m))
    limits = (required.translation_mm, required.rotation_deg)
    bounds, more = (required.reached_mm, required.reached_deg), 0
    for bound, limit, least in zip(bounds, limits, reached(left, required.at), strict=True):
        if bound > limit:
            if limit <= least:
                return None
            share = (bound**2 - limit**2) / (limit**2 - least**2)
            more = max(more, ceil(hand_eye.images_used * share))
    return more if more <= MOST_MORE_IMAGES else None


def _required(hand_eye: Calibration, options: CalibrateOptions, distance_m: float) -> Requirement:
    """Return the accuracy that the options require (default: GRASPING), and the accuracy that the calibration states.

    `distance_m` is the distance (m) of a point at the image centre from the camera, and of one at the valid radius.
    """
    uncertainty, camera, valid_px = hand_eye.uncertainty, hand_eye.intrinsics, None
    reached_mm, reached_deg = reached(uncertainty, options.require_at)
    translation_mm, rotation_deg = options.require or GRASPING
    assert uncertainty.seen is not None
    if options.require_at == "seen" and uncertainty.joint is not None and camera is not None:
        x = hand_eye.gripper_from_camera
        valid_px = valid_radius_px(x, uncertainty, camera, distance_m, 1e-3 * translation_mm)
    return Requirement(
        translation_mm=translation_mm,
        rotation_deg=rotation_deg,
        asked=options.require is not None,
        distance_mm=0.0 if options.require_at == "camera" else uncertainty.seen.distance_mm,
        reached_mm=reached_mm,
        reached_deg=reached_deg,
        at=options.require_at,
        valid_px=valid_px,
    )
