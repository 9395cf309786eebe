"""Anderson's acceleration of a fixed-point iteration.

Weights of observations and sizes of errors are estimated from a state, and the state follows from them: each round
leaves up to 0.8 of the distance of the last one. The next round begins at the combination of the last rounds whose
step would be smallest (Anderson, J. ACM 12, 1965; Walker and Ni, SIAM J. Numer. Anal. 49, 2011).
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

ROUNDS_BEFORE = 3
"""Number of earlier rounds that the next one uses."""
PARALLEL = 1e-2
"""Rounds whose steps differ by less than this share of what others differ by add nothing."""
FARTHEST = 5.0
"""Largest distance of the combination from the end of a round, in lengths of the round's own step."""


class Acceleration:
    """Anderson acceleration from the last rounds of an iteration."""

    def __init__(self) -> None:
        self._ends: list[Float[ndarray, " n"]] = []
        self._steps: list[Float[ndarray, " n"]] = []

    def next(
        self, begin: Float[ndarray, " n"], end: Float[ndarray, " n"], weight: Float[ndarray, " n"]
    ) -> Float[ndarray, " n"]:
        """Return the begin of the next round, from the begin and the end of this one.

        `weight` is one over the standard deviation of each unknown; unknowns of weight 0 follow the others.
        """
        self._ends = [*self._ends[-ROUNDS_BEFORE:], end]
        self._steps = [*self._steps[-ROUNDS_BEFORE:], end - begin]
        if len(self._steps) == 1:
            return end
        judged = np.flatnonzero(weight)
        weight = weight[judged]
        step = weight * self._steps[-1][judged]
        by_round = weight[:, None] * np.diff([one[judged] for one in self._steps], axis=0).T
        share = np.linalg.lstsq(by_round, step, rcond=PARALLEL)[0]
        beyond = np.diff(self._ends, axis=0).T @ share
        far = float(np.linalg.norm(weight * beyond[judged]))
        most = FARTHEST * float(np.linalg.norm(step))
        return end - beyond * (most / far if far > most else 1.0)

    def forget(self) -> None:
        """Drop the earlier rounds, which no longer show how the iteration proceeds."""
        self._ends, self._steps = [], []
