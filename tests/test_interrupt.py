"""One answer whatever the number of threads, and Ctrl-C at any moment: one line, nothing half-written, a run resumes."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from in_process import run_jcr
from jcr.result import RunResult
from waiting import until

pytestmark = pytest.mark.slow

MOMENTS: dict[str, Callable[[int, Path], bool]] = {
    "while libraries load": lambda process, _: "pycolmap" in Path(f"/proc/{process}/maps").read_text(),
    "while COLMAP works": lambda _, temporary: any(temporary.glob("jcr-colmap-*/*")),
}
"""Whether it has come: of the process's number and the folder of its temporary files. Both are after the lock."""


@pytest.mark.parametrize("moment", MOMENTS)
def test_an_interrupted_run_reports_it_in_one_line_and_resumes(
    moment: str, small_capture: Path, tmp_path: Path
):
    out, temporary = tmp_path / "out", tmp_path / "temporary"
    temporary.mkdir()
    words = ["calibrate", str(small_capture), str(out), "--quiet", "--json"]
    with subprocess.Popen(
        [sys.executable, "-m", "jcr", *words],
        env=os.environ | {"TMPDIR": str(temporary)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as running:
        until(lambda: running.poll() is not None or MOMENTS[moment](running.pid, temporary))
        running.send_signal(signal.SIGINT)
        _, printed = running.communicate(timeout=60)
    # Python itself ends by the signal, which shells show as 130, where it was interrupted in what it compiled from
    # a string, as dataclasses are.
    assert running.returncode in (130, -signal.SIGINT), printed
    assert printed.startswith("error: interrupted") and printed.count("\n") == 1
    assert not out.exists() and not list(temporary.iterdir()), "nothing came of it"
    if moment == "while COLMAP works":
        finished = run_jcr(*words)
        assert finished.returncode in (0, 3), finished.stderr
        assert len(json.loads(finished.stdout)["images"]) == 5


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
