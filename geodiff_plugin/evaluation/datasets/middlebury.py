"""Reads Middlebury's sets of 2001 to 2006, with 8-bit disparities of both views and no calibration file.

Source: https://vision.middlebury.edu/stereo/data/. Disparities are grey values divided by a factor; 0 is
unknown. For 2005 and 2006, the page gives focal length and baseline at full size, and ``dmin.txt`` gives the
disparity that cropping removed. The sets of 2001 and 2003 have no published calibration. AbsRel of depth does
not depend on focal length and baseline.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    disparity_to_depth,
    existing,
    folders,
    like,
    make_sample,
    read_rgb,
    step_px,
)
from geodiff_plugin.formats import read_text
from geodiff_plugin.types import Rig

#: Focal length at full size, pixels, and baseline, metres, of the sets of 2005 and 2006.
FOCAL_PX = 3740.0
BASELINE_M = 0.16
#: Baseline of sets without published calibration, metres; their focal length is the image's width.
NOMINAL_BASELINE_M = 0.1
#: Height of the full-size images of 2005 and 2006; the others have a half and a third of it.
FULL_HEIGHT = 1110
#: Width of the full-size images of 2003, whose grey values are pixels; the others have a half and a quarter.
FULL_WIDTH_2003 = 1800
#: Grey values per pixel of disparity in 2001.
FACTOR_2001 = 8.0
#: Maximum difference between the disparities of both views of a visible pixel.
MAX_DIFFERENCE_PX = 1.0

_SCENES_2003 = ("cones", "teddy")
_SCENES_2005 = (
    "Art",
    "Books",
    "Computer",
    "Dolls",
    "Drumsticks",
    "Dwarves",
    "Laundry",
    "Moebius",
    "Reindeer",
)


class Scale(NamedTuple):
    """Grey values per pixel, focal length and baseline for images of one size; published or nominal."""

    grey_per_px: float
    focal_px: float
    baseline_m: float
    published: bool


def _nominal(grey_per_px: float, size: tuple[int, int]) -> Scale:
    return Scale(grey_per_px, float(size[1]), NOMINAL_BASELINE_M, published=False)


def _scale_2005(size: tuple[int, int], path: Path) -> Scale:
    """Return the scale of an image ``(H, W)`` of 2005 or 2006; ``InputError`` for another size."""
    factor = round(FULL_HEIGHT / size[0])
    if factor not in (1, 2, 3) or abs(FULL_HEIGHT / size[0] - factor) > 0.02:
        heights = ", ".join(str(FULL_HEIGHT // k) for k in (1, 2, 3))
        hint = "Use the images as downloaded: their disparities and focal length depend on the size."
        bad_value(str(path), f"of height {heights}", size[0], hint)
    return Scale(factor, FOCAL_PX / factor, BASELINE_M, published=True)


class _Edition(NamedTuple):
    """One year: names of its views without suffix (left, right), and the scale of an image by its size."""

    views: tuple[str, str]
    disparities: tuple[str, str]
    scale: Callable[[tuple[int, int], Path], Scale]


_EARLY, _LATE = (("im2", "im6"), ("disp2", "disp6")), (("view1", "view5"), ("disp1", "disp5"))
EDITIONS = {
    "middlebury2001": _Edition(*_EARLY, lambda size, _: _nominal(FACTOR_2001, size)),
    "middlebury2003": _Edition(*_EARLY, lambda size, _: _nominal(FULL_WIDTH_2003 / size[1], size)),
    "middlebury2005": _Edition(*_LATE, _scale_2005),
    "middlebury2006": _Edition(*_LATE, _scale_2005),
}


def _image(folder: Path, stem: str) -> Path | None:
    paths = (folder / f"{stem}{suffix}" for suffix in (".png", ".ppm", ".pgm"))
    return next(filter(existing, paths), None)


def _set_of(folder: Path) -> str:
    """Return the data set of a folder, from its files and its name."""
    if _image(folder, "view1"):
        return "middlebury2005" if folder.name in _SCENES_2005 else "middlebury2006"
    return "middlebury2003" if folder.name.lower().startswith(_SCENES_2003) else "middlebury2001"


def _find(root: Path, name: str) -> list[SampleRef]:
    """Find scene folders with the left view and its disparities; scenes without are the benchmark's test."""
    edition = EDITIONS[name]
    refs = []
    for folder in folders(root, 3):
        left, right = (_image(folder, stem) for stem in edition.views)
        disparity, disparity_right = (_image(folder, stem) for stem in edition.disparities)
        if left is None or disparity is None or _set_of(folder) != name:
            continue
        files = {
            "left": left,
            "right": right or left.with_stem(edition.views[1]),
            "disparity": disparity,
            "disparity_right": disparity_right,
            "offset": folder / "dmin.txt" if edition.views == _LATE[0] else None,
        }
        refs.append(SampleRef(name, folder.name, files))
    return refs


