"""Task that ends its process, where a spawned process can import it."""

import os

from jcr.pipeline.batch import BatchRow, Task


def dies_on_bad(task: Task) -> BatchRow:
    """End this process as the system ends one that is short of memory."""
    if task.capture.name == "bad":
        os._exit(9)
    return BatchRow(capture=str(task.capture), out=str(task.out), status="accepted", offset_std_mm=1.0)
