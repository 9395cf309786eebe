"""Back end of another package: MapAnything (Keetha et al. 2025, arXiv 2509.13414), points and cameras in metres.

Its conventions are those of jcr: cameras x right, y down, z forward, poses recon_from_camera, pixel (0, 0) a centre. Its
package is only known from the documentation of its repository; this adapter was not run with its weights.
"""

from functools import partial
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from jcr import Capture, InputError, Reconstruction
from jcr.backends import Backend, ReconstructOptions, device_of, network_weights
from jcr.geometry import apply, inverse
from jcr.pointmaps.image_grid import image_grid, resize_and_crop
from jcr.pointmaps.posed_pointmaps import PosedPointmaps

LONG_EDGE, PATCH = 518, 14


class Model(Protocol):
    """Model of the package, as far as the adapter uses it."""

    def infer(self, views: list[dict[str, Any]], **options: Any) -> list[dict[str, Any]]:
        """Return the outputs of each view."""
        ...


def reconstruct(capture: Capture, options: ReconstructOptions, progress: Any = None) -> Reconstruction:
    """Reconstruct a capture by MapAnything."""
    from jcr.pointmaps.any_view import reconstruct_any_view  # imports torch

    return reconstruct_any_view(
        capture, load, network_weights(options), device_of(options), "mapanything", progress
    )


def load(weights: Path, device: str) -> Any:
    """Load the network from a folder; raise InputError where it has none."""
    from mapanything.models import MapAnything  # type: ignore[import-not-found]

    try:
        return partial(predict, MapAnything.from_pretrained(str(weights)).to(device), device=device)
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{weights}: no weights of MapAnything ({' '.join(str(error).split())})") from None


def predict(model: Model, views: Any, device: str = "cpu") -> PosedPointmaps:
    """Predict all views in one pass, given the intrinsics where they are known."""
    import torch

    from jcr.pointmaps.any_view import normalised, output, rigid

    grid = image_grid(views.size, LONG_EDGE, PATCH, keep_square=True)
    colors = np.stack([resize_and_crop(image, grid) for image in views.colors])
    shown: list[dict[str, Any]] = [
        {"img": image[None], "data_norm_type": ["dinov2"]} for image in normalised(colors, device)
    ]
    if views.pinhole is not None:
        matrix = torch.from_numpy(grid.grid_intrinsics(views.pinhole).matrix).float().to(device)
        for view in shown:
            view["intrinsics"] = matrix[None]
    with torch.inference_mode():
        # The mask is applied to the confidence: masked points would be zeros.
        answers = model.infer(shown, use_amp=device != "cpu", apply_mask=False)
    count, height, width = colors.shape[:3]
    points = np.empty((count, height, width, 3), np.float32)
    confidence, poses = np.empty((count, height, width)), np.empty((count, 4, 4))
    for k, answer in enumerate(answers):
        poses[k] = rigid(output(answer, "camera_poses", (1, 4, 4), "MapAnything"))[0]
        points[k] = apply(inverse(poses[k]), output(answer, "pts3d", (height, width, 3), "MapAnything"))
        confidence[k] = output(answer, "conf", (height, width), "MapAnything")
        if "mask" in answer:
            confidence[k] *= output(answer, "mask", (height, width), "MapAnything") > 0.5
    return PosedPointmaps(
        grid=grid, recon_from_camera=poses, x_in_camera=points, confidence=confidence, is_metric=True
    )


BACKEND = Backend(
    name="mapanything",
    reconstruct=reconstruct,
    licence="Apache-2.0",
    auto=True,
    tests_camera=False,
    options=("weights",),
    hub_id="facebook/map-anything-apache",
    revision="00f9c245bbcb60522d1ed7f9e9d88462c6e3f38a",
    package="mapanything",
    install="pip install git+https://github.com/facebookresearch/map-anything",
    sees_all_views=True,
)
