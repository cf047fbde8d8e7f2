"""Reads images from files and memory as floats in [0, 1] (S3.3, the two views), and their EXIF data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from geodiff_plugin._internal.camera_checks import check_intrinsics
from geodiff_plugin._internal.checks import InputError, bad_type, bad_value, check_choice, check_number, warn
from geodiff_plugin.cameras import Camera
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import (
    ORIENTATION,
    ORIENTATIONS,
    SWAPPING_ORIENTATIONS,
    UPRIGHT,
    PathLike,
    exif_of,
    open_image,
)
from geodiff_plugin.formats.frame_packing import FRAME_LAYOUTS, Packing, find_packing
from geodiff_plugin.formats.maps import MAX_16_BITS
from geodiff_plugin.formats.rigs import intrinsics

#: Minimum side in pixels: smaller images have no matches; also the smallest sensible latent of the VAE.
MIN_SIDE = 32
#: Tolerance for values outside [0, 1] due to resampling; larger ones indicate another range.
OVERSHOOT = 1e-3
#: 16-bit images whose values are all below this come from a camera with 10 or 12 bits.
DARK_16_BITS = 8192
#: Formats with several frames or pages of the same kind; others contain previews.
SEVERAL = ("GIF", "PNG", "TIFF", "WEBP")
CHANNELS = (1, 3, 4)
#: Entity group of the two images in a spatial HEIC file.
STEREO_GROUP = "ster"
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35_MM = math.hypot(36.0, 24.0)
#: Maximum ratio between a focal length and its EXIF value; larger ones indicate another image size. EXIF is
#: accurate to a few per cent, and rectification or undistortion changes it by less.
_OTHER_LENS = 1.4
#: Relative tolerance of the aspect ratio, for rounding; cropping exceeds it.
_SAME_SHAPE = 0.01
HINT = "Pass K (--K), a field of view (--fov), or images with EXIF data."


def _check_sides(width: int, height: int, name: str) -> None:
    if min(height, width) < MIN_SIDE:
        expected = f"at least {MIN_SIDE} pixels per side"
        bad_value(
            name, expected, f"{width}x{height}", "It may be a thumbnail or a latent.", code="image.small"
        )


def _array_of(image: Image.Image, name: str) -> np.ndarray:
    """Return an image of any Pillow mode as ``(H, W)`` floats or uint16, or ``(H, W, C)`` uint8."""
    _check_sides(*image.size, name)
    if image.mode == "F":
        return np.asarray(image, dtype=np.float32)
    if image.mode.startswith("I"):  # 16-bit grey: I;16, I;16B, or I in files that Pillow converts
        grey = np.asarray(image)
        if grey.min() < 0 or grey.max() > MAX_16_BITS:
            bad_value(name, "an image of 8 or 16 bits", f"values from {grey.min():g} to {grey.max():g}")
        return grey.astype(np.uint16)
    return np.asarray(image.convert("RGBA" if has_alpha(image) else "RGB"))


def has_alpha(image: Image.Image) -> bool:
    """Whether an image has an alpha channel or a transparent colour."""
    return image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info


def _file_findings(image: Image.Image, name: str) -> list[Finding]:
    """Return findings on an opened image before decoding: several frames, or 16-bit colour read as 8 bits."""
    findings = list[Finding]()
    frames = getattr(image, "n_frames", 1)
    if frames > 1 and image.format in SEVERAL:
        sentence = f"{name} holds {frames} frames or pages; only the first is used."
        findings.append(Finding("image.frames", sentence))
    # Pillow loads only the upper 8 bits of these; the tile information is gone after loading.
    if any(";16" in str(tile[3]) for tile in getattr(image, "tile", ())) and not image.mode.startswith("I"):
        findings += _dark_findings(257 * int(np.asarray(image.convert("RGB")).max()), name)
    return findings


def _dark_findings(maximum: int, name: str) -> list[Finding]:
    text = f"{name} is a 16-bit image that is nearly black: its maximum is {maximum} of {MAX_16_BITS}."
    hint = "If its camera has 12 bits, multiply them by 16; with 10 bits, by 64."
    return [Finding("image.dark", f"{text} {hint}")] if maximum < DARK_16_BITS else []


def _to_01(value: np.ndarray, name: str) -> tuple[np.ndarray, list[Finding]]:
    """Convert ``(H, W)`` or ``(H, W, C)`` to ``(H, W, 3)`` float32 in [0, 1]; also return findings."""
    value = value[..., None] if value.ndim == 2 else value
    findings = list[Finding]()
    if value.shape[-1] == 4:
        value = value[..., :3]
        findings.append(
            Finding(
                "image.alpha",
                f"{name} has an alpha channel: fully transparent pixels (alpha 0) are treated as invalid.",
            )
        )
    if value.dtype in (np.uint8, np.uint16):
        findings += _dark_findings(int(value.max()), name) if value.dtype == np.uint16 else []
        value = value.astype(np.float32) / np.iinfo(value.dtype).max
    elif value.dtype.kind == "f":
        if not np.isfinite(value).all():
            bad_value(name, "finite", "NaN or infinity", "Mask or fill those pixels first.")
        low, high = float(value.min()), float(value.max())
        if low < -OVERSHOOT or high > 1 + OVERSHOOT:
            hint = "Divide by 255." if low >= 0 else "Map [-1, 1] to [0, 1] with (x + 1) / 2."
            bad_value(name, "floats in [0, 1]", f"values from {low:g} to {high:g}", hint)
        value = value.astype(np.float32, copy=False).clip(0.0, 1.0)
    else:
        hint = f"Convert it with astype('uint8'){' * 255' if value.dtype == bool else ''}."
        bad_value(name, "uint8, uint16 or floats in [0, 1]", f"dtype {value.dtype}", hint)
    return np.repeat(value, 3, axis=-1) if value.shape[-1] == 1 else value, findings


def read_image(
    path: PathLike, name: str = "left", *, as_stored: bool = False, page: int = 0
) -> tuple[np.ndarray, list[Finding]]:
    """Read an image file as ``(H, W, 3)`` float32 in [0, 1], with findings about conversions.

    Applies the EXIF orientation, unless the camera refers to the pixels ``as_stored``. ``page`` is the number
    of an image in a file of several.
    """
    with open_image(path, name) as image:
        findings = _file_findings(image, name)
        image.seek(page)
        image.load()
        is_reoriented = image.getexif().get(ORIENTATION) in ORIENTATIONS and not as_stored
        upright = ImageOps.exif_transpose(image) if is_reoriented else image
        pixels = _array_of(upright, name)
    image_01, more = _to_01(pixels, name)
    findings += more
    if is_reoriented:
        text = f"{name} was rotated or mirrored to {upright.width}x{upright.height} by its EXIF orientation"
        findings.append(Finding("image.rotated", f"{text}; pass K for the upright image."))
    return image_01, findings


def read_alpha(path: PathLike, name: str, *, as_stored: bool = False) -> np.ndarray | None:
    """Return the pixels ``(H, W)`` bool of an image file with alpha above 0, rotated like in ``read_image``.

    ``None`` stands for all pixels.
    """
    with open_image(path, name) as image:
        if not has_alpha(image):
            return None
        upright = image if as_stored else ImageOps.exif_transpose(image)
        shown = np.asarray(upright.convert("RGBA"))[..., 3] > 0
    return None if shown.all() else shown


#: Tag with the kinds of the images in an MPO file, and the kinds of previews.
MPO_ENTRIES = 0xB002
PREVIEW = "Thumbnail"


def pages_of_both(path: PathLike, name: str) -> tuple[int, int]:
    """Return the page numbers of the left and right image in an MPO or spatial HEIC file.

    Source: CIPA DC-007, whose stereo images are in order; ISO/IEC 23008-12: the first item of an entity group
    ``ster`` is the left view.
    """
    with open_image(path, name) as image:
        count = int(getattr(image, "n_frames", 1))
        is_heic = image.format == "HEIF"
        entries = (getattr(image, "mpinfo", None) or {}).get(MPO_ENTRIES) or ()
        kinds = [str(entry["Attribute"]["MPType"]) for entry in entries]
        groups = image.info.get("entity_groups") or ()
    if not is_heic:
        if count != 2:
            bad_value(name, "an MPO file with two images, the left one first", f"{count} in {path}")
        if any(PREVIEW in kind for kind in kinds):
            got = f"{path} with one view and its preview"
            bad_value(name, "an MPO file of two views", got, "Pass the right view as RIGHT.")
        return 0, 1
    pair = next((list(group["images"]) for group in groups if group["type"] == STEREO_GROUP), [])
    if len(pair) != 2 or None in pair:
        hint = "Pass the right view as RIGHT. Spatial HEIC needs pillow-heif 1.8 or later."
        expected = "a spatial HEIC file (entity group ster) if RIGHT is missing"
        bad_value(name, expected, f"{path} with {count} images and no such group", hint)
    return int(pair[0]), int(pair[1])


def _hwc(value: Any, name: str) -> np.ndarray:
    """Convert an array (channels last) or tensor (channels first) to ``(H, W, C)``, C of 1, 3 or 4."""
    if not isinstance(value, (torch.Tensor, np.ndarray)):
        bad_type(
            name, "a PIL image, a numpy array or a torch tensor", value, "For a file, use Image.open(path)."
        )
    if isinstance(value, torch.Tensor):
        channels, shape, turn = 0, "(3, H, W)", "For torch, put channels first: value.permute(2, 0, 1)."
    else:
        value = value[..., None] if value.ndim == 2 else value
        channels = -1
        shape = "(H, W, 3) or (H, W)"
        turn = "For numpy, put channels last: value.transpose(1, 2, 0)."
    if value.ndim != 3 or value.shape[channels] not in CHANNELS:
        hints = {2: "Add a channel axis: value[None].", 3: turn, 4: "Pass a batch as a list: list(value)."}
        expected = f"an image of shape {shape}, of 1, 3 or 4 channels"
        bad_value(name, expected, f"shape {tuple(value.shape)}", hints.get(value.ndim, ""))
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = value.float() if value.dtype == torch.bfloat16 else value  # numpy has no bfloat16
        value = value.permute(1, 2, 0).numpy()
    _check_sides(value.shape[1], value.shape[0], name)
    # TIFF and PGM readers keep the file's byte order, which torch does not support.
    return value.astype(value.dtype.newbyteorder("="), copy=False)


def image_size_of(value: Any, name: str) -> tuple[int, int]:
    """Return ``(width, height)`` of an input of ``as_image_01`` without reading pixels or warning."""
    if isinstance(value, Image.Image):
        _check_sides(*value.size, name)
        return value.size
    height, width, _ = _hwc(value, name).shape
    return width, height


def in_stored_pixels(value: Any) -> Any:
    """Mark images in memory as stored, so that their EXIF orientation is ignored without a warning.

    Copies PIL images that have an EXIF orientation; processes lists and tuples per entry.
    """
    if isinstance(value, (list, tuple)):
        return type(value)(map(in_stored_pixels, value))
    if not isinstance(value, Image.Image) or value.getexif().get(ORIENTATION) not in ORIENTATIONS:
        return value
    copy = value.copy()
    copy.getexif()[ORIENTATION] = UPRIGHT
    return copy


def as_image_01(value: Any, name: str) -> torch.Tensor:
    """Convert an image in memory to a tensor ``(3, H, W)`` float32 in [0, 1] on the CPU; not differentiable.

    ``value`` is a PIL image (used as is), numpy ``(H, W, C)`` or ``(H, W)``, or torch ``(C, H, W)``, of
    uint8, uint16 or float in [0, 1]. One channel is repeated; a fourth (alpha) is left out.
    """
    if isinstance(value, Image.Image):
        of_file = _file_findings(value, name)
        hwc, of_pixels = _to_01(_array_of(value, name), name)
        findings = of_file + of_pixels
        if value.getexif().get(ORIENTATION) in ORIENTATIONS:
            hint = "apply it with PIL.ImageOps.exif_transpose and pass K for the upright image."
            sentence = f"{name} has an EXIF orientation that is not applied; {hint}"
            findings.append(Finding("image.orientation", sentence))
    else:
        hwc, findings = _to_01(_hwc(value, name), name)
    for finding in findings:
        warn(finding, stacklevel=3)
    return torch.from_numpy(np.ascontiguousarray(hwc.transpose(2, 0, 1)))


def intrinsics_from_fov(fov_deg: float, size: tuple[int, int]) -> np.ndarray:
    """Return K for square pixels and a central principal point; ``fov_deg`` is horizontal."""
    check_number(fov_deg, "fov", 1.0, 170.0)
    focal = size[0] / 2 / math.tan(math.radians(fov_deg) / 2)
    return intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)


def _exif_number(entries: Mapping[int, Any], tag: Base) -> float:
    """Return a positive number of the EXIF data, or 0 if missing."""
    try:
        value = float(entries.get(tag) or 0.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0


def _check_uncropped(taken: tuple[float, float], size: tuple[int, int], name: str) -> None:
    """Raise an error if the aspect ratio differs from the original image's; both are ``(width, height)``."""
    width, height = size
    shapes = [(taken[0] / taken[1]) / shape for shape in (width / height, height / width)]
    if min(max(ratio, 1 / ratio) for ratio in shapes) > 1 + _SAME_SHAPE:
        got = f"{taken[0]:.0f}x{taken[1]:.0f}: the image was cropped"
        hint = f"Pass the original image. {HINT}"
        bad_value(f"EXIF of {name}", f"for an image of {width}x{height}", got, hint, code="exif.cropped")


