"""Calibrations of data sets of stereo pairs (S5.1)."""

from __future__ import annotations

import json
import re
from collections.abc import Collection
from pathlib import PurePath

import numpy as np

from geodiff_plugin._checks import bad_value, warn
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    projected,
    rigid,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_storage
from geodiff_plugin.geometry import OPENGL_FROM_OPENCV
from geodiff_plugin.messages import Message
from geodiff_plugin.types import Rig

MM_PER_METRE = 1000.0
CM_PER_METRE = 100.0
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05
#: A number by its name, as YAML, TOML and people write it.
NAMED_NUMBER = re.compile(r"^[ \t]*(\w+)[ \t]*[:=][ \t]*([-+.\deE]+)[ \t]*(?:#.*)?$", re.MULTILINE)
#: No stereo camera has a shorter baseline: people who copy the format write metres.
LEAST_MIDDLEBURY_MM = 1.0
PROJECTION = re.compile(r"(P_rect_|P)(\d+)")
PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
#: What the baseline is called, in metres.
BASELINES = ("baseline_meters", "baseline_m", "baseline", "bl")
#: A frame of SceneFlow: its number, and a line for each camera.
SCENEFLOW_FRAME = re.compile(
    r"^Frame[ \t]+(\d+)[ \t]*\r?\n[ \t]*L[ \t]+(.*)\n[ \t]*R[ \t]+(.*)$", re.MULTILINE
)
#: Its lenses, by the names of Driving's folders.
SCENEFLOW_FOCAL_PX = {"35mm": 1050.0, "15mm": 450.0}
SCENEFLOW_CENTRE = (479.5, 269.5)
SCENEFLOW_SIZE = (960, 540)
#: Numbers of a camera of DROID-SLAM with distortion.
COUNT_OF_DROID = 8
#: How exactly the rotation of a pose that is written in rows of four is one.
ROTATION_TOLERANCE = 1e-3
#: Metres between the cameras of Spring, which its files do not say.
SPRING_BASELINE_M = 0.065
#: What the names of its left images, or of their folder, contain.
SPRING_NAME = "frame_left"


def read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``doffs = cx1 - cx0`` is what the ground truth was made with, so it goes before ``cam1``."""
    entries = dict(ENTRY.findall(texts[0]))
    has_right = "cam1" in entries
    K_left, K_right = (
        array_of(re.split(r"[\s;,]+", entries[key].strip("[] \t")), (3, 3), key)
        for key in ("cam0", "cam1" if has_right else "cam0")
    )
    if "doffs" in entries or not has_right:
        cx = K_left[0, 2] + float(entries["doffs"])
        if not has_right or abs(K_right[0, 2] - cx) > DOFFS_TOLERANCE_PX:
            said = f"says cx = {K_right[0, 2]:g}" if has_right else "is missing"
            sentence = f"cam1 {said}; using cx0 + doffs = {cx:g} px for the right image."
            warn(Message("calibration.doffs", sentence))
            K_right[0, 2] = cx
    size = entries.get("width"), entries.get("height")
    baseline_mm = array_of(entries["baseline"], (), "baseline")
    if 0 < baseline_mm < LEAST_MIDDLEBURY_MM and choice.baseline_m is None:
        cure = f"If it is in metres, give it as such: --baseline {baseline_mm:g} (baseline_m)."
        bad_value("baseline", "millimetres", baseline_mm, cure)
    return make_rig(Camera(K_left, size), Camera(K_right, size), baseline_mm / MM_PER_METRE, rectified=True)


def read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``K.txt``: nine numbers of K of both images, and the baseline in metres."""
    *K, baseline_m = texts[0].replace(",", " ").split()
    if len(K) + 1 == COUNT_OF_DROID:
        cure = "Give the measured distance of parallel cameras: --fx --fy --cx --cy --distortion --baseline."
        bad_value(
            "the file", "9 numbers of K and the baseline", "fx fy cx cy k1 k2 p1 p2 of one camera", cure
        )
    if len(K) != 9:
        cure = "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E)."
        bad_value("the file", "9 numbers of K and the baseline in metres", f"{len(K) + 1} numbers", cure)
    return make_rig(Camera(K), Camera(K), baseline_m)


