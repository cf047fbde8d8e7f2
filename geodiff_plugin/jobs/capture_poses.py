"""Solves the poses of a capture once, stores them in its folder, and scales them according to the options."""

from __future__ import annotations

import zlib
from contextvars import Context
from dataclasses import dataclass, fields
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin._internal.threads import available_cores
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import atomic_path, read_intrinsics
from geodiff_plugin.jobs.capture_frame import maps_of_frame
from geodiff_plugin.jobs.journal import Shard
from geodiff_plugin.jobs.lengths import KnownScale, check_lengths, known_scale
from geodiff_plugin.jobs.notices import collected_warnings, silent
from geodiff_plugin.jobs.options import OF_SCALE, CaptureOptions
from geodiff_plugin.pose.multiview import SolvedCapture

#: File with the solved poses, read again by a resumed run.
POSES_FILE = "poses.npz"
#: Arrays of solved poses that may be missing.
OPTIONAL = ("E_given", "overlays")
#: Errors of numpy for a missing, truncated or other file.
DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, BadZipFile, zlib.error)


def open_capture(options: CaptureOptions) -> Capture:
    """Open the capture of the options, without solving poses."""
    K = None if options.k is None else read_intrinsics(options.k, "--K")
    capture = Capture.open(
        options.path,
        K=K,
        fov=options.fov,
        trajectory=options.trajectory,
        images=options.images,
        mask=options.mask,
    )
    if options.poses == "given" and capture.poses is None:
        bad_value("--poses given", "used with a capture that has poses", f"{options.path} without")
    if "mesh" in options.export and find_spec("open3d") is None:
        bad_value("--export mesh", "used with Open3D installed", "no Open3D", "Run: pip install open3d")
    capture.check_points(options.points, any(getattr(options, way) is not None for way in OF_SCALE))
    check_lengths(capture, options)
    return capture


@dataclass(frozen=True)
class RunKeys:
    """Values that another process needs besides the options: keys of poses and frames, and the scale."""

    poses_key: str
    frames_key: str
    scale: KnownScale | None


def solved_poses(
    capture: Capture, options: CaptureOptions, key: str, scale: KnownScale | None = None
) -> KnownScale | None:
    """Solve for the poses, or load the poses of an earlier run of the same capture; then set the scale.

    Args:
        capture: a capture without solved poses; sets them.
        options: options of the command.
        key: digest of all inputs that the poses depend on.
        scale: scale found by another process; computed here by default.

    Returns:
        The scale given by the options, or ``None``.

    Raises:
        InputError: a shard whose poses are not solved yet, or a length that cannot be measured.
    """
    capture.solved = _load_or_solve(capture, options, key)
    capture.scale_measured = (options.known_length or options.distance) is not None
    if scale is None:
        scale = known_scale(capture, options, partial(maps_of_frame, capture, options))
    if scale is not None:
        capture.rescale(scale.factor)
        if scale.doubt is not None:
            capture.scale_measured = False
            capture.findings.append(scale.doubt)
    return scale


def _load_or_solve(capture: Capture, options: CaptureOptions, key: str) -> SolvedCapture:
    """Load the poses of an earlier run, or solve and store them."""
    path = options.out / POSES_FILE
    shard = Shard.of(options.shard)
    solved = None if options.overwrite and shard.whole else load_solved(path, key)
    if solved is not None:
        return solved
    if not shard.whole:
        problem = "The poses of these frames are not solved yet"
        raise_input_error(f"{problem}. Run geodiff capture with --poses-only first, then the shards.")
    solved = capture.solve(options.poses, threads=available_cores())
    _save_solved(path, solved, key)
    return solved


def _save_solved(path: Path, solved: SolvedCapture, key: str) -> None:
    """Write solved poses as ``.npz``, with the key of their frames and settings."""
    arrays = {f.name: getattr(solved, f.name) for f in fields(solved) if f.name not in ("seen", "findings")}
    for name in OPTIONAL:
        given = getattr(solved, name)
        arrays[name] = np.zeros(0) if given is None else given
    arrays["px"], arrays["point"] = map(np.concatenate, zip(*solved.seen, strict=True))
    arrays["counts"] = np.array([len(points) for _, points in solved.seen])
    arrays["findings"] = np.array([(each.code, each) for each in solved.findings], np.str_).reshape(-1, 2)
    with atomic_path(path) as temporary:
        np.savez_compressed(temporary, key=np.array(key), **arrays)


def load_solved(path: Path, key: str) -> SolvedCapture | None:
    """Read the solved poses of a file; ``None`` if it has none with that key, or is damaged."""
    try:
        # Opened here, because numpy leaves a damaged archive open.
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as archive:
            arrays = dict(archive)
        stored_key = str(arrays.pop("key"))
        return _solved_of_arrays(arrays) if stored_key == key else None
    except DAMAGED:
        return None


def _solved_of_arrays(arrays: dict[str, np.ndarray]) -> SolvedCapture:
    """Return the solved poses of the arrays that ``_save_solved`` writes, without the key."""
    further = dict(arrays)
    ends = np.cumsum(further.pop("counts"))[:-1]
    px_of_frames = np.split(further.pop("px"), ends)
    points_of_frames = np.split(further.pop("point"), ends)
    seen = tuple(zip(px_of_frames, points_of_frames, strict=True))
    findings = tuple(Finding(str(code), str(text)) for code, text in further.pop("findings"))
    values: dict[str, Any] = {}
    for name, array in further.items():
        is_missing = name in OPTIONAL and not array.size
        values[name] = None if is_missing else array.item() if array.ndim == 0 else array
    return SolvedCapture(seen=seen, findings=findings, **values)


def reopened_capture(options: CaptureOptions, keys: RunKeys) -> Capture:
    """Open the capture with its solved poses in another process; do not report findings again."""

    def opened() -> Capture:
        with collected_warnings(silent):
            capture = open_capture(options)
            solved_poses(capture, options, keys.poses_key, keys.scale)
            return capture

    return Context().run(opened)  # outside any ``captured_warnings`` block
