"""A run that is killed at any moment leaves whole files, and the same command ends as if nothing had happened."""

import json
import multiprocessing
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from jcr.calibration.record import read_calibration
from jcr.cli import main
from jcr.records.reconstruction_npz import read_reconstruction
from jcr.result import RunResult
from jcr.scene.cloud import read_cloud
from jcr.scene.map_file import load_map

pytestmark = pytest.mark.long

KILLS = int(os.environ.get("JCR_TEST_KILLS", "2"))
WRITES = 10
"""Times that a run writes a file."""
PROCESSES = multiprocessing.get_context("forkserver")
# What a run imports is imported once: what is killed before it works has done nothing.
PROCESSES.set_forkserver_preload(
    ["jcr.cli.run_calibrate_batch", "jcr.pipeline.run", "jcr.sfm.colmap", "jcr.report.html"]
)


def is_locked(path: Path) -> bool:
    """Whether a process has the lock of a file; to try it would be to have it for a moment."""
    return path.exists() and f":{path.stat().st_ino} " in Path("/proc/locks").read_text()


class Run:
    """`jcr run` of a capture in a process of its own."""

    def __init__(self, capture: Path, out: Path) -> None:
        self.capture, self.out = capture, out
        self.process = PROCESSES.Process(target=main, args=(["run", str(capture), str(out), "--quiet"],))
        self.process.start()

    def finish(self) -> None:
        self.process.join(300)
        assert self.process.exitcode in (0, 3)

    def wait_for_lock(self) -> None:
        while self.process.is_alive() and not is_locked(self.out / ".lock"):
            time.sleep(0.01)

    def kill_after(self, seconds: float) -> bool:
        """Kill it after this many seconds of work; False where it was done before."""
        self.wait_for_lock()
        self.process.join(seconds)
        return self._kill()

    def kill_while_writing(self, number: int) -> bool:
        """Kill it while it writes its file of that number; False where it was done before."""
        seen: set[str] = set()
        while self.process.is_alive() and len(seen) < number:
            if self.out.is_dir():
                seen |= {name for name in os.listdir(self.out) if ".part" in name}
            time.sleep(2e-4)
        return self._kill()

    def _kill(self) -> bool:
        self.process.kill()
        self.process.join()
        assert self.process.exitcode in (0, 3, -signal.SIGKILL)
        return self.process.exitcode == -signal.SIGKILL


READERS = {
    "calibration.json": read_calibration,
    "uncertainty.npz": lambda path: [np.load(path)[name] for name in np.load(path).files],
    "reconstruction.npz": read_reconstruction,
    "depth.npz": lambda path: RunResult(path.parent).reconstruction, "cloud.ply": read_cloud,
    "map.safetensors": load_map, "run.json": lambda path: json.loads(path.read_text()),
    "report.html": lambda path: path.read_text().rindex("</html>"),
    "log.txt": lambda path: path.read_text().rindex("\n"),
}  # fmt: skip


def check_whole(out: Path) -> None:
    """Every file of a run folder is what it should be, or is not there; what was begun is beside it."""
    for path in out.iterdir():
        if path.name in READERS:
            READERS[path.name](path)
        else:
            assert path.name == ".lock" or ".part" in path.name, path


def results(out: Path) -> dict[str, object]:
    """All that a run found, without the time it took."""
    reconstruction = {}
    for file in ("reconstruction.npz", "depth.npz"):
        with np.load(out / file) as arrays:
            reconstruction |= {f"{file}: {name}": arrays[name].tobytes() for name in arrays.files}
    calibration = json.loads((out / "calibration.json").read_text())
    del calibration["timings_s"]
    for attempt in calibration["attempts"]:
        del attempt["reconstruct_s"], attempt["calibrate_s"]
    return {
        "calibration": calibration,
        "reconstruction": reconstruction,
        "map": {name: array.tobytes() for name, array in load_file(out / "map.safetensors").items()},
        "cloud": (out / "cloud.ply").read_bytes(),
        "log": [line for line in (out / "log.txt").read_text().splitlines() if not line.endswith(" s")],
        "files": sorted(path.name for path in out.iterdir()),
    }


def test_a_killed_run_leaves_whole_files_and_resumes_to_the_same(small_capture, small_done, tmp_path, capsys):
    """JCR_TEST_KILLS=100 for a hundred; half at a random moment, half while a random file is written."""
    draw = random.Random(0)
    expected = results(small_done)
    timings = json.loads((small_done / "calibration.json").read_text())["timings_s"]
    killed = finished = writing = 0
    out = tmp_path / "out0"
    while killed < KILLS:
        run = Run(small_capture, out)
        while_writing = draw.random() < 0.5
        if while_writing:
            died = run.kill_while_writing(draw.randint(1, WRITES))
        else:
            died = run.kill_after(draw.uniform(0, sum(timings.values())))
        if not died:
            assert results(out) == expected
            finished, out = finished + 1, tmp_path / f"out{finished + 1}"
        elif out.is_dir():
            killed += 1
            writing += any(".part" in path.name for path in out.iterdir())
            check_whole(out)
    Run(small_capture, out).finish()
    assert results(out) == expected
    with capsys.disabled():
        if KILLS > 10:
            sys.stdout.write(
                f"{killed} kills, {writing} of them while a file was written, {finished + 1} ends\n"
            )
