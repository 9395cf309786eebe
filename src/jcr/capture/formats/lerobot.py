"""LeRobot data sets v2.1 and v3.0: videos or images of a wrist camera, with poses or joint angles frame by frame."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from jcr.capture.camera_info import read_camera_info
from jcr.capture.joints import read_arm
from jcr.capture.lerobot_files import Episode, Feature, images_in_table, read_episode, read_info
from jcr.capture.options import ReadOptions
from jcr.capture.pose_table import poses_of_columns
from jcr.capture.pose_track import pose_track, speed
from jcr.capture.recorded_cameras import ImagesOfRows, RecordedCamera, asked_cameras, camera_names
from jcr.capture.recording import Recording, capture_of_recording
from jcr.capture.robot_poses import CONVENTIONS
from jcr.capture.video import frames_at
from jcr.errors import InputError
from jcr.progress import Progress
from jcr.records import Capture

CARTESIAN = "observation.state.cartesian_position"
"""DROID's: x, y, z (m), roll, pitch, yaw (rad) of the gripper in the robot's base."""
STATE = "observation.state"


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """The best frames of the chosen episodes in the folder `into`.

    Raises InputError listing the cameras, states or episodes that there are where those of the options are not.
    """
    info, asked = read_info(path), asked_cameras(options)
    camera = _camera(info.features, options, list(asked), path)
    key = _state_key(info.features, options, path)
    episodes = [read_episode(path, info, camera, key, index) for index in options.episode]
    state = np.concatenate([episode.state for episode in episodes])
    poses, joints = _poses(state, key, info.features[key], options, path)
    motion = np.concatenate(
        [_speed(episode, poses[part]) for episode, part in zip(episodes, _rows(episodes), strict=True)]
    )

    names = [
        f"episode_{episode.index:06d}_frame_{k:06d}"
        for episode in episodes
        for k in range(len(episode.time_s))
    ]
    own, *further = camera_names([camera, *asked])
    others = []
    for name, (other, mount) in zip(further, asked.items(), strict=True):
        if mount is None:
            raise InputError(
                f"{path}: a data set does not tell what carries {other}; write --further-cameras {other}=base for a "
                f"fixed camera, {other}=gripper for one on the gripper"
            )
        theirs = [read_episode(path, info, other, key, index) for index in options.episode]
        others.append(RecordedCamera(name, mount, _images_of(theirs, other, info.fps), lambda _: None))
    recording = Recording(
        source=path,
        options=options,
        names=names,
        base_from_gripper=poses,
        speed=motion,
        gap_ns=np.zeros(len(state), np.int64),  # a row is one instant
        images_of_rows=_images_of(episodes, camera, info.fps),
        intrinsics_of_size=lambda size: (
            None if options.camera_info is None else read_camera_info(options.camera_info, size)
        ),
        joints=joints,
        camera_name=own,
        others=others,
    )
    return capture_of_recording(recording, into, report)


def _rows(episodes: list[Episode]) -> list[Int[ndarray, " k"]]:
    """Of each episode among the frames of all."""
    ends = np.cumsum([len(episode.time_s) for episode in episodes])
    return np.split(np.arange(ends[-1]), ends[:-1])


def _images_of(episodes: list[Episode], key: str, fps: float) -> ImagesOfRows:
    """Of the camera of a key."""

    def images(rows: Int[ndarray, " k"]) -> Iterator[tuple[int, bytes | UInt8[ndarray, "h w 3"], str]]:
        for episode, part in zip(episodes, _rows(episodes), strict=True):
            mine = rows[np.isin(rows, part)]
            if len(mine) == 0:
                continue
            if episode.video is None:
                files = images_in_table(episode, key, mine - part[0])
                for row, file in zip(mine.tolist(), files, strict=True):
                    yield row, file, ".jpg" if file.startswith(b"\xff\xd8") else ".png"
                continue
            times = episode.video_start_s + episode.time_s[mine - part[0]]
            frames = frames_at(episode.video, times, 0.5 / fps)
            for row, rgb in zip(mine.tolist(), frames, strict=True):
                yield row, rgb, ".png"

    return images


def _camera(features: dict[str, Feature], options: ReadOptions, asked: list[str], path: Path) -> str:
    """The key of the wrist's camera, where there are others too or not; InputError with the keys that there are."""
    cameras = [key for key, feature in features.items() if feature.dtype in ("video", "image")]
    listed = ", ".join(cameras) or "no videos or images"
    if unknown := [key for key in asked if key not in cameras]:
        raise InputError(f"{path}: --further-cameras {unknown[0]}: there are {listed}")
    if options.camera_topic in asked:
        raise InputError(f"{path}: --further-cameras {options.camera_topic}: is the wrist's camera already")
    left = [key for key in cameras if key not in asked]
    if options.camera_topic in cameras:
        return str(options.camera_topic)
    if options.camera_topic is not None or len(left) != 1:
        raise InputError(
            f"{path}: choose the wrist's camera with --camera-topic, further ones with --further-cameras: {listed}"
        )
    return left[0]


def _state_key(features: dict[str, Feature], options: ReadOptions, path: Path) -> str:
    key = options.joint_topic or (CARTESIAN if CARTESIAN in features and options.urdf is None else STATE)
    if key not in features:
        states = [name for name, feature in features.items() if feature.dtype.startswith("float")]
        raise InputError(
            f"{path}: no {key}; choose the robot's state with --joint-topic: {', '.join(states)}"
        )
    return key


def _poses(
    state: Float[ndarray, "n k"], key: str, feature: Feature, options: ReadOptions, path: Path
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, "n j"] | None]:
    """Gripper poses from the state: a pose by the names of its numbers or the convention asked for, or joints.

    The joint angles (rad) too, where the state has those of a chain of rotating joints.
    """
    where = f"{path}: {key}"
    names = feature.numbers()
    if options.urdf is not None:
        arm = read_arm(options)
        recorded = state[:, arm.columns(names, where)]
        return arm.poses(recorded), arm.angles(recorded)
    wanted = CONVENTIONS["rpy" if options.pose_convention == "auto" else options.pose_convention].columns
    if key == CARTESIAN or options.pose_convention != "auto":
        names = list(wanted)
    elif not set(wanted) <= set(names):
        raise InputError(
            f"{where}: {', '.join(names) or 'its numbers'} are no pose; give --urdf and --gripper-frame for joint "
            "angles (--pose-units m-deg for degrees), or --pose-convention"
        )
    if state.shape[1] < len(names):
        raise InputError(f"{where}: {state.shape[1]} numbers, a pose of this convention has {len(names)}")
    columns = {name: tuple(repr(float(value)) for value in state[:, k]) for k, name in enumerate(names)}
    return poses_of_columns(columns, frozenset(), options, where), None


def _speed(episode: Episode, poses: Float[ndarray, "n 4 4"]) -> Float[ndarray, " n"]:
    stamps = np.round(1e9 * episode.time_s).astype(np.int64)
    return speed(pose_track(stamps, poses).at, stamps)
