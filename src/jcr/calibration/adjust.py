"""Joint bundle adjustment of a case's camera poses, points, intrinsics and gripper poses (estimation/).

A case without adjusted images keeps the fit to camera poses; errors of the intrinsics are added to its covariance.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.hand_eye import JUDGED, image_verdicts, judged, leave_one_out
from jcr.calibration.record import Calibration
from jcr.camera import by_parameters, by_point, parameter_names
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.intrinsics_prior import decentring
from jcr.estimation.pose_equations import (
    paper_residuals,
    pose_by_pose,
    predicted_gripper_poses,
    reported_poses,
)
from jcr.estimation.problem import pose_problem, transferred, wrist_arm, wrist_problem
from jcr.estimation.projection import view_of
from jcr.estimation.solve import START_NOISE, Solution, recon_frame, solve, uncertainty_of
from jcr.findings import Finding, FindingKind
from jcr.geometry import (
    Poses,
    apply,
    inverse,
    retract,
    rotation_exp,
    scale_translation,
    skew,
    step_between,
    transform,
)
from jcr.records import COVARIANCE_ORDER, JointCovariance, PaperResiduals

FEWEST = 6
"""Fewest observations of an image; with fewer, the camera's motion due to wrong intrinsics is not computed."""
SETTLED_ENOUGH = 0.5
"""Largest last step, in standard deviations, for which an adjustment that did not converge is a note and no warning:
effects of that size are not reported either (checks/effects.py)."""


def with_adjusted_images(case: Case) -> Case:
    """Return the case after bundle adjustment, with the adjusted calibration in place of the fit to camera poses.

    A rejected fit is replaced too, because without given intrinsics its camera poses are poor. For correspondences
    between pointmaps, whose errors are correlated, the fit is replaced only if the leave-one-out error
    (`LeaveOneOut.length_m`) decreases. The fit is kept if the motions are degenerate, or if the adjustment fails
    (points behind the cameras).

    If the case is not adjustable (`Case.is_adjustable`), the fit is kept. The uncertainty of given intrinsics, or of
    the principal point for a network's camera poses, is added to its covariance.
    """
    if not case.is_adjustable and case.reconstruction.predicted_focal is not None:
        # Camera poses of a network do not depend on the focal length. An error of the principal point rotates their
        # hand-eye transform; the joint covariance contains this correlation.
        hand_eye, camera, x = case.hand_eye, case.camera, case.hand_eye.gripper_from_camera
        root, names = camera.directions * camera.std, parameter_names(camera.intrinsics)
        by_camera = np.zeros((7, len(root)))
        by_camera[3:6, names.index("cx")] = x[:3, 1] / camera.intrinsics.fx
        by_camera[3:6, names.index("cy")] = -x[:3, 0] / camera.intrinsics.fy
        moved = by_camera @ root
        uncertainty = hand_eye.uncertainty.with_error(moved @ moved.T, "intrinsics")
        half = np.concatenate([moved, root])
        together = half @ half.T
        together[:7, :7] = uncertainty.covariance
        joint = JointCovariance(covariance=together, order=(*COVARIANCE_ORDER, *names))
        return replace(case, hand_eye=judged(hand_eye.with_uncertainty(replace(uncertainty, joint=joint))))
    if not case.is_adjustable:
        made_with_them = case.reconstruction.evidence is None and not case.tracks.from_pointmaps
        if case.capture.intrinsics is None or not made_with_them or not case.hand_eye.converged:
            return case
        return replace(case, hand_eye=judged(with_intrinsics_considered(case)))
    try:
        found = adjust_case(case)
    except np.linalg.LinAlgError:
        return case
    case = replace(case, adjusted=found)
    if not case.hand_eye.observability.observable:
        return case
    refined = readjusted(case, found)
    nearer, than = refined.held_out, case.hand_eye.held_out
    if case.tracks.from_pointmaps and (nearer is None or than is None or nearer.length_m >= than.length_m):
        return case
    return replace(case, hand_eye=refined, fit=case.pose_fit)


