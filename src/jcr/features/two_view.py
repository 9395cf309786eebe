"""Relative motions of two cameras from matched directions, with covariance.

A homography has two solutions (Malis and Vargas, INRIA RR-6303, 2007). Each motion is refined on the Sampson error
(Hartley and Zisserman, section 11.4.3), whose curvature gives the covariance.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import rotation_exp, skew
from jcr.least_squares import minimise

NOISE_ROUNDS, ENOUGH = 2, 1e-4
"""Number of estimates of the noise, and relative change of the cost that ends the optimisation after each."""
ABOUT_AXES = skew(np.eye(3))
"""Derivatives of a rotation matrix by angles about the three axes, at the identity."""
LEAST_SIGMA_PX = 0.3
"""Least standard deviation of a match, px; no detector is better over a whole image."""
LARGEST_SIGMA_PX = 3.0
"""Largest standard deviation, px, of the matches of an accepted motion."""


@dataclass(frozen=True)
class CameraMotion:
    """Possible relative motion of cameras i and j of an image pair: rotation, direction, covariance and noise."""

    rotation: Float[ndarray, "3 3"]
    direction: Float[ndarray, "3"]
    """Unit vector from camera i to camera j, in the frame of camera i."""
    covariance: Float[ndarray, "5 5"]
    """Covariance (rad²) of the rotation vector in axes of camera i and of two components across the direction."""
    sigma_px: float
    """Robust standard deviation of the matches' Sampson distances, px."""

    def angle_std(self) -> float:
        """Return the standard deviation, rad, of the angle by which the motion rotates.

        Without a rotation, and so without an axis, it is the root of the mean variance over the three axes.
        """
        covariance = self.covariance[:3, :3]
        if np.trace(self.rotation) > 2.999999:  # without rotation the axis is undefined
            return float(np.sqrt(np.trace(covariance) / 3))
        values, vectors = np.linalg.eigh(self.rotation + self.rotation.T)
        axis = vectors[:, int(np.argmax(values))]
        return float(np.sqrt(max(axis @ covariance @ axis, 0.0)))


def camera_motions(
    ray_i: Float[ndarray, "m 2"],
    ray_j: Float[ndarray, "m 2"],
    focal_px: float,
    j_from_i_essential: Float[ndarray, "3 3"] | None,
    j_from_i_homography: Float[ndarray, "3 3"] | None,
) -> list[CameraMotion]:
    """Return the motions that may explain matched rays (x/z, y/z) of cameras i and j, best first; empty without one.

    The best motion has the smallest Sampson distances. The matrices map rays of image i to image j; a matrix is None if
    it was not found. `focal_px` converts residuals to px.
    """
    found: list[CameraMotion] = []
    for start in starting_motions(ray_i, ray_j, j_from_i_essential, j_from_i_homography):
        one = _least_squares_motion(*start, ray_i, ray_j, focal_px)
        if one is None or one.sigma_px > LARGEST_SIGMA_PX:
            continue
        if all(np.linalg.norm(other.rotation - one.rotation) > 0.02 for other in found):
            found.append(one)
    return sorted(found, key=lambda one: one.sigma_px)


def starting_motions(
    ray_i: Float[ndarray, "m 2"],
    ray_j: Float[ndarray, "m 2"],
    essential: Float[ndarray, "3 3"] | None,
    homography: Float[ndarray, "3 3"] | None,
) -> list[tuple[Float[ndarray, "3 3"], Float[ndarray, "3"]]]:
    """Return rotations i_from_j and unit directions from camera i to j that an essential matrix or a homography allows.

    An essential matrix gives the one decomposition of four that has most points in front of both cameras. A homography
    gives those whose plane lies in front of camera i at nearly every match.
    """
    found = []
    if essential is not None:
        found.append(cv2.recoverPose(essential, ray_i, ray_j, np.eye(3), distanceThresh=1e6)[1:3])
    if homography is not None:
        _, rotations, translations, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
        for r, translation, normal in zip(rotations, translations, normals, strict=True):
            is_ahead = np.mean(_homogeneous(ray_i) @ normal[:, 0] > 0) > 0.9
            found += [(r, translation)] if is_ahead and np.linalg.norm(translation) > 1e-6 else []
    return [(r.T, -r.T @ translation[:, 0] / np.linalg.norm(translation)) for r, translation in found]