def read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Older files have one principal point for both; lines ``fx: 500`` or ``fx = 500`` are read too."""
    data = json.loads(texts[0]) if texts[0].lstrip()[:1] == "{" else dict(NAMED_NUMBER.findall(texts[0]))
    size = data.get("width"), data.get("height")
    columns = ("cx", "cx") if "cx" in data else ("cx0", "cx1")
    left, right = (Camera(intrinsics(data["fx"], data["fy"], data[cx], data["cy"]), size) for cx in columns)
    named = next((key for key in BASELINES if key in data), "")
    baseline_m = data[named] if named else choice.baseline_m
    if baseline_m is None:
        cure = "Give the distance of the cameras, which must be parallel, in metres (--baseline, baseline_m)."
        bad_value("the file", f"one with {' or '.join(BASELINES)}", "none", cure)
    return make_rig(left, right, baseline_m)


def read_cityscapes(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Cityscapes' ``camera.json``, of rectified images of one K; the pose in the vehicle is left out."""
    data = json.loads(texts[0])
    values = data["intrinsic"]
    camera = Camera(intrinsics(*(values[key] for key in ("fx", "fy", "u0", "v0"))))
    return make_rig(camera, camera, data["extrinsic"]["baseline"], rectified=True)


def read_spring(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Spring's ``cam_data/intrinsics.txt``: a line fx fy cx cy a frame, the first one of number 1.

    Other programs write such lines too (ETH3D's SLAM sets, ``calib/*.txt`` of DROID-SLAM); only Spring's
    images, by their names, stand 65 mm apart.
    """
    rows = array_of(texts[0].split(), (-1,), "fx fy cx cy").reshape(-1, 4)
    turn = rows[:3, :3]
    if len(rows) in (3, 4) and np.allclose(turn @ turn.T, np.eye(3), atol=ROTATION_TOLERANCE):
        cure = "Give K of the cameras (--K, --K-right), and it as --E, if it is the right camera's pose in "
        cure += "the left camera's frame."
        bad_value("the file", "a calibration", "a pose", cure)
    left_image = str(choice.image_names[0]) if choice.image_names else ""
    if SPRING_NAME not in left_image and choice.baseline_m is None:
        named = zip(("fx", "fy", "cx", "cy"), rows[0], strict=True)
        typed = " ".join(f"--{name} {number:g}" for name, number in named)
        cure = f"Give the measured distance of parallel cameras: {typed} --baseline METRES."
        got = f"fx fy cx cy of one camera and {left_image or 'no image'}"
        bad_value("the file", "of Spring, whose images are frame_left_0001.png and so on", got, cure)
    numbers = re.findall(r"\d+", left_image)
    row = int(numbers[-1]) - 1 if numbers else 0
    if (rows != rows[0]).any() and not 0 <= row < len(rows):
        cure = "Spring's images are frame_left_0001.png and so on."
        bad_value("the left image", f"named by its number, 1 to {len(rows)}", choice.image_names, cure)
    camera = Camera(intrinsics(*rows[row if 0 <= row < len(rows) else 0]))
    return make_rig(camera, camera, SPRING_BASELINE_M, rectified=True)


def read_robotcar(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``models/stereo_wide_left.txt`` and ``_right.txt`` of Oxford RobotCar: of images without distortion.

    The matrix is the pose of the image's axes in the frame of the stereo camera. Source:
    ``python/camera_model.py`` of ori-mrg/robotcar-dataset-sdk.
    """
    rows = [array_of(text.split(), (-1,), "the model").reshape(-1, 4) for text in texts]
    left, right = (Camera(intrinsics(*each[0])) for each in rows)
    poses = [rigid(each[1:], "the pose of the model") for each in rows]
    return make_rig(left, right, np.linalg.inv(poses[0]) @ poses[1], rectified=True)


def read_argoverse(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Argoverse's ``vehicle_calibration_stereo_info.json``: its rectified pair, by the poses in the vehicle.

    Source: ``argoverse/utils/calibration.py`` of argoverse/argoverse-api.
    """
    cameras = {each["key"]: each["value"] for each in json.loads(texts[0])["camera_data_"]}
    names = [f"image_raw_stereo_front_{side}" for side in ("left", "right")]
    if not {f"{name}_rect" for name in names} <= cameras.keys():
        cure = "Give vehicle_calibration_stereo_info.json of the stereo images."
        bad_value("the file", "one of the rectified stereo pair", ", ".join(cameras), cure)
    keys = ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_")
    left, right = (Camera(intrinsics(*(cameras[f"{name}_rect"][key] for key in keys))) for name in names)
    shifts = [cameras[name]["vehicle_SE3_camera_"]["translation"] for name in names]
    places = array_of(shifts, (2, 3), "the places of the cameras")
    return make_rig(left, right, float(np.linalg.norm(places[0] - places[1])), rectified=True)


def read_sceneflow(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """SceneFlow's ``camera_data.txt``: poses of both cameras a frame, camera-to-world in Blender's axes.

    K is not in the file: that of the published 960x540 images, by the folder's name for the two lenses of
    Driving. Lengths are units of Blender's.
    """
    frames = SCENEFLOW_FRAME.findall(texts[0])
    poses = {int(number): (left, right) for number, left, right in frames}
    left_image = str(choice.image_names[0]) if choice.image_names else ""
    digits = re.findall(r"\d+", PurePath(left_image.replace("\\", "/")).stem)
    number = int(digits[-1]) if digits else -1
    if number not in poses:
        expected = f"named by its frame, {min(poses)} to {max(poses)}, as 0006.png"
        bad_value("the left image", expected, left_image or "no name")
    lens = next((name for name in SCENEFLOW_FOCAL_PX if f"{name}_focallength" in left_image), None)
    if lens is None:
        sentence = "Assumed: SceneFlow's 35 mm lens (1050 px); Driving has images of 15 mm (450 px) as well."
        warn(Message("calibration.assumed-lens", sentence))
    focal = SCENEFLOW_FOCAL_PX[lens or "35mm"]
    camera = Camera(intrinsics(focal, focal, *SCENEFLOW_CENTRE), SCENEFLOW_SIZE)
    of_sides = zip(("L", "R"), poses[number], strict=True)
    E_left, E_right = (
        rigid(numbers.split(), f"{side} of frame {number}") @ OPENGL_FROM_OPENCV for side, numbers in of_sides
    )
    return make_rig(camera, camera, np.linalg.inv(E_left) @ E_right)


def _kitti_cameras(available: Collection[int], choice: CameraChoice) -> tuple[int, int]:
    """The pair that was given, else of the image folder's name, else the colour pair, else the only one."""
    have = sorted(available)
    pairs = [pair for pair in PAIRS if set(pair) <= set(have)] or [(have[0], have[-1])]
    for kind, camera in FOLDER.findall(str(choice.image_folder_hint))[-1:]:
        pair = PAIRS[kind == "colored" or int(camera) >= 2]
        if pair in pairs:
            return two_cameras(choice, have, pair)
    if len(pairs) > 1 and choice.cameras is None:
        which = "Of the grey pair 0,1 and the colour pair 2,3 of the calibration 2,3 is taken."
        warn(Message("calibration.kitti-cameras", f"{which} Give cameras (--cameras)."))
    return two_cameras(choice, have, pairs[-1])


def read_vkitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Virtual KITTI 2: K (``intrinsic.txt``) and pose (``extrinsic.txt``) of both cameras in every frame.

    Poses are world-to-camera. The pair is rectified, so poses of another direction would not be parallel.
    """
    left_image = str(choice.image_names[0]) if choice.image_names else ""
    digits = re.findall(r"\d+", PurePath(left_image.replace("\\", "/")).stem)
    rows = [[line.split() for line in text.splitlines()[1:] if line.strip()] for text in texts]
    rows.sort(key=lambda table: len(table[0]))  # the shorter lines are those of K
    frame = str(int(digits[-1])) if digits else ""
    K, T = ({row[1]: row[2:] for row in table if row[0] == frame} for table in rows)
    if not (K.keys() & T.keys() >= {"0", "1"}):
        numbers = [int(row[0]) for row in rows[0]]
        expected = f"named by its frame, {min(numbers)} to {max(numbers)}, as rgb_00006.jpg"
        bad_value("the left image", expected, left_image or "no name")
    left, right = (Camera(intrinsics(*K[camera])) for camera in "01")
    T_left, T_right = (rigid(T[camera], f"camera {camera} of frame {frame}") for camera in "01")
    E = T_left @ np.linalg.inv(T_right)
    if not np.allclose(E[:3, :3], np.eye(3), atol=1e-3) or E[0, 3] < 0.9 * np.linalg.norm(E[:3, 3]):
        bad_value("extrinsic.txt", "world-to-camera poses of a rectified pair", f"{E[:3].round(3).tolist()}")
    return make_rig(left, right, E, rectified=True)


def _kitti_projections(text: str, choice: CameraChoice) -> list[tuple[np.ndarray, list[str] | None]]:
    """``(3, 4)`` projections of the left and the right camera, and the words of their sizes, if there."""
    rows = {key: words.split() for key, words in re.findall(r"(?m)^\s*(\w+)\s*:(.*)$", text)}
    named = {int(match[2]): match for match in map(PROJECTION.fullmatch, rows) if match}
    pair = (named[camera] for camera in _kitti_cameras(named, choice))
    return [(array_of(rows[m[0]], (3, 4), m[0]), rows.get(f"S_rect_{m[2]}")) for m in pair]


def read_kitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P_rect_02`` with ``S_rect_02`` of ``calib_cam_to_cam``, or ``P0`` to ``P3``; DrivingStereo's too."""
    (P_left, size_left), (P_right, size_right) = _kitti_projections(texts[0], choice)
    return projected(P_left, P_right, size_left, size_right)


def left_projection_of_kitti(text: str, choice: CameraChoice) -> np.ndarray:
    """``(3, 4)`` of the left camera that ``read_kitti`` takes; ``InputError`` for another calibration."""
    if not re.search(r"(?m)^\s*P(?:_rect_|)\d+\s*:", text):
        bad_value("calibration", "one of KITTI (P_rect_02, or P0 to P3)", "another")
    return _kitti_projections(text, choice)[0][0]


def read_mvsnet(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """One ``cam.txt`` a view, in the unit of the files: metres in most sets, millimetres in DTU."""
    poses, cameras = [], []
    for text in texts:
        extrinsic, _, intrinsic = text.partition("extrinsic")[2].partition("intrinsic")
        # The rotations of hand-held sets are rigid to a few 1e-4; inverting them as they are would shear E.
        poses.append(rigid(extrinsic.split()[:16], "extrinsic"))
        cameras.append(Camera(intrinsic.split()[:9]))  # a line of depth range stands behind
    return make_rig(cameras[0], cameras[1], poses[0] @ np.linalg.inv(poses[1]))


def read_booster(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """For the images at full resolution, which are rectified; lengths are millimetres."""
    entries = read_storage(texts[0])
    left, right = (Camera(array_of(entries[key], (3, -1), key)[:, :3]) for key in ("proj_matl", "proj_matr"))
    return make_rig(left, right, entries["baselinelr"].item() / MM_PER_METRE, rectified=True)
