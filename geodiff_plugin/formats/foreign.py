"""Calibrations of formats that are known and not read: what each is, and what to give instead."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

from geodiff_plugin._checks import bad_value

#: Bytes by which a file is recognised.
HEAD_BYTES = 4096


@dataclass(frozen=True)
class ForeignCalibration:
    """A format that is not read: what its files begin with or hold early, what it is, and the cure."""

    mark: str
    name: str
    cure: str


ONE_CAMERA = "It is of one camera: give the stereo calibration, or K and E of the pair (--K, --K-right, --E)."
OF_PAIR = "Give K of both, and as --E the right camera's pose in the left camera's frame, in metres."
#: How a file of RealEstate10K begins: a video, then a frame's time and 18 numbers of its camera.
REAL_ESTATE_10K = r"\Ahttps?://\S+\s+\d+(?:[ \t]+[-+.\deE]+){18}"
REAL_ESTATE_10K_CURE = (
    "Write it as transforms.json: its fx fy cx cy are shares of the image's width and height, and its 3x4 "
    "matrix maps the world to the camera."
)
SAVE_NPZ = "In Python: np.savez('calib.npz', K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T) of its matrices."
FOREIGN_CALIBRATIONS = (
    ForeignCalibration(
        r"<(?:imagelist|images)>\s*\"",
        "a list of the calibration's pictures",
        "Give what the calibration wrote: intrinsics.yml and extrinsics.yml of OpenCV's sample.",
    ),
    ForeignCalibration(
        r"\A\s*(RadTan|Pinhole|EquiDistant|KannalaBrandt|FOV|ATAN)[ \t]+[-+.\d]",
        "a camera.txt of DSO",
        ONE_CAMERA,
    ),
    ForeignCalibration(
        r"\AMATLAB 5\.0 MAT-file|\A\x89HDF",
        "a .mat of MATLAB (or HDF5)",
        "In MATLAB: writelines(jsonencode(toStruct(stereoParams)), 'stereo.json').",
    ),
    ForeignCalibration(r"\A\x80[\x02-\x05]", "pickled objects, which are never loaded", SAVE_NPZ),
    ForeignCalibration(r"\A\x93NUMPY", "a single array", f"Give it as --K or --E. {SAVE_NPZ}"),
    ForeignCalibration(r"\APIEH", "a .cam of MPI Sintel", f"Read it by its sintel_io.py. {ONE_CAMERA}"),
    ForeignCalibration(
        r"^\s*(Camera-system parameters|Calibration results)\s*:?\s*$",
        "Kalibr's results as text",
        "Give the camchain.yaml of the same run.",
    ),
    ForeignCalibration(r"<calibration>\s*<projection>", "a lens of Metashape (XML)", ONE_CAMERA),
    ForeignCalibration(
        r"\A(?=[\s\S]*^model_type\s*:)(?![\s\S]*^cam0_calib\s*:)",
        "a camera of VINS-Fusion",
        "Give the configuration that names both cameras (cam0_calib, cam1_calib).",
    ),
    ForeignCalibration(
        r"^Device info\s*:",
        "a RealSense without its calibration",
        "Give what rs-enumerate-devices -c prints.",
    ),
    ForeignCalibration(
        r'\A\s*\[(?=[\s\S]*"transform")(?=[\s\S]*"intrinsics")[\s\S]*"distortion_model"',
        "a rig of cuVSLAM (.edex)",
        OF_PAIR,
    ),
    ForeignCalibration(
        r'"CalibrationInformation"',
        "the calibration of an Azure Kinect, whose colour and depth camera are no stereo pair",
        "Give its colour image alone, with --K and the depth map as --points.",
    ),
    ForeignCalibration(
        r'"calibDataSource"',
        "cameras of the Panoptic Studio",
        f"Its R and t are from the world to the camera, in centimetres. {OF_PAIR}",
    ),
    ForeignCalibration(
        r'\A\s*\{\s*"class_name"[\s\S]*"extrinsic_r"',
        "a camera of XRPrimer",
        f"If world2cam is true, extrinsic_r and extrinsic_t are from the world to the camera. {OF_PAIR}",
    ),
    ForeignCalibration(
        r'\A\s*\[[\s\S]*"camera_intrinsic"|\A\s*\{\s*"extrinsics"\s*:\s*\[\s*\{\s*"rotation"',
        "cameras of a vehicle's frame (nuScenes, DGP)",
        OF_PAIR,
    ),
    ForeignCalibration(
        r"^fu\s*=[\s\S]*^u_direction\s*=",
        "a camera of the Ames Stereo Pipeline (.tsai)",
        f"Its R and C are from the camera to the world. {OF_PAIR}",
    ),
    ForeignCalibration(
        REAL_ESTATE_10K,
        "a sequence of RealEstate10K",
        REAL_ESTATE_10K_CURE,
    ),
    ForeignCalibration(
        r"\A# Bundle file|\ANVM_V3|<document[^>]*>\s*<chunk|\A\s*\[\s*\{[\s\S]*\"(shots|cameras)\"",
        "a reconstruction of many images",
        "Give it to geodiff capture.",
    ),
    ForeignCalibration(
        r"^\s*camRect\d+\s*:|^\s*disparity_to_depth\s*:",
        "a cam_to_cam.yaml of DSEC",
        "Give --fx --fy --cx --cy of the pair's camRect, and as --baseline 1 / Q[3][2] of its Q.",
    ),
    ForeignCalibration(
        r"^camera\.A\s*=\s*\[",
        "parameters of an rc_visard or of cvkit",
        "Give --fx --fy --cx --cy of its camera.A, and its t as --baseline.",
    ),
    ForeignCalibration(r'\A\s*\{(?=[\s\S]*"intrinsic_matrix")', "a camera of Open3D", ONE_CAMERA),
)


def refuse_foreign_calibration(file: Path) -> None:
    """Refuse a file of a format that is known and not read."""
    if not os.path.isfile(file) or not os.access(file, os.R_OK):
        return  # what is wrong is said where it is read
    with file.open("rb") as opened:
        head = opened.read(HEAD_BYTES).decode("latin-1")
    for each in FOREIGN_CALIBRATIONS:
        if re.search(each.mark, head, re.MULTILINE):
            bad_value("calibration", "in a format that is read", f"{file}, {each.name}", each.cure)
