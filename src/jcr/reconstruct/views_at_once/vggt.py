"""VGGT (Wang et al. 2025, arXiv 2503.11651): depth, confidence and cameras of all views, in an arbitrary unit.

Its conventions: images in [0, 1], 518 wide, a tall one cropped to 518 rows around its middle; a camera is nine numbers
(absT_quaR_FoV): translation and quaternion x, y, z, w of camera_from_recon, then the vertical and horizontal field of
view, with the optical axis through the image's middle; depth is along z. Its depth is more accurate than its points,
which its paper says too, and is what is read.
"""

from contextlib import nullcontext
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import nn

from jcr.errors import InputError
from jcr.geometry import inverse, transform
from jcr.reconstruct.preprocess import ImageGrid, resize_and_crop
from jcr.reconstruct.views_at_once.interface import (
    Predict,
    Predicted,
    Views,
    checked,
    output,
    rays_of,
    unit_range,
)

WIDTH, PATCH = 518, 14


def load(weights: Path, device: str) -> Predict:
    """The network in a folder; InputError where it is not there."""
    from vggt.models.vggt import VGGT  # type: ignore[import-not-found]

    try:
        return partial(predict, VGGT.from_pretrained(str(weights)).eval().to(device))
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{weights}: no weights of VGGT ({' '.join(str(error).split())})") from None


def predict(network: nn.Module, views: Views) -> Predicted:
    """One pass over all views."""
    grid = grid_of(views.size)
    colors = np.stack([resize_and_crop(image, grid) for image in views.colors])
    device = next(network.parameters()).device.type
    half = torch.autocast("cuda", torch.bfloat16) if device == "cuda" else nullcontext()
    with torch.inference_mode(), half:
        answer = network(unit_range(colors, device))
    count, height, width = colors.shape[:3]
    depth = output(answer, "depth", (count, height, width), "VGGT")
    recon_from_camera, pinholes = cameras(output(answer, "pose_enc", (count, 9), "VGGT"), height, width)
    return checked(
        Predicted(
            grid,
            depth[..., None] * rays_of(pinholes, height, width),
            output(answer, "depth_conf", (count, height, width), "VGGT"),
            pinholes,
            recon_from_camera,
            is_metric=False,
        ),
        "VGGT",
    )


def grid_of(size: tuple[int, int]) -> ImageGrid:
    """The width becomes 518, the height the nearest multiple of the patch, cropped to 518 around its middle."""
    height = round(size[1] * WIDTH / size[0] / PATCH) * PATCH
    shown = min(height, WIDTH)
    return ImageGrid(size, (WIDTH, height), (0, (height - shown) // 2), (WIDTH, shown))


def cameras(
    encoding: Float[ndarray, "n 9"], height: int, width: int
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, "n 4"]]:
    """recon_from_camera and pinholes of encoded cameras."""
    encoding = encoding.astype(np.float64)
    rotation = Rotation.from_quat(encoding[:, 3:7]).as_matrix()
    fy, fx = height / 2 / np.tan(encoding[:, 7] / 2), width / 2 / np.tan(encoding[:, 8] / 2)
    middle = [np.full(len(encoding), (edge - 1) / 2) for edge in (width, height)]
    return inverse(transform(rotation, encoding[:, :3])), np.stack([fx, fy, *middle], axis=-1)