def readjusted(case: Case, found: Solution) -> Calibration:
    """Return the calibration that the adjustment `found` of a case gives, with the findings of earlier checks.

    Kinds JUDGED are derived again, and a finding states whether this adjustment settled.
    """
    derived = JUDGED | {FindingKind.NOT_SETTLED}
    kept = tuple(one for one in case.hand_eye.findings if one.kind not in derived)
    refined = replace(refined_by(case, found), findings=kept)
    for one in kept:
        refined = refined.with_finding(one)
    refined = judged(refined)
    if found.settled:
        return refined
    # The iterations ended before the steps and the estimated sizes of the errors converged.
    severity = "warns" if found.last_step > SETTLED_ENOUGH else "informs"
    size = {"value": found.last_step, "rounds": float(found.iterations)}
    return refined.with_findings(Finding.of(FindingKind.NOT_SETTLED, severity, "reconstruction", **size))


def adjust_case(
    case: Case,
    *,
    combinations: Float[ndarray, "e p"] | None = None,
    confirmed_errors: Float[ndarray, "s b"] | None = None,
) -> Solution:
    """Adjust the used images and gripper poses of a case, starting from its last adjustment or its fit to camera poses.

    `combinations` (e,p) are p directions in the e parameters of the camera (hypotheses.Row) to estimate in addition;
    None: none. `confirmed_errors` (s,b) are b patterns of gripper pose errors of one standard deviation each; None:
    none. Their rows, s = 6 per used image, are translation (m) and rotation vector (rad) in base axes.

    The initial robot pose noise is that of the fit, and at least START_NOISE. A smaller initial noise needs ten times
    the steps if poses and images contradict each other.
    """
    fit = case.pose_fit
    arm = wrist_arm(case.base_from_gripper[case.used], case.systematic)
    metres, radians = fit.robot_noise.together
    problem, state = wrist_problem(
        replace(arm, carries=case.carries, confirmed_errors=confirmed_errors),
        (fit.gripper_from_camera, fit.scale, fit.base_from_recon.rigid),
        case.recon_from_camera[case.used],
        case.camera,
        case.tracks,
        noise=case.options.robot_noise_m_rad,
        combinations=combinations,
    )
    if (near := case.adjusted) is not None:
        state = transferred(near.problem, near.state, problem)
    noise = max(START_NOISE[0], metres), max(START_NOISE[1], radians)
    return solve(problem, state, start_noise=noise)


def with_intrinsics_considered(case: Case) -> Calibration:
    """Return the fit to camera poses with the errors of the intrinsics added to its covariance C: C + S Φ Sᵀ.

    This is Schmidt's consider covariance (Tapley, Schutz and Born, "Statistical Orbit Determination", 2004, chapter 6).
    Φ is the covariance of the intrinsics, from their prior (`Case.camera`). S is the derivative of the fit by the
    intrinsics. For S, each parameter changes by one standard deviation, and the camera poses change so that the pixels
    of the tracks stay in place. The fit is returned unchanged if an image has fewer than FEWEST observations.
    """
    hand_eye, tracks, camera = case.hand_eye, case.tracks, case.camera
    base_from_gripper, recon_from_camera = (
        case.base_from_gripper[case.used],
        case.recon_from_camera[case.used],
    )
    moved = np.zeros((len(recon_from_camera), 6, len(camera.std)))
    for row, pose in enumerate(recon_from_camera):
        if len(seen := np.flatnonzero(tracks.image == row)) < FEWEST:
            return hand_eye
        x_in_camera = apply(inverse(pose), tracks.points_in_recon[tracks.point[seen]].astype(float))
        by_x = by_point(camera.intrinsics, x_in_camera)
        by_pose = np.concatenate([by_x, -by_x @ skew(x_in_camera)], axis=2).reshape(-1, 6)
        by_intrinsics = by_parameters(camera.intrinsics, x_in_camera) @ (camera.directions * camera.std)
        steps = -np.linalg.lstsq(by_pose, by_intrinsics.reshape(len(by_pose), -1), rcond=None)[0].T
        again = pose @ inverse(transform(rotation_exp(steps[:, 3:]), steps[:, :3]))
        moved[row] = step_between(pose, again).T
    start = hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon.rigid
    problem, state = pose_problem(
        base_from_gripper,
        recon_from_camera,
        start,
        error_covariance=case.systematic,
        noise_floor=hand_eye.robot_noise.given,
        priors=case.priors,
    )
    found = solve(problem, state, averaged=False)
    by_camera = reported_poses(problem, found.state)[2]
    shifts = -(found.at_mode.gain @ pose_by_pose(by_camera, moved.reshape(6 * len(moved), -1)))[:7]
    return hand_eye.with_uncertainty(hand_eye.uncertainty.with_error(shifts @ shifts.T, "intrinsics"))


