"""Calibrations in the settings of visual odometry and SLAM: OKVIS, SVO, stella_vslam, AirSLAM, StVO-PL.

Source: ``config/config_fpga_p2_euroc.yaml`` of ethz-asl/okvis and ``config/euroc.yaml`` of
smartroboticslab/okvis2; ``svo_ros/param/calib/euroc_stereo.yaml`` of uzh-rpg/rpg_svo_pro_open;
``example/euroc/EuRoC_stereo.yaml`` of stella-cv/stella_vslam; ``configs/camera`` of sair-lab/AirSLAM;
``config/dataset_params`` of rubengooj/stvo-pl.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.named import read_opencv
from geodiff_plugin.formats.rigs import (
    Camera,
    CameraChoice,
    array_of,
    intrinsics,
    make_rig,
    rectified_from,
    rigid,
    two_cameras,
)
from geodiff_plugin.formats.storage import read_yaml, without_sizes
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
#: AirSLAM's ``distortion_type``: OpenCV's model and how many of the five coefficients it has.
AIRSLAM_LENSES = {0: ("opencv", 0), 1: ("opencv", 5), 2: ("fisheye", 4)}


def read_okvis(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """OKVIS' cameras; ``T_SC`` is a camera's pose in the frame of the IMU, in metres."""
    cameras = read_yaml(texts[0])["cameras"]
    pair = two_cameras(choice, range(len(cameras)), (0, 1))
    poses = [rigid(cameras[n]["T_SC"], f"T_SC of camera {n}") for n in pair]
    left, right = (_okvis_camera(cameras[n]) for n in pair)
    return make_rig(left, right, np.linalg.inv(poses[0]) @ poses[1])


def _okvis_camera(entries: Entries) -> Camera:
    K = intrinsics(*entries["focal_length"], *entries["principal_point"])
    return Camera(
        K, entries["image_dimension"], entries["distortion_coefficients"], entries["distortion_type"]
    )


def read_svo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """A rig of SVO or maplab; ``T_B_C`` is a camera's pose in the body's frame, ``T_C_B`` its inverse.

    maplab's files of all sensors list it among them.
    """
    content = read_yaml(texts[0])
    rig = next((each for each in content.get("sensors", ()) if "cameras" in each), content)
    cameras = rig["cameras"]
    pair = two_cameras(choice, range(len(cameras)), (0, 1))
    poses = []
    for n in pair:
        name = "T_B_C" if "T_B_C" in cameras[n] else "T_C_B"
        pose = rigid(without_sizes(cameras[n][name]), f"{name} of camera {n}")
        poses.append(pose if name == "T_B_C" else np.linalg.inv(pose))
    left, right = (_svo_camera(cameras[n]["camera"]) for n in pair)
    return make_rig(left, right, np.linalg.inv(poses[0]) @ poses[1])


def _svo_camera(entries: Entries) -> Camera:
    model, lens = str(entries["type"]), entries["distortion"]
    model = str(lens["type"]) if model == "pinhole" else model  # of another one the lens is refused
    size = entries["image_width"], entries["image_height"]
    K = intrinsics(*without_sizes(entries["intrinsics"]))
    return Camera(K, size, without_sizes(lens["parameters"]), model)


def read_stella(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Rectified images of one K, and with a ``StereoRectifier`` the cameras as they stand; metres."""
    content = read_yaml(texts[0])
    entries = content["Camera"]
    if entries.get("model") != "perspective" or "focal_x_baseline" not in entries:
        expected = "of a stereo camera (setup stereo, model perspective, focal_x_baseline)"
        got = f"of setup {entries.get('setup')} and model {entries.get('model')}"
        bad_value("the settings", expected, got, "Give the settings that stella_vslam runs in stereo with.")
    size = entries.get("cols"), entries.get("rows")
    K = intrinsics(*(entries[name] for name in ("fx", "fy", "cx", "cy")))
    baseline_m = array_of(entries["focal_x_baseline"], (), "focal_x_baseline") / K[0, 0]
    rig = make_rig(Camera(K, size), Camera(K, size), baseline_m, rectified=True)
    made = content.get("StereoRectifier")
    if made is None:
        return rig
    left, right = (
        Camera(array_of(made[f"K_{side}"], (3, 3), f"K_{side}"), size, made[f"D_{side}"], _stella_lens(made))
        for side in ("left", "right")
    )
    return rectified_from(rig, left, right, (made["R_left"], made["R_right"]))


def _stella_lens(made: Entries) -> str:
    return str(made.get("model", "perspective"))


def read_airslam(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """AirSLAM's cameras; ``T_type`` 0 says a camera's pose in the body's frame, 1 its inverse, in metres."""
    content = read_yaml(texts[0])
    kind = content.get("distortion_type")
    if kind not in AIRSLAM_LENSES:
        bad_value("distortion_type", f"one of {', '.join(map(str, AIRSLAM_LENSES))}", kind)
    model, count = AIRSLAM_LENSES[kind]
    size = content["image_width"], content["image_height"]
    poses, cameras = [], []
    for name in ("cam0", "cam1"):
        entries = content[name]
        pose = rigid(entries["T"], f"T of {name}")
        poses.append(pose if entries["T_type"] == 0 else np.linalg.inv(pose))
        lens = entries["distortion_coeffs"][:count]
        cameras.append(Camera(intrinsics(*entries["intrinsics"]), size, lens, model))
    return make_rig(cameras[0], cameras[1], np.linalg.inv(poses[0]) @ poses[1])


def read_stvo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """StVO-PL's and PL-SLAM's ``cam0``: both cameras and R, t, or one K of rectified images; metres."""
    entries = read_yaml(texts[0])["cam0"]
    size = entries["cam_width"], entries["cam_height"]
    if "Kl" in entries:
        return read_opencv((json.dumps(entries | {"image_size": size}),), choice)
    K = intrinsics(*(entries[f"cam_{name}"] for name in ("fx", "fy", "cx", "cy")))
    lens = [entries.get(f"cam_d{n}", 0.0) for n in range(4)]
    camera = Camera(K, size, lens)
    return make_rig(camera, camera, entries["cam_bl"], rectified=not any(lens))
