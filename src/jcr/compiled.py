"""Numba's compiler as the loops over pixels use it."""

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
from numba import njit

# Sums keep their order. Where the compiler may change it, a loop gives other bits fresh than from the cache, for it is
# inlined otherwise; on 12 images of 400x300 that freedom saved no time.
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"nnan", "ninf", "nsz"}, "error_model": "numpy"}
_PART: dict[str, Any] = _OPTIONS | {"forceinline": True, "_nrt": False}


def compiled(function: Callable[..., Any]) -> Any:
    """Compile the function when it is first called, and keep it on disk where that can be written.

    Such functions carry no shapes to check and say `@no_type_check`: a checker around them could not be compiled.
    """
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither beside the source nor in the user's cache
        return njit(**_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Compile a function that is inlined where compiled functions call it; it must allocate nothing.

    Then the arrays that it is given need not be counted, which takes as long as the window of a pixel, and longer where
    two threads count one array.
    """
    return njit(**_PART)(function)


@compiled
@no_type_check
def random_state(seed):
    """State of `uniform`, the same for a seed in every thread and version."""
    return np.array([np.uint64(88172645463325252) ^ (np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15))])


@inlined
@no_type_check
def uniform(state):
    """Return a number from 0 to 1 (Marsaglia, "Xorshift RNGs", 2003)."""
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return (x >> np.uint64(11)) * (1.0 / 9007199254740992.0)
