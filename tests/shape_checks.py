"""Shapes and types are checked in the first calls that a test makes of a function, and not in all.

A test that draws hundreds of problems spent more than half of its time on finding the same shapes right again.
"""

import sys
from collections import Counter
from collections.abc import Callable
from types import FunctionType
from typing import Any

CALLS = 4
"""Checked calls of one function in one test."""

_checks: Counter[tuple[str, str]] = Counter()
_resting: list[FunctionType] = []


def begin() -> None:
    """Check every function again: a test begins."""
    _checks.clear()
    while _resting:
        del _resting.pop().__no_type_check__  # type: ignore[attr-defined]


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Check arguments or a result for jaxtyping by beartype, until `CALLS` calls were right.

    Beartype writes a checker when a function is first called: of all that are imported a test calls a few.
    """
    name = function.__module__, function.__qualname__
    if "<locals>" in function.__qualname__:  # defined again in each call of what is around it
        _checks[name] += 1
        if _checks[name] > CALLS:
            return function
    checker: Callable[..., Any] | None = None

    def counted(*arguments: Any, **named: Any) -> Any:
        nonlocal checker
        if checker is None:
            from beartype import beartype

            checker = beartype(function)
        _checks[name] += 1
        if _checks[name] == 2 * CALLS:  # arguments and result
            _rest(*name)
        return checker(*arguments, **named)

    return counted


def _rest(module: str, qualname: str) -> None:
    """Have jaxtyping's wrapper pass calls on, which it does where the function says `__no_type_check__`."""
    found: Any = sys.modules.get(module)
    for part in qualname.split("."):
        found = vars(found).get(part) if hasattr(found, "__dict__") else None
    if isinstance(found, staticmethod | classmethod):
        found = found.__func__
    if isinstance(found, property):
        found = found.fget
    if isinstance(found, FunctionType) and hasattr(found, "__wrapped__"):
        found.__no_type_check__ = True  # type: ignore[attr-defined]
        _resting.append(found)
