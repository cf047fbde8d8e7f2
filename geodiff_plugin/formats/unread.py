"""Table of formats that are recognised but not supported, and errors that suggest alternatives."""

from __future__ import annotations

import codecs
import os
import re
from collections import Counter
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import NamedTuple, NoReturn

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.layouts import CaptureFormat

#: Number of leading bytes compared with a signature.
HEAD_BYTES = 4096
#: Limits, because listing a whole disk is slow: entries of a folder, subfolders compared with the formats,
#: and files per pattern whose first bytes are read.
MAX_ENTRIES, MAX_FOLDERS, MAX_HEADS = 2000, 20, 5
#: Maximum number of file types and folders in a message.
MAX_LISTED = 6
#: Minimum fraction of a format's patterns for it to be suggested.
MIN_FRACTION = 0.5
#: Subfolders of a project that contain its model.
MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "sensors")


class UnreadFormat(NamedTuple):
    """A format that is not supported.

    Attributes:
        files: patterns of its file or folder names, separated by blanks.
        content: regular expression that matches the first bytes of such a file; empty if the name is
            sufficient.
        name: description, as in "FILE, <name>" and "FILE is <name>".
        hint: alternative.
        has_poses: whether it may contain poses of the images in the same folder.
    """

    files: str
    content: str
    name: str
    hint: str
    has_poses: bool = True


