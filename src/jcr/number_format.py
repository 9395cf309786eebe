"""Formatting of numbers and labelled lines for reports and the terminal."""

import numpy as np

HUGE = 1e15
"""Largest accepted number; sums of squares of smaller ones cannot overflow."""
MOST_DECIMALS = 9
"""Largest number of decimals of a number with a standard deviation."""

INDENT = 12
"""Number of characters before the text of a labelled line."""


def decimals_of(std: float) -> int:
    """Return the number of decimals for a value with this standard deviation; the last place is worth std/10 to std.

    There are at most nine decimals, nine for std 0, and none for a std that is negative, infinite or NaN.
    """
    if not np.isfinite(std) or std <= 0:
        return MOST_DECIMALS if std == 0 else 0
    return int(np.clip(np.floor(1 - np.log10(std)), 0, MOST_DECIMALS))


def significant(value: float, digits: int = 2) -> str:
    """Return the number as text with `digits` significant digits and at most six decimals, without an exponent.

    NaN and infinity give "unknown".
    """
    if not np.isfinite(value):
        return "unknown"
    if abs(value) < 0.5e-6:
        return "0"
    decimals = digits - 1 - int(np.floor(np.log10(abs(value))))
    return f"{value:.{min(max(decimals, 0), 6)}f}"


def labelled(label: str, *lines: str) -> list[str]:
    """Return the lines indented by INDENT characters, with `label` at the start of the first."""
    return [f"{label if k == 0 else '':<{INDENT}}{line}" for k, line in enumerate(lines)]
