"""Threads that torch does not fill with threads of its own."""

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager

import torch


@contextmanager
def threads_of_one_core(device: torch.device, count: int | None = None) -> Iterator[Executor]:
    """`count` threads, by default one for each core, in which torch works without threads of its own; one on a GPU.

    Torch's own wait for each other, spinning, after each of thousands of short operations: where another process takes
    one core, the training that should last a second lasted a minute.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor((count or threads) if device.type == "cpu" else 1) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)
