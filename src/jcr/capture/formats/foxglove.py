"""Foxglove's messages in MCAP files, in protobuf or JSON, as the messages of ROS that the reader of bags takes.

https://docs.foxglove.dev/docs/sdk/schemas describes the messages.
"""

import base64
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from jcr.extras import extra
from jcr.memory import require_memory

ENCODINGS = ("protobuf", "json")
"""Encodings of messages; those of ROS are read by rosbags."""
INDEX_BYTES = 8_000_000
"""Part (bytes) of the end of a file in which names of messages are looked for; an hour of video has 1 MB of index."""


ABSENT = {
    **dict.fromkeys(("x", "y", "z", "w"), 0.0), **dict.fromkeys(("K", "D", "P", "transforms"), ()),
    **dict.fromkeys(("frame_id", "parent_frame_id", "format", "distortion_model"), ""),
}  # fmt: skip
"""Values of fields that are not in a message of JSON, as protobuf has them."""


def _of_json(content: dict[str, Any]) -> SimpleNamespace:
    """Return an object of JSON with the fields of the message in protobuf, which names the parts of a time otherwise."""
    time = {"seconds": content.get("sec"), "nanos": content.get("nsec")}
    return SimpleNamespace(**ABSENT | time | content)


def _as_ros(message: Any, frame: str = "frame_id", **fields: Any) -> SimpleNamespace:
    """Return the message of ROS with fields and the header of a message; `frame` names the field with its frame."""
    stamp = SimpleNamespace(sec=message.timestamp.seconds, nanosec=message.timestamp.nanos)
    header = SimpleNamespace(stamp=stamp, frame_id=getattr(message, frame))
    return SimpleNamespace(header=header, **fields)


def _data(message: Any) -> bytes:
    """Return the bytes of an image, which JSON has in base64."""
    data = message.data
    return base64.b64decode(data, validate=True) if isinstance(data, str) else bytes(data)


def _raw(message: Any) -> SimpleNamespace:
    size: dict[str, Any] = {name: getattr(message, name) for name in ("width", "height", "encoding", "step")}
    return _as_ros(message, is_bigendian=False, data=_data(message), **size)


def _calibration(message: Any) -> SimpleNamespace:
    fields: dict[str, Any] = {name: list(getattr(message, name.upper())) for name in ("k", "d", "p")}
    fields |= {name: getattr(message, name) for name in ("width", "height", "distortion_model")}
    return _as_ros(message, **fields)


def _transforms(messages: Iterable[Any]) -> SimpleNamespace:
    made = [
        _as_ros(one, "parent_frame_id", child_frame_id=one.child_frame_id, transform=one) for one in messages
    ]
    return SimpleNamespace(transforms=made)


SCHEMAS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "foxglove.CompressedImage": (
        "sensor_msgs/msg/CompressedImage",
        lambda one: _as_ros(one, format=one.format, data=_data(one)),
    ),
    "foxglove.RawImage": ("sensor_msgs/msg/Image", _raw),
    "foxglove.CameraCalibration": ("sensor_msgs/msg/CameraInfo", _calibration),
    "foxglove.FrameTransform": ("tf2_msgs/msg/TFMessage", lambda one: _transforms([one])),
    "foxglove.FrameTransforms": ("tf2_msgs/msg/TFMessage", lambda one: _transforms(one.transforms)),
    "foxglove.PoseInFrame": ("geometry_msgs/msg/PoseStamped", lambda one: _as_ros(one, pose=one.pose)),
    "foxglove.CompressedVideo": ("foxglove_msgs/msg/CompressedVideo", lambda one: one),
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
                decode = partial(json.loads, object_hook=_of_json)
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
