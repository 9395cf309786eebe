"""Many captures at once: the broken one fails alone, finished ones are not run again."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from conftest import shrunk_capture
from dying_process import copies_a_run, dies_on_bad
from jcr.calibration.options import CalibrateOptions
from jcr.capture.images import encode_png
from jcr.capture.options import ReadOptions
from jcr.cli import dispatch
from jcr.pipeline import batch as module
from jcr.pipeline.batch import BatchRow, batch, run_one
from jcr.pipeline.options import BatchOptions
from jcr.result import RunOptions

pytestmark = pytest.mark.slow

COMPLETE = BatchOptions(calibrate_only=True, processes=2)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> list[Path]:
    """Four and five small images of the table, one folder with a broken image, one with no features."""
    root = tmp_path_factory.mktemp("captures")
    folders = [
        shrunk_capture(tabletop, root / name, count, 320)
        for name, count in (("a", 4), ("b", 5), ("broken", 4), ("plain", 4))
    ]
    for name in ("01.jpg", "02.jpg"):  # two that are left are too few
        (root / "broken" / "images" / name).write_bytes(b"no picture")
    for k, image in enumerate((root / "plain" / "images").iterdir()):
        image.write_bytes(encode_png(np.full((240, 320, 3), 90 + 8 * k, np.uint8)))
    return folders


def test_a_bad_capture_fails_alone(captures: list[Path], tmp_path: Path, capsys):
    out, names = tmp_path / "all", [str(path) for path in captures]
    command = ["batch", *names, str(out), "--calibrate-only", "--processes", "2", "--quiet"]
    assert dispatch([*command, "--json"]) == 3
    printed = capsys.readouterr()
    rows = {Path(row["capture"]).name: BatchRow(**row) for row in json.loads(printed.out)["captures"]}
    assert "of 4 captures failed or are rejected" in printed.err and printed.err.count("\n") == 1
    assert rows["broken"].status == "failed" and "not a readable image" in rows["broken"].reason
    assert rows["plain"].status == "rejected" and "registered" in rows["plain"].reason
    assert rows["a"].images == 4 and rows["b"].images == 5 and rows["b"].offset_std_mm is not None
    with (out / "summary.csv").open() as file:
        table = list(csv.DictReader(file))
    assert len(table) == 4 and table[-1]["status"] == "failed"
    page = (out / "summary.html").read_text()
    assert page.count("<tr>") == 5 and "not a readable image" in page


def test_deleted_results_and_changed_facts_of_a_capture_are_made_again(
    tmp_path: Path, captures: list[Path], monkeypatch: pytest.MonkeyPatch
):
    """Robot, URDF, joints, depth, further cameras and a result that is gone count as the images and poses do."""
    capture, report = shutil.copytree(captures[1], tmp_path / "capture"), tmp_path / "all/capture/report.html"
    shutil.copytree(capture / "images", capture / "other")
    depth = [f"{k}.png" for k in range(5)]
    for name in depth:
        (capture / name).write_bytes(encode_png(np.full((240, 320), 600, np.uint16)))
    (capture / "robot.urdf").write_text('<robot name="r"><link name="base"/></robot>')
    frames = json.loads((capture / "capture.json").read_text())["frames"]

    def is_made() -> bool:
        """Run the batch, with a stage in place of the work, and return whether it was called."""
        called = []

        def noted(result: object, stages: object, progress: object) -> None:
            called.append(result)
            raise module.InputError("no work here")

        with monkeypatch.context() as patched:
            patched.setattr("jcr.pipeline.run.make", noted)
            run_one(*task)
        return bool(called)

    task = capture, report.parent, RunOptions(map=None), ReadOptions()
    assert run_one(*task).status != "failed" and not is_made()
    for changed in (
        {"frames": frames[:4]},
        {"robot": "ur5e"},
        {"intrinsics_std": {"fx": 1.0, "fy": 1.0, "cx": 1.0, "cy": 1.0, "distortion": [0.1] * 5}},
        {"cameras": {"fixed": {"mount": "base", "intrinsics": None, "images": ["other/00.jpg"]}}},
        {"frames": [frame | {"depth": name} for frame, name in zip(frames, depth, strict=True)]},
        {"frames": [frame | {"joints": [0.1 * k] * 6} for k, frame in enumerate(frames)]},
        {"urdf": "robot.urdf"},
    ):
        before = (capture / "capture.json").read_text()
        (capture / "capture.json").write_text(json.dumps(json.loads(before) | changed))
        assert is_made(), changed
        (capture / "capture.json").write_text(before)
        assert not is_made(), changed
    report.unlink()
    assert is_made()


def test_cores_are_counted_where_processes_cannot_be_bound_to_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, captures: list[Path]
):
    monkeypatch.delattr(module.os, "sched_getaffinity", raising=False)  # as on macOS
    (row,) = batch([captures[2]], tmp_path / "all", RunOptions(), BatchOptions(calibrate_only=True))
    assert row.status == "failed" and "not a readable image" in row.reason


def test_a_recording_is_not_extracted_into_a_folder_where_another_process_writes(
    tmp_path: Path, captures: list[Path]
):
    with module.locked(tmp_path):
        row = run_one(captures[0], tmp_path, RunOptions(map=None), ReadOptions())
    assert row.status == "failed" and "another jcr is writing there" in row.reason
    assert not (tmp_path / "capture").exists()


def test_a_process_that_dies_takes_no_other_capture_with_it_and_names_are_kept_apart(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
):
    monkeypatch.setattr(module, "run_one", dies_on_bad)
    paths = [tmp_path / name for name in ("one", "bad", "two", "a/two", "two-2")]
    rows = batch(paths, tmp_path / "out", RunOptions(), COMPLETE)
    assert [row.status for row in rows] == ["accepted"] * 4 + ["failed"]
    assert "process died" in rows[-1].reason
    assert {Path(row.out).name for row in rows} == {"one", "bad", "two", "two-2", "two-2-2"}


def test_the_episode_whose_camera_moved_is_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, small_done: Path
):
    monkeypatch.setattr(module, "run_one", copies_a_run)
    read = ReadOptions(episode=(0, 1, 2))
    rows = batch([small_done], tmp_path / "out", RunOptions(), COMPLETE, read=read)
    moved = {Path(row.out).name[-1]: row for row in rows}
    assert [round(moved[k].moved_mm or 0.0, 6) for k in "012"] == [0.0, 0.0, 20.0]
    assert not moved["0"].reason and "differs by 20.0 mm" in moved["2"].reason
    assert "differs by 20.0 mm" in (tmp_path / "out" / "summary.html").read_text()


def test_a_capture_that_falls_short_of_what_is_required_is_rejected(tmp_path: Path, captures: list[Path]):
    options = RunOptions(calibrate=CalibrateOptions(require=(0.001, 0.001)), map=None)
    row = run_one(captures[1], tmp_path / "b", options, ReadOptions())
    assert row.status == "rejected" and row.reason, row
