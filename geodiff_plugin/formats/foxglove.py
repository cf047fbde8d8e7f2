"""Reads MCAP files with Foxglove's protobuf messages like a bag, using ``mcap-protobuf-support``.

Source: ``RawImage.proto``, ``CompressedImage.proto`` and ``CameraCalibration.proto`` of
foxglove/foxglove-sdk; the MCAP specification of foxglove/mcap.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value, raise_input_error

MAGIC = b"\x89MCAP0\r\n"
#: Header of an MCAP file, after an opcode and a length, which states the profile of its messages.
HEAD = struct.Struct("<BQI")
#: Profiles of ROS, whose messages are not protobuf.
ROS_PROFILES = ("ros1", "ros2")
#: Foxglove's message types by the ROS equivalent.
MESSAGES = {
    "foxglove.RawImage": "foxglove/Image",
    "foxglove.CompressedImage": "foxglove/CompressedImage",
    "foxglove.CompressedVideo": "foxglove/CompressedVideo",
    "foxglove.CameraCalibration": "foxglove/CameraInfo",
}
INSTALL = "Foxglove messages need mcap-protobuf-support: pip install 'geodiff-plugin[foxglove]'."


def profile_of(path: Path) -> str | None:
    """Return the profile in the header of an MCAP file, often empty; ``None`` for other files."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        head = file.read(len(MAGIC) + HEAD.size)
        if len(head) < len(MAGIC) + HEAD.size or not head.startswith(MAGIC):
            return None
        _, _, length = HEAD.unpack(head[len(MAGIC) :])
        return file.read(min(length, 256)).decode(errors="replace")


@dataclass(frozen=True)
class Connection:
    """A topic of a file, with its ROS message type."""

    topic: str
    msgtype: str


class FoxgloveReader(AbstractContextManager["FoxgloveReader"]):
    """Reads protobuf messages of an MCAP file with the interface of rosbags' ``AnyReader``.

    ``deserialize`` returns messages with ROS field names.
    """

    def __init__(self, path: Path) -> None:
        try:
            from mcap.reader import make_reader
            from mcap_protobuf.decoder import DecoderFactory
        except ImportError:
            raise_input_error(INSTALL)
        self._path = path
        self._make = make_reader
        self._factory = DecoderFactory()
        self._decoders: dict[str, Any] = {}
        self.connections: list[Connection] = []

    def open(self) -> None:
        """Read the summary of the file."""
        self._file = self._path.open("rb")
        try:
            self._read_summary()
        except Exception:
            self.close()
            raise

    def _read_summary(self) -> None:
        self._reader = self._make(self._file)
        summary = self._reader.get_summary()
        channels, schemas = (summary.channels, summary.schemas) if summary else ({}, {})
        for channel in channels.values():
            schema = schemas.get(channel.schema_id)
            if channel.message_encoding == "protobuf" and schema is not None:
                self._decoders[channel.topic] = self._factory.decoder_for("protobuf", schema)
                self.connections.append(Connection(channel.topic, MESSAGES.get(schema.name, schema.name)))
        if not self.connections:
            held = sorted({channel.message_encoding for channel in channels.values()})
            hint = "Export both topics as folders of images, and pass those."
            got = f"{self._path} of {', '.join(held) or 'nothing'}"
            bad_value("LEFT", "an MCAP file of messages of ROS 2 or of protobuf", got, hint)

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __enter__(self) -> FoxgloveReader:
        self.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def messages(
        self, connections: Sequence[Connection], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[Connection, int, Any]]:
        """Yield connection, recording time in nanoseconds and message before ``stop``, in order."""
        by_topic = {connection.topic: connection for connection in connections}
        found = self._reader.iter_messages(topics=list(by_topic), starting_at=start, ending_before=stop)
        for _, channel, message in found:
            yield by_topic[channel.topic], message.log_time, self._decoders[channel.topic](message.data)

    def deserialize(self, message: Any, msgtype: str) -> Any:
        """Return an image or calibration with ROS field names."""
        header = SimpleNamespace(frame_id=message.frame_id)
        if msgtype == MESSAGES["foxglove.CameraCalibration"]:
            matrices = {key: list(getattr(message, key)) for key in "DKRP"}
            sizes = {"width": message.width, "height": message.height}
            return SimpleNamespace(
                header=header, distortion_model=message.distortion_model, **sizes, **matrices
            )
        data = np.frombuffer(message.data, np.uint8)
        if msgtype == MESSAGES["foxglove.CompressedImage"]:
            return SimpleNamespace(header=header, format=message.format, data=data)
        names = ("width", "height", "encoding", "step")
        return SimpleNamespace(
            header=header, data=data, is_bigendian=0, **{name: getattr(message, name) for name in names}
        )

    @staticmethod
    def header_ns(message: Any) -> int:
        """Return the capture time of an image in nanoseconds."""
        return int(message.timestamp.seconds) * 1_000_000_000 + int(message.timestamp.nanos)