def occluded_by(disparity: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``(H, W)`` bool: pixels whose disparity the right view's map ``(H, W)`` does not confirm.

    Both maps are in pixels, 0 where unknown; pixels that leave the right view are occluded, too.
    """
    rows, columns = np.indices(disparity.shape)
    at = np.rint(columns - disparity).astype(int)
    inside = (at >= 0) & (at < disparity.shape[1])
    seen = right[rows, np.clip(at, 0, disparity.shape[1] - 1)]
    return ~(inside & (seen > 0) & (np.abs(seen - disparity) <= MAX_DIFFERENCE_PX))


def _offset_px(path: Path | None, grey_per_px: float) -> float:
    """Return the disparity that cropping removed, in pixels of the image; the file is for full size."""
    if path is None:
        return 0.0
    text = read_text(path, "disparity offset").strip()
    try:
        return float(text) / grey_per_px
    except ValueError:
        bad_value(str(path), "one number", repr(text[:40]))


def _load(ref: SampleRef) -> StereoSample:
    """Read one pair; ``notes`` state the calibration."""
    files = ref.files
    images = read_rgb(files["left"], "left image"), read_rgb(files["right"], "right image")
    size = images[0].shape[:2]
    scale = EDITIONS[ref.dataset].scale(size, files["left"])

    def disparities(name: str) -> np.ndarray:
        grey = read_rgb(files[name], "ground-truth disparity")[..., 0]
        return like(images[0], files[name], grey) / np.float64(scale.grey_per_px)

    disparity = disparities("disparity")
    occluded = None
    if files["disparity_right"] is not None:
        occluded = (disparity > 0) & occluded_by(disparity, disparities("disparity_right"))
    rig = _rig(size, scale, _offset_px(files["offset"], scale.grey_per_px))
    depth_m = disparity_to_depth(disparity, rig.K_left, rig.K_right, rig.E)
    notes = {"truth": files["disparity"].name, "disparity_step_px": step_px(disparity[disparity > 0])}
    notes["calibration"] = (
        "as published" if scale.published else "not published: focal length and baseline are nominal"
    )
    return make_sample(ref, images, rig, np.where(disparity > 0, depth_m, 0), notes, occluded=occluded)


def _rig(size: tuple[int, int], scale: Scale, offset_px: float) -> Rig:
    """Return the rig of a rectified pair whose principal point is the middle of the left image."""
    height, width = size
    f = scale.focal_px
    cx = (width - 1) / 2
    cy = (height - 1) / 2
    K = [np.array([[f, 0, c], [0, f, cy], [0, 0, 1.0]]) for c in (cx, cx + offset_px)]
    E = np.eye(4)
    E[0, 3] = scale.baseline_m
    left, right = (Camera(each, (width, height)) for each in K)
    return Rig(left, right, E, source="Middlebury", rectified=True)


_PAGES = {
    "middlebury2001": "scenes2001/, folders with im2.ppm, im6.ppm, disp2.pgm and disp6.pgm",
    "middlebury2003": "scenes2003/, cones and teddy",
    "middlebury2005": "scenes2005/, two-view zips of the six training scenes",
    "middlebury2006": "scenes2006/, two-view zips",
}
#: Middlebury's sets of 2001 to 2006.
MIDDLEBURY = [
    Dataset(
        name=name,
        find=partial(_find, name=name),
        load=_load,
        cap_m=None,
        obtain=f"https://vision.middlebury.edu/stereo/data/{page} (free with citation).",
        bad_px=2.0,
    )
    for name, page in _PAGES.items()
]
