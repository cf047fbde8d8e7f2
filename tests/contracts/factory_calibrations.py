"""Calibrations in the layouts that makers of rigs and calibration tools write, all of a rig of 0.12 m."""

from __future__ import annotations

import json
from pathlib import Path

from geodiff_plugin.formats import read_calibration
from geodiff_plugin.types import Rig

# Stereolabs: millimetres, one pair of sections a resolution.
ZED_CAMERA = "fx={f}\nfy={f}\ncx={cx}\ncy={cy}\nk1=0\nk2=0\np1=0\np2=0\nk3=0\n"
ZED = "\n".join(
    f"[{side}_CAM_{name}]\n" + ZED_CAMERA.format(f=f, cx=cx, cy=cy)
    for name, f, cx, cy in (("2K", 1400, 1100, 620), ("HD", 700, 640.5, 360.25))
    for side in ("LEFT", "RIGHT")
)
ZED += (
    "\n[STEREO]\nBaseline=120\nTY=0\nTZ=0\nCV_2K=0\nCV_HD=0\nRX_2K=0\nRX_HD=0\nRZ_2K=0\nRZ_HD=0\n\n"
    "[MISC]\nSensor_ID=0\n"
)

# What rs-enumerate-devices -c prints, behind its list of modes.
REALSENSE_PRINTED = """Intrinsic Parameters:

 Intrinsic of "Infrared 1" / 640x480 / {Y8}
  Width:        640
  Height:       480
  PPX:          300
  PPY:          200
  Fx:           700
  Fy:           700
  Distortion:   Brown Conrady
  Coeffs:       0       0       0       0       0
  FOV (deg):    49.13 x 37.85

 Intrinsic of "Infrared 2" / 640x480 / {Y8}
  Width:        640
  Height:       480
  PPX:          300
  PPY:          200
  Fx:           700
  Fy:           700
  Distortion:   Brown Conrady
  Coeffs:       0       0       0       0       0
  FOV (deg):    49.13 x 37.85

Extrinsic Parameters:

 Extrinsic from "Infrared 1"      To      "Infrared 1" :
 Rotation Matrix:
   1                0                0
   0                1                0
   0                0                1

 Translation Vector: 0  0  0

 Extrinsic from "Infrared 1"      To      "Infrared 2" :
 Rotation Matrix:
   1                0                0
   0                1                0
   0                0                1

 Translation Vector: -0.12  0  0

 Extrinsic from "Infrared 2"      To      "Infrared 1" :
 Rotation Matrix:
   1                0                0
   0                1                0
   0                0                1

 Translation Vector: 0.12  0  0
"""
RS2_INTRINSICS = {
    "width": 640,
    "height": 480,
    "ppx": 300.0,
    "ppy": 200.0,
    "fx": 700.0,
    "fy": 700.0,
    "model": "distortion.brown_conrady",
    "coeffs": [0.0, 0.0, 0.0, 0.0, 0.0],
}
RS2_EXTRINSICS = {"rotation": [1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0], "translation": [-0.12, 0.0, 0.0]}
REALSENSE_JSON = json.dumps(
    {
        "serial": "123456789",
        "intrinsics": {"infra1": RS2_INTRINSICS, "infra2": RS2_INTRINSICS, "color": RS2_INTRINSICS},
        "extrinsics": {"infra1_to_infra2": RS2_EXTRINSICS, "infra1_to_color": RS2_EXTRINSICS},
    },
    indent=1,
)

# Luxonis: centimetres; cameras as pairs of socket and camera, the left one (1) linked to the right one (2).
TURN = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def _oak_camera(to: int, x_cm: float) -> dict:
    shift = {"x": x_cm, "y": 0.0, "z": 0.0}
    return {
        "cameraType": 0,
        "distortionCoeff": [8.1, -21.9, 0.001, -0.0002, 62.5, 7.9, -21.1, 60.8, 0, 0, 0, 0, 0, 0],
        "extrinsics": {
            "rotationMatrix": TURN,
            "specTranslation": shift,
            "toCameraSocket": to,
            "translation": shift,
        },
        "height": 800,
        "intrinsicMatrix": [[700.0, 0.0, 640.0], [0.0, 700.0, 400.0], [0.0, 0.0, 1.0]],
        "lensPosition": 0,
        "specHfovDeg": 71.9,
        "width": 1280,
    }


OAK_DATA = {
    "batchName": "",
    "boardName": "OAK-D",
    "cameraData": [[2, _oak_camera(0, 4.0)], [1, _oak_camera(2, -12.0)], [0, _oak_camera(-1, 0.0)]],
    "stereoRectificationData": {
        "leftCameraSocket": 1,
        "rectifiedRotationLeft": TURN,
        "rectifiedRotationRight": TURN,
        "rightCameraSocket": 2,
    },
    "version": 6,
}
OAK = json.dumps(OAK_DATA, indent=1)

