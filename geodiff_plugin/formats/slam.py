"""Reads SLAM settings for rectified or raw images: ORB-SLAM, stella_vslam, StVO-PL.

Source: ``example/euroc/EuRoC_stereo.yaml`` of stella-cv/stella_vslam; ``config/dataset_params`` of
rubengooj/stvo-pl; ``Examples/Stereo`` of UZ-SLAMLab/ORB_SLAM3 and raulmur/ORB_SLAM2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.formats.rigs import (
    CameraChoice,
    RawCamera,
    array_of,
    intrinsics,
    make_rig,
    rectified_from,
    rigid,
    transform,
)
from geodiff_plugin.formats.storage import read_storage, read_yaml
from geodiff_plugin.types import Rig

Entries = dict[str, Any]
ORB_LENSES = {"PinHole": ("k1", "k2", "p1", "p2", "k3"), "KannalaBrandt8": ("k1", "k2", "k3", "k4")}
#: Keys of the right camera's pose in the left camera's frame, in settings of version 1.0 and older.
ORB_POSES = ("Stereo.T_c1_c2", "Tlr")
#: Keys of the baseline of rectified images and their camera types, by the left camera's name: version 1.0
#: states that images are rectified, older versions use the pinhole type.
ORB_RECTIFIED = {"Camera1": ("Stereo.b", ("Rectified",)), "Camera": ("Camera.bf", ("Rectified", "PinHole"))}


def read_stella(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read rectified images with one K, and with a ``StereoRectifier`` the raw cameras; metres."""
    content = read_yaml(texts[0])
    entries = content["Camera"]
    if entries.get("model") != "perspective" or "focal_x_baseline" not in entries:
        expected = "settings of a stereo camera (setup stereo, model perspective, focal_x_baseline)"
        got = f"setup {entries.get('setup')} and model {entries.get('model')}"
        bad_value("the settings", expected, got, "Pass stella_vslam's settings for stereo.")
    size = entries.get("cols"), entries.get("rows")
    K = intrinsics(*(entries[name] for name in ("fx", "fy", "cx", "cy")))
    baseline_m = array_of(entries["focal_x_baseline"], (), "focal_x_baseline") / K[0, 0]
    rig = make_rig(RawCamera(K, size), RawCamera(K, size), baseline_m, rectified=True)
    made = content.get("StereoRectifier")
    if made is None:
        return rig
    left, right = (
        RawCamera(
            array_of(made[f"K_{side}"], (3, 3), f"K_{side}"), size, made[f"D_{side}"], _stella_lens(made)
        )
        for side in ("left", "right")
    )
    return rectified_from(rig, left, right, (made["R_left"], made["R_right"]))


def _stella_lens(made: Entries) -> str:
    return str(made.get("model", "perspective"))


def read_stvo(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read StVO-PL's and PL-SLAM's ``cam0``: both cameras and R, t, or one K of rectified images; metres."""
    entries = read_yaml(texts[0])["cam0"]
    size = entries["cam_width"], entries["cam_height"]
    if "Kl" in entries:
        left, right = (RawCamera(intrinsics(*entries[f"K{n}"]), size, entries[f"D{n}"]) for n in "lr")
        return make_rig(left, right, np.linalg.inv(transform(entries["R"], entries["t"], "R, t")))
    K = intrinsics(*(entries[f"cam_{name}"] for name in ("fx", "fy", "cx", "cy")))
    lens = [entries.get(f"cam_d{n}", 0.0) for n in range(4)]
    camera = RawCamera(K, size, lens)
    return make_rig(camera, camera, entries["cam_bl"], rectified=not any(lens))


def _orb_camera(entries: Entries, name: str, kind: str) -> RawCamera:
    """Return a camera by name; a pinhole may omit zero coefficients."""
    keys = ("fx", "fy", "cx", "cy", *ORB_LENSES.get(kind, ()))
    default = 0.0 if kind == "PinHole" else None
    given = {key: entries.get(f"{name}.{key}".lower(), default if key[0] in "kp" else None) for key in keys}
    numbers = [array_of(value, (), f"{name}.{key}") for key, value in given.items()]
    size = [entries.get(f"camera.{side}", [None])[0] for side in ("width", "height")]
    return RawCamera(intrinsics(*numbers[:4]), size, numbers[4:], kind)


def read_orb_slam(texts: tuple[str, ...], choice: CameraChoice) -> Rig:
    """Read raw images with ``Stereo.T_c1_c2`` (or ``Tlr``), or rectified images with one K, in metres."""
    entries = read_storage(texts[0])
    kind = entries.get("camera.type", "PinHole")
    left = "Camera1" if "camera1.fx" in entries else "Camera"
    pose = next((name for name in ORB_POSES if name.lower() in entries), None)
    if pose is not None:
        first, second = (_orb_camera(entries, name, kind) for name in (left, "Camera2"))
        return make_rig(first, second, rigid(entries[pose.lower()], pose))
    baseline, types = ORB_RECTIFIED[left]
    # For a single camera with a depth sensor, the baseline is fictitious.
    depth_sensor = any(key.endswith("depthmapfactor") for key in entries)
    if depth_sensor or baseline.lower() not in entries or kind not in types:
        expected = f"settings of a stereo camera, with {ORB_POSES[0]}, or {baseline} of rectified images"
        got = f"a camera of type {kind} {'with a depth sensor' if depth_sensor else 'without them'}"
        bad_value("the settings", expected, got, "Pass ORB-SLAM's settings for stereo.")
    camera = _orb_camera(entries, left, "PinHole")
    if np.any(camera.coefficients):
        expected = f"zero for rectified images (no {ORB_POSES[0]})"
        bad_value(
            f"Lens distortion of {left}", expected, "other values", "The file may be of a single camera."
        )
    length = array_of(entries[baseline.lower()], (), baseline)
    return make_rig(camera, camera, length / (1.0 if left == "Camera1" else camera.K[0, 0]), rectified=True)
