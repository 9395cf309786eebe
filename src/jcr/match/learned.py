"""Features by networks, found in images that are rotated about the viewing axis first.

The networks are not made for images that are rotated against each other.
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from torch import Tensor

from jcr.match import aliked, weights, xfeat
from jcr.match.gate import Key, by_quarters
from jcr.match.lightglue import LightGlue
from jcr.progress import Progress, silent, steps

LONG_SIDE_PX = 1024
"""Larger images are reduced to this."""
KEYPOINTS = {"xfeat": 1280, "aliked": 1024}
"""Of an image at most. ALIKED's matcher is ten times slower than XFeat's."""
COARSE = 512
"""Of the best keypoints, with which the search for X's rotation begins: a pair takes a quarter of the time of all."""
MULTIPLE = 32


@dataclass(frozen=True)
class _Set:
    """Keypoints found in an image that was rotated."""

    start: int
    """Row of the first among all keypoints of the image."""
    x_px: Float[Tensor, "k 2"]
    """In the rotated image."""
    descriptor: Float[Tensor, "k d"]
    size: tuple[int, int]
    """Of the rotated image: width, height."""

    def best(self, count: int) -> "_Set":
        """The first, which are the best."""
        return replace(self, x_px=self.x_px[:count], descriptor=self.descriptor[:count])


class LearnedFeatures:
    """Keypoints of a capture's images, and a matcher that rotates the images as asked.

    What the networks find does not rotate with the image (of a thousand keypoints chance finds as many again):
    every angle
    has keypoints of its own, and `x_px` grows as angles are asked for.
    """

    minds_roll = True
    every_pair = 12

    def __init__(
        self,
        kind: Literal["xfeat", "aliked"],
        images: Sequence[UInt8[ndarray, "h w 3"]],
        report: Progress = silent,
    ) -> None:
        self._kind, self._images, self._report = kind, list(images), report
        self._network, self._matcher = _networks(kind)
        self._sets: dict[tuple[int, int], _Set] = {}
        self.x_px: list[Float[ndarray, "_ 2"]] = [np.zeros((0, 2)) for _ in images]
        """Of every image, all angles together; pixel centres are whole numbers."""

    def add(self, image: UInt8[ndarray, "h w 3"]) -> int:
        """One more image; its row."""
        self._images.append(image)
        self.x_px.append(np.zeros((0, 2)))
        return len(self._images) - 1

    def match(self, i: int, j: int, roll_i: float, roll_j: float) -> Int[ndarray, "m 2"]:
        """Rows of the keypoints of images i and j that match, the images rotated by these angles (rad) before."""
        return self.matches([(i, j)], np.array([[roll_i, roll_j]]))[0]

    def matches(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> list[Int[ndarray, "_ 2"]]:
        """The same of many pairs, on all cores; `coarse`: of the best COARSE keypoints."""
        with _one_thread(), ThreadPoolExecutor(os.cpu_count()) as pool:
            self._find_all(pairs, rolls, pool)
            most = COARSE if coarse else KEYPOINTS[self._kind]
            found = [
                (self._found(i, float(roll_i)).best(most), self._found(j, float(roll_j)).best(most))
                for (i, j), (roll_i, roll_j) in zip(pairs, rolls, strict=True)
            ]
            rows = pool.map(lambda both: self._matched(*both), found)
            return [of for _, of in zip(steps(self._report, "matching", pairs), rows, strict=True)]

    def _matched(self, first: _Set, second: _Set) -> Int[ndarray, "m 2"]:
        rows, _ = self._matcher(
            first.x_px, second.x_px, first.descriptor, second.descriptor, first.size, second.size
        )
        return rows.numpy() + [first.start, second.start]

    def descriptors(self, row: int, roll: float) -> tuple[int, Float[ndarray, "k d"]]:
        """Row of the first keypoint of an image rotated by an angle (rad), and the unit descriptors from there on."""
        with _one_thread():
            found = self._found(row, roll)
        return found.start, found.descriptor.numpy()

    def _find_all(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], pool: ThreadPoolExecutor) -> None:
        """Keypoints of all images, as they are rotated, that have none yet."""
        wanted = dict.fromkeys(
            _key(row, float(roll))
            for key, both in zip(pairs, rolls, strict=True)
            for row, roll in zip(key, both, strict=True)
        )
        new = [key for key in wanted if key not in self._sets]
        for key, found in zip(new, pool.map(self._detected, new), strict=True):
            self._keep(key, *found)

    def _found(self, row: int, roll: float) -> _Set:
        key = _key(row, roll)
        if key not in self._sets:
            self._keep(key, *self._detected(key))
        return self._sets[key]

    def _detected(self, key: tuple[int, int]) -> tuple[_Set, Float[ndarray, "k 2"]]:
        """Keypoints of an image that is rotated by whole degrees, and where they are in the image as given."""
        row, degrees = key
        pixels, given_from_rotated = _prepared(self._images[row], math.radians(degrees))
        count = KEYPOINTS[self._kind]
        if isinstance(self._network, xfeat.XFeat):
            x_px, descriptor = xfeat.detect(self._network, pixels, count)
        else:
            x_px, descriptor = aliked.detect(self._network, pixels, count)
        given = _mapped(x_px.double().numpy(), given_from_rotated)
        height, width = self._images[row].shape[:2]
        inside = ((given > 2) & (given < [width - 3, height - 3])).all(1)  # not in what fills the corners
        kept = torch.from_numpy(inside)
        return _Set(0, x_px[kept], descriptor[kept], (pixels.shape[2], pixels.shape[1])), given[inside]

    def _keep(self, key: tuple[int, int], found: _Set, x_px: Float[ndarray, "k 2"]) -> None:
        row, _ = key
        self._sets[key] = replace(found, start=len(self.x_px[row]))
        self.x_px[row] = np.concatenate([self.x_px[row], x_px])


