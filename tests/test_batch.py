"""Many captures at once: the broken one fails alone, finished ones are not run again."""

import csv
import json
import shutil
import time
from dataclasses import replace
from pathlib import Path

import pytest

from dying_process import copies_a_run, dies_on_bad
from jcr.calibration.options import CalibrateOptions
from jcr.capture.options import ReadOptions
from jcr.cli import dispatch
from jcr.pipeline import batch as module
from jcr.pipeline.batch import BatchRow, Task, batch, run_one
from jcr.pipeline.options import BatchOptions
from jcr.pipeline.run import RunOptions

pytestmark = pytest.mark.slow

COMPLETE = BatchOptions(calibrate_only=True, processes=2)


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory, tabletop: Path) -> list[Path]:
    """Four and five small images of the table, one folder with a broken image, one with no features."""
    from PIL import Image

    root = tmp_path_factory.mktemp("captures")
    content = json.loads((tabletop / "capture.json").read_text())
    intrinsics = content["intrinsics"] | {key: content["intrinsics"][key] / 2 for key in ("fx", "fy")}
    intrinsics |= {"cx": 159.5, "cy": 119.5}
    for name, rows in (("a", range(4)), ("b", range(5)), ("broken", range(4)), ("plain", range(4))):
        (root / name / "images").mkdir(parents=True)
        frames = [content["frames"][k] for k in rows]
        for k, frame in enumerate(frames):
            image = Image.open(tabletop / frame["image"]).resize((320, 240), Image.Resampling.BOX)
            if name == "plain":
                image = Image.new("RGB", (320, 240), (90 + 8 * k, 90, 90))
            image.save(root / name / frame["image"], quality=95)
        (root / name / "capture.json").write_text(json.dumps({"frames": frames, "intrinsics": intrinsics}))
    for name in ("01.jpg", "02.jpg"):  # two that are left are too few
        (root / "broken" / "images" / name).write_bytes(b"no picture")
    return [root / name for name in ("a", "b", "broken", "plain")]


def test_a_bad_capture_fails_alone_and_what_is_finished_is_not_run_again(
    captures: list[Path], tmp_path: Path, capsys
):
    out = tmp_path / "all"
    names = [str(path) for path in captures]
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

    stamps = {name: (out / name / "calibration.json").stat().st_mtime_ns for name in ("a", "b", "plain")}
    content = json.loads((captures[0] / "capture.json").read_text())
    content["frames"][0]["base_from_gripper"][0][3] += 1e-4
    (captures[0] / "capture.json").write_text(json.dumps(content))
    assert dispatch(command) == 3
    assert str(out / "summary.html") in capsys.readouterr().out
    again = {name: (out / name / "calibration.json").stat().st_mtime_ns for name in stamps}
    assert again["a"] > stamps["a"] and again["b"] == stamps["b"] and again["plain"] == stamps["plain"]


def test_deleted_results_and_changed_facts_of_a_capture_are_made_again(tmp_path: Path, captures: list[Path]):
    """Joints, the robot and a result that is gone count as the images and poses do."""
    capture, out = tmp_path / "capture", tmp_path / "all"
    shutil.copytree(captures[1], capture)

    def stamp() -> int:
        (row,) = batch([capture], out, RunOptions(), replace(COMPLETE, processes=1))
        assert row.status != "failed", row.reason
        return (out / "capture" / "calibration.json").stat().st_mtime_ns

    first = stamp()
    assert stamp() == first
    (out / "capture" / "report.html").unlink()
    second = stamp()
    assert second > first and (out / "capture" / "report.html").is_file()
    content = json.loads((capture / "capture.json").read_text())
    content["robot"] = "ur5e"
    (capture / "capture.json").write_text(json.dumps(content))
    assert stamp() > second


def test_cores_are_counted_where_processes_cannot_be_bound_to_them(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, captures: list[Path]
):
    monkeypatch.delattr(module.os, "sched_getaffinity", raising=False)  # as on macOS
    (row,) = batch([captures[2]], tmp_path / "all", RunOptions(), BatchOptions(calibrate_only=True))
    assert row.status == "failed" and "not a readable image" in row.reason


def test_a_process_that_dies_takes_no_other_capture_with_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(module, "run_one", dies_on_bad)
    paths = [tmp_path / name for name in ("one", "bad", "two", "three")]
    rows = batch(paths, tmp_path / "out", RunOptions(), COMPLETE)
    assert [row.status for row in rows] == ["accepted", "accepted", "accepted", "failed"]
    assert "process died" in rows[-1].reason


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
    options = RunOptions(calibrate=CalibrateOptions(require=(0.001, 0.001)))
    row = run_one(
        Task(capture=captures[1], out=tmp_path / "b", run=options, calibrate_only=True, read=ReadOptions())
    )
    assert row.status == "rejected" and row.reason, row


def test_folders_of_one_name_are_kept_apart(tmp_path: Path):
    assert module._names([tmp_path / "a/x", tmp_path / "b/x", tmp_path / "x-2", tmp_path / "b/x"]) == [
        "x",
        "x-2",
        "x-2-2",
        "x-3",
    ]


@pytest.mark.slow
def test_a_node_of_a_ray_cluster_that_dies_loses_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    pytest.importorskip("ray", reason="the extra jcr-handeye[cluster] is not installed")
    from ray.cluster_utils import Cluster

    first, removed = tmp_path / "0", tmp_path / "removed"

    def unfinished(task: Task) -> BatchRow:
        """The first ends at once, the others when the node is gone on which some of them run."""
        deadline = time.monotonic() + 60
        while task.capture != first and not removed.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        return BatchRow(capture=str(task.capture), out=str(task.out), status="accepted", offset_std_mm=1.0)

    monkeypatch.setattr(module, "run_one", unfinished)
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 2})
    try:
        nodes = [cluster.add_node(num_cpus=2)]

        def kill(stage: str, fraction: float) -> None:
            if fraction > 0 and nodes:
                cluster.remove_node(nodes.pop(), allow_graceful=False)
                removed.touch()

        options = replace(COMPLETE, ray=cluster.address)
        greedy = replace(options, cpus_per_task=64)
        with pytest.raises(module.InputError, match="no node has the 64 cores"):
            batch([tmp_path / "0"], tmp_path / "none", RunOptions(), greedy)
        rows = batch([tmp_path / f"{k}" for k in range(6)], tmp_path / "out", RunOptions(), options, kill)
    finally:
        cluster.shutdown()
    assert not nodes
    assert sorted(Path(row.capture).name for row in rows if row.status == "accepted") == list("012345")
