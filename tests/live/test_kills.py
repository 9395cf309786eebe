"""A capture that is calibrated while it is taken, killed at any moment: nothing is lost, and the end is the same."""

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
from jcr.run_folder import LIVE

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("JCR_TEST_KILLS", "2"))
IMAGES = 6
LONGEST_S = 4.0
"""Processor time of a process before it is killed, at most."""
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(
    ["jcr.pipeline", "jcr.live.calibration", "jcr.reconstruct.growing", "jcr.report.html"]
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


def started(tabletop: Path, folder: Path) -> BaseProcess:
    process = PROCESSES.Process(target=take, args=(tabletop, folder))
    process.start()
    return process


def cpu_s(process: BaseProcess) -> float:
    """Processor time that a process has taken: how far it is does not depend on what else runs."""
    try:
        fields = Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return np.inf
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def result(folder: Path) -> np.ndarray:
    content = json.loads((folder / LIVE / "calibration.json").read_text())
    return np.append(content["gripper_from_camera"], content["uncertainty"]["covariance"])


def test_a_killed_capture_loses_nothing_and_ends_at_the_same_numbers(
    tabletop: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """JCR_TEST_KILLS=30 for thirty."""
    undisturbed = started(tabletop, tmp_path / "undisturbed")
    undisturbed.join(300)
    expected = result(tmp_path / "undisturbed")
    draw, killed, ends, left = random.Random(0), 0, 0, []
    folder = tmp_path / "0"
    while killed < KILLS or ends == 0:
        process, most = started(tabletop, folder), draw.uniform(0, LONGEST_S) if killed < KILLS else np.inf
        while process.is_alive() and cpu_s(process) < most:
            time.sleep(0.005)
        process.kill()
        process.join(300)
        if process.exitcode == 0:
            # From the same images, to the rounding of sums.
            assert np.allclose(result(folder), expected, rtol=1e-6, atol=1e-12)
            ends, folder = ends + 1, tmp_path / f"{ends + 1}"
            continue
        assert process.exitcode == -9
        killed += 1
        # Every image whose calibration stood is there, and all that capture.json names can be read.
        names = LiveFolder(folder).names
        assert names == [f"images/00{row}.png" for row in range(len(names))]
        assert not any((folder / f"kept-{row}").exists() for row in range(len(names), IMAGES))
        left.append(len(names))
    if KILLS > 10:
        with capsys.disabled():
            sys.stdout.write(f"{killed} kills, {ends} ends at the same numbers; images then: {left}\n")
