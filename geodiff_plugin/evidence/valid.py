"""Valid pixels: masks and alpha channels as given, detection of empty borders, and neutral content outside.

An invalid pixel shows no scene: the frame around an endoscope's image, the wedges of a rectified image,
letterbox bars. Before anything else its content is replaced by a smooth continuation of the valid pixels, so
no later stage depends on it. Stages that count pixels read ``View.valid`` in addition.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from geodiff_plugin._internal.checks import bad_type, bad_value
from geodiff_plugin.cameras import ALL_VALID, Camera, eroded, resized_mask
from geodiff_plugin.formats import has_alpha, open_image, undistorted
from geodiff_plugin.matching.census import grey

#: Values of a mask above this fraction of the range of its type are valid.
WHITE = 0.5
#: Grey levels up to which a side of an image counts as black.
BLACK = 6
#: Grey levels up to which compression brightens a black border, further than ``FADE_PX[0]`` from the scene.
FAINT = 12
#: Grey levels above which a pixel shows the scene.
LIT = 32
#: Minimum fraction of a side of the image that is black.
MIN_RIM = 0.1
#: Minimum area of a border as a fraction of the image.
MIN_AREA = 0.004
#: Distances in pixels from the scene between which a border is black already. The dark parts of a scene fade.
FADE_PX = (3, 6)
#: Minimum fraction of black pixels between these distances.
MIN_BLACK_NEAR = 0.9
#: Minimum fraction of black pixels in all of a border from the first distance on.
MIN_BLACK = 0.95
#: Minimum fraction of the edge of a border with lit pixels next to it. The dark parts of a scene are ragged.
MIN_CONTACT = 0.65
#: Distance in pixels from a detected border up to which image content is not used.
BLEND_PX = 3
#: Distance in pixels from a detected border up to which pixels get no depth: they show the border in part.
RIM_PX = 1
#: Maximum difference in grey levels within a border of another colour: surfaces have noise and shading.
FLAT = 2
#: Difference in grey levels to such a border above which a pixel shows the scene.
LIT_FLAT = 16
#: Minimum fraction of such pixels further than ``BLOCK_PX`` from the scene, the side of a block of JPEG.
MIN_FLAT, BLOCK_PX = 0.98, 8
#: Minimum intersection over union of the borders of all views.
MIN_OVERLAP = 0.5
#: Approximate number of pixels of the images in which borders of other colours are sought first.
SEARCH_PIXELS = 100_000
#: Side in pixels of the corners whose grey level is taken as the level of the border.
CORNER_PX = 4


def as_mask(value: Any, name: str, size: tuple[int, int]) -> Tensor | None:
    """Return the valid pixels ``(H, W)`` bool of a mask for an image of ``size``; ``None`` if all are valid.

    ``value`` is a PIL image, numpy ``(H, W)`` or ``(H, W, C)``, or torch ``(H, W)`` or ``(C, H, W)``: bool,
    integers, or floats in [0, 1]. White (above half of the range) means valid.
    """
    if value is None:
        return None
    if isinstance(value, Image.Image):
        value = np.asarray(value.convert("L") if value.mode in ("1", "P", "RGB", "RGBA", "LA") else value)
    if isinstance(value, Tensor):
        value = value.detach().cpu()
        value = (value.permute(1, 2, 0) if value.ndim == 3 else value).numpy()
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "buif":
        bad_type(name, "a PIL image, a numpy array or a torch tensor", value)
    mask = value[..., :3].max(-1) if value.ndim == 3 else value
    if mask.shape != size:
        got = f"{mask.shape[1]}x{mask.shape[0]}" if mask.ndim == 2 else f"shape {mask.shape}"
        bad_value(name, f"{size[1]}x{size[0]} pixels, like its image", got, "White pixels are valid.")
    if mask.dtype.kind in "ui":
        mask = mask > WHITE * (np.iinfo(mask.dtype).max if mask.max() > 1 else 1)
    elif mask.dtype.kind == "f":
        mask = mask > WHITE
    if not mask.any():
        bad_value(name, "white (valid) for some pixels", "no valid pixel", "White pixels are valid.")
    return None if mask.all() else torch.from_numpy(np.ascontiguousarray(mask))


def read_mask(path: Path, name: str, size: tuple[int, int], *, scaled: bool = False) -> Tensor | None:
    """Read the valid pixels ``(H, W)`` of an image of ``size`` from a file, as ``as_mask`` does.

    With ``scaled``, the file may have another resolution of the same aspect ratio. ``name`` is for errors.
    """
    with open_image(path, name) as image:
        image.load()  # the file is closed below
        own_size = image.height, image.width
        if scaled and _have_same_aspect(own_size, size):
            mask = as_mask(image, name, own_size)
            return None if mask is None else resized_mask(mask, size)
        return as_mask(image, name, size)


def _have_same_aspect(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Whether the smaller of two sizes ``(H, W)`` is the larger one scaled down, up to rounding."""
    (height, width), larger = sorted([first, second])
    return abs(larger[0] * width / larger[1] - height) < 1


