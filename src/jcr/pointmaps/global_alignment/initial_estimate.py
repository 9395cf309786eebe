"""Initial estimate of global alignment: focal length, pairwise similarities in closed form, and a spanning tree."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.estimation.absolute_pose import ransac_pose
from jcr.geometry import apply, fit_similarity, inverse
from jcr.pointmaps.global_alignment.observations import ImageObservations
from jcr.pointmaps.global_alignment.pointmap_residuals import State


@dataclass(frozen=True)
class PairSimilarities:
    """x_in_first = R · (ratio · x_in_second) + t for each pair, lengths in the images' own units."""

    first_from_second: Float[ndarray, "e 4 4"]
    log_ratio: Float[ndarray, " e"]
    """Log of the ratio of the second image's unit to the first's."""
    residual: Float[ndarray, " e"]
    """Median distance after the fit, relative to the distance of the points."""


def initial_state(images: list[ImageObservations], edges: Int[ndarray, "e 2"]) -> State:
    """Estimate the state to a few per cent: every image's own depth, chained along the pairs that agree best."""
    focal = _focal(images)
    depth, unit = _depths(images, focal, len(edges))
    pairs = _similarities(images, edges, focal, depth, unit)
    cost = pairs.residual + _contradiction(edges, pairs, len(images))
    recon_from_camera, log_scale = _chain(edges, pairs, cost)
    # The gauge of eq. 1: the product of the pair scales is 1.
    shift = (log_scale[edges[:, 0]] - unit).mean()
    log_scale -= shift
    recon_from_camera[:, :3, 3] *= np.exp(-shift)
    return State(
        recon_from_camera=recon_from_camera,
        log_focal=float(np.log(focal)),
        log_pair_scale=log_scale[edges[:, 0]] - unit,
        pair_error=np.zeros((len(edges), 6)),
        log_depth=[np.log(z) + scale for z, scale in zip(depth, log_scale, strict=True)],
    )


def _focal(images: list[ImageObservations]) -> float:
    """Estimate fx: the median over the first views of pixel radius over tangent of the angle off the axis.

    Raises RejectedError where no first view shows it.
    """
    ratios = []
    for o in images:
        n = o.direction[o.second_count :]
        usable = (n[:, 2] > 1e-3) & (np.hypot(n[:, 0], n[:, 1]) > 1e-3) & (o.weight[o.second_count :] > 0)
        radius = np.broadcast_to(np.hypot(*o.pixel_offset), usable.shape)
        ratios.append((radius * n[:, 2])[usable] / np.hypot(n[:, 0], n[:, 1])[usable])
    if not sum(ratio.size for ratio in ratios):
        raise RejectedError("no first view of a pair has points in front of its camera")
    return float(np.median(np.concatenate(ratios)))


def _depths(
    images: list[ImageObservations], focal: float, pairs: int
) -> tuple[list[Float[ndarray, " _"]], Float[ndarray, " e"]]:
    """Estimate the depth of each image in its own unit, and the log of each pair's unit in that of its first image."""
    depth = []
    unit = np.zeros(pairs)
    for o in images:
        first = slice(o.second_count, None)
        if len(o.pair) == o.second_count:
            depth.append(_depth_by_resection(o, focal))
            continue
        forward = np.maximum(o.direction[first, 2], 1e-6).astype(np.float64)
        log_depth = o.log_range[first] + np.log(forward)
        middle = np.median(log_depth - np.median(log_depth, axis=1)[:, None], axis=0)
        for _ in range(2):
            shift = np.median(log_depth - middle, axis=1)
            middle = np.median(log_depth - shift[:, None], axis=0)
        shift = np.median(log_depth - middle, axis=1)
        unit[o.pair[first]] = shift
        depth.append(np.exp(middle))
    return depth, unit


def _depth_by_resection(o: ImageObservations, focal: float) -> Float[ndarray, " m"]:
    """Estimate the depth of an image that is first in no pair by resection from the view with most inliers."""
    x_px = (o.pixel_offset.T / focal).astype(np.float64)
    best_depth, best_inliers = np.ones(len(x_px)), -1
    for direction, log_range, weight in zip(o.direction, o.log_range, o.weight, strict=True):
        points = (direction * np.exp(log_range)).T.astype(np.float64)
        use = weight > 0
        if use.sum() < 6:
            continue
        found = ransac_pose(x_px[use], points[use], 1.0, 0.02)
        if found is not None and found[1].sum() > best_inliers:
            depth = apply(inverse(found[0]), points)[:, 2]
            best_depth, best_inliers = np.maximum(depth, 0.01 * np.median(np.abs(depth))), int(found[1].sum())
    return best_depth


