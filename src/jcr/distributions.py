"""Tails and quantiles of chi-squared and F, of scipy.special: scipy.stats takes as long to import as all else.

Names and results are those of scipy.stats.
"""

from typing import Any

import numpy as np
from numpy import ndarray
from scipy.special import betaln, chdtr, chdtrc, chdtri, fdtrc, gammaincinv

Number = float | int | np.number | ndarray


class chi2:  # noqa: N801
    """Sum of `freedom` squares of standard normal numbers: probabilities of x and quantiles, by x or share, freedom."""

    cdf = staticmethod(lambda x, freedom: chdtr(freedom, x))
    sf = staticmethod(lambda x, freedom: chdtrc(freedom, x))
    ppf = staticmethod(lambda share, freedom: 2 * gammaincinv(np.asarray(freedom) / 2, share))
    isf = staticmethod(lambda share, freedom: chdtri(freedom, share))


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
