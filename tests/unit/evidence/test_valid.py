"""Masks in every form, alpha channels, neutral content, and which borders are found without a mask."""

import io
from functools import cache

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import InputError
from geodiff_plugin.cameras import eroded, resized_mask
from geodiff_plugin.evidence.inputs import left_alphas
from geodiff_plugin.evidence.valid import (
    BLEND_PX,
    RIM_PX,
    alpha_mask,
    as_mask,
    both,
    common_borders,
    content_mask,
    filled,
    neutral_views,
    outside_borders,
    read_mask,
)
from tests.tiny import render_plane

SIZE = (120, 160)
V, U = np.mgrid[: SIZE[0], : SIZE[1]]
CIRCLE = (U - 80) ** 2 + (V - 60) ** 2 < 56**2
LETTERBOX = (V >= 15) & (V < 105)
PILLARBOX = (U >= 20) & (U < 140)
WEDGE = 4 + 10 * V / SIZE[0] + 2 * ((V - 60) / 60) ** 2 < U
TOP = V >= 12
SHAPES = {"circle": CIRCLE, "letterbox": LETTERBOX, "pillarbox": PILLARBOX, "wedge": WEDGE, "top": TOP}


@cache
def scene(seed: int = 0) -> np.ndarray:
    """A textured plane ``(H, W, 3)`` uint8."""
    K = np.array([[150.0, 0, 79.5], [0, 150, 59.5], [0, 0, 1]])
    return render_plane(K, np.eye(4), SIZE, np.array([0.25, -0.35, 1.0]), 2.0, seed)[0]


def as_jpeg(image: np.ndarray, quality: int) -> torch.Tensor:
    """An image ``(3, H, W)`` in [0, 1], compressed."""
    held = io.BytesIO()
    Image.fromarray(image).save(held, "JPEG", quality=quality)
    return tensor(np.asarray(Image.open(held)))


def tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image.transpose(2, 0, 1) / np.float32(255))


@pytest.mark.parametrize(
    "value",
    [
        CIRCLE,
        CIRCLE.astype(np.uint8),
        255 * CIRCLE.astype(np.uint8),
        65535 * CIRCLE.astype(np.uint16),
        CIRCLE.astype(np.float32),
        np.dstack([255 * CIRCLE.astype(np.uint8)] * 3),
        Image.fromarray(255 * CIRCLE.astype(np.uint8)),
        Image.fromarray(CIRCLE),  # of mode 1
        Image.fromarray(255 * CIRCLE.astype(np.uint8)).convert("RGB"),
        torch.from_numpy(CIRCLE),
        torch.from_numpy(CIRCLE)[None].float(),
    ],
)
def test_white_pixels_of_a_mask_in_any_form_are_valid(value):
    found = as_mask(value, "mask", SIZE)
    assert found.dtype == torch.bool and np.array_equal(found.numpy(), CIRCLE)


def test_a_mask_without_invalid_pixels_is_none():
    assert as_mask(None, "mask", SIZE) is None and as_mask(np.ones(SIZE, bool), "mask", SIZE) is None


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (CIRCLE[:, 1:], "mask must be 160x120 pixels, like its image; got 159x120"),
        (np.zeros(SIZE), "mask must be white .* got no valid pixel"),
        ("mask.png", "mask must be a PIL image"),
        (np.zeros(3), r"mask must be .* got shape \(3,\)"),
    ],
)
def test_an_unusable_mask_is_an_error(value, said):
    with pytest.raises(InputError, match=said):
        as_mask(value, "mask", SIZE)


def test_pixels_of_alpha_0_are_not_valid():
    alpha = np.where(CIRCLE, 255, 0).astype(np.uint8)
    four = np.dstack([scene(), alpha])
    images = [four, Image.fromarray(four), torch.from_numpy(four.transpose(2, 0, 1))]
    for image in images:
        assert np.array_equal(alpha_mask(image).numpy(), CIRCLE)
    assert all(np.array_equal(each.numpy(), CIRCLE) for each in left_alphas(images))
    for image in (scene(), Image.fromarray(scene()), np.dstack([scene(), np.full(SIZE, 255, np.uint8)])):
        assert alpha_mask(image) is None


