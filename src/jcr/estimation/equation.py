"""Hand-eye equation of an image: residuals of its reported gripper pose and their derivatives.

Each image gives `base_from_gripper · X = Z · S_λ(world_from_rig)`. The first 13 unknowns are steps of
geometry.retract: of X (6), of the logarithm of the scale λ, of Z (6). Each further arm adds the 12 steps of its X and
Z; other unknowns of the problem follow.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.geometry import (
    Poses,
    Transform,
    Transforms,
    by_inverse,
    inverse,
    scale_translation,
    skew,
    step_between,
)

TRANSLATION, ROTATION, SCALE = slice(0, 3), slice(3, 6), slice(6, 7)
BASE_TRANSLATION, BASE_ROTATION = slice(7, 10), slice(10, 13)
"""Columns of the 13 unknowns; the first seven are records.COVARIANCE_ORDER."""
UNKNOWNS = 13

PRIOR_STD = np.array([1.0] * 3 + [np.pi] * 3 + [5.0])
"""Standard deviations (m, rad, log scale) of a prior that only keeps unobservable directions finite."""
LARGEST_ROTATION = 0.5
"""Largest step of a rotation (rad) and of the logarithm of scale: a poor initial estimate of nearly unobservable
motions must not rotate beyond a half turn."""
ASSUMED_NOISE = (5e-4, np.radians(0.1))
"""Assumed noise (m, rad) of a robot that has not been measured."""


def predict(
    x: Transforms,
    scale: Float[ndarray, "*batch"] | np.floating | float,
    z: Transforms,
    recon_from_camera: Poses,
) -> Float[ndarray, "*batch n 4 4"]:
    """Return gripper poses (...,n,4,4): base_from_recon · S_λ(recon_from_camera) · X⁻¹, for one or many (X, λ, Z)."""
    scaled = scale_translation(recon_from_camera, np.asarray(scale)[..., None])
    return z[..., None, :, :] @ scaled @ inverse(x)[..., None, :, :]


def residuals(
    x: Transform,
    scale: float,
    z: Transform,
    base_from_gripper: Poses,
    recon_from_camera: Poses,
    exchanged: bool = False,
) -> tuple[Float[ndarray, "n 6"], Float[ndarray, "n 6 13"]]:
    """Return steps from the reported gripper poses to the predicted ones (base axes), and their Jacobian.

    `exchanged`: the camera is fixed and the gripper carries the scene. X is then base_from_camera, Z
    gripper_from_recon, and they predict gripper_from_base; the residuals are still those of base_from_gripper.
    """
    predicted = predict(x, scale, z, recon_from_camera)
    rotation = predicted[:, :3, :3]
    arm = scale * recon_from_camera[:, :3, 3] @ z[:3, :3].T
    j = np.zeros((len(predicted), 6, UNKNOWNS))
    j[:, :3, TRANSLATION] = -rotation
    j[:, :3, ROTATION] = -rotation @ skew(x[:3, 3])
    j[:, :3, 6] = arm
    j[:, :3, BASE_TRANSLATION] = np.eye(3)
    j[:, :3, BASE_ROTATION] = -skew(arm - rotation @ x[:3, 3])
    j[:, 3:, ROTATION] = -rotation
    j[:, 3:, BASE_ROTATION] = np.eye(3)
    if exchanged:
        return step_between(base_from_gripper, inverse(predicted)), by_inverse(predicted) @ j
    return step_between(base_from_gripper, predicted), j


def residuals_by_camera(
    x: Transform, scale: float, z: Transform, recon_from_camera: Poses, exchanged: bool = False
) -> Float[ndarray, "n 6 6"]:
    """Return the derivative of `residuals` by a step of each camera."""
    base_from_recon = z[:3, :3]
    lever = recon_from_camera[:, :3, :3] @ x[:3, :3].T @ x[:3, 3]
    j = np.zeros((len(lever), 6, 6))
    j[:, :3, :3] = scale * base_from_recon
    j[:, :3, 3:] = base_from_recon @ skew(lever)
    j[:, 3:, 3:] = base_from_recon
    return by_inverse(predict(x, scale, z, recon_from_camera)) @ j if exchanged else j


def pose_by_pose(blocks: Float[ndarray, "n 6 6"], matrix: Float[ndarray, "r c"]) -> Float[ndarray, "r c"]:
    """Return the product of a block-diagonal matrix, one block a pose, and a matrix of r = 6n rows."""
    return (blocks @ matrix.reshape(len(blocks), 6, -1)).reshape(matrix.shape)


def columns_of_arm(arm: int) -> Int[ndarray, "12"]:
    """Return the columns of X and Z of an arm among the unknowns."""
    first = 12 * arm
    return np.r_[:6, 7:13] if arm == 0 else np.arange(first + 1, first + 13)


def weak_prior(arms: int = 1) -> Float[ndarray, "u u"]:
    """Return the information that keeps unobservable directions of the unknowns of some arms finite."""
    std = np.full(12 * arms + 1, np.inf)
    for arm in range(arms):
        std[columns_of_arm(arm)[:6]] = PRIOR_STD[:6]
    std[SCALE] = PRIOR_STD[SCALE]
    return np.diag(std**-2.0)


def share_within_limits(step: Float[ndarray, " u"]) -> float:
    """Return the share of a step of the arms' unknowns that keeps all rotations within LARGEST_ROTATION."""
    arms = range((len(step) - 1) // 12)
    rotations = np.r_[SCALE, *(columns_of_arm(arm)[[3, 4, 5, 9, 10, 11]] for arm in arms)]
    return min(1.0, LARGEST_ROTATION / max(float(np.abs(step[rotations]).max()), 1e-300))


def expected_covariance(hessian: Float[ndarray, "*batch 13 13"]) -> Float[ndarray, "*batch 7 7"]:
    """Return the covariance of X and scale that information and the weak prior leave, in COVARIANCE_ORDER."""
    return np.linalg.inv(hessian + weak_prior())[..., :7, :7]


def paper_residuals(
    base_from_gripper: Float[ndarray, "n 4 4"],
    recon_from_camera: Float[ndarray, "n 4 4"],
    gripper_from_camera: Transform,
    scale: float,
    used: Bool[ndarray, " n"],
) -> tuple[float, float]:
    """Return the mean δ_t (m) and δ_R (Frobenius norm) of A·X − X·B(λ) over consecutive used images (paper, eq. 16)."""
    a, b = (inverse(of[used][:-1]) @ of[used][1:] for of in (base_from_gripper, recon_from_camera))
    gap = a @ gripper_from_camera - gripper_from_camera @ scale_translation(b, scale)
    translation = np.linalg.norm(gap[:, :3, 3], axis=1).mean()
    return float(translation), float(np.linalg.norm(gap[:, :3, :3], axis=(1, 2)).mean())
