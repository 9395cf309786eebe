"""Boards and tags from their names as a user writes them, and detection of their points in images by OpenCV.

A *body* is a rigid object of known size: a board, or a single tag.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from typing import Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray

from jcr.camera import HALF_PIXEL
from jcr.errors import InputError

KINDS = (
    "charuco:7x5:0.030:0.022:DICT_4X4_50 (squares across x down, square and marker in metres)",
    "chessboard:9x6:0.025 (inner corners, square in metres)",
    "aruco:0.050:DICT_4X4_50 and apriltag:0.050:36h11 (any number of tags, side of the black square in metres)",
)
INK = 120
"""Least difference of a pixel's strongest and weakest channel (0 to 255) that is too colourful for a grey board."""
LARGEST = 1.0
"""Largest length of a square or tag, m; a larger number was meant in millimetres."""
FEWEST_POINTS = 4
"""Least number of points of a board or tag that an image must show to be used."""
EVEN = 0.2
"""Largest `_unevenness` of a chessboard's corners. Correct corners of three boards before five cameras have up to 0.15,
points beside the board of 80 images 0.28 to 5.7; with 0.1 some correct ones are replaced by less accurate ones, with 0.3
two of these 80 wrong detections remain."""
PRINTED_STD = 0.002
"""Relative standard deviation of a printed board's size."""
SIDE = "SIDE"
"""Word that replaces an unknown side of a square or tag in a board's name; the side is then the unit of length."""


@dataclass(frozen=True)
class Sighting:
    """Detected points of one body (a board or a single tag) in one image."""

    body: int
    """Number of the tag; 0 for a board."""
    index: tuple[int, ...]
    """Number of each point on the body."""
    x_in_body: Float[ndarray, "k 3"]
    """Points in the body's frame, z = 0, m or sides."""
    x_px: Float[ndarray, "k 2"]


Detector = Callable[[UInt8[ndarray, "h w"]], list[Sighting]]
"""Function from a grey image to the detections of a board or of tags."""


@dataclass(frozen=True)
class Board:
    """Board or tags that a user's --board name may mean, with the function that detects them in a grey image."""

    name: str
    detect: Detector
    glance: Callable[[UInt8[ndarray, "h w"]], bool] | None
    """Quick test whether a grey image may show the board; None: `detect` itself is quick."""
    side: float
    """Side of a square or tag, m; 1 if it is unknown."""
    size_std: float | None
    """Relative standard deviation of the size; None: the side is unknown and is the unit of length."""


PROBED = 3
"""Number of images, spread over the capture, in which a board is searched for thoroughly before its quick test decides
about the others. A search in vain of 1920x1080 pixels takes 1.6 s, the quick test 0.14 s; with one image more or fewer,
29 images take 3 s more or fewer of 20 s."""
GLANCE_PX = 800
"""Largest long side, px, of an image for the quick test of a chessboard; larger images are reduced to it. The quick test
found the board in all of 20 images of five cameras in which the thorough search finds it: it misses at most one in seven
(95 %), and both of two images, the fewest that are useful, in 2 % of captures at most. With 400 px it misses 3 of 20;
with 1200 px it finds the same and takes 1.6 times as long."""
_KEPT: dict[tuple[str, str, tuple[int, ...], bytes], Any] = {}
MOST_KEPT = 4000
"""Largest number of results of `_kept`."""


