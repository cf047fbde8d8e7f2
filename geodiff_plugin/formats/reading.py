"""Reads calibration files, whose formats are recognised from their content (S3.3)."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np

from geodiff_plugin._internal.checks import UnknownFormatError, bad_type, bad_value, warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import colmap, spatial, storage
from geodiff_plugin.formats.calibrations import CALIBRATION_FORMATS
from geodiff_plugin.formats.files import PathLike
from geodiff_plugin.formats.rigs import CalibrationFormat, CameraChoice, reading_file, with_baseline
from geodiff_plugin.formats.unread import raise_unread_calibration
from geodiff_plugin.types import Rig


def _texts(path: PathLike | Sequence[PathLike]) -> dict[Path, str]:
    """Return the text of each file; for a COLMAP model, which may be a folder, the texts of its two files."""
    paths = (path,) if isinstance(path, (str, os.PathLike)) else path
    if not isinstance(paths, (tuple, list)) or not all(isinstance(p, (str, os.PathLike)) for p in paths):
        bad_type("calibration", "a path, or a pair of paths (left, right)", path)
    if len(paths) == 1 and os.path.isdir(paths[0]):
        folder = Path(paths[0])
        if not (model := colmap.model_files(folder)) and (text := storage.text_of_arrays(folder)):
            return {folder: text}
        paths = model or paths
    for file in paths:
        raise_unread_calibration(Path(file))
    return {Path(file): _text(Path(file)) for file in paths}


def _text(file: Path) -> str:
    """Return the text of a calibration; converts an archive of matrices and a spatial photo to JSON."""
    if file.suffix.lower() in spatial.SUFFIXES and file.is_file():
        return spatial.text_of_spatial_photo(file)
    is_npz = file.suffix.lower() == ".npz" and file.is_file()
    return storage.text_of_npz(file) if is_npz else colmap.calibration_text(file)


def _format_of(texts: dict[Path, str], is_alone: bool = False) -> CalibrationFormat:
    """Return the common format of all files; raise an error if their number does not fit it.

    ``is_alone`` states that there may be a left image only.
    """
    names = set()
    for path, text in texts.items():
        fits = [name for name, each in CALIBRATION_FORMATS.items() if re.search(each.mark, text, re.M)]
        if not fits:
            expected = f"in a known format ({', '.join(CALIBRATION_FORMATS)})"
            hint = "Check the file, or pass fx, fy, cx, cy and baseline, or K and E."
            got = f"{path}, in a different format"
            bad_value("calibration", expected, got, hint, UnknownFormatError)
        names.add(fits[0])
    if len(names) != 1:
        bad_value("calibration", "files of the same format", " and ".join(sorted(names)) or "none")
    entry = CALIBRATION_FORMATS[names.pop()]
    if len(texts) not in entry.file_counts and not (is_alone and entry.one_is_enough and len(texts) == 1):
        _raise_file_count(entry, list(texts))
    return entry


def _raise_file_count(entry: CalibrationFormat, files: list[Path]) -> NoReturn:
    """Raise an error for a number of files that does not fit their format."""
    counts = " or ".join(map(str, entry.file_counts))
    noun = "file" if entry.file_counts == (1,) else "files"
    both = "Pass both: --calib twice, for the left and the right view (in Python, two paths)."
    once = "Pass a file of both cameras once; for single-camera files pass K and E of the pair."
    expected = f"{counts} {noun} of this format, {entry.summary}"
    got = f"{len(files)}, {' and '.join(map(str, files))}"
    hint, code = (both, "calibration.one-camera") if len(files) == 1 else (once, "")
    bad_value("calibration", expected, got, hint, code=code)


def _with_companions(entry: CalibrationFormat, texts: dict[Path, str]) -> tuple[str, ...]:
    """Return the texts, including files that the first one names in its folder."""
    if entry.companions is None:
        return tuple(texts.values())
    (file, text), *_ = texts.items()
    return (*texts.values(), *(_text(file.parent / Path(name).name) for name in entry.companions(text)))


def _in_metres(rig: Rig, baseline_m: float | None, by_image: bool) -> Rig:
    """Scale the rig to the baseline ``baseline_m``; warn if its unit is unknown."""
    if baseline_m is None:
        if not by_image:
            return rig
        hint = "Pass the measured camera distance as baseline_m (--baseline) to get metres."
        sentence = f"{rig.source} has no unit, so depth is in the model's unit. {hint}"
        warn(Finding("calibration.no-unit", sentence), stacklevel=3)
        return replace(rig, unit=None, measured=False)
    return with_baseline(rig, baseline_m)


def read_calibration(
    path: PathLike | Sequence[PathLike],
    cameras: tuple[int, int] | None = None,
    image_folder_hint: str | None = None,
    *,
    image_names: tuple[str, str] | None = None,
    image_size: tuple[int, int] | None = None,
    baseline_m: float | None = None,
    distorted: bool = False,
    is_alone: bool = False,
) -> Rig:
    """Read a calibration file of any supported format.

    Args:
        path: one file, a pair (left, right) for formats with one file per view, or the folder of a COLMAP
            model.
        cameras: both cameras in a file of many (KITTI, Kalibr, OAK-D); by default from the folder, then the
            file.
        image_folder_hint: name or path of the left image's folder (or of the image): ``image_2`` means 2, 3.
        image_names: names or paths of both images in a COLMAP model or transforms.json.
        image_size: ``(width, height)`` of the left image, for files with several resolutions (ZED,
            RealSense), of the whole sensor (OAK-D), or without one (NeRF's transforms.json).
        baseline_m: measured distance between the cameras in metres; replaces the file's.
        distorted: whether the caller removes lens distortion from the images (``Camera.lens``).
        is_alone: whether there is only a left image, for which one ROS ``camera_info`` is enough. Both
            cameras of the rig are then the same.

    Returns:
        The rig: K in pixels of the images that the file is for, E in metres. A right camera 0.12 m to the
        right of the left one has ``E[0, 3] == +0.12``.

    Raises:
        OSError, TypeError: unreadable file (FileNotFoundError: missing file), or no path.
        ValueError: unknown or truncated format, missing cameras, or lens distortion unless ``distorted``.
    """
    texts = _texts(path)
    entry = _format_of(texts, is_alone)
    source = " and ".join(map(str, texts))
    if cameras is not None and not entry.uses_cameras:
        bad_value("cameras", "omitted for a file of two cameras", cameras, "It selects among more than two.")
    choice = CameraChoice(cameras, image_folder_hint, image_names, image_size, baseline_m, is_alone)
    other = "It may be from a different program, or describe a single camera."
    with reading_file(source, entry.summary, *texts.values(), hint=other):
        rig = replace(entry.read(_with_companions(entry, texts), choice), source=source)
    for side, lens in (("left", rig.left.lens), ("right", rig.right.lens)):
        if lens is not None and not distorted:
            hint = "Undistort or rectify both images and pass P1 and P2 of the result, or use geodiff depth."
            got = f"{lens.model} {np.array2string(lens.coefficients, precision=4, separator=', ')}"
            name = f"Lens distortion of the {side} camera in {source}"
            bad_value(name, "zero (images of a pinhole camera)", got, hint)
    return _in_metres(rig, baseline_m, entry.by_image)


def is_as_stored(path: PathLike | Sequence[PathLike]) -> bool:
    """Whether a calibration refers to pixels as stored, before EXIF orientation."""
    return _format_of(_texts(path), is_alone=True).as_stored


def has_pose_per_image(path: PathLike | Sequence[PathLike]) -> bool:
    """Whether a calibration (as in ``read_calibration``) has different poses for each pair of images."""
    return _format_of(_texts(path)).by_image
