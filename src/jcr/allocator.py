"""Main memory of the process: return of freed blocks, and limits that are checked before an allocation."""

import ctypes
import os
import resource

from jcr.errors import InputError

GB = 1e9
ADDRESS_SPACE = 2_000_000_000
"""Bytes. A small calibration without torch uses 1.6 GB of address space, most of which is never touched."""
MORE_MEMORY = "use fewer or smaller images, end other programs, or raise its limit (ulimit -v)"
"""Remedy where the memory ends."""


def require_address_space() -> None:
    """Raise InputError where a limit (ulimit -v) leaves less address space than the libraries need.

    With less, OpenBLAS ends the process and libraries cannot be loaded, both without a reason.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise InputError(
            f"out of memory: this process may have {limit / GB:.1f} GB of address space (ulimit -v), and its libraries "
            f"need {ADDRESS_SPACE / GB:.0f} GB; raise the limit"
        )


def require_memory(size: int, claimant: str) -> None:
    """Raise InputError where `size` (bytes), which `claimant` states, exceeds the memory of the machine.

    Linux grants such allocations and ends the process when the pages are written.
    """
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > physical:
        raise InputError(
            f"{claimant}: unpacks to {size / GB:.1f} GB, this machine has {physical / GB:.1f} GB; use a smaller file"
        )


def give_back() -> None:
    """Return freed blocks to the system; glibc keeps hundreds of MB after work in threads."""
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)
