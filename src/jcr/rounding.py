"""Numbers as people read them."""

import numpy as np


def significant(value: float, digits: int = 2) -> str:
    """The number with this many significant digits, never in powers of ten; at most six decimals."""
    if not np.isfinite(value):
        return "unknown"
    if abs(value) < 0.5e-6:
        return "0"
    decimals = digits - 1 - int(np.floor(np.log10(abs(value))))
    return f"{value:.{min(max(decimals, 0), 6)}f}"
