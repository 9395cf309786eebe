"""Section of the images: each with its residuals and the reprojection errors of its features."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from jcr.camera import is_distorted, project, resized, undistortion, unproject, without_distortion
from jcr.capture.images import read_image
from jcr.geometry import apply, inverse
from jcr.records import Capture, ImageVerdict, Intrinsics
from jcr.report.render import Content, image_url
from jcr.result import RunResult
from jcr.rounding import significant

LARGEST, SMALLEST, PIXELS = 1024, 160, 6e6
"""Pixels across of the images, and of all together at most, which is about a megabyte; they open large."""
MARKS, MAGNIFIED = 120, 20
"""Features drawn over each image, and how many times their reprojection errors are drawn longer."""
SHOWN = 12
"""Images that are not collapsed."""
GRID = 17
"""Points to a side at which the pixels of an image's file are given; between them they are interpolated."""


def shown_names(images: Sequence[ImageVerdict]) -> list[str]:
    """Return file names without their folders, unless two of them would then be the same."""
    short = [Path(image.image).name for image in images]
    return short if len(set(short)) == len(short) else [image.image for image in images]


def image_numbers(image: ImageVerdict) -> str:
    """Return residuals and median reprojection error of one image as text, as far as there are any."""
    parts = [
        (image.translation_residual_mm, " mm"),
        (image.rotation_residual_deg, "°"),
        (image.reprojection_px, " px"),
    ]
    return " · ".join(f"{significant(value)}{unit}" for value, unit in parts if value is not None)


def images_section(capture: Capture, result: RunResult | None = None) -> Content:
    """Return every image, of a calibration with its numbers, and the reason where it was rejected."""
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
    content = {
        "cards": cards,
        "shown": SHOWN,
        "is_calibrated": is_calibrated,
        "rejected": sum(card["rejected"] is not None for card in cards),
        "magnified": MAGNIFIED,
        "size": (intrinsics.width, intrinsics.height) if is_calibrated and intrinsics else capture.image_size,
        "pixels": pixels_of_file(intrinsics or capture.intrinsics, capture.image_size),
    }
    return content


def pixels_of_file(intrinsics: Intrinsics | None, size: tuple[int, int]) -> dict[str, list[list[float]]]:
    """Return x and y, in the image file, of a grid of points over the displayed image, which is undistorted."""
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in size)
    shown = np.stack(np.meshgrid(u, v), axis=-1)
    if intrinsics is not None and is_distorted(intrinsics):
        shown = project(intrinsics, unproject(without_distortion(intrinsics), shown))
    x, y = np.moveaxis(shown.round(1), -1, 0).tolist()
    return {"x": x, "y": y}


def _reprojections(result: RunResult) -> dict[int, str]:
    """Return an SVG path per image of the capture: lines from some features to the projections of their 3D points."""
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
    """Return every image as a small JPEG, undistorted as in the 3D view; more images are smaller."""
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
        return image_url(pixels if undistort is None else undistort(pixels))

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(thumbnail, capture.images))
