"""The section that shows the trained map: from the cameras' places, and cut open."""

from html import escape
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import apply, apply_similarity, inverse
from jcr.report.figures import TRACK_COLOR, label_colors, picture_url, rendered_points, slice_figure
from jcr.report.map_samples import CLEARANCE, SurfacePoints, point_size, slices
from jcr.report.markup import filled
from jcr.report.pictures import shown_names
from jcr.results import RunResult

if TYPE_CHECKING:
    from jcr.represent.scene import SceneMap

WIDE = 480
"""Pixels across of an image that stands alone."""
PAIRS = 4
"""Images that are shown beside the map."""
THUMBNAIL = 320
"""Pixels across of a rendered view."""


def map_section(
    result: RunResult,
    scene: "SceneMap",
    surface: SurfacePoints,
    base_from_camera: Float[ndarray, "m 4 4"],
) -> str:
    """Sampled points in predicted colour and class beside the images, and two slices of the occupancy."""
    level, upright = slices(scene, surface)
    above = f"{100 * CLEARANCE:.0f} cm above the support"
    return filled(
        "map.html",
        size=" × ".join(f"{side:.2f}" for side in scene.box[1] - scene.box[0]),
        unknown=f"{100 * surface.unknown_share:.0f}",
        pairs=_pairs(result, scene, surface, base_from_camera),
        overlaid=_overlaid(result, base_from_camera),
        slices=slice_figure(f"Occupancy at z = {level.at:.3f} m, {above}", level, upright.at, "upright slice")
        + slice_figure(f"Occupancy at y = {upright.at:.3f} m", upright, level.at, "level slice"),
    )


def _overlaid(result: RunResult, base_from_camera: Float[ndarray, "m 4 4"]) -> str:
    """The dense cloud with the tracked features in red (paper, section V), as two cameras see it."""
    reconstruction, hand_eye, cloud = result.reconstruction, result.hand_eye, result.cloud
    tracked = reconstruction.tracks.points_in_recon
    if cloud is None or len(tracked) == 0:
        return ""
    tracked = apply_similarity(hand_eye.base_from_recon, hand_eye.scale, tracked)
    lens, side = reconstruction.dense.intrinsics, point_size(cloud.points_in_base)
    red = np.tile(np.array(TRACK_COLOR, np.uint8), (len(tracked), 1))
    names = shown_names(result.calibration.images)
    figures = []
    for k in np.unique(np.flatnonzero(hand_eye.inliers)[[0, -1]]):
        camera_from_base = inverse(base_from_camera[k])
        pixels = rendered_points(apply(camera_from_base, cloud.points_in_base), cloud.color, side, lens, WIDE)
        over = rendered_points(apply(camera_from_base, tracked), red, side, lens, WIDE)
        pixels = np.where(over[..., 3:] > 0, over, pixels)
        name = escape(names[int(reconstruction.image_index[k])])
        figures.append(
            f'<figure><div class="pair"><img src="{picture_url(pixels, "WEBP")}" alt="{name}"></div>'
            f"<figcaption>from the place of {name}</figcaption></figure>"
        )
    return (
        "<h3>Points as measured, and the tracked features in red</h3>"
        f'<div class="pairs">{"".join(figures)}</div>'
    )


def _pairs(
    result: RunResult,
    scene: "SceneMap",
    surface: SurfacePoints,
    base_from_camera: Float[ndarray, "m 4 4"],
) -> str:
    reconstruction, dense = result.reconstruction, result.reconstruction.dense
    lens = dense.intrinsics
    size = (THUMBNAIL, round(THUMBNAIL * lens.height / lens.width))
    used = np.flatnonzero(result.hand_eye.inliers)
    chosen = used[np.linspace(0, len(used) - 1, min(PAIRS, len(used))).round().astype(int)]
    side = point_size(surface.points_in_base)
    names = shown_names(result.calibration.images)
    colors, caption = [surface.color], "photograph; points of predicted occupancy over ½, in predicted colour"
    if len(scene.label_names) > 1:
        colors.append(label_colors(len(scene.label_names))[surface.label])
        caption += "; the same by predicted label"
    figures = []
    for k in chosen:
        photograph = cv2.resize(dense.colors[k], size, interpolation=cv2.INTER_AREA)
        x_in_camera = apply(inverse(base_from_camera[k]), surface.points_in_base)
        urls = [picture_url(photograph, "JPEG")]
        urls += [picture_url(rendered_points(x_in_camera, c, side, lens, THUMBNAIL), "WEBP") for c in colors]
        name = escape(names[int(reconstruction.image_index[k])])
        pictures = "".join(f'<img src="{url}" alt="{name}">' for url in urls)
        figures.append(
            f'<figure><div class="pair">{pictures}</div><figcaption>{name}: {caption}</figcaption></figure>'
        )
    return "".join(figures)
