"""Frames of a video as images in [0, 1], read by OpenCV."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Self

import numpy as np

from geodiff_plugin._checks import InputFileError, bad_value
from geodiff_plugin.formats.files import check_file

__all__ = ["VIDEOS", "VideoReader", "both_halves", "count_frames", "is_video"]

#: Suffixes of videos.
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


def is_video(path: Path) -> bool:
    """Whether a file is named as a video is."""
    return path.suffix.lower() in VIDEOS


def _open(path: Path, name: str) -> Any:
    import cv2

    capture = cv2.VideoCapture(str(check_file(path, name, "a video file")))
    if not capture.isOpened():
        cure = "Convert it, or extract its frames into a folder."
        bad_value(name, "a video that OpenCV reads", path, cure)
    return capture


def count_frames(path: Path, name: str = "video") -> int:
    """How many frames a video has, by going through it: heads of videos are not to be relied on."""
    capture, count = _open(path, name), 0
    while capture.grab():
        count += 1
    capture.release()
    if count == 0:
        bad_value(name, "a video with frames in it", f"{path}, which has none")
    return count


class VideoReader:
    """Frames of a video file, cheapest in order; a context manager."""

    def __init__(self, path: Path, name: str = "video") -> None:
        self._path, self._name = path, name
        self._capture, self._next = _open(path, name), 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._capture.release()

    def read(self, frame: int) -> np.ndarray:
        """One frame, ``(H, W, 3)`` float32 in [0, 1], RGB, by its number from 0."""
        import cv2

        if frame < self._next:
            self._capture.release()
            self._capture, self._next = _open(self._path, self._name), 0
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
    left, right = np.split(image_01, 2, axis=1)
    return np.ascontiguousarray(left), np.ascontiguousarray(right)
