"""The files of a pair with two further views, each with its own size, camera and pose."""

from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from geodiff_plugin.cameras import Distortion
from geodiff_plugin.jobs.options import DepthOptions
from tests.unit.jobs.made_runs import pose

#: ``(width, height)`` of the left image, the right one and two further views.
SIZES = ((54, 40), (60, 46), (64, 50), (48, 36))
KS = [
    np.array([[50.0 + n, 0, (w - 1) / 2 + 1.5], [0, 47.0 - n, (h - 1) / 2 - 0.5], [0, 0, 1]])
    for n, (w, h) in enumerate(SIZES)
]
ES = [
    np.eye(4),
    pose((1, -3, 2), (0.11, 0.02, -0.01)),
    pose((2, 4, -1), (-0.2, 0.1, 0.03)),
    pose((0, 0, 3), (0.1, -0.3, 0)),
]
LENSES = ("-0.2,0.05,0.001,0", "-0.1,0.02,0,0.002", "fisheye:0.05,0.01,0,0")
NAMES = ("left", "right", "third", "fourth")


def write_files(folder: Path) -> Path:
    """Images, intrinsics and poses."""
    rng = np.random.default_rng(1)
    for name, (width, height), K, E in zip(NAMES, SIZES, KS, ES, strict=True):
        smooth = cv2.resize(rng.random((9, 11, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
        image = np.clip(smooth * 200 + 20, 0, 255).astype(np.uint8)
        Image.fromarray(image).save(folder / f"{name}.png")
        np.savetxt(folder / f"K-{name}.txt", K)
        np.save(folder / f"E-{name}.npy", E)
    return folder


def image_of(files, name) -> np.ndarray:
    return np.asarray(Image.open(files / f"{name}.png"), np.float32) / 255


def options(files, *views: str, **more) -> DepthOptions:
    """Of a pair given by matrices, with further views."""
    given = {
        "left": files / "left.png",
        "right": files / "right.png",
        "k": files / "K-left.txt",
        "k_right": files / "K-right.txt",
        "e": files / "E-right.npy",
        "view": tuple(files / f"{name}.png" for name in views),
        "view_e": tuple(files / f"E-{name}.npy" for name in views),
        "view_k": tuple(files / f"K-{name}.txt" for name in views),
    }
    return DepthOptions(**given | more)


BARE = {"k": None, "k_right": None, "e": None}
NUMBERS = BARE | {"fx": 50.0, "baseline": 0.12}


def lens(text: str | None) -> Distortion | None:
    return None if text is None else Distortion("opencv", np.array(text.split(","), float))
