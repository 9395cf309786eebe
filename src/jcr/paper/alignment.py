"""Global alignment of pairwise pointmaps by gradient descent on every pixel (paper section III, eq. 1).

The paper uses the alignment of DUSt3R, which is written anew here. X̂ is a depth map, a focal length and a camera pose
per image. P_e and σ_e are a rigid transform and a scale per pair, tied to no camera. The weight is log C, as in DUSt3R.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.spatial.transform import Rotation
from torch import Tensor

from jcr.geometry import inverse, transform
from jcr.pointmaps.global_alignment.align import PIXELS, Alignment
from jcr.pointmaps.global_alignment.initial_estimate import initial_state
from jcr.pointmaps.global_alignment.observations import AlignmentProblem, observe
from jcr.pointmaps.global_alignment.residuals import AlignmentState, initial_depth
from jcr.pointmaps.pair_predictions import PairPredictions
from jcr.progress import Progress, silent

Depths = Float[ndarray, "n p"]
STEPS, LEARNING_RATE = 300, 0.01
"""Number of Adam steps, and learning rate of the first; it falls to 0 along a cosine (DUSt3R's defaults). The authors
of the paper took 5000 steps."""
FOCAL_SLOWNESS = 20.0  # factor of log f in its parameter, so that one step changes f by little (as DUSt3R)
PAIRS_AT_ONCE = 16  # in one forward and backward pass, which bounds the memory


def align(
    predictions: PairPredictions, steps: int = STEPS, device: str = "cpu", progress: Progress = silent
) -> Alignment:
    """Return camera poses, depths and pair scales that minimise eq. 1 by `steps` steps of Adam; covariance is NaN.

    The initial estimate chains the pairs along a spanning tree. `device` is the torch device of the descent.
    """
    problem = AlignmentProblem.of(predictions)
    count = predictions.image_count
    start = initial_state(problem.observe_all(PIXELS), predictions.edges)
    everything = (observe(problem, k, slice(None)) for k in range(count))
    model = PointmapModel(start, np.stack([initial_depth(o, start) for o in everything]), problem).to(device)
    groups = [slice(e, e + PAIRS_AT_ONCE) for e in range(0, len(predictions.edges), PAIRS_AT_ONCE)]
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, betas=(0.9, 0.9))
    for step in range(steps):
        optimizer.param_groups[0]["lr"] = 0.5 * LEARNING_RATE * (1 + math.cos(math.pi * step / steps))
        optimizer.zero_grad()
        points = model.points()
        # The gradient of each group is collected on a copy of the points, and then passed on once.
        collected = points.detach().requires_grad_()
        for group in groups:
            sum(model.loss(collected, group, view) for view in (0, 1)).backward()  # pyright: ignore[reportAttributeAccessIssue]
        points.backward(collected.grad)
        optimizer.step()
        progress("align pairs as published", (step + 1) / steps)
    return _alignment(model, problem, groups)


class PointmapModel(torch.nn.Module):
    """Unknowns of eq. 1: X̂_i by camera pose, focal length and depths of each image; P_e and σ_e of each pair.

    They begin at the estimate `start`, and at `depth` (recon units) of the p pixels of n images.
    """

    offset: Tensor

    def __init__(self, start: AlignmentState, depth: Depths, problem: AlignmentProblem) -> None:
        super().__init__()
        predictions = problem.predictions
        self.problem, self.images = problem, torch.from_numpy(predictions.edges)
        self.shown = predictions.pts3d, predictions.pts3d_in_other_view
        self.confidence = predictions.conf, predictions.conf2
        height, width = predictions.conf.shape[1:]
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        cx, cy = problem.principal_point_px
        offset = np.stack([(x - cx).ravel(), (y - cy).ravel() / problem.aspect], axis=1)
        self.register_buffer("offset", torch.from_numpy(offset.astype(np.float32)))
        observer = start.recon_from_camera[predictions.edges[:, 0]]
        self.camera_quat_xyzw = _parameter(_quat_xyzw(start.recon_from_camera))
        self.camera_center = _parameter(start.recon_from_camera[:, :3, 3])
        self.log_depth = _parameter(np.log(depth))
        self.slow_focal = _parameter(np.array(FOCAL_SLOWNESS * start.log_focal))
        self.pair_quat_xyzw = _parameter(_quat_xyzw(observer))
        self.log_scale = _parameter(start.log_pair_scale)
        # The scale multiplies the whole of P_e, including its translation.
        self.pair_center = _parameter(observer[:, :3, 3] / np.exp(start.log_pair_scale)[:, None])

    def scale(self) -> Tensor:
        """Return σ_e (e,), whose product is 1; without this constraint all points would shrink to one."""
        return torch.exp(self.log_scale - self.log_scale.mean())

    def points(self) -> Tensor:
        """Return X̂ (n, pixels, 3) in the recon frame."""
        ray = (self.offset / torch.exp(self.slow_focal / FOCAL_SLOWNESS))[None]
        ray = torch.cat([ray, torch.ones_like(ray[..., :1])], dim=2)
        in_camera = torch.exp(self.log_depth)[..., None] * ray
        return in_camera @ rotations(self.camera_quat_xyzw).mT + self.camera_center[:, None]

    def distance(self, points: Tensor, pairs: slice, view: int) -> Tensor:
        """Return ‖X̂_i − σ_e P_e X_e,i‖ (pairs, pixels) for the first (0) or second (1) view of some pairs."""
        shown = torch.from_numpy(self.shown[view][pairs]).to(points.device).flatten(1, 2)
        aligned = shown @ rotations(self.pair_quat_xyzw[pairs]).mT + self.pair_center[pairs, None]
        aligned = self.scale()[pairs, None, None] * aligned
        return torch.linalg.vector_norm(points[self.images[pairs, view]] - aligned, dim=2)

    def loss(self, points: Tensor, pairs: slice, view: int) -> Tensor:
        """Return the sum over some pairs of the mean weighted distance of one view: terms of eq. 1 per pixel."""
        weight = (
            torch.from_numpy(self.problem.weigh(self.confidence[view][pairs])).to(points.device).flatten(1)
        )
        return (weight * self.distance(points, pairs, view)).mean(dim=1).sum()


@torch.no_grad()
def _alignment(model: PointmapModel, problem: AlignmentProblem, groups: list[slice]) -> Alignment:
    """Return the state of the model as an Alignment; the confidence is the mean over the pairs that show an image."""
    predictions = problem.predictions
    count, (height, width) = predictions.image_count, predictions.conf.shape[1:]
    total = np.zeros((count, height, width), np.float32)
    for edge, *confidences in zip(predictions.edges, predictions.conf, predictions.conf2, strict=True):
        for image, confidence in zip(edge, confidences, strict=True):
            total[image] += problem.weigh(confidence)
    shown = np.bincount(predictions.edges.ravel(), minlength=count)
    mean = total / shown[:, None, None].astype(np.float32)
    points, focal = model.points(), float(torch.exp(model.slow_focal / FOCAL_SLOWNESS))
    distance = torch.cat([model.distance(points, group, 1).median(dim=1).values for group in groups])
    reach = torch.linalg.vector_norm(points - model.camera_center[:, None], dim=2).median(dim=1).values
    center = model.camera_center.double().cpu().numpy()
    recon_from_camera = transform(rotations(model.camera_quat_xyzw).double().cpu().numpy(), center)
    return Alignment(
        recon_from_camera=inverse(recon_from_camera[0]) @ recon_from_camera,
        focal_px=(focal, focal * problem.aspect),
        principal_point_px=problem.principal_point_px,
        depth=model.log_depth.exp().reshape(count, height, width).cpu().numpy(),
        confidence=np.exp(mean) if problem.log_weight else mean,
        pair_scale=model.scale().double().cpu().numpy(),
        pair_residual=(distance / reach[model.images[:, 0]]).double().cpu().numpy(),
        covariance=np.full((6 * count, 6 * count), np.nan),
    )


def rotations(quat_xyzw: Tensor) -> Tensor:
    """Return rotation matrices (k,3,3) of quaternions (k,4) of any length."""
    unit, identity = torch.nn.functional.normalize(quat_xyzw, dim=1), torch.eye(3, device=quat_xyzw.device)
    axis = unit[:, None, :3].expand(-1, 3, 3)
    cross = torch.linalg.cross(axis, identity.expand_as(axis)).mT  # cross @ v is axis × v
    return identity + 2 * unit[:, 3, None, None] * cross + 2 * cross @ cross


def _parameter(values: ndarray) -> torch.nn.Parameter:
    return torch.nn.Parameter(torch.tensor(values, dtype=torch.float32))


def _quat_xyzw(recon_from_camera: Float[ndarray, "k 4 4"]) -> Float[ndarray, "k 4"]:
    return Rotation.from_matrix(recon_from_camera[:, :3, :3]).as_quat()