# fmt: off
ONE_CAMERA = "It has one camera. Pass the stereo calibration, or K and E of the pair (--K, --K-right, --E)."
OF_PAIR = "Pass K of both, and the right camera's pose in the left camera's frame, in metres, as --E."
SAVE_NPZ = "Save its matrices in Python: np.savez('calib.npz', K1=K1, D1=D1, K2=K2, D2=D2, R=R, T=T)."
COLMAP_EXPORT = "Export its registration as COLMAP."
TO_TRANSFORMS = "Write its poses as transforms.json"
#: Matches RealEstate10K: the URL of a video, then the time of a frame and 18 camera parameters.
REAL_ESTATE = (
    r"\Ahttps?://\S+\s+\d+(?:[ \t]+[-+.\deE]+){18}", "a RealEstate10K sequence",
    "Write it as transforms.json: its fx fy cx cy are fractions of the image's width and height, and its 3x4 "
    "matrix maps the world to the camera.",
)
CALIBRATIONS = tuple(UnreadFormat("*", *row) for row in (
    (r"<(?:imagelist|images)>\s*\"", "a list of the calibration's images",
     "Pass the result of the calibration: intrinsics.yml and extrinsics.yml of OpenCV's sample."),
    (r"\A\s*(RadTan|Pinhole|EquiDistant|KannalaBrandt|FOV|ATAN)[ \t]+[-+.\d]", "a DSO camera.txt",
     ONE_CAMERA),
    (r"\AMATLAB 5\.0 MAT-file|\A\x89HDF", "a MATLAB .mat (or HDF5) file",
     "In MATLAB: writelines(jsonencode(toStruct(stereoParams)), 'stereo.json')."),
    (r"\A\x80[\x02-\x05]", "pickled objects, which are never loaded", SAVE_NPZ),
    (r"\A\x93NUMPY", "a single array", f"Pass it as --K or --E. {SAVE_NPZ}"),
    (r"\APIEH", "an MPI Sintel .cam", f"Read it with its sintel_io.py. {ONE_CAMERA}"),
    (r"^\s*(Camera-system parameters|Calibration results)\s*:?\s*$", "Kalibr's results as text",
     "Pass the camchain.yaml of the same run."),
    (r"<calibration>\s*<projection>", "a Metashape lens (XML)", ONE_CAMERA),
    (r"\A(?=[\s\S]*^model_type\s*:)(?![\s\S]*^cam0_calib\s*:)", "a VINS-Fusion camera",
     "Pass the configuration with both cameras (cam0_calib, cam1_calib)."),
    (r"^Device info\s*:", "a RealSense without calibration", "Pass the output of rs-enumerate-devices -c."),
    (r'\A\s*\[(?=[\s\S]*"transform")(?=[\s\S]*"intrinsics")[\s\S]*"distortion_model"',
     "a cuVSLAM rig (.edex)", OF_PAIR),
    (r'"CalibrationInformation"',
     "an Azure Kinect calibration, whose colour and depth cameras are not a stereo pair",
     "Pass only its colour image, with --K and the depth map as --points."),
    (r'"calibDataSource"', "Panoptic Studio cameras",
     f"Its R and t are world-to-camera, in centimetres. {OF_PAIR}"),
    (r'\A\s*\{\s*"class_name"[\s\S]*"extrinsic_r"', "an XRPrimer camera",
     f"If world2cam is true, extrinsic_r and extrinsic_t are world-to-camera. {OF_PAIR}"),
    (r'\A\s*\[[\s\S]*"camera_intrinsic"|\A\s*\{\s*"extrinsics"\s*:\s*\[\s*\{\s*"rotation"',
     "cameras in a vehicle's frame (nuScenes, DGP)", OF_PAIR),
    (r"^fu\s*=[\s\S]*^u_direction\s*=", "an Ames Stereo Pipeline camera (.tsai)",
     f"Its R and C are camera-to-world. {OF_PAIR}"),
    REAL_ESTATE,
    (r"\A# Bundle file|\ANVM_V3|<document[^>]*>\s*<chunk|\A\s*\[\s*\{[\s\S]*\"(shots|cameras)\"",
     "a reconstruction of many images", "Pass it to geodiff capture."),
    (r"^\s*camRect\d+\s*:|^\s*disparity_to_depth\s*:", "a DSEC cam_to_cam.yaml",
     "Pass --fx --fy --cx --cy of the pair's camRect, and 1 / Q[3][2] as --baseline."),
    (r"^camera\.A\s*=\s*\[", "rc_visard or cvkit parameters",
     "Pass --fx --fy --cx --cy of its camera.A, and its t as --baseline."),
    (r'\A\s*\{(?=[\s\S]*"intrinsic_matrix")', "an Open3D camera", ONE_CAMERA),
))
CAPTURES = tuple(UnreadFormat(*row) for row in (
    ("*.sens", "", "a ScanNet sequence",
     "Export it with SensReader: reader.py --export_color_images --export_poses --export_intrinsics."),
    ("*.r3d", "", "a Record3D archive", "Export it from the app as EXR + JPG sequence."),
    ("*.psx *.psz", "", "a Metashape project",
     "In Metashape: File, Export, Export Cameras, as Agisoft XML."),
    ("*.vrs", "", "a Project Aria recording", "Export images and poses with projectaria_tools."),
    ("sfm_data*.bin", "", "an OpenMVG reconstruction",
     "Run: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json -V -I -E."),
    ("*.mg", "", "a Meshroom project", "Pass cameras.sfm of its StructureFromMotion folder."),
    ("*.mvs", "", "an OpenMVS scene", "Pass the COLMAP model that it was made from."),
    ("database.db", "", "COLMAP's matches without a model",
     "Run: colmap mapper --database_path database.db --image_path images --output_path sparse.", False),
    ("*_annotations.jgz", "", "CO3D annotations", "Write a sequence as transforms.json."),
    ("*.svo *.svo2", "", "a ZED recording", "Export it as a video with ZED_SVO_Editor."),
    ("*.rcproj", "", "a RealityCapture project", COLMAP_EXPORT),
    ("*.csv", r"\A#(name,x,y|cameras \d)", "RealityCapture cameras", COLMAP_EXPORT),
    ("*.xml", r"<BlocksExchange", "a ContextCapture block (BlocksExchange)",
     "Export it for COLMAP, or export undistorted images with transforms.json."),
    ("*_calibrated_camera_parameters.txt", "", "Pix4D cameras",
     "Write them as transforms.json: R is world-to-camera, t the camera position."),
    ("shots.geojson", "", "OpenDroneMap shots",
     "Pass the project, whose opensfm/reconstruction.json has the same cameras."),
    ("*.json", r'"PinholeCameraTrajectory"', "an Open3D trajectory",
     "Write it as transforms.json: its extrinsics are world-to-camera, column-major."),
    ("intri.yml extri.yml", "", "EasyMocap cameras",
     "Put simultaneous images of all cameras into a folder with transforms.json."),
    ("KeyFrameData", "", "a 4Seasons recording",
     "Write its camToWorld as transforms.json, or pass undistorted_images/cam0 with --K."),
    ("extrinsic.txt", r"\Aframe\s+cameraID", "Virtual KITTI cameras",
     "Pass two images to geodiff depth, with --calib intrinsic.txt --calib extrinsic.txt."),
    ("rtabmap*.db", "", "an RTAB-Map database",
     "Export images and the poses of the camera (RGB-D SLAM format) with rtabmap-export."),
    ("oxts", "", "the GPS of a KITTI raw drive",
     f"{TO_TRANSFORMS} (pykitti computes them), or pass two images to geodiff depth with --calib."),
    ("pose_intrinsic_imu.json", "", "ScanNet++ phone poses",
     "Pass the scene, whose dslr/ is supported, or write these as transforms.json."),
    ("scene_camera.json", "", "BOP dataset cameras",
     "Write its cam_R_w2c and cam_t_w2c, in millimetres, as transforms.json."),
    ("*.txt", r"\A\S+\.(?i:jpe?g|png)(?:[ \t]+[-+.\deE]+){9}[ \t]*$", "ACE0 poses",
     "Write them as transforms.json: w x y z and the translation are world-to-camera."),
    ("*.txt", *REAL_ESTATE),
    ("ARKit_camera_pose.txt", "", "ARKit Data Logger poses",
     "Write them as transforms.json: they are camera-to-world, in OpenGL's axes."),
    ("airsim_rec.txt", "", "an AirSim recording",
     "Write it as transforms.json: its world is north, east, down, its bodies forward, right, down."),
    ("trainval_poses.txt", "", "a Neural RGB-D scene",
     f"{TO_TRANSFORMS}: four rows each, camera-to-world, in OpenGL's axes."),
    ("v1.0-*", "", "a part of nuScenes", "Write one camera's poses as transforms.json."),
    ("city_SE3_egovehicle.feather", "", "an Argoverse 2 log", "Write one camera's poses as transforms.json."),
    ("data_poses cam0_to_world.txt", "", "KITTI-360 poses",
     "Write them as transforms.json, or pass two images to geodiff depth with --calib perspective.txt."),
    ("*.tfrecord", "", "a Waymo recording", "Write images and poses as transforms.json."),
    ("*.hdf5 *.h5", "", "arrays in HDF5", "Write images and poses as transforms.json."),
    ("*.traj", "", "an ARKitScenes trajectory", "Write it as transforms.json."),
    ("image_lcam_front", "", "a TartanAir V2 folder", f"{TO_TRANSFORMS}."),
    ("*.bag *.mcap *.db3", "", "a ROS bag", "Pass it to geodiff depth, with --left-topic and --right-topic."),
    ("cfg_args", "", "a 3D Gaussian splatting result", "Pass the project that it was trained on."),
    ("*.zip *.tar *.tgz *.tar.gz *.7z *.rar", "", "an archive", "Unpack it and pass its folder.", False),
    ("*.ply *.splat *.spz *.obj *.glb *.usdz", "", "a model without its images",
     "Pass the images with their cameras.", False),
    ("*.pkl *.pickle *.pt", "", "pickled objects", "They are never loaded. Save them as .npz.", False),
))
# fmt: on


