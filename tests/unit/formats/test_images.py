"""Images and their EXIF data: values of every type, and focal lengths by formulas written out here."""

import io
import math
import struct
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from PIL import Image

from geodiff_plugin._internal.checks import InputError, captured_warnings
from geodiff_plugin.formats.images import (
    as_image_01,
    image_size_of,
    in_stored_pixels,
    intrinsics_from_exif,
    intrinsics_from_fov,
    pages_of_both,
    read_image,
    split_views,
    warn_of_other_lens,
)
from tests.fuzz.test_fuzz import EXAMPLES, damaged, is_recoverable
from tests.unit.error_sentences import check_error
from tests.unit.formats.heic_files import with_group

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
    K, findings = intrinsics_from_exif(
        with_exif(size, equivalent=26, focal=4.2, per_x=900, width=size[0]), "left"
    )
    focal = 26 * 500 / math.hypot(36, 24)
    np.testing.assert_allclose(K, [[focal, 0, size[0] / 2 - 0.5], [0, focal, size[1] / 2 - 0.5], [0, 0, 1]])
    assert [finding.code for finding in findings] == ["camera.from-exif"]
    assert findings[0] == f"K of left: 26 mm in 35 mm equivalent in EXIF, {focal:.0f} px."


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
        K, findings = intrinsics_from_exif(image, "right")
        np.testing.assert_allclose(K[0, 0], 8 * 180 * 0.5 * 1.5)
        np.testing.assert_allclose(K[1, 1], 8 * 150 * 0.5 * 1.5)
        assert [finding.code for finding in findings] == ["camera.from-exif", "camera.zoom"]
        assert findings[0] == "K of right: 8 mm on its sensor in EXIF, 1080 px."
        assert findings[1].startswith("right was taken with 1.5x digital zoom")
    del entries["per_y"], entries["zoom"]
    K, findings = intrinsics_from_exif(with_exif((800, 600), **entries), "right")
    assert K[0, 0] == K[1, 1] == pytest.approx(8 * 180) and len(findings) == 1


@pytest.mark.parametrize("missing", ["focal", "per_x", "width"])
def test_without_a_focal_length_and_the_density_of_the_sensor_there_is_no_k(missing):
    entries = {"focal": 8.0, "per_x": 180.0, "width": 400, "height": 300}
    for value in (None, 0, "no number", float("nan"), -3):
        changed = {name: v for name, v in entries.items() if name != missing}
        image = with_exif((400, 300), **changed)
        if value is not None:
            image.getexif().get_ifd(0x8769)[TAGS[missing]] = value
        with pytest.raises(
            InputError, match="K of left must be specified; got no focal length in its EXIF. Pass K"
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
        f"EXIF of left must be for an image of {size[0]}x{size[1]}; got {taken[0]}x{taken[1]}: the image was"
    )
    with pytest.raises(InputError, match=said):
        intrinsics_from_exif(image, "left")
    image.getexif().get_ifd(0x8769)[TAGS["height"]] = 0
    intrinsics_from_exif(image, "left")  # one side alone is not conclusive


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
def test_a_focal_length_that_contradicts_exif_in_either_way_is_reported_unless_it_was_zoomed(
    factor, is_told, zoom
):
    image = with_exif((400, 300), equivalent=26, **({} if zoom is None else {"zoom": zoom}))
    theirs, _ = intrinsics_from_exif(image, "left")
    K = theirs.copy()
    K[0, 0] *= factor
    with captured_warnings() as said:
        if is_told and zoom != 2.0:
            with pytest.warns(
                UserWarning, match=f"focal length of {K[0, 0]:.0f} px for left, {factor:.2f} times"
            ):
                warn_of_other_lens(image, K, "left")
        else:
            warn_of_other_lens(image, K, "left")
    assert [finding.code for finding in said] == ["camera.focal-mismatch"] * (is_told and zoom != 2.0)
    warn_of_other_lens(Image.new("RGB", (64, 48)), K, "left")


def test_values_of_every_type_are_fractions_of_its_range(tmp_path):
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
        assert image_size_of(value, "left") == (52, 36)
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


