"""The node: topics in, ``geodiff_plugin.live`` in a thread, topics out."""

from __future__ import annotations

import array
import threading
from typing import Any

import numpy as np
import rclpy
import torch
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from message_filters import ApproximateTimeSynchronizer, Subscriber
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, Image, RegionOfInterest
from std_msgs.msg import Header

from geodiff_plugin import InputError, enable_geometry_guidance, live, load_prior
from geodiff_plugin.runtime.machine import pick_device
from geodiff_ros.frames import MessageSource, Results

#: Message classes by full name.
TYPES = {
    f"{package}/msg/{each.__name__}": each
    for package, classes in {
        "sensor_msgs": (Image, CameraInfo, RegionOfInterest),
        "diagnostic_msgs": (DiagnosticArray, DiagnosticStatus, KeyValue),
        "std_msgs": (Header,),
    }.items()
    for each in classes
}
#: Parameters with their defaults, which config/depth.yaml repeats.
PARAMETERS: dict[str, Any] = {
    "prior": "bundled",
    "device": "auto",
    "dtype": "float32",
    "preset": "fast",
    "steps": 0,
    "check_every": 100,
    "encoding": "32FC1",
    "min_confidence": 0.0,
    "max_sigma": 0.0,
    "rectified": True,
    "slop": 0.005,
}
#: Number of messages that wait for their counterpart of the other camera.
QUEUE = 10
OUTPUTS = {
    "depth/image": Image,
    "depth/confidence": Image,
    "depth/sigma": Image,
    "depth/camera_info": CameraInfo,
    "/diagnostics": DiagnosticArray,
}


def as_sequence(values: np.ndarray) -> array.array[Any]:
    """Convert an array to the type that generated messages take without looking at every entry."""
    return array.array(values.dtype.char, values.tobytes())


class DepthNode(Node):
    """Publishes the depth of the newest pair of images."""

    def __init__(self) -> None:
        super().__init__("geodiff_depth")
        self._given = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self._source = MessageSource()
        given = {name: self._given[name] for name in ("encoding", "min_confidence", "max_sigma")}
        self._results = Results(TYPES, **given, as_sequence=as_sequence)
        self._outputs = {topic: self.create_publisher(kind, topic, QUEUE) for topic, kind in OUTPUTS.items()}
        quality = {"qos_profile": qos_profile_sensor_data}
        for side in ("left", "right"):
            self.create_subscription(CameraInfo, f"{side}/camera_info", self._taken(side), **quality)
        views = [Subscriber(self, Image, f"{side}/image", **quality) for side in ("left", "right")]
        self._pairs = ApproximateTimeSynchronizer(views, QUEUE, self._given["slop"])
        self._pairs.registerCallback(self._source.images)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _taken(self, side: str) -> Any:
        return lambda info: self._source.camera_info(side, info)

    def _run(self) -> None:
        """Process frames until the node ends, or log why that is not possible."""
        try:
            self._publish_frames()
        except InputError as error:
            self.get_logger().fatal(str(error))

    def _publish_frames(self) -> None:
        given = self._given
        device = pick_device(given["device"])
        dtype = getattr(torch, given["dtype"])
        pipe = enable_geometry_guidance(load_prior(given["prior"], device, dtype))
        pipe.set_progress_bar_config(disable=True)
        rig = self._source.rig(given["rectified"])
        if rig is None:
            return
        call = {"num_inference_steps": given["steps"]} if given["steps"] else {}
        sharing = {"preset": given["preset"], "check_every": given["check_every"]}
        for frame in live(pipe, self._source, rig, **sharing, **call):
            for topic, message in self._results.messages(frame).items():
                self._outputs[topic].publish(message)

    def destroy_node(self) -> None:
        """End the thread, then the node."""
        self._source.close()
        self._thread.join()
        super().destroy_node()


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = DepthNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
