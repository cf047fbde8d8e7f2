"""Images and their EXIF data: values of every type, and focal lengths by formulas written out here."""

import math

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin._checks import InputError, noted
from geodiff_plugin.formats.images import (
    as_image_01,
    in_stored_pixels,
    intrinsics_from_exif,
    intrinsics_from_fov,
    pages_of_both,
    picture_size,
    read_image,
    warn_of_other_lens,
)

RNG = np.random.default_rng(12)
PIXELS = RNG.integers(0, 256, (36, 52, 3), np.uint8)

#: Numbers of EXIF's tags.
TAGS = {"orientation": 0x0112, "zoom": 0xA404, "equivalent": 0xA405, "focal": 0x920A}
TAGS |= {"width": 0xA002, "height": 0xA003, "per_x": 0xA20E, "per_y": 0xA20F, "unit": 0xA210}


def with_exif(size: tuple[int, int], **entries) -> Image.Image:
    image = Image.new("RGB", size)
    exif = image.getexif()
    for name, value in entries.items():
        (exif if name == "orientation" else exif.get_ifd(0x8769))[TAGS[name]] = value
    return image


@pytest.mark.parametrize("size", [(400, 300), (300, 400)])
def test_a_focal_length_in_35_mm_equivalent_is_one_of_the_diagonal(size):
    K, notes = intrinsics_from_exif(
        with_exif(size, equivalent=26, focal=4.2, per_x=900, width=size[0]), "left"
    )
    focal = 26 * 500 / math.hypot(36, 24)
    np.testing.assert_allclose(K, [[focal, 0, size[0] / 2 - 0.5], [0, focal, size[1] / 2 - 0.5], [0, 0, 1]])
    assert [note.code for note in notes] == ["camera.from-exif"]
    assert notes[0] == f"K of left: 26 mm in 35 mm equivalent by its EXIF, {focal:.0f} px."


