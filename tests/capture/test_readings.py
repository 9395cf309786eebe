"""Readings: numbers to poses in every notation, units, names of columns, the robot's pose beside others, directions."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jcr.capture.documents import Table
from jcr.capture.notations import (
    MAKERS,
    NUMBERS,
    angle_unit,
    length_unit,
    notation_of,
    numbers_of,
    poses_of,
)
from jcr.capture.options import ReadOptions
from jcr.capture.readings import Candidate, pose_columns, readings_of, text_of
from jcr.geometry import inverse, transform
from refusal import refused
from simulation.problems import hand_eye_problem

POSES = hand_eye_problem(np.random.default_rng(3), 12).base_from_gripper
POSITION, ROTATION = POSES[:, :3, 3], POSES[:, :3, :3]
X, Y, Z = np.eye(3)


def as_numbers(notation: str, length: float = 1.0, angle: float = 1.0) -> np.ndarray:
    """Return positions and rotations of the poses in a notation and in other units."""
    numbers = numbers_of(ROTATION, notation)
    return np.hstack([length * POSITION, (angle if NUMBERS[notation] == 3 else 1.0) * numbers])


def table_of(numbers: np.ndarray, columns: str = "", **facts: object) -> Table:
    """Return a table with these column names, separated by spaces; without names if empty."""
    names = tuple(columns.split()) if columns else (None,) * numbers.shape[1]
    rows = tuple(map(tuple, numbers.tolist()))
    usual = {"file": Path("poses.csv"), "place": "", "keys": None, "words": ""}
    return Table(columns=names, rows=rows, **(usual | facts))  # pyright: ignore[reportArgumentType]


def read(table: Table, **options: object) -> list[Candidate]:
    """Return the readings of a table."""
    return readings_of(table, ReadOptions(**options), "poses.csv")[1]  # pyright: ignore[reportArgumentType]


def notations(found: list[Candidate]) -> list[str]:
    return [reading.notation + ("⁻¹" if reading.inverted else "") for reading, _ in found]


KNOWN = {
    # Where the gripper's axes x, y and z point in the base, worked out by hand from the makers' definitions.
    "ur rotvec": ([0.1, 0.2, 0.3, 0, np.pi, 0], (-X, Y, -Z)),
    "xarm-axis-angle": ([100, 200, 300, 0, 180, 0], (-X, Y, -Z)),
    "kuka epson": ([100, 200, 300, 90, 90, 0], (-Z, -X, Y)),  # A about z, then B about the new y
    "fanuc xarm yaskawa techman jaka": (
        [100, 200, 300, 90, 0, 90],
        (Y, Z, X),
    ),  # W about fixed x, then R about fixed z
    "rpy unitree realman aubo": ([0.1, 0.2, 0.3, np.pi / 2, 0, np.pi / 2], (Y, Z, X)),
    "staubli mecademic": ([100, 200, 300, 90, 0, 90], (Z, -X, -Y)),  # rx about x, then rz about the new z
    "doosan": ([100, 200, 300, 90, 90, 0], (-Z, -X, Y)),  # A about z, B about the new y, C about the new z
    "kawasaki doosan": ([100, 200, 300, 0, 90, 90], (Y, Z, X)),
    "abb": ([100, 200, 300, 0, 1, 0, 0], (X, -Y, -Z)),
    "quat:xyzw": ([0.1, 0.2, 0.3, 1, 0, 0, 0], (X, -Y, -Z)),
    "franka": ([0, 1, 0, 0, -1, 0, 0, 0, 0, 0, 1, 0, 0.1, 0.2, 0.3, 1], (Y, -X, Z)),
    "matrix": ([0, -1, 0, 0.1, 1, 0, 0, 0.2, 0, 0, 1, 0.3, 0, 0, 0, 1], (Y, -X, Z)),
}


@pytest.mark.parametrize("conventions", KNOWN)
def test_known_poses(conventions: str):
    row, axes = KNOWN[conventions]
    for convention in conventions.split():
        ((_, (pose, *_)),) = read(table_of(np.tile(np.array(row, float), (4, 1))), pose_convention=convention)
        np.testing.assert_allclose(pose[:3, :3].T, axes, atol=1e-9)
        np.testing.assert_allclose(pose[:3, 3], [0.1, 0.2, 0.3], atol=1e-12)


def test_every_maker_has_a_known_pose():
    assert set(MAKERS) <= set(" ".join(KNOWN).split())


@pytest.mark.parametrize("notation", NUMBERS)
@pytest.mark.parametrize(
    ("units", "length", "angle"), [("m-rad", 1, 1), ("mm-deg", 1e3, np.degrees(1)), ("cm-rad", 100, 1)]
)
def test_notations_and_units_are_inverted_by_the_writer(notation, units, length, angle):
    numbers = as_numbers(notation, length, angle)
    np.testing.assert_allclose(poses_of(numbers[:, :3], numbers[:, 3:], notation, units), POSES, atol=1e-9)


def test_rows_that_are_no_transform_are_nan():
    quaternion = np.array([[0, 0, 0, 1.005], [0, 0, 0, 1.02], [0, 0, 0, np.nan], [0, 0, 1e200, 0]])
    assert np.isnan(poses_of(np.zeros((4, 3)), quaternion, "quat:xyzw")[:, 0, 0]).tolist() == [
        False,
        True,
        True,
        True,
    ]
    mirror, shear = np.diag([1.0, 1, -1]), np.eye(3) + 0.03 * np.outer(X, Y)
    matrices = np.stack([np.eye(3), mirror, shear]).reshape(3, 9)
    assert np.isnan(poses_of(np.zeros((3, 3)), matrices, "matrix")[:, 0, 0]).tolist() == [False, True, True]


@pytest.mark.parametrize("name", ["kukka", "euler:xx", "euler:abc", "euler:", "quat", "euler:zyx "])
def test_an_unknown_notation_lists_those_there_are(name: str):
    with refused(r"--pose-convention .*: not one of quat:xyzw, .*euler:ZYX, .*kuka"):
        notation_of(name)


@pytest.mark.parametrize(
    ("scale", "stated", "unit"),
    [(1, None, "m"), (1e3, None, "mm"), (100, "cm", "cm"), (1e3, "mm", "mm"), (1, "m", "m")],
)
def test_units_of_length_follow_from_the_size(scale: float, stated: str | None, unit: str):
    assert length_unit(scale * POSITION, stated, "poses.csv") == unit


def test_one_wrong_row_does_not_change_the_unit_of_the_others():
    """It made all others a thousand times too small, silently."""
    wrong = POSITION.copy()
    wrong[1] = [812.5, 0.2, 0.3]
    assert length_unit(wrong, None, "poses.csv") == length_unit(wrong, "m", "poses.csv") == "m"
    assert length_unit(np.vstack([1e3 * POSITION, [[0.1, 0.2, 0.3]]]), None, "poses.csv") == "mm"


@pytest.mark.parametrize(
    ("position", "stated", "words"),
    [
        (POSITION, "mm", "too near for mm; these look like metres: give --pose-units m-rad"),
        (POSITION, "cm", "too near for cm; these look like metres"),
        (1e3 * POSITION, "m", "these look like millimetres: give --pose-units mm-rad"),
        # Read as millimetres without a word, the hand-eye transform was accepted ten times too small.
        (1e2 * POSITION, None, "as centimetres: say which with --pose-units mm-rad or cm-rad"),
        # An arm on a vehicle 35 m from the origin of a map, in metres; whatever unit is stated.
        *(
            (
                POSITION + [35, 2, 0],
                stated,
                "are up to 35.* m from the origin; the base frame is far away: subtract one",
            )
            for stated in (None, "mm", "cm")
        ),
        (POSITION + [35, 2, 0], "m", "far away: subtract one offset"),
        (1e3 * POSITION + [35e3, 0, 0], "mm", "far away: subtract one offset"),
    ],
)
def test_units_that_the_numbers_contradict_and_far_base_frames_are_refused(position, stated, words):
    with refused(f"poses.csv: .*{words}"):
        length_unit(position, stated, "poses.csv")


def test_units_of_angles_follow_from_the_size():
    numbers = numbers_of(ROTATION, "euler:ZYX")
    for factor, unit in ((1.0, "rad"), (np.degrees(1.0), "deg")):
        assert angle_unit(factor * numbers, "euler:ZYX", None, "") == unit
        assert angle_unit(factor * numbers, "euler:ZYX", unit, "") == unit
    with refused("look like degrees: give --pose-units m-deg"):
        angle_unit(np.degrees(numbers), "euler:ZYX", "rad", "poses.csv")
    with refused("look like radians: give --pose-units m-rad"):
        angle_unit(0.5 * numbers, "euler:ZYX", "deg", "poses.csv")
    assert angle_unit(numbers_of(ROTATION, "quat:wxyz"), "quat:wxyz", "deg", "") == "rad"


QUATERNION, RPY, VECTOR = as_numbers("quat:xyzw"), as_numbers("euler:xyz"), as_numbers("rotvec")
MM_DEG, W_FIRST = as_numbers("euler:xyz", 1e3, np.degrees(1)), as_numbers("quat:wxyz")
XYZ, MESSAGE = "x y z", "pose.position.x pose.position.y pose.position.z"
NAMED = {
    "w named first": (W_FIRST, f"{XYZ} qw qx qy qz", "quat:xyzw"),
    "tum": (QUATERNION, "tx ty tz qx qy qz qw", "quat:xyzw"),
    "ethz": (QUATERNION, "x y z q_x q_y q_z q_w", "quat:xyzw"),
    "ros topic": (QUATERNION, MESSAGE + "".join(f" pose.orientation.{axis}" for axis in "xyzw"), "quat:xyzw"),
    "rosbag csv": (QUATERNION, " ".join(f"field.pose.{part}" for part in (
        "position.x", "position.y", "position.z", "orientation.x", "orientation.y", "orientation.z", "orientation.w")),
        "quat:xyzw"),
    "easy_handeye": (QUATERNION, " ".join(f"robot.{part}" for part in (
        "translation.x", "translation.y", "translation.z", "rotation.x", "rotation.y", "rotation.z", "rotation.w")),
        "quat:xyzw"),
    "list with order": (W_FIRST, "xyz.0 xyz.1 xyz.2 quat_wxyz.0 quat_wxyz.1 quat_wxyz.2 quat_wxyz.3", "quat:wxyz"),
    "rpy": (RPY, f"{XYZ} roll pitch yaw", "euler:xyz"),
    "rpy in any order": (RPY[:, [5, 4, 3, 2, 1, 0]], "yaw pitch roll z y x", "euler:xyz"),
    "units in brackets": (MM_DEG, "X[mm] Y[mm] Z[mm] Roll[deg] Pitch[deg] Yaw[deg]", "euler:xyz"),
    "epson": (as_numbers("euler:ZYX", 1e3, np.degrees(1)), "X Y Z U V W", "euler:ZYX"),
    "lerobot": (VECTOR, "ee.x ee.y ee.z ee.wx ee.wy ee.wz", "rotvec"),
    "tvec rvec": (VECTOR, "tvec.0 tvec.1 tvec.2 rvec.0 rvec.1 rvec.2", "rotvec"),
    "R and t": (np.hstack([POSITION, ROTATION.reshape(-1, 9)]),
                "t.0 t.1 t.2 " + " ".join(f"R.{i}.{j}" for i in range(3) for j in range(3)), None),
    "t_vec and a whole transform without translation": (
        np.hstack([POSITION, transform(ROTATION, np.zeros(3)).reshape(-1, 16)]),
        "t_vec.0 t_vec.1 t_vec.2 " + " ".join(f"r_mtx.{i}.{j}" for i in range(4) for j in range(4)), None),
}  # fmt: skip


@pytest.mark.parametrize("name", NAMED)
def test_names_of_columns_state_the_notation(name: str):
    numbers, columns, notation = NAMED[name]
    found = read(table_of(numbers, columns))
    np.testing.assert_allclose(found[0][1], POSES, atol=1e-9)
    if notation is not None:
        ((reading, _),) = found
        assert (reading.notation, reading.inverted, reading.decided_by) == (notation, False, "names")
        assert text_of(reading).startswith((reading.columns and f"{reading.columns}: ") + "x y z in m")


def test_numbers_exclude_what_cannot_be():
    """A quaternion is found among more numbers by its length; angles beyond 2π are no radians."""
    joints = np.random.default_rng(0).uniform(-3, 3, (12, 6))
    found = read(table_of(np.hstack([joints, QUATERNION])))
    assert {reading.notation for reading, _ in found} == {"quat:xyzw", "quat:wxyz"}
    assert sum(np.abs(poses - POSES).max() < 1e-9 for _, poses in found) == 1
    assert {reading.units for reading, _ in read(table_of(MM_DEG))} == {"mm-deg"}
    assert pose_columns(table_of(np.arange(24.0).reshape(12, 2))) == []


def test_units_stated_by_a_name_or_an_option_are_refused_where_numbers_contradict():
    with refused(r"poses.csv: .*too near for mm"):
        read(table_of(RPY, "x_mm y_mm z_mm roll pitch yaw"))
    with refused("look like degrees"):
        read(table_of(MM_DEG, "x y z roll_rad pitch_rad yaw_rad"))
    with refused("too near for cm"):
        read(table_of(RPY, f"{XYZ} roll pitch yaw"), pose_units="cm-rad")
    ((reading, poses),) = read(
        table_of(as_numbers("euler:xyz", 100), f"{XYZ} roll pitch yaw"), pose_units="cm-rad"
    )
    assert reading.units == "cm-rad" and np.allclose(poses, POSES, atol=1e-9)


def test_columns_without_the_numbers_of_the_notation_are_named():
    with refused("no columns hold the 4 numbers of --pose-convention abb; .*euler:xyz"):
        read(table_of(RPY, f"{XYZ} roll pitch yaw"), pose_convention="abb")


BOARD = hand_eye_problem(np.random.default_rng(4), 12).base_from_gripper
OTHER = np.hstack([BOARD[:, :3, 3], Rotation.from_matrix(BOARD[:, :3, :3]).as_quat()])
PARTS = ["x", "y", "z", "qx", "qy", "qz", "qw"]


def test_two_poses_that_could_be_the_robots_are_both_read_and_a_name_chooses():
    names = " ".join(f"{name}.{part}" for name in ("flange", "tcp") for part in PARTS)
    table = table_of(np.hstack([OTHER, QUATERNION]), names)
    assert [reading.columns for reading, _ in read(table)] == ["flange", "tcp"]
    ((reading, poses),) = read(table, pose_columns="tcp")
    assert reading.columns == "tcp" and np.allclose(poses, POSES, atol=1e-9)


@pytest.mark.parametrize(("place", "file", "inverted"), [
    ("base_from_gripper", "a.json", [False]), ("T_gripper2base", "a.json", [False]), ("end2base", "a.json", [False]),
    ("", "O_T_EE.txt", [False]), ("gripper_from_base", "a.json", [True]), ("base2gripper", "a.json", [True]),
    ("", "base_in_gripper.npy", [True]), ("", "poses.npy", [False, True]), ("T", "a.json", [False, True]),
])  # fmt: skip
def test_words_state_the_direction(place: str, file: str, inverted: list[bool]):
    table = table_of(POSES.reshape(12, 16), place=place, file=Path(file))
    found = read(table)
    assert [reading.inverted for reading, _ in found] == inverted
    for reading, poses in found:
        np.testing.assert_allclose(poses, inverse(POSES) if reading.inverted else POSES, atol=1e-9)
    ((reading, poses),) = read(table, pose_inverted=True)
    assert reading.inverted and np.allclose(poses, inverse(POSES), atol=1e-9)


def test_the_configuration_of_a_robtarget_is_no_quaternion():
    """Without rotation, a configuration of ones and zeros has the more exact length."""
    rows = tuple(
        (300.0 + 20 * k, 100.0 - 20 * k, 500.0, -0.1008, -0.4892, 0.8584, -0.1165, 0.0, 0.0, -1.0, 0.0)
        for k in range(5)
    )
    table = Table(file=Path("a.mod"), columns=(None,) * 11, rows=rows, keys=None, words="const robtarget")
    ((reading, poses),) = readings_of(table, ReadOptions(), "a.mod")[1]
    assert reading.notation == "quat:wxyz" and not reading.inverted
    assert np.allclose(poses[:, :3, 3], [[0.3 + 0.02 * k, 0.1 - 0.02 * k, 0.5] for k in range(5)])
