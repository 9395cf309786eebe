"""ROS 1 bags, ROS 2 sqlite3 and MCAP: the images of one topic, with poses from tf or from joint states."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Int, UInt16
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jcr.capture.camera_info import lens_of_ros, read_camera_info
from jcr.capture.joints import JointTrack, read_arm
from jcr.capture.options import ReadOptions
from jcr.capture.plain_files import first_fault, read_yaml
from jcr.capture.pose_track import speed
from jcr.capture.recording import capture_of_recording
from jcr.capture.ros_image import depth_of, picture_of
from jcr.capture.tf_tree import TfTree
from jcr.errors import InputError
from jcr.extras import extra
from jcr.progress import Progress
from jcr.records import Capture, Intrinsics

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
METADATA = "metadata.yaml"
ALIGNED = "aligned_depth"
"""In the names of topics whose depth has the pixels of the colour image (realsense2_camera: aligned_depth_to_color)."""
SAME_MOMENT_NS = 20_000_000
"""Colour and depth of one exposure have stamps nearer than this."""
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """The best frames of a bag in the folder `into`; the bag is streamed, never held.

    Raises InputError with the topics or frames that there are where those of the options are not, and for images
    whose poses are stale.
    """
    with _opened(path) as reader:
        topic = _camera_topic(reader, options, path)
        info_topics = (f"{topic.rsplit('/', k)[0]}/camera_info" for k in (1, 2))
        infos = [
            c for name in info_topics for c in reader.connections if c.topic == name and c.msgtype == INFO
        ]
        cameras = [c for c in reader.connections if c.topic == topic]
        pose_connections = _pose_connections(reader, options, path)
        _refuse_other_definitions(reader, [*cameras, *infos[:1], *pose_connections], path)
        log_ns, stamp_ns, info = [], [], None
        tree, joint_states = TfTree(), []
        span = max(reader.end_time - reader.start_time, 1)
        for connection, at, message in _messages(reader, [*cameras, *infos[:1], *pose_connections], path):
            if connection.msgtype in TF:
                tree.add(message.transforms, static=connection.topic.endswith("tf_static"))
            elif connection.msgtype == JOINTS:
                joint_states.append((_stamp(message, at), message.name, message.position))
            elif connection.msgtype == INFO:
                info = info or message
            else:
                log_ns.append(at)
                stamp_ns.append(_stamp(message, at))
                report("frames", 0.1 * (at - reader.start_time) / span)
        if not stamp_ns:
            raise InputError(f"{path}: topic {topic} has no images")
        order = np.unique(stamp_ns, return_index=True)[1]
        stamps, logs = np.array(stamp_ns)[order], np.array(log_ns)[order]
        arm = None if options.urdf is None else _joint_track(joint_states, options, path)
        poses_at = tree.poses_at(options.base_frame, options.gripper_frame, path) if arm is None else arm.at
        poses, gap_ns = poses_at(stamps)
        joints = None if arm is None else arm.angles(stamps)

        def pictures(rows: Int[np.ndarray, " k"]) -> Iterator[tuple[int, Any, str]]:
            for row in rows.tolist():
                at = int(logs[row])
                for _, _, message in _messages(reader, cameras, path, start=at, stop=at + 1):
                    if _stamp(message, at) == stamps[row]:
                        yield row, *picture_of(message, f"{path}: {topic}")
                        break

        aligned = [c for c in reader.connections if c.msgtype in IMAGES and ALIGNED in c.topic]
        _refuse_other_definitions(reader, aligned, path)

        def depth_at(row: int) -> UInt16[np.ndarray, "h w"] | None:
            """Of the exposure nearest to the frame's; None where it has none."""
            at = int(logs[row])
            found, off = None, SAME_MOMENT_NS
            near = {"start": at - 5 * SAME_MOMENT_NS, "stop": at + 5 * SAME_MOMENT_NS}
            for connection, recorded, message in _messages(reader, aligned, path, **near):
                if (apart := abs(_stamp(message, recorded) - int(stamps[row]))) <= off:
                    found, off = depth_of(message, f"{path}: {connection.topic}"), apart
            return found

        def lens(size: tuple[int, int]) -> Intrinsics | None:
            if options.camera_info is not None:
                return read_camera_info(options.camera_info, size)
            return None if info is None else _lens(info, topic, size, f"{path}: {infos[0].topic}")

        names = [str(stamp) for stamp in stamps]
        motion = speed(poses_at, stamps)
        return capture_of_recording(
            path,
            names,
            poses,
            motion,
            gap_ns,
            pictures,
            lens,
            options,
            into,
            report,
            joints,
            depth_at if aligned else None,
        )


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


def _camera_topic(reader: Any, options: ReadOptions, path: Path) -> str:
    """The topic that was asked for, or the only one with colour images."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in IMAGES})
    if options.camera_topic is not None:
        if options.camera_topic not in topics:
            raise InputError(
                f"{path}: no images on {options.camera_topic}; topics with images: {', '.join(topics) or 'none'}"
            )
        return options.camera_topic
    colour = [topic for topic in topics if "depth" not in topic.lower()]
    if len(colour) != 1:
        raise InputError(
            f"{path}: {len(colour)} topics with images; choose one with --camera-topic: {', '.join(topics) or 'none'}"
        )
    return colour[0]


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


def _lens(info: Any, topic: str, size: tuple[int, int], where: str) -> Intrinsics | None:
    """Intrinsics of the topic's images: K and D, or P of rectified ones. ROS 1 writes these in capitals."""
    k, d, p = (list(getattr(info, name if hasattr(info, name) else name.upper())) for name in "kdp")
    calibrated = (info.width, info.height)
    if "image_rect" in topic:
        return lens_of_ros([*p[:3], *p[4:7], *p[8:11]], "", (), calibrated, size, where)
    return lens_of_ros(k, info.distortion_model, d, calibrated, size, where)
