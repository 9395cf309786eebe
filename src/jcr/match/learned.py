"""Features by networks: keypoints of every image once, descriptors of the image turned by any angle about its axis.

The networks are not made for images that are turned against each other. The keypoints stay those of the image as it
was taken, so that tracks run through all pairs; what is turned is the image in which they are described.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from jcr.match import aliked, weights, xfeat
from jcr.match.lightglue import LightGlue

LONG_SIDE_PX = 1024
"""Larger images are reduced to this."""
KEYPOINTS = {"xfeat": 1280, "aliked": 1024}
"""Of an image at most. ALIKED's matcher is ten times slower than XFeat's."""
UPRIGHT_ENOUGH = math.radians(15)
"""An image is turned by whole quarters where that leaves no more than this, for it costs no resampling."""
MULTIPLE = 32


@dataclass
class LearnedFeatures:
    """Keypoints of a capture's images, and a matcher that turns the images as it is told."""

    kind: Literal["xfeat", "aliked"]
    images: Sequence[UInt8[ndarray, "h w 3"]]
    x_px: list[Float[ndarray, "k 2"]] = field(init=False)
    """In the given images; pixel centres are whole numbers."""
    _network: xfeat.XFeat | aliked.Aliked = field(init=False)
    _matcher: LightGlue = field(init=False)
    _described: dict[tuple[int, int], tuple[Tensor, Tensor, tuple[int, int]]] = field(init=False)

    def __post_init__(self) -> None:
        self._network, self._matcher = _networks(self.kind)
        self._described = {}
        self.x_px = []

    def extract(self, step: Callable[[float], None] = lambda fraction: None) -> None:
        """The keypoints of every image."""
        detect = xfeat.detect if self.kind == "xfeat" else aliked.detect
        for k, image in enumerate(self.images):
            step(k / len(self.images))
            pixels, original_from_working = _prepared(image, 0.0)
            with _one_thread():
                found = detect(self._network, pixels, KEYPOINTS[self.kind])  # pyright: ignore[reportArgumentType]
            self.x_px.append(_mapped(found.double().numpy(), original_from_working))
        step(1.0)

    def match(self, i: int, j: int, roll_i: float, roll_j: float) -> Int[ndarray, "m 2"]:
        """Rows of the keypoints of images i and j that match, the images turned by these angles (rad) before."""
        x_i, descriptor_i, size_i = self._describe(i, roll_i)
        x_j, descriptor_j, size_j = self._describe(j, roll_j)
        with _one_thread():
            early = self.kind == "aliked"  # XFeat's matcher was trained without
            rows, _ = self._matcher(x_i, x_j, descriptor_i, descriptor_j, size_i, size_j, early)
        return rows.numpy()

    def descriptors(self, image: int, roll: float) -> Float[ndarray, "k d"]:
        """Unit descriptors of an image's keypoints, the image turned by an angle (rad) before."""
        return self._describe(image, roll)[1].numpy()

    def _describe(self, row: int, roll: float) -> tuple[Tensor, Tensor, tuple[int, int]]:
        """Keypoints in the turned image, their descriptors, and its size."""
        roll = _by_quarters(roll)
        key = row, round(math.degrees(roll))
        if key not in self._described:
            pixels, original_from_turned = _prepared(self.images[row], roll)
            x_px = _mapped(self.x_px[row], np.linalg.inv(original_from_turned))
            at = torch.from_numpy(x_px).float()
            describe = xfeat.describe if self.kind == "xfeat" else aliked.describe
            with _one_thread():
                found = describe(self._network, pixels, at)  # pyright: ignore[reportArgumentType]
            self._described[key] = at, found, (pixels.shape[-1], pixels.shape[-2])
        return self._described[key]


def _networks(kind: str) -> tuple[xfeat.XFeat | aliked.Aliked, LightGlue]:
    """The published networks of one kind of features; raises as WeightsFile.read does."""
    if kind == "xfeat":
        network, of_network = xfeat.XFeat(), weights.XFEAT.read()
        matcher = LightGlue(64, 96, heads=1, layers=6)
        of_matcher = {
            name.removeprefix("matcher."): value
            for name, value in weights.LIGHTERGLUE.read().items()
            if name.startswith("matcher.")
        }
        of_network = {
            name: value for name, value in of_network.items() if not name.startswith("fine_matcher")
        }
    else:
        network, of_network = aliked.Aliked(), weights.ALIKED_N16.read()
        matcher, of_matcher = LightGlue(128, 256, heads=4, layers=9), weights.ALIKED_LIGHTGLUE.read()
    of_matcher = {name: value for name, value in of_matcher.items() if name != "confidence_thresholds"}
    network.load_state_dict(of_network)
    matcher.load_state_dict(of_matcher)
    return network.eval(), matcher.eval()


def _by_quarters(roll: float) -> float:
    """The angle, or the whole quarters of a turn that are near it; in [0, 2π), to a degree."""
    quarters = round(roll / (math.pi / 2)) * math.pi / 2
    nearest = quarters if abs(roll - quarters) <= UPRIGHT_ENOUGH else math.radians(round(math.degrees(roll)))
    return nearest % (2 * math.pi)


def _prepared(
    image: UInt8[ndarray, "h w 3"], roll: float
) -> tuple[Float[Tensor, "3 h2 w2"], Float[ndarray, "3 3"]]:
    """The image turned, reduced and padded for a network, values in 0..1, and given from prepared pixels."""
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    small_size = round(width * scale), round(height * scale)
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA) if scale < 1 else image
    sx, sy = width / small_size[0], height / small_size[1]
    given_from_small = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    cosine, sine = math.cos(roll), math.sin(roll)
    turn = np.array([[cosine, -sine], [sine, cosine]])
    w, h = small_size
    corners = turn @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1]])
    low, extent = corners.min(1), corners.max(1) - corners.min(1)
    turned_from_small = np.eye(3)
    turned_from_small[:2, :2], turned_from_small[:2, 2] = turn, -low
    out = [MULTIPLE * math.ceil((round(float(side)) + 1) / MULTIPLE) for side in extent]
    turned = cv2.warpAffine(
        small,
        turned_from_small[:2],
        (out[0], out[1]),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels = torch.from_numpy(np.ascontiguousarray(turned)).permute(2, 0, 1).float() / 255
    return pixels, given_from_small @ np.linalg.inv(turned_from_small)


def _mapped(x_px: Float[ndarray, "k 2"], to_from: Float[ndarray, "3 3"]) -> Float[ndarray, "k 2"]:
    """Pixels under an affine map."""
    return x_px @ to_from[:2, :2].T + to_from[:2, 2]


@contextmanager
def _one_thread():
    """Torch's threads wait for each other after every short operation, ten times slower where cores are busy."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
