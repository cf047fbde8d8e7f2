"""KITTI stereo 2012: street pairs, grey or colour, with lidar truth.

Data flow: folder -> references -> ``StereoSample``.
Paper: S5.1 names KITTI stereo; the 2012 set is read for its denser grey pairs.
"""

from __future__ import annotations

from pathlib import Path

from geodiff_plugin.evaluation.datasets._files import folders
from geodiff_plugin.evaluation.datasets.kitti import KITTI_CAP_M, load_kitti
from geodiff_plugin.evaluation.datasets.sample import Dataset, SampleRef

__all__ = ["KITTI2012", "find_kitti2012"]

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
