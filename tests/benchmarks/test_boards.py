"""The bench of boards keeps its draws as it makes them."""

from pathlib import Path

import pytest

from benchmarks import boards
from benchmarks.boards import BENDS_M, IMAGES, POSE_SCALES, Outcome


def test_an_interrupted_table_goes_on_where_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made, rows, file = (
        list[tuple[float, ...]](),
        len(IMAGES) * len(BENDS_M) * len(POSE_SCALES),
        tmp_path / "runs" / "d",
    )

    def simulated(*draw: float) -> dict[str, Outcome]:
        if len(made) == rows + 3:
            raise KeyboardInterrupt
        made.append(draw)
        return {how: Outcome(float(len(made)), 0.1, 1.0, True, False) for how in boards.HOWS}

    monkeypatch.setattr(boards, "_simulated", simulated)
    with pytest.raises(KeyboardInterrupt):
        boards._table(2, file)
    assert [seed for *_, seed in made[:rows]] == [0] * rows  # every row has a draw before any has two
    before, made[:] = list(made), []
    table = boards._table(2, file)
    assert len(made) == rows - 3 and not set(made) & set(before)
    assert [one["both"].mm for one in table[IMAGES[0], BENDS_M[0], POSE_SCALES[0]]] == [1.0, rows + 1.0]
