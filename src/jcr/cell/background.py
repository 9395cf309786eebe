"""Removal of the static background from the images of a fixed camera.

Behind a thing in the gripper stands the rest of the cell, with more features than the thing has. Where many images
show the same colour at a pixel, that is what stands there; an image keeps what differs from it, and fades to grey
elsewhere, softly, for a sharp border would be a feature of its own.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.capture.images import encode_png, read_image
from jcr.files import write_bytes

LEVELS = 14.0
"""Least difference (of 255) of two colours that are not the same; noise and JPEG are less, after averaging."""
REDUCED = 320
"""px across, at which images are compared."""
LEAST_SHARE, LEAST = 0.3, 3
"""Share and number of the images that must agree on a pixel of the background."""
GREY = 128
GROWN, SOFT = 0.012, 0.008
"""Growth of the moving part, and sigma of the fading around it, as shares of the width."""


def moving_parts(images: Sequence[UInt8[ndarray, "h w 3"]]) -> list[UInt8[ndarray, "h w 3"]]:
    """Return the images of a fixed camera with the static background faded to grey."""
    height, width = images[0].shape[:2]
    small = min(REDUCED, width), max(1, round(height * min(REDUCED, width) / width))
    reduced = np.stack(
        [cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32) for image in images]
    )
    background, known = _background(reduced)
    out = []
    for image, small_image in zip(images, reduced, strict=True):
        moves = (np.abs(small_image - background).max(-1) > LEVELS) | ~known
        mask = cv2.morphologyEx(moves.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
        grown = max(1, round(GROWN * small[0]))
        mask = cv2.dilate(mask, np.ones((2 * grown + 1, 2 * grown + 1), np.uint8))
        share = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR)
        share = cv2.GaussianBlur(share, (0, 0), SOFT * width)[..., None]
        out.append(np.rint(GREY + share * (image.astype(np.float32) - GREY)).astype(np.uint8))
    return out


def _background(reduced: Float[ndarray, "n h w 3"]) -> tuple[Float[ndarray, "h w 3"], ndarray]:
    """Return at each pixel the colour on which most images agree, and whether enough of them do."""
    agreeing = np.stack(
        [(np.abs(reduced - one).max(-1) < LEVELS).sum(0) for one in reduced]
    )  # (n,h,w): images like each
    best = agreeing.argmax(0)
    rows, columns = np.indices(best.shape)
    enough = agreeing.max(0) >= max(LEAST, LEAST_SHARE * len(reduced))
    return reduced[best, rows, columns], enough


def write_moving_parts(source: Path, names: Sequence[str], folder: Path) -> None:
    """Write those of the images of a folder under the same names in another; PNG, whatever the names end with."""
    for name, image in zip(names, moving_parts([read_image(source / name) for name in names]), strict=True):
        write_bytes(folder / name, encode_png(image))
