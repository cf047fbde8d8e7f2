"""Images from files and from memory, and lens distortion taken out of them."""

import io
import sys
import warnings

import cv2
import numpy as np
import pytest
import torch
from PIL import Image
from PIL.PngImagePlugin import PngImageFile

from geodiff_plugin import InputError
from geodiff_plugin.formats import as_image_01, picture_size, read_image
from geodiff_plugin.formats.files import is_turned, upright_size
from geodiff_plugin.formats.images import intrinsics_from_exif
from geodiff_plugin.formats.lenses import (
    distortion_from_text,
    undistorted,
    undistorted_pixels,
    undistorted_points,
)

H, W = 40, 48
V, U = np.mgrid[0:H, 0:W]
#: ``(H, W, 3)`` uint8 whose corners all differ.
RAMP = np.stack([U * 5, V * 6, 10 + U + V], axis=-1).astype(np.uint8)
X = RAMP.astype(np.float32) / 255
RGBA = np.dstack([RAMP, np.full((H, W), 7, np.uint8)])
PIL = Image.fromarray(RAMP)


def saved(folder, image, name="x.png", **options):
    image.save(folder / name, **options)
    return folder / name


def heard(value) -> list[str]:
    """The warnings of ``as_image_01``, which ``picture_size`` does not repeat."""
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        as_image_01(value, "left")
        picture_size(value, "left")
    return [str(w.message) for w in said]


#: Ways to mirror an image; EXIF's orientations 1 to 4 do so, 5 to 8 change rows and columns then.
FLIPS = [X, X[:, ::-1], X[::-1, ::-1], X[::-1]]
UPRIGHT = [*FLIPS, *(FLIPS[i].transpose(1, 0, 2) for i in (0, 3, 2, 1))]


def _turned_png(folder, behind: bool):
    """A PNG file of a photograph on its side, whose EXIF data lie before or behind its pixels."""
    exif = Image.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = 35  # the focal length in 35 mm equivalent
    path = saved(folder, PIL, exif=exif)
    if behind:
        raw = path.read_bytes()
        start, end = raw.index(b"eXIf") - 4, len(raw) - 12
        stop = start + 12 + int.from_bytes(raw[start : start + 4], "big")
        path.write_bytes(raw[:start] + raw[stop:end] + raw[start:stop] + raw[end:])
    return path


@pytest.mark.parametrize("behind", [False, True])
def test_exif_of_a_png_is_found_before_and_behind_its_pixels(tmp_path, behind):
    path = _turned_png(tmp_path, behind)
    assert is_turned(path) and upright_size(path, "left") == (H, W)
    assert intrinsics_from_exif(path, "left")[0][0, 2] == (H - 1) / 2


def test_a_png_is_not_decoded_for_its_exif_unless_it_is_cut_off(tmp_path, monkeypatch):
    path = _turned_png(tmp_path, behind=False)
    cut = tmp_path / "cut.png"
    cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(InputError, match="does not decode"):
        is_turned(cut)
    monkeypatch.setattr(PngImageFile, "load", lambda _: pytest.fail("its pixels were decoded"))
    assert is_turned(path) and upright_size(path, "left") == (H, W)
    assert not is_turned(saved(tmp_path, PIL, "plain.png"))
    assert intrinsics_from_exif(path, "left")[0][0, 2] == (H - 1) / 2


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_orientation_is_applied_and_told(tmp_path, orientation):
    exif = Image.Exif()
    exif[0x0112] = orientation
    image, notes = read_image(saved(tmp_path, PIL, exif=exif), "right")
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, UPRIGHT[orientation - 1])
    assert len(notes) == (orientation > 1)
    assert all(note.startswith("right was turned") and "the turned image" in note for note in notes)
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
    assert said == ["left has an alpha channel; it is dropped."] * alpha == heard(image)
    assert len(read_image(saved(tmp_path, PIL.convert("P"), transparency=0))[1]) == 1


