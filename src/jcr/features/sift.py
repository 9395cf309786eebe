"""SIFT keypoints, descriptors and matches by OpenCV, which is three times as fast as COLMAP.

Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from hashlib import blake2b

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8
from numpy import ndarray
from PIL import Image

from jcr.features.pair_verification import Key
from jcr.progress import Progress, steps

WORKING_SIZE_PX = 1600
"""Largest long side of an image in which features are found, px; larger images are reduced to it."""
SIFT_KEYPOINTS = 2000
"""Largest number of keypoints of an image, those of highest contrast."""
CONTRAST = 0.01
"""Least contrast of a keypoint. With COLMAP's 0.02 elephant_floor has 420 an image, and 2 of its 15 images register."""
RATIO = 0.8
"""Largest ratio of the descriptor distances to the nearest and the second nearest keypoint (Lowe 2004)."""
KEPT = 64
"""Number of images whose keypoints are remembered, 1 MB each: several stages ask for those of the same image."""
_kept: dict[bytes, tuple[Float[ndarray, "k 2"], Float32[ndarray, "k 128"]]] = {}
"""Keypoints and descriptors by the digest of the grey image, the oldest first."""
SIFT_DISTANCE = 0.7
"""Largest distance of the unit descriptors of a match, as in COLMAP."""


def grey_of(pixels: UInt8[ndarray, "h w 3"], size: tuple[int, int]) -> UInt8[ndarray, "h2 w2"]:
    """Return an image in grey, resized to `size` (width, height) by OpenCV's area interpolation.

    Pillow's BOX filter, which does not divide a pixel between two areas, moves 2400 px images by 0.25 px.
    """
    grey = np.asarray(Image.fromarray(pixels).convert("L"))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def detect(grey: UInt8[ndarray, "h w"]) -> tuple[Float[ndarray, "k 2"], Float32[ndarray, "k 128"]]:
    """Return keypoints (x, y in px; pixel centres are whole numbers) and unit descriptors (RootSIFT) of a grey image.

    The arrays are empty if nothing is found. They are not writable, because the last KEPT results are remembered.
    """
    key = blake2b(grey.tobytes(), key=repr(grey.shape).encode()).digest()
    found = _kept.get(key)
    if found is None:
        found = _detected(grey)
        for each in found:
            each.flags.writeable = False
        for oldest in list(_kept)[: len(_kept) + 1 - KEPT]:
            _kept.pop(oldest, None)
        _kept[key] = found
    return found


def _detected(grey: UInt8[ndarray, "h w"]) -> tuple[Float[ndarray, "k 2"], Float32[ndarray, "k 128"]]:
    """Return keypoints and descriptors as in `detect`, which remembers them."""
    # Without the precise upscaling every point is off by a quarter of a pixel.
    sift = cv2.SIFT.create(nfeatures=SIFT_KEYPOINTS, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    points, descriptors = sift.detectAndCompute(grey, None)
    if not points:
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    # The Hellinger distance replaces the Euclidean one (RootSIFT, Arandjelović and Zisserman 2012).
    root = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    return np.array([point.pt for point in points]), root


def matches(
    first: Float32[ndarray, "k 128"], second: Float32[ndarray, "l 128"]
) -> tuple[Int[ndarray, " m"], Int[ndarray, " m"]]:
    """Return the matches of two images as rows of `first` and of `second` (unit descriptors).

    Matches are mutual nearest neighbours that are nearer than SIFT_DISTANCE and pass the ratio test (RATIO). There are
    none if an image has fewer than two descriptors.
    """
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, int), np.zeros(0, int)
    cosine = first @ second.T
    row, best = np.arange(len(first)), cosine.argmax(1)
    largest = cosine[row, best]
    mutual = largest == cosine.max(0)[best]  # argmax along columns takes 2.4 times as long
    cosine[row, best] = -1.0
    # Distances of unit vectors from their cosines.
    nearest, next_nearest = (np.sqrt(np.maximum(2 - 2 * of, 0)) for of in (largest, cosine.max(1)))
    kept = np.flatnonzero(mutual & (nearest < SIFT_DISTANCE) & (nearest < RATIO * next_nearest))
    return kept, best[kept]


class SiftFeatures:
    """SIFT keypoints and descriptors of images reduced to one size; image rotation does not change them."""

    needs_upright = False
    every_pair = 24
    farthest = SIFT_DISTANCE

    def __init__(
        self, images: Sequence[UInt8[ndarray, "h w 3"]], size: tuple[int, int], threads: int, report: Progress
    ) -> None:
        """Find the features of all images (RGB), resized to `size` (width, height), in `threads` threads."""
        self._size = size
        with ThreadPoolExecutor(threads) as pool:
            found = pool.map(lambda image: detect(grey_of(image, size)), images)
            both = [one for _, one in zip(steps(report, "features", images), found, strict=True)]
        self.x_px: list[Float[ndarray, "_ 2"]] = [x_px for x_px, _ in both]
        """Keypoints of every image, in pixels of images of `size`."""
        self.descriptors: list[Float32[ndarray, "_ 128"]] = [descriptors for _, descriptors in both]
        """Descriptors of these keypoints, of unit length."""

    def add(self, image: UInt8[ndarray, "h w 3"]) -> None:
        """Find the features of one more image (RGB) and append them as the last row."""
        x_px, descriptors = detect(grey_of(image, self._size))
        self.x_px.append(x_px)
        self.descriptors.append(descriptors)

    def remove(self, row: int) -> None:
        """Remove the features of an image; rows of later images decrease by one."""
        del self.x_px[row], self.descriptors[row]

    def matches(self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"]) -> list[Int[ndarray, "_ 2"]]:
        """Return for each pair its m matches, as rows of keypoints of its first and of its second image (m,2).

        SIFT does not use the rotations `rolls`.
        """
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda key: matches(*(self.descriptors[row] for row in key)), pairs)
            return [np.stack(rows, 1) for rows in found]
