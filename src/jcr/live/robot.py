"""States of a robot arm from its controller, detection of rest, and gripper poses from plain numbers.

Universal Robots, Franka and UFACTORY arms are read. No motion is commanded, so an arm may be guided by hand. The readers
raise InputError if a package is missing, the robot cannot be reached, or the connection ends.
"""

import contextlib
import io
import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.notations import METRES_LIMIT, RADIANS_LIMIT, UNIT_TOLERANCE, poses_of
from jcr.errors import InputError
from jcr.extras import extra
from jcr.geometry import inverse, rotation_angle
from jcr.records.capture_schema import MOST_ROTATION, read_rigid

REST_S = 0.5
"""Time (s) without motion after which an arm is at rest."""
REST = (2e-4, np.radians(0.03))
"""Largest motion (m, rad) of an arm at rest."""
MOVED_ON = (0.01, np.radians(3.0))
"""Least motion (m, rad) from the last image's gripper pose to the pose at rest where the next image is taken."""
TRY_AGAIN = (1e-3, np.radians(0.2))
"""Least motion (m, rad), in place of MOVED_ON, after an image that was refused."""
BY_COUNT = {6: "rotvec", 7: "quat:xyzw", 16: "matrix"}
"""Pose convention by the number of numbers."""
ARM_KINDS = ("ur", "franka", "xarm")
"""Kinds of arms whose controllers can be read."""
Action = Literal["take", "retake", "remove", "undo", "finish"]
"""Command of the live page."""
UR_PORT = 30003
"""Default port: the real-time interface of UR controllers."""
UR_TIMEOUT_S = 5.0
"""Time (s) without data after which the connection to a UR fails."""
FRANKA_POLL_S, XARM_POLL_S = 0.008, 0.02
"""Time (s) between two reads of the state of a Franka and of a UFACTORY arm."""
UR_TOOL = {764: 588, 812: 588} | dict.fromkeys(range(1044, 4096), 444)
"""First byte of x, y, z (m) and rx, ry, rz (rotation vector, rad) of the tool centre point, by the length of the packet
(bytes): before software 3.0, and since then, where 1044 is the length in 3.0 and later releases append fields."""
UR_JOINTS = 252
"""First byte of the six actual joint angles (rad), in every version."""


@dataclass(frozen=True)
class RobotState:
    """Gripper pose and joint angles of an arm at one time."""

    time_s: float
    """Time (s) by the clock of the controller, or of this machine if the controller sends no time."""
    base_from_gripper: Float[ndarray, "4 4"]
    """Gripper pose (m)."""
    joints: Float[ndarray, " dof"] | None = None
    """Joint angles (rad); None if the source does not send them."""


States = Callable[[], Iterator[RobotState]]
"""Function that connects to an arm and returns an iterator of its states; closing the iterator ends the connection."""


def next_rest(states: States, last: Float[ndarray, "4 4"] | None, limit: tuple[float, float]) -> RobotState:
    """Wait until the arm rests at a pose that differs from `last` by more than `limit` (m, rad); return its state.

    The arm is at rest if it moves less than 0.2 mm and 0.03° in 0.5 s. `last` is a gripper pose (4,4); None: any pose
    at rest is returned. Raises InputError if the states end before.
    """
    recent: deque[RobotState] = deque()
    for state in states():
        if recent and state.time_s < recent[-1].time_s:
            recent.clear()  # The controller's clock was set back.
        while recent and is_farther(recent[0].base_from_gripper, state.base_from_gripper, REST):
            recent.popleft()
        recent.append(state)
        while len(recent) > 1 and state.time_s - recent[1].time_s >= REST_S:
            recent.popleft()
        is_new = last is None or is_farther(last, state.base_from_gripper, limit)
        if is_new and state.time_s - recent[0].time_s >= REST_S:
            return state
    raise InputError("the arm sends no more states; the same command resumes")


def is_farther(a: Float[ndarray, "4 4"], b: Float[ndarray, "4 4"], limit: tuple[float, float]) -> bool:
    """Test whether two gripper poses a, b (4,4) differ by more than `limit` in translation (m) or in rotation (rad)."""
    motion = inverse(a) @ b
    return bool(np.linalg.norm(motion[:3, 3]) > limit[0] or rotation_angle(motion[:3, :3]) > limit[1])