@pytest.mark.parametrize(("times", "told"), [(4, True), (16, True), (257, False)])
def test_10_and_12_bits_in_16_are_told_once(tmp_path, times, told):
    colour = RAMP.astype(np.uint16) * times
    grey = colour[..., 0]
    said = read_image(saved(tmp_path, Image.fromarray(grey)))[1]
    assert len(said) == told
    assert not told or f"its values reach {grey.max()} of 65535" in said[0] and "by 16; with 10" in said[0]
    kinds = (grey, colour, torch.from_numpy(colour).permute(2, 0, 1), Image.fromarray(grey.astype(np.int32)))
    for value in (*kinds, Image.fromarray(grey)):
        assert ["nearly black" in sentence for sentence in heard(value)] == [True] * told
    assert heard(RAMP // 8) == []


@pytest.mark.parametrize("channels", [3, 4])
def test_12_bits_in_a_coloured_file_are_told(tmp_path, channels):
    """Pillow keeps the upper 8 bits of these, and no mode that tells."""
    for times, told in ((16, True), (257, False)):
        deep = np.full((*RAMP.shape[:2], channels), 65535, np.uint16)
        deep[..., :3] = RAMP.astype(np.uint16) * times
        assert cv2.imwrite(str(tmp_path / f"{times}.png"), deep)
        notes = [note for note in read_image(tmp_path / f"{times}.png")[1] if "alpha" not in note]
        assert ["nearly black" in note for note in notes] == [True] * told


@pytest.mark.parametrize("name", ["x.gif", "x.png", "x.tiff", "x.webp"])
def test_only_the_first_of_several_frames_is_taken_and_told(tmp_path, name):
    more = {"lossless": True} if name == "x.webp" else {}
    frames = {"save_all": True, "append_images": [Image.fromarray(RAMP[::-1])], **more}
    path = saved(tmp_path, Image.fromarray(RAMP), name, **frames)
    assert read_image(path)[1] == ["left holds 2 frames or pages; only the first is taken."]
    with Image.open(path) as opened, pytest.warns(UserWarning, match="left holds 2 frames"):
        as_image_01(opened, "left")
    assert read_image(saved(tmp_path, Image.fromarray(RAMP), "one.gif"))[1] == []


def test_heic_is_read_where_pillow_heif_is(tmp_path, monkeypatch):
    path = tmp_path / "x.HEIC"
    path.write_bytes(b"no image")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(ValueError, match="pillow-heif only. Run: pip install pillow-heif"):
        read_image(path)
    monkeypatch.undo()
    heif = pytest.importorskip("pillow_heif")
    grey = Image.fromarray(np.full((40, 60, 3), 77, np.uint8))
    heif.from_pillow(grey).save(path, quality=-1)
    assert np.abs(read_image(path)[0] - 77 / 255).mean() < 0.02


def test_an_image_beyond_pillows_limit_says_so(tmp_path, monkeypatch):
    path = saved(tmp_path, PIL)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", H * W - 1)
    assert read_image(path)[1] == []  # beyond Pillow's warning alone
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", H * W // 3)
    with pytest.raises(ValueError, match=r"x\.png, which does not decode .*pixels.*too large"):
        read_image(path)


TENSOR = torch.from_numpy(X).permute(2, 0, 1)


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
    assert picture_size(value, "right") == (W, H)
    image.zero_()
    assert not isinstance(value, torch.Tensor) or value.any(), "memory is not shared"


def with_value(value):
    image = np.full((H, W, 3), 0.5, dtype=np.float32)
    image[3, 4, 1] = value
    return image


@pytest.mark.parametrize(
    ("value", "error", "match"),
    [
        (with_value(-0.9), ValueError, r"-0\.9.*\(x \+ 1\) / 2"),
        (np.zeros((1, H, W, 3)), ValueError, r"A batch is a list: list\(value\)"),
        (torch.zeros(H, W), ValueError, r"value\[None\]"),
        (torch.zeros(H, W, 3), ValueError, r"permute\(2, 0, 1\)"),
        (np.zeros((H, W, 2)), ValueError, "1, 3 or 4 channels"),
        ("left.png", TypeError, "right must be a PIL image.*got the text"),
    ],
)
def test_what_is_no_image(value, error, match):
    assert as_image_01(with_value(1.0005), "right").max() == 1.0, "resampling may overshoot"
    with pytest.raises(error, match=match):
        as_image_01(value, "right")


K = np.array([[100.0, 0, 79.5], [0, 100.0, 59.5], [0, 0, 1]])
LENSES = ["-0.2,0.05,0,0", "-0.35,0.15,0,0", "0.4,0.1,0,0,0", "fisheye:0.03,0,0,0", "fisheye:-0.05,0.02,0,0"]


def bent_px(pinhole: np.ndarray, lens: str) -> np.ndarray:
    """By the definition of both models."""
    rays = (pinhole - K[:2, 2]) / 100
    r = np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
    k1, k2 = map(float, lens.rpartition(":")[2].split(",")[:2])
    if lens.startswith("fisheye"):
        theta = np.arctan(r)
        return 100 * rays * theta * (1 + k1 * theta**2 + k2 * theta**4) / r + K[:2, 2]
    return 100 * rays * (1 + k1 * r**2 + k2 * r**4) + K[:2, 2]


@pytest.mark.parametrize("lens", LENSES)
def test_pixels_and_known_depths_come_to_those_of_a_pinhole_camera(lens) -> None:
    """To the corners, where OpenCV's few iterations alone are off by a pixel."""
    v, u = np.mgrid[:120:7, :160:7]
    pinhole = np.stack([u, v], -1).reshape(-1, 2).astype(float)
    found = undistorted_pixels(bent_px(pinhole, lens), K, distortion_from_text(lens))
    np.testing.assert_allclose(found, pinhole, atol=0.01)
    depth_m, at = np.zeros((120, 160), np.float32), np.array([(30, 20), (80, 60), (31, 20), (120, 90)])
    depth_m[at[:, 1], at[:, 0]] = (2.0, 3.0, 5.0, 4.0)
    depth_m[0, :2] = np.nan, -1.0
    points = undistorted_points(depth_m, K, distortion_from_text(lens))
    assert sorted(points[:, 2].tolist()) == [2, 3, 4, 5], "each value once, as it was"
    taken = bent_px(points[:, :2] / points[:, 2:] * 100.0 + K[:2, 2], lens)
    np.testing.assert_allclose(taken[np.argsort(points[:, 2])], at[[0, 1, 3, 2]], atol=0.02)


@pytest.mark.parametrize("lens", [LENSES[0], LENSES[3]])
def test_a_blob_in_an_image_comes_to_its_pinhole_pixel(lens) -> None:
    v, u = np.mgrid[:120, :160]
    for pinhole in np.array([[119.5, 89.5], [49.5, 69.5]]):
        at = bent_px(pinhole[None], lens)[0]
        blob = np.exp(-((u - at[0]) ** 2 + (v - at[1]) ** 2) / 4.0)[..., None].repeat(3, 2)
        image = undistorted(blob.astype(np.float32), K, distortion_from_text(lens))[..., 0]
        middle = [(along * image).sum() / image.sum() for along in (u, v)]
        np.testing.assert_allclose(middle, pinhole, atol=0.1)
