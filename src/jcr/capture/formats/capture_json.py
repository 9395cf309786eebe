"""The capture folder: `capture.json` and the images it names."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from jcr.capture.camera_info import intrinsics_as_json, read_intrinsics, read_std, std_as_json
from jcr.capture.cell_cameras import cameras_as_json, with_cameras
from jcr.capture.checks import checked_capture, read_rigid, require_frames
from jcr.capture.conventions import CONVENTIONS
from jcr.capture.depth_images import depth_of_frames
from jcr.capture.formats import Format
from jcr.capture.options import MAX_FRAMES, ReadOptions
from jcr.capture.plain_files import contained, read_json, shown
from jcr.errors import InputError
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.files import write_bytes, write_new, write_text
from jcr.records import Capture

FILE, URDF = "capture.json", "robot.urdf"
MAX_BYTES = 32_000_000
"""Size of the largest capture.json: a larger one takes long to read, and is no capture."""
MOST_ROTATION = 6 * np.pi + 0.01
"""Largest joint angle, rad: no joint rotates farther to either side."""
OF_EVERY_FORMAT = ("format", "pose_inverted")
"""Options that a capture.json is read by, too."""


def read(path: Path, options: ReadOptions | None = None) -> Capture:
    """Read the capture in a folder, or named by its capture.json; no option changes how (`unused_options`)."""
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    if not file.is_file():
        raise InputError(f"{folder}: holds no capture.json; name a capture folder")
    if (size := file.stat().st_size) > MAX_BYTES:
        raise InputError(
            f"{file}: {size / 1e6:.0f} MB; {MAX_BYTES // 1_000_000} MB at most, which hold {MAX_FRAMES} frames"
        )
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file}: has no list "frames"; expected {{"frames": [...], "intrinsics": ...}}')
    frames, faults = content["frames"], dict[int, str]()
    require_frames(len(frames), str(file), 0)
    images = [_image_name(frame, i, file) for i, frame in enumerate(frames)]
    poses, joints = np.full((len(frames), 4, 4), np.nan), _joints(frames, images, file, faults)
    for i, (name, frame) in enumerate(zip(images, frames, strict=True)):
        where = f"{file}: base_from_gripper of frame {i} ({name})"
        try:
            if "base_from_gripper" not in frame:
                raise InputError(f"{where} is missing; add the gripper pose")
            poses[i] = read_rigid(frame["base_from_gripper"], where)
        except InputError as error:
            faults.setdefault(i, str(error))
    capture, rows = checked_capture(folder, images, poses, str(file), faults)
    joints = None if joints is None else joints[rows]
    used = [i in rows for i in range(len(frames))]
    frames = [frames[i] for i in rows]
    robot, notes = _robot(content.get("robot"), joints, file)
    intrinsics = read_intrinsics(content.get("intrinsics"), capture.image_size, file)
    convention = content.get("pose_convention")
    capture = replace(
        capture,
        pose_convention=convention if isinstance(convention, str) and convention in CONVENTIONS else None,
        intrinsics=intrinsics,
        intrinsics_std=read_std(content.get("intrinsics_std"), intrinsics, file),
        notes=(*capture.notes, *notes),
        joints=joints,
        robot=robot,
        urdf=_urdf(content.get("urdf"), file),
        depths=depth_of_frames(frames, folder, str(file)),
    )
    return with_cameras(capture, content.get("cameras"), file, used)


def unused_options(options: ReadOptions) -> str | None:
    """Return a note on given options that a capture.json does not need; None where there are none."""
    usual = asdict(ReadOptions())
    given = [
        f"--{name.replace('_', '-')}"
        for name, value in asdict(options).items()
        if name not in OF_EVERY_FORMAT and value != usual[name]
    ]
    if not given:
        return None
    are = "is" if len(given) == 1 else "are"
    return f"{' and '.join(given)} {are} not used: capture.json holds 4x4 poses in metres, and its own intrinsics"


def write(folder: Path, capture: Capture, **remarks: Any) -> None:
    """Write capture.json for images that lie in `folder` already; `remarks` are keys that readers ignore."""
    frames: list[dict[str, Any]] = [
        {"image": name, "base_from_gripper": pose.tolist()}
        for name, pose in zip(capture.images, capture.base_from_gripper, strict=True)
    ]
    if capture.joints is not None:
        for frame, row in zip(frames, capture.joints.tolist(), strict=True):
            frame["joints"] = row
    for frame, name in zip(frames, capture.depths or (), strict=False):
        if name is not None:
            frame["depth"] = name
    arm = {} if capture.robot is None else {"robot": capture.robot}
    if capture.urdf is not None:
        # Beside the images, whatever it was called: a capture is complete in its folder.
        if capture.urdf.resolve() != (folder / URDF).resolve():
            write_bytes(folder / URDF, capture.urdf.read_bytes())
        arm["urdf"] = URDF
    intrinsics = None if capture.intrinsics is None else intrinsics_as_json(capture.intrinsics)
    stated: dict[str, Any] = {"frames": frames, "intrinsics": intrinsics}
    if capture.intrinsics_std is not None:
        stated["intrinsics_std"] = std_as_json(capture.intrinsics_std)
    if capture.pose_convention is not None:
        stated["pose_convention"] = capture.pose_convention
    stated |= arm | cameras_as_json(capture) | remarks
    write_text(folder / FILE, json.dumps(stated, indent=1) + "\n")


def origin(folder: Path) -> Path:
    """Return the table or recording whose frames were copied into a capture folder, or the folder itself."""
    content = read_json(folder / FILE) if (folder / FILE).is_file() else {}
    content = content if isinstance(content, dict) else {}
    made_from = content.get("made_from")
    source = made_from[0] if isinstance(made_from, list) and made_from else content.get("source")
    return Path(source) if isinstance(source, str) and source else folder.resolve()


def kept(capture: Capture, folder: Path) -> Capture:
    """Copy the capture into a folder of its own with a capture.json, unless it has one where it lies.

    A run whose capture was read from another format can then go on without that format's options.
    """
    if capture.source is None:
        return capture
    others = (name for camera in capture.others for name in camera.images)
    for name in filter(None, (*capture.images, *(capture.depths or ()), *others)):
        write_new(folder / name, (capture.folder / name).read_bytes())
    write(folder, capture, source=str(capture.source))
    return replace(read(folder), cameras=capture.cameras, notes=capture.notes)


def _joints(
    frames: list[Any], images: list[str], file: Path, faults: dict[int, str]
) -> Float[ndarray, "n dof"] | None:
    """Return joint angles (rad) of all frames, None where no frame has them; frames that lack some are `faults`."""
    rows = dict[int, Float[ndarray, " dof"]]()
    for i, (name, frame) in enumerate(zip(images, frames, strict=True)):
        where = f"{file}: joints of frame {i} ({name})"
        if frame.get("joints") is None:
            faults[i] = f"{where}: no joints; give them for all frames or for none"
            continue
        try:
            rows[i] = read_joints(frame["joints"], where)
        except InputError as error:
            faults[i] = str(error)
            continue
        count = len(next(iter(rows.values())))
        if len(rows[i]) != count:
            faults[i] = f"{where}: {len(rows[i])} angles, but the first frame has {count}; give all of each"
    if not rows and all(frame.get("joints") is None for frame in frames):
        faults.clear()
        return None
    joints = np.full((len(frames), len(next(iter(rows.values()), ()))), np.nan)
    for i in rows.keys() - faults.keys():
        joints[i] = rows[i]
    return joints


def read_joints(value: Any, where: str) -> Float[ndarray, " dof"]:
    """Return joint angles (rad) of one frame from a list; InputError where it holds anything else."""
    try:
        row = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: not numbers; write a list of angles in radians") from None
    if row.ndim != 1 or len(row) == 0 or not np.isfinite(row).all():
        raise InputError(f"{where}: must be a list of finite angles in radians")
    if np.abs(row).max() > MOST_ROTATION:
        raise InputError(f"{where}: up to {np.abs(row).max():.4g} rad; these look like degrees: convert them")
    return row


def _robot(
    name: Any, joints: Float[ndarray, "n dof"] | None, file: Path
) -> tuple[str | None, tuple[str, ...]]:
    """Return the name of a known arm, and a note where it is not known."""
    if name is None:
        return None, ()
    if name not in ROBOT_NAMES:
        return None, (
            f"robot {shown(name)} is not one of {', '.join(ROBOT_NAMES)}: its kinematics are not used",
        )
    dof = arm_named(name).dof
    if joints is not None and joints.shape[1] != dof:
        raise InputError(
            f"{file}: frames have {joints.shape[1]} joints, but a {name} has {dof}; correct either"
        )
    return name, ()


def _urdf(name: Any, file: Path) -> Path | None:
    """Return the path of the URDF inside the capture; InputError where it is not there."""
    if name is None:
        return None
    if not isinstance(name, str):
        raise InputError(f"{file}: urdf must be a path inside the capture, as text")
    contained(file.parent, name, f"{file}: urdf")
    if not (file.parent / name).is_file():
        raise InputError(f"{file}: urdf {name} is not there; add it, or remove the key")
    return file.parent / name


def _image_name(frame: Any, index: int, file: Path) -> str:
    """Return the image of a frame; InputError where it names none."""
    if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
        raise InputError(f'{file}: frame {index} has no "image"; give the image\'s path as text')
    return frame["image"]


def _is_capture(path: Path) -> bool:
    """Return whether a path is a folder with a capture.json, or a JSON file with frames."""
    if path.suffix.lower() != ".json" or not path.is_file():
        return (path / FILE).is_file()
    content = {} if path.name == FILE else read_json(path)
    return path.name == FILE or (isinstance(content, dict) and "frames" in content)


FORMAT = Format(name="capture", about="a folder with capture.json", recognises=_is_capture, read=read)
