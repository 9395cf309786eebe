"""The capture folder: `capture.json` and the images that it names."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from jcr.capture.camera_info import IntrinsicsEntry, StdEntry
from jcr.capture.cell_cameras import cameras_as_json, with_cameras
from jcr.capture.checks import RigidMatrix, checked_capture, require_frames
from jcr.capture.conventions import CONVENTIONS
from jcr.capture.formats import Format
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import contained, read_json, shown, validated
from jcr.errors import InputError
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.files import write_new
from jcr.records import Capture

FILE, URDF = "capture.json", "robot.urdf"
MOST_ROTATION = 6 * np.pi + 0.01
"""Largest joint angle, rad: no joint rotates farther to either side."""


def _plausible(angles: list[float]) -> list[float]:
    """Return joint angles (rad); raise ValueError where they look like degrees."""
    if (largest := max(map(abs, angles))) > MOST_ROTATION:
        raise ValueError(f"up to {largest:.4g} rad; these look like degrees: convert them")
    return angles


class FrameEntry(BaseModel):
    """Frame of a capture.json: an image with the data recorded at it."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False)
    image: str
    """Path in the folder of the capture."""
    base_from_gripper: RigidMatrix
    joints: Annotated[list[float], Field(min_length=1), AfterValidator(_plausible)] | None = None
    """Joint angles (rad), from the base on."""
    depth: str | None = None
    """Path of a depth camera's image."""
    time_s: float | None = None
    """Time on the camera's clock."""


class CaptureFile(BaseModel):
    """Content of a capture.json; other keys are kept."""

    model_config = ConfigDict(strict=True, frozen=True, allow_inf_nan=False, extra="allow")
    frames: list[Any]
    """Entries that FrameEntry validates one by one, so that a few of them may be faulty."""
    intrinsics: IntrinsicsEntry | None = None
    intrinsics_std: StdEntry | None = None
    pose_convention: Any = None
    robot: Any = None
    urdf: str | None = None
    cameras: dict[str, Any] | None = None

    def as_text(self) -> str:
        """Return the text of the file."""
        return json.dumps(self.model_dump(mode="json", exclude_unset=True), indent=1) + "\n"


def read_content(file: Path) -> CaptureFile:
    """Read a capture.json; raise InputError where the file is none."""
    if not file.is_file():
        raise InputError(f"{file.parent}: holds no capture.json; name a capture folder")
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file}: has no list "frames"; expected {{"frames": [...], "intrinsics": ...}}')
    return validated(CaptureFile, content, str(file))


def frame_of(content: CaptureFile, row: int, file: Path) -> FrameEntry:
    """Return a frame of a capture.json; raise InputError that names its image where the frame cannot be used."""
    return validated(
        FrameEntry, content.frames[row], f"{file}: frame {row} ({_image_name(content, row, file)})"
    )


def read(path: Path, options: ReadOptions | None = None) -> Capture:
    """Read the capture in a folder, or named by its capture.json; no option changes how."""
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    content = read_content(file)
    count = len(content.frames)
    require_frames(count, str(file), 0)
    images = [_image_name(content, row, file) for row in range(count)]
    frames, faults = dict[int, FrameEntry](), dict[int, str]()
    for row in range(count):
        try:
            frames[row] = frame_of(content, row, file)
        except InputError as error:
            faults[row] = str(error)
    dof = next((len(frame.joints) for frame in frames.values() if frame.joints), 0)
    for row, frame in frames.items():
        if (angles := len(frame.joints or ())) != dof:
            what = f"{angles or 'no'} joint angles, others have {dof}; give them for all or for none"
            faults[row] = f"{file}: frame {row} ({images[row]}): {what}"
    poses = np.full((count, 4, 4), np.nan)
    for row in frames.keys() - faults.keys():
        poses[row] = frames[row].base_from_gripper
    capture, rows = checked_capture(folder, images, poses, str(file), faults)
    for row in rows:
        if (depth := frames[row].depth) is not None:
            _inside(folder, depth, f"{file}: depth of frame {row}")
    stated = stated_fields(content, [frames[row] for row in rows], capture.image_size, file)
    notes = (*capture.notes, *stated.pop("notes"))
    capture = replace(capture, **stated, notes=notes)
    if content.cameras is None:
        return capture
    return with_cameras(capture, content.cameras, str(file), [row in rows for row in range(count)])


