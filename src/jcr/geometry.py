"""Rigid transforms and similarities as plain arrays.

`a_from_b` is a (...,4,4) float64 matrix that maps b coordinates to a: `x_in_a = a_from_b · x_in_b`.
A 4x4 matrix contains no scale: a similarity is a rigid `a_from_b` and a scale that is applied to x_in_b first.

A step (v, w) of a transform `a_from_b` changes it to t + v, exp(w) R; v (m) and w (rad) are in the axes of frame a.
All steps, errors and covariances of transforms are in this form (`retract`), translation before rotation.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.errors import InputError
from jcr.number_format import HUGE

Transform = Float[ndarray, "4 4"]
Transforms = Float[ndarray, "*batch 4 4"]
Poses = Float[ndarray, "n 4 4"]
Rotations = Float[ndarray, "*batch 3 3"]
Vectors = Float[ndarray, "*batch 3"]

RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR − I accepted as rounding; transforms printed with four digits pass."""
TINY = 1e-300
"""Lower bound of denominators, against 0 / 0."""
ARM = 0.3
"""Lever (m) by which an angle (rad) is multiplied to compare it with a length: 0.1 mm counts like 0.02°."""
ROOT_FROM_OPTICAL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Transform from a camera's optical frame (z forward, x right) to its root link (x forward, z up), as in REP-103."""
PARALLEL = 1e-6
"""Weight that keeps the point nearest to parallel lines finite."""


def rotation_exp(rotation_vector: Vectors) -> Rotations:
    """Return the rotation matrices (...,3,3) of rotation vectors (...,3) in rad: the exponential map of SO(3)."""
    if rotation_vector.size == 0:  # refused by SciPy before 1.14
        return np.zeros((*rotation_vector.shape[:-1], 3, 3))
    flat = Rotation.from_rotvec(rotation_vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*rotation_vector.shape[:-1], 3, 3)


def rotation_log(rotation: Rotations) -> Vectors:
    """Return the rotation vectors (...,3), in rad with length ≤ π, of rotation matrices; accurate near 0 and π too."""
    if rotation.size == 0:  # refused by SciPy before 1.14
        return np.zeros(rotation.shape[:-1])
    return Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec().reshape(*rotation.shape[:-2], 3)


