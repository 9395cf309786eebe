"""Hand-eye calibration from poses: robust fit, uncertainty, observability, leave-one-out error and findings."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.calibration.arm_of_capture import errors_of
from jcr.calibration.record import Calibration
from jcr.calibration.verdict import MIN_FOR_OUTLIERS, judged, poses_agree
from jcr.capture.checks import far_faults
from jcr.errors import InputError, count_of
from jcr.estimation.arms import arm_named
from jcr.estimation.camera_noise import camera_error_covariance
from jcr.estimation.closed_form import initial_estimate
from jcr.estimation.kinematics import Arm
from jcr.estimation.observability import observability
from jcr.estimation.outlier_rejection import least_trimmed, robust_fit
from jcr.estimation.pose_equations import paper_residuals, predicted_gripper_poses
from jcr.estimation.problem import SCALE, PoseModel, Start, offset_prior, scale_prior
from jcr.estimation.robot_noise import of_poses
from jcr.estimation.solve import Solution
from jcr.geometry import Poses, Transform, require_rigid, step_between, transform
from jcr.least_squares import one_blas_thread
from jcr.number_format import significant
from jcr.records import ImageVerdict, LeaveOneOut, Mount, PaperResiduals, Uncertainty

SCALE_STD = 0.002
"""Relative standard deviation of the size of a printed marker."""


Offset = tuple[Float[ndarray, "3"], float, float]
"""Known coordinate of the camera: a unit axis in the gripper frame, the camera's position along it (m), and std (m)."""
CameraErrors = Literal["none", "independent", "in sequence"]
"""Errors of the camera poses that are tested."""


@one_blas_thread
def solve_hand_eye(  # noqa: PLR0913 (each is a fact about the capture)
    base_from_gripper: ArrayLike,
    recon_from_camera: ArrayLike,
    *,
    robot_noise: tuple[float, float] | None = None,
    offset: Offset | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    scale: float | None = None,
    scale_std: float = SCALE_STD,
    joints: ArrayLike | None = None,
    robot: str | Arm | None = None,
    systematic: Float[ndarray, "r r"] | None = None,
    camera_errors: CameraErrors = "in sequence",
    names: Sequence[str] | None = None,
) -> Calibration:
    """Calibrate from pairs of gripper and camera poses: gripper_from_camera, scale of the camera poses, covariance.

    Both pose arguments are stacks (n,4,4), at the same instants and in the same order. Two poses are always rejected.
    Gripper poses are in the base frame (m), camera poses in any frame and unit. `robot_noise` is a lower bound on the
    noise of the gripper poses (1 sigma per axis: m, rad); the residuals may show more. `camera_covariance` (6n,6n) is
    the covariance of errors of the camera poses, as steps (geometry.retract). Each pose has six rows: translation (unit
    of the camera poses), then rotation vector (rad), in axes of their frame.

    `robot` names the arm (jcr.estimation.arms.ROBOT_NAMES), and `joints` (n,dof) are its angles (rad), starting at the
    base. They determine how joint offsets and link errors affect the poses. With `robot` only, the angles are computed
    from the poses; with neither, systematic errors are assumed to vary smoothly over the poses. `systematic` (6n,6n) is
    the covariance of these errors (m, rad; base axes) for a size of 1 rad; None: it is computed.

    `scale` (metres per unit of the camera poses) is known with the relative standard deviation `scale_std`; 1 for
    metric poses. None: the scale is estimated. `offset` is a known coordinate of the camera, for motions that do not
    determine it. It holds an axis in the gripper frame, the camera's position along it (m), and its standard deviation
    (m).

    `camera_errors` are tested, and included if the poses show them, unless there is a `camera_covariance`. The value
    "independent" stands for translations along the optical axis, and rotations about the scene or about the origin of
    the given frame, where a board is. The value "in sequence" adds errors that accumulate from pose to pose, as in
    visual odometry or SLAM. `names` are those of the poses, for the result's `images`; None: "pose 0", "pose 1", ….

    Raises InputError for shapes, values or counts that cannot be poses, and for poses or angles that do not fit the
    robot. Degenerate motion raises nothing; it is in the result (`observability`, `converged`).
    """
    gripper = _checked(base_from_gripper, "base_from_gripper")
    camera = _checked(recon_from_camera, "recon_from_camera")
    n, rows = len(gripper), 6 * len(gripper)
    if camera_covariance is not None and camera_covariance.shape != (rows, rows):
        raise InputError(f"camera_covariance: shape {camera_covariance.shape}; {n} poses need {rows, rows}")
    names = [f"pose {k}" for k in range(n)] if names is None else list(names)
    known = None if scale is None else (scale, scale_std)
    _require_possible(n, len(camera), names, known, robot_noise, camera_errors)
    far_faults(gripper[:, :3, 3], "base_from_gripper", names)
    offsets = () if offset is None else (offset_prior(*offset),)
    model = PoseModel(
        camera_covariance=camera_covariance,
        error_covariance=_systematic(gripper, robot, joints) if systematic is None else systematic,
        noise_floor=robot_noise,
        priors=offsets if known is None else (*offsets, scale_prior(*known)),
    )
    fit = fit_poses(gripper, camera, names, model, camera_errors)
    return judged(fit, fit.findings)


