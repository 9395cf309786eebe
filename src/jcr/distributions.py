"""Tail probabilities and quantiles of the chi-squared and F distributions, computed with scipy.special.

Names and results are those of scipy.stats, whose import takes as long as all other imports together.
"""

from typing import Any

import numpy as np
from numpy import ndarray
from scipy.special import betaln, chdtr, chdtrc, chdtri, fdtrc, gammaincinv

Number = float | int | np.number | ndarray


class chi2:  # noqa: N801
    """Chi-squared distribution with the functions cdf, sf, ppf and isf of scipy.stats.

    The first argument is a value (cdf, sf) or a probability (ppf, isf), the second the degrees of freedom.
    """

    cdf = staticmethod(lambda x, freedom: chdtr(freedom, x))
    sf = staticmethod(lambda x, freedom: chdtrc(freedom, x))
    ppf = staticmethod(lambda share, freedom: 2 * gammaincinv(np.asarray(freedom) / 2, share))
    isf = staticmethod(lambda share, freedom: chdtri(freedom, share))


class f:  # noqa: N801
    """F distribution, the ratio of two mean squares of independent standard normal numbers; only `logsf`."""

    @staticmethod
    def logsf(x: Number, over: Number, under: Number) -> Any:
        """Return the natural logarithm of P(F > x), the probability that an F-distributed number F exceeds `x`.

        `over` and `under` are the degrees of freedom of numerator and denominator.

        If P underflows, the result is the leading term of the incomplete beta function (DLMF 8.17.7).
        """
        tail, half = np.asarray(fdtrc(over, under, x)), np.asarray(under) / 2
        share = np.maximum(under / (under + np.asarray(over) * np.asarray(x, float)), 1e-300)
        leading = half * np.log(share) - np.log(half) - betaln(half, np.asarray(over) / 2)
        return np.where(tail > 1e-290, np.log(np.maximum(tail, 1e-300)), leading)[()]
