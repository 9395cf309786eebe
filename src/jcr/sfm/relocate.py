"""Where new images of a reconstructed scene were taken from: features matched to older images of known pose.

A feature that a new image shares with two or more older ones is triangulated from those; the new camera follows
from the points (perspective-n-point), with its covariance. Any back end's camera poses will do.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray

from jcr.camera import NORMALIZED, by_point, project, resized, unproject
from jcr.features.sift import detect, grey_of, matches
from jcr.geometry import across_lines, inverse, retract, rotation_exp, skew, transform
from jcr.least_squares import minimise
from jcr.records import Intrinsics, Reconstruction

WORKING_SIZE_PX = 1600
GATE_PX = 3.0
"""Reprojection error beyond which an observation is a mismatch."""
MIN_PARALLAX = np.radians(1.5)
MIN_POINTS = 30
"""Fewer agree by chance on repeated patterns."""
LOSS_SCALE = 2.0
"""Cauchy loss, in sigma."""
MEASUREMENTS = 10
"""How often the image's noise is estimated, at most."""


@dataclass(frozen=True)
class Features:
    """What is found in one image."""

    x_px: Float[ndarray, "k 2"]
    """Pixels of the original image, distorted."""
    rays: Float[ndarray, "k 2"]
    """(x/z, y/z), undistorted."""
    descriptors: Float32[ndarray, "k 128"]
    """Descriptors of unit length."""


@dataclass(frozen=True)
class Located:
    """A new image's camera in the frame of the reconstruction."""

    recon_from_camera: Float[ndarray, "4 4"]
    covariance: Float[ndarray, "6 6"]
    """Covariance of a step of the camera (geometry.retract; recon units, rad)."""
    points: int
    sigma_px: float
    """Noise of its image coordinates."""


def relocate(
    reconstruction: Reconstruction,
    older: Sequence[UInt8[ndarray, "h w 3"]],
    new: Sequence[UInt8[ndarray, "h w 3"]],
) -> list[Located | int]:
    """The camera of each new image; where it shares too little with the older ones, how many points it shares.

    `older` are the images of the reconstruction's rows, in their order; all are of one camera.
    """
    intrinsics = reconstruction.intrinsics
    known = [features(image, intrinsics) for image in older]
    return [
        _located(features(image, intrinsics), known, reconstruction.recon_from_camera, intrinsics.fx)
        for image in new
    ]


def features(image: UInt8[ndarray, "h w 3"], intrinsics: Intrinsics) -> Features:
    """SIFT of an image of these intrinsics, reduced to WORKING_SIZE_PX."""
    scale = min(1.0, WORKING_SIZE_PX / max(intrinsics.width, intrinsics.height))
    size = round(intrinsics.width * scale), round(intrinsics.height * scale)
    found, descriptors = detect(grey_of(image, size))
    to_original = np.array([intrinsics.width / size[0], intrinsics.height / size[1]])
    return Features(
        (found + 0.5) * to_original - 0.5, unproject(resized(intrinsics, *size), found)[:, :2], descriptors
    )


def _located(
    new: Features, known: list[Features], recon_from_camera: Float[ndarray, "m 4 4"], focal_px: float
) -> Located | int:
    rays = new.rays
    gate = GATE_PX / focal_px
    of_row = [matches(new.descriptors, others.descriptors) for others in known]
    feature = np.concatenate([mine for mine, _ in of_row])
    row = np.repeat(np.arange(len(known)), [len(mine) for mine, _ in of_row])
    seen = np.concatenate([known[k].rays[theirs] for k, (_, theirs) in enumerate(of_row)])
    x_in_recon, spread, good = triangulated(feature, row, seen, recon_from_camera, gate, len(rays))
    if good.sum() < MIN_POINTS:
        return int(good.sum())
    points, spread, rays = x_in_recon[good], spread[good], rays[good]
    found, rotation, shift, inliers = cv2.solvePnPRansac(
        points, focal_px * rays, np.diag([focal_px, focal_px, 1.0]), None,
        iterationsCount=2000, reprojectionError=GATE_PX, confidence=0.9999, flags=cv2.SOLVEPNP_SQPNP,
    )  # fmt: skip
    if not found or inliers is None or len(inliers) < MIN_POINTS:
        return 0 if inliers is None else len(inliers)
    start = inverse(transform(rotation_exp(rotation[:, 0]), shift[:, 0]))
    agree = np.asarray(inliers, int)[:, 0]
    return _least_squares_pose(points[agree], spread[agree], rays[agree], start, focal_px)


