"""Images of bags: every encoding by its own colours and bytes, and the scale of both views of a pair."""

import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError, InputFileError, captured_warnings
from geodiff_plugin.formats.bag_images import both_as_01, decode_image

PATH = Path("drive.mcap")
RNG = np.random.default_rng(3)


def message(encoding: str, values: np.ndarray, big: bool = False, pad: int = 5, **changes) -> SimpleNamespace:
    """Rows of numbers in either byte order, each with some bytes behind it."""
    rows = np.ascontiguousarray(values.astype(values.dtype.newbyteorder(">" if big else "<")))
    rows = np.pad(rows.view(np.uint8).reshape(len(values), -1), ((0, 0), (0, pad)), constant_values=77)
    entries = {"encoding": encoding, "is_bigendian": int(big), "data": rows.ravel(), "step": rows.shape[1]}
    entries |= {"height": values.shape[0], "width": values.shape[1]}
    return SimpleNamespace(**(entries | changes))


#: By name: how many numbers a pixel, and where of these red, green and blue are.
PLAIN = {"rgb": (3, (0, 1, 2)), "rgba": (4, (0, 1, 2)), "bgr": (3, (2, 1, 0)), "bgra": (4, (2, 1, 0))}
PLAIN |= {"mono": (1, (0, 0, 0))}
CASES = [(f"{name}{bits}", f"u{bits // 8}", *how) for name, how in PLAIN.items() for bits in (8, 16)]
CASES += [
    (f"{bits}UC{n}", f"u{bits // 8}", n, order)
    for bits in (8, 16)
    for n, order in ((1, (0, 0, 0)), (3, (2, 1, 0)), (4, (2, 1, 0)))
]
CASES += [("mono10", "u2", 1, (0, 0, 0)), ("mono12", "u2", 1, (0, 0, 0))]
CASES += [
    ("32FC1", "f4", 1, (0, 0, 0)),
    ("32FC3", "f4", 3, (2, 1, 0)),
    ("RGB8", "u1", 3, (0, 1, 2)),
    ("8uc1", "u1", 1, (0, 0, 0)),
]


@pytest.mark.parametrize(("encoding", "kind", "channels", "order"), CASES)
@pytest.mark.parametrize("big", [False, True])
def test_every_number_of_a_plain_encoding_is_in_its_place(encoding, kind, channels, order, big):
    values = (
        RNG.random((6, 8, channels)).astype("f4")
        if kind == "f4"
        else RNG.integers(0, 255, (6, 8, channels)).astype(kind) * (1 if kind == "u1" else 200)
    )
    image = decode_image(message(encoding, values.astype(kind), big), PATH)
    assert image.dtype == np.dtype(kind) and image.dtype.isnative
    np.testing.assert_array_equal(image, values.astype(kind)[..., order])


def yuv(colour) -> tuple[int, int, int]:
    """Luminance and colour differences by BT.601, of video's range."""
    r, g, b = (value / 255 for value in colour)
    y = 0.299 * r + 0.587 * g + 0.114 * b
    return round(16 + 219 * y), round(128 + 224 * (b - y) / 1.772), round(128 + 224 * (r - y) / 1.402)


