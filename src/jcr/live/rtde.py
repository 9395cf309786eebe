"""Gripper poses and joint angles of a Universal Robots arm by its makers' RTDE interface, with the package ur-rtde."""

import time
from collections.abc import Iterator

import numpy as np

from jcr.errors import InputError
from jcr.extras import extra
from jcr.live.asks import pose_of_numbers
from jcr.live.rest import State

POLL_S = 0.008
SILENT_S = 5.0
"""Without a new timestamp for so long, the controller is gone."""


def states(host: str) -> Iterator[State]:
    """What the robot says from now on; the pose is that of the tool centre point set in the installation.

    Raises InputError when the package is missing, or the robot cannot be reached or falls silent.
    """
    where = f"--poses rtde:{host}"
    package = extra("rtde_receive", "ur", where, "; or give --poses ur:HOST, which needs no package")
    try:
        robot = package.RTDEReceiveInterface(host, 125.0, ["timestamp", "actual_q", "actual_TCP_pose"])
    except (RuntimeError, ValueError) as error:
        raise InputError(
            f"{where}: {' '.join(str(error).split())}; check the address, that the robot is on, and that RTDE is "
            "enabled (Settings, Security, Services)"
        ) from None
    heard, latest = time.monotonic(), -1.0
    try:
        while robot.isConnected() and time.monotonic() - heard < SILENT_S:
            if (now := robot.getTimestamp()) != latest:
                heard, latest = time.monotonic(), now
                pose = pose_of_numbers(robot.getActualTCPPose(), where)
                yield State(now, pose, np.array(robot.getActualQ()))
            time.sleep(POLL_S)
    finally:
        robot.disconnect()
    raise InputError(f"{where}: the robot stopped sending; check that it is on; the same command resumes")
