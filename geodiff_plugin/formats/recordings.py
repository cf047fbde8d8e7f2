"""Reads videos with OpenCV, and bags: ROS with ``rosbags`` (extra ``ros``), protobuf with ``foxglove``."""

from __future__ import annotations

import bisect
import os
import struct
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from geodiff_plugin._internal.checks import InputError, InputFileError, bad_value, raise_input_error
from geodiff_plugin.formats.bag_images import CODED, DECODE_CODED, both_as_01, decode_image
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.foxglove import ROS_PROFILES, FoxgloveReader, profile_of
from geodiff_plugin.formats.ros_messages import (
    CAMERA_INFO,
    IMAGE,
    camera_info_message,
    camera_info_text,
    depth_values,
    image_message,
    sigma_values,
)

VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
BAG_SUFFIXES = (".mcap", ".bag")


def is_video(path: Path) -> bool:
    """Whether a file has the suffix of a video."""
    return path.suffix.lower() in VIDEOS


def _open_video(path: Path, name: str) -> cv2.VideoCapture:
    capture = cv2.VideoCapture(str(check_file(path, name, "a video file")))
    if not capture.isOpened():
        bad_value(
            name, "a video that OpenCV can read", path, "Convert it, or extract its frames into a folder."
        )
    return capture


class EndOfRecordingError(InputFileError):
    """A frame after the last one of a video or bag."""


class VideoFacts(NamedTuple):
    """Number, rate, size and times of a video's frames."""

    frames: int
    fps: float  # mean, frames per second
    size: tuple[int, int]  # (width, height)
    times: tuple[float, ...]  # seconds of every frame from the first one


#: Deviation of container times from a constant rate that is due to rounding, seconds.
ROUNDED_TIME_S = 0.0015


def video_facts(
    path: Path, name: str = "video", see: Callable[[float, np.ndarray], bool] | None = None
) -> VideoFacts:
    """Return facts of a video; counts frames by decoding, because headers are unreliable.

    Calls ``see`` with the time in seconds and BGR pixels ``(H, W, 3)`` uint8 of each frame, until it returns
    ``False``. Phones record at a variable rate, so the times are those in the container.
    """
    capture = _open_video(path, name)
    times = list[float]()
    while capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0)
        if see is not None and not see(times[-1], capture.retrieve()[1]):
            see = None
    facts = (cv2.CAP_PROP_FPS, cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)
    fps, width, height = (capture.get(fact) for fact in facts)
    capture.release()
    if not times:
        bad_value(name, "a video with frames", f"{path}, which has none")
    fps = fps or 30.0
    return VideoFacts(len(times), fps, (int(width), int(height)), _frame_times(times, fps))


def _frame_times(times: Sequence[float], fps: float) -> tuple[float, ...]:
    """Return the times in seconds from the first frame; at a constant rate, without rounding.

    Some backends of OpenCV report no times. Then the rate is taken as constant.
    """
    given = np.asarray(times) - times[0]
    even = np.arange(len(times)) / fps
    if not (np.diff(given) > 0).all() or np.abs(given - even).max() < ROUNDED_TIME_S:
        return tuple(even.tolist())
    return tuple(given.tolist())


class VideoReader(AbstractContextManager["VideoReader"]):
    """Reads frames of a video file, fastest in order; a context manager."""

    def __init__(self, path: Path, name: str = "video") -> None:
        self._path, self._name = path, name
        self._capture = _open_video(path, name)
        self._next = 0

    def __exit__(self, *_: object) -> None:
        self._capture.release()

    def read(self, frame: int) -> np.ndarray:
        """Read one frame by number from 0, ``(H, W, 3)`` float32 in [0, 1], RGB."""
        if frame < self._next:
            self._capture.release()
            self._capture = _open_video(self._path, self._name)
            self._next = 0
        while self._next < frame and self._capture.grab():
            self._next += 1
        read, image = self._capture.read() if self._next == frame else (False, None)
        if not read:
            # OpenCV does not distinguish the end of a video from damage.
            raise EndOfRecordingError(f"frame {frame} of {self._path} cannot be decoded.")
        self._next += 1
        return cv2.cvtColor(image, cv2.COLOR_BGR2RGB).astype(np.float32) / 255.0


