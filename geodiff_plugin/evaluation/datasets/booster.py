"""Booster: indoor scenes full of glass and mirrors, with dense truth and material classes.

Paper: S5.1, Table 1 (228 pairs of the balanced split).
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    check_size,
    disparity_to_depth,
    folders,
    make_sample,
    read_npy,
    read_rgb,
)
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.geometry.cameras import resize_intrinsics

__all__ = ["BOOSTER", "SHRINK", "find_booster", "load_booster"]

SHRINK = 4
"""Images of 12 megapixels are scored at a quarter of their size, as the set's authors do."""


def find_booster(root: Path) -> list[SampleRef]:
    """References to every image pair of every scene below ``root``.

    A scene, which has one truth and several lightings, is a folder with ``camera_00`` and ``camera_02`` (the
    balanced split), ``disp_00.npy`` and a calibration ``calib_00-02.xml``.
    """
    refs = []
    for scene in folders(root, 3):
        if not ((scene / "camera_00").is_dir() and (scene / "camera_02").is_dir()):
            continue
        others = sorted(scene.glob("*.xml"))
        named = scene / "calib_00-02.xml"
        for left in sorted((scene / "camera_00").glob("im*.png")):
            files = {
                "left": left,
                "right": scene / "camera_02" / left.name,
                "disparity": scene / "disp_00.npy",
                "occluded": scene / "mask_00.png",
                "material": scene / "mask_cat.png",
                "calibration": others[0] if others and not named.is_file() else named,
            }
            refs.append(SampleRef("booster", f"{scene.name}-{left.stem}", files))
    return refs


def _shrunk(image: np.ndarray) -> np.ndarray:
    """``(H / 4, W / 4, 3)`` uint8, mean over squares of four by four pixels."""
    planes = torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None]
    small = F.avg_pool2d(planes, SHRINK)[0].permute(1, 2, 0).numpy()
    return np.rint(small).astype(np.uint8)


def _sampled(values: np.ndarray) -> np.ndarray:
    """Every fourth value: truth and classes must not be mixed across edges."""
    offset = SHRINK // 2
    return values[offset::SHRINK, offset::SHRINK]


def _quarter_intrinsics(K: np.ndarray, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    size = (height // SHRINK, width // SHRINK)
    return resize_intrinsics(torch.from_numpy(K)[None], (height, width), size)[0].numpy()


def load_booster(ref: SampleRef) -> StereoSample:
    """Read one pair at a quarter of its size.

    Args:
        ref: ``files`` holds ``left``, ``right``, ``disparity`` (npy, pixels of the full size, 0 = unknown),
            ``calibration`` and, where the scene has them, ``occluded`` (0 = hidden in the right view) and
            ``material`` (class 0 the least, 3 the most specular or transparent).

    Returns:
        The sample; classes 2 and 3 are what the set's authors call ToM (transparent or mirror).

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a file is damaged, sizes disagree, or a side is no multiple of 4.
    """
    files = ref.files
    left, right = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    if any(side % SHRINK for side in (*left.shape[:2], *right.shape[:2])):
        bad_value(str(files["left"]), f"of sides that are multiples of {SHRINK}", left.shape[:2])
    rig = read_calibration(files["calibration"])
    disparity = read_npy(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, left.shape)
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    depth_m[~(np.isfinite(disparity) & (disparity > 0))] = 0
    depth_m = _sampled(depth_m)
    masks = {}
    for name in ("occluded", "material"):
        if files[name].is_file():
            mask = read_rgb(files[name], f"{name} mask")[..., 0]
            check_size(files[name], mask.shape, left.shape)
            masks[name] = _sampled(mask)
    occluded = (masks["occluded"] == 0) & (depth_m > 0) if "occluded" in masks else None
    quarter = replace(
        rig, K_left=_quarter_intrinsics(rig.K_left, left), K_right=_quarter_intrinsics(rig.K_right, right)
    )
    images = (_shrunk(left), _shrunk(right))
    notes = {"truth": "disp_00.npy", "disparity_step_px": 0.0}
    return make_sample(
        ref, images, quarter, depth_m, notes, occluded=occluded, material=masks.get("material")
    )


BOOSTER = Dataset(
    name="booster",
    find=find_booster,
    load=load_booster,
    cap_m=10.0,
    obtain="booster_gt.zip from https://cvlab-unibo.github.io/booster-web/ (non-commercial research), "
    "unpacked: train/balanced/<scene>.",
    full_count=228,
)
