"""ROS 1 bags, ROS 2 sqlite3 and MCAP: images of one camera, with gripper poses from tf or from joint states."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8, UInt16
from numpy import ndarray

from jcr.capture.camera_info import intrinsics_of_ros, read_camera_info
from jcr.capture.formats import Format
from jcr.capture.joints import JointTrack, read_arm
from jcr.capture.options import ReadOptions
from jcr.capture.pose_track import speed
from jcr.capture.recording import Recording, capture_of_recording
from jcr.capture.ros_image import depth_of, image_of
from jcr.capture.tf_tree import TfTree
from jcr.errors import InputError
from jcr.extras import extra
from jcr.progress import Progress
from jcr.records import Capture, Intrinsics

IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
SUFFIXES = (".bag", ".mcap", ".db3")
ALIGNED = "aligned_depth"
"""Part of the names of topics whose depth has the pixels of the colour image (realsense2_camera)."""
SAME_MOMENT_NS = 20_000_000
"""Largest difference between the stamps of the colour and the depth image of one exposure, ns."""


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a folder with a metadata.yaml, or a file."""
    return (path / "metadata.yaml").is_file() or path.suffix.lower() in SUFFIXES


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """Read the best frames of a bag into the folder `into`; the bag is streamed and never in memory whole.

    Raises InputError that lists the existing topics or frames where the options name others, and for images whose
    poses are stale.
    """
    with _opened(path) as reader:
        bag = _scan(reader, options, path, report)
        stamps, order = np.unique(bag.stamp_ns, return_index=True)
        log_ns = np.array(bag.log_ns)[order]
        track = None if options.urdf is None else _joint_track(bag.joint_states, options, path)
        by_tf = options.base_frame, options.gripper_frame, path
        poses_at = bag.tree.poses_at(*by_tf) if track is None else track.at
        poses, gap_ns = poses_at(stamps)
        recording = Recording(
            source=path,
            options=options,
            names=[str(stamp) for stamp in stamps],
            base_from_gripper=poses,
            speed=speed(poses_at, stamps),
            gap_ns=gap_ns,
            images_of_rows=lambda rows: _images(bag, rows, stamps, log_ns),
            intrinsics_of_size=lambda size: _intrinsics(bag, options, size),
            joints=None if track is None else track.angles(stamps),
            depth_at=(lambda row: _depth(bag, int(stamps[row]), int(log_ns[row]))) if bag.depth else None,
        )
        return capture_of_recording(recording, into, report)


@dataclass(kw_only=True)
class _Bag:
    """Connections of an open bag, and the content of one pass over its messages other than images."""

    reader: Any
    path: Path
    topic: str
    """Topic of the camera's images."""
    images: list[Any]
    """Connections of the images."""
    info: list[Any]
    """Connections of the images' CameraInfo."""
    depth: list[Any]
    """Connections of depth that has the pixels of the images."""
    stamp_ns: list[int] = field(default_factory=list)
    """Stamps of the images."""
    log_ns: list[int] = field(default_factory=list)
    """Times at which the images were recorded."""
    camera_info: Any = None
    """First CameraInfo message."""
    tree: TfTree = field(default_factory=TfTree)
    joint_states: list[tuple[int, list[str], Any]] = field(default_factory=list)
    """Stamp (ns), names and positions of each message."""


def _scan(reader: Any, options: ReadOptions, path: Path, report: Progress) -> _Bag:
    """Read transforms, joint states, CameraInfo and the stamps of the images in one pass."""
    topic = _camera_topic(reader, options, path)
    connections = reader.connections
    infos = (f"{topic.rsplit('/', k)[0]}/camera_info" for k in (1, 2))
    info = next(
        filter(None, ([c for c in connections if c.topic == name and c.msgtype == INFO] for name in infos)),
        [],
    )
    bag = _Bag(
        reader=reader,
        path=path,
        topic=topic,
        images=[c for c in connections if c.topic == topic],
        info=info,
        depth=[c for c in connections if c.msgtype in IMAGES and ALIGNED in c.topic],
    )
    wanted = [*bag.images, *bag.info, *_pose_connections(reader, options, path)]
    _refuse_other_definitions(reader, [*wanted, *bag.depth], path)
    span = max(reader.end_time - reader.start_time, 1)
    for connection, at, message in _messages(bag, wanted):
        if connection.msgtype in TF:
            bag.tree.add(message.transforms, static=connection.topic.endswith("tf_static"))
        elif connection.msgtype == JOINTS:
            bag.joint_states.append((_stamp(message, at), message.name, message.position))
        elif connection.msgtype == INFO:
            bag.camera_info = bag.camera_info or message
        else:
            bag.stamp_ns.append(_stamp(message, at))
            bag.log_ns.append(at)
            report("frames", 0.1 * (at - reader.start_time) / span)
    if not bag.stamp_ns:
        raise InputError(f"{path}: topic {topic} has no images; choose another with --camera-topic")
    return bag


def _images(
    bag: _Bag, rows: Int[ndarray, " k"], stamps: Int[ndarray, " n"], log_ns: Int[ndarray, " n"]
) -> Iterator[tuple[int, bytes | UInt8[ndarray, "h w 3"], str]]:
    """Yield row, image and file ending of the given rows of the recording."""
    for row in rows.tolist():
        at = int(log_ns[row])
        for _, _, message in _messages(bag, bag.images, start=at, stop=at + 1):
            if _stamp(message, at) == stamps[row]:
                yield row, *image_of(message, f"{bag.path}: {bag.topic}")
                break


