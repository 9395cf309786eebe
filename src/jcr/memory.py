"""Main memory: how much of it the process holds, and giving back what it no longer uses.

A budget in GB is one of the peak resident set: what `ps` and `/usr/bin/time -v` show, the program itself included.
"""

import ctypes
import math
import os
import resource
import sys
from functools import cache
from pathlib import Path

from jcr.errors import InputError

GB = 1e9
ALLOWANCE = 150_000_000
"""Bytes beside what is estimated: what libraries take when they are first used, and freed blocks among others."""

ADDRESS_SPACE = 2_000_000_000
"""Bytes: of it a small calibration without torch uses 1.6 GB, most of it never touched."""
MORE_MEMORY = "use fewer or smaller images, end other programs, or raise its limit (ulimit -v)"
"""The remedy where memory ends."""
MAP = 300_000_000
"""Bytes of calibration, map and report beside the reconstruction."""
FOUND = 5_000_000
"""Bytes per image: features, matches and tracks in structure from motion and bundle adjustment."""


def require_address_space() -> None:
    """Raise InputError where a limit (ulimit -v) leaves less address space than the libraries take that we call.

    With less OpenBLAS ends the process, and libraries cannot be loaded, both without a reason.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise InputError(
            f"out of memory: this process may have {limit / GB:.1f} GB of address space (ulimit -v), and its libraries "
            f"need {ADDRESS_SPACE / GB:.0f} GB; raise the limit"
        )


def resident() -> int:
    """Bytes of the resident set now; where the system does not report that, at its peak."""
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
    """Print what work will take (bytes), before it starts; the same is not printed twice, of many captures in a row."""
    _write_once(
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


def plan(
    images: int, size: tuple[int, int], memory_gb: float, *, features: int = 0, result: int = 0, work: int = 0
) -> None:
    """Print what memory a stage over this many images of a size, and those after it, will take before it starts.

    All in bytes: `features` are what finding those of one image takes at least, `result` what stays of each image,
    `work` what an image takes while it is worked on. Raises InputError where the budget cannot be kept with one image
    at a time.
    """
    width, height = size
    program = resident() + ALLOWANCE
    pixels = 3 * width * height * images
    results = images * (result + FOUND)
    budget = memory_gb * GB
    least = program + pixels + max(features, results + max(work, MAP))
    require(least, budget, f"a run of {images} images of {width}x{height}, with the program itself,")
    at_once = min(os.cpu_count() or 1, images)
    # Freed blocks are given back only when half a budget is in use: with an ample one the stages' needs add up.
    ample = program + pixels + max(features * at_once, results + at_once * work + MAP)
    announce(min(ample, int(budget)), budget)


@cache
def _write_once(line: str) -> None:
    sys.stderr.write(line)


@cache
def _c_library() -> ctypes.CDLL | None:
    """The C library where it is glibc, the only one that has to be asked."""
    library = ctypes.CDLL(None)
    return library if hasattr(library, "malloc_trim") else None
