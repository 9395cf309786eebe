"""Global alignment by gradient descent on every pixel (paper section III, eq. 1), as published with DUSt3R.

The model is the published one: a depth map, a focal length and a camera per image; a rigid transform and a
scale per pair, tied to no camera; residual norms (not their squares) weighted by log confidence; Adam from a
spanning tree of the pairs. It is the baseline that Gauss-Newton is measured against. `python -m benchmarks align` aligns
one file of pairwise pointmaps by either method.
"""

import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import torch
import tyro
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from jcr.files import written_whole
from jcr.geometry import inverse, transform
from jcr.pointmaps.global_alignment.align import Alignment, global_align
from jcr.pointmaps.global_alignment.initial_estimate import initial_state
from jcr.pointmaps.global_alignment.observations import AlignmentProblem, observe
from jcr.pointmaps.global_alignment.residuals import AlignmentState, initial_depth
from jcr.pointmaps.pairs import PairPredictions, read_pairs

STEPS, LEARNING_RATE = 300, 0.01
"""Steps, and learning rate of the first; it falls to 0 along a cosine."""
START_PIXELS = 2048
FOCAL_SLOWNESS = 20.0
"""The optimised focal parameter is this times log f, so that one step changes it by little (as published)."""
PAIRS_AT_ONCE = 16
"""Bounds the memory of one forward and backward pass."""


@dataclass(frozen=True)
class Arguments:
    """Align pairwise pointmaps into one reconstruction.

    PAIRS.npz holds edges (E,2), pts3d and pts3d_in_other_view (E,H,W,3), conf and conf2 (E,H,W). OUT.npz gets
    poses (N,4,4), camera to recon; focals (N,); depth and confidence (N,H,W); principal_point (2,); pair_scale and
    pair_residual (E,).

    examples:
      python -m benchmarks align pairs.npz aligned.npz
      python -m benchmarks align pairs.npz published.npz --method adam
    """

    pairs: Annotated[Path, tyro.conf.Positional]
    """Pairwise pointmaps to read."""
    result: Annotated[Path, tyro.conf.Positional]
    """Alignment to write."""
    method: Literal["fast", "adam"] = "fast"
    """fast: Gauss-Newton on chosen pixels (jcr.global_align); adam: gradient descent on every pixel, as published."""


def main(words: Sequence[str]) -> int:
    """Read the pairs, align them, write the result, and print the seconds of the alignment as JSON."""
    arguments = tyro.cli(Arguments, prog="python -m benchmarks align", args=words)
    predictions = read_pairs(arguments.pairs)
    begin = time.perf_counter()
    alignment = align_adam(predictions) if arguments.method == "adam" else global_align(predictions)
    seconds = time.perf_counter() - begin
    with written_whole(arguments.result) as temporary, open(temporary, "wb") as stream:
        np.savez(
            stream,
            poses=alignment.recon_from_camera,
            focals=np.full(len(alignment.depth), alignment.focal_px[0]),
            depth=alignment.depth,
            confidence=alignment.confidence,
            principal_point=np.array(alignment.principal_point_px),
            pair_scale=alignment.pair_scale,
            pair_residual=alignment.pair_residual,
        )
    for text in (*alignment.warnings, *alignment.notes):
        sys.stderr.write(f"{text}\n")
    sys.stdout.write(json.dumps({"method": arguments.method, "seconds": seconds}) + "\n")
    return 0


def align_adam(predictions: PairPredictions, steps: int = STEPS) -> Alignment:
    """Align by Adam steps over all pixels of all pairs; the result has no covariance (NaN)."""
    problem = AlignmentProblem.of(predictions)
    count, height, width = predictions.image_count, *predictions.conf.shape[1:]
    start = initial_state(problem.observe_all(START_PIXELS), predictions.edges)
    everything = (observe(problem, k, slice(None)) for k in range(count))
    model = PointmapModel(start, np.stack([initial_depth(o, start) for o in everything]), problem)
    groups = [slice(e, e + PAIRS_AT_ONCE) for e in range(0, len(predictions.edges), PAIRS_AT_ONCE)]
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.9))
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 0.5 * LEARNING_RATE * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        points = model.points()
        # Each group's gradient is gathered on a copy of the points, which then passes it on once.
        gathered = points.detach().requires_grad_()
        for group in groups:
            loss = torch.zeros(())
            for view, confidence in enumerate((predictions.conf, predictions.conf2)):
                weight = torch.from_numpy(problem.weigh(confidence[group])).flatten(1)
                loss = loss + (weight * model.distance(gathered, group, view)).mean(dim=1).sum()
            loss.backward()
        points.backward(gathered.grad)
        optimizer.step()
    # The network's confidence, averaged over the pairs that show an image.
    total = np.zeros((count, height, width), np.float32)
    for edge, *confidences in zip(predictions.edges, predictions.conf, predictions.conf2, strict=True):
        for image, confidence in zip(edge, confidences, strict=True):
            total[image] += problem.weigh(confidence)
    shown = np.bincount(predictions.edges.ravel(), minlength=count)
    mean = total / shown[:, None, None].astype(np.float32)
    with torch.no_grad():
        points = model.points()
        residual = [
            torch.maximum(
                *(
                    model.distance(points, group, view).median(dim=1).values / model.range(group, view)
                    for view in (0, 1)
                )
            )
            for group in groups
        ]
        recon_from_camera = transform(
            model.rotation(model.camera_quat_xyzw).double().numpy(), model.camera_center.double().numpy()
        )
        focal = float(model.focal())
        return Alignment(
            recon_from_camera=inverse(recon_from_camera[0]) @ recon_from_camera,
            focal_px=(focal, focal * problem.aspect),
            principal_point_px=problem.principal_point_px,
            depth=model.log_depth.exp().reshape(count, height, width).numpy(),
            confidence=np.exp(mean) if problem.log_weight else mean,
            pair_scale=model.scale().double().numpy(),
            pair_residual=torch.cat(residual).double().numpy(),
            covariance=np.full((6 * count, 6 * count), np.nan),
        )


