"""Images from files and memory as floats in [0, 1] (S3.3, the two views), and their EXIF data."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps
from PIL.ExifTags import IFD, Base

from geodiff_plugin._checks import InputError, bad_type, bad_value, check_number, warn
from geodiff_plugin.formats.files import ORIENTATION, TURNS, UPRIGHT, PathLike, exif_of, open_image
from geodiff_plugin.formats.rigs import intrinsics
from geodiff_plugin.messages import Message

#: Fewer pixels a side hold no matches; also the VAE's smallest sensible latent.
MIN_SIDE = 32
#: Resampling may overshoot [0, 1] by a little; more than this is another range.
OVERSHOOT = 1e-3
#: 16-bit values that all lie below this are those of a camera of 10 or 12 bits, as they come.
DARK_16_BITS = 8192
#: Formats that hold several frames or pages of one kind; others hold previews.
SEVERAL = ("GIF", "PNG", "TIFF", "WEBP")
CHANNELS = (1, 3, 4)
#: What HEIC files call the two pictures of a spatial photograph.
STEREO_GROUP = "ster"
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_DIAGONAL_35_MM = math.hypot(36.0, 24.0)
#: A focal length further off its EXIF than this factor is of an image of another size: EXIF is known to a few
#: per cent, and rectification or a lens that was straightened changes it by less.
_OTHER_LENS = 1.4
#: Sides may be rounded by this share before an image counts as cropped.
_SAME_SHAPE = 0.01
CURES = "Give K (--K), a field of view (--fov), or photographs with their EXIF."


def _check_sides(width: int, height: int, name: str) -> None:
    if min(height, width) < MIN_SIDE:
        expected = f"at least {MIN_SIDE} pixels a side"
        bad_value(name, expected, f"{width}x{height}", "Is this a thumbnail or a latent?")


def _array_of(image: Image.Image, name: str) -> np.ndarray:
    """``(H, W)`` floats or uint16, or ``(H, W, C)`` uint8, of an image in any mode that Pillow has."""
    _check_sides(*image.size, name)
    if image.mode == "F":
        return np.asarray(image, dtype=np.float32)
    if image.mode.startswith("I"):  # 16-bit grey: I;16, I;16B, or I in files that Pillow widens
        grey = np.asarray(image)
        if grey.min() < 0 or grey.max() > 65535:
            bad_value(name, "an image of 8 or 16 bits", f"values from {grey.min():g} to {grey.max():g}")
        return grey.astype(np.uint16)
    alpha = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
    return np.asarray(image.convert("RGBA" if alpha else "RGB"))


def _file_notes(image: Image.Image, name: str) -> list[Message]:
    """What to say of an opened image before its pixels: several frames; few of 16 bits used, in colour."""
    notes, frames = list[Message](), getattr(image, "n_frames", 1)
    if frames > 1 and image.format in SEVERAL:
        sentence = f"{name} holds {frames} frames or pages; only the first is taken."
        notes.append(Message("image.frames", sentence))
    # Pillow loads the upper 8 bits of these, and tells only before.
    if any(";16" in str(tile[3]) for tile in getattr(image, "tile", ())) and not image.mode.startswith("I"):
        notes += _dark_notes(257 * int(np.asarray(image.convert("RGB")).max()), name)
    return notes


def _dark_notes(most: int, name: str) -> list[Message]:
    said = f"{name} is a 16-bit image that is nearly black: its values reach {most} of 65535."
    cure = "If its camera has 12 bits, multiply them by 16; with 10 bits, by 64."
    return [Message("image.dark", f"{said} {cure}")] if most < DARK_16_BITS else []


def _to_01(value: np.ndarray, name: str) -> tuple[np.ndarray, list[Message]]:
    """``(H, W, 3)`` float32 in [0, 1] of ``(H, W)`` or ``(H, W, C)`` numbers, and what to say of them."""
    value, notes = value[..., None] if value.ndim == 2 else value, list[Message]()
    if value.shape[-1] == 4:
        value = value[..., :3]
        notes.append(Message("image.alpha", f"{name} has an alpha channel; it is dropped."))
    if value.dtype in (np.uint8, np.uint16):
        notes += _dark_notes(int(value.max()), name) if value.dtype == np.uint16 else []
        value = value.astype(np.float32) / np.iinfo(value.dtype).max
    elif value.dtype.kind == "f":
        if not np.isfinite(value).all():
            bad_value(name, "finite", "NaN or infinity in it", "Mask or fill those pixels first.")
        low, high = float(value.min()), float(value.max())
        if low < -OVERSHOOT or high > 1 + OVERSHOOT:
            cure = "Divide by 255." if low >= 0 else "Map [-1, 1] to [0, 1] with (x + 1) / 2."
            bad_value(name, "floats in [0, 1]", f"values from {low:g} to {high:g}", cure)
        value = value.astype(np.float32, copy=False).clip(0.0, 1.0)
    else:
        cure = f"Convert it with astype('uint8'){' * 255' if value.dtype == bool else ''}."
        bad_value(name, "uint8, uint16 or floats in [0, 1]", f"dtype {value.dtype}", cure)
    return np.repeat(value, 3, axis=-1) if value.shape[-1] == 1 else value, notes


def read_image(
    path: PathLike, name: str = "left", *, as_stored: bool = False, page: int = 0
) -> tuple[np.ndarray, list[Message]]:
    """An image file, ``(H, W, 3)`` float32 in [0, 1], and sentences about what was done to it.

    It is turned upright by its EXIF orientation, unless its camera is one of the pixels ``as_stored``.
    ``page`` is the number of a picture in a file of several.
    """
    with open_image(path, name) as image:
        notes = _file_notes(image, name)
        image.seek(page)
        image.load()
        is_turned = image.getexif().get(ORIENTATION) in TURNS and not as_stored
        upright = ImageOps.exif_transpose(image) if is_turned else image
        pixels = _array_of(upright, name)
    image_01, more = _to_01(pixels, name)
    notes += more
    if is_turned:
        said = f"{name} was turned or mirrored to {upright.width}x{upright.height}, as its EXIF says"
        notes.append(Message("image.turned", f"{said}; a K that you give must belong to the turned image."))
    return image_01, notes


#: The tag of an MPO file that says of what kind each of its pictures is, and what previews are called there.
MPO_ENTRIES = 0xB002
PREVIEW = "Thumbnail"


def pages_of_both(path: PathLike, name: str) -> tuple[int, int]:
    """Numbers of the left and the right picture in an MPO or a spatial HEIC file.

    Source: CIPA DC-007, whose stereo images are in order; ISO/IEC 23008-12: the first item of an entity group
    ``ster`` is the left view.
    """
    with open_image(path, name) as image:
        count, is_heic = int(getattr(image, "n_frames", 1)), image.format == "HEIF"
        entries = (getattr(image, "mpinfo", None) or {}).get(MPO_ENTRIES) or ()
        kinds = [str(entry["Attribute"]["MPType"]) for entry in entries]
        groups = image.info.get("entity_groups") or ()
    if not is_heic:
        if count != 2:
            bad_value(name, "an MPO file with two pictures, left one first", f"{count} in {path}")
        if any(PREVIEW in kind for kind in kinds):
            got = f"{path} of one view and its preview"
            bad_value(name, "an MPO file of two views", got, "Give the right view as RIGHT.")
        return 0, 1
    pair = next((list(group["images"]) for group in groups if group["type"] == STEREO_GROUP), [])
    if len(pair) != 2 or None in pair:
        cure = "Give the right view as RIGHT. Of a spatial photograph pillow-heif 1.8 or later is needed."
        expected = "a spatial HEIC file (entity group ster) where RIGHT is missing"
        bad_value(name, expected, f"{path} with {count} pictures and no such group", cure)
    return int(pair[0]), int(pair[1])


def _hwc(value: Any, name: str) -> np.ndarray:
    """``(H, W, C)``, C of 1, 3 or 4, of an array with channels last or a tensor with channels first."""
    if not isinstance(value, (torch.Tensor, np.ndarray)):
        bad_type(name, "a PIL image, a numpy array or a torch tensor", value, "Of a file: Image.open(path).")
    if isinstance(value, torch.Tensor):
        channels, shape, turn = 0, "(3, H, W)", "torch images start with channels: value.permute(2, 0, 1)."
    else:
        value = value[..., None] if value.ndim == 2 else value
        channels, shape = -1, "(H, W, 3) or (H, W)"
        turn = "numpy images end in channels: value.transpose(1, 2, 0)."
    if value.ndim != 3 or value.shape[channels] not in CHANNELS:
        cures = {2: "Add a channel axis: value[None].", 3: turn, 4: "A batch is a list: list(value)."}
        expected = f"an image of shape {shape}, of 1, 3 or 4 channels"
        bad_value(name, expected, f"shape {tuple(value.shape)}", cures.get(value.ndim, ""))
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = value.float() if value.dtype == torch.bfloat16 else value  # numpy has no bfloat16
        value = value.permute(1, 2, 0).numpy()
    _check_sides(value.shape[1], value.shape[0], name)
    # Readers of TIFF and PGM leave the file's byte order, which says nothing about the values.
    return value.astype(value.dtype.newbyteorder("="), copy=False)


def picture_size(value: Any, name: str) -> tuple[int, int]:
    """``(width, height)`` of what ``as_image_01`` takes, without a look at its pixels, nor its warnings."""
    if isinstance(value, Image.Image):
        _check_sides(*value.size, name)
        return value.size
    height, width, _ = _hwc(value, name).shape
    return width, height


def in_stored_pixels(value: Any) -> Any:
    """Images from memory as they lie there, for cameras of the stored pixels: nobody need turn them.

    A copy of a PIL image whose EXIF orientation says so; a list or tuple of images entry by entry.
    """
    if isinstance(value, (list, tuple)):
        return type(value)(map(in_stored_pixels, value))
    if not isinstance(value, Image.Image) or value.getexif().get(ORIENTATION) not in TURNS:
        return value
    copy = value.copy()
    copy.getexif()[ORIENTATION] = UPRIGHT
    return copy


def as_image_01(value: Any, name: str) -> torch.Tensor:
    """An image from memory as a tensor ``(3, H, W)`` float32 in [0, 1] on the CPU; not differentiable.

    ``value`` is a PIL image, as it lies in memory; numpy ``(H, W, C)`` or ``(H, W)``, or torch ``(C, H, W)``,
    of uint8, uint16 or float in [0, 1]. One channel is repeated, a fourth dropped with a warning.
    """
    if isinstance(value, Image.Image):
        of_file = _file_notes(value, name)
        hwc, of_pixels = _to_01(_array_of(value, name), name)
        notes = of_file + of_pixels
        if value.getexif().get(ORIENTATION) in TURNS:
            cure = "turn it with PIL.ImageOps.exif_transpose and give the K of the turned image."
            sentence = f"{name} carries an EXIF orientation that is not applied; {cure}"
            notes.append(Message("image.orientation", sentence))
    else:
        hwc, notes = _to_01(_hwc(value, name), name)
    for note in notes:
        warn(note, stacklevel=3)
    return torch.from_numpy(np.ascontiguousarray(hwc.transpose(2, 0, 1)))


def intrinsics_from_fov(fov_deg: float, size: tuple[int, int]) -> np.ndarray:
    """K of a camera with square pixels and its principal point in the middle; ``fov_deg`` is horizontal."""
    check_number(fov_deg, "fov", 1.0, 170.0)
    focal = size[0] / 2 / math.tan(math.radians(fov_deg) / 2)
    return intrinsics(focal, focal, (size[0] - 1) / 2, (size[1] - 1) / 2)


def _exif_number(entries: Mapping[int, Any], tag: Base) -> float:
    """A positive number of the EXIF data; 0 where there is none."""
    try:
        value = float(entries.get(tag) or 0.0)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) and value > 0 else 0.0


def _check_uncropped(taken: tuple[float, float], size: tuple[int, int], name: str) -> None:
    """Refuse an image of another shape than the one it was taken with; both are ``(width, height)``."""
    width, height = size
    shapes = [(taken[0] / taken[1]) / shape for shape in (width / height, height / width)]
    if min(max(ratio, 1 / ratio) for ratio in shapes) > 1 + _SAME_SHAPE:
        got = f"one of {taken[0]:.0f}x{taken[1]:.0f}: it was cropped since it was taken"
        cure = f"Give the image as it was taken. {CURES}"
        bad_value(f"EXIF of {name}", f"of an image of {width}x{height}", got, cure)


def intrinsics_from_exif(
    source: PathLike | Image.Image, name: str, *, as_stored: bool = False
) -> tuple[np.ndarray, list[Message]]:
    """K of a photograph to a few per cent, and what was assumed.

    A file's is that of the upright image, unless it is to be read ``as_stored``; an image's as it lies.
    """
    if not isinstance(source, Image.Image):
        with open_image(source, name) as image:
            K, notes = intrinsics_from_exif(image, name)
            turned = exif_of(image).get(ORIENTATION, 1) >= 5 and not as_stored
        return intrinsics(K[1, 1], K[0, 0], K[1, 2], K[0, 2]) if turned else K, notes
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
        bad_value(f"K of {name}", "known", "no focal length in its EXIF", CURES)
    notes = [Message("camera.from-exif", f"K of {name}: {focal} by its EXIF, {fx:.0f} px.")]
    if zoom > 1.01:
        sentence = f"{name} was zoomed digitally by {zoom:g}; some cameras do not count that in."
        notes.append(Message("camera.zoom", sentence))
    return intrinsics(fx, fy, (width - 1) / 2, (height - 1) / 2), notes


def warn_of_other_lens(source: PathLike | Image.Image, K: np.ndarray, name: str) -> None:
    """Warn of a focal length that contradicts the EXIF data of an uncropped image."""
    try:
        theirs, notes = intrinsics_from_exif(source, name)
    except InputError:
        return
    factor = K[0, 0] / theirs[0, 0]
    zoomed = any(note.code == "camera.zoom" for note in notes)
    if not zoomed and max(factor, 1 / factor) >= _OTHER_LENS:
        said = f"{factor:.2f} times the {theirs[0, 0]:.0f} px of its EXIF: is K for an image of another size?"
        cure = "If it is, all metres are off by that factor."
        sentence = f"K has a focal length of {K[0, 0]:.0f} px for {name}, {said} {cure}"
        warn(Message("camera.other-lens", sentence), stacklevel=3)
