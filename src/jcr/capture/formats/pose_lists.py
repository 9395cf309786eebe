"""YAML and JSON lists of poses, and samples of marker-based hand-eye tools, read as rows of named cells.

A list entry is a pose in any of these forms: geometry_msgs/Pose, PoseStamped, Transform and TransformStamped as ROS
prints them, translation with quaternion, rotation vector or angles, a 3x3 rotation with a translation, a 4x4 matrix
(nested or 16 numbers, row by row), or plain numbers. A sample of MoveIt Calibration or easy_handeye2 is a pair of
poses, gripper in base and marker in camera.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jcr.capture.pairing import IMAGE_SUFFIXES
from jcr.capture.plain_files import read_json, read_yaml, shown
from jcr.errors import InputError

SUFFIXES = (".yaml", ".yml", ".json")
PAIRS = (("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking"))
"""Keys of the gripper pose and the marker pose in a sample of MoveIt Calibration and of easy_handeye2."""
_ALIASES = {
    re.compile(r"(?:[tp]_?|(?:pos|position|xyz|translation|tvec)_)([xyz])"): r"\1",
    re.compile(r"(?:q|quat|quaternion|orientation|rotation)_(?:xyzw_|wxyz_)?([xyzw])"): r"q\1",
    re.compile(r"(?:rvec|rotvec|rotation_vector|axis_angle|r|ur)_([xyz])"): r"r\1",
}
"""Patterns of other column names for position, quaternion and rotation vector, and the name that replaces them."""
Entry = dict[str, Any] | list[Any]
"""Cells (texts or numbers) of one pose: a dictionary by the column names of a table, or a list without names."""


def usual_name(column: str) -> str:
    """Return the name that jcr uses for a column of poses: "Position.X" gives "x"; an unknown name in lower case."""
    plain = re.sub(r"[\s.]+", "_", column.strip().strip('"').lower()).strip("_")
    matches = ((pattern.fullmatch(plain), usual) for pattern, usual in _ALIASES.items())
    return next((match.expand(usual) for match, usual in matches if match), plain)


def read_yaml_or_json(file: Path) -> Any:
    """Read a YAML or JSON file; several YAML documents (as `ros2 topic echo` prints) become a list."""
    return read_json(file) if file.suffix.lower() == ".json" else read_yaml(file)


def pair_keys(content: Any) -> tuple[str, str] | None:
    """Return the keys of gripper pose and marker pose in the samples of a YAML or JSON file; None if it has no samples.

    `content` is that of the file. For easy_handeye2 the keys are ("robot", "tracking").
    """
    first = next(iter(_entries(content)), None)
    return next((keys for keys in PAIRS if isinstance(first, dict) and set(keys) <= first.keys()), None)


def read_rows(content: Any, where: str, key: str | None = None) -> tuple[list[str] | None, list[list[Any]]]:
    """Return a list of poses, read from YAML or JSON, as a table: the column names, and a row of cells for each pose.

    The column names are None if the poses are lists of bare numbers. `key` selects the pose in entries with several
    poses; None: an entry is a pose. A missing cell is "". Messages of InputError begin with `where`.
    """
    entries = _entries(content)
    if not entries:
        raise InputError(f"{where}: holds no list of poses; write one entry per image")
    if key is not None:
        entries = [entry.get(key) if isinstance(entry, dict) else None for entry in entries]
    cells = [_entry(entry, f"{where}: entry {k}") for k, entry in enumerate(entries, start=1)]
    first = cells[0]
    if isinstance(first, list):
        return None, [row if isinstance(row, list) else [] for row in cells]
    return list(first), [[row.get(k, "") if isinstance(row, dict) else "" for k in first] for row in cells]


def _entries(content: Any) -> list[Any]:
    """Return the entries (one per image) of the content of a YAML or JSON file; empty if it has none.

    The content is a list, an object that contains a list, or an object that maps image names to poses.
    """
    if isinstance(content, list):
        return content
    if not isinstance(content, dict):
        return []
    if content and all(Path(str(name)).suffix.lower() in IMAGE_SUFFIXES for name in content):
        return [{"image": name, "pose": pose} for name, pose in content.items()]
    lists = (value for value in content.values() if isinstance(value, list) and value)
    return next((value for value in lists if isinstance(value[0], dict | list)), [])


def _entry(entry: Any, where: str) -> Entry:
    """Return one entry of a list of poses as a dictionary from column name to number; a row of bare numbers as a list.

    Raises InputError, begun with `where`, if the entry has no pose, or two values for one column.
    """
    if isinstance(entry, list) and len(entry) not in (3, 4, 12, 16) and all(map(_is_plain, entry)):
        return entry
    cells = dict[str, Any]()
    for name, cell in _cells(entry, ""):
        if cells.setdefault(name, cell) != cell:
            raise InputError(f"{where}: holds two values of {name[:20]}; give one pose per entry")
    if "m00" in cells and "m03" not in cells:  # a 3x3 rotation
        position = {usual_name(name): name for name in cells}
        cells |= {f"m{row}3": cells.pop(position[axis]) for row, axis in enumerate("xyz") if axis in position}
    if not cells:
        text = "is no pose; give position and orientation, or a 4x4 matrix"
        raise InputError(f"{where}: {shown(entry)} {text}")
    return cells


def _cells(value: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Yield column name and cell, such as ("position_x", 0.1), of each number and text in a pose of a YAML or JSON file.

    `value` is the pose or a part of it, such as its rotation, and `key` its key in the file.
    """
    if isinstance(value, dict):
        parts = {str(name).lower(): part for name, part in value.items()}
        if type(parts.get("sec")) is int and type(parts.get("nanosec")) is int:
            yield "timestamp", parts["sec"] * 10**9 + parts["nanosec"]
            return
        for name, part in parts.items():
            if _is_plain(part):
                column = f"{key}_{name}"
                yield (name if usual_name(column) == column else column), part
            else:
                yield from _cells(part, name)
        return
    rows = [row if isinstance(row, list) else [row] for row in value] if isinstance(value, list) else []
    flat, widths = [cell for row in rows for cell in row], {len(row) for row in rows}
    width = {9: 3, 12: 4, 16: 4}.get(len(flat), 0)
    if not all(map(_is_plain, flat)) or not widths <= {1, width}:
        return
    if width:
        yield from ((f"m{k // width}{k % width}", cell) for k, cell in enumerate(flat))
    elif len(flat) == 4:
        order = "wxyz" if key.endswith("wxyz") else "xyzw"
        yield from ((f"q{axis}", cell) for axis, cell in zip(order, flat, strict=True))
    elif len(flat) == 3:
        # Three numbers of a rotation may be a vector or angles; those of an unknown key are the position.
        prefix = {"qx": "r", "rx": f"{key}_"}.get(usual_name(f"{key}_x"), "")
        names = ("roll", "pitch", "yaw") if key == "rpy" else [f"{prefix}{axis}" for axis in "xyz"]
        yield from zip(names, flat, strict=True)


def _is_plain(value: Any) -> bool:
    """Test whether a value is a text or a number, not a truth value."""
    return isinstance(value, str | int | float) and not isinstance(value, bool)
