"""From poses to a judged hand-eye calibration: robust fit, uncertainty, observability, leave-one-out error."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from numpy.typing import ArrayLike

from jcr.errors import InputError
from jcr.geometry import require_rigid
from jcr.handeye.arms import arm_named
from jcr.handeye.fit import Cues, PoseFit
from jcr.handeye.observability import observability
from jcr.handeye.residuals import paper_residuals
from jcr.handeye.robots import Arm, Joints
from jcr.handeye.robust import robust_fit
from jcr.handeye.systematic import systematic_errors
from jcr.least_squares import one_blas_thread
from jcr.records import HandEye, HeldOut, RobotNoise

MAX_NOISE = (0.02, np.radians(3.0))
"""m, rad: worse than the worst servo arm; poses and images then do not belong together."""
MAX_STD = (0.02, np.radians(3.0), 0.05)
"""m, rad, relative scale: an answer less certain than this is none."""
MIN_SHARE_USED = 0.6
SCALE_STD = 0.002
"""Relative; of a printed marker's size."""
FEW = 5
"""Images, below which a wrong one cannot be outvoted and the robot pose noise is hardly known."""
SURPRISE = 1.5
"""Times the robot noise that was given; more is worth saying."""


@one_blas_thread
def solve_hand_eye(
    base_from_gripper: ArrayLike,
    recon_from_camera: ArrayLike,
    *,
    robot_noise: tuple[float, float] | None = None,
    cues: Cues | None = None,
    camera_covariance: Float[ndarray, "r r"] | None = None,
    scale: float | None = None,
    scale_std: float = SCALE_STD,
    joints: ArrayLike | None = None,
    robot: str | Arm | None = None,
    systematic: Float[ndarray, "r r"] | None = None,
) -> HandEye:
    """Hand-eye calibration with unknown scale from camera poses of your own.

    Takes two stacks (n,4,4), n ≥ 2, taken at the same instants and in the same order: gripper poses in the base frame
    (m) and camera poses in any frame and unit. `robot_noise` is a lower bound on the noise of the gripper poses (1 sigma
    per axis: m, rad); the residuals may show more. `camera_covariance` (6n,6n), as records.CameraEvidence defines it, is
    needed if the camera poses are not exact compared with the gripper poses.

    `robot` names the arm (jcr.handeye.arms.ROBOT_NAMES) and `joints` (n,dof) are its angles (rad), starting at the base:
    they determine how joint offsets and link errors affect the poses. With `robot` only, the angles are computed from
    the poses; with neither, systematic errors are assumed to vary smoothly over the poses. `systematic` is their
    covariance, if it is known already (systematic.py).

    `scale` (metres per unit of the camera poses, 1 if these are metric) is known to `scale_std` (relative); without it
    the scale is estimated.

    Raises InputError for shapes, values or counts that cannot be poses, and for poses or angles that do not fit the
    robot. Degenerate motion raises nothing; it is in the result (`observability`, `converged`).
    """
    gripper = _checked(base_from_gripper, "base_from_gripper")
    camera = _checked(recon_from_camera, "recon_from_camera")
    n = len(gripper)
    if len(camera) != n:
        raise InputError(
            f"recon_from_camera: {len(camera)} camera poses for {n} gripper poses; give one per image"
        )
    if n < 2:
        raise InputError(f"base_from_gripper: {n} pose; a hand-eye calibration needs three or more")
    if scale is not None:
        if not (np.isfinite([scale, scale_std]).all() and scale > 0 and scale_std > 0):
            raise InputError(
                f"scale: {scale} ± {scale_std} must be two positive numbers (m per unit, relative)"
            )
        cues = replace(cues or Cues(), scale=(scale, scale_std))
    if robot_noise is not None and not (np.isfinite(robot_noise).all() and min(robot_noise) > 0):
        raise InputError(f"robot_noise: {robot_noise} must be two positive numbers (m, rad)")

    if camera_covariance is not None and camera_covariance.shape != (6 * n, 6 * n):
        raise InputError(
            f"camera_covariance: shape {camera_covariance.shape}; {n} poses need {(6 * n, 6 * n)}"
        )

    if systematic is None:
        systematic = systematic_errors(gripper, *_checked_arm(robot, joints, n))

    # Sorted by what the poses are, not by how they came: the same images in any order, the same last bit. An image
    # that was given twice is one: its error counted as two would pass for agreement.
    pairs = np.concatenate([gripper.reshape(n, 16), camera.reshape(n, 16)], axis=1)
    _, order, back = np.unique(pairs, axis=0, return_index=True, return_inverse=True)
    rows = (6 * order[:, None] + np.arange(6)).ravel()
    among = np.ix_(rows, rows)
    if camera_covariance is not None:
        camera_covariance = camera_covariance[among]
    fit, used_sorted = robust_fit(
        gripper[order], camera[order], robot_noise, cues, camera_covariance, systematic[among]
    )
    used = used_sorted[back]
    seen = observability(gripper[used], fit.gripper_from_camera, camera[used], cues)
    held_out = _held_out(fit, used_sorted)
    delta_t, delta_r = paper_residuals(gripper, camera, fit.gripper_from_camera, fit.scale, used)
    hand_eye = HandEye(
        gripper_from_camera=fit.gripper_from_camera,
        scale=fit.scale,
        base_from_recon=fit.base_from_recon,
        covariance=fit.covariance,
        inliers=used,
        translation_residual_m=np.linalg.norm(fit.translation_residual, axis=1)[back],
        rotation_residual_rad=np.linalg.norm(fit.rotation_residual, axis=1)[back],
        observability=seen,
        robot_noise=RobotNoise(
            *fit.noise, fit.noise_estimated, robot_noise, fit.systematic, fit.systematic_left
        ),
        residual_translation=delta_t,
        residual_rotation=delta_r,
        converged=False,
        held_out=held_out,
        budget=fit.budget,
    )
    return judged(replace(hand_eye, reasons=_reasons(hand_eye)))