# camera_calibration's left.yaml and right.yaml: metres, -fx * baseline in the right one's P.
ROS_LEFT = """image_width: 640
image_height: 480
camera_name: narrow_stereo/left
camera_matrix:
  rows: 3
  cols: 3
  data: [710., 0., 305., 0., 710., 205., 0., 0., 1.]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28, 0.09, 0.001, 0.0002, 0.0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [700., 0., 300., 0., 0., 700., 200., 0., 0., 0., 1., 0.]
"""
ROS_RIGHT = ROS_LEFT.replace("[700., 0., 300., 0.,", "[700., 0., 300., -84.,").replace("/left", "/right")
# ros2 topic echo --once /left/camera_info.
ROS_ECHO_LEFT = """header:
  stamp:
    sec: 1700000000
    nanosec: 0
  frame_id: left
height: 480
width: 640
distortion_model: plumb_bob
d: [-0.28, 0.09, 0.001, 0.0002, 0.0]
k: [710.0, 0.0, 305.0, 0.0, 710.0, 205.0, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [700.0, 0.0, 300.0, 0.0, 0.0, 700.0, 200.0, 0.0, 0.0, 0.0, 1.0, 0.0]
---
"""
ROS_ECHO_RIGHT = ROS_ECHO_LEFT.replace("p: [700.0, 0.0, 300.0, 0.0", "p: [700.0, 0.0, 300.0, -84.0")

KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [700.0, 700.0, 300.0, 200.0]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.12]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.0, 0.0, 0.0, 0.0]
  distortion_model: radtan
  intrinsics: [700.0, 700.0, 300.0, 200.0]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""

# EuRoC: each camera's pose in the body's frame, whose x axis is the cameras' z.
_EUROC = """# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0, 0.0, 1.0, 0.3,
         -1.0, 0.0, 0.0, {y},
         0.0, -1.0, 0.0, 0.2,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [640, 480]
camera_model: pinhole
intrinsics: [700.0, 700.0, 300.0, 200.0] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [0.0, 0.0, 0.0, 0.0]
"""
EUROC_LEFT, EUROC_RIGHT = _EUROC.format(y=0.06), _EUROC.format(y=-0.06)

# ORB-SLAM3's settings of version 1.0, and those before it of rectified images.
ORB_SLAM = """%YAML:1.0

File.version: "1.0"

Camera.type: "PinHole"

# Left camera
Camera1.fx: 700.0
Camera1.fy: 700.0 # pixels
Camera1.cx: 300.0
Camera1.cy: 200.0
Camera1.k1: 0.0
Camera1.k2: 0.0
Camera1.p1: 0.0
Camera1.p2: 0.0

Camera2.fx: 700.0
Camera2.fy: 700.0
Camera2.cx: 300.0
Camera2.cy: 200.0

Camera.width: 640
Camera.height: 480
Camera.fps: 20

Stereo.T_c1_c2: !!opencv-matrix
  rows: 4
  cols: 4
  dt: f
  data: [1.0, 0.0, 0.0, 0.12,
         0.0, 1.0, 0.0, 0.0,
         0.0, 0.0, 1.0, 0.0,
         0.0, 0.0, 0.0, 1.0]
"""
ORB_SLAM_RECTIFIED = """%YAML:1.0
Camera.fx: 700.0
Camera.fy: 700.0
Camera.cx: 300.0
Camera.cy: 200.0

Camera.k1: 0.0
Camera.k2: 0.0
Camera.p1: 0.0
Camera.p2: 0.0

Camera.width: 640
Camera.height: 480

# stereo baseline times fx
Camera.bf: 84.0

ThDepth: 35 # times the baseline
"""

COLMAP_CAMERAS = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
# Number of cameras: 1
1 PINHOLE 640 480 700 700 300.5 200.5
"""
# World-to-camera and no unit: the two cameras are half a unit apart.
COLMAP_IMAGES = """# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 3, mean observations per image: 1
1 1 0 0 0 0.25 1 -2 1 rig/left.jpg
320.5 240.25 17
2 0 1 0 0 5 6 7 1 rig/other.jpg
1.5 2.5 -1
3 1 0 0 0 -0.25 1 -2 1 rig/right.jpg

"""
COLMAP_CHOICE = {"image_names": ("rig/left.jpg", "rig/right.jpg"), "baseline_m": 0.12}

# One unit is 24 cm: the cameras stand half a unit apart, in a world whose z is up and whose y is forward.
NERF = """{
  "camera_model": "OPENCV",
  "fl_x": 700.0, "fl_y": 700.0, "cx": 300.5, "cy": 200.5, "w": 640, "h": 480,
  "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0,
  "frames": [
    {"file_path": "./images/left.jpg", "colmap_im_id": 1,
     "transform_matrix": [[1, 0, 0, 3.25], [0, 0, -1, 4], [0, 1, 0, 5], [0, 0, 0, 1]]},
    {"file_path": "./images/other.jpg", "colmap_im_id": 2,
     "transform_matrix": [[0, 1, 0, 7], [0, 0, -1, 8], [-1, 0, 0, 9], [0, 0, 0, 1]]},
    {"file_path": "./images/right.jpg", "colmap_im_id": 3,
     "transform_matrix": [[1, 0, 0, 3.75], [0, 0, -1, 4], [0, 1, 0, 5], [0, 0, 0, 1]]}
  ],
  "applied_transform": [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
}
"""
NERF_CHOICE = {"image_names": ("images/left.jpg", "images/right.jpg"), "baseline_m": 0.12}


def read_texts(folder: Path, *texts: str, **choice) -> Rig:
    """The rig of texts that are written to files first, ``choice`` as ``read_calibration`` takes it."""
    paths = [folder / f"file{number}" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return read_calibration(paths[0] if len(paths) == 1 else paths, **choice)
