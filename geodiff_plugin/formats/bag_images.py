"""Images of bags in the encodings of ``sensor_msgs/image_encodings.hpp`` and of camera drivers.

``rosbags-image`` is not used: it ignores ``step``, so that padded rows shear, and takes NV12 to be as high as
its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._checks import InputFileError, bad_value, warn
from geodiff_plugin.messages import Message

#: Bits of a camera, at least and at most, whose numbers may lie in 16 bits as they come.
SENSOR_BITS = (10, 12, 14)
#: Types of messages with coded videos, and what makes pictures of them.
CODED = (
    "FFMPEGPacket",
    "CompressedVideo",
    "theora_image_transport/Packet",
    "theora_image_transport/msg/Packet",
)
DECODE_CODED = "Republish them as raw images and record those: ros2 run image_transport republish ffmpeg raw."


@dataclass(frozen=True)
class Encoding:
    """An encoding of raw images: type of its numbers, how many a pixel, OpenCV's code that makes RGB of it.

    ``rows`` are those of the data for each of the image: half as many again hold the colours of NV12.
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
        # OpenCV's own types say nothing of colours; its images are BGR.
        table |= dict.fromkeys((f"bgr{bits}", f"{bits}UC3"), Encoding(kind, 3, cv2.COLOR_BGR2RGB))
        table |= dict.fromkeys((f"bgra{bits}", f"{bits}UC4"), Encoding(kind, 4, cv2.COLOR_BGRA2RGB))
        table |= dict.fromkeys((f"mono{bits}", f"{bits}UC1"), Encoding(kind, 1, cv2.COLOR_GRAY2RGB))
        # OpenCV names Bayer patterns by the second row, ROS by the first.
        for name, opencv in (("rggb", "BG"), ("bggr", "RG"), ("gbrg", "GR"), ("grbg", "GB")):
            table[f"bayer_{name}{bits}"] = Encoding(kind, 1, getattr(cv2, f"COLOR_Bayer{opencv}2RGB"))
    return table


#: By the name that a message has, whose letters may be large or small.
ENCODINGS = _encodings()


def decode_image(message: Any, path: Path) -> np.ndarray:
    """``(H, W, 3)``, RGB, in its own type, of an ``Image`` or a ``CompressedImage``."""
    data = np.asarray(message.data, dtype=np.uint8)
    if hasattr(message, "format"):
        image = cv2.imdecode(data, cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH)
        if image is None:
            cure = (
                DECODE_CODED if any(word in message.format.lower() for word in ("264", "265", "hevc")) else ""
            )
            raise InputFileError(f"an image of {path} ({message.format}) does not decode. {cure}".rstrip())
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    by_small = {name.lower(): encoding for name, encoding in ENCODINGS.items()}
    encoding = by_small.get(str(message.encoding).lower())
    if encoding is None:
        bad_value("the encoding", f"one of {', '.join(ENCODINGS)}", f"{message.encoding} in {path}")
    numbers = np.dtype((">" if message.is_bigendian else "<") + encoding.kind)
    height = round(message.height * encoding.rows)
    used = message.width * encoding.channels * numbers.itemsize
    if message.step < used or data.size < height * message.step:
        expected = f"of {height} rows of {used} bytes ({message.encoding})"
        bad_value(
            "an image", expected, f"{data.size} bytes, rows of {message.step}, in {path}", "Is it cut off?"
        )
    rows = data[: height * message.step].reshape(height, message.step)[:, :used]
    image = np.ascontiguousarray(rows).view(numbers).astype(encoding.kind)
    image = image.reshape(height, message.width, encoding.channels)
    return image if encoding.code is None else cv2.cvtColor(image, encoding.code)


def both_as_01(images: Sequence[np.ndarray], path: Path) -> list[np.ndarray]:
    """Images of one moment as float32 in [0, 1], both by the bits that the brighter one needs."""
    most = max(float(image.max()) for image in images)
    if images[0].dtype.kind == "f":
        full = 1.0 if most <= 1.0 else 255.0
        if not all(np.isfinite(image).all() and image.min() >= 0 for image in images) or most > full:
            bad_value("an image of floats", "of values from 0 to 1, or to 255", f"up to {most:g} in {path}")
    elif images[0].dtype == np.uint16:
        bits = next((bits for bits in SENSOR_BITS if most < 1 << bits), 16)
        full = float((1 << bits) - 1)
        if bits < 16:
            sentence = f"Its 16-bit images reach {most:.0f}: they are taken to be of {bits} bits."
            warn(Message("image.bits", f"{path.name}: {sentence}"), stacklevel=3)
    else:
        full = float(np.iinfo(images[0].dtype).max)
    return [image.astype(np.float32) / np.float32(full) for image in images]