@pytest.mark.parametrize(
    ("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0), (5, 0.001), (None, 25.4), (9, 25.4)]
)
def test_a_focal_length_on_the_sensor_is_one_of_the_pixels_that_were_taken(unit, mm):
    """At half the size, of pixels that are less dense down than across, with a digital zoom."""
    entries = {
        "focal": 8.0,
        "per_x": 180.0 * mm,
        "per_y": 150.0 * mm,
        "width": 800,
        "height": 600,
        "zoom": 1.5,
    }
    entries |= {} if unit is None else {"unit": unit}
    for size, taken in (((400, 300), (800, 600)), ((300, 400), (800, 600)), ((300, 400), (600, 800))):
        image = with_exif(size, **(entries | dict(zip(("width", "height"), taken, strict=True))))
        K, notes = intrinsics_from_exif(image, "right")
        np.testing.assert_allclose(K[0, 0], 8 * 180 * 0.5 * 1.5)
        np.testing.assert_allclose(K[1, 1], 8 * 150 * 0.5 * 1.5)
        assert [note.code for note in notes] == ["camera.from-exif", "camera.zoom"]
        assert notes[0] == "K of right: 8 mm on its sensor by its EXIF, 1080 px."
        assert notes[1].startswith("right was zoomed digitally by 1.5;")
    del entries["per_y"], entries["zoom"]
    K, notes = intrinsics_from_exif(with_exif((800, 600), **entries), "right")
    assert K[0, 0] == K[1, 1] == pytest.approx(8 * 180) and len(notes) == 1


@pytest.mark.parametrize("missing", ["focal", "per_x", "width"])
def test_without_a_focal_length_and_the_density_of_the_sensor_there_is_no_k(missing):
    entries = {"focal": 8.0, "per_x": 180.0, "width": 400, "height": 300}
    for value in (None, 0, "no number", float("nan"), -3):
        changed = {name: v for name, v in entries.items() if name != missing}
        image = with_exif((400, 300), **changed)
        if value is not None:
            image.getexif().get_ifd(0x8769)[TAGS[missing]] = value
        with pytest.raises(
            InputError, match="K of left must be known; got no focal length in its EXIF. Give K"
        ):
            intrinsics_from_exif(image, "left")


@pytest.mark.parametrize(
    ("size", "taken", "is_whole"),
    [
        ((400, 300), (4000, 3000), True),
        ((300, 400), (4000, 3000), True),
        ((400, 300), (3000, 4000), True),
        ((403, 300), (4000, 3000), True),
        ((400, 303), (4000, 3000), True),
        ((405, 300), (4000, 3000), False),
        ((400, 305), (4000, 3000), False),
        ((300, 300), (4000, 3000), False),
    ],
)
def test_an_image_of_another_shape_than_it_was_taken_with_was_cropped(size, taken, is_whole):
    image = with_exif(size, equivalent=30, width=taken[0], height=taken[1])
    if is_whole:
        intrinsics_from_exif(image, "left")
        return
    said = (
        f"EXIF of left must be of an image of {size[0]}x{size[1]}; got one of {taken[0]}x{taken[1]}: it was"
    )
    with pytest.raises(InputError, match=said):
        intrinsics_from_exif(image, "left")
    image.getexif().get_ifd(0x8769)[TAGS["height"]] = 0
    intrinsics_from_exif(image, "left")  # one side alone says nothing


@pytest.mark.parametrize("orientation", [1, 3, 5, 6, 8])
def test_k_of_a_file_is_the_one_of_the_upright_image_unless_it_is_read_as_stored(orientation, tmp_path):
    entries = {"focal": 8.0, "per_x": 1800.0, "per_y": 1500.0, "width": 400, "height": 300, "unit": 3}
    image = with_exif((400, 300), orientation=orientation, **entries)
    image.save(tmp_path / "a.jpg", exif=image.getexif())
    stored = np.array([[1440.0, 0, 199.5], [0, 1200.0, 149.5], [0, 0, 1]])
    upright = np.array([[1200.0, 0, 149.5], [0, 1440.0, 199.5], [0, 0, 1]])
    np.testing.assert_allclose(intrinsics_from_exif(tmp_path / "a.jpg", "left", as_stored=True)[0], stored)
    found = intrinsics_from_exif(tmp_path / "a.jpg", "left")[0]
    np.testing.assert_allclose(found, upright if orientation >= 5 else stored)


def test_a_field_of_view_is_horizontal():
    K = intrinsics_from_fov(80.0, (640, 300))
    np.testing.assert_allclose(np.degrees(2 * np.arctan(320 / K[0, 0])), 80)
    assert K[1, 1] == K[0, 0] and K[:2, 2].tolist() == [319.5, 149.5]
    for fov, fits in ((1.0, True), (170.0, True), (0.99, False), (170.01, False)):
        if fits:
            intrinsics_from_fov(fov, (64, 48))
        else:
            with pytest.raises(InputError, match="fov must be"):
                intrinsics_from_fov(fov, (64, 48))


@pytest.mark.parametrize(
    ("factor", "is_told"), [(1.41, True), (1.39, False), (1 / 1.39, False), (1 / 1.41, True)]
)
@pytest.mark.parametrize("zoom", [None, 1.005, 2.0])
def test_a_focal_length_that_contradicts_exif_in_either_way_is_told_unless_it_was_zoomed(
    factor, is_told, zoom
):
    image = with_exif((400, 300), equivalent=26, **({} if zoom is None else {"zoom": zoom}))
    theirs, _ = intrinsics_from_exif(image, "left")
    K = theirs.copy()
    K[0, 0] *= factor
    with noted() as said:
        if is_told and zoom != 2.0:
            with pytest.warns(
                UserWarning, match=f"focal length of {K[0, 0]:.0f} px for left, {factor:.2f} times"
            ):
                warn_of_other_lens(image, K, "left")
        else:
            warn_of_other_lens(image, K, "left")
    assert [note.code for note in said] == ["camera.other-lens"] * (is_told and zoom != 2.0)
    warn_of_other_lens(Image.new("RGB", (64, 48)), K, "left")


def test_values_of_every_type_are_shares_of_its_range(tmp_path):
    whole = PIXELS.astype(np.uint16) * 257
    floats = RNG.random((36, 52, 3)).astype(np.float32)
    grey = floats[..., 0]
    for value, expected in (
        (PIXELS, PIXELS / 255),
        (whole, whole / 65535),
        (floats, floats),
        (floats.astype(np.float64), floats),
        (grey, np.stack([grey] * 3, -1)),
        (PIXELS[..., 0], np.stack([PIXELS[..., 0] / 255] * 3, -1)),
        (torch.from_numpy(floats.transpose(2, 0, 1).copy()).double(), floats),
        (torch.from_numpy(grey)[None], np.stack([grey] * 3, -1)),
        (Image.fromarray(grey), np.stack([grey] * 3, -1)),
    ):
        image = as_image_01(value, "left")
        assert image.shape == (3, 36, 52) and image.dtype == torch.float32
        np.testing.assert_allclose(image.numpy(), expected.transpose(2, 0, 1), atol=1e-6)
        assert picture_size(value, "left") == (52, 36)
    # Floats may overshoot by a thousandth, and are clipped then.
    edge = floats.copy()
    edge[0, 0] = 1.0009, -0.0009, 0.5
    np.testing.assert_array_equal(as_image_01(edge, "left")[:, 0, 0], [1, 0, 0.5])
    for value, said in (
        (1.0011, r"Divide by 255"),
        (-0.0011, r"Map \[-1, 1\] to"),
        (np.nan, "NaN or infinity"),
    ):
        edge[0, 0, 1] = value
        with pytest.raises(InputError, match=said):
            as_image_01(edge, "left")
    for value, said in (
        (PIXELS > 3, r"dtype bool\. Convert it with astype\('uint8'\) \* 255"),
        (whole.astype(int), "dtype int64"),
    ):
        with pytest.raises(InputError, match=said):
            as_image_01(value, "left")


@pytest.mark.parametrize(("most", "is_told"), [(8191, True), (8192, False)])
def test_nearly_black_images_of_16_bits_are_told(most, is_told, tmp_path):
    values = np.linspace(0, most, 40 * 50).reshape(40, 50).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    notes = read_image(tmp_path / "a.png")[1]
    assert [note.code for note in notes] == ["image.dark"] * is_told
    with noted() as said, pytest.warns(UserWarning) if is_told else np.errstate():
        as_image_01(values, "left")
    assert [note.code for note in said] == ["image.dark"] * is_told


@pytest.mark.parametrize("side", [31, 32])
def test_an_image_has_at_least_32_pixels_a_side(side, tmp_path):
    for size in ((side, 60), (60, side)):
        for value in (Image.new("RGB", size), np.zeros((*size[::-1], 3), np.uint8)):
            if side == 32:
                assert (
                    picture_size(value, "left") == size and as_image_01(value, "left").shape[1:] == size[::-1]
                )
                continue
            for call in (picture_size, as_image_01):
                with pytest.raises(
                    InputError, match=rf"left must be at least 32 pixels a side; got {size[0]}x{size[1]}"
                ):
                    call(value, "left")


def test_a_page_of_several_is_read_by_its_number(tmp_path):
    pages = [Image.fromarray(np.roll(PIXELS, n, axis=1)) for n in range(3)]
    pages[0].save(tmp_path / "a.tiff", save_all=True, append_images=pages[1:])
    for number in range(3):
        image, notes = read_image(tmp_path / "a.tiff", page=number)
        np.testing.assert_array_equal(
            image, (np.roll(PIXELS, number, axis=1) / np.float32(255)).astype(np.float32)
        )
        assert [note.code for note in notes] == ["image.frames"] and "holds 3 frames" in notes[0]
    assert np.array_equal(read_image(tmp_path / "a.tiff")[0], read_image(tmp_path / "a.tiff", page=0)[0])


def test_stored_pixels_are_not_turned(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PIXELS).save(tmp_path / "a.png", exif=exif)
    stored, notes = read_image(tmp_path / "a.png", as_stored=True)
    np.testing.assert_array_equal(stored, PIXELS.astype(np.float32) / 255)
    assert notes == []
    for call in (read_image, intrinsics_from_exif):
        with pytest.raises(TypeError):
            call(tmp_path / "a.png", "left", True)  # settings are given by name
    turned, notes = read_image(tmp_path / "a.png", "right")
    np.testing.assert_array_equal(turned, np.rot90(stored, -1))
    assert notes[0].startswith("right was turned or mirrored to 36x52, as its EXIF says")


def test_images_in_memory_lose_their_orientation_one_by_one():
    plain, turned = Image.fromarray(PIXELS), with_exif((48, 36), orientation=6)
    for kind in (list, tuple):
        given = kind([plain, turned, PIXELS])
        got = in_stored_pixels(given)
        assert type(got) is kind and got[0] is plain and got[2] is PIXELS
        assert got[1].getexif()[0x0112] == 1 and turned.getexif()[0x0112] == 6
        with noted() as said:
            as_image_01(got[1], "left")
        assert said == []
    with noted() as said, pytest.warns(UserWarning, match="carries an EXIF orientation that is not applied"):
        as_image_01(turned, "left")
    assert [note.code for note in said] == ["image.orientation"]


def test_a_file_without_two_views_is_refused(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "a.jpg")
    with pytest.raises(
        InputError, match="LEFT must be an MPO file with two pictures, left one first; got 1 in"
    ):
        pages_of_both(tmp_path / "a.jpg", "LEFT")
    views = [Image.fromarray(PIXELS), Image.fromarray(PIXELS[::-1])]
    views[0].save(tmp_path / "a.mpo", format="MPO", save_all=True, append_images=views[1:])
    assert pages_of_both(tmp_path / "a.mpo", "LEFT") == (0, 1)
    views[0].save(tmp_path / "a.mpo", format="MPO", save_all=True, append_images=[*views[1:], views[0]])
    with pytest.raises(InputError, match="left one first; got 3 in"):
        pages_of_both(tmp_path / "a.mpo", "LEFT")


def test_whole_numbers_beyond_16_bits_are_refused():
    for low, high, fits in ((0, 65535, True), (-1, 9000, False), (0, 65536, False)):
        values = np.full((40, 40), 9000, np.int32)
        values[0, :2] = low, high
        image = Image.fromarray(values)
        if fits:
            np.testing.assert_allclose(as_image_01(image, "left")[1].numpy(), values / 65535, atol=1e-6)
        else:
            with pytest.raises(
                InputError, match=f"an image of 8 or 16 bits; got values from {low} to {values.max()}"
            ):
                as_image_01(image, "left")


def test_channels_and_axes_that_do_not_fit_are_named_with_their_cure():
    for value, said in (
        (
            np.zeros((40, 40, 2)),
            r"left must be an image of shape \(H, W, 3\) or \(H, W\), of 1, 3 or 4 channels",
        ),
        (np.zeros((3, 40, 40)), r"got shape \(3, 40, 40\)\. numpy images end in channels: value.transpose"),
        (np.zeros((2, 40, 40, 3)), "A batch is a list"),
        (torch.zeros(40, 40), r"of shape \(3, H, W\), .*Add a channel axis"),
        (torch.zeros(40, 40, 3), "torch images start with channels"),
    ):
        with pytest.raises(InputError, match=said):
            as_image_01(value, "left")
    four = np.concatenate([PIXELS, PIXELS[..., :1]], axis=-1)
    with pytest.warns(UserWarning, match="left has an alpha channel; it is dropped"):
        np.testing.assert_allclose(
            as_image_01(four, "left").numpy().transpose(1, 2, 0), PIXELS / 255, atol=1e-6
        )


def test_a_warning_points_at_the_line_that_gave_the_image():
    """At the caller of the class or function that reads it, not at a line of the package."""
    four, zoomed = np.zeros((40, 40, 4), np.uint8), with_exif((400, 300), equivalent=26)

    def reading(call, *given):
        return lambda: call(*given)

    for read in (
        reading(as_image_01, four, "left"),
        reading(warn_of_other_lens, zoomed, np.diag([9e4, 9e4, 1.0]), "left"),
    ):
        with pytest.warns(UserWarning) as caught:
            exec(compile("read()", "user.py", "exec"), {"read": read})
        assert [warning.filename for warning in caught] == ["user.py"]
