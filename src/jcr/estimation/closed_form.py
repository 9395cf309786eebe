"""Closed-form hand-eye calibration with unknown scale from all pairs of images, for many problems at once.

For every image `base_from_gripper · X = base_from_recon · S_λ(recon_from_camera)`. With `base_from_recon` free, the
sum of squared differences over n images equals the sum over all n(n-1)/2 pairs. No logarithm of a rotation is used, so
rotations by 180° need no special treatment.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import Rotations, Transform, inverse, nearest_rotation, transform

Poses = Float[ndarray, "*#batch n 4 4"]
ROUNDS = 5
"""Largest number of alternating refinements of the two rotations; a likelihood fit follows."""
RELATIVE_CUT = 1e-10
"""Relative singular value below which a direction counts as unobservable."""


def closed_form(
    base_from_gripper: Poses, recon_from_camera: Poses, rounds: int = ROUNDS
) -> tuple[Float[ndarray, "... 4 4"], Float[ndarray, "..."] | np.floating, Float[ndarray, "... 4 4"]]:
    """Return `gripper_from_camera` (...,4,4), scale (...) and `base_from_recon` (...,4,4) in closed form.

    Inputs (...,n,4,4) are n poses; scale is a length in base over that in recon. Rotations are solved first, with
    `rounds` of alternating refinement; then translations and scale by linear least squares (the paper's scale recovery
    problem, eq. 8 to 10). Degenerate motions give the translation of least norm, and a scale that may be 0 or negative.
    """
    of_gripper, of_camera = base_from_gripper[..., :3, :3], recon_from_camera[..., :3, :3]
    rotation, base_rotation = rotations(of_gripper, of_camera, rounds)
    # Least squares of R_G t_X + t_G = λ R_Z t_C + t_Z; the paper prints t_c^e for t_C in its d_i(λ).
    center, position = recon_from_camera[..., :3, 3], base_from_gripper[..., :3, 3]
    in_base = center @ np.swapaxes(base_rotation, -1, -2)
    rows = np.concatenate([of_gripper, -in_base[..., None], -position[..., None]], axis=-1)
    rows = rows - rows.mean(-3, keepdims=True)
    # The scale's column is normalised, so that the cut of singular values does not depend on the reconstruction's unit.
    # Camera centres that differ by rounding only count as equal.
    size, whole = np.sqrt((rows[..., 3] ** 2).mean((-1, -2))), np.sqrt((center**2).mean((-1, -2)))
    unit = np.where(size > RELATIVE_CUT * whole, size, np.inf)
    rows[..., 3] /= unit[..., None, None]
    rows = rows.reshape(*rows.shape[:-3], -1, 5)
    solution = np.linalg.pinv(rows[..., :4], rcond=RELATIVE_CUT) @ rows[..., 4:]
    translation, scale = solution[..., :3, 0], solution[..., 3, 0] / unit
    gap = (of_gripper @ translation[..., None, :, None])[..., 0] + position - scale[..., None, None] * in_base
    return transform(rotation, translation), scale, transform(base_rotation, gap.mean(-2))


def initial_estimate(
    base_from_gripper: Float[ndarray, "n 4 4"], recon_from_camera: Float[ndarray, "n 4 4"]
) -> tuple[Transform, float, Transform]:
    """Return gripper_from_camera, scale and base_from_recon of `closed_form`, with a positive scale.

    Scale is a length in base over that in recon. A scale ≤ 0 is replaced by the extent of the gripper positions over
    that of the camera positions.
    """
    x, scale, z = closed_form(base_from_gripper, recon_from_camera)
    if scale <= 0:
        way, center = base_from_gripper[:, :3, 3], recon_from_camera[:, :3, 3]
        extent, seen = (np.linalg.norm(of - of.mean(0)) for of in (way, center))
        # Any scale fits a camera that only rotates.
        scale = extent / seen if seen > RELATIVE_CUT * np.linalg.norm(center) else 1.0
    return x, float(scale) or 1.0, z


def motions(a_from_b: Poses) -> Float[ndarray, "... n n 4 4"]:
    """Return all relative motions of n poses: entry (i, j) is a_from_b[i]⁻¹ · a_from_b[j], that is bᵢ_from_bⱼ."""
    return inverse(a_from_b)[..., :, None, :, :] @ a_from_b[..., None, :, :, :]


def sine_axis(rotation: Rotations) -> Float[ndarray, "*batch 3"]:
    """Return the rotation axis times the sine of the angle (...,3), which is smooth at angles 0 and π."""
    antisymmetric = (rotation - np.swapaxes(rotation, -1, -2)) / 2
    return np.stack([antisymmetric[..., 2, 1], antisymmetric[..., 0, 2], antisymmetric[..., 1, 0]], axis=-1)


def rotations(
    gripper: Float[ndarray, "*#batch n 3 3"], camera: Float[ndarray, "*#batch n 3 3"], rounds: int = ROUNDS
) -> tuple[Rotations, Rotations]:
    """Return R_X and R_Z, the rotations of gripper_from_camera and base_from_recon, from R_G · R_X = R_Z · R_C.

    R_G is `gripper` (rotations of base_from_gripper), R_C is `camera` (rotations of recon_from_camera). The method is
    the linear solution of Shah (2013), by the leading singular pair of Σ R_C ⊗ R_G, then `rounds` of alternating least
    squares.
    """
    kron = np.einsum("...nij,...nkl->...ikjl", gripper, camera)
    leading = np.linalg.svd(kron.reshape(*kron.shape[:-4], 9, 9))[2][..., 0, :].reshape(
        *kron.shape[:-4], 3, 3
    )
    rotation = nearest_rotation(np.where(np.linalg.det(leading) < 0, -1.0, 1.0)[..., None, None] * leading)
    from_camera = np.swapaxes(camera, -1, -2)
    base = nearest_rotation((gripper @ rotation[..., None, :, :] @ from_camera).sum(-3))
    for _ in range(rounds):
        before = rotation
        rotation = nearest_rotation((np.swapaxes(gripper, -1, -2) @ base[..., None, :, :] @ camera).sum(-3))
        base = nearest_rotation((gripper @ rotation[..., None, :, :] @ from_camera).sum(-3))
        if np.abs(rotation - before).max() < 1e-13:
            break
    return rotation, base
