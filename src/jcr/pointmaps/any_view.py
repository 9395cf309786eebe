"""Adapter of networks that predict depth, confidence and a camera pose of all images at once."""

import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import nearest_rotation
from jcr.hub import Weights
from jcr.pointmaps.image_grid import ImageGrid, prepare_images, resize_and_crop
from jcr.pointmaps.posed_pointmaps import PosedPointmaps
from jcr.pointmaps.reconstruction import reconstruct_pointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, Intrinsics, Reconstruction

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class Views:
    """Undistorted images of one camera and, if known, their intrinsics: the input of a network."""

    colors: UInt8[ndarray, "n h w 3"]
    """RGB, upright and undistorted, at the camera's own resolution; the network resizes them."""
    pinhole: Intrinsics | None
    """Pinhole intrinsics of these images; None: unknown."""

    @property
    def size(self) -> tuple[int, int]:
        """Width, height in pixels."""
        return self.colors.shape[2], self.colors.shape[1]


Predict = Callable[[Views], PosedPointmaps]
"""Function of a network with its weights loaded, from images to pointmaps with camera poses."""


def reconstruct_any_view(
    capture: Capture,
    load: Callable[[Path, str], Predict],
    weights: Weights,
    device: str,
    backend: str,
    progress: Progress = silent,
) -> Reconstruction:
    """Reconstruct a capture by a network that predicts all images at once, and refine it by matches.

    `load` returns the network of a folder of weights on a torch device. The unit is that of the prediction. Pixels
    whose point or confidence is not finite, or whose point lies behind the camera, get confidence 0. Raises InputError
    for weights that are missing or damaged, and for a prediction without usable depth or cameras.
    """
    images = prepare_images(capture, lambda size: ImageGrid.uncropped(size, size))
    progress("reconstruct", 0.0)
    with redirect_stdout(sys.stderr):  # packages print to stdout, which is for the command's result
        maps = load(weights.path, device)(Views(images.colors, images.pinhole))
    progress("reconstruct", 1.0)
    there = np.isfinite(maps.x_in_camera).all(-1) & (maps.x_in_camera[..., 2] > 0)
    there &= np.isfinite(maps.confidence) & (maps.confidence > 0)
    if not there.any() or not np.isfinite(maps.recon_from_camera).all():
        raise InputError(f"{backend} gave no usable depth or camera; get its weights again")
    maps = replace(
        maps,
        x_in_camera=np.where(there[..., None], maps.x_in_camera, 0).astype(np.float32),
        confidence=np.where(there, maps.confidence, 0).astype(np.float32),
        notes=(*maps.notes, weights.note),
    )
    colors = np.stack([resize_and_crop(image, maps.grid) for image in images.colors])
    return reconstruct_pointmaps(
        capture, replace(images, grid=maps.grid, colors=colors), maps, backend, progress
    )


def normalised(colors: UInt8[ndarray, "n h w 3"], device: str) -> torch.Tensor:
    """Return images (RGB, 0 to 255) as a tensor (n,3,h,w), normalised by mean and deviation of ImageNet's colours."""
    mean, deviation = (
        torch.tensor(rgb, device=device)[:, None, None] for rgb in (IMAGENET_MEAN, IMAGENET_STD)
    )
    unit_range = torch.from_numpy(np.array(colors)).to(device).permute(0, 3, 1, 2) / 255
    return (unit_range - mean) / deviation


def output(answer: Any, name: str, shape: tuple[int, ...], model: str) -> ndarray:
    """Return the entry `name` of a network's outputs as a float32 array of this shape.

    `answer` is a mapping from names to tensors. Raises InputError, naming the `model`, if the entry is absent or has
    another number of elements.
    """
    tensor = answer.get(name) if hasattr(answer, "get") else None
    if not isinstance(tensor, torch.Tensor) or tensor.numel() != np.prod(shape):
        raise InputError(f"{model} gave no {name} of shape {shape}; update the older of the packages")
    return tensor.detach().float().cpu().numpy().reshape(shape)


def rigid(matrices: Float[ndarray, "n r 4"]) -> Float[ndarray, "n 4 4"]:
    """Return rigid transforms from a network's n matrices, 3x4 or 4x4, each with the nearest exact rotation."""
    made = np.tile(np.eye(4), (len(matrices), 1, 1))
    made[:, :3] = matrices[:, :3]
    made[:, :3, :3] = nearest_rotation(made[:, :3, :3])
    return made
