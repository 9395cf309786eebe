"""Reading a capture, whatever it was written as: the format is known by its files, and each has its own reader."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

from jcr.capture.checks import how_rotated, how_scaled, require_frames, require_motion
from jcr.capture.formats import capture_json
from jcr.capture.formats.colmap import find_model
from jcr.capture.formats.table import find_table, image_names
from jcr.capture.options import MIN_FRAMES, ReadOptions
from jcr.capture.plain_files import read_json, read_yaml
from jcr.capture.table_cells import SUFFIXES
from jcr.errors import InputError
from jcr.geometry import inverse
from jcr.options import checked_options
from jcr.progress import Progress, silent
from jcr.records import Capture, PosePairs
from jcr.records.words import sentence

BAGS = (".bag", ".mcap", ".db3")


@dataclass(frozen=True)
class Format:
    """A row of the table."""

    name: str
    what: str
    reader: str
    """module:function of (path, options), below jcr.capture."""
    recording: bool = False
    """Its images lie inside of a file: the reader also takes the folder to put the chosen ones in."""


FORMATS = {
    row.name: row
    for row in (
        Format("capture", "a folder with capture.json", "formats.capture_json:read"),
        Format("table", "images and a table of gripper poses", "formats.table:read"),
        Format("moveit", "samples of MoveIt Calibration", "formats.samples:read_moveit"),
        Format("easy_handeye2", "samples of easy_handeye2", "formats.samples:read_easy_handeye2"),
        Format("colmap", "a COLMAP model and gripper poses", "formats.colmap:read"),
        Format("bag", "a ROS 1 or ROS 2 bag", "formats.bag:read", recording=True),
        Format("lerobot", "a LeRobot dataset", "formats.lerobot:read", recording=True),
    )
}


def read_capture(
    path: str | Path,
    options: ReadOptions | Mapping[str, Any] | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress | None = None,
) -> Capture:
    """Read the capture at a path, in any format of the page `captures`.

    The images of a recording (bag, LeRobot) are extracted to the new folder `into`, itself a capture folder. Raises
    InputError with the file, the fault and its remedy, if anything is missing, unreadable, of another size, not rigid
    or in millimetres, or if there are fewer than three frames.
    """
    found = read_source(path, options, into=into, progress=progress)
    if isinstance(found, PosePairs):
        raise InputError(
            f"{path}: has camera poses but no images; use `jcr calibrate`, or solve_hand_eye in Python"
        )
    return found


def read_source(
    path: str | Path,
    options: ReadOptions | Mapping[str, Any] | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress | None = None,
    at_least: int = MIN_FRAMES,
) -> Capture | PosePairs:
    """As `read_capture`, and poses of cameras without images where that is what the file holds."""
    path, options = Path(path), checked_options(options, ReadOptions)
    if not path.exists():
        raise InputError(
            f"{path}: no such capture; name a folder that holds a capture.json, or another format"
        )
    if options.frames < 3:
        raise InputError(f"--frames {options.frames}: at least 3 frames are needed, 8 to 15 are good")
    row = FORMATS[format_of(path, options) if options.format == "auto" else options.format]
    module, function = row.reader.split(":")
    reader: Any = getattr(import_module(f"jcr.capture.{module}"), function)
    if not row.recording:
        found = reader(path, options)
        if options.pose_inverted:
            found = replace(found, base_from_gripper=inverse(found.base_from_gripper))
        if not isinstance(found, Capture):
            require_frames(len(found.base_from_gripper), str(path), 0)
            require_motion(found.base_from_gripper, str(path))
            return found
        require_frames(len(found), str(path), at_least)
        require_motion(found.base_from_gripper, str(path))
        rotated = how_rotated(found)
        remarks = (
            None if rotated is None else sentence(rotated),
            how_scaled(found),
            capture_json.unused_options(options) if row.name == "capture" else None,
        )
        return replace(found, notes=(*found.notes, *filter(None, remarks)))
    if into is None:
        raise InputError(f"{path}: its images are inside it; give a folder to extract them to: into=FOLDER")
    return _extracted(path, options, Path(into), reader, progress or silent)


def _extracted(path: Path, options: ReadOptions, into: Path, reader: Any, progress: Progress) -> Capture:
    """The capture of a recording in the folder `into`; taken from there when it was made from the same before."""
    state = path.stat()
    made_from = [
        str(path.resolve()),
        state.st_size,
        state.st_mtime_ns,
        json.loads(json.dumps(asdict(options), default=str)),
    ]
    if not (into / capture_json.FILE).is_file() or _content(into).get("made_from") != made_from:
        capture = reader(path, options, into, progress)
        if options.pose_inverted:
            capture = replace(capture, base_from_gripper=inverse(capture.base_from_gripper))
        capture_json.write(into, capture, notes=capture.notes, made_from=made_from)
    return replace(capture_json.read(into), notes=tuple(_content(into)["notes"]))


def _content(folder: Path) -> dict[str, Any]:
    content = read_json(folder / capture_json.FILE)
    return content if isinstance(content, dict) else {}


def format_of(path: Path, options: ReadOptions | None = None) -> str:
    """The name of the format that the files at a path show; InputError when they show none."""
    return _of_folder(path, options or ReadOptions()) if path.is_dir() else _of_file(path)


def _of_folder(folder: Path, options: ReadOptions) -> str:
    for name, sign in (
        ("capture", "capture.json"),
        ("bag", "metadata.yaml"),
        ("lerobot", "meta/info.json"),
    ):
        if (folder / sign).is_file():
            return name
    if find_model(folder) is not None:
        return "colmap"
    if options.poses is not None or find_table(folder) is not None:
        return "table"
    if any(file.suffix in BAGS for file in folder.iterdir()):
        raise InputError(f"{folder}: holds bags; name one of them")
    if taken := image_names(folder):
        raise InputError(
            f"{folder}: no capture.json and no poses.csv beside its {len(taken)} images ({taken[0]} … {taken[-1]}); "
            "add a table of gripper poses with the columns image,x,y,z,qx,qy,qz,qw (m), or name one with --poses"
        )
    raise InputError(
        f"{folder}: holds no capture.json, nor anything else that jcr reads ({', '.join(FORMATS)}); "
        "see jcr docs captures"
    )


def _of_file(file: Path) -> str:
    suffix = file.suffix.lower()
    if suffix == ".json":
        return "capture"
    if suffix in BAGS:
        return "bag"
    if suffix in SUFFIXES:
        return "table"
    if suffix in (".samples", ".yaml", ".yml"):
        content = read_yaml(file)
        if isinstance(content, list):
            return "moveit"
        if isinstance(content, dict) and "samples" in content:
            return "easy_handeye2"
    raise InputError(
        f"{file}: not recognised by its name or content; give its format with --format "
        f"({', '.join(FORMATS)}), see jcr docs captures"
    )
