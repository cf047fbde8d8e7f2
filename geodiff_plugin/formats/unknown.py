"""What to say of a path that is no capture: formats that are known but not read, and the nearest that is."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NoReturn

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.files import check_file
from geodiff_plugin.formats.foreign import REAL_ESTATE_10K, REAL_ESTATE_10K_CURE
from geodiff_plugin.formats.layouts import CaptureFormat
from geodiff_plugin.messages import Message

#: Files of a folder that are looked at: listing a whole disk takes long.
MOST_FILES = 2000
#: Kinds of files that a message gives.
MOST_KINDS = 6
#: Folders in it that are compared with the formats.
MOST_FOLDERS = 20
#: Where a model lies in the folder above that of its images, beside that folder itself.
MODEL_FOLDERS = ("", "sparse/0", "sparse", "colmap/sparse/0", "sensors")
#: Files of one mark whose beginnings are compared.
MOST_LOOKED_AT = 5
#: Bytes of a beginning.
HEAD_BYTES = 4096
#: The share of a format's marks from which it counts as near.
LEAST_MARKS = 0.5


@dataclass(frozen=True)
class ForeignFormat:
    """A format that is not read: names of its files, what it is, and what converts it.

    ``content`` is a regular expression that the beginning of such a file has, where names alone do not tell.
    ``has_poses``: it may hold poses of the photographs beside it.
    """

    marks: tuple[str, ...]
    name: str
    cure: str
    content: str = ""
    has_poses: bool = True


SENS = "SensReader's reader.py --export_color_images --export_poses --export_intrinsics writes what is read."
MAPPER = "Run: colmap mapper --database_path database.db --image_path images --output_path sparse."
COLMAP_EXPORT = "Export its registration as COLMAP."
PSX = "In Metashape: File, Export, Export Cameras, as Agisoft XML."
FOREIGN = (
    ForeignFormat(("*.sens",), "a sequence of ScanNet", SENS),
    ForeignFormat(("*.r3d",), "an archive of Record3D", "Export it from the app as EXR + JPG sequence."),
    ForeignFormat(("*.psx", "*.psz"), "a project of Metashape", PSX),
    ForeignFormat(("*.vrs",), "a recording of Project Aria", "Export images and poses by projectaria_tools."),
    ForeignFormat(
        ("sfm_data*.bin",),
        "a reconstruction of OpenMVG",
        "Run: openMVG_main_ConvertSfM_DataFormat -i sfm_data.bin -o sfm_data.json -V -I -E.",
    ),
    ForeignFormat(("*.mg",), "a project of Meshroom", "Give cameras.sfm of its StructureFromMotion folder."),
    ForeignFormat(("*.mvs",), "a scene of OpenMVS", "Give the COLMAP model that it was made from."),
    ForeignFormat(("database.db",), "COLMAP's matches without a model", MAPPER, has_poses=False),
    ForeignFormat(("*_annotations.jgz",), "annotations of CO3D", "Write a sequence as transforms.json."),
    ForeignFormat(("*.svo", "*.svo2"), "a recording of ZED", "Export it as a video with ZED_SVO_Editor."),
    ForeignFormat(("*.rcproj",), "a project of RealityCapture", COLMAP_EXPORT),
    ForeignFormat(("*.csv",), "cameras of RealityCapture", COLMAP_EXPORT, r"\A#(name,x,y|cameras \d)"),
    ForeignFormat(
        ("*.xml",),
        "a block of ContextCapture (BlocksExchange)",
        "Export it for COLMAP, or its images without distortion with transforms.json.",
        r"<BlocksExchange",
    ),
    ForeignFormat(
        ("*_calibrated_camera_parameters.txt",),
        "cameras of Pix4D",
        "Write them as transforms.json: R is from the world to the camera, t the place of the camera.",
    ),
    ForeignFormat(
        ("shots.geojson",),
        "shots of OpenDroneMap",
        "Give the project: its opensfm/reconstruction.json has the same cameras.",
    ),
    ForeignFormat(
        ("*.json",),
        "a trajectory of Open3D",
        "Write it as transforms.json: its extrinsics are from the world to the camera, by columns.",
        r'"PinholeCameraTrajectory"',
    ),
    ForeignFormat(
        ("intri.yml", "extri.yml"),
        "cameras of EasyMocap",
        "Put one moment's image of each camera into a folder with transforms.json.",
    ),
    ForeignFormat(
        ("KeyFrameData",),
        "a recording of 4Seasons",
        "Write its camToWorld as transforms.json, or give undistorted_images/cam0 with --K.",
    ),
    ForeignFormat(
        ("extrinsic.txt",),
        "cameras of Virtual KITTI",
        "Give two images to geodiff depth, with --calib intrinsic.txt --calib extrinsic.txt.",
        r"\Aframe\s+cameraID",
    ),
    ForeignFormat(
        ("rtabmap*.db",),
        "a database of RTAB-Map",
        "Export images and the poses of the camera (RGB-D SLAM format) by rtabmap-export.",
    ),
    ForeignFormat(
        ("oxts",),
        "the GPS of a drive of KITTI raw",
        "Write its poses (pykitti's) as transforms.json, or give two images to geodiff depth with --calib.",
    ),
    ForeignFormat(
        ("pose_intrinsic_imu.json",),
        "poses of a phone of ScanNet++",
        "Give the scene, whose dslr/ is read, or write these as transforms.json.",
    ),
    ForeignFormat(
        ("scene_camera.json",),
        "cameras of a BOP data set",
        "Write its cam_R_w2c and cam_t_w2c, in millimetres, as transforms.json.",
    ),
    ForeignFormat(
        ("*.txt",),
        "poses of ACE0",
        "Write them as transforms.json: w x y z and the translation are from the world to the camera.",
        r"\A\S+\.(?i:jpe?g|png)(?:[ \t]+[-+.\deE]+){9}[ \t]*$",
    ),
    ForeignFormat(
        ("*.txt",),
        "a sequence of RealEstate10K",
        REAL_ESTATE_10K_CURE,
        REAL_ESTATE_10K,
    ),
    ForeignFormat(
        ("ARKit_camera_pose.txt",),
        "poses of ARKit Data Logger",
        "Write them as transforms.json: they are camera-to-world, in OpenGL's axes.",
    ),
    ForeignFormat(
        ("airsim_rec.txt",),
        "a recording of AirSim",
        "Write it as transforms.json: its world is north, east, down, its bodies forward, right, down.",
    ),
    ForeignFormat(
        ("trainval_poses.txt",),
        "a scene of Neural RGB-D",
        "Write its poses as transforms.json: four rows each, camera-to-world, in OpenGL's axes.",
    ),
    ForeignFormat(("v1.0-*",), "a part of nuScenes", "Write one camera's poses as transforms.json."),
    ForeignFormat(
        ("city_SE3_egovehicle.feather",),
        "a log of Argoverse 2",
        "Write one camera's poses as transforms.json.",
    ),
    ForeignFormat(
        ("data_poses", "cam0_to_world.txt"),
        "poses of KITTI-360",
        "Write them as transforms.json, or give two images to geodiff depth with --calib perspective.txt.",
    ),
    ForeignFormat(("*.tfrecord",), "a recording of Waymo", "Write images and poses as transforms.json."),
    ForeignFormat(("*.hdf5", "*.h5"), "arrays in HDF5", "Write images and poses as transforms.json."),
    ForeignFormat(("*.traj",), "a trajectory of ARKitScenes", "Write it as transforms.json."),
    ForeignFormat(("image_lcam_front",), "a folder of TartanAir V2", "Write its poses as transforms.json."),
    ForeignFormat(
        ("*.bag", "*.mcap", "*.db3"), "a bag of ROS", "Give it to geodiff depth, with --left and --right."
    ),
    ForeignFormat(
        ("cfg_args",), "a result of 3D Gaussian splatting", "Give the project that it was trained on."
    ),
    ForeignFormat(
        ("*.zip", "*.tar", "*.tgz", "*.tar.gz", "*.7z", "*.rar"),
        "an archive",
        "Unpack it and give its folder.",
        has_poses=False,
    ),
    ForeignFormat(
        ("*.ply", "*.splat", "*.spz", "*.obj", "*.glb", "*.usdz"),
        "a model without its photographs",
        "Give the photographs with their cameras.",
        has_poses=False,
    ),
    ForeignFormat(
        ("*.pkl", "*.pickle", "*.pt"),
        "pickled objects",
        "They are never loaded: save .npz.",
        has_poses=False,
    ),
)


def refuse_foreign(source: Path) -> None:
    """Refuse a file of a format that is known and not read."""
    if source.is_file():
        for each in FOREIGN:
            if any(source.match(mark) for mark in each.marks) and _has_content(source, each.content):
                bad_value("PATH", "a capture that is read", f"{source}, {each.name}", each.cure)


def refuse_unknown(source: Path, formats: Sequence[CaptureFormat]) -> NoReturn:
    """Refuse a path that no reader recognises: what was looked for, what is there, and what comes nearest."""
    *others, last = (each.summary for each in formats)
    expected, all_formats = "a capture that is read", f"It is none of these: {', '.join(others)} or {last}."
    if source.is_file():
        check_file(source, "PATH", expected)  # what failed downloads leave has a cure of its own
        bad_value("PATH", expected, source, all_formats)
    posed = [each for each in formats if each.has_poses]
    hints = [_rig(source), _foreign(source), _inside(source, posed), _nearest(source, posed)]
    cure = " ".join(filter(None, hints)) or _inside(source, formats)
    got = f"{source}, which holds {_content(source)}"
    bad_value("PATH", expected, got, f"{cure} {all_formats}".strip())


def poses_beside(folder: Path, formats: Sequence[CaptureFormat]) -> tuple[Message, ...]:
    """What to say of a folder whose images are read without poses, though it may hold some."""
    posed = [each for each in formats if each.has_poses]
    hints = [_foreign(folder, only_poses=True), _inside(folder, posed), _above(folder, posed)]
    said = " ".join(filter(None, hints))
    return (Message("capture.poses-beside", f"Images are read, without poses. {said}"),) if said else ()


def _has_content(file: Path, content: str) -> bool:
    """Whether the beginning of a file has a regular expression; any has an empty one."""
    if not content:
        return True
    with file.open("rb") as opened:
        head = opened.read(HEAD_BYTES).decode("utf-8-sig", errors="replace")
    return re.search(content, head, re.MULTILINE) is not None


def _content(folder: Path) -> str:
    """The kinds of files in a folder, and the folders in it."""
    there = list(islice(folder.iterdir(), MOST_FILES))
    kinds = Counter(path.suffix.lower() or path.name for path in there if path.is_file())
    folders = sorted(f"{path.name}/" for path in there if path.is_dir())
    said = [f"{count} {kind}" for kind, count in kinds.most_common(MOST_KINDS)] + folders[:MOST_KINDS]
    return ", ".join(said) or "nothing"


def _foreign(folder: Path, only_poses: bool = False) -> str:
    """What a file of a format that is known and not read is, and what converts it."""
    for each in FOREIGN:
        if only_poses and not each.has_poses:
            continue
        found = (path for mark in each.marks for path in sorted(folder.glob(mark))[:MOST_LOOKED_AT])
        file = next((path for path in found if not each.content or _is_like(path, each.content)), None)
        if file is not None:
            return f"{file.name} is {each.name}. {each.cure}"
    return ""


def _is_like(path: Path, content: str) -> bool:
    return path.is_file() and os.access(path, os.R_OK) and _has_content(path, content)


def _rig(folder: Path) -> str:
    """What to do with a folder that holds one of left and one of right images."""
    names = [path.name for path in islice(folder.iterdir(), MOST_FILES) if path.is_dir()]
    sides = [next((n for n in names if n.lower().startswith(side)), None) for side in ("left", "right")]
    if None in sides:
        return ""
    return f"Pairs of a stereo rig are for geodiff depth: give it {sides[0]}/ and {sides[1]}/, with --calib."


def _inside(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """A folder inside that looks like a capture of one of the formats."""
    inside = sorted(path for path in islice(folder.iterdir(), MOST_FILES) if path.is_dir())[:MOST_FOLDERS]
    for each in formats:
        for below in inside:
            if all(_has(below, mark) for mark in each.marks):
                return f"{below.name}/ looks like {each.summary}: give that folder."
    return ""


def _above(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """The folder above, if it looks like a capture whose file of cameras names images."""
    above = folder.resolve().parent
    for each in formats:
        marks = [tuple(name.removeprefix("**/") for name in _patterns(mark)) for mark in each.marks]
        if not each.names_images or marks[0][0].startswith("*"):  # any program writes a *.xml
            continue
        if any(all(_has(above / place, mark) for mark in marks) for place in MODEL_FOLDERS):
            return f"The folder above, {above.name}/, looks like {each.summary}: give that folder."
    return ""


def _patterns(mark: str | tuple[str, ...]) -> tuple[str, ...]:
    return (mark,) if isinstance(mark, str) else mark


def _has(folder: Path, mark: str | tuple[str, ...]) -> bool:
    return any(any(folder.glob(pattern)) for pattern in _patterns(mark))


def _nearest(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """The format of whose marks the most are there, if that is half of them."""
    best, said = (LEAST_MARKS, 0), ""
    for each in formats:
        there = [mark for mark in each.marks if _has(folder, mark)]
        lacking = [_patterns(mark) for mark in each.marks if mark not in there]
        files = sum("." in _patterns(mark)[0] for mark in there)  # say more than folders
        score = len(there) / len(each.marks), files
        if lacking and score > best:
            also = ", ".join(
                " or ".join(each.removeprefix("**/") for each in patterns) for patterns in lacking
            )
            best, said = score, f"Nearest is {each.summary}, which also has {also}."
    return said
