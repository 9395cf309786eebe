"""Faults of folders and files, and odd surroundings, at the command line: one line with a remedy, earlier results stay.

Faults of captures are in tests/capture/test_capture.py, those of weights in tests/pointmaps/dust3r/test_weights.py.
"""

import json
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from capture_writers import write_easy_handeye2
from corpus import small_capture as noise_capture
from in_process import run_jcr
from jcr.calibration.record import read_calibration
from jcr.cli import dispatch
from jcr.estimation.arms import arm_named
from jcr.estimation.kinematics import forward_kinematics
from jcr.geometry import scale_translation
from jcr.pipeline import stages
from jcr.records.reconstruction_npz import read_reconstruction
from jcr.result import RunResult
from places import contents
from refusal import refused
from simulation.problems import hand_eye_problem
from waiting import until

pytestmark = pytest.mark.slow

COUNT = 6


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small capture with nothing wrong but its images, which are noise."""
    return noise_capture(tmp_path_factory.mktemp("sound"), (96, 72), COUNT).folder


@pytest.fixture
def place(tmp_path: Path, sound: Path, small_done: Path) -> Path:
    """A folder with copies of a capture and a finished run."""
    shutil.copytree(sound, tmp_path / "capture")
    large = shutil.ignore_patterns("reconstruction.npz", "depth.npz", "*.ply", "*.html")
    shutil.copytree(small_done, tmp_path / "done", ignore=large)
    return tmp_path


def too_long(file: Path) -> None:
    """Gripper positions in another unit than the arm's joint angles say; no image would show it."""
    arm, content = arm_named("ur5e"), json.loads(file.read_text())
    joints = arm.rest + 0.4 * np.random.default_rng(1).normal(size=(COUNT, arm.dof))
    poses = forward_kinematics(arm, joints)
    poses[:, :3, 3] *= 1.05
    for frame, angles, pose in zip(content["frames"], joints, poses, strict=True):
        frame |= {"joints": angles.tolist(), "base_from_gripper": pose.tolist()}
    file.write_text(json.dumps(content | {"robot": "ur5e"}))


