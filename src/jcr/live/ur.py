"""Gripper poses of a Universal Robots arm from its real-time interface (port 30003, or 30013 read-only).

Layout: "Remote control via TCP/IP", Universal Robots article 16496, and the page RealTime5.10 of the Client
Interfaces manual: a big-endian int32 with the length of the packet, the controller's time as a double, then
groups of doubles. From software 3.0 (CB3, e-Series) nine groups of six precede the actual tool vector; before
(CB2) it is the target and actual joints, the tool's accelerometer, fifteen unused and the force.
"""

import socket
import struct
from collections import deque
from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.errors import InputError
from jcr.geometry import inverse, rotation_angle
from jcr.live.asks import Answer, Ask, pose_of_numbers

TIMEOUT_S = 5.0
TOOL_VECTOR_SINCE_3_0, TOOL_VECTOR_BEFORE = 444, 588
"""Byte at which x, y, z (m) and rx, ry, rz (rotation vector, rad) of the tool centre point begin."""
BEFORE_3_0 = (764, 812)
SINCE_3_0 = range(1044, 4096)
"""Lengths of packets; each release since 3.0 (1044 bytes) appended to the one before."""
REST_S = 0.5
REST = (2e-4, np.radians(0.03))
"""m, rad: an arm that stays within this for REST_S is at rest."""
MOVED_ON = (0.01, np.radians(3.0))
"""m, rad: as far as this from the last picture, rest asks for the next one."""
TRY_AGAIN = (1e-3, np.radians(0.2))
"""m, rad: as far as this from a pose that was refused, likewise."""

State = tuple[float, Float[ndarray, "4 4"]]
"""Time of the controller (s), base_from_gripper of the tool centre point set in the installation."""


def ur_poses(host: str, port: int, say: Callable[[str], None]) -> Iterator[Ask]:
    """A request whenever the arm has come to rest in a new place; drive it by its program or by hand.

    Raises InputError when the robot cannot be reached, falls silent or sends something else.
    """
    say(f"move the arm; a picture is taken whenever it rests ({host})")
    last, limit = None, MOVED_ON

    def heard(answer: Answer) -> None:
        nonlocal limit
        limit = MOVED_ON if answer["accepted"] else TRY_AGAIN

    while True:
        pose = _at_rest(host, port, last, limit)
        # The connection is closed meanwhile: packets that wait would tell where the arm has been.
        yield Ask(pose, heard, current=lambda: next(states(host, port))[1])
        last = pose


def _at_rest(
    host: str, port: int, last: Float[ndarray, "4 4"] | None, limit: tuple[float, float]
) -> Float[ndarray, "4 4"]:
    """Where the arm rests, once it is farther than `limit` from `last`."""
    recent: deque[State] = deque()
    for time_s, pose in states(host, port):
        while recent and farther(recent[0][1], pose, REST):
            recent.popleft()
        recent.append((time_s, pose))
        while len(recent) > 1 and time_s - recent[1][0] >= REST_S:
            recent.popleft()
        if time_s - recent[0][0] >= REST_S and (last is None or farther(last, pose, limit)):
            return pose
    raise AssertionError("states() never ends but by raising")


def farther(a: Float[ndarray, "4 4"], b: Float[ndarray, "4 4"], limit: tuple[float, float]) -> bool:
    """Whether two poses are more than (m, rad) apart."""
    motion = inverse(a) @ b
    return bool(np.linalg.norm(motion[:3, 3]) > limit[0] or rotation_angle(motion[:3, :3]) > limit[1])


def states(host: str, port: int) -> Iterator[State]:
    """What the robot says from now on, 125 or 500 times a second."""
    where = f"--poses ur:{host}:{port}"
    try:
        with socket.create_connection((host, port), TIMEOUT_S) as connection:
            stream = connection.makefile("rb")
            while True:
                yield _state(stream.read(4), stream.read, where)
    except TimeoutError:
        raise InputError(
            f"{where}: silent for {TIMEOUT_S:.0f} s; is the robot on, the address right?"
        ) from None
    except OSError as error:
        raise InputError(f"{where}: {error}; check the address, and that the robot is on") from None


def _state(head: bytes, read: Callable[[int], bytes], where: str) -> State:
    length = struct.unpack("!i", head)[0] if len(head) == 4 else 0
    if length not in BEFORE_3_0 and length not in SINCE_3_0:
        raise InputError(
            f"{where}: a packet of {length} bytes is none of a UR real-time port; use 30003 or 30013"
            if head
            else f"{where}: the robot closed the connection; is another program using the port?"
        )
    packet = head + read(length - 4)
    if len(packet) < length:
        raise InputError(f"{where}: the connection broke; the same command goes on")
    offset = TOOL_VECTOR_BEFORE if length in BEFORE_3_0 else TOOL_VECTOR_SINCE_3_0
    tool = struct.unpack_from("!6d", packet, offset)
    return struct.unpack_from("!d", packet, 4)[0], pose_of_numbers(list(tool), where)
