"""A capture by different cameras in the painted room: no size, K, pose or rotation is like another."""

import json
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin.types import DepthFrame
from tests.unit.capture_room import FLIP, render
from tests.views import posed_frame

SIZES = [(48, 36), (40, 44), (66, 39), (44, 40)]
FOCAL = [(41.0, 47.0), (38.0, 33.0), (52.0, 44.0), (36.0, 43.0)]
CENTRES = [(22.3, 19.1), (21.0, 20.2), (31.5, 17.4), (20.1, 21.7)]
#: Rotations about x, y and z in degrees: all are far from symmetric, so that rows cannot pass for columns.
TURNS = [(12, 35, 20), (8, 41, 27), (17, 30, 14), (10, 38, 31)]
PLACES = [(-0.3, 0.1, -0.4), (0.05, -0.05, -0.3), (-0.1, 0.3, -0.6), (0.2, 0.15, -0.5)]
NAMES = ["a", "b", "c", "d"]

KS = np.array(
    [[[fx, 0, cx], [0, fy, cy], [0, 0, 1]] for (fx, fy), (cx, cy) in zip(FOCAL, CENTRES, strict=True)]
)
ES = np.tile(np.eye(4), (4, 1, 1))
ES[:, :3, :3] = Rotation.from_euler("xyz", TURNS, degrees=True).as_matrix()
ES[:, :3, 3] = PLACES


def image_of(number: int) -> np.ndarray:
    """``(H, W, 3)`` in [0, 1]."""
    return (render(ES[number], SIZES[number], KS[number])[0] / 255).astype(np.float32)


def depth_of(number: int) -> np.ndarray:
    return render(ES[number], SIZES[number], KS[number])[1].astype(np.float32)


def frame_of(number: int, factor: float | np.ndarray = 1.0, confidence: float = 0.6) -> DepthFrame:
    depth = (depth_of(number) * factor).astype(np.float32)
    return posed_frame(NAMES[number], depth, np.full_like(depth, confidence), KS[number], ES[number])


def write_capture(folder: Path, with_depth: bool = False) -> Path:
    """A folder with transforms.json, in which each frame has a camera of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    frames = []
    for number, (name, (width, height), K, E) in enumerate(zip(NAMES, SIZES, KS, ES, strict=True)):
        Image.fromarray(render(E, (width, height), K)[0]).save(folder / f"{name}.png")
        frame = {"file_path": f"{name}.png", "transform_matrix": (E @ FLIP).tolist(), "w": width, "h": height}
        frame |= {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
        if with_depth:
            np.save(folder / f"{name}_depth.npy", depth_of(number))
            frame["depth_file_path"] = f"{name}_depth.npy"
        frames.append(frame)
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder
