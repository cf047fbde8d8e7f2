"""Maps of one number a pixel, as OpenCV, OpenEXR, Pillow and numpy write them."""

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats.maps import read_map_file, read_pfm

RNG = np.random.default_rng(9)
FLOATS = RNG.normal(size=(5, 8)).astype(np.float32)
WHOLE = RNG.integers(0, 65536, (5, 8)).astype(np.uint16)


@pytest.mark.parametrize(("order", "scale"), [("<", "-1.0"), (">", "1.0"), ("<", "-0.5"), (">", "2")])
def test_pfm_of_either_byte_order_has_its_top_row_last_in_the_file(order, scale, tmp_path):
    path = tmp_path / "m.pfm"
    path.write_bytes(f"Pf\n8 5\n{scale}\n".encode() + FLOATS[::-1].astype(f"{order}f4").tobytes())
    np.testing.assert_array_equal(read_pfm(path), FLOATS)
    np.testing.assert_array_equal(read_map_file(path), FLOATS)


@pytest.mark.parametrize(
    ("head", "cut"),
    [
        ("PF\n8 5\n-1\n", 0),
        ("Pf\n8 5\n-1\n", 1),
        ("Pf\n0 5\n-1\n", 0),
        ("Pf\n8\n-1\n", 0),
        ("Pf\n8 5\nx\n", 0),
    ],
)
def test_other_pfm_files_are_rejected(head, cut, tmp_path):
    body = FLOATS.tobytes()
    (tmp_path / "m.pfm").write_bytes(head.encode() + body[: len(body) - cut])
    with pytest.raises(InputError, match=r"map must be a whole (grey PFM|image) file"):
        read_pfm(tmp_path / "m.pfm")


def test_images_keep_their_type_and_their_values(tmp_path):
    for values, suffix in ((WHOLE, "png"), (WHOLE, "tiff"), (FLOATS, "tiff")):
        cv2.imwrite(str(tmp_path / f"m.{suffix}"), values)
        read = read_map_file(tmp_path / f"m.{suffix}")
        assert read.dtype == values.dtype
        np.testing.assert_array_equal(read, values)
    for low, high, kind in ((0, 65535, np.uint16), (-1, 65535, np.int32), (0, 65536, np.int32)):
        values = np.array([[low, 7], [9, high]], np.int32)
        Image.fromarray(values).save(tmp_path / "m.tif")
        read = read_map_file(tmp_path / "m.tif")
        assert read.dtype == kind, "numbers that fit are those of 16 bits"
        np.testing.assert_array_equal(read, values)
    Image.fromarray((WHOLE >> 8).astype(np.uint8)).save(tmp_path / "m.png")
    with pytest.raises(InputError, match="a 16-bit grey PNG or TIFF; got .* of mode L"):
        read_map_file(tmp_path / "m.png")


@pytest.mark.parametrize(
    ("low", "high", "is_map"), [(0.0011, 0.9e6, True), (0.0009, 5, False), (1, 1.1e6, False)]
)
def test_bytes_of_floats_are_a_map_if_all_are_likely_depths(low, high, is_map, tmp_path):
    values = np.linspace(low, high, 40, dtype="<f4").reshape(5, 8)
    cv2.imwrite(str(tmp_path / "m.png"), np.ascontiguousarray(values).view(np.uint8).reshape(5, 8, 4))
    if is_map:
        np.testing.assert_array_equal(read_map_file(tmp_path / "m.png"), values)
    else:
        with pytest.raises(InputError, match="of mode RGBA"):
            read_map_file(tmp_path / "m.png")


