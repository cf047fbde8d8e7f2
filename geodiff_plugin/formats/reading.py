"""Reading of calibration files: the table of formats, recognised from their content (S3.3)."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import FolderError, InputError, bad_type, bad_value, check_number, refuse, warn
from geodiff_plugin.formats import benchmarks, devices, nerf, opencv, robots
from geodiff_plugin.formats.colmap import COLMAP, model_files, model_text
from geodiff_plugin.formats.files import check_file, read_text
from geodiff_plugin.formats.rigs import CalibrationFormat, CameraChoice, check_no_distortion, make_rig
from geodiff_plugin.types import Rig

__all__ = ["CALIBRATION_FORMATS", "has_pose_per_image", "read_calibration"]


def _line(pattern: str) -> Callable[[str], object]:
    """Whether a line of a text begins so."""
    return re.compile(rf"^{pattern}", re.MULTILINE).search


def _json(*keys: str) -> Callable[[str], object]:
    """Whether a text is JSON that has these keys."""
    return lambda text: text.lstrip().startswith(("{", "[")) and all(f'"{key}"' in text for key in keys)


_OPENCV = re.compile('!!opencv-matrix|<opencv_storage|"opencv-matrix"').search
#: Every format by name. The first that recognises a file reads it: formats that others contain come first.
CALIBRATION_FORMATS: dict[str, CalibrationFormat] = {
    "middlebury": CalibrationFormat(
        "Middlebury or ETH3D calib.txt (cam0=[...])", _line(r"\s*cam0\s*=\s*\["), benchmarks.read_middlebury
    ),
    "kitti_cam_to_cam": CalibrationFormat(
        "KITTI (P_rect_02: ...)", _line(r"\s*P_rect_\d+\s*:"), benchmarks.read_kitti, uses_cameras=True
    ),
    # The number behind the colon keeps OpenCV's "P1: !!opencv-matrix" out.
    "kitti_projections": CalibrationFormat(
        "KITTI (P0: ...)", _line(r"\s*P[0-3]\s*:\s*[-+.\d]"), benchmarks.read_kitti, uses_cameras=True
    ),
    "foundation_stereo": CalibrationFormat(
        "K.txt of FoundationStereo (9 numbers, baseline)",
        re.compile(r"(?:[-+.\de\s,]|nan|inf)+", re.IGNORECASE).fullmatch,
        benchmarks.read_foundation_stereo,
    ),
    "booster": CalibrationFormat(
        "Booster xml (proj_matL)", re.compile("<opencv_st(?s:.*)proj_matL").search, benchmarks.read_booster
    ),
    "mvsnet": CalibrationFormat(
        "a pair of MVSNet cam.txt (extrinsic)", _line(r"\s*extrinsic\s*$"), benchmarks.read_mvsnet, (2,)
    ),
    "zed": CalibrationFormat(
        "ZED SN*.conf ([LEFT_CAM_HD])", _line(r"\s*\[(LEFT|RIGHT)_CAM_\w+\]"), devices.read_zed
    ),
    "realsense": CalibrationFormat(
        "RealSense (rs-enumerate-devices -c, or rs2 as JSON)",
        lambda text: devices.RS_PRINTED.search(text) or _json("ppx")(text),
        devices.read_realsense,
    ),
    "oak": CalibrationFormat(
        "OAK-D JSON (cameraData)", _json("cameraData"), devices.read_oak, uses_cameras=True
    ),
    "nerf": CalibrationFormat(
        "transforms.json of nerfstudio or instant-ngp (frames, transform_matrix)",
        _json("frames", "transform_matrix"),
        nerf.read_nerf,
        has_unit=False,
        by_image=True,
    ),
    "kalibr": CalibrationFormat(
        "Kalibr camchain.yaml (cam0)", _line(r"cam\d+:\s*(?:#.*)?$"), robots.read_kalibr, uses_cameras=True
    ),
    "euroc": CalibrationFormat(
        "a pair of EuRoC sensor.yaml (T_BS)", _line(r"T_BS\s*:"), robots.read_euroc, (2,)
    ),
    # Older settings describe the rectification too, and OpenCV's reader has these names.
    "orb_slam": CalibrationFormat(
        "ORB-SLAM's stereo settings (Camera1.fx, Camera.bf)",
        re.compile(r"(?ms)\A(?!.*^LEFT\.P[ \t]*:).*^(?:Camera1?\.fx|Camera\.bf)[ \t]*:").search,
        robots.read_orb_slam,
    ),
    "opencv": CalibrationFormat(
        "OpenCV YAML, XML or JSON (P1, P2, or M1, M2, R, T)", _OPENCV, opencv.read_opencv, (1, 2)
    ),
    "ros": CalibrationFormat(
        "a pair of ROS camera_info (projection_matrix)",
        _line(r"(projection_matrix|distortion_model|rectification_matrix)\s*:"),
        robots.read_ros,
        (2,),
    ),
    "stereodemo": CalibrationFormat("stereodemo JSON (fx)", _json("fx"), benchmarks.read_stereodemo),
    "colmap": COLMAP,
}

PathLike = str | os.PathLike[str]

#: What a reader that takes a whole file for granted raises on one that is not.
UNFINISHED = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError)


def _texts(path: PathLike | Sequence[PathLike]) -> dict[Path, str]:
    """The text of each file; of a COLMAP model, the one calibration that may be a folder, of two."""
    paths = (path,) if isinstance(path, (str, os.PathLike)) else path
    if not isinstance(paths, (tuple, list)) or not all(isinstance(p, (str, os.PathLike)) for p in paths):
        bad_type("calibration", "a path, or a pair of paths (left, right)", path)
    if len(paths) not in (1, 2):
        bad_value("calibration", "one file, or a pair (left, right)", f"{len(paths)} files")
    if len(paths) == 1 and os.path.isdir(paths[0]):
        files = model_files(Path(paths[0]))
        if files is None:
            raise FolderError(
                "calibration must be a calibration file, or the folder of a COLMAP model with its cameras "
                f"and images (.txt or .bin); got the folder {paths[0]}. Name the file inside it."
            )
        paths = files
    return {Path(p): _text(Path(p)) for p in paths}


def _text(path: Path) -> str:
    text = model_text(check_file(path, "calibration", "a calibration file"))
    return read_text(path, "calibration", "a calibration file") if text is None else text


def _recognise(text: str, path: Path) -> str:
    name = next((name for name, entry in CALIBRATION_FORMATS.items() if entry.matches(text)), None)
    if name is None:
        formats = "; ".join(entry.summary for entry in CALIBRATION_FORMATS.values())
        cure = "Is this the right file? Otherwise give fx, fy, cx, cy and baseline, or K and E."
        bad_value("calibration", f"in a known format ({formats})", f"{path}, which is none of them", cure)
    return name


def _one_format(texts: dict[Path, str]) -> str:
    """The name of the format that all files have, as many as it needs."""
    names = [_recognise(text, path) for path, text in texts.items()]
    if len(set(names)) > 1:
        bad_value("calibration", "two files of one format", " and ".join(names))
    calibration = CALIBRATION_FORMATS[names[0]]
    if len(texts) not in calibration.file_counts:
        count, cure = "one file", "It describes both cameras; give it once."
        if len(texts) == 1:
            count, cure = "two files", "Give --calib twice, for the left and the right view."
        got = " and ".join(map(str, texts))
        bad_value("calibration", f"{count} ({calibration.summary})", got, cure)
    return names[0]


def _read(texts: dict[Path, str], calibration: CalibrationFormat, choice: CameraChoice) -> Rig:
    """The rig of files of one format; whatever is wrong in them becomes a sentence with their names."""
    source = " and ".join(map(str, texts))
    try:
        raw = calibration.read(tuple(texts.values()), choice)
        rig = make_rig(raw, source)
    except InputError as error:
        refuse(f"{source}: {error}")
    except UNFINISHED as error:
        said = str(error).partition("\n")[0] or "other entries"
        got = f"no {error}" if isinstance(error, KeyError) else said
        bad_value(source, f"a whole {calibration.summary}", got, "Is the file cut off?")
    for note in raw.notes:
        warn(f"{source}: {note}", stacklevel=3)
    return rig


def _check_cameras(cameras: tuple[int, int] | None, calibration: CalibrationFormat) -> None:
    if cameras is None:
        return
    if not calibration.uses_cameras:
        bad_value("cameras", "left out for a file of two cameras", cameras, "It chooses among more than two.")
    pair = isinstance(cameras, (tuple, list)) and len(cameras) == 2
    if not pair or not all(type(camera) is int for camera in cameras):
        bad_value("cameras", "a pair of camera numbers, as (2, 3)", repr(cameras))


def _in_metres(rig: Rig, baseline_m: float | None, has_unit: bool) -> Rig:
    """The rig with its cameras ``baseline_m`` apart; a warning where nothing says what its unit is."""
    if baseline_m is None:
        if has_unit:
            return rig
        warn(
            f"{rig.source} has no unit: depth comes out in the model's own. Give the measured "
            "distance of the two cameras as baseline_m (--baseline) to get metres.",
            stacklevel=3,
        )
        return replace(rig, unit=None, measured=False)
    check_number(baseline_m, "baseline_m", float(np.finfo(np.float64).tiny), 1e9)
    length = float(np.linalg.norm(rig.E[:3, 3]))
    if length == 0:
        cure = "Both its cameras are at one place."
        bad_value("baseline_m", f"left out for {rig.source}", baseline_m, cure)
    E = rig.E.copy()
    E[:3, 3] *= baseline_m / length
    return replace(rig, E=E)


def read_calibration(
    path: PathLike | Sequence[PathLike],
    cameras: tuple[int, int] | None = None,
    image_folder_hint: str | None = None,
    *,
    image_names: tuple[str, str] | None = None,
    image_size: tuple[int, int] | None = None,
    baseline_m: float | None = None,
    distorted: bool = False,
) -> Rig:
    """Read a calibration file, whatever its format.

    Args:
        path: one file, a pair (left, right) for formats with one a view, or the folder of a COLMAP model.
        cameras: left and right camera of a file of many (KITTI, Kalibr, OAK-D); ``None`` goes by the folder,
            then by the file.
        image_folder_hint: name or path of the left image's folder (or of the image): ``image_2`` means 2, 3.
        image_names: names or paths of both images, by which a COLMAP model or a transforms.json knows them.
        image_size: ``(width, height)`` of the left image, for files with several resolutions (ZED,
            RealSense), of the whole sensor (OAK-D) or of none (NeRF's transforms.json).
        baseline_m: measured distance of the two cameras in metres; replaces that of the file.
        distorted: whether the caller takes lens distortion out of the images (``Rig.distortion``).

    Returns:
        The rig: K in pixels of the images that the file is for, E in metres.

    Raises:
        FileNotFoundError, IsADirectoryError, PermissionError: no readable file.
        TypeError: not a path or a pair of paths.
        ValueError: empty, unknown format, cut off, lens distortion unless ``distorted``, cameras that are not
            there.

    Convention:
        A right camera 0.12 m to the right of the left one has ``E[0, 3] == +0.12``.
    """
    texts = _texts(path)
    calibration = CALIBRATION_FORMATS[_one_format(texts)]
    _check_cameras(cameras, calibration)
    choice = CameraChoice(
        (cameras[0], cameras[1]) if cameras else None,
        None if image_folder_hint is None else str(image_folder_hint),
        None if image_names is None else (str(image_names[0]), str(image_names[1])),
        None if image_size is None else (int(image_size[0]), int(image_size[1])),
    )
    rig = _read(texts, calibration, choice)
    if not distorted:
        for side, lens in zip(("left", "right"), rig.distortion, strict=True):
            check_no_distortion(lens, f"Lens distortion of the {side} camera in {rig.source}")
    return _in_metres(rig, baseline_m, calibration.has_unit)


def has_pose_per_image(path: PathLike | Sequence[PathLike]) -> bool:
    """Whether a calibration is another one for every pair of images, found by their names.

    Args:
        path: as in ``read_calibration``.

    Raises:
        OSError, TypeError, ValueError: as ``read_calibration``, where no format is recognised.
    """
    return CALIBRATION_FORMATS[_one_format(_texts(path))].by_image
