"""Normal equations of pairwise pointmaps against cameras, focal lengths, depths and pair scales.

A predicted point errs differently *across* its line of sight (where in the observer's picture it appears) and
*along* it (how far it is): networks know directions several times better than distances, and their errors in
distance are smooth, so that a thousand pixels do not average them out. Each residual is therefore split,

    across = n − (n·x̂) x̂        along = log|x| − log|q| − log σ_e

(x the modelled point seen from the observer, x̂ its direction; q the predicted point, n its direction, both
turned into the recon axes), and the two parts are weighted by variances measured on the residuals themselves:
per pointmap by their median, and per kind of view by how far neighbouring residuals go together. Pairs that
contradict the others get large variances and so lose their say.

Depths are eliminated pixel by pixel (Schur complement; Triggs et al., "Bundle adjustment: a modern
synthesis", 2000, section 6), which leaves a system of the size of the cameras and pairs.
"""

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.geometry import skew
from jcr.reconstruct.dust3r.align_observations import CELL_SIDE, ImageObservations

ROBUST_WIDTH = 3.0
"""Standard deviations at which a residual's weight has fallen to a quarter (Geman-McClure)."""

LEAST_NOISE = np.float32(1e-5)
"""Spread below which float32 pointmaps say nothing."""


@dataclass(frozen=True)
class State:
    """All that alignment estimates."""

    recon_from_camera: Float[ndarray, "n 4 4"]
    log_focal: Float[ndarray, " n"]
    log_pair_scale: Float[ndarray, " e"]
    log_depth: Float[ndarray, "n m"]


@dataclass(frozen=True)
class Noise:
    """Spread of the residuals of some pointmaps, `across` (rad per axis) and `along` (relative) the sight."""

    across: Float[ndarray, "*k"]
    along: Float[ndarray, "*k"]
    across_inflation: Float[ndarray, "*k"]
    """Factor by which neighbouring residuals going together widen the variance of their mean, at least 1."""
    along_inflation: Float[ndarray, "*k"]


@dataclass(frozen=True)
class Residuals:
    """The two parts of the residuals of one image's pointmaps, and the geometry they hang on (recon axes)."""

    depth_arm: Float[ndarray, "3 m"]
    """From the image's camera centre to the modelled points."""
    focal_arm: Float[ndarray, "3 m"]
    """Change of the modelled points per change of log focal: toward the optical axis at constant depth."""
    x_in_recon: Float[ndarray, "3 m"]
    toward: Float[ndarray, "k 3 m"]
    """Unit vectors from the observer to the modelled points, x̂."""
    distance: Float[ndarray, "k m"]
    across: Float[ndarray, "k 3 m"]
    across_squared: Float[ndarray, "k m"]
    """Squared chord between the directions: grows up to a half turn, as |across| does not."""
    along: Float[ndarray, "k m"]


def residuals(observations: ImageObservations, state: State, log_depth: Float[ndarray, " m"]) -> Residuals:
    """Model one image's points at `log_depth` and compare them with every pointmap that shows them."""
    o, k = observations, observations.image
    rotation, center = state.recon_from_camera[:, :3, :3], state.recon_from_camera[:, :3, 3]
    ray = np.ones((3, o.pixel_offset.shape[1]), np.float32)
    ray[:2] = o.pixel_offset * np.float32(np.exp(-state.log_focal[k]))
    depth = np.exp(log_depth).astype(np.float32)
    depth_arm = rotation[k].astype(np.float32) @ (ray * depth)
    focal_arm = rotation[k, :, 2:].astype(np.float32) * depth - depth_arm
    sight = depth_arm + (center[k] - center[o.observer]).astype(np.float32)[:, :, None]
    distance = np.sqrt(np.einsum("kcm,kcm->km", sight, sight))
    toward = sight / distance[:, None]
    seen = rotation[o.observer].astype(np.float32) @ o.direction
    cosine = np.einsum("kcm,kcm->km", seen, toward)
    across = seen - cosine[:, None] * toward
    across_squared = np.einsum("kcm,kcm->km", across, across) + (1.0 - cosine) ** 2
    along = np.log(distance) - o.log_range - state.log_pair_scale[o.pair].astype(np.float32)[:, None]
    x_in_recon = depth_arm + center[k].astype(np.float32)[:, None]
    return Residuals(depth_arm, focal_arm, x_in_recon, toward, distance, across, across_squared, along)


def measure_noise(observations: ImageObservations, r: Residuals) -> Noise:
    """Spread per pointmap: medians over those of unit normals, and how far cells agree."""
    across = np.maximum(np.sqrt(np.median(r.across_squared, axis=1) / 1.386), LEAST_NOISE)
    along = np.maximum(1.4826 * np.median(np.abs(r.along), axis=1), LEAST_NOISE)
    weight = observations.weight * agreement(r, Noise(across, along, across, along))
    across_inflation = _inflation(observations, weight, r.across)
    return Noise(across, along, across_inflation, _inflation(observations, weight, r.along[:, None]))


def _inflation(
    o: ImageObservations, weight: Float[ndarray, "k m"], parts: Float[ndarray, "k c m"]
) -> Float[ndarray, " k"]:
    """Variance of residuals' cell means over what independent residuals would have (the design effect)."""
    total = np.maximum(weight.sum(axis=1), 1e-12)
    cell_total = weight @ o.cell
    weighted = weight[:, None] * parts
    variance = np.einsum("kcm,kcm->k", weighted, parts) / total
    means = (weighted @ o.cell) / np.maximum(cell_total, 1e-12)[:, None]
    variance_of_means = np.einsum("kcg,kcg,kg->k", means, means, cell_total) / total
    per_cell = weight.shape[1] / CELL_SIDE**2
    return np.maximum(1.0, per_cell * variance_of_means / np.maximum(variance, 1e-30))