@pytest.mark.parametrize("encoding", ["uyvy", "yuv422", "yuyv", "yuy2", "yuv422_yuy2", "nv12", "nv21"])
def test_luminance_and_colour_differences_give_the_colours_back(encoding):
    """Two colours, one to the left and one to the right."""
    colours = np.array([(200, 90, 30), (20, 160, 220)])
    expected = np.repeat(colours, 4, axis=0)[None].repeat(6, axis=0)
    y, u, v = np.array([yuv(colour) for colour in colours]).T
    luma = np.repeat(y, 4)[None].repeat(6, axis=0).astype(np.uint8)
    first, second = (u, v) if encoding != "nv21" else (v, u)
    chroma = (
        np.stack([np.repeat(first, 2), np.repeat(second, 2)], axis=1)
        .ravel()[None]
        .repeat(6, axis=0)
        .astype(np.uint8)
    )
    if encoding.startswith("nv"):
        given = message(encoding, np.vstack([luma, chroma[:3]]), height=6)
    else:
        pair = (luma, chroma) if "yuy" in encoding else (chroma, luma)
        given = message(encoding, np.stack(pair, axis=-1))
    image = decode_image(given, PATH)
    assert image.shape == (6, 8, 3)
    np.testing.assert_allclose(image.astype(int), expected, atol=4)


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_pattern_is_named_by_its_first_pixels(pattern, bits):
    colour = dict(zip("rgb", (210, 120, 40), strict=True))
    cell = np.array([colour[letter] for letter in pattern], f"u{bits // 8}").reshape(2, 2) * (
        1 if bits == 8 else 250
    )
    image = decode_image(message(f"bayer_{pattern}{bits}", np.tile(cell, (4, 5))), PATH)
    expected = np.array([210, 120, 40]) * (1 if bits == 8 else 250)
    np.testing.assert_array_equal(image[2:-2, 2:-2], np.broadcast_to(expected, (4, 6, 3)))


def test_a_truncated_image_is_rejected():
    values = RNG.integers(0, 255, (6, 8, 3), np.uint8)
    whole = message("rgb8", values, pad=0)
    np.testing.assert_array_equal(decode_image(whole, PATH), values)
    for changes, got in (
        ({"step": 23}, "144 bytes, rows of 23"),
        ({"data": whole.data[:-1]}, "143 bytes, rows of 24"),
        ({"height": 7}, "144 bytes, rows of 24"),
        ({"width": 9}, "144 bytes, rows of 24"),
    ):
        rows, used = changes.get("height", 6), 3 * changes.get("width", 8)
        expected = f"an image must be {rows} rows of {used} bytes .rgb8.; got {got}, in drive.mcap"
        with pytest.raises(InputError, match=expected):
            decode_image(SimpleNamespace(**(vars(whole) | changes)), PATH)
    longer = SimpleNamespace(**(vars(whole) | {"data": np.append(whole.data, 9)}))
    np.testing.assert_array_equal(decode_image(longer, PATH), values)
    with pytest.raises(InputError, match=r"the encoding must be one of uyvy, .*; got jpegxl in drive\.mcap"):
        decode_image(message("jpegxl", values), PATH)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "mono16", "nv12", "uyvy"])
def test_an_image_without_pixels_is_rejected(encoding):
    given = message(encoding, np.zeros((4, 4, 3), np.uint8), height=0, width=0)
    with pytest.raises(InputError, match=r"an image must be of at least one pixel; got 0x0 in drive\.mcap"):
        decode_image(given, PATH)


@pytest.mark.parametrize(("encoding", "width", "height"), [("nv12", 5, 5), ("nv21", 6, 5), ("uyvy", 5, 4)])
def test_subsampled_colours_need_an_even_size(encoding, width, height):
    given = message(encoding, np.zeros((9, 12), np.uint8), width=width, height=height)
    expected = rf"of even width and height \({encoding}\); got {width}x{height} in drive\.mcap"
    with pytest.raises(InputError, match=expected):
        decode_image(given, PATH)


def huge_png() -> bytes:
    """A PNG whose header states more pixels than OpenCV reads."""
    data = cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1].tobytes()
    header = data[12:16] + struct.pack(">II", 1 << 20, 1 << 20) + data[24:29]
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


@pytest.mark.parametrize("data", [b"", b"\xff\xd8\xff", huge_png()], ids=["empty", "cut", "huge"])
def test_a_damaged_compressed_image_is_rejected(data):
    given = SimpleNamespace(format="jpeg", data=np.frombuffer(data, np.uint8))
    with pytest.raises(InputFileError, match=r"an image of drive\.mcap \(jpeg\) cannot be decoded\.\Z"):
        decode_image(given, PATH)


