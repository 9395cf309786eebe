"""Ctrl-C at any moment: one line, status 130, nothing half-written, and the same command resumes."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

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
    command = [sys.executable, "-m", "jcr", "calibrate", str(small_capture), str(out), "--quiet", "--json"]
    environment = os.environ | {"TMPDIR": str(temporary)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        until(lambda: running.poll() is not None or MOMENTS[moment](running.pid, temporary))
        running.send_signal(signal.SIGINT)
        _, printed = running.communicate(timeout=60)
    # Python itself ends by the signal, which shells show as 130, where it was interrupted in what it compiled from
    # a string, as dataclasses are.
    assert running.returncode in (130, -signal.SIGINT), printed
    assert printed.startswith("error: interrupted") and printed.count("\n") == 1
    assert not out.exists() and not list(temporary.iterdir()), "nothing came of it"
    if moment == "while libraries load":  # nothing is there that could be resumed
        return
    finished = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert finished.returncode in (0, 3), finished.stderr
    assert len(json.loads(finished.stdout)["images"]) == 5
