"""Which pairs of images a network is shown."""

from dataclasses import dataclass
from itertools import accumulate
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.estimation.closed_form import rotations
from jcr.geometry import apply, fit_similarity, inverse, rotation_angle, transform
from jcr.pointmaps.pairs import PairPredictions

PairGraph = Literal["auto", "complete", "window", "robot"]
"""complete: all pairs; window: images near each other in the capture's order; robot: all pairs but those that by the
robot's poses have no view in common; auto: complete up to FEW_IMAGES images, robot beyond."""
FEW_IMAGES = 12
"""Up to here "auto" predicts every pair (132); a chain that is wrong costs more than it saves."""

WINDOW = 3
"""Distance in the capture's order up to which two images make a pair of the window graph."""

LEAST_OVERLAP, WIDER = 0.02, 1.5
"""Share of an image's points that the other one of a pair must see, in a field of view half again as wide as its own."""
SAMPLES = 1000
"""Points of an image, about."""


def complete_pairs(count: int) -> Int[ndarray, "e 2"]:
    """Every pair in both orders: (i, j) with i > j first, then each reversed, as published."""
    return _both_orders(np.argwhere(np.tri(count, k=-1, dtype=bool)))


def window_pairs(count: int, size: int) -> Int[ndarray, "e 2"]:
    """Pairs of images at most `size` apart in the order of the capture, in both orders."""
    near = np.tri(count, k=-1, dtype=bool) & ~np.tri(count, k=-size - 1, dtype=bool)
    return _both_orders(np.argwhere(near))


def _both_orders(edges: Int[ndarray, "e 2"]) -> Int[ndarray, "e2 2"]:
    return np.concatenate([edges, edges[:, ::-1]])


def overlapping_pairs(
    chain: PairPredictions, base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Int[ndarray, "e 2"], str]:
    """Pairs that can see something in common, in both orders, and in words how that was found.

    `chain` holds the pairs of neighbours, `window_pairs(n, 1)`. From their relative camera poses and the
    robot's come a first hand-eye calibration and the pairs' scales; with them every image's points go into
    the base frame and from there into every other camera. A pair is left out only when less than
    LEAST_OVERLAP of the points of either image fall into half again the other's field of view. All pairs
    are kept where the motions do not determine where the camera looks, or the chain contradicts the robot.
    """
    everything = complete_pairs(len(base_from_gripper))
    views = _chain_views(chain, len(base_from_gripper))
    fit = _first_calibration(views, base_from_gripper)
    if isinstance(fit, str):
        return everything, f"all pairs predicted: {fit}"
    gripper_from_camera, metres = fit
    base_from_camera = base_from_gripper @ gripper_from_camera
    camera_from_base = inverse(base_from_camera)
    points = [scale * view.points for scale, view in zip(metres, views, strict=True)]
    points.append(metres[-1] * views[-1].next_points)
    seen = np.zeros((len(points), len(points)))
    for i, x_in_camera in enumerate(points):
        x_in_base = apply(base_from_camera[i], x_in_camera)
        for j, others in enumerate(points):
            seen[i, j] = _share_in_view(apply(camera_from_base[j], x_in_base), others)
    first, second = everything.T
    keep = (np.maximum(seen, seen.T)[first, second] >= LEAST_OVERLAP) | (np.abs(first - second) == 1)
    return everything[keep], f"{keep.sum()} of {len(keep)} pairs predicted: the others share no view"


