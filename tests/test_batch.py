"""Many captures at once: the broken one fails alone, finished ones are not run again."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import jcr
from conftest import shrunk_capture
from dying_process import copies_a_run, dies_on_bad
from jcr.calibration.options import CalibrateOptions
from jcr.capture.formats.lerobot import episodes_of
from jcr.capture.images import encode_png
from jcr.capture.options import ReadOptions
from jcr.cli import dispatch
from jcr.geometry import transform
from jcr.pipeline import batch as module
from jcr.pipeline.batch import BatchRow, batch, run_one
from jcr.pipeline.episode_agreement import agreement
from jcr.pipeline.options import BatchOptions
from jcr.result import RunOptions
from refusal import refused

pytestmark = pytest.mark.slow

COMPLETE = BatchOptions(calibrate_only=True, processes=2)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> list[Path]:
    """Four and five small images of the table, one folder with a broken image, one with no features."""
    root = tmp_path_factory.mktemp("captures")
    folders = [
        shrunk_capture(tabletop, root / name, count, 200)
        for name, count in (("a", 4), ("b", 5), ("broken", 4), ("plain", 4))
    ]
    for name in ("01.jpg", "02.jpg"):  # two that are left are too few
        (root / "broken" / "images" / name).write_bytes(b"no picture")
    for k, image in enumerate((root / "plain" / "images").iterdir()):
        image.write_bytes(encode_png(np.full((150, 200, 3), 90 + 8 * k, np.uint8)))
    return folders


def test_a_bad_capture_fails_alone(captures: list[Path], tmp_path: Path, capsys):
    out, names = tmp_path / "all", [str(path) for path in captures]
    command = ["batch", *names, str(out), "--calibrate-only", "--processes", "1", "--quiet"]
    assert dispatch([*command, "--json"]) == 3
    printed = capsys.readouterr()
    rows = {Path(row["capture"]).name: BatchRow(**row) for row in json.loads(printed.out)["captures"]}
    assert "of 4 captures failed, are rejected, or are not as exact as needed" in printed.err
    assert printed.err.count("\n") == 1
    assert rows["broken"].status == "failed" and "not a readable image" in rows["broken"].reason
    assert rows["plain"].status == "rejected" and "registered" in rows["plain"].reason
    assert rows["a"].images == 4 and rows["b"].images == 5 and rows["b"].point_95_mm is not None
    found = jcr.load_run(out / "b").calibration
    assert (rows["b"].x_m, rows["b"].fx) == (found.gripper_from_camera[0, 3], found.intrinsics.fx)
    with (out / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 4 and table[-1]["status"] == "failed"
    page = (out / "summary.html").read_text()
    assert page.count("<tr>") == 5 and "not a readable image" in page


def test_a_recording_is_not_extracted_where_another_process_writes(tmp_path: Path, captures: list[Path]):
    with module.locked(tmp_path):
        row = run_one(captures[0], tmp_path, RunOptions(map=None), ReadOptions())
    assert row.status == "failed" and "another jcr is writing there" in row.reason
    assert not (tmp_path / "capture").exists()


def test_a_process_that_dies_takes_no_other_capture_with_it_and_names_are_kept_apart(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "run_one", dies_on_bad)
    paths = [tmp_path / name for name in ("one", "bad", "two", "a/two", "two-2")]
    rows = batch(paths, tmp_path / "out", RunOptions(), COMPLETE)
    assert [row.status for row in rows] == ["accepted"] * 4 + ["failed"]
    assert "process died" in rows[-1].reason
    assert {Path(row.out).name for row in rows} == {"one", "bad", "two", "two-2", "two-2-2"}


def test_a_moved_episode_camera_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_done: Path):
    monkeypatch.setattr(module, "run_one", copies_a_run)
    read = ReadOptions(episode=(0, 1, 2))
    rows = batch([small_done], tmp_path / "out", RunOptions(), COMPLETE, read=read)
    moved = {Path(row.out).name[-1]: row for row in rows}
    assert [round(moved[k].moved_mm or 0.0, 6) for k in "012"] == [0.0, 0.0, 20.0]
    assert not moved["0"].reason and "differs by 20.0 mm" in moved["2"].reason
    page = (tmp_path / "out" / "summary.html").read_text()
    for words in (
        "differs by 20.0 mm", "A: episodes 0 to 1", "B: episode 2",
        "moved by 20.0 mm and 0.00° between episodes 1 and 2",
    ):  # fmt: skip
        assert words in page
    assert [moved[k].camera for k in "012"] == ["A", "A", "B"]


def test_all_episodes_are_named_and_of_many_some(tmp_path: Path):
    (tmp_path / "meta").mkdir()
    info = {"features": {}, "fps": 10, "data_path": "x", "total_episodes": 5}
    for total, count in ((5, 5), (5000, 200)):
        (tmp_path / "meta/info.json").write_text(json.dumps(info | {"total_episodes": total}))
        episodes, meant = episodes_of(tmp_path, ReadOptions(episode=("all",)))
        assert (len(episodes), meant) == (count, total) and episodes[0] == 0 and episodes[-1] == total - 1
    assert episodes_of(tmp_path, ReadOptions(episode=(3, 1))) == ([3, 1], 2)
    (tmp_path / "meta/info.json").write_text(json.dumps(info | {"total_episodes": 0}))
    with refused("total_episodes"):
        episodes_of(tmp_path, ReadOptions(episode=("all",)))
    with refused("LeRobot"):
        episodes_of(tmp_path / "meta", ReadOptions(episode=("all",)))


def test_episodes_form_groups_of_one_pose_and_intrinsics_that_differ_are_named(small_done: Path):
    one = jcr.load_run(small_done).found
    std = 1e-3 * max(one.uncertainty.translation_std_mm)
    camera = one.intrinsics
    camera = replace(camera, std=(0.5,) * 4 + (0.01,) * (len(camera.distortion)))

    def moved(shift: float, focal: float = 0.0) -> jcr.Calibration:
        x = one.gripper_from_camera @ transform(np.eye(3), np.array([0.0, 0.0, shift]))
        return replace(
            one, on_gripper=x, intrinsics=replace(camera, fx=camera.fx + focal, fy=camera.fy + focal)
        )

    shifts = (0.0, 0.5 * std, 30 * std, 0.0, 30 * std)
    agreed = agreement((2, 4, 6, 8, 10), [moved(shift, 8.0 * (k == 3)) for k, shift in enumerate(shifts)])
    assert agreed.group == [0, 0, 1, 0, 1]
    assert agreed.sentences[:2] == ["A: episodes 2 to 4, 8", "B: episodes 6, 10"]
    assert [words.split(" between ")[1] for words in agreed.sentences[2:5]] == [
        "episodes 4 and 6", "episodes 6 and 8", "episodes 8 and 10"]  # fmt: skip
    assert agreed.sentences[5] == "the intrinsics differ from those of most episodes in 8"


def test_a_capture_that_falls_short_of_what_is_required_is_not_accepted(tmp_path: Path, captures: list[Path]):
    options = RunOptions(calibrate=CalibrateOptions(require=(0.001, 0.001)), map=None)
    row = run_one(captures[1], tmp_path / "b", options, ReadOptions())
    assert row.status == "accepted, but not as exact as needed" and row.reason and not row.is_accepted, row


def test_a_batch_of_no_captures_is_an_input_error(tmp_path: Path):
    with refused("no captures"):
        batch([], tmp_path / "out", RunOptions(), BatchOptions())
    assert not (tmp_path / "out").exists()
