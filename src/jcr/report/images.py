"""Section of the images: each with its residuals and the reprojection errors of its features."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.camera import is_distorted, project, resized, undistortion, unproject, without_distortion
from jcr.capture.images import read_image
from jcr.geometry import apply, inverse
from jcr.records import Capture, ImageVerdict, Intrinsics, Reconstruction
from jcr.report.raster import image_url
from jcr.report.render import Section
from jcr.rounding import significant
from jcr.run_folder import RunResult

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


def images_section(result: RunResult) -> Section:
    """Return every image with its numbers, and the reason where it was rejected."""
    images, marks = result.calibration.images, _reprojections(result)
    urls = thumbnails(result.capture, result.intrinsics)
    cards = [
        {
            "path": image.image,
            "name": name,
            "url": url,
            "numbers": image_numbers(image),
            "rejected": None if image.used else image.reason or "no reason given",
            "marks": marks.get(k),
        }
        for k, (image, name, url) in enumerate(zip(images, shown_names(images), urls, strict=True))
    ]
    return _section(cards, result.capture, result.intrinsics)


def images_alone_section(capture: Capture) -> Section:
    """Return the images of a run without a calibration."""
    cards = [
        {"path": name, "name": name, "url": url, "numbers": "", "rejected": None, "marks": None}
        for name, url in zip(capture.images, thumbnails(capture, capture.intrinsics), strict=True)
    ]
    return _section(cards, capture, None)


def _section(cards: Sequence[dict[str, Any]], capture: Capture, intrinsics: Intrinsics | None) -> Section:
    """Return the section of cards; `intrinsics` are those of a calibration, None without one."""
    width, height = capture.image_size
    content = {
        "cards": cards,
        "shown": SHOWN,
        "is_calibrated": intrinsics is not None,
        "rejected": sum(card["rejected"] is not None for card in cards),
        "magnified": MAGNIFIED,
        "size": (width, height) if intrinsics is None else (intrinsics.width, intrinsics.height),
        "pixels": pixels_of_file(intrinsics or capture.intrinsics, capture.image_size),
    }
    return Section("images", content)


def pixels_of_file(intrinsics: Intrinsics | None, size: tuple[int, int]) -> dict[str, list[list[float]]]:
    """Return x and y, in the image file, of a grid of points over the displayed image, which is undistorted."""
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in size)
    shown = np.stack(np.meshgrid(u, v), axis=-1)
    if intrinsics is not None and is_distorted(intrinsics):
        shown = project(intrinsics, unproject(without_distortion(intrinsics), shown))
    x, y = np.moveaxis(shown.round(1), -1, 0).tolist()
    return {"x": x, "y": y}


def _reprojections(result: RunResult) -> dict[int, str]:
    """Return an SVG path per image of the capture: reprojection errors of some features."""
    tracks = result.reconstruction.tracks
    intrinsics = result.intrinsics or result.reconstruction.intrinsics
    if len(tracks.image) == 0:
        return {}
    errors, straight = reprojections_px(result.reconstruction), without_distortion(intrinsics)
    drawings, draw = {}, np.random.default_rng(0)
    for k, row in enumerate(result.image_index):
        seen = np.flatnonzero(tracks.image == k)
        if len(seen) == 0:
            continue
        seen = draw.permutation(seen)[:MARKS]
        at = project(straight, unproject(intrinsics, tracks.x_px[seen])) + 0.5
        drawings[int(row)] = "".join(
            f"M{x:.0f} {y:.0f}l{dx:.0f} {dy:.0f}"
            for (x, y), (dx, dy) in zip(at, MAGNIFIED * errors[seen], strict=True)
        )
    return drawings


def reprojections_px(reconstruction: Reconstruction) -> Float[ndarray, "k 2"]:
    """Return the vector from each feature to the projection of its 3D point (px)."""
    tracks = reconstruction.tracks
    errors = np.zeros_like(tracks.x_px)
    for k, camera_from_recon in enumerate(inverse(reconstruction.recon_from_camera)):
        seen = tracks.image == k
        x_in_camera = apply(camera_from_recon, tracks.points_in_recon[tracks.point[seen]])
        errors[seen] = project(reconstruction.intrinsics, x_in_camera) - tracks.x_px[seen]
    return errors


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
