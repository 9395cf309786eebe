"""Closed-form hand-eye calibration with unknown scale from all pairs of images, for many problems at once.

For every image `base_from_gripper · X = base_from_recon · S_λ(recon_from_camera)`. With `base_from_recon` free, the
sum of squared differences over n images equals the sum over all n(n-1)/2 pairs. No logarithm of a rotation is used, so
rotations by 180° need no special treatment.
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import (
    ARM,
    Rotations,
    Transform,
    inverse,
    nearest_rotation,
    rotation_exp,
    scale_translation,
    sine_axis,
    transform,
)

Poses = Float[ndarray, "*#batch n 4 4"]
ROTATION_ROUNDS = 5
"""Largest number of alternating refinements of the two rotations; a likelihood fit follows."""
ONE_AXIS = np.radians(6)
"""Largest rms deviation of the rotation axis (rad) for which rotations about one axis are solved for."""
RELATIVE_CUT = 1e-10
"""Relative singular value below which a direction counts as unobservable."""


def closed_form(
    base_from_gripper: Poses, recon_from_camera: Poses, rounds: int = ROTATION_ROUNDS
) -> tuple[Float[ndarray, "... 4 4"], Float[ndarray, "..."] | np.floating, Float[ndarray, "... 4 4"]]:
    """Return `gripper_from_camera` (...,4,4), scale (...) and `base_from_recon` (...,4,4) in closed form.

    Inputs (...,n,4,4) are n poses; scale is a length in base over that in recon. Rotations are solved first, with
    `rounds` of alternating refinement; then translations and scale by linear least squares (the paper's scale recovery
    problem, eq. 8 to 10). Degenerate motions give the translation of least norm, and a scale that may be 0 or negative.
    For rotations about one axis, positions determine the camera's rotation about it.
    """
    shape = np.broadcast_shapes(base_from_gripper.shape, recon_from_camera.shape)
    gripper, camera = np.broadcast_to(base_from_gripper, shape), np.broadcast_to(recon_from_camera, shape)
    found = _translations(gripper, camera, *rotations(gripper[..., :3, :3], camera[..., :3, :3], rounds))
    # Rotations about one axis leave the rotation of the camera about it to the positions.
    length = np.linalg.svd(gripper[..., :3, :3].mean(-3), compute_uv=False)[..., 0]
    about_one = np.asarray(np.sqrt(np.maximum(1 - length**2, 0.0)) < ONE_AXIS)
    if not about_one.any():
        return found
    own = gripper[about_one], camera[about_one]
    other = _translations(*own, *_about_one_axis(*own))
    x, scale, z = np.array(found[0]), np.array(found[1]), np.array(found[2])
    before = x[about_one], scale[about_one], z[about_one]
    better = _cost(other[0], np.asarray(other[1]), other[2], *own) < _cost(*before, *own)
    x[about_one], scale[about_one], z[about_one] = (
        np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
        for new, old in zip(other, before, strict=True)
    )
    return x, scale[()], z


def _about_one_axis(
    gripper: Float[ndarray, "k n 4 4"], camera: Float[ndarray, "k n 4 4"]
) -> tuple[Float[ndarray, "k 3 3"], Float[ndarray, "k 3 3"]]:
    """Return R_X and R_Z (`rotations`) of k problems whose grippers rotate about one axis each.

    Rotations alone determine R_X and R_Z up to a common rotation by φ about the axis. Positions are linear in λ cos φ,
    λ sin φ, λ for the part along the axis, and t_X, which gives φ.
    """
    of_gripper, of_camera = gripper[..., :3, :3], camera[..., :3, :3]
    turns = []
    for rotation in (of_gripper, of_camera):
        back = np.swapaxes(rotation, -1, -2)
        turns.append(np.concatenate([back[:, :1] @ rotation, back @ np.roll(rotation, -1, 1)], axis=1))
    axes = [sine_axis(one) for one in turns]
    u, _, vt = np.linalg.svd(np.einsum("kni,knj->kij", *axes))
    u[..., 2] *= np.linalg.det(u @ vt)[:, None]
    rotation, axis = u @ vt, u[..., 0]
    base = nearest_rotation((of_gripper @ rotation[:, None] @ np.swapaxes(of_camera, -1, -2)).sum(1))
    up = (of_gripper @ axis[:, None, :, None])[..., 0].mean(1)
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    in_base = camera[..., :3, 3] @ np.swapaxes(base, -1, -2)
    along = (in_base @ up[..., None]) * up[:, None]
    columns = in_base - along, np.cross(up[:, None], in_base - along), along
    rows = np.concatenate([of_gripper, -np.stack(columns, -1), -gripper[..., :3, 3:]], axis=-1)
    rows = (rows - rows.mean(1, keepdims=True)).reshape(len(rows), -1, 7)
    solution = np.linalg.pinv(rows[..., :6], rcond=RELATIVE_CUT) @ rows[..., 6:]
    angle = np.arctan2(solution[:, 4], solution[:, 3])
    return rotation_exp(angle * axis) @ rotation, rotation_exp(angle * up) @ base


def _cost(
    x: Float[ndarray, "k 4 4"],
    scale: Float[ndarray, " k"],
    z: Float[ndarray, "k 4 4"],
    gripper: Float[ndarray, "k n 4 4"],
    camera: Float[ndarray, "k n 4 4"],
) -> Float[ndarray, " k"]:
    """Return the sum of squared differences (m², angles times ARM) of both sides; infinite for a negative scale."""
    gap = gripper @ x[:, None] - z[:, None] @ scale_translation(camera, scale[:, None])
    squared = (gap[..., :3, 3] ** 2).sum((-1, -2)) + ARM**2 * (gap[..., :3, :3] ** 2).sum((-1, -2, -3)) / 2
    return np.where(scale > 0, squared, np.inf)


def _translations(
    base_from_gripper: Poses, recon_from_camera: Poses, rotation: Rotations, base_rotation: Rotations
) -> tuple[Float[ndarray, "... 4 4"], Float[ndarray, "..."] | np.floating, Float[ndarray, "... 4 4"]]:
    """Return the results of `closed_form` for known rotations of gripper_from_camera and base_from_recon."""
    # Least squares of R_G t_X + t_G = λ R_Z t_C + t_Z; the paper prints t_c^e for t_C in its d_i(λ).
    of_gripper = base_from_gripper[..., :3, :3]
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


def rotations(
    gripper: Float[ndarray, "*#batch n 3 3"],
    camera: Float[ndarray, "*#batch n 3 3"],
    rounds: int = ROTATION_ROUNDS,
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
