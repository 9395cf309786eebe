"""Joint bundle adjustment of a case's camera poses, points, intrinsics and gripper poses (estimation/).

A case without adjusted images keeps the fit to camera poses; errors of the intrinsics are added to its covariance.
"""

from dataclasses import replace

import numpy as np

from jcr.calibration.case import Case, Model
from jcr.calibration.hand_eye import image_verdicts, leave_one_out, transforms
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import with_uncertainty
from jcr.camera import by_parameters, by_point, parameter_names
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.intrinsics_prior import decentring
from jcr.estimation.pose_equations import (
    paper_residuals,
    pose_by_pose,
    predicted_gripper_poses,
    reported_poses,
)
from jcr.estimation.problem import Problem, pose_problem, transferred, wrist_arm, wrist_problem
from jcr.estimation.projection import view_of
from jcr.estimation.robot_noise import of_poses
from jcr.estimation.solve import START_NOISE, Solution, recon_frame, solve, uncertainty_of
from jcr.geometry import (
    apply,
    inverse,
    retract,
    rotation_exp,
    scale_translation,
    skew,
    step_between,
    transform,
)
from jcr.records import COVARIANCE_ORDER, JointCovariance, PaperResiduals, Uncertainty

FEWEST = 6
"""Fewest observations of an image; with fewer, the camera's motion due to wrong intrinsics is not computed."""


def adjusted(case: Case) -> Case:
    """Return the case after the bundle adjustment of its model, or with the fit to camera poses if that fails.

    A rejected fit is replaced too, because without given intrinsics its camera poses are poor. If the case is not
    adjustable (`Case.is_adjustable`), the fit is kept. The uncertainty of given intrinsics, or of the principal point
    for a network's camera poses, is then added to its covariance.
    """
    if case.is_adjustable:
        try:
            return solved(case, case.model)
        except np.linalg.LinAlgError:
            return case
    fit, uncertainty = case.fit, None
    made_with_intrinsics = case.reconstruction.evidence is None and not case.model.tracks.from_pointmaps
    if case.reconstruction.predicted_focal is not None:
        uncertainty = _with_network_camera(case)
    elif case.capture.intrinsics is not None and made_with_intrinsics and case.calibration.converged:
        uncertainty = _with_intrinsics_considered(case)
    return case if uncertainty is None else replace(case, numbers=with_uncertainty(fit, uncertainty))


def solved(case: Case, model: Model) -> Case:
    """Return the case with another model, and the solution of its images as far as it is better than the fit to poses.

    The numbers of the case stay those of the fit if the motions are degenerate. For correspondences between pointmaps,
    whose errors are correlated, they stay unless the leave-one-out error (`LeaveOneOut.length_m`) decreases. Raises
    LinAlgError if the adjustment fails, as where points lie behind the cameras.
    """
    case = replace(case, model=model, solution=solution_of(case, model))
    if not all("nearly" in one.details for one in case.fit.findings):
        return case
    numbers = adjusted_numbers(case)
    nearer, than = numbers.held_out, case.fit.held_out
    is_worse = nearer is None or than is None or nearer.length_m >= than.length_m
    return case if model.tracks.from_pointmaps and is_worse else replace(case, numbers=numbers)


def solution_of(case: Case, model: Model) -> Solution:
    """Adjust images and gripper poses of a model, starting from the case's solution if it is near, else from its fit.

    The initial robot pose noise is that of the fit, and at least START_NOISE. A smaller initial noise needs ten times
    the steps if poses and images contradict each other.
    """
    fit, used = case.fit, np.flatnonzero(model.used)
    arm = wrist_arm(case.base_from_gripper[used], of_poses(case.robot.systematic, used))
    metres, radians = fit.robot_noise.together
    problem, state = wrist_problem(
        replace(arm, carries=case.carries),
        (fit.parent_from_camera, fit.scale, fit.body_from_recon.rigid),
        case.recon_from_camera[used],
        model.camera,
        model.observations,
        noise=case.options.robot_noise_m_rad,
        effects=model.effects,
    )
    problem = replace(problem, priors=model.lengths)
    if case.solution is not None and _is_near(case.model, model, case.solution.problem, problem):
        state = transferred(case.solution.problem, case.solution.state, problem)
    noise = max(START_NOISE[0], metres), max(START_NOISE[1], radians)
    return solve(problem, state, start_noise=noise)


def _is_near(before: Model, after: Model, old: Problem, new: Problem) -> bool:
    """Return whether a solution of one model is a state of another: the same images, camera and boards, fewer points."""
    if before.tracks is not after.tracks or before.camera is not after.camera:
        return False
    rows, own = (one.observations.point_rows for one in (old, new) if one.observations is not None)
    assert rows is not None and own is not None
    return np.array_equal(before.used, after.used) and bool(np.isin(own, rows).all())