def judged(hand_eye: HandEye) -> HandEye:
    """The calibration with its verdict: `converged`, and a warning for each thing that speaks against it."""
    doubts = list(_doubts(hand_eye))
    remarks = list(_remarks(hand_eye))
    return replace(hand_eye, converged=not doubts, warnings=(*doubts, *remarks))


def _doubts(hand_eye: HandEye):
    """Reasons not to trust the answer, worst first, each with its remedy."""
    for name, cure in zip(hand_eye.observability.unobservable, hand_eye.observability.advice, strict=False):
        yield f"unobservable from these motions: {name}; {cure}"
    used, n = int(hand_eye.inliers.sum()), len(hand_eye.inliers)
    noise = hand_eye.robot_noise
    disagree = used < max(3, MIN_SHARE_USED * n) and n > 2
    if disagree:
        yield (
            f"only {used} of {n} images agree on one calibration; check that images and poses are paired, "
            "and the convention of the poses (jcr check)"
        )
    metres, radians = noise.together
    if metres > MAX_NOISE[0] or radians > MAX_NOISE[1]:
        yield (
            f"gripper poses and images disagree by {1e3 * metres:.0f} mm and "
            f"{np.degrees(radians):.1f}° per axis; check the pairing and the convention of the poses "
            "(jcr check)"
        )
    if hand_eye.observability.observable:
        std = np.sqrt(np.diag(hand_eye.covariance))
        for value, limit, text in (
            (std[:3].max(), MAX_STD[0], f"the translation is known to ±{1e3 * std[:3].max():.0f} mm only"),
            (
                std[3:6].max(),
                MAX_STD[1],
                f"the rotation is known to ±{np.degrees(std[3:6].max()):.1f}° only",
            ),
            (std[6], MAX_STD[2], f"the scale is known to ±{100 * std[6]:.0f} % only"),
        ):
            if value > limit:
                # Of few images half the uncertainty may be that the robot's noise is hardly known.
                tell = ", or give the robot's repeatability (--robot-noise MM DEG)"
                unknown = noise.given is None and used < FEW
                yield f"{text}; add images, rotated by 20° or more about different axes{tell if unknown else ''}"


