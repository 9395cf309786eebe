"""A printed board is what the marker back end looks for, at the size that its name says."""

import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy import ndarray

import jcr
from jcr.export.board_sheet import POINT_MM, as_pdf, as_svg, board_sheet
from jcr.reconstruct.board import boards

PX_PER_MM = 8


def printed(rectangles_mm: ndarray, paper_mm: tuple[float, float]) -> ndarray:
    paper = np.full((round(PX_PER_MM * paper_mm[1]), round(PX_PER_MM * paper_mm[0])), 255, np.uint8)
    for x, y, width, height in PX_PER_MM * rectangles_mm:
        paper[round(y) : round(y + height), round(x) : round(x + width)] = 0
    return cv2.GaussianBlur(paper, (0, 0), 1.5)


def of_pdf(data: bytes) -> tuple[ndarray, tuple[float, float]]:
    """What its page shows: rectangles in mm from the top left, and the paper."""
    width, height = (float(number) for number in re.search(rb"MediaBox \[0 0 (\S+) (\S+)\]", data).groups())
    scale = float(re.search(rb"(\S+) 0 0 \S+ 0 0 cm", data)[1])
    found = [[float(number) for number in four] for four in re.findall(rb"(\S+) (\S+) (\S+) (\S+) re", data)]
    x, y, w, h = (scale * np.array(found) * POINT_MM).T
    return np.stack([x, height * POINT_MM - y - h, w, h], axis=1), (width * POINT_MM, height * POINT_MM)


@pytest.mark.parametrize("spec", ["charuco:8x5:0.030:0.022:DICT_4X4_50", "chessboard:8x5:0.027"])
def test_a_printed_board_is_found_whole_and_at_its_size(spec: str):
    sheet = board_sheet(spec)
    rectangles, paper = of_pdf(as_pdf(sheet))
    assert np.allclose(rectangles, sheet.rectangles_mm, atol=1e-3) and np.allclose(
        paper, (297, 210), atol=1e-3
    )
    (sighting,) = boards(spec)[0].detect(printed(rectangles, paper))
    x_mm = (sighting.x_px + 0.5) / PX_PER_MM
    expected = 1e3 * sighting.x_in_body[:, :2]
    assert len(x_mm) == (7 * 4 if spec.startswith("charuco") else 8 * 5)
    # The board's own frame and the paper's have the same axes, up to where they begin.
    assert np.allclose(x_mm - x_mm.mean(0), expected - expected.mean(0), atol=0.05)
    assert f"--board {spec}" in as_svg(sheet)


def test_a_pdf_says_where_its_objects_are():
    data = as_pdf(board_sheet("chessboard:8x5:0.027"))
    table = int(re.search(rb"startxref\n(\d+)", data)[1])
    assert data[table : table + 4] == b"xref"
    for number, start in enumerate(re.findall(rb"(\d{10}) 00000 n", data[table:]), 1):
        assert data[int(start) :].startswith(b"%d 0 obj" % number)
    length = int(re.search(rb"/Length (\d+)", data)[1])
    assert data.split(b"stream\n", 1)[1][length:].startswith(b"\nendstream")


@pytest.mark.parametrize(
    ("spec", "words"),
    [
        ("charuco:12x8:0.030:0.022:DICT_4X4_50", "360 x 240 mm, but a4 has room for"),
        (
            "charuco:12x9:0.030:0.022:DICT_4X4_50",
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
    command = [sys.executable, "-m", "jcr", "board", tmp_path / "b.pdf"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and "--board charuco:8x5:0.030:0.022:DICT_4X4_50" in done.stdout
    assert (tmp_path / "b.pdf").read_bytes().startswith(b"%PDF")