def test_the_maximum_of_16_bit_colour_is_stated_in_its_own_range(tmp_path):
    """Pillow reads its upper 8 bits only: 2 of 255 is 514 of 65535."""
    cv2.imwrite(str(tmp_path / "a.png"), np.full((40, 50, 3), 600, np.uint16))
    (finding,) = read_image(tmp_path / "a.png")[1]
    assert finding.code == "image.dark" and "its maximum is 514 of 65535" in finding


@pytest.mark.parametrize(("most", "is_told"), [(8191, True), (8192, False)])
def test_nearly_black_images_of_16_bits_are_reported(most, is_told, tmp_path):
    values = np.linspace(0, most, 40 * 50).reshape(40, 50).astype(np.uint16)
    Image.fromarray(values).save(tmp_path / "a.png")
    findings = read_image(tmp_path / "a.png")[1]
    assert [finding.code for finding in findings] == ["image.dark"] * is_told
    with captured_warnings() as said, pytest.warns(UserWarning) if is_told else np.errstate():
        as_image_01(values, "left")
    assert [finding.code for finding in said] == ["image.dark"] * is_told


@pytest.mark.parametrize("side", [31, 32])
def test_an_image_has_at_least_32_pixels_a_side(side, tmp_path):
    for size in ((side, 60), (60, side)):
        for value in (Image.new("RGB", size), np.zeros((*size[::-1], 3), np.uint8)):
            if side == 32:
                assert (
                    image_size_of(value, "left") == size
                    and as_image_01(value, "left").shape[1:] == size[::-1]
                )
                continue
            for call in (image_size_of, as_image_01):
                with pytest.raises(
                    InputError, match=rf"left must be at least 32 pixels per side; got {size[0]}x{size[1]}"
                ):
                    call(value, "left")


def test_a_page_of_several_is_read_by_its_number(tmp_path):
    pages = [Image.fromarray(np.roll(PIXELS, n, axis=1)) for n in range(3)]
    pages[0].save(tmp_path / "a.tiff", save_all=True, append_images=pages[1:])
    for number in range(3):
        image, findings = read_image(tmp_path / "a.tiff", page=number)
        np.testing.assert_array_equal(
            image, (np.roll(PIXELS, number, axis=1) / np.float32(255)).astype(np.float32)
        )
        assert [finding.code for finding in findings] == ["image.frames"] and "holds 3 frames" in findings[0]
    assert np.array_equal(read_image(tmp_path / "a.tiff")[0], read_image(tmp_path / "a.tiff", page=0)[0])


def test_stored_pixels_are_not_turned(tmp_path):
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(PIXELS).save(tmp_path / "a.png", exif=exif)
    stored, findings = read_image(tmp_path / "a.png", as_stored=True)
    np.testing.assert_array_equal(stored, PIXELS.astype(np.float32) / 255)
    assert findings == []
    for call in (read_image, intrinsics_from_exif):
        with pytest.raises(TypeError):
            call(tmp_path / "a.png", "left", True)  # settings are given by name
    turned, findings = read_image(tmp_path / "a.png", "right")
    np.testing.assert_array_equal(turned, np.rot90(stored, -1))
    assert findings[0].startswith("right was rotated or mirrored to 36x52 by its EXIF orientation")


def test_images_in_memory_lose_their_orientation_one_by_one():
    plain, turned = Image.fromarray(PIXELS), with_exif((48, 36), orientation=6)
    for kind in (list, tuple):
        given = kind([plain, turned, PIXELS])
        got = in_stored_pixels(given)
        assert type(got) is kind and got[0] is plain and got[2] is PIXELS
        assert got[1].getexif()[0x0112] == 1 and turned.getexif()[0x0112] == 6
        with captured_warnings() as said:
            as_image_01(got[1], "left")
        assert said == []
    with (
        captured_warnings() as said,
        pytest.warns(UserWarning, match="has an EXIF orientation that is not applied"),
    ):
        as_image_01(turned, "left")
    assert [finding.code for finding in said] == ["image.orientation"]


