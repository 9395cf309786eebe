"""Foxglove's messages in MCAP files, in protobuf or JSON, as the messages of ROS that the reader of bags takes.

https://docs.foxglove.dev/docs/sdk/schemas describes the messages.
"""

import base64
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jcr.allocator import require_memory
from jcr.extras import extra

ENCODINGS = ("protobuf", "json")
"""Encodings of messages; those of ROS are read by rosbags."""
INDEX_BYTES = 8_000_000
"""Part (bytes) of the end of a file in which names of messages are looked for; an hour of video has 1 MB of index."""


def _stamp(message: Any) -> SimpleNamespace:
    """Return the stamp of a message as that of ROS: protobuf names the parts seconds and nanos, JSON sec and nsec."""
    time = _value(message, "timestamp")
    sec, nanosec = ("sec", "nsec") if isinstance(time, dict) else ("seconds", "nanos")
    return SimpleNamespace(sec=_value(time, sec), nanosec=_value(time, nanosec))


def _value(message: Any, name: str, otherwise: Any = None) -> Any:
    """Return a field of a message, which is a dictionary (JSON) or has attributes (protobuf)."""
    return message.get(name, otherwise) if isinstance(message, dict) else getattr(message, name)


def _data(message: Any) -> bytes:
    """Return the bytes of an image, which JSON has in base64."""
    data = _value(message, "data")
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _header(message: Any, frame: str = "frame_id") -> SimpleNamespace:
    """Return the header of ROS for a message; `frame` names the field with its frame."""
    return SimpleNamespace(stamp=_stamp(message), frame_id=_value(message, frame, ""))


def _compressed(message: Any) -> SimpleNamespace:
    return SimpleNamespace(header=_header(message), format=_value(message, "format", ""), data=_data(message))


def _raw(message: Any) -> SimpleNamespace:
    names = ("width", "height", "encoding", "step")
    fields = {name: _value(message, name) for name in names}
    return SimpleNamespace(header=_header(message), is_bigendian=False, data=_data(message), **fields)


def _calibration(message: Any) -> SimpleNamespace:
    fields = {name: list(_value(message, name.upper(), [])) for name in ("k", "d", "p")}
    size = {name: _value(message, name) for name in ("width", "height")}
    model = _value(message, "distortion_model", "")
    return SimpleNamespace(header=_header(message), distortion_model=model, **fields, **size)


def _transform(message: Any) -> SimpleNamespace:
    moved, turned = _value(message, "translation"), _value(message, "rotation")
    transform = SimpleNamespace(
        translation=SimpleNamespace(**{axis: _value(moved, axis, 0.0) for axis in "xyz"}),
        rotation=SimpleNamespace(**{axis: _value(turned, axis, 0.0) for axis in "xyzw"}),
    )
    child = _value(message, "child_frame_id")
    return SimpleNamespace(
        header=_header(message, "parent_frame_id"), child_frame_id=child, transform=transform
    )


def _transforms(message: Any) -> SimpleNamespace:
    return SimpleNamespace(transforms=[_transform(one) for one in _value(message, "transforms", [])])


def _pose(message: Any) -> SimpleNamespace:
    pose = _value(message, "pose")
    position, turned = _value(pose, "position"), _value(pose, "orientation")
    pose = SimpleNamespace(
        position=SimpleNamespace(**{axis: _value(position, axis, 0.0) for axis in "xyz"}),
        orientation=SimpleNamespace(**{axis: _value(turned, axis, 0.0) for axis in "xyzw"}),
    )
    return SimpleNamespace(header=_header(message), pose=pose)


SCHEMAS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "foxglove.CompressedImage": ("sensor_msgs/msg/CompressedImage", _compressed),
    "foxglove.RawImage": ("sensor_msgs/msg/Image", _raw),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _calibration),
    "foxglove.FrameTransform": (
        "tf2_msgs/msg/TFMessage",
        lambda message: SimpleNamespace(transforms=[_transform(message)]),
    ),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", _transforms),
    "foxglove.PoseInFrame": ("geometry_msgs/msg/PoseStamped", _pose),
    "foxglove.CompressedVideo": ("foxglove_msgs/msg/CompressedVideo", lambda message: message),
}
"""Type of ROS of each message of Foxglove, and the conversion to it."""


class FoxgloveReader:
    """MCAP file with messages of Foxglove, with the interface of the reader of bags (rosbags' AnyReader)."""

    def __init__(self, file: Path) -> None:
        """Open a file and read its index; raise InputError without the packages, and their errors for a damaged file."""
        reading = extra("mcap.reader", "ros", "an MCAP file of Foxglove")
        self._decoders = extra("mcap_protobuf.decoder", "ros", "an MCAP file of Foxglove").DecoderFactory()
        self._stream = file.open("rb")
        self._reader = reading.make_reader(self._stream)
        summary = self._reader.get_summary()
        if summary is None or summary.statistics is None:
            raise ValueError("it has no index; repair it with `mcap recover`")
        require_memory(max((one.uncompressed_size for one in summary.chunk_indexes), default=0), str(file))
        self.start_time = summary.statistics.message_start_time
        self.end_time = summary.statistics.message_end_time
        self._schemas, self.connections = summary.schemas, list[SimpleNamespace]()
        for channel in summary.channels.values():
            schema = summary.schemas.get(channel.schema_id)
            if schema is not None and schema.name in SCHEMAS and channel.message_encoding in ENCODINGS:
                kind = SCHEMAS[schema.name][0]
                self.connections.append(SimpleNamespace(topic=channel.topic, msgtype=kind, id=channel.id))

    def messages(
        self, connections: Sequence[Any], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Any, int, Any]]:
        """Yield connection, time of recording (ns) and message, from `start` (ns, included) to `stop` (excluded)."""
        of_channel = {one.id: one for one in connections}
        topics = [one.topic for one in connections]
        records = self._reader.iter_messages(topics, starting_at=start, ending_before=stop)
        for schema, channel, record in records if topics else ():
            if channel.id in of_channel and schema is not None:
                decode = json.loads
                if channel.message_encoding == "protobuf":
                    decode = self._decoders.decoder_for("protobuf", schema)
                message = SCHEMAS[schema.name][1](decode(record.data))
                yield of_channel[channel.id], record.log_time, message

    def deserialize(self, message: Any, msgtype: str) -> Any:
        """Return a message, which `messages` has decoded."""
        return message

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


def recognises(file: Path) -> bool:
    """Test whether a file is an MCAP file whose index, near its end, names messages of Foxglove."""
    if file.suffix.lower() != ".mcap" or not file.is_file():
        return False
    with file.open("rb") as stream:
        stream.seek(max(0, file.stat().st_size - INDEX_BYTES))
        return b"foxglove." in stream.read()