def sample_frames(path: Path, count: int, samples: int) -> list[np.ndarray]:
    """Read up to ``samples`` of a video's ``count`` frames, evenly spread, ``(H, W, 3)`` uint8 RGB.

    Seeks, which is fast but may return a neighbouring frame.
    """
    capture = _open_video(path, "video")
    images = []
    for k in range(samples):
        capture.set(cv2.CAP_PROP_POS_FRAMES, (2 * k + 1) * count // (2 * samples))
        read, image = capture.read()
        images += [cv2.cvtColor(image, cv2.COLOR_BGR2RGB)] if read else []
    capture.release()
    return images or [np.rint(VideoReader(path).read(0) * 255).astype(np.uint8)]


class Stamp(NamedTuple):
    """Times of a message in nanoseconds."""

    header_ns: int  # in its header
    recorded_ns: int


class BagFrame(NamedTuple):
    """Depth of one image of a bag."""

    stamp: Stamp  # stamp of the image
    depth_m: np.ndarray  # (H, W) metres; unknown where 0, negative or NaN
    K: np.ndarray  # (3, 3) pixels
    sigma_m: np.ndarray | None = None  # (H, W) standard deviation of the depth, metres


def is_bag(path: Path) -> bool:
    """Whether a path has the suffix of a bag, or is the folder of one."""
    return path.suffix in (*BAG_SUFFIXES, ".db3") or os.path.isfile(path / "metadata.yaml")


def _open_bag(path: Path) -> Any:
    profile = profile_of(path)
    if profile == "ros1":
        hint = "Pass the original .bag, or record with ROS 2."
        bad_value("LEFT", "a .bag of ROS 1, or an MCAP file of ROS 2", f"{path}, an MCAP file of ROS 1", hint)
    if profile is not None and profile not in ROS_PROFILES:
        return FoxgloveReader(path)
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ImportError:
        raise_input_error("Reading bags needs rosbags. Install it with: pip install 'geodiff-plugin[ros]'.")
    return AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))


def _connections(reader: Any, path: Path, topic: str) -> list[Any]:
    images = [c for c in reader.connections if c.msgtype.endswith(("/Image", "/CompressedImage"))]
    topics = sorted({connection.topic for connection in images})
    coded = {c.topic: c.msgtype for c in reader.connections if c.msgtype.endswith(CODED)}
    if topic in coded:
        bad_value(topic, "a topic of single images", f"compressed video ({coded[topic]})", DECODE_CODED)
    if topic not in topics:
        got = f"{path}, whose images are {', '.join(topics) or 'none'}"
        bad_value(topic, "a topic of images in the bag", got)
    return [connection for connection in images if connection.topic == topic]


def _header_ns(reader: Any, raw: Any) -> int:
    """Return nanoseconds in the header, the first entry of every message with an image."""
    if isinstance(reader, FoxgloveReader):
        return reader.header_ns(raw)
    layout = "<4xII" if not reader.is2 or raw[1] & 1 else ">4xII"
    seconds, nanoseconds = struct.unpack_from(layout, raw)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


@lru_cache(maxsize=4)
def list_pairs(path: Path, topics: tuple[str, str], tolerance_s: float) -> tuple[tuple[Stamp, Stamp], ...]:
    """Return the stamps of both images of every pair, in order (``_simultaneous``)."""
    stamps: list[list[Stamp]] = []
    try:
        with _open_bag(path) as reader:
            for topic in topics:
                messages = reader.messages(_connections(reader, path, topic))
                stamps.append(sorted(Stamp(_header_ns(reader, raw), at) for _, at, raw in messages))
    except InputError:
        raise
    except Exception as error:  # any error that a damaged bag may cause
        reason = str(error).partition("\n")[0] or type(error).__name__
        bad_value("LEFT", "a whole bag", f"{path} ({reason})", "It may be truncated.")
    pairs = _simultaneous(stamps[0], stamps[1], tolerance_s)
    if not pairs:
        got = f"{len(stamps[0])} and {len(stamps[1])} images, none within {tolerance_s:g} s of each other"
        bad_value(
            "--left-topic, --right-topic", "topics of simultaneous images", got, "Pass a larger --tolerance."
        )
    return tuple(pairs)


def _simultaneous(lefts: list[Stamp], rights: list[Stamp], tolerance_s: float) -> list[tuple[Stamp, Stamp]]:
    """Return pairs of images that are each other's nearest in time, within a tolerance of their headers.

    Both lists are sorted. If one camera lost a frame, the other's frame is left out.
    """
    pairs = []
    for left in lefts:
        right = _nearest(rights, left)
        if right is None or abs(right.header_ns - left.header_ns) > 1e9 * tolerance_s:
            continue
        if _nearest(lefts, right) == left:
            pairs.append((left, right))
    return pairs


def _nearest(stamps: list[Stamp], to: Stamp) -> Stamp | None:
    """Return the nearest stamp by header, or by recording time if headers are equal; ``None`` if none."""

    def distance(stamp: Stamp) -> tuple[int, int]:
        return abs(stamp.header_ns - to.header_ns), abs(stamp.recorded_ns - to.recorded_ns)

    at = bisect.bisect(stamps, to)
    return min(stamps[max(0, at - 1) : at + 1], key=distance, default=None)