def _depth(bag: _Bag, stamp: int, logged: int) -> UInt16[ndarray, "h w"] | None:
    """Return the depth (mm) of the exposure nearest to a stamp; None where no depth was taken with it."""
    nearest, off = None, SAME_MOMENT_NS
    span = {"start": logged - 5 * SAME_MOMENT_NS, "stop": logged + 5 * SAME_MOMENT_NS}
    for connection, at, message in _messages(bag, bag.depth, **span):
        if (apart := abs(_stamp(message, at) - stamp)) <= off:
            nearest, off = depth_of(message, f"{bag.path}: {connection.topic}"), apart
    return nearest


def _intrinsics(bag: _Bag, options: ReadOptions, size: tuple[int, int]) -> Intrinsics | None:
    """Return the intrinsics of --camera-info or of the CameraInfo; P of rectified images. ROS 1 writes K, D, P."""
    if options.camera_info is not None:
        return read_camera_info(options.camera_info, size)
    if (info := bag.camera_info) is None:
        return None
    k, d, p = (list(getattr(info, name if hasattr(info, name) else name.upper())) for name in "kdp")
    calibrated, where = (info.width, info.height), f"{bag.path}: {bag.info[0].topic}"
    if "image_rect" in bag.topic:
        return intrinsics_of_ros([*p[:3], *p[4:7], *p[8:11]], "", (), calibrated, size, where)
    return intrinsics_of_ros(k, info.distortion_model, d, calibrated, size, where)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag; InputError where it is none, or damaged."""
    highlevel = extra("rosbags.highlevel", "ros", "a bag")
    typesys = extra("rosbags.typesys", "ros", "a bag")
    try:
        # Older sqlite3 bags hold no message definitions; those of the standard messages never changed since.
        standard = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = highlevel.AnyReader([path], default_typestore=standard)
        reader.open()
        if not all(isinstance(name, str) for c in reader.connections for name in (c.topic, c.msgtype)):
            raise ValueError("its metadata has a topic without a name")
    except Exception as error:  # each storage raises its own errors, SQLite, YAML and struct among them
        raise InputError(
            f"{path}: not a readable bag ({error}); check that it was closed and is whole"
        ) from None
    try:
        yield reader
    finally:
        reader.close()


def _refuse_other_definitions(reader: Any, connections: list[Any], path: Path) -> None:
    """Raise InputError where a bag defines a message, or one inside it, otherwise than ROS 2 and ROS 1 do."""
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
    """Return a hash over a message's fields and those of all that is in it; None where not all are defined."""
    try:
        return store.hash_rihs01(name)
    except KeyError:
        return None


def _messages(bag: _Bag, connections: list[Any], **span: int) -> Iterator[tuple[Any, int, Any]]:
    """Yield connection, time of recording (ns) and content of each message; InputError where the bag is damaged."""
    recorded = bag.reader.messages(connections, **span)
    while True:
        try:
            connection, at, raw = next(recorded)
            message = bag.reader.deserialize(raw, connection.msgtype)
        except StopIteration:
            return
        except Exception as error:  # each storage raises its own errors, struct and KeyError among them
            raise InputError(
                f"{bag.path}: damaged ({error}); repair it with the tool that recorded it"
            ) from None
        yield connection, at, message


def _camera_topic(reader: Any, options: ReadOptions, path: Path) -> str:
    """Return the topic of --camera-topic, or the only one with colour images."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in IMAGES})
    # A topic /compressed beside its raw topic has the same images once more.
    colour = [
        topic
        for topic in topics
        if "depth" not in topic.lower() and topic.removesuffix("/compressed") not in {*topics} - {topic}
    ]
    if options.camera_topic in topics:
        return str(options.camera_topic)
    if options.camera_topic is None and len(colour) == 1:
        return colour[0]
    asked = "" if options.camera_topic is None else f"no images on {options.camera_topic}; "
    raise InputError(
        f"{path}: {asked}choose the wrist camera's topic with --camera-topic: {', '.join(topics) or 'there are none'}"
    )


def _pose_connections(reader: Any, options: ReadOptions, path: Path) -> list[Any]:
    """Return the connections that carry the robot: tf, or joint states where a URDF is given."""
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


def _joint_track(
    joint_states: list[tuple[int, list[str], Any]], options: ReadOptions, path: Path
) -> JointTrack:
    """Return the joints of the arm of --urdf, each sampled at the stamps of its own messages."""
    arm = read_arm(options)
    samples: dict[str, list[tuple[int, float]]] = {}
    for stamp, names, values in joint_states:
        for name, value in zip(names, values, strict=False):
            samples.setdefault(name, []).append((stamp, float(value)))
    arm.columns(list(samples), str(path))
    stamps, positions = list[Int[ndarray, " k"]](), list[Float[ndarray, " k"]]()
    for joint in arm.joints:
        of_joint, values = zip(*samples[joint], strict=True)
        stamp, order = np.unique(of_joint, return_index=True)
        stamps.append(stamp)
        positions.append(np.array(values)[order])
    return JointTrack(arm, tuple(stamps), tuple(positions))


def _stamp(message: Any, log_ns: int) -> int:
    """Return the stamp (ns) of a message; the time of its recording for drivers that leave the stamp empty."""
    stamp = message.header.stamp
    return stamp.sec * 10**9 + stamp.nanosec or log_ns


FORMAT = Format(name="bag", about="a ROS 1 or ROS 2 bag", recognises=is_bag, read=read, recording=True)
