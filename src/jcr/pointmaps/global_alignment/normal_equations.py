"""Gauss-Newton equations of pairwise pointmaps, reduced to cameras, focal lengths and pair scales.

Depths are eliminated pixel by pixel (Schur complement; Triggs et al., "Bundle adjustment: a modern
synthesis", 2000, section 6). So are the rigid errors of the pairs' second views: they stand for the pair
poses P_e of eq. 1, free there, here tied to the cameras by a spread that is measured (gauss_newton.py).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.geometry import skew
from jcr.pointmaps.global_alignment.observations import ImageObservations
from jcr.pointmaps.global_alignment.pointmap_residuals import Noise, Residuals, agreement


@dataclass(frozen=True)
class Layout:
    """Order of the unknowns in the reduced system: steps of the cameras, log focal, log pair scales."""

    images: int
    pairs: int

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 6 * self.images + 1 + self.pairs

    @property
    def focal(self) -> int:
        """Column of the log focal."""
        return 6 * self.images

    @property
    def scales(self) -> Int[ndarray, " e"]:
        """Columns of the log pair scales."""
        return 6 * self.images + 1 + np.arange(self.pairs)


def depth_equations(
    r: Residuals, noise: Noise, weight: Float[ndarray, "k m"]
) -> tuple[Float[ndarray, " m"], Float[ndarray, " m"]]:
    """Return the Gauss-Newton hessian and gradient of the log depths alone, every pointmap independent."""
    weight = weight / r.distance
    w_across = weight / noise.across[:, None] ** 2
    w_along = weight / noise.along[:, None] ** 2
    along_arm = _dot(r.toward, r.depth_arm)
    hessian = (w_along - w_across) / r.distance * along_arm**2
    hessian += w_across / r.distance * (r.depth_arm**2).sum(axis=0)
    gradient = w_along * r.along * along_arm - w_across * _dot(r.across, r.depth_arm)
    total = hessian.sum(axis=0)
    return total + np.float32(1e-6) * total.max() + np.float32(1e-30), gradient.sum(axis=0)


@dataclass(frozen=True, kw_only=True)
class ImageEquations:
    """Gauss-Newton equations of one image: local unknowns are relative twists, its pair scales, its focal.

    Twists are those of geometry.twist_from_step: points of an image move with its camera, so that only the difference
    of the twists of image and observer shows in a pointmap.
    """

    hessian: Float[ndarray, "c c"]
    gradient: Float[ndarray, " c"]
    depth_hessian: Float[ndarray, " m"]
    depth_gradient: Float[ndarray, " m"]
    coupling: Float[ndarray, "c m"]

    def depth_step(self, local_step: Float[ndarray, " c"]) -> Float[ndarray, " m"]:
        """Return the change of log depth after a step of the local unknowns."""
        return -(self.depth_gradient + local_step.astype(np.float32) @ self.coupling) / self.depth_hessian

    def reduced(self, ties: "PairTies") -> "ReducedEquations":
        """Eliminate the depths, and then the errors of the pairs under their ties."""
        scaled = self.coupling / self.depth_hessian
        hessian = self.hessian - (scaled @ self.coupling.T).astype(np.float64)
        gradient = self.gradient - (scaled @ self.depth_gradient).astype(np.float64)
        count = 6 * len(ties.error)
        twists = np.arange(count).reshape(-1, 6)
        tied = hessian[:count, :count].copy()
        tied[twists[:, :, None], twists[:, None, :]] += ties.information
        covariance = np.linalg.inv(tied)
        gain = covariance @ hessian[:count]
        offset = covariance @ (gradient[:count] - ties.pull.ravel())
        own_covariance = covariance[twists[:, :, None], twists[:, None, :]]
        return ReducedEquations(
            hessian=hessian - hessian[:, :count] @ gain,
            gradient=gradient - hessian[:, :count] @ offset,
            gain=gain,
            offset=offset,
            error_variance=np.einsum("kij,kjl,kil->ki", ties.axes, own_covariance, ties.axes),
        )


@dataclass(frozen=True)
class PairTies:
    """Prior on the errors of an image's second views."""

    axes: Float[ndarray, "n 6 6"]
    """Adjoint of the observers: twists in recon axes to twists in theirs."""
    error: Float[ndarray, "n 6"]
    """Present value, in the observers' axes."""
    spread: Float[ndarray, "6"]

    @property
    def information(self) -> Float[ndarray, "n 6 6"]:
        """Information on the errors' changes, recon axes."""
        return self.axes.transpose(0, 2, 1) @ (self.axes / self.spread[:, None] ** 2)

    @property
    def pull(self) -> Float[ndarray, "n 6"]:
        """Gradient at the present value, recon axes."""
        return np.einsum("kji,kj->ki", self.axes, self.error / self.spread**2)


@dataclass(frozen=True, kw_only=True)
class ReducedEquations:
    """Equations of one image's local unknowns, without its depths and the errors of its pairs."""

    hessian: Float[ndarray, "c c"]
    gradient: Float[ndarray, " c"]
    gain: Float[ndarray, "t c"]
    offset: Float[ndarray, " t"]
    error_variance: Float[ndarray, "n 6"]
    """Variances of the pairs' errors where the cameras are given, in the observers' axes."""

    def pair_step(self, local_step: Float[ndarray, " c"]) -> Float[ndarray, "n 6"]:
        """Return the change of the pairs' errors (recon axes) after a step of the local unknowns."""
        return (self.gain @ local_step + self.offset).reshape(-1, 6)


