"""The user's pairs: one folder each, with left, right, calibration and, for scores, depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    check_calibrated_sizes,
    check_size,
    folders,
    make_sample,
    read_depth_m,
    read_rgb,
)
from geodiff_plugin.formats import read_calibration

__all__ = ["FOLDER", "find_folder", "load_folder"]

_DEPTHS = ("depth.npy", "depth.pfm", "depth.png", "depth_mm.png")


def _image(folder: Path, stem: str) -> Path | None:
    """The image file of this name that Pillow knows, a PNG before others."""
    Image.init()
    files = (path for path in folder.glob(f"{stem}.*") if path.is_file())
    found = [path for path in files if path.suffix.lower() in Image.EXTENSION]
    return min(found, key=lambda path: (path.suffix.lower() != ".png", path.name), default=None)


def _depth(folder: Path) -> Path | None:
    return next((folder / name for name in _DEPTHS if (folder / name).is_file()), None)


def find_folder(root: Path) -> list[SampleRef]:
    """References to ``root`` and the folders right below it with ``left.*``, ``right.*`` and ``calib.*``.

    A folder that lacks one of the three counts as a pair: reading it names the file that is missing.

    Images are of any format that Pillow reads. The calibration is one file of any known format, or
    ``calib_left.*`` and ``calib_right.*``; one with a pose per image knows these as ``left.*`` and
    ``right.*``, in whatever folder. Depth, if there, is ``depth.npy`` or ``depth.pfm`` (metres) or
    ``depth.png`` (16 bit, millimetres); 0, NaN and infinity are unknown.
    """
    refs = []
    for folder in folders(root, 1):
        left, right = _image(folder, "left"), _image(folder, "right")
        single = sorted(folder.glob("calib.*"))
        pair = [*sorted(folder.glob("calib_left.*"))[:1], *sorted(folder.glob("calib_right.*"))[:1]]
        calibrated = bool(single) or len(pair) == 2
        if (left is None and right is None) or (left is not None) + (right is not None) + calibrated < 2:
            continue
        # What is missing has a path as well, so that reading the pair says so.
        files = {
            "left": left or folder / "left.png",
            "right": right or folder / "right.png",
            "calibration": single[0] if single else pair[0] if calibrated else folder / "calib.txt",
            "calibration_right": pair[1] if calibrated and not single else None,
            "depth": _depth(folder),
        }
        refs.append(SampleRef("folder", folder.resolve().name, files))
    return refs


def load_folder(ref: SampleRef) -> StereoSample:
    """Read one own pair.

    Args:
        ref: ``files`` holds ``left``, ``right``, ``calibration``, and ``calibration_right`` and ``depth`` or
            ``None``.

    Returns:
        The sample; without depth, ``valid`` is False everywhere and ``notes["truth"]`` says what was sought.

    Raises:
        OSError: a file is missing.
        ValueError: a file is damaged, or sizes disagree.
    """
    files = ref.files
    left, right = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    first, second = files["calibration"], files["calibration_right"]
    rig = read_calibration(
        first if second is None else (first, second),
        image_folder_hint=str(files["left"]),
        image_names=(files["left"].name, files["right"].name),  # the pair's folder is the user's own choice
        image_size=left.shape[1::-1],
    )
    check_calibrated_sizes((first, second or first), rig, left, right)
    depth_m = np.zeros(left.shape[:2], np.float32)
    truth = f"no {', '.join(_DEPTHS[:-1])} or {_DEPTHS[-1]} in {files['left'].parent}"
    if files["depth"] is not None:
        depth_m, truth = read_depth_m(files["depth"], "depth"), files["depth"].name
        check_size(files["depth"], depth_m.shape, left.shape)
    return make_sample(ref, (left, right), rig, depth_m, {"truth": truth})


FOLDER = Dataset(
    name="folder",
    find=find_folder,
    load=load_folder,
    cap_m=None,
    obtain="your own: <pair>/left.png, right.png, calib.* (any known format) and "
    "depth.npy, .pfm (metres) or .png (mm).",
)
