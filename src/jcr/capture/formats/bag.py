"""Bags of ROS and MCAP files of Foxglove: images of a camera, and gripper poses from tf, poses or joint states."""

import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from operator import index
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from jcr.capture.documents import read_content
from jcr.capture.formats import foxglove
from jcr.capture.frame_extraction import Picture, Recording, capture_of_recording
from jcr.capture.options import ReadOptions, chosen_name
from jcr.capture.pose_track import PosesAt, Stamps, TfTree, interpolated_poses, poses_of_numbers, speed
from jcr.capture.ros_messages import image_of, intrinsics_of_ros
from jcr.capture.urdf_chain import read_arm
from jcr.errors import LONGEST_SHOWN, InputError, shown
from jcr.extras import extra
from jcr.progress import Progress
from jcr.records import Capture, FrameNames, Intrinsics

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO, JOINTS = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"
TF = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
POSE = "geometry_msgs/msg/PoseStamped"
VIDEOS = {
    "foxglove_msgs/msg/CompressedVideo": "foxglove",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket": "ffmpeg",
}
"""Types of video messages, and the transport of image_transport that decodes each."""
BAG_SUFFIXES = (".bag", ".mcap", ".db3")
LATEST_NS = 2**62
"""Largest time stamp (ns): in the year 2116, far enough from the largest int64 for differences of two."""


def recognises(path: Path) -> bool:
    """Test whether a path is a bag: a folder with a metadata.yaml, or a .bag, .mcap or .db3 file."""
    return (path / "metadata.yaml").is_file() or path.suffix.lower() in BAG_SUFFIXES


def read(path: Path, options: ReadOptions, into: Path, report: Progress) -> Capture:
    """Extract the sharpest frames at rest of a bag into the folder `into`, and return them as a capture."""
    with _opened(path) as reader:
        bag = _Bag(reader, path, options, report)
        stamps, joints, base = bag.stamp_ns, None, options.base_frame
        if bag.poses:
            poses_at, base = bag.poses_at(), base or bag.pose_frame
        elif options.urdf is None:
            poses_at = bag.tree.poses_at(options.base_frame, options.gripper_frame, path)
        else:
            arm = read_arm(options)
            base = arm.base
            arm.columns(list(bag.joints), str(path))
            ordered = [dict(sorted(bag.joints[name].items())) for name in arm.joints]
            samples = [(np.array([*one]), np.array([*one.values()])) for one in ordered]

            def by_joints(at: Stamps) -> tuple[Float[ndarray, "n 4 4"], Int[ndarray, " n"]]:
                recorded, gap = arm.interpolated(samples, at)
                return arm.poses(recorded, str(path)), gap

            poses_at, joints = by_joints, arm.angles(arm.interpolated(samples, stamps)[0])

        poses, gap_ns = poses_at(stamps)
        recording = Recording(
            source=path,
            options=options,
            names=[str(stamp) for stamp in stamps],
            base_from_gripper=poses,
            speed=speed(poses_at, stamps),
            gap_ns=gap_ns,
            images_of_rows=bag.pictures,
            intrinsics_of_size=bag.intrinsics,
            joints=joints,
            frame_names=FrameNames().replaced(base=base, camera=bag.frame_id),
        )
        return capture_of_recording(recording, into, report)