def linked_to_itself(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def pipe(path: Path) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def other_format(path: Path) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": "jcr.calibration/9"}))


@dataclass(frozen=True)
class Evil:
    """Unpickling it writes a file."""

    file: Path

    def __reduce__(self):
        return Path.touch, (self.file,)


def pickled(path: Path) -> None:
    np.savez(path, edges=np.array([Evil(path.with_name("executed"))], dtype=object))


def nothing(path: Path) -> None:
    """Change no file: the command itself is wrong."""


CALIBRATE, TOO_LONG = "calibrate capture out --quiet", r"[45]\.\d ± \d\.\d % too long for a ur5e"
QUERY = "query done points.csv"
FAULTS: dict[str, tuple[str, Callable[[Path], Any], str, str]] = {
    "positions too long": ("capture/capture.json", too_long, CALIBRATE, f"{TOO_LONG}.*check the unit"),
    "output that nobody may write": (
        "out",
        nothing,
        "calibrate capture /proc/out --quiet",
        "cannot be written",
    ),
    "export below a file": (
        "out",
        lambda p: p.write_text("precious"),
        "export done urdf out/a.urdf --parent-frame flange",
        "cannot be written",
    ),
    "output that is a file": ("out", lambda p: p.write_text("precious"), CALIBRATE, "is a file"),
    "calibration of a newer format": ("done/calibration.json", other_format, "compare done done", "format"),
    "no map": ("done/map.safetensors", Path.unlink, QUERY, "no map here"),
    "state that is a pipe": ("done/run.json", pipe, "map done --quiet", "a pipe or a device"),
    "state that is a link to itself": ("done/run.json", linked_to_itself, "map done --quiet", "no run"),
    "cameras that are a pipe": (
        "done/reconstruction.npz",
        pipe,
        "verify done capture --quiet",
        "a pipe or a device",
    ),
    "predictions with code": ("pairs.npz", pickled, f"{CALIBRATE} --predictions pairs.npz", r"pairs\.npz"),
}
"""File, its change, the command, and words of its error."""


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_ends_in_one_line_and_harms_nothing(place: Path, fault: str, monkeypatch, capsys):
    file, change, command, words = FAULTS[fault]
    monkeypatch.chdir(place)
    Path("points.csv").write_text("x,y,z\n0.4,0,0.2\n")
    change(place / file)
    before = contents(place)
    assert dispatch(command.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and re.search(words, said), said
    # Nothing half-written is left, no empty folder, and no code of a file was run.
    assert contents(place) == before and not Path("out").is_dir()


@pytest.mark.parametrize("name", ["reconstruction.npz", "depth.npz"])
def test_a_damaged_reconstruction_is_named_others_stay(tmp_path: Path, small_done: Path, name: str, capsys):
    copy = tmp_path / "done"
    shutil.copytree(small_done, copy)
    cut(copy / name)
    before = contents(copy)
    assert dispatch(["map", str(copy), "--quiet"]) == 2
    said = capsys.readouterr().err
    assert f"{name}: damaged" in said and said.count("\n") == 1
    assert contents(copy) == before


def test_a_failed_run_leaves_no_map_of_an_earlier_one(tmp_path: Path, sound: Path, small_done: Path, capsys):
    out = tmp_path / "out"
    shutil.copytree(small_done, out)
    state = json.loads((out / "run.json").read_text()) | {
        "capture": str(sound.resolve())
    }  # now with other images
    (out / "run.json").write_text(json.dumps(state))
    assert dispatch(["calibrate", str(sound), str(out), "--backend", "colmap", "--quiet"]) == 3
    assert read_calibration(out).parent_from_camera is None
    kept = {path.name for path in out.iterdir()}
    assert kept == {".lock", "calibration.json", "log.txt", "report.html", "run.json"}
    capsys.readouterr()
    # The folder has the state of the failed run, and nothing to make a map of.
    assert dispatch(["map", str(out), "--quiet"]) == 3
    assert capsys.readouterr().err.startswith("error: ") and not (out / "map.safetensors").exists()


def test_a_state_never_vouches_for_a_reconstruction_that_it_does_not_know(tmp_path, small_done, monkeypatch):
    """Killed between the two files of another capture, the first capture's run would take the wrong one."""
    out, made = tmp_path / "out", RunResult(small_done)
    shutil.copytree(small_done, out)

    def killed(*_) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(stages, "write_reconstruction", killed)
    with pytest.raises(KeyboardInterrupt):
        stages.keep_reconstruction(made.with_parts(out=out), made.reconstruction)
    assert not (out / "run.json").exists()


def test_a_full_disk_leaves_the_earlier_results(tmp_path: Path, small_done: Path, capsys):
    disk = tmp_path / "disk"
    disk.mkdir()
    size = sum(path.stat().st_size for path in small_done.iterdir())
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size + (2 << 20)}", "tmpfs", str(disk)]
    try:
        subprocess.run(mount, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small file system to fill cannot be mounted here")
    try:
        shutil.copytree(small_done, disk, dirs_exist_ok=True)
        (disk / "filler").write_bytes(b"x" * (1 << 20))
        before = contents(disk)
        assert dispatch(["map", str(disk), "--max-seconds", "1", "--quiet"]) == 2
        said = capsys.readouterr().err
        assert "No space left" in said and said.count("\n") == 1
        changed = {name for name, digest in contents(disk).items() if before.get(name) != digest}
        assert changed <= {"calibration.json", "log.txt", "run.json"}, "a result was lost or is half-written"
        assert read_calibration(disk).converged
    finally:
        subprocess.run(["umount", str(disk)], check=True)


RESULTS = ("calibration.json", "log.txt")
ODD = "a b'c\"d $HOME `x` *;&|<é>"


CASES: dict[str, tuple[int, str, str, dict[str, str | None], str]] = {
    "no HOME in locale C": (0, "", '"$@"', dict.fromkeys(("HOME", "XDG_CACHE_HOME", "USER", "LOGNAME"))
        | {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}, "place"),
    "paths with spaces and quotes, umask 077 and closed stdin": (0, "", 'umask 077; "$@" <&-', {}, ODD),
    "full stdout": (2, "No space left", '"$@" >/dev/full', {}, "place"),
}  # fmt: skip
"""Exit status, words of the error, start, changes of the environment (None: removed), and the folder's name."""


@pytest.mark.parametrize("name", CASES)
def test_a_command_ends_as_it_should_wherever_it_is_started(name: str, tmp_path: Path):
    status, words, shell, changes, folder = CASES[name]
    problem = hand_eye_problem(np.random.default_rng(0), 10, robot_noise=(3e-4, 1e-3))
    samples = write_easy_handeye2(
        tmp_path / ODD, problem.base_from_gripper, scale_translation(problem.recon_from_camera, problem.scale)
    )
    out = tmp_path / folder / "out"
    environment = {key: value for key, value in (os.environ | changes).items() if value is not None}
    command = [sys.executable, "-m", "jcr", "calibrate", str(samples), str(out)]
    finished = subprocess.run(
        ["sh", "-c", shell, "sh", *command], env=environment, capture_output=True, text=True, timeout=200
    )  # fmt: skip
    assert finished.returncode == status, finished.stderr
    assert "Traceback" not in finished.stderr and words in finished.stderr
    # What was found is kept, whatever became of the words about it.
    assert read_calibration(out).converged and all((out / name).is_file() for name in RESULTS)
    assert not list(out.glob("*.part*"))
    modes = {stat.S_IMODE((out / name).stat().st_mode) for name in RESULTS}
    assert modes == {0o600} or "umask" not in name


def test_a_run_that_is_asked_to_end_leaves_nothing_half_written_and_goes_on(small_capture: Path, tmp_path):
    out, temporary = tmp_path / "out", tmp_path / "temporary"
    temporary.mkdir()
    words = ["calibrate", str(small_capture), str(out), "--quiet", "--json", "--require", "none"]
    with subprocess.Popen(
        [sys.executable, "-m", "jcr", *words],
        env=os.environ | {"TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        until(lambda: running.poll() is not None or any(temporary.glob("jcr-colmap-*/*")))
        running.send_signal(signal.SIGINT)
        _, printed = running.communicate(timeout=60)
    # Python itself ends by the signal, which shells show as 130, where it was interrupted in what it compiled from
    # a string, as dataclasses are.
    assert running.returncode in (-signal.SIGINT, 130) and "Traceback" not in printed
    assert printed.startswith("error: interrupted") and printed.count("\n") == 1
    assert not out.exists() and not list(temporary.iterdir()), "nothing came of it"
    finished = run_jcr(*words)
    assert finished.returncode == 0 and len(json.loads(finished.stdout)["images"]) == 5, finished.stderr
    assert not list(out.glob(".*.part*"))


def test_arrays_larger_than_the_memory_are_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Zeros pack 1000 to 1: a small file may unpack to more than the machine has."""
    file = tmp_path / "reconstruction.npz"
    np.savez_compressed(file, about=np.array("{}"), image_index=np.zeros(1_000_000))
    assert file.stat().st_size < 20_000
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PHYS_PAGES": 1000, "SC_PAGE_SIZE": 4096}[name])
    with refused(r"reconstruction\.npz: unpacks to 0\.0 GB of 0\.0 GB here"):
        read_reconstruction(file)
