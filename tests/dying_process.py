"""Tasks of a batch that end their process or copy a run, where a spawned process can import them."""

import json
import os
import shutil
from pathlib import Path

from jcr.capture.options import ReadOptions
from jcr.pipeline.batch import BatchRow
from jcr.result import RunOptions


def dies_on_bad(capture: Path, out: Path, options: RunOptions, read: ReadOptions) -> BatchRow:
    """End this process as the system ends one that is short of memory."""
    if capture.name == "bad":
        os._exit(9)
    return BatchRow(capture=str(capture), out=str(out), status="accepted", point_95_mm=1.0)


def copies_a_run(capture: Path, out: Path, options: RunOptions, read: ReadOptions) -> BatchRow:
    """Copy the run folder that the capture names; in the last of three episodes the camera is moved by 20 mm."""
    shutil.copytree(capture, out)
    file = out / "calibration.json"
    content = json.loads(file.read_text())
    content["gripper_from_camera"][0][3] += 0.02 * (read.episode == (2,))
    file.write_text(json.dumps(content))
    return BatchRow(capture=str(capture), out=str(out), status="accepted")