class _Bag:
    """Open bag, and the content of all its messages except the images, collected in one pass."""

    def __init__(self, reader: Any, path: Path, options: ReadOptions, report: Progress) -> None:
        """Read transforms, joint states, CameraInfo and image time stamps of the bag `path`.

        Raises InputError for a missing topic or message content that is not ROS's.
        """
        self.reader, self.path, self.tree = reader, path, TfTree()
        stamps, recorded = list[int](), list[int]()
        self.joints = dict[str, dict[int, float]]()
        """Positions of each joint: from the joint's name to a dictionary from time stamp (ns) to position."""
        self.poses = dict[int, tuple[float, ...]]()
        """Pose of the gripper (x, y, z, qx, qy, qz, qw) by time stamp (ns), from a topic of poses."""
        self.pose_frame: object = None
        """Frame in the header of the first pose."""
        self.camera_info: Any = None
        self.frame_id: object = None
        """Frame in the header of the first image."""
        self.topic = topic = _camera_topic(reader, options, path)
        self.images = [c for c in reader.connections if c.topic == topic]
        infos = [f"{topic.rsplit('/', k)[0]}/camera_info" for k in (1, 2)]
        every = [c for c in reader.connections if c.msgtype == INFO]
        info = [c for name in infos for c in every if c.topic == name][:1]
        if not info and len({c.topic for c in reader.connections if c.msgtype in IMAGE_TYPES}) == 1 == len(
            every
        ):
            info = every  # the names of Foxglove's topics are free
        span = max(reader.end_time - reader.start_time, 1)
        wanted = [*self.images, *info, *_pose_connections(reader, options, path)]
        for connection, at, message in self.messages(wanted):
            kind = connection.msgtype
            try:
                if kind in TF:
                    self.tree.add(message.transforms, static=connection.topic.endswith("tf_static"))
                elif kind == JOINTS:
                    for name, value in zip(message.name, message.position, strict=False):
                        if not isinstance(name, str):
                            raise TypeError("a joint whose name is no text")
                        self.joints.setdefault(name, {}).setdefault(_stamp(message, at), float(value))
                elif kind == POSE:
                    at_m, q = message.pose.position, message.pose.orientation
                    numbers = (at_m.x, at_m.y, at_m.z, q.x, q.y, q.z, q.w)
                    self.poses.setdefault(_stamp(message, at), tuple(map(float, numbers)))
                    self.pose_frame = self.pose_frame or message.header.frame_id
                elif kind == INFO:
                    self.camera_info = self.camera_info or message
                else:
                    self.frame_id = self.frame_id or message.header.frame_id
                    stamps.append(_stamp(message, at))
                    recorded.append(at)
            except (AttributeError, TypeError, ValueError, OverflowError) as error:
                text = f"its {kind} is not the one of ROS ({str(error)[:LONGEST_SHOWN]}); record the standard message"
                raise InputError(f"{path}: {text}") from None
            report("frames", 0.1 * (at - reader.start_time) / span)
        if not stamps:
            raise InputError(f"{path}: topic {topic} has no images; choose another with --camera-topic")
        self.stamp_ns, order = np.unique(stamps, return_index=True)
        """Ascending time stamps (ns) of the images."""
        self.log_ns = np.array(recorded)[order]
        """Times (ns) at which the images were recorded."""

    def poses_at(self) -> PosesAt:
        """Return the function from time stamps (ns) to the poses of the pose topic and the gaps (ns) of its samples."""
        stamps, numbers = np.array([*self.poses]), np.array([*self.poses.values()])
        return partial(
            interpolated_poses, stamps, poses_of_numbers(numbers, f"{self.path}: its topic of poses")
        )

    def messages(self, connections: list[Any], **span: int) -> Iterator[tuple[Any, int, Any]]:
        """Yield the connection, time of recording (ns) and decoded content of each message of `connections`.

        `span` may limit the times of recording: `start` (included) and `stop` (excluded), in ns.
        """
        try:
            for connection, at, raw in self.reader.messages(connections, **span):
                yield connection, at, self.reader.deserialize(raw, connection.msgtype)
        except Exception as error:  # each storage raises its own errors, struct and KeyError among them
            raise InputError(f"{self.path}: damaged ({error}); repair it with its recorder") from None

    def pictures(self, rows: Int[ndarray, " k"]) -> Iterator[Picture]:
        """Yield the row, image (encoded bytes, RGB pixels, or an error) and file ending for each of k rows.

        A row is the index of an image of the bag in the order of time stamps. Images that are not found are left out.
        """
        for row in rows.tolist():
            at = int(self.log_ns[row])
            for _, _, message in self.messages(self.images, start=at, stop=at + 1):
                if _stamp(message, at) == self.stamp_ns[row]:
                    try:
                        yield row, *image_of(message, f"{self.path}: {self.topic}")
                    except InputError as error:
                        yield row, error, ""
                    break

    def intrinsics(self, size: tuple[int, int]) -> Intrinsics | None:
        """Return the intrinsics in the bag's CameraInfo for images of `size` (width, height); None if it has none.

        For rectified images they are those of CameraInfo's projection matrix P (3,4), without distortion.
        """
        if (info := self.camera_info) is None:
            return None
        where = f"{self.path}: camera_info of {self.topic}"
        return intrinsics_of_ros(info, size, where, is_rectified="image_rect" in self.topic)


