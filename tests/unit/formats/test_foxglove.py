"""MCAP files by their head, and protobuf messages under the names of ROS.

Schemas are written here by the numbers of Foxglove's .proto files.
"""

import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import given

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.foxglove import Connection, FoxgloveReader, profile_of
from geodiff_plugin.formats.recordings import BagReader, list_pairs, stereo_calibration
from tests.fuzz.test_fuzz import EXAMPLES, damaged, is_recoverable


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
def test_the_header_of_an_mcap_file_states_its_profile(raw, profile, tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(raw)
    assert (
        profile_of(path) == profile and profile_of(tmp_path) is None and profile_of(tmp_path / "no") is None
    )


pytest.importorskip("mcap_protobuf")
pytest.importorskip("rosbags")
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, timestamp_pb2  # noqa: E402
from mcap.writer import Writer  # noqa: E402

from tests.unit.formats.bags import SIZE, TOPICS, K, rgb  # noqa: E402


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


def test_a_file_without_protobuf_is_closed_and_its_content_is_reported(tmp_path):
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


#: Entries of the messages: number, type (9 text, 12 bytes, 7 fixed32, 1 double), and whether it is a list.
SCHEMAS = {
    "RawImage": {
        **{"width": (2, 7), "height": (3, 7), "encoding": (4, 9), "step": (5, 7), "data": (6, 12)},
        "frame_id": (7, 9),
    },
    "CompressedImage": {"data": (2, 12), "format": (3, 9), "frame_id": (4, 9)},
    "CompressedVideo": {"frame_id": (2, 9), "data": (3, 12), "format": (4, 9)},
    "CameraCalibration": {
        **{"width": (2, 7), "height": (3, 7), "distortion_model": (4, 9)},
        **{"D": (5, 1, 3), "K": (6, 1, 3), "R": (7, 1, 3), "P": (8, 1, 3), "frame_id": (9, 9)},
    },
}
ONCE = 1  # the label of an entry that is no list


def schema(kind: str) -> descriptor_pb2.FileDescriptorProto:
    file = descriptor_pb2.FileDescriptorProto(
        name=f"foxglove/{kind}.proto", package="foxglove", syntax="proto3"
    )
    file.dependency.append("google/protobuf/timestamp.proto")
    message = file.message_type.add(name=kind)
    stamp = message.field.add(name="timestamp", number=1, type=11, label=ONCE)
    stamp.type_name = ".google.protobuf.Timestamp"
    for name, (number, kind_of, *label) in SCHEMAS[kind].items():
        message.field.add(name=name, number=number, type=kind_of, label=label[0] if label else ONCE)
    return file


def message_of(kind: str, at_ns: int, **entries) -> bytes:
    pool = descriptor_pool.DescriptorPool()
    pool.AddSerializedFile(timestamp_pb2.DESCRIPTOR.serialized_pb)
    pool.AddSerializedFile(schema(kind).SerializeToString())
    message = message_factory.GetMessageClass(pool.FindMessageTypeByName(f"foxglove.{kind}"))()
    message.timestamp.seconds, message.timestamp.nanos = divmod(at_ns, 10**9)
    for name, value in entries.items():
        if isinstance(value, list):
            getattr(message, name).extend(value)
        else:
            setattr(message, name, value)
    return message.SerializeToString()


def write_mcap(path: Path, kind: str, encoding: str = "protobuf", info: str = "camera_info") -> Path:
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="", library="test")
        channels: dict[str, int] = {}

        def write(topic: str, of: str, at_ns: int, **entries) -> None:
            if topic not in channels:
                files = descriptor_pb2.FileDescriptorSet()
                files.file.append(
                    descriptor_pb2.FileDescriptorProto.FromString(timestamp_pb2.DESCRIPTOR.serialized_pb)
                )
                files.file.append(schema(of))
                number = writer.register_schema(f"foxglove.{of}", encoding, files.SerializeToString())
                channels[topic] = writer.register_channel(topic, encoding, number)
            writer.add_message(channels[topic], at_ns + 5, message_of(of, at_ns, **entries), at_ns + 5)

        for side, seconds in enumerate(((0.0, 0.1), (0.001, 0.099))):
            P = np.column_stack([K, (-60.0 * 0.12 * side, 0, 0)]).ravel().tolist()
            camera = {
                "width": SIZE[1],
                "height": SIZE[0],
                "distortion_model": "plumb_bob",
                "frame_id": "optical",
            }
            camera |= {"K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(), "D": [0.0] * 5, "P": P}
            write(f"/cam{side}/{info}", "CameraCalibration", 10**12, **camera)
            for number, second in enumerate(seconds):
                at_ns, image = 10**12 + round(1e9 * second), rgb(number, side)
                if kind == "RawImage":
                    rows = np.pad(image.reshape(SIZE[0], -1), ((0, 0), (0, 8)))
                    entries = {"width": SIZE[1], "height": SIZE[0], "encoding": "rgb8", "step": rows.shape[1]}
                    entries |= {"data": rows.tobytes()}
                else:
                    coded = cv2.imencode(".png", image[..., ::-1])[1].tobytes()
                    entries = {"data": coded, "format": "png" if kind == "CompressedImage" else "h264"}
                write(f"/cam{side}/image_rect", kind, at_ns, **entries)
        writer.finish()
    return path


@pytest.mark.parametrize("kind", ["RawImage", "CompressedImage"])
def test_pairs_images_and_cameras_of_protobuf_are_read(kind, tmp_path):
    path = write_mcap(tmp_path / "drive.mcap", kind)
    pairs = list_pairs(path, TOPICS, 0.005)
    assert [[stamp.header_ns - 10**12 for stamp in pair] for pair in pairs] == [
        [0, 10**6],
        [10**8, 99 * 10**6],
    ]
    with BagReader(path, TOPICS, 0.005) as reader:
        for number in (1, 0):
            for side, image in enumerate(np.split(reader.read(number), 2, axis=1)):
                np.testing.assert_array_equal(image, rgb(number, side).astype(np.float32) / 255)


@pytest.mark.parametrize("info", ["camera_info", "calibration"])
def test_the_calibration_is_next_to_the_images(info, tmp_path):
    path = write_mcap(tmp_path / "drive.mcap", "CompressedImage", info=info)
    texts, frame_id = stereo_calibration(path, TOPICS)
    files = tuple(tmp_path / f"{number}.yaml" for number in (0, 1))
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    rig = read_calibration(files)
    np.testing.assert_allclose(rig.K_left, K)
    assert frame_id == "optical" and rig.E[0, 3] == pytest.approx(0.12) and rig.size_left == (64, 48)


def test_unreadable_files_are_named_with_a_hint(tmp_path):
    with pytest.raises(InputError, match="compressed video .*Republish"):
        list_pairs(write_mcap(tmp_path / "v.mcap", "CompressedVideo"), TOPICS, 0.005)
    with pytest.raises(InputError, match="a topic of images in the bag; got .*image_rect"):
        list_pairs(write_mcap(tmp_path / "t.mcap", "RawImage"), ("/cam7/image", TOPICS[1]), 0.005)
    with pytest.raises(InputError, match="of json.*folders of images"):
        list_pairs(write_mcap(tmp_path / "j.mcap", "RawImage", "json"), TOPICS, 0.005)
    whole = write_mcap(tmp_path / "w.mcap", "RawImage").read_bytes()
    (tmp_path / "ros1.mcap").write_bytes(whole[:17] + b"\x04\0\0\0ros1" + whole[21:])
    with pytest.raises(InputError, match="an MCAP file of ROS 1. Pass the original .bag"):
        list_pairs(tmp_path / "ros1.mcap", TOPICS, 0.005)


def test_without_the_reader_the_error_states_what_to_install(tmp_path, monkeypatch):
    path = write_mcap(tmp_path / "drive.mcap", "RawImage")
    monkeypatch.setitem(sys.modules, "mcap_protobuf.decoder", None)
    with pytest.raises(InputError, match=r"pip install 'geodiff-plugin\[foxglove\]'"):
        list_pairs(path, TOPICS, 0.005)


@pytest.mark.parametrize("fraction", [0.0, 0.01, 0.3, 0.7, 0.99])
def test_a_file_that_is_cut_off_is_a_sentence(fraction, tmp_path):
    whole = write_mcap(tmp_path / "whole.mcap", "CompressedImage").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(InputError, match="cut.mcap.*(truncated|empty)"):
        list_pairs(tmp_path / "cut.mcap", TOPICS, 0.005)


def test_a_damaged_file_is_a_sentence_or_read(tmp_path):
    path = write_mcap(tmp_path / "drive.mcap", "CompressedImage")

    @EXAMPLES
    @given(data=damaged(path.read_bytes()))
    def check(data):
        path.write_bytes(data)
        list_pairs.cache_clear()

        def read():
            list_pairs(path, TOPICS, 0.005)
            with BagReader(path, TOPICS, 0.005) as reader:
                reader.read(0)
            stereo_calibration(path, TOPICS)

        is_recoverable(read)

    check()
