"""A board or a length that cannot be is refused before any work."""

from pathlib import Path

import pytest

from in_process import run_jcr
from jcr.pipeline import run

FIRST = "images/00.jpg"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--board", "chessbord:9x6:0.02"], "no such board; write it as charuco:"),
        (["--board", "chessboard:9x6:-1"], "-1 is no length of a square in metres"),
        (["--backend", "colmap", "--board", "chessboard:9:0.02"], "9 is no size such as 7x5"),
        (["--known-length", FIRST, "1", "2", "3", "4", "0"], "a positive length in millimetres"),
        (["--known-length", FIRST, "1", "2", "1", "2", "50"], "both ends are one pixel; give two"),
        (["--known-length", "99.jpg", "1", "2", "3", "4", "50"], "no image 99.jpg; it has images/00.jpg"),
        (["--known-length", FIRST, "1", "2", "3", "4000", "50"], "pixel (3, 4000) is outside images/00.jpg"),
    ],
)
def test_a_board_or_a_length_that_cannot_be_is_refused_before_any_work(
    tabletop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
):
    monkeypatch.setattr(run, "begun", lambda *_: pytest.fail("the capture was worked on"))
    found = run_jcr("run", tabletop, tmp_path / "out", *arguments)
    assert found.returncode == 2 and words in found.stderr, found.stderr
    assert len(found.stderr.splitlines()) == 1 and not (tmp_path / "out" / "calibration.json").exists()
