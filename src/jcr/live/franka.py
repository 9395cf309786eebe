"""Gripper poses and joint angles of a Franka arm by the Franka Control Interface, with the package franky-control."""

import time
from collections.abc import Iterator

import numpy as np

from jcr.capture.checks import read_rigid
from jcr.errors import InputError
from jcr.extras import extra
from jcr.live.rest import State

POLL_S = 0.008


def states(host: str) -> Iterator[State]:
    """States of the robot from now on; the pose is O_T_EE, of the end effector set in Desk.

    Nothing is commanded, so the arm may be guided by hand. Raises InputError when the package is missing, or the
    robot cannot be reached or hangs up.
    """
    where = f"--poses franka:{host}"
    franky = extra("franky", "franka", where)
    try:
        # Reading the state needs no real-time kernel.
        robot = franky.Robot(host, realtime_config=franky.RealtimeConfig.Ignore)
        while True:
            state = robot.state
            pose = read_rigid(np.array(state.O_T_EE.matrix).tolist(), where)
            yield State(state.time.to_sec(), pose, np.array(state.q, dtype=np.float64))
            time.sleep(POLL_S)
    except (franky.Exception, franky.NetworkException, RuntimeError) as error:
        raise InputError(
            f"{where}: {' '.join(str(error).split())}; check the address, that FCI is activated in Desk, and that no "
            "other program controls the arm"
        ) from None
