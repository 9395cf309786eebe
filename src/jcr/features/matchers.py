"""Verified two-view geometries of matched features, for any kind of features."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import pycolmap
from jaxtyping import Float, Float32, Int
from numpy import ndarray

from jcr.features.gate import Key, Pair
from jcr.features.verify import Geometries, View, matched, pair_of
from jcr.records import Intrinsics

FeatureName = Literal["sift", "xfeat"]


@runtime_checkable
class Features(Protocol):
    """Keypoints of a capture's images, of any kind."""

    x_px: list[Float[ndarray, "_ 2"]]
    """Keypoints of every image found so far, px; pixel centres are whole numbers."""
    descriptors: list[Float32[ndarray, "_ d"]]
    """Descriptors of these keypoints, of unit length."""
    farthest: float
    """Largest distance of the descriptors of a match."""

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
        self.farthest = features.farthest
        self.raw: dict[Key, Int[ndarray, "_ 2"]] = {}
        """All matches of the pairs that were tried last, right or wrong."""
        self._verified: dict[tuple[Key, bytes], pycolmap.TwoViewGeometry | None] = {}
        """Geometries by pair and matches."""
        self._pairs: dict[tuple[Key, int, Intrinsics], tuple[Pair, pycolmap.TwoViewGeometry]] = {}
        """Pairs by the identity of their geometry, which is kept with them so that no other takes its place."""
        self.x_px = self._at_work()
        """Keypoints at the working size; more come with every angle by which an image is rotated."""

    def geometries(
        self, pairs: Sequence[Key], rolls: Float[ndarray, "p 2"], coarse: bool = False
    ) -> Geometries:
        """Return verified two-view geometries of pairs, their images rotated (rad) before; `coarse` as in Features."""
        new = [k for k, key in enumerate(pairs) if self.minds_roll or key not in self.raw]
        some = [pairs[k] for k in new]
        self.raw |= dict(zip(some, self._features.matches(some, rolls[new], coarse), strict=True))
        self.x_px = self._at_work()
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            found = pool.map(lambda key: self.verified(key, self.raw[key]), pairs)
            return {key: geometry for key, geometry in zip(pairs, found, strict=True) if geometry is not None}

    @property
    def descriptors(self) -> list[Float32[ndarray, "_ d"]]:
        """Unit descriptors of the keypoints of every image."""
        return self._features.descriptors

    def verified(self, key: Key, rows: Int[ndarray, "m 2"]) -> pycolmap.TwoViewGeometry | None:
        """Return the geometry of some of a pair's matches, kept in memory; None where too few agree on one."""
        depends = key, np.ascontiguousarray(rows).tobytes()
        if depends not in self._verified:
            self._verified[depends] = matched(self.x_px, self._camera, *key, rows, self.seed, self.known)
        return self._verified[depends]

    def pair(self, view: View, key: Key, geometry: pycolmap.TwoViewGeometry) -> Pair:
        """Return a geometry with its readings through the view's intrinsics, kept in memory."""
        depends = key, id(geometry), view.intrinsics
        if depends not in self._pairs:
            self._pairs[depends] = pair_of(view, *key, geometry), geometry
        return self._pairs[depends][0]

    def image_added(self) -> None:
        """Read the keypoints of an image that the features have since the last pairs."""
        self.x_px = self._at_work()

    def image_removed(self, row: int) -> None:
        """Forget the pairs of an image that the features no longer have; the rows of later images are one less."""
        self.x_px = self._at_work()

        def after(key: Key) -> Key:
            """Return the rows of a pair without the image."""
            return key[0] - (key[0] > row), key[1] - (key[1] > row)

        self._pairs.clear()
        self.raw = {after(key): rows for key, rows in self.raw.items() if row not in key}
        self._verified = {
            (after(key), rows): one for (key, rows), one in self._verified.items() if row not in key
        }

    def _at_work(self) -> list[Float[ndarray, "_ 2"]]:
        return [(x + 0.5) * self._scale - 0.5 for x in self._features.x_px]
