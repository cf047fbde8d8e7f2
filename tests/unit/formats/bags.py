"""Bags of ROS with images of both cameras and their camera_info, for tests; needs ``rosbags``."""

from pathlib import Path

import cv2
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_typestore

TOPICS = "/cam0/image_rect", "/cam1/image_rect"
RAW = "/cam0/image_raw", "/cam1/image_raw"
K = np.array([[60.0, 0, 31.5], [0, 61.0, 23.5], [0, 0, 1]])
SIZE = (48, 64)
PINHOLE = {"model": "plumb_bob", "D": np.zeros(5), "R": (np.eye(3), np.eye(3))}


def rgb(number: int, side: int) -> np.ndarray:
    rng = np.random.default_rng(10 * number + side)
    return cv2.resize(rng.integers(0, 255, (6, 8, 3), dtype=np.uint8), SIZE[::-1])


def write_bag(path: Path, topics=TOPICS, encoding: str = "rgb8", images=None, **info) -> Path:
    """A bag with images of both cameras at those seconds, and their camera_info, 0.12 m apart."""
    ros2, info = path.suffix == ".mcap", PINHOLE | {"K": K} | info
    store = get_typestore(Stores.ROS2_HUMBLE if ros2 else Stores.ROS1_NOETIC)
    serialize = store.serialize_cdr if ros2 else store.serialize_ros1
    plugin = {"version": 9, "storage_plugin": rosbag2.StoragePlugin.MCAP}
    folder = path.with_suffix(".folder")
    with rosbag2.Writer(folder, **plugin) if ros2 else rosbag1.Writer(path) as writer:

        def write(topic: str, kind: str, at_ns: int, *values) -> None:
            stamp = store.types["builtin_interfaces/msg/Time"](*divmod(10**12 + at_ns, 10**9))
            header = store.types["std_msgs/msg/Header"](*(() if ros2 else (7,)), stamp, "optical")
            known = [c for c in writer.connections if c.topic == topic]
            kind = f"sensor_msgs/msg/{kind}"
            to = known[0] if known else writer.add_connection(topic, kind, typestore=store)
            writer.write(to, 10**12 + at_ns + 5, serialize(store.types[kind](header, *values), kind))

        for side, topic in enumerate(topics):
            P = np.column_stack([K, (-60.0 * 0.12 * side, 0, 0)])
            matrices = [np.asarray(m, float).ravel() for m in (info["D"], info["K"], info["R"][side], P)]
            window = info.get("roi", (0, 0, 0, 0))  # x, y, height, width
            roi = store.types["sensor_msgs/msg/RegionOfInterest"](*window, False)
            base = topic.removesuffix("/compressed").rpartition("/")[0]
            write(
                f"{base}/camera_info",
                "CameraInfo",
                0,
                *SIZE,
                info["model"],
                *matrices,
                *info.get("binning", (0, 0)),
                roi,
            )
            for number, seconds in enumerate(((0.0, 0.1, 0.2), (0.001, 0.099, 0.35))[side]):
                image, at_ns = rgb(number, side) if images is None else images[side], round(1e9 * seconds)
                if topic.endswith("/compressed"):
                    data = cv2.imencode(".png", image[..., ::-1])[1].ravel()
                    write(topic, "CompressedImage", at_ns, "png", data)
                    continue
                rows = np.pad(image.reshape(len(image), -1).view(np.uint8), ((0, 0), (0, 8)))  # padded
                write(topic, "Image", at_ns, *SIZE, encoding, 0, rows.shape[1], rows.ravel())
    if ros2:
        (folder / f"{folder.name}.mcap").rename(path)
    return path
