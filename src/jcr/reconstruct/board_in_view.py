"""Whether images show a calibration board or tags, and the --board that would use it, where none was given."""

from collections.abc import Sequence
from itertools import product

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.reconstruct.board import RATIOS, boards
from jcr.records import Capture, Finding, Kind

LOOKED_AT = 3
"""Images; a board that helps is in most of them."""
FAMILIES = ("4X4", "5X5", "6X6", "7X7", "APRILTAG_36h11", "APRILTAG_25h9")
SIZES = (50, 100, 250, 1000)
FEWEST = 2
"""Images in which the same tags are found, or the same chessboard: one may be a trick of the texture."""
SMALLEST = 4
"""Inner corners on a side of a chessboard; three by three are found in windows and keyboards, too."""
LONG_SIDE_PX = 800


def board_in_view(images: Sequence[UInt8[ndarray, "h w 3"]]) -> str | None:
    """A --board for what the images show, with SIDE (and MARKER) for the lengths; None without a board."""
    chosen = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, LOOKED_AT).astype(int))]
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in chosen]
    if (factor := LONG_SIDE_PX / max(grey[0].shape)) < 1:
        grey = [cv2.resize(one, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) for one in grey]
    return _tags(grey) or _chessboard(grey)


def _tags(grey: list[UInt8[ndarray, "h w"]]) -> str | None:
    best: tuple[int, str, set[int]] = (0, "", set())
    for family in FAMILIES:
        name = f"DICT_{family}" if "APRIL" in family else f"DICT_{family}_1000"
        detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)))
        seen = [
            {int(number) for number in np.ravel(ids)} if ids is not None else set[int]()
            for _, ids, _ in map(detector.detectMarkers, grey)
        ]
        again = {number for number in set[int]().union(*seen) if sum(number in ids for ids in seen) >= FEWEST}
        if len(again) > best[0]:
            best = len(again), family, again
    _, family, numbers = best
    if not numbers:
        return None
    if family.startswith("APRILTAG"):
        return f"apriltag:SIDE:{family.removeprefix('APRILTAG_')}"
    size = next(size for size in SIZES if max(numbers) < size)
    dictionary = f"DICT_{family}_{size}"
    return _charuco(grey, dictionary, max(numbers) + 1) or f"aruco:SIDE:{dictionary}"


def _charuco(grey: list[UInt8[ndarray, "h w"]], dictionary: str, markers: int) -> str | None:
    """The board whose corners lie between the markers; None where there are too few corners for one."""
    best: tuple[int, str] = (0, "")
    for down, across in product(range(3, 16), repeat=2):
        # A marker in every second square; of the last ones none may have been in view.
        if across < down or not markers <= across * down // 2 <= markers + 1:
            continue
        for ratio in RATIOS:
            for reading in boards(f"charuco:{across}x{down}:0.1:{0.1 * ratio:.3f}:{dictionary}"):
                count = sum(len(s.index) for image in grey for s in reading.detect(image))
                if count > best[0]:
                    squares = reading.name.split(":")[1]
                    best = count, f"charuco:{squares}:SIDE:MARKER:{dictionary}"
            if best[0] >= len(grey) * (across - 1) * (down - 1) // 2:
                return best[1]
    return best[1] if best[0] >= 6 * len(grey) else None


def _chessboard(grey: list[UInt8[ndarray, "h w"]]) -> str | None:
    sizes = []
    for image in grey:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(
            image, (3, 3), cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        )
        if found and meta is not None and min(meta.shape[:2]) >= SMALLEST:
            sizes.append(tuple(sorted(meta.shape[:2], reverse=True)))
    if len(sizes) < FEWEST:
        return None
    # Where the border of a board leaves the frame, it is found smaller.
    across, down = max(set(sizes), key=lambda size: (sizes.count(size), size))
    return f"chessboard:{across}x{down}:SIDE"


def proposed_for(capture: Capture, board: str | None) -> Finding | None:
    """That a board is in the images of a capture; None where one was given, and where the camera watches the gripper."""
    if board is not None or capture.mount == "base":
        return None
    return proposed([read_image(capture.folder / name) for name in capture.images])


def proposed(images: Sequence[UInt8[ndarray, "h w 3"]]) -> Finding | None:
    """That a board is in view, and the --board that would use it; None where there is none."""
    if (board := board_in_view(images)) is None:
        return None
    return Finding(kind=Kind.BOARD_IN_VIEW, severity="warns", mend="reconstruction", details={"board": board})