def boards(spec: str) -> list[Board]:
    """Return the boards that a name such as charuco:7x5:0.03:0.022:DICT_4X4_50 may mean, the one as written first.

    A ChArUco board is also returned in the layout of OpenCV before 4.6 and with columns and rows swapped. The word SIDE
    stands for an unknown side, which is then the unit of length. Raises InputError for a name that means no board.
    """
    (kind, *parts), glance = spec.split(":"), None
    try:
        match kind, parts:
            case "charuco", [count, side, marker, tags]:
                size, lengths, detectors = _count(count), (_length(side), _length(marker)), {}
                for (across, down), legacy in product((size, size[::-1]), (False, True)):
                    name = spec.replace(count, f"{across}x{down}") + " printed as before OpenCV 4.6" * legacy
                    detectors[name] = _charuco((across, down), *lengths, _tags(tags), legacy)
            case "chessboard", [count, side]:
                detectors = {spec: _chessboard(_count(count), _length(side))}
                glance = partial(_may_show_chessboard, count=_count(count))
            case "aruco", [side, tags]:
                detectors = {spec: _single_tags(_length(side), _tags(tags))}
            case "apriltag", [side, tags]:
                detectors = {spec: _single_tags(_length(side), _tags(f"DICT_APRILTAG_{tags}"))}
            case _:
                raise ValueError(f"no such board; write it as {'; '.join(KINDS)}")
    except ValueError as error:
        raise InputError(f"board {spec}: {error}") from None
    size_std = None if SIDE in parts else PRINTED_STD
    return [Board(name, detect, glance, _length(side), size_std) for name, detect in detectors.items()]


def _count(text: str) -> tuple[int, int]:
    """Return columns and rows from a text such as 7x5; raise ValueError for another text."""
    across, by, down = text.partition("x")
    if not (by and across.isdecimal() and down.isdecimal() and int(across) > 1 and int(down) > 1):
        raise ValueError(f"{text} is no size such as 7x5")
    return int(across), int(down)


def _length(text: str) -> float:
    """Return a length in metres from a text, or 1 for the word SIDE; raise ValueError for another text."""
    if text == SIDE:
        return 1.0
    try:
        length = float(text)
    except ValueError:
        length = 0.0
    if not 0 < length <= LARGEST:
        raise ValueError(f"{text} is no length of a square in metres; 30 mm is 0.030")
    return length


def _tags(name: str) -> cv2.aruco.Dictionary:
    """Return OpenCV's dictionary of tags of this name, such as DICT_4X4_50; raise ValueError for another name."""
    known = [key for key in dir(cv2.aruco) if key.startswith("DICT_")]
    if name not in known:
        raise ValueError(f"{name} is no dictionary of tags; there are {', '.join(sorted(known))}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _charuco(
    count: tuple[int, int], square: float, marker: float, tags: cv2.aruco.Dictionary, legacy: bool
) -> Detector:
    """Return the detector of the inner corners of a ChArUco board; its pixels have whole numbers at pixel centres.

    `count` are the board's squares (columns, rows); `square` and `marker` are side lengths (m). `legacy` is the layout
    of OpenCV before 4.6.
    """
    if marker >= square:
        raise ValueError(f"a marker of {marker} m does not fit into a square of {square} m")
    board = cv2.aruco.CharucoBoard(count, square, marker, tags)
    board.setLegacyPattern(legacy)
    detector = cv2.aruco.CharucoDetector(board)
    corners, shift_px = np.asarray(board.getChessboardCorners(), np.float64), _charuco_shift_px()

    def detect(grey: UInt8[ndarray, "h w"]) -> list[Sighting]:
        x_px, ids, _, _ = detector.detectBoard(grey)
        if ids is None:
            return []
        index = ids.ravel().astype(int)
        in_image = x_px.reshape(-1, 2).astype(np.float64) - shift_px
        return [Sighting(0, tuple(index.tolist()), corners[index], in_image)]

    return detect


@cache
def _charuco_shift_px() -> float:
    """Return how far (0 or 0.5 px) the installed OpenCV reports ChArUco corners too far right and down.

    OpenCV's pull request 28380 removed this shift. It is measured once, in a drawn board.
    """
    square, margin = 40, 20
    board = cv2.aruco.CharucoBoard((4, 3), 1.0, 0.7, _tags("DICT_4X4_50"))
    drawn = board.generateImage((4 * square + 2 * margin, 3 * square + 2 * margin), marginSize=margin)
    x_px, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(drawn)
    corners = np.asarray(board.getChessboardCorners(), np.float64)[np.ravel(ids).astype(int), :2]
    true = margin + square * corners - HALF_PIXEL
    return HALF_PIXEL * round(float(np.mean(x_px.reshape(-1, 2) - true)) / HALF_PIXEL)


