"""MCAP files by their head, and protobuf messages under the names of ROS."""

import struct
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin.formats.foxglove import Connection, FoxgloveReader, profile_of


def head(profile: bytes, length: int | None = None) -> bytes:
    size = len(profile) if length is None else length
    return b"\x89MCAP0\r\n" + b"\x01" + struct.pack("<QI", 4 + size, size) + profile + b"rest"


@pytest.mark.parametrize(
    ("raw", "profile"),
    [
        (head(b"ros2"), "ros2"),
        (head(b""), ""),
        (head(b"x" * 300), "x" * 256),
        (head(b"ab\xff"), "ab\ufffd"),
        (head(b"ros2").replace(b"MCAP0", b"MCAP1"), None),
        (head(b"")[:20], None),
        (head(b"")[:21], ""),
        (b"", None),
    ],
)
def test_the_head_of_an_mcap_file_says_its_profile(raw, profile, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(raw)
    assert (
        profile_of(path) == profile and profile_of(tmp_path) is None and profile_of(tmp_path / "no") is None
    )


pytest.importorskip("mcap_protobuf")


def reader() -> FoxgloveReader:
    return FoxgloveReader(Path("a.mcap"))


def test_messages_have_the_names_of_ros():
    made = reader()
    camera = SimpleNamespace(
        frame_id="eye", width=64, height=48, distortion_model="plumb_bob", D=(1, 2), K=(3,), R=(4,), P=(5, 6)
    )
    read = made.deserialize(camera, "foxglove/CameraInfo")
    assert read.header.frame_id == "eye" and (read.width, read.height) == (64, 48)
    assert (read.distortion_model, read.D, read.K, read.R, read.P) == ("plumb_bob", [1, 2], [3], [4], [5, 6])
    coded = SimpleNamespace(frame_id="eye", data=b"\x01\xff", format="jpeg")
    read = made.deserialize(coded, "foxglove/CompressedImage")
    assert vars(read).keys() == {"header", "format", "data"} and read.format == "jpeg"
    assert read.header.frame_id == "eye" and np.array_equal(read.data, np.array([1, 255], np.uint8))
    raw = SimpleNamespace(frame_id="eye", data=b"\x02\x03", width=2, height=1, encoding="mono8", step=2)
    read = made.deserialize(raw, "foxglove/Image")
    assert (read.width, read.height, read.encoding, read.step, read.is_bigendian) == (2, 1, "mono8", 2, 0)
    assert read.header.frame_id == "eye" and np.array_equal(read.data, np.array([2, 3], np.uint8))
    stamp = SimpleNamespace(timestamp=SimpleNamespace(seconds=1_700_000_001, nanos=987_654_321))
    assert made.header_ns(stamp) == 1_700_000_001_987_654_321


class Mcap:
    """What ``mcap.reader`` gives for a file with these channels and messages."""

    def __init__(self, channels, messages=()):
        self.asked = []
        schemas = {n: SimpleNamespace(name=name) for n, (_, name, _) in channels.items() if name is not None}
        made = {
            n: SimpleNamespace(schema_id=n, topic=topic, message_encoding=how)
            for n, (topic, _, how) in channels.items()
        }
        self.summary = SimpleNamespace(channels=made, schemas=schemas)
        self.messages = messages

    def get_summary(self):
        return self.summary

    def iter_messages(self, topics, starting_at, ending_before):
        self.asked.append((topics, starting_at, ending_before))
        for number, at, data in self.messages:
            if self.summary.channels[number].topic in topics:
                yield None, self.summary.channels[number], SimpleNamespace(log_time=at, data=data)


def opened(tmp_path, mcap) -> FoxgloveReader:
    path = tmp_path / "a.mcap"
    path.touch()
    made = FoxgloveReader(path)
    made._make = lambda file: mcap
    made._factory = SimpleNamespace(decoder_for=lambda how, schema: lambda data: (how, schema.name, data))
    return made


def test_topics_of_protobuf_are_read_with_their_own_decoders(tmp_path):
    channels = {
        1: ("/a", "foxglove.RawImage", "protobuf"),
        2: ("/b", "foxglove.CompressedImage", "protobuf"),
        3: ("/c", "foxglove.CameraCalibration", "protobuf"),
        4: ("/d", "foxglove.CompressedVideo", "protobuf"),
        5: ("/e", "own.Message", "protobuf"),
        6: ("/f", "foxglove.RawImage", "json"),
        7: ("/g", None, "protobuf"),
    }
    mcap = Mcap(channels, [(2, 70, b"two"), (1, 80, b"one")])
    with opened(tmp_path, mcap) as made:
        types = ["Image", "CompressedImage", "CameraInfo", "CompressedVideo"]
        expected = [
            Connection(f"/{letter}", f"foxglove/{kind}") for letter, kind in zip("abcd", types, strict=True)
        ]
        assert made.connections == [*expected, Connection("/e", "own.Message")]
        read = list(made.messages(expected[:2], 5, 99))
        assert read == [
            (expected[1], 70, ("protobuf", "foxglove.CompressedImage", b"two")),
            (expected[0], 80, ("protobuf", "foxglove.RawImage", b"one")),
        ]
        list(made.messages(expected[:1]))
        assert mcap.asked == [(["/a", "/b"], 5, 99), (["/a"], None, None)]
        file = made._file
        assert not file.closed
    assert file.closed


def test_a_file_without_protobuf_is_closed_and_says_what_it_holds(tmp_path):
    for channels, held in (({1: ("/a", "x", "json"), 2: ("/b", "y", "cdr")}, "cdr, json"), ({}, "nothing")):
        made = opened(tmp_path, Mcap(channels))
        with pytest.raises(
            ValueError,
            match=f"LEFT must be an MCAP file of messages of ROS 2 or of protobuf; got .* of {held}",
        ):
            made.open()
        assert made._file.closed
    empty = Mcap({})
    empty.summary = None
    with pytest.raises(ValueError, match="got .* of nothing"):
        opened(tmp_path, empty).open()
