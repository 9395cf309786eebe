"""Hand-eye calibration with unknown scale in closed form, over all pairs of images at once.

For every image `base_from_gripper · X = base_from_recon · S_λ(recon_from_camera)`. Summing the squared
differences of this equation over all pairs of images is the same as summing over images with
`base_from_recon` free, so all n(n-1)/2 motions are used at the cost of n.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import Rotations, inverse, nearest_rotation, transform

Weights = Float[ndarray, " n"]
Rotation3 = Float[ndarray, "3 3"]


def closed_form(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"], weights: Weights
) -> tuple[Float[ndarray, "4 4"], float, Float[ndarray, "4 4"]]:
    """Closed-form `gripper_from_camera`, scale and `base_from_recon`.

    Rotation first, then translation and scale by one linear least squares (the paper's scale recovery
    problem, eq. 6, whose grid search over λ it makes needless).
    """
    rotation, base_rotation = _rotations(base_from_gripper, recon_from_camera, weights)
    translation, scale, base_translation = _translations(
        base_from_gripper, recon_from_camera, base_rotation, weights
    )
    return transform(rotation, translation), scale, transform(base_rotation, base_translation)


def motions(a_from_b: Float[ndarray, "n 4 4"]) -> Float[ndarray, "n n 4 4"]:
    """All relative motions: entry (i, j) is a_from_b[i]⁻¹ · a_from_b[j]."""
    return inverse(a_from_b)[:, None] @ a_from_b[None]


def sine_axis(rotation: Rotations) -> Float[ndarray, "*batch 3"]:
    """Rotation axis times the sine of the angle (...,3): smooth at 0 and, unlike the logarithm, at π."""
    antisymmetric = (rotation - np.swapaxes(rotation, -1, -2)) / 2
    return np.stack([antisymmetric[..., 2, 1], antisymmetric[..., 0, 2], antisymmetric[..., 1, 0]], axis=-1)


def _rotations(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"], weights: Weights
) -> tuple[Rotation3, Rotation3]:
    """R_X and the rotation of base_from_recon.

    R_G · R_X = R_Z · R_C is linear in both; the leading singular pair of Σ w R_C ⊗ R_G solves it (Shah 2013)
    without a logarithm, hence without trouble at 0 or π. It is ambiguous where the motions are half turns
    alone, so Park-Martin's sum over pairs (1994) competes, on sine-weighted axes instead of logarithms.
    """
    gripper, camera = base_from_gripper[:, :3, :3], recon_from_camera[:, :3, :3]
    kron = np.einsum("n,nij,nkl->ikjl", weights, gripper, camera).reshape(9, 9)
    _, _, vt = np.linalg.svd(kron)
    leading = vt[0].reshape(3, 3)
    candidates = [nearest_rotation(leading * np.sign(np.linalg.det(leading) or 1.0))]

    pair_weights = weights[:, None] * weights[None]
    a, b = (
        sine_axis(motions(base_from_gripper)[..., :3, :3]),
        sine_axis(motions(recon_from_camera)[..., :3, :3]),
    )
    candidates.append(nearest_rotation(np.einsum("nm,nmi,nmj->ij", pair_weights, a, b)))

    def polish(rotation: Rotation3) -> tuple[float, Rotation3, Rotation3]:
        # The two best rotations given each other, in turn: monotone; a likelihood fit finishes the work.
        base = rotation
        for _ in range(5):
            base = nearest_rotation(np.einsum("n,nij,nkj->ik", weights, gripper @ rotation, camera))
            before = rotation
            rotation = nearest_rotation(np.einsum("n,nji,njk->ik", weights, gripper, base @ camera))
            if np.abs(rotation - before).max() < 1e-13:
                break
        gap = gripper @ rotation - base @ camera
        return float(weights @ (gap**2).sum((1, 2))), rotation, base

    _, rotation, base_rotation = min((polish(candidate) for candidate in candidates), key=lambda fit: fit[0])
    return rotation, base_rotation


def _translations(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    base_rotation: Rotation3,
    weights: Weights,
) -> tuple[Float[ndarray, "3"], float, Float[ndarray, "3"]]:
    """t_X, λ and t_Z (of base_from_recon) from R_G t_X + t_G = λ R_Z t_C + t_Z, linear in all three.

    The paper prints t_c^e for the camera's translation in its d_i(λ); t_C is meant.
    """
    n = len(weights)
    rows = np.zeros((n, 3, 7))
    rows[:, :, :3] = base_from_gripper[:, :3, :3]
    rows[:, :, 3] = -(recon_from_camera[:, :3, 3] @ base_rotation.T)
    rows[:, :, 4:] = -np.eye(3)
    right = -base_from_gripper[:, :3, 3]
    root = np.sqrt(weights)[:, None]
    # Columns of unit length: the cut-off for a null direction must not depend on the reconstruction's unit.
    length = np.linalg.norm(rows[:, :, 3]) / np.sqrt(n) or 1.0
    rows[:, :, 3] /= length
    solution = np.linalg.lstsq(
        (rows * root[..., None]).reshape(3 * n, 7), (right * root).ravel(), rcond=1e-10
    )[0]
    return solution[:3], float(solution[3] / length), solution[4:]
