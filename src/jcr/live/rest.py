"""An arm that is watched: a request for an image whenever it has come to rest in a new place."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.geometry import inverse, rotation_angle
from jcr.live.asks import Answer, Ask

REST_S = 0.5
REST = (2e-4, np.radians(0.03))
"""m, rad: an arm that stays within this for REST_S is at rest."""
MOVED_ON = (0.01, np.radians(3.0))
"""m, rad: as far as this from the last image, rest asks for the next one."""
TRY_AGAIN = (1e-3, np.radians(0.2))
"""m, rad: as far as this from a pose that was refused, likewise."""


@dataclass(frozen=True)
class State:
    """Where an arm is."""

    time_s: float
    """On the controller's clock."""
    base_from_gripper: Float[ndarray, "4 4"]
    joints: Float[ndarray, " dof"] | None = None
    """rad; None where the source does not send them."""


States = Callable[[], Iterator[State]]
"""Begins to listen: what the arm sends from then on, without end. Closing the iterator hangs up."""


def asks_at_rest(states: States) -> Iterator[Ask]:
    """A request whenever the arm has come to rest in a new place; drive it by its program or by hand."""
    last, limit = None, MOVED_ON

    def heard(answer: Answer) -> None:
        nonlocal limit
        limit = MOVED_ON if answer["accepted"] else TRY_AGAIN

    def current() -> Float[ndarray, "4 4"]:
        return next(states()).base_from_gripper

    while True:
        state = _at_rest(states, last, limit)
        # The connection is closed meanwhile: states that wait would be those of where the arm has been.
        yield Ask(state.base_from_gripper, answer=heard, current=current, joints=state.joints)
        last = state.base_from_gripper


def _at_rest(states: States, last: Float[ndarray, "4 4"] | None, limit: tuple[float, float]) -> State:
    """Where the arm rests, once it is farther than `limit` from `last`."""
    recent: deque[State] = deque()
    for state in states():
        if recent and state.time_s < recent[-1].time_s:
            recent.clear()  # The controller's clock was set back.
        while recent and farther(recent[0].base_from_gripper, state.base_from_gripper, REST):
            recent.popleft()
        recent.append(state)
        while len(recent) > 1 and state.time_s - recent[1].time_s >= REST_S:
            recent.popleft()
        if state.time_s - recent[0].time_s >= REST_S and (
            last is None or farther(last, state.base_from_gripper, limit)
        ):
            return state
    raise AssertionError("States never end but by raising")


def farther(a: Float[ndarray, "4 4"], b: Float[ndarray, "4 4"], limit: tuple[float, float]) -> bool:
    """Whether two poses are more than (m, rad) apart."""
    motion = inverse(a) @ b
    return bool(np.linalg.norm(motion[:3, 3]) > limit[0] or rotation_angle(motion[:3, :3]) > limit[1])
