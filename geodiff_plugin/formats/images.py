"""Images from files and from memory as floats in [0, 1] (S3.3, the two views)."""

from __future__ import annotations

import os
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin._checks import bad_type, bad_value, warn
from geodiff_plugin.formats.files import ORIENTATION, open_image

#: Fewer pixels a side hold no matches; also the VAE's smallest sensible latent.
MIN_SIDE = 32
#: Resampling may overshoot [0, 1] by a little; more than this is another range.
OVERSHOOT = 1e-3
#: Values of the EXIF orientation of an image that is to be turned or mirrored.
TURNS = range(2, 9)
#: 16-bit values that all lie below this are those of a camera of 10 or 12 bits, as they come.
DARK_16_BITS = 8192
CHANNELS = (1, 3, 4)
#: Formats that hold several frames or pages of one kind; others hold previews.
SEVERAL = ("GIF", "PNG", "TIFF", "WEBP")


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


def _file_notes(image: Image.Image, name: str) -> list[str]:
    """What to say of an opened image before its pixels: several frames; few of 16 bits used, in colour."""
    notes, frames = list[str](), getattr(image, "n_frames", 1)
    if frames > 1 and image.format in SEVERAL:
        notes.append(f"{name} holds {frames} frames or pages; only the first is taken.")
    # Pillow loads the upper 8 bits of these, and tells only before.
    if any(";16" in str(tile[3]) for tile in getattr(image, "tile", ())) and not image.mode.startswith("I"):
        most = 257 * int(np.asarray(image.convert("RGB")).max())
        notes += [_dark_note(most, name)] if most < DARK_16_BITS else []
    return notes


def _dark_note(most: int, name: str) -> str:
    return (
        f"{name} is a 16-bit image that is nearly black: its values reach {most} of 65535. "
        "If its camera has 12 bits, multiply them by 16; with 10 bits, by 64."
    )


def _to_01(value: np.ndarray, name: str) -> tuple[np.ndarray, list[str]]:
    """``(H, W, 3)`` float32 in [0, 1] of ``(H, W)`` or ``(H, W, C)`` numbers, and what to say of them."""
    value, notes = value[..., None] if value.ndim == 2 else value, []
    if value.shape[-1] == 4:
        value, notes = value[..., :3], [f"{name} has an alpha channel; it is dropped."]
    if value.dtype in (np.uint8, np.uint16):
        if value.dtype == np.uint16 and value.max() < DARK_16_BITS:
            notes.append(_dark_note(int(value.max()), name))
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


def read_image(path: str | os.PathLike[str], name: str = "left") -> tuple[np.ndarray, list[str]]:
    """Read an image file, upright: ``(H, W, 3)`` float32 in [0, 1], and sentences about what was done to it.

    Alpha is dropped, the image turned as its EXIF orientation says, and of several frames the first is taken.

    Raises:
        OSError, ValueError: no readable file; not an image, cut off, or a side under 32 pixels.
    """
    with open_image(path, name) as image:
        said = _file_notes(image, name)
        image.seek(0)
        image.load()
        is_turned = image.getexif().get(ORIENTATION) in TURNS
        upright = ImageOps.exif_transpose(image)
    image_01, notes = _to_01(_array_of(upright, name), name)
    notes = said + notes
    if is_turned:
        notes.append(
            f"{name} was turned or mirrored to {upright.width}x{upright.height}, as its EXIF orientation "
            "says; K must belong to the turned image."
        )
    return image_01, notes


def _hwc(value: Any, name: str) -> np.ndarray:
    """``(H, W, C)``, C of 1, 3 or 4, of an array with channels last or a tensor with channels first."""
    if not isinstance(value, (torch.Tensor, np.ndarray)):
        bad_type(name, "a PIL image, a numpy array or a torch tensor", value)
    if isinstance(value, torch.Tensor):
        channels, shape, turn = 0, "(3, H, W)", "torch images start with channels: value.permute(2, 0, 1)."
    else:
        value = value[..., None] if value.ndim == 2 else value
        channels, shape = -1, "(H, W, 3) or (H, W)"
        turn = "numpy images end in channels: value.transpose(1, 2, 0)."
    if value.ndim != 3 or value.shape[channels] not in CHANNELS:
        cures = {2: "Add a channel axis: value[None].", 3: turn, 4: "Take one image of the batch: value[0]."}
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


def as_image_01(value: Any, name: str) -> torch.Tensor:
    """An image from memory as a tensor ``(3, H, W)`` float32 in [0, 1] on the CPU; not differentiable.

    ``value`` is a PIL image, as it lies in memory; numpy ``(H, W, C)`` or ``(H, W)``, or torch ``(C, H, W)``,
    of uint8, uint16 or float in [0, 1]. One channel is repeated, a fourth dropped with a warning.

    Raises:
        TypeError: none of these types.
        ValueError: wrong rank or channels, NaN or infinity, floats outside [0, 1], a side under 32 pixels.
    """
    if isinstance(value, Image.Image):
        said = _file_notes(value, name)
        hwc, notes = _to_01(_array_of(value, name), name)
        notes = said + notes
        if value.getexif().get(ORIENTATION) in TURNS:
            notes.append(
                f"{name} carries an EXIF orientation that is not applied; "
                "turn it with PIL.ImageOps.exif_transpose and give the K of the turned image."
            )
    else:
        hwc, notes = _to_01(_hwc(value, name), name)
    for note in notes:
        warn(note, stacklevel=3)
    return torch.from_numpy(np.ascontiguousarray(hwc.transpose(2, 0, 1)))
