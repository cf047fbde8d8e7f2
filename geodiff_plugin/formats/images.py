"""Images from files and from memory as floats in [0, 1] (S3.3, the two views)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin._checks import InputError, bad_type, bad_value, warn
from geodiff_plugin.formats.files import DECODE_ERRORS, open_image, refuse_damaged

__all__ = ["MIN_SIDE", "as_image_01", "picture_size", "read_image"]

#: Fewer pixels a side hold no matches; also the VAE's smallest sensible latent.
MIN_SIDE = 32
#: Resampling may overshoot [0, 1] by a little; more than this is another range.
OVERSHOOT = 1e-3
EXIF_ORIENTATION = 0x0112
TURNS = {
    2: "mirrored left to right",
    3: "turned by 180 degrees",
    4: "mirrored top to bottom",
    5: "mirrored and turned by 90 degrees",
    6: "turned by 90 degrees clockwise",
    7: "mirrored and turned by 90 degrees",
    8: "turned by 90 degrees counter-clockwise",
}
#: 16-bit values that all lie below this are those of a camera of 10 or 12 bits, as they come.
DARK_16_BITS = 8192
#: Formats of Pillow whose files may hold several frames or pages that are pictures of their own; what goes
#: with a phone's JPEG is none.
MANY_FRAMES = ("GIF", "PNG", "TIFF", "WEBP")


def _check_sides(width: int, height: int, name: str) -> None:
    if min(height, width) < MIN_SIDE:
        expected = f"at least {MIN_SIDE} pixels a side"
        bad_value(name, expected, f"{width}x{height}", "Is this a thumbnail or a latent?")


def _has_16_bits(image: Image.Image) -> bool:
    """Whether an image has 16 bits; of a coloured one Pillow loads the upper 8, and tells only before."""
    raw_modes = (str(tile[3]) for tile in getattr(image, "tile", ()))
    return image.mode.startswith("I") or any(";16" in mode for mode in raw_modes)


def _frame_notes(image: Image.Image, name: str) -> list[str]:
    frames = getattr(image, "n_frames", 1) if image.format in MANY_FRAMES else 1
    return [f"{name} holds {frames} frames or pages; only the first is taken."] if frames > 1 else []


def _dark_notes(most: int, name: str) -> list[str]:
    """A sentence if a camera of 10 or 12 bits filled the lowest of an image's 16; else nothing."""
    if most >= DARK_16_BITS:
        return []
    return [
        f"{name} is a 16-bit image that is nearly black: its values reach {most} of 65535. "
        "If its camera has 12 bits, multiply them by 16; with 10 bits, by 64."
    ]


def _alpha_notes(has_alpha: bool, name: str) -> list[str]:
    return [f"{name} has an alpha channel; it is dropped."] if has_alpha else []


def _of_pillow(image: Image.Image, name: str, deep: bool) -> tuple[np.ndarray, list[str]]:
    """``(H, W, 3)`` float32 in [0, 1] of an image in any mode that Pillow has, and what to say of it."""
    _check_sides(*image.size, name)
    if image.mode == "F":
        grey = _checked_floats(np.asarray(image, dtype=np.float32), name)
        return np.repeat(grey[..., None], 3, axis=-1), []
    if image.mode.startswith("I"):  # 16-bit grey: I;16, I;16B, or I in files that Pillow widens
        grey = np.asarray(image).astype(np.float32)
        if grey.min() < 0 or grey.max() > 65535:
            bad_value(name, "an image of 8 or 16 bits", f"values from {grey.min():g} to {grey.max():g}")
        notes = _dark_notes(int(grey.max()), name) if deep else []
        return np.repeat(grey[..., None] / 65535.0, 3, axis=-1), notes
    alpha = image.mode in ("RGBA", "LA", "PA", "La", "RGBa") or "transparency" in image.info
    rgb = np.asarray((image.convert("RGBA") if alpha else image).convert("RGB"))
    notes = _alpha_notes(alpha, name) + (_dark_notes(int(rgb.max()) * 257, name) if deep else [])
    return rgb.astype(np.float32) / 255.0, notes


def read_image(path: str | os.PathLike[str], name: str = "left") -> tuple[np.ndarray, list[str]]:
    """Read an image file, upright.

    Grey, palette, 16-bit and CMYK images work; alpha is dropped; of several frames the first is taken.

    Returns:
        ``(H, W, 3)`` float32 in [0, 1], and sentences about what was done to it: alpha dropped, or turned
        as the EXIF orientation says (K must belong to the turned image), 16 bits of which few are used, or
        only the first of several frames taken. They call the image ``name``.

    Raises:
        OSError, ValueError: no readable file; not an image, cut off, or a side under 32 pixels.
    """
    try:
        with open_image(path, name) as image:
            deep, notes = _has_16_bits(image), _frame_notes(image, name)
            image.seek(0)
            image.load()
            turn = TURNS.get(image.getexif().get(EXIF_ORIENTATION, 1))
            upright = ImageOps.exif_transpose(image)
    except InputError:
        raise
    except DECODE_ERRORS as error:
        refuse_damaged(name, path, error)
    image_01, more = _of_pillow(upright, name, deep)
    if turn is not None:
        more.append(
            f"{name} was {turn} to {upright.width}x{upright.height}, as its EXIF orientation says; "
            "K must belong to the turned image."
        )
    return image_01, notes + more


