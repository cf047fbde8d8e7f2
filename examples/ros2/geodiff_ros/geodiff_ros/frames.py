"""Frames of a rig from messages, and messages from their results; needs no ROS."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from geodiff_plugin import LiveFrame, Rig, StereoFrame
from geodiff_plugin.formats.ros_messages import (
    AsSequence,
    Types,
    camera_info_message,
    depth_values,
    image_message,
    images_of_messages,
    rig_of_messages,
    sigma_values,
)
from geodiff_plugin.streaming.newest import Newest

HEADER = "std_msgs/msg/Header"
DIAGNOSTICS, STATUS, KEY_VALUE = (
    f"diagnostic_msgs/msg/{name}" for name in ("DiagnosticArray", "DiagnosticStatus", "KeyValue")
)
#: Levels of ``DiagnosticStatus``.
OK, WARN = b"\x00", b"\x01"


class MessageSource:
    """Frames for ``geodiff_plugin.live`` from messages: the newest pair is next; its header is the stamp."""

    def __init__(self) -> None:
        self._pairs = Newest[tuple[Any, Any]]()
        self._infos: dict[str, Any] = {}
        self._first: tuple[Any, Any] | None = None
        self._is_ready = threading.Event()

    def camera_info(self, side: str, info: Any) -> None:
        """Take the ``CameraInfo`` of ``"left"`` or ``"right"``; only the first one is used."""
        self._infos.setdefault(side, info)
        self._set_ready()

    def images(self, left: Any, right: Any) -> None:
        """Take the images of one moment, in place of a pair that has not been processed yet."""
        self._first = self._first or (left, right)
        self._pairs.put((left, right))
        self._set_ready()

    def _set_ready(self) -> None:
        """Release ``rig`` once both cameras and an image are known."""
        if len(self._infos) == 2 and self._first is not None:
            self._is_ready.set()

    def rig(self, rectified: bool) -> Rig | None:
        """Wait for cameras and images and return the rig; ``None`` if the source was closed before.

        The size of the images shows whether the cameras describe them before or after binning.
        """
        self._is_ready.wait()
        if len(self._infos) < 2 or self._first is None:
            return None
        height, width = images_of_messages(*self._first)[0].shape[:2]
        return rig_of_messages(self._infos["left"], self._infos["right"], rectified, (width, height))

    def close(self) -> None:
        """End the frames."""
        self._is_ready.set()
        self._pairs.close()

    def __iter__(self) -> Iterator[StereoFrame]:
        while (pair := self._pairs.take()) is not None:
            left, right = pair
            yield StereoFrame(*images_of_messages(left, right), stamp=left.header)


@dataclass(frozen=True)
class Results:
    """Makes the messages of a result.

    Attributes:
        types: message classes by full name.
        encoding: ``"32FC1"`` or ``"16UC1"``.
        min_confidence: depths with a lower confidence are unknown.
        max_sigma: depths with a larger standard deviation, metres, are unknown; 0 for any.
        as_sequence: converts an array to the type of a message's sequences.
        as_level: converts a level of ``DiagnosticStatus`` to the type of its field.
    """

    types: Types
    encoding: str = "32FC1"
    min_confidence: float = 0.0
    max_sigma: float = 0.0
    as_sequence: AsSequence = np.asarray
    as_level: Callable[[bytes], Any] = bytes

    def messages(self, frame: LiveFrame) -> dict[str, Any]:
        """Return the messages of a frame by topic, all with the header of its left image."""
        output = frame.output.with_holes(self.min_confidence, self.max_sigma or None)
        header = frame.stamp
        depth_m = output.prediction[0, ..., 0]
        messages = {}
        if output.sigma is not None:
            confidence = frame.output.confidence[0, ..., 0].astype("<f4")
            messages["depth/confidence"] = self._image(header, confidence, "32FC1")
            sigma = sigma_values(output.sigma[0, ..., 0], self.encoding)
            messages["depth/sigma"] = self._image(header, sigma, self.encoding)
        K = np.asarray(output.K)[0].astype(np.float64)
        size = (depth_m.shape[1], depth_m.shape[0])
        return messages | {
            "depth/image": self._image(header, depth_values(depth_m, self.encoding), self.encoding),
            "depth/camera_info": camera_info_message(self.types, header, K, size, self.as_sequence),
            "/diagnostics": self._diagnostics(frame),
        }

    def _image(self, header: Any, values: np.ndarray, encoding: str) -> Any:
        return image_message(self.types, header, values, encoding, self.as_sequence)

    def _diagnostics(self, frame: LiveFrame) -> Any:
        verdict = frame.output.verdict
        entries = {"latency_ms": f"{1000 * frame.latency_s:.0f}", "frame": str(frame.number)}
        entries |= {"checked": str(frame.checked).lower()}
        status = self.types[STATUS](
            level=self.as_level(OK if verdict.trusted else WARN),
            name="geodiff: depth",
            message=f"{verdict.status}: {' '.join(verdict.reasons)}" if verdict.reasons else verdict.status,
            hardware_id="",
            values=[self.types[KEY_VALUE](key=key, value=value) for key, value in entries.items()],
        )
        header = self.types[HEADER](stamp=frame.stamp.stamp, frame_id="")
        return self.types[DIAGNOSTICS](header=header, status=[status])