def _require_possible(
    grippers: int,
    cameras: int,
    names: Sequence[str],
    scale: tuple[float, float] | None,
    robot_noise: tuple[float, float] | None,
    camera_errors: CameraErrors,
) -> None:
    """Raise InputError unless poses and names are as many, and values are such, as `solve_hand_eye` needs."""
    if len(names) != grippers:
        raise InputError(f"names: {count_of(len(names), 'name')} for {grippers} poses; give one per pose")
    if camera_errors not in get_args(CameraErrors):
        raise InputError(f"camera_errors: {camera_errors!r:.80}; give one of {get_args(CameraErrors)}")
    if grippers != cameras:
        raise InputError(
            f"recon_from_camera: {cameras} camera poses for {grippers} gripper poses; give one per image"
        )
    if grippers < 2:
        raise InputError(f"base_from_gripper: {grippers} pose; a hand-eye calibration needs three or more")
    if scale is not None and not (np.isfinite(scale).all() and min(scale) > 0):
        raise InputError(
            f"scale: {scale[0]} ± {scale[1]} must be two positive numbers (m per unit, relative)"
        )
    if robot_noise is not None and not (
        np.shape(robot_noise) == (2,) and np.isfinite(robot_noise).all() and min(robot_noise) > 0
    ):
        raise InputError(f"robot_noise: {robot_noise!r:.80} must be two positive numbers (m, rad)")


def fit_poses(
    gripper: Poses,
    camera: Poses,
    names: Sequence[str],
    model: PoseModel,
    camera_errors: CameraErrors = "none",
) -> Calibration:
    """Return the numbers of a robust fit to n pairs of poses, and as findings what the motions do not determine.

    `gripper` is base_from_gripper, `camera` recon_from_camera, `names` are those of the pairs. If `model` has no
    covariance of the camera poses, errors of the kinds `camera_errors` are tested, and included if the poses show them.
    """
    fit, (x, scale, z), distinct = _fitted(gripper, camera, model, camera_errors)
    assert fit.problem.used is not None
    used = fit.problem.used[distinct]
    predicted = model.moving(predicted_gripper_poses(x, scale, z, camera))
    metres, radians = np.linalg.norm(step_between(gripper, predicted).reshape(-1, 2, 3), axis=2).T
    left_out, moving = fit.leave_one_out[0][fit.problem.used], model.moving(gripper)
    return Calibration(
        **transforms("base" if model.carries == "scene" else "gripper", x, z),
        scale=scale,
        uncertainty=Uncertainty(covariance=fit.covariance[:7, :7], budget=fit.budget),
        backend="poses given",
        images=image_verdicts(names, used, metres, radians),
        residuals=PaperResiduals(*paper_residuals(moving, camera, x, scale, used)),
        robot_noise=fit.noise,
        held_out=leave_one_out(left_out, "each image predicted by the others"),
        findings=observability(moving[used], x, camera[used], model.priors).findings,
    )


def transforms(mount: Mount, x: Transform, z: Transform) -> dict[str, Any]:
    """Return the fields of a Calibration for its transforms: X, the camera's pose, and Z, that of the scaled scene."""
    if mount == "gripper":
        return {"mount": mount, "on_gripper": x, "resting": z}
    return {"mount": mount, "on_base": x, "carried": z}


def _fitted(
    gripper: Poses, camera: Poses, model: PoseModel, camera_errors: CameraErrors
) -> tuple[Solution, Start, Int[ndarray, " n"]]:
    """Return the robust fit to the poses without duplicates, X, scale and Z, and for each pose its index in that fit.

    The arguments are those of `fit_poses`.
    """
    n = len(gripper)
    # Poses that occur twice count once, because an error that occurs twice would look like agreement. They are sorted,
    # so that the result does not depend on their order.
    pairs = np.concatenate([gripper.reshape(n, 16), camera.reshape(n, 16)], axis=1)
    _, order, distinct = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    moving = model.moving(gripper)
    agreeing = least_trimmed(moving[order], camera[order])[0] if len(order) >= MIN_FOR_OUTLIERS else None

    # A frame at the centre of the cameras with their extent as unit keeps the digits.
    centres, own = camera[:, :3, 3], model.of(order)
    middle = centres[order].mean(0)
    unit = float(np.sqrt(((centres[order] - middle) ** 2).sum(1).mean()))
    unit = unit if unit > 1e-12 * np.abs(centres).max() else 1.0
    central = transform(camera[order, :3, :3], (centres[order] - middle) / unit)
    log_unit, per_unit = np.log(unit), np.tile(np.repeat([1 / unit, 1.0], 3), len(order))
    priors = (one._replace(value=one.value + log_unit * float(one.row[SCALE].item())) for one in own.priors)
    own = replace(own, priors=tuple(priors))

    def fitted(covariance: Float[ndarray, "r r"] | None) -> tuple[Solution, Start]:
        """Return the robust fit to the distinct poses, and X, scale and Z in the given frame.

        `covariance` is that of the distinct camera poses.
        """
        if covariance is not None:
            covariance = per_unit[:, None] * covariance * per_unit
        fit = robust_fit(gripper[order], central, replace(own, camera_covariance=covariance), agreeing)
        scale, z = fit.state.scale / unit, fit.state.z[0].copy()
        z[:3, 3] -= z[:3, :3] @ (scale * middle)
        return fit, (fit.state.x[0], scale, z)

    fit, start = fitted(own.camera_covariance)
    if camera_errors != "none" and own.camera_covariance is None:
        assert fit.problem.used is not None
        likely, used = start, fit.problem.used[distinct]
        if not poses_agree(fit.noise):
            # The fit may have explained camera errors by systematic robot errors; the closed form has neither.
            likely, used = initial_estimate(gripper, camera), np.ones(n, dtype=bool)
        in_sequence = camera_errors == "in sequence"
        errors = camera_error_covariance(gripper, camera, likely, used, model, in_sequence)
        if errors is not None:
            fit, start = fitted(of_poses(errors, order))
    return fit, start, distinct


