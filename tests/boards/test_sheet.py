"""A printed board is what the marker back end looks for, at the size that its name says."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from in_process import run_jcr
from jcr.boards.detection import boards
from jcr.boards.sheet import as_pdf, board_sheet


def mm_of_page(data: bytes) -> tuple[ndarray, ndarray]:
    """Width and height (mm) of the page of a PDF, and of the image on it."""
    paper = re.search(rb"/MediaBox \[ 0 0 (\S+) (\S+) \]", data)
    image = re.search(rb"q (\S+) 0 0 (\S+) 0 0 cm /image Do Q", data)
    assert paper and image
    return tuple(
        25.4 / 72 * np.array([float(number) for number in found.groups()]) for found in (paper, image)
    )


@pytest.mark.parametrize(
    "spec",
    [
        "charuco:8x5:0.030:0.022:DICT_4X4_50",
        "charuco:7x5:0.031:0.0233:DICT_5X5_50",
        pytest.param("chessboard:8x5:0.027", marks=pytest.mark.slow),
    ],
)
def test_a_printed_board_is_found_whole_and_at_its_size(spec: str):
    pixels, px_per_mm = board_sheet(spec)
    paper, image = mm_of_page(as_pdf(pixels, px_per_mm))
    np.testing.assert_allclose(paper, (297, 210), atol=0.03)
    np.testing.assert_allclose(image, np.array(pixels.size) / px_per_mm, atol=1e-3)
    grey = cv2.resize(
        255 * np.asarray(pixels, np.uint8), None, fx=1 / 3, fy=1 / 3, interpolation=cv2.INTER_AREA
    )
    (sighting,) = boards(spec)[0].detect(grey)
    x_mm = 3 * (sighting.x_px + 0.5) / px_per_mm
    expected = 1e3 * sighting.x_in_body[:, :2]
    across, down = (int(text) for text in spec.split(":")[1].split("x"))
    assert len(x_mm) == ((across - 1) * (down - 1) if spec.startswith("charuco") else across * down)
    # The board's own frame and the paper's have the same axes, up to where they begin.
    assert np.allclose(x_mm - x_mm.mean(0), expected - expected.mean(0), atol=0.05)


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("charuco:12x8:0.030:0.022:DICT_4X4_50", "360 x 240 mm, but a4 has room for"),
        (
            "charuco:12x9:0.020:0.015:DICT_4X4_50",
            "need 54 markers, but DICT_4X4_50 has 50; choose DICT_4X4_100",
        ),
        ("circles:4x11:0.020", "prints charuco"),
        ("charuco:7x5:30:22:DICT_4X4_50", "30 mm is 0.030"),
    ],
)
def test_what_cannot_be_printed_is_one_line(spec: str, words: str):
    with pytest.raises(jcr.InputError, match=words):
        board_sheet(spec)


@pytest.mark.slow
def test_the_command_writes_the_file_and_names_the_option(tmp_path: Path):
    done = run_jcr("board", tmp_path / "b.pdf")
    assert done.returncode == 0 and "--board charuco:8x5:0.030:0.022:DICT_4X4_50" in done.stdout
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