def _similarities(
    images: list[ImageObservations],
    edges: Int[ndarray, "e 2"],
    focal: float,
    depth: list[Float[ndarray, " _"]],
    unit: Float[ndarray, " e"],
) -> PairSimilarities:
    """Register each image's own points to its second views (Umeyama 1991, weights by Geman-McClure)."""
    first_from_second, log_ratio = np.empty((len(edges), 4, 4)), np.empty(len(edges))
    residual = np.empty(len(edges))
    for o, z in zip(images, depth, strict=True):
        n = o.second_count
        if n == 0:
            continue
        x = np.concatenate([o.pixel_offset / focal, np.ones_like(o.pixel_offset[:1])]) * z
        scale = np.exp(o.log_range[:n] - unit[o.pair[:n], None])
        y = np.swapaxes(o.direction[:n] * scale[:, None], 1, 2)
        weight = o.weight[:n].astype(np.float64)
        fit = fit_similarity(y, x.T, weight)
        for _ in range(5):
            relative = _distances(y, x, *fit) / scale
            middle = np.median(relative, axis=1, keepdims=True)
            fit = fit_similarity(y, x.T, weight / (1.0 + (relative / (2.0 * middle + 1e-9)) ** 2) ** 2)
        first_from_second[o.pair[:n]] = fit[0]
        log_ratio[o.pair[:n]] = np.log(fit[1])
        residual[o.pair[:n]] = np.median(_distances(y, x, *fit) / scale, axis=1)
    return PairSimilarities(first_from_second, log_ratio, residual)


def _distances(
    y: Float[ndarray, "k m 3"],
    x: Float[ndarray, "3 m"],
    y_from_x: Float[ndarray, "k 4 4"],
    ratio: Float[ndarray, " k"],
) -> Float[ndarray, "k m"]:
    """Return the distance of y from the transformed x."""
    transformed = ratio[:, None, None] * (y_from_x[:, :3, :3] @ x) + y_from_x[:, :3, 3:]
    return np.linalg.norm(np.swapaxes(y, 1, 2) - transformed, axis=1)


def _contradiction(edges: Int[ndarray, "e 2"], pairs: PairSimilarities, images: int) -> Float[ndarray, " e"]:
    """Return the angle of each pair's rotation from the composition over a third image (rad); 0 where there is none.

    A pair whose two pointmaps fit each other but not the scene is seen by nothing else. Of all ways around,
    the first quartile counts: with a third of the pairs wrong, most ways around a right one are wrong too.
    """
    rotation = np.full((images, images, 3, 3), np.nan)
    first, second = edges.T
    rotation[second, first] = pairs.first_from_second[:, :3, :3].transpose(0, 2, 1)
    rotation[first, second] = pairs.first_from_second[:, :3, :3]
    around = np.einsum("ekab,ekbc->ekac", rotation[first], rotation[:, second].transpose(1, 0, 2, 3))
    gap = np.linalg.norm(around - rotation[first, second][:, None], axis=(2, 3)) / np.sqrt(2.0)
    known = np.isfinite(gap)
    count = known.sum(axis=1)
    ordered = np.sort(np.where(known, gap, np.inf), axis=1)
    return np.where(count > 0, ordered[np.arange(len(edges)), count // 4], 0.0)


def _chain(
    edges: Int[ndarray, "e 2"], pairs: PairSimilarities, cost: Float[ndarray, " e"]
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, " n"]]:
    """Chain cameras and log units of the images along the minimum spanning tree (Prim) from image 0."""
    count = int(edges.max()) + 1
    recon_from_camera = np.tile(np.eye(4), (count, 1, 1))
    log_scale = np.zeros(count)
    reached = np.arange(count) == 0
    while not reached.all():
        leaving = np.flatnonzero(reached[edges[:, 0]] != reached[edges[:, 1]])
        pair = leaving[np.argmin(cost[leaving])]
        first, second = edges[pair]
        if reached[first]:
            log_scale[second] = log_scale[first] + pairs.log_ratio[pair]
        else:
            log_scale[first] = log_scale[second] - pairs.log_ratio[pair]
        step = pairs.first_from_second[pair].copy()
        step[:3, 3] *= np.exp(log_scale[first])
        if reached[first]:
            recon_from_camera[second] = recon_from_camera[first] @ step
        else:
            recon_from_camera[first] = recon_from_camera[second] @ inverse(step)
        reached[[first, second]] = True
    return recon_from_camera, log_scale
