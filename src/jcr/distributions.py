"""Tails and quantiles of chi-squared and F, of scipy.special: scipy.stats takes as long to import as all else.

Names and results are those of scipy.stats.
"""

from typing import Any

import numpy as np
from numpy import ndarray
from scipy.special import betaln, chdtr, chdtrc, chdtri, fdtrc, gammaincinv

Number = float | int | np.number | ndarray


class chi2:  # noqa: N801
    """Sum of `freedom` squares of standard normal numbers."""

    @staticmethod
    def cdf(x: Number, freedom: Number) -> Any:
        """Probability of at most x."""
        return chdtr(freedom, x)

    @staticmethod
    def sf(x: Number, freedom: Number) -> Any:
        """Probability of more than x."""
        return chdtrc(freedom, x)

    @staticmethod
    def ppf(share: Number, freedom: Number) -> Any:
        """Return the value that is exceeded with a probability of 1 - share."""
        return 2 * gammaincinv(np.asarray(freedom) / 2, share)

    @staticmethod
    def isf(share: Number, freedom: Number) -> Any:
        """Return the value that is exceeded with a probability of share."""
        return chdtri(freedom, share)


class f:  # noqa: N801
    """Ratio of two mean squares."""

    @staticmethod
    def logsf(x: Number, over: Number, under: Number) -> Any:
        """Return the logarithm of the probability of more than x, finite where the probability itself underflows.

        There it is the leading term of the incomplete beta function at a small argument (DLMF 8.17.7).
        """
        tail, half = np.asarray(fdtrc(over, under, x)), np.asarray(under) / 2
        share = np.maximum(under / (under + np.asarray(over) * np.asarray(x, float)), 1e-300)
        leading = half * np.log(share) - np.log(half) - betaln(half, np.asarray(over) / 2)
        return np.where(tail > 1e-290, np.log(np.maximum(tail, 1e-300)), leading)[()]
