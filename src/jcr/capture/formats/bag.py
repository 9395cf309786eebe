"""ROS 1 bags, ROS 2 sqlite3 and MCAP: images of one topic or more, with poses from tf or from joint states."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float, Int, UInt16
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr.capture.camera_info import intrinsics_of_ros, read_camera_info
from jcr.capture.joints import JointTrack, read_arm
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import first_fault, read_yaml
from jcr.capture.pose_track import PosesAt, speed
from jcr.capture.recorded_cameras import (
    ImagesOfRows,
    IntrinsicsOfSize,
    RecordedCamera,
    asked_cameras,
    camera_names,
)
from jcr.capture.recording import Recording, capture_of_recording
from jcr.capture.ros_image import depth_of, image_of
from jcr.capture.tf_tree import TfTree
from jcr.errors import InputError
from jcr.extras import extra
from jcr.geometry import inverse, motion_length
from jcr.progress import Progress
from jcr.records import Capture, Intrinsics, Mount

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
METADATA = "metadata.yaml"
ALIGNED = "aligned_depth"
"""In the names of topics whose depth has the pixels of the colour image (realsense2_camera: aligned_depth_to_color)."""
SAME_MOMENT_NS = 20_000_000
"""Colour and depth of one exposure have stamps nearer than this."""
SAME_POSE = 1e-3
"""m, rotation counted at ARM: by which the arm may move between the exposures of two cameras on it."""
LOOKED_AT = 50
"""Images of a topic at whose stamps tf is asked what carries their camera."""
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """The best frames of a bag in the folder `into`; the bag is streamed and never in memory whole.

    Raises InputError with the topics or frames that there are where those of the options are not, and for images
    whose poses are stale.
    """
    asked = asked_cameras(options)
    with _opened(path) as reader:
        heard = _heard(reader, options, asked, path, report)
        arm = None if options.urdf is None else _joint_track(heard.joint_states, options, path)
        by_tf = options.base_frame, options.gripper_frame, path
        poses_at = heard.tree.poses_at(*by_tf) if arm is None else arm.at
        mounts = _mounts(heard, options, asked, path)
        topic, *others = _chosen(heard.topics, options, asked, mounts, path)
        stamps = heard.recorded[topic].sorted()[0]
        poses, gap_ns = poses_at(stamps)
        frames = _Frames(
            reader=reader,
            path=path,
            options=options,
            heard=heard,
            mounts=mounts,
            poses_at=poses_at,
            topic=topic,
            stamps=stamps,
            base_from_gripper=poses,
        )
        own, *further = camera_names([topic, *others])
        recording = Recording(
            source=path,
            options=options,
            names=[str(stamp) for stamp in stamps],
            base_from_gripper=poses,
            speed=speed(poses_at, stamps),
            gap_ns=gap_ns,
            images_of_rows=frames.images_of(topic),
            intrinsics_of_size=frames.intrinsics,
            joints=None if arm is None else arm.angles(stamps),
            depth_at=frames.depth_at if heard.aligned else None,
            camera_name=own,
            others=[
                RecordedCamera(name, mount, frames.images_of(other), frames.intrinsics_of(other))
                for name, other in zip(further, others, strict=True)
                if (mount := mounts[other]) is not None
            ],
        )
        return capture_of_recording(recording, into, report)


@dataclass
class _Recorded:
    """When the images of one topic were true and were recorded, and the frame that they name."""

    stamp_ns: list[int] = field(default_factory=list)
    log_ns: list[int] = field(default_factory=list)
    frame: str = ""

    def add(self, stamp: int, log: int, frame: str) -> None:
        self.stamp_ns.append(stamp)
        self.log_ns.append(log)
        self.frame = frame.lstrip("/")

    def sorted(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """Both, in order of the stamps; of those with the same stamp the first."""
        stamps, order = np.unique(self.stamp_ns, return_index=True)
        return stamps, np.array(self.log_ns)[order]

    def some(self) -> Int[np.ndarray, " n"]:
        """Stamps through the whole recording."""
        stamps, _ = self.sorted()
        return stamps[np.linspace(0, len(stamps) - 1, min(len(stamps), LOOKED_AT)).round().astype(int)]


@dataclass(frozen=True, kw_only=True)
class _Heard:
    """What one pass over a bag found, its images aside."""

    topics: list[str]
    """Topics of cameras on which something was recorded."""
    cameras: list[Any]
    """Connections of all camera topics."""
    aligned: list[Any]
    """Connections of depth that has the pixels of a colour image."""
    recorded: dict[str, _Recorded]
    infos: dict[str, Any]
    """The connection of the CameraInfo of each camera topic."""
    camera_infos: dict[str, Any]
    """The first message on each topic of a CameraInfo."""
    tree: TfTree
    joint_states: list[Any]


def _heard(
    reader: Any, options: ReadOptions, asked: Mapping[str, Mount | None], path: Path, report: Progress
) -> _Heard:
    topics = _camera_topics(reader, options, list(asked), path)
    infos = {topic: info for topic in topics if (info := _info_of(reader, topic)) is not None}
    cameras = [c for c in reader.connections if c.topic in topics]
    aligned = [c for c in reader.connections if c.msgtype in IMAGES and ALIGNED in c.topic]
    pose_connections = _pose_connections(reader, options, path)
    wanted = [*cameras, *{info.topic: info for info in infos.values()}.values(), *pose_connections]
    _refuse_other_definitions(reader, [*wanted, *aligned], path)
    recorded, camera_infos = {topic: _Recorded() for topic in topics}, dict[str, Any]()
    tree, joint_states = TfTree(), list[Any]()
    span = max(reader.end_time - reader.start_time, 1)
    for connection, at, message in _messages(reader, wanted, path):
        if connection.msgtype in TF:
            tree.add(message.transforms, static=connection.topic.endswith("tf_static"))
        elif connection.msgtype == JOINTS:
            joint_states.append((_stamp(message, at), message.name, message.position))
        elif connection.msgtype == INFO:
            camera_infos.setdefault(connection.topic, message)
        else:
            recorded[connection.topic].add(_stamp(message, at), at, message.header.frame_id)
            report("frames", 0.1 * (at - reader.start_time) / span)
    return _Heard(
        topics=_with_images(topics, recorded, (options.camera_topic, *asked), path),
        cameras=cameras,
        aligned=aligned,
        recorded=recorded,
        infos=infos,
        camera_infos=camera_infos,
        tree=tree,
        joint_states=joint_states,
    )


def _mounts(
    heard: _Heard, options: ReadOptions, asked: Mapping[str, Mount | None], path: Path
) -> dict[str, Mount | None]:
    """What carries each camera, by what was asked, else by tf; None where neither tells or there is one camera."""
    mounts = dict[str, Mount | None].fromkeys(heard.topics)
    if len(heard.topics) > 1:
        for name in heard.topics:
            one = heard.recorded[name]
            by_tf = one.frame, options.base_frame, options.gripper_frame, one.some(), path
            mounts[name] = heard.tree.mount_of(*by_tf)
    mounts.update((name, mount) for name, mount in asked.items() if mount is not None)
    return mounts


@dataclass(frozen=True, kw_only=True)
class _Frames:
    """Images, depth and intrinsics at the stamps of the chosen camera's images, read from the bag when asked for."""

    reader: Any
    path: Path
    options: ReadOptions
    heard: _Heard
    mounts: dict[str, Mount | None]
    poses_at: PosesAt
    topic: str
    """Topic of the chosen camera."""
    stamps: Int[np.ndarray, " n"]
    base_from_gripper: Float[np.ndarray, "n 4 4"]

    def images_of(self, topic: str) -> ImagesOfRows:
        """Of a camera those that were taken where the arm was at the chosen camera's."""

        def images(rows: Int[np.ndarray, " k"]) -> Iterator[tuple[int, Any, str]]:
            of_topic = [c for c in self.heard.cameras if c.topic == topic]
            all_stamps, all_logs = self.heard.recorded[topic].sorted()
            nearest = _nearest(all_stamps, self.stamps[rows])
            there, gaps = self.poses_at(all_stamps[nearest])
            moved = motion_length(inverse(self.base_from_gripper[rows]) @ there)
            apart = np.abs(all_stamps[nearest] - self.stamps[rows])
            same = (apart == 0) | (gaps <= 1e6 * self.options.max_gap_ms) & (moved < SAME_POSE)
            for row, k, usable in zip(rows.tolist(), nearest.tolist(), same.tolist(), strict=True):
                if not usable and self.mounts[topic] != "base":
                    continue
                at = int(all_logs[k])
                for _, _, message in _messages(self.reader, of_topic, self.path, start=at, stop=at + 1):
                    if _stamp(message, at) == all_stamps[k]:
                        yield row, *image_of(message, f"{self.path}: {topic}")
                        break

        return images

    def depth_at(self, row: int) -> UInt16[np.ndarray, "h w"] | None:
        """Of the exposure nearest to the frame's; None where it has none."""
        at = int(self.heard.recorded[self.topic].sorted()[1][row])
        found, off = None, SAME_MOMENT_NS
        near = {"start": at - 5 * SAME_MOMENT_NS, "stop": at + 5 * SAME_MOMENT_NS}
        for connection, logged, message in _messages(self.reader, self.heard.aligned, self.path, **near):
            if (apart := abs(_stamp(message, logged) - int(self.stamps[row]))) <= off:
                found, off = depth_of(message, f"{self.path}: {connection.topic}"), apart
        return found

    def intrinsics_of(self, topic: str) -> IntrinsicsOfSize:
        """By the CameraInfo that belongs to a topic."""

        def intrinsics(size: tuple[int, int]) -> Intrinsics | None:
            name = self.heard.infos[topic].topic if topic in self.heard.infos else ""
            messages = self.heard.camera_infos
            return (
                _intrinsics(messages[name], topic, size, f"{self.path}: {name}") if name in messages else None
            )

        return intrinsics

    def intrinsics(self, size: tuple[int, int]) -> Intrinsics | None:
        """Of the chosen camera: as asked for, else by its CameraInfo."""
        if self.options.camera_info is not None:
            return read_camera_info(self.options.camera_info, size)
        return self.intrinsics_of(self.topic)(size)


