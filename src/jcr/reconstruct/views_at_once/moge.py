"""MoGe-2 (Wang et al. 2025, arXiv 2507.02546): metric points of one view at a time, and no cameras.

Its conventions: images in [0, 1] of any size; points x right, y down, z forward in metres; intrinsics are shares of the
image's width and height, counted from its corner; a mask instead of a confidence.
"""

import math
from functools import partial
from pathlib import Path

import numpy as np
from torch import nn

from jcr.errors import InputError
from jcr.reconstruct.preprocess import ImageGrid, resize_and_crop
from jcr.reconstruct.views_at_once.interface import (
    Predict,
    Predicted,
    Views,
    checked,
    output,
    pinhole_of_edges,
    unit_range,
)

LONG_EDGE = 640
"""Longest side of the images that it is shown; nothing is cropped."""


def load(weights: Path, device: str) -> Predict:
    """The network in a folder with its model.pt; InputError where it is not there."""
    from moge.model.v2 import MoGeModel  # type: ignore[import-not-found]

    try:
        return partial(predict, MoGeModel.from_pretrained(weights / "model.pt").eval().to(device))
    except (OSError, ValueError, RuntimeError, KeyError) as error:
        raise InputError(f"{weights}: no weights of MoGe-2 ({' '.join(str(error).split())})") from None


def predict(network: nn.Module, views: Views) -> Predicted:
    """Every view by itself, given the field of view where the intrinsics are known."""
    grid = ImageGrid.shrunk(views.size, LONG_EDGE)
    device = next(network.parameters()).device.type
    fov_deg = None
    if views.pinhole is not None:
        fx = grid.grid_intrinsics(views.pinhole).fx
        fov_deg = math.degrees(2 * math.atan(grid.size[0] / 2 / fx))
    width, height = grid.size
    points, masks, pinholes = [], [], []
    for image in views.colors:
        colors = resize_and_crop(image, grid)[None]
        answer = network.infer(  # type: ignore[operator]
            unit_range(colors, device)[0], fov_x=fov_deg, apply_mask=False, use_fp16=device == "cuda"
        )
        points.append(output(answer, "points", (height, width, 3), "MoGe-2"))
        masks.append(output(answer, "mask", (height, width), "MoGe-2"))
        matrix = output(answer, "intrinsics", (3, 3), "MoGe-2") * [[width], [height], [1]]
        pinholes.append(pinhole_of_edges(matrix))
    made = Predicted(
        grid=grid,
        x_in_camera=np.stack(points),
        confidence=np.stack(masks),
        pinholes=np.stack(pinholes),
        recon_from_camera=None,
        is_metric=True,
    )
    return checked(made, "MoGe-2")