class PointmapModel(torch.nn.Module):
    """The unknowns of eq. 1: X̂_i by camera, focal length and depth of each image; P_e and σ_e of each pair."""

    def __init__(
        self, start: AlignmentState, depth: Float[ndarray, "n p"], problem: AlignmentProblem
    ) -> None:
        super().__init__()
        predictions = problem.predictions
        self.images = torch.from_numpy(predictions.edges)
        self.shown = (predictions.pts3d, predictions.pts3d_in_other_view)
        height, width = predictions.conf.shape[1:]
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        cx, cy = problem.principal_point_px
        offset = np.stack([(x - cx).ravel(), (y - cy).ravel() / problem.aspect], axis=1)
        self.offset = torch.from_numpy(offset.astype(np.float32))

        observer = start.recon_from_camera[predictions.edges[:, 0]]
        self.camera_quat_xyzw = _parameter(_quat_xyzw(start.recon_from_camera))
        self.camera_center = _parameter(start.recon_from_camera[:, :3, 3])
        self.log_depth = _parameter(np.log(depth))
        self.slow_focal = _parameter(np.array(FOCAL_SLOWNESS * start.log_focal))
        self.pair_quat_xyzw = _parameter(_quat_xyzw(observer))
        self.log_scale = _parameter(start.log_pair_scale)
        # The scale multiplies the whole of P_e in eq. 1, its translation too.
        self.pair_center = _parameter(observer[:, :3, 3] / np.exp(start.log_pair_scale)[:, None])

    def focal(self) -> Tensor:
        """Return fx, common to all images."""
        return torch.exp(self.slow_focal / FOCAL_SLOWNESS)

    def scale(self) -> Tensor:
        """Return σ_e (e,), whose product is 1."""
        return torch.exp(self.log_scale - self.log_scale.mean())

    def points(self) -> Tensor:
        """Return X̂ (n, pixels, 3) in the recon frame."""
        ray = (self.offset / self.focal())[None]
        ray = torch.cat([ray, torch.ones_like(ray[..., :1])], dim=2)
        in_camera = torch.exp(self.log_depth)[..., None] * ray
        return in_camera @ self.rotation(self.camera_quat_xyzw).mT + self.camera_center[:, None]

    def distance(self, points: Tensor, pairs: slice, view: int) -> Tensor:
        """Return ‖X̂_i − σ_e P_e X_e,i‖ (pairs, pixels) for the first (0) or second (1) view of some pairs."""
        shown = torch.from_numpy(self.shown[view][pairs]).flatten(1, 2)
        aligned = shown @ self.rotation(self.pair_quat_xyzw[pairs]).mT + self.pair_center[pairs, None]
        aligned = self.scale()[pairs, None, None] * aligned
        return torch.linalg.vector_norm(points[self.images[pairs, view]] - aligned, dim=2)

    def range(self, pairs: slice, view: int) -> Tensor:
        """Return the median distance (pairs,) of a view's points from the first camera, recon units."""
        shown = torch.from_numpy(self.shown[view][pairs]).flatten(1, 2)
        return self.scale()[pairs] * torch.linalg.vector_norm(shown, dim=2).median(dim=1).values

    @staticmethod
    def rotation(quat_xyzw: Tensor) -> Tensor:
        """Return rotation matrices (k,3,3) of quaternions (k,4) of any length."""
        x, y, z, w = torch.nn.functional.normalize(quat_xyzw, dim=1).unbind(dim=1)
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
        return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def _parameter(values: ndarray) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.tensor(values, dtype=torch.float32))


def _quat_xyzw(recon_from_camera: Float[ndarray, "k 4 4"]) -> Float[ndarray, "k 4"]:
    return Rotation.from_matrix(recon_from_camera[:, :3, :3]).as_quat()
