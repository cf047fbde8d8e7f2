"""Readers of calibrations in stereo data sets (S5.1)."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from pathlib import PurePath
from typing import NoReturn

import numpy as np

from geodiff_plugin._internal.checks import bad_value, warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.maps import MM_PER_METRE
from geodiff_plugin.formats.rigs import (
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    projected,
    rigid,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_storage
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.types import Rig

ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Values are printed with three decimals, so a correct cam1 agrees with doffs within this tolerance.
DOFFS_TOLERANCE_PX = 0.05
#: Matches a named number as in YAML, TOML and text files.
NAMED_NUMBER = re.compile(r"^[ \t]*(\w+)[ \t]*[:=][ \t]*([-+.\deE]+)[ \t]*(?:#.*)?$", re.MULTILINE)
#: Minimum plausible baseline: users who copy the format often write metres.
MIN_MIDDLEBURY_MM = 1.0
PROJECTION = re.compile(r"(P_rect_|P)(\d+)")
#: Cameras of KITTI.
GREY_PAIR = (0, 1)
COLOUR_PAIR = (2, 3)
#: Folder names of benchmarks: image_2 and image_02, and colored_0 in KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
#: Keys of the baseline in metres.
BASELINES = ("baseline_meters", "baseline_m", "baseline", "bl")
#: Matches a frame of SceneFlow: its number, and one line per camera.
SCENEFLOW_FRAME = re.compile(
    r"^Frame[ \t]+(\d+)[ \t]*\r?\n[ \t]*L[ \t]+(.*)\n[ \t]*R[ \t]+(.*)$", re.MULTILINE
)
#: Focal lengths by folder name in Driving.
SCENEFLOW_FOCAL_PX = {"35mm": 1050.0, "15mm": 450.0}
SCENEFLOW_CENTRE = (479.5, 269.5)
SCENEFLOW_SIZE = (960, 540)
#: Number of values for a DROID-SLAM camera with distortion.
COUNT_OF_DROID = 8
#: Tolerance of the orthogonality of a rotation in a pose with rows of four.
ROTATION_TOLERANCE = 1e-3
#: Baseline of Spring in metres, which is missing in its files.
SPRING_BASELINE_M = 0.065
#: Part of the names of its left images, or of their folder.
SPRING_NAME = "frame_left"


def _left_image(choice: CameraChoice) -> tuple[str, int]:
    """Return the name of the left image as given, and the last number in it (-1 if none)."""
    name = str(choice.image_names[0]) if choice.image_names else ""
    digits = re.findall(r"\d+", PurePath(name.replace("\\", "/")).stem)
    return name, int(digits[-1]) if digits else -1


def read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Middlebury's or ETH3D's calib.txt; ``doffs`` overrides ``cam1``, as in the ground truth."""
    entries = dict(ENTRY.findall(texts[0]))
    has_right = "cam1" in entries
    K_left, K_right = (
        array_of(re.split(r"[\s;,]+", entries[key].strip("[] \t")), (3, 3), key)
        for key in ("cam0", "cam1" if has_right else "cam0")
    )
    if "doffs" in entries or not has_right:
        cx = K_left[0, 2] + float(entries["doffs"])
        if not has_right or abs(K_right[0, 2] - cx) > DOFFS_TOLERANCE_PX:
            state = f"has cx = {K_right[0, 2]:g}" if has_right else "is missing"
            sentence = f"cam1 {state}; using cx0 + doffs = {cx:g} px for the right image."
            warn(Finding("calibration.doffs", sentence))
            K_right[0, 2] = cx
    size = entries.get("width"), entries.get("height")
    baseline_mm = array_of(entries["baseline"], (), "baseline")
    if 0 < baseline_mm < MIN_MIDDLEBURY_MM and choice.baseline_m is None:
        hint = (
            f"If it is in millimetres, confirm it with --baseline {baseline_mm / MM_PER_METRE:g}; if it is "
            f"in metres, pass --baseline {baseline_mm:g} (baseline_m, in metres)."
        )
        bad_value("baseline", "at least 1 mm, as rigs of this format have", baseline_mm, hint)
    return make_rig(
        RawCamera(K_left, size), RawCamera(K_right, size), baseline_mm / MM_PER_METRE, rectified=True
    )


