"""Search for a board in the images of a capture: thorough where the board may be, quick where it is not."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest
from jaxtyping import UInt8
from numpy import ndarray

from jcr.boards.detection import PROBED, Board, Sighting, boards, most_seen

SPEC, SQUARE_PX = "chessboard:6x5:0.025", 24


def background(seed: int, colour: bool = False) -> UInt8[ndarray, "360 480 3"]:
    """Return an image of smooth random texture, grey or with strong colours."""
    small = np.random.default_rng(seed).uniform(0, 255, (12, 16, 3)).astype(np.uint8)
    image = np.asarray(cv2.resize(small, (480, 360), interpolation=cv2.INTER_CUBIC), np.uint8)
    return image if colour else np.repeat(image[..., :1], 3, axis=2)


def with_board(seed: int) -> UInt8[ndarray, "360 480 3"]:
    """Return a background with a chessboard of 6x5 inner corners and a white border."""
    image, row, column = background(seed), *(np.indices((6 * SQUARE_PX, 7 * SQUARE_PX)) // SQUARE_PX)
    sheet = np.pad(255 * ((row + column) % 2), SQUARE_PX, constant_values=255).astype(np.uint8)
    image[60 : 60 + sheet.shape[0], 90 : 90 + sheet.shape[1]] = sheet[..., None]
    return image


def counted(board: Board) -> tuple[Board, list[int]]:
    """Return the board with a detector that appends to the list at each thorough search."""
    searches, detect = list[int](), board.detect

    def counting(grey: UInt8[ndarray, "h w"]) -> list[Sighting]:
        searches.append(1)
        return detect(grey)

    return replace(board, detect=counting), searches


@pytest.mark.parametrize(("colour", "passes"), [(False, 1), (True, 2)])
def test_a_board_that_no_image_shows_is_searched_thoroughly_in_few_images(colour: bool, passes: int):
    board, searches = counted(boards(SPEC)[0])
    images = [background(seed, colour) for seed in range(100 * passes, 100 * passes + 20)]
    _, seen = most_seen([board], images)
    assert not any(seen)
    # Coloured pixels are filled in before a second pass; images without any are not searched again.
    assert len(searches) == passes * PROBED


def test_a_quick_test_that_is_mistaken_costs_one_thorough_search_only():
    board, searches = counted(boards(SPEC)[0])
    mistaken = iter([False, True] + [False] * 100)
    images = [background(seed) for seed in range(3000, 3020)]
    _, seen = most_seen([replace(board, glance=lambda _: next(mistaken))], images)
    assert not any(seen) and len(searches) == PROBED + 1


@pytest.mark.parametrize("shown", [(3, 14), (0, 5), (17,)])
def test_a_board_that_few_images_show_is_found_in_each(shown: Sequence[int]):
    board, searches = counted(boards(SPEC)[0])
    make: dict[bool, Callable[[int], ndarray]] = {True: with_board, False: background}
    images = [make[k in shown](1000 + 50 * shown[0] + k) for k in range(20)]
    _, seen = most_seen([board], images)
    assert [k for k, sightings in enumerate(seen) if sightings] == list(shown)
    assert len(searches) == len(images)


def test_tags_whose_search_is_quick_are_searched_in_each_image():
    board, searches = counted(boards("aruco:0.050:DICT_4X4_50")[0])
    most_seen([board], [background(seed) for seed in range(2000, 2010)])
    assert len(searches) == 10
