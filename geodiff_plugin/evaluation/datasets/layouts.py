"""Reads datasets in their official layouts, and the user's own folders (S5.1, Tables 1 to 3)."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from geodiff_plugin._internal.checks import bad_value, check_choice
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    ExtraView,
    Images,
    SampleRef,
    StereoSample,
    check_size,
    disparity_to_depth,
    existing,
    folders,
    like,
    make_sample,
    read_depth_m,
    read_rgb,
    step_px,
)
from geodiff_plugin.formats import read_calibration, read_depth_png, read_map, read_text
from geodiff_plugin.types import Rig


def _read_pair(ref: SampleRef) -> tuple[Images, Rig]:
    """Read images and rig from the files ``left``, ``right``, ``calibration`` and ``calibration_right``."""
    files = ref.files
    second = ref.files.get("calibration_right")
    left, right, first = files["left"], files["right"], files["calibration"]
    images = read_rgb(left, "left image"), read_rgb(right, "right image")
    given = first if second is None else (first, second)
    names = (left.name, right.name)
    height, width = images[0].shape[:2]
    hint = str(left)
    left_size = (width, height)
    rig = read_calibration(given, files.get("cameras"), hint, image_names=names, image_size=left_size)
    sizes = (first, rig.size_left, "left"), (second or first, rig.size_right, "right")
    for image, (path, size, side) in zip(images, sizes, strict=True):
        if size is not None:
            check_size(path, size[::-1], image.shape, side)
    return images, rig


class _KittiViews(NamedTuple):
    """Folders of the left and right images of one kind, and the numbers of their cameras."""

    left: str
    right: str
    cameras: tuple[int, int]


class _KittiYear(NamedTuple):
    """Folders in ``training``: views, best first; calibrations; ground truth of all and of some pixels."""

    views: tuple[_KittiViews, ...]
    calibrations: str
    occ: str
    noc: str


_COLOUR_CAMERAS = (2, 3)
_GREY_CAMERAS = (0, 1)
_KITTI_2015 = _KittiYear(
    views=(_KittiViews("image_2", "image_3", _COLOUR_CAMERAS),),
    calibrations="calib_cam_to_cam",
    occ="disp_occ_0",
    noc="disp_noc_0",
)
_KITTI_2012 = _KittiYear(
    views=(
        _KittiViews("colored_0", "colored_1", _COLOUR_CAMERAS),
        _KittiViews("image_0", "image_1", _GREY_CAMERAS),
    ),
    calibrations="calib",
    occ="disp_occ",
    noc="disp_noc",
)


def _find_kitti(root: Path, name: str, year: _KittiYear) -> list[SampleRef]:
    """Find pairs in ``training`` or its parents: colour before grey, all pixels before fewer."""
    refs = []
    for folder in folders(root, 3):
        available = [views for views in year.views if (folder / views.left).is_dir()]
        if not available or not any(
            (folder / ground_truth).is_dir() for ground_truth in (year.occ, year.noc)
        ):
            continue
        for left in sorted((folder / available[0].left).glob("*_10.png")):
            occ, noc = folder / year.occ / left.name, folder / year.noc / left.name
            files = {
                "left": left,
                "right": folder / available[0].right / left.name,
                "disparity": existing(occ) or existing(noc) or occ,
                "noc": existing(noc) if occ.is_file() else None,
                "calibration": folder / year.calibrations / f"{left.stem[:-3]}.txt",
                "cameras": available[0].cameras,
            }
            refs.append(SampleRef(name, left.stem[:-3], files))
    return refs


def _load_kitti(ref: SampleRef) -> StereoSample:
    """Read one KITTI pair; ``occluded`` is set if ground truth without occluded pixels exists."""
    (images, rig), ground_truth, noc = _read_pair(ref), ref.files["disparity"], ref.files["noc"]
    noc_only = ground_truth.parent.name.startswith("disp_noc")
    disparity, valid = read_depth_png(ground_truth, 256.0, "ground-truth disparity")
    occluded = None
    if noc is not None:
        _, seen_twice = read_depth_png(noc, 256.0, "disparity of non-occluded pixels")
        occluded = valid & ~like(images[0], noc, seen_twice)
    elif noc_only:
        occluded = np.zeros_like(valid)
    depth_m = disparity_to_depth(like(images[0], ground_truth, disparity), rig.K_left, rig.K_right, rig.E)
    notes = {"truth": ground_truth.parent.name, "disparity_step_px": 1 / 256, "noc_only": noc_only}
    return make_sample(ref, images, rig, np.where(valid, depth_m, 0), notes, occluded=occluded)


#: Scene folders without public ground truth, which are also in the image archives.
_TESTS = ("testF", "testH", "testQ", "two_view_test")


#: Scenes of Middlebury 2021, each with one to three numbered pairs.
_SCENES_2021 = (
    *("artroom", "bandsaw", "chess", "curule", "ladder", "octogons"),
    *("pendulum", "podium", "skates", "skiboots", "traproom"),
)


def _set_of_scene(root: Path, folder: Path, ground_truth: Path) -> str:
    """Return the dataset of a folder in Middlebury's format, from the names of folders and files."""
    parts = (root.resolve().name, *folder.relative_to(root).parts)
    if any("eth3d" in part.lower() or "two_view" in part for part in parts):
        return "eth3d"
    if ground_truth.name == "disp0GT.pfm":
        return "middeval3"
    return "middlebury2021" if folder.name.rstrip("0123456789") in _SCENES_2021 else "middlebury2014"


