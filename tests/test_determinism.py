"""One capture, one seed, one machine: one answer, whatever the number of threads."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

pytestmark = pytest.mark.slow


def calibration(capture: Path, out: Path, threads: int) -> dict:
    """What `jcr calibrate` finds with this many threads on this many cores."""
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    cores = set(sorted(os.sched_getaffinity(0))[:threads])
    command = [sys.executable, "-m", "jcr", "calibrate", str(capture), str(out), "--quiet"]
    finished = subprocess.run(
        command,
        env=os.environ | dict.fromkeys(names, str(threads)),
        preexec_fn=lambda: os.sched_setaffinity(0, cores),
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert finished.returncode in (0, 3), finished.stderr
    return json.loads((out / "calibration.json").read_text())


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="this machine has one core")
def test_one_thread_and_two_give_the_same(small_capture: Path, tmp_path: Path):
    one = calibration(small_capture, tmp_path / "one", 1)
    two = calibration(small_capture, tmp_path / "two", 2)
    assert [image["used"] for image in one["images"]] == [image["used"] for image in two["images"]]
    for name in ("gripper_from_camera", "scale", "base_from_recon"):
        assert np.allclose(one[name], two[name], rtol=0, atol=1e-6), name
    assert np.allclose(
        one["uncertainty"]["covariance"], two["uncertainty"]["covariance"], rtol=1e-6, atol=1e-12
    )
