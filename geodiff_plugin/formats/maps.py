"""Maps of one number a pixel from the kinds of files that hold them, in the file's own type and unit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import PathLike, check_file, open_image, read_npy

LARGEST_16_BITS = 65535
MAP_FILES = "a map (H, W) as .npy, .npz, .pfm, .exr, 16-bit .png or .tiff"
#: Channels of an OpenEXR file that may hold depth, the first that is there.
EXR_CHANNELS = ("Z", "Y", "R", "V")
#: Those of a colour picture, which in a map are all the same.
EXR_COLOURS = ("R", "G", "B")
#: Depths that a PNG of bytes of floats may hold.
LIKELY_DEPTH_M = (1e-3, 1e6)
#: What a ``.dpt`` begins with.
DPT_TAG = b"PIEH"


def read_pfm(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` float32 of a grey portable float map, top row first, unlike the file."""
    file = check_file(path, name, "a PFM file")
    with open(file, "rb") as stream:
        kind = stream.readline(8).strip()
        try:
            width, height = (int(word) for word in stream.readline(64).split())
            scale = float(stream.readline(64))
        except ValueError:
            kind, width, height, scale = b"", 0, 0, 0.0
        data = stream.read()
    if kind != b"Pf" or min(width, height) < 1 or len(data) < 4 * width * height:
        bad_value(name, "a whole grey PFM file (Pf, size, scale)", file, "Is it cut off, or a PNG or npy?")
    values = np.frombuffer(data, dtype="<f4" if scale < 0 else ">f4", count=width * height)
    return np.flipud(values.reshape(height, width)).astype(np.float32)


def read_map_file(path: PathLike, name: str = "map") -> np.ndarray:
    """The ``(H, W)`` numbers of a map, in the file's own type and unit."""
    file = check_file(path, name, MAP_FILES)
    values = np.squeeze(MAP_READERS.get(file.suffix.lower(), _picture_map)(file, name))
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        bad_value(name, MAP_FILES, f"{file} of shape {values.shape}", "Save one map of the left image.")
    return values


def _picture_map(file: Path, name: str) -> np.ndarray:
    """The numbers of a PNG or TIFF of one channel, of 16 bits or floats."""
    with open_image(file, name, "a map of 16 bits or floats") as image:
        mode, values = image.mode, np.asarray(image)
    if mode == "F":
        return values
    if mode == "RGBA" and (floats := _floats_of_bytes(values)) is not None:
        return floats
    if not mode.startswith("I"):
        bad_value(
            name, "a 16-bit grey PNG or TIFF", f"{file} of mode {mode}", "An 8-bit copy has lost the values."
        )
    return values.astype(np.uint16) if values.min() >= 0 and values.max() <= LARGEST_16_BITS else values


def _floats_of_bytes(rgba: np.ndarray) -> np.ndarray | None:
    """The ``(H, W)`` float32 metres that TartanAir V2 keeps in the bytes of a PNG, or ``None`` for a picture.

    A picture's alpha of 255 makes no positive number. Source: ``DataLoader/Dataset/TartanAir.py`` of
    MAC-VO/MAC-VO, which reads by OpenCV, so blue first.
    """
    floats = np.ascontiguousarray(rgba[..., [2, 1, 0, 3]]).view("<f4")[..., 0]
    with np.errstate(invalid="ignore"):
        likely = (floats >= LIKELY_DEPTH_M[0]) & (floats <= LIKELY_DEPTH_M[1])
    return floats.astype(np.float32) if likely.all() else None


def _dpt_map(file: Path, name: str) -> np.ndarray:
    """MPI Sintel's ``.dpt``. Source: its ``sintel_io.py``."""
    data = file.read_bytes()
    width, height = np.frombuffer(data[4:12].ljust(8, b"\0"), "<i4")
    if data[:4] != DPT_TAG or min(width, height) < 1 or len(data) != 12 + 4 * int(width) * int(height):
        bad_value(name, "a whole .dpt of MPI Sintel", file, "Is it cut off?")
    return np.frombuffer(data, "<f4", offset=12).reshape(height, width)


def _npy_map(file: Path, name: str) -> np.ndarray:
    return read_npy(file, name, MAP_FILES)


def _npz_map(file: Path, name: str) -> np.ndarray:
    try:
        with open(file, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return archive["depth" if "depth" in archive.files else " ".join(archive.files)]
    except Exception as error:  # of any kind that a damaged file leads to
        bad_value(name, "an .npz with 'depth' or a single array", f"{file} ({error})")


def _exr_map(file: Path, name: str) -> np.ndarray:
    """The only channel of an OpenEXR file, or its Z, Y or R, where the colours are alike."""
    try:
        import OpenEXR
    except ImportError:
        bad_value(name, MAP_FILES, file, "Run: pip install OpenEXR, or save the map with numpy.save.")
    try:
        with OpenEXR.File(str(file), separate_channels=True) as opened:
            channels = {key: np.asarray(channel.pixels) for key, channel in opened.channels().items()}
    except Exception as error:  # of any kind that a damaged file leads to
        bad_value(name, "a whole OpenEXR file", f"{file} ({error})", "Is it cut off?")
    key = next((key for key in EXR_CHANNELS if key in channels), next(iter(channels), ""))
    if not key:
        bad_value(name, "an OpenEXR file with a channel", file)
    colours = [channels[colour] for colour in EXR_COLOURS if colour in channels]
    if key == "R" and any(not np.array_equal(each, colours[0], equal_nan=True) for each in colours[1:]):
        bad_value(name, "a map of depths", f"{file}, a colour picture", "Save the depth as a channel Z.")
    return channels[key].astype(np.float32)


MAP_READERS: dict[str, Callable[[Path, str], np.ndarray]] = {
    ".npy": _npy_map,
    ".npz": _npz_map,
    ".pfm": read_pfm,
    ".exr": _exr_map,
    ".dpt": _dpt_map,
}
"""By suffix; another file is a picture."""
