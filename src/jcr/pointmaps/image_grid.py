"""Images at the resolution of a network, and the intrinsics of their pixels.

Pixel (0, 0) is the centre of the top-left pixel: a resize by s maps x' = (x + 0.5)·s − 0.5, a crop subtracts its corner.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from PIL import Image

from jcr.camera import (
    cropped,
    is_distorted,
    pinhole_inside,
    project,
    resized,
    undistortion,
    unproject,
    usable_intrinsics,
    without_distortion,
)
from jcr.capture.images import read_image
from jcr.records import Capture, Intrinsics

PATCH = 16


@dataclass(frozen=True)
class ImageGrid:
    """Pixel grid of a network: the part of an undistorted image that remains after a resize and then a crop."""

    original_size: tuple[int, int]
    """Width, height of the upright, undistorted image, px."""
    resized_size: tuple[int, int]
    crop_corner: tuple[int, int]
    """Left, top of the crop in the resized image."""
    size: tuple[int, int]
    """Width, height of the grid."""

    @classmethod
    def uncropped(cls, original_size: tuple[int, int], size: tuple[int, int]) -> "ImageGrid":
        """Return the grid of the whole image resized to `size`; both sizes are (width, height), px."""
        return cls(original_size, size, (0, 0), size)

    @property
    def scale(self) -> Float[ndarray, "2"]:
        """Factor of the resize for x and for y; the two differ only by rounding."""
        return np.array(self.resized_size) / np.array(self.original_size)

    def grid_from_original(self, x_px: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Return the pixels (x, y) on the grid that correspond to pixels (...,2) of the original, undistorted image."""
        return (x_px + 0.5) * self.scale - 0.5 - np.array(self.crop_corner)

    def grid_intrinsics(self, original: Intrinsics) -> Intrinsics:
        """Return the grid's pinhole intrinsics from those of the original image, whose distortion is dropped."""
        return cropped(
            resized(without_distortion(original), *self.resized_size), *self.crop_corner, *self.size
        )

    def original_intrinsics(self, grid: Intrinsics) -> Intrinsics:
        """Return the pinhole intrinsics of the original image from the intrinsics of its resized and cropped grid.

        They undo the crop first, then the resizing; distortion is dropped.
        """
        left, top = self.crop_corner
        whole = cropped(without_distortion(grid), -left, -top, *self.resized_size)
        return resized(whole, *self.original_size)


def image_grid(
    original_size: tuple[int, int], long_edge: int = 512, patch: int = PATCH, keep_square: bool = False
) -> ImageGrid:
    """Return the resize and crop that DUSt3R applies to an image of `original_size` (width, height).

    With `long_edge` 512, the long edge becomes 512 px and both edges are cropped around the centre to multiples of
    `patch`, px. A square image is cropped to 4:3 unless `keep_square`, because DUSt3R was not trained on squares. With
    224, the short edge becomes 224, then a square is cropped.
    """
    width, height = original_size
    longest = max(width, height)
    target = round(long_edge * longest / min(width, height)) if long_edge == 224 else long_edge
    resized = (round(width * target / longest), round(height * target / longest))
    center = (resized[0] // 2, resized[1] // 2)
    if long_edge == 224:
        half = (min(center),) * 2
    else:
        half = tuple(2 * c // patch * (patch // 2) for c in center)
        if resized[0] == resized[1] and not keep_square:
            half = (half[0], 3 * half[0] // 4)
    corner = (center[0] - half[0], center[1] - half[1])
    return ImageGrid(original_size, resized, corner, (2 * half[0], 2 * half[1]))


@dataclass(frozen=True, kw_only=True)
class PreparedImages:
    """Images of a capture, resized and cropped to the pixel grid of a network, with their intrinsics."""

    colors: UInt8[ndarray, "n h w 3"]
    grid: ImageGrid
    intrinsics_of_capture: Intrinsics | None
    """Intrinsics of the capture's own images, with distortion; None: unknown."""
    pinhole: Intrinsics | None
    """Pinhole intrinsics of the undistorted images that `grid` resizes; None: unknown."""
    warnings: tuple[str, ...] = ()

    @property
    def intrinsics(self) -> Intrinsics | None:
        """Pinhole intrinsics of the network's grid; None: unknown."""
        return None if self.pinhole is None else self.grid.grid_intrinsics(self.pinhole)

    def grid_px(self, x_px: Float[ndarray, "*n 2"]) -> Float[ndarray, "*n 2"]:
        """Return the pixels (x, y) on the grid that correspond to pixels (...,2) of the capture's distorted images."""
        camera = self.intrinsics_of_capture
        if self.pinhole is not None and camera is not None and is_distorted(camera):
            x_px = project(self.pinhole, unproject(camera, x_px))
        return self.grid.grid_from_original(x_px)


def prepare_images(
    capture: Capture, grid_of: Callable[[tuple[int, int]], ImageGrid] = image_grid
) -> PreparedImages:
    """Read the images of a capture, undistort them if the intrinsics are known, and resize and crop them.

    `grid_of` returns the resize and crop for an image's width and height.
    """
    intrinsics, warnings = usable_intrinsics(capture.intrinsics)
    pinhole = intrinsics
    if intrinsics is not None and is_distorted(intrinsics):
        pinhole = pinhole_inside(intrinsics, max(intrinsics.width, intrinsics.height))
    grid = grid_of(capture.image_size if pinhole is None else (pinhole.width, pinhole.height))
    return PreparedImages(
        colors=read_colors(capture, grid, intrinsics, pinhole),
        grid=grid,
        intrinsics_of_capture=intrinsics,
        pinhole=pinhole,
        warnings=warnings,
    )


def read_colors(
    capture: Capture, grid: ImageGrid, intrinsics: Intrinsics | None, pinhole: Intrinsics | None
) -> UInt8[ndarray, "n h w 3"]:
    """Read the images of a capture (RGB), resized and cropped to `grid`.

    `intrinsics` are those of the capture's images. If they have distortion and `pinhole` is given, the images are first
    undistorted to those of `pinhole`.
    """
    width, height = grid.size
    colors = np.empty((len(capture), height, width, 3), np.uint8)
    for row, name in enumerate(capture.images):
        image = read_image(capture.folder / name)
        if intrinsics is not None and pinhole is not None and is_distorted(intrinsics):
            image = undistortion(intrinsics, pinhole)(image)
        colors[row] = resize_and_crop(image, grid)
    return colors


def resize_and_crop(image: UInt8[ndarray, "h w 3"], grid: ImageGrid) -> UInt8[ndarray, "h2 w2 3"]:
    """Resize and crop an image to the grid by DUSt3R's filters: Lanczos to shrink, bicubic to enlarge."""
    shrinks = max(grid.original_size) > max(grid.resized_size)
    filter_ = Image.Resampling.LANCZOS if shrinks else Image.Resampling.BICUBIC
    resized = Image.fromarray(image).resize(grid.resized_size, filter_)
    left, top = grid.crop_corner
    return np.asarray(resized)[top : top + grid.size[1], left : left + grid.size[0]]
