"""The walk of ``captures`` as programs for radiance fields and splats keep it."""

import json
from pathlib import Path

import numpy as np

from tests.contracts.captures import CENTRAL, TRUE, Twin, images, words
from tests.unit.capture_room import SIZE, K

#: LLFF's axes are down, right, backwards.
LLFF_FROM_OPENCV = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


def splats(folder: Path) -> Twin:
    """A result next to the images that it was trained on; names have no suffix."""
    images(folder / "images", [f"DSC_{i}.png" for i in range(4)], CENTRAL)
    cameras = []
    for i, E in enumerate(TRUE):
        place = {"position": E[:3, 3].tolist(), "rotation": E[:3, :3].tolist()}
        cameras.append({"id": i, "img_name": f"DSC_{i}", "width": SIZE[0], "height": SIZE[1], **place})
        cameras[-1] |= {"fx": CENTRAL[0, 0], "fy": CENTRAL[1, 1]}
    (folder / "output").mkdir()
    (folder / "output" / "cameras.json").write_text(json.dumps(cameras))
    (folder / "output" / "cfg_args").write_text("Namespace(sh_degree=3)")
    return Twin(folder / "output", CENTRAL, unit=None, file="cameras.json")


def llff(folder: Path) -> Twin:
    """Rows are in the order of names as text: 10 comes before 2."""
    names = ["img1.png", "img10.png", "img2.png", "img3.png"]
    images(folder / "images", names, CENTRAL)
    rows = []
    for E in TRUE:
        pose = np.column_stack([E[:3, :3] @ LLFF_FROM_OPENCV.T, E[:3, 3], (SIZE[1], SIZE[0], CENTRAL[0, 0])])
        rows.append([*pose.ravel(), 0.5, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))
    return Twin(folder, CENTRAL, unit=None, file="poses_bounds.npy")


def neus(folder: Path) -> Twin:
    """Projections that were multiplied by a number each, of a scene that is scaled to a sphere."""
    images(folder / "image", [f"{i:03d}.png" for i in range(4)])
    matrices = {}
    for i, E in enumerate(TRUE):
        P = np.eye(4)
        P[:3] = (-1.5 if i == 2 else 0.5 + i) * K @ np.linalg.inv(E)[:3]
        matrices |= {f"world_mat_{i}": P, f"scale_mat_{i}": np.diag([2.0, 2.0, 2.0, 1.0])}
    np.savez(folder / "cameras_sphere.npz", **matrices)
    return Twin(folder, unit=None, file="cameras_sphere.npz")


def sdfstudio(folder: Path) -> Twin:
    images(folder, [f"{i:06d}_rgb.png" for i in range(4)])
    matrix = np.eye(4)
    matrix[:3, :3] = K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    frames = [
        {"rgb_path": f"{i:06d}_rgb.png", "camtoworld": E.tolist(), "intrinsics": matrix.tolist()}
        for i, E in enumerate(TRUE)
    ]
    data = {"camera_model": "OPENCV", "height": SIZE[1], "width": SIZE[0], "worldtogt": np.eye(4).tolist()}
    (folder / "meta_data.json").write_text(json.dumps(data | {"frames": frames}))
    return Twin(folder, unit=None, file="meta_data.json")


def nerfies(folder: Path) -> Twin:
    """Images of half the size that the cameras are for."""
    half = np.diag([0.5, 0.5, 1.0])
    small = SIZE[0] // 2, SIZE[1] // 2
    corner = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    small_K = half @ (K + corner) - corner
    images(folder / "rgb" / "2x", [f"0_{i:05d}.png" for i in range(4)], small_K, small)
    (folder / "camera").mkdir()
    for i, E in enumerate(TRUE):
        entries = {"orientation": E[:3, :3].T.tolist(), "position": E[:3, 3].tolist(), "skew": 0.0}
        entries |= {"focal_length": K[0, 0], "pixel_aspect_ratio": K[1, 1] / K[0, 0], "image_size": SIZE}
        entries |= {"principal_point": [K[0, 2] + 0.5, K[1, 2] + 0.5]}
        entries |= {"radial_distortion": [0.0, 0.0, 0.0], "tangential_distortion": [0.0, 0.0]}
        (folder / "camera" / f"0_{i:05d}.json").write_text(json.dumps(entries))
    return Twin(folder, small_K, unit=None, size=small, file="camera/0_00002.json")


def nsvf(folder: Path) -> Twin:
    """Names of images and poses that only their order joins."""
    images(folder / "rgb", [f"0_{i:05d}.png" for i in range(4)])
    (folder / "pose").mkdir()
    for i, E in enumerate(TRUE):
        (folder / "pose" / f"1_{i:05d}.txt").write_text("\n".join(words(row) for row in E))
    matrix = np.eye(4)
    matrix[:3, :3] = K
    (folder / "intrinsics.txt").write_text("\n".join(words(row) for row in matrix))
    return Twin(folder, unit=None, file="pose/1_00002.txt")


def nerf_plus_plus(folder: Path) -> Twin:
    """A split of NeRF++, with a camera of each image."""
    images(folder / "rgb", [f"{i:06d}.png" for i in range(4)])
    matrix = np.eye(4)
    matrix[:3, :3] = K
    for place, matrices in (("pose", TRUE), ("intrinsics", [matrix] * 4)):
        (folder / place).mkdir()
        for i, each in enumerate(matrices):
            (folder / place / f"{i:06d}.txt").write_text(words(each))
    return Twin(folder, unit=None, file="intrinsics/000002.txt")


WRITERS = (splats, llff, neus, sdfstudio, nerfies, nsvf, nerf_plus_plus)
