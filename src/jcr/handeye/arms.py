"""Arms by name, from what their makers publish; frames, angles and signs are those of the controller."""

from collections.abc import Callable
from typing import Literal

import numpy as np

from jcr.geometry import transform
from jcr.handeye.robots import Arm, from_dh

PI = np.pi
FULL_TURN = (-2 * PI, 2 * PI)


def _ur(name: str, d1: float, a2: float, a3: float, d4: float, d5: float, d6: float) -> Arm:
    """Universal Robots e-Series, standard parameters.

    Source: Universal Robots, "DH Parameters for calculations of kinematics and dynamics"; the same numbers are in
    ur_description/config/*/default_kinematics.yaml of ros-industrial/universal_robot. The base is that of the
    controller, rotated by 180° about z from base_link of ROS; the gripper is tool0. Limits: joint_limits.yaml.
    """
    rows = [
        (0.0, d1, PI / 2, 0.0),
        (a2, 0.0, 0.0, 0.0),
        (a3, 0.0, 0.0, 0.0),
        (0.0, d4, PI / 2, 0.0),
        (0.0, d5, -PI / 2, 0.0),
        (0.0, d6, 0.0, 0.0),
    ]
    limits = [FULL_TURN] * 2 + [(-PI, PI)] + [FULL_TURN] * 3
    # At zero the arm reaches along -x of the controller's base; the table is at +x.
    rest = (PI, -1.6, 1.9, -1.9, -PI / 2, 0.0)
    return from_dh(name, rows, limits, rest, modified=False)


def _franka(name: str, limits: list[tuple[float, float]]) -> Arm:
    """Franka Emika Panda (FER) and Research 3, modified parameters; the gripper is the flange.

    Source: Franka Control Interface documentation, "Robot and interface specifications"; robots/fer/kinematics.yaml and
    robots/fr3/joint_limits.yaml of frankaemika/franka_description.
    """
    rows = [
        (0.0, 0.333, 0.0, 0.0),
        (0.0, 0.0, -PI / 2, 0.0),
        (0.0, 0.316, PI / 2, 0.0),
        (0.0825, 0.0, PI / 2, 0.0),
        (-0.0825, 0.384, -PI / 2, 0.0),
        (0.0, 0.0, PI / 2, 0.0),
        (0.088, 0.0, PI / 2, 0.0),
    ]
    flange = transform(np.eye(3), np.array([0.0, 0.0, 0.107]))
    rest = (0.0, -PI / 4, 0.0, -3 * PI / 4, 0.0, PI / 2, PI / 4)
    return from_dh(name, rows, limits, rest, modified=True, last_from_gripper=flange)


def _panda() -> Arm:
    limits = [2.8973, 1.7628, 2.8973, None, 2.8973, None, 2.8973]
    both = [(-limit, limit) if limit is not None else (0.0, 0.0) for limit in limits]
    both[3], both[5] = (-3.0718, -0.0698), (-0.0175, 3.7525)
    return _franka("panda", both)


def _fr3() -> Arm:
    return _franka(
        "fr3",
        [
            (-2.7437, 2.7437),
            (-1.7837, 1.7837),
            (-2.9007, 2.9007),
            (-3.0421, -0.1518),
            (-2.8065, 2.8065),
            (0.5445, 4.5169),
            (-3.0159, 3.0159),
        ],
    )


RobotName = Literal["ur3e", "ur5e", "ur10e", "panda", "fr3"]

_ARMS: dict[RobotName, Callable[[], Arm]] = {
    "ur3e": lambda: _ur("ur3e", 0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": lambda: _ur("ur5e", 0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": lambda: _ur("ur10e", 0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "panda": _panda,
    "fr3": _fr3,
}


def arm_named(name: RobotName) -> Arm:
    """The arm of that name."""
    return _ARMS[name]()
