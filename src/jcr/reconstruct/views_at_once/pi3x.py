"""Pi3X, the successor of π³ (Wang et al. 2025, arXiv 2507.13347): points and cameras of all views, no view the first.

Its conventions: images in [0, 1] of at most 255,000 pixels; cameras are recon_from_camera; points are in their camera's
frame; the confidence is a logit; intrinsics that go in count from the image's corner. It takes intrinsics and camera
poses, and draws the scale at which it reads the poses: from a seed of its own here, so that an answer can be repeated.
"""

import math
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from torch import nn

from jcr.errors import InputError
from jcr.reconstruct.preprocess import ImageGrid
from jcr.reconstruct.views_at_once.interface import (
    Predict,
    Predicted,
    Views,
    checked,
    edge_matrix,
    output,
    rigid,
    unit_range,
)

PIXELS, PATCH = 255_000, 14
LEAST_CONFIDENCE = 0.1
"""Below which the package drops a point."""


def load(weights: Path, device: str) -> Predict:
    """The network in a folder; InputError where it is not there."""
    from pi3.models.pi3x import Pi3X  # type: ignore[import-not-found]

    try:
        return partial(predict, Pi3X.from_pretrained(str(weights)).eval().to(device))
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{weights}: no weights of Pi3X ({' '.join(str(error).split())})") from None


def predict(network: nn.Module, views: Views) -> Predicted:
    """One pass over all views, given the intrinsics where known, and the poses where the views have them."""
    grid = grid_of(views.size)
    # Lanczos, whether it shrinks or enlarges.
    colors = np.stack(
        [
            np.asarray(Image.fromarray(image).resize(grid.size, Image.Resampling.LANCZOS))
            for image in views.colors
        ]
    )
    count, height, width = colors.shape[:3]
    device = next(network.parameters()).device.type
    known: dict[str, torch.Tensor] = {}
    if views.pinhole is not None:
        matrix = torch.from_numpy(edge_matrix(grid.grid_intrinsics(views.pinhole))).float().to(device)
        known["intrinsics"] = matrix.expand(1, count, 3, 3)
        if views.recon_from_camera is not None:
            known["poses"] = torch.from_numpy(views.recon_from_camera).float().to(device)[None]
    half = torch.autocast("cuda", torch.bfloat16) if device == "cuda" else nullcontext()
    with torch.inference_mode(), half, torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        answer = network(unit_range(colors, device)[None], **known)
    points = output(answer, "local_points", (count, height, width, 3), "Pi3X")
    logit = output(answer, "conf", (count, height, width), "Pi3X")
    confidence = 1 / (1 + np.exp(-logit.astype(np.float64)))
    return checked(
        Predicted(
            grid,
            points,
            np.where(confidence > LEAST_CONFIDENCE, confidence, 0),
            _pinholes(points),
            rigid(output(answer, "camera_poses", (count, 4, 4), "Pi3X")),
            is_metric=True,
        ),
        "Pi3X",
    )


def grid_of(size: tuple[int, int]) -> ImageGrid:
    """As many pixels as it was trained with, in multiples of the patch, nearly in the image's own shape."""
    scale = math.sqrt(PIXELS / (size[0] * size[1]))
    across, down = (round(edge * scale / PATCH) for edge in size)
    while across * down * PATCH**2 > PIXELS:
        if across / down > size[0] / size[1]:
            across -= 1
        else:
            down -= 1
    shown = max(1, across) * PATCH, max(1, down) * PATCH
    return ImageGrid(size, shown, (0, 0), shown)


def _pinholes(points: Float[ndarray, "n h w 3"]) -> Float[ndarray, "n 4"]:
    """The pinhole of each view by least squares, its axis through the image's middle: x/z = (u − cx)/fx."""
    height, width = points.shape[1:3]
    v, u = np.mgrid[:height, :width] - np.array([height - 1, width - 1])[:, None, None] / 2
    slope = points[..., :2].astype(np.float64) / np.where(points[..., 2:] > 0, points[..., 2:], np.nan)
    fx, fy = (
        np.nansum(slope[..., axis] * pixel, axis=(1, 2)) / np.nansum(slope[..., axis] ** 2, axis=(1, 2))
        for axis, pixel in ((0, u), (1, v))
    )
    middle = [np.full(len(points), (edge - 1) / 2) for edge in (width, height)]
    return np.stack([fx, fy, *middle], axis=-1)