def pose_of_numbers(numbers: list[float], where: str) -> Float[ndarray, "4 4"]:
    """Return base_from_gripper (4,4) from the numbers of one pose (m, rad); raise InputError else.

    6 numbers are x y z and a rotation vector, 7 are x y z qx qy qz qw, 16 are a matrix by rows.
    """
    if (named := BY_COUNT.get(len(numbers))) is None:
        forms = "x y z rx ry rz | x y z qx qy qz qw | 16 numbers by rows; m, rad"
        raise InputError(f"{where}: {len(numbers)} numbers; give {forms}")
    position, rotation = np.array(numbers[:3], float), np.array(numbers[3:], float)
    if len(numbers) == 16:
        matrix = np.reshape(numbers, (4, 4))
        position, rotation = matrix[:3, 3], matrix[:3, :3].ravel()
        if not (np.abs(matrix[3] - (0, 0, 0, 1)) < UNIT_TOLERANCE).all():
            raise InputError(f"{where}: the last row is not 0 0 0 1; give the matrix by rows")
    if (far_m := float(np.linalg.norm(position))) > METRES_LIMIT:
        raise InputError(f"{where}: {far_m:.4g} m from the base; these look like millimetres: give metres")
    if len(numbers) == 6 and (largest := float(np.abs(rotation).max())) > RADIANS_LIMIT:
        raise InputError(f"{where}: an angle of {largest:.4g} rad; these look like degrees: give radians")
    pose = poses_of(position[None], rotation[None], named)[0]
    if np.isnan(pose).any():
        raise InputError(f"{where}: no rigid transform, or NaN or infinity in it; check the numbers")
    return pose


def states_of(source: str) -> States | None:
    """Return the state reader of an arm, named ur:HOST[:PORT], franka:HOST or xarm:HOST; None for other sources."""
    kind, _, address = source.partition(":")
    if kind not in ARM_KINDS or not address:
        return None
    if kind == "ur":
        host, _, number = address.rpartition(":") if ":" in address else (address, "", str(UR_PORT))
        if not host or not number.isdecimal() or len(number) > 5 or int(number) > 65535:
            raise InputError(f"--poses {source}: no address; write HOST:PORT such as 192.168.0.2:{UR_PORT}")
        return lambda: ur_states(host, int(number))
    read = franka_states if kind == "franka" else xarm_states
    return lambda: read(address)


def ur_states(host: str, port: int) -> Iterator[RobotState]:
    """Yield the states of a UR arm from its real-time interface (port 30003, or 30013 read-only), at 125 or 500 Hz.

    A packet has a big-endian int32 with its length, the controller's time as a double, and then groups of doubles
    ("Remote control via TCP/IP", Universal Robots article 16496; Client Interfaces manual, page RealTime5.10). Since
    software 3.0 (CB3, e-Series) the actual tool vector follows nine groups of six. Before 3.0 (CB2) it follows target
    and actual joints, the tool's accelerometer, fifteen unused numbers and the force.
    """
    where = f"--poses ur:{host}:{port}"
    try:
        with socket.create_connection((host, port), UR_TIMEOUT_S) as connection:
            stream = connection.makefile("rb")
            while head := stream.read(4):
                length = int.from_bytes(head) if len(head) == 4 else 0
                if length not in UR_TOOL:
                    raise InputError(f"{where}: {length} bytes: no packet of a UR; use port 30003 or 30013")
                if len(packet := head + stream.read(length - 4)) < length:
                    break
                (time_s,) = struct.unpack_from("!d", packet, 4)
                tool = struct.unpack_from("!6d", packet, UR_TOOL[length])
                joints = np.array(struct.unpack_from("!6d", packet, UR_JOINTS))
                # A last joint without limits may have an angle beyond the largest that capture.json allows.
                plausible = joints if (np.abs(joints) < MOST_ROTATION).all() else None
                yield RobotState(time_s, pose_of_numbers(list(tool), where), plausible)
    except TimeoutError:
        raise InputError(f"{where}: silent for {UR_TIMEOUT_S:.0f} s; check the robot and address") from None
    except OSError as error:
        raise InputError(f"{where}: {error}; check the address, and that the robot is on") from None
    raise InputError(f"{where}: the robot closed the connection; is another program using the port?")


def franka_states(host: str) -> Iterator[RobotState]:
    """Yield the states of a Franka arm (FER, FR3), read from its control interface by the package franky-control.

    base_from_gripper is O_T_EE: the pose of the end effector that is set in Franka Desk.
    """
    where = f"--poses franka:{host}"
    franky = extra("franky", "franka", where)
    try:
        # A real-time kernel is not needed to read the state.
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
    """Yield the states of a UFACTORY arm (xArm, Lite 6, 850), read by the package xarm-python-sdk.

    base_from_gripper is the pose of the tool centre point that is set in UFACTORY Studio.
    """
    where = f"--poses xarm:{host}"
    timeout = socket.getdefaulttimeout()
    # The package prints its version and errors, which the InputError replaces, and changes the timeout of all sockets.
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
                    f"{where}: code {code or wrong} of UFACTORY Studio; the same command resumes"
                )
            base_from_gripper = pose_of_numbers([*np.divide(pose[:3], 1e3), *pose[3:]], where)
            joints = np.array(angles[: arm.axis], dtype=np.float64)
            yield RobotState(time.monotonic(), base_from_gripper, joints)
            time.sleep(XARM_POLL_S)
    finally:
        arm.disconnect()