def triangulated(
    feature: Int[ndarray, " c"],
    row: Int[ndarray, " c"],
    seen: Float[ndarray, "c 2"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    gate: float,
    n: int,
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3 3"], Bool[ndarray, " n"]]:
    """The point nearest to the rays of each feature, its covariance for rays of 1 rad noise, and whether two agree."""
    rotation, center = recon_from_camera[row, :3, :3], recon_from_camera[row, :3, 3]
    direction = np.einsum("cij,cj->ci", rotation, np.c_[seen, np.ones(len(seen))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = across_lines(direction)
    point, kept, weight = np.zeros((n, 3)), np.ones(len(row), bool), np.ones(len(row))
    normal = np.zeros((n, 3, 3))
    for _ in range(3):  # later without those that missed, and by how far each camera was
        normal, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
        weighted = weight[kept, None, None] * across[kept]
        np.add.at(normal, feature[kept], weighted)
        np.add.at(right, feature[kept], np.einsum("cij,cj->ci", weighted, center[kept]))
        # With one ray, or parallel ones, the depth is open; the small term keeps it finite.
        normal += 1e-9 * np.eye(3)
        point = np.linalg.solve(normal, right[..., None])[..., 0]
        in_camera = np.einsum("cji,cj->ci", rotation, point[feature] - center)
        ahead = in_camera[:, 2] > 1e-6
        miss = project(NORMALIZED, np.where(ahead[:, None], in_camera, [0.0, 0.0, 1.0])) - seen
        kept = ahead & (np.linalg.norm(miss, axis=1) < gate)
        squared = (in_camera**2).sum(1)
        weight = 1 / np.maximum(squared, 1e-2 * np.median(squared)) if len(squared) else weight
    count = np.bincount(feature[kept], minlength=n)
    mean = np.zeros((n, 3))
    np.add.at(mean, feature[kept], direction[kept])
    # The mean of unit vectors is shorter than one by half their mean squared angle from it.
    angle = np.sqrt(np.maximum(2 - 2 * np.linalg.norm(mean, axis=1) / np.maximum(count, 1), 0.0))
    return point, np.linalg.inv(normal), (count >= 2) & (2 * angle > MIN_PARALLAX)


def _least_squares_pose(
    points: Float[ndarray, "k 3"],
    spread: Float[ndarray, "k 3 3"],
    rays: Float[ndarray, "k 2"],
    recon_from_camera: Float[ndarray, "4 4"],
    focal_px: float,
) -> Located:
    """The least reprojection error under a Cauchy loss, and the covariance that it leaves.

    A point is as uncertain as the old rays that met in it; one that few saw counts for little. That, and the noise of
    the image, are measured where the camera is, and again where it then comes to be.
    """
    sigma, normal = 1.0 / focal_px, np.eye(6)
    for _ in range(MEASUREMENTS):
        residual, jacobian = _reprojection(points, rays, recon_from_camera)
        rotated = -jacobian[:, :, :3]
        whitening = np.linalg.inv(
            np.linalg.cholesky(np.eye(2) + rotated @ spread @ np.swapaxes(rotated, 1, 2))
        )
        squared = ((whitening @ residual[..., None]) ** 2).sum((1, 2))
        before, sigma = sigma, max(float(np.sqrt(np.median(squared))) / 1.1774, 0.05 / focal_px)
        whitening /= LOSS_SCALE * sigma

        def whitened(pose: Float[ndarray, "4 4"], whitening: ndarray = whitening) -> tuple[ndarray, ndarray]:
            residual, jacobian = _reprojection(points, rays, pose)
            return (whitening @ residual[..., None])[..., 0], whitening @ jacobian

        found = minimise(whitened, recon_from_camera, retract, "cauchy")
        recon_from_camera, normal = found.unknowns, LOSS_SCALE**2 * found.normal
        if abs(sigma - before) < 1e-6 * sigma:
            break
    return Located(recon_from_camera, np.linalg.inv(normal), len(points), sigma * focal_px)


def _reprojection(
    points: Float[ndarray, "k 3"], rays: Float[ndarray, "k 2"], recon_from_camera: Float[ndarray, "4 4"]
) -> tuple[Float[ndarray, "k 2"], Float[ndarray, "k 2 6"]]:
    """By how much the camera misses the rays, and the derivative by its step."""
    rotation, arm = recon_from_camera[:3, :3], points - recon_from_camera[:3, 3]
    x = arm @ rotation
    rotated = by_point(NORMALIZED, x) @ rotation.T
    return project(NORMALIZED, x) - rays, np.concatenate([-rotated, rotated @ skew(arm)], axis=2)
