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
LEAST_SIGMA_PX = 0.3
"""Least standard deviation of a match, px; no detector is better over a whole image."""
LARGEST_SIGMA_PX = 3.0
"""Largest standard deviation, px, of the matches of an accepted motion."""


@dataclass(frozen=True)
class CameraMotion:
    """Possible relative motion of cameras i and j of an image pair: rotation, direction, covariance and noise."""

    rotation: Float[ndarray, "3 3"]
    """Rotation i_from_j."""
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

    The directions are in the frame of camera i. Both matrices map rays (x/z, y/z) of image i to image j. An essential
    matrix gives the one decomposition of four that has most points in front of both cameras. A homography gives those
    whose plane lies in front of camera i at nearly every match.
    """
    found = []
    if essential is not None:
        found.append(cv2.recoverPose(essential, ray_i, ray_j, np.eye(3), distanceThresh=1e6)[1:3])
    if homography is not None:
        count, rotations, translations, normals = cv2.decomposeHomographyMat(homography, np.eye(3))
        found += [
            (rotations[k], translations[k])
            for k in range(count)
            if np.mean(_homogeneous(ray_i) @ normals[k][:, 0] > 0) > 0.9
            and np.linalg.norm(translations[k]) > 1e-6
        ]
    return [(rotation.T, _unit(-rotation.T @ translation[:, 0])) for rotation, translation in found]


def _sampson_px(
    rotation: Float[ndarray, "3 3"],
    direction: Float[ndarray, "3"],
    ray_i: Float[ndarray, "m 2"],
    ray_j: Float[ndarray, "m 2"],
    focal_px: float,
) -> tuple[Float[ndarray, "m 1"], Float[ndarray, "m 1 5"]]:
    """Return the signed Sampson distance (px) of each match from a camera motion, and its derivatives by a step.

    `rotation` is i_from_j, and `direction` points from camera i to camera j in the frame of i. Rays are x/z, y/z; the
    distance in rays is multiplied by `focal_px`. Derivatives 0 to 2 are by a rotation vector w in axes of camera i,
    which changes the rotation R to exp(w) R. Derivatives 3 and 4 are by components of the direction along the two
    vectors of `_sideways`.
    """
    of_direction, h_i, h_j = skew(direction), _homogeneous(ray_i), _homogeneous(ray_j)
    essential = of_direction @ rotation  # x_i · E x_j = 0
    by_step = np.concatenate(
        [of_direction @ skew(np.eye(3)) @ rotation, skew(np.stack(_sideways(direction))) @ rotation]
    )
    line_i, line_j = h_j @ essential.T, h_i @ essential
    line_i_by, line_j_by = h_j @ np.swapaxes(by_step, 1, 2), h_i @ by_step
    # Norm of the gradient of x_i · E x_j by x and y of both rays.
    norm = np.maximum(np.sqrt((line_i[:, :2] ** 2).sum(1) + (line_j[:, :2] ** 2).sum(1)), 1e-12)
    distance = (h_i * line_i).sum(1) / norm
    norm_by = (line_i_by[..., :2] * line_i[:, :2] + line_j_by[..., :2] * line_j[:, :2]).sum(2) / norm
    by_motion = focal_px * (((h_i * line_i_by).sum(2) - distance * norm_by) / norm).T
    return focal_px * distance[:, None], by_motion[:, None]


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
    at, sigma, normal = (rotation, direction), LEAST_SIGMA_PX, np.eye(5)
    for _ in range(NOISE_ROUNDS):
        residual, _ = _sampson_px(*at, ray_i, ray_j, focal_px)
        sigma = max(1.48 * float(np.median(np.abs(residual))), LEAST_SIGMA_PX)
        scaled = focal_px / (2 * sigma)
        found = minimise(
            lambda at, scaled=scaled: _sampson_px(*at, ray_i, ray_j, scaled),
            at,
            lambda at, step: _retracted(*at, step),
            "cauchy",
            tolerance=ENOUGH,
        )
        at, normal = found.unknowns, found.normal
    # Errors of neighbouring matches are correlated: at most a hundred matches count as independent.
    independent = min(len(ray_i), 100) / len(ray_i)
    return CameraMotion(*at, np.linalg.inv(4 * independent * normal + 1e-6 / sigma**2 * np.eye(5)), sigma)


def _retracted(
    rotation: Float[ndarray, "3 3"], direction: Float[ndarray, "3"], step: Float[ndarray, "5"]
) -> tuple[Float[ndarray, "3 3"], Float[ndarray, "3"]]:
    one, other = _sideways(direction)
    return rotation_exp(step[:3]) @ rotation, _unit(direction + step[3] * one + step[4] * other)


def _sideways(direction: Float[ndarray, "3"]) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"]]:
    """Return two unit vectors that, together with the unit vector `direction`, are orthogonal to each other."""
    across_with = skew(direction)
    one = _unit(across_with[:, int(np.argmin(np.abs(direction)))])
    return one, across_with @ one


def _unit(v: Float[ndarray, "3"]) -> Float[ndarray, "3"]:
    return v / max(float(np.linalg.norm(v)), 1e-12)
