"""Pairwise pointmaps of a known tabletop scene with the errors a network makes, and the truth beside them."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray

from jcr.camera import rays
from jcr.errors import InputError
from jcr.geometry import apply, inverse, rotation_angle, rotation_exp, transform
from jcr.pointmaps.pair_predictions import SHAPES, PairPredictions, complete_pairs
from jcr.records import Intrinsics
from simulation.truth import read_truth, true_depth

SPHERES = np.array([[0.12, 0.04, 0.08, 0.08], [-0.17, 0.13, 0.06, 0.06], [0.03, -0.21, 0.10, 0.10]])
"""Centre and radius, metres; they lie on the table z = 0."""
BOXES = np.array(
    [
        [[-0.27, -0.24, 0.0], [-0.12, -0.08, 0.18]],
        [[0.19, 0.11, 0.0], [0.35, 0.22, 0.10]],
        [[-0.06, 0.23, 0.0], [0.09, 0.35, 0.25]],
    ]
)
ROWS_ABOVE = np.array([[-1.5, -1.5, 0.0], [1.5, 1.5, 2.0]])
GROWTH_DEG = 60.0
"""Angle between the views at which the errors of second views are twice those of first ones."""


@dataclass(frozen=True)
class PairErrors:
    """Errors of predicted pointmaps; relative ones are one sigma over the point's distance."""

    pixel: float = 0.003
    """White, in all directions, independent per pixel."""
    warp: float = 0.01
    """Smooth over the image, along the line of sight."""
    bend: float = 0.0
    """Smooth over the image, across the line of sight (rad)."""
    pair_rotation_deg: float = 0.0
    """Rigid rotation of second views about the first camera, per axis."""
    outliers: float = 0.02
    """Fraction of pixels with errors 20 times larger and low confidence."""
    wrong_pairs: int = 0
    """Pairs whose second view is put at a wrong place, as confident as any."""
    noise_pairs: int = 0
    """Pairs whose points are noise, as confident as any."""
    focal: float = 0.0
    """Error of the focal length of all pointmaps, relative."""


@dataclass(frozen=True)
class PairTruth:
    """Truth that the predictions were made from."""

    base_from_camera: Float[ndarray, "n 4 4"]
    depth: Float[ndarray, "n h w"]
    intrinsics: Intrinsics
    pair_unit: Float[ndarray, " e"]
    """Pair units per metre."""
    spoilt: Int[ndarray, " k"]
    """Pairs made wrong on purpose."""


def synthetic_pairs(
    edges: Int[ndarray, "e 2"],
    size: tuple[int, int] = (128, 96),
    errors: PairErrors | None = None,
    seed: int = 0,
    intrinsics: Intrinsics | None = None,
) -> tuple[PairPredictions, PairTruth]:
    """Predict `edges` at `size` (width, height), each pair in a unit between half and twice a metre.

    Without `intrinsics` the focal length is 0.95 widths and the principal point the middle, and the
    predictions carry none.
    """
    errors = errors or PairErrors()
    rng = np.random.default_rng(seed)
    width, height = size
    k = intrinsics or Intrinsics(0.95 * width, 0.95 * width, (width - 1) / 2, (height - 1) / 2, width, height)
    images = int(edges.max()) + 1
    base_from_camera = _cameras(images, rng)
    depth = np.stack([scene_depth(pose, rays(k)) for pose in base_from_camera])
    return predicted_pairs(
        edges, base_from_camera, depth, k, errors, rng, carries_intrinsics=intrinsics is not None
    )


