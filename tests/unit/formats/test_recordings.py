"""Videos frame by frame, and bags: which images are a pair, and every field of what is written."""

import functools
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from geodiff_plugin._internal.checks import InputError, InputFileError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.recordings import (
    BagFrame,
    BagReader,
    EndOfRecordingError,
    Stamp,
    VideoReader,
    is_bag,
    is_video,
    list_pairs,
    stereo_calibration,
    video_facts,
    write_depth_bag,
)
from tests.views import lenses_of

SIZE = (64, 40)


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Twelve frames, each of its own shade, redder to the right and greener downwards."""
    path = tmp_path_factory.mktemp("video") / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 12.5, SIZE)
    v, u = np.mgrid[:40, :64]
    for n in range(12):
        writer.write(np.stack([np.full_like(u, 20 * n), 5 * v, 3 * u], axis=-1).astype(np.uint8))
    writer.release()
    return path


def shade(image: np.ndarray) -> int:
    return round(float(image[..., 2].mean()) * 255 / 20)


def test_a_video_has_its_frames_its_rate_and_its_size(video, tmp_path):
    facts = video_facts(video)
    assert facts.frames == 12 and facts.fps == pytest.approx(12.5) and facts.size == SIZE
    np.testing.assert_allclose(facts.times, np.arange(12) / 12.5, atol=1e-9)
    (tmp_path / "no.mp4").write_bytes(b"no video")
    with pytest.raises(InputError, match="video must be a video that OpenCV can read; got"):
        video_facts(tmp_path / "no.mp4")


def test_frames_are_read_by_their_number_in_any_order(video):
    with VideoReader(video) as reader:
        for number in (3, 4, 11, 0, 7, 7, 2):
            image = reader.read(number)
            assert image.shape == (40, 64, 3) and image.dtype == np.float32 and shade(image) == number
        red, green = image[..., 0], image[..., 1]
        assert red[:, -8:].mean() > red[:, :8].mean() + 0.3 and green[-8:].mean() > green[:8].mean() + 0.3
        for number in (12, 20):
            with pytest.raises(EndOfRecordingError, match=rf"frame {number} of .* cannot be decoded"):
                reader.read(number)
        assert shade(reader.read(5)) == 5


@pytest.mark.parametrize(
    ("name", "video", "bag"),
    [
        ("a.MP4", True, False),
        ("a.mcap", False, True),
        ("a.bag", False, True),
        ("a.db3", False, True),
        ("a.png", False, False),
    ],
)
def test_recordings_are_recognised_by_their_suffix(name, video, bag, tmp_path):
    assert is_video(Path(name)) == video and is_bag(Path(name)) == bag
    assert not is_bag(tmp_path)
    (tmp_path / "metadata.yaml").touch()
    assert is_bag(tmp_path)


pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2  # noqa: E402
from rosbags.highlevel import AnyReader  # noqa: E402
from rosbags.typesys import Stores, get_typestore  # noqa: E402

from tests.unit.formats import bags  # noqa: E402

typestore = functools.cache(get_typestore)  # which takes long
START = 1_600_000_000_987_654_321


def bag(path: Path, images: dict[str, list[tuple[int, int]]], sizes=((6, 4), (6, 4)), infos=()) -> Path:
    """Images of one colour at milliseconds ``(of the header, of the recording)`` by topic; camera_infos."""
    ros2 = path.suffix != ".bag"
    store = typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    types, serialize = store.types, store.serialize_cdr if ros2 else store.serialize_ros1
    plugin = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    folder = path.with_suffix(".folder")
    if not path.suffix:  # a folder as ROS 2 recorded it before files had the definitions of their messages
        plugin, folder = {"version": 8, "storage_plugin": rosbag2.StoragePlugin.SQLITE3}, path
    with rosbag2.Writer(folder, **plugin) if ros2 else rosbag1.Writer(path) as writer:

        def header(at_ns: int, frame: str):
            stamp = types["builtin_interfaces/msg/Time"](*divmod(at_ns, 10**9))
            return types["std_msgs/msg/Header"](*(() if ros2 else (3,)), stamp, frame)

        for side, (topic, stamps) in enumerate(images.items()):
            to = writer.add_connection(topic, "sensor_msgs/msg/Image", typestore=store)
            width, height = sizes[side]
            for number, (at, recorded) in enumerate(stamps):
                data = np.full(3 * width * height, 10 * number + 100 * side, np.uint8)
                message = types["sensor_msgs/msg/Image"](
                    header(START + 10**6 * at, f"eye{side}"), height, width, "rgb8", 0, 3 * width, data
                )
                writer.write(to, START + 10**6 * recorded, serialize(message, message.__msgtype__))
        for side, (topic, width, height, model, K, P) in enumerate(infos):
            to = writer.add_connection(topic, "sensor_msgs/msg/CameraInfo", typestore=store)
            roi = types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            D, R = np.arange(5.0) + side, np.eye(3) + 0.1 * side
            arrays = [np.asarray(each, float).ravel() for each in (D, K, R, P)]
            message = types["sensor_msgs/msg/CameraInfo"](
                header(START, f"info{side}"), height, width, model, *arrays, 0, 0, roi
            )
            writer.write(to, START, serialize(message, message.__msgtype__))
    if path.suffix == ".mcap":
        (folder / f"{folder.name}.mcap").rename(path)
    return path


TOPICS = ("/a/image", "/b/image")


@pytest.mark.parametrize("suffix", [".mcap", ".bag", ""])
def test_every_left_image_has_the_nearest_right_one(suffix, tmp_path):
    """Recorded out of order, with two right images between two left ones, and one that is too far off."""
    lefts = [(0, 9), (100, 110), (200, 205), (300, 301), (400, 402)]
    rights = [(104, 120), (97, 98), (203, 204), (196, 230), (312, 313), (-11, 1), (399, 500)]
    path = bag(tmp_path / f"a{suffix}", dict(zip(TOPICS, (lefts, rights), strict=True)))
    pairs = list_pairs(path, TOPICS, 0.0105)
    ms = [tuple((stamp.header_ns - START) / 1e6 for stamp in pair) for pair in pairs]
    assert ms == [(100, 97), (200, 203), (400, 399)]
    recorded = [tuple((stamp.recorded_ns - START) / 1e6 for stamp in pair) for pair in pairs]
    assert recorded == [(110, 98), (205, 204), (402, 500)]
    ms = [[(stamp.header_ns - START) // 10**6 for stamp in pair] for pair in list_pairs(path, TOPICS, 0.012)]
    assert ms == [[0, -11], [100, 97], [200, 203], [300, 312], [400, 399]]
    with BagReader(path, TOPICS, 0.0105) as reader:
        for number, (left, right) in enumerate(((1, 1), (2, 2), (4, 6))):
            image = reader.read(number)
            assert image.shape == (4, 12, 3) and image.dtype == np.float32
            np.testing.assert_allclose(image[:, :6], 10 * left / 255)
            np.testing.assert_allclose(image[:, 6:], (10 * right + 100) / 255)
    with pytest.raises(
        InputError, match=r"topics of simultaneous images; got 5 and 7 images, none within 0.0005 s"
    ):
        list_pairs(path, TOPICS, 0.0005)
    with pytest.raises(
        InputError,
        match=r"/c must be a topic of images in the bag; got .* whose images are /a/image, /b/image",
    ):
        list_pairs(path, ("/c", TOPICS[1]), 0.01)


def test_one_right_image_is_of_one_pair_only(tmp_path):
    path = bag(tmp_path / "a.mcap", {TOPICS[0]: [(0, 0), (4, 4)], TOPICS[1]: [(2, 2)]})
    assert [(pair[0].header_ns - START) // 10**6 for pair in list_pairs(path, TOPICS, 0.005)] == [0]


def test_a_lost_image_does_not_shift_the_later_pairs(tmp_path):
    lefts, rights = ([(ms, ms) for ms in times] for times in ((0, 33, 66, 99), (0, 66, 99)))
    path = bag(tmp_path / "a.mcap", dict(zip(TOPICS, (lefts, rights), strict=True)))
    for tolerance in (0.005, 0.05):
        pairs = list_pairs(path, TOPICS, tolerance)
        assert [[(stamp.header_ns - START) // 10**6 for stamp in pair] for pair in pairs] == [
            [0, 0],
            [66, 66],
            [99, 99],
        ]


def test_images_with_equal_headers_are_matched_by_recording_time(tmp_path):
    lefts, rights = ([(0, ms) for ms in times] for times in ((0, 30, 60), (2, 29, 61)))
    path = bag(tmp_path / "a.mcap", dict(zip(TOPICS, (lefts, rights), strict=True)))
    recorded = [
        [(stamp.recorded_ns - START) // 10**6 for stamp in pair] for pair in list_pairs(path, TOPICS, 0)
    ]
    assert recorded == [[0, 2], [30, 29], [60, 61]]


def test_both_images_of_a_pair_must_be_of_one_size(tmp_path):
    path = bag(tmp_path / "a.mcap", {TOPICS[0]: [(0, 0)], TOPICS[1]: [(0, 0)]}, ((6, 4), (8, 5)))
    with (
        BagReader(path, TOPICS, 0.01) as reader,
        pytest.raises(InputFileError, match="have equal sizes; got 6x4 and 8x5"),
    ):
        reader.read(0)


def test_a_frame_after_the_last_is_distinguished_from_a_damaged_one(tmp_path, monkeypatch):
    path = bag(tmp_path / "a.mcap", {topic: [(0, 0), (10, 10)] for topic in TOPICS})

    def fails(reader, raw, kind):
        raise AssertionError

    with BagReader(path, TOPICS, 0.001) as reader:
        with pytest.raises(EndOfRecordingError, match="has no pair 2"):
            reader.read(2)
        monkeypatch.setattr(AnyReader, "deserialize", fails)  # as it does if a message is too short
        with pytest.raises(InputFileError, match="a message of .* cannot be read .AssertionError.") as caught:
            reader.read(1)
        assert not isinstance(caught.value, EndOfRecordingError)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_the_cameras_of_both_topics_are_those_next_to_each(suffix, tmp_path):
    topics = ("/one/image_rect_color", "/two/image_raw/compressed")
    K = [np.array([[60.0 + n, 0, 31 + n], [0, 61.0 + n, 23], [0, 0, 1]]) for n in range(3)]
    P = [np.column_stack([each, (-7.5 * n, 0, 0.5)]) for n, each in enumerate(K)]
    infos = [
        ("/one/camera_info", 64, 48, "plumb_bob", K[0], P[0]),
        ("/two/calibration", 80, 50, "equidistant", K[1], P[1]),
        ("/two/other_info", 1, 2, "x", K[2], P[2]),
    ]
    path = bag(tmp_path / f"a{suffix}", {"/x/image": [(0, 0)]}, infos=infos)
    texts, frame_id = stereo_calibration(path, topics)
    assert frame_id == "info0"
    for side, (text, (_, width, height, model, k, p)) in enumerate(zip(texts, infos, strict=False)):
        entries = yaml.safe_load(text)
        assert (entries["width"], entries["height"], entries["distortion_model"]) == (width, height, model)
        assert entries["rectified"] == (side == 0)
        for key, expected in zip("DKRP", (np.arange(5.0) + side, k, np.eye(3) + 0.1 * side, p), strict=True):
            np.testing.assert_allclose(entries[key], np.ravel(expected))
    assert len(texts) == 2 and stereo_calibration(path, topics[::-1])[1] == "info1"
    with pytest.raises(InputError, match="in the bag as /three/camera_info, or an option; got neither"):
        stereo_calibration(path, (topics[0], "/three/image"))


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_every_field_of_a_written_depth_is_that_of_its_frame(suffix, encoding, tmp_path):
    frames = []
    for number in range(3):
        depth_m = np.random.default_rng(number).uniform(0.5, 9, (4 + number, 7)).astype(np.float32)
        depth_m[0, :3] = np.nan, 0, -1
        K = np.array([[60.0 + number, 0, 3.25], [0, 62.0, 2.5 + number], [0, 0, 1]])
        frames.append(BagFrame(Stamp(START + 10**9 * number, START + 7 + 10**8 * number), depth_m, K))
    path = tmp_path / f"d{suffix}"
    assert write_depth_bag(path, frames, "eye", encoding) == 3
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    with AnyReader([path]) as reader:
        read = [(c.topic, at, reader.deserialize(raw, c.msgtype)) for c, at, raw in reader.messages()]
    assert [topic for topic, *_ in read] == ["/depth/image", "/depth/camera_info"] * 3
    for number, frame in enumerate(frames):
        (_, at, image), (_, also_at, info) = read[2 * number : 2 * number + 2]
        assert at == also_at == frame.stamp.recorded_ns
        for message in (image, info):
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == frame.stamp.header_ns
            assert message.header.frame_id == "eye" and (message.height, message.width) == frame.depth_m.shape
        assert image.encoding == encoding and image.is_bigendian == 0
        assert (
            image.step == 7 * (2 if encoding == "16UC1" else 4)
            and len(image.data) == image.step * image.height
        )
        values = image.data.view("<u2" if encoding == "16UC1" else "<f4").reshape(frame.depth_m.shape)
        known = frame.depth_m > 0
        if encoding == "16UC1":
            np.testing.assert_array_equal(
                values, np.where(known, np.rint(np.where(known, frame.depth_m, 0) * 1000.0), 0)
            )
        else:
            np.testing.assert_array_equal(values, np.where(known, frame.depth_m, np.nan))
        D, k, R, P = (getattr(info, key, getattr(info, key.upper(), None)) for key in "dkrp")
        np.testing.assert_array_equal(np.reshape(k, (3, 3)), frame.K)
        np.testing.assert_array_equal(np.reshape(P, (3, 4)), np.column_stack([frame.K, np.zeros(3)]))
        np.testing.assert_array_equal(np.reshape(R, (3, 3)), np.eye(3))
        assert info.distortion_model == "plumb_bob" and np.array_equal(D, np.zeros(5))
        assert (info.binning_x, info.binning_y, info.roi.width, info.roi.do_rectify) == (0, 0, 0, False)
        assert (info.roi.x_offset, info.roi.y_offset, info.roi.height) == (0, 0, 0)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1"])
def test_sigma_is_a_message_of_the_same_stamp_and_encoding_rounded_up_in_millimetres(
    suffix, encoding, tmp_path
):
    rng, frames = np.random.default_rng(9), []
    for number in range(3):
        sigma_m = rng.uniform(1e-4, 0.2, (5, 6)).astype(np.float32)
        sigma_m[0, :2] = np.nan, 70.0
        given = None if number == 1 else sigma_m
        frames.append(BagFrame(Stamp(START + number, START + number), np.ones((5, 6)), np.eye(3), given))
    assert write_depth_bag(tmp_path / f"d{suffix}", frames, "eye", encoding) == 3
    with AnyReader([tmp_path / f"d{suffix}"]) as reader:
        read = [(c.topic, reader.deserialize(raw, c.msgtype), c.msgtype) for c, _, raw in reader.messages()]
    found = [message for topic, message, _ in read if topic == "/depth/sigma"]
    stamps = [(message.header.stamp.sec, message.header.stamp.nanosec) for message in found]
    assert stamps == [divmod(frames[n].stamp.header_ns, 10**9) for n in (0, 2)]
    assert {kind for topic, _, kind in read if topic == "/depth/sigma"} == {"sensor_msgs/msg/Image"}
    for message, frame in zip(found, frames[::2], strict=True):
        assert message.encoding == encoding and message.header.frame_id == "eye"
        values = message.data.view("<u2" if encoding == "16UC1" else "<f4").reshape(5, 6)
        if encoding == "32FC1":
            np.testing.assert_array_equal(values, frame.sigma_m)
            continue
        assert values[0, :2].tolist() == [0, 65535] and values.ravel()[2:].min() >= 1
        above = values.ravel()[2:] / 1000 - frame.sigma_m.ravel()[2:]
        assert above.min() > -1e-6 and above.max() < 1.001e-3


@pytest.mark.parametrize("seed", range(4))
def test_the_images_of_a_pair_are_each_others_nearest_of_all(seed, tmp_path):
    """The earlier one of two at the same distance."""
    rng = np.random.default_rng(seed)
    lefts, rights = (sorted(rng.choice(250, count, replace=False).tolist()) for count in (13, 15))
    stamps = {topic: [(at, at + 1) for at in ms] for topic, ms in zip(TOPICS, (lefts, rights), strict=True)}
    path = bag(tmp_path / "a.mcap", {topic: rng.permutation(each).tolist() for topic, each in stamps.items()})
    distance = np.abs(np.subtract.outer(lefts, rights))
    nearest_right, nearest_left = distance.argmin(1), distance.argmin(0)
    expected = [
        (lefts[n], rights[m])
        for n, m in enumerate(nearest_right)
        if nearest_left[m] == n and distance[n, m] <= 12
    ]
    found = [tuple((s.header_ns - START) // 10**6 for s in pair) for pair in list_pairs(path, TOPICS, 0.012)]
    assert found == expected and 4 < len(expected) < 13


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("topics", [bags.TOPICS, tuple(f"{topic}/compressed" for topic in bags.TOPICS)])
def test_pairs_are_those_of_the_same_moments(tmp_path, suffix, topics) -> None:
    path = bags.write_bag(tmp_path / f"drive{suffix}", topics)
    assert is_bag(path) and not is_bag(tmp_path)
    stamps = [[header - 10**12 for header, _ in pair] for pair in list_pairs(path, topics, 0.005)]
    assert stamps == [[0, 10**6], [10**8, 99 * 10**6]]
    with BagReader(path, topics, 0.005) as reader:
        for number in (1, 0):
            for side, image in enumerate(np.split(reader.read(number), 2, axis=1)):
                assert image.dtype == np.float32
                np.testing.assert_array_equal(image, bags.rgb(number, side).astype(np.float32) / 255)
    rig = rig_of(path, topics, tmp_path)
    assert rig.rectified and rig.size_left == (64, 48) and rig.E[0, 3] == pytest.approx(0.12)


@pytest.mark.parametrize(
    ("bits", "encoding"), [(10, "mono16"), (12, "mono16"), (12, "mono12"), (10, "16UC1")]
)
def test_few_bits_in_sixteen_are_scaled_alike_for_both_views(tmp_path, bits, encoding) -> None:
    full = bags.rgb(0, 0)[..., 0].astype(np.uint16) * (2**bits - 1) // 255
    full[0, 0] = 2**bits - 1
    path = bags.write_bag(tmp_path / "a.mcap", encoding=encoding, images=(full, full // 8))
    with BagReader(path, bags.TOPICS, 0.005) as reader, pytest.warns(UserWarning, match=f"so {bits} bits"):
        left, right = np.split(reader.read(0), 2, axis=1)
    np.testing.assert_allclose(left[..., 0], full / (2**bits - 1), atol=1e-6)
    np.testing.assert_allclose(right[..., 0], (full // 8) / (2**bits - 1), atol=1e-6)


def rig_of(path: Path, topics, folder: Path):
    texts, frame = stereo_calibration(path, topics)
    assert frame == "optical"
    files = [folder / f"{number}.yaml" for number in range(2)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    return read_calibration(files, distorted=True)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
def test_the_region_and_the_binning_of_a_bag_change_its_cameras(tmp_path, suffix):
    height, width = bags.SIZE
    window = (6, 4, height, width)  # x, y, height, width
    path = bags.write_bag(tmp_path / f"a{suffix}", roi=window, binning=(2, 2))
    texts, _ = stereo_calibration(path, bags.TOPICS)
    files = [tmp_path / f"{number}.yaml" for number in range(2)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    shifted = bags.K - [[0, 0, 6], [0, 0, 4], [0, 0, 0]]
    binned = read_calibration(files, image_size=(width // 2, height // 2))
    np.testing.assert_allclose(binned.K_left, np.diag([0.5, 0.5, 1]) @ shifted)
    assert binned.size_left == (width // 2, height // 2)
    assert np.linalg.norm(binned.E[:3, 3]) == pytest.approx(0.12)
    stated = read_calibration(files, image_size=(width, height))  # a driver that writes K of the images
    np.testing.assert_allclose(stated.K_left, shifted)


def test_cameras_of_raw_images(tmp_path) -> None:
    """A point that both rectified cameras see is where the poses of the raw ones have it."""
    D, model = [0.1, 0.02, 0, 0], "equidistant"
    turns = [cv2.Rodrigues(np.array(v))[0] for v in ([0.02, -0.01, 0.03], [-0.01, 0.02, -0.02])]
    raw_K = bags.K + [[3.0, 0, 2], [0, 4, 1], [0, 0, 0]]
    rig = rig_of(
        bags.write_bag(tmp_path / "a.mcap", bags.RAW, model=model, D=D, K=raw_K, R=turns), bags.RAW, tmp_path
    )
    assert not rig.rectified and [lens.model for lens in lenses_of(rig)] == ["fisheye"] * 2
    np.testing.assert_array_equal(rig.right.lens.coefficients, D)
    np.testing.assert_array_equal(rig.K_left, raw_K)
    rectified = np.array([0.3, -0.2, 2.0])
    left, right = turns[0].T @ rectified, turns[1].T @ (rectified - [0.12, 0, 0])
    np.testing.assert_allclose((rig.T_right_from_left @ [*left, 1])[:3], right, atol=1e-12)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("fraction", [0.0, 0.02, 0.5, 0.98])
def test_a_bag_that_is_cut_off_is_a_sentence(fraction, suffix, tmp_path):
    whole = bags.write_bag(tmp_path / f"whole{suffix}").read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: int(fraction * len(whole))])
    with pytest.raises(InputError, match=r"cut\.(mcap|bag).*(truncated|empty)"):
        list_pairs(cut, bags.TOPICS, 0.005)
