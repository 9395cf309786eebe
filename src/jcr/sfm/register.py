"""Registration of new images in a reconstruction: features are triangulated, then each camera's pose is computed."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8
from numpy import ndarray

from jcr.camera import NORMALIZED, project, resized, unproject
from jcr.estimation.absolute_pose import CameraPose, absolute_pose
from jcr.features.sift import WORKING_SIZE_PX, detect, grey_of, matches
from jcr.geometry import across_lines
from jcr.records import Intrinsics, Reconstruction

POSE_GATE_PX = 3.0
"""Reprojection error, px, above which an observation is a mismatch."""
MIN_PARALLAX = np.radians(1.5)
"""Least angle, rad, between the rays of a point."""
POSE_POINTS = 30
"""Least number of points that must agree on a pose; fewer can agree by chance on repeated patterns."""


@dataclass(frozen=True)
class ImageFeatures:
    """SIFT features of one image."""

    x_px: Float[ndarray, "k 2"]
    """Keypoints in the original image, distorted, px."""
    rays: Float[ndarray, "k 2"]
    """Undistorted directions x/z, y/z of the keypoints."""
    descriptors: Float32[ndarray, "k 128"]


@dataclass(frozen=True)
class KnownImages:
    """Images of one camera whose poses and intrinsics are known, and their SIFT features."""

    camera: Intrinsics
    recon_from_camera: Float[ndarray, "m 4 4"]
    features: tuple[ImageFeatures, ...]


@dataclass(frozen=True, kw_only=True)
class Registration:
    """Result of the registration of a new image: its pose, and the points that it shares with images of known poses."""

    pose: CameraPose
    points_in_recon: Float[ndarray, "p 3"]
    x_px: Float[ndarray, "p 2"]
    """Keypoints of the new image, one per point, px."""
    row: Int[ndarray, " k"]
    """Known image (row) of each further observation of these points."""
    row_x_px: Float[ndarray, "k 2"]
    row_point: Int[ndarray, " k"]
    point: Int[ndarray, " p"] | None = None
    """Row of each point among the points of the reconstruction, for corners of a board; None: the points are new."""


def register(
    reconstruction: Reconstruction,
    older: Sequence[UInt8[ndarray, "h w 3"]],
    new: Sequence[UInt8[ndarray, "h w 3"]],
) -> list[CameraPose | int]:
    """Return for each new image its camera pose in the recon frame; if it fails, the number of points that agree.

    It fails with fewer than POSE_POINTS. `older` are the images of the reconstruction's rows. All are of one camera.
    """
    camera = reconstruction.intrinsics
    older_features = tuple(features(image, camera) for image in older)
    known = KnownImages(camera, reconstruction.recon_from_camera, older_features)
    found = [registrations(known, image, camera)[0] for image in new]
    return [one.pose if one else count for one, count in found]


def features(image: UInt8[ndarray, "h w 3"], intrinsics: Intrinsics) -> ImageFeatures:
    """Return an image's SIFT features, in its own pixels; an image larger than WORKING_SIZE_PX is reduced first."""
    scale = min(1.0, WORKING_SIZE_PX / max(intrinsics.width, intrinsics.height))
    size = round(intrinsics.width * scale), round(intrinsics.height * scale)
    found, descriptors = detect(grey_of(image, size))
    to_original = np.array([intrinsics.width / size[0], intrinsics.height / size[1]])
    return ImageFeatures(
        (found + 0.5) * to_original - 0.5, unproject(resized(intrinsics, *size), found)[:, :2], descriptors
    )