def read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read ``K.txt``: nine numbers of K for both images, and the baseline in metres."""
    *K, baseline_m = texts[0].replace(",", " ").split()
    if len(K) + 1 == COUNT_OF_DROID:
        hint = "For parallel cameras, pass --fx --fy --cx --cy --distortion --baseline."
        bad_value(
            "the file", "9 numbers of K and the baseline", "fx fy cx cy k1 k2 p1 p2 of one camera", hint
        )
    if len(K) != 9:
        hint = "Add the baseline as a second line, or pass a file with only K or E as K and E (--K, --E)."
        code = "calibration.no-baseline" if len(K) == 8 else ""  # K alone
        got = f"{len(K) + 1} numbers"
        bad_value("the file", "9 numbers of K and the baseline in metres", got, hint, code=code)
    return make_rig(RawCamera(K), RawCamera(K), baseline_m)


def read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read stereodemo JSON or lines ``fx: 500`` or ``fx = 500``; older files share one principal point."""
    data = json.loads(texts[0]) if texts[0].lstrip()[:1] == "{" else dict(NAMED_NUMBER.findall(texts[0]))
    size = data.get("width"), data.get("height")
    columns = ("cx", "cx") if "cx" in data else ("cx0", "cx1")
    left, right = (
        RawCamera(intrinsics(data["fx"], data["fy"], data[cx], data["cy"]), size) for cx in columns
    )
    named = next((key for key in BASELINES if key in data), "")
    baseline_m = data[named] if named else choice.baseline_m
    if baseline_m is None:
        hint = "For parallel cameras, pass their distance in metres (--baseline, baseline_m)."
        bad_value(
            "the file", f"one with {' or '.join(BASELINES)}", "none", hint, code="calibration.no-baseline"
        )
    return make_rig(left, right, baseline_m)