def image_equations(observations: ImageObservations, r: Residuals, noise: Noise) -> ImageEquations:
    """Return the Gauss-Newton equations of one image's pointmaps with residuals `r` of spread `noise`.

    With v the change of a modelled point, the change of (across, along) has the squared norm
    vᵀ (α I + β x̂ x̂ᵀ) v, α = w_across/|x|², β = w_along/|x|² − α; every block below is that form for two of
    the directions an unknown moves the point in: twist (I, −[X]), depth (the arm), focal.
    """
    o, n = observations, observations.second_count
    # Of mean 1, so that the hessian is the information in the pointmaps.
    robust = o.weight / np.maximum(o.weight.mean(), np.float32(1e-12)) * agreement(r, noise)
    w_across = robust / (noise.across**2 * noise.across_inflation)[:, None]
    w_along = robust / (noise.along**2 * noise.along_inflation)[:, None]
    alpha = w_across / r.distance**2
    beta = w_along / r.distance**2 - alpha
    toward, arm, focal_arm = r.toward, r.depth_arm, r.focal_arm
    depth_pull, focal_pull = _pull(alpha, beta, toward, arm), _pull(alpha, beta, toward, focal_arm)
    scale_pull = -w_along / r.distance
    residual_force = (w_along * r.along / r.distance)[:, None] * toward
    residual_force -= (w_across / r.distance)[:, None] * r.across
    screw = _moments(r.x_in_recon, toward[:n])

    maps = len(o.pair)
    size = 6 * n + maps + 1
    twists = np.arange(6 * n).reshape(n, 6)
    scales = 6 * n + np.arange(maps)
    hessian = np.zeros((size, size))
    hessian[twists[:, :, None], twists[:, None, :]] = (screw * beta[:n, None]) @ screw.transpose(0, 2, 1)
    hessian[twists[:, :, None], twists[:, None, :]] += _isotropic(alpha[:n], r.x_in_recon)
    hessian[twists, scales[:n, None]] = np.einsum("km,kcm->kc", scale_pull[:n], screw)
    hessian[twists, -1] = _moments(r.x_in_recon, focal_pull[:n]).sum(axis=2)
    hessian[scales, scales] = w_along.sum(axis=1)
    hessian[scales, -1] = np.einsum("km,km->k", scale_pull, _dot(toward, focal_arm))
    hessian[-1, -1] = np.vdot(focal_pull.sum(axis=0), focal_arm)
    hessian[scales[:n, None], twists] = hessian[twists, scales[:n, None]]
    hessian[-1, :-1] = hessian[:-1, -1]

    gradient = np.concatenate(
        [
            _moments(r.x_in_recon, residual_force[:n]).sum(axis=2).ravel(),
            -(w_along * r.along).sum(axis=1),
            [np.vdot(residual_force.sum(axis=0), focal_arm)],
        ]
    )
    coupling = np.concatenate(
        [
            _moments(r.x_in_recon, depth_pull[:n]).reshape(6 * n, arm.shape[1]),
            scale_pull * _dot(toward, arm),
            (depth_pull.sum(axis=0) * focal_arm).sum(axis=0)[None],
        ]
    )
    depth_hessian = (depth_pull.sum(axis=0) * arm).sum(axis=0)
    # A pixel without weight keeps its depth.
    depth_hessian += np.float32(1e-6) * depth_hessian.max() + np.float32(1e-30)
    return ImageEquations(
        hessian=hessian,
        gradient=gradient,
        depth_hessian=depth_hessian,
        depth_gradient=(residual_force.sum(axis=0) * arm).sum(axis=0),
        coupling=coupling,
    )


def _pull(
    alpha: Float[ndarray, "k m"],
    beta: Float[ndarray, "k m"],
    toward: Float[ndarray, "k 3 m"],
    v: Float[ndarray, "3 m"],
) -> Float[ndarray, "k 3 m"]:
    """Return (α I + β x̂ x̂ᵀ) v."""
    return alpha[:, None] * v + (beta * _dot(toward, v))[:, None] * toward


def _moments(x: Float[ndarray, "3 m"], force: Float[ndarray, "n 3 m"]) -> Float[ndarray, "n 6 m"]:
    """Return (I, −[X])ᵀ applied to forces at points X: force and moment."""
    out = np.empty((len(force), 6, x.shape[1]), np.float32)
    out[:, :3] = force
    for row, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)), start=3):
        out[:, row] = x[a] * force[:, b] - x[b] * force[:, a]
    return out


def _isotropic(alpha: Float[ndarray, "n m"], x: Float[ndarray, "3 m"]) -> Float[ndarray, "n 6 6"]:
    """Return Σ α (I, −[X])ᵀ (I, −[X]) over the pixels, from the weights' moments of X."""
    products = (x[:, None] * x).reshape(9, -1)
    moments = alpha @ np.concatenate([np.ones_like(x[:1]), x, products]).T
    second = moments[:, 4:].reshape(-1, 3, 3)
    out = np.zeros((len(alpha), 6, 6))
    out[:, :3, :3] = moments[:, :1, None] * np.eye(3)
    out[:, 3:, :3] = skew(moments[:, 1:4].astype(np.float64))
    out[:, :3, 3:] = out[:, 3:, :3].transpose(0, 2, 1)
    out[:, 3:, 3:] = np.trace(second, axis1=1, axis2=2)[:, None, None] * np.eye(3) - second
    return out


def _dot(a: Float[ndarray, "k 3 m"], v: Float[ndarray, "3 m"]) -> Float[ndarray, "k m"]:
    """Return the dot products over the components."""
    return np.einsum("kcm,cm->km", a, v)
