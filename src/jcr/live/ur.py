"""Gripper poses of a Universal Robots arm from its real-time interface (port 30003, or 30013 read-only).

Layout: "Remote control via TCP/IP", Universal Robots article 16496, and the page RealTime5.10 of the Client
Interfaces manual: a big-endian int32 with the length of the packet, the controller's time as a double, then
groups of doubles. From software 3.0 (CB3, e-Series) nine groups of six precede the actual tool vector; before
(CB2) it is the target and actual joints, the tool's accelerometer, fifteen unused and the force.
"""

import socket
import struct
from collections.abc import Callable, Iterator

import numpy as np

from jcr.capture.formats.capture_json import MOST_ROTATION
from jcr.errors import InputError
from jcr.live.asks import pose_of_numbers
from jcr.live.rest import State

TIMEOUT_S = 5.0
TOOL_VECTOR_SINCE_3_0, TOOL_VECTOR_BEFORE = 444, 588
"""Byte at which x, y, z (m) and rx, ry, rz (rotation vector, rad) of the tool centre point begin."""
BEFORE_3_0 = (764, 812)
SINCE_3_0 = range(1044, 4096)
"""Lengths of packets; each release since 3.0 (1044 bytes) appended to the one before."""
JOINTS = 252
"""Byte at which the six actual joint angles (rad) begin, in every version."""


def states(host: str, port: int) -> Iterator[State]:
    """States of the robot from now on, 125 or 500 times a second.

    Raises InputError when the robot cannot be reached, falls silent or sends something else.
    """
    where = f"--poses ur:{host}:{port}"
    try:
        with socket.create_connection((host, port), TIMEOUT_S) as connection:
            stream = connection.makefile("rb")
            while True:
                yield _state(stream.read(4), stream.read, where)
    except TimeoutError:
        raise InputError(
            f"{where}: silent for {TIMEOUT_S:.0f} s; is the robot on, and the address right?"
        ) from None
    except OSError as error:
        raise InputError(f"{where}: {error}; check the address, and that the robot is on") from None


def _state(head: bytes, read: Callable[[int], bytes], where: str) -> State:
    length = struct.unpack("!i", head)[0] if len(head) == 4 else 0
    if length not in BEFORE_3_0 and length not in SINCE_3_0:
        raise InputError(
            f"{where}: a packet of {length} bytes does not come from a UR real-time port; use 30003 or 30013"
            if head
            else f"{where}: the robot closed the connection; is another program using the port?"
        )
    packet = head + read(length - 4)
    if len(packet) < length:
        raise InputError(f"{where}: the connection broke; the same command resumes")
    offset = TOOL_VECTOR_BEFORE if length in BEFORE_3_0 else TOOL_VECTOR_SINCE_3_0
    tool = struct.unpack_from("!6d", packet, offset)
    joints = np.array(struct.unpack_from("!6d", packet, JOINTS))
    # A last joint without limits may have gone round more often than a capture.json allows.
    plausible = joints if (np.abs(joints) < MOST_ROTATION).all() else None
    return State(struct.unpack_from("!d", packet, 4)[0], pose_of_numbers(list(tool), where), plausible)
