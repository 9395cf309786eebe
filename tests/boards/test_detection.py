"""Where the detectors put the points of a board: at the truth, in pixels whose first has its centre at (0, 0)."""

import cv2
import numpy as np
import pytest
from numpy import ndarray

from jcr.boards.detection import boards

FINE = 8
"""Samples a side of a pixel."""
PX_PER_M = 4000
"""Of the sheets."""


def charuco() -> tuple[ndarray, ndarray]:
    board = cv2.aruco.CharucoBoard(
        (7, 6), 0.030, 0.022, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    )
    return board.generateImage((840, 720), marginSize=0), np.zeros(2)


def chessboard() -> tuple[ndarray, ndarray]:
    row, column = np.indices((6 * 100, 9 * 100)) // 100
    return (255 * ((row + column) % 2)).astype(np.uint8), np.array([0.025, 0.025])


def circles() -> tuple[ndarray, ndarray]:
    sheet = np.full((13 * 80, 10 * 80), 255, np.uint8)
    for row in range(11):
        for k in range(4):
            cv2.circle(sheet, (80 * (2 * k + 1 + row % 2), 80 * (1 + row)), 28, 0, -1, cv2.LINE_AA)
    return sheet, np.array([80.5, 80.5]) / PX_PER_M


def tag() -> tuple[ndarray, ndarray]:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    return cv2.aruco.generateImageMarker(dictionary, 3, 200), np.array([0.025, 0.025])


@pytest.mark.parametrize(
    ("spec", "draw", "flip", "limit_px"),
    [
        ("charuco:7x6:0.030:0.022:DICT_4X4_50", charuco, 1, 0.03),
        ("chessboard:8x5:0.025", chessboard, 1, 0.03),
        ("circles:4x11:0.020", circles, 1, 0.1),
        # Its axis of the body points up; AprilTag's fit of lines leaves 0.05 px.
        ("apriltag:0.050:36h11", tag, -1, 0.1),
    ],
)
def test_a_detector_s_points_are_at_the_truth_on_average(spec, draw, flip, limit_px):
    sheet, origin = draw()
    sheet = cv2.copyMakeBorder(sheet, 100, 100, 100, 100, cv2.BORDER_CONSTANT, value=255)
    errors = []
    for degrees, shift in ((20, (0.1, 0.3)), (110, (0.4, -0.2)), (200, (-0.3, 0.1)), (290, (0.2, 0.4))):
        angle = np.radians(degrees)
        rotation = 0.25 * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        # Pixels of the image from those of the sheet, both counted from their images' corners.
        middle = np.array([160.0, 160.0]) + shift - rotation @ (np.array(sheet.shape[::-1]) / 2)
        from_centres = np.column_stack([FINE * rotation, FINE * (middle + rotation @ [0.5, 0.5]) - 0.5])
        fine = cv2.warpAffine(sheet, from_centres, (320 * FINE, 320 * FINE), borderValue=255)
        image = cv2.GaussianBlur(cv2.resize(fine, (320, 320), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
        (sighting,) = boards(spec)[0].detect(image)
        on_sheet = (sighting.x_in_body[:, :2] * [1, flip] + origin) * PX_PER_M + 100
        errors.append(sighting.x_px - (on_sheet @ rotation.T + middle - 0.5))
    assert np.abs(np.concatenate(errors).mean(0)).max() < limit_px
