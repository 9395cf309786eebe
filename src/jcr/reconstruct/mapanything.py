"""The MapAnything back end (Keetha et al. 2025): all images at once, metric, told the intrinsics where known.

Its package is imported only when this back end is asked for. Its conventions are ours: cameras x right, y
down, z forward, poses recon_from_camera, pixel (0, 0) a centre.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from jcr.errors import InputError
from jcr.geometry import inverse, nearest_rotation, rotation_angle
from jcr.progress import Progress, silent
from jcr.reconstruct.pointmaps import reconstruction_from_pointmaps
from jcr.reconstruct.preprocess import PreparedImages, image_grid, prepare_images
from jcr.records import Capture, Reconstruction

LONG_EDGE, PATCH = 518, 14
# The encoder is a DINOv2, normalised as ImageNet is.
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@runtime_checkable
class Model(Protocol):
    """What is asked of the package's model."""

    def infer(self, views: list[dict[str, Any]], **options: Any) -> list[dict[str, Tensor]]: ...


@dataclass(frozen=True)
class MapAnythingOptions:
    """One pass of a metric network over all images."""

    weights: str
    """Hub id or folder; facebook/map-anything is better and non-commercial."""
    device: str = "cpu"
    """Where the network runs: cpu or cuda."""


def reconstruct(
    capture: Capture,
    options: MapAnythingOptions,
    progress: Progress | None = None,
    model: Model | None = None,
) -> Reconstruction:
    """Camera poses, pointmaps and tracks in metres, as far as the network is right about them.

    The robot's poses are not shown to it, so its own can be held against them: how far the angles between
    views differ is among the notes. Raises InputError when its weights are not there.
    """
    report = progress or silent
    model = model or _load(options)
    images = prepare_images(capture, lambda size: image_grid(size, LONG_EDGE, PATCH, keep_square=True))
    report("reconstruct", 0.0)
    with torch.inference_mode():
        # Masked points would be zeros without a say; the mask is used on the confidence instead.
        views = model.infer(_views(images, options.device), use_amp=options.device != "cpu", apply_mask=False)
    report("reconstruct", 1.0)
    count, height, width = images.colors.shape[:3]
    shapes = {"pts3d": (height, width, 3), "camera_poses": (4, 4), "conf": (height, width)}
    outputs = {name: np.empty((count, *shape), np.float32) for name, shape in shapes.items()}
    for k, view in enumerate(views):
        for name, shape in shapes.items():
            if name not in view or view[name].numel() != np.prod(shape):
                raise InputError(
                    f"MapAnything gave no {name} of shape {shape}; its package is of another release than "
                    "this jcr knows, update the older of the two"
                )
            outputs[name][k] = view[name].float().cpu().numpy().reshape(shape)
        if "mask" in view:
            outputs["conf"][k] *= view["mask"].float().cpu().numpy().reshape(height, width) > 0.5
    points, confidence = outputs["pts3d"], outputs["conf"]
    there = np.isfinite(points).all(-1) & np.isfinite(confidence) & (confidence > 0)
    recon_from_camera = outputs["camera_poses"].astype(np.float64)
    # bfloat16 leaves rotations orthonormal to three digits only.
    recon_from_camera[:, :3, :3] = nearest_rotation(recon_from_camera[:, :3, :3])
    recon_from_camera[:, 3] = [0, 0, 0, 1]
    return reconstruction_from_pointmaps(
        images,
        np.arange(count),
        recon_from_camera,
        np.where(there[..., None], points, 0),
        np.where(there, confidence, 0),
        source=options.weights,
        backend="mapanything",
        is_metric=True,
        notes=(_against_robot(recon_from_camera, capture.base_from_gripper),),
    )


def _views(images: PreparedImages, device: str) -> list[dict[str, Any]]:
    colors = torch.from_numpy(images.colors).to(device).permute(0, 3, 1, 2) / 255
    mean, deviation = (torch.tensor(values, device=device)[:, None, None] for values in (MEAN, DEVIATION))
    views: list[dict[str, Any]] = [
        {"img": image[None], "data_norm_type": ["dinov2"]} for image in (colors - mean) / deviation
    ]
    if images.intrinsics is not None:
        matrix = torch.from_numpy(images.intrinsics.matrix).float().to(device)
        for view in views:
            view["intrinsics"] = matrix[None]
    return views


def _against_robot(recon_from_camera: np.ndarray, base_from_gripper: np.ndarray) -> str:
    """The angle between two views is the same for camera and gripper, wherever the camera is mounted."""
    first, second = np.triu_indices(len(recon_from_camera), 1)
    camera, gripper = (
        rotation_angle((inverse(poses[first]) @ poses[second])[:, :3, :3])
        for poses in (recon_from_camera, base_from_gripper)
    )
    apart = np.degrees(np.median(np.abs(camera - gripper)))
    return f"angles between views differ from the robot's by {apart:.2f}° (median over pairs)"


def _load(options: MapAnythingOptions) -> Model:
    from mapanything.models import MapAnything  # type: ignore[import-not-found]

    try:
        return MapAnything.from_pretrained(options.weights).to(options.device)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(
            f"{options.weights}: no weights of MapAnything ({' '.join(str(error).split())})"
        ) from None
