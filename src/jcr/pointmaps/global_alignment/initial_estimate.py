"""Initial estimate of global alignment: focal length, pairwise similarities in closed form, and a spanning tree."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.errors import RejectedError
from jcr.estimation.absolute_pose import ransac_pose
from jcr.geometry import apply, fit_similarity, inverse
from jcr.pointmaps.global_alignment.observations import ImageObservations
from jcr.pointmaps.global_alignment.residuals import AlignmentState


def initial_state(images: list[ImageObservations], edges: Int[ndarray, "e 2"]) -> AlignmentState:
    """Return an initial estimate of all unknowns, accurate to a few per cent.

    Depths come from the pairs that have the image first, and cameras from a spanning tree of the pairs that agree best.
    `edges` are the images (first, second) of each pair. Raises RejectedError where no first view has points in front of
    its camera.
    """
    # The median of pixel radius / tangent of the angle off the optical axis, of pointmaps in their own camera's frame.
    ratios = []
    for o in images:
        x, y, forward = o.direction[o.second_count :].swapaxes(0, 1)
        aside = np.hypot(x, y)
        usable = (forward > 1e-3) & (aside > 1e-3) & (o.weight[o.second_count :] > 0)
        ratios.append((np.hypot(*o.pixel_offset) * forward)[usable] / aside[usable])
    if not sum(ratio.size for ratio in ratios):
        raise RejectedError("no first view of a pair has points in front of its camera")
    focal = float(np.median(np.concatenate(ratios)))
    depth, unit = [], np.zeros(len(edges))
    first_from_second, (log_ratio, cost) = np.empty((len(edges), 4, 4)), np.empty((2, len(edges)))
    for o in images:
        own, first = _own_depth(o, focal)
        unit[o.pair[o.second_count :]] = first
        depth.append(own)
    for o, z in zip(images, depth, strict=True):
        if n := o.second_count:
            pairs = o.pair[:n]
            first_from_second[pairs], log_ratio[pairs], cost[pairs] = _similarities(o, focal, z, unit[pairs])
    cost += _contradiction(edges, first_from_second[:, :3, :3], len(images))
    recon_from_camera, log_scale = _chain(edges, first_from_second, log_ratio, cost)
    # The gauge of eq. 1: the product of the pair scales is 1.
    shift = (log_scale[edges[:, 0]] - unit).mean()
    log_scale -= shift
    recon_from_camera[:, :3, 3] *= np.exp(-shift)
    return AlignmentState(
        recon_from_camera=recon_from_camera,
        log_focal=float(np.log(focal)),
        log_pair_scale=log_scale[edges[:, 0]] - unit,
        pair_error=np.zeros((len(edges), 6)),
        log_depth=[np.log(z) + scale for z, scale in zip(depth, log_scale, strict=True)],
    )


def _own_depth(o: ImageObservations, focal: float) -> tuple[Float[ndarray, " m"], Float[ndarray, " f"]]:
    """Return an image's m pixel depths (z) in a unit of the image, and log scales of the f pairs that have it first.

    A log scale is the log of the pair's depths minus that of the image's depths. The depth is the median over these
    pairs, and `focal` is fx in px. Without such a pair, the log scales are empty, and the depth comes from the second
    view with most inliers. The image's camera is then located in the frame of this view (resection); if this fails for
    every view, all depths are 1.
    """
    if len(o.pair) > o.second_count:
        forward = np.maximum(o.direction[o.second_count :, 2], 1e-6).astype(np.float64)
        log_depth = o.log_range[o.second_count :] + np.log(forward)
        shift, middle = np.median(log_depth, axis=1), log_depth[0]
        for _ in range(3):
            middle = np.median(log_depth - shift[:, None], axis=0)
            shift = np.median(log_depth - middle, axis=1)
        return np.exp(middle), shift
    x_px = (o.pixel_offset.T / focal).astype(np.float64)
    best_depth, best_inliers = np.ones(len(x_px)), -1
    for direction, log_range, weight in zip(o.direction, o.log_range, o.weight, strict=True):
        points = (direction * np.exp(log_range)).T.astype(np.float64)
        use = weight > 0
        found = ransac_pose(x_px[use], points[use], 1.0, 0.02) if use.sum() >= 6 else None
        if found is not None and found[1].sum() > best_inliers:
            depth = apply(inverse(found[0]), points)[:, 2]
            best_depth, best_inliers = np.maximum(depth, 0.01 * np.median(np.abs(depth))), int(found[1].sum())
    return best_depth, np.zeros(0)


def _similarities(
    o: ImageObservations, focal: float, depth: Float[ndarray, " m"], unit: Float[ndarray, " n"]
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, " n"], Float[ndarray, " n"]]:
    """Register an image's own points to the pointmaps of its n pairs as second image (Umeyama 1991, robust).

    Returns three arrays with an entry per pair: first_from_second in the first image's unit; the log ratio of the
    second image's unit to the first's; the median residual relative to the distance of the points. `focal` is fx in px,
    and `depth` the z of the image's m pixels in its unit. `unit` has for each pair the log scale of the
    pair's first image, as returned by `_own_depth`.
    """
    n = o.second_count
    x = np.concatenate([o.pixel_offset / focal, np.ones_like(o.pixel_offset[:1])]) * depth
    scale = np.exp(o.log_range[:n] - unit[:, None])
    y, weight = o.direction[:n] * scale[:, None], o.weight[:n].astype(np.float64)
    robust, middle, pose, ratio = weight, np.zeros((n, 1)), np.zeros((n, 4, 4)), np.ones(n)
    for _ in range(6):
        pose, ratio = fit_similarity(np.swapaxes(y, 1, 2), x.T, robust)
        transformed = ratio[:, None, None] * (pose[:, :3, :3] @ x) + pose[:, :3, 3:]
        relative = np.linalg.norm(y - transformed, axis=1) / scale
        middle = np.median(relative, axis=1, keepdims=True)
        robust = weight / (1.0 + (relative / (2.0 * middle + 1e-9)) ** 2) ** 2
    return pose, np.log(ratio), middle[:, 0]


def _contradiction(
    edges: Int[ndarray, "e 2"], first_from_second: Float[ndarray, "e 3 3"], images: int
) -> Float[ndarray, " e"]:
    """Return for each pair the disagreement of its rotation with the product of two pairs over a third image.

    The disagreement of rotations that differ by the angle θ is 2 sin(θ/2), about θ in rad. It detects a pair whose two
    pointmaps fit each other but not the scene. The result is the first quartile over the third images. With a third of
    the pairs wrong, most products around a correct pair are wrong, too. The result is 0 without a third image.
    """
    rotation = np.full((images, images, 3, 3), np.nan)
    first, second = edges.T
    rotation[second, first] = first_from_second.transpose(0, 2, 1)
    rotation[first, second] = first_from_second
    around = np.einsum("ekab,ekbc->ekac", rotation[first], rotation[:, second].transpose(1, 0, 2, 3))
    gap = np.linalg.norm(around - rotation[first, second][:, None], axis=(2, 3)) / np.sqrt(2.0)
    known = np.isfinite(gap)
    count = known.sum(axis=1)
    ordered = np.sort(np.where(known, gap, np.inf), axis=1)
    return np.where(count > 0, ordered[np.arange(len(edges)), count // 4], 0.0)


def _chain(
    edges: Int[ndarray, "e 2"],
    first_from_second: Float[ndarray, "e 4 4"],
    log_ratio: Float[ndarray, " e"],
    cost: Float[ndarray, " e"],
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, " n"]]:
    """Return recon_from_camera and log unit of each image, chained from image 0 along the minimum spanning tree (Prim).

    Frame and unit of recon are those of image 0. `edges` are the images (first, second) of each pair, and
    `first_from_second` has translations in the first image's unit. `log_ratio` is the log of the second image's unit
    over the first's, and `cost` the weight of each pair in the tree.
    """
    count = int(edges.max()) + 1
    recon_from_camera, log_scale = np.tile(np.eye(4), (count, 1, 1)), np.zeros(count)
    reached = np.arange(count) == 0
    while not reached.all():
        leaving = np.flatnonzero(reached[edges[:, 0]] != reached[edges[:, 1]])
        pair = leaving[np.argmin(cost[leaving])]
        first, second = edges[pair]
        step = first_from_second[pair].copy()
        if reached[first]:
            log_scale[second] = log_scale[first] + log_ratio[pair]
            step[:3, 3] *= np.exp(log_scale[first])
            recon_from_camera[second] = recon_from_camera[first] @ step
        else:
            log_scale[first] = log_scale[second] - log_ratio[pair]
            step[:3, 3] *= np.exp(log_scale[first])
            recon_from_camera[first] = recon_from_camera[second] @ inverse(step)
        reached[[first, second]] = True
    return recon_from_camera, log_scale
