"""Numba's compiler as the loops over pixels use it."""

from collections.abc import Callable
from typing import Any

from numba import njit

_OPTIONS = {"nogil": True, "fastmath": True, "error_model": "numpy"}


def compiled(function: Callable[..., Any]) -> Any:
    """The function compiled when it is first called, and kept on disk where that can be written.

    Such functions carry no shapes to check and say `@no_type_check`: a checker around them could not be compiled.
    """
    try:
        return njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # neither beside the source nor in the user's cache
        return njit(**_OPTIONS)(function)
