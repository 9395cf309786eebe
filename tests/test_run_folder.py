"""Run folders that somebody edited or cut: refused in one line, or read; never a traceback."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from corpus import sound_run
from jcr.cli import dispatch
from jcr.errors import InputError
from jcr.files import locked
from jcr.pipeline.stages import begun, complete, is_unchanged
from jcr.records import Capture, CellCamera
from jcr.result import RunOptions


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with calibration.json and run.json, of poses without noise; its capture lies in it."""
    return sound_run(tmp_path_factory.mktemp("sound") / "out")


def test_a_run_with_files_beside_its_images_is_complete_in_relative_folders(
    sound: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(sound, "out")
    for file in (
        "cell/images/0.png",
        "cell/0.depth.png",
        "cell/fixed/0.png",
        "cell/robot.urdf",
        "out/added/0.png",
    ):
        Path(file).parent.mkdir(parents=True, exist_ok=True)
        Path(file).write_bytes(b"image")
    other = CellCamera(name="fixed", mount="base", images=("fixed/0.png",), image_size=(64, 48))
    capture = Capture(
        folder=Path("cell"),
        images=("images/0.png",),
        base_from_gripper=np.eye(4)[None],
        image_size=(64, 48),
        urdf=Path("cell/robot.urdf"),
        depths=("0.depth.png",),
        others=(other,),
    )
    run = begun(Path("out"), capture, RunOptions(map=None))
    complete(run)
    assert is_unchanged(run)
    Path("cell/fixed/0.png").write_bytes(b"another image")
    assert not is_unchanged(run)


Content = dict[str, Any]


def options(content: Content) -> Content:
    return content["options"]


STATES: dict[str, Callable[[Content], Any]] = {
    "no options": lambda c: c.pop("options"),
    "unknown option": lambda c: options(c)["reconstruct"].update(magic=1),
    "no such back end": lambda c: options(c)["reconstruct"].update(backend="magic"),
    "NaN": lambda c: options(c)["reconstruct"].update(seed=float("nan")),
    "capture with NUL": lambda c: c.update(capture="a\0b"),
    "capture of a name too long": lambda c: c.update(capture="/tmp/" + "x" * 300),
    "capture gone": lambda c: c.update(capture="/nowhere"),
    "no fingerprint": lambda c: c.update(made=None),
}

CALIBRATIONS: dict[str, Callable[[Content], Any]] = {
    "scale NaN": lambda c: c.update(scale=float("nan")),
    "scale null": lambda c: c.update(scale=None),
    "covariance of six": lambda c: c["uncertainty"]["covariance"].pop(),
    "negative variance": lambda c: c["uncertainty"]["covariance"][0].__setitem__(0, -1.0),
    "covariance in another order": lambda c: c["uncertainty"]["order"].reverse(),
    "mirrored transform": lambda c: c["gripper_from_camera"][0].__setitem__(0, 3.0),
    "two coefficients": lambda c: c["intrinsics"].update(distortion=[0.1, 0.2]),
    "no reason": lambda c: c.update(converged=False, warnings=[]),
    "unknown key": lambda c: c.update(magic=1),
}


def edited(sound: Path, out: Path, name: str, change: Callable[[Content], Any]) -> Path:
    shutil.copytree(sound, out)
    content = json.loads((out / name).read_text())
    change(content)
    (out / name).write_text(json.dumps(content))
    return out


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """What is said where a command ends with status 2 and one line."""
    assert dispatch(arguments) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and len(said) < 500
    return said


@pytest.mark.parametrize("variant", STATES)
def test_an_edited_run_json_is_refused_in_one_line(sound: Path, tmp_path: Path, variant: str, capsys):
    out = edited(sound, tmp_path / "out", "run.json", STATES[variant])
    said = refused(["map", str(out), "--quiet"], capsys)
    assert "run.json" in said or "/nowhere" in said


@pytest.mark.parametrize("variant", CALIBRATIONS)
def test_an_edited_calibration_is_refused_in_one_line(sound: Path, tmp_path: Path, variant: str, capsys):
    out = edited(sound, tmp_path / "out", "calibration.json", CALIBRATIONS[variant])
    for command in (
        ["compare", str(out), str(sound)],
        ["export", str(out), "ros2", str(tmp_path / "made.xml")],
        ["verify", str(out), str(sound / "capture"), "--quiet"],
    ):
        assert "calibration.json" in refused(command, capsys)
    assert not (tmp_path / "made.xml").exists()


@pytest.mark.parametrize("name", ["run.json", "calibration.json"])
@pytest.mark.parametrize("length", [0, 1, 40])
def test_a_cut_file_is_refused(sound: Path, tmp_path: Path, name: str, length: int, capsys):
    out = edited(sound, tmp_path / "out", name, lambda content: None)
    (out / name).write_text((out / name).read_text()[:length])
    command = ["map", str(out)] if name == "run.json" else ["compare", str(out), str(out)]
    assert name in refused([*command, "--quiet"] if name == "run.json" else command, capsys)


def test_a_capture_in_a_folder_whose_name_is_not_utf8_is_refused_before_any_work():
    capture = Capture(
        folder=Path("caf\udce9"), images=("a.png",), base_from_gripper=np.eye(4)[None], image_size=(640, 480)
    )
    with pytest.raises(InputError, match="not UTF-8; rename it"):
        begun(Path("out"), capture, RunOptions())


def test_memory_that_ends_is_one_line(capsys, monkeypatch: pytest.MonkeyPatch):
    def load(name: str) -> ModuleType:
        raise MemoryError("Unable to allocate 5.62 MiB")

    monkeypatch.setattr("jcr.cli.command", load)
    assert dispatch(["run"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: out of memory (Unable to allocate 5.62 MiB); ") and said.count("\n") == 1


def test_a_second_run_in_the_same_folder_is_refused(tmp_path: Path):
    with locked(tmp_path / "out"), pytest.raises(InputError, match="another jcr"), locked(tmp_path / "out"):
        pytest.fail("two runs write the same folder")
    # The folder, into which nothing came, is gone with its lock.
    assert not (tmp_path / "out").exists()
