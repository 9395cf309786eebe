"""The section that goes through the images: what each shows, and how well its features fit."""

import json
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from html import escape
from pathlib import Path

import cv2
import numpy as np

from jcr.camera import is_distorted, project, resized, undistortion, unproject, without_distortion
from jcr.capture.images import read_image
from jcr.geometry import apply, inverse
from jcr.records import Capture, ImageVerdict, Intrinsics
from jcr.report.figures import picture_url
from jcr.report.markup import filled
from jcr.results import RunResult
from jcr.rounding import significant

LARGEST, SMALLEST, PIXELS = 1024, 160, 6e6
"""Pixels across of the images, and of all together at most, which is about a megabyte; they open large."""
MARKS, MAGNIFIED = 120, 20
"""Features drawn over each image, and how many times their reprojection errors are drawn longer."""


GRID = 17
"""Points to a side at which the pixels of an image's file are given; between them they are interpolated."""


def shown_names(images: Sequence[ImageVerdict]) -> list[str]:
    """File names without their folders, unless two of them would then be the same."""
    short = [Path(image.image).name for image in images]
    return short if len(set(short)) == len(short) else [image.image for image in images]


def image_numbers(image: ImageVerdict) -> str:
    """Residuals and median reprojection error of one image, as far as there are any."""
    parts = [
        (image.translation_residual_mm, " mm"),
        (image.rotation_residual_deg, "°"),
        (image.reprojection_px, " px"),
    ]
    return " · ".join(f"{significant(value)}{unit}" for value, unit in parts if value is not None)


def images_section(result: RunResult) -> str:
    """Every image with its numbers, and why it was rejected if it was."""
    images = result.calibration.images
    cards, marks = [], _reprojections(result)
    pictures = zip(images, shown_names(images), thumbnails(result.capture, result.lens), strict=True)
    for k, (image, name, picture) in enumerate(pictures):
        numbers = image_numbers(image)
        lines = [f'<span class="file" title="{escape(image.image)}">{escape(name)}</span>']
        if numbers:
            lines.append(f"<span>{numbers}</span>")
        if not image.used:
            lines.append(f'<span class="why">Rejected: {escape(image.reason or "no reason given")}</span>')
        if numbers:
            lines.append(f'<button data-through="{k}">look from here</button>')
        cards.append(
            f'<figure class="{"used" if image.used else "rejected"}"><div class="shot"><img id="image-{k}" '
            f'src="{picture}" alt="{escape(image.image)}">{marks.get(k, "")}</div>'
            f"<figcaption>{''.join(lines)}</figcaption></figure>"
        )
    rejected = sum(not image.used for image in images)
    say = f"{rejected} of {len(images)} were rejected." if rejected else f"All {len(images)} were used."
    about = (
        "With each: how far its gripper pose is from where the calibration puts it (mm, degrees), and the median "
        "distance between its features and their 3D points (pixels). Marks are features that other images show too, "
        f"each with the way to where its 3D point falls, {MAGNIFIED} times as long."
    )
    pixels = pixels_of_file(result.lens, result.capture.image_size)
    return filled("images.html", say=say, about=about, cards="".join(cards), pixels=pixels)


def pixels_of_file(lens: Intrinsics | None, size: tuple[int, int]) -> str:
    """JSON: x and y, in the image file, of a grid of points over an image as it is shown, which is undistorted."""
    u, v = (np.linspace(-0.5, side - 0.5, GRID) for side in size)
    shown = np.stack(np.meshgrid(u, v), axis=-1)
    if lens is not None and is_distorted(lens):
        shown = project(lens, unproject(without_distortion(lens), shown))
    x, y = np.moveaxis(shown.round(1), -1, 0).tolist()
    return json.dumps({"x": x, "y": y})


def _reprojections(result: RunResult) -> dict[int, str]:
    """Per image of the capture a drawing over its image: some features, and where their 3D points fall."""
    reconstruction, lens = result.reconstruction, result.lens
    tracks, straight = reconstruction.tracks, without_distortion(lens)
    drawings, draw = {}, np.random.default_rng(0)
    for k, row in enumerate(reconstruction.image_index):
        seen = np.flatnonzero(tracks.image == k)
        if len(seen) == 0:
            continue
        seen = draw.permutation(seen)[:MARKS]
        x_in_camera = apply(
            inverse(reconstruction.recon_from_camera[k]), tracks.points_in_recon[tracks.point[seen]]
        )
        miss = project(reconstruction.intrinsics, x_in_camera) - tracks.x_px[seen]
        at = project(straight, unproject(lens, tracks.x_px[seen])) + 0.5
        ways = "".join(
            f"M{x:.0f} {y:.0f}l{dx:.0f} {dy:.0f}"
            for (x, y), (dx, dy) in zip(at, MAGNIFIED * miss, strict=True)
        )
        drawings[int(row)] = (
            f'<svg class="marks" viewBox="0 0 {lens.width} {lens.height}" aria-hidden="true"><path d="{ways}"/></svg>'
        )
    return drawings


def thumbnails(capture: Capture, lens: Intrinsics | None) -> list[str]:
    """Every image as a JPEG of the size that there is room for; intrinsics undistort it, to what the 3D view shows."""
    shape = capture.image_size[1] / capture.image_size[0]
    width = min(LARGEST, capture.image_size[0], int(np.sqrt(PIXELS / len(capture) / shape)))
    width = max(width, SMALLEST)

    size = width, round(width * shape)
    undistort = None
    if lens is not None and is_distorted(lens):
        small = resized(lens, *size)
        undistort = undistortion(small, without_distortion(small))

    def thumbnail(name: str) -> str:
        pixels = cv2.resize(read_image(capture.folder / name), size, interpolation=cv2.INTER_AREA)
        return picture_url(pixels if undistort is None else undistort(pixels), "JPEG")

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(thumbnail, capture.images))
