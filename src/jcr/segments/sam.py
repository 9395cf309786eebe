"""Segmentation by Segment Anything 2: masks of every image, merged into objects where they overlap in space.

The network is `transformers`' Sam2Model (Ravi et al., "SAM 2: Segment Anything in Images and Videos", 2024). Its image
processor needs torchvision, so images are prepared here.
"""

import os
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch.nn import functional as F

from jcr.calibration.record import Calibration, PublishedCalibration
from jcr.errors import InputError
from jcr.extras import extra
from jcr.hub import cached_files
from jcr.progress import Progress, silent, steps
from jcr.records import Reconstruction
from jcr.segments.options import LabelImages

if TYPE_CHECKING:
    from transformers import Sam2Model

IMAGE_MEAN, IMAGE_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of RGB values in [0, 1] by which the network's input is normalised."""
SIDE_POINTS, BATCH = 16, 64
"""Number of prompt points along each side of an image, and number of prompts per forward pass."""
LEAST_QUALITY, LEAST_STABILITY = 0.7, 0.9
"""Smallest quality and stability of a mask. Quality is the network's estimate of the mask's overlap with the truth.
Stability is the overlap of the masks with the threshold one higher and one lower, as in the authors' automatic mask
generator."""
DUPLICATE_IOU = 0.7
"""Intersection over union above which two masks of one image are duplicates."""
VOXEL = 0.01
"""Side (m) of the cells of space in which masks of different images are compared."""
OVERLAP = 0.5
"""Intersection over union, in the cells that both images see, above which masks of two images show one object."""


def load_sam(weights: str) -> "Sam2Model":
    """Load Segment Anything 2 from a hub id or path, onto the GPU if there is one.

    A hub id must have been downloaded before. Raises InputError if the weights are missing or damaged.
    """
    extra("transformers", "sam", "--segments sam")
    from transformers import Sam2Model, logging

    folder = weights
    if not os.path.isdir(weights):
        if not (cached := cached_files(weights)):
            raise InputError(f"--sam-weights {weights}: not found; jcr models get {weights} downloads them")
        folder = str(cached[0].parent)

    bars = logging.is_progress_bar_enabled()
    logging.disable_progress_bar()  # loading is fast, and --quiet must print nothing
    try:
        model = Sam2Model.from_pretrained(folder, local_files_only=True)
    except (OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"--sam-weights {weights}: cannot be loaded ({reason}); it must hold config.json and model.safetensors"
        ) from None
    finally:
        if bars:
            logging.enable_progress_bar()
    torch.nn.Module.to(model.eval(), "cuda" if torch.cuda.is_available() else "cpu")
    return model


def sam_labels(
    model: "Sam2Model",
    reconstruction: Reconstruction,
    hand_eye: Calibration | PublishedCalibration,
    progress: Progress = silent,
) -> LabelImages:
    """Return label images of the registered images, on the pixel grid of the pointmaps, and label names.

    Labels are masks of Segment Anything, merged into objects by their overlap in the base frame, for which `hand_eye`
    is needed.
    """
    dense = reconstruction.dense
    images = steps(progress, "segment anything", list(dense.colors))
    masks = [image_masks(model, image) for image in images]
    x_in_base = hand_eye.base_from_recon(dense.points_in_recon.astype(np.float64))
    return merged(masks, x_in_base, dense.confidence > 0)