def _checked_floats(values: np.ndarray, name: str) -> np.ndarray:
    if not np.isfinite(values).all():
        bad_value(name, "finite", "NaN or infinity in it", "Mask or fill those pixels first.")
    low, high = float(values.min()), float(values.max())
    if low < -OVERSHOOT or high > 1 + OVERSHOOT:
        cure = "Divide by 255." if low >= 0 else "Map [-1, 1] to [0, 1] with (x + 1) / 2."
        bad_value(name, "floats in [0, 1]", f"values from {low:g} to {high:g}", cure)
    return values.astype(np.float32, copy=False).clip(0.0, 1.0)


def _hwc(value: Any, name: str) -> np.ndarray:
    """``(H, W, C)``, C of 1, 3 or 4, of an array with channels last or a tensor with channels first."""
    if isinstance(value, torch.Tensor):
        batch, flat = "Take one image of the batch: value[0].", "Add a channel axis: value[None]."
        first, last, shape, place = 0, -1, "(3, H, W)", "first"
        turn = "torch images start with channels: value.permute(2, 0, 1)."
    elif isinstance(value, np.ndarray):
        batch, flat = "Take one image of the batch.", ""
        first, last, shape, place = -1, 0, "(H, W, 3) or (H, W)", "last"
        turn = "numpy images end in channels: value.transpose(1, 2, 0)."
        value = value[..., None] if value.ndim == 2 else value
    else:
        bad_type(name, "a PIL image, a numpy array or a torch tensor", value)
    if value.ndim != 3:
        cure = batch if value.ndim == 4 else flat
        bad_value(name, f"an image of shape {shape}", f"shape {tuple(value.shape)}", cure)
    if value.shape[first] not in (1, 3, 4):
        cure = turn if value.shape[last] in (1, 3, 4) else ""
        bad_value(name, f"an image with 1, 3 or 4 channels {place}", f"shape {tuple(value.shape)}", cure)
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu()
        value = value.float() if value.dtype == torch.bfloat16 else value  # numpy has no bfloat16
        value = value.permute(1, 2, 0).numpy()
    _check_sides(value.shape[1], value.shape[0], name)
    # Readers of TIFF and PGM leave the file's byte order, which says nothing about the values.
    return value.astype(value.dtype.newbyteorder("="), copy=False)


def _of_array(value: np.ndarray, name: str) -> tuple[np.ndarray, list[str]]:
    """``(H, W, 3)`` float32 in [0, 1] of ``(H, W, C)`` uint8, uint16 or floats, and what to say of it."""
    notes = _alpha_notes(value.shape[-1] == 4, name)
    value = value[..., :3]
    notes += _dark_notes(int(value.max()), name) if value.dtype == np.uint16 else []
    if value.dtype in (np.uint8, np.uint16):
        scaled = value.astype(np.float32) / np.iinfo(value.dtype).max
    elif value.dtype.kind == "f":
        scaled = _checked_floats(value, name)
    else:
        cure = f"Convert it with astype('uint8'){' * 255' if value.dtype == bool else ''}."
        bad_value(name, "uint8, uint16 or floats in [0, 1]", f"dtype {value.dtype}", cure)
    return np.repeat(scaled, 3, axis=-1) if scaled.shape[-1] == 1 else scaled, notes


def picture_size(value: Any, name: str) -> tuple[int, int]:
    """``(width, height)`` of what ``as_image_01`` takes, without a look at its pixels, nor its warnings.

    Raises:
        TypeError, ValueError: no image by its type or shape, or a side under 32 pixels.
    """
    if isinstance(value, Image.Image):
        _check_sides(*value.size, name)
        return value.size
    height, width, _ = _hwc(value, name).shape
    return width, height


def as_image_01(value: Any, name: str) -> torch.Tensor:
    """An image from memory as a tensor.

    A PIL image is taken as it lies in memory, as diffusers does; one that still carries an EXIF turn gets a
    warning. A fourth channel is alpha and is dropped with a warning; one channel is repeated. 16 bits of
    which few are used get a warning.

    Args:
        value: PIL image; numpy ``(H, W, C)`` or ``(H, W)``, or torch ``(C, H, W)``, of uint8, uint16 or
            float in [0, 1].
        name: the argument that it came in, for messages.

    Returns:
        ``(3, H, W)`` float32 in [0, 1] on the CPU; not differentiable.

    Raises:
        TypeError: none of these types.
        ValueError: wrong rank or channels, NaN or infinity, floats outside [0, 1], a side under 32 pixels.
    """
    if isinstance(value, Image.Image):
        deep, notes = _has_16_bits(value), _frame_notes(value, name)
        if value.getexif().get(EXIF_ORIENTATION) in TURNS:
            notes.append(
                f"{name} carries an EXIF orientation that is not applied; "
                "turn it with PIL.ImageOps.exif_transpose and give the K of the turned image."
            )
        hwc, more = _of_pillow(value, name, deep)
        notes += more
    else:
        hwc, notes = _of_array(_hwc(value, name), name)
    for note in notes:
        warn(note, stacklevel=3)
    return torch.from_numpy(np.ascontiguousarray(hwc.transpose(2, 0, 1)))