def undistorted_mask(valid: Tensor | None, camera: Camera, size: tuple[int, int]) -> Tensor | None:
    """Return the valid pixels after undistortion of an image of ``size (H, W)``, given those before.

    The same mask if the camera has no lens. Borders have to be detected before, because a lens bends them.
    """
    if camera.lens is None:
        return valid
    inside = filled_by_undistortion(np.ones(size, bool) if valid is None else valid.numpy(), camera)
    return None if inside.all() else torch.from_numpy(inside)


def filled_by_undistortion(valid: np.ndarray, camera: Camera) -> np.ndarray:
    """Return the pixels ``(H, W)`` bool that undistortion fills with ``valid (H, W)`` ones only."""
    inside: np.ndarray = undistorted(valid.astype(np.float32), camera) > ALL_VALID
    return inside


def without_overlays(valid: Tensor | None, overlays: np.ndarray, size: tuple[int, int]) -> Tensor:
    """Return the valid pixels of an image of ``size (H, W)`` outside of static pixels.

    These, ``overlays (h, w)`` bool, may have another size.
    """
    outside = resized_mask(~torch.from_numpy(overlays), size)
    return outside if valid is None else outside & valid


def alpha_mask(image: Any) -> Tensor | None:
    """Return the pixels ``(H, W)`` bool of an image with an alpha above 0; ``None`` if all are."""
    if isinstance(image, Image.Image):
        alpha = np.asarray(image.convert("RGBA"))[..., 3] if has_alpha(image) else None
    elif isinstance(image, Tensor):
        alpha = image[3].detach().float().cpu().numpy() if image.ndim == 3 and len(image) == 4 else None
    elif isinstance(image, np.ndarray):
        alpha = image[..., 3] if image.ndim == 3 and image.shape[-1] == 4 else None
    else:
        alpha = None
    if alpha is None or not (alpha > 0).any() or (alpha > 0).all():
        return None
    return torch.from_numpy(np.ascontiguousarray(alpha > 0))


def both(one: Tensor | None, other: Tensor | None) -> Tensor | None:
    """Return the pixels that are valid in both masks; ``None`` stands for all pixels."""
    if one is None or other is None:
        return other if one is None else one
    return one & other


def outside_borders(images_01: Sequence[Tensor], given: Sequence[Tensor | None]) -> list[Tensor | None]:
    """Return the valid pixels ``(H, W)`` bool of each view ``(3, H, W)`` of one scene; ``None`` for all.

    These are ``given``, or else all but black borders of the view and their rim. Without any given, they also
    exclude the common borders of all views.
    """
    common = common_borders(images_01) if all(mask is None for mask in given) else None
    borders: Sequence[Tensor | None] = [None] * len(images_01) if common is None else common
    masks = list[Tensor | None]()
    for image, mask, border in zip(images_01, given, borders, strict=True):
        found = both(content_mask(image), border) if mask is None else None
        masks.append(mask if found is None else eroded(found, RIM_PX))
    return masks


def content_mask(image_01: Tensor) -> Tensor | None:
    """Find the pixels ``(H, W)`` bool of an image ``(3, H, W)`` outside of black borders; ``None`` for all.

    A border is black, reaches the side of the image and lies outside of the convex hull of all lit pixels,
    which follow its whole edge. The frame of a round image, letterbox bars and the wedges of a rectified
    image are like that. The dark parts of a scene are not, as other parts reach further out than they do.
    """
    return _outside_of_borders(image_01) if _has_rim(_sides(image_01, _brightest), BLACK) else None


def common_borders(images_01: Sequence[Tensor]) -> list[Tensor] | None:
    """Find a border of any colour that all views ``(3, H, W)`` have; ``None`` if there is none.

    It is like a black border, at about the same place in every view, and flatter than anything that a camera
    sees. Returns the pixels ``(H, W)`` bool of each view outside of it.
    """
    if len(images_01) < 2:
        return None
    rims = [_sides(image, grey) for image in images_01]
    corners = [corner for side in rims[0][:2] for corner in (side[:CORNER_PX], side[-CORNER_PX:])]
    for level in sorted({float(np.median(corner)) for corner in corners}):
        if not all(_has_rim([np.abs(side - level) for side in rim], FLAT) for rim in rims):
            continue
        every = [max(1, round((image[0].numel() / SEARCH_PIXELS) ** 0.5)) for image in images_01]
        small = [image[:, ::step, ::step] for image, step in zip(images_01, every, strict=True)]
        if _common(small, level) is not None and (found := _common(images_01, level)) is not None:
            return found
    return None


def _common(images_01: Sequence[Tensor], level: float) -> list[Tensor] | None:
    """Return the pixels of each view outside of a border of one grey level, if all views have it."""
    # Compression spreads colour further than brightness.
    masks = [_outside_of_borders((grey(image) - level).abs(), flat=True) for image in images_01]
    valid = [mask for mask in masks if mask is not None]
    if len(valid) < len(masks):
        return None
    size = (min(mask.shape[0] for mask in valid), min(mask.shape[1] for mask in valid))
    first, *others = (~resized_mask(mask, size) for mask in valid)
    alike = all(float((first & other).sum()) > MIN_OVERLAP * float((first | other).sum()) for other in others)
    return valid if alike else None