@torch.no_grad()
def image_masks(model: "Sam2Model", image: UInt8[ndarray, "h w 3"]) -> Bool[ndarray, "k h w"]:
    """Return the k masks that the network finds in one RGB image, highest quality first, without duplicates.

    Prompts are points on a regular grid. The network gives three masks for each, of which the one of highest quality is
    taken. The quality is the network's estimate of the mask's intersection over union with the truth. Masks below
    LEAST_QUALITY or LEAST_STABILITY are left out.
    """
    device = next(model.parameters()).device
    size = model.config.prompt_encoder_config.image_size  # pyright: ignore
    height, width = (size, size) if isinstance(size, int) else size
    pixels = torch.from_numpy(image).to(device).movedim(-1, 0)[None] / 255
    pixels = F.interpolate(pixels, (height, width), mode="bilinear", antialias=True)
    mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (IMAGE_MEAN, IMAGE_STD))
    embeddings = model.get_image_embeddings((pixels - mean) / std)
    steps = (torch.arange(SIDE_POINTS, device=device) + 0.5) / SIDE_POINTS
    points = torch.stack(torch.meshgrid(steps * width, steps * height, indexing="xy"), -1).reshape(-1, 1, 2)
    found, quality = [], []
    for batch in points.split(BATCH):
        out = model(
            input_points=batch[None],
            input_labels=torch.ones(1, len(batch), 1, dtype=torch.int64, device=device),
            image_embeddings=embeddings,
        )
        best = out.iou_scores[0].argmax(1)
        row = torch.arange(len(best), device=device)
        logits = F.interpolate(out.pred_masks[0][row, best][None], image.shape[:2], mode="bilinear")[0]
        stable = (logits > 1).sum((1, 2)) / (logits > -1).sum((1, 2)).clamp(min=1)
        good = (out.iou_scores[0][row, best] >= LEAST_QUALITY) & (stable >= LEAST_STABILITY)
        found.append(logits[good] > 0)
        quality.append(out.iou_scores[0][row, best][good])
    masks = torch.cat(found)[torch.cat(quality).argsort(descending=True)]
    flat = masks.flatten(1).float()
    area, shared = flat.sum(1), flat @ flat.T
    same = shared > DUPLICATE_IOU * (area[:, None] + area - shared)
    kept: list[int] = []
    for k in range(len(masks)):  # skip masks that repeat a better one
        if area[k] > 0 and not same[k, kept].any():
            kept.append(k)
    return masks[kept].cpu().numpy()


def merged(
    masks: list[Bool[ndarray, "_ h w"]], x_in_base: Float[ndarray, "m h w 3"], known: Bool[ndarray, "m h w"]
) -> LabelImages:
    """Return label images (m,h,w) from the masks of m images, 1 for the largest object, 0 for none, and label names.

    `masks` has the masks of each image. `x_in_base` is the position of each pixel (m), and `known` marks the pixels
    with a position. Two masks of different images show one object if they fill the same cells of space, counted in
    cells that both images see. Their intersection over union in cells of 1 cm must exceed 0.5. If there are several
    images, an object must appear in two or more. Where masks overlap, the smaller one is used.
    """
    low = x_in_base[known].min(0) if known.any() else np.zeros(3)
    cell = np.floor((x_in_base - low) / VOXEL).astype(np.int64)
    shape = cell[known].max(0, initial=0) + 1
    cell = np.ravel_multi_index(tuple(np.moveaxis(cell, -1, 0)), tuple(shape), mode="clip")
    numbers, cell = np.unique(np.where(known, cell, -1), return_inverse=True)
    cell = cell.reshape(known.shape)
    # Rows are masks or images, columns are cells of space.
    image_of = np.repeat(np.arange(len(masks)), [len(of_image) for of_image in masks])
    inside = np.zeros((len(image_of), len(numbers)), bool)
    seen = np.zeros((len(masks), len(numbers)), bool)
    for k in range(len(masks)):
        seen[k, cell[k][known[k]]] = True
        for row, mask in zip(np.flatnonzero(image_of == k), masks[k], strict=True):
            inside[row, cell[k][mask & known[k]]] = True
    holds = inside.astype(np.float32)
    shared = holds @ holds.T
    in_other = (holds @ seen.T.astype(np.float32))[:, image_of]
    union = in_other + in_other.T - shared
    one = (shared > OVERLAP * union) & (image_of[:, None] != image_of)
    _, group = connected_components(coo_array(one), directed=False)

    several = np.array([len(np.unique(image_of[group == g])) for g in range(group.max(initial=-1) + 1)])
    size = np.array([inside[group == g].any(0).sum() for g in range(len(several))])
    size[several < min(2, len(masks))] = 0
    rank = np.zeros(len(size), int)
    rank[np.argsort(-size)[: (size > 0).sum()]] = np.arange(1, (size > 0).sum() + 1)
    labels = np.zeros(known.shape, np.int64)
    for row in np.argsort([-mask.sum() for of_image in masks for mask in of_image]):
        # Smaller masks overwrite larger ones: a mug lies on the table.
        k = image_of[row]
        mask = masks[k][row - np.searchsorted(image_of, k)]
        if rank[group[row]] > 0:
            labels[k][mask] = rank[group[row]]
    return labels, ("none", *(f"segment {n}" for n in range(1, int((size > 0).sum()) + 1)))
