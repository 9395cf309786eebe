"""Main memory of the process: checks of the available memory, and return of freed memory to the system."""

import ctypes
import os
import resource

from jcr.errors import InputError

GB = 1e9
ADDRESS_SPACE = 2_000_000_000
"""Smallest limit of the address space (bytes); a small calibration without torch uses 1.6 GB, most of it unused."""
MORE_MEMORY = "use fewer or smaller images, end other programs, or raise its limit (ulimit -v)"
"""Remedy in messages about a lack of memory."""


def require_address_space() -> None:
    """Raise InputError if the limit of the address space (ulimit -v) is below 2 GB.

    Below it, OpenBLAS ends the process, or libraries fail to load, without a clear message.
    """
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise InputError(
            f"out of memory: this process may have {limit / GB:.1f} GB of address space (ulimit -v), and its libraries "
            f"need {ADDRESS_SPACE / GB:.0f} GB; raise the limit"
        )


def require_memory(size: int, claimant: str) -> None:
    """Raise InputError if `size`, the bytes that the file `claimant` needs, exceeds the memory of the machine.

    Linux allows such an allocation and ends the process when the memory is written.
    """
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if size > physical:
        raise InputError(
            f"{claimant}: unpacks to {size / GB:.1f} GB of {physical / GB:.1f} GB here; use a smaller file"
        )


def give_back() -> None:
    """Return freed memory to the system; glibc keeps hundreds of MB after multithreaded work."""
    library = ctypes.CDLL(None)
    if hasattr(library, "malloc_trim"):
        library.malloc_trim(0)
