"""Reads maps with one number per pixel from all supported file types, in their own dtype and unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.files import PathLike, check_file, open_image, read_npy

#: The largest value of 16 bits.
MAX_16_BITS = 65535
#: Also the default units per metre of integer depth maps.
MM_PER_METRE = 1000.0
MAP_FILES = "a map (H, W) as .npy, .npz, .pfm, .exr, 16-bit .png or .tiff"
#: Channels of an OpenEXR file that may hold depth, in order of preference.
EXR_CHANNELS = ("Z", "Y", "R", "V")
#: Channels of a colour image; in a map they are all equal.
EXR_COLOURS = ("R", "G", "B")
#: Plausible range of depths stored as float bytes in a PNG.
LIKELY_DEPTH_M = (1e-3, 1e6)
#: First bytes of a ``.dpt``.
DPT_TAG = b"PIEH"


def read_pfm(path: PathLike, name: str = "map") -> np.ndarray:
    """Read a grey portable float map as ``(H, W)`` float32."""
    what = "a whole grey PFM file (Pf, size, scale)"
    with open_image(path, name, what) as image:
        if image.mode != "F":
            bad_value(name, what, f"{path} of mode {image.mode}", "Check that it is not a PNG or npy.")
        return np.array(image, np.float32)


def read_map_file(path: PathLike, name: str = "map") -> np.ndarray:
    """Read the ``(H, W)`` numbers of a map, in the file's own dtype and unit."""
    file = check_file(path, name, MAP_FILES)
    values = np.squeeze(MAP_READERS.get(file.suffix.lower(), _image_map)(file, name))
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        bad_value(name, MAP_FILES, f"{file} of shape {values.shape}", "Save one map of the left image.")
    return values


def _image_map(file: Path, name: str) -> np.ndarray:
    """Read a PNG or TIFF of one channel, of 16 bits or floats."""
    with open_image(file, name, "a map of 16 bits or floats") as image:
        mode = image.mode
        values = np.asarray(image)
    if mode == "F":
        return values
    if mode == "RGBA" and (floats := _floats_of_bytes(values)) is not None:
        return floats
    if not mode.startswith("I"):
        bad_value(
            name,
            "a 16-bit grey PNG or TIFF",
            f"{file} of mode {mode}",
            "An 8-bit copy does not contain the values.",
        )
    return values.astype(np.uint16) if values.min() >= 0 and values.max() <= MAX_16_BITS else values


def _floats_of_bytes(rgba: np.ndarray) -> np.ndarray | None:
    """Decode ``(H, W)`` float32 metres from the bytes of a TartanAir V2 PNG; ``None`` for a colour image.

    The alpha of 255 in a colour image never gives a positive number. Source:
    ``DataLoader/Dataset/TartanAir.py`` of MAC-VO/MAC-VO, which reads with OpenCV, hence blue first.
    """
    floats = np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
    with np.errstate(invalid="ignore"):
        likely = (floats >= LIKELY_DEPTH_M[0]) & (floats <= LIKELY_DEPTH_M[1])
    return floats.astype(np.float32) if likely.all() else None


def _dpt_map(file: Path, name: str) -> np.ndarray:
    """Read MPI Sintel's ``.dpt``. Source: its ``sintel_io.py``."""
    data = file.read_bytes()
    width, height = np.frombuffer(data[4:12].ljust(8, b"\0"), "<i4")
    if data[:4] != DPT_TAG or min(width, height) < 1 or len(data) != 12 + 4 * int(width) * int(height):
        bad_value(name, "a whole .dpt of MPI Sintel", file, "It may be truncated.")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width)


def _npy_map(file: Path, name: str) -> np.ndarray:
    return read_npy(file, name, MAP_FILES)


def _npz_map(file: Path, name: str) -> np.ndarray:
    try:
        with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return archive["depth" if "depth" in archive.files else " ".join(archive.files)]
    except Exception as error:  # any error that a damaged file may cause
        bad_value(name, "an .npz with 'depth' or a single array", f"{file} ({error})")


def _exr_map(file: Path, name: str) -> np.ndarray:
    """Read the only channel of an OpenEXR file, or Z, Y or R if the colours are equal."""
    try:
        import OpenEXR
    except ImportError:
        bad_value(
            name, MAP_FILES, file, "Install it with: pip install OpenEXR, or save the map with numpy.save."
        )
    try:
        with OpenEXR.File(str(file), separate_channels=True) as opened:
            channels = {key: np.asarray(channel.pixels) for key, channel in opened.channels().items()}
    except Exception as error:  # any error that a damaged file may cause
        bad_value(name, "a whole OpenEXR file", f"{file} ({error})", "It may be truncated.")
    key = next((key for key in EXR_CHANNELS if key in channels), next(iter(channels), ""))
    if not key:
        bad_value(name, "an OpenEXR file with a channel", file)
    colours = [channels[colour] for colour in EXR_COLOURS if colour in channels]
    if key == "R" and any(not np.array_equal(each, colours[0], equal_nan=True) for each in colours[1:]):
        bad_value(name, "a map of depths", f"{file}, a colour image", "Save the depth as a channel Z.")
    return channels[key].astype(np.float32)


MAP_READERS: dict[str, Callable[[Path, str], np.ndarray]] = {
    ".npy": _npy_map,
    ".npz": _npz_map,
    ".pfm": read_pfm,
    ".exr": _exr_map,
    ".dpt": _dpt_map,
}
"""By suffix; all other files are read as images."""