def image_verdicts(
    names: Sequence[str],
    used: Bool[ndarray, " n"],
    metres: Float[ndarray, " n"],
    radians: Float[ndarray, " n"],
    reprojection_px: Float[ndarray, " n"] | None = None,
) -> tuple[ImageVerdict, ...]:
    """Return a record of each registered image: whether it is used, its residuals, and the reason if it is rejected.

    All arguments have one entry per image. `metres` (m) and `radians` (rad) are the sizes of each image's residual:
    reported against predicted gripper pose. `reprojection_px` is the median reprojection error, NaN for an image
    without one; None: the images were not adjusted.
    """
    px = np.full(len(names), np.nan) if reprojection_px is None else reprojection_px
    return tuple(
        ImageVerdict(
            image=name,
            used=bool(used[k]),
            reason=None
            if used[k]
            else f"its gripper pose is {significant(mm)} mm and {significant(deg)}° from where the other images put it",
            translation_residual_mm=mm,
            rotation_residual_deg=deg,
            reprojection_px=None if np.isnan(px[k]) else float(px[k]),
        )
        for k, (name, mm, deg) in enumerate(
            zip(names, (1e3 * metres).tolist(), np.degrees(radians).tolist(), strict=True)
        )
    )


def leave_one_out(
    residual: Float[ndarray, "u 6"], how: str, reprojection_px: float | None = None
) -> LeaveOneOut | None:
    """Return the mean leave-one-out error from the residuals of u used images; None for fewer than four.

    `residual` (u,6) is translation (m), then rotation vector (rad), from an image's reported gripper pose to its
    prediction by the other images. Their norms are averaged. `how` names the method of prediction in words;
    `reprojection_px` is copied.
    """
    if len(residual) < 4:
        return None
    metres, radians = np.linalg.norm(residual.reshape(-1, 2, 3), axis=2).mean(0)
    return LeaveOneOut(1e3 * float(metres), float(np.degrees(radians)), reprojection_px, how)


def _systematic(
    gripper: Poses, robot: str | Arm | None, joints: ArrayLike | None
) -> Float[ndarray, "r r"] | None:
    """Return the covariance (6n,6n) of the systematic errors of n gripper poses for joint errors of 1 rad.

    Each pose has six rows: translation (m), rotation vector (rad), base axes. None without a `robot`: the errors vary
    smoothly over the poses. `joints` (n,dof) are in rad; None: they are computed from the poses. Raises InputError if
    the poses do not fit the arm and its joint angles.
    """
    if robot is None:
        if joints is not None:
            raise InputError("joints: which robot? name it (robot=), or leave the joint angles out")
        return None
    arm = arm_named(robot) if isinstance(robot, str) else robot
    angles = None if joints is None else _numbers(joints, "joints", "(n,dof) in rad")
    if angles is not None and angles.shape != (wanted := (len(gripper), arm.dof)):
        raise InputError(f"joints: shape {angles.shape}; {wanted[0]} poses of a {arm.name} need {wanted}")
    if angles is not None and not np.isfinite(angles).all():
        raise InputError("joints: NaN or infinite; give the angle of every joint at every image")
    return errors_of(gripper, arm, angles).systematic


def _numbers(values: ArrayLike, name: str, shape: str) -> Float[ndarray, "..."]:
    """Return `values` as an array of floats of any shape; raise InputError unless they are numbers.

    The message states `name`, the argument's name, and `shape`, the expected shape in words.
    """
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: not numbers; give an array {shape}") from None


def _checked(transforms: ArrayLike, name: str) -> Float[ndarray, "n 4 4"]:
    """Return `transforms` as an array (n,4,4) with exact rotations; raise InputError unless all are nearly rigid.

    The message states `name`, the argument's name.
    """
    stack = _numbers(transforms, name, "(n,4,4)")
    if stack.ndim != 3 or stack.shape[1:] != (4, 4):
        raise InputError(f"{name}: shape {stack.shape}; give one 4x4 matrix per image, (n,4,4)")
    return np.array([require_rigid(matrix, f"{name}[{i}]") for i, matrix in enumerate(stack)]).reshape(
        -1, 4, 4
    )
