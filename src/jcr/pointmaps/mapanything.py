"""MapAnything (Keetha et al. 2025, arXiv 2509.13414): points and cameras of all views in metres.

Its conventions are ours: cameras x right, y down, z forward, poses recon_from_camera, pixel (0, 0) a centre. It takes
intrinsics.
"""

from functools import partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from jcr.errors import InputError
from jcr.geometry import apply, inverse
from jcr.pointmaps.grid import image_grid, resize_and_crop
from jcr.pointmaps.interface import (
    Predict,
    Predicted,
    Views,
    checked,
    normalised,
    output,
    rigid,
)

LONG_EDGE, PATCH = 518, 14


@runtime_checkable
class Model(Protocol):
    """What is asked of the package's model."""

    def infer(self, views: list[dict[str, Any]], **options: Any) -> list[dict[str, Tensor]]: ...


def load(weights: Path, device: str) -> Predict:
    """The network in a folder; InputError where it is not there."""
    from mapanything.models import MapAnything  # type: ignore[import-not-found]

    try:
        return partial(predict, MapAnything.from_pretrained(str(weights)).to(device), device=device)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{weights}: no weights of MapAnything ({' '.join(str(error).split())})") from None


def predict(model: Model, views: Views, device: str = "cpu") -> Predicted:
    """Predict all views in one pass, given the intrinsics where they are known."""
    grid = image_grid(views.size, LONG_EDGE, PATCH, keep_square=True)
    colors = np.stack([resize_and_crop(image, grid) for image in views.colors])
    shown: list[dict[str, Any]] = [
        {"img": image[None], "data_norm_type": ["dinov2"]} for image in normalised(colors, device)
    ]
    if views.pinhole is not None:
        matrix = torch.from_numpy(grid.grid_intrinsics(views.pinhole).matrix).float().to(device)
        for view in shown:
            view["intrinsics"] = matrix[None]
    with torch.inference_mode():
        # The mask is applied to the confidence: masked points would be zeros.
        answers = model.infer(shown, use_amp=device != "cpu", apply_mask=False)
    count, height, width = colors.shape[:3]
    points = np.empty((count, height, width, 3), np.float32)
    confidence, poses, pinholes = (
        np.empty((count, height, width)),
        np.empty((count, 4, 4)),
        np.empty((count, 4)),
    )
    for k, answer in enumerate(answers):
        poses[k] = rigid(output(answer, "camera_poses", (1, 4, 4), "MapAnything"))[0]
        x_in_recon = output(answer, "pts3d", (height, width, 3), "MapAnything")
        points[k] = apply(inverse(poses[k]), x_in_recon)
        confidence[k] = output(answer, "conf", (height, width), "MapAnything")
        if "mask" in answer:
            confidence[k] *= output(answer, "mask", (height, width), "MapAnything") > 0.5
        own = output(answer, "intrinsics", (3, 3), "MapAnything")
        pinholes[k] = own[0, 0], own[1, 1], own[0, 2], own[1, 2]
    return checked(
        Predicted(
            grid=grid,
            x_in_camera=points,
            confidence=confidence,
            pinholes=pinholes,
            recon_from_camera=poses,
            is_metric=True,
        ),
        "MapAnything",
    )
