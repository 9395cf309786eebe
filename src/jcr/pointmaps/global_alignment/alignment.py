"""Result of the global alignment of pairwise pointmaps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import rays
from jcr.records import Intrinsics


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """One reconstruction from pairwise pointmaps: a camera and a depth map per image, a scale per pair.

    The recon frame is the camera frame of image 0; its unit is the geometric mean of the pairs' own units, so
    metric predictions give metres.
    """

    recon_from_camera: Float[ndarray, "n 4 4"]
    focal_px: tuple[float, float]
    """fx, fy, common to all images."""
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
        pinhole = Intrinsics(*self.focal_px, *self.principal_point_px, width, height)
        return rays(pinhole).astype(np.float32) * self.depth[..., None]
