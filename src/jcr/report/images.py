"""Section of the images in the report: each with its residuals and the reprojection errors of its features."""

import base64
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jcr.camera import is_distorted, project, resized, undistortion, unproject, without_distortion
from jcr.capture.images import encode_jpeg, read_image
from jcr.geometry import apply, inverse
from jcr.number_format import significant
from jcr.records import Capture, ImageVerdict, Intrinsics
from jcr.report.render import Content
from jcr.result import RunResult

LARGEST, SMALLEST, PIXELS = 1024, 160, 6e6
"""Largest and smallest width (px) of the images in the report, and largest number of all their pixels, about 1 MB."""
MARKS, MAGNIFIED = 120, 20
"""Largest number of features drawn over an image, and factor by which their reprojection errors are magnified."""
OPEN_IMAGES = 12
"""Number of images that are not collapsed."""
GRID = 17
"""Points per side of the grid in `pixels_of_file`; the page interpolates between them."""


def shown_names(images: Sequence[ImageVerdict]) -> list[str]:
    """Return the file names of images without their folders, or with them if two names would be equal."""
    short = [Path(image.image).name for image in images]
    return short if len(set(short)) == len(short) else [image.image for image in images]


def image_numbers(image: ImageVerdict) -> str:
    """Return translation and rotation residual and median reprojection error of an image as text; none if unknown."""
    parts = [
        (image.translation_residual_mm, "\u00a0mm"),
        (image.rotation_residual_deg, "°"),
        (image.reprojection_px, "\u00a0px"),
    ]
    return " · ".join(f"{significant(value)}{unit}" for value, unit in parts if value is not None)


def images_section(capture: Capture, result: RunResult | None = None) -> Content:
    """Return a card for each image; with a `result` also its residuals, feature marks, and reason of a rejection."""
    intrinsics = capture.intrinsics if result is None else result.intrinsics
    cards: list[dict[str, Any]] = [
        {"path": name, "name": name, "url": url, "numbers": "", "rejected": None, "marks": None}
        for name, url in zip(capture.images, thumbnails(capture, intrinsics), strict=True)
    ]
    if result is not None:
        images, marks = result.calibration.images, _reprojections(result)
        for k, (card, image, name) in enumerate(zip(cards, images, shown_names(images), strict=True)):
            card |= {"name": name, "numbers": image_numbers(image), "marks": marks.get(k)}
            card["rejected"] = None if image.used else image.reason or "no reason given"
    is_calibrated = result is not None and intrinsics is not None
    return {
        "cards": cards,
        "shown": OPEN_IMAGES,
        "is_calibrated": is_calibrated,
        "rejected": sum(card["rejected"] is not None for card in cards),
        "magnified": MAGNIFIED,
        "size": (intrinsics.width, intrinsics.height) if is_calibrated and intrinsics else capture.image_size,
        "pixels": pixels_of_file(intrinsics or capture.intrinsics, capture.image_size),
    }


def pixels_of_file(intrinsics: Intrinsics | None, size: tuple[int, int]) -> dict[str, list[list[float]]]:
    """Return for GRID x GRID points of a displayed image their pixels in the image file: {"x": rows, "y": rows}.

    The points form a regular 17 x 17 grid over the whole displayed image, row by row from its top-left corner. The
    displayed image has `size` (width, height) and no distortion; the file has the distortion of `intrinsics` (None:
    none). The page uses the grid to show the pixel under the pointer.
    """
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in size)
    shown = np.stack(np.meshgrid(u, v), axis=-1)
    if intrinsics is not None and is_distorted(intrinsics):
        shown = project(intrinsics, unproject(without_distortion(intrinsics), shown))
    x, y = np.moveaxis(shown.round(1), -1, 0).tolist()
    return {"x": x, "y": y}


def _reprojections(result: RunResult) -> dict[int, str]:
    """Return the reprojection errors of each registered image as an SVG path, by the index of the image in the capture.

    Each path has lines for up to 120 features, from the feature towards the projection of its 3D point, 20 times as
    long as the error (px). Its coordinates are pixels of the undistorted image from the top-left corner.
    """
    found, tracks = result.reconstruction, result.reconstruction.tracks
    straight = without_distortion(result.intrinsics or found.intrinsics)
    drawings, draw = {}, np.random.default_rng(0)
    for k, row in enumerate(result.image_index):
        seen = draw.permutation(np.flatnonzero(tracks.image == k))[:MARKS]
        if len(seen) == 0:
            continue
        x_px = tracks.x_px[seen]
        x_in_camera = apply(inverse(found.recon_from_camera[k]), tracks.points_in_recon[tracks.point[seen]])
        error = MAGNIFIED * (project(found.intrinsics, x_in_camera) - x_px)
        at = project(straight, unproject(result.intrinsics or found.intrinsics, x_px)) + 0.5
        drawings[int(row)] = "".join(
            f"M{x:.0f} {y:.0f}l{dx:.0f} {dy:.0f}" for (x, y), (dx, dy) in zip(at, error, strict=True)
        )
    return drawings


def thumbnails(capture: Capture, intrinsics: Intrinsics | None) -> list[str]:
    """Return every image as data URL of a small undistorted JPEG; its width decreases with the number of images.

    `intrinsics` are those of the image files; None: the distortion is unknown and not removed.
    """
    shape = capture.image_size[1] / capture.image_size[0]
    width = min(LARGEST, capture.image_size[0], int(np.sqrt(PIXELS / len(capture) / shape)))
    width = max(width, SMALLEST)
    size = width, round(width * shape)
    undistort = None
    if intrinsics is not None and is_distorted(intrinsics):
        small = resized(intrinsics, *size)
        undistort = undistortion(small, without_distortion(small))

    def thumbnail(name: str) -> str:
        pixels = cv2.resize(read_image(capture.folder / name), size, interpolation=cv2.INTER_AREA)
        jpeg = encode_jpeg(pixels if undistort is None else undistort(pixels))
        return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(thumbnail, capture.images))
