"""Images from files and from memory."""

from __future__ import annotations

import io
import sys
import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.formats import as_image_01, picture_size, read_image

H, W = 40, 48


def ramp():
    """``(H, W, 3)`` uint8 whose corners all differ."""
    v, u = np.mgrid[0:H, 0:W]
    return np.stack([u * 5, v * 6, 10 + u + v], axis=-1).astype(np.uint8)


def saved(tmp_path, image, name="x.png", **options):
    image.save(tmp_path / name, **options)
    return tmp_path / name


def test_rgb_png_is_exact(tmp_path):
    image, notes = read_image(saved(tmp_path, Image.fromarray(ramp())))
    assert image.dtype == np.float32 and notes == []
    np.testing.assert_array_equal(image, ramp().astype(np.float32) / 255)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied_and_told(tmp_path, orientation):
    """Against the definition of the eight orientations, written out as flips."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    image, notes = read_image(saved(tmp_path, Image.fromarray(ramp()), exif=exif), "right")
    x = ramp().astype(np.float32) / 255
    upright = {
        1: x,
        2: x[:, ::-1],
        3: x[::-1, ::-1],
        4: x[::-1],
        5: x.transpose(1, 0, 2),
        6: x[::-1].transpose(1, 0, 2),
        7: x[::-1, ::-1].transpose(1, 0, 2),
        8: x[:, ::-1].transpose(1, 0, 2),
    }[orientation]
    np.testing.assert_array_equal(image, upright)
    if orientation == 1:
        assert notes == []
    else:
        assert len(notes) == 1 and notes[0].startswith("right was ") and "K must belong" in notes[0]


def test_alpha_is_dropped_and_told(tmp_path):
    rgba = np.dstack([ramp(), np.full((H, W), 7, np.uint8)])
    image, notes = read_image(saved(tmp_path, Image.fromarray(rgba)))
    np.testing.assert_array_equal(image, ramp().astype(np.float32) / 255)
    assert notes == ["left has an alpha channel; it is dropped."]
    assert read_image(saved(tmp_path, Image.fromarray(rgba[..., 2:])))[1] == notes


def test_16_bit_grey(tmp_path):
    grey = ramp()[..., 0].astype(np.uint16) * 257
    image, notes = read_image(saved(tmp_path, Image.fromarray(grey)))
    assert notes == []
    np.testing.assert_allclose(image, np.repeat(ramp()[..., :1] / 255.0, 3, axis=-1), atol=1e-6)


def test_12_bits_in_16_are_told(tmp_path):
    grey = ramp()[..., 0].astype(np.uint16) * 16
    _, notes = read_image(saved(tmp_path, Image.fromarray(grey)))
    assert len(notes) == 1
    assert f"its values reach {grey.max()} of 65535" in notes[0] and "multiply them by 16" in notes[0]


@pytest.mark.parametrize("channels", [3, 4])
def test_12_bits_in_16_of_a_coloured_file_are_told(tmp_path, channels):
    """Pillow keeps the upper 8 bits of these, which leaves 16 levels and no mode that tells."""
    cv2 = pytest.importorskip("cv2")
    deep = np.full((H, W, channels), 65535, np.uint16)
    deep[..., :3] = ramp()[..., ::-1]
    for times, told in ((16, True), (257, False)):
        path = tmp_path / f"{times}.png"
        values = np.concatenate([deep[..., :3] * np.uint16(times), deep[..., 3:]], axis=-1)
        assert cv2.imwrite(str(path), values)
        notes = [note for note in read_image(path)[1] if "alpha" not in note]
        assert len(notes) == told and all("is a 16-bit image that is nearly black" in note for note in notes)
        with warnings.catch_warnings(record=True) as said, Image.open(path) as image:
            warnings.simplefilter("always")
            as_image_01(image, "left")
        assert [str(w.message) for w in said if "alpha" not in str(w.message)] == notes


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK"])
def test_other_modes_become_rgb(tmp_path, mode):
    name = "x.tif" if mode == "CMYK" else "x.png"
    image, notes = read_image(saved(tmp_path, Image.fromarray(ramp()).convert(mode), name))
    assert image.shape == (H, W, 3) and image.min() >= 0 and image.max() <= 1 and notes == []


def test_palette_with_transparency(tmp_path):
    path = saved(tmp_path, Image.fromarray(ramp()).convert("P"), transparency=0)
    image, notes = read_image(path)
    assert image.shape == (H, W, 3) and len(notes) == 1


@pytest.mark.parametrize("suffix", ["png", "jpg", "tif", "webp"])
def test_a_cut_off_image_is_a_sentence(tmp_path, suffix):
    noise = np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8)
    path = saved(tmp_path, Image.fromarray(noise), f"whole.{suffix}")
    whole = path.read_bytes()
    refused = 0
    for share in (0.02, 0.3, 0.6, 0.9):
        cut = tmp_path / f"cut.{suffix}"
        cut.write_bytes(whole[: int(len(whole) * share)])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own remarks about broken TIFF tags
            with pytest.raises(ValueError, match=r"left must be .*cut\."):
                read_image(cut)
        refused += 1
    assert refused == 4


def test_file_errors(tmp_path):
    with pytest.raises(FileNotFoundError, match="right must be an image file"):
        read_image(tmp_path / "nope.png", "right")
    with pytest.raises(IsADirectoryError, match="left"):
        read_image(tmp_path)
    (tmp_path / "a.png").write_text("hello")
    with pytest.raises(ValueError, match="a format that Pillow does not read"):
        read_image(tmp_path / "a.png")
    (tmp_path / "empty.png").write_bytes(b"")
    with pytest.raises(ValueError, match="empty"):
        read_image(tmp_path / "empty.png")
    with pytest.raises(ValueError, match="at least 32 pixels a side; got 48x31"):
        read_image(saved(tmp_path, Image.fromarray(ramp()[:31])))
    with pytest.raises(TypeError, match="left"):
        read_image(5)


@pytest.mark.parametrize("name", ["x.gif", "x.png", "x.tiff", "x.webp"])
def test_only_the_first_of_several_frames_is_taken_and_told(tmp_path, name):
    first, second = (Image.fromarray(value) for value in (ramp(), ramp()[::-1]))
    more = {"lossless": True} if name == "x.webp" else {}
    path = saved(tmp_path, first, name, save_all=True, append_images=[second], **more)
    image, notes = read_image(path)
    assert notes == ["left holds 2 frames or pages; only the first is taken."]
    tolerance = 0.15 if name == "x.gif" else 0  # 256 colours
    np.testing.assert_allclose(image, ramp().astype(np.float32) / 255, atol=tolerance)
    with Image.open(path) as opened, pytest.warns(UserWarning, match="left holds 2 frames"):
        as_image_01(opened, "left")
    assert read_image(saved(tmp_path, first, "one.gif"))[1] == []


def test_an_image_beyond_pillows_limit_says_so(tmp_path, monkeypatch):
    path = saved(tmp_path, Image.fromarray(ramp()))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", H * W - 1)
    assert read_image(path)[1] == []  # beyond Pillow's warning alone
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", H * W // 3)
    with pytest.raises(ValueError, match=r"at most 0 megapixels; got .*x\.png, a larger one\. Scale it down"):
        read_image(path)


def test_heic_is_read_where_pillow_heif_is(tmp_path, monkeypatch):
    path = tmp_path / "x.HEIC"
    path.write_bytes(b"no image")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ValueError, match="pillow-heif only. Run: pip install pillow-heif"):
        read_image(path)
    monkeypatch.undo()
    heif = pytest.importorskip("pillow_heif")
    heif.from_pillow(Image.fromarray(ramp())).save(path, quality=-1)
    image, notes = read_image(path)
    assert notes == [] and np.abs(image - ramp() / 255).mean() < 0.02


def test_as_image_01_all_kinds_agree():
    x = ramp()
    expected = torch.from_numpy(x.astype(np.float32) / 255).permute(2, 0, 1)
    kinds = {
        "pil": Image.fromarray(x),
        "uint8": x,
        "uint16": x.astype(np.uint16) * 257,
        "uint16 of another byte order": (x.astype(np.uint16) * 257).astype(">u2"),
        "float64": x / 255.0,
        "torch_uint8": torch.from_numpy(x).permute(2, 0, 1),
        "torch": expected.clone().requires_grad_(True),
    }
    for kind, value in kinds.items():
        image = as_image_01(value, "right")
        assert image.dtype == torch.float32 and image.shape == (3, H, W) and not image.requires_grad, kind
        torch.testing.assert_close(image, expected, rtol=0, atol=1e-6)
    half = as_image_01(expected.bfloat16(), "right")
    torch.testing.assert_close(half, expected, rtol=0, atol=4e-3)


def test_as_image_01_grey_is_repeated():
    grey = ramp()[..., 0]
    for value in (grey, grey[..., None], torch.from_numpy(grey)[None], Image.fromarray(grey)):
        image = as_image_01(value, "right")
        assert image.shape == (3, H, W)
        assert torch.equal(image[0], image[2])


def test_as_image_01_does_not_share_memory():
    source = torch.rand(3, H, W)
    before = source.clone()
    as_image_01(source, "right").zero_()
    assert torch.equal(source, before)


def test_as_image_01_drops_alpha_with_a_warning():
    rgba = np.dstack([ramp(), np.full((H, W), 7, np.uint8)])
    for value in (rgba, Image.fromarray(rgba), torch.from_numpy(rgba).permute(2, 0, 1)):
        with pytest.warns(UserWarning, match="right has an alpha channel"):
            assert as_image_01(value, "right").shape == (3, H, W)


def test_as_image_01_warns_of_a_pending_exif_turn():
    exif = Image.Exif()
    exif[0x0112] = 6
    buffer = io.BytesIO()
    Image.fromarray(ramp()).save(buffer, format="PNG", exif=exif)
    with Image.open(buffer) as image, pytest.warns(UserWarning, match="exif_transpose"):
        assert as_image_01(image, "right").shape == (3, H, W)


def with_value(value):
    image = np.full((H, W, 3), 0.5, dtype=np.float32)
    image[3, 4, 1] = value
    return image


@pytest.mark.parametrize(
    ("value", "error", "match"),
    [
        (with_value(np.nan), ValueError, "right must be finite"),
        (with_value(np.inf), ValueError, "right must be finite"),
        (with_value(200.0), ValueError, r"\[0, 1\].*200.*Divide by 255"),
        (with_value(-0.9), ValueError, r"-0\.9.*\(x \+ 1\) / 2"),
        (np.zeros((1, H, W, 3)), ValueError, "batch"),
        (torch.zeros(1, 3, H, W), ValueError, r"value\[0\]"),
        (torch.zeros(H, W), ValueError, r"value\[None\]"),
        (np.zeros((3, H, W)), ValueError, r"transpose\(1, 2, 0\)"),
        (torch.zeros(H, W, 3), ValueError, r"permute\(2, 0, 1\)"),
        (np.zeros((H, W, 2)), ValueError, "1, 3 or 4 channels"),
        (np.zeros((H, W, 3), dtype=np.int64), ValueError, "dtype int64"),
        (np.zeros((H, W, 3), dtype=bool), ValueError, "dtype bool"),
        (np.zeros((31, W, 3)), ValueError, "at least 32"),
        (np.zeros((0, W, 3)), ValueError, "at least 32"),
        (Image.new("RGB", (20, 50)), ValueError, "20x50"),
        ("left.png", TypeError, "right must be a PIL image.*got str"),
        (None, TypeError, "right"),
    ],
)
def test_as_image_01_errors(value, error, match):
    with pytest.raises(error, match=match):
        as_image_01(value, "right")


def test_resampling_overshoot_is_clipped():
    image = as_image_01(with_value(1.0005), "right")
    assert image.max() == 1.0


@pytest.mark.parametrize("times", [4, 16])
@pytest.mark.parametrize("kind", ["numpy", "colour", "torch", "pil", "pil I"])
def test_as_image_01_tells_of_10_or_12_bits_in_16_once(kind, times):
    colour = ramp().astype(np.uint16) * times
    grey = colour[..., 0]
    value = {
        "numpy": grey,
        "colour": colour,
        "torch": torch.from_numpy(colour).permute(2, 0, 1),
        "pil": Image.fromarray(grey),
        "pil I": Image.fromarray(grey.astype(np.int32)),
    }[kind]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        as_image_01(value, "right")
        picture_size(value, "right")
    (sentence,) = (str(w.message) for w in said)
    most = int(np.max(colour if kind in ("colour", "torch") else grey))
    assert sentence.startswith(
        f"right is a 16-bit image that is nearly black: its values reach {most} of 65535."
    )
    assert "12 bits, multiply them by 16; with 10 bits, by 64." in sentence


def test_as_image_01_says_nothing_of_full_16_bits():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        as_image_01(ramp().astype(np.uint16) * 257, "right")
        as_image_01(ramp() // 8, "right")  # dark, but not by its number of bits


def test_picture_size_is_that_of_the_image():
    x = ramp()
    for value in (x, x[..., 0], Image.fromarray(x), torch.from_numpy(x).permute(2, 0, 1)):
        assert picture_size(value, "right") == (W, H)
    with pytest.raises(ValueError, match="at least 32 pixels a side; got 48x31"):
        picture_size(x[:31], "right")
    with pytest.raises(TypeError, match="right must be a PIL image.*got str"):
        picture_size("right.png", "right")
