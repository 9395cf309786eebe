"""Mistakes with a board in rendered images, and what the calibration finds."""

import json
from pathlib import Path

import numpy as np
import pytest

import jcr
from jcr.capture.images import encode_png, read_image
from jcr.files import write_bytes
from jcr.findings import FindingKind, sentence
from jcr.geometry import inverse, rotation_exp, transform
from jcr.run_folder import RunResult
from simulation.boards import with_chessboard
from simulation.truth import read_truth

pytestmark = pytest.mark.slow
ROWS = (0, 1, 2, 3, 5, 8, 10, 11)
"""Images of the bundled capture, all of which show the board."""
PLACES = tuple(
    transform(rotation_exp(np.array([0.0, 0.0, yaw])), np.array([x, y, 0.16]))
    for x, y, yaw in ((0.47, -0.07, 0.3), (0.42, -0.02, 0.5))
)
"""base_from_board, above all that stands on the table."""


@pytest.fixture(scope="module")
def captures(tabletop: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A board of 6x5 corners and 25 mm that lies still, and one that is moved after five of eight images."""
    truth, content = read_truth(tabletop), json.loads((tabletop / "capture.json").read_text())
    frames = [content["frames"][k] for k in ROWS]
    folders = {name: tmp_path_factory.mktemp(name) for name in ("still", "moved")}
    for name, folder in folders.items():
        for number, (row, frame) in enumerate(zip(ROWS, frames, strict=True)):
            place = PLACES[int(name == "moved" and number >= 5)]
            drawn = with_chessboard(
                read_image(tabletop / frame["image"]),
                inverse(truth.base_from_camera[row]) @ place,
                truth.intrinsics,
                (6, 5),
                0.025,
            )
            write_bytes(folder / f"{row:02d}.png", encode_png(drawn))
        named = [frame | {"image": f"{row:02d}.png"} for row, frame in zip(ROWS, frames, strict=True)]
        (folder / "capture.json").write_text(json.dumps(content | {"frames": named}))
    return folders


def calibrated(capture: Path, out: Path, board: str) -> RunResult:
    options = {"reconstruct": {"backend": "colmap", "board": board}}
    return jcr.calibrate(capture, out, options)


def test_another_kind_is_not_found_and_what_the_images_show_is_proposed(
    captures: dict[str, Path], tmp_path: Path
):
    result = calibrated(captures["still"], tmp_path, "chessboard:8x5:0.025")
    assert result.verdict == "accepted with warnings" and result.calibration.board is None
    (named,) = (one for one in result.hand_eye.findings if one.kind is FindingKind.BOARD_NOT_FOUND)
    assert "no two images show chessboard:8x5:0.025" in sentence(named)
    assert "seem to show chessboard:6x5:SIDE" in sentence(named)


def test_a_board_that_was_moved_between_images_is_used_where_it_lay_longer(
    captures: dict[str, Path], tmp_path: Path
):
    result = calibrated(captures["moved"], tmp_path, "chessboard:6x5:0.025")
    board = result.calibration.board
    assert board is not None and board.images == 5 and board.side_mm == pytest.approx(25.0, abs=0.05)
    assert np.allclose(board.centres_in_base[0][2], 0.16, atol=5e-4)
    (named,) = (one for one in result.hand_eye.findings if one.kind is FindingKind.BOARD_MOVED)
    assert named.images == ("08.png", "10.png", "11.png")