def _sampson_px(
    rotation: Float[ndarray, "3 3"],
    across: Float[ndarray, "3 3"],
    x_i: Float[ndarray, "m 3"],
    x_j: Float[ndarray, "m 3"],
    focal_px: float,
) -> tuple[Float[ndarray, "m 1"], Float[ndarray, "m 1 5"]]:
    """Return the signed Sampson distance (px) of each match from a camera motion, and its derivatives by a step.

    `rotation` is i_from_j. The first column of the rotation matrix `across` is the direction from camera i to camera j
    in the frame of i. `x_i` and `x_j` are homogeneous rays; the distance in rays is multiplied by `focal_px`. The step
    is that of `_retracted`.
    """
    direction, one, other = across.T
    of_direction = skew(direction)
    # The essential matrix, x_i · E x_j = 0, and its five derivatives.
    by_rotation, by_direction = of_direction @ ABOUT_AXES @ rotation, skew(np.stack([-other, one])) @ rotation
    every = np.concatenate([(of_direction @ rotation)[None], by_rotation, by_direction])
    # Lines E x_j, and the first two components of Eᵀ x_i.
    of_j = (every.reshape(18, 3) @ x_j.T).reshape(6, 3, -1)
    of_i = (np.swapaxes(every[:, :, :2], 1, 2).reshape(12, 3) @ x_i.T).reshape(6, 2, -1)
    value = (of_j * x_i.T).sum(1)
    # Norm of the gradient of x_i · E x_j by x and y of both rays, and its derivatives times the norm.
    by_norm = (of_j[:, :2] * of_j[0, :2]).sum(1) + (of_i * of_i[0]).sum(1)
    norm = np.maximum(np.sqrt(by_norm[0]), 1e-12)
    distance = value[0] / norm
    by_step = (value[1:] - distance / norm * by_norm[1:]) / norm
    return focal_px * distance[:, None], focal_px * by_step.T[:, None]


def _homogeneous(ray: Float[ndarray, "m 2"]) -> Float[ndarray, "m 3"]:
    return np.concatenate([ray, np.ones((len(ray), 1))], 1)


def _least_squares_motion(
    rotation: Float[ndarray, "3 3"],
    direction: Float[ndarray, "3"],
    ray_i: Float[ndarray, "m 2"],
    ray_j: Float[ndarray, "m 2"],
    focal_px: float,
) -> CameraMotion | None:
    """Return a camera motion refined to least Sampson distances, with covariance; None for fewer than eight matches.

    The initial `rotation` (i_from_j) and `direction` (i to j, in the frame of i) have five parameters. The loss is
    Cauchy, whose scale is estimated alternately. Rays are x/z, y/z; `focal_px` converts distances to px.
    """
    if len(ray_i) < 8:
        return None
    one = skew(direction)[:, int(np.argmin(np.abs(direction)))]
    one = one / np.linalg.norm(one)
    across = np.stack([direction, one, skew(direction) @ one], axis=1)
    x_i, x_j = _homogeneous(ray_i), _homogeneous(ray_j)
    sigma, normal = LEAST_SIGMA_PX, np.eye(5)
    for _ in range(NOISE_ROUNDS):
        residual, _ = _sampson_px(rotation, across, x_i, x_j, focal_px)
        sigma = max(1.48 * float(np.median(np.abs(residual))), LEAST_SIGMA_PX)
        scaled = focal_px / (2 * sigma)
        found = minimise(
            lambda at, scaled=scaled: _sampson_px(*at, x_i, x_j, scaled),
            (rotation, across),
            lambda at, step: _retracted(*at, step),
            "cauchy",
            tolerance=ENOUGH,
        )
        (rotation, across), normal = found.unknowns, found.normal
    # Errors of neighbouring matches are correlated: at most a hundred matches count as independent.
    independent = min(len(ray_i), 100) / len(ray_i)
    covariance = np.linalg.inv(4 * independent * normal + 1e-6 / sigma**2 * np.eye(5))
    return CameraMotion(rotation, across[:, 0], covariance, sigma)


def _retracted(
    rotation: Float[ndarray, "3 3"], across: Float[ndarray, "3 3"], step: Float[ndarray, "5"]
) -> tuple[Float[ndarray, "3 3"], Float[ndarray, "3 3"]]:
    """Return `rotation` and `across` of `_sampson_px` after a step of five angles (rad).

    The first three are a rotation vector in axes of camera i. The last two turn the direction about the second and the
    third column of `across`.
    """
    first, second = rotation_exp(np.array([step[:3], [0.0, step[3], step[4]]]))
    return first @ rotation, across @ second
