"""Converts between ROS messages and arrays, for bags and for nodes.

Messages of ``rosbags`` and of ROS 2's own Python packages have the same fields and take them as keywords. The
conversions therefore accept either: they get the message classes by name.

Source: ``sensor_msgs/msg/Image.msg`` and ``CameraInfo.msg`` of ros2/common_interfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from geodiff_plugin.formats.bag_images import both_as_01, decode_image
from geodiff_plugin.formats.depth import depth_mm, sigma_mm

if TYPE_CHECKING:
    from geodiff_plugin.types import Rig

#: Message class by its full name, such as ``sensor_msgs/msg/Image``.
Types = Mapping[str, Any]
#: Converts an array to the type of a message's sequences: numpy for ``rosbags``, ``array.array`` for ROS 2.
AsSequence = Callable[[np.ndarray], Any]
IMAGE, CAMERA_INFO, REGION = (
    f"sensor_msgs/msg/{name}" for name in ("Image", "CameraInfo", "RegionOfInterest")
)
#: Fields of a region of interest that change the camera.
REGION_FIELDS = ("x_offset", "y_offset", "width", "height")


def depth_values(depth_m: np.ndarray, encoding: str) -> np.ndarray:
    """Return the pixels of a depth image: integer millimetres, 0 where unknown, or metres, NaN where unknown.

    ``depth_m (H, W)`` is unknown where 0, negative or NaN; ``encoding`` is ``"16UC1"`` or ``"32FC1"``.
    """
    values = np.where(depth_m > 0, depth_m, np.nan).astype("<f4")
    return depth_mm(values) if encoding == "16UC1" else values


def sigma_values(sigma_m: np.ndarray, encoding: str) -> np.ndarray:
    """Return the pixels of an image of standard deviations ``(H, W)``, like ``depth_values``, rounded up."""
    values = sigma_m.astype("<f4")
    return sigma_mm(values) if encoding == "16UC1" else values


def image_message(
    types: Types, header: Any, values: np.ndarray, encoding: str, as_sequence: AsSequence = np.asarray
) -> Any:
    """Return an ``Image`` with pixels ``(H, W)`` or ``(H, W, C)``, which match the encoding."""
    values = np.ascontiguousarray(values)
    height, width = values.shape[:2]
    data = as_sequence(values.view(np.uint8).ravel())
    layout = {"encoding": encoding, "is_bigendian": 0, "step": values.strides[0]}
    return types[IMAGE](header=header, height=height, width=width, **layout, data=data)


def camera_info_message(
    types: Types, header: Any, K: np.ndarray, size: tuple[int, int], as_sequence: AsSequence = np.asarray
) -> Any:
    """Return a ``CameraInfo`` for images without lens distortion; ``size`` is ``(width, height)``."""
    matrices = {"d": np.zeros(5), "k": K, "r": np.eye(3), "p": np.column_stack([K, np.zeros(3)])}
    numbers: dict[str, Any] = {name: np.asarray(m, np.float64).ravel() for name, m in matrices.items()}
    numbers["d"] = as_sequence(numbers["d"])  # the only one without a fixed length
    if "K" in getattr(types[CAMERA_INFO], "__dataclass_fields__", {}):  # ROS 1
        numbers = {name.upper(): value for name, value in numbers.items()}
    roi = types[REGION](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    shared = {"distortion_model": "plumb_bob", "binning_x": 0, "binning_y": 0, "roi": roi}
    return types[CAMERA_INFO](header=header, height=size[1], width=size[0], **shared, **numbers)


def camera_info_text(info: Any, rectified: bool) -> str:
    """Return a ``CameraInfo`` as a file for ``read_ros``, for rectified or raw images."""
    entries: dict[str, Any] = {"width": info.width, "height": info.height}
    entries |= {"distortion_model": info.distortion_model, "rectified": rectified}
    for key in "DKRP":  # lower case in ROS 2
        entries[key] = np.array(getattr(info, key, getattr(info, key.lower(), ())), float).tolist()
    entries |= {f"binning_{axis}": int(getattr(info, f"binning_{axis}", 0)) for axis in "xy"}
    if (roi := getattr(info, "roi", None)) is not None:  # Foxglove's messages have none
        entries["roi"] = {name: int(getattr(roi, name)) for name in REGION_FIELDS}
    return yaml.safe_dump(entries)


def rig_of_messages(
    left: Any, right: Any, rectified: bool = True, image_size: tuple[int, int] | None = None
) -> Rig:
    """Return the rig of the ``CameraInfo`` of both cameras, for rectified or raw images.

    ``image_size`` is the ``(width, height)`` of the left image. Without it, messages that state a binning are
    taken to describe the images before binning, which is wrong for some drivers.

    Raises:
        InputError: the cameras are not calibrated as a pair.
    """
    # Imported here because they load torch, which bag commands need only once their options are checked.
    from geodiff_plugin.formats.rigs import CameraChoice
    from geodiff_plugin.formats.ros import read_ros

    texts = tuple(camera_info_text(info, rectified) for info in (left, right))
    return read_ros(texts, CameraChoice(image_size=image_size))


def images_of_messages(left: Any, right: Any, name: str = "the topics") -> tuple[np.ndarray, np.ndarray]:
    """Return both images of ``Image`` or ``CompressedImage``, ``(H, W, 3)`` float32 in [0, 1], RGB.

    Raises:
        InputError: an encoding that is not supported, or a truncated image; ``name`` is its source.
    """
    source = Path(name)
    left_01, right_01 = both_as_01([decode_image(each, source) for each in (left, right)], source)
    return left_01, right_01
