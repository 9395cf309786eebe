"""Required and reached accuracy of a calibration, and the gripper poses to add until the required one is reached."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.options import GRASPING, MOST_POSES, CalibrateOptions
from jcr.calibration.record import Calibration
from jcr.calibration.robot_errors import RobotErrorPrior, of_poses
from jcr.estimation.point_uncertainty import seen_points, valid_radius_px, within_95
from jcr.estimation.prediction import (
    Assumptions,
    PredictedCamera,
    assumed_camera,
    candidate_poses,
    choose_poses,
    median_distance,
    nearest,
    predict,
    predict_covariance,
    total_uncertainty,
    typical_noise,
)
from jcr.findings import Concerns, Finding, FindingKind
from jcr.geometry import Poses, inverse, rotation_angle
from jcr.records import NextPose, Requirement, SceneUncertainty, Uncertainty, Where

PROPOSED = 2
"""Number of gripper poses that are proposed at least after a calibration that misses the required accuracy."""
COMPARED, EXISTING = 80, 40
"""Largest number of candidate poses, and of poses of the capture that the predictions for the candidates include."""


def better_poses(
    assumptions: Assumptions,
    base_from_gripper: Poses,
    robot: RobotErrorPrior,
    count: int,
    reach: Float[ndarray, "2 3"] | None = None,
    seed: int = 0,
    is_likely: Callable[[Poses], Bool[ndarray, " k"]] | None = None,
) -> Float[ndarray, "c 4 4"]:
    """Return `count` gripper poses to add that reduce the predicted uncertainty most, best first.

    The uncertainty is that of a point at the scene distance (`total_uncertainty`). `base_from_gripper` and `robot` are
    the poses of the capture and the prior of their errors. The candidates are random poses (`candidate_poses`) with
    gripper positions in the box `reach` (rows min, max; m, base frame), drawn with `seed`. `reach` None: the box of the
    capture's positions, enlarged by a quarter.

    `is_likely` returns a mask of the poses whose images are likely to register; other candidates are used only if the
    mask is empty. None: all candidates are used.
    """
    now, x = base_from_gripper, assumptions.gripper_from_camera
    if count == 0:
        return now[:0]
    possible = candidate_poses(now, x, reach, np.random.default_rng(seed))
    if is_likely is not None and (likely := is_likely(possible)).any():
        possible = possible[likely]
    possible = possible[:COMPARED]
    existing = np.linspace(0, len(now) - 1, min(len(now), EXISTING)).round().astype(int)
    systematic, poses = robot.with_poses(now, possible), np.concatenate([now, possible])

    def uncertainty_of(rows: Int[ndarray, " c"]) -> float:
        """Return the predicted total uncertainty (no unit) with the candidate poses of these indices added."""
        together = np.r_[existing, len(now) + rows]
        errors = of_poses(systematic, together)
        covariance = predict_covariance(assumptions, poses[together], errors, averaged=False)
        return total_uncertainty(covariance, assumptions.distance_m * x[:3, 2])

    return possible[choose_poses(count, len(possible), uncertainty_of)]


def predictions(
    assumptions: Assumptions, base_from_gripper: Poses, robot: RobotErrorPrior, added: Float[ndarray, "c 4 4"]
) -> Callable[[int], Uncertainty]:
    """Return a function that predicts the calibration's uncertainty with the first k of the `added` poses, given k.

    `base_from_gripper` and `robot` are the present gripper poses and the prior of their errors.
    """
    now = base_from_gripper
    poses = np.concatenate([now, added])
    return cache(lambda k: predict(assumptions, poses[: len(now) + k], robot.with_poses(now, added[:k])))


def next_poses(
    base_from_gripper: Poses,
    names: Sequence[str],
    added: Float[ndarray, "c 4 4"],
    predicted: Callable[[int], Uncertainty],
    reported: Uncertainty | None = None,
) -> tuple[NextPose, ...]:
    """Return records of the added poses, each with the uncertainty expected once this and all earlier ones are added.

    `names` are the images of the poses in `base_from_gripper`; `predicted` is the function that `predictions` returns.
    With the `reported` uncertainty of the calibration, the expected one is `reported` times the predicted ratio of
    after to before, because images and robot may differ from the assumptions. None: the prediction is used as it is.
    """
    found = []
    for count, pose in enumerate(added, start=1):
        std, bounds = (then := predicted(count)).std, np.array(reached(then, "seen"))
        if reported is not None:
            std = std * reported.std / predicted(0).std
            bounds = bounds * reached(reported, "seen") / reached(predicted(0), "seen")
        like = int(nearest(pose[None], base_from_gripper)[0])
        motion = inverse(base_from_gripper[like]) @ pose
        found.append(
            NextPose(
                base_from_gripper=pose,
                expected_std=std,
                within_95_mm=float(bounds[0]),
                rotation_95_deg=float(bounds[1]),
                like=names[like],
                moved_m=float(np.linalg.norm(motion[:3, 3])),
                rotation_rad=float(rotation_angle(motion[:3, :3])),
            )
        )
    return tuple(found)


def assumptions_of(case: Case) -> Assumptions:
    """Return the assumptions of predictions: new images and gripper poses are like the used ones of the case.

    If the case's images were not adjusted, camera poses are assumed to be given and exact (`Assumptions.camera` None).
    """
    used, metric_std = case.base_from_gripper[case.used], case.reconstruction.metric_std
    assumptions = assumptions_of_poses(case.hand_eye, used, metric_std)
    if case.adjusted is None or (distance := case.scene_distance_m) is None:
        return assumptions
    return replace(assumptions, distance_m=distance, camera=PredictedCamera.of(case.adjusted))


def assumptions_of_poses(
    hand_eye: Calibration, used: Float[ndarray, "n 4 4"], scale_std: float | None = None
) -> Assumptions:
    """Return the assumptions of predictions for a calibration from camera poses; `used` are its used gripper poses.

    `scale_std` is the relative standard deviation of a known scale; None: the scale is estimated.
    """
    return Assumptions(
        gripper_from_camera=hand_eye.gripper_from_camera,
        distance_m=median_distance(used @ hand_eye.gripper_from_camera),
        noise=hand_eye.robot_noise,
        scale_std=scale_std,
    )


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
    robot: RobotErrorPrior,
    assumptions: Assumptions,
    scene: SceneUncertainty | None = None,
) -> Calibration:
    """Return the calibration with its point uncertainty, the required accuracy, and the gripper poses to add.

    Poses are proposed if the required accuracy is not reached, if `options.next_poses` requests them, or if the
    calibration is rejected. A missed accuracy is also added as a finding. `gripper` (base_from_gripper) and `robot`,
    the prior of its errors, are those of the registered images. `scene` is None for a calibration from camera poses.
    """
    used, robot = gripper[hand_eye.inliers], robot.of(np.flatnonzero(hand_eye.inliers))
    x, uncertainty = hand_eye.gripper_from_camera, hand_eye.uncertainty
    seen = seen_points(x, uncertainty, hand_eye.intrinsics, assumptions.distance_m)
    uncertainty = replace(uncertainty, seen=seen, scene=scene)
    required = _required(hand_eye.with_uncertainty(uncertainty), options, assumptions.distance_m)
    # More images reduce neither the error of wrong intrinsics nor that of robot errors that depend on the reach.
    lasting = [
        one.covariance
        for one in hand_eye.findings
        if one.concerns == "intrinsics" or one.kind.row.group == "strain"
    ]
    assumptions = replace(assumptions, faults=sum(lasting, start=np.zeros((7, 7))))
    least = options.next_poses if required.met else max(PROPOSED, options.next_poses)
    if not hand_eye.converged:
        # Predictions for a rejected calibration assume a typical camera pose, and at least the typical robot errors.
        found, usual, least = hand_eye.robot_noise, typical_noise(), PROPOSED
        sizes = ("translation", "rotation", "systematic")
        noise = replace(found, **{name: max(getattr(found, name), getattr(usual, name)) for name in sizes})
        assumptions = replace(assumptions, gripper_from_camera=assumed_camera(used), noise=noise, camera=None)
    is_open = hand_eye.converged and not required.met
    added = better_poses(assumptions, used, robot, MOST_POSES if is_open else least)
    predicted = predictions(assumptions, used, robot, added)

    def is_met(count: int) -> bool:
        """Test whether `count` added poses are predicted to reach the required accuracy."""
        share = np.divide(reached(predicted(count), required.at), reached(predicted(0), required.at))
        mm, deg = (share * (required.reached_mm, required.reached_deg)).tolist()
        return replace(required, reached_mm=mm, reached_deg=deg).met

    more = None if not hand_eye.converged or is_open else 0
    if is_open and is_met(MOST_POSES):
        more = next(count for count in range(1, MOST_POSES + 1) if is_met(count))
    added, reported = added[: max(least, more or 0)], uncertainty if hand_eye.converged else None
    hand_eye = replace(
        hand_eye,
        uncertainty=uncertainty,
        next_poses=next_poses(used, hand_eye.names_used, added, predicted, reported),
        requirement=(required := replace(required, more_images=more)),
        findings=tuple(one for one in hand_eye.findings if one.kind is not FindingKind.NOT_EXACT_ENOUGH),
    )
    if not is_open:
        return hand_eye
    systematic = uncertainty.budget is not None and uncertainty.budget.mostly_systematic
    concerns: Concerns = "images" if more is not None else "robot" if systematic else "none"
    severity, size = "rejects" if required.asked else "warns", 1e-3 * required.reached_mm
    short = Finding.of(FindingKind.NOT_EXACT_ENOUGH, severity, concerns, value=size, **required.details)
    return hand_eye.with_findings(short)


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
