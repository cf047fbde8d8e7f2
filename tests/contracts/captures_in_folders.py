"""The walk of ``captures`` as nerfstudio, COLMAP, 7-Scenes, ScanNet and TUM RGB-D keep it."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.colmap import write_colmap
from tests.contracts.captures import TRUE, Twin
from tests.unit.capture_room import SIZE, K, render, write_transforms

IMAGES = [render(E)[0] for E in TRUE]


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def transforms(folder: Path) -> Path:
    return write_transforms(folder, TRUE, TRUE)


def colmap_text(folder: Path) -> Path:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    views = [(f"f{i:02d}.png", K, E, SIZE) for i, E in enumerate(TRUE)]
    for (name, *_), image in zip(views, IMAGES, strict=True):
        save(folder / "images" / name, image)
    cloud = Cloud(np.array([[0.5, 0.25, 2.6]]), np.full((1, 3), 9, np.uint8))
    seen = [(np.full((1, 2), 10.0), np.zeros(1, int))] * 2 + [(np.zeros((0, 2)), np.zeros(0, int))]
    write_colmap(model, views, cloud, [*seen, seen[0]])
    return folder


def colmap_binary(folder: Path) -> Path:
    model = colmap_text(folder) / "sparse" / "0"
    pytest.importorskip("pycolmap").Reconstruction(str(model)).write_binary(str(model))
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").unlink()
    return folder


def seven_scenes(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / f"frame-{i:06d}.color.png", image)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsics.txt", K)
    return folder


def scannet(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / "color" / f"{10 * i}.png", image)  # 30 comes after 0, 10, 20
        save(folder / "depth" / f"{10 * i}.png", image)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{10 * i}.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsic_color.txt", np.pad(K, (0, 1)) + np.diag([0, 0, 0, 1]))
    return folder


def trajectory(E: np.ndarray, times: np.ndarray) -> str:
    rows = np.c_[times, E[:, :3, 3], Rotation.from_matrix(E[:, :3, :3]).as_quat()]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows)


def tum(folder: Path) -> Path:
    for i, image in enumerate(IMAGES):
        save(folder / "rgb" / f"{i}.png", image)
    names = "".join(f"{i}.5 rgb/{i}.png\n" for i in range(4))
    (folder / "rgb.txt").write_text("# timestamp filename\n" + names)
    (folder / "depth.txt").write_text(names.replace(".5", ".51"))
    (folder / "groundtruth.txt").write_text(trajectory(TRUE, np.arange(4) + 0.5))
    np.savetxt(folder / "K.txt", K)
    return folder


def nerfstudio(folder: Path) -> Twin:
    return Twin(transforms(folder), has_depth=True, file="transforms.json")


def colmap_as_text(folder: Path) -> Twin:
    return Twin(colmap_text(folder), unit=None, file="sparse/0/images.txt")


def colmap_as_binary(folder: Path) -> Twin:
    return Twin(colmap_binary(folder), unit=None, file="sparse/0/images.bin")


def seven(folder: Path) -> Twin:
    return Twin(seven_scenes(folder), file="frame-000001.pose.txt")


def scannet_sequence(folder: Path) -> Twin:
    return Twin(scannet(folder), file="pose/10.txt")


def tum_rgbd(folder: Path) -> Twin:
    return Twin(tum(folder), file="groundtruth.txt")


WRITERS = (nerfstudio, colmap_as_text, colmap_as_binary, seven, scannet_sequence, tum_rgbd)