def _find_scenes(root: Path, name: str) -> list[SampleRef]:
    """Find folders in Middlebury's format with ground truth; folder or file names determine the set."""
    refs = []
    for folder in folders(root, 3):
        if not ((folder / "im0.png").is_file() and (folder / "calib.txt").is_file()):
            continue
        separate = folder.parent.parent / "two_view_training_gt" / folder.name / "disp0GT.pfm"
        ground_truths = map(existing, (folder / "disp0.pfm", folder / "disp0GT.pfm", separate))
        ground_truth = next(filter(None, ground_truths), folder / "disp0.pfm")
        dataset = _set_of_scene(root, folder, ground_truth)
        if dataset == name and (ground_truth.is_file() or folder.parent.name not in _TESTS):
            names = {"left": "im0.png", "right": "im1.png", "calibration": "calib.txt"}
            files: dict[str, Any] = {key: folder / file for key, file in names.items()}
            files |= {"disparity": ground_truth, "mask": existing(ground_truth.parent / "mask0nocc.png")}
            refs.append(SampleRef(name, folder.name, files))
    return refs


def _load_scene(ref: SampleRef) -> StereoSample:
    """Read one pair in Middlebury's format; its mask is 128 for occluded in the right view, 0 for unknown."""
    (images, rig), ground_truth, mask = _read_pair(ref), ref.files["disparity"], ref.files["mask"]
    disparity = like(images[0], ground_truth, read_map(ground_truth, "ground-truth disparity"))
    valid = np.isfinite(disparity)
    occluded = None
    if mask is not None:
        seen = read_rgb(mask, "mask of non-occluded pixels")[..., 0]
        occluded = valid & (like(images[0], mask, seen) == 128)
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    notes = {"truth": ground_truth.name, "disparity_step_px": step_px(disparity[valid])}
    return make_sample(ref, images, rig, depth_m, notes, occluded=occluded)


#: Booster's 12 megapixel images are scored at a quarter of their size, as by the authors.
SHRINK = 4
#: Every fourth value, because ground truth and classes must not be mixed across edges.
_EVERY = np.s_[SHRINK // 2 :: SHRINK, SHRINK // 2 :: SHRINK]


def _find_booster(root: Path, name: str) -> list[SampleRef]:
    """Find all image pairs of the balanced split, which has one ground truth and several lightings."""
    refs = []
    for scene in folders(root, 3):
        if not ((scene / "camera_00").is_dir() and (scene / "camera_02").is_dir()):
            continue
        names = {"disparity": "disp_00.npy", "occluded": "mask_00.png", "material": "mask_cat.png"}
        names["calibration"] = "calib_00-02.xml"
        for left in sorted((scene / "camera_00").glob("im*.png")):
            files = {"left": left, "right": scene / "camera_02" / left.name}
            files |= {key: scene / file for key, file in names.items()}
            refs.append(SampleRef(name, f"{scene.name}-{left.stem}", files))
    return refs


def _quartered(image: np.ndarray, camera: Camera) -> tuple[np.ndarray, Camera]:
    """Return ``(H / 4, W / 4, 3)`` uint8, averaged over 4 x 4 pixels, and its camera."""
    planes = torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None]
    shrunk = np.rint(F.avg_pool2d(planes, SHRINK)[0].permute(1, 2, 0).numpy()).astype(np.uint8)
    (height, width), (rows, columns) = image.shape[:2], shrunk.shape[:2]
    return shrunk, replace(camera, size=(width, height)).resized((columns, rows))


