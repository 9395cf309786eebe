"""Rigid transforms and similarities as plain arrays.

`a_from_b` is a (...,4,4) float64 matrix that maps b coordinates to a: `x_in_a = a_from_b · x_in_b`.
Scale never hides in a 4x4: a similarity is a rigid `a_from_b` and a scale that is applied first.
"""

import warnings

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.errors import InputError

Transforms = Float[ndarray, "*batch 4 4"]
Rotations = Float[ndarray, "*batch 3 3"]
Vectors = Float[ndarray, "*batch 3"]

HUGE = 1e15
"""No length or reconstruction has larger numbers, and sums of their squares stay far from overflow."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR − I accepted as rounding; transforms printed with four digits pass."""


def rotation_exp(rotation_vector: Vectors) -> Rotations:
    """SO(3) exponential: rotation vectors (...,3) rad to matrices (...,3,3)."""
    flat = Rotation.from_rotvec(rotation_vector.reshape(-1, 3)).as_matrix()
    return flat.reshape(*rotation_vector.shape[:-1], 3, 3)


def rotation_log(rotation: Rotations) -> Vectors:
    """SO(3) logarithm: matrices (...,3,3) to rotation vectors (...,3) rad, length ≤ π; safe at 0 and π."""
    if rotation.size == 0:  # refused by SciPy before 1.14
        return np.zeros(rotation.shape[:-1])
    flat = Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_rotvec()
    return flat.reshape(*rotation.shape[:-2], 3)


def rotation_angle(rotation: Rotations) -> Float[ndarray, "*batch"] | np.floating:
    """Angle of rotation in [0, π] rad, accurate near both ends (unlike arccos of the trace)."""
    return np.linalg.norm(rotation_log(rotation), axis=-1)


def skew(v: Vectors) -> Rotations:
    """Cross-product matrices (...,3,3): `skew(v) @ w == cross(v, w)`."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def transform(
    rotation: Float[ndarray, "*#batch 3 3"], translation: Float[ndarray, "*#batch 3"]
) -> Float[ndarray, "... 4 4"]:
    """Assemble (...,4,4) from rotation (...,3,3) and translation (...,3), which broadcast."""
    batch = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*batch, 4, 4))
    out[..., :3, :3] = rotation
    out[..., :3, 3] = translation
    out[..., 3, 3] = 1.0
    return out


def inverse(a_from_b: Transforms) -> Transforms:
    """Rigid inverse, (...,4,4), without a general matrix inversion."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return transform(rotation_t, -(rotation_t @ a_from_b[..., :3, 3:])[..., 0])


def adjoint(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n 6 6"]:
    """Matrices that take twists (v, ω) in b axes to a axes."""
    out = np.zeros((len(a_from_b), 6, 6))
    rotation = a_from_b[:, :3, :3]
    out[:, :3, :3] = out[:, 3:, 3:] = rotation
    out[:, :3, 3:] = skew(a_from_b[:, :3, 3]) @ rotation
    return out


def apply(a_from_b: Float[ndarray, "4 4"], x_in_b: Vectors) -> Vectors:
    """x_in_a for points (...,3) under one rigid transform (4,4)."""
    return x_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def scale_translation(a_from_b: Transforms, scale: float) -> Transforms:
    """S_λ: the transform with its translation multiplied by `scale`, its rotation untouched."""
    out = a_from_b.astype(np.float64, copy=True)
    out[..., :3, 3] *= scale
    return out


def apply_similarity(a_from_b: Float[ndarray, "4 4"], scale: float, x_in_b: Vectors) -> Vectors:
    """x_in_a = R · (scale · x_in_b) + t for points (...,3)."""
    return apply(a_from_b, scale * x_in_b)


def nearest_rotation(matrix: Rotations) -> Rotations:
    """The proper rotations (...,3,3) closest to the matrices in Frobenius norm (det = +1)."""
    u, _, vt = np.linalg.svd(matrix)
    sign = np.ones(matrix.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(u @ vt))
    return (u * sign[..., None, :]) @ vt


def fit_similarity(
    x_in_a: Float[ndarray, "n 3"], x_in_b: Float[ndarray, "n 3"], weights: Float[ndarray, " n"] | None = None
) -> tuple[Float[ndarray, "4 4"], float]:
    """Least-squares `a_from_b` (4,4) and scale with x_in_a ≈ R·(scale·x_in_b) + t (Umeyama 1991)."""
    w = np.full(len(x_in_a), 1.0 / len(x_in_a)) if weights is None else weights / weights.sum()
    mean_a, mean_b = w @ x_in_a, w @ x_in_b
    a, b = x_in_a - mean_a, x_in_b - mean_b
    cross = (a * w[:, None]).T @ b
    rotation = nearest_rotation(cross)
    scale = float(np.trace(rotation.T @ cross) / (w @ (b * b).sum(-1)))
    return transform(rotation, mean_a - scale * rotation @ mean_b), scale


def rotation_between_deg(
    a: Float[ndarray, "*#batch 3 3"], b: Float[ndarray, "*#batch 3 3"]
) -> Float[ndarray, "..."] | np.floating:
    """Angle in degrees between two (stacks of) rotations."""
    return np.degrees(rotation_angle(np.swapaxes(a, -1, -2) @ b))


def roll_pitch_yaw(rotation: Float[ndarray, "3 3"]) -> Float[ndarray, "3"]:
    """Roll, pitch, yaw (rad) about the fixed axes x, y, z: R = Rz(yaw)·Ry(pitch)·Rx(roll); at gimbal lock yaw is 0."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of gimbal lock, where any of the equal answers will do
        return Rotation.from_matrix(rotation).as_euler("xyz")


def require_rigid(matrix: Float[ndarray, "4 4"], where: str) -> Float[ndarray, "4 4"]:
    """The matrix with its rotation made exact; InputError saying how far from rigid it is, and why.

    `where` begins the message: the file and frame, or the argument, that the matrix came from.
    """
    if not (np.abs(matrix) < HUGE).all():
        raise InputError(
            f"{where}: holds NaN or infinity (or beyond {HUGE:.0e}); record that pose again or drop the frame"
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
        raise InputError(f"{where}: no rotation, RᵀR differs from the identity by {off:.2g}; {hint}")
    if determinant < 0:
        raise InputError(
            f"{where}: a reflection (determinant {determinant:.3f}); an axis has its sign flipped"
        )
    return transform(nearest_rotation(rotation), matrix[:3, 3])
