"""Depth Anything 3 (Lin et al. 2025, arXiv 2511.10647): depth, confidence and cameras of any number of images.

Conventions of the network: cameras are camera_from_recon, x right, y down, z forward; depth is along z; intrinsics have
their origin at the image's corner; the unit is arbitrary. Only the network of its package is used.
"""

import json
import os
import warnings
from contextlib import nullcontext
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from numpy import ndarray
from torch import nn

from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.hub import Weights
from jcr.pointmaps.any_view import Predict, Views, normalised, output, reconstruct_any_view, rigid
from jcr.pointmaps.image_grid import ImageGrid
from jcr.pointmaps.posed_pointmaps import PosedPointmaps
from jcr.progress import Progress, silent
from jcr.records import Capture, Reconstruction

LONG_EDGE, PATCH = 504, 14


def reconstruct_da3(
    capture: Capture, weights: Weights, device: str, backend: str, progress: Progress = silent
) -> Reconstruction:
    """Reconstruct a capture by Depth Anything 3; raise InputError for weights that are missing or damaged."""
    return reconstruct_any_view(capture, load, weights, device, backend, progress)


def load(weights: Path, device: str) -> Predict:
    """Return the function that predicts views with the network of a folder with config.json and model.safetensors.

    Raises InputError for files that are missing, damaged or of another network.
    """
    from safetensors import SafetensorError
    from safetensors.torch import load_file

    try:
        name = json.loads((weights / "config.json").read_text("utf-8"))["model_name"]
        state = load_file(weights / "model.safetensors")
        network = build(name)
        network.load_state_dict({key.removeprefix("model."): state[key] for key in state})
    except (OSError, ValueError, KeyError, RuntimeError, SafetensorError) as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{weights}: no weights of Depth Anything 3 ({reason})") from None
    return partial(predict_views, network.to(device))


def build(name: str) -> nn.Module:
    """Return Depth Anything 3 in the configuration `name`, with random weights; raise KeyError for an unknown name."""
    os.environ.setdefault("DA3_LOG_LEVEL", "ERROR")  # otherwise the package prints its layers
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings of the configuration's library
        from depth_anything_3.cfg import create_object, load_config  # type: ignore[import-not-found]
        from depth_anything_3.registry import MODEL_REGISTRY  # type: ignore[import-not-found]

        return create_object(load_config(MODEL_REGISTRY[name])).eval()


def predict_views(network: nn.Module, views: Views) -> PosedPointmaps:
    """Return the pointmaps and camera poses of all images, predicted in one pass.

    The images are resized so that their long edge has about LONG_EDGE px (`grid_of`). Frame and unit are arbitrary.
    """
    grid = grid_of(views.size)
    colors = np.stack([resized_for_grid(image, grid) for image in views.colors])
    device = next(network.parameters()).device.type
    # Half precision halves the time on a GPU, as in the package; on a CPU it is no faster.
    half = torch.autocast("cuda", torch.bfloat16) if device == "cuda" else nullcontext()
    with torch.inference_mode(), half:
        answer = network(normalised(colors, device)[None], None, None)
    count, height, width = colors.shape[:3]
    depth = output(answer, "depth", (count, height, width), "Depth Anything 3")
    matrices = output(answer, "intrinsics", (count, 3, 3), "Depth Anything 3")
    # In the network's intrinsics, pixel coordinates are 0 at the image's corner, and 0.5 at the first pixel's centre.
    centres = *np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), np.ones((height, width))
    rays = np.einsum("nij,jhw->nhwi", np.linalg.inv(matrices), np.stack(centres)).astype(np.float32)
    camera_from_recon = rigid(output(answer, "extrinsics", (count, 3, 4), "Depth Anything 3"))
    return PosedPointmaps(
        grid=grid,
        x_in_camera=depth[..., None] * rays,
        confidence=output(answer, "depth_conf", (count, height, width), "Depth Anything 3"),
        recon_from_camera=inverse(camera_from_recon),
        is_metric=False,
    )


def grid_of(size: tuple[int, int]) -> ImageGrid:
    """Return the network's grid for an image of `size` (width, height), px.

    The long edge is resized to LONG_EDGE px, and both edges are rounded to multiples of PATCH.
    """
    edges = (round(edge * LONG_EDGE / max(size)) for edge in size)
    width, height = (max(1, (edge + PATCH // 2) // PATCH) * PATCH for edge in edges)
    return ImageGrid.uncropped(size, (width, height))


def resized_for_grid(image: UInt8[ndarray, "h w 3"], grid: ImageGrid) -> UInt8[ndarray, "h2 w2 3"]:
    """Resize an image (RGB) to a long edge of LONG_EDGE px, and then to the size of `grid`.

    Each step is bicubic if it enlarges an edge and otherwise averages over areas, as in Depth Anything 3.
    """
    height, width = image.shape[:2]
    scale = LONG_EDGE / max(width, height)
    for size in ((max(1, round(width * scale)), max(1, round(height * scale))), grid.size):
        if size != (width, height):
            enlarges = size[0] > width or size[1] > height
            image = cv2.resize(image, size, interpolation=cv2.INTER_CUBIC if enlarges else cv2.INTER_AREA)
            width, height = size
    return image
