"""XFeat features of images that are rotated about the viewing axis first, matched by LightGlue.

The networks do not match images that are rotated against each other.
"""

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from threadpoolctl import threadpool_limits
from torch import Tensor

from jcr.features import xfeat
from jcr.features.gate import Key, by_quarters
from jcr.progress import Progress, silent, steps

LONG_SIDE_PX = 1024
"""Larger images are reduced to this."""
KEYPOINTS = 1280
"""Largest number of keypoints of an image."""
COARSE = 512
"""Number of the best keypoints with which the search for X's rotation begins; a pair takes a quarter of the time."""


@dataclass(frozen=True)
class _Keypoints:
    """Keypoints found in a rotated image, best first."""

    start: int
    """Row of the first one among all keypoints of the image."""
    x_px: Float[Tensor, "k 2"]
    """Position in the rotated image."""
    descriptor: Float[Tensor, "k d"]
    size: tuple[int, int]
    """Width and height of the rotated image."""

    def best(self, count: int) -> "_Keypoints":
        """Return the best `count` keypoints."""
        return replace(self, x_px=self.x_px[:count], descriptor=self.descriptor[:count])


class LearnedFeatures:
    """Keypoints of a capture's images, and a matcher that rotates the images before.

    The keypoints do not rotate with the image (chance alone finds as many again), so every angle has keypoints of its
    own, and `x_px` grows with each new angle.
    """

    minds_roll = True
    every_pair = 12
    farthest = xfeat.FARTHEST

    def __init__(self, images: Sequence[UInt8[ndarray, "h w 3"]], report: Progress = silent) -> None:
        """Load the networks; keypoints are found when pairs are matched."""
        self._images, self._report = list(images), report
        self._network, self._matcher = xfeat.networks()
        self._sets: dict[tuple[int, int], _Keypoints] = {}
        self.x_px: list[Float[ndarray, "_ 2"]] = [np.zeros((0, 2)) for _ in images]
        """Keypoints of every image at all angles, px; pixel centres are whole numbers."""
        self.descriptors: list[Float32[ndarray, "_ d"]] = [np.zeros((0, xfeat.LENGTH), np.float32)] * len(
            images
        )
        """Descriptors of these keypoints, of unit length."""

    def matches(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> list[Int[ndarray, "_ 2"]]:
        """Match many pairs on all cores; `coarse` uses the best COARSE keypoints of each image only."""
        with ThreadPoolExecutor(os.cpu_count(), initializer=_one_thread) as pool:
            self._find_all(pairs, rolls, pool)
            most = COARSE if coarse else KEYPOINTS
            found = [
                (self._sets[_key(i, roll_i)].best(most), self._sets[_key(j, roll_j)].best(most))
                for (i, j), (roll_i, roll_j) in zip(pairs, rolls, strict=True)
            ]
            rows = pool.map(lambda both: self._matched(*both), found)
            return [of for _, of in zip(steps(self._report, "matching", pairs), rows, strict=True)]

    def _matched(self, first: _Keypoints, second: _Keypoints) -> Int[ndarray, "m 2"]:
        """Return rows of the matching keypoints, counted among all keypoints of the two images."""
        rows, _ = xfeat.match(
            self._matcher,
            (first.x_px, second.x_px),
            (first.descriptor, second.descriptor),
            (first.size, second.size),
        )
        return rows.numpy() + [first.start, second.start]

    def _find_all(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], pool: ThreadPoolExecutor) -> None:
        """Find the keypoints of all rotated images that have none yet."""
        wanted = dict.fromkeys(
            _key(row, float(roll))
            for key, both in zip(pairs, rolls, strict=True)
            for row, roll in zip(key, both, strict=True)
        )
        new = [key for key in wanted if key not in self._sets]
        for key, found in zip(new, pool.map(self._detected, new), strict=True):
            self._keep(key, *found)

    def _detected(self, key: tuple[int, int]) -> tuple[_Keypoints, Float[ndarray, "k 2"]]:
        """Return the keypoints of an image rotated by whole degrees, and their positions in the image as given."""
        row, degrees = key
        pixels, given_from_rotated = _prepared(self._images[row], math.radians(degrees))
        x_px, descriptor = xfeat.detect(self._network, pixels, KEYPOINTS)
        given = _mapped(x_px.double().numpy(), given_from_rotated)
        height, width = self._images[row].shape[:2]
        inside = ((given > 2) & (given < [width - 3, height - 3])).all(1)  # not in the replicated border
        kept = torch.from_numpy(inside)
        return _Keypoints(0, x_px[kept], descriptor[kept], (pixels.shape[2], pixels.shape[1])), given[inside]

    def _keep(self, key: tuple[int, int], found: _Keypoints, x_px: Float[ndarray, "k 2"]) -> None:
        """Append keypoints of a rotated image; `x_px` are their positions in the image as given."""
        row, _ = key
        self._sets[key] = replace(found, start=len(self.x_px[row]))
        self.x_px[row] = np.concatenate([self.x_px[row], x_px])
        self.descriptors[row] = np.concatenate([self.descriptors[row], found.descriptor.numpy()])


def _key(row: int, roll: float) -> tuple[int, int]:
    """Return the row and the angle to a degree, by which the keypoints of a rotated image are found again."""
    return row, round(math.degrees(by_quarters(roll)))


def _prepared(
    image: UInt8[ndarray, "h w 3"], roll: float
) -> tuple[Float[Tensor, "3 h2 w2"], Float[ndarray, "3 3"]]:
    """Return the image rotated, reduced and padded, values in 0..1, and the affine map given_from_prepared of pixels."""
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
    out = [xfeat.MULTIPLE * math.ceil((round(float(side)) + 1) / xfeat.MULTIPLE) for side in extent]
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
    """Return pixels under an affine map."""
    return x_px @ to_from[:2, :2].T + to_from[:2, 2]


def _one_thread() -> None:
    """Limit torch to one thread in this thread alone; several wait for each other after every short operation."""
    torch.get_num_threads()  # Torch sets the number of a thread when it is first used there, and not again.
    threadpool_limits(1, user_api="openmp")