def stated_fields(
    content: CaptureFile, frames: Sequence[FrameEntry], size: tuple[int, int], file: Path
) -> dict[str, Any]:
    """Return the fields of the Capture of some frames that a capture.json states, other cameras apart."""
    intrinsics = None
    if content.intrinsics is not None:
        intrinsics = content.intrinsics.record(size, f"{file}: intrinsics")
    std = content.intrinsics_std
    angles = [frame.joints for frame in frames if frame.joints is not None]
    joints = np.array(angles) if angles and len(angles) == len(frames) else None
    robot, notes = content.robot, ()
    if robot is not None and robot not in ROBOT_NAMES:
        known = ", ".join(ROBOT_NAMES)
        robot, notes = None, (f"robot {shown(robot)} is not one of {known}: its kinematics are not used",)
    if robot is not None and joints is not None and joints.shape[1] != (dof := arm_named(robot).dof):
        text = f"frames have {joints.shape[1]} joints, but a {robot} has {dof}; correct either"
        raise InputError(f"{file}: {text}")
    urdf = None if content.urdf is None else _inside(file.parent, content.urdf, f"{file}: urdf")
    depths = tuple(frame.depth for frame in frames)
    convention = content.pose_convention
    return {
        "intrinsics": intrinsics,
        "intrinsics_std": None if std is None else std.array(intrinsics, f"{file}: intrinsics_std"),
        "joints": joints,
        "robot": robot,
        "urdf": urdf,
        "depths": depths if any(depths) else None,
        "pose_convention": convention if isinstance(convention, str) and convention in CONVENTIONS else None,
        "notes": notes,
    }


def write(folder: Path, capture: Capture, **remarks: Any) -> None:
    """Write capture.json for images that lie in `folder` already; `remarks` are keys that readers ignore."""
    frames = []
    for row, (name, pose) in enumerate(zip(capture.images, capture.base_from_gripper, strict=True)):
        more: dict[str, Any] = {} if capture.joints is None else {"joints": capture.joints[row].tolist()}
        if capture.depths is not None and capture.depths[row] is not None:
            more["depth"] = capture.depths[row]
        frames.append(FrameEntry.model_validate({"image": name, "base_from_gripper": pose} | more))
    given, std, urdf = capture.intrinsics, capture.intrinsics_std, capture.urdf
    if urdf is not None and urdf.resolve() != (folder / URDF).resolve():
        write_new(folder / URDF, urdf.read_bytes())  # a capture is complete in its folder
    optional = {
        "intrinsics_std": None if std is None else StdEntry.of(std),
        "pose_convention": capture.pose_convention,
        "robot": capture.robot,
        "urdf": None if urdf is None else URDF,
        "cameras": cameras_as_json(capture) or None,
    }
    stated = {key: value for key, value in optional.items() if value is not None} | remarks
    intrinsics = None if given is None else IntrinsicsEntry.of(given)
    write_new(folder / FILE, CaptureFile(frames=frames, intrinsics=intrinsics, **stated).as_text().encode())


def origin(folder: Path) -> Path:
    """Return the table or recording whose frames were copied into a capture folder, or the folder itself."""
    try:
        return Path(read_json(folder / FILE)["made_from"][0])
    except (InputError, KeyError, IndexError, TypeError):
        return folder.resolve()


def kept(capture: Capture, folder: Path) -> Capture:
    """Copy the capture into a folder of its own with a capture.json, unless it has one where it lies.

    A run whose capture was read from another format can then go on without that format's options.
    """
    if capture.source is None:
        return capture
    others = (name for camera in capture.others for name in camera.images)
    for name in filter(None, (*capture.images, *(capture.depths or ()), *others)):
        write_new(folder / name, (capture.folder / name).read_bytes())
    write(folder, capture, made_from=[str(capture.source)])
    return replace(read(folder), cameras=capture.cameras, notes=capture.notes)


def _inside(folder: Path, name: str, where: str) -> Path:
    """Return a file of the folder; raise InputError where the folder has no such file."""
    if not (file := contained(folder, name, where)).is_file():
        raise InputError(f"{where}: {name} is not there; add it, or remove the key")
    return file


def _image_name(content: CaptureFile, row: int, file: Path) -> str:
    """Return the image of a frame; raise InputError where it names none."""
    frame = content.frames[row]
    if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
        raise InputError(f'{file}: frame {row} has no "image"; give the image\'s path as text')
    return frame["image"]


def _is_capture(path: Path) -> bool:
    """Return whether a path is a folder with a capture.json, or a JSON file with frames."""
    if path.name == FILE or path.suffix.lower() != ".json" or not path.is_file():
        return (path if path.name == FILE else path / FILE).is_file()
    content = read_json(path)
    return isinstance(content, dict) and "frames" in content


FORMAT = Format(name="capture", about="a folder with capture.json", recognises=_is_capture, read=read)
