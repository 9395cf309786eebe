"""Hand-eye transform and scale from consecutive motions (paper section IV-B, eq. 2 to 11).

Here A_i = gripper_i from gripper_i+1 and B_i = camera_i from camera_i+1. B(λ) is B with its translation multiplied by λ
(eq. 3), and A X = X B(λ) (eq. 4). The paper writes E_i and P_i for the inverse poses, which gives the same equation.
Two misprints of the paper are corrected, in eq. 7 and eq. 9.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.options import MIN_FRAMES
from jcr.errors import RejectedError, count_of
from jcr.geometry import Rotations, Transform, inverse, nearest_rotation, rotation_log, transform

Poses = Float[ndarray, "n 4 4"]
SCALES = np.linspace(1.0, 4.0, 20_000)
"""Values of λ that the authors' code tries; a scale outside of them is not found."""


def motions(a_from_b: Poses) -> Float[ndarray, "n-1 4 4"]:
    """Return the n − 1 motions between consecutive poses, a_from_b[i]⁻¹ · a_from_b[i+1] (eq. 2)."""
    return inverse(a_from_b[:-1]) @ a_from_b[1:]


def hand_eye_rotation(a: Poses, b: Poses) -> Rotations:
    """Return R_c^e in closed form from gripper motions `a` and camera motions `b` (eq. 5 to 7, Park and Martin 1994).

    The logarithm is that of eq. 5 and 6, with its limits at the angles 0 and π, where eq. 6 divides by zero. The paper
    prints M with the logarithm of the gripper first. (MᵀM)^(-1/2) Mᵀ is R_c^e only if that of the camera is first.
    """
    m = np.einsum("ni,nj->ij", rotation_log(b[:, :3, :3]), rotation_log(a[:, :3, :3]))
    # The orthogonal factor of Mᵀ by singular values is (MᵀM)^(-1/2) Mᵀ.
    return nearest_rotation(m.T)


def translation_and_scale(
    a: Poses, b: Poses, rotation: Rotations, scales: Float[ndarray, " k"] | None = None
) -> tuple[Float[ndarray, "3"], float]:
    """Return t_c^e (m) and λ that solve the scale recovery problem (eq. 8 to 10).

    The paper prints λ t_c^e in d_i (eq. 9), where λ t_B, the camera's motion, is meant. The residual C t − d(λ) is then
    linear in t and λ, and one least-squares solution gives both. If `scales` are given, λ is the one of them with the
    smallest residual, as in the paper: for each, t is (CᵀC)⁻¹Cᵀ d(λ) (eq. 10).
    """
    c = (np.eye(3) - a[:, :3, :3]).reshape(-1, 3)
    constant, per_scale = a[:, :3, 3].reshape(-1), (b[:, :3, 3] @ rotation.T).reshape(-1)
    if scales is None:
        *t, scale = np.linalg.lstsq(np.column_stack([c, per_scale]), constant, rcond=None)[0]
        return np.array(t), float(scale)
    d = constant[:, None] - scales * per_scale[:, None]
    t = np.linalg.pinv(c) @ d
    best = int(((c @ t - d) ** 2).sum(0).argmin())
    return t[:, best], float(scales[best])


def solve(
    base_from_gripper: Poses, recon_from_camera: Poses, scales: Float[ndarray, " k"] | None = None
) -> tuple[Transform, float]:
    """Return gripper_from_camera (eq. 11) and λ, metres per unit of the reconstruction.

    `scales` None solves for λ; SCALES is the search of the paper. Raises RejectedError with fewer than three poses, and
    where the result is no transform or no positive scale.
    """
    if len(base_from_gripper) < MIN_FRAMES:
        raise RejectedError(
            f"{count_of(len(base_from_gripper), 'image')} have a camera pose, the published solver needs {MIN_FRAMES}",
            "overlap the views more",
        )
    a, b = motions(base_from_gripper), motions(recon_from_camera)
    rotation = hand_eye_rotation(a, b)
    translation, scale = translation_and_scale(a, b, rotation, scales)
    x = transform(rotation, translation)
    if not (np.isfinite(x).all() and 0 < scale < np.inf):
        raise RejectedError(f"the published solver diverged: scale {scale:.3g}", "rotate the wrist more")
    return x, scale