def predicted_pairs(
    edges: Int[ndarray, "e 2"],
    base_from_camera: Float[ndarray, "n 4 4"],
    depth: Float[ndarray, "n h w"],
    k: Intrinsics,
    errors: PairErrors,
    rng: np.random.Generator,
    carries_intrinsics: bool,
) -> tuple[PairPredictions, PairTruth]:
    """Return predictions of a network for views of known depth (0: nothing there), each pair in a unit of its own."""
    height, width = depth.shape[1:]
    focal = 1 + errors.focal
    x_in_camera = depth[..., None] * rays(replace(k, fx=focal * k.fx, fy=focal * k.fy))
    count = len(edges)
    unit = np.exp(rng.uniform(-np.log(2), np.log(2), count))
    spoilt = rng.permutation(count)[: errors.wrong_pairs + errors.noise_pairs]
    points = np.empty((2, count, height, width, 3), np.float32)
    confidence = np.empty((2, count, height, width), np.float32)
    for e, (first, second) in enumerate(edges):
        first_from_second = inverse(base_from_camera[first]) @ base_from_camera[second]
        baseline_deg = float(np.degrees(rotation_angle(first_from_second[:3, :3])))
        rotation = rotation_exp(np.radians(rng.normal(0, 1, 3) * errors.pair_rotation_deg))
        first_from_second = transform(rotation, np.zeros(3)) @ first_from_second
        if e in spoilt[: errors.wrong_pairs]:
            first_from_second = (
                transform(rotation_exp(rng.normal(0, 0.5, 3)), rng.normal(0, 0.3, 3)) @ first_from_second
            )
        for view, image in enumerate((first, second)):
            exact = apply(first_from_second, x_in_camera[image]) if view else x_in_camera[image]
            growth = 1 + view * baseline_deg / GROWTH_DEG
            outlier = rng.random((height, width)) < errors.outliers
            made = _with_errors(exact, depth[image], outlier, growth, errors, rng)
            if e in spoilt[errors.wrong_pairs :]:
                made = rng.normal(0, 0.3, exact.shape) + [0, 0, 1]
            points[view, e] = unit[e] * made
            log_confidence = (
                rng.normal(1.8, 0.3, (height, width)) - 3 * outlier - 0.01 * baseline_deg * (1 + view)
            )
            log_confidence -= 0.4 * np.clip(depth[image] - 1, 0, 2)
            confidence[view, e] = np.where(depth[image] > 0, 1 + np.exp(log_confidence), 1)
    predictions = PairPredictions(
        edges=edges.astype(np.int64),
        pts3d=points[0],
        conf=confidence[0],
        pts3d_in_other_view=points[1],
        conf2=confidence[1],
        intrinsics=k if carries_intrinsics else None,
    )
    return predictions, PairTruth(base_from_camera, depth, k, unit, spoilt)


def _with_errors(
    exact: Float[ndarray, "h w 3"],
    depth: Float[ndarray, "h w"],
    outlier: Bool[ndarray, "h w"],
    growth: float,
    errors: PairErrors,
    rng: np.random.Generator,
) -> Float[ndarray, "h w 3"]:
    """Add smooth errors along and across the sight, and white ones in all directions, to points."""
    height, width = depth.shape
    white = errors.pixel * growth * np.where(outlier, 20, 1) * depth
    stretched = exact * (1 + errors.warp * growth * smooth_noise(rng, height, width))[..., None]
    bend = errors.bend * growth * np.stack([smooth_noise(rng, height, width) for _ in range(3)], axis=-1)
    return stretched + np.cross(bend, exact) + white[..., None] * rng.normal(size=exact.shape)


def pairs_of_capture(
    folder: Path, size: tuple[int, int] = (128, 96), errors: PairErrors | None = None, seed: int = 0
) -> tuple[PairPredictions, PairTruth]:
    """Return predictions of a network for all pairs of a simulated capture, from its true depth.

    The images' size must be an odd multiple of `size`, so that the grid's pixels are pixels of the images.
    """
    truth = read_truth(folder)
    intrinsics, (width, height) = truth.intrinsics, size
    factor = intrinsics.width // width
    if factor % 2 == 0 or (factor * width, factor * height) != (intrinsics.width, intrinsics.height):
        raise InputError(
            f"{folder}: images of {intrinsics.width}x{intrinsics.height} are no odd multiple of {width}x{height}"
        )
    count = len(truth.images)
    middle = factor // 2
    depth = np.stack([true_depth(truth, k)[middle::factor, middle::factor] for k in range(count)])
    cx, cy = (intrinsics.cx - middle) / factor, (intrinsics.cy - middle) / factor
    k = Intrinsics(intrinsics.fx / factor, intrinsics.fy / factor, cx, cy, width, height)
    edges, rng = complete_pairs(count), np.random.default_rng(seed)
    return predicted_pairs(
        edges, truth.base_from_camera, depth, k, errors or PairErrors(), rng, carries_intrinsics=True
    )


