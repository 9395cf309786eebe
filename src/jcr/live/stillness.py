"""Choice of an image that can be kept: at rest, sharp, exposed, and different from the images taken elsewhere."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from jcr.capture.images import BLURRED, brightness_and_sharpness, exposure_fault
from jcr.live.cameras import Frame

REST_S = 0.2
"""Time between two images that are compared for motion."""
STILL = 2.5
"""Mean grey levels by which images at rest differ on a 160 px wide grid: pixel noise of sigma 10 gives 1.9,
a shift of one pixel in 640 of a textured tabletop 3."""
GRID_PX = 160


@dataclass(frozen=True, eq=False)
class ImageSummary:
    """Coarse grey levels and sharpness of an image, with which later images are compared."""

    grid: Float32[ndarray, "gh gw"]
    """Grey levels without their mean, coarse enough for a sensor's noise to vanish."""
    sharpness: float

    @staticmethod
    def of(image: UInt8[ndarray, "h w 3"]) -> "ImageSummary":
        """Return the summary of an RGB image."""
        return ImageSummary(_grid(image), brightness_and_sharpness(image)[1])

    def is_like(self, other: "ImageSummary") -> bool:
        """Test whether two images show the same view but for noise."""
        return self.grid.shape == other.grid.shape and bool(np.abs(self.grid - other.grid).mean() < STILL)


def frame_at_rest(frames: Iterator[Frame], kept: Sequence[ImageSummary], patience_s: float) -> Frame | str:
    """Return the first frame at rest that can be kept, or after `patience_s` the reason why none could.

    The images `kept` were taken from elsewhere, so this one must differ. Raises StopIteration at the end of a video
    file.
    """
    earlier = next(frames)
    end = earlier.time_s + patience_s
    while True:
        frame = next(frames)
        if frame.time_s < earlier.time_s:
            # The clock was set back: time is counted from here.
            earlier, end = frame, frame.time_s + patience_s
        if frame.time_s - earlier.time_s < REST_S:
            continue
        fault = _fault(earlier, frame, kept)
        if fault is None:
            return frame
        if frame.time_s > end:
            return fault
        earlier = frame


def _fault(earlier: Frame, frame: Frame, kept: Sequence[ImageSummary]) -> str | None:
    """Return the reason why a frame cannot be kept; None where it can be."""
    if earlier.image.shape != frame.image.shape:
        return "the size of the camera's images changes; fix it with --camera-size"
    now = ImageSummary.of(frame.image)
    usual = float(np.median([one.sharpness for one in kept])) if kept else 0.0
    if not now.is_like(ImageSummary.of(earlier.image)):
        return "the image is not still; wait until the arm and everything in view is at rest"
    if (fault := exposure_fault(brightness_and_sharpness(frame.image)[0])) is not None:
        return f"the image is {fault}; change light or exposure"
    if now.sharpness < BLURRED * usual:
        return f"the image is blurred ({100 * now.sharpness / usual:.0f} % of the usual sharpness)"
    # Images of another size are refused where they are kept.
    if any(now.is_like(one) for one in kept):
        return (
            "the gripper moved but the image did not change; is the stream frozen, or is it another camera?"
        )
    return None


def _grid(image: UInt8[ndarray, "h w 3"]) -> Float32[ndarray, "gh gw"]:
    """Return the grid of `ImageSummary`."""
    height = max(1, round(GRID_PX * image.shape[0] / image.shape[1]))
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    coarse = cv2.resize(grey, (GRID_PX, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    return coarse - coarse.mean()
