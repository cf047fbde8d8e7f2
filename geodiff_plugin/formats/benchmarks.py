"""Calibrations of data sets: Middlebury, KITTI, MVSNet, FoundationStereo, stereodemo (S5.1)."""

from __future__ import annotations

import json
import re
from collections.abc import Collection

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
from geodiff_plugin.types import Rig

MM_PER_METRE = 1000.0
ENTRY = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)[ \t]*$", re.MULTILINE)
#: Files are printed with three decimals, so an honest cam1 agrees with doffs better than this.
DOFFS_TOLERANCE_PX = 0.05
KITTI_ROW = re.compile(r"^\s*(\w+)\s*:(.*)$", re.MULTILINE)
PROJECTION = re.compile(r"(P_rect_|P)(\d+)")
#: KITTI's grey pair and colour pair.
PAIRS = ((0, 1), (2, 3))
#: Folder names of the benchmarks: image_2 and image_02, and colored_0 of KITTI 2012.
FOLDER = re.compile(r"(image|colored)_0?([0-3])(?!\d)")
WHICH = (
    "Of the grey pair 0,1 and the colour pair 2,3 of the calibration 2,3 is taken. Give cameras (--cameras)."
)


def _matrix(entries: dict[str, str], key: str) -> np.ndarray:
    value = entries[key]
    if not value.endswith("]"):
        bad_value(key, "[f 0 cx; 0 f cy; 0 0 1]", repr(value), "Is the file cut off?")
    return array_of([row.split() for row in value.strip("[]").split(";")], (3, 3), key)


def read_middlebury(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``doffs`` is what the ground truth was made with, so ``cx0 + doffs`` goes before ``cam1``.

    Convention:
        ``doffs = cx1 - cx0``, so that Z = baseline * f / (disparity + doffs); the baseline is in millimetres.
    """
    entries = dict(ENTRY.findall(texts[0]))
    K_left = _matrix(entries, "cam0")
    K_right = _matrix(entries, "cam1") if "cam1" in entries else None
    if K_right is None or "doffs" in entries:
        expected = K_left[0, 2] + float(entries["doffs"])
        if K_right is None or abs(K_right[0, 2] - expected) > DOFFS_TOLERANCE_PX:
            said = "is missing" if K_right is None else f"says cx = {K_right[0, 2]:g}"
            warn(f"cam1 {said}; using cx0 + doffs = {expected:g} px for the right image.")
            K_right = K_left.copy() if K_right is None else K_right
            K_right[0, 2] = expected
    size = entries.get("width"), entries.get("height")
    baseline_m = float(entries["baseline"]) / MM_PER_METRE
    return make_rig(Camera(K_left, size), Camera(K_right, size), baseline_m, rectified=True)


def read_foundation_stereo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``K.txt``: nine numbers of K of both images, and the baseline in metres."""
    values = texts[0].replace(",", " ").split()
    if len(values) != 10:
        cure = "Add the baseline as a second line; a file that holds only K or E goes to K and E (--K, --E)."
        bad_value("the file", "9 numbers of K and the baseline in metres", f"{len(values)} numbers", cure)
    camera = Camera(array_of(values[:9], (3, 3), "K"))
    return make_rig(camera, camera, values[9])


def read_stereodemo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Older files have one principal point for both images."""
    data = json.loads(texts[0])
    size = data.get("width"), data.get("height")
    left, right = (
        Camera(intrinsics(data["fx"], data["fy"], data["cx" if "cx" in data else cx], data["cy"]), size)
        for cx in ("cx0", "cx1")
    )
    return make_rig(left, right, data["baseline_meters"])


def _kitti_cameras(available: Collection[int], choice: CameraChoice) -> tuple[int, int]:
    """The pair that was given, else of the image folder's name, else the colour pair, else the only one."""
    if choice.cameras is not None:
        return two_cameras(choice, available)
    pairs = [pair for pair in PAIRS if set(pair) <= set(available)]
    for kind, camera in FOLDER.findall(choice.image_folder_hint or "")[-1:]:
        pair = PAIRS[kind == "colored" or int(camera) >= 2]
        if pair in pairs:
            return pair
    have = sorted(available)
    if not pairs and len(have) != 2:
        got = f"cameras {', '.join(map(str, have))}"
        bad_value("the file", "a calibration with two cameras", got, "Give cameras (--cameras).")
    return pairs[-1] if pairs else (have[0], have[1])


def read_kitti(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """``P_rect_02`` with ``S_rect_02`` of ``calib_cam_to_cam``, or ``P0`` to ``P3``; DrivingStereo's too."""
    rows = dict(KITTI_ROW.findall(texts[0]))
    named = {int(match[2]): match for match in map(PROJECTION.fullmatch, rows) if match}
    cameras = _kitti_cameras(named, choice)
    P = [array_of(rows[named[camera][0]].split(), (3, 4), named[camera][0]) for camera in cameras]
    sizes = [rows.get(f"S_rect_{named[camera][2]}") for camera in cameras]
    chosen = choice.cameras or FOLDER.search(choice.image_folder_hint or "")
    if {0, 1, 2, 3} <= named.keys() and not chosen:
        warn(WHICH)
    return projected(*P, *(None if size is None else size.split() for size in sizes))


def _mvsnet_view(text: str) -> tuple[np.ndarray, Camera]:
    """World-to-camera transform and camera; the line of depth range behind them is never looked at."""
    extrinsic, _, intrinsic = text.partition("extrinsic")[2].partition("intrinsic")
    # The rotations of hand-held sets are rigid to a few 1e-4 only; inverting them as they are would shear E.
    T = rigid(extrinsic.split()[:16], "extrinsic")
    return T, Camera(array_of(intrinsic.split()[:9], (3, 3), "intrinsic"))


def read_mvsnet(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """One ``cam.txt`` a view, in the unit of the files: metres in most sets, millimetres in DTU."""
    (T_left_from_world, left), (T_right_from_world, right) = map(_mvsnet_view, texts)
    return make_rig(left, right, T_left_from_world @ np.linalg.inv(T_right_from_world))
