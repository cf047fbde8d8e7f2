"""What to say of a path that is no capture: formats that are known but not read, and the nearest that is."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NoReturn

from geodiff_plugin._checks import bad_value
from geodiff_plugin.formats.layouts import CaptureFormat

#: Files of a folder that are looked at: listing a whole disk takes long.
MOST_FILES = 2000
#: Kinds of files that a message gives.
MOST_KINDS = 6


@dataclass(frozen=True)
class ForeignFormat:
    """A format that is not read: names of its files, what it is, and what converts it."""

    marks: tuple[str, ...]
    name: str
    cure: str


SENS = "SensReader's reader.py --export_color_images --export_poses --export_intrinsics writes what is read."
MAPPER = "Run: colmap mapper --database_path database.db --image_path images --output_path sparse."
PSX = "In Metashape: File, Export, Export Cameras, as Agisoft XML."
FOREIGN = (
    ForeignFormat(("*.sens",), "a sequence of ScanNet", SENS),
    ForeignFormat(("*.r3d",), "an archive of Record3D", "Export it from the app as EXR + JPG sequence."),
    ForeignFormat(("*.psx", "*.psz"), "a project of Metashape", PSX),
    ForeignFormat(("*.vrs",), "a recording of Project Aria", "Export images and poses by projectaria_tools."),
    ForeignFormat(
        ("sfm_data.json", "sfm_data.bin"),
        "a reconstruction of OpenMVG",
        "Run: openMVG_main_openMVG2Colmap -i sfm_data.bin -o sparse.",
    ),
    ForeignFormat(("*.sfm",), "a reconstruction of Meshroom", "Run: aliceVision_exportColmap."),
    ForeignFormat(("*.mvs",), "a scene of OpenMVS", "Give the COLMAP model that it was made from."),
    ForeignFormat(("database.db",), "COLMAP's matches without a model", MAPPER),
    ForeignFormat(
        ("cameras_sphere.npz", "cameras.npz"),
        "cameras of NeuS and IDR",
        "Split world_mat @ scale_mat by cv2.decomposeProjectionMatrix and write transforms.json.",
    ),
    ForeignFormat(("*_annotations.jgz",), "annotations of CO3D", "Write a sequence as transforms.json."),
    ForeignFormat(("poses_bounds.npy",), "poses of LLFF", "Give the COLMAP model that they were made from."),
    ForeignFormat(("*.svo", "*.svo2"), "a recording of ZED", "Export it as a video with ZED_SVO_Editor."),
    ForeignFormat(("*.rcproj",), "a project of RealityCapture", "Export its registration as COLMAP."),
    ForeignFormat(
        ("rtabmap*.db",),
        "a database of RTAB-Map",
        "Export images and the poses of the camera (RGB-D SLAM format) by rtabmap-export.",
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
    ),
    ForeignFormat(
        ("*.ply", "*.splat", "*.spz", "*.obj", "*.glb", "*.usdz"),
        "a model without its photographs",
        "Give the photographs with their cameras.",
    ),
    ForeignFormat(("*.pkl", "*.pickle", "*.pt"), "pickled objects", "They are never loaded: save .npz."),
)


def refuse_foreign(source: Path) -> None:
    """Refuse a file of a format that is known and not read."""
    if source.is_file():
        for each in FOREIGN:
            if any(source.match(mark) for mark in each.marks):
                bad_value("PATH", "a capture that is read", f"{source}, {each.name}", each.cure)


def refuse_unknown(source: Path, formats: Sequence[CaptureFormat]) -> NoReturn:
    """Refuse a path that no reader recognises: what was looked for, what is there, and what comes nearest."""
    expected = ", ".join(each.summary for each in formats)
    if source.is_file():
        bad_value("PATH", expected, f"{source}, which is none of these")
    cure = " ".join(filter(None, [_foreign(source), _nearest(source, formats)]))
    bad_value("PATH", expected, f"{source}, which is none of these: it holds {_content(source)}", cure)


def _content(folder: Path) -> str:
    """The kinds of files in a folder, and the folders in it."""
    there = list(islice(folder.iterdir(), MOST_FILES))
    kinds = Counter(path.suffix.lower() or path.name for path in there if path.is_file())
    folders = sorted(f"{path.name}/" for path in there if path.is_dir())
    said = [f"{count} {kind}" for kind, count in kinds.most_common(MOST_KINDS)] + folders[:MOST_KINDS]
    return ", ".join(said) or "nothing"


def _foreign(folder: Path) -> str:
    """What a file of a format that is known and not read is, and what converts it."""
    for each in FOREIGN:
        found = next((path for mark in each.marks for path in sorted(folder.glob(mark))), None)
        if found is not None:
            return f"{found.name} is {each.name}. {each.cure}"
    return ""


def _nearest(folder: Path, formats: Sequence[CaptureFormat]) -> str:
    """A folder inside that looks like a capture, else the format of whose marks the most are there."""
    inside = sorted(path for path in islice(folder.iterdir(), MOST_FILES) if path.is_dir())
    for below in inside[:MOST_KINDS]:
        for each in formats:
            if all(any(below.glob(mark)) for mark in each.marks):
                return f"{below.name}/ looks like {each.summary}: give that folder."
    best, said = (0.0, 0), ""
    for each in formats:
        lacking = [mark for mark in each.marks if not any(folder.glob(mark))]
        files = sum("." in mark and mark not in lacking for mark in each.marks)  # say more than folders
        score = 1 - len(lacking) / len(each.marks), files
        if lacking and score > best:
            best, said = score, f"Nearest is {each.summary}, which also has {', '.join(lacking)}."
    return said
