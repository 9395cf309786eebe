"""Bundle adjustment of a case: images, points, intrinsics and robot poses together (estimation/).

Where images are not adjusted, the covariance of the fit to poses includes the errors of given intrinsics.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.calibration.case import Case
from jcr.calibration.hand_eye import image_verdicts, judged
from jcr.calibration.record import Calibration
from jcr.camera import by_parameters, by_point, parameter_names
from jcr.estimation.closed_form import initial_estimate
from jcr.estimation.image_equations import median_reprojection_px
from jcr.estimation.intrinsics_prior import CameraPrior, decentring, joint_covariance
from jcr.estimation.pose_equations import paper_residuals, predicted_gripper_poses
from jcr.estimation.problem import LinearPrior, pose_problem, wrist_arm
from jcr.estimation.projection import view_of
from jcr.estimation.solve import START_NOISE, Solution, adjust_wrist, recon_frame, solve, uncertainty_of
from jcr.findings import Finding, FindingKind
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
from jcr.records import Intrinsics, LeaveOneOut, PaperResiduals, Tracks, Uncertainty

FEWEST = 6
"""Fewest observations of an image from which the motion of its camera with the intrinsics is computed."""
SETTLED_ENOUGH = 0.5
"""Standard deviations of the last step below which an adjustment that did not settle is only noted: smaller effects
are not reported either (checks/effects.py)."""


def with_adjusted_images(case: Case) -> Case:
    """Adjust the images of a case and replace its fit from poses by the calibration that results.

    A rejected fit is replaced too: without intrinsics the fit from poses alone is poor, and the adjustment is not. On
    correspondences between pointmaps, whose errors neighbours share, it is replaced only where the leave-one-out error
    becomes smaller. The fit stays where the motions leave a direction unobservable, which images do not change, and
    where the adjustment fails because points lie behind the cameras.
    """
    if not case.is_adjustable:
        return _considered(case)
    try:
        found = adjust_case(case, combinations=case.free_focus if case.shows_camera else None)
    except np.linalg.LinAlgError:
        return case
    case = replace(case, adjusted=found)
    if not case.hand_eye.observability.observable:
        return case
    refined = judged(refined_by(case, found)).with_findings(*_not_settled(found))
    nearer, than = refined.held_out, case.hand_eye.held_out
    if case.tracks.from_pointmaps and (nearer is None or than is None or nearer.length_m >= than.length_m):
        return case
    return replace(case, hand_eye=refined, fit=case.pose_fit)


def _not_settled(found: Solution) -> Iterator[Finding]:
    """Yield a finding where the rounds of the adjustment ended before sizes and steps settled."""
    if not found.settled:
        severity = "warns" if found.last_step > SETTLED_ENOUGH else "informs"
        details = {"rounds": float(found.iterations)}
        yield Finding.of(
            FindingKind.NOT_SETTLED, severity, "reconstruction", value=found.last_step, **details
        )


def adjust_case(
    case: Case,
    *,
    prior: CameraPrior | None = None,
    combinations: Float[ndarray, "e p"] | None = None,
    confirmed_errors: Float[ndarray, "s b"] | None = None,
) -> Solution:
    """Adjust the used images and gripper poses of a case, from its fit to poses or from its adjustment.

    `prior` takes the place of the case's camera; the rest is that of ReportedPoses and adjust_wrist.
    """
    fit = case.pose_fit
    arm = wrist_arm(case.base_from_gripper[case.used], case.systematic)
    return adjust_wrist(
        replace(arm, carries=case.carries, confirmed_errors=confirmed_errors),
        (fit.gripper_from_camera, fit.scale, fit.base_from_recon.rigid),
        case.recon_from_camera[case.used],
        case.camera if prior is None else prior,
        case.tracks,
        noise=case.options.robot_noise_m_rad,
        combinations=combinations,
        near=case.adjusted,
        start_noise=_start_noise(fit),
    )


def _start_noise(fit: Calibration) -> tuple[float, float]:
    """Return the errors of gripper poses per axis (m, rad) that the fit to camera poses leaves, random and systematic.

    Images that are first adjusted to poses that contradict them take ten times the steps.
    """
    metres, radians = fit.robot_noise.together
    return max(START_NOISE[0], metres), max(START_NOISE[1], radians)


def with_decentring(uncertainty: Uncertainty, camera: Intrinsics, x: Float[ndarray, "4 4"]) -> Uncertainty:
    """Return an uncertainty with that of a thin prism that nobody measured and no image shows.

    It moves the transform `x` and the intrinsics together, and places no point elsewhere. Cameras of other models than
    the pinhole have their own coefficients.
    """
    if camera.model != "pinhole":
        return uncertainty
    steps = decentring(camera, x)
    return uncertainty.with_error(steps @ steps.T, "intrinsics")


def with_prior_of_intrinsics(hand_eye: Calibration, camera: CameraPrior) -> Calibration:
    """Return a calibration from a network's cameras with the prior uncertainty of the intrinsics.

    The focal length does not move these cameras. A wrong principal point rotates all of them, so that the transform and
    the principal point together place points where they are.
    """
    root, names = camera.directions * camera.std, parameter_names(camera.intrinsics)
    x, by_camera = hand_eye.gripper_from_camera, np.zeros((7, len(root)))
    by_camera[3:6, names.index("cx")] = x[:3, 1] / camera.intrinsics.fx
    by_camera[3:6, names.index("cy")] = -x[:3, 0] / camera.intrinsics.fy
    rotated = by_camera @ root
    uncertainty = hand_eye.uncertainty.with_error(rotated @ rotated.T, "intrinsics")
    joint = joint_covariance(uncertainty.covariance, rotated @ root.T, root @ root.T, camera.intrinsics)
    return hand_eye.with_uncertainty(replace(uncertainty, joint=joint))


def _considered(case: Case) -> Case:
    """Return the case with the errors of its intrinsics, which a fit to poses cannot estimate, as uncertainty."""
    if case.reconstruction.predicted_focal is not None:
        known = with_prior_of_intrinsics(case.hand_eye, case.camera)
        return replace(case, hand_eye=judged(known))
    made_with_them = case.reconstruction.evidence is None and not case.tracks.from_pointmaps
    if case.capture.intrinsics is None or not made_with_them or not case.hand_eye.converged:
        return case
    considered = with_intrinsics_considered(
        case.hand_eye,
        case.base_from_gripper[case.used],
        case.recon_from_camera[case.used],
        case.tracks,
        case.camera,
        case.priors,
        case.systematic,
    )
    return replace(case, hand_eye=judged(considered))


def with_intrinsics_considered(
    hand_eye: Calibration,
    base_from_gripper: Float[ndarray, "m 4 4"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    tracks: Tracks,
    camera: CameraPrior,
    priors: tuple[LinearPrior, ...],
    systematic: Float[ndarray, "s s"],
) -> Calibration:
    """Return the calibration with the errors of its intrinsics in its covariance C and budget: C + S Φ Sᵀ.

    This is the consider covariance of Schmidt, Φ that of the intrinsics (Tapley, Schutz and Born, "Statistical Orbit
    Determination", 2004, chapter 6), for a calibration from camera poses alone, which cannot estimate them.
    All arguments are of the used images. The sensitivity S follows from solutions with the cameras that one standard
    deviation of each parameter would give: cameras that keep the pixels of `tracks` in place.
    """
    seen = [np.flatnonzero(tracks.image == row) for row in range(len(recon_from_camera))]
    if min(map(len, seen)) < FEWEST:
        return hand_eye
    each = zip(recon_from_camera, seen, strict=True)
    moved = np.array([_camera_with_other_intrinsics(one, tracks, rows, camera) for one, rows in each])

    def solved(recon_from_camera: Float[ndarray, "m 4 4"]) -> tuple[Float[ndarray, "4 4"], float]:
        problem, state = pose_problem(
            base_from_gripper,
            recon_from_camera,
            initial_estimate(base_from_gripper, recon_from_camera),
            error_covariance=systematic,
            noise_floor=hand_eye.robot_noise.given,
            priors=priors,
        )
        found = solve(problem, state, averaged=False).state
        return found.x[0], found.scale

    x, scale = solved(recon_from_camera)
    shifts = np.zeros((7, len(camera.std)))
    for k in range(len(camera.std)):
        x_k, scale_k = solved(moved[:, k])
        shifts[:, k] = np.append(step_between(x, x_k), np.log(scale_k / scale))
    return hand_eye.with_uncertainty(hand_eye.uncertainty.with_error(shifts @ shifts.T, "intrinsics"))


def _camera_with_other_intrinsics(
    recon_from_camera: Float[ndarray, "4 4"], tracks: Tracks, rows: ndarray, camera: CameraPrior
) -> Float[ndarray, "c 4 4"]:
    """Return the camera poses that fit the image's points after one standard deviation more of each parameter."""
    x_in_camera = apply(inverse(recon_from_camera), tracks.points_in_recon[tracks.point[rows]].astype(float))
    by_x = by_point(camera.intrinsics, x_in_camera)
    by_pose = np.concatenate([by_x, -by_x @ skew(x_in_camera)], axis=2).reshape(-1, 6)
    by_intrinsics = by_parameters(camera.intrinsics, x_in_camera) @ (camera.directions * camera.std)
    steps = -np.linalg.lstsq(by_pose, by_intrinsics.reshape(len(by_pose), -1), rcond=None)[0].T
    return recon_from_camera @ inverse(transform(rotation_exp(steps[:, 3:]), steps[:, :3]))


def refined_by(case: Case, found: Solution) -> Calibration:
    """Return the calibration of a case from an adjustment, without the findings that its numbers decide."""
    fit, used, x = case.pose_fit, case.used, found.state.x[0]
    scale, base_from_recon = recon_frame(found, case.tracks)
    uncertainty, intrinsics = uncertainty_of(found), found.problem.intrinsics(found.state)[0]
    if case.capture.intrinsics is None:
        uncertainty = with_decentring(uncertainty, intrinsics, x)
    gripper, camera = case.base_from_gripper, case.recon_from_camera
    # Rejected poses are measured against where their cameras show them.
    predicted = base_from_recon @ scale_translation(camera, scale) @ inverse(x)
    state, rigs = found.state, found.problem.arms[0].rigs
    predicted[used] = predicted_gripper_poses(x, state.scale, state.z[0], state.world_from_rig[rigs])
    metres, radians = np.linalg.norm(step_between(gripper, predicted).reshape(-1, 2, 3), axis=2).T
    reprojection = np.full(len(gripper), np.nan)
    reprojection[used] = median_reprojection_px(found.problem, found.images.view)
    reasons = [image.reason for image in fit.images]
    return replace(
        fit,
        on_gripper=x,
        resting=base_from_recon,
        scale=scale,
        source="images",
        uncertainty=uncertainty,
        intrinsics=intrinsics.with_std(uncertainty.intrinsics_std),
        images=image_verdicts(case.names, fit.inliers, reasons, metres, radians, reprojection),
        residuals=PaperResiduals(*paper_residuals(gripper, camera, x, scale, fit.inliers)),
        robot_noise=found.noise,
        held_out=_leave_one_out(found),
    )


def _leave_one_out(found: Solution) -> LeaveOneOut | None:
    """Return the mean error of gripper poses that are predicted by an adjustment without their image."""
    left_out = found.leave_one_out[0]
    m = len(left_out)
    if m < 4:
        return None
    metres, radians = np.linalg.norm(left_out.reshape(m, 2, 3), axis=2).mean(0)
    # The images as they would be with every gripper, and the rig on it, displaced by its own leave-one-out residual.
    likely, images = found.most_likely, found.images
    x, z = likely.x[0], likely.z[0]
    own, rigs = found.problem.arms[0].rigs, likely.world_from_rig.copy()
    gripper = predicted_gripper_poses(x, likely.scale, z, rigs[own])
    in_metres = inverse(z) @ retract(gripper, -left_out) @ x
    rigs[own] = scale_translation(in_metres, 1 / likely.scale)
    moved = view_of(found.problem, replace(images.state, world_from_rig=rigs))
    return LeaveOneOut(
        1e3 * float(metres),
        float(np.degrees(radians)),
        float(np.median(median_reprojection_px(found.problem, moved))),
        "each image's gripper pose predicted by the others",
    )