def _cameras(count: int, rng: np.random.Generator) -> Float[ndarray, "n 4 4"]:
    """Draw base_from_camera of views round a part of the table, at varied height, distance and roll."""
    azimuth = 1.2 * np.pi * np.arange(count) / count + rng.uniform(-0.1, 0.1, count)
    elevation, radius = rng.uniform(np.pi / 6, np.pi / 3, count), rng.uniform(0.55, 0.85, count)
    eye = radius * np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    target = np.concatenate([rng.uniform(-0.08, 0.08, (2, count)), np.zeros((1, count))])
    forward = (target - eye).T / np.linalg.norm(target - eye, axis=0)[:, None]
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    level = np.stack([right, np.cross(forward, right), forward], axis=-1)
    roll = rotation_exp(rng.uniform(-0.5, 0.5, count)[:, None] * np.array([0.0, 0.0, 1.0]))
    return transform(level @ roll, eye.T)


def scene_depth(
    base_from_camera: Float[ndarray, "4 4"], ray: Float[ndarray, "h w 3"]
) -> Float[ndarray, "h w"]:
    """Return the depth of the nearest surface along rays of unit depth."""
    origin, direction = base_from_camera[:3, 3], ray @ base_from_camera[:3, :3].T
    nearest = np.maximum(*((ROWS_ABOVE[:, None, None] - origin) / direction)).min(axis=-1)
    for *center, radius in SPHERES:
        to_center = origin - center
        a, b = (direction**2).sum(axis=-1), direction @ to_center
        root = b**2 - a * (to_center @ to_center - radius**2)
        hit = np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, np.inf)
        nearest = np.minimum(nearest, np.where(hit > 0, hit, np.inf))
    for box in BOXES:
        low, high = (box[:, None, None] - origin) / direction
        enter, leave = np.minimum(low, high).max(axis=-1), np.maximum(low, high).min(axis=-1)
        nearest = np.minimum(nearest, np.where((enter > 0) & (enter < leave), enter, np.inf))
    return nearest


def scene_distance(x: Float[ndarray, "n 3"]) -> Float[ndarray, " n"]:
    """Return the distance (m) of points in the scene's frame to table, spheres and boxes, negative inside."""
    distances = [x[:, 2]]
    for *center, radius in SPHERES:
        distances.append(np.linalg.norm(x - center, axis=1) - radius)
    for low, high in BOXES:
        q = np.abs(x - (low + high) / 2) - (high - low) / 2
        distances.append(np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(1), 0))
    return np.min(distances, axis=0)


def smooth_noise(rng: np.random.Generator, height: int, width: int) -> Float[ndarray, "h w"]:
    """Draw unit normals on a 4x5 grid and interpolate them."""
    return cv2.resize(rng.normal(size=(4, 5)), (width, height), interpolation=cv2.INTER_LINEAR)


def write_pairs(path: Path, predictions: PairPredictions) -> None:
    """Write predictions as the npz file that jcr reads."""
    arrays: dict[str, object] = {name: getattr(predictions, name) for name in SHAPES}
    arrays |= {"images": np.array(predictions.images, dtype=str), "is_metric": predictions.is_metric}
    if predictions.colors is not None:
        arrays["colors"] = predictions.colors
    if predictions.intrinsics is not None:
        k = predictions.intrinsics
        arrays["intrinsics"] = np.array([k.fx, k.fy, k.cx, k.cy])
    if predictions.grid is not None:
        arrays["grid"] = np.array(list(asdict(predictions.grid).values()), dtype=np.int64)
    np.savez(path, **arrays)  # type: ignore[arg-type]
