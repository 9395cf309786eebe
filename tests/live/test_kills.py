"""A capture that is calibrated while it is taken, killed at any moment: nothing is lost, and the end is the same."""

import itertools
import json
import multiprocessing
import os
import random
import sys
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import numpy as np
import pytest

import jcr
from jcr.capture.images import read_image
from jcr.live.calibration import LiveCalibration
from jcr.live.folder import LiveFolder

pytestmark = pytest.mark.long

KILLS = int(os.environ.get("JCR_TEST_KILLS", "2"))
IMAGES = 5
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(
    ["jcr.pipeline.run", "jcr.live.calibration", "jcr.sfm.live_map", "jcr.report.html"]
)


def take(tabletop: Path, folder: Path) -> None:
    """Take what is missing of a capture, and calibrate all of it."""
    capture = jcr.read_capture(tabletop)
    live = LiveCalibration(folder, intrinsics=capture.intrinsics)
    live.update()
    for row in range(len(live.live.names), IMAGES):
        live.add(
            read_image(tabletop / capture.images[row]), capture.base_from_gripper[row], time_s=float(row)
        )
        (folder / f"kept-{row}").touch()
    live.finish()
    live.close()


def ended(tabletop: Path, folder: Path, most_s: float = np.inf) -> tuple[int | None, float]:
    """The exit code of a process that takes the capture, and its processor time; killed when it has taken `most_s`."""
    process = PROCESSES.Process(target=take, args=(tabletop, folder))
    process.start()
    taken_s = 0.0
    while process.is_alive() and taken_s < most_s:
        time.sleep(0.005)
        taken_s = max(taken_s, cpu_s(process))
    process.kill()
    process.join(300)
    return process.exitcode, taken_s


def cpu_s(process: BaseProcess) -> float:
    """Processor time that a process has taken: how far it is does not depend on what else runs."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def result(folder: Path) -> np.ndarray:
    content = json.loads((folder / "result" / "calibration.json").read_text())
    return np.append(content["gripper_from_camera"], content["uncertainty"]["covariance"])


def test_a_killed_capture_loses_nothing_and_ends_at_the_same_numbers(
    tabletop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """JCR_TEST_KILLS=30 for thirty; their moments are spread over the whole capture, a random one in each part."""
    code, whole_s = ended(tabletop, tmp_path / "undisturbed")
    assert code == 0
    expected = result(tmp_path / "undisturbed")
    draw, folders, left = random.Random(0), (tmp_path / f"{k}" for k in itertools.count()), []
    while len(left) < KILLS:
        folder = next(folders)
        code, taken_s = ended(tabletop, folder, whole_s * (len(left) + draw.random()) / KILLS)
        if code == 0:
            whole_s = taken_s  # Shorter than the first, which may have compiled.
            continue
        assert code == -9
        # Every image whose calibration stood is there, and all that capture.json names can be read.
        names = LiveFolder(folder).names
        assert names == [f"images/00{row}.png" for row in range(len(names))]
        assert not any((folder / f"kept-{row}").exists() for row in range(len(names), IMAGES))
        left.append(len(names))
        assert ended(tabletop, folder)[0] == 0
        # From the same images, to the rounding of sums.
        assert np.allclose(result(folder), expected, rtol=1e-6, atol=1e-12)
    if KILLS > 10:
        with capsys.disabled():
            sys.stdout.write(f"the images at each kill: {left}; all ended at the same numbers\n")
