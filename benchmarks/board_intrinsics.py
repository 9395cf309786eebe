"""Intrinsics of the same images from features and from a board's corners alone, by OpenCV; and from half of them."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.corners import Corners
from jcr.calibration.stage import calibrate
from jcr.camera import parameters
from jcr.errors import RejectedError
from jcr.records import HandEye, Intrinsics, Reconstruction
from jcr.results import RunResult

FEWEST_IMAGES = 4
FEWEST_CORNERS = 12
"""Of an image: fewer leave its pose to the noise."""
FLAGS = cv2.CALIB_FIX_K3
"""Both focal lengths, principal point, k1, k2, p1, p2, as a calibration frees them."""

GIVEN = (
    cv2.CALIB_USE_INTRINSIC_GUESS
    | cv2.CALIB_FIX_FOCAL_LENGTH
    | cv2.CALIB_FIX_PRINCIPAL_POINT
    | cv2.CALIB_FIX_TANGENT_DIST
    | cv2.CALIB_FIX_K1
    | cv2.CALIB_FIX_K2
    | cv2.CALIB_FIX_K3
)
"""Nothing is freed but poses."""
FEATURES, FLAT, SHAPE_FREE = "features", "board, flat", "board, shape free"
HALVES = "even images", "odd images"


@dataclass(frozen=True)
class Fit:
    """One calibration of a camera."""

    how: str
    images: int
    parameters: Float[ndarray, " p"]
    """fx, fy, cx, cy, k1, ..."""
    std: Float[ndarray, " p"] | None
    """None where they were given and not estimated."""
    rms_px: float | None = None
    """Of the corners, per axis."""
    rms_px_of_features: float | None = None
    """With the intrinsics of features; None where it was not asked."""


def intrinsics_of_features(result: RunResult) -> tuple[Fit, ...]:
    """Those of a calibration, and of calibrations from every other image of its reconstruction."""
    used = int(result.hand_eye.inliers.sum())
    fits = [_of_features(FEATURES, result.hand_eye, result.reconstruction.intrinsics, used)]
    if fits[0].std is None:
        return tuple(fits)
    for half, which in enumerate(HALVES):
        own = _half(result.reconstruction, half)
        try:
            found = calibrate(result.capture, own)
        except (RejectedError, np.linalg.LinAlgError):
            continue
        if found.estimate.intrinsics_std is not None:
            fits.append(_of_features(f"{FEATURES}, {which}", found, own.intrinsics, int(found.inliers.sum())))
    return tuple(fits)


def _of_features(how: str, hand_eye: HandEye, given: Intrinsics, images: int) -> Fit:
    return Fit(how, images, parameters(hand_eye.intrinsics or given), hand_eye.estimate.intrinsics_std)


def _half(found: Reconstruction, half: int) -> Reconstruction:
    """Every other image, and the points that two of these see."""
    rows, tracks = np.arange(half, len(found.image_index), 2), found.tracks
    own = np.isin(tracks.image, rows)
    own &= np.bincount(tracks.point[own], minlength=len(tracks.points_in_recon))[tracks.point] >= 2
    kept = tracks.only(own)
    points, point = np.unique(kept.point, return_inverse=True)
    return replace(
        found,
        image_index=found.image_index[rows],
        recon_from_camera=found.recon_from_camera[rows],
        tracks=replace(
            kept,
            image=np.searchsorted(rows, kept.image),
            point=point,
            points_in_recon=tracks.points_in_recon[points],
        ),
        evidence=None,
    )


def intrinsics_of_board(corners: Corners, of_features: Intrinsics) -> tuple[Fit, ...]:
    """From all images, flat and with the sheet's shape free, and from every other; none of too few corners."""
    counts = np.bincount(corners.image)
    if (counts >= FEWEST_CORNERS).sum() < FEWEST_IMAGES:
        return ()
    corners = corners.of(counts[corners.image] >= FEWEST_CORNERS)
    corners = replace(corners, image=np.unique(corners.image, return_inverse=True)[1])
    size = of_features.width, of_features.height
    kinds = [FLAT]
    if np.bincount(corners.image).min() == len(corners.x_in_board):
        kinds.append(SHAPE_FREE)
    fits = [_fit(kind, kind, corners, size, of_features) for kind in kinds]
    for kind in kinds:
        for half, which in enumerate(HALVES):
            own = corners.of(corners.image % 2 == half)
            if len(np.unique(own.image)) >= FEWEST_IMAGES:
                fits.append(_fit(f"{kind}, {which}", kind, own, size, None))
    return tuple(fits)


def _fit(how: str, kind: str, corners: Corners, size: tuple[int, int], of_features: Intrinsics | None) -> Fit:
    own = [corners.image == k for k in np.unique(corners.image)]
    points = [corners.x_in_board[corners.corner[one]].astype(np.float32) for one in own]
    pixels = [corners.x_px[one].astype(np.float32) for one in own]
    if kind == SHAPE_FREE:
        # Fixed are the first corner, the last one, and the last of the first row.
        fixed = int((points[0][:, 1] == points[0][0, 1]).sum()) - 1
        rms, matrix, distortion, _, _, shape, std, *_ = cv2.calibrateCameraROExtended(
            points, pixels, size, fixed, np.eye(3), np.zeros(5), flags=FLAGS
        )
        points = [shape.reshape(-1, 3)] * len(own)
    else:
        rms, matrix, distortion, _, _, std, *_ = cv2.calibrateCameraExtended(
            points, pixels, size, np.eye(3), np.zeros(5), flags=FLAGS
        )
    by_features = None
    if of_features is not None and of_features.model == "pinhole":
        given = of_features.matrix, np.array(of_features.distortion)
        by_features = cv2.calibrateCamera(points, pixels, size, *given, flags=GIVEN)[0]
    (fx, _, cx), (_, fy, cy) = matrix[0], matrix[1]
    values = np.array([fx, fy, cx, cy, *distortion.ravel()[:5]])
    per_axis = np.sqrt(0.5)
    return Fit(
        how,
        len(own),
        values,
        std.ravel()[: len(values)],
        float(rms * per_axis),
        None if by_features is None else float(by_features * per_axis),
    )
