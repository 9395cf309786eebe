"""LeRobot data sets v2.1 and v3.0: images or video of a wrist camera, with a pose or joint angles for each frame."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray
from pydantic import BaseModel, ConfigDict, Field

from jcr.capture.documents import Table
from jcr.capture.frame_extraction import Picture, Recording, capture_of_recording
from jcr.capture.images import require_pixels
from jcr.capture.options import ReadOptions, chosen_name
from jcr.capture.pose_track import interpolated_poses, speed
from jcr.capture.readings import readings_of, undecided
from jcr.capture.urdf_chain import RecordedArm, read_arm
from jcr.errors import InputError, count_of, shown
from jcr.extras import extra
from jcr.files import path_inside
from jcr.progress import Progress
from jcr.records import Capture, FrameNames
from jcr.records.json_file import read_json, validated_content

INFO = "meta/info.json"
CARTESIAN = "observation.state.cartesian_position"
"""Key of the gripper pose in DROID: x, y, z (m), roll, pitch, yaw (rad) in the robot's base frame."""
STATE_COLUMN = "observation.state"
USUAL_BYTES, PACKED = 200_000_000, 20
"""Size in memory up to which columns are read from any file, and the largest ratio to the size of their file above it:
images hardly pack, and a file of LeRobot has 100 MB. Zeros pack to a thousandth."""
MOST_FRAMES = 500_000
"""Largest number of frames of an episode: five hours at 30 Hz."""
MOST_EPISODES = 200
"""Largest number of episodes that "all" takes: a set of thousands has a camera that moves a few times, if at all."""
LATEST_S = 9e9
"""Largest time stamp (s), about that of the largest int64 in ns (9.2e9); time since 1970 is 1.8e9."""


class Feature(BaseModel):
    """Entry of a LeRobot data set's meta/info.json for one recorded quantity: its type and the names of its numbers."""

    dtype: str = ""
    names: Any = None
    """Names of the numbers: a list of texts, or such a list inside {"motors": …} or {"axes": …}."""

    def numbers(self) -> list[str]:
        """Return the names of the quantity's numbers, in lower case and without ".pos"; empty if there are no names."""
        names = self.names
        while isinstance(names, dict):
            names = next(iter(names.values()), None)
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return []
        return [name.removesuffix(".pos").lower() for name in names]


class Info(BaseModel):
    """Content of meta/info.json of a LeRobot data set: recorded quantities, frame rate, and templates of file paths."""

    model_config = ConfigDict(allow_inf_nan=False, strict=True)
    features: dict[str, Feature]
    fps: Annotated[float, Field(gt=0, le=1e6)]
    codebase_version: str = ""
    chunks_size: Annotated[int, Field(ge=1)] = 1000
    total_episodes: Annotated[int, Field(ge=0)] = 0
    data_path: Annotated[str, Field(max_length=1000)]
    video_path: Annotated[str, Field(max_length=1000)] | None = None


@dataclass(frozen=True)
class Episode:
    """One recording (episode) of the data set: times and robot states of its frames, and the files of its images."""

    index: int
    frame: Int[ndarray, " n"]
    """Value of frame_index of each row in the table."""
    time_s: Float[ndarray, " n"]
    """Time (s) of each frame since the start of the episode."""
    state: Float[ndarray, "n k"]
    table: Path
    video: Path | None
    """Video file of the images; None if the images are stored in the table."""
    video_start_s: float


def recognises(path: Path) -> bool:
    """Test whether a folder is a LeRobot data set, which has a meta/info.json."""
    return (path / INFO).is_file()


def episodes_of(path: Path, options: ReadOptions) -> tuple[list[int], int]:
    """Return the episodes that the options name, at most MOST_EPISODES for "all", and the number that were meant."""
    named = [one for one in options.episode if one != "all"]
    if len(named) == len(options.episode):
        return named, len(named)
    if not recognises(path):
        raise InputError(f"{path}: --episode all is for LeRobot data sets; leave it out")
    info: Info = validated_content(Info, read_json(path / INFO), str(path / INFO))
    if not (total := info.total_episodes):
        raise InputError(f"{path / INFO}: states no total_episodes; name the episodes")
    steps = np.linspace(0, total - 1, min(total, MOST_EPISODES)).round().astype(int)
    return sorted({*named, *steps.tolist()}), total


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """Extract the sharpest frames at rest from the episode that the options name; return them as a capture."""
    info: Info = validated_content(Info, read_json(path / INFO), str(path / INFO))
    features = info.features
    cameras = [key for key, feature in features.items() if feature.dtype in ("video", "image")]
    what = f"{path}: the wrist camera"
    camera = chosen_name(cameras, options.camera_topic, cameras, what, "--camera-topic")
    states = [key for key, feature in features.items() if feature.dtype.startswith("float")]
    usual = [
        key for key in ((STATE_COLUMN,) if options.urdf else (CARTESIAN, STATE_COLUMN)) if key in states
    ][:1]
    key = chosen_name(states, options.joint_topic, usual, f"{path}: the robot's state", "--joint-topic")
    if len(options.episode) != 1:
        raise InputError(
            f"{path}: {count_of(len(options.episode), 'episode')}; read one, or all by jcr batch"
        )
    ((index, *_), _) = episodes_of(path, options)
    episode = read_episode(path, info, camera, key, index)
    arm = None if options.urdf is None else read_arm(options)
    poses, joints = _poses(episode.state, key, features[key], options, path, arm)
    stamps = np.round(1e9 * episode.time_s).astype(np.int64)
    recording = Recording(
        source=path,
        options=options,
        names=[f"episode_{episode.index:06d}_frame_{k:06d}" for k in range(len(poses))],
        base_from_gripper=poses,
        speed=speed(partial(interpolated_poses, stamps, poses), stamps),
        gap_ns=np.zeros(len(poses), np.int64),  # pose and image of a row have the same time
        images_of_rows=lambda rows: _images(episode, rows, camera, info.fps),
        joints=joints,
        frame_names=FrameNames() if arm is None else FrameNames().replaced(base=arm.base),
    )
    return capture_of_recording(recording, into, report)


