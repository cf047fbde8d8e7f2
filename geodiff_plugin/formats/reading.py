"""Reading of calibration files: the table of formats, recognised from their content (S3.3)."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from geodiff_plugin._checks import UnknownFormatError, bad_type, bad_value, check_number, warn
from geodiff_plugin.formats import (
    colmap,
    devices,
    matlab,
    multicamera,
    named,
    robotics,
    slam,
    stereo,
    storage,
    transforms,
)
from geodiff_plugin.formats.files import PathLike
from geodiff_plugin.formats.foreign import refuse_foreign_calibration
from geodiff_plugin.formats.rigs import CalibrationFormat, CameraChoice, in_units, reading_whole
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

_JSON = r"\A\s*[{\[]"
_NUMBER = r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?"
#: A line of four numbers.
_ROW = rf"{_NUMBER}(?:[ \t]+{_NUMBER}){{3}}[ \t]*(?:\r?\n|\Z)"
#: A line that begins with a name of a camera, its matrix or its place.
_NAME_OF_CAMERA = (
    r"^[ \t]*(?:[\w.-]*(?i:cam|intrin|extrin|matrix|mtx|dist|stereo|rotation|translation|baseline|left|right)"
    r"[\w.-]*|[KMDRTP][\w.]?\w?)[ \t]*(?::|=(?!=))"
)
#: Every format by name. The first that recognises a file reads it: formats that others contain come first.
CALIBRATION_FORMATS: dict[str, CalibrationFormat] = {
    "middlebury": CalibrationFormat(
        "Middlebury or ETH3D calib.txt (cam0=[...])", r"^\s*cam0\s*=\s*\[", stereo.read_middlebury),
    "kitti_cam_to_cam": CalibrationFormat(
        "KITTI (P_rect_02: ...)", r"^\s*P_rect_\d+\s*:", stereo.read_kitti, uses_cameras=True),
    # Two numbers behind the colon keep OpenCV's "P1: !!opencv-matrix", lists of YAML and the penalties P1 and
    # P2 of a matcher's settings out.
    "kitti_projections": CalibrationFormat(
        "KITTI (P0: ...)", rf"^\s*P[0-3][ \t]*:[ \t]*{_NUMBER}[ \t]+[-+.\d]", stereo.read_kitti,
        uses_cameras=True),
    "robotcar": CalibrationFormat(
        "pair of Oxford RobotCar's models (fx fy cx cy, and a 4x4)",
        rf"\A(?:\s*{_ROW}){{4}}\s*0(?:\.0*)?[ \t]+-?0(?:\.0*)?[ \t]+-?0(?:\.0*)?[ \t]+1(?:\.0*)?\s*\Z",
        stereo.read_robotcar, (2,)),
    "spring": CalibrationFormat(
        "Spring's intrinsics.txt (fx fy cx cy a line)",
        rf"\A(?:\s*{_NUMBER}(?:[ \t]+{_NUMBER}){{3}}[ \t]*(?:\n|\Z))+\s*\Z", stereo.read_spring),
    "sceneflow": CalibrationFormat(
        "SceneFlow's camera_data.txt (Frame, L, R)", r"\A\s*Frame[ \t]+\d+[ \t]*\r?\n[ \t]*L[ \t]",
        stereo.read_sceneflow, by_image=True),
    "vkitti": CalibrationFormat(
        "Virtual KITTI's intrinsic.txt and extrinsic.txt (frame cameraID)", r"\A\s*frame[ \t]+cameraID\b",
        stereo.read_vkitti, (2,)),
    "foundation_stereo": CalibrationFormat(
        "K.txt of FoundationStereo (9 numbers, baseline)", r"\A(?i:[-+.\de\s,]|nan|inf)+\Z",
        stereo.read_foundation_stereo),
    "booster": CalibrationFormat(
        "Booster xml (proj_matL)", r"<opencv_st[\s\S]*proj_matL", stereo.read_booster),
    "mvsnet": CalibrationFormat(
        "pair of MVSNet cam.txt (extrinsic)", r"^\s*extrinsic\s*$", stereo.read_mvsnet, (2,)),
    "zed": CalibrationFormat(
        "ZED SN*.conf ([LEFT_CAM_HD])", r"^\s*\[(LEFT|RIGHT)_CAM_\w+\]", devices.read_zed),
    "realsense": CalibrationFormat(
        "RealSense (rs-enumerate-devices -c, or rs2 as JSON)",
        rf'{devices.RS_PRINTED}|{_JSON}(?=[\s\S]*"ppx")', devices.read_realsense),
    "oak": CalibrationFormat(
        "OAK-D JSON (cameraData)", _JSON + r'(?=[\s\S]*"cameraData")', devices.read_oak, uses_cameras=True),
    "nerf": CalibrationFormat(
        "transforms.json of nerfstudio or instant-ngp (frames, transform_matrix)",
        _JSON + r'(?=[\s\S]*"frames")(?=[\s\S]*"transform_matrix")', transforms.read_nerf, by_image=True,
        as_stored=True),
    "basalt": CalibrationFormat(
        "basalt's calibration.json (T_imu_cam)", _JSON + r'(?=[\s\S]*"T_imu_cam")', robotics.read_basalt,
        uses_cameras=True),
    "cityscapes": CalibrationFormat(
        "Cityscapes' camera.json (u0, v0)", _JSON + r'(?=[\s\S]*"u0")(?=[\s\S]*"extrinsic")',
        stereo.read_cityscapes),
    "matlab": CalibrationFormat(
        "MATLAB's stereoParams by jsonencode (CameraParameters1)",
        _JSON + r'(?=[\s\S]*"CameraParameters1")', matlab.read_matlab),
    "argoverse": CalibrationFormat(
        "Argoverse's calibration of its stereo pair (vehicle_SE3_camera_)",
        _JSON + r'(?=[\s\S]*"vehicle_SE3_camera_")', stereo.read_argoverse),
    "bouguet": CalibrationFormat(
        "Bouguet's calibration toolbox (fc_left, kc_left)", r"^[^%\n]*\bfc_left[ \t]*=[ \t]*\[",
        matlab.read_bouguet),
    "multical": CalibrationFormat(
        "multical's calibration.json (cameras, camera_poses)",
        _JSON + r'(?=[\s\S]*"cameras")(?=[\s\S]*"camera_poses")', multicamera.read_multical,
        uses_cameras=True),
    "mc_calib": CalibrationFormat(
        "MC-Calib's calibrated_cameras_data.yml (camera_pose_matrix)", r"^[ \t]+camera_pose_matrix[ \t]*:",
        multicamera.read_mc_calib, uses_cameras=True),
    "mrcal": CalibrationFormat(
        "pair of mrcal's .cameramodel (lensmodel)", r"['\"]lensmodel['\"]\s*:", multicamera.read_mrcal, (2,)),
    "anipose": CalibrationFormat(
        "calibration.toml of anipose, Calib.toml of Pose2Sim (matrix, distortions)",
        r"\A(?=[\s\S]*^distortions[ \t]*=)[\s\S]*^matrix[ \t]*=", multicamera.read_anipose,
        uses_cameras=True),
    "okvis": CalibrationFormat(
        "settings of OKVIS (cameras, T_SC)", r"^[ \t]*-?[ \t]*\{?[ \t]*T_SC[ \t]*:", slam.read_okvis,
        uses_cameras=True),
    "svo": CalibrationFormat(
        "rig of SVO or maplab (cameras, T_B_C)",
        r"\A(?=[\s\S]*^[ \t-]*cameras[ \t]*:)[\s\S]*^[ \t-]*T_(B_C|C_B)[ \t]*:", slam.read_svo,
        uses_cameras=True),
    "stella": CalibrationFormat(
        "settings of stella_vslam (Camera, focal_x_baseline)",
        r"\A(?=[\s\S]*^[ \t]+(setup|focal_x_baseline)[ \t]*:)[\s\S]*^Camera[ \t]*:[ \t]*(#.*)?$",
        slam.read_stella),
    "airslam": CalibrationFormat(
        "settings of AirSLAM (cam0, T_type)", r"^[ \t]+T_type[ \t]*:", slam.read_airslam),
    "stvo": CalibrationFormat(
        "settings of StVO-PL (cam0, cam_bl)", r"\A(?=[\s\S]*^cam0[ \t]*:)[\s\S]*^[ \t]+cam_bl[ \t]*:",
        slam.read_stvo),
    "ros_ini": CalibrationFormat(
        ".ini of ROS' camera_calibration ([image], camera matrix)", r"^camera matrix[ \t]*$",
        robotics.read_ros_ini, (1, 2)),
    "vins": CalibrationFormat(
        "VINS-Fusion's configuration (cam0_calib, body_T_cam0)", r"^(cam0_calib|model_type)\s*:",
        robotics.read_vins, beside=robotics.vins_cameras),
    "kalibr": CalibrationFormat(
        "Kalibr camchain.yaml (cam0)", r"^cam\d+:\s*(?:#.*)?$|^[ \t]+T_cn_cnm1[ \t]*:", robotics.read_kalibr,
        uses_cameras=True),
    "euroc": CalibrationFormat("pair of EuRoC sensor.yaml (T_BS)", r"^T_BS\s*:", robotics.read_euroc, (2,)),
    # Older settings describe the rectification too, and OpenCV's reader has these names.
    "orb_slam": CalibrationFormat(
        "ORB-SLAM's stereo settings (Camera1.fx, Camera.bf)",
        r"\A(?![\s\S]*^LEFT\.P[ \t]*:)[\s\S]*^(?:Camera1?\.fx|Camera\.bf)[ \t]*:", robotics.read_orb_slam),
    "opencv": CalibrationFormat(
        "OpenCV YAML, XML or JSON (P1, P2, or M1, M2, R, T)",
        r'!!opencv-matrix|<opencv_storage|"opencv-matrix"', named.read_opencv, (1, 2, 3)),
    "ros": CalibrationFormat(
        "pair of ROS camera_info (projection_matrix)",
        r"^(projection_matrix|distortion_model|rectification_matrix)\s*:", robotics.read_ros, (2,)),
    "stereodemo": CalibrationFormat(
        "stereodemo JSON, or lines of names and numbers (fx)",
        _JSON + rf'(?=[\s\S]*"fx")|^[ \t]*fx[ \t]*[:=][ \t]*{_NUMBER}', stereo.read_stereodemo),
    "colmap": CalibrationFormat(
        "COLMAP model (cameras.txt and images.txt)", colmap.MARK, colmap.read_colmap, (2,), by_image=True,
        as_stored=True),
    # Whatever JSON is left, and texts with a name of cameras: which names it lacks is the best to be said.
    "named": CalibrationFormat(
        "JSON, YAML, TOML or .npz of named matrices (K1, D1, K2, D2, R, T)",
        rf"\A\s*\{{|{_NAME_OF_CAMERA}", named.read_opencv, (1, 2, 3)),
}  # fmt: skip


def _texts(path: PathLike | Sequence[PathLike]) -> dict[Path, str]:
    """The text of each file; of a COLMAP model, the one calibration that may be a folder, of two."""
    paths = (path,) if isinstance(path, (str, os.PathLike)) else path
    if not isinstance(paths, (tuple, list)) or not all(isinstance(p, (str, os.PathLike)) for p in paths):
        bad_type("calibration", "a path, or a pair of paths (left, right)", path)
    if len(paths) == 1 and os.path.isdir(paths[0]):
        folder = Path(paths[0])
        if not (model := colmap.model_files(folder)) and (text := storage.text_of_arrays(folder)):
            return {folder: text}
        paths = model or paths
    for file in paths:
        refuse_foreign_calibration(Path(file))
    return {Path(file): _text(Path(file)) for file in paths}


def _text(file: Path) -> str:
    """The text of a calibration, of an archive of matrices as JSON."""
    is_npz = file.suffix.lower() == ".npz" and file.is_file()
    return storage.text_of_npz(file) if is_npz else colmap.calibration_text(file)


def _format_of(texts: dict[Path, str]) -> CalibrationFormat:
    """The format that all files have, as many as it needs."""
    names = set()
    for path, text in texts.items():
        fits = [name for name, each in CALIBRATION_FORMATS.items() if re.search(each.mark, text, re.M)]
        if not fits:
            expected = f"in a known format ({', '.join(CALIBRATION_FORMATS)})"
            cure = "Is this the right file? Otherwise give fx, fy, cx, cy and baseline, or K and E."
            got = f"{path}, which is none of them"
            bad_value("calibration", expected, got, cure, UnknownFormatError)
        names.add(fits[0])
    if len(names) != 1:
        bad_value("calibration", "files of one format", " and ".join(sorted(names)) or "none")
    entry = CALIBRATION_FORMATS[names.pop()]
    if len(texts) not in entry.file_counts:
        counts = " or ".join(map(str, entry.file_counts))
        files = "file" if entry.file_counts == (1,) else "files"
        both = "Give both: --calib twice, for the left and the right view (in Python two paths)."
        once = "A file of both cameras is given once; of files of one camera each give K and E of the pair."
        expected = f"{counts} {files} of this format, {entry.summary}"
        got = f"{len(texts)}, {' and '.join(map(str, texts))}"
        bad_value("calibration", expected, got, both if len(texts) == 1 else once)
    return entry


def _with_beside(entry: CalibrationFormat, texts: dict[Path, str]) -> tuple[str, ...]:
    """The texts, and those of the files that the first one names in its own folder."""
    if entry.beside is None:
        return tuple(texts.values())
    (file, text), *_ = texts.items()
    return (*texts.values(), *(_text(file.parent / Path(name).name) for name in entry.beside(text)))


def _in_metres(rig: Rig, baseline_m: float | None, by_image: bool) -> Rig:
    """The rig with its cameras ``baseline_m`` apart; a warning where nothing says what its unit is."""
    if baseline_m is None:
        if not by_image:
            return rig
        cure = "Give the measured distance of the two cameras as baseline_m (--baseline) to get metres."
        sentence = f"{rig.source} has no unit: depth comes out in the model's own. {cure}"
        warn(Message("calibration.no-unit", sentence), stacklevel=3)
        return replace(rig, unit=None, measured=False)
    check_number(baseline_m, "baseline_m", float(np.finfo(np.float64).tiny), 1e9)
    length = float(np.linalg.norm(rig.E[:3, 3]))
    if length == 0:
        cure = "Both its cameras are at one place."
        bad_value("baseline_m", f"left out for {rig.source}", baseline_m, cure)
    return in_units(rig, length / baseline_m)


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
        cameras: both cameras of a file of many (KITTI, Kalibr, OAK-D); else by the folder, then by the file.
        image_folder_hint: name or path of the left image's folder (or of the image): ``image_2`` means 2, 3.
        image_names: names or paths of both images, by which a COLMAP model or a transforms.json knows them.
        image_size: ``(width, height)`` of the left image, for files with several resolutions (ZED,
            RealSense), of the whole sensor (OAK-D) or of none (NeRF's transforms.json).
        baseline_m: measured distance of the two cameras in metres; replaces that of the file.
        distorted: whether the caller takes lens distortion out of the images (``Rig.distortion``).

    Returns:
        The rig: K in pixels of the images that the file is for, E in metres: a right camera 0.12 m to the
        right of the left one has ``E[0, 3] == +0.12``.

    Raises:
        OSError, TypeError: no readable file (FileNotFoundError: none at all); no path.
        ValueError: unknown format, cut off, cameras that are not there, lens distortion unless ``distorted``.
    """
    texts = _texts(path)
    entry, source = _format_of(texts), " and ".join(map(str, texts))
    if cameras is not None and not entry.uses_cameras:
        bad_value("cameras", "left out for a file of two cameras", cameras, "It chooses among more than two.")
    choice = CameraChoice(cameras, image_folder_hint, image_names, image_size, baseline_m)
    other = "Is it of another program, or of one camera?"
    with reading_whole(source, entry.summary, *texts.values(), cure=other):
        rig = replace(entry.read(_with_beside(entry, texts), choice), source=source)
    for side, lens in zip(("left", "right"), rig.distortion, strict=True):
        if lens is not None and not distorted:
            cure = "Undistort or rectify both images and give P1 and P2 of the result, or use geodiff depth."
            got = f"{lens.model} {np.array2string(lens.coefficients, precision=4, separator=', ')}"
            name = f"Lens distortion of the {side} camera in {source}"
            bad_value(name, "zero (images of a pinhole camera)", got, cure)
    return _in_metres(rig, baseline_m, entry.by_image)


def is_as_stored(path: PathLike | Sequence[PathLike]) -> bool:
    """Whether a calibration's cameras are those of the pixels as files store them, not as EXIF turns them."""
    return _format_of(_texts(path)).as_stored


def has_pose_per_image(path: PathLike | Sequence[PathLike]) -> bool:
    """Whether a calibration, as ``read_calibration`` takes it, is another one for every pair of images."""
    return _format_of(_texts(path)).by_image