def _load_booster(ref: SampleRef) -> StereoSample:
    """Read one pair at a quarter of its size; in masks, 0 of ``occluded`` means occluded."""
    files = ref.files
    (left, right), rig = _read_pair(ref)
    if any(side % SHRINK for side in (*left.shape[:2], *right.shape[:2])):
        bad_value(str(files["left"]), f"of sides that are multiples of {SHRINK}", left.shape[:2])
    disparity = like(left, files["disparity"], read_map(files["disparity"], "ground-truth disparity"))
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    depth_m = np.where(disparity > 0, depth_m, 0)[_EVERY]
    masks = {
        name: like(left, files[name], read_rgb(files[name], f"{name} mask")[..., 0])[_EVERY]
        for name in ("occluded", "material")
        if files[name].is_file()
    }
    if "occluded" in masks:
        masks["occluded"] = (masks["occluded"] == 0) & (depth_m > 0)
    (left, of_left), (right, of_right) = _quartered(left, rig.left), _quartered(right, rig.right)
    rig = replace(rig, left=of_left, right=of_right)
    notes = {"truth": "disp_00.npy"}
    return make_sample(ref, (left, right), rig, depth_m, notes | {"disparity_step_px": 0.0}, **masks)


#: Maximum number of further views of a posed sample, best first.
MAX_OTHER_VIEWS = 4
#: Numbers of key views with filtered ground truth in the Robust Multi-View Depth Benchmark.
KEY_VIEWS: dict[str, tuple[int, ...]] = {
    "Barn": tuple(range(60, 401, 20)),
    "Church": tuple(range(10, 491, 20)),
    "Courthouse": (243, 263, 283, 343, 523, 743, 763, 783, 923, 943, 963, 983, 1103),
    "Ignatius": tuple(range(17, 258, 20)),
}


def _sources_of(path: Path) -> dict[int, list[int]]:
    """Return the source views of every reference view in a ``pair.txt``, best first."""
    lines = [line.split() for line in read_text(path, "list of view pairs").splitlines() if line.strip()]
    try:
        sources = {}
        for i in range(int(lines[0][0])):
            reference = int(lines[1 + 2 * i][0])
            row = lines[2 + 2 * i]
            sources[reference] = [int(source) for source in row[1 : 1 + 2 * int(row[0]) : 2]]
    except (IndexError, ValueError):
        layout = "a pair.txt (count, then 'id' and 'n id score ...' lines per view)"
        bad_value(str(path), layout, "a different format")
    return sources


def _posed_views(group: Path, every: bool, benchmark: bool) -> list[list[int]]:
    """Return left, right and further views, best first, for each sample of a group."""
    sources = _sources_of(group / "pair.txt")
    if not (every or benchmark):
        views = sorted({*sources, *chain(*sources.values())})
        return [views] if len(views) > 1 else []
    listed = {view: sources.get(view, []) for view in KEY_VIEWS[group.name]} if benchmark else sources
    return [[i, j, *listed[i]] for i in listed for j in (listed[i] if every else listed[i][:1])]