def registrations(
    known: KnownImages,
    image: UInt8[ndarray, "h w 3"],
    camera: Intrinsics,
    focals: Sequence[Literal["given", "free"]] = ("given",),
    gate_px: float = POSE_GATE_PX,
) -> list[tuple[Registration | None, int]]:
    """Return for each of `focals` a new image's registration and the number of points that agree on its pose.

    The registration is None if fewer than POSE_POINTS agree. Matches of the image with the known images are triangulated
    from the known images; the pose is the one on which most points agree. The focal length of the new image's
    intrinsics (`camera`) is held (`given`) or estimated (`free`). `gate_px` is the largest error (px) of a point.
    """
    new = features(image, camera)
    of_row = [matches(new.descriptors, others.descriptors) for others in known.features]
    feature = np.concatenate([mine for mine, _ in of_row])
    row = np.repeat(np.arange(len(of_row)), [len(mine) for mine, _ in of_row])
    theirs = list(zip(known.features, (rows for _, rows in of_row), strict=True))
    rays, row_x_px = (np.concatenate([getattr(k, of)[own] for k, own in theirs]) for of in ("rays", "x_px"))
    points, spread, good = triangulated_features(
        feature, row, rays, known.recon_from_camera, POSE_GATE_PX / known.camera.fx, len(new.rays)
    )
    seen = good[feature]
    point, row, row_x_px = (np.cumsum(good) - 1)[feature[seen]], row[seen], row_x_px[seen]
    points, spread, x_px = points[good], spread[good], new.x_px[good]
    # Observations in known images are kept if they are near the projections of their points.
    rotation, centre = known.recon_from_camera[row, :3, :3], known.recon_from_camera[row, :3, 3]
    in_camera = np.einsum("cji,cj->ci", rotation, points[point] - centre)
    near = in_camera[:, 2] > 1e-6
    projected = project(known.camera, np.where(near[:, None], in_camera, [0.0, 0.0, 1.0]))
    near &= np.linalg.norm(projected - row_x_px, axis=1) < POSE_GATE_PX
    found = list[tuple[Registration | None, int]]()
    for focal in focals:
        std_px, pose, count = 1.0, None, len(points)
        for _ in range(2):  # the noise estimated in the new image is used for the known images
            if count < POSE_POINTS:
                break
            covariance = (std_px / known.camera.fx) ** 2 * spread
            pose = absolute_pose(x_px, points, camera, covariance, gate_px, focal)
            std_px, count = (0.0, 0) if pose is None else (pose.std_px, int(pose.inlier.sum()))
        if pose is None or count < POSE_POINTS:
            found.append((None, count))
            continue
        kept = near & pose.inlier[point]
        inliers = {
            "points_in_recon": points[pose.inlier],
            "x_px": x_px[pose.inlier],
            "row": row[kept],
            "row_x_px": row_x_px[kept],
            "row_point": (np.cumsum(pose.inlier) - 1)[point[kept]],
        }
        found.append((Registration(pose=pose, **inliers), count))
    return found


def triangulated_features(
    feature: Int[ndarray, " c"],
    row: Int[ndarray, " c"],
    seen: Float[ndarray, "c 2"],
    recon_from_camera: Float[ndarray, "m 4 4"],
    gate: float,
    n: int,
) -> tuple[Float[ndarray, "n 3"], Float[ndarray, "n 3 3"], Bool[ndarray, " n"]]:
    """Return each of `n` features' point, its covariance per rad² of ray variance, and whether two rays agree on it.

    Observation c is the ray `seen[c]` (x/z, y/z) of image `row[c]` to the feature `feature[c]`. Points and covariances
    are in the recon frame and unit. Rays that miss their point by more than `gate`, in x/z and y/z, are mismatches. Two
    rays agree only if the angle between them is above MIN_PARALLAX.
    """
    rotation, center = recon_from_camera[row, :3, :3], recon_from_camera[row, :3, 3]
    direction = np.einsum("cij,cj->ci", rotation, np.c_[seen, np.ones(len(seen))])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    across = across_lines(direction)
    point, kept, weight = np.zeros((n, 3)), np.ones(len(row), bool), np.ones(len(row))
    normal = np.zeros((n, 3, 3))
    for _ in range(3):  # later rounds exclude mismatches and weight by the distances of the cameras
        normal, right = np.zeros((n, 3, 3)), np.zeros((n, 3))
        weighted = weight[kept, None, None] * across[kept]
        np.add.at(normal, feature[kept], weighted)
        np.add.at(right, feature[kept], np.einsum("cij,cj->ci", weighted, center[kept]))
        # With one ray or parallel rays the depth is undetermined; the small term keeps it finite.
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
