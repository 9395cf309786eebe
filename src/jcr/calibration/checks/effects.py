"""Forward selection of additional effects on the camera and on the gripper poses, until none is significant.

In each round the best effect on the camera (checks/camera.py) competes with the best one on the poses
(estimation/hypotheses.py). If both are significant, the cause is the one that makes the other insignificant. Confirmed
effects are estimated in all further tests, and the final adjustment includes those that its model can represent.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.calibration.adjust import adjust_case, refined_by
from jcr.calibration.case import Case, some_points
from jcr.calibration.checks.camera import (
    FOCUS,
    LOG_P,
    MATERIAL,
    MIN_IMAGES,
    MOST_BYTES,
    CameraAdjustment,
    CameraEffect,
    best_camera_effect,
    camera_finding,
    is_material,
    of_case,
    rows_of_arm,
    with_effect_free,
)
from jcr.calibration.hand_eye import judged, poses_agree
from jcr.calibration.options import GRASPING
from jcr.calibration.record import Calibration
from jcr.camera import parameters, with_thin_prism
from jcr.estimation.hypotheses import (
    PLAUSIBLE,
    STRAINS,
    Test,
    arm_rows,
    best_tests,
    explains_by_order,
    order_rows,
)
from jcr.estimation.pose_equations import Region, pose_equations
from jcr.estimation.problem import SCALE, UNKNOWNS, columns_of_arm, pose_problem
from jcr.estimation.robot_noise import Equations, LogSizes, most_likely, solve_equations
from jcr.estimation.solve import Solution
from jcr.findings import Finding, FindingKind, kinds_of
from jcr.geometry import Poses, step_between

AT_ONCE = 3
"""Largest number of effects that are reported for one capture."""
LOG_ALPHA = {kind: np.log(1e-6) for kind in kinds_of("strain")}
"""Largest log p-value of significant effects of the arm. In 132 simulated captures of 8 to 20 images without such
effects, 72 of them by arms with joint offsets up to 1° and link errors of 1 mm, no p-value is below 1e-5."""
LOG_ALPHA_OF_ORDER = np.log(1e-4)
"""Largest log p-value of significant effects that depend on the order of the images."""
SHARES = frozenset({FindingKind.SLIP, FindingKind.BASE_MOVED, FindingKind.DRIFT})
"""Effects with one motion times a known factor per image; also compared with other orders of the images."""
EFFECTS = kinds_of("camera", "strain") | SHARES | {FindingKind.DELAY}
"""Kinds of findings that these tests make."""
TINY_PX, TINY = 0.5, 0.1
"""Displacement in the corner of the image (px), and change of the calibration in units of LARGE_MOTION, up to which
different focal lengths are a remark and no warning."""
LARGE_MOTION = GRASPING[0] * 1e-3, float(np.radians(GRASPING[1]))
"""Motion of the camera or the base (m, rad) above which the calibration is rejected; a smaller motion is added to the
uncertainty."""


def check_effects(case: Case) -> Case:
    """Return the case with findings on effects that the model lacks, such as rolling shutter, camera slip or arm sag.

    With adjusted images, the calibration then includes the effects as parameters. A fit to camera poses is tested only
    for effects that depend on the image order.
    """
    if not case.is_open:
        return case
    longer = _with_rejected_runs(case)
    if case.adjusted is None or longer.adjusted is None or not case.shows_camera:
        evidence = case.reconstruction.evidence
        found = effects_of_fit(
            case.base_from_gripper,
            case.recon_from_camera,
            case.hand_eye,
            case.names,
            camera_covariance=None if evidence is None else evidence.covariance,
            error_covariance=case.robot.systematic,
            noise_floor=case.options.robot_noise_m_rad,
            priors=case.priors,
        )
        return case.after(found)
    state, findings = effects(of_case(longer))
    return case.after(findings) if longer is not case else _adopted(case, state, findings)


def effects(state: CameraAdjustment) -> tuple[CameraAdjustment, tuple[Finding, ...]]:
    """Return the adjustment with all confirmed effects on one camera and its gripper poses, and a finding per effect.

    A camera effect is not reported if gripper poses and images contradict each other even with the effect estimated.
    """
    findings, dismissed, passed = list[Finding](), list[CameraEffect](), set[FindingKind]()
    camera_explains = True
    while len(findings) < AT_ONCE:
        of_camera, log_chance = best_camera_effect(state, dismissed) if camera_explains else (None, 0.0)
        poses = _tested_poses(state)
        test = None if state.arm is None else best_pose_effect(poses, passed)
        if test is not None and (of_camera is None or _explains(state, test, of_camera, log_chance)):
            passed.add(test.row.kind)
            found = pose_finding(test, poses, state.names, state.std)
            if found is not None:
                findings.append(found)
                state = state.with_free(state.found, (*state.poses, test.row))
        elif of_camera is not None:
            after = with_effect_free(state, of_camera)
            found = None if after is None else camera_finding(after, state)
            camera_explains = after is None or poses_agree(after.adjusted.noise)
            if after is None or found is None or not camera_explains or not is_material(found, after):
                dismissed.append(of_camera)
                continue
            state = after
            findings.append(found)
        else:
            break
    return state, tuple(findings)


def _explains(state: CameraAdjustment, test: Test, of_camera: CameraEffect, log_chance: float) -> bool:
    """Return True if the pose effect `test` is the cause of the misfit, False if the camera effect `of_camera` is.

    Both are significant; each is tested again with the other one estimated. `log_chance` is the logarithm of the camera
    effect's p-value.
    """
    with_camera = with_effect_free(state, of_camera)
    if with_camera is None:
        return True
    left = best_pose_effect(_tested_poses(with_camera), {row.kind for row in state.poses})
    poses_remain = left is not None and left.row.kind is test.row.kind
    camera_remains = state.with_free(state.found, (*state.poses, test.row)).log_p(of_camera) <= LOG_P
    return test.log_p < log_chance if poses_remain == camera_remains else poses_remain


@dataclass(frozen=True, kw_only=True)
class ArmEquations:
    """Equations of all gripper poses, with the rows, the columns and the poses of one arm."""

    equations: Equations
    log_sizes: LogSizes
    """Logarithms of the sizes of the robot errors."""
    base_from_gripper: Poses
    """Reported gripper poses of the arm."""
    rows: slice
    """Rows of the arm's poses, 6 per pose."""
    columns: Int[ndarray, "12"]
    """Columns of the arm's gripper_from_camera (6), then of its base_from_recon (6)."""


