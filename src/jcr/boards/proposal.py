"""Proposal of the option --board from what the images show: tags by their family, chessboards by their corners."""

from collections import Counter
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy import ndarray

from jcr.capture.images import read_image
from jcr.findings import Finding, FindingKind
from jcr.records import Capture

LOOKED_AT = 3
"""Number of images that are searched; a useful board is in most of them."""
FAMILIES = ("4X4_1000", "5X5_1000", "6X6_1000", "7X7_1000", "APRILTAG_36h11", "APRILTAG_25h9")
"""Largest dictionary of OpenCV with tags of each kind, without DICT_."""
DICTIONARY_SIZES = (50, 100, 250, 1000)
FEWEST_SHOWN = 2
"""Least number of images that must show the same tags or chessboard; in a single image, texture may look like one."""
LEAST_CORNERS = 4
"""Least number of inner corners on a side of a chessboard; windows and keyboards also show 3x3 corners."""
SEARCHED_PX = 800
"""Largest long side, px, of an image that is searched; larger images are reduced to it."""


def board_in_view(images: Sequence[UInt8[ndarray, "h w 3"]]) -> str | None:
    """Return the value of --board for the board in the RGB images, with SIDE as its length; None if no board is found.

    Three images (LOOKED_AT) are searched, first for tags, then for a chessboard.
    """
    chosen = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, LOOKED_AT).astype(int))]
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in chosen]
    if (factor := SEARCHED_PX / max(grey[0].shape)) < 1:
        grey = [cv2.resize(one, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA) for one in grey]
    return _tags(grey) or _chessboard(grey)


def _tags(grey: list[UInt8[ndarray, "h w"]]) -> str | None:
    """Return the value of --board for the tag dictionary with most tags in the images; None without tags.

    A tag counts if two or more images (FEWEST_SHOWN) show it. The tags of a ChArUco board are proposed as single tags,
    because the user has to count its squares.
    """
    family, numbers = "", list[int]()
    for name in FAMILIES:
        tags = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))
        detected = map(cv2.aruco.ArucoDetector(tags).detectMarkers, grey)
        seen = Counter(
            number for _, ids, _ in detected if ids is not None for number in np.unique(ids).tolist()
        )
        again = [number for number, images in seen.items() if images >= FEWEST_SHOWN]
        if len(again) > len(numbers):
            family, numbers = name, again
    if not numbers:
        return None
    if family.startswith("APRILTAG"):
        return f"apriltag:SIDE:{family.removeprefix('APRILTAG_')}"
    return f"aruco:SIDE:DICT_{family[:3]}_{next(size for size in DICTIONARY_SIZES if max(numbers) < size)}"


def _chessboard(grey: list[UInt8[ndarray, "h w"]]) -> str | None:
    """Return the value of --board for the chessboard that most grey images show; None if fewer than two show it."""
    sizes = []
    for image in grey:
        found, _, meta = cv2.findChessboardCornersSBWithMeta(
            image, (3, 3), cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
        )
        if found and meta is not None and min(meta.shape[:2]) >= LEAST_CORNERS:
            sizes.append(tuple(sorted(meta.shape[:2], reverse=True)))
    if len(sizes) < FEWEST_SHOWN:
        return None
    # A board that is partly outside of the image is detected as smaller.
    across, down = max(set(sizes), key=lambda size: (sizes.count(size), size))
    return f"chessboard:{across}x{down}:SIDE"


def proposed(capture: Capture, board: str | None) -> tuple[Finding, ...]:
    """Return the finding that the capture's images show a board, with the value of --board that would use it.

    The result is empty if they show none, if --board has a value (`board`), or if the camera is fixed.
    """
    if board is not None or capture.mount == "base":
        return ()
    if (found := board_in_view([read_image(capture.folder / name) for name in capture.images])) is None:
        return ()
    return (Finding.of(FindingKind.BOARD_IN_VIEW, "warns", "reconstruction", board=found),)