def _key(row: int, roll: float) -> tuple[int, int]:
    """An image as it is rotated, to a degree."""
    return row, round(math.degrees(by_quarters(roll)))


def _networks(kind: str) -> tuple[xfeat.XFeat | aliked.Aliked, LightGlue]:
    """The published networks of one kind of features; raises as WeightsFile.read does."""
    if kind == "xfeat":
        network, of_network = xfeat.XFeat(), weights.XFEAT.read()
        matcher = LightGlue(64, 96, heads=1, layers=6, least_matchable=0.05, ends_early=False)
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
        matcher = LightGlue(128, 256, heads=4, layers=9, least_matchable=0.01, ends_early=True)
        of_matcher = weights.ALIKED_LIGHTGLUE.read()
    of_matcher = {name: value for name, value in of_matcher.items() if name != "confidence_thresholds"}
    network.load_state_dict(of_network)
    matcher.load_state_dict(of_matcher)
    return network.eval(), matcher.eval()


def _prepared(
    image: UInt8[ndarray, "h w 3"], roll: float
) -> tuple[Float[Tensor, "3 h2 w2"], Float[ndarray, "3 3"]]:
    """The image rotated, reduced and padded for a network, values in 0..1, and given from prepared pixels."""
    height, width = image.shape[:2]
    scale = min(1.0, LONG_SIDE_PX / max(height, width))
    small_size = round(width * scale), round(height * scale)
    small = cv2.resize(image, small_size, interpolation=cv2.INTER_AREA) if scale < 1 else image
    sx, sy = width / small_size[0], height / small_size[1]
    given_from_small = np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]])
    cosine, sine = math.cos(roll), math.sin(roll)
    rotation = np.array([[cosine, -sine], [sine, cosine]])
    w, h = small_size
    corners = rotation @ np.array([[0, w - 1, 0, w - 1], [0, 0, h - 1, h - 1]])
    low, extent = corners.min(1), corners.max(1) - corners.min(1)
    rotated_from_small = np.eye(3)
    rotated_from_small[:2, :2], rotated_from_small[:2, 2] = rotation, -low
    out = [MULTIPLE * math.ceil((round(float(side)) + 1) / MULTIPLE) for side in extent]
    rotated = cv2.warpAffine(
        small,
        rotated_from_small[:2],
        (out[0], out[1]),
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    pixels = torch.from_numpy(np.ascontiguousarray(rotated)).permute(2, 0, 1).float() / 255
    return pixels, given_from_small @ np.linalg.inv(rotated_from_small)


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
