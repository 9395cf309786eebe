"""Where and how a run is started: no HOME, locale C, umask, odd paths, closed or full outputs, a signal."""

import json
import os
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from capture_writers import write_easy_handeye2
from in_process import run_jcr
from jcr.calibration.record import read_calibration
from jcr.errors import InputError
from jcr.geometry import scale_translation
from jcr.records.npz import read_reconstruction
from jcr.result import RunResult
from simulation.problems import hand_eye_problem
from waiting import until

pytestmark = pytest.mark.slow

RESULTS = ("calibration.json", "log.txt")
ODD = "a b'c\"d $HOME `x` *;&|<é>"


@dataclass(frozen=True)
class Surroundings:
    """What is unusual, and how the command must end."""

    status: int = 0
    said: str = ""
    shell: str = '"$@"'
    """How it is started."""
    without: tuple[str, ...] = ()
    environment: dict[str, str] = field(default_factory=dict)
    folder: str = "place"
    check: Callable[[Path], bool] = lambda out: True


def private(out: Path) -> bool:
    return all(stat.S_IMODE((out / name).stat().st_mode) == 0o600 for name in RESULTS)


CASES = {
    "no HOME in locale C": Surroundings(
        without=("HOME", "XDG_CACHE_HOME", "USER", "LOGNAME"),
        environment={"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"},
    ),
    "paths with spaces and quotes, umask 077 and closed stdin": Surroundings(
        shell='umask 077; "$@" <&-', folder=ODD, check=private
    ),
    "closed stdout": Surroundings(shell='"$@" >&-'),
    "closed stderr": Surroundings(shell='"$@" 2>&-'),
    "full stdout": Surroundings(2, "No space left", shell='"$@" >/dev/full'),
    "output that nobody may write": Surroundings(2, "cannot be written", folder="/proc/1/jcr"),
}


@pytest.mark.parametrize("name", CASES)
def test_a_command_ends_as_it_should_wherever_it_is_started(name: str, tmp_path: Path):
    case = CASES[name]
    problem = hand_eye_problem(np.random.default_rng(0), 10, robot_noise=(3e-4, 1e-3))
    samples = write_easy_handeye2(
        tmp_path / ODD, problem.base_from_gripper, scale_translation(problem.recon_from_camera, problem.scale)
    )
    out = tmp_path / case.folder / "out"
    environment = {key: value for key, value in os.environ.items() if key not in case.without}
    command = [sys.executable, "-m", "jcr", "calibrate", str(samples), str(out)]
    finished = subprocess.run(
        ["sh", "-c", case.shell, "sh", *command],
        env=environment | case.environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=200,
    )
    assert finished.returncode == case.status, finished.stderr
    assert "Traceback" not in finished.stderr and case.said in finished.stderr
    if case.folder.startswith("/"):
        return
    # What was found is kept, whatever became of the words about it.
    assert read_calibration(out).converged and all((out / name).is_file() for name in RESULTS)
    assert case.check(out) and not list(out.glob("*.part*"))


MOMENTS: dict[str, Callable[[int, Path], bool]] = {
    "while libraries load": lambda process, _: "pycolmap" in Path(f"/proc/{process}/maps").read_text(),
    "while COLMAP works": lambda _, temporary: any(temporary.glob("jcr-colmap-*/*")),
}
"""Whether it has come: of the process's number and the folder of its temporary files. Both are after the lock."""


@pytest.mark.parametrize(
    ("moment", "number"), [*((moment, signal.SIGINT) for moment in MOMENTS), ([*MOMENTS][1], signal.SIGTERM)]
)
def test_a_run_that_is_asked_to_end_leaves_nothing_half_written_and_goes_on(
    moment: str, number: signal.Signals, small_capture: Path, tmp_path: Path
):
    out, temporary = tmp_path / "out", tmp_path / "temporary"
    temporary.mkdir()
    words = ["calibrate", str(small_capture), str(out), "--no-dense", "--quiet", "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "jcr", *words],
        env=os.environ | {"TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        until(lambda: running.poll() is not None or MOMENTS[moment](running.pid, temporary))
        running.send_signal(number)
        _, printed = running.communicate(timeout=60)
    # Python itself ends by the signal, which shells show as 130, where it was interrupted in what it compiled from
    # a string, as dataclasses are.
    assert running.returncode in (-number, 128 + number, 130) and "Traceback" not in printed
    if number is signal.SIGINT:
        assert printed.startswith("error: interrupted") and printed.count("\n") == 1
        assert not out.exists() and not list(temporary.iterdir()), "nothing came of it"
    if moment == "while COLMAP works":
        finished = run_jcr(*words)
        assert finished.returncode == 0 and len(json.loads(finished.stdout)["images"]) == 5, finished.stderr
        assert not list(out.glob(".*.part*"))


@pytest.mark.long
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be bound to cores here")
def test_two_threads_on_one_core_find_what_one_thread_finds_on_all_of_them(
    small_capture: Path, small_done: Path, tmp_path: Path
):
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    core = {min(os.sched_getaffinity(0))}
    subprocess.run(
        [sys.executable, "-m", "jcr", "calibrate", str(small_capture), str(tmp_path), "--quiet"],
        env=os.environ | dict.fromkeys(names, "2"),
        preexec_fn=lambda: os.sched_setaffinity(0, core),
        timeout=300,
    )
    one, two = (RunResult(out).calibration for out in (small_done, tmp_path))
    assert [image.used for image in one.images] == [image.used for image in two.images]
    for name in ("gripper_from_camera", "scale"):
        assert np.allclose(getattr(one, name), getattr(two, name), rtol=0, atol=1e-6), name
    assert np.allclose(one.covariance, two.covariance, rtol=1e-6, atol=1e-12)


def test_too_little_address_space_is_one_line(tmp_path: Path):
    finished = subprocess.run(
        ["sh", "-c", 'ulimit -v 1200000; "$@"', "sh", sys.executable, "-m", "jcr", "check", str(tmp_path)],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert finished.returncode == 2 and finished.stderr.count("\n") == 1
    assert finished.stderr.startswith("error: out of memory: ") and "ulimit -v" in finished.stderr


def test_arrays_larger_than_the_memory_are_refused_unread(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Zeros pack 1000 to 1: a small file may unpack to more than the machine has."""
    file = tmp_path / "reconstruction.npz"
    np.savez_compressed(file, about=np.array("{}"), image_index=np.zeros(1_000_000))
    assert file.stat().st_size < 20_000
    monkeypatch.setattr(os, "sysconf", lambda name: {"SC_PHYS_PAGES": 1000, "SC_PAGE_SIZE": 4096}[name])
    with pytest.raises(
        InputError, match=r"reconstruction\.npz: unpacks to 0\.0 GB, this machine has 0\.0 GB"
    ):
        read_reconstruction(file)
