"""Verified two-view geometries of matched features, for any kind of features."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, Protocol, runtime_checkable

import pycolmap
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.features.gate import Key
from jcr.features.verify import Geometries, matched

FeatureName = Literal["sift", "xfeat"]


@runtime_checkable
class Features(Protocol):
    """Keypoints of a capture's images, of any kind."""

    x_px: list[Float[ndarray, "_ 2"]]
    """Keypoints of every image found so far, px; pixel centres are whole numbers."""

    @property
    def minds_roll(self) -> bool:
        """True if the features need images that are rotated upright."""
        ...

    @property
    def every_pair(self) -> int:
        """Captures of up to this many images have all pairs matched; of more, pairs grow in proportion to the images."""
        ...

    def matches(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> list[Int[ndarray, "_ 2"]]:
        """Return rows of matching keypoints of pairs, their images rotated (rad) before; `coarse`: of the best ones."""
        ...


class Matcher:
    """Verified matches between a capture's images, all of one camera."""

    def __init__(
        self, features: Features, scale: Float[ndarray, "2"], camera: pycolmap.Camera, known: bool, seed: int
    ) -> None:
        """`camera` is at the working size, `scale` its pixels per pixel of the features, `known` as of `matched`."""
        self._features, self._scale = features, scale
        self._camera, self.known, self.seed = camera, known, seed
        self.minds_roll, self.every_pair = features.minds_roll, features.every_pair
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}
        """All matches of the pairs that were tried last, right or wrong."""
        self.x_px = self._at_work()
        """Keypoints at the working size; more come with every angle by which an image is rotated."""

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> Geometries:
        """Return verified two-view geometries of pairs, their images rotated (rad) before; `coarse` as in Features."""
        self.raw |= dict(zip(pairs, self._features.matches(pairs, rolls, coarse), strict=True))
        self.x_px = self._at_work()
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda key: self.verified(key, self.raw[key]), pairs)
            return {key: geometry for key, geometry in zip(pairs, found, strict=True) if geometry is not None}

    def verified(self, key: Key, rows: Int[ndarray, "m 2"]) -> pycolmap.TwoViewGeometry | None:
        """Return the geometry of some of a pair's matches; None where too few agree on one."""
        return matched(self.x_px, self._camera, *key, rows, self.seed, self.known)

    def _at_work(self) -> list[Float[ndarray, "_ 2"]]:
        return [(x + 0.5) * self._scale - 0.5 for x in self._features.x_px]
