"""Reads the two views of a rig from cameras, video files and network streams with OpenCV."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats import Packing, check_file, find_packing

#: Number of failed reads in a row after which a camera or stream counts as gone. Cameras fail now and then,
#: most of all right after they were opened.
MAX_FAILED_READS = 20
#: Seconds between a failed read and the next one.
RETRY_S = 0.05
#: How a source holds both views unless stated otherwise.
SIDE_BY_SIDE = Packing()
#: Frames per second of a video file that does not state them.
DEFAULT_RATE = 30.0


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """Both views of a rig at one moment.

    Attributes:
        left: ``(H, W, 3)`` RGB, uint8 or float in [0, 1].
        right: the same for the right view.
        stamp: anything that identifies the frame, such as the header of a message; kept in the result.
        arrived_s: ``time.perf_counter()`` when the frame arrived, from which latency is measured.
    """

    left: np.ndarray
    right: np.ndarray
    stamp: Any = None
    arrived_s: float = field(default_factory=time.perf_counter)


class CameraSource:
    """Both views from OpenCV: one device, file or stream that holds both, or two of them, left one first.

    Two devices are triggered right after each other, so moving objects need cameras with a common trigger.
    A video file is played at its own rate, like a camera, unless ``realtime`` is false.

    Args:
        sources: numbers of devices, paths of videos, or URLs such as ``rtsp://...``.
        packing: how one source holds both views; ``None`` infers it from the first frame.
        size: ``(width, height)`` of the frames to request from a device.
        realtime: whether to play a video file at its rate.

    Raises:
        InputError: more than two sources, or one that OpenCV cannot open.
    """

    def __init__(
        self,
        sources: Sequence[int | str | Path],
        packing: Packing | None = SIDE_BY_SIDE,
        *,
        size: tuple[int, int] | None = None,
        realtime: bool = True,
    ) -> None:
        if len(sources) not in (1, 2):
            bad_value("source", "one source that holds both views, or two", f"{len(sources)} sources")
        self._names = [str(source) for source in sources]
        self.packing = packing
        self._open = ExitStack()
        self._captures = [self._opened(name, size) for name in self._names]
        is_file = not any(map(_is_live, self._names))
        rate = self._captures[0].get(cv2.CAP_PROP_FPS) or DEFAULT_RATE
        self._interval_s = 1.0 / rate if is_file and realtime else 0.0
        self._is_file = is_file

    def _opened(self, name: str, size: tuple[int, int] | None) -> cv2.VideoCapture:
        """Open one source."""
        if not _is_live(name):
            check_file(Path(name), "--source", "a video file, the number of a camera or the URL of a stream")
        capture = cv2.VideoCapture(int(name) if name.isdigit() else name)
        self._open.callback(capture.release)
        if not capture.isOpened():
            self.close()
            hint = "`v4l2-ctl --list-devices` lists cameras on Linux. Close other programs that use them."
            bad_value("--source", "a camera, a video file or a stream that OpenCV can open", name, hint)
        if name.isdigit():
            capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)  # otherwise frames wait in the driver and are old
            for key, value in zip(
                (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT), size or (), strict=False
            ):
                capture.set(key, value)
        return capture

    def close(self) -> None:
        """Release the devices and files."""
        self._open.close()

    def __iter__(self) -> Iterator[StereoFrame]:
        start = time.perf_counter()
        count = 0
        while self._grab():
            arrived_s = time.perf_counter()
            images = [cv2.cvtColor(capture.retrieve()[1], cv2.COLOR_BGR2RGB) for capture in self._captures]
            left, right = images if len(images) == 2 else self._both_of(images[0])
            yield StereoFrame(left, right, count, arrived_s)
            count += 1
            time.sleep(max(0.0, start + count * self._interval_s - time.perf_counter()))

    def _both_of(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Split a frame that holds both views."""
        if self.packing is None:
            path = None if _is_live(self._names[0]) else Path(self._names[0])
            self.packing = find_packing([image], "--source", path)
        return self.packing.split(image, "--source")

    def _grab(self) -> bool:
        """Take the next frame of all sources at once; ``False`` at the end of a file."""
        for _ in range(1 if self._is_file else MAX_FAILED_READS):
            # All sources are read even if the first fails, so that they stay at the same frame.
            failed = [name for name, each in zip(self._names, self._captures, strict=True) if not each.grab()]
            if not failed:
                return True
            if not self._is_file:
                time.sleep(RETRY_S)
        if not self._is_file:
            hint = "Check the connection, and whether another program uses the camera."
            bad_value("--source", "a camera or stream that delivers frames", f"none from {failed[0]}", hint)
        return False


def _is_live(name: str) -> bool:
    """Whether a source is a device or a network stream, not a file."""
    return name.isdigit() or "://" in name
