"""Numbers and labelled lines for people."""

import numpy as np

MOST_DECIMALS = 9


def decimals_of(std: float) -> int:
    """Return the decimals of a number with this standard deviation: none is below a tenth of it."""
    if not np.isfinite(std) or std <= 0:
        return MOST_DECIMALS if std == 0 else 0
    return int(np.clip(np.floor(1 - np.log10(std)), 0, MOST_DECIMALS))


def with_std(value: float, std: float) -> str:
    """Return the number and its standard deviation with the decimals that these leave: 25.40 ± 0.05."""
    decimals = decimals_of(std)
    return f"{value:.{decimals}f} ± {std:.{decimals}f}"


def significant(value: float, digits: int = 2) -> str:
    """Return the number with this many significant digits, never in powers of ten; at most six decimals."""
    if not np.isfinite(value):
        return "unknown"
    if abs(value) < 0.5e-6:
        return "0"
    decimals = digits - 1 - int(np.floor(np.log10(abs(value))))
    return f"{value:.{min(max(decimals, 0), 6)}f}"


def labelled(label: str, *lines: str) -> list[str]:
    """Return lines behind a label in a column of 12 characters."""
    return [f"{label if k == 0 else '':<12}{line}" for k, line in enumerate(lines)]