def intrinsics_from_exif(
    source: PathLike | Image.Image, name: str, *, as_stored: bool = False
) -> tuple[np.ndarray, list[Finding]]:
    """Estimate K of an image from EXIF to a few per cent, with findings about assumptions.

    For a file it refers to the upright image, unless ``as_stored``; an image in memory is used as is.
    """
    if not isinstance(source, Image.Image):
        with open_image(source, name) as image:
            K, findings = intrinsics_from_exif(image, name)
            swapped = exif_of(image).get(ORIENTATION) in SWAPPING_ORIENTATIONS and not as_stored
        return intrinsics(K[1, 1], K[0, 0], K[1, 2], K[0, 2]) if swapped else K, findings
    number = partial(_exif_number, exif_of(source).get_ifd(IFD.Exif))
    width, height = source.size
    taken = number(Base.ExifImageWidth), number(Base.ExifImageHeight)
    if all(taken):
        _check_uncropped(taken, source.size, name)
    focal_35, focal_mm = number(Base.FocalLengthIn35mmFilm), number(Base.FocalLength)
    per_unit_x, zoom = number(Base.FocalPlaneXResolution), number(Base.DigitalZoomRatio)
    if focal_35:
        fx = fy = focal_35 * math.hypot(width, height) / _DIAGONAL_35_MM
        focal = f"{focal_35:g} mm in 35 mm equivalent"
    elif focal_mm and per_unit_x and taken[0]:
        mm = _MM_PER_UNIT.get(int(number(Base.FocalPlaneResolutionUnit) or 2), 25.4)
        fx = focal_mm * per_unit_x / mm * (max(width, height) / max(taken)) * max(zoom, 1.0)
        fy = fx * (number(Base.FocalPlaneYResolution) or per_unit_x) / per_unit_x
        focal = f"{focal_mm:g} mm on its sensor"
    else:
        bad_value(f"K of {name}", "specified", "no focal length in its EXIF", HINT, code="exif.missing")
    findings = [Finding("camera.from-exif", f"K of {name}: {focal} in EXIF, {fx:.0f} px.")]
    if zoom > 1.01:
        sentence = (
            f"{name} was taken with {zoom:g}x digital zoom, which some cameras omit from the focal length."
        )
        findings.append(Finding("camera.zoom", sentence))
    return intrinsics(fx, fy, (width - 1) / 2, (height - 1) / 2), findings