def _remarks(hand_eye: HandEye):
    """What a user should know of an answer that may still be trusted."""
    noise = hand_eye.robot_noise
    metres, radians = _disagreement(hand_eye)
    if noise.given is not None and (
        metres > SURPRISE * noise.given[0] or radians > SURPRISE * noise.given[1]
    ):
        yield (
            f"gripper poses and images disagree by {1e3 * metres:.2g} mm and "
            f"{np.degrees(radians):.2g}° per axis, more than the given robot noise "
            f"({1e3 * noise.given[0]:.2g} mm, {np.degrees(noise.given[1]):.2g}°): the larger is used"
        )
    held_out = hand_eye.held_out
    if held_out is not None:
        typical = 1e3 * np.sqrt(3) * hand_eye.robot_noise.together[0]
        if held_out.translation_mm > max(3 * typical, 2.0):
            yield (
                f"the leave-one-out error ({held_out.translation_mm:.1f} mm) is well above the fit's residual "
                f"({typical:.1f} mm): too few images for this motion; add some"
            )
    if len(hand_eye.inliers) < FEW:
        yield f"with {len(hand_eye.inliers)} images a wrong one cannot be identified; take 8 or more"


def _disagreement(hand_eye: HandEye) -> tuple[float, float]:
    """Root mean square residual of the used images per axis (m, rad), made up for the 13 unknowns that were fitted."""
    used = hand_eye.inliers
    count = 6 * int(used.sum())
    fitted = count / max(count - 13, 1)
    metres, radians = (
        float(np.sqrt(fitted * (residual[used] ** 2).mean() / 3))
        for residual in (hand_eye.translation_residual_m, hand_eye.rotation_residual_rad)
    )
    return metres, radians


def _reasons(hand_eye: HandEye) -> tuple[str | None, ...]:
    metres, radians = hand_eye.robot_noise.together
    typical_mm, typical_deg = 1e3 * metres, np.degrees(radians)
    return tuple(
        None
        if used
        else (
            f"its gripper pose is {1e3 * metres:.1f} mm and {np.degrees(radians):.2f}° from where the other "
            f"images put it (their noise: {typical_mm:.1f} mm, {typical_deg:.2f}°)"
        )
        for used, metres, radians in zip(
            hand_eye.inliers, hand_eye.translation_residual_m, hand_eye.rotation_residual_rad, strict=True
        )
    )


def _held_out(fit: PoseFit, used: Bool[ndarray, " n"]) -> HeldOut | None:
    """Each used image predicted by a fit to the others; None when too few are left to fit."""
    if used.sum() < 4:
        return None
    metres, radians = np.linalg.norm(fit.missed[used].reshape(-1, 2, 3), axis=2).mean(0)
    return HeldOut(
        1e3 * float(metres), float(np.degrees(radians)), None, "each image predicted by the others"
    )


def _checked_arm(
    robot: str | Arm | None, joints: ArrayLike | None, count: int
) -> tuple[Arm | None, Joints | None]:
    if robot is None:
        if joints is not None:
            raise InputError("joints: which robot? name it (robot=), or leave the joint angles out")
        return None, None
    arm = arm_named(robot) if isinstance(robot, str) else robot
    if joints is None:
        return arm, None
    try:
        angles = np.asarray(joints, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError("joints: not numbers; give an array (n,dof) in rad") from None
    if angles.shape != (count, arm.dof):
        raise InputError(
            f"joints: shape {angles.shape}; {count} poses of a {arm.name} need {(count, arm.dof)}"
        )
    if not np.isfinite(angles).all():
        raise InputError("joints: NaN or infinite; give the angle of every joint at every image")
    return arm, angles


def _checked(transforms: ArrayLike, name: str) -> Float[ndarray, "n 4 4"]:
    try:
        stack = np.asarray(transforms, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: not numbers; give an array (n,4,4)") from None
    if stack.ndim != 3 or stack.shape[1:] != (4, 4):
        raise InputError(f"{name}: shape {stack.shape}; give one 4x4 matrix per image, (n,4,4)")
    return np.stack([require_rigid(matrix, f"{name}[{i}]") for i, matrix in enumerate(stack)] or [np.eye(4)])[
        : len(stack)
    ]