def test_compressed_images_keep_their_bits_and_their_order_of_colours():
    for kind in (np.uint8, np.uint16):
        values = RNG.integers(0, 255, (6, 8, 3)).astype(kind) * (1 if kind is np.uint8 else 200)
        data = cv2.imencode(".png", values[..., ::-1])[1].ravel()
        image = decode_image(SimpleNamespace(format="rgb8; png compressed", data=data), PATH)
        assert image.dtype == kind
        np.testing.assert_array_equal(image, values)
    for form, reported in (("H264", True), ("h265", True), ("hevc", True), ("jpeg", False)):
        with pytest.raises(
            InputFileError, match=rf"an image of drive\.mcap \({form}\) cannot be decoded\."
        ) as caught:
            decode_image(SimpleNamespace(format=form, data=data[:20]), PATH)
        assert ("image_transport republish" in str(caught.value)) == reported and not str(
            caught.value
        ).endswith(" ")


@pytest.mark.parametrize(
    ("most", "full", "bits"),
    [
        (1022, 1023, 10),
        (1023, 1023, 10),
        (1024, 4095, 12),
        (4095, 4095, 12),
        (4096, 16383, 14),
        (16384, 65535, None),
        (65535, 65535, None),
    ],
)
def test_both_views_of_16_bits_are_scaled_by_the_bits_of_the_brighter(most, full, bits):
    for brighter in (0, 1):
        images = [np.full((2, 3, 3), 500, np.uint16) for _ in range(2)]
        images[brighter][1, 2, 0] = most
        with captured_warnings() as said:
            if bits is None:
                both = both_as_01(images, PATH)
            else:
                with pytest.warns(
                    UserWarning,
                    match=f"drive.mcap: Its 16-bit images have a maximum of {most}, so {bits} bits",
                ):
                    both = both_as_01(images, PATH)
        assert [finding.code for finding in said] == ["image.bits"] * (bits is not None)
        for image, scaled in zip(images, both, strict=True):
            assert scaled.dtype == np.float32
            np.testing.assert_allclose(scaled, image / full, rtol=1e-6)


def test_views_of_floats_are_fractions_or_levels():
    for most, full in ((0.9, 1), (1.0, 1), (1.01, 255), (255.0, 255)):
        images = [np.full((2, 2, 3), 0.25, np.float32), np.full((2, 2, 3), most, np.float32)]
        for scaled, image in zip(both_as_01(images, PATH), images, strict=True):
            np.testing.assert_allclose(scaled, image / full, rtol=1e-6)
    for bad in (255.1, -0.1, np.nan, np.inf):
        images = [np.full((2, 2, 3), 0.5, np.float32) for _ in range(2)]
        images[1][0, 0] = bad
        with pytest.raises(InputError, match="an image of floats must be in .0, 1. or .0, 255.; got up to"):
            both_as_01(images, PATH)
    bytes_01 = both_as_01([np.full((2, 2, 3), 51, np.uint8), np.full((2, 2, 3), 3, np.uint8)], PATH)
    assert bytes_01[0][0, 0, 0] == np.float32(0.2) and bytes_01[1][0, 0, 0] == pytest.approx(3 / 255)


def test_views_of_two_types_are_rejected():
    images = [np.zeros((2, 2, 3), kind) for kind in (np.uint8, np.uint16)]
    for pair in (images, images[::-1]):
        with pytest.raises(InputError, match="images of a pair must be of one type; got uint16 and uint8 in"):
            both_as_01(pair, PATH)


def test_the_warning_on_few_bits_points_at_the_line_that_reads_the_bag():
    images = [np.full((2, 3, 3), 500, np.uint16)] * 2
    with pytest.warns(UserWarning) as caught:
        exec(compile("read()", "user.py", "exec"), {"read": lambda: both_as_01(images, PATH)})
    assert [warning.filename for warning in caught] == ["user.py"]
