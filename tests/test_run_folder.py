"""Run folders that somebody edited or cut are refused in one line, or read; their files are written whole."""

import json
import os
import shutil
import stat
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

import numpy as np
import pytest

from corpus import sound_run
from jcr.capture.formats.capture_json import kept
from jcr.capture.read import read_capture
from jcr.cli import dispatch
from jcr.files import locked, write_new, write_text, written_whole
from jcr.pipeline import backend_selection
from jcr.pipeline.run import calibrate
from jcr.pipeline.stages import begun, complete, is_unchanged
from jcr.records import CellCamera
from jcr.result import RunOptions, RunResult
from refusal import refused
from scenes import capture_of


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with calibration.json and run.json, of poses without noise; its capture lies in it."""
    return sound_run(tmp_path_factory.mktemp("sound") / "out")


def test_a_run_with_files_beside_its_images_is_complete_in_relative_folders(sound, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sound, "out")
    beside = "images/0.png", "0.depth.png", "fixed/0.png", "robot.urdf"
    for file in (*(f"cell/{name}" for name in beside), "out/added/0.png"):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        Path(file).write_bytes(b"image")
    other = CellCamera(name="fixed", mount="base", images=("fixed/0.png",), image_size=(64, 48))
    images = {"images": ("images/0.png",), "depths": ("0.depth.png",), "image_size": (64, 48)}
    facts = {"folder": Path("cell"), "urdf": Path("cell/robot.urdf"), "others": (other,)}
    capture = capture_of(np.eye(4)[None], **images, **facts)
    run = begun(Path("out"), capture, RunOptions(map=None))
    Path("out/report.html").write_text("")
    complete(run)
    assert is_unchanged(run)
    for file in (*(f"cell/{name}" for name in beside), "out/added/0.png", "out/calibration.json"):
        before = Path(file).read_bytes()
        Path(file).write_bytes(before + b" ")
        assert not is_unchanged(begun(Path("out"), capture, RunOptions(map=None))), file
        Path(file).write_bytes(before)
    for changed in ({"robot": "ur5e"}, {"joints": np.zeros((1, 6))}, {"urdf": None}):
        assert not is_unchanged(begun(Path("out"), replace(capture, **changed), RunOptions(map=None))), (
            changed
        )
    Path("out/report.html").unlink()
    assert not is_unchanged(run)


Change = Callable[[dict[str, Any]], Any]

STATES: dict[str, Change] = {
    "no options": lambda c: c.pop("options"),
    "unknown option": lambda c: c["options"]["reconstruct"].update(magic=1),
    "no such back end": lambda c: c["options"]["reconstruct"].update(backend="magic"),
    "NaN": lambda c: c["options"]["reconstruct"].update(seed=float("nan")),
    "capture with NUL": lambda c: c.update(capture="a\0b"),
    "capture of a name too long": lambda c: c.update(capture="/tmp/" + "x" * 300),
    "capture gone": lambda c: c.update(capture="/nowhere"),
    "no fingerprints": lambda c: c.update(made=None),
}
CALIBRATIONS: dict[str, Change] = {
    "scale NaN": lambda c: c.update(scale=float("nan")), "scale null": lambda c: c.update(scale=None),
    "covariance of six": lambda c: c["uncertainty"]["covariance"].pop(),
    "negative variance": lambda c: c["uncertainty"]["covariance"][0].__setitem__(0, -1.0),
    "mirrored transform": lambda c: c["gripper_from_camera"][0].__setitem__(0, 3.0),
    "two coefficients": lambda c: c["intrinsics"].update(distortion=[0.1, 0.2]),
    "no reason": lambda c: c.update(converged=False, warnings=[]), "unknown key": lambda c: c.update(magic=1),
}  # fmt: skip
FILES = [("run.json", STATES), ("calibration.json", CALIBRATIONS)]


@pytest.mark.parametrize(
    ("name", "change"),
    [
        pytest.param(name, change, id=f"{name} {about}")
        for name, table in FILES
        for about, change in table.items()
    ]
    + [
        pytest.param(name, length, id=f"{name} cut to {length}") for name, _ in FILES for length in (0, 1, 40)
    ],
)
def test_edited_or_cut_files_refused(sound: Path, tmp_path: Path, name: str, change: Change | int, capsys):
    out, made = shutil.copytree(sound, tmp_path / "out"), tmp_path / "made.xml"
    text = (out / name).read_text()
    if isinstance(change, int):
        text = text[:change]
    else:
        content = json.loads(text)
        change(content)
        text = json.dumps(content)
    (out / name).write_text(text)
    commands = [["map", str(out), "--quiet"]]
    if name == "calibration.json":
        verify = ["verify", str(out), str(sound / "capture"), "--quiet"]
        commands = [["compare", str(out), str(sound)], ["export", str(out), "ros2", str(made)], verify]
    for command in commands:
        assert dispatch(command) == 2
        said = capsys.readouterr().err
        assert said.startswith("error: ") and said.count("\n") == 1 and len(said) < 500
        assert name in said or "/nowhere" in said
    assert not made.exists()


def test_a_run_whose_capture_was_moved_away_says_where_it_was(sound: Path, tmp_path: Path, capsys):
    out, gone = shutil.copytree(sound, tmp_path / "out"), tmp_path / "table"
    state = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(state | {"capture": str(gone)}))
    for command in (["add-camera", str(out), "a.png"], ["verify", str(out), str(sound / "capture")],
                    ["export", str(out), "colmap", str(tmp_path / "colmap")]):  # fmt: skip
        assert dispatch(command) == 2
        said = capsys.readouterr().err
        assert f"made from the capture at {gone}, which is gone; move it back there, or run it again" in said


def test_a_capture_in_a_folder_whose_name_is_not_utf8_is_refused_before_any_work():
    capture = capture_of(np.eye(4)[None], folder=Path("caf\udce9"), images=("a.png",))
    with refused("not UTF-8; rename it"):
        begun(Path("out"), capture, RunOptions())


def test_memory_that_ends_is_one_line(capsys, monkeypatch: pytest.MonkeyPatch):
    def load(name: str) -> ModuleType:
        raise MemoryError("Unable to allocate 5.62 MiB")

    monkeypatch.setattr("jcr.cli.command", load)
    assert dispatch(["run"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: out of memory (Unable to allocate 5.62 MiB); ") and said.count("\n") == 1


def test_a_second_run_in_the_same_folder_is_refused(tmp_path: Path):
    with locked(tmp_path / "out"), refused("another jcr"), locked(tmp_path / "out"):
        pytest.fail("two runs write the same folder")
    # The folder, into which nothing came, is gone with its lock.
    assert not (tmp_path / "out").exists()


def test_a_kill_during_the_calibration_keeps_the_reconstruction(
    small_capture: Path, small_done: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    made = RunResult(small_done).reconstruction

    def killed(*_: object) -> NoReturn:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(backend_selection, "reconstruct", lambda *_: made)
        patched.setattr(backend_selection, "calibrate_reconstruction", killed)
        with pytest.raises(KeyboardInterrupt):
            calibrate(str(small_capture), tmp_path / "out", backend="colmap")
    assert (tmp_path / "out" / "reconstruction.npz").is_file()
    monkeypatch.setattr(backend_selection, "reconstruct", lambda *_: pytest.fail("reconstructed again"))
    result = calibrate(str(small_capture), tmp_path / "out", backend="colmap")
    before = RunResult(small_done).gripper_from_camera
    np.testing.assert_allclose(result.gripper_from_camera, before, atol=1e-9)


def test_a_capture_with_changed_images_is_not_read_with_an_earlier_run(small_capture: Path, small_done: Path):
    capture = read_capture(small_capture)
    assert len(RunResult(small_done, capture=capture).of_wrist_camera()[1]) == 5
    for rows in ([1, 0, 2, 3, 4], [0, 1, 2, 3]):
        with refused("changed after"):
            RunResult(small_done, capture=capture.of_rows(np.array(rows))).of_wrist_camera()


@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_a_file_has_the_users_permissions_and_the_umask_of_the_process_stays(tmp_path, monkeypatch, umask):
    """Files that another thread makes meanwhile must not be open to everybody."""
    before = os.umask(umask)
    try:
        with monkeypatch.context() as patched:
            patched.setattr(os, "umask", lambda mask: pytest.fail("the umask of the process is changed"))
            write_text(tmp_path / "calibration.json", "{}")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "calibration.json").stat().st_mode) == 0o666 & ~umask
    assert [file.name for file in tmp_path.iterdir()] == ["calibration.json"]


def test_a_file_that_has_the_bytes_already_keeps_its_time(tmp_path: Path):
    file = tmp_path / "depth.png"
    write_new(file, b"one")
    os.utime(file, (1, 1))
    write_new(file, b"one")
    assert file.stat().st_mtime == 1
    write_new(file, b"two")
    assert file.read_bytes() == b"two" and file.stat().st_mtime > 1


def test_a_file_that_is_not_written_whole_leaves_the_old_one_and_nothing_beside_it(tmp_path: Path):
    (tmp_path / "map.bin").write_text("old")
    with pytest.raises(KeyboardInterrupt), written_whole(tmp_path / "map.bin") as temporary:
        temporary.write_text("new")
        raise KeyboardInterrupt
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("map.bin", "old")]


def test_the_run_of_another_capture_is_not_overwritten(sound: Path, small_capture: Path):
    """The map and the accepted calibration of another capture were deleted without a word."""
    before = (sound / "calibration.json").read_bytes()
    with refused("holds the run of .*; name another folder, or delete it"):
        calibrate(small_capture, sound)
    assert (sound / "calibration.json").read_bytes() == before


def test_what_was_changed_in_python_is_what_later_commands_read(small_capture: Path, tmp_path: Path):
    """They read the whole capture of the folder, and its poses as they stand there."""
    capture = read_capture(small_capture)
    corrected = capture.base_from_gripper.copy()
    corrected[:, 2, 3] += 0.01
    assert kept(capture, tmp_path / "same") is capture and not (tmp_path / "same").exists()
    changed = {
        "fewer": capture.of_rows([0, 2, 3, 4]),
        "moved": replace(capture, base_from_gripper=corrected),
        "unknown": replace(capture, intrinsics=None),
        "named": replace(capture, robot="ur5e"),
    }
    for name, one in changed.items():
        copy = kept(one, tmp_path / name)
        again = read_capture(copy.folder)
        assert copy.folder == tmp_path / name and again.images == one.images, name
        assert np.allclose(again.base_from_gripper, one.base_from_gripper, rtol=0, atol=1e-12), name
        assert (again.intrinsics, again.robot) == (one.intrinsics, one.robot), name
    shutil.copytree(small_capture / "images", tmp_path / "bare" / "images")
    bare = replace(capture, folder=tmp_path / "bare")
    assert read_capture(kept(bare, tmp_path / "made").folder).images == capture.images
    first = calibrate(changed["fewer"], tmp_path / "out")
    assert RunResult(first.out).of_wrist_camera()[1].images == changed["fewer"].images
    assert not first.is_unchanged and calibrate(changed["fewer"], tmp_path / "out").is_unchanged
