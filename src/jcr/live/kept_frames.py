"""Choice of frames that a live capture keeps: at rest, sharp, well exposed, unlike images at other gripper poses."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float32, UInt8
from numpy import ndarray

from jcr.capture.images import BLURRED, exposure_fault, sharpness
from jcr.live.cameras import Frame

COMPARED_S = 0.2
"""Time (s) between two images that are compared for motion."""
STILL_GREY = 2.5
"""Largest mean difference (grey levels) of two images at rest, compared at a width of GRID_PX: pixel noise of 10 levels
gives 1.9, and a shift of a textured tabletop by one pixel in 640 gives 3."""
GRID_PX = 160
"""Width (px) to which images are reduced for comparison."""


@dataclass(frozen=True, eq=False)
class ImageSummary:
    """Grey levels at low resolution and sharpness of an image, to compare later images with it."""

    grid: Float32[ndarray, "gh gw"]
    """Grey levels of the image reduced to GRID_PX, minus their mean."""
    sharpness: float

    @staticmethod
    def of(image: UInt8[ndarray, "h w 3"]) -> "ImageSummary":
        """Return the summary of an RGB image: grey levels at low resolution, and sharpness."""
        size = GRID_PX, max(1, round(GRID_PX * image.shape[0] / image.shape[1]))
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        coarse = cv2.resize(grey, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        return ImageSummary(coarse - coarse.mean(), sharpness(image))

    def is_like(self, other: "ImageSummary") -> bool:
        """Test whether two images are the same view: equal size, and grey levels that differ by noise only."""
        return self.grid.shape == other.grid.shape and bool(
            np.abs(self.grid - other.grid).mean() < STILL_GREY
        )


def frame_at_rest(frames: Iterator[Frame], kept: Sequence[ImageSummary], patience_s: float) -> Frame | str:
    """Return the first frame at rest that can be kept; after `patience_s` seconds, the reason why none can be kept.

    A frame is at rest if it shows the same as a frame at least 0.2 s earlier (`is_like`). It can be kept if it is also
    well exposed, not blurred, and different from the images `kept`, which were taken at other gripper poses. Raises
    StopIteration at the end of a video file.
    """
    usual = float(np.median([one.sharpness for one in kept])) if kept else 0.0
    earlier = next(frames)
    end = earlier.time_s + patience_s
    while True:
        frame = next(frames)
        if frame.time_s < earlier.time_s:
            # The clock was set back, so the patience is counted from this frame.
            earlier, end = frame, frame.time_s + patience_s
        if frame.time_s - earlier.time_s < COMPARED_S:
            continue
        now = ImageSummary.of(frame.image)
        if earlier.image.shape != frame.image.shape:
            fault = "the size of the camera's images changes; fix it with --camera-size"
        elif not now.is_like(ImageSummary.of(earlier.image)):
            fault = "the image is not still; wait until the arm and everything in view is at rest"
        elif (exposure := exposure_fault(frame.image)) is not None:
            fault = f"the image is {exposure}; change light or exposure"
        elif now.sharpness < BLURRED * usual:
            fault = f"the image is blurred ({100 * now.sharpness / usual:.0f} % of the usual sharpness)"
        # LiveFolder.add refuses images whose size differs from the kept ones.
        elif any(now.is_like(one) for one in kept):
            fault = "the gripper moved but the image did not change; is the stream frozen, or is it another camera?"
        else:
            return frame
        if frame.time_s > end:
            return fault
        earlier = frame