def _first_calibration(
    views: list["_ChainView"], base_from_gripper: Float[ndarray, "n 4 4"]
) -> tuple[Float[ndarray, "4 4"], Float[ndarray, " k"]] | str:
    """A rough gripper_from_camera and metres per unit of each pair of neighbours, or why there is none."""
    gripper_motion = inverse(base_from_gripper[:-1]) @ base_from_gripper[1:]
    camera_motion = np.stack([view.camera_from_next for view in views])
    rotation_a, rotation_b = gripper_motion[:, :3, :3], camera_motion[:, :3, :3]
    # (1 − cos θ) a aᵀ of each rotation by θ about a, half of its squared logarithm where it is small.
    cosine = (np.trace(rotation_a, axis1=1, axis2=2) - 1) / 2
    scatter = rotation_a.sum(0) - cosine.sum() * np.eye(3)
    _, second, largest = np.linalg.eigvalsh((scatter + scatter.T) / 2)
    if largest < 5e-4 or second < 0.02 * largest:
        return "neighbours rotate about less than two axes, so where the camera looks is unknown"
    # Chained along the neighbours, for any frame of the cameras will do.
    camera = np.stack(list(accumulate(rotation_b, np.matmul, initial=np.eye(3))))
    rotation, _ = rotations(base_from_gripper[:, :3, :3], camera, np.ones(len(camera)))
    miss = rotation_angle(np.swapaxes(rotation_a @ rotation, -1, -2) @ rotation @ rotation_b)
    if np.median(miss) > np.radians(10):
        return "the pairs of neighbours do not agree with the robot's rotations"
    # (R_A − I) t − λ_k R t_B = −t_A, linear in the lever arm t, with a weak prior at 0, and one λ_k per pair.
    motions = np.arange(len(views))
    lever, scales = rotation_a - np.eye(3), np.zeros((len(views), 3, len(views)))
    scales[motions, :, motions] = -camera_motion[:, :3, 3] @ rotation.T
    rows = np.concatenate([lever, scales], axis=2).reshape(-1, 3 + len(views))
    matrix = np.concatenate([rows, 0.1 * np.eye(3, 3 + len(views))])
    right = np.append(-gripper_motion[:, :3, 3].ravel(), np.zeros(3))
    solution = np.linalg.lstsq(matrix, right, rcond=None)[0]
    if (solution[3:] <= 0).any():
        return "the pairs of neighbours do not agree with the robot's translations"
    return transform(rotation, solution[:3]), solution[3:]


@dataclass(frozen=True)
class _ChainView:
    """Two neighbours in one pair's unit."""

    camera_from_next: Float[ndarray, "4 4"]
    points: Float[ndarray, "p 3"]
    """Points of the first image in its camera frame."""
    next_points: Float[ndarray, "p 3"]
    """Points of the next image in its own camera frame."""


def _chain_views(chain: PairPredictions, count: int) -> list[_ChainView]:
    row = {(int(first), int(second)): e for e, (first, second) in enumerate(chain.edges)}
    views = []
    for k in range(count - 1):
        there, back = row[k, k + 1], row[k + 1, k]
        # The same pixels of the next image, in the camera frame of image k and in their own.
        confidence = np.minimum(chain.conf2[there], chain.conf[back]).ravel()
        best = np.argsort(confidence)[-len(confidence) // 2 :]
        pixels = best[:: max(1, len(best) // SAMPLES)]
        in_camera = chain.pts3d_in_other_view[there].reshape(-1, 3)[pixels].astype(np.float64)
        in_next = chain.pts3d[back].reshape(-1, 3)[pixels].astype(np.float64)
        camera_from_next, scale = fit_similarity(in_camera, in_next)
        own = np.argsort(chain.conf[there].ravel())[-len(confidence) // 2 :][:: max(1, len(best) // SAMPLES)]
        points = chain.pts3d[there].reshape(-1, 3)[own].astype(np.float64)
        views.append(_ChainView(camera_from_next, points, scale * in_next))
    return views


def _share_in_view(x_in_camera: Float[ndarray, "n 3"], view: Float[ndarray, "p 3"]) -> float:
    """Fraction of points that fall into the field of view that a camera's own points span, widened."""
    directions = view[:, :2] / np.maximum(view[:, 2:], 1e-6)
    low, high = np.quantile(directions, [0.01, 0.99], axis=0)
    middle, half = (low + high) / 2, WIDER * (high - low) / 2
    ahead = x_in_camera[:, 2] > 1e-6
    inside = np.abs(x_in_camera[ahead, :2] / x_in_camera[ahead, 2:] - middle) <= half
    return float(inside.all(-1).sum() / len(x_in_camera))
