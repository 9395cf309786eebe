"""Scale and noise of the images of a depth camera, compared with the robot at the features."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.calibration.record import Calibration
from jcr.capture.images import read_depth_images
from jcr.geometry import apply, inverse
from jcr.records import Capture, DepthCheck, Reconstruction

MIN_IMAGES, MIN_FEATURES = 3, 60
"""Fewest images and features at which depth is compared."""
OUTSIDE = 0.3
"""Relative difference from the common one beyond which a depth is that of another surface."""
BINS = 8
"""Bins of distance in which the noise of depth is measured."""
NORMAL = 1.4826
"""Standard deviations of a normal error in its median absolute deviation."""


def depth_check(capture: Capture, reconstruction: Reconstruction, hand_eye: Calibration) -> DepthCheck | None:
    """Return scale and noise of the depth images by the robot; None where too few features have a depth.

    Raises InputError where a depth image cannot be read.
    """
    if capture.depths is None:
        return None
    measured, predicted, image = _pairs(capture, reconstruction, hand_eye.scale, capture.depths)
    off = np.log(measured / predicted)
    rows, count = np.unique(image, return_counts=True)
    rows = rows[count >= MIN_FEATURES // 6]
    if len(rows) < MIN_IMAGES or len(off) < MIN_FEATURES:
        return None
    # An image's features share what its pose is off by, so images are counted and not features.
    medians = np.array([np.median(off[image == row]) for row in rows])
    common = float(np.median(medians))
    spread = NORMAL * float(np.median(np.abs(medians - common)))
    std = np.hypot(1.2533 * spread / np.sqrt(len(rows)), np.sqrt(hand_eye.covariance[6, 6]))
    same = np.abs(off - common) < OUTSIDE
    depth = predicted[same]
    noise_m, noise_per_m = _noise(depth, measured[same] / np.exp(common) - depth)
    near, far = np.percentile(depth, [5, 95])
    return DepthCheck(
        off_percent=100 * float(np.expm1(common)),
        std_percent=100 * float(std),
        noise_m=noise_m,
        noise_per_m=noise_per_m,
        distances_m=(float(near), float(far)),
        images=len(rows),
        features=int(same.sum()),
    )


def _pairs(
    capture: Capture, reconstruction: Reconstruction, scale: float, depths: tuple[str | None, ...]
) -> tuple[Float[ndarray, " k"], Float[ndarray, " k"], Int[ndarray, " k"]]:
    """Return measured depths (m), depths by the robot, and images of all features that have both."""
    tracks = reconstruction.tracks
    parts = []
    for k, row in enumerate(reconstruction.image_index):
        if row >= len(depths) or (name := depths[row]) is None:
            continue
        depth = read_depth_images(capture.folder / name, capture.image_size)
        seen = np.flatnonzero(tracks.image == k)
        u, v = np.rint(tracks.x_px[seen]).astype(int).T
        inside = (u >= 1) & (v >= 1) & (u < depth.shape[1] - 1) & (v < depth.shape[0] - 1)
        seen, u, v = seen[inside], u[inside], v[inside]
        around = np.stack([depth[v + dv, u + du] for dv in (-1, 0, 1) for du in (-1, 0, 1)])
        camera_from_recon = inverse(reconstruction.recon_from_camera[k])
        x_in_camera = apply(camera_from_recon, tracks.points_in_recon[tracks.point[seen]])
        # At the edge of a thing, colour and depth are of different ones.
        whole = (around > 0).all(0) & (np.ptp(around, axis=0) < 0.03 * around[4]) & (x_in_camera[:, 2] > 0)
        parts.append((around[4][whole].astype(float), scale * x_in_camera[whole, 2], np.full(whole.sum(), k)))
    if not parts:
        return np.zeros(0), np.zeros(0), np.zeros(0, int)
    measured, predicted, image = map(np.concatenate, zip(*parts, strict=True))
    return measured, predicted, image


def _noise(depth: Float[ndarray, " k"], residual: Float[ndarray, " k"]) -> tuple[float, float]:
    """Return a (m) and b (1/m) of sigma² = a² + (b z²)² by the spread of the residuals in bins of distance."""
    from scipy.optimize import nnls  # few captures have a depth camera, and it takes 0.1 s

    bins = np.array_split(np.argsort(depth), BINS)
    z = np.array([np.median(depth[rows]) for rows in bins])
    variance = np.array([(NORMAL * np.median(np.abs(residual[rows]))) ** 2 for rows in bins])
    # Relative, for a variance that is estimated is as uncertain as it is large.
    design = np.stack([np.ones(BINS), z**4], 1) / variance[:, None].clip(1e-12)
    (constant, growing), _ = nnls(design, np.ones(BINS))
    return float(np.sqrt(constant)), float(np.sqrt(growing))
