"""KITTI stereo 2015: colour street pairs with lidar truth.

Data flow: folder -> references -> ``StereoSample``.
Paper: S5.1, Table 1 (200 training pairs).
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin.evaluation.datasets._files import folders
from geodiff_plugin.evaluation.datasets.kitti import KITTI_CAP_M, load_kitti
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef

__all__ = ["KITTI2015", "find_kitti2015"]


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
