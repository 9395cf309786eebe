"""Capture folder: `capture.json` and the images that it names."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from jcr.capture.checks import checked_capture, require_frames
from jcr.capture.images import read_image, size_of_all
from jcr.capture.options import ReadOptions
from jcr.errors import InputError, count_of, did_you_mean, shown
from jcr.estimation.arms import ROBOT_NAMES, arm_named
from jcr.files import capture_file, path_inside, read_bytes, write_new
from jcr.records import Capture, CellCamera
from jcr.records.capture_schema import (
    CameraEntries,
    CameraEntry,
    CaptureFile,
    FrameEntry,
    IntrinsicsEntry,
    StdEntry,
)
from jcr.records.json_file import read_json, validated_content

FILE, URDF = "capture.json", "robot.urdf"
_CAMERAS = TypeAdapter(CameraEntries)


def recognises(path: Path) -> bool:
    """Test whether a path is a folder with a capture.json, or a JSON file with the key "frames"."""
    if path.name == FILE or path.suffix.lower() != ".json" or not path.is_file():
        return (path if path.name == FILE else path / FILE).is_file()
    content = read_json(path)
    return isinstance(content, dict) and "frames" in content


def read_capture_json(file: Path) -> CaptureFile:
    """Read a capture.json; raise InputError if the file is missing or does not fit the schema.

    Of the frames, only the image names are checked; `frame_of` validates the rest.
    """
    if not file.is_file():
        raise InputError(f"{file.parent}: holds no capture.json; name a capture folder")
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list):
        raise InputError(f'{file}: has no list "frames"; expected {{"frames": [...], "intrinsics": ...}}')
    for row, frame in enumerate(content["frames"]):
        if not isinstance(frame, dict) or not isinstance(frame.get("image"), str):
            raise InputError(f'{file}: frame {row} has no "image"; give the image\'s path as text')
    if misplaced := sorted(
        (CameraEntry.model_fields.keys() - CaptureFile.model_fields.keys()) & content.keys()
    ):
        raise InputError(
            f'{file}: "{misplaced[0]}" belongs to a camera; write "cameras": {{"NAME": {{"mount": "base"}}}}'
        )
    return validated_content(CaptureFile, content, str(file))


def frame_of(content: CaptureFile, row: int, file: Path) -> FrameEntry:
    """Return the validated frame `row` (from 0) of a capture.json; raise InputError that names its image if invalid."""
    where = f"{file}: frame {row} ({content.frames[row]['image']})"
    return validated_content(FrameEntry, content.frames[row], where)


def read(path: Path, options: ReadOptions | None = None) -> Capture:
    """Read the capture in a folder, or the one of a capture.json; the options have no effect.

    A few frames that cannot be used are left out with a note. Raises InputError for any other fault.
    """
    folder, file = (path, path / FILE) if path.is_dir() else (path.parent, path)
    content = read_capture_json(file)
    count = len(content.frames)
    require_frames(count, str(file), 0)
    images = [frame["image"] for frame in content.frames]
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
    notes = (*capture.notes, *stated.pop("notes"), *_unknown_keys(content, str(file)))
    capture = replace(capture, **stated, notes=notes)
    if content.cameras is None:
        return capture
    return with_cameras(capture, content.cameras, str(file), [row in rows for row in range(count)])


def _unknown_keys(content: CaptureFile, where: str) -> list[str]:
    """Return a note for each key that is similar to a known one that is not there, so probably misspelt.

    Other keys are remarks, such as a base_from_camera beside base_from_gripper.
    """
    frames = {key for frame in content.frames for key in frame}
    camera = content.intrinsics
    given = content.model_extra or {}, frames, (camera and camera.model_extra) or {}
    known = CaptureFile.model_fields, FrameEntry.model_fields, IntrinsicsEntry.model_fields
    return [
        f"{where}: {shown(key)} is not used{meant}"
        for keys, names in zip(given, known, strict=True)
        for key in sorted(set(keys) - names.keys())
        if (meant := did_you_mean(key, names.keys() - keys))
    ]


def stated_fields(
    content: CaptureFile, frames: Sequence[FrameEntry], size: tuple[int, int], file: Path
) -> dict[str, Any]:
    """Return the optional fields of Capture from a capture.json, as keyword arguments: intrinsics, joints, robot, ….

    The cameras of the entry "cameras" are not included (see `with_cameras`).
    """
    angles = [frame.joints for frame in frames if frame.joints is not None]
    joints = np.array(angles) if angles and len(angles) == len(frames) else None
    robot, notes = content.robot, ()
    if robot is not None and robot not in ROBOT_NAMES:
        known = ", ".join(ROBOT_NAMES)
        robot, notes = None, (f"robot {shown(robot)} is not one of {known}: its kinematics are not used",)
    if robot is not None and joints is not None and joints.shape[1] != (dof := arm_named(robot).dof):
        text = f"frames have {count_of(joints.shape[1], 'joint')}, but a {robot} has {dof}; correct either"
        raise InputError(f"{file}: {text}")
    depths = tuple(frame.depth for frame in frames)
    return _stated_intrinsics(content, size, str(file)) | {
        "joints": joints,
        "robot": robot,
        "urdf": None if content.urdf is None else _inside(file.parent, content.urdf, f"{file}: urdf"),
        "depths": depths if any(depths) else None,
        "reading": content.reading,
        "frame_names": content.frame_names,
        "notes": notes,
    }


def with_cameras(capture: Capture, cameras: Any, where: str, used: Sequence[bool] | None = None) -> Capture:
    """Return the capture with the other cameras from `cameras`, the entry "cameras" of a capture.json.

    `used` is True for each frame of the file that the capture contains; None: it contains all. Raises InputError if the
    entry is invalid.
    """
    entries: dict[str, CameraEntry] = validated_content(_CAMERAS, cameras, f"{where}: cameras")
    own = next((name for name, entry in entries.items() if entry.is_own), None)
    if own is not None:
        capture = replace(capture, camera_name=own, mount=entries.pop(own).mount)
    elif capture.camera_name in entries:
        raise InputError(f"{where}: camera {capture.camera_name} is the frames' own; rename the other")
    used = [True] * len(capture) if used is None else used
    others = [_camera(name, one, capture, f"{where}: camera {name}", used) for name, one in entries.items()]
    return replace(capture, others=tuple(others))


def _camera(name: str, entry: CameraEntry, capture: Capture, where: str, used: Sequence[bool]) -> CellCamera:
    """Return the camera `name` from its entry in "cameras"; raise InputError if its image sizes differ."""
    poses, frame, watches = None, None, capture.mount == "base"
    if watches is not (entry.watches == "gripper" or (watches and entry.watches is None)):
        raise InputError(
            f"{where}: the frames' own camera watches the {'gripper' if watches else 'scene'}, and this one something "
            "else; make a capture for each"
        )
    if watches and entry.mount == "gripper":
        raise InputError(
            f"{where}: is on the gripper, which the frames' camera watches; make one capture each"
        )
    listed: Sequence[str | None] = entry.images or ()
    if entry.frames is not None:
        listed = [one.image for one in entry.frames]
        poses = np.array([one.base_from_gripper for one in entry.frames])
    elif entry.mount == "gripper" or watches:
        if len(listed) != len(used):
            raise InputError(
                f"{where}: {count_of(len(listed), 'image')} for {count_of(len(used), 'frame')}; give one each, or null"
            )
        listed = [image for image, is_used in zip(listed, used, strict=True) if is_used]
        frame = np.flatnonzero([image is not None for image in listed])
    images = [image for image in listed if image is not None]
    require_frames(len(images), where, 1)
    for image in images:
        capture_file(capture.folder, image, where)
    if len(set(images)) < len(images) or set(images) & set(capture.images):
        raise InputError(f"{where}: an image is named twice, or is one of the frames' own")
    size = size_of_all({name: read_image(capture.folder / name).shape[1::-1] for name in images}, where)
    return CellCamera(
        name=name,
        mount=entry.mount,
        images=tuple(images),
        image_size=size,
        frame=frame,
        arm=entry.arm,
        base_from_gripper=poses,
        **_stated_intrinsics(entry, size, where),
    )


def _stated_intrinsics(
    stated: CaptureFile | CameraEntry, size: tuple[int, int], where: str
) -> dict[str, Any]:
    """Return the intrinsics of an entry in a capture.json as the fields `intrinsics` and `intrinsics_std` of Capture.

    `intrinsics` is None, and `intrinsics_std` is missing, where the entry `stated` has none.
    """
    given, std = stated.intrinsics, stated.intrinsics_std
    intrinsics = None if given is None else given.record(size, f"{where}: intrinsics")
    if std is None:
        return {"intrinsics": intrinsics}
    where = f"{where}: intrinsics_std"
    if intrinsics is None:
        raise InputError(f"{where}: there are no intrinsics whose errors these are; give both or none")
    if (missing := len(intrinsics.distortion) - len(std.distortion)) < 0:
        raise InputError(f"{where}: distortion has at most {count_of(len(intrinsics.distortion), 'number')}")
    values = [std.fx, std.fy, std.cx, std.cy, *std.distortion, *[None] * missing]
    return {"intrinsics": intrinsics, "intrinsics_std": np.array(values, np.float64)}


def _intrinsics_entries(record: Capture | CellCamera) -> dict[str, Any]:
    """Return the entries "intrinsics" and "intrinsics_std" of capture.json for the intrinsics of a capture or camera."""
    given, std = record.intrinsics, record.intrinsics_std
    entries: dict[str, Any] = {"intrinsics": None if given is None else IntrinsicsEntry.of(given)}
    if std is not None:
        fx, fy, cx, cy, *distortion = (None if np.isnan(value) else value for value in std.tolist())
        entries["intrinsics_std"] = StdEntry(fx=fx, fy=fy, cx=cx, cy=cy, distortion=distortion)
    return entries


def camera_entries(capture: Capture) -> dict[str, CameraEntry]:
    """Return the entry "cameras" of a capture.json, by camera name; empty if the wrist camera is the only one.

    Otherwise the first entry is the capture's own camera, without images.
    """
    if not capture.others and capture.mount == "gripper":
        return {}
    entries = {capture.camera_name: CameraEntry(mount=capture.mount)}
    for camera in capture.others:
        if camera.base_from_gripper is not None:
            pairs = zip(camera.images, camera.base_from_gripper, strict=True)
            frames = [FrameEntry(image=image, base_from_gripper=pose) for image, pose in pairs]
            listed: dict[str, Any] = {"arm": camera.arm, "frames": frames}
        elif camera.frame is None:
            listed = {"images": [*camera.images]}
        else:
            at = dict(zip(camera.frame.tolist(), camera.images, strict=True))
            listed = {"images": [at.get(row) for row in range(len(capture))]}
        entries[camera.name] = CameraEntry(mount=camera.mount, **listed, **_intrinsics_entries(camera))
    return entries


def write(folder: Path, capture: Capture, **remarks: Any) -> None:
    """Write the capture.json of a capture whose images are in `folder` already, and copy the arm's URDF beside it.

    `remarks` are further entries of the file, which readers of captures ignore.
    """
    urdf = capture.urdf
    if urdf is not None and urdf.resolve() != (folder / URDF).resolve():
        write_new(
            path_inside(folder, URDF, str(folder)), read_bytes(urdf)
        )  # so that the folder contains the whole capture
    write_new(folder / FILE, _content(capture, **remarks).as_text().encode())


def _content(capture: Capture, **remarks: Any) -> CaptureFile:
    """Return the content of the capture.json that states a capture, with `remarks` as further entries."""
    frames = []
    for row, (name, pose) in enumerate(zip(capture.images, capture.base_from_gripper, strict=True)):
        more: dict[str, Any] = {} if capture.joints is None else {"joints": capture.joints[row].tolist()}
        if capture.depths is not None and capture.depths[row] is not None:
            more["depth"] = capture.depths[row]
        frames.append(FrameEntry.model_validate({"image": name, "base_from_gripper": pose} | more))
    named = {key: name for key, name in vars(capture.frame_names).items() if name is not None}
    optional = {
        "reading": capture.reading,
        "frame_names": named or None,
        "robot": capture.robot,
        "urdf": None if capture.urdf is None else URDF,
        "cameras": camera_entries(capture) or None,
    }
    stated = {key: value for key, value in optional.items() if value is not None} | remarks
    return CaptureFile(frames=frames, **_intrinsics_entries(capture), **stated)


def _is_stated(capture: Capture) -> bool:
    """Test whether the capture.json in the folder of a capture states the same frames, intrinsics, arm and cameras."""
    file = capture.folder / FILE
    if not file.is_file():  # a program made the record of its own images and poses
        return False
    content = read_capture_json(file)
    if content.cameras or len(content.frames) != len(capture):
        stated = read(capture.folder)  # decodes all images, which tell the frames that cannot be used
    else:
        frames = [frame_of(content, row, file) for row in range(len(capture))]
        images, poses = zip(*((one.image, one.base_from_gripper) for one in frames), strict=True)
        fields = stated_fields(content, frames, capture.image_size, file)
        stated = replace(capture, images=images, base_from_gripper=np.array(poses), **fields)
    return stated.urdf == capture.urdf and _content(stated).as_text() == _content(capture).as_text()


def origin(folder: Path) -> Path:
    """Return the table or recording from which a capture folder was made; the folder itself if it has no origin."""
    try:
        return Path(read_json(folder / FILE)["made_from"][0])
    except (InputError, KeyError, IndexError, TypeError):
        return folder.resolve()


def kept(capture: Capture, folder: Path) -> Capture:
    """Copy the images of a capture that no capture.json states into `folder`, write one, and return the copy.

    A capture that the capture.json in its folder states is returned unchanged, without a copy. Others were read from
    another format, or changed in Python since, as by `Capture.of_rows`; later commands on a run read what is copied.
    """
    if capture.source is None and _is_stated(capture):
        return capture
    others = (name for camera in capture.others for name in camera.images)
    names = [*filter(None, (*capture.images, *(capture.depths or ()), *others))]
    where = str(capture.source or capture.folder)
    sources = [capture_file(capture.folder, name, where) for name in names]
    copies = [path_inside(folder, name, where) for name in names]
    for source, copy in zip(sources, copies, strict=True):  # after every name was checked
        write_new(copy, read_bytes(source))
    write(folder, capture, made_from=[where])
    return replace(read(folder), notes=capture.notes, untaken=capture.untaken)


def _inside(folder: Path, name: str, where: str) -> Path:
    """Return the path `folder/name`; raise InputError if the folder has no such file."""
    if not (file := capture_file(folder, name, where)).is_file():
        raise InputError(f"{where}: {name} is not there; add it, or remove the key")
    return file
