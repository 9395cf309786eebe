"""SIFT features of all images of a capture, found once, and matched in memory."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray

from jcr.features.gate import Key
from jcr.features.sift import FARTHEST, Sift, detect, grey_of, matches
from jcr.progress import Progress, steps


class SiftFeatures:
    """SIFT of a capture's images at a working size; how images are rotated against each other is no matter."""

    minds_roll = False
    every_pair = 24
    farthest = FARTHEST

    def __init__(
        self,
        images: Sequence[UInt8[ndarray, "h w 3"]],
        size: tuple[int, int],
        threads: int,
        report: Progress,
    ) -> None:
        """Find the features of all images, some at once."""
        self.x_px: list[Float[ndarray, "_ 2"]] = []
        """Keypoints of every image, in pixels of images of `size`."""
        self.descriptors: list[Float32[ndarray, "_ 128"]] = []
        """Descriptors of these keypoints, of unit length."""
        self._size = size
        with ThreadPoolExecutor(threads) as pool:
            found = pool.map(self._of_image, images)
            for _, one in zip(steps(report, "features", images), found, strict=True):
                self._append(one)

    def add(self, image: UInt8[ndarray, "h w 3"]) -> None:
        """Find the features of one more image."""
        self._append(self._of_image(image))

    def remove(self, row: int) -> None:
        """Remove an image; the rows of later ones are one less."""
        del self.x_px[row], self.descriptors[row]

    def _append(self, found: Sift) -> None:
        self.x_px.append(found[0])
        self.descriptors.append(found[1])

    def _of_image(self, image: UInt8[ndarray, "h w 3"]) -> Sift:
        """Return the features of an image at the working size."""
        return detect(grey_of(image, self._size))

    def matches(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> list[Int[ndarray, "_ 2"]]:
        """Return rows of matching keypoints of each pair; SIFT uses neither the rotations (rad) nor `coarse`."""

        def of_pair(key: Key) -> Int[ndarray, "_ 2"]:
            return np.stack(matches(self.descriptors[key[0]], self.descriptors[key[1]]), 1)

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return list(pool.map(of_pair, pairs))
