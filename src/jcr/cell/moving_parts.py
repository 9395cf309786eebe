"""Images of a fixed camera that observes an object in the gripper, without their static background.

The static background is removed from the images, because the background often has more features than the object. A
pixel's background is the colour that many images share. Each image keeps the pixels that differ from the background and
fades to grey elsewhere, smoothly, because a sharp border would produce features.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.capture.images import encode_png, read_image
from jcr.files import write_bytes
from jcr.records import Capture

LEVELS = 14.0
"""Smallest difference (of 255) between different colours; noise and JPEG artefacts are smaller at reduced size."""
REDUCED = 320
"""Width (px) at which images are compared."""
LEAST_SHARE, LEAST_IMAGES = 0.3, 3
"""Smallest share and number of images that must agree on a background pixel."""
GREY = 128
"""Grey level of the removed background."""
GROWN, SOFT = 0.012, 0.008
"""Dilation of the moving part, and sigma of the blur of its border, as shares of the image width."""


def with_moving_parts(capture: Capture, moving: Path) -> Capture:
    """Return the capture of a fixed camera with images without the static background, written to the folder `moving`."""
    images = moving_parts([read_image(capture.folder / name) for name in capture.images])
    for name, image in zip(capture.images, images, strict=True):
        write_bytes(moving / name, encode_png(image))  # PNG whatever the name
    return replace(capture, folder=moving)


def moving_parts(images: Sequence[UInt8[ndarray, "h w 3"]]) -> list[UInt8[ndarray, "h w 3"]]:
    """Return the images of a fixed camera with the static background faded to grey; moving parts keep their colour.

    The background of a pixel is its most frequent colour over the images; a pixel without a frequent colour counts as
    moving.
    """
    height, width = images[0].shape[:2]
    small = min(REDUCED, width), max(1, round(height * min(REDUCED, width) / width))
    reduced = np.stack(
        [cv2.resize(image, small, interpolation=cv2.INTER_AREA).astype(np.float32) for image in images]
    )
    # For each pixel, the number of images that have the same colour as each image (n,h,w), and the most frequent colour.
    agreeing = np.stack([(np.abs(reduced - one).max(-1) < LEVELS).sum(0) for one in reduced])
    background = np.take_along_axis(reduced, agreeing.argmax(0)[None, ..., None], axis=0)[0]
    known = agreeing.max(0) >= max(LEAST_IMAGES, LEAST_SHARE * len(images))
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
