"""Waiting for what another process or thread does, as long as it takes."""

import time
from collections.abc import Callable

PATIENCE_S = 180.0
"""Far more than anything waited for takes on a busy machine."""


def until(condition: Callable[[], bool]) -> None:
    """Return once `condition` holds; AssertionError where it does not within PATIENCE_S."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, "what is waited for does not happen"
        time.sleep(0.01)