def _find_posed(root: Path, name: str, pairs: str = "default", pixel_centre: float = 0.0) -> list[SampleRef]:
    """Find groups with ``images``, ``cams`` and ``pair.txt``; one pair per group or key view.

    ``pairs="all"``: every listed pair. ``pixel_centre`` is the coordinate of the top-left pixel's centre.
    """
    check_choice(pairs, "pairs", ("default", "all"))
    refs = []
    every = pairs == "all"
    benchmark = name == "robustmvd"
    for group in folders(root, 2):
        complete = (
            (group / "pair.txt").is_file() and (group / "cams").is_dir() and (group / "images").is_dir()
        )
        if not complete or benchmark != (group.name in KEY_VIEWS and (group / "depth").is_dir()):
            continue
        for left, right, *others in _posed_views(group, every, benchmark):
            label = f"{group.name}-{left}-{right}" if every or benchmark else group.name
            others = list(dict.fromkeys(view for view in others if view not in (left, right)))
            taken = (left, right, *others[:MAX_OTHER_VIEWS])
            # The benchmark counts ground truth and scans from 1.
            ground_truth = f"depth/{left + 1:06d}.npz" if benchmark else f"depths/{left:08d}.pfm"
            files: dict[str, Any] = {
                "views": taken,
                "pixel_centre": pixel_centre,
                "truth": group / ground_truth,
            }
            names = [("left", "calibration"), ("right", "calibration_right")]
            names += [(f"image {view}", f"camera {view}") for view in taken[2:]]
            for view, (image, camera) in zip(taken, names, strict=True):
                images = [group / "images" / f"{view:08d}{suffix}" for suffix in (".png", ".jpg", ".jpeg")]
                files[image] = next(filter(existing, images), images[0])
                files[camera] = group / "cams" / f"{view:08d}_cam.txt"
            refs.append(SampleRef(name, label, files))
    return refs


def _load_posed(ref: SampleRef) -> StereoSample:
    """Read one posed pair, possibly without ground truth; ignores the depth range in camera files."""
    (images, rig), files = _read_pair(ref), ref.files
    ground_truth = files["truth"]
    extra = []

    def from_centre(camera: Camera) -> Camera:
        """Return the camera with the centre of its first pixel at 0."""
        K = camera.K.copy()
        K[:2, 2] -= files["pixel_centre"]
        return replace(camera, K=K)

    for view in files["views"][2:]:
        image = read_rgb(files[f"image {view}"], "further image")
        camera = files[f"camera {view}"]
        pose = read_calibration((files["calibration"], camera))
        extra.append(ExtraView(image, from_centre(pose.right).K, pose.E))
    depth_m = np.zeros(images[0].shape[:2], np.float32)
    named = f"no {ground_truth}"
    if ground_truth.is_file() or ref.dataset == "robustmvd":
        depth_m = like(images[0], ground_truth, read_map(ground_truth, "ground-truth depth"))
        named = f"{ground_truth.parent.name}/{ground_truth.name}"
    notes = {"truth": named, "views": files["views"][:2]}
    shifted = replace(rig, left=from_centre(rig.left), right=from_centre(rig.right))
    return make_sample(ref, images, shifted, depth_m, notes, extra_views=tuple(extra))


_DEPTHS = ("depth.npy", "depth.pfm", "depth.png", "depth_mm.png")


def _image(folder: Path, stem: str) -> Path | None:
    """Return the image file with this name, PNG preferred."""
    Image.init()
    listed = [p for p in folder.glob(f"{stem}.*") if p.is_file() and p.suffix.lower() in Image.EXTENSION]
    return min(listed, key=lambda path: (path.suffix.lower() != ".png", path.name), default=None)


def _find_folders(root: Path, name: str) -> list[SampleRef]:
    """Find ``root`` and its subfolders with two of left, right and calib; reading reports the missing one."""
    refs = []
    for folder in folders(root, 1):
        left, right = _image(folder, "left"), _image(folder, "right")
        single = sorted(folder.glob("calib.*"))
        pair = [*sorted(folder.glob("calib_left.*"))[:1], *sorted(folder.glob("calib_right.*"))[:1]]
        calibrated = bool(single) or len(pair) == 2
        cameras = single[:1] or (pair if calibrated else [folder / "calib.txt"])
        if not (left or right) or bool(left) + bool(right) + calibrated < 2:
            continue
        files = {
            "left": left or folder / "left.png",
            "right": right or folder / "right.png",
            "calibration": cameras[0],
            "calibration_right": cameras[1] if len(cameras) > 1 else None,
            "depth": next(filter(None, (existing(folder / depth) for depth in _DEPTHS)), None),
        }
        refs.append(SampleRef(name, folder.resolve().name, files))
    return refs