def test_two_masks_leave_what_both_do():
    one, other = torch.from_numpy(CIRCLE), torch.from_numpy(LETTERBOX)
    assert both(None, None) is None and both(one, None) is one and both(None, one) is one
    assert np.array_equal(both(one, other).numpy(), CIRCLE & LETTERBOX)


def test_neutral_content_depends_on_valid_pixels_only():
    valid = torch.from_numpy(CIRCLE & (U != 70))
    image = tensor(scene())
    made = [filled(torch.where(valid, image, torch.rand_like(image)), valid) for _ in range(2)]
    assert torch.equal(*made) and torch.equal(made[0][:, valid], image[:, valid])
    low, high = image[:, valid].aminmax()
    assert made[0].min() >= low and made[0].max() <= high


def test_a_resized_pixel_is_valid_if_all_of_it_is():
    valid = torch.ones(8, 12, dtype=torch.bool)
    valid[:3] = False
    assert resized_mask(valid, (4, 6)).tolist() == [[False] * 6] * 2 + [[True] * 6] * 2
    assert eroded(valid, 2).sum(0).tolist() == [3] * 12


@pytest.mark.parametrize("quality", [75, 90, 95])
@pytest.mark.parametrize("shape", SHAPES)
def test_black_borders_are_found_despite_compression(shape, quality):
    valid = SHAPES[shape]
    found = content_mask(as_jpeg(scene() * valid[..., None].astype(np.uint8), quality)).numpy()
    assert (found & ~valid).sum() <= 0.15 * (~valid).sum() and (~found & valid).sum() <= 0.01 * valid.sum()


def framed(colour: tuple[int, int, int], valid: np.ndarray, seed: int, quality: int) -> torch.Tensor:
    """A scene in a border of one colour."""
    image = cv2.resize(scene(seed), valid.shape[::-1])
    return as_jpeg(np.where(valid[..., None], image, np.uint8(colour)), quality)


@pytest.mark.parametrize("quality", [75, 90, 95])
@pytest.mark.parametrize("shape", ["circle", "letterbox", "pillarbox"])
@pytest.mark.parametrize("colour", [(255, 255, 255), (128, 128, 128), (240, 230, 200)])
def test_borders_of_any_colour_that_all_views_have_are_found(colour, shape, quality):
    valid = cv2.resize(SHAPES[shape].astype(np.uint8), None, fx=2, fy=2) > 0
    views = [framed(colour, valid, seed, quality) for seed in (0, 1)]
    found = common_borders(views)
    for mask in found:
        outside = ~mask.numpy()
        assert (~outside & ~valid).sum() <= 0.2 * (~valid).sum() and (
            outside & valid
        ).sum() <= 0.01 * valid.sum()
    assert common_borders([views[0], tensor(scene(1))]) is None, "only one view has it"
    assert common_borders(views[:1]) is None, "a single view may show a bright sky"
    pairs = neutral_views([tensor(scene(0)), tensor(scene(1))], [None, None])
    assert all(mask is None for _, mask in pairs)
    for (image, mask), border in zip(neutral_views(views, [None, None]), found, strict=True):
        assert torch.equal(mask, eroded(border, RIM_PX))
        assert not torch.equal(image[:, ~mask], views[0][:, ~mask])