def agreement(r: Residuals, noise: Noise) -> Float[ndarray, "k m"]:
    """Geman-McClure weights of the residuals, in (0, 1]."""
    u = r.across_squared / noise.across[:, None] ** 2 + r.along**2 / noise.along[:, None] ** 2
    return (1.0 + u * np.float32(ROBUST_WIDTH**-2)) ** -2


def pooled_noise(images: list[ImageObservations], r: list[Residuals]) -> list[Noise]:
    """Noise of every pointmap: spreads of its own, but no less than a third of the median of its kind of view
    (a pair must not win all say by a lucky fit); inflations of its kind."""
    own = [measure_noise(o, ri) for o, ri in zip(images, r, strict=True)]
    second = np.concatenate([o.second for o in images])
    parts = [np.concatenate([getattr(n, f.name) for n in own]) for f in fields(Noise)]
    kinds = np.array(
        [
            [np.median(p[second == kind]) if (second == kind).any() else 1.0 for p in parts]
            for kind in (False, True)
        ]
    )
    out = []
    for o, n in zip(images, own, strict=True):
        across, along, across_inflation, along_inflation = kinds[o.second.astype(int)].T.astype(np.float32)
        out.append(
            Noise(
                np.maximum(n.across, across / 3),
                np.maximum(n.along, along / 3),
                across_inflation,
                along_inflation,
            )
        )
    return out


@dataclass(frozen=True)
class Layout:
    """Where the unknowns stand in the reduced system: twists of the cameras, log focals, log pair scales.

    A twist (v, ω) in recon axes moves a camera by T ← [exp(ω) R, exp(ω) c + v]; points of an image move with
    its camera, so that only the difference of the twists of image and observer shows in a pointmap.
    """

    images: int
    pairs: int
    focals: int
    """0: given; 1: shared; else one per image."""

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return 6 * self.images + self.focals + self.pairs

    def focal(self, image: int) -> int | None:
        """Column of the log focal of an image; None where it is given."""
        if self.focals == 0:
            return None
        return 6 * self.images + (image if self.focals > 1 else 0)

    @property
    def scales(self) -> Int[ndarray, " e"]:
        """Columns of the log pair scales."""
        return 6 * self.images + self.focals + np.arange(self.pairs)


def depth_equations(
    r: Residuals, noise: Noise, weight: Float[ndarray, "k m"]
) -> tuple[Float[ndarray, " m"], Float[ndarray, " m"]]:
    """Gauss-Newton hessian and gradient of the log depths alone, every pointmap an independent witness."""
    weight = weight / r.distance
    w_across = weight / noise.across[:, None] ** 2
    w_along = weight / noise.along[:, None] ** 2
    along_arm = _dot(r.toward, r.depth_arm)
    hessian = (w_along - w_across) / r.distance * along_arm**2
    hessian += w_across / r.distance * (r.depth_arm**2).sum(axis=0)
    gradient = w_along * r.along * along_arm - w_across * _dot(r.across, r.depth_arm)
    total = hessian.sum(axis=0)
    return total + np.float32(1e-6) * total.max() + np.float32(1e-30), gradient.sum(axis=0)


@dataclass(frozen=True)
class ImageEquations:
    """Gauss-Newton equations of one image: local unknowns are relative twists, its pair scales, its focal."""

    hessian: Float[ndarray, "c c"]
    gradient: Float[ndarray, " c"]
    depth_hessian: Float[ndarray, " m"]
    depth_gradient: Float[ndarray, " m"]
    coupling: Float[ndarray, "c m"]

    def depth_step(self, local_step: Float[ndarray, " c"]) -> Float[ndarray, " m"]:
        """Change of log depth once the local unknowns have moved."""
        return -(self.depth_gradient + local_step.astype(np.float32) @ self.coupling) / self.depth_hessian

    def reduced(self) -> tuple[Float[ndarray, "c c"], Float[ndarray, " c"]]:
        """Hessian and gradient with the depths eliminated."""
        scaled = self.coupling / self.depth_hessian
        hessian = self.hessian - (scaled @ self.coupling.T).astype(np.float64)
        return hessian, self.gradient - (scaled @ self.depth_gradient).astype(np.float64)


def image_equations(observations: ImageObservations, r: Residuals, noise: Noise) -> ImageEquations:
    """Gauss-Newton equations of one image's pointmaps with residuals `r` of spread `noise`.

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
    # A pixel nobody predicts keeps its depth.
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
    """(α I + β x̂ x̂ᵀ) v."""
    return alpha[:, None] * v + (beta * _dot(toward, v))[:, None] * toward


def _moments(x: Float[ndarray, "3 m"], force: Float[ndarray, "n 3 m"]) -> Float[ndarray, "n 6 m"]:
    """(I, −[X])ᵀ applied to forces at points X: force and moment, what a twist feels."""
    out = np.empty((len(force), 6, x.shape[1]), np.float32)
    out[:, :3] = force
    for row, (a, b) in enumerate(((1, 2), (2, 0), (0, 1)), start=3):
        out[:, row] = x[a] * force[:, b] - x[b] * force[:, a]
    return out


def _isotropic(alpha: Float[ndarray, "n m"], x: Float[ndarray, "3 m"]) -> Float[ndarray, "n 6 6"]:
    """Σ α (I, −[X])ᵀ (I, −[X]) over the pixels, from the weights' moments of X."""
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
    return np.einsum("kcm,cm->km", a, v)
