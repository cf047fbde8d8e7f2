"""Bags: pairs by their time stamps, every encoding, cameras of raw and rectified images, depth read back."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.bag_images import both_as_01, decode_image
from geodiff_plugin.formats.recordings import (
    BagFrame,
    BagReader,
    Stamp,
    is_bag,
    list_pairs,
    stereo_calibration,
    write_depth_bag,
)

pytest.importorskip("rosbags")
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

TOPICS = "/cam0/image_rect", "/cam1/image_rect"
RAW = "/cam0/image_raw", "/cam1/image_raw"
K = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]])
SIZE = (48, 64)
PINHOLE = {"model": "plumb_bob", "D": np.zeros(5), "R": (np.eye(3), np.eye(3))}


def picture(number: int, side: int) -> np.ndarray:
    rng = np.random.default_rng(10 * number + side)
    return cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), SIZE[::-1])


def write_bag(path: Path, topics=TOPICS, encoding: str = "rgb8", images=None, **info) -> Path:
    """A bag with pictures of both cameras at those seconds, and their camera_info, 0.12 m apart."""
    ros2, info = path.suffix == ".mcap", PINHOLE | {"K": K} | info
    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    serialize = store.serialize_cdr if ros2 else store.serialize_ros1
    plugin = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    folder = path.with_suffix(".folder")
    with rosbag2.Writer(folder, **plugin) if ros2 else rosbag1.Writer(path) as writer:

        def write(topic: str, kind: str, at_ns: int, *values) -> None:
            stamp = store.types["builtin_interfaces/msg/Time"](*divmod(10**12 + at_ns, 10**9))
            header = store.types["std_msgs/msg/Header"](*(() if ros2 else (7,)), stamp, "optical")
            known = [c for c in writer.connections if c.topic == topic]
            kind = f"sensor_msgs/msg/{kind}"
            to = known[0] if known else writer.add_connection(topic, kind, typestore=store)
            writer.write(to, 10**12 + at_ns + 5, serialize(store.types[kind](header, *values), kind))

        for side, topic in enumerate(topics):
            P = np.column_stack([K, (-60.0 * 0.12 * side, 0, 0)])
            matrices = [np.asarray(m, float).ravel() for m in (info["D"], info["K"], info["R"][side], P)]
            roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
            base = topic.removesuffix("/compressed").rpartition("/")[0]
            write(f"{base}/camera_info", "CameraInfo", 0, *SIZE, info["model"], *matrices, 0, 0, roi)
            for number, seconds in enumerate(((0.0, 0.1, 0.2), (0.001, 0.099, 0.35))[side]):
                image, at_ns = picture(number, side) if images is None else images[side], round(1e9 * seconds)
                if topic.endswith("/compressed"):
                    data = cv2.imencode(".png", image[..., ::-1])[1].ravel()
                    write(topic, "CompressedImage", at_ns, "png", data)
                    continue
                rows = np.pad(image.reshape(len(image), -1).view(np.uint8), ((0, 0), (0, 8)))  # padded
                write(topic, "Image", at_ns, *SIZE, encoding, 0, rows.shape[1], rows.ravel())
    if ros2:
        (folder / f"{folder.name}.mcap").rename(path)
    return path


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("topics", [TOPICS, tuple(f"{topic}/compressed" for topic in TOPICS)])
def test_pairs_are_those_of_the_same_moments(tmp_path, suffix, topics) -> None:
    path = write_bag(tmp_path / f"drive{suffix}", topics)
    assert is_bag(path) and not is_bag(tmp_path)
    stamps = [[header - 10**12 for header, _ in pair] for pair in list_pairs(path, topics, 0.005)]
    assert stamps == [[0, 10**6], [10**8, 99 * 10**6]]
    with BagReader(path, topics, 0.005) as reader:
        for number in (1, 0):
            for side, image in enumerate(np.split(reader.read(number), 2, axis=1)):
                assert image.dtype == np.float32
                np.testing.assert_array_equal(image, picture(number, side).astype(np.float32) / 255)
    rig = rig_of(path, topics, tmp_path)
    assert rig.rectified and rig.size_left == (64, 48) and rig.E[0, 3] == pytest.approx(0.12)


GREY = picture(0, 0)[..., 0]
COLOUR, FLAT = np.dstack([GREY] * 3), np.full_like(GREY, 99)
ALPHA = np.dstack([COLOUR, np.full_like(GREY, 9)])
#: Grey by every encoding of luminance and colour differences: these are 128 then.
LUMA = (16 + GREY.astype(float) * 219 / 255).round().astype(np.uint8)
YUYV, UYVY = (np.dstack(pair) for pair in ((LUMA, np.full_like(LUMA, 128)), (np.full_like(LUMA, 128), LUMA)))
NV12 = np.vstack([LUMA, np.full_like(LUMA[:24], 128)])
MOSAIC = np.zeros(SIZE, np.uint8)
MOSAIC[::2, ::2] = 200  # the red pixels of rggb


@pytest.mark.parametrize(
    ("encoding", "image", "expected"),
    [
        ("bgr8", COLOUR, GREY),
        ("bgra8", ALPHA, GREY),
        ("mono16", GREY.astype(np.uint16) * 257, GREY),
        ("8UC3", COLOUR, GREY),
        ("8UC4", ALPHA, GREY),
        ("rgb16", COLOUR.astype(np.uint16) * 257, GREY),
        ("16UC1", GREY.astype(np.uint16) * 257, GREY),
        ("32FC1", (GREY / 255).astype(np.float32), GREY),
        ("32FC1", GREY.astype(np.float32), GREY),
        ("yuv422_yuy2", YUYV, GREY),
        ("yuyv", YUYV, GREY),
        ("uyvy", UYVY, GREY),
        ("yuv422", UYVY, GREY),
        ("nv12", NV12, GREY),
        ("nv21", NV12, GREY),
        ("BGR8", COLOUR, GREY),
        ("bayer_rggb8", FLAT, FLAT),
        ("bayer_grbg16", FLAT.astype(np.uint16) * 257, FLAT),
        ("bayer_rggb8", MOSAIC, None),
    ],
)
def test_encodings_of_raw_images(tmp_path, encoding, image, expected) -> None:
    """A grey picture is the same by all of them."""
    path = write_bag(tmp_path / "a.mcap", encoding=encoding, images=(image, image))
    with BagReader(path, TOPICS, 0.005) as reader:
        left = reader.read(0)[:, :64]
    if expected is not None:
        off = 2 / 255 if encoding[:2] in ("yu", "uy", "nv") else 1e-6  # of 219 steps there
        np.testing.assert_allclose(left, np.dstack([expected] * 3) / 255, atol=off)
    else:
        red, green, blue = left[10:-10, 10:54].mean((0, 1))
        assert red > 0.5 and green < 0.05 and blue < 0.05


def test_colours_of_every_encoding_of_luminance(tmp_path) -> None:
    """Pure red by BT.601: Y 81, U 90, V 240."""
    y, u, v = (np.full((48, 64), value, np.uint8) for value in (81, 90, 240))
    chroma = np.where(np.arange(64) % 2, v, u)
    forms = {"yuyv": np.dstack([y, chroma]), "uyvy": np.dstack([chroma, y])}
    forms |= {
        "nv12": np.vstack([y, chroma[:24]]),
        "nv21": np.vstack([y, np.where(np.arange(64) % 2, u, v)[:24]]),
    }
    for encoding, image in forms.items():
        path = write_bag(tmp_path / f"{encoding}.mcap", encoding=encoding, images=(image, image))
        with BagReader(path, TOPICS, 0.005) as reader:
            np.testing.assert_allclose(reader.read(0)[5, 5], [1, 0, 0], atol=0.02)


def raw(encoding: str, image: np.ndarray, big: bool = False) -> SimpleNamespace:
    """The message of an image, in either order of bytes, with 6 bytes behind every row."""
    numbers = image.astype(image.dtype.newbyteorder(">" if big else "<"))
    rows = np.ascontiguousarray(numbers).view(np.uint8).reshape(len(image), -1)
    data = np.pad(rows, ((0, 0), (0, 6)), constant_values=255)
    size = {"height": image.shape[0], "width": image.shape[1], "step": data.shape[1]}
    return SimpleNamespace(encoding=encoding, is_bigendian=big, data=data.ravel(), **size)


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", ["rgb", "rgba", "bgr", "bgra", "UC3", "UC4", "rggb", "bggr", "gbrg", "grbg"])
def test_every_encoding_of_colours_gives_them_back_in_their_order(name, bits, big) -> None:
    """A picture of one colour; a Bayer pattern is named by its pixels row by row."""
    colour = dict(zip("rgba", (200, 100, 40, 9), strict=True))
    letters = {"UC3": "bgr", "UC4": "bgra"}.get(name, name)
    values = np.array([colour[letter] for letter in letters], f"u{bits // 8}") * (1 if bits == 8 else 257)
    if letters.count("g") == 2:
        encoding, image = f"bayer_{name}{bits}", np.tile(values.reshape(2, 2), (5, 6))
    else:
        encoding, image = f"{bits}{name}" if name[0] == "U" else f"{name}{bits}", np.tile(values, (10, 12, 1))
    found = decode_image(raw(encoding, image, big), Path("a.mcap"))
    expected = np.array([200, 100, 40]) * (1 if bits == 8 else 257)
    np.testing.assert_array_equal(found[2:-2, 2:-2], np.broadcast_to(expected, (6, 8, 3)))


@pytest.mark.parametrize(
    ("most", "full"),
    [(1023, 1023), (1024, 4095), (4095, 4095), (4096, 16383), (16383, 16383), (16384, 65535)],
)
@pytest.mark.filterwarnings("ignore:.*16-bit images reach")
def test_sixteen_bits_hold_the_fewest_of_a_camera_that_the_brightest_pixel_needs(most, full) -> None:
    images = [np.full((2, 2, 3), value, np.uint16) for value in (most, 7)]
    left, right = both_as_01(images, Path("a.mcap"))
    assert left.max() == pytest.approx(most / full) and right.max() == pytest.approx(7 / full)


@pytest.mark.parametrize(
    ("bits", "encoding"), [(10, "mono16"), (12, "mono16"), (12, "mono12"), (10, "16UC1")]
)
def test_few_bits_in_sixteen_are_scaled_alike_for_both_views(tmp_path, bits, encoding) -> None:
    full = GREY.astype(np.uint16) * (2**bits - 1) // 255
    full[0, 0] = 2**bits - 1
    path = write_bag(tmp_path / "a.mcap", encoding=encoding, images=(full, full // 8))
    with BagReader(path, TOPICS, 0.005) as reader, pytest.warns(UserWarning, match=f"of {bits} bits"):
        left, right = np.split(reader.read(0), 2, axis=1)
    np.testing.assert_allclose(left[..., 0], full / (2**bits - 1), atol=1e-6)
    np.testing.assert_allclose(right[..., 0], (full // 8) / (2**bits - 1), atol=1e-6)


def test_what_no_reader_decodes_is_named_with_its_cure(tmp_path) -> None:
    path = write_bag(tmp_path / "a.mcap", encoding="jpegxl", images=(GREY, GREY))
    with BagReader(path, TOPICS, 0.005) as reader, pytest.raises(InputError, match="got jpegxl"):
        reader.read(0)


def rig_of(path: Path, topics, folder: Path):
    texts, frame = stereo_calibration(path, topics)
    assert frame == "optical"
    files = [folder / f"{number}.yaml" for number in range(2)]
    for file, text in zip(files, texts, strict=True):
        file.write_text(text)
    return read_calibration(files, distorted=True)


def test_cameras_of_raw_images(tmp_path) -> None:
    """A point that both rectified cameras see is where the poses of the raw ones have it."""
    D, model = [0.1, 0.02, 0, 0], "equidistant"
    turns = [cv2.Rodrigues(np.array(v))[0] for v in ([0.02, -0.01, 0.03], [-0.01, 0.02, -0.02])]
    raw_K = K + [[3.0, 0, 2], [0, 4, 1], [0, 0, 0]]
    rig = rig_of(write_bag(tmp_path / "a.mcap", RAW, model=model, D=D, K=raw_K, R=turns), RAW, tmp_path)
    assert not rig.rectified and [lens.model for lens in rig.distortion] == ["fisheye"] * 2
    np.testing.assert_array_equal(rig.distortion[1].coefficients, D)
    np.testing.assert_array_equal(rig.K_left, raw_K)
    rectified = np.array([0.3, -0.2, 2.0])
    left, right = turns[0].T @ rectified, turns[1].T @ (rectified - [0.12, 0, 0])
    np.testing.assert_allclose((rig.T_right_from_left @ [*left, 1])[:3], right, atol=1e-12)


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "u2", 1000.0), ("32FC1", "f4", 1.0)])
def test_depth_comes_back(tmp_path, suffix, encoding, kind, unit) -> None:
    depth_m = np.linspace(0.5, 9.0, 35, dtype=np.float32).reshape(5, 7)
    depth_m[0, 0], depth_m[1, 1] = np.nan, 0.0
    stamps = [Stamp(1_500_000_000_000_000_001 + n, 5 + n) for n in range(2)]
    frames = [BagFrame(stamp, depth_m + n, K) for n, stamp in enumerate(stamps)]
    path = tmp_path / f"depth{suffix}"
    assert write_depth_bag(path, frames, "optical", encoding) == 2
    assert [file.name for file in tmp_path.iterdir()] == [path.name]
    with AnyReader([path]) as reader:
        messages = [(c.topic, at, reader.deserialize(raw, c.msgtype)) for c, at, raw in reader.messages()]
    assert [topic for topic, _, _ in messages] == ["/depth/image", "/depth/camera_info"] * 2
    for number, (_, at, image) in enumerate(messages[::2]):
        assert at == 5 + number and image.header.frame_id == "optical"
        assert image.header.stamp.sec == 1_500_000_000 and image.header.stamp.nanosec == 1 + number
        values = image.data.view(kind).reshape(image.height, image.width).astype(float)
        expected = np.where(depth_m + number > 0, depth_m + number, np.nan)
        np.testing.assert_allclose(np.where(values == 0, np.nan, values / unit), expected, atol=6e-4)
    camera = messages[1][2]
    np.testing.assert_array_equal(np.reshape(getattr(camera, "k", getattr(camera, "K", None)), (3, 3)), K)
    assert (camera.width, camera.height) == (7, 5)


def test_refusals(tmp_path) -> None:
    path = write_bag(tmp_path / "a.mcap")
    with pytest.raises(InputError, match="/no must be a topic .*whose images are /cam0/image_rect"):
        list_pairs(path, ("/no", TOPICS[1]), 0.005)
    with pytest.raises(InputError, match=r"none within 1e-05 s of each other.*--tolerance"):
        list_pairs(path, TOPICS, 1e-5)
    with pytest.raises(InputError, match="in the bag as /camera_info, or given; got neither"):
        stereo_calibration(path, ("/image", TOPICS[1]))


@pytest.mark.parametrize("suffix", [".mcap", ".bag"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
def test_a_bag_that_is_cut_off_is_a_sentence(share, suffix, tmp_path):
    whole = write_bag(tmp_path / f"whole{suffix}").read_bytes()
    cut = tmp_path / f"cut{suffix}"
    cut.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(InputError, match=r"cut\.(mcap|bag).*(cut off|empty)"):
        list_pairs(cut, TOPICS, 0.005)