def refined_by(case: Case, found: Solution) -> Calibration:
    """Return the calibration that the adjustment `found` of a case gives, with the findings of the fit to camera poses.

    `readjusted` replaces these findings. For an arm that carries the
    scene, gripper_from_camera stands for base_from_camera, and base_from_recon for gripper_from_object.
    """
    fit, used, x = case.pose_fit, case.used, found.state.x[0]
    scale, base_from_recon = recon_frame(found, case.tracks)
    uncertainty, intrinsics = uncertainty_of(found), found.problem.intrinsics(found.state)[0]
    if case.capture.intrinsics is None and intrinsics.model == "pinhole":
        # An unmodelled thin prism changes transform and intrinsics together and moves no point. Camera models other
        # than pinhole have coefficients of their own for it.
        steps = decentring(intrinsics, x)
        uncertainty = uncertainty.with_error(steps @ steps.T, "intrinsics")
    gripper, camera = case.base_from_gripper, case.recon_from_camera
    # For an arm that carries the scene, X, Z and the rigs predict gripper_from_base.
    of_arm: Callable[[Poses], Poses] = inverse if case.carries == "scene" else np.asarray
    # The residuals of rejected gripper poses refer to the poses that their camera poses predict.
    predicted = of_arm(base_from_recon @ scale_translation(camera, scale) @ inverse(x))
    state, rigs = found.state, found.problem.arms[0].rigs
    predicted[used] = of_arm(predicted_gripper_poses(x, state.scale, state.z[0], state.world_from_rig[rigs]))
    metres, radians = np.linalg.norm(step_between(gripper, predicted).reshape(-1, 2, 3), axis=2).T
    reprojection = np.full(len(gripper), np.nan)
    reprojection[used] = median_reprojection_px(found.problem, found.images.view)
    reasons = [image.reason for image in fit.images]
    # Each gripper pose is predicted without its own image. The reprojection error refers to cameras that are displaced
    # by the leave-one-out residuals of their gripper poses.
    left_out, likely = found.leave_one_out[0], found.most_likely
    x_likely, z, displaced = likely.x[0], likely.z[0], likely.world_from_rig.copy()
    gripper_likely = of_arm(predicted_gripper_poses(x_likely, likely.scale, z, displaced[rigs]))
    in_metres = inverse(z) @ of_arm(retract(gripper_likely, -left_out)) @ x_likely
    displaced[rigs] = scale_translation(in_metres, 1 / likely.scale)
    moved = view_of(found.problem, replace(found.images.state, world_from_rig=displaced))
    reprojection_px = float(np.median(median_reprojection_px(found.problem, moved)))
    how = "each image's gripper pose predicted by the others"
    return replace(
        fit,
        on_gripper=x,
        resting=base_from_recon,
        scale=scale,
        source="images",
        uncertainty=uncertainty,
        intrinsics=intrinsics.with_std(uncertainty.intrinsics_std),
        images=image_verdicts(case.names, fit.inliers, reasons, metres, radians, reprojection),
        residuals=PaperResiduals(*paper_residuals(of_arm(gripper), camera, x, scale, fit.inliers)),
        robot_noise=found.noise,
        held_out=leave_one_out(left_out, how, reprojection_px),
    )
