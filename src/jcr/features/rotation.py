"""X's rotation from relative rotations of cameras, some wrong: AX = XB over pairs of images.

Whatever X is, a pair of cameras rotates by the angle of its grippers (the screw congruence of Chen 1991), and R_A R_X =
R_X R_B. Hypotheses come from two pairs each, as in RANSAC; the best is refined on all pairs that agree with it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from jcr.estimation.closed_form import sine_axis
from jcr.geometry import nearest_rotation, rotation_exp, rotation_log, skew

MAX_HYPOTHESES = 3000
LEAST_ACROSS = 0.25
"""Sine of the angle between two axes times the smaller sine of their rotations: less fixes nothing."""
ROUNDS = 20


@dataclass(frozen=True, kw_only=True)
class RotationOfX:
    """gripper_from_camera's rotation, how sure it is, and which pairs say so."""

    rotation: Float[ndarray, "3 3"]
    covariance: Float[ndarray, "3 3"]
    """Covariance of a rotation vector in gripper axes, rad²."""
    agreeing: Bool[ndarray, " p"]
    residual: Float[ndarray, " p"]
    """rad, per pair."""
    sigma: float
    """Robust size of the residuals of those that agree, rad."""

    def std(self) -> float:
        """Return the standard deviation of the worst direction, rad."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))


def rotation_of_x(
    gripper: Float[ndarray, "p 3 3"],
    camera: Float[ndarray, "p 3 3"],
    tolerance: Float[ndarray, " p"],
) -> RotationOfX | None:
    """R_X from relative rotations i_from_j of gripper and camera; None where no three pairs about two axes agree.

    `tolerance` (rad) is the largest disagreement of a sound pair.
    """
    axis_a, axis_b = sine_axis(gripper), sine_axis(camera)
    first, second = np.triu_indices(len(gripper), 1)
    across = np.linalg.norm(np.cross(axis_a[first], axis_a[second]), axis=1)
    order = np.argsort(-across, kind="stable")
    order = order[across[order] > 0.02]
    if (
        len(order) > MAX_HYPOTHESES
    ):  # spread over good and less good, for the best may all be of one wrong pair
        order = order[np.linspace(0, len(order) - 1, MAX_HYPOTHESES).astype(int)]
    if not len(order):
        return None
    a = np.stack([axis_a[first[order]], axis_a[second[order]]], 2)
    b = np.stack([axis_b[first[order]], axis_b[second[order]]], 2)
    a, b = (np.concatenate([of, np.cross(of[..., 0], of[..., 1])[..., None]], 2) for of in (a, b))
    hypotheses = nearest_rotation(a @ np.swapaxes(b, 1, 2))
    best, best_score = None, 0.0
    for start in range(0, len(hypotheses), 256):
        few = hypotheses[start : start + 256]
        gap = _gap(few[:, None], gripper, camera)
        score = np.maximum(1 - (gap / tolerance) ** 2, 0).sum(1)
        if score.max() > best_score:
            best, best_score = few[int(score.argmax())], float(score.max())
    if best is None:
        return None
    return _least_squares_rotation(best, gripper, camera, tolerance)


def _least_squares_rotation(
    x: Float[ndarray, "3 3"],
    gripper: Float[ndarray, "p 3 3"],
    camera: Float[ndarray, "p 3 3"],
    tolerance: Float[ndarray, " p"],
) -> RotationOfX | None:
    information = np.zeros((3, 3))
    agreeing = np.zeros(len(gripper), dtype=bool)
    for _ in range(ROUNDS):
        rotated = x @ camera @ x.T
        residual = rotation_log(np.swapaxes(rotated, 1, 2) @ gripper)
        agreeing = np.linalg.norm(residual, axis=1) < tolerance
        if agreeing.sum() < 3:
            return None
        # rotated → exp(w) rotated exp(-w): the residual, in the axes after rotated, changes by (rotatedᵀ − I) w.
        jacobian = np.swapaxes(rotated, 1, 2) - np.eye(3)
        w = np.where(agreeing, 1 / (1 + (2 * np.linalg.norm(residual, axis=1) / tolerance) ** 2), 0.0)
        information = np.einsum("p,pki,pkj->ij", w, jacobian, jacobian)
        gradient = np.einsum("p,pki,pk->i", w, jacobian, residual)
        step = np.linalg.solve(information + 1e-9 * np.eye(3), gradient)
        x = nearest_rotation(rotation_exp(step) @ x)
        if np.abs(step).max() < 1e-9:
            break
    gap = _gap(x, gripper, camera)
    sigma = max(1.48 * float(np.median(gap[agreeing])) / np.sqrt(3), np.radians(0.02))
    if np.linalg.eigvalsh(information)[0] < LEAST_ACROSS**2 * 0.1:
        return None
    return RotationOfX(
        rotation=x,
        covariance=sigma**2 * np.linalg.inv(information),
        agreeing=agreeing,
        residual=gap,
        sigma=sigma,
    )


def _gap(
    x: Float[ndarray, "*batch 3 3"], gripper: Float[ndarray, "p 3 3"], camera: Float[ndarray, "p 3 3"]
) -> Float[ndarray, "..."]:
    """Angle (rad; batch by p) by which each pair contradicts R_X."""
    trace = np.einsum("...ij,...ij->...", gripper @ x, x @ camera)
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


def linear_parts(
    gripper_rotation: Float[ndarray, "p 3 3"],
    gripper_translation: Float[ndarray, "p 3"],
    camera_direction_in_gripper: Float[ndarray, "p 3"],
) -> tuple[Float[ndarray, "p 3 3"], Float[ndarray, "p 3"]]:
    """Coefficients and constants, linear in t_X, of d × ((R_A − I) t_X + t_A) = 0 for each pair.

    d is the direction in which the camera moved, R_X t_B without its length: no scale is needed for t_X.
    """
    cross = skew(camera_direction_in_gripper)
    return cross @ (gripper_rotation - np.eye(3)), (cross @ gripper_translation[..., None])[..., 0]