def _has_content(file: Path, content: str) -> bool:
    """Whether the first bytes of a readable file, text or binary, match a regular expression."""
    if not content:
        return True
    if not os.path.isfile(file) or not os.access(file, os.R_OK):
        return False
    with file.open("rb") as opened:
        head = opened.read(HEAD_BYTES).removeprefix(codecs.BOM_UTF8).decode("latin-1")
    return re.search(content, head, re.MULTILINE | re.ASCII) is not None


def raise_unread_calibration(file: Path) -> None:
    """Raise an error for a calibration file in an unsupported format."""
    _raise_unsupported(file, CALIBRATIONS, "calibration", "in a supported format")


def raise_unread_capture(source: Path) -> None:
    """Raise an error for a capture file in an unsupported format; ``raise_unknown`` handles folders."""
    _raise_unsupported(source, CAPTURES, "PATH", "a supported capture")


def _raise_unsupported(file: Path, formats: Sequence[UnreadFormat], name: str, expected: str) -> None:
    if not os.path.isfile(file):
        return  # the reader of the file reports the error
    for each in formats:
        if any(file.match(pattern) for pattern in each.files.split()) and _has_content(file, each.content):
            bad_value(name, expected, f"{file}, {each.name}", each.hint)


def raise_unknown(source: Path, formats: Sequence[CaptureFormat]) -> NoReturn:
    """Raise an error for an unrecognised path: its content, the nearest format, and all formats."""
    *others, last = (each.summary for each in formats)
    expected = "a supported capture"
    all_formats = f"Supported are: {', '.join(others)} and {last}."
    if source.is_file():
        check_file(source, "PATH", expected)  # failed downloads have a separate hint
        bad_value("PATH", expected, source, all_formats)
    posed = [each for each in formats if each.has_poses]
    hints = [_rig(source), _unread_inside(source), _inside(source, posed), _nearest(source, posed)]
    hint = " ".join(filter(None, hints)) or _inside(source, formats)
    got = f"{source}, which contains {_content(source)}"
    bad_value("PATH", expected, got, f"{hint} {all_formats}".strip())