def test_arrays_may_have_axes_of_one_and_a_name(tmp_path):
    np.save(tmp_path / "m.npy", FLOATS[None, ..., None])
    np.testing.assert_array_equal(read_map_file(tmp_path / "m.npy"), FLOATS)
    np.savez(tmp_path / "m.npz", other=FLOATS + 1, depth=FLOATS)
    np.testing.assert_array_equal(read_map_file(tmp_path / "m.npz"), FLOATS)
    np.savez(tmp_path / "m.npz", prediction=FLOATS)
    np.testing.assert_array_equal(read_map_file(tmp_path / "m.npz"), FLOATS)
    np.savez(tmp_path / "m.npz", a=FLOATS, b=FLOATS)
    with pytest.raises(InputError, match="an .npz with 'depth' or a single array"):
        read_map_file(tmp_path / "m.npz")
    for values in (np.zeros((3, 4, 5)), np.zeros(4), np.zeros((3, 4), complex), np.zeros((3, 4), bool)):
        np.savez(tmp_path / "m.npz", values)
        with pytest.raises(InputError, match=r"map must be a map \(H, W\) as .npy"):
            read_map_file(tmp_path / "m.npz")


def exr(path, channels: dict[str, np.ndarray]) -> None:
    openexr = pytest.importorskip("OpenEXR")
    head = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(head, channels) as file:
        file.write(str(path))


def test_the_depth_of_an_exr_is_its_z_else_y_else_r_else_v_else_its_first_channel(tmp_path):
    names = ("Z", "Y", "R", "V", "depth")
    for first in range(5):
        channels = {name: FLOATS + number for number, name in enumerate(names) if number >= first}
        channels |= {"A": FLOATS - 9} if first < 4 else {}
        exr(tmp_path / "m.exr", channels)
        np.testing.assert_array_equal(read_map_file(tmp_path / "m.exr"), FLOATS + first)
    half = FLOATS.astype(np.float16)
    exr(tmp_path / "m.exr", {"Z": half})
    read = read_map_file(tmp_path / "m.exr")
    np.testing.assert_array_equal(read, half)
    assert read.dtype == np.float32


def test_an_exr_of_colours_is_a_map_if_they_are_alike_and_unknown_pixels_do_not_matter(tmp_path):
    grey = FLOATS.copy()
    grey[2, 3] = np.nan
    for others, is_map in (
        ({"G": grey, "B": grey}, True),
        ({"G": grey, "B": grey + 1}, False),
        ({"G": grey + 1, "B": grey}, False),
        ({"B": grey + 1}, False),
        ({}, True),
    ):
        exr(tmp_path / "m.exr", {"R": grey, **others})
        if is_map:
            np.testing.assert_array_equal(read_map_file(tmp_path / "m.exr"), grey)
        else:
            with pytest.raises(InputError, match="a map of depths; got .*, a colour image"):
                read_map_file(tmp_path / "m.exr")
    exr(tmp_path / "m.exr", {"Z": grey, "R": grey, "G": grey + 1, "B": grey + 2})
    np.testing.assert_array_equal(read_map_file(tmp_path / "m.exr"), grey)
    (tmp_path / "cut.exr").write_bytes((tmp_path / "m.exr").read_bytes()[:90])
    with pytest.raises(InputError, match="a whole OpenEXR file"):
        read_map_file(tmp_path / "cut.exr")


def test_a_dpt_must_have_exactly_its_pixels(tmp_path):
    head = np.array([202021.25], "<f4").tobytes() + np.array([8, 5], "<i4").tobytes()
    for body, fits in (
        (FLOATS.tobytes(), True),
        (FLOATS.tobytes() + b"\0", False),
        (FLOATS.tobytes()[:-4], False),
    ):
        (tmp_path / "m.dpt").write_bytes(head + body)
        if fits:
            np.testing.assert_array_equal(read_map_file(tmp_path / "m.dpt"), FLOATS)
        else:
            with pytest.raises(InputError, match="a whole .dpt of MPI Sintel"):
                read_map_file(tmp_path / "m.dpt")
    (tmp_path / "m.dpt").write_bytes(b"PIEX" + head[4:] + FLOATS.tobytes())
    with pytest.raises(InputError, match="a whole .dpt of MPI Sintel"):
        read_map_file(tmp_path / "m.dpt")
