"""YAML and JSON lists of poses as rows of named cells, and the samples of marker-based hand-eye tools.

A list entry is a pose in any of these forms: geometry_msgs/Pose, PoseStamped, Transform and TransformStamped as ROS
prints them, translation with quaternion, rotation vector or angles, a 3x3 rotation with a translation, a 4x4 matrix
(nested or 16 numbers, row by row), or plain numbers. A sample of MoveIt Calibration or easy_handeye2 is a pair of
poses, gripper in base and marker in camera.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jcr.capture.pairing import IMAGE_SUFFIXES
from jcr.capture.plain_files import read_json, read_yaml, shown
from jcr.errors import InputError

SUFFIXES = (".yaml", ".yml", ".json", ".samples")
PAIRS = (("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking"))
"""Keys of a sample's gripper pose and marker pose: MoveIt Calibration, easy_handeye2."""
_ROTATIONS = {
    "orientation": "quat", "rotation": "quat", "quaternion": "quat", "quat": "quat", "q": "quat", "quat_xyzw": "quat",
    "quat_wxyz": "wxyz", "rvec": "vector", "rotvec": "vector", "rotation_vector": "vector", "axis_angle": "vector",
    "rpy": "rpy", "euler": "rpy", "roll_pitch_yaw": "rpy",
}  # fmt: skip
"""Notations of a rotation by the names of its key."""
_NAMES = {
    "quat": ("qx", "qy", "qz", "qw"), "wxyz": ("qw", "qx", "qy", "qz"), "vector": ("rvec_x", "rvec_y", "rvec_z"),
    "rpy": ("roll", "pitch", "yaw"),
}  # fmt: skip
Entry = dict[str, str] | list[str]
"""Cells of one pose: by the names of a table's columns, or plain numbers."""


def read_content(file: Path) -> Any:
    """Read a YAML or JSON file; several YAML documents (as `ros2 topic echo` prints) are a list."""
    return read_json(file) if file.suffix.lower() == ".json" else read_yaml(file)


def pair_keys(content: Any) -> tuple[str, str] | None:
    """Return the keys of the two poses of each sample; None where a file's content is no list of samples."""
    entries = _entries(content)
    first = entries[0] if entries else None
    return next((keys for keys in PAIRS if isinstance(first, dict) and set(keys) <= first.keys()), None)


def read_entries(content: Any, where: str, key: str | None = None) -> list[Entry]:
    """Return the cells of every pose of a list, of the part below `key` of each entry where one is given."""
    entries = _entries(content)
    if not entries:
        raise InputError(f"{where}: holds no list of poses; write one entry per image")
    if key is not None:
        entries = [entry.get(key) if isinstance(entry, dict) else None for entry in entries]
    return [_cells(entry, f"{where}: entry {k}") for k, entry in enumerate(entries, start=1)]


def _entries(content: Any) -> list[Any]:
    """Return the entries of a list, of the first list in an object, or of an object that maps images to poses."""
    if isinstance(content, list):
        return content
    if not isinstance(content, dict):
        return []
    if content and all(Path(str(name)).suffix.lower() in IMAGE_SUFFIXES for name in content):
        return [{"image": name, "pose": pose} for name, pose in content.items()]
    lists = (value for value in content.values() if isinstance(value, list) and value)
    return next((value for value in lists if isinstance(value[0], dict | list)), [])


def _cells(entry: Any, where: str) -> Entry:
    """Return the cells of one entry; InputError where it holds no pose."""
    if isinstance(entry, list) and len(entry) not in (3, 4, 12, 16) and all(map(_is_plain, entry)):
        return [_text(value) for value in entry]
    cells = dict[str, str]()
    for name, text in _flattened(entry, ""):
        if cells.setdefault(name, text) != text:
            raise InputError(f"{where}: holds two values of {name[:20]}; give one pose per entry")
    if "m00" in cells and "m03" not in cells and {"x", "y", "z"} <= cells.keys():
        cells |= {f"m{row}3": cells.pop(axis) for row, axis in enumerate("xyz")}
    if not cells:
        raise InputError(
            f"{where}: {shown(entry)} is no pose; give position and orientation, or a 4x4 matrix"
        )
    return cells


def _flattened(value: Any, key: str) -> Iterator[tuple[str, str]]:
    """Yield names and cells of a pose and of its parts; `key` is the key of the value."""
    rotation = _ROTATIONS.get(key)
    if isinstance(value, dict):
        lower = {str(name).lower(): part for name, part in value.items()}
        seconds = next((lower[name] for name in ("sec", "secs") if name in lower), None)
        nanoseconds = next((lower[name] for name in ("nanosec", "nsecs") if name in lower), 0)
        if type(seconds) is int and type(nanoseconds) is int:
            yield "timestamp", str(seconds * 10**9 + nanoseconds)
        elif set("xyzw") <= lower.keys():
            yield from ((f"q{axis}", _text(lower[axis])) for axis in "xyzw")
        elif rotation is not None and set("xyz") <= lower.keys():
            yield from _of_list([lower[axis] for axis in "xyz"], rotation)
        else:
            for name, part in lower.items():
                if name not in dict(PAIRS).values():
                    yield from _flattened(part, name)
    elif isinstance(value, list):
        yield from _of_list(value, rotation)
    elif key and _is_plain(value):
        yield key, _text(value)


def _of_list(value: list[Any], rotation: str | None) -> Iterator[tuple[str, str]]:
    """Yield the cells of a matrix, a quaternion, three numbers of a rotation, or a position."""
    if value and all(isinstance(row, list) for row in value):
        rows, columns = len(value), {len(row) for row in value}
        if rows not in (3, 4) or not columns <= {3, 4} or len(columns) > 1:
            return
        value = [cell for row in value for cell in row]
        width = columns.pop()
    else:
        width = 4 if len(value) in (12, 16) else 0
    if not all(map(_is_plain, value)):
        return
    if width:
        yield from ((f"m{k // width}{k % width}", _text(cell)) for k, cell in enumerate(value))
    elif len(value) == 4:
        yield from zip(_NAMES[rotation or "quat"], map(_text, value), strict=False)
    elif len(value) == 3:
        of_rotation = ("rx", "ry", "rz") if rotation in (None, "quat", "wxyz") else _NAMES[rotation]
        names = ("x", "y", "z") if rotation is None else of_rotation
        yield from zip(names, map(_text, value), strict=True)


def _is_plain(value: Any) -> bool:
    """Return whether a value is text or a number."""
    return isinstance(value, str | int | float) and not isinstance(value, bool)


def _text(value: Any) -> str:
    """Return the text of a cell."""
    return value if isinstance(value, str) else repr(value)