def test_the_rim_of_a_detected_border_gets_no_depth_and_that_of_a_given_mask_does():
    valid = torch.from_numpy(CIRCLE)
    black = torch.where(valid, tensor(scene()), 0.0)
    (found,) = outside_borders([black], [None])
    assert torch.equal(found, eroded(content_mask(black), RIM_PX)) and found.sum() < valid.sum()
    assert outside_borders([black], [valid])[0] is valid
    image, _ = neutral_views([black], [None])[0]
    assert torch.equal(image, filled(black, eroded(content_mask(black), BLEND_PX)))
    assert outside_borders([tensor(scene())] * 2, [None, None]) == [None, None]


@pytest.mark.parametrize("sky", [90.0, 200.0])
def test_a_sky_and_a_wall_with_noise_are_no_border(sky):
    rng = np.random.default_rng(0)
    views = []
    for seed in (0, 1):
        image = np.where((V < 40)[..., None], sky, scene(seed)) + rng.normal(0, 2.5, (*SIZE, 3))
        views.append(tensor(image.clip(0, 255).astype(np.uint8)))
    assert common_borders(views) is None
    skyline = 40 + 14 * np.sin(U / 17) + 8 * np.sin(U / 5) > V
    flat = [tensor(np.where(skyline[..., None], 255, scene(seed)).astype(np.uint8)) for seed in (0, 1)]
    assert common_borders(flat) is None


def test_borders_at_different_places_are_a_part_of_the_scene():
    views = [framed((255, 255, 255), SHAPES["letterbox"], 0, 90), framed((255, 255, 255), PILLARBOX, 1, 90)]
    assert common_borders(views) is None


def test_given_masks_are_taken_as_they_are():
    white = [framed((255, 255, 255), SHAPES["letterbox"], seed, 90) for seed in (0, 1)]
    (_, one), (_, other) = neutral_views(white, [torch.from_numpy(CIRCLE), None])
    assert torch.equal(one, torch.from_numpy(CIRCLE)) and other is None


def dark(name: str) -> np.ndarray:
    """A scene that is black at its border and has no black border."""
    image = scene().astype(float)
    if name == "vignette":
        image *= np.clip(1.3 - np.hypot(U - 80, V - 60) / 80, 0, 1)[..., None]
    elif name == "night":
        image = image * 0.1
    elif name == "skyline":
        image *= (40 + 25 * np.sin(U / 9) * np.cos(U / 4) < V)[..., None]
    elif name == "door":
        image *= ((U > 30) | (V < 25))[..., None]
    elif name == "clipped":
        image = (image - 110) * 1.5
    return image.clip(0, 255).astype(np.uint8)


@pytest.mark.parametrize("name", ["as it is", "vignette", "night", "skyline", "door", "clipped"])
def test_the_dark_parts_of_a_scene_are_valid(name):
    assert content_mask(as_jpeg(dark(name), 90)) is None


def test_a_black_image_has_no_border():
    assert content_mask(torch.zeros(3, *SIZE)) is None


@pytest.mark.parametrize("size", [(270, 480), (135, 240), (2158, 3840), (1079, 1920)])
def test_a_mask_of_another_resolution_may_be_rounded(size, tmp_path):
    """The smaller size is the larger one divided, and rounded in either direction."""
    half = np.arange(size[1])[None].repeat(size[0], 0) < size[1] // 2
    Image.fromarray(half.astype(np.uint8) * 255).save(tmp_path / "mask.png")
    mask = read_mask(tmp_path / "mask.png", "mask", (1079, 1920), scaled=True)
    assert mask.shape == (1079, 1920) and abs(mask.float().mean() - 0.5) < 0.01


@pytest.mark.parametrize("size", [(266, 480), (274, 480), (480, 270), (2162, 3840)])
def test_a_mask_of_another_aspect_ratio_is_rejected(size, tmp_path):
    Image.fromarray(np.eye(*size, dtype=np.uint8) * 255).save(tmp_path / "mask.png")
    with pytest.raises(
        InputError, match=f"mask must be 1920x1079 pixels, like its image; got {size[1]}x{size[0]}"
    ):
        read_mask(tmp_path / "mask.png", "mask", (1079, 1920), scaled=True)