def test_a_file_without_two_views_is_rejected(tmp_path):
    Image.fromarray(PIXELS).save(tmp_path / "a.jpg")
    with pytest.raises(
        InputError, match="LEFT must be an MPO file with two images, the left one first; got 1 in"
    ):
        pages_of_both(tmp_path / "a.jpg", "LEFT")
    views = [Image.fromarray(PIXELS), Image.fromarray(PIXELS[::-1])]
    views[0].save(tmp_path / "a.mpo", format="MPO", save_all=True, append_images=views[1:])
    assert pages_of_both(tmp_path / "a.mpo", "LEFT") == (0, 1)
    views[0].save(tmp_path / "a.mpo", format="MPO", save_all=True, append_images=[*views[1:], views[0]])
    with pytest.raises(InputError, match="left one first; got 3 in"):
        pages_of_both(tmp_path / "a.mpo", "LEFT")


def test_whole_numbers_beyond_16_bits_are_rejected():
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


def test_wrong_channels_and_axes_are_reported_with_a_hint():
    for value, said in (
        (
            np.zeros((40, 40, 2)),
            r"left must be an image of shape \(H, W, 3\) or \(H, W\), of 1, 3 or 4 channels",
        ),
        (np.zeros((3, 40, 40)), r"got shape \(3, 40, 40\)\. For numpy, put channels last: value\.transpose"),
        (np.zeros((2, 40, 40, 3)), "Pass a batch as a list"),
        (torch.zeros(40, 40), r"of shape \(3, H, W\), .*Add a channel axis"),
        (torch.zeros(40, 40, 3), "For torch, put channels first"),
    ):
        with pytest.raises(InputError, match=said):
            as_image_01(value, "left")
    four = np.concatenate([PIXELS, PIXELS[..., :1]], axis=-1)
    with pytest.warns(UserWarning, match="left has an alpha channel: fully transparent pixels"):
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


