"""Videos, read by OpenCV, and bags: of ROS by ``rosbags`` (extra ``ros``), of protobuf by ``foxglove``."""

from __future__ import annotations

import bisect
import os
import struct
import tempfile
from collections.abc import Iterable
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import yaml

from geodiff_plugin._checks import InputError, InputFileError, bad_value, refuse
from geodiff_plugin.formats.bag_images import CODED, DECODE_CODED, both_as_01, decode_image
from geodiff_plugin.formats.depth import depth_mm
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.foxglove import ROS_PROFILES, FoxgloveReader, profile_of

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
BAG_SUFFIXES = (".mcap", ".bag")


def is_video(path: Path) -> bool:
    """Whether a file is named as a video is."""
    return path.suffix.lower() in VIDEOS


def _open_video(path: Path, name: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(check_file(path, name, "a video file")))
    if not capture.isOpened():
        bad_value(name, "a video that OpenCV reads", path, "Convert it, or extract its frames into a folder.")
    return capture


class VideoFacts(NamedTuple):
    """What a video file holds."""

    frames: int
    fps: float  # frames a second
    size: tuple[int, int]  # (width, height)


def video_facts(path: Path, name: str = "video") -> VideoFacts:
    """What a video holds; its frames are counted by going through them, as heads are not reliable."""
    capture, count = _open_video(path, name), 0
    while capture.grab():
        count += 1
    facts = (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    fps, width, height = (capture.get(fact) for fact in facts)
    capture.release()
    if count == 0:
        bad_value(name, "a video with frames in it", f"{path}, which has none")
    return VideoFacts(count, fps or 30.0, (int(width), int(height)))


class VideoReader(AbstractContextManager["VideoReader"]):
    """Frames of a video file, cheapest in order; a context manager."""

    def __init__(self, path: Path, name: str = "video") -> None:
        self._path, self._name = path, name
        self._capture, self._next = _open_video(path, name), 0

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def read(self, frame: int) -> np.ndarray:
        """One frame, ``(H, W, 3)`` float32 in [0, 1], RGB, by its number from 0."""
        if frame < self._next:
            self._capture.release()
            self._capture, self._next = _open_video(self._path, self._name), 0
        while self._next < frame and self._capture.grab():
            self._next += 1
        read, image = self._capture.read() if self._next == frame else (False, None)
        if not read:
            raise InputFileError(f"frame {frame} of {self._path} does not decode.")
        self._next += 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255.0


def both_halves(image_01: np.ndarray, name: str = "video") -> tuple[np.ndarray, np.ndarray]:
    """Left and right view of a frame ``(H, 2 W, 3)`` that has them side by side, left one first."""
    width = image_01.shape[1]
    if width % 2:
        cure = "Or give the right view's video as RIGHT."
        bad_value(name, "both views side by side, so of even width", f"{width} pixels wide", cure)
    left, right = map(np.ascontiguousarray, np.split(image_01, 2, axis=1))
    return left, right


class Stamp(NamedTuple):
    """Time of a message, nanoseconds."""

    header_ns: int  # by its header
    recorded_ns: int


class BagFrame(NamedTuple):
    """Depth of one image of a bag."""

    stamp: Stamp  # of the image
    depth_m: np.ndarray  # (H, W) metres; 0, NaN or less where unknown
    K: np.ndarray  # (3, 3) pixels


def is_bag(path: Path) -> bool:
    """Whether a path is named as a bag is, or is the folder of one."""
    return path.suffix in (*BAG_SUFFIXES, ".db3") or os.path.isfile(path / "metadata.yaml")


def _open_bag(path: Path) -> Any:
    profile = profile_of(path)
    if profile == "ros1":
        cure = "Give the .bag that it was made from, or record it by ROS 2."
        bad_value("LEFT", "a .bag of ROS 1, or an MCAP file of ROS 2", f"{path}, an MCAP file of ROS 1", cure)
    if profile is not None and profile not in ROS_PROFILES:
        return FoxgloveReader(path)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        refuse("Bags are read by rosbags. Run: pip install 'geodiff-plugin[ros]'.")
    return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _connections(reader: Any, path: Path, topic: str) -> list[Any]:
    images = [c for c in reader.connections if c.msgtype.endswith(("/Image", "/CompressedImage"))]
    topics = sorted({connection.topic for connection in images})
    coded = {c.topic: c.msgtype for c in reader.connections if c.msgtype.endswith(CODED)}
    if topic in coded:
        bad_value(topic, "a topic of single images", f"coded video ({coded[topic]})", DECODE_CODED)
    if topic not in topics:
        got = f"{path}, whose images are {', '.join(topics) or 'none'}"
        bad_value(topic, "a topic of images in the bag", got)
    return [connection for connection in images if connection.topic == topic]


def _header_ns(reader: Any, raw: Any) -> int:
    """Nanoseconds in the header, which every message with an image begins with."""
    if isinstance(reader, FoxgloveReader):
        return reader.header_ns(raw)
    layout = "<4xII" if not reader.is2 or raw[1] & 1 else ">4xII"
    seconds, nanoseconds = struct.unpack_from(layout, raw)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


@lru_cache(maxsize=4)
def list_pairs(path: Path, topics: tuple[str, str], tolerance_s: float) -> tuple[tuple[Stamp, Stamp], ...]:
    """The stamps of the images that belong together, each right one to one left one, in order."""
    stamps: list[list[Stamp]] = []
    try:
        with _open_bag(path) as reader:
            for topic in topics:
                messages = reader.messages(_connections(reader, path, topic))
                stamps.append(sorted(Stamp(_header_ns(reader, raw), at) for _, at, raw in messages))
    except InputError:
        raise
    except Exception as error:  # of any kind that a damaged bag leads to
        said = str(error).partition("\n")[0] or type(error).__name__
        bad_value("LEFT", "a whole bag", f"{path} ({said})", "Is it cut off?")
    pairs, free = [], stamps[1]
    for left in stamps[0]:
        at = bisect.bisect(free, left)
        around = free[max(0, at - 1) : at + 1]
        near = min(around, key=lambda right: abs(right.header_ns - left.header_ns), default=None)
        if near is not None and abs(near.header_ns - left.header_ns) <= 1e9 * tolerance_s:
            pairs.append((left, near))
            free.remove(near)
    if not pairs:
        got = f"{len(stamps[0])} and {len(stamps[1])} images, none within {tolerance_s:g} s of each other"
        bad_value("--left, --right", "of images of the same moments", got, "Give a larger --tolerance.")
    return tuple(pairs)


class BagReader(AbstractContextManager["BagReader"]):
    """Both images of the pairs of ``list_pairs``, side by side as in a video; a context manager."""

    def __init__(self, path: Path, topics: tuple[str, str], tolerance_s: float) -> None:
        self._path, self._pairs, self._reader = path, list_pairs(path, topics, tolerance_s), _open_bag(path)
        self._reader.open()
        self._connections = [_connections(self._reader, path, topic) for topic in topics]

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def read(self, frame: int) -> np.ndarray:
        """A pair, ``(H, 2 W, 3)`` float32 in [0, 1], RGB, left one first."""
        images = [self._image(*each) for each in zip(self._connections, self._pairs[frame], strict=True)]
        if images[0].shape != images[1].shape:
            sizes = " and ".join("{1}x{0}".format(*image.shape) for image in images)
            raise InputFileError(f"pair {frame} of {self._path} must be of one size; got {sizes}.")
        return np.hstack(both_as_01(images, self._path))

    def _image(self, connections: list[Any], stamp: Stamp) -> np.ndarray:
        at = stamp.recorded_ns
        for connection, _, raw in self._reader.messages(connections, at, at + 1):
            if _header_ns(self._reader, raw) == stamp.header_ns:
                return decode_image(self._reader.deserialize(raw, connection.msgtype), self._path)
        raise InputFileError(f"the image of {stamp.header_ns} ns in {self._path} does not read.")


def stereo_calibration(path: Path, topics: tuple[str, str]) -> tuple[list[str], str]:
    """The ``camera_info`` beside two topics as files of ``read_ros``, and the left one's ``frame_id``."""
    texts, frames = [], []
    with _open_bag(path) as reader:
        for topic in topics:
            base, _, name = topic.removesuffix("/compressed").rpartition("/")
            infos = [c for c in reader.connections if c.msgtype.endswith("/CameraInfo")]
            named = [c for c in infos if c.topic in (f"{base}/camera_info", f"{base}/calibration")]
            first = next(reader.messages(named), None) if named else None
            if first is None:
                cure = "Give --calib, or the cameras in another way."
                bad_value("calibration", f"in the bag as {base}/camera_info, or given", "neither", cure)
            info = reader.deserialize(first[2], first[0].msgtype)
            entries: dict[str, Any] = {"width": info.width, "height": info.height}
            entries |= {"distortion_model": info.distortion_model, "rectified": "rect" in name}
            for key in "DKRP":  # ROS 2 has them in small letters
                entries[key] = np.array(getattr(info, key, getattr(info, key.lower(), ())), float).tolist()
            texts.append(yaml.safe_dump(entries))
            frames.append(info.header.frame_id)
    return texts, frames[0]


def write_depth_bag(path: Path, frames: Iterable[BagFrame], frame_id: str, encoding: str) -> int:
    """Write ``/depth/image`` and ``/depth/camera_info`` of all frames, whole or not at all; how many.

    ``path`` ends in .mcap (ROS 2) or .bag (ROS 1). ``"16UC1"`` is millimetres, 0 where unknown, ``"32FC1"``
    metres, NaN where unknown.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_ros2, count = path.suffix != ".bag", 0
    store: Any = get_typestore(Stores.ROS2_HUMBLE if is_ros2 else Stores.ROS1_NOETIC)
    plugin: dict[str, Any] = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    kinds = {"/depth/image": "sensor_msgs/msg/Image", "/depth/camera_info": "sensor_msgs/msg/CameraInfo"}
    image_of, camera_of = (store.types[kind] for kind in kinds.values())
    serialize = store.serialize_cdr if is_ros2 else store.serialize_ros1
    roi = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        made = Path(folder) / "depth"
        writer: Any = rosbag2.Writer(made, **plugin) if is_ros2 else rosbag1.Writer(made)
        with writer:
            topics = [writer.add_connection(name, kind, typestore=store) for name, kind in kinds.items()]
            for stamp, depth_m, K in frames:
                count += 1
                time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp.header_ns, 1_000_000_000))
                order = {} if is_ros2 else {"seq": 0}
                header = store.types["std_msgs/msg/Header"](**order, stamp=time, frame_id=frame_id)
                values = np.where(depth_m > 0, depth_m, np.nan).astype("<f4")
                values = depth_mm(values) if encoding == "16UC1" else values
                size, data = values.shape, np.ascontiguousarray(values).view(np.uint8).ravel()
                image = image_of(header, *size, encoding, 0, values.strides[0], data)
                P = np.column_stack([K, np.zeros(3)])
                matrices = [m.astype(np.float64).ravel() for m in (np.zeros(5), K, np.eye(3), P)]
                camera = camera_of(header, *size, "plumb_bob", *matrices, 0, 0, roi)
                for topic, message in zip(topics, (image, camera), strict=True):
                    writer.write(topic, stamp.recorded_ns, serialize(message, message.__msgtype__))
        os.replace(made / "depth.mcap" if is_ros2 else made, path)
    return count