def _chessboard(count: tuple[int, int], square: float) -> Detector:
    """Return the detector of a chessboard with `count` inner corners (columns, rows) and squares of side `square`, m."""
    across, down = count
    if (across + down) % 2 == 0:
        raise ValueError(
            f"a chessboard of {across}x{down} inner corners looks the same after a rotation by 180°; use one with an "
            "odd and an even side"
        )
    row, column = np.indices((down, across)).reshape(2, -1)
    x_in_board = square * np.column_stack([column, row, 0 * row])

    def detect(grey: UInt8[ndarray, "h w"]) -> list[Sighting]:
        for find in (_sector_based, _square_based):
            if (x_px := find(grey, count)) is None or _unevenness(x_px.reshape(down, across, 2)) > EVEN:
                continue
            # The square below and right of the first corner must be dark; a rotation by 180° changes that.
            at = x_px.reshape(down, across, 2)
            centre = (at[:-1, :-1] + at[1:, :-1] + at[:-1, 1:] + at[1:, 1:]) / 4
            u, v = np.moveaxis(np.rint(centre).astype(int), -1, 0)
            shade = grey[v.clip(0, grey.shape[0] - 1), u.clip(0, grey.shape[1] - 1)].astype(float)
            like_first = np.indices(shade.shape).sum(0) % 2 == 0
            if shade[like_first].mean() >= shade[~like_first].mean():
                x_px = x_px[::-1]
            return [Sighting(0, tuple(range(across * down)), x_in_board, x_px)]
        return []

    return detect


def _may_show_chessboard(grey: UInt8[ndarray, "h w"], count: tuple[int, int]) -> bool:
    """Test quickly whether a chessboard with `count` inner corners (columns, rows) is in a reduced grey image."""
    if (factor := GLANCE_PX / max(grey.shape)) < 1:
        grey = np.asarray(
            cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA), np.uint8
        )
    return (
        bool(cv2.findChessboardCornersSB(grey, count, flags=0)[0]) or _square_based(grey, count) is not None
    )


def _unevenness(at: Float[ndarray, "r c 2"]) -> float:
    """Return the largest difference of neighbouring steps between corners, as a share of the median step.

    `at` holds the pixels of a chessboard's corners in rows and columns. The steps along rows and along columns are
    compared with the next ones in both directions.
    """
    steps = [np.diff(at, axis=axis) for axis in (0, 1)]
    changes = [np.diff(step, axis=axis) for step in steps for axis in (0, 1)]
    largest = max(float(np.linalg.norm(one, axis=-1).max(initial=0.0)) for one in changes)
    return largest / float(np.median(np.linalg.norm(steps[1], axis=-1)))


def _sector_based(grey: UInt8[ndarray, "h w"], count: tuple[int, int]) -> Float[ndarray, "k 2"] | None:
    """Return the pixels of a chessboard's corners by Duda and Frese, BMVC 2018; None if it is not found.

    The method is more accurate than `_square_based`, but needs a white border as wide as a square. Without the border,
    it may return points beside the board.
    """
    found, corners = cv2.findChessboardCornersSB(
        grey, count, flags=cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    )
    return corners.reshape(-1, 2).astype(np.float64) if found else None


def _square_based(grey: UInt8[ndarray, "h w"], count: tuple[int, int]) -> Float[ndarray, "k 2"] | None:
    """Return the pixels of a chessboard's corners by dark squares that touch; None if it is not found."""
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
    found, corners = cv2.findChessboardCorners(grey, count, flags=flags)
    if not found:
        return None
    at = corners.reshape(count[1], count[0], 2)
    apart = min(float(np.linalg.norm(np.diff(at, axis=axis), axis=-1).min()) for axis in (0, 1))
    half = max(2, round(apart / 3))  # the window contains one corner only
    until = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    return cv2.cornerSubPix(grey, corners, (half, half), (-1, -1), until).reshape(-1, 2).astype(np.float64)