def _load_folder(ref: SampleRef) -> StereoSample:
    """Read one pair; without depth ``valid`` is False everywhere, and the notes state what was searched."""
    (images, rig), path = _read_pair(ref), ref.files["depth"]
    depth_m = np.zeros(images[0].shape[:2], np.float32)
    ground_truth = f"no {', '.join(_DEPTHS[:-1])} or {_DEPTHS[-1]} in {ref.files['left'].parent}"
    if path is not None:
        depth_m = like(images[0], path, read_depth_m(path, "depth"))
        ground_truth = path.name
    return make_sample(ref, images, rig, depth_m, {"truth": ground_truth})


#: Options for finding posed pairs, in addition to the folder.
_POSED = ("pairs", "pixel_centre")
#: All datasets, in the order of the results.
LAYOUTS = [
    Dataset(
        name="kitti2015",
        find=partial(_find_kitti, name="kitti2015", year=_KITTI_2015),
        load=_load_kitti,
        cap_m=80.0,
        bad_px=3.0,
        obtain="data_scene_flow.zip and data_scene_flow_calib.zip from "
        "https://www.cvlibs.net/datasets/kitti/eval_scene_flow.php (CC BY-NC-SA 3.0), in one folder.",
    ),
    Dataset(
        name="kitti2012",
        find=partial(_find_kitti, name="kitti2012", year=_KITTI_2012),
        load=_load_kitti,
        cap_m=80.0,
        bad_px=3.0,
        obtain="data_stereo_flow.zip from https://www.cvlibs.net/datasets/kitti/eval_stereo_flow.php "
        "(CC BY-NC-SA 3.0).",
    ),
    Dataset(
        name="middlebury2014",
        find=partial(_find_scenes, name="middlebury2014"),
        load=_load_scene,
        cap_m=None,
        bad_px=2.0,
        obtain="scene folders from https://vision.middlebury.edu/stereo/data/scenes2014/ "
        "(free with citation).",
    ),
    Dataset(
        name="middeval3",
        find=partial(_find_scenes, name="middeval3"),
        load=_load_scene,
        cap_m=None,
        bad_px=2.0,
        obtain="MiddEval3-data-Q.zip and MiddEval3-GT0-Q.zip (or H, F) from "
        "https://vision.middlebury.edu/stereo/submit3/, in one folder.",
    ),
    Dataset(
        name="eth3d",
        find=partial(_find_scenes, name="eth3d"),
        load=_load_scene,
        cap_m=None,
        bad_px=1.0,
        obtain="two_view_training.7z and two_view_training_gt.7z from https://www.eth3d.net/datasets "
        "(CC BY-NC-SA 4.0), in folders of these names.",
    ),
    Dataset(
        name="booster",
        find=partial(_find_booster, name="booster"),
        load=_load_booster,
        cap_m=10.0,
        obtain="booster_gt.zip from https://cvlab-unibo.github.io/booster-web/ (non-commercial research).",
    ),
    Dataset(
        name="mvsnet",
        find=partial(_find_posed, name="mvsnet"),
        load=_load_posed,
        cap_m=None,
        obtain="folders of images/, cams/ and pair.txt in the MVSNet layout of Tanks and Temples; "
        "metrics also need depths/*.pfm in metres.",
        options=_POSED,
    ),
    Dataset(
        name="robustmvd",
        find=partial(_find_posed, name="robustmvd", pixel_centre=0.5),
        load=_load_posed,
        cap_m=None,
        obtain="tanks_and_temples_images.zip and tanks_and_temples_depth.zip of "
        "https://github.com/lmb-freiburg/robustmvd; then create cams/ and pair.txt from its sample list as "
        "described in docs/how-to/evaluation.md.",
        options=_POSED,
    ),
    Dataset(
        name="folder",
        find=partial(_find_folders, name="folder"),
        load=_load_folder,
        cap_m=None,
        obtain="your own pairs: <pair>/left.png, right.png, calib.* and depth.npy, .pfm (metres) "
        "or .png (mm).",
    ),
    Dataset(
        name="middlebury2021",
        find=partial(_find_scenes, name="middlebury2021"),
        load=_load_scene,
        cap_m=None,
        bad_px=2.0,
        obtain="scene folders from https://vision.middlebury.edu/stereo/data/scenes2021/ "
        "(free with citation).",
    ),
]
