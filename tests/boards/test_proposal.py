"""A board that a user did not name is recognised, and proposed in the words of --board."""

import cv2
import numpy as np
import pytest
from numpy import ndarray

from jcr.boards.proposal import board_in_view, proposed
from jcr.boards.sheet import PAPERS_MM, board_sheet
from jcr.findings import sentence

PX_PER_MM = 5


def seen(spec: str, views: int = 3) -> list[ndarray]:
    """Photographs of the printed sheet, each from another direction."""
    printed, _ = board_sheet(spec)
    width, height = (round(PX_PER_MM * side) for side in PAPERS_MM["a4"])
    paper = np.where(np.asarray(printed.convert("L").resize((width, height))) > 127, 245, 15).astype(np.uint8)
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]], np.float32)
    photographs = []
    for _ in range(views):
        moved = corners * 0.5 + np.array([60.0, 60.0]) + rng.uniform(-40, 40, (4, 2))
        warp = cv2.getPerspectiveTransform(corners, moved.astype(np.float32))
        image = cv2.warpPerspective(paper, warp, (900, 700), flags=cv2.INTER_AREA, borderValue=120)
        photographs.append(cv2.cvtColor(cv2.GaussianBlur(image, (0, 0), 1.0), cv2.COLOR_GRAY2RGB))
    return photographs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("printed", "found"),
    [
        ("charuco:8x5:0.030:0.022:DICT_4X4_50", "aruco:SIDE:DICT_4X4_50"),
        ("chessboard:8x5:0.027", "chessboard:8x5:SIDE"),
    ],
)
def test_a_board_is_recognised(printed: str, found: str):
    images = seen(printed)
    assert board_in_view(images) == found
    finding = proposed(images)
    assert finding is not None
    text = sentence(finding)
    assert f"--board {found}" in text


@pytest.mark.slow
def test_single_tags_are_recognised():
    tags = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    scene = np.full((700, 900), 200, np.uint8)
    for k in range(3):
        scene[250:410, 100 + 250 * k : 260 + 250 * k] = cv2.aruco.generateImageMarker(tags, 5 + k, 160)
    images = [np.roll(cv2.cvtColor(scene, cv2.COLOR_GRAY2RGB), shift, axis=1) for shift in (0, 20, -30)]
    found = proposed(images)
    text = None if found is None else sentence(found)
    assert text is not None and "--board apriltag:SIDE:36h11" in text


@pytest.mark.slow
def test_a_table_without_a_board_is_none(tabletop):
    images = [
        cv2.cvtColor(cv2.imread(str(file)), cv2.COLOR_BGR2RGB) for file in sorted(tabletop.glob("images/*"))
    ]
    assert board_in_view(images) is None