def _require_plain(file: Path) -> None:
    """Raise ValueError if a table of a sqlite3 bag has columns that are computed: few bytes then yield gigabytes."""
    with closing(sqlite3.connect(f"{file.resolve().as_uri()}?mode=ro&immutable=1", uri=True)) as bag:
        for (name,) in bag.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            if any(row[0] for row in bag.execute("SELECT hidden FROM pragma_table_xinfo(?)", (name,))):
                raise ValueError(f"its table {shown(name)} has computed columns")


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag and yield its reader (rosbags' AnyReader); raise InputError if the path is no bag or it is damaged."""
    if is_foxglove := foxglove.recognises(path):
        extra("mcap", "ros", "an MCAP file of Foxglove")
    highlevel = extra("rosbags.highlevel", "ros", "a bag")
    typesys = extra("rosbags.typesys", "ros", "a bag")
    try:
        metadata = path / "metadata.yaml"
        about = read_content(metadata) if metadata.is_file() else None
        files = about["rosbag2_bagfile_information"]["relative_file_paths"] if about is not None else []
        if not isinstance(files, list):  # a text would be taken for as many files as it has letters
            raise ValueError("its metadata has no list of files")
        for file in sorted(path.glob("*.db3")) if path.is_dir() else [path] * (path.suffix.lower() == ".db3"):
            _require_plain(file)
        # Older sqlite3 bags hold no message definitions; the standard messages have not changed since.
        standard = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
        reader = foxglove.FoxgloveReader(path) if is_foxglove else None
        if reader is None or not reader.connections:
            reader = highlevel.AnyReader([path], default_typestore=standard)
            reader.open()
        if not all(isinstance(name, str) for c in reader.connections for name in (c.topic, c.msgtype)):
            raise ValueError("its metadata has a topic without a name")
    except Exception as error:  # each storage raises its own errors, SQLite, YAML and struct among them
        raise InputError(f"{path}: not a readable bag ({error}); check that it is whole") from None
    try:
        yield reader
    finally:
        reader.close()


def _camera_topic(reader: Any, options: ReadOptions, path: Path) -> str:
    """Return the topic of --camera-topic, or without that option the only topic with colour images."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype in IMAGE_TYPES})
    videos = {c.topic: VIDEOS[c.msgtype] for c in reader.connections if c.msgtype in VIDEOS}
    asked = options.camera_topic or (next(iter(videos), "") if not topics else "")
    if (transport := videos.get(asked)) is not None:
        raise InputError(
            f"{path}: {asked} is a video; play the recording and record its images: ros2 run image_transport republish "
            f"--ros-args -p in_transport:={transport} -p out_transport:=compressed -r in/{transport}:={asked} -r "
            f"out/compressed:={asked}/images/compressed"
        )
    # A topic /compressed repeats the images of its raw topic.
    repeats = {f"{topic}/compressed" for topic in topics}
    colour = [topic for topic in topics if "depth" not in topic.lower() and topic not in repeats]
    what = f"{path}: the wrist camera's topic"
    return chosen_name(topics, options.camera_topic, colour, what, "--camera-topic")


def _pose_connections(reader: Any, options: ReadOptions, path: Path) -> list[Any]:
    """Return the reader's connections (topics) with the robot's poses: tf, a PoseStamped topic, or joint states.

    Joint states are read if `options.urdf` is given; a topic of poses if the options name it, or without tf.
    """
    if options.urdf is None:
        found = [c for c in reader.connections if c.msgtype in TF]
        poses = sorted({c.topic for c in reader.connections if c.msgtype == POSE})
        if poses and (options.joint_topic in poses or not found):
            topic = chosen_name(
                poses, options.joint_topic, poses, f"{path}: the gripper's poses", "--joint-topic"
            )
            return [c for c in reader.connections if c.topic == topic]
        if not found:
            raise InputError(f"{path}: no /tf and no poses; give --urdf for joint states, or record tf, too")
        return found
    topics = sorted({c.topic for c in reader.connections if c.msgtype == JOINTS})
    topic = chosen_name(topics, options.joint_topic, topics, f"{path}: the joint states", "--joint-topic")
    return [c for c in reader.connections if c.topic == topic]


def _stamp(message: Any, log_ns: int) -> int:
    """Return the time stamp (ns) in the header of a ROS message; `log_ns`, the time of recording, if the stamp is 0.

    Raises TypeError or OverflowError for a stamp that is none.
    """
    stamp = message.header.stamp
    # A text of a bag with its own definitions would be repeated a billion times.
    if abs(found := index(stamp.sec) * 10**9 + index(stamp.nanosec)) > LATEST_NS:
        raise OverflowError(f"a time stamp of {found} ns")
    return found or log_ns
