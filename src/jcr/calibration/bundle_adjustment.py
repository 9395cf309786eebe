"""Joint bundle adjustment of a case's camera poses, points, intrinsics and gripper poses (estimation/).

A case without adjusted images keeps the fit to camera poses; errors of a network's camera are added to its covariance.
"""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from jcr.calibration.case import MIN_IMAGES, Case, Model
from jcr.calibration.hand_eye import image_verdicts, leave_one_out, transforms
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import with_uncertainty
from jcr.camera import parameter_names
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.intrinsics_prior import decentring
from jcr.estimation.pose_equations import paper_residuals, predicted_gripper_poses
from jcr.estimation.problem import (
    SCALE,
    UNKNOWNS,
    LinearPrior,
    Problem,
    transferred,
    wrist_arm,
    wrist_problem,
)
from jcr.estimation.projection import view_of
from jcr.estimation.robot_noise import of_poses
from jcr.estimation.solve import START_NOISE, Solution, recon_frame, solve, uncertainty_of
from jcr.geometry import inverse, retract, scale_translation, step_between
from jcr.records import COVARIANCE_ORDER, JointCovariance, PaperResiduals, Uncertainty


def adjusted(case: Case) -> Case:
    """Return the case after the bundle adjustment of its model, or with the fit to camera poses if that fails.

    A rejected fit is replaced too, because without given intrinsics its camera poses are poor. The fit is kept
    for camera poses with a covariance (`evidence`), fewer than MIN_IMAGES used images, and fewer observations than
    unknowns. The uncertainty of the principal point is then added to the covariance of a fit to a network's camera
    poses.
    """
    if case.reconstruction.evidence is None and len(case.used) >= MIN_IMAGES and case.model.is_determined:
        with suppress(np.linalg.LinAlgError):
            return solved(case, case.model)
    elif case.reconstruction.predicted_focal is not None:
        return replace(case, numbers=with_uncertainty(case.fit, _with_network_camera(case)))
    return case


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
    priors = list(model.lengths)
    for row, value, std in case.pose_model.priors:
        is_scale = bool(row[SCALE].item())
        # The size of a board is a length, which is compared with the robot's positions before it becomes a prior.
        if not is_scale or model.tracks.boards is None:
            own = np.pad(row, (0, problem.unknowns - UNKNOWNS))
            priors.append(LinearPrior(own, value - is_scale * float(np.log(fit.scale)), std))
    problem = replace(problem, priors=tuple(priors))
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
        images=image_verdicts(case.names, fit.inliers, metres, radians, reprojection),
        residuals=PaperResiduals(*paper_residuals(of_arm(gripper), camera, x, scale, fit.inliers)),
        robot_noise=found.noise,
        held_out=leave_one_out(left_out, how, reprojection_px),
    )