def poses_in_folder(folder: Path, formats: Sequence[CaptureFormat]) -> tuple[Finding, ...]:
    """Return a finding if a folder's images are read without poses although it may contain some."""
    posed = [each for each in formats if each.has_poses]
    hints = [_unread_inside(folder, only_poses=True), _inside(folder, posed), _above(folder, posed)]
    text = " ".join(filter(None, hints))
    return (Finding("capture.unused-poses", f"Images are read without poses. {text}"),) if text else ()


def _content(folder: Path) -> str:
    """List the file types in a folder, and its subfolders."""
    entries = list(islice(folder.iterdir(), MAX_ENTRIES))
    kinds = Counter(path.suffix.lower() or path.name for path in entries if path.is_file())
    folders = sorted(f"{path.name}/" for path in entries if path.is_dir())[:MAX_LISTED]
    return ", ".join([f"{n} {kind}" for kind, n in kinds.most_common(MAX_LISTED)] + folders) or "nothing"


def _unread_inside(folder: Path, only_poses: bool = False) -> str:
    """Describe a file of an unsupported format in the folder, and the alternative."""
    for each in CAPTURES:
        found = (path for name in each.files.split() for path in sorted(folder.glob(name))[:MAX_HEADS])
        file = next((file for file in found if _has_content(file, each.content)), None)
        if file is not None and (each.has_poses or not only_poses):
            return f"{file.name} is {each.name}. {each.hint}"
    return ""


def _rig(folder: Path) -> str:
    """Return the hint for a folder with one folder of left and one of right images."""
    names = [path.name for path in islice(folder.iterdir(), MAX_ENTRIES) if path.is_dir()]
    sides = [next((n for n in names if n.lower().startswith(side)), None) for side in ("left", "right")]
    if None in sides:
        return ""
    return f"For pairs of a stereo rig, use geodiff depth with {sides[0]}/, {sides[1]}/ and --calib."


def _inside(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """Return a hint on the first subfolder that looks like a supported capture."""
    below = sorted(path for path in islice(folder.iterdir(), MAX_ENTRIES) if path.is_dir())[:MAX_FOLDERS]
    for each in formats:
        for place in below:
            if all(_has(place, patterns) for patterns in each.patterns):
                return f"{place.name}/ looks like {each.summary}; pass that folder."
    return ""


def _above(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """Return a hint on the parent folder, if it looks like a capture whose camera file lists images."""
    above = folder.resolve().parent
    for each in formats:
        marks = [[name.removeprefix("**/") for name in patterns] for patterns in each.patterns]
        if not each.names_images or marks[0][0].startswith("*"):  # any program may write a *.xml
            continue
        if any(all(_has(above / place, mark) for mark in marks) for place in MODEL_FOLDERS):
            return f"The parent folder {above.name}/ looks like {each.summary}; pass that folder."
    return ""


def _has(folder: Path, patterns: Sequence[str]) -> bool:
    return any(any(folder.glob(pattern)) for pattern in patterns)


def _nearest(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """Return the format with most of its files present, if at least half are."""
    best = (MIN_FRACTION, 0)
    text = ""
    for each in formats:
        present = [_has(folder, patterns) for patterns in each.patterns]
        # Files are more specific than folders.
        files = sum(is_there and "." in p[0] for is_there, p in zip(present, each.patterns, strict=True))
        score = sum(present) / len(present), files
        if not all(present) and score > best:
            missing = [p for is_there, p in zip(present, each.patterns, strict=True) if not is_there]
            also = ", ".join(" or ".join(name.removeprefix("**/") for name in p) for p in missing)
            best = score
            text = f"The most similar format is {each.summary}, which also has {also}."
    return text