def read_episode(path: Path, info: Info, camera: str, key: str, index: int) -> Episode:
    """Read the episode number `index` (from 0) of the data set at `path`, whose meta/info.json is `info`.

    Raises InputError for a missing or damaged episode.
    """
    has_video = info.features[camera].dtype == "video"
    fields: dict[str, Any] = {"episode_chunk": index // info.chunks_size, "episode_index": index}
    video_fields, start_s = fields, 0.0
    if info.codebase_version.startswith("v3"):
        # Version 3.0 has many episodes in one table and one video; meta/episodes lists them.
        of_video = [f"videos/{camera}/{n}" for n in ("chunk_index", "file_index", "from_timestamp")]
        columns = ["data/chunk_index", "data/file_index", *(of_video if has_video else [])]
        listed = _read_table(path / "meta" / "episodes", columns, index)
        if not len(listed):
            raise InputError(f"{path}: no episode {index} in meta/episodes; they are counted from 0")
        chunk, number, *video = (listed[name][0].as_py() for name in columns)
        fields = {"chunk_index": chunk, "file_index": number}
        if video:
            video_fields = {"chunk_index": video[0], "file_index": video[1]}
            start_s = float(
                _seconds(video[2:], f"{path}: from_timestamp of episode {index} in meta/episodes")[0]
            )
    table = _file(path, info.data_path, fields)
    if not table.is_file():
        raise InputError(f"{table}: not there, so there is no episode {index}; they are counted from 0")
    rows = _read_table(table, ["frame_index", "timestamp", key], index)
    if len(rows) > MOST_FRAMES:
        raise InputError(f"{table}: over {MOST_FRAMES:,} frames in episode {index}; choose another")
    rows = rows.to_pydict()
    time_s = _seconds(rows["timestamp"], f"{table}: timestamp of episode {index}")
    try:
        state, frame = np.array(rows[key], np.float64), np.array(rows["frame_index"])
        if not (len(state) and state.ndim == 2 and frame.ndim == 1):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        text = "is empty, no list, or has rows of different lengths; choose another episode"
        raise InputError(f"{table}: {key} of episode {index} {text}") from None
    if not np.isfinite(state).all():
        raise InputError(f"{table}: {key} holds NaN or infinity; choose another episode")
    if frame.dtype.kind not in "iu":
        raise InputError(f"{table}: frame_index of episode {index} holds no whole numbers; download it again")
    video = _file(path, info.video_path or "", video_fields | {"video_key": camera}) if has_video else None
    return Episode(index, frame, time_s, state, table, video, start_s)


def _seconds(values: Sequence[Any], where: str) -> Float[ndarray, " n"]:
    """Return times (s) from the cells of a table; raise InputError if one is no time."""
    for row, value in enumerate(values):
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not abs(value) <= LATEST_S:
            raise InputError(f"{where}: {shown(value)} in row {row} is no time (s); choose another episode")
    return np.array(values, np.float64)


def _read_table(path: Path, columns: list[str], episode: int, rows: Sequence[int] | None = None) -> Any:
    """Read columns of one episode from Parquet, a file or a folder of files, as a table of pyarrow.

    `rows` are the frame indices to read; None: all frames of the episode.
    """
    parquet = extra("pyarrow.parquet", "lerobot", "a LeRobot data set")
    filters: list[tuple[str, str, Any]] = [("episode_index", "==", episode)]
    if rows is not None:
        filters.append(("frame_index", "in", rows))
    try:
        for file in path.rglob("*.parquet") if path.is_dir() else [path]:
            about = parquet.read_metadata(file)
            starts, places = (
                tuple(f"{name}." for name in columns),
                np.ndindex(about.num_row_groups, about.num_columns),
            )
            chunks = (about.row_group(k).column(j) for k, j in places)
            read = (chunk for chunk in chunks if f"{chunk.path_in_schema}.".startswith(starts))
            size = sum(max(chunk.total_uncompressed_size, 8 * chunk.num_values) for chunk in read)
            if size > max(USUAL_BYTES, PACKED * file.stat().st_size):
                raise ValueError(f"it unpacks to {size / 1e9:.1f} GB")
        images = [f"{name}.bytes" for name in columns]  # equal ones are kept once
        return parquet.read_table(
            path, columns=columns, filters=filters, partitioning=None, read_dictionary=images
        )
    except Exception as error:  # Arrow's own errors have no common base
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: not a readable table of the set ({reason}); download it again") from None


def _file(path: Path, template: str, fields: dict[str, Any]) -> Path:
    """Return the file of a path template such as data/chunk-{episode_chunk:03d}/file.parquet, filled with `fields`.

    The template is relative to the data set `path`.
    """
    name = re.sub(
        r"\{(\w+)(?::0?(\d?\d)d)?\}",  # the value of a field is padded with zeros to the width in the template
        lambda field: str(fields.get(field[1], field[0])).zfill(int(field[2] or 0)),
        template,
    )
    return path_inside(path, name, str(path / INFO))


def _images(episode: Episode, rows: Int[ndarray, " k"], key: str, fps: float) -> Iterator[Picture]:
    """Yield row, image (encoded bytes or RGB pixels) and file ending for each of k ascending rows of an episode.

    The images are from its video or table.
    """
    if episode.video is not None:
        frames = _video_frames(episode.video, episode.video_start_s + episode.time_s[rows], 0.5 / fps)
        yield from ((row, rgb, ".png") for row, rgb in zip(rows.tolist(), frames, strict=True))
        return
    numbers = episode.frame[rows].tolist()
    found = _read_table(episode.table, ["frame_index", key], episode.index, numbers)
    place = {number: k for k, number in enumerate(found["frame_index"].to_pylist())}
    for row, number in zip(rows.tolist(), numbers, strict=True):
        cell = found[key][place[number]].as_py() if number in place else None
        file = cell.get("bytes") if isinstance(cell, dict) else None
        if not file or not isinstance(file, bytes):
            what = f"holds no {key} of frame {number}; write the data set with embedded images"
            raise InputError(f"{episode.table}: {what}")
        yield row, file, ".jpg" if file.startswith(b"\xff\xd8") else ".png"


def _video_frames(
    file: Path, time_s: Float[ndarray, " n"], tolerance_s: float
) -> Iterator[UInt8[ndarray, "h w 3"]]:
    """Yield the RGB frames at n ascending times (s) since the start of a video."""
    av = extra("av", "lerobot", "a video")
    due = time_s.tolist()
    try:
        with av.open(str(file)) as container:
            stream = container.streams.video[0]
            require_pixels((stream.codec_context.width, stream.codec_context.height), str(file))
            stream.thread_type = "AUTO"
            container.seek(max(int((due[0] - tolerance_s) / stream.time_base), 0), stream=stream)
            for frame in container.decode(stream):
                require_pixels((frame.width, frame.height), str(file))
                while due and frame.time is not None and abs(frame.time - due[0]) <= tolerance_s:
                    yield np.asarray(frame.to_ndarray(format="rgb24"))
                    due.pop(0)
                if not due or (frame.time is not None and frame.time > due[0] + tolerance_s):
                    break
    except InputError:
        raise
    except (av.FFmpegError, IndexError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{file}: not a readable video ({error}); download it again") from None
    if due:
        raise InputError(f"{file}: has no frame at {due[0]:.3f} s, as listed; download it again")


def _poses(
    state: Float[ndarray, "n k"],
    key: str,
    feature: Feature,
    options: ReadOptions,
    path: Path,
    arm: RecordedArm | None,
) -> tuple[Float[ndarray, "n 4 4"], Float[ndarray, "n j"] | None]:
    """Return base_from_gripper (m) and joint angles (rad) of n frames from `state`, k numbers per frame.

    With an `arm` the numbers are positions of its joints, else poses. The joint angles, in the order of the arm's
    chain, are None without an arm, or if a sliding joint moves the gripper.
    """
    where, names, width = f"{path}: {key}", feature.numbers(), state.shape[1]
    if key == CARTESIAN and not names:
        names = ["x", "y", "z", "roll", "pitch", "yaw"]
    if len(names) > width:
        raise InputError(
            f"{where}: {count_of(len(names), 'name')} for {count_of(width, 'number')}; correct {INFO}"
        )
    if arm is not None:
        recorded = state[:, arm.columns(names, where)]
        return arm.poses(recorded, where), arm.angles(recorded)
    columns, cells = (*names, *[None] * (width - len(names))), tuple(map(tuple, state.tolist()))
    table = Table(file=path, place=key, columns=columns, rows=cells)
    _, readings = readings_of(table, options, where)
    if not readings:
        listed = ", ".join(names) or "its numbers"
        raise InputError(
            f"{where}: {listed} are no pose; give --urdf and --gripper-frame for joint angles (--pose-units m-deg for "
            "degrees), or --pose-convention"
        )
    direct = [one for one in readings if not one[0].inverted] or readings
    if len(direct) > 1:
        raise undecided(where, [reading for reading, _ in direct])
    poses = direct[0][1]
    if (wrong := np.flatnonzero(np.isnan(poses[:, 0, 0]))).size:
        raise InputError(f"{where}: frame {wrong[0]} holds no pose; choose another episode")
    return poses, None
