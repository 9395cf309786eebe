"""Reading of captures: the files show the format, and each format has its own reader."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, TypeVar

from jcr.capture import folder as folders
from jcr.capture import marker_samples
from jcr.capture.checks import require_frames, require_motion
from jcr.capture.discovery import IMAGE_SUFFIXES
from jcr.capture.formats import bag, capture_json, lerobot
from jcr.capture.notations import notation_of
from jcr.capture.options import MIN_FRAMES, ReadOptions
from jcr.errors import InputError, first_few
from jcr.files import as_path
from jcr.findings.finding import joined
from jcr.geometry import inverse
from jcr.options import checked_options
from jcr.progress import Progress, silent
from jcr.records import Capture, PosePairs, Reading

Read = TypeVar("Read", Capture, PosePairs)
READERS: dict[str, Any] = {
    "capture": capture_json,
    "bag": bag,
    "lerobot": lerobot,
    "samples": marker_samples,
    "table": folders,
}
"""Reader module of each format, in the order in which the formats are tested."""
RECORDINGS = ("bag", "lerobot")
"""Formats whose images are stored inside a file and are extracted on reading."""
OF_RECORDINGS = ("frames", "episode", "camera_topic", "joint_topic")
"""Options of reading that concern recordings alone."""
STATED = ("pose_convention", "pose_units", "poses", "pose_columns", "camera_info", "mount", "urdf")
"""Options of reading whose values a capture.json states itself."""


def read_capture(
    path: str | Path,
    options: ReadOptions | Mapping[str, Any] | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress = silent,
    at_least: int = MIN_FRAMES,
) -> Capture:
    """Read the capture at a path, in any format of the manual's page `captures`.

    The images of a recording (bag, LeRobot) are extracted to the new folder `into`, itself a capture folder. A few
    frames that cannot be used are left out, each with a note. Raises InputError with the file, the fault and its remedy
    for any other fault, and if fewer than `at_least` frames remain.
    """
    found = read_source(path, options, into=into, progress=progress, at_least=at_least)
    if isinstance(found, PosePairs):
        raise InputError(f"{path}: has camera poses but no images; use `jcr calibrate` or solve_hand_eye")
    return found


def read_source(
    path: str | Path,
    options: ReadOptions | Mapping[str, Any] | None = None,
    *,
    into: str | Path | None = None,
    progress: Progress = silent,
    at_least: int = MIN_FRAMES,
) -> Capture | PosePairs:
    """Return the capture at a path, or PosePairs if the file has camera poses but no images.

    The arguments are those of `read_capture`. A recording is not extracted again if `into` holds the frames of the same
    files and options already.
    """
    path, options = as_path(path, "capture"), checked_options(options, ReadOptions)
    if not path.exists():
        raise InputError(
            f"{path}: no such capture; name a folder with a capture.json, or a file or folder of another format "
            "(jcr docs captures)"
        )
    if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES:
        raise InputError(f"{path}: is one image; name the folder that holds all images and the gripper poses")
    name = format_of(path) if options.format == "auto" else options.format
    _require_fitting(path, name, options)
    if name not in RECORDINGS:
        folder, origin, found = None, [], READERS[name].read(path, options)
    elif into is None:
        raise InputError(f"{path}: its images are inside it; give a folder to extract them to: into=FOLDER")
    else:
        folder, origin = as_path(into, "into"), _origin(path, options)
        file = folder / capture_json.FILE
        extra = (capture_json.read_capture_json(file).model_extra or {}) if file.is_file() else {}
        if extra.get("made_from") == origin:
            return replace(capture_json.read(folder), notes=tuple(extra["notes"]))
        found = READERS[name].read(path, options, folder, progress)
    found = _as_asked(found, path, options)
    if folder is not None:
        capture_json.write(folder, found, notes=found.notes, made_from=origin)
        return replace(capture_json.read(folder), notes=found.notes)
    require_frames(len(found), str(path), at_least)
    if isinstance(found, PosePairs) or not found.candidates:
        require_motion(found.base_from_gripper, str(path))
    return found


def _as_asked(found: Read, path: Path, options: ReadOptions) -> Read:
    """Return what was read at a path with the inverted poses, the mount and the names of frames of the options."""
    is_unread = isinstance(found, Capture) and found.reading is None and not found.candidates
    if options.pose_inverted and is_unread:
        read = Reading(file=path.name, inverted=True, decided_by="option")
        found = replace(found, base_from_gripper=inverse(found.base_from_gripper), reading=read)
    if options.mount == "base":
        if isinstance(found, PosePairs):
            raise InputError(f"--mount base: is for images; {path} has poses of a marker alone; leave it out")
        found = replace(found, mount="base")
    names = {"base": options.base_frame, "gripper": options.gripper_frame}
    return replace(found, frame_names=found.frame_names.replaced(**names))


def _require_fitting(path: Path, name: str, options: ReadOptions) -> None:
    """Raise InputError for options of reading that are wrong, or do not concern a capture of the format `name`."""
    if options.frames < MIN_FRAMES:
        raise InputError(f"--frames {options.frames}: at least {MIN_FRAMES} are needed; take 5 to 15")
    if options.pose_convention != "auto":
        notation_of(options.pose_convention)  # a wrong name is an error, also for formats that do not need it
    default = ReadOptions()
    given = [
        field.name
        for field in fields(options)
        if getattr(options, field.name) != getattr(default, field.name)
    ]
    if name == "capture" and (stated := [one for one in given if one in STATED]):
        flags = joined([f"--{one.replace('_', '-')}" for one in stated])
        raise InputError(
            f"{path}: its capture.json states poses, intrinsics and mount itself, and {flags} would change them; "
            "correct capture.json, or leave the option out (jcr docs captures)"
        )
    if name not in RECORDINGS and (excess := [one for one in given if one in OF_RECORDINGS]):
        flag = f"--{excess[0].replace('_', '-')}"
        raise InputError(f"{path}: {flag} is for bags and data sets, which this is not; leave it out")


def format_of(path: Path) -> str:
    """Return the name of the capture format at a path, such as "table".

    Raises InputError for a folder of bags, and for a folder of captures without images of its own.
    """
    for name in ("capture", "bag", "lerobot", "samples"):
        if READERS[name].recognises(path):
            return name
    if path.is_dir() and any(bag.recognises(file) for file in path.iterdir()):
        raise InputError(f"{path}: holds bags; name one of them")
    inside = sorted(str(file.parent) for file in path.glob(f"*/{capture_json.FILE}"))
    if inside and not any(file.suffix.lower() in IMAGE_SUFFIXES for file in path.iterdir()):
        raise InputError(f"{path}: holds captures, not images; did you mean {first_few(inside)}?")
    return "table"


def _origin(path: Path, options: ReadOptions) -> list[Any]:
    """Return the entry made_from of an extracted capture: path of the recording, digest of its files, and options."""
    sources = [path, *filter(None, (options.urdf, options.camera_info))]
    files = [file for one in sources for file in ([one] if one.is_file() else sorted(one.rglob("*")))]
    states = [(str(one), (state := one.stat()).st_size, state.st_mtime_ns) for one in files if one.is_file()]
    digest = hashlib.sha256(json.dumps(states).encode()).hexdigest()
    return [str(path.resolve()), digest, json.loads(json.dumps(asdict(options), default=str))]
