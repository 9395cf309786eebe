"""A task that takes its process with it, where a spawned process can import it."""

import os

from jcr.pipeline.batch import Row, Task


def dies_on_bad(task: Task) -> Row:
    """What a process short of memory does."""
    if task.capture.name == "bad":
        os._exit(9)
    return Row(capture=str(task.capture), out=str(task.out), status="accepted", offset_std_mm=1.0)