def _single_tags(side: float, tags: cv2.aruco.Dictionary) -> Detector:
    """Return the detector of single tags of a dictionary, whose black squares have this side, m.

    The four corners have the order of OpenCV: top left, top right, bottom right, bottom left; the origin is the tag's
    centre. A number that occurs twice in an image is ignored.
    """
    parameters = cv2.aruco.DetectorParameters()
    # Fits lines to the edges; sub-pixel corners are drawn inwards by blur, 0.1 to 0.4 px. AprilTag's corners are counted
    # from the corner of the image.
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_APRILTAG
    detector = cv2.aruco.ArucoDetector(tags, parameters)
    half = side / 2
    corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])

    def detect(grey: UInt8[ndarray, "h w"]) -> list[Sighting]:
        found, ids, _ = detector.detectMarkers(grey)
        if ids is None:
            return []
        numbers, counts = np.unique(ids, return_counts=True)
        # Two tags with one number cannot be distinguished.
        twice = set(numbers[counts > 1].tolist())
        return [
            Sighting(int(number), (0, 1, 2, 3), corners, x_px.reshape(4, 2).astype(np.float64) - HALF_PIXEL)
            for number, x_px in zip(ids.ravel(), found, strict=True)
            if int(number) not in twice
        ]

    return detect


Result = TypeVar("Result")


def _kept(board: Board, of: Callable[[UInt8[ndarray, "h w"]], Result], grey: UInt8[ndarray, "h w"]) -> Result:
    """Return the result of a search `of` a board for a grey image, which later back ends do not compute again."""
    what = "detect" if of is board.detect else "glance"
    key = board.name, what, grey.shape, hashlib.sha256(grey.tobytes()).digest()
    if key not in _KEPT:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        _KEPT[key] = of(grey)
    return _KEPT[key]


def _searched(board: Board, grey: Sequence[UInt8[ndarray, "h w"]]) -> list[list[Sighting]]:
    """Return the detections of a board in each grey image.

    All images are searched thoroughly if the board is detected in one of PROBED images, or in one in which its quick
    test succeeds. Otherwise the board is taken as absent from the others.
    """
    found = dict[int, list[Sighting]]()
    if (glance := board.glance) is not None:
        for k in np.unique(
            np.linspace(0, len(grey) - 1, min(PROBED, len(grey))).round().astype(int)
        ).tolist():
            found[k] = _kept(board, board.detect, grey[k])
        # The quick test may succeed in an image where corners of another board look like this one.
        others = (image for k, image in enumerate(grey) if k not in found and _kept(board, glance, image))
        if not any(found.values()) and not any(_kept(board, board.detect, image) for image in others):
            return [[] for _ in grey]
    return [found[k] if k in found else _kept(board, board.detect, image) for k, image in enumerate(grey)]


def _ink(image: UInt8[ndarray, "h w 3"]) -> UInt8[ndarray, "h w"]:
    """Return 1 for the strongly coloured pixels of an RGB image (INK), 0 for the others."""
    red, green, blue = cv2.split(image)
    most, least = cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue)
    return (cv2.subtract(most, least) > INK).astype(np.uint8)


def most_seen(
    readings: Sequence[Board], images: Sequence[UInt8[ndarray, "h w 3"]]
) -> tuple[Board, list[list[Sighting]]]:
    """Return the board of the candidates `readings` with most points in the images, and its detections in each image.

    The images are RGB. The first board is tried first. The others are tried only while the best board is found in fewer
    than half of the images. All boards are then tried in images whose strongly coloured pixels are filled in, under the
    same condition.
    """
    best, seen, points = readings[0], [], -1
    for fill in (False, True):
        prepared = images
        if fill:  # drawn detections hide the board's corners
            prepared = [cv2.inpaint(image, _ink(image), 3, cv2.INPAINT_TELEA) for image in images]
        grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in prepared]
        for board in readings:
            found = _searched(board, grey)
            count = sum(len(sighting.index) for sightings in found for sighting in sightings)
            if count > points:
                best, seen, points = board, found, count
            if 2 * sum(map(bool, seen)) >= len(images):
                return best, seen
    return best, seen
