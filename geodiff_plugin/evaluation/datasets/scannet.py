"""Reads the two-view pairs of ScanNet that BA-Net, DeMoN's successors and UniMatch are compared on.

Source: BA-Net (Tang and Tan, ICLR 2019); the list of pairs and the protocol are UniMatch's
(``dataloader/depth`` and ``evaluate_depth.py`` of github.com/autonomousvision/unimatch): colour images are
resized to the depth map, whose intrinsics serve both views, and depth counts from 0.5 to 10 m, unaligned.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation.datasets.sample import (
    Dataset,
    SampleRef,
    StereoSample,
    existing,
    folders,
    make_sample,
    read_depth_m,
    read_rgb,
)
from geodiff_plugin.formats import read_text
from geodiff_plugin.types import Rig

#: List of pairs: scene, left and right frame in each line.
PAIRS_NAME = "scannet_banet_test_pairs.txt"
#: Depth range that counts, metres.
MIN_M, MAX_M = 0.5, 10.0


def _lines(path: Path) -> list[list[str]]:
    """Return the words of each line of a list of pairs."""
    rows = [line.split() for line in read_text(path, "list of pairs").splitlines() if line.strip()]
    for row in rows:
        if len(row) != 3:
            bad_value(str(path), "lines of 'scene left right'", repr(" ".join(row)[:60]))
    return rows


def _find(root: Path, name: str) -> list[SampleRef]:
    """Find the listed pairs whose colour images exist, below the list's folder or its folder ``test``."""
    refs = []
    for folder in folders(root, 1):
        listed = existing(folder / PAIRS_NAME)
        for scene, left, right in _lines(listed) if listed else ():
            test = folder / "test" / scene
            base = test if test.is_dir() else folder / scene
            files: dict[str, Any] = {
                "left": base / "color" / f"{left}.jpg",
                "right": base / "color" / f"{right}.jpg",
                "depth": base / "depth" / f"{left}.png",
                "intrinsics": base / "intrinsic" / "intrinsic_depth.txt",
                "pose_left": base / "pose" / f"{left}.txt",
                "pose_right": base / "pose" / f"{right}.txt",
            }
            if files["left"].is_file() and files["right"].is_file():
                refs.append(SampleRef(name, f"{scene}-{left}-{right}", files))
    return refs


def _matrix(path: Path) -> np.ndarray:
    """Read ``(4, 4)`` float64; ``InputError`` for another shape or, as in lost frames, infinite values."""
    text = read_text(path, "matrix")
    try:
        values = np.array(text.split(), np.float64).reshape(4, 4)
    except ValueError:
        bad_value(str(path), "16 numbers", repr(text[:60]))
    if not np.isfinite(values).all():
        bad_value(str(path), "finite", "infinite values", "ScanNet's tracker lost this frame.")
    return values


def _resized(path: Path, size: tuple[int, int], name: str) -> np.ndarray:
    """Read an image and resize it to ``(width, height)`` as UniMatch does."""
    return np.asarray(Image.fromarray(read_rgb(path, name)).resize(size))


def _load(ref: SampleRef) -> StereoSample:
    """Read one pair at the size of its depth map."""
    files = ref.files
    depth_m = read_depth_m(files["depth"], "depth")
    size = depth_m.shape[1], depth_m.shape[0]
    images = _resized(files["left"], size, "left image"), _resized(files["right"], size, "right image")
    camera = Camera(_matrix(files["intrinsics"])[:3, :3], size)
    E = np.linalg.inv(_matrix(files["pose_left"])) @ _matrix(files["pose_right"])
    rig = Rig(camera, camera, E, source=str(files["intrinsics"]), measured=False)
    counted = np.where((depth_m > MIN_M) & (depth_m < MAX_M), depth_m, 0)
    return make_sample(ref, images, rig, counted, {"truth": files["depth"].name})


SCANNET = Dataset(
    name="scannet",
    find=partial(_find, name="scannet"),
    load=_load,
    cap_m=MAX_M,
    obtain="test scenes of http://www.scan-net.org (terms of use), exported to test/<scene>/color, depth, "
    f"pose and intrinsic; {PAIRS_NAME} of https://github.com/autonomousvision/unimatch next to test/.",
)
