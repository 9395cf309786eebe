"""What an any-view model would predict of a simulated capture: the truth with errors of a published size."""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from benchmarks.simulated.truth import read_truth, true_depth
from jcr.camera import rays
from jcr.geometry import inverse, rotation_angle, rotation_exp, transform
from jcr.reconstruct.views_at_once.da3 import grid_of
from jcr.reconstruct.views_at_once.interface import Predict, Predicted, Views
from jcr.simulate.truth import Truth


@dataclass(frozen=True)
class ViewErrors:
    """Errors of predicted views; one sigma."""

    rotation_deg: float = 0.4
    """Rotation of each camera about the scene that it looks at, per axis: what moves the camera and keeps its image."""
    aim_deg: float = 0.1
    """Rotation of each camera about itself, per axis."""
    distance: float = 0.01
    """Of the camera from the scene, relative."""
    warp: float = 0.01
    """Of depth, smooth over the image, relative."""
    white: float = 0.001
    """Of depth, pixel by pixel, relative."""
    unit: float = 1.0
    """Metres that the model calls one."""


def predictions(folder: Path, errors: ViewErrors, seed: int) -> Predict:
    """A model that answers about the capture in a folder, whatever it is shown; its camera poses are its own."""
    truth = read_truth(folder)

    def predict(views: Views) -> Predicted:
        return predicted_views(truth, errors, seed)

    return predict


def predicted_views(truth: Truth, errors: ViewErrors, seed: int) -> Predicted:
    """The truth on the grid of Depth Anything 3, with errors."""
    rng = np.random.default_rng([seed, 17])
    count, intrinsics = len(truth.images), truth.intrinsics
    grid = grid_of((intrinsics.width, intrinsics.height))
    pinhole = grid.grid_intrinsics(intrinsics)
    width, height = grid.size
    looked_at = np.zeros((count, 3))
    points = np.empty((count, height, width, 3), np.float32)
    confidence = np.empty((count, height, width), np.float32)
    for k in range(count):
        depth = true_depth(truth, k).astype(np.float32)
        known = cv2.resize((depth > 0).astype(np.float32), grid.size, interpolation=cv2.INTER_AREA)
        # Edges come out smooth, as networks make them.
        z = cv2.resize(depth, grid.size, interpolation=cv2.INTER_AREA) / np.maximum(known, 1e-6)
        looked_at[k] = [0, 0, np.median(z[known > 0.99])]
        z = z * (1 + errors.warp * _smooth(rng, height, width))
        z = z * (1 + errors.white * rng.normal(size=z.shape))
        points[k] = z[..., None] * rays(pinhole)
        slope = np.abs(cv2.Laplacian(z.astype(np.float32), cv2.CV_32F)) / np.maximum(z, 1e-6)
        confidence[k] = np.where(known > 0.99, 1 + np.exp(1.5 - 60 * slope), 0)
    rotation = rotation_exp(np.radians(errors.rotation_deg) * rng.normal(size=(count, 3)))
    aim = rotation_exp(np.radians(errors.aim_deg) * rng.normal(size=(count, 3)))
    farther = 1 + errors.distance * rng.normal(size=count)
    moved = transform(rotation, looked_at - np.einsum("kij,kj->ki", rotation, looked_at * farther[:, None]))
    base_from_camera = truth.base_from_camera @ moved @ transform(aim, np.zeros((count, 3)))
    recon_from_camera = inverse(base_from_camera[0]) @ base_from_camera
    recon_from_camera[:, :3, 3] /= errors.unit
    pinholes = np.tile([pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy], (count, 1))
    return Predicted(
        grid=grid,
        x_in_camera=points / np.float32(errors.unit),
        confidence=confidence,
        pinholes=pinholes,
        recon_from_camera=recon_from_camera,
        is_metric=False,
    )


def auc(
    recon_from_camera: Float[ndarray, "n 4 4"],
    base_from_camera: Float[ndarray, "n 4 4"],
    threshold_deg: float,
) -> float:
    """Share of pairs of views that are right, averaged over thresholds up to one, as pose benchmarks count.

    A pair is as wrong as the larger of its rotation's error and its baseline's direction's.
    """
    first, second = np.triu_indices(len(recon_from_camera), 1)
    found, true = (inverse(poses[first]) @ poses[second] for poses in (recon_from_camera, base_from_camera))
    rotated = np.degrees(rotation_angle(found[:, :3, :3] @ np.swapaxes(true[:, :3, :3], 1, 2)))
    ways = [way / np.linalg.norm(way, axis=1, keepdims=True) for way in (found[:, :3, 3], true[:, :3, 3])]
    aimed = np.degrees(np.arccos(np.clip((ways[0] * ways[1]).sum(1), -1, 1)))
    return float(np.clip(1 - np.maximum(rotated, aimed) / threshold_deg, 0, 1).mean())


def _smooth(rng: np.random.Generator, height: int, width: int) -> Float[ndarray, "h w"]:
    """Unit normals on a 3x4 grid, interpolated."""
    return cv2.resize(rng.normal(size=(3, 4)), (width, height), interpolation=cv2.INTER_CUBIC)
