"""How far predicted pairs are from the truth, in one view's own unit and in the poses they imply."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from PIL import Image

from jcr.geometry import fit_similarity, inverse, rotation_between_deg
from jcr.reconstruct.dust3r.network import Dust3r, Features
from jcr.reconstruct.dust3r.preprocess import cover_grid, resize_and_crop
from jcr.simulate.truth import read_truth, true_depth
from jcr.train.scenes import Views, points_in_camera


class PairErrors(NamedTuple):
    """Of e pairs."""

    points: Float[ndarray, "e"]
    """Median over the pixels of both views of the distance from the truth over that from the camera, at the
    scale that fits best."""
    rotation_deg: Float[ndarray, "e"]
    """Of the second camera in the first one's frame."""
    direction_deg: Float[ndarray, "e"]
    """Of the way from the first camera to the second."""


@torch.inference_mode()
def pair_errors(network: Dust3r, views: Views, first: torch.Tensor, second: torch.Tensor) -> PairErrors:
    """Errors of ordered pairs, of which each must be there in both orders."""
    features = network.encode(views.images)
    parts = []
    for rows in torch.arange(len(first)).split(32):
        pair = [Features(features.tokens[x[rows]], features.grid) for x in (first, second)]
        parts.append([x.points[:, 2::4, 2::4].flatten(1, 2).cpu() for x in network.decode(*pair)])
    points1, points2 = (torch.cat(part).double().numpy() for part in zip(*parts, strict=True))
    true = points_in_camera(views)[:, 2::4, 2::4].flatten(1, 2).double().cpu().numpy()
    world_from_camera = views.world_from_camera.double().cpu().numpy()
    edges = torch.stack([first, second], 1).tolist()
    row = {tuple(edge): e for e, edge in enumerate(edges)}
    errors = np.empty((len(edges), 3))
    for e, (i, j) in enumerate(edges):
        i_from_j = inverse(world_from_camera[i]) @ world_from_camera[j]
        truth = np.concatenate([true[i], true[j] @ i_from_j[:3, :3].T + i_from_j[:3, 3]])
        found = np.concatenate([points1[e], points2[e]])
        found, truth = (x[np.concatenate([true[i], true[j]])[:, 2] > 0] for x in (found, truth))
        length = np.linalg.norm(truth, axis=1)
        scale = np.median(length / np.linalg.norm(found, axis=1))
        pose, _ = fit_similarity(points2[e], points1[row[j, i]])
        direction = (
            pose[:3, 3] @ i_from_j[:3, 3] / np.linalg.norm(pose[:3, 3]) / np.linalg.norm(i_from_j[:3, 3])
        )
        errors[e] = (
            np.median(np.linalg.norm(scale * found - truth, axis=1) / length),
            rotation_between_deg(pose[:3, :3], i_from_j[:3, :3]),
            np.degrees(np.arccos(np.clip(direction, -1, 1))),
        )
    return PairErrors(*errors.T)


def summary(errors: PairErrors) -> dict[str, float]:
    """Medians, and the area under the curve of the share of pairs below an angle, up to 5° and 15°."""
    worse = np.maximum(errors.rotation_deg, errors.direction_deg)
    return {
        "points_percent": round(100 * float(np.median(errors.points)), 2),
        "rotation_deg": round(float(np.median(errors.rotation_deg)), 2),
        "direction_deg": round(float(np.median(errors.direction_deg)), 2),
        "auc5": round(area_under_curve(worse, 5.0), 3),
        "auc15": round(area_under_curve(worse, 15.0), 3),
    }


def area_under_curve(error_deg: Float[ndarray, "e"], limit_deg: float) -> float:
    """Mean over angles up to the limit of the share of errors below them."""
    return float(np.clip(1 - error_deg / limit_deg, 0, None).mean())


def capture_views(folder: Path, size: tuple[int, int]) -> Views:
    """The images of a simulated capture with their truth, resized and cropped as the network reads them.

    A depth of 0 is where there is nothing.
    """
    truth = read_truth(folder)
    camera = truth.intrinsics
    grid = cover_grid((camera.width, camera.height), size)
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    column, row = (
        grid.original_from_grid(np.stack([x, y], -1).astype(float)).round().astype(int).transpose(2, 0, 1)
    )
    images, depths = [], []
    for k, name in enumerate(truth.images):
        image = np.asarray(Image.open(folder / name).convert("RGB"))
        images.append(torch.from_numpy(resize_and_crop(image, grid).copy()).permute(2, 0, 1) / 127.5 - 1)
        depths.append(torch.from_numpy(true_depth(truth, k)[row, column].astype(np.float32)))
    focal = grid.grid_intrinsics(camera).fx
    return Views(
        torch.stack(images),
        torch.stack(depths),
        torch.from_numpy(truth.base_from_camera.astype(np.float32)),
        torch.full((len(images),), focal),
    )
