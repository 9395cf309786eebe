"""Gripper poses and joint angles from the controllers of arms: Universal Robots, Franka, UFACTORY.

Nothing is commanded, so an arm may be guided by hand. Readers raise InputError when the package is missing, or the
robot cannot be reached or hangs up.
"""

import contextlib
import io
import socket
import struct
import time
from collections.abc import Callable, Iterator

import numpy as np

from jcr.capture.controllers import poses_from_numbers
from jcr.capture.options import ConventionName
from jcr.errors import InputError
from jcr.extras import extra
from jcr.live.robot import RobotState, States, pose_of_numbers
from jcr.records.capture_json import MOST_ROTATION, read_rigid

UR_PORT = 30003
UR_TIMEOUT_S = 5.0
FRANKA_POLL_S, XARM_POLL_S = 0.008, 0.02
UR_TOOL_SINCE_3_0, UR_TOOL_BEFORE = 444, 588
"""Byte at which x, y, z (m) and rx, ry, rz (rotation vector, rad) of the tool centre point begin."""
UR_BEFORE_3_0 = (764, 812)
UR_SINCE_3_0 = range(1044, 4096)
"""Lengths of packets; each release since 3.0 (1044 bytes) appended to the one before."""
UR_JOINTS = 252
"""Byte at which the six actual joint angles (rad) begin, in every version."""


def states_of(source: str) -> States | None:
    """Return the states of the arm that `--poses` names (ur:HOST[:PORT], franka:HOST, xarm:HOST); None of no arm."""
    kind, _, address = source.partition(":")
    if kind not in NOTATIONS or not address:
        return None
    if kind == "ur":
        host, port = address_of(address, UR_PORT, "--poses ur:")
        return lambda: ur_states(host, port)
    read = franka_states if kind == "franka" else xarm_states
    return lambda: read(address)


def address_of(text: str, port: int, option: str) -> tuple[str, int]:
    """Return host and port of HOST[:PORT]; raise InputError that begins with `option`."""
    host, _, number = text.rpartition(":") if ":" in text else (text, "", str(port))
    if not host or not number.isdigit() or not int(number) < 65536:
        raise InputError(f"{option}{text}: no address; write HOST:PORT such as 127.0.0.1:{port}")
    return host, int(number)


NOTATIONS: dict[str, ConventionName] = {"ur": "ur", "franka": "franka", "xarm": "xarm"}
"""Convention in which each kind of arm shows poses."""


def ur_states(host: str, port: int) -> Iterator[RobotState]:
    """Yield the states of a UR arm from its real-time interface, 125 or 500 times a second.

    Port 30003, or 30013 read-only. Layout: "Remote control via TCP/IP", Universal Robots article 16496, and the page
    RealTime5.10 of the Client Interfaces manual: a big-endian int32 with the length of the packet, the controller's time
    as a double, then groups of doubles. From software 3.0 (CB3, e-Series) nine groups of six precede the actual tool
    vector; before (CB2) the target and actual joints, the tool's accelerometer, fifteen unused and the force.
    """
    where = f"--poses ur:{host}:{port}"
    try:
        with socket.create_connection((host, port), UR_TIMEOUT_S) as connection:
            stream = connection.makefile("rb")
            while True:
                yield _ur_state(stream.read(4), stream.read, where)
    except TimeoutError:
        raise InputError(
            f"{where}: silent for {UR_TIMEOUT_S:.0f} s; is the robot on, and the address right?"
        ) from None
    except OSError as error:
        raise InputError(f"{where}: {error}; check the address, and that the robot is on") from None


def _ur_state(head: bytes, read: Callable[[int], bytes], where: str) -> RobotState:
    """Return the state in one packet, whose first four bytes are `head`."""
    length = struct.unpack("!i", head)[0] if len(head) == 4 else 0
    if length not in UR_BEFORE_3_0 and length not in UR_SINCE_3_0:
        raise InputError(
            f"{where}: a packet of {length} bytes does not come from a UR real-time port; use 30003 or 30013"
            if head
            else f"{where}: the robot closed the connection; is another program using the port?"
        )
    packet = head + read(length - 4)
    if len(packet) < length:
        raise InputError(f"{where}: the connection broke; the same command resumes")
    offset = UR_TOOL_BEFORE if length in UR_BEFORE_3_0 else UR_TOOL_SINCE_3_0
    tool = struct.unpack_from("!6d", packet, offset)
    joints = np.array(struct.unpack_from("!6d", packet, UR_JOINTS))
    # A last joint without limits may have turned more often than a capture.json allows.
    plausible = joints if (np.abs(joints) < MOST_ROTATION).all() else None
    return RobotState(struct.unpack_from("!d", packet, 4)[0], pose_of_numbers(list(tool), where), plausible)


def franka_states(host: str) -> Iterator[RobotState]:
    """Yield the states of a Franka arm (FER, FR3) by its control interface, with the package franky-control.

    The pose is O_T_EE, of the end effector set in Desk.
    """
    where = f"--poses franka:{host}"
    franky = extra("franky", "franka", where)
    try:
        # Reading the state needs no real-time kernel.
        robot = franky.Robot(host, realtime_config=franky.RealtimeConfig.Ignore)
        while True:
            state = robot.state
            pose = read_rigid(np.array(state.O_T_EE.matrix).tolist(), where)
            yield RobotState(state.time.to_sec(), pose, np.array(state.q, dtype=np.float64))
            time.sleep(FRANKA_POLL_S)
    except (franky.Exception, franky.NetworkException, RuntimeError) as error:
        raise InputError(
            f"{where}: {' '.join(str(error).split())}; check the address, that FCI is activated in Desk, and that no "
            "other program controls the arm"
        ) from None


def xarm_states(host: str) -> Iterator[RobotState]:
    """Yield the states of a UFACTORY arm (xArm, Lite 6, 850), with the package xarm-python-sdk.

    The pose is that of the tool centre point set in UFACTORY Studio.
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
            joints = np.array(angles[: arm.axis], dtype=np.float64)
            yield RobotState(time.monotonic(), base_from_gripper, joints)
            time.sleep(XARM_POLL_S)
    finally:
        arm.disconnect()