def read_cityscapes(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Cityscapes' ``camera.json`` of rectified images with one K; ignore the pose in the vehicle."""
    data = json.loads(texts[0])
    values = data["intrinsic"]
    camera = RawCamera(intrinsics(*(values[key] for key in ("fx", "fy", "u0", "v0"))))
    return make_rig(camera, camera, data["extrinsic"]["baseline"], rectified=True)


def read_spring(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Spring's ``cam_data/intrinsics.txt``: one line fx fy cx cy per frame, starting at number 1.

    Other programs write such lines too (ETH3D's SLAM sets, ``calib/*.txt`` of DROID-SLAM); only Spring's
    images, recognised by name, have a baseline of 65 mm.
    """
    rows = array_of(texts[0].split(), (-1,), "fx fy cx cy").reshape(-1, 4)
    _reject_pose(rows)
    left_image, number = _left_image(choice)
    if SPRING_NAME not in left_image and choice.baseline_m is None:
        _raise_not_spring(rows[0], left_image)
    camera = RawCamera(intrinsics(*_spring_row(rows, number, choice)))
    return make_rig(camera, camera, SPRING_BASELINE_M, rectified=True)


def _reject_pose(rows: np.ndarray) -> None:
    """Raise an error for rows ``(N, 4)`` that are a pose, 3x4 or 4x4."""
    R = rows[:3, :3]
    if len(rows) in (3, 4) and np.allclose(R @ R.T, np.eye(3), atol=ROTATION_TOLERANCE):
        hint = (
            "If it is the right camera's pose in the left camera's frame, pass it with --E, and K with --K."
        )
        bad_value("the file", "a calibration", "a pose", hint)


def _raise_not_spring(row: np.ndarray, left_image: str) -> NoReturn:
    """Raise an error for a file of another program, whose baseline is unknown."""
    values = zip(("fx", "fy", "cx", "cy"), row, strict=True)
    typed = " ".join(f"--{name} {value:g}" for name, value in values)
    hint = f"For parallel cameras, pass {typed} --baseline METRES."
    got = f"fx fy cx cy of one camera and {left_image or 'no image'}"
    bad_value("the file", "a file of Spring, with images named frame_left_0001.png etc.", got, hint)


def _spring_row(rows: np.ndarray, number: int, choice: CameraChoice) -> np.ndarray:
    """Return the row of a frame by its number from 1; the first if it has none (-1) or all rows are equal."""
    if 1 <= number <= len(rows):
        return rows[number - 1]
    if number >= 0 and (rows != rows[0]).any():
        hint = "Spring's images are named frame_left_0001.png etc."
        bad_value("the left image", f"named with a number from 1 to {len(rows)}", choice.image_names, hint)
    return rows[0]


def read_argoverse(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read the rectified pair in Argoverse's ``vehicle_calibration_stereo_info.json``.

    Source: ``argoverse/utils/calibration.py`` of argoverse/argoverse-api.
    """
    cameras = {each["key"]: each["value"] for each in json.loads(texts[0])["camera_data_"]}
    names = [f"image_raw_stereo_front_{side}" for side in ("left", "right")]
    if not {f"{name}_rect" for name in names} <= cameras.keys():
        hint = "Pass vehicle_calibration_stereo_info.json of the stereo images."
        bad_value("the file", "a file of the rectified stereo pair", ", ".join(cameras), hint)
    keys = ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_")
    left, right = (RawCamera(intrinsics(*(cameras[f"{name}_rect"][key] for key in keys))) for name in names)
    shifts = [cameras[name]["vehicle_SE3_camera_"]["translation"] for name in names]
    places = array_of(shifts, (2, 3), "the camera positions")
    return make_rig(left, right, float(np.linalg.norm(places[0] - places[1])), rectified=True)


def read_sceneflow(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read SceneFlow's ``camera_data.txt``: camera-to-world poses per frame in Blender's axes.

    The file lacks K. K is taken from the published 960x540 images; the folder name selects one of Driving's
    two lenses. Lengths are in Blender units.
    """
    frames = SCENEFLOW_FRAME.findall(texts[0])
    poses = {int(number): (left, right) for number, left, right in frames}
    left_image, number = _left_image(choice)
    if number not in poses:
        expected = f"named with a frame number from {min(poses)} to {max(poses)}, such as 0006.png"
        bad_value("the left image", expected, left_image or "no name")
    lens = next((name for name in SCENEFLOW_FOCAL_PX if f"{name}_focallength" in left_image), None)
    if lens is None:
        sentence = "SceneFlow's 35 mm lens (1050 px) is assumed; Driving also has images with 15 mm (450 px)."
        warn(Finding("calibration.assumed-lens", sentence))
    focal = SCENEFLOW_FOCAL_PX[lens or "35mm"]
    camera = RawCamera(intrinsics(focal, focal, *SCENEFLOW_CENTRE), SCENEFLOW_SIZE)
    of_sides = zip(("L", "R"), poses[number], strict=True)
    E_left, E_right = (
        rigid(numbers.split(), f"{side} of frame {number}") @ OPENGL_FROM_OPENCV for side, numbers in of_sides
    )
    return make_rig(camera, camera, np.linalg.inv(E_left) @ E_right)


def _kitti_pair_of_folder(path: str) -> tuple[int, int] | None:
    """Return the pair that the innermost of KITTI's folder names in a path belongs to; ``None`` without."""
    names = FOLDER.findall(path)
    if not names:
        return None
    kind, camera = names[-1]
    return COLOUR_PAIR if kind == "colored" or int(camera) in COLOUR_PAIR else GREY_PAIR


def _kitti_cameras(available: Collection[int], choice: CameraChoice) -> tuple[int, int]:
    """Return the given pair, or the one in the image folder's name, or the colour pair, or the only one."""
    have = sorted(available)
    pairs = [pair for pair in (GREY_PAIR, COLOUR_PAIR) if set(pair) <= set(have)]
    pairs = pairs or [(have[0], have[-1])]
    pair_of_folder = _kitti_pair_of_folder(str(choice.image_folder_hint))
    if pair_of_folder in pairs:
        return two_cameras(choice, have, pair_of_folder)
    if len(pairs) > 1 and choice.cameras is None:
        which = "The calibration has a grey pair 0,1 and a colour pair 2,3; 2,3 is used."
        warn(Finding("calibration.kitti-cameras", f"{which} Select one with cameras (--cameras)."))
    return two_cameras(choice, have, pairs[-1])


def read_vkitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Virtual KITTI 2: K (``intrinsic.txt``) and pose (``extrinsic.txt``) per camera and frame.

    Poses are world-to-camera. The pair is rectified; with the inverse convention its cameras would not be
    parallel.
    """
    left_image, number = _left_image(choice)
    rows = [[line.split() for line in text.splitlines()[1:] if line.strip()] for text in texts]
    rows.sort(key=lambda table: len(table[0]))  # the file with shorter rows has K
    frame = str(number)
    K, T = ({row[1]: row[2:] for row in table if row[0] == frame} for table in rows)
    if not (K.keys() & T.keys() >= {"0", "1"}):
        numbers = [int(row[0]) for row in rows[0]]
        expected = f"named with a frame number from {min(numbers)} to {max(numbers)}, such as rgb_00006.jpg"
        bad_value("the left image", expected, left_image or "no name")
    left, right = (RawCamera(intrinsics(*K[camera])) for camera in "01")
    T_left, T_right = (rigid(T[camera], f"camera {camera} of frame {frame}") for camera in "01")
    E = T_left @ np.linalg.inv(T_right)
    if not np.allclose(E[:3, :3], np.eye(3), atol=1e-3) or E[0, 3] < 0.9 * np.linalg.norm(E[:3, 3]):
        bad_value("extrinsic.txt", "world-to-camera poses of a rectified pair", f"{E[:3].round(3).tolist()}")
    return make_rig(left, right, E, rectified=True)


def _kitti_projections(text: str, choice: CameraChoice) -> list[tuple[np.ndarray, list[str] | None]]:
    """Return ``(3, 4)`` projections of the left and right camera, and the words of their sizes, if any."""
    rows = {key: words.split() for key, words in re.findall(r"(?m)^\s*(\w+)\s*:(.*)$", text)}
    named = {int(match[2]): match for match in map(PROJECTION.fullmatch, rows) if match}
    pair = (named[camera] for camera in _kitti_cameras(named, choice))
    return [(array_of(rows[m[0]], (3, 4), m[0]), rows.get(f"S_rect_{m[2]}")) for m in pair]


def read_kitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read KITTI's or DrivingStereo's ``P_rect_02`` with ``S_rect_02``, or ``P0`` to ``P3``."""
    (P_left, size_left), (P_right, size_right) = _kitti_projections(texts[0], choice)
    return projected(P_left, P_right, size_left, size_right)


def left_projection_of_kitti(text: str, choice: CameraChoice) -> np.ndarray:
    """Return the ``(3, 4)`` projection of ``read_kitti``'s left camera; raise for other formats."""
    if not re.search(r"(?m)^\s*P(?:_rect_|)\d+\s*:", text):
        bad_value("calibration", "KITTI's (P_rect_02, or P0 to P3)", "a different format")
    return _kitti_projections(text, choice)[0][0]


def read_booster(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read Booster's calibration of the full-resolution rectified images; lengths are in millimetres."""
    entries = read_storage(texts[0])
    left, right = (
        RawCamera(array_of(entries[key], (3, -1), key)[:, :3]) for key in ("proj_matl", "proj_matr")
    )
    return make_rig(left, right, entries["baselinelr"].item() / MM_PER_METRE, rectified=True)
