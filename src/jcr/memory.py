"""Main memory: how much of it the process holds, and giving back what it no longer uses.

A budget in GB is one of the peak resident set: what `ps` and `/usr/bin/time -v` show, the program itself included.
"""

import ctypes
import math
import resource
import sys
from functools import cache
from pathlib import Path

from jcr.errors import InputError

GB = 1e9
ALLOWANCE = 150_000_000
"""Bytes beside what is estimated: what libraries take when they are first used, and freed blocks among others."""

MAP = 300_000_000
"""Bytes of calibration, map and report beside the reconstruction."""


def resident() -> int:
    """Bytes of the resident set now; where the system does not tell, at its peak."""
    try:
        pages = int(Path("/proc/self/statm").read_text("utf-8").split()[1])
    except OSError:
        unit = 1 if sys.platform == "darwin" else 1024
        return unit * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return pages * resource.getpagesize()


def give_back() -> None:
    """Return freed blocks to the system, which the C library keeps by the hundred MB after work in threads."""
    if (library := _c_library()) is not None:
        library.malloc_trim(0)


def relieve(budget: float) -> None:
    """Give back as soon as half a budget (bytes) is in use; before that it is not worth the time."""
    if resident() > budget / 2:
        give_back()


def announce(needed: int, budget: float, beside: str = "") -> None:
    """Say what work will take (bytes), before it starts; the same is not said twice, of many captures in a row."""
    _say(
        f"memory: about {needed / GB:.2g} GB, the program included{beside}; the budget is {budget / GB:.2g} GB\n"
    )


def require(needed: int, budget: float, what: str) -> None:
    """Raise InputError where `what` needs more bytes than the budget."""
    if not needed <= budget:  # not a number, too
        least = math.ceil(10 * needed / GB) / 10
        raise InputError(
            f"--memory-gb {budget / GB:.2g}: {what} needs {needed / GB:.2g} GB; raise --memory-gb to {least:g}, or "
            "use smaller images"
        )


@cache
def _say(line: str) -> None:
    sys.stderr.write(line)


@cache
def _c_library() -> ctypes.CDLL | None:
    """The C library where it is glibc, the only one that has to be asked."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") else None