def _with_images(
    topics: list[str], recorded: dict[str, _Recorded], named: tuple[str | None, ...], path: Path
) -> list[str]:
    """The topics on which something was recorded; InputError for one that was asked for, or where nothing was."""
    empty = [topic for topic in topics if not recorded[topic].stamp_ns]
    if refused := [topic for topic in empty if topic in named or len(empty) == len(topics)]:
        raise InputError(f"{path}: topic {refused[0]} has no images")
    return [topic for topic in topics if topic not in empty]


def _nearest(sample_ns: Int[np.ndarray, " n"], at_ns: Int[np.ndarray, " k"]) -> Int[np.ndarray, " k"]:
    """Rows of ascending samples."""
    after = np.searchsorted(sample_ns, at_ns).clip(1, max(len(sample_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(sample_ns) - 1)
    return np.where(np.abs(sample_ns[after] - at_ns) < np.abs(sample_ns[before] - at_ns), after, before)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    highlevel = extra("rosbags.highlevel", "ros", "a bag")
    typesys = extra("rosbags.typesys", "ros", "a bag")
    if (path / METADATA).is_file():
        _check_metadata(path / METADATA)
    try:
        # Older sqlite3 bags hold no message definitions; those of the standard messages never changed since.
        standard = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = highlevel.AnyReader([path], default_typestore=standard)
        reader.open()
    except Exception as error:  # each storage raises its own errors, SQLite and struct among them
        raise InputError(
            f"{path}: not a readable bag ({error}); check that it was closed and is whole"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


class _Metadata(BaseModel):
    """What rosbags takes from a metadata.yaml without a look at its kind."""

    model_config = ConfigDict(extra="ignore")
    relative_file_paths: Annotated[list[Annotated[str, Field(max_length=1000)]], Field(max_length=10_000)]
    files: list[dict[str, Any]] | None = None
    topics_with_message_count: list["_Counted"]


class _Counted(BaseModel):
    topic_metadata: "_Topic"


class _Topic(BaseModel):
    name: str
    type: str


def _check_metadata(file: Path) -> None:
    content = read_yaml(file)
    try:
        _Metadata.model_validate(content.get("rosbag2_bagfile_information"), strict=True)
    except ValidationError as error:
        raise InputError(f"{file}: {first_fault(error)}; make it again with `ros2 bag reindex`") from None
    except AttributeError:
        raise InputError(f"{file}: describes no bag; make it again with `ros2 bag reindex`") from None


def _refuse_other_definitions(reader: Any, connections: list[Any], path: Path) -> None:
    """InputError where a bag defines a message, or one inside it, otherwise than ROS 2 and ROS 1 do."""
    typesys = extra("rosbags.typesys", "ros", "a bag")
    ros2, ros1 = (typesys.get_typestore(s) for s in (typesys.Stores.ROS2_HUMBLE, typesys.Stores.ROS1_NOETIC))
    ros1.register({name: ros2.fielddefs[TF[0]] for name in TF})
    for name in {connection.msgtype for connection in connections}:
        defined = _definition(reader.typestore, name)
        if defined is None or defined not in (_definition(ros2, name), _definition(ros1, name)):
            raise InputError(
                f"{path}: its definition of {name} is not the one of ROS; record it with the standard message"
            )


def _definition(store: Any, name: str) -> str | None:
    """A hash over a message's fields and those of all that is in it; None where not all are defined."""
    try:
        return store.hash_rihs01(name)
    except KeyError:
        return None


def _messages(reader: Any, connections: list[Any], path: Path, **span: int) -> Iterator[tuple[Any, int, Any]]:
    """Connection, time of recording (ns) and content of each message; InputError where the bag is damaged."""
    recorded = reader.messages(connections, **span)
    while True:
        try:
            connection, at, raw = next(recorded)
            message = reader.deserialize(raw, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:  # each storage raises its own errors, struct and KeyError among them
            raise InputError(f"{path}: damaged ({error}); repair it with the tool that recorded it") from None
        yield connection, at, message


def _camera_topics(reader: Any, options: ReadOptions, asked: list[str], path: Path) -> list[str]:
    """Topics whose images may be wanted: those that were asked for, or all with colour images."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in IMAGES})
    if options.camera_topic in asked:
        raise InputError(f"{path}: --further-cameras {options.camera_topic}: is the wrist's camera already")
    for topic in (options.camera_topic, *asked):
        if topic is not None and topic not in topics:
            raise InputError(
                f"{path}: no images on {topic}; topics with images: {', '.join(topics) or 'none'}"
            )
    if options.camera_topic is not None:
        return [options.camera_topic, *asked]
    colour = [topic for topic in topics if "depth" not in topic.lower()]
    # The same images, once more in a smaller form.
    colour = [
        topic
        for topic in colour
        if topic in asked or topic.removesuffix("/compressed") not in {*colour} - {topic}
    ]
    if not colour:
        raise InputError(
            f"{path}: 0 topics with images; choose one with --camera-topic: {', '.join(topics) or 'none'}"
        )
    return colour


def _chosen(
    topics: list[str],
    options: ReadOptions,
    asked: dict[str, Mount | None],
    mounts: dict[str, Mount | None],
    path: Path,
) -> list[str]:
    """The topic of the wrist's camera, then those of further ones; InputError where tf does not tell which is which.

    Unless topics are named, the only one that moves with the gripper is the wrist's, and fixed ones come with it.
    """
    own = options.camera_topic
    if own is None:
        left = [topic for topic in topics if topic not in asked]
        on_gripper = [topic for topic in left if mounts[topic] == "gripper"]
        if len(left) == 1:
            on_gripper = left
        elif any(mounts[topic] is None for topic in left):
            on_gripper = []
        if len(on_gripper) != 1:
            words = {"gripper": "moves with the gripper", "base": "stands still", None: "tf does not tell"}
            listed = ", ".join(f"{topic} ({words[mounts[topic]]})" for topic in left)
            raise InputError(
                f"{path}: {len(left)} topics with images; choose one with --camera-topic, further ones with "
                f"--further-cameras: {listed or 'all are named by --further-cameras'}"
            )
        own = on_gripper[0]
        if not asked:
            return [own, *(topic for topic in left if topic != own and mounts[topic] == "base")]
    for topic in asked:
        if mounts[topic] is None:
            raise InputError(
                f"{path}: tf does not tell what carries the camera of {topic}; write --further-cameras {topic}=base for "
                f"a fixed one, {topic}=gripper for one on the gripper"
            )
    return [own, *asked]


def _info_of(reader: Any, topic: str) -> Any | None:
    """The connection with the intrinsics of a topic's images."""
    names = [f"{topic.rsplit('/', k)[0]}/camera_info" for k in (1, 2)]
    found = [c for name in names for c in reader.connections if c.topic == name and c.msgtype == INFO]
    return found[0] if found else None


def _pose_connections(reader: Any, options: ReadOptions, path: Path) -> list[Any]:
    """The connections that carry the robot: tf, or joint states where a URDF is given."""
    if options.urdf is None:
        found = [c for c in reader.connections if c.msgtype in TF]
        if not found:
            raise InputError(f"{path}: no /tf; give --urdf for joint states, or record tf as well")
        return found
    topics = sorted({c.topic for c in reader.connections if c.msgtype == JOINTS})
    wanted = options.joint_topic or (topics[0] if len(topics) == 1 else None)
    if wanted not in topics:
        raise InputError(
            f"{path}: choose the joint states with --joint-topic: {', '.join(topics) or 'there are none'}"
        )
    return [c for c in reader.connections if c.topic == wanted]


def _joint_track(joint_states: list[Any], options: ReadOptions, path: Path) -> JointTrack:
    arm = read_arm(options)
    stamps: dict[str, list[int]] = {}
    positions: dict[str, list[float]] = {}
    for stamp, names, values in joint_states:
        for name, value in zip(names, values, strict=False):
            stamps.setdefault(name, []).append(stamp)
            positions.setdefault(name, []).append(float(value))
    arm.columns(list(stamps), str(path))
    rows = [np.unique(stamps[joint], return_index=True) for joint in arm.joints]
    sampled = tuple(
        np.array(positions[joint])[order] for joint, (_, order) in zip(arm.joints, rows, strict=True)
    )
    return JointTrack(arm, tuple(stamp for stamp, _ in rows), sampled)


def _stamp(message: Any, log_ns: int) -> int:
    """When the message was true (ns); the time of its recording for drivers that leave the stamp empty."""
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec or log_ns


def _intrinsics(info: Any, topic: str, size: tuple[int, int], where: str) -> Intrinsics | None:
    """Intrinsics of the topic's images: K and D, or P of rectified ones. ROS 1 writes these in capitals."""
    k, d, p = (list(getattr(info, name if hasattr(info, name) else name.upper())) for name in "kdp")
    calibrated = (info.width, info.height)
    if "image_rect" in topic:
        return intrinsics_of_ros([*p[:3], *p[4:7], *p[8:11]], "", (), calibrated, size, where)
    return intrinsics_of_ros(k, info.distortion_model, d, calibrated, size, where)