def _with_network_camera(case: Case) -> Uncertainty:
    """Return the uncertainty of the fit to a network's camera poses, jointly with that of its intrinsics.

    Camera poses of a network do not depend on the focal length. An error of the principal point rotates their hand-eye
    transform; the joint covariance contains this correlation.
    """
    fit, camera, x = case.fit, case.model.camera, case.fit.parent_from_camera
    root, names = camera.directions * camera.std, parameter_names(camera.intrinsics)
    by_camera = np.zeros((7, len(root)))
    by_camera[3:6, names.index("cx")] = x[:3, 1] / camera.intrinsics.fx
    by_camera[3:6, names.index("cy")] = -x[:3, 0] / camera.intrinsics.fy
    moved = by_camera @ root
    uncertainty = fit.uncertainty.with_error(moved @ moved.T, "intrinsics")
    half = np.concatenate([moved, root])
    together = half @ half.T
    together[:7, :7] = uncertainty.covariance
    joint = JointCovariance(covariance=together, order=(*COVARIANCE_ORDER, *names))
    return replace(uncertainty, joint=joint)


def _with_intrinsics_considered(case: Case) -> Uncertainty:
    """Return the uncertainty of the fit to camera poses, with errors of the intrinsics in its covariance C: C + S Φ Sᵀ.

    This is Schmidt's consider covariance (Tapley, Schutz and Born, "Statistical Orbit Determination", 2004, chapter 6).
    Φ is the covariance of the intrinsics, from their prior (`Model.camera`). S is the derivative of the fit by the
    intrinsics. For S, each parameter changes by one standard deviation, and the camera poses change so that the pixels
    of the tracks stay in place. Nothing is added if an image has fewer than FEWEST observations.
    """
    fit, tracks, camera = case.fit, case.model.observations, case.model.camera
    base_from_gripper, recon_from_camera = (
        case.base_from_gripper[case.used],
        case.recon_from_camera[case.used],
    )
    moved = np.zeros((len(recon_from_camera), 6, len(camera.std)))
    for row, pose in enumerate(recon_from_camera):
        if len(seen := np.flatnonzero(tracks.image == row)) < FEWEST:
            return fit.uncertainty
        x_in_camera = apply(inverse(pose), tracks.points_in_recon[tracks.point[seen]].astype(float))
        by_x = by_point(camera.intrinsics, x_in_camera)
        by_pose = np.concatenate([by_x, -by_x @ skew(x_in_camera)], axis=2).reshape(-1, 6)
        by_intrinsics = by_parameters(camera.intrinsics, x_in_camera) @ (camera.directions * camera.std)
        steps = -np.linalg.lstsq(by_pose, by_intrinsics.reshape(len(by_pose), -1), rcond=None)[0].T
        again = pose @ inverse(transform(rotation_exp(steps[:, 3:]), steps[:, :3]))
        moved[row] = step_between(pose, again).T
    start = fit.parent_from_camera, fit.scale, fit.body_from_recon.rigid
    problem, state = pose_problem(
        base_from_gripper,
        recon_from_camera,
        start,
        error_covariance=case.systematic,
        noise_floor=fit.robot_noise.given,
        priors=case.priors,
        carries=case.carries,
    )
    found = solve(problem, state, averaged=False)
    by_camera = reported_poses(problem, found.state)[2]
    shifts = -(found.at_mode.gain @ pose_by_pose(by_camera, moved.reshape(6 * len(moved), -1)))[:7]
    return fit.uncertainty.with_error(shifts @ shifts.T, "intrinsics")


def adjusted_numbers(case: Case) -> Calibration:
    """Return the numbers of the calibration that the solution of a case gives; its findings are to be ignored."""
    assert case.solution is not None
    found, fit, used, x = case.solution, case.fit, case.used, case.solution.state.x[0]
    scale, body_from_recon = recon_frame(found, case.model.observations)
    uncertainty, intrinsics = uncertainty_of(found), found.problem.intrinsics(found.state)[0]
    if case.capture.intrinsics is None and intrinsics.model == "pinhole":
        # An unmodelled thin prism changes transform and intrinsics together and moves no point. Camera models other
        # than pinhole have coefficients of their own for it.
        steps = decentring(intrinsics, x)
        uncertainty = uncertainty.with_error(steps @ steps.T, "intrinsics")
    gripper, camera = case.base_from_gripper, case.recon_from_camera
    of_arm = case.of_arm  # for an arm that carries the scene, X, Z and the rigs predict gripper_from_base
    # The residuals of rejected gripper poses refer to the poses that their camera poses predict.
    predicted = of_arm(body_from_recon @ scale_translation(camera, scale) @ inverse(x))
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
        **transforms(case.capture.mount, x, body_from_recon),
        scale=scale,
        source="images",
        uncertainty=uncertainty,
        intrinsics=intrinsics.with_std(uncertainty.intrinsics_std),
        images=image_verdicts(case.names, fit.inliers, reasons, metres, radians, reprojection),
        residuals=PaperResiduals(*paper_residuals(of_arm(gripper), camera, x, scale, fit.inliers)),
        robot_noise=found.noise,
        held_out=leave_one_out(left_out, how, reprojection_px),
    )
