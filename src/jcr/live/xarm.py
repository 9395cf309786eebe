"""Gripper poses and joint angles of a UFACTORY arm (xArm, Lite 6, 850), with the package xarm-python-sdk."""

import contextlib
import io
import socket
import time
from collections.abc import Iterator

import numpy as np

from jcr.capture.robot_poses import poses_from_numbers
from jcr.errors import InputError
from jcr.extras import extra
from jcr.live.rest import State

POLL_S = 0.02


def states(host: str) -> Iterator[State]:
    """States of the robot from now on; the pose is that of the tool centre point set in UFACTORY Studio.

    Nothing is commanded. Raises InputError when the package is missing, or the robot cannot be reached or hangs up.
    """
    where = f"--poses xarm:{host}"
    timeout = socket.getdefaulttimeout()
    # The package prints its version and its errors, which our one line replaces, and sets a default for all sockets.
    with contextlib.redirect_stdout(io.StringIO()):
        api = extra("xarm.wrapper", "xarm", where).XArmAPI
        try:
            arm = api(host, is_radian=True, enable_report=False, check_joint_limit=False)
        except Exception as error:
            raise InputError(f"{where}: {error}; check the address, and that the control box is on") from None
        finally:
            socket.setdefaulttimeout(timeout)
    try:
        while True:
            code, pose = arm.get_position_aa(is_radian=True)
            wrong, angles = arm.get_servo_angle(is_radian=True)
            if code or wrong:
                raise InputError(
                    f"{where}: the arm answers with code {code or wrong}; look at UFACTORY Studio what it reports; "
                    "the same command resumes"
                )
            (base_from_gripper,) = poses_from_numbers(np.array([pose]), "xarm-axis-angle", "mm-rad", where)
            yield State(time.monotonic(), base_from_gripper, np.array(angles[: arm.axis], dtype=np.float64))
            time.sleep(POLL_S)
    finally:
        arm.disconnect()
