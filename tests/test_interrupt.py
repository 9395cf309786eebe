"""Ctrl-C at any moment: one line, status 130, nothing half-written, and the same command resumes."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow


def test_an_interrupted_run_says_so_in_one_line_and_resumes(small_capture: Path, tmp_path: Path):
    command = [
        sys.executable,
        "-m",
        "jcr",
        "calibrate",
        str(small_capture),
        str(tmp_path / "out"),
        "--quiet",
        "--json",
    ]
    for seconds in (
        0.1,
        0.5,
    ):  # after the folder is there: while it imports, and while COLMAP works; all takes 1.5
        running = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 60
        while not (tmp_path / "out" / ".lock").exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        time.sleep(seconds)
        running.send_signal(signal.SIGINT)
        _, told = running.communicate(timeout=60)
        # Python itself ends by the signal, which shells show as 130, where it was interrupted in what it compiled from
        # a string, as dataclasses are.
        assert running.returncode in (130, -signal.SIGINT), told
        assert told.startswith("error: interrupted") and told.count("\n") == 1
        assert not list((tmp_path / "out").glob("*.part*"))
        assert not (tmp_path / "out").exists(), "nothing came of it"
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert finished.returncode in (0, 3), finished.stderr
    assert len(json.loads(finished.stdout)["images"]) == 5
