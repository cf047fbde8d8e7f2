"""Middlebury 2014, MiddEval3 and ETH3D two-view: three sets in one file format.

Paper: S5.1, Table 3 (15 pairs). Depth in metres is ``f b / (d + doffs)``, with doffs in pixels and b from
millimetres.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    check_calibrated_sizes,
    check_size,
    disparity_to_depth,
    folders,
    make_sample,
    read_rgb,
)
from geodiff_plugin.formats import read_calibration, read_pfm

__all__ = ["ETH3D", "MIDDEVAL3", "MIDDLEBURY2014", "find_scenes", "load_middlebury"]

#: Folders of scenes whose truth is not published; the archives of the images have them as well.
_TESTS = ("testF", "testH", "testQ", "two_view_test")


def find_scenes(root: Path) -> list[SampleRef]:
    """References to every scene of the three sets below ``root``.

    A scene is a folder with ``im0.png`` and ``calib.txt``. Its truth is ``disp0.pfm`` (2014),
    ``disp0GT.pfm`` beside the images (MiddEval3), or ``disp0GT.pfm`` in ``two_view_training_gt/<scene>``
    (ETH3D). Which of the three it belongs to follows from the folder's name (``eth3d``, ``two_view``) and
    else by the truth's name. Test scenes without truth are none.
    """
    refs = []
    for folder in folders(root, 3):
        if not ((folder / "im0.png").is_file() and (folder / "calib.txt").is_file()):
            continue
        below_root = (root.resolve().name, *folder.relative_to(root).parts)
        beside = folder.parent.parent / "two_view_training_gt" / folder.name / "disp0GT.pfm"
        candidates = (folder / "disp0.pfm", folder / "disp0GT.pfm", beside)
        truth = next((path for path in candidates if path.is_file()), None)
        if truth is None:
            if folder.parent.name in _TESTS:
                continue
            truth = folder / "disp0.pfm"
        if any("eth3d" in part.lower() or "two_view" in part for part in below_root):
            dataset = "eth3d"
        else:
            dataset = "middeval3" if truth.name == "disp0GT.pfm" else "middlebury2014"
        mask = truth.parent / "mask0nocc.png"
        files = {
            "left": folder / "im0.png",
            "right": folder / "im1.png",
            "calibration": folder / "calib.txt",
            "disparity": truth,
            "mask": mask if mask.is_file() else None,
        }
        refs.append(SampleRef(dataset, folder.name, files))
    return refs


def _step_px(disparity: np.ndarray) -> float:
    """Coarseness of the truth: gap between neighbouring values, 0 where as good as continuous."""
    values = np.unique(disparity)
    gaps = np.diff(values)
    # Float truth has gaps far below a sixteenth of a pixel; truth that was made from 8-bit maps has none.
    return float(gaps.min()) if gaps.size and gaps.min() > 1 / 16 else 0.0


def load_middlebury(ref: SampleRef) -> StereoSample:
    """Read one pair in Middlebury's format.

    Args:
        ref: ``files`` holds ``left``, ``right``, ``disparity``, ``calibration`` and optionally ``mask``
            (``mask0nocc.png``: 255 seen twice, 128 hidden in the right view, 0 unknown).

    Returns:
        The sample; ``notes["disparity_step_px"]`` says how coarse the truth is (Adirondack's quarter size: 1
        px).

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or sizes disagree.
    """
    files = ref.files
    left, right = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    rig = read_calibration(files["calibration"])
    check_calibrated_sizes((files["calibration"],) * 2, rig, left, right)
    disparity = read_pfm(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, left.shape)
    valid = np.isfinite(disparity)
    occluded = None
    if files.get("mask") is not None:
        mask = read_rgb(files["mask"], "mask of pixels seen twice")[..., 0]
        check_size(files["mask"], mask.shape, left.shape)
        occluded = valid & (mask == 128)
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    notes = {"truth": files["disparity"].name, "disparity_step_px": _step_px(disparity[valid])}
    return make_sample(ref, (left, right), rig, depth_m, notes, occluded=occluded)


def _one_set(name: str, obtain: str, full_count: int | None) -> Dataset:
    def find(root: Path) -> list[SampleRef]:
        return [ref for ref in find_scenes(root) if ref.dataset == name]

    return Dataset(
        name=name, find=find, load=load_middlebury, cap_m=None, obtain=obtain, full_count=full_count
    )


MIDDLEBURY2014 = _one_set(
    "middlebury2014",
    "scene folders from https://vision.middlebury.edu/stereo/data/scenes2014/ (free with citation).",
    None,
)
MIDDEVAL3 = _one_set(
    "middeval3",
    "MiddEval3-data-Q.zip and MiddEval3-GT0-Q.zip (or H, F) from "
    "https://vision.middlebury.edu/stereo/submit3/, unpacked into one folder.",
    15,
)
ETH3D = _one_set(
    "eth3d",
    "two_view_training.7z and two_view_training_gt.7z from https://www.eth3d.net/datasets (CC BY-NC-SA 4.0), "
    "unpacked into two_view_training and two_view_training_gt.",
    27,
)
