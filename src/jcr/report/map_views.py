"""The sections on the trained map: from the cameras' places, cut open, and what stands on its support plane."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import apply, apply_similarity, inverse
from jcr.report.figures import slice_figure
from jcr.report.images import shown_names
from jcr.report.map_samples import CLEARANCE, SurfacePoints, point_size, slices
from jcr.report.raster import TRACK_COLOR, colored, image_url, label_colors, points_in_pixels
from jcr.report.render import Section
from jcr.results import RunResult
from jcr.segment.measure import Measured

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap

WIDE = 480
"""Pixels across of an image that stands alone."""
DRAWN = 100_000
"""Points of the cloud in it, at most twice as many."""
PAIRS = 4
"""Images that are shown beside the map."""
THUMBNAIL = 320
"""Pixels across of a rendered view."""

Row = tuple[str, list[str]]
"""An image's name, and the data URLs beside one another."""


def map_section(
    result: RunResult,
    scene: "SceneMap",
    surface: SurfacePoints,
    base_from_camera: Float[ndarray, "m 4 4"],
) -> Section:
    """Sampled points in predicted colour and class beside the images, and two slices of the occupancy."""
    level, upright = slices(scene, surface)
    above = f"{100 * CLEARANCE:.0f} cm above the support"
    content = {
        "size": " × ".join(f"{side:.2f}" for side in scene.box[1] - scene.box[0]),
        "unknown": f"{100 * surface.unknown_share:.0f}",
        "has_labels": len(scene.label_names) > 1,
        "pairs": list(_pairs(result, len(scene.label_names), surface, base_from_camera)),
        "overlaid": list(_overlaid(result, base_from_camera)),
        "slices": [
            slice_figure(f"Occupancy at z = {level.at:.3f} m, {above}", level, upright.at, "upright slice"),
            slice_figure(f"Occupancy at y = {upright.at:.3f} m", upright, level.at, "level slice"),
        ],
    }
    return Section("map", content)


def _overlaid(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> Iterator[Row]:
    """The dense cloud with the tracked features in red (paper, section V), as two cameras see it."""
    reconstruction, hand_eye, cloud = result.reconstruction, result.hand_eye, result.cloud
    tracked = reconstruction.tracks.points_in_recon
    if cloud is None or len(tracked) == 0:
        return
    tracked = apply_similarity(hand_eye.base_from_recon, hand_eye.scale, tracked)
    every = max(len(cloud.points_in_base) // DRAWN, 1)
    measured, color = cloud.points_in_base[::every], cloud.color[::every]
    intrinsics, side = reconstruction.dense.intrinsics, point_size(measured)
    red = np.tile(np.array(TRACK_COLOR, np.uint8), (len(tracked), 1))
    names = shown_names(result.calibration.images)
    for k in np.unique(np.flatnonzero(hand_eye.inliers)[[0, -1]]):
        pixels, over = (
            colored(points_in_pixels(apply(inverse(base_from_camera[k]), x), side, intrinsics, WIDE), color)
            for x, color in ((measured, color), (tracked, red))
        )
        pixels = np.where(over[..., 3:] > 0, over, pixels)
        yield names[int(reconstruction.image_index[k])], [image_url(pixels, "WEBP")]


def _pairs(
    result: RunResult, labels: int, surface: SurfacePoints, base_from_camera: Float[ndarray, "m 4 4"]
) -> Iterator[Row]:
    """A photograph each, and the map from there in predicted colour and, where it has labels, by label."""
    dense = result.reconstruction.dense
    intrinsics = dense.intrinsics
    size = (THUMBNAIL, round(THUMBNAIL * intrinsics.height / intrinsics.width))
    used = np.flatnonzero(result.hand_eye.inliers)
    chosen = used[np.linspace(0, len(used) - 1, min(PAIRS, len(used))).round().astype(int)]
    names = shown_names(result.calibration.images)
    colors = [surface.color] + ([label_colors(labels)[surface.label]] if labels > 1 else [])
    for k in chosen:
        photograph = cv2.resize(dense.colors[k], size, interpolation=cv2.INTER_AREA)
        x_in_camera = apply(inverse(base_from_camera[k]), surface.points_in_base)
        shown = points_in_pixels(x_in_camera, surface.point_size, intrinsics, THUMBNAIL)
        urls = [image_url(photograph, "JPEG"), *(image_url(colored(shown, c), "WEBP") for c in colors)]
        yield names[int(result.image_index[k])], urls


def objects_section(measured: Measured, label_names: tuple[str, ...]) -> Section:
    """Height and box of every object with one standard deviation, beside the colour of its label."""
    colors = label_colors(len(label_names)).tolist()
    rows = []
    for one in measured.objects:
        length, width, height = (
            f"{1e3 * value:.1f} ±\u00a0{1e3 * std:.1f}"
            for value, std in zip(one.box_size, one.box_std, strict=True)
        )
        if not one.top_seen:
            height = f"at least {1e3 * one.height:.1f}"
        x, y = one.base_from_box[:2, 3]
        rows.append((one.name, colors[one.label], (height, length, width, f"{x:.3f}, {y:.3f}")))
    return Section("objects", {"rows": rows, "noise": f"{1e3 * measured.support.noise:.1f}"})
