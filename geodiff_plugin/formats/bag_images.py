"""Decodes images of bags in the encodings of ``sensor_msgs/image_encodings.hpp`` and camera drivers.

``rosbags-image`` is not used: it ignores ``step``, so padded rows shear, and assumes that NV12 data is as
high as its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._internal.checks import InputFileError, bad_value, warn
from geodiff_plugin.findings import Finding

#: Numbers of bits of sensors whose values may be stored unscaled in 16 bits.
SENSOR_BITS = (10, 12, 14)
#: Message types of compressed videos, and programs that decode them.
CODED = (
    "FFMPEGPacket",
    "CompressedVideo",
    "theora_image_transport/Packet",
    "theora_image_transport/msg/Packet",
)
#: Parts of the names of video codecs in the ``format`` of a compressed image.
CODECS = ("264", "265", "hevc")
DECODE_CODED = "Republish them as raw images and record those: ros2 run image_transport republish ffmpeg raw."


@dataclass(frozen=True)
class Encoding:
    """An encoding of raw images: type of its values, channels, and OpenCV's conversion code to RGB.

    ``rows`` is data rows per image row: NV12 has half as many again for the colours.
    """

    kind: str
    channels: int
    code: int | None
    rows: float = 1.0


def _encodings() -> dict[str, Encoding]:
    table = {
        **dict.fromkeys(("uyvy", "yuv422"), Encoding("u1", 2, cv2.COLOR_YUV2RGB_UYVY)),
        **dict.fromkeys(("yuyv", "yuy2", "yuv422_yuy2"), Encoding("u1", 2, cv2.COLOR_YUV2RGB_YUYV)),
        "nv12": Encoding("u1", 1, cv2.COLOR_YUV2RGB_NV12, 1.5),
        "nv21": Encoding("u1", 1, cv2.COLOR_YUV2RGB_NV21, 1.5),
        "mono10": Encoding("u2", 1, cv2.COLOR_GRAY2RGB),
        "mono12": Encoding("u2", 1, cv2.COLOR_GRAY2RGB),
        "32FC1": Encoding("f4", 1, cv2.COLOR_GRAY2RGB),
        "32FC3": Encoding("f4", 3, cv2.COLOR_BGR2RGB),
    }
    for bits in (8, 16):
        kind = f"u{bits // 8}"
        table |= {f"rgb{bits}": Encoding(kind, 3, None), f"rgba{bits}": Encoding(kind, 4, cv2.COLOR_RGBA2RGB)}
        # OpenCV's own types do not state colours; its images are BGR.
        table |= dict.fromkeys((f"bgr{bits}", f"{bits}UC3"), Encoding(kind, 3, cv2.COLOR_BGR2RGB))
        table |= dict.fromkeys((f"bgra{bits}", f"{bits}UC4"), Encoding(kind, 4, cv2.COLOR_BGRA2RGB))
        table |= dict.fromkeys((f"mono{bits}", f"{bits}UC1"), Encoding(kind, 1, cv2.COLOR_GRAY2RGB))
        # OpenCV names Bayer patterns by the second row, ROS by the first.
        for name, opencv in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")):
            table[f"bayer_{name}{bits}"] = Encoding(kind, 1, getattr(cv2, f"COLOR_Bayer{opencv}2RGB"))
    return table


#: Encodings by name in a message.
ENCODINGS = _encodings()
#: The same by lower-case name: drivers differ in letter case.
ENCODINGS_BY_LOWER_NAME = {name.lower(): encoding for name, encoding in ENCODINGS.items()}


def decode_image(message: Any, path: Path) -> np.ndarray:
    """Return an ``Image`` or ``CompressedImage`` as ``(H, W, 3)``, RGB, in its own dtype.

    Raises:
        InputError: an unsupported encoding, or data that is truncated or does not match its encoding.
    """
    data = np.asarray(message.data, dtype=np.uint8)
    decode = _decode_compressed if hasattr(message, "format") else _decode_raw
    return decode(message, data, path)


def _decode_compressed(message: Any, data: np.ndarray, path: Path) -> np.ndarray:
    try:
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
    except cv2.error:  # no data, or a header with a huge size; other damage returns None
        image = None
    if image is None:
        is_video = any(word in message.format.lower() for word in CODECS)
        hint = f" {DECODE_CODED}" if is_video else ""
        raise InputFileError(f"an image of {path} ({message.format}) cannot be decoded.{hint}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def _decode_raw(message: Any, data: np.ndarray, path: Path) -> np.ndarray:
    encoding = ENCODINGS_BY_LOWER_NAME.get(str(message.encoding).lower())
    if encoding is None:
        bad_value("the encoding", f"one of {', '.join(ENCODINGS)}", f"{message.encoding} in {path}")
    size = f"{message.width}x{message.height} in {path}"
    if not (message.width and message.height):
        bad_value("an image", "of at least one pixel", size)
    stored = np.dtype((">" if message.is_bigendian else "<") + encoding.kind)
    height = round(message.height * encoding.rows)
    row_bytes = message.width * encoding.channels * stored.itemsize
    if message.step < row_bytes or data.size < height * message.step:
        expected = f"{height} rows of {row_bytes} bytes ({message.encoding})"
        got = f"{data.size} bytes, rows of {message.step}, in {path}"
        bad_value("an image", expected, got, "It may be truncated.")
    rows = data[: height * message.step].reshape(height, message.step)[:, :row_bytes]
    image = np.ascontiguousarray(rows).view(stored).astype(encoding.kind)
    image = image.reshape(height, message.width, encoding.channels)
    try:
        return image if encoding.code is None else cv2.cvtColor(image, encoding.code)
    except cv2.error:  # an odd width or height, although two pixels share one colour
        bad_value("an image", f"of even width and height ({message.encoding})", size)


def both_as_01(images: Sequence[np.ndarray], path: Path) -> list[np.ndarray]:
    """Convert images of one moment to float32 in [0, 1], with the bit depth that the brighter one needs."""
    kinds = {str(image.dtype) for image in images}
    if len(kinds) > 1:
        hint = "Record both topics with the same encoding."
        bad_value("the images of a pair", "of one type", f"{' and '.join(sorted(kinds))} in {path}", hint)
    maximum = max(float(image.max()) for image in images)
    if images[0].dtype.kind == "f":
        full = 1.0 if maximum <= 1.0 else 255.0
        if not all(np.isfinite(image).all() and image.min() >= 0 for image in images) or maximum > full:
            bad_value("an image of floats", "in [0, 1] or [0, 255]", f"up to {maximum:g} in {path}")
    elif images[0].dtype == np.uint16:
        bits = next((bits for bits in SENSOR_BITS if maximum < 1 << bits), 16)
        full = float((1 << bits) - 1)
        if bits < 16:
            sentence = f"Its 16-bit images have a maximum of {maximum:.0f}, so {bits} bits are assumed."
            warn(Finding("image.bits", f"{path.name}: {sentence}"), stacklevel=3)
    else:
        full = float(np.iinfo(images[0].dtype).max)
    return [image.astype(np.float32) / np.float32(full) for image in images]
