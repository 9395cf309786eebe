"""The section on a board: where its corners were found, its size and its bend."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.attack import reconstructed
from jcr.calibration.calibration_json import CalibrationFile, calibration_file
from jcr.calibration.stage import calibrate
from jcr.capture.images import encode_png
from jcr.files import write_bytes
from jcr.report.board import board_section
from jcr.report.html import report_html
from jcr.report.svg import Figure
from jcr.results import RunResult
from simulation.boards import Sheet, with_sheet
from simulation.faults import Faults, faulty_capture

pytestmark = pytest.mark.slow
BEND_M = 2e-3


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    """Grey images that stand for those of a bent sheet of 25 mm among 500 other points; the first shows none of it."""
    rng = np.random.default_rng([0, 8])
    bare = faulty_capture(rng, 8, Faults())
    found = with_sheet(bare, rng, Sheet(bend_m=BEND_M))
    capture, reconstruction = reconstructed(bare, estimated=False)
    tracks = found.tracks
    shown = tracks.only((tracks.image > 0) | ~tracks.on_board[tracks.point])
    reconstruction = replace(reconstruction, tracks=shown)
    folder = tmp_path_factory.mktemp("board")
    capture = replace(capture, folder=folder)
    for name in capture.images:
        write_bytes(folder / name, encode_png(np.full((480, 640, 3), 128, np.uint8)))
    hand_eye = calibrate(capture, reconstruction)
    return RunResult(
        out=folder,
        capture=capture,
        calibration=calibration_file(capture, reconstruction, hand_eye, {}, "0"),
        hand_eye=hand_eye,
        reconstruction=reconstruction,
    )


def circles(figure: Figure) -> np.ndarray:
    """x, y of the drawn circles."""
    return np.array(
        [[one.attributes["cx"], one.attributes["cy"]] for one in figure.shapes if one.tag == "circle"], float
    )


def test_corners_are_drawn_where_they_were_found(run: RunResult):
    section = board_section(run)
    assert section is not None
    first, second, _ = section.content["figures"]
    tracks = run.reconstruction.tracks
    for figure in (first, second):
        name = figure.label.split()[-1]
        row = run.capture.images.index(name)
        assert row > 0
        x_px = tracks.x_px[(tracks.image == row) & tracks.on_board[tracks.point]]
        drawn = circles(figure)
        assert drawn.shape == (54, 2) and (drawn > 0).all() and (drawn < [figure.width, figure.height]).all()
        by = np.column_stack([np.ones(54), x_px])
        fit, left, *_ = np.linalg.lstsq(by, drawn, rcond=None)
        assert np.allclose(fit[1:], fit[1, 0] * np.eye(2), atol=1e-3) and left.max() < 0.5


def test_the_bend_is_drawn_in_millimetres_and_kept_in_the_file(run: RunResult, tmp_path: Path):
    board = run.calibration.board
    assert board is not None and board.bend_mm == pytest.approx(1e3 * BEND_M, abs=0.3)
    shape = np.array(board.shape_mm)
    assert shape.shape == (54, 3) and np.ptp(shape[:, 2]) == pytest.approx(board.bend_mm, abs=2e-3)
    assert np.ptp(shape[:, :2], axis=0) == pytest.approx([200, 125], rel=0.01)
    section = board_section(run)
    assert section is not None
    x, y = circles(section.content["figures"][2]).T
    edges, middle = (x < x.min() + 5) | (x > x.max() - 5), np.abs(x - (x.min() + x.max()) / 2) < 5
    assert y[edges].max() < y[middle].min()  # up is towards smaller y
    again = CalibrationFile.model_validate_json(run.calibration.model_dump_json())
    assert again.board == board


def test_the_page_has_the_numbers_of_the_board_and_no_section_without_one(run: RunResult):
    page = report_html(run)
    assert '<section class="long" id="board">' in page and 'href="#board"' in page
    assert "chessboard:9x6:0.025 was found in 7 of 8 images: 54 corners" in page and "25 mm stated" in page
    without = run.calibration.model_copy(update={"board": None})
    assert board_section(replace(run, calibration=without)) is None