def _tested_poses(state: CameraAdjustment) -> ArmEquations:
    """Return the gripper pose equations of the arm that is tested together with the camera."""
    adjusted, arm = state.adjusted, state.arm or 0
    return ArmEquations(
        equations=adjusted.equations,
        log_sizes=adjusted.log_sizes,
        base_from_gripper=adjusted.problem.arms[arm].base_from_gripper,
        rows=rows_of_arm(adjusted.problem, arm),
        columns=columns_of_arm(arm),
    )


def best_pose_effect(poses: ArmEquations, passed: Collection[FindingKind]) -> Test | None:
    """Return the test of the most significant effect on the poses of an arm; kinds in `passed` are not tested.

    Return None without a significant effect, if the effect is implausibly large, or if poses and images contradict each
    other even with the effect estimated: the poses then have another fault. A motion counts only if it is more
    significant in the true order of the images than in nearly all random orders.
    """
    equations, own, gripper = poses.equations, poses.rows, poses.base_from_gripper
    n, s = len(gripper), len(equations.residual)
    if n < MIN_IMAGES:
        return None
    by_motion = equations.jacobian[own][:, poses.columns].reshape(n, 6, 12)
    by_x, by_z = by_motion[:, :, :6], by_motion[:, :, 6:]
    rows = [
        replace(row, columns=np.pad(row.columns, ((own.start, s - own.stop), (0, 0))))
        for row in (*order_rows(gripper, by_x, by_z), *arm_rows(gripper))
        if row.kind not in passed
    ]
    for test in best_tests(equations, poses.log_sizes, rows):
        kind, place = test.row.kind, test.row.place
        if test.log_p > LOG_ALPHA.get(kind, LOG_ALPHA_OF_ORDER):
            continue
        if not test.is_within(PLAUSIBLE[kind]) or not poses_agree(test.noise):
            return None
        if kind in SHARES:
            share = np.linspace(-0.5, 0.5, n) if place == 0 else (np.arange(n) >= place).astype(float)
            others, by = (
                (own.start // 6, (s - own.stop) // 6),
                by_z if kind is FindingKind.BASE_MOVED else by_x,
            )
            by, share = np.pad(by, (others, (0, 0), (0, 0))), np.pad(share, others)
            images = slice(own.start // 6, own.stop // 6)
            if not explains_by_order(equations, poses.log_sizes, by, share, images):
                continue
        return test
    return None


def pose_finding(
    test: Test, poses: ArmEquations, names: Sequence[str], std: Float[ndarray, "6"]
) -> Finding | None:
    """Return the finding of a significant effect on the poses; None if it moves the camera by less than 0.5 `std`.

    `test` was made with the equations `poses`. `names` are the image names in order, `std` the standard deviations of
    the camera's pose (m, rad).
    """
    own, moved = test.shift[poses.columns[:6]], test.estimate
    kind, place, p = test.row.kind, test.row.place, float(np.exp(max(test.log_p, -700)))
    if kind.row.group == "strain":
        columns = test.row.prior_std * test.row.columns
        straight = straight_shift(poses.equations, poses.log_sizes, columns)[poses.columns[:6]]
        if not (np.abs([own, straight]) > MATERIAL * std).any():
            return None
        return Finding.of(kind, "warns", "robot", p=p, **_size_of_strain(test))
    if kind is FindingKind.DELAY:
        moved = own
    if not (np.abs(moved) > MATERIAL * std).any():
        return None
    # The shift of the finding is the effect on gripper_from_camera; for a motion of the base, that on the fit.
    shift = {FindingKind.SLIP: moved, FindingKind.DRIFT: moved / 2}.get(kind, own)
    known: dict[str, Any] = {"p": p, "shift": (*shift.tolist(), 0.0)}
    if kind is FindingKind.DELAY:
        size = {"value": float(test.estimate[0]), "std": float(np.sqrt(test.covariance[0, 0]))}
        return Finding.of(kind, "warns", "poses", unit="interval", **size, **known)
    metres, radians = np.linalg.norm(moved.reshape(2, 3), axis=1).tolist()
    known |= {"value": metres, "rotation": radians}
    if kind is FindingKind.DRIFT:
        return Finding.of(kind, "warns", "mount", **known)
    count, longer = max((place, "before"), (len(names) - place, "after"))
    severity = "rejects" if metres > LARGE_MOTION[0] or radians > LARGE_MOTION[1] else "warns"
    concerns = "mount" if kind is FindingKind.SLIP else "poses"
    known |= {"longer": longer, "count": float(count)}
    return Finding.of(kind, severity, concerns, names[place - 1], names[place], **known)


def _size_of_strain(test: Test) -> dict[str, Any]:
    """Return the fields of a finding for the size, standard deviation and axis of a strain, a lean or a sag."""
    estimate, covariance = test.estimate, test.covariance
    if test.row.kind is FindingKind.BASE_LEANS:
        return {"value": float(estimate[0]), "std": float(np.sqrt(covariance[0, 0]))}
    if test.row.kind is FindingKind.TOOL_SAGS:
        value = float(np.linalg.norm(estimate))
        axis, frame = estimate / value, "gripper"
        std = float(np.sqrt(axis @ covariance @ axis))
    else:
        values, vectors = np.linalg.eigh(np.einsum("k,kab->ab", estimate, STRAINS))
        k = int(np.abs(values).argmax())
        axis, frame = vectors[:, k] * np.sign(vectors[np.abs(vectors[:, k]).argmax(), k]), "base"
        by = np.einsum("a,kab,b->k", axis, STRAINS, axis)
        # The strain has trace 0: the two other axes have minus half of it each.
        value, std = 1.5 * float(values[k]), 1.5 * float(np.sqrt(by @ covariance @ by))
    return {"value": value, "std": std, "frame": frame, **dict(zip("xyz", axis.tolist(), strict=True))}


def _adopted(case: Case, state: CameraAdjustment, findings: tuple[Finding, ...]) -> Case:
    """Return the case with a calibration that includes the effects, or with `findings` alone if that one is rejected.

    The effects were found with a subset of the points, and are now estimated from all points that memory permits.
    Camera effects that then change the calibration by at most half a standard deviation (MATERIAL) are dropped.
    """
    free = state.combinations
    most = MOST_BYTES // (16 * (1 if free is None else free.shape[1]))
    fewer = case
    if len(case.tracks.image) > most:
        fewer = replace(case, chosen_tracks=some_points(case.tracks, most), adjusted=None)
    adjusted, adopted = with_effects(fewer, state, findings)
    if adjusted is None:
        return case.after(findings)
    before, refined = case.hand_eye, judged(refined_by(fewer, adjusted))
    if not refined.converged:
        return case.after(findings)
    of_camera = {one.kind for one in findings if one.kind.row.group == "camera"} - {FindingKind.INTRINSICS}
    moved = np.abs(step_between(before.gripper_from_camera, refined.gripper_from_camera))
    std = np.sqrt(np.diag(before.covariance)[:6]) * before.converged
    if of_camera and not (moved > MATERIAL * std).any():
        rest = tuple(one for one in state.found if one.kind not in of_camera)
        kept = tuple(one for one in findings if one.kind not in of_camera)
        return _adopted(case, replace(state, found=rest), kept)
    adopted = tuple(as_remark(one, moved, case.capture.image_size) for one in adopted)
    return fewer.after(adopted, refined, adjusted)


def as_remark(found: Finding, moved: Float[ndarray, "6"], image_size: tuple[int, int]) -> Finding:
    """Return the finding of a tiny difference of focal lengths, which the calibration includes, as a remark.

    Hundreds of images show differences that no user needs to correct: in the corner of the image by less than TINY_PX,
    with a change `moved` of the calibration (m, rad) by less than TINY of the accuracy that grasping needs.
    """
    metres, radians = np.linalg.norm(moved.reshape(2, 3), axis=1) / LARGE_MOTION
    corner_px = float(np.hypot(*image_size)) / 2 * abs(found.value or 0.0)
    is_tiny = found.kind in FOCUS and corner_px < TINY_PX and max(metres, radians) < TINY
    return replace(found, severity="informs") if is_tiny else found


def with_effects(
    case: Case, state: CameraAdjustment, findings: tuple[Finding, ...]
) -> tuple[Solution | None, tuple[Finding, ...]]:
    """Return an adjustment with the effects on camera and arm as parameters, and the findings with remaining shifts.

    The result is the effective hand-eye transform, which predicts best from reported gripper poses. Its difference from
    the transform for the true poses, and the possible error of the scale, are the remaining shifts. A thin prism
    becomes part of the intrinsics. Return None as adjustment if there is no effect on camera or arm.
    """
    strains = [row for row in state.poses if row.kind.row.group == "strain"]
    if not strains and not any(one.kind.row.group == "camera" for one in findings):
        return None, findings
    free = state.combinations
    if any(one.kind is FindingKind.THIN_PRISM for one in state.found) and state.intrinsics.model != "fisheye":
        camera = with_thin_prism(case.reconstruction.intrinsics)
        case = replace(case, reconstruction=replace(case.reconstruction, intrinsics=camera), adjusted=None)
        found = tuple(one for one in state.found if one.kind is not FindingKind.THIN_PRISM)
        if (free := replace(state, found=found).combinations) is not None:
            # Rows for the new camera parameters are inserted after those of the previous camera model.
            before, now = len(parameters(state.intrinsics)), len(parameters(camera))
            free = np.insert(free, [before] * (now - before), 0.0, axis=0)
    bent = np.concatenate([row.prior_std * row.columns for row in strains], axis=1) if strains else None
    adjusted, remaining = adjust_case(case, combinations=free, confirmed_errors=bent), list[Finding]()
    for one in findings:
        if one.kind.row.group == "camera":
            one = as_adopted(one)
        elif bent is not None and one.kind in (row.kind for row in strains):
            # The shift due to all effects of the arm together belongs to the first finding.
            straight = np.zeros(7)
            if one.kind is strains[0].kind:
                straight = straight_shift(adjusted.equations, adjusted.log_sizes, bent)[:7]
            if one.kind is FindingKind.LENGTHS and one.value is not None:
                # One of three axes has another scale; no image shows which scale is the true metre.
                jacobian = adjusted.equations.jacobian[:, :UNKNOWNS]
                region = Region.of_unknowns(np.delete(jacobian, SCALE, axis=1), UNKNOWNS)
                metre = abs(one.value) / 3 * np.r_[-(region.fit @ jacobian[:, SCALE])[:6, 0], 1.0]
                straight = straight + metre * (1 if straight[:6] @ metre[:6] >= 0 else -1)
            one = replace(one, shift=tuple(straight.tolist()))
        remaining.append(one)
    return adjusted, tuple(remaining)


def as_adopted(found: Finding) -> Finding:
    """Return the finding of an effect that the calibration includes: its shift is removed."""
    return replace(found, shift=None, intrinsics_shift=None)


def straight_shift(
    equations: Equations, log_sizes: LogSizes, columns: Float[ndarray, "s b"]
) -> Float[ndarray, " p"]:
    """Return the step of the p unknowns from values for the reported gripper poses to values for the true ones.

    `log_sizes` are the logarithms of the sizes of the robot errors. `columns` (s,b) are the b confirmed error patterns
    of the poses, one standard deviation each.
    """
    straight = replace(equations, confirmed=columns @ columns.T)
    return solve_equations(straight, log_sizes).step - solve_equations(equations, log_sizes).step


def _with_rejected_runs(case: Case) -> Case:
    """Return the case that again uses consecutive rejected images, because a slip of the camera may reject them."""
    in_order = with_rejected_runs(case.hand_eye.inliers)
    if (in_order == case.hand_eye.inliers).all():
        return case
    longer = replace(case, hand_eye=case.hand_eye.with_used(in_order), chosen_tracks=None, adjusted=None)
    if case.adjusted is None:
        return longer
    try:
        return replace(longer, adjusted=adjust_case(longer))
    except np.linalg.LinAlgError:
        return case


def with_rejected_runs(used: Bool[ndarray, " n"]) -> Bool[ndarray, " n"]:
    """Return the mask of the used images, extended by rejected images whose neighbour is rejected too."""
    rejected = np.pad(~used, 1)
    return used | rejected[:-2] | rejected[2:]


def effects_of_fit(
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    hand_eye: Calibration,
    names: Sequence[str],
    **known: Any,
) -> tuple[Finding, ...]:
    """Return a finding of the most significant effect of the image order on a fit to camera poses, or an empty tuple.

    `names` are the images of the poses; `known` are keyword arguments of `pose_problem`.
    """
    start = hand_eye.gripper_from_camera, hand_eye.scale, hand_eye.base_from_recon.rigid
    problem, state = pose_problem(base_from_gripper, recon_from_camera, start, **known)
    used = with_rejected_runs(hand_eye.inliers)
    equations = pose_equations(replace(problem, used=used), state, None).equations
    poses = ArmEquations(
        equations=equations,
        log_sizes=most_likely(equations)[0],
        base_from_gripper=base_from_gripper[used],
        rows=slice(0, 6 * int(used.sum())),
        columns=columns_of_arm(0),
    )
    # Errors of camera poses resemble effects of the arm, which only a bundle adjustment separates from them.
    test = best_pose_effect(poses, kinds_of("strain"))
    std = np.sqrt(np.diag(hand_eye.covariance)[:6]) * hand_eye.converged
    found = (
        None
        if test is None
        else pose_finding(test, poses, [names[k] for k in np.flatnonzero(used).tolist()], std)
    )
    return () if found is None else (found,)
