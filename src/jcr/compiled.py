"""Decorators that compile loops over pixels with Numba, and a random number generator for them."""

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
from numba import njit

# The options do not allow the compiler to reorder sums: freshly compiled and cached loops, which are inlined
# differently, would give different results. On 12 images of 400x300, reordering saved no time.
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"nnan", "ninf", "nsz"}, "error_model": "numpy"}
_PART: dict[str, Any] = _OPTIONS | {"forceinline": True, "_nrt": False}


def compiled(function: Callable[..., Any]) -> Any:
    """Decorate a function to be compiled at its first call and cached on disk if the cache is writable.

    The function needs `@no_type_check`, because Numba cannot compile a wrapper that checks types.
    """
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither the folder of the source nor the user's cache is writable
        return njit(**_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Decorate a function to be inlined into the compiled functions that call it; it must not allocate memory.

    Without allocations, Numba needs no reference counts of the arguments, which would take as long as the work for one
    pixel.
    """
    return njit(**_PART)(function)


@compiled
@no_type_check
def random_state(seed):
    """Return the initial state, an array of one uint64, of the generator `uniform` for an integer `seed`.

    The state does not depend on the thread or on the version of NumPy.
    """
    return np.array([np.uint64(88172645463325252) ^ (np.uint64(seed) * np.uint64(0x9E3779B97F4A7C15))])


@inlined
@no_type_check
def uniform(state):
    """Return a uniform random number in [0, 1) and update `state` (Marsaglia, "Xorshift RNGs", 2003).

    `state` is the array that `random_state` returned; each call changes it in place.
    """
    x = state[0]
    x ^= x << np.uint64(13)
    x ^= x >> np.uint64(7)
    x ^= x << np.uint64(17)
    state[0] = x
    return (x >> np.uint64(11)) * (1.0 / 9007199254740992.0)
