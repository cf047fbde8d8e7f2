"""Pairs of two images and a calibration: KITTI, Middlebury, ETH3D, Booster, and the user's own folders.

Paper: S5.1, Tables 1 and 2. Depth in metres is ``f b / (d + doffs)``, with doffs in pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    Images,
    SampleRef,
    StereoSample,
    check_size,
    disparity_to_depth,
    folders,
    make_sample,
    read_depth_m,
    read_npy,
    read_rgb,
)
from geodiff_plugin.formats import read_calibration, read_depth_png, read_pfm
from geodiff_plugin.geometry import resize_intrinsics
from geodiff_plugin.types import Rig


def read_pair(ref: SampleRef, by_size: bool = False, **how: Any) -> tuple[Images, Rig]:
    """Images and rig of a reference whose files are ``left``, ``right`` and ``calibration``.

    Args:
        ref: ``calibration_right`` names the right camera's file where that is another one.
        by_size: the calibration may hold several resolutions, of which the left image's counts.
        **how: keywords of ``read_calibration``.

    Raises:
        OSError: a file is missing.
        ValueError: a file is damaged, or the calibration is for another size.
    """
    images = read_rgb(ref.files["left"], "left image"), read_rgb(ref.files["right"], "right image")
    first, second = ref.files["calibration"], ref.files.get("calibration_right")
    how |= {"image_size": images[0].shape[1::-1]} if by_size else {}
    rig = read_calibration(first if second is None else (first, second), **how)
    sizes = rig.size_left, rig.size_right
    of_side = zip((first, second or first), sizes, images, ("left", "right"), strict=True)
    for path, size, image, side in of_side:
        if size is not None:
            check_size(path, size[::-1], image.shape, side)
    return images, rig


KITTI_CAP_M = 80.0
"""Truth beyond 80 m does not count, the range that monocular depth papers use on KITTI."""


class _Kitti(NamedTuple):
    """Folders of left and right images with the numbers of their cameras, of both truths, of calibrations."""

    images: Sequence[tuple[str, str, tuple[int, int]]]
    occ: str
    noc: str
    calibrations: str


_KITTI = {
    "kitti2015": _Kitti([("image_2", "image_3", (2, 3))], "disp_occ_0", "disp_noc_0", "calib_cam_to_cam"),
    "kitti2012": _Kitti(
        [("colored_0", "colored_1", (2, 3)), ("image_0", "image_1", (0, 1))], "disp_occ", "disp_noc", "calib"
    ),
}


def _find_kitti(root: Path, name: str) -> list[SampleRef]:
    """Pairs below the folder ``training``, its parent or that one's; colour where there is some, else grey.

    The truth of a pair is ``occ`` (all pixels) where it exists, else ``noc`` (pixels seen twice).
    """
    refs, layout = [], _KITTI[name]
    for folder in folders(root, 3):
        colours = [own for own in layout.images if (folder / own[0]).is_dir()]
        if not colours or not any((folder / truth).is_dir() for truth in (layout.occ, layout.noc)):
            continue
        left_name, right_name, cameras = colours[0]
        for left in sorted((folder / left_name).glob("*_10.png")):
            occ, noc = (folder / truth / left.name for truth in (layout.occ, layout.noc))
            files = {
                "left": left,
                "right": folder / right_name / left.name,
                "disparity": occ if occ.is_file() or not noc.is_file() else noc,
                "noc": noc if occ.is_file() and noc.is_file() else None,
                "calibration": folder / layout.calibrations / f"{left.stem[:-3]}.txt",
                "cameras": cameras,
            }
            refs.append(SampleRef(name, left.stem[:-3], files))
    return refs


def _load_kitti(ref: SampleRef) -> StereoSample:
    """Read one KITTI pair; ``occluded`` where both kinds of truth exist."""
    files = ref.files
    images, rig = read_pair(ref, cameras=files["cameras"])
    disparity, valid = read_depth_png(files["disparity"], 256.0, "true disparity")
    check_size(files["disparity"], disparity.shape, images[0].shape)
    occluded = None
    if files.get("noc") is not None:
        _, seen_twice = read_depth_png(files["noc"], 256.0, "disparity of the pixels seen twice")
        check_size(files["noc"], seen_twice.shape, images[0].shape)
        occluded = valid & ~seen_twice
    depth_m = np.where(valid, disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E), 0)
    notes = {"truth": Path(files["disparity"]).parent.name, "disparity_step_px": 1 / 256}
    return make_sample(ref, images, rig, depth_m, notes, occluded=occluded)


#: Folders of scenes whose truth is not published; the archives of the images have them as well.
_TESTS = ("testF", "testH", "testQ", "two_view_test")


def _find_scenes(root: Path, name: str) -> list[SampleRef]:
    """Scenes of one of the three sets in Middlebury's format: folders with ``im0.png`` and ``calib.txt``.

    The truth is ``disp0.pfm`` (2014), ``disp0GT.pfm`` beside the images (MiddEval3), or ``disp0GT.pfm`` in
    ``two_view_training_gt/<scene>`` (ETH3D). The set follows from the folder's name (``eth3d``,
    ``two_view``), else from the truth's. Test scenes without truth are none.
    """
    refs = []
    for folder in folders(root, 3):
        if not ((folder / "im0.png").is_file() and (folder / "calib.txt").is_file()):
            continue
        beside = folder.parent.parent / "two_view_training_gt" / folder.name / "disp0GT.pfm"
        candidates = (folder / "disp0.pfm", folder / "disp0GT.pfm", beside)
        truth = next((path for path in candidates if path.is_file()), None)
        if truth is None and folder.parent.name in _TESTS:
            continue
        truth = truth or folder / "disp0.pfm"
        parts = (root.resolve().name, *folder.relative_to(root).parts)
        dataset = "middeval3" if truth.name == "disp0GT.pfm" else "middlebury2014"
        if any("eth3d" in part.lower() or "two_view" in part for part in parts):
            dataset = "eth3d"
        mask = truth.parent / "mask0nocc.png"
        files = {
            "left": folder / "im0.png",
            "right": folder / "im1.png",
            "calibration": folder / "calib.txt",
            "disparity": truth,
            "mask": mask if mask.is_file() else None,
        }
        if dataset == name:
            refs.append(SampleRef(dataset, folder.name, files))
    return refs


def _step_px(disparity: np.ndarray) -> float:
    """Coarseness of the truth: gap between neighbouring values, 0 where as good as continuous."""
    gaps = np.diff(np.unique(disparity))
    # Float truth has gaps far below a sixteenth of a pixel; truth that was made from 8-bit maps has none.
    return float(gaps.min()) if gaps.size and gaps.min() > 1 / 16 else 0.0


def _load_scene(ref: SampleRef) -> StereoSample:
    """Read one pair in Middlebury's format; its mask has 255 seen twice, 128 hidden on the right, 0 unknown.

    ``notes["disparity_step_px"]`` says how coarse the truth is (Adirondack's quarter size: 1 px).
    """
    files = ref.files
    images, rig = read_pair(ref)
    disparity = read_pfm(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, images[0].shape)
    valid, occluded = np.isfinite(disparity), None
    if files.get("mask") is not None:
        mask = read_rgb(files["mask"], "mask of pixels seen twice")[..., 0]
        check_size(files["mask"], mask.shape, images[0].shape)
        occluded = valid & (mask == 128)
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    notes = {"truth": files["disparity"].name, "disparity_step_px": _step_px(disparity[valid])}
    return make_sample(ref, images, rig, depth_m, notes, occluded=occluded)


SHRINK = 4
"""Booster's images of 12 megapixels are scored at a quarter of their size, as the set's authors do."""


def _find_booster(root: Path) -> list[SampleRef]:
    """Every image pair of every scene, which has one truth and several lightings.

    A scene is a folder with ``camera_00`` and ``camera_02`` (the balanced split), ``disp_00.npy`` and a
    calibration ``calib_00-02.xml``.
    """
    refs = []
    for scene in folders(root, 3):
        if not ((scene / "camera_00").is_dir() and (scene / "camera_02").is_dir()):
            continue
        others, named = sorted(scene.glob("*.xml")), scene / "calib_00-02.xml"
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
    return np.rint(F.avg_pool2d(planes, SHRINK)[0].permute(1, 2, 0).numpy()).astype(np.uint8)


def _sampled(values: np.ndarray) -> np.ndarray:
    """Every fourth value: truth and classes must not be mixed across edges."""
    return values[SHRINK // 2 :: SHRINK, SHRINK // 2 :: SHRINK]


def _quarter_intrinsics(K: np.ndarray, image: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    size = (height // SHRINK, width // SHRINK)
    return resize_intrinsics(torch.from_numpy(K)[None], (height, width), size)[0].numpy()


def _load_booster(ref: SampleRef) -> StereoSample:
    """Read one pair at a quarter of its size; the disparity is in pixels of the full size, 0 = unknown.

    Masks, where the scene has them: ``occluded`` (0 = hidden in the right view), and ``material`` (class 0
    the least, 3 the most specular or transparent; 2 and 3 are the authors' ToM, transparent or mirror).

    Raises:
        OSError: a file is missing.
        ValueError: a file is damaged, sizes disagree, or a side is no multiple of 4.
    """
    files = ref.files
    (left, right), rig = read_pair(ref)
    if any(side % SHRINK for side in (*left.shape[:2], *right.shape[:2])):
        bad_value(str(files["left"]), f"of sides that are multiples of {SHRINK}", left.shape[:2])
    disparity = read_npy(files["disparity"], "true disparity")
    check_size(files["disparity"], disparity.shape, left.shape)
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    depth_m = _sampled(np.where(np.isfinite(disparity) & (disparity > 0), depth_m, 0))
    masks = {}
    for name in ("occluded", "material"):
        if files[name].is_file():
            mask = read_rgb(files[name], f"{name} mask")[..., 0]
            check_size(files[name], mask.shape, left.shape)
            masks[name] = _sampled(mask)
    if "occluded" in masks:
        masks["occluded"] = (masks["occluded"] == 0) & (depth_m > 0)
    K_left, K_right = _quarter_intrinsics(rig.K_left, left), _quarter_intrinsics(rig.K_right, right)
    quarter, notes = (
        replace(rig, K_left=K_left, K_right=K_right),
        {"truth": "disp_00.npy", "disparity_step_px": 0.0},
    )
    return make_sample(ref, (_shrunk(left), _shrunk(right)), quarter, depth_m, notes, **masks)


_DEPTHS = ("depth.npy", "depth.pfm", "depth.png", "depth_mm.png")


def _image(folder: Path, stem: str) -> Path | None:
    """The image file of this name that Pillow knows, a PNG before others."""
    Image.init()
    listed = [p for p in folder.glob(f"{stem}.*") if p.is_file() and p.suffix.lower() in Image.EXTENSION]
    return min(listed, key=lambda path: (path.suffix.lower() != ".png", path.name), default=None)


def _find_folders(root: Path) -> list[SampleRef]:
    """``root`` and the folders right below it with ``left.*``, ``right.*`` and ``calib.*``.

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
            "depth": next((folder / name for name in _DEPTHS if (folder / name).is_file()), None),
        }
        refs.append(SampleRef("folder", folder.resolve().name, files))
    return refs


def _load_folder(ref: SampleRef) -> StereoSample:
    """Read one pair; without depth ``valid`` is False everywhere, and the notes say what was sought.

    Raises:
        OSError: a file is missing.
        ValueError: a file is damaged, or sizes disagree.
    """
    files = ref.files
    images, rig = read_pair(
        ref,
        by_size=True,
        image_folder_hint=str(files["left"]),
        image_names=(files["left"].name, files["right"].name),  # the pair's folder is the user's own choice
    )
    depth_m = np.zeros(images[0].shape[:2], np.float32)
    truth = f"no {', '.join(_DEPTHS[:-1])} or {_DEPTHS[-1]} in {files['left'].parent}"
    if files["depth"] is not None:
        depth_m, truth = read_depth_m(files["depth"], "depth"), files["depth"].name
        check_size(files["depth"], depth_m.shape, images[0].shape)
    return make_sample(ref, images, rig, depth_m, {"truth": truth})


#: How to get each set.
_OBTAIN = {
    "kitti2015": "data_scene_flow.zip and data_scene_flow_calib.zip from "
    "https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php (CC BY-NC-SA 3.0), unpacked into one folder.",
    "kitti2012": "data_stereo_flow.zip from https://www.cvlibs.net/datasets/kitti/eval_stereo_flow.php "
    "(CC BY-NC-SA 3.0), unpacked into one folder.",
    "middlebury2014": "scene folders from https://vision.middlebury.edu/stereo/data/scenes2014/ (free with "
    "citation).",
    "middeval3": "MiddEval3-data-Q.zip and MiddEval3-GT0-Q.zip (or H, F) from "
    "https://vision.middlebury.edu/stereo/submit3/, unpacked into one folder.",
    "eth3d": "two_view_training.7z and two_view_training_gt.7z from https://www.eth3d.net/datasets "
    "(CC BY-NC-SA 4.0), unpacked into two_view_training and two_view_training_gt.",
    "booster": "booster_gt.zip from https://cvlab-unibo.github.io/booster-web/ (non-commercial research), "
    "unpacked: train/balanced/<scene>.",
    "folder": "your own: <pair>/left.png, right.png, calib.* (any known format) and depth.npy, .pfm (metres) "
    "or .png (mm).",
}


def _kitti(name: str, count: int) -> Dataset:
    find = partial(_find_kitti, name=name)
    return Dataset(name, find, _load_kitti, KITTI_CAP_M, _OBTAIN[name], full_count=count)


def _scenes(name: str, count: int | None) -> Dataset:
    return Dataset(name, partial(_find_scenes, name=name), _load_scene, None, _OBTAIN[name], full_count=count)


PAIRS = (
    *(_kitti("kitti2015", 200), _kitti("kitti2012", 194)),
    *(_scenes("middlebury2014", None), _scenes("middeval3", 15), _scenes("eth3d", 27)),
    Dataset("booster", _find_booster, _load_booster, 10.0, _OBTAIN["booster"], full_count=228),
    Dataset("folder", _find_folders, _load_folder, None, _OBTAIN["folder"]),
)
