"""What goes into an any-view model and what comes out, in our conventions; its adapter converts at the border."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import nearest_rotation
from jcr.pointmaps.grid import ImageGrid
from jcr.records import Intrinsics

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Views:
    """What a model is shown."""

    colors: UInt8[ndarray, "n h w 3"]
    """RGB, upright and without distortion, in the camera's own resolution: resizing is part of a model."""
    pinhole: Intrinsics | None
    """The camera of these images; None: unknown."""

    @property
    def size(self) -> tuple[int, int]:
        """Width, height in pixels."""
        return self.colors.shape[2], self.colors.shape[1]


@dataclass(frozen=True, kw_only=True)
class Predicted:
    """The output of a model for the views."""

    grid: ImageGrid
    """Where its pixels lie in the images that it was shown."""
    x_in_camera: Float[ndarray, "n h w 3"]
    """A point per pixel of the grid, in its own camera's frame; finite where the confidence is above 0."""
    confidence: Float[ndarray, "n h w"]
    """At least 0; 0 means no estimate. Comparable within an image, and no probability."""
    pinholes: Float[ndarray, "n 4"]
    """fx, fy, cx, cy of each view on the grid, pixel (0, 0) a centre."""
    recon_from_camera: Float[ndarray, "n 4 4"]
    """Rigid camera poses in one frame of the model's choice."""
    is_metric: bool
    """Whether the unit is meant to be the metre."""


Predict = Callable[[Views], Predicted]
"""A model with its weights loaded."""


def pinhole_of_edges(matrix: Float[ndarray, "*n 3 3"]) -> Float[ndarray, "*n 4"]:
    """fx, fy, cx, cy with pixel (0, 0) a centre, of matrices whose origin is the image's corner, as networks have it."""
    fx, fy, cx, cy = matrix[..., 0, 0], matrix[..., 1, 1], matrix[..., 0, 2], matrix[..., 1, 2]
    return np.stack([fx, fy, cx - 0.5, cy - 0.5], axis=-1)


def rays_of(pinholes: Float[ndarray, "n 4"], height: int, width: int) -> Float[ndarray, "n h w 3"]:
    """Directions of unit depth of the pixels' centres of each view."""
    v, u = np.mgrid[:height, :width]
    fx, fy, cx, cy = (pinholes[:, k, None, None] for k in range(4))
    x, y = (u - cx) / fx, (v - cy) / fy
    return np.stack([x, y, np.ones_like(x)], axis=-1).astype(np.float32)


def normalised(colors: UInt8[ndarray, "n h w 3"], device: str) -> torch.Tensor:
    """Images (n,3,h,w) as encoders trained on ImageNet take them."""
    mean, deviation = (
        torch.tensor(values, device=device)[:, None, None] for values in (IMAGENET_MEAN, IMAGENET_STD)
    )
    unit_range = torch.from_numpy(np.array(colors)).to(device).permute(0, 3, 1, 2) / 255
    return (unit_range - mean) / deviation


def output(answer: Any, name: str, shape: tuple[int, ...], model: str) -> ndarray:
    """An output of a network as float32 of a shape; InputError where it is absent or of another size."""
    tensor = answer.get(name) if hasattr(answer, "get") else None
    if not isinstance(tensor, torch.Tensor) or tensor.numel() != np.prod(shape):
        raise InputError(
            f"{model} gave no {name} of shape {shape}; its package is of another release than this jcr knows, "
            "update the older of the two"
        )
    return tensor.detach().float().cpu().numpy().reshape(shape)


def rigid(matrices: Float[ndarray, "n r 4"]) -> Float[ndarray, "n 4 4"]:
    """Transforms (n,4,4) float64 of what a network gave as 3x4 or 4x4: half precision leaves rotations approximate."""
    made = np.tile(np.eye(4), (len(matrices), 1, 1))
    made[:, :3] = matrices[:, :3]
    made[:, :3, :3] = nearest_rotation(made[:, :3, :3])
    return made


def checked(predicted: Predicted, model: str) -> Predicted:
    """The same with confidence 0 wherever it cannot be used; InputError where nothing is left."""
    confidence = predicted.confidence
    there = np.isfinite(predicted.x_in_camera).all(-1) & np.isfinite(confidence) & (confidence > 0)
    there &= predicted.x_in_camera[..., 2] > 0
    if not there.any() or not np.isfinite(predicted.recon_from_camera).all():
        raise InputError(
            f"{model} gave no usable depth or camera; its weights may be damaged, get them again"
        )
    return replace(
        predicted,
        x_in_camera=np.where(there[..., None], predicted.x_in_camera, 0).astype(np.float32),
        confidence=np.where(there, confidence, 0).astype(np.float32),
    )