@pytest.mark.parametrize(
    ("call", "parts"),
    [
        (
            lambda p: as_image_01(np.zeros((31, 40, 3)), "the left"),
            ("the left", "at least 32 pixels per side", "40x31", "a thumbnail"),
        ),
        (
            lambda p: image_size_of(Image.new("RGB", (20, 50)), "the left"),
            ("the left", "at least 32 pixels per side", "20x50", "a thumbnail"),
        ),
        (
            lambda p: as_image_01(np.full((40, 40), np.nan), "the left"),
            ("the left", "finite", "NaN or infinity", "Mask or fill"),
        ),
        (
            lambda p: as_image_01(np.full((40, 40), 7.0), "the left"),
            ("the left", "floats in [0, 1]", "values from 7 to 7", "Divide by 255"),
        ),
        (
            lambda p: as_image_01(np.linspace(-1, 1, 1600).reshape(40, 40), "the left"),
            ("the left", "floats in [0, 1]", "values from -1 to 1", "(x + 1) / 2"),
        ),
        (
            lambda p: as_image_01(np.zeros((40, 40), int), "the left"),
            ("the left", "uint8, uint16 or floats in [0, 1]", "dtype int64", "astype('uint8')."),
        ),
        (
            lambda p: as_image_01(np.zeros((40, 40), bool), "the left"),
            ("the left", "uint8, uint16 or floats in [0, 1]", "dtype bool", "astype('uint8') * 255."),
        ),
        (
            lambda p: as_image_01([1], "the left"),
            ("the left", "a PIL image, a numpy array or a torch tensor", "list", "Image.open(path)"),
        ),
        (
            lambda p: as_image_01(np.zeros((40, 40, 5)), "the left"),
            (
                "the left",
                "an image of shape (H, W, 3) or (H, W), of 1, 3",
                "shape (40, 40, 5)",
                "For numpy, put channels last:",
            ),
        ),
        (
            lambda p: as_image_01(torch.zeros(5, 40, 40), "the left"),
            (
                "the left",
                "an image of shape (3, H, W), of 1, 3",
                "shape (5, 40, 40)",
                "For torch, put channels first:",
            ),
        ),
        (
            lambda p: pages_of_both(p / "a.png", "LEFT"),
            ("LEFT", "an MPO file with two images", "1 in {}/a.png"),
        ),
        (lambda p: intrinsics_from_fov(171.0, (40, 40)), ("fov", "between 1 and 170", "171")),
        (
            lambda p: intrinsics_from_exif(
                with_exif((400, 300), width=400, height=400, equivalent=26), "LEFT"
            ),
            ("EXIF of LEFT", "for an image of 400x300", "400x400: the image was cropped", "original image"),
        ),
        (
            lambda p: intrinsics_from_exif(with_exif((400, 300)), "LEFT"),
            ("K of LEFT", "specified", "no focal length in its EXIF", "Pass K (--K)"),
        ),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, call, parts):
    Image.fromarray(PIXELS).save(tmp_path / "a.png")
    check_error(lambda: call(tmp_path), *(part.format(tmp_path) for part in parts))


H, W = 40, 48
V, U = np.mgrid[0:H, 0:W]
#: ``(H, W, 3)`` uint8 whose corners all differ.
RAMP = np.stack([U * 5, V * 6, 10 + U + V], axis=-1).astype(np.uint8)
X = RAMP.astype(np.float32) / 255
RGBA = np.dstack([RAMP, np.full((H, W), 7, np.uint8)])
PIL = Image.fromarray(RAMP)
TENSOR = torch.from_numpy(X).permute(2, 0, 1)
#: Ways to mirror an image; EXIF's orientations 1 to 4 do so, 5 to 8 change rows and columns then.
FLIPS = [X, X[:, ::-1], X[::-1, ::-1], X[::-1]]
UPRIGHT = [*FLIPS, *(FLIPS[i].transpose(1, 0, 2) for i in (0, 3, 2, 1))]


def saved(folder, image, name="x.png", **options):
    image.save(folder / name, **options)
    return folder / name


def heard(value) -> list[str]:
    """The warnings of ``as_image_01``, which ``image_size_of`` does not repeat."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        as_image_01(value, "left")
        image_size_of(value, "left")
    return [str(w.message) for w in caught]


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied_and_reported(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    image, findings = read_image(saved(tmp_path, PIL, exif=exif), "right")
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, UPRIGHT[orientation - 1])
    assert len(findings) == (orientation > 1)
    assert all(
        finding.startswith("right was rotated") and "the upright image" in finding for finding in findings
    )
    buffer = io.BytesIO()
    PIL.save(buffer, format="PNG", exif=exif)
    with Image.open(buffer) as pending:
        assert ["exif_transpose" in sentence for sentence in heard(pending)] == [True] * (orientation > 1)


@pytest.mark.parametrize(
    ("image", "expected", "alpha"),
    [
        (Image.fromarray(RGBA), X, True),
        (Image.fromarray(RGBA[..., 2:]), X[..., 2:], True),
        (Image.fromarray(RAMP[..., 0].astype(np.uint16) * 257), X[..., :1], False),
        *((PIL.convert(mode), None, False) for mode in ("L", "1", "P", "CMYK")),
    ],
)
def test_other_modes_become_rgb_and_alpha_is_dropped(tmp_path, image, expected, alpha):
    read, said = read_image(saved(tmp_path, image, "x.tif"))
    assert read.shape == (H, W, 3) and read.min() >= 0 and read.max() <= 1
    if expected is not None:
        np.testing.assert_allclose(read, np.broadcast_to(expected, read.shape), atol=1e-6)
    assert (
        said
        == ["left has an alpha channel: fully transparent pixels (alpha 0) are treated as invalid."] * alpha
        == heard(image)
    )
    assert len(read_image(saved(tmp_path, PIL.convert("P"), transparency=0))[1]) == 1


@pytest.mark.parametrize("channels", [3, 4])
def test_12_bits_in_a_coloured_file_are_reported(tmp_path, channels):
    """Pillow keeps only the upper 8 bits of these, and no mode reveals it."""
    for times, reported in ((16, True), (257, False)):
        deep = np.full((*RAMP.shape[:2], channels), 65535, np.uint16)
        deep[..., :3] = RAMP.astype(np.uint16) * times
        assert cv2.imwrite(str(tmp_path / f"{times}.png"), deep)
        findings = [finding for finding in read_image(tmp_path / f"{times}.png")[1] if "alpha" not in finding]
        assert ["nearly black" in finding for finding in findings] == [True] * reported


@pytest.mark.parametrize("name", ["x.gif", "x.png", "x.tiff", "x.webp"])
def test_only_the_first_of_several_frames_is_used_and_this_is_reported(tmp_path, name):
    more = {"lossless": True} if name == "x.webp" else {}
    frames = {"save_all": True, "append_images": [Image.fromarray(RAMP[::-1])], **more}
    path = saved(tmp_path, Image.fromarray(RAMP), name, **frames)
    assert read_image(path)[1] == ["left holds 2 frames or pages; only the first is used."]
    with Image.open(path) as opened, pytest.warns(UserWarning, match="left holds 2 frames"):
        as_image_01(opened, "left")
    assert read_image(saved(tmp_path, Image.fromarray(RAMP), "one.gif"))[1] == []


def test_heic_is_read_where_pillow_heif_is(tmp_path, monkeypatch):
    path = tmp_path / "x.HEIC"
    path.write_bytes(b"no image")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ValueError, match="needs pillow-heif. Install it with: pip install pillow-heif"):
        read_image(path)
    monkeypatch.undo()
    heif = pytest.importorskip("pillow_heif")
    grey = Image.fromarray(np.full((40, 60, 3), 77, np.uint8))
    heif.from_pillow(grey).save(path, quality=-1)
    assert np.abs(read_image(path)[0] - 77 / 255).mean() < 0.02


@pytest.mark.parametrize(
    ("value", "atol"),
    [
        (PIL, 0),
        (RAMP, 0),
        ((RAMP.astype(np.uint16) * 257).astype(">u2"), 1e-6),  # another byte order
        (RAMP / 255.0, 1e-6),
        (torch.from_numpy(RAMP).permute(2, 0, 1), 0),
        (TENSOR.clone().requires_grad_(True), 0),
        (TENSOR.bfloat16(), 4e-3),
    ],
)
def test_all_kinds_of_images_in_memory_agree(value, atol):
    image = as_image_01(value, "right")
    assert image.dtype == torch.float32 and image.shape == (3, H, W) and not image.requires_grad
    torch.testing.assert_close(image, TENSOR, rtol=0, atol=atol)
    assert image_size_of(value, "right") == (W, H)
    image.zero_()
    assert not isinstance(value, torch.Tensor) or value.any(), "memory is not shared"


def spatial(path: Path, kind: bytes = b"ster", order: tuple[int, ...] = (1, 0)) -> Path:
    """A HEIC file with the mirrored image first, as the main one, and then the other one."""
    pillow_heif = pytest.importorskip("pillow_heif", minversion="1.8")
    pillow_heif.register_heif_opener()
    Image.fromarray(RAMP[:, ::-1]).save(path, save_all=True, append_images=[PIL], quality=-1)
    path.write_bytes(with_group(path.read_bytes(), order, kind))
    return path


def test_the_left_and_right_image_of_a_spatial_file_are_those_that_its_group_names(tmp_path):
    for order in ((1, 0), (0, 1)):
        path = spatial(tmp_path / "spatial.HEIC", order=order)
        assert pages_of_both(path, "LEFT") == order
        for page, expected in enumerate((X[:, ::-1], X)):
            assert np.abs(read_image(path, page=page)[0] - expected).mean() < 0.05
    path = spatial(tmp_path / "burst.heic", b"altr")
    with pytest.raises(InputError, match="spatial HEIC file .*2 images.*Pass the right view as RIGHT"):
        pages_of_both(path, "LEFT")


def test_a_damaged_spatial_image_is_read_or_raises_a_clear_error(tmp_path):
    path = spatial(tmp_path / "spatial.heic")

    @EXAMPLES
    @given(data=damaged(path.read_bytes()))
    def check(data):
        path.write_bytes(data)
        is_recoverable(lambda: [read_image(path, page=page) for page in pages_of_both(path, "LEFT")])

    check()


#: Kinds of CIPA DC-007 as the index of an MPO file holds them.
PREVIEW, OTHER_VIEW = 0x010002, 0x020002


@pytest.mark.parametrize("kind", [PREVIEW, OTHER_VIEW])
def test_a_preview_in_an_mpo_file_is_no_second_view(tmp_path, kind):
    left, right = (Image.fromarray(np.full((8, 12, 3), grey, np.uint8)) for grey in (90, 120))
    path = tmp_path / "pair.mpo"
    left.save(path, "MPO", save_all=True, append_images=[right])
    data = bytearray(path.read_bytes())
    second = data.index(b"MPF\0") + 4 + 50 + 16  # of the entries, 16 bytes each, behind those of the head
    data[second : second + 4] = struct.pack("<I", kind)
    path.write_bytes(data)
    if kind == OTHER_VIEW:
        assert pages_of_both(path, "LEFT") == (0, 1)
        return
    with pytest.raises(InputError, match="an MPO file of two views; got .* with one view and its preview"):
        pages_of_both(path, "LEFT")


@pytest.mark.parametrize("layout", ["full", "half", "over-under", "half-over-under"])
def test_split_views_keep_the_type_of_the_image_and_adapt_k(layout):
    pixels = RNG.integers(0, 256, (80, 120, 3), np.uint8)
    stacked, half = "over" in layout, "half" in layout
    expected = np.split(pixels, 2, axis=0 if stacked else 1)
    shown = (
        expected[0].shape[1] * (1 + (half and not stacked)),
        expected[0].shape[0] * (1 + (half and stacked)),
    )
    K = np.array([[90.0, 0, (shown[0] - 1) / 2], [0, 95.0, (shown[1] - 1) / 2], [0, 0, 1]])
    for image in (pixels, Image.fromarray(pixels), torch.from_numpy(pixels).permute(2, 0, 1)):
        left, right, K_stored = split_views(image, K, layout)
        for view, half_of_it in zip((left, right), expected, strict=True):
            assert type(view) is type(image) or isinstance(view, Image.Image)
            view = view.permute(1, 2, 0) if isinstance(view, torch.Tensor) else view
            np.testing.assert_array_equal(np.asarray(view), half_of_it)
        # A ray keeps its place relative to the edges of the image.
        height, width = expected[0].shape[:2]
        assert K_stored[0, 0] / width == pytest.approx(90 / shown[0])
        assert K_stored[1, 1] / height == pytest.approx(95 / shown[1])
        np.testing.assert_allclose(K_stored[:2, 2], [(width - 1) / 2, (height - 1) / 2])
    both = split_views(pixels, (K, K + np.diag([1.0, 0, 0])), layout).K
    assert isinstance(both, tuple) and both[1][0, 0] > both[0][0, 0]


@pytest.mark.parametrize("layout", ["full", "over-under"])
def test_split_views_keep_the_alpha_channel(layout):
    pixels = RNG.integers(0, 256, (80, 120, 4), np.uint8)
    expected = np.split(pixels, 2, axis=0 if layout == "over-under" else 1)
    for image in (pixels, Image.fromarray(pixels), torch.from_numpy(pixels).permute(2, 0, 1)):
        for view, half in zip(split_views(image, np.eye(3), layout)[:2], expected, strict=True):
            view = view.permute(1, 2, 0) if isinstance(view, torch.Tensor) else view
            np.testing.assert_array_equal(np.asarray(view), half)


def test_split_views_infer_the_same_layout_with_and_without_an_alpha_channel():
    pixels = np.vstack([RNG.integers(0, 256, (60, 80, 3), np.uint8)] * 2)
    alpha = RNG.integers(0, 256, (120, 80, 1), np.uint8)
    with pytest.warns(UserWarning, match=r"the image holds the views one above the other"):
        left, _, _ = split_views(np.dstack([pixels, alpha]), np.eye(3) * [[50], [50], [1]])
    np.testing.assert_array_equal(left, np.dstack([pixels, alpha])[:60])


def test_split_views_warn_of_an_inferred_layout_and_name_what_is_wrong():
    pixels = np.hstack([RNG.integers(0, 256, (60, 80, 3), np.uint8)] * 2)
    with pytest.warns(UserWarning, match=r"the image holds the views side by side \(full\)"):
        left, right, _ = split_views(pixels, np.eye(3) * [[50], [50], [1]])
    np.testing.assert_array_equal(left, right)
    with pytest.raises(InputError, match="layout must be one of full, half"):
        split_views(pixels, np.eye(3), "quarter")
    with pytest.raises(InputError, match="of even width"):
        split_views(pixels[:, 1:], np.eye(3), "full")
