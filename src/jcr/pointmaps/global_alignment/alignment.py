"""Options and result of global alignment."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import rays
from jcr.errors import InputError
from jcr.pointmaps.pairs import PairPredictions
from jcr.records import Intrinsics

LEAST_PIXELS = 50
"""Least number of pixels per image: several for each coarse cell of the correlation of residuals."""


@dataclass(frozen=True, kw_only=True)
class AlignOptions:
    """Options of global alignment."""

    focal: Literal["auto", "shared", "own", "given"] = "auto"
    """shared: one for all images; own: one per image; given: fixed at the predictions' intrinsics; auto: given
    where the predictions carry intrinsics, else shared."""
    principal_point_px: tuple[float, float] | None = None
    """x, y on the pointmaps' grid, pixel (0, 0) being a centre; unset: the predictions' intrinsics where they
    carry them, else the image's middle, ((W - 1)/2, (H - 1)/2)."""
    pixels: int = 2048
    """Pixels per image, the most confident of as many equal cells."""


@dataclass(frozen=True)
class Pinhole:
    """Common projection of the images, up to the focal lengths that alignment estimates."""

    principal_point_px: tuple[float, float]
    aspect: float
    """Ratio fy / fx."""
    focal_px: float | None
    """Given fx; None: estimated."""
    shared: bool
    """Whether all images have one focal length."""


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """One reconstruction from pairwise pointmaps: a camera and a depth map per image, a scale per pair.

    The recon frame is the camera frame of image 0; its unit is the geometric mean of the pairs' own units, so
    metric predictions give metres.
    """

    recon_from_camera: Float[ndarray, "n 4 4"]
    focal_px: Float[ndarray, "n 2"]
    """fx, fy of each image."""
    principal_point_px: tuple[float, float]
    depth: Float[ndarray, "n h w"]
    """Depth along the optical axis, recon units."""
    confidence: Float[ndarray, "n h w"]
    """Confidence of the network, averaged over the pairs, weighted by their agreement with this depth."""
    pair_scale: Float[ndarray, " e"]
    """σ_e: recon units per unit of the pair's pointmaps (paper eq. 1)."""
    pair_residual: Float[ndarray, " e"]
    """Typical distance of a pair's points from the reconstruction, relative to that from the camera."""
    covariance: Float[ndarray, "r r"]
    """Covariance of the steps of all cameras (translation, rotation), r = 6n; zero for image 0."""
    notes: tuple[str, ...] = ()
    """Pairs that contradict the others and count little."""
    warnings: tuple[str, ...] = ()
    """Faults of the alignment that the user must act on, such as pairs that agree on nothing."""

    def x_in_camera(self) -> Float[ndarray, "n h w 3"]:
        """Return the points of all pixels in their cameras' frames, float32."""
        _, height, width = self.depth.shape
        cx, cy = self.principal_point_px
        ray = [rays(Intrinsics(fx, fy, cx, cy, width, height)) for fx, fy in self.focal_px]
        return np.stack(ray).astype(np.float32) * self.depth[..., None]


def pinhole_of(predictions: PairPredictions, options: AlignOptions) -> Pinhole:
    """Return the known part of the projection before alignment.

    Raises InputError where a given focal length is asked for and the predictions carry none.
    """
    given = predictions.intrinsics
    if options.focal == "given" and given is None:
        raise InputError(
            "focal 'given', but the predictions carry no intrinsics; add them or ask for 'shared'"
        )
    height, width = predictions.conf.shape[1:]
    middle = ((width - 1) / 2, (height - 1) / 2) if given is None else (given.cx, given.cy)
    return Pinhole(
        principal_point_px=options.principal_point_px or middle,
        aspect=given.fy / given.fx if given else 1.0,
        focal_px=given.fx if given and options.focal in ("auto", "given") else None,
        shared=options.focal != "own",
    )


def check_options(options: AlignOptions) -> None:
    """Raise InputError for numbers that no alignment can work with."""
    if options.pixels < LEAST_PIXELS:
        raise InputError(
            f"{options.pixels} pixels per image are too few; alignment needs {LEAST_PIXELS} or more"
        )


def check_connected(predictions: PairPredictions) -> None:
    """Raise InputError naming the images that no chain of pairs joins to the first."""
    count = predictions.image_count
    if len(predictions.edges) == 0:
        raise InputError("the predictions have no pair; predict at least one")
    reached = np.zeros(count, dtype=bool)
    reached[predictions.edges[0, 0]] = True
    for _ in range(count):
        joined = reached[predictions.edges].any(axis=1)
        reached[predictions.edges[joined].ravel()] = True
    if not reached.all():
        names = ", ".join(predictions.names[k] for k in np.flatnonzero(~reached))
        raise InputError(
            f"no chain of pairs joins {names} to the other images; predict pairs between them, "
            "or leave these images out"
        )
