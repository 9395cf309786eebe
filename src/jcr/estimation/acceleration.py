"""A fixed point in fewer rounds: Anderson's acceleration.

Weights of observations and sizes of errors are estimated from where everything is, and everything moves to where they
put it: each round leaves much of what the last one left, up to 0.8 of it. The rounds before show along what, and the
next begins where a combination of them would stand still (Anderson, J. ACM 12, 1965; Walker and Ni, SIAM J. Numer.
Anal. 49, 2011).
"""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

ROUNDS_BEFORE = 3
"""That the next one makes use of."""
PARALLEL = 1e-2
"""Rounds whose steps differ by less than this share of what others differ by add nothing."""
FARTHEST = 5.0
"""Times a round's own step that the combination may go beyond it."""


class Acceleration:
    """The last rounds of an iteration."""

    def __init__(self) -> None:
        self._ends: list[Float[ndarray, " n"]] = []
        self._steps: list[Float[ndarray, " n"]] = []

    def next(
        self, begin: Float[ndarray, " n"], end: Float[ndarray, " n"], weight: Float[ndarray, " n"]
    ) -> Float[ndarray, " n"]:
        """Where the next round begins, from where this one began and ended.

        `weight` makes unknowns comparable, as one over their standard deviations does; those of no weight follow.
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
        """Begin again, for what the rounds before showed is no longer so."""
        self._ends, self._steps = [], []