class BagReader(AbstractContextManager["BagReader"]):
    """Reads both images of the pairs of ``list_pairs``, side by side as in a video; a context manager."""

    def __init__(self, path: Path, topics: tuple[str, str], tolerance_s: float) -> None:
        self._path = path
        self._pairs = list_pairs(path, topics, tolerance_s)
        self._reader = _open_bag(path)
        self._reader.open()
        self._connections = [_connections(self._reader, path, topic) for topic in topics]

    def __exit__(self, *_: object) -> None:
        self._reader.close()

    def read(self, frame: int) -> np.ndarray:
        """Read a pair, ``(H, 2 W, 3)`` float32 in [0, 1], RGB, left view first."""
        if frame >= len(self._pairs):
            raise EndOfRecordingError(f"{self._path} has no pair {frame}.")
        images = [self._image(*each) for each in zip(self._connections, self._pairs[frame], strict=True)]
        if images[0].shape != images[1].shape:
            sizes = " and ".join("{1}x{0}".format(*image.shape) for image in images)
            raise InputFileError(f"pair {frame} of {self._path} must have equal sizes; got {sizes}.")
        return np.hstack(both_as_01(images, self._path))

    def _image(self, connections: list[Any], stamp: Stamp) -> np.ndarray:
        at = stamp.recorded_ns
        for connection, _, raw in self._reader.messages(connections, at, at + 1):
            if _header_ns(self._reader, raw) == stamp.header_ns:
                try:
                    message = self._reader.deserialize(raw, connection.msgtype)
                except Exception as error:  # any error that a damaged message may cause
                    reason = str(error).partition("\n")[0] or type(error).__name__
                    raise InputFileError(f"a message of {self._path} cannot be read ({reason}).") from None
                return decode_image(message, self._path)
        raise InputFileError(f"the image of {stamp.header_ns} ns in {self._path} cannot be read.")


def stereo_calibration(path: Path, topics: tuple[str, str]) -> tuple[list[str], str]:
    """Return the ``camera_info`` of two topics as files for ``read_ros``, and the left ``frame_id``."""
    texts, frames = [], []
    with _open_bag(path) as reader:
        for topic in topics:
            base, _, name = topic.removesuffix("/compressed").rpartition("/")
            infos = [c for c in reader.connections if c.msgtype.endswith("/CameraInfo")]
            named = [c for c in infos if c.topic in (f"{base}/camera_info", f"{base}/calibration")]
            first = next(reader.messages(named), None) if named else None
            if first is None:
                hint = "Pass --calib or other camera options."
                bad_value("calibration", f"in the bag as {base}/camera_info, or an option", "neither", hint)
            info = reader.deserialize(first[2], first[0].msgtype)
            texts.append(camera_info_text(info, "rect" in name))
            frames.append(info.header.frame_id)
    return texts, frames[0]


#: Topics of a depth bag and their message types.
DEPTH_TOPICS = {"/depth/image": IMAGE, "/depth/camera_info": CAMERA_INFO, "/depth/sigma": IMAGE}


def write_depth_bag(path: Path, frames: Iterable[BagFrame], frame_id: str, encoding: str) -> int:
    """Write ``/depth/image``, ``/depth/camera_info`` and ``/depth/sigma`` of all frames; return their number.

    ``path`` ends in .mcap (ROS 2) or .bag (ROS 1). ``"16UC1"`` is millimetres, 0 where unknown, ``"32FC1"``
    metres, NaN where unknown. Standard deviations have the same encoding (``sigma_mm``); frames without them
    have no ``/depth/sigma``.
    """
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    is_ros2 = path.suffix != ".bag"
    count = 0
    store: Any = get_typestore(Stores.ROS2_HUMBLE if is_ros2 else Stores.ROS1_NOETIC)
    plugin: dict[str, Any] = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    serialize = store.serialize_cdr if is_ros2 else store.serialize_ros1
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.name}.") as folder:
        made = Path(folder) / "depth"
        topics = dict[str, Any]()
        writer: Any = rosbag2.Writer(made, **plugin) if is_ros2 else rosbag1.Writer(made)
        with writer:
            for frame in frames:
                count += 1
                for name, message in _depth_messages(store.types, frame, frame_id, encoding).items():
                    if name not in topics:
                        topics[name] = writer.add_connection(name, DEPTH_TOPICS[name], typestore=store)
                    data = serialize(message, message.__msgtype__)
                    writer.write(topics[name], frame.stamp.recorded_ns, data)
        os.replace(made / "depth.mcap" if is_ros2 else made, path)
    return count


def _depth_messages(types: Any, frame: BagFrame, frame_id: str, encoding: str) -> dict[str, Any]:
    """Return the messages of a frame by topic, all with the stamp of its image."""
    time = types["builtin_interfaces/msg/Time"](*divmod(frame.stamp.header_ns, 1_000_000_000))
    header_of = types["std_msgs/msg/Header"]
    order = {"seq": 0} if "seq" in header_of.__dataclass_fields__ else {}  # ROS 1 only
    header = header_of(**order, stamp=time, frame_id=frame_id)
    images = {"/depth/image": depth_values(frame.depth_m, encoding)}
    if frame.sigma_m is not None:
        images["/depth/sigma"] = sigma_values(frame.sigma_m, encoding)
    messages = {name: image_message(types, header, each, encoding) for name, each in images.items()}
    size = frame.depth_m.shape[::-1]
    return messages | {"/depth/camera_info": camera_info_message(types, header, frame.K, size)}
