"""Videos for tests: frames at any times in an MP4 container, as phones record them."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

#: Boxes on the way to the durations of samples (ISO/IEC 14496-12, 8.6.1.2).
PATH = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
#: Units of time per second that are written.
TIMESCALE = 10_000


def write_video(path: Path | str, frames: Iterable[np.ndarray], times: Sequence[float]) -> Path:
    """Write RGB frames ``(H, W, 3)`` uint8 that are shown at increasing ``times`` in seconds, as MP4.

    OpenCV writes them at a constant rate; then the table of durations in the file is replaced.
    """
    path, frames = Path(path), list(frames)
    height, width = frames[0].shape[:2]
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (width, height))
    for frame in frames:
        writer.write(np.ascontiguousarray(frame[..., ::-1]))
    writer.release()
    ticks = np.rint(np.asarray(times) * TIMESCALE).astype(int)
    durations = [*np.diff(ticks).tolist(), int(np.median(np.diff(ticks)))]
    path.write_bytes(_retimed(path.read_bytes(), durations))
    return path


def _retimed(data: bytes, durations: Sequence[int]) -> bytes:
    """Replace the durations of all samples; the index must lie behind the samples, whose offsets it has."""
    boxes = dict(_boxes(data))
    assert list(boxes).index(b"moov") > list(boxes).index(b"mdat")
    return b"".join(_box(kind, _changed(kind, body, durations)) for kind, body in _boxes(data))


def _changed(kind: bytes, body: bytes, durations: Sequence[int]) -> bytes:
    if kind in PATH:
        inner = [(k, b) for k, b in _boxes(body) if k != b"edts"]  # an edit list would cut the longer video
        return b"".join(_box(k, _changed(k, b, durations)) for k, b in inner)
    if kind == b"mdhd":
        assert body[0] == 0  # version with 32 bits per number
        return body[:12] + struct.pack(">II", TIMESCALE, sum(durations)) + body[20:]
    if kind == b"stts":
        entries = b"".join(struct.pack(">II", 1, duration) for duration in durations)
        return struct.pack(">II", 0, len(durations)) + entries
    return body


def _boxes(data: bytes) -> list[tuple[bytes, bytes]]:
    boxes, at = [], 0
    while at < len(data):
        size, kind = struct.unpack_from(">I4s", data, at)
        assert size >= 8
        boxes.append((kind, data[at + 8 : at + size]))
        at += size
    return boxes


def _box(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I4s", len(body) + 8, kind) + body
