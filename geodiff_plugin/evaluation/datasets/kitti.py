"""KITTI stereo 2012 and 2015: street pairs with lidar truth (paper S5.1, Table 1)."""

from __future__ import annotations

from pathlib import Path

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
from geodiff_plugin.formats import read_calibration, read_disparity_kitti_png

__all__ = ["KITTI2012", "KITTI2015", "KITTI_CAP_M", "find_kitti2012", "find_kitti2015", "load_kitti"]

KITTI_CAP_M = 80.0
"""Truth beyond 80 m does not count, the range that monocular depth papers use on KITTI."""


def load_kitti(ref: SampleRef) -> StereoSample:
    """Read one KITTI pair.

    Args:
        ref: ``files`` holds ``left``, ``right``, ``disparity``, ``calibration`` (paths), ``cameras`` (two
            numbers of ``P0`` .. ``P3``) and optionally ``noc``, the disparity of the pixels that are seen
            twice.

    Returns:
        The sample; ``occluded`` where both kinds of truth exist, ``notes["truth"]`` says which was read.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, or its size is not the left image's.
    """
    files = ref.files
    left, right = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    rig = read_calibration(files["calibration"], cameras=files["cameras"])
    check_calibrated_sizes((files["calibration"],) * 2, rig, left, right)
    disparity, valid = read_disparity_kitti_png(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, left.shape)
    occluded = None
    if files.get("noc") is not None:
        _, seen_twice = read_disparity_kitti_png(files["noc"], "disparity of the pixels seen twice")
        check_size(files["noc"], seen_twice.shape, left.shape)
        occluded = valid & ~seen_twice
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    depth_m[~valid] = 0
    notes = {"truth": Path(files["disparity"]).parent.name, "disparity_step_px": 1 / 256}
    return make_sample(ref, (left, right), rig, depth_m, notes, occluded=occluded)


_IMAGES = (("colored_0", "colored_1", (2, 3)), ("image_0", "image_1", (0, 1)))


def find_kitti2012(root: Path) -> list[SampleRef]:
    """References to the pairs below ``root``; colour images where the folder has them, else grey.

    The truth of a pair is ``disp_occ`` (all pixels) where it exists, else ``disp_noc`` (pixels seen twice).
    """
    refs = []
    for folder in folders(root, 3):
        if not ((folder / "disp_occ").is_dir() or (folder / "disp_noc").is_dir()):
            continue
        for left_name, right_name, cameras in _IMAGES:
            if not (folder / left_name).is_dir():
                continue
            for left in sorted((folder / left_name).glob("*_10.png")):
                occ, noc = folder / "disp_occ" / left.name, folder / "disp_noc" / left.name
                files = {
                    "left": left,
                    "right": folder / right_name / left.name,
                    "disparity": occ if occ.is_file() else noc,
                    "noc": noc if occ.is_file() and noc.is_file() else None,
                    "calibration": folder / "calib" / f"{left.stem[:-3]}.txt",
                    "cameras": cameras,
                }
                refs.append(SampleRef("kitti2012", left.stem[:-3], files))
            break
    return refs


KITTI2012 = Dataset(
    name="kitti2012",
    find=find_kitti2012,
    load=load_kitti,
    cap_m=KITTI_CAP_M,
    obtain="data_stereo_flow.zip from https://www.cvlibs.net/datasets/kitti/eval_stereo_flow.php "
    "(CC BY-NC-SA 3.0), unpacked into one folder.",
    full_count=194,
)


def find_kitti2015(root: Path) -> list[SampleRef]:
    """References to the pairs below ``root`` (the folder ``training``, its parent, or the parent of that)."""
    refs = []
    for folder in folders(root, 3):
        if not ((folder / "image_2").is_dir() and (folder / "disp_occ_0").is_dir()):
            continue
        for left in sorted((folder / "image_2").glob("*_10.png")):
            noc = folder / "disp_noc_0" / left.name
            files = {
                "left": left,
                "right": folder / "image_3" / left.name,
                "disparity": folder / "disp_occ_0" / left.name,
                "noc": noc if noc.is_file() else None,
                "calibration": folder / "calib_cam_to_cam" / f"{left.stem[:-3]}.txt",
                "cameras": (2, 3),
            }
            refs.append(SampleRef("kitti2015", left.stem[:-3], files))
    return refs


KITTI2015 = Dataset(
    name="kitti2015",
    find=find_kitti2015,
    load=load_kitti,
    cap_m=KITTI_CAP_M,
    obtain="data_scene_flow.zip and data_scene_flow_calib.zip from "
    "https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php (CC BY-NC-SA 3.0), unpacked into one folder.",
    full_count=200,
)
