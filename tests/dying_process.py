"""Tasks of a batch that end their process or copy a run, where a spawned process can import them."""

import json
import os
import shutil

from jcr.pipeline.batch import BatchRow, Task


def dies_on_bad(task: Task) -> BatchRow:
    """End this process as the system ends one that is short of memory."""
    if task.capture.name == "bad":
        os._exit(9)
    return BatchRow(capture=str(task.capture), out=str(task.out), status="accepted", offset_std_mm=1.0)


def copies_a_run(task: Task) -> BatchRow:
    """Copy the run folder that the capture names; in the last of three episodes the camera is moved by 20 mm."""
    shutil.copytree(task.capture, task.out)
    file = task.out / "calibration.json"
    content = json.loads(file.read_text())
    content["gripper_from_camera"][0][3] += 0.02 * (task.read.episode == (2,))
    file.write_text(json.dumps(content))
    return BatchRow(capture=str(task.capture), out=str(task.out), status="accepted")