def _outside_of_borders(image_01: Tensor, *, flat: bool = False) -> Tensor | None:
    """Return the pixels ``(H, W)`` bool of an image outside of black, or also ``flat``, borders."""
    brightest = (_brightest(image_01)[0] * 255.0).round().byte().cpu().numpy()
    lit = cv2.morphologyEx(
        (brightest > (LIT_FLAT if flat else LIT)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
    )
    outlines, _ = cv2.findContours(lit, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not outlines:
        return None
    hull = np.zeros_like(lit)
    cv2.fillConvexPoly(hull, cv2.convexHull(np.concatenate(outlines)), 1)
    count, regions, areas, _ = cv2.connectedComponentsWithStats(1 - hull, connectivity=4)
    outside = np.zeros(lit.shape, bool)
    for number in range(1, count):
        region = regions == number
        if areas[number, cv2.CC_STAT_AREA] >= MIN_AREA * lit.size and _is_border(region, brightest, lit):
            outside |= region & (not flat or _is_flat(region, brightest))
    return torch.from_numpy(~outside) if outside.any() else None


def _brightest(image_01: Tensor) -> Tensor:
    """Return the brightest channel of an image ``(3, H, W)``, ``(1, H, W)``."""
    return image_01.amax(0, keepdim=True)


def _sides(image_01: Tensor, levels: Callable[[Tensor], Tensor]) -> list[np.ndarray]:
    """Copy the sides of an image ``(3, H, W)`` to the host in one transfer: top, bottom, left, right.

    ``levels`` reduces an image to one channel.
    """
    sides = (image_01[:, :1], image_01[:, -1:], image_01[..., :1].mT, image_01[..., -1:].mT)
    values = levels(torch.cat(sides, -1)).flatten().cpu().numpy()
    return np.split(values, np.cumsum([side.shape[-1] for side in sides])[:-1])


def _has_rim(sides: Sequence[np.ndarray], level: float) -> bool:
    """Return whether a part of any side of a map is at most at a grey level."""
    return any(float((side <= level / 255.0).mean()) > MIN_RIM for side in sides)


def _is_border(region: np.ndarray, brightest: np.ndarray, lit: np.ndarray) -> bool:
    """Return whether a region outside of the hull is black, up to an edge along which pixels are lit."""
    near, far = FADE_PX
    away = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    black, inner = brightest <= FAINT, away >= near
    if (
        not inner.any()
        or black[inner].mean() < MIN_BLACK
        or black[inner & (away <= far)].mean() < MIN_BLACK_NEAR
    ):
        return False
    edge = (cv2.dilate(region.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & ~region
    return bool(edge.any()) and bool(cv2.dilate(lit, np.ones((3, 3), np.uint8))[edge].mean() >= MIN_CONTACT)


def _is_flat(region: np.ndarray, brightest: np.ndarray) -> bool:
    """Return whether a region is black but for compression next to the scene."""
    away = cv2.distanceTransform(region.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inner = brightest[away > BLOCK_PX]
    return bool(inner.size) and bool((inner <= FLAT).mean() >= MIN_FLAT)


def filled(image_01: Tensor, valid: Tensor) -> Tensor:
    """Replace the pixels of an image ``(C, H, W)`` that are not valid by a smooth continuation of the others.

    Means of valid pixels on a pyramid, each level filled from the next coarser one.
    """
    known = valid.to(image_01).expand(1, 1, *valid.shape)
    levels = [(torch.where(known > 0, image_01[None], 0.0), known)]
    while levels[-1][1].numel() > 1 and not bool((levels[-1][1] > 0).all()):
        total, count = (F.avg_pool2d(each, 2, ceil_mode=True, count_include_pad=False) for each in levels[-1])
        levels.append((total, count))
    total, count = levels.pop()
    below = total / count.clamp_min(1e-6)
    for total, count in reversed(levels):
        smooth = F.interpolate(below, total.shape[-2:], mode="bilinear", align_corners=False)
        below = torch.where(count > 0, total / count.clamp_min(1e-6), smooth)
    return below[0]


def neutral_views(
    images_01: Sequence[Tensor], given: Sequence[Tensor | None], detects_borders: bool = True
) -> list[tuple[Tensor, Tensor | None]]:
    """Make the content of each view of one scene neutral where it is not valid; also returns valid pixels.

    These, ``(H, W)`` bool, are ``given``, or else those ``outside_borders`` if ``detects_borders``; ``None``
    stands for all.
    """
    masks = outside_borders(images_01, given) if detects_borders else given
    views = list[tuple[Tensor, Tensor | None]]()
    for image, own, mask in zip(images_01, given, masks, strict=True):
        if mask is None:
            views.append((image, None))
        else:
            used = mask if own is not None else eroded(mask, BLEND_PX - RIM_PX)
            views.append((filled(image, used), mask))
    return views
