"""Rigid transforms and similarities as plain arrays.

`a_from_b` is a (...,4,4) float64 matrix that maps b coordinates to a: `x_in_a = a_from_b · x_in_b`.
Scale never hides in a 4x4: a similarity is a rigid `a_from_b` and a scale that is applied first.

Steps, errors and covariances of an `a_from_b` are those of `retract`, everywhere: (v, w), both in the axes of a, with
t ← t + v and R ← exp(w) R. v moves the origin of b whatever w is, which keeps the two parts of different units apart.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation

from jcr.errors import InputError

Transform = Float[ndarray, "4 4"]
Transforms = Float[ndarray, "*batch 4 4"]
Poses = Float[ndarray, "n 4 4"]
Rotations = Float[ndarray, "*batch 3 3"]
Vectors = Float[ndarray, "*batch 3"]

HUGE = 1e15
"""No length or reconstruction has larger numbers, and sums of their squares stay far from overflow."""
RIGID_TOLERANCE = 1e-3
"""Largest entry of RᵀR − I accepted as rounding; transforms printed with four digits pass."""
TINY = 1e-300
"""Keeps 0 / 0 from being asked; no sum of squares of lengths is as small."""
ARM = 0.3
"""m. Where a length and an angle (rad) are counted together, the angle counts at this arm: 0.1 mm weighs as 0.02°."""
PARALLEL = 1e-6
"""Keeps the point nearest to lines finite where they are parallel, and meet anywhere along them."""


def rotation_exp(rotation_vector: Vectors) -> Rotations:
    """SO(3) exponential: rotation vectors (...,3) rad to matrices (...,3,3)."""
    if rotation_vector.size == 0:  # refused by SciPy before 1.14
        return np.zeros((*rotation_vector.shape[:-1], 3, 3))
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


def by_similarity(v: Vectors) -> Float[ndarray, "*batch 3 7"]:
    """Return the derivatives of points v from an origin by a step (v, w) of it and the logarithm of a scale about it."""
    identity = np.broadcast_to(np.eye(3), (*v.shape, 3))
    return np.concatenate([identity, -skew(v), v[..., None]], axis=-1)


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


def retract(
    a_from_b: Float[ndarray, "*#batch 4 4"], step: Float[ndarray, "*#batch 6"]
) -> Float[ndarray, "... 4 4"]:
    """Return transforms (...,4,4) after steps (...,6) as this module defines them: t + v, exp(w) R."""
    return transform(
        rotation_exp(step[..., 3:]) @ a_from_b[..., :3, :3], a_from_b[..., :3, 3] + step[..., :3]
    )


def step_between(
    a_from_b: Float[ndarray, "*#batch 4 4"], target: Float[ndarray, "*#batch 4 4"]
) -> Float[ndarray, "... 6"]:
    """Return the steps (...,6) from `a_from_b` to `target`: the inverse of `retract`, up to a rotation by 180°."""
    rotation = target[..., :3, :3] @ np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    return np.concatenate([target[..., :3, 3] - a_from_b[..., :3, 3], rotation_log(rotation)], axis=-1)


def step_axes(rotation: Rotations) -> Float[ndarray, "*batch 6 6"]:
    """Return the matrices (…,6,6) that turn steps (m, then rad) from the axes of frame b to those of a.

    `rotation` (…,3,3) holds the rotations a_from_b.

    A motion on the right, T ← T·exp(ξ), is the step `step_axes(R) @ ξ` to first order.
    """
    out = np.zeros((*rotation.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    return out


def twist_from_step(a_from_b: Transforms) -> Float[ndarray, "*batch 6 6"]:
    """Matrices (...,6,6) that take steps to twists (v', w) about the origin of a, which move every point x by v' + w×x.

    In twists bodies that move together move alike, so that only differences of twists show in what they see of each
    other; v' = v + t×w.
    """
    out = np.zeros((*a_from_b.shape[:-2], 6, 6))
    out[..., range(6), range(6)] = 1.0
    out[..., :3, 3:] = skew(a_from_b[..., :3, 3])
    return out


def by_inverse(a_from_b: Transforms) -> Float[ndarray, "*batch 6 6"]:
    """Matrices (...,6,6) that take steps of transforms to those of their inverses."""
    rotation_t = np.swapaxes(a_from_b[..., :3, :3], -1, -2)
    out = -step_axes(rotation_t)
    out[..., :3, 3:] = -rotation_t @ skew(a_from_b[..., :3, 3])
    return out


def adjoint(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n 6 6"]:
    """Matrices that take twists (v, ω) in b axes to a axes."""
    return twist_from_step(a_from_b) @ step_axes(a_from_b[:, :3, :3])


def apply(a_from_b: Transform, x_in_b: Vectors) -> Vectors:
    """x_in_a for points (...,3) under one rigid transform (4,4)."""
    return x_in_b @ a_from_b[:3, :3].T + a_from_b[:3, 3]


def scale_translation(
    a_from_b: Float[ndarray, "*#batch 4 4"], scale: Float[ndarray, "*#batch"] | np.floating | float
) -> Float[ndarray, "... 4 4"]:
    """S_λ: the transforms with their translations multiplied by scales (...), their rotations untouched."""
    return transform(a_from_b[..., :3, :3], np.asarray(scale)[..., None] * a_from_b[..., :3, 3])


@dataclass(frozen=True)
class Similarity:
    """Similarity a_from_b: x_in_a = R · (scale · x_in_b) + t."""

    rigid: Float[ndarray, "4 4"]
    """Rotation R and translation t (m)."""
    scale: float
    """Metres per unit of b."""

    def __call__(self, x_in_b: Vectors) -> Vectors:
        """Return points (…,3) in a."""
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
    """Least-squares `a_from_b` (...,4,4) and scales (...) with x_in_a ≈ R·(scale·x_in_b) + t (Umeyama 1991).

    Without a batch the scale is a float. Points of no weight or of no extent give scale 1.
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
    """Projectors (...,3,3) onto the plane at right angles to unit directions (...,3): I − d dᵀ.

    They are what lines show of the point nearest to them: Σ (I − d dᵀ) x = Σ (I − d dᵀ) o, with o on each line.
    """
    return np.eye(3) - direction[..., :, None] * direction[..., None, :]


def nearest_to_lines(
    origin: Float[ndarray, "*#batch n 3"], direction: Float[ndarray, "*#batch n 3"]
) -> Float[ndarray, "... 3"]:
    """Return the points (...,3) nearest to n lines each, given by a point and a unit direction (...,n,3)."""
    across = across_lines(direction)
    normal = across.sum(-3) + PARALLEL * np.eye(3)
    return np.linalg.solve(normal, (across @ origin[..., None]).sum(-3))[..., 0]


def motion_length(motion: Transforms) -> Float[ndarray, "*batch"] | np.floating:
    """Return the length of motions (...,4,4) (m): the way of the origin, and the angle times ARM."""
    return np.linalg.norm(motion[..., :3, 3], axis=-1) + ARM * rotation_angle(motion[..., :3, :3])


def largest_motion(a_from_b: Float[ndarray, "n 4 4"]) -> tuple[float, float]:
    """Return the longest translation (m) and the largest rotation (rad) between any two of the transforms."""
    motion = inverse(a_from_b)[:, None] @ a_from_b[None]
    return float(np.linalg.norm(motion[..., :3, 3], axis=-1).max()), float(
        np.max(rotation_angle(motion[..., :3, :3]))
    )


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


def require_rigid(matrix: Transform, where: str) -> Transform:
    """Return the matrix with its rotation made exact; raise InputError where it is too far from rigid.

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