def rotation_angle(rotation: Rotations) -> Float[ndarray, "*batch"] | np.floating:
    """Return the angles (...) of rotations (...,3,3), 0 to π rad; accurate near 0 and π, unlike arccos of the trace."""
    cosine = (np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2
    return np.arctan2(np.linalg.norm(sine_axis(rotation), axis=-1), cosine)


def sine_axis(rotation: Rotations) -> Vectors:
    """Return the rotation axis times the sine of the angle (...,3), which is smooth at angles 0 and π."""
    antisymmetric = (rotation - np.swapaxes(rotation, -1, -2)) / 2
    return np.stack([antisymmetric[..., 2, 1], antisymmetric[..., 0, 2], antisymmetric[..., 1, 0]], axis=-1)


def skew(v: Vectors) -> Rotations:
    """Return the cross-product matrices (...,3,3): `skew(v) @ w == cross(v, w)`."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def by_similarity(v: Vectors) -> Float[ndarray, "*batch 3 7"]:
    """Return [I, -skew(v), v] (...,3,7), the derivatives of points v (...,3) by a small similarity transform.

    Columns: translation (3), rotation vector about the origin (3, rad), natural logarithm of the scale (1), in the
    frame of v.
    """
    return np.concatenate([np.broadcast_to(np.eye(3), (*v.shape, 3)), -skew(v), v[..., None]], axis=-1)


def transform(
    rotation: Float[ndarray, "*#batch 3 3"], translation: Float[ndarray, "*#batch 3"]
) -> Float[ndarray, "... 4 4"]:
    """Return transforms (...,4,4) from rotations (...,3,3) and translations (...,3), which broadcast."""
    out = np.zeros((*np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1]), 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def inverse(a_from_b: Transforms) -> Transforms:
    """Return b_from_a (...,4,4), the inverses of rigid transforms."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return transform(rotation_t, -(rotation_t @ a_from_b[..., :3, 3:])[..., 0])


def retract(
    a_from_b: Float[ndarray, "*#batch 4 4"], step: Float[ndarray, "*#batch 6"]
) -> Float[ndarray, "... 4 4"]:
    """Return transforms (...,4,4) after steps (v, w) of shape (...,6): translation t + v, rotation exp(w) R.

    t and R are those of `a_from_b`; v is a translation (m) and w a rotation vector (rad), both in the axes of frame a.
    """
    return transform(
        rotation_exp(step[..., 3:]) @ a_from_b[..., :3, :3], a_from_b[..., :3, 3] + step[..., :3]
    )


def step_between(
    a_from_b: Float[ndarray, "*#batch 4 4"], target: Float[ndarray, "*#batch 4 4"]
) -> Float[ndarray, "... 6"]:
    """Return the steps (...,6) for which `retract(a_from_b, step)` is `target`.

    A step is a translation (m), then a rotation vector (rad), in the axes of frame a. `target` is an a_from_b, too.
    """
    rotation = target[..., :3, :3] @ np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return np.concatenate([target[..., :3, 3] - a_from_b[..., :3, 3], rotation_log(rotation)], axis=-1)


def step_axes(rotation: Rotations) -> Float[ndarray, "*batch 6 6"]:
    """Return the matrices (…,6,6) that turn steps (m, then rad) from the axes of frame b to those of frame a.

    `rotation` R (…,3,3) holds the rotations a_from_b; both blocks of a matrix are R. To first order `step_axes(R) @ ξ`
    is the step from T to T·exp(ξ), for a transform T with rotation R.
    """
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    return out


def twist_from_step(a_from_b: Transforms) -> Float[ndarray, "*batch 6 6"]:
    """Return the matrices (...,6,6) that turn steps (v, w) of a_from_b into twists (v + t × w, w) about the origin of a.

    A twist (u, w) moves every point x in frame a by u + w × x; t is the translation of a_from_b. Bodies that move
    together have equal twists, unlike steps.
    """
    out = np.zeros((*a_from_b.shape[:-2], 6, 6))
    out[..., range(6), range(6)] = 1.0
    out[..., :3, 3:] = skew(a_from_b[..., :3, 3])
    return out


def by_inverse(a_from_b: Transforms) -> Float[ndarray, "*batch 6 6"]:
    """Return the matrices (...,6,6) that turn small steps (`retract`) of a_from_b into those of its inverse b_from_a.

    Steps of a_from_b are in the axes of frame a, those of b_from_a in the axes of frame b: translation, then rotation.
    """
    return -step_axes(np.swapaxes(a_from_b[..., :3, :3], -1, -2)) @ twist_from_step(a_from_b)


def adjoint(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n 6 6"]:
    """Return the adjoint matrices (n,6,6) that turn twists (linear v, angular ω) in frame b into twists in frame a."""
    return twist_from_step(a_from_b) @ step_axes(a_from_b[:, :3, :3])


def apply(a_from_b: Transform, x_in_b: Vectors) -> Vectors:
    """Return x_in_a (...,3), the points transformed by one rigid transform (4,4)."""
    return x_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def scale_translation(
    a_from_b: Float[ndarray, "*#batch 4 4"], scale: Float[ndarray, "*#batch"] | np.floating | float
) -> Float[ndarray, "... 4 4"]:
    """Return the transforms with their translations multiplied by the scales (...); rotations do not change."""
    return transform(a_from_b[..., :3, :3], np.asarray(scale)[..., None] * a_from_b[..., :3, 3])


@dataclass(frozen=True)
class Similarity:
    """Similarity a_from_b: x_in_a = R · (scale · x_in_b) + t."""

    rigid: Float[ndarray, "4 4"]
    """Rotation R and translation t (m)."""
    scale: float
    """Metres per unit of b."""

    def __call__(self, x_in_b: Vectors) -> Vectors:
        """Return x_in_a (…,3) in metres, the transformed points `x_in_b` (…,3)."""
        return apply(self.rigid, self.scale * np.asarray(x_in_b, float))


def nearest_rotation(matrix: Rotations) -> Rotations:
    """Return the proper rotations (...,3,3) closest to the matrices in Frobenius norm (det = +1)."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * sign[..., None, :]) @ vt


def fit_similarity(
    x_in_a: Float[ndarray, "*#batch n 3"],
    x_in_b: Float[ndarray, "*#batch n 3"],
    weights: Float[ndarray, "*#batch n"] | None = None,
) -> tuple[Float[ndarray, "... 4 4"], Any]:
    """Return least-squares a_from_b (...,4,4; R, t) and scale (...) of x_in_a ≈ R·(scale·x_in_b) + t (Umeyama 1991).

    `weights` of the n points: None for equal ones. Points without weight or extent give scale 1.
    """
    w = np.ones(x_in_a.shape[:-1]) if weights is None else weights
    w = w / np.maximum(w.sum(-1, keepdims=True), TINY)
    mean_a, mean_b = (w[..., None, :] @ x for x in (x_in_a, x_in_b))
    b = x_in_b - mean_b
    cross = np.swapaxes((x_in_a - mean_a) * w[..., None], -1, -2) @ b
    rotation = nearest_rotation(cross)
    moment = np.einsum("...ij,...ij->...", rotation, cross)
    scale = np.maximum(moment, TINY) / np.maximum((w * (b * b).sum(-1)).sum(-1), TINY)
    middle = (rotation @ np.swapaxes(mean_b, -1, -2))[..., 0]
    return transform(rotation, mean_a[..., 0, :] - scale[..., None] * middle), scale


def across_lines(direction: Vectors) -> Rotations:
    """Return the projectors I − d dᵀ (...,3,3) onto the plane perpendicular to unit directions d (...,3).

    The point x nearest to lines through points o solves Σ (I − d dᵀ) x = Σ (I − d dᵀ) o.
    """
    return np.eye(3) - direction[..., :, None] * direction[..., None, :]


def nearest_to_lines(
    origin: Float[ndarray, "*#batch n 3"], direction: Float[ndarray, "*#batch n 3"]
) -> Float[ndarray, "... 3"]:
    """Return the point (...,3) with the least sum of squared distances to n lines.

    A line is given by a point `origin` on the line and a unit vector `direction`. Among the points nearest to parallel
    lines, the one closest to the coordinate origin is returned.
    """
    across = across_lines(direction)
    normal = across.sum(-3) + PARALLEL * np.eye(3)
    return np.linalg.solve(normal, (across @ origin[..., None]).sum(-3))[..., 0]


def motion_length(motion: Transforms) -> Float[ndarray, "*batch"] | np.floating:
    """Return the length (m) of motions (...,4,4): length of the translation plus 0.3 m times the angle (rad)."""
    return np.linalg.norm(motion[..., :3, 3], axis=-1) + ARM * rotation_angle(motion[..., :3, :3])


def largest_motion(a_from_b: Float[ndarray, "n 4 4"]) -> tuple[float, float]:
    """Return the largest distance (m) between the origins of b, and the largest angle (rad), in any two transforms."""
    motion = inverse(a_from_b)[:, None] @ a_from_b[None]
    return float(np.linalg.norm(motion[..., :3, 3], axis=-1).max()), float(
        np.max(rotation_angle(motion[..., :3, :3]))
    )


def rotation_between_deg(
    a: Float[ndarray, "*#batch 3 3"], b: Float[ndarray, "*#batch 3 3"]
) -> Float[ndarray, "..."] | np.floating:
    """Return the angle (degrees, 0 to 180) of the rotation aᵀb between rotations a, b (...,3,3), which broadcast."""
    return np.degrees(rotation_angle(np.swapaxes(a, -1, -2) @ b))


def roll_pitch_yaw(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "3"]:
    """Return roll, pitch, yaw (rad) with R = Rz(yaw)·Ry(pitch)·Rx(roll); at gimbal lock yaw is 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about gimbal lock, where roll and yaw are not unique
        return Rotation.from_matrix(rotation).as_euler("xyz")


def require_rigid(matrix: Transform, where: str) -> Transform:
    """Return the matrix (4,4) with its rotation R made exact; raise InputError if it is no rigid transform.

    An element of RᵀR may deviate from the identity by 1e-3 at most. `where` begins the message: the file and frame, or
    the argument, that the matrix came from.
    """
    if not (np.abs(matrix) < HUGE).all():
        raise InputError(
            f"{where}: holds NaN or infinity (or beyond {HUGE:.0e}); record that pose again or leave it out"
        )
    if not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-9):
        transposed = np.allclose(matrix[:, 3], [0, 0, 0, 1], atol=1e-9)
        hint = "it is transposed (column-major): transpose it" if transposed else "write 0 0 0 1"
        raise InputError(f"{where}: its last row is {np.round(matrix[3], 4).tolist()}, not 0 0 0 1; {hint}")
    rotation = matrix[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    determinant = float(np.linalg.det(rotation))
    if off > RIGID_TOLERANCE:
        size = abs(determinant) ** (1 / 3)
        scaled = size > 0 and np.abs(rotation.T @ rotation / size**2 - np.eye(3)).max() < RIGID_TOLERANCE
        hint = f"it is scaled by {size:.4g}: divide it out" if scaled else "check units, order and angles"
        raise InputError(f"{where}: not a rotation matrix, RᵀR differs from identity by {off:.2g}; {hint}")
    if determinant < 0:
        raise InputError(f"{where}: a reflection (determinant {determinant:.3f}); flip the sign of an axis")
    return transform(nearest_rotation(rotation), matrix[:3, 3])