def warn_of_other_lens(source: PathLike | Image.Image, K: np.ndarray, name: str) -> None:
    """Warn of a focal length that contradicts the EXIF data of an uncropped image."""
    try:
        theirs, findings = intrinsics_from_exif(source, name)
    except InputError:
        return
    factor = K[0, 0] / theirs[0, 0]
    zoomed = any(finding.code == "camera.zoom" for finding in findings)
    if not zoomed and max(factor, 1 / factor) >= _OTHER_LENS:
        factor_text = f"{factor:.2f} times the {theirs[0, 0]:.0f} px in its EXIF"
        hint = "If K is for a different image size, depth is wrong by that factor. Check K."
        sentence = f"K has a focal length of {K[0, 0]:.0f} px for {name}, {factor_text}. {hint}"
        warn(Finding("camera.focal-mismatch", sentence), stacklevel=3)


class SplitViews(NamedTuple):
    """Both views of an image, and their camera matrix."""

    left: Any  # of the type of the image
    right: Any
    K: Any  # as given, for the pixels of the views


def split_views(image: Any, K: Any, layout: str | None = None) -> SplitViews:
    """Split an image that holds both views, left view first, for ``GeometryGuidance``.

    >>> left, right, K = split_views(image, K, "half")

    Half layouts squeeze the views. They stay as they are in the image, and K is adapted to their pixels. An
    alpha channel is split like the colours.

    Args:
        image: PIL image, numpy ``(H, W, C)`` or torch ``(C, H, W)``.
        K: ``(3, 3)`` intrinsics of a view before it was squeezed, pixels; or a tuple of both.
        layout: ``"full"`` or ``"half"`` (side by side), ``"over-under"`` or ``"half-over-under"``; ``None``
            infers it from shape and content, and warns.

    Raises:
        InputError: a wrong type or layout, or an odd width or height of the image.
    """
    if isinstance(image, Image.Image):
        pixels = np.asarray(image.convert("RGBA" if has_alpha(image) else "RGB"))
    else:
        pixels = _hwc(image, "image")
    if layout is None:
        packing = find_packing([pixels[..., :3]], "the image")
        if packing.finding is not None:
            warn(packing.finding)
    else:
        packing = Packing(check_choice(layout, "layout", FRAME_LAYOUTS))
    halves = packing.split(pixels, "image")
    size = (halves[0].shape[1], halves[0].shape[0])
    views: Sequence[Any] = halves
    if isinstance(image, Image.Image):
        views = [Image.fromarray(half) for half in halves]
    elif isinstance(image, torch.Tensor):
        views = image.chunk(2, dim=1 if packing.is_stacked else 2)
    given = K if isinstance(K, tuple) else (K,)
    Ks = tuple(
        Camera(check_intrinsics(each, "K"), packing.shown_size(size)).resized(size).K for each in given
    )
    return SplitViews(views[0], views[1], Ks if isinstance(K, tuple) else Ks[0])
