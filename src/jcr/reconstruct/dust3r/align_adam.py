"""Global alignment by gradient descent on every pixel (paper section III, eq. 1), as published with DUSt3R.

The model is the published one: a depth map, a focal length and a camera per image; a rigid transform and a
scale per pair, tied to no camera; residual norms (not their squares) weighted by log confidence; Adam from a
spanning tree of the pairs. It stands as the baseline that `align_fast` is measured against.
"""

import math
import time

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from jcr.geometry import inverse, transform
from jcr.progress import Progress
from jcr.reconstruct.dust3r.align_depth import initial_depth
from jcr.reconstruct.dust3r.align_observations import choose_pixels, observe, weight_is_log
from jcr.reconstruct.dust3r.align_start import initial_state
from jcr.reconstruct.dust3r.alignment import Alignment, AlignOptions, pinhole_of
from jcr.reconstruct.dust3r.pairs import PairPredictions

START_PIXELS = 2048
FOCAL_SLOWNESS = 20.0
"""The optimised focal parameter is this times log f, so that one step changes it by little (as published)."""
PAIRS_AT_ONCE = 16
"""Bounds the memory of one forward and backward pass."""


def align_adam(
    predictions: PairPredictions, options: AlignOptions, progress: Progress | None = None
) -> Alignment:
    """Align by `options.steps` Adam steps over all pixels of all pairs."""
    begin = time.perf_counter()
    pinhole = pinhole_of(predictions, options)
    log_weight = weight_is_log(predictions)
    count, height, width = predictions.image_count, *predictions.conf.shape[1:]
    pixels = choose_pixels(predictions, START_PIXELS)
    start = initial_state(
        [observe(predictions, pinhole, k, pixels[k], log_weight) for k in range(count)],
        predictions.edges,
        pinhole,
    )
    depth = np.stack(
        [
            initial_depth(observe(predictions, pinhole, k, slice(None), log_weight), start)
            for k in range(count)
        ]
    )
    offset = torch.from_numpy(observe(predictions, pinhole, 0, slice(None), log_weight).pixel_offset.T.copy())

    camera_quat = _parameter(_quat_xyzw(start.recon_from_camera))
    camera_center = _parameter(start.recon_from_camera[:, :3, 3])
    log_depth = _parameter(np.log(depth))
    slow_focal = _parameter(FOCAL_SLOWNESS * (start.log_focal[:1] if pinhole.shared else start.log_focal))
    first = predictions.edges[:, 0]
    pair_quat = _parameter(_quat_xyzw(start.recon_from_camera[first]))
    pair_scale = _parameter(start.log_pair_scale)
    # The scale multiplies the whole of P_e in eq. 1, its translation too.
    pair_center = _parameter(start.recon_from_camera[first, :3, 3] / np.exp(start.log_pair_scale)[:, None])
    parameters = [camera_quat, camera_center, log_depth, pair_quat, pair_scale, pair_center]
    if pinhole.focal_px is None:
        parameters.append(slow_focal)

    def model() -> Tensor:
        """Points (n, h·w, 3) in the recon frame."""
        focal = torch.exp(slow_focal / FOCAL_SLOWNESS).expand(count)
        ray = torch.cat([offset / focal[:, None, None], torch.ones(count, len(offset), 1)], dim=2)
        in_camera = torch.exp(log_depth)[..., None] * ray
        return in_camera @ _rotation(camera_quat).mT + camera_center[:, None]

    optimizer = torch.optim.Adam(parameters, lr=options.learning_rate, betas=(0.9, 0.9))
    for step in range(options.steps):
        optimizer.param_groups[0]["lr"] = (
            0.5 * options.learning_rate * (1 + math.cos(math.pi * step / options.steps))
        )
        optimizer.zero_grad()
        points = model()
        # Pairs go in groups: each group's gradient is gathered on a copy of the points and passed on once.
        leaf = points.detach().requires_grad_()
        for begin_pair in range(0, len(first), PAIRS_AT_ONCE):
            group = slice(begin_pair, begin_pair + PAIRS_AT_ONCE)
            scale = torch.exp(pair_scale - pair_scale.mean())[group, None, None]
            rotation, center = _rotation(pair_quat[group]).mT, pair_center[group, None]
            loss = torch.zeros(())
            for view, image in enumerate(predictions.edges[group].T):
                shown = (predictions.pts3d, predictions.pts3d_in_other_view)[view][group].reshape(
                    len(image), -1, 3
                )
                conf = (predictions.conf, predictions.conf2)[view][group].reshape(len(image), -1)
                aligned = scale * (torch.from_numpy(shown) @ rotation + center)
                weight = torch.from_numpy(np.log(np.maximum(conf, 1.0)) if log_weight else conf)
                distance = torch.linalg.vector_norm(leaf[torch.from_numpy(image)] - aligned, dim=2)
                loss = loss + (weight * distance).mean(dim=1).sum()
            loss.backward()
        points.backward(leaf.grad)
        optimizer.step()
        if progress is not None:
            progress("align pairs", (step + 1) / options.steps)

    with torch.no_grad():
        recon_from_camera = transform(_rotation(camera_quat).double().numpy(), camera_center.double().numpy())
        depth = torch.exp(log_depth).reshape(count, height, width).numpy()
        focal = torch.exp(slow_focal / FOCAL_SLOWNESS).expand(count).double().numpy()
        scale = torch.exp(pair_scale - pair_scale.mean()).double().numpy()
    return Alignment(
        recon_from_camera=inverse(recon_from_camera[0]) @ recon_from_camera,
        focal_px=np.stack([focal, focal * pinhole.aspect], axis=1),
        principal_point_px=pinhole.principal_point_px,
        depth=depth,
        confidence=np.ones_like(depth),
        pair_scale=scale,
        pair_residual=np.zeros(len(first)),
        seconds=time.perf_counter() - begin,
        method="adam",
    )


def _parameter(values: np.ndarray) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, requires_grad=True)


def _quat_xyzw(recon_from_camera: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(recon_from_camera[:, :3, :3]).as_quat()


def _rotation(quat_xyzw: Tensor) -> Tensor:
    """Rotation matrices (k,3,3) of quaternions (k,4) of any length."""
    x, y, z, w = torch.nn.functional.normalize(quat_xyzw, dim=1).unbind(dim=1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
