"""Decorators that compile loops over pixels with Numba, and a random number generator for them."""

from collections.abc import Callable
from typing import Any, no_type_check

import numpy as np
from jaxtyping import UInt64
from numba import njit
from numpy import ndarray

# The options do not allow the compiler to reorder sums: freshly compiled and cached loops, which are inlined
# differently, would give different results. On 12 images of 400x300, reordering saved no time.
_OPTIONS: dict[str, Any] = {"nogil": True, "fastmath": {"nnan", "ninf", "nsz"}, "error_model": "numpy"}


def compiled(function: Callable[..., Any]) -> Any:
    """Decorate a function to be compiled at its first call and cached on disk if the cache is writable.

    The function needs `@no_type_check`, because Numba cannot compile a wrapper that checks types.
    """
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither the folder of the source nor the user's cache is writable
        return njit(**_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """Decorate a function to be inlined into the compiled functions that call it, before Numba infers their types.

    Numba then compiles it only there, and counts no references of its arguments, which would take as long as the work
    for one pixel.
    """
    return njit(inline="always", **_OPTIONS)(function)


def random_state(seed: int) -> UInt64[ndarray, "1"]:
    """Return the initial state of the generator `uniform` for an integer `seed` from 0 on.

    The state does not depend on the thread or on the version of NumPy.
    """
    return np.array([88172645463325252 ^ (seed * 0x9E3779B97F4A7C15) % 2**64], np.uint64)


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
