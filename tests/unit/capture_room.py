"""A room with painted walls, seen by one camera on a walk: exact images, depth and poses, in milliseconds."""

import json
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

SIZE = (240, 180)
K = np.array([[200.0, 0, 118.0], [0, 205.0, 91.0], [0, 0, 1]])
HALF = np.array([2.0, 1.4, 2.6])
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def _paint(seed: int) -> np.ndarray:
    """Speckles of several sizes, ``(512, 512, 3)`` uint8."""
    rng, paint = np.random.default_rng(seed), np.zeros((512, 512, 3))
    for side in (16, 48, 128, 256):
        paint += cv2.resize(rng.random((side, side, 3)), (512, 512), interpolation=cv2.INTER_CUBIC)
    return np.clip((paint - 0.8) / 2.4 * 255, 0, 255).astype(np.uint8)


PAINTS = [_paint(seed) for seed in range(6)]


def walk(count: int) -> np.ndarray:
    """``(count, 4, 4)`` camera-to-world poses: an arc through the room that looks at the far wall."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i, pose in enumerate(poses):
        a = i - (count - 1) / 2
        pose[:3, 3] = 0.11 * a, 0.08 * np.sin(0.9 * i), -0.4 + 0.05 * np.cos(0.7 * i)
        pose[:3, :3] = Rotation.from_euler(
            "yxz", [-2.0 * a, 3 * np.sin(i), 2 * np.cos(i)], degrees=True
        ).as_matrix()
    return poses


def render(E: np.ndarray, size: tuple[int, int] = SIZE, K: np.ndarray = K) -> tuple[np.ndarray, np.ndarray]:
    """Image ``(H, W, 3)`` uint8 and depth ``(H, W)`` of a camera in the room; the same arrays each time."""
    return _rendered(np.asarray(E, float).tobytes(), size, np.asarray(K, float).tobytes())


@lru_cache(maxsize=32)
def _rendered(pose: bytes, size: tuple[int, int], camera: bytes) -> tuple[np.ndarray, np.ndarray]:
    E, K = np.frombuffer(pose).reshape(4, 4), np.frombuffer(camera).reshape(3, 3)
    v, u = np.mgrid[: size[1], : size[0]]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ E[:3, :3].T
    with np.errstate(divide="ignore"):
        radius = np.where(rays > 0, HALF - E[:3, 3], -HALF - E[:3, 3]) / np.where(rays == 0, 1e-12, rays)
    axis, depth = radius.argmin(-1), radius.min(-1)
    points = E[:3, 3] + rays * depth[..., None]
    image = np.zeros((*depth.shape, 3), np.uint8)
    for wall in range(3):
        a, b = (points[..., other] for other in range(3) if other != wall)
        at = [((x * 90 + 256) % 511).astype(np.float32) for x in (a, b)]
        for side in (0, 1):
            hit = (axis == wall) & ((np.take_along_axis(rays, axis[..., None], -1)[..., 0] > 0) == bool(side))
            image[hit] = cv2.remap(PAINTS[2 * wall + side], *at, cv2.INTER_LINEAR)[hit]
    for shared in (image, depth):
        shared.flags.writeable = False
    return image, depth


def perturbed(E: np.ndarray, shift: float = 0.02, turn_deg: float = 2.0, seed: int = 0) -> np.ndarray:
    """Poses of a tracker that drifts: errors that change slowly along the walk."""
    rng = np.random.default_rng(seed)
    drawn = [np.convolve(rng.normal(size=len(E) + 6), np.ones(7) / 7**0.5, "valid") for _ in range(6)]
    smooth = np.stack(drawn, axis=1)
    out = E.copy()
    out[:, :3, 3] += shift * smooth[:, :3]
    out[:, :3, :3] = (Rotation.from_rotvec(np.radians(turn_deg) * smooth[:, 3:])).as_matrix() @ E[:, :3, :3]
    return out


def write_transforms(folder: Path, E: np.ndarray, given: np.ndarray, **more: object) -> Path:
    """A folder of transforms.json with images and depth maps in millimetres."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    frames = []
    for i, (pose, said) in enumerate(zip(E, given, strict=True)):
        image, depth = render(pose)
        Image.fromarray(image).save(folder / f"images/f{i:02d}.png")
        Image.fromarray(np.rint(depth * 1000).astype(np.uint16)).save(folder / f"depth/f{i:02d}.png")
        file = {"file_path": f"images/f{i:02d}.png", "depth_file_path": f"depth/f{i:02d}.png"}
        frames.append(file | {"transform_matrix": (said @ FLIP).tolist()})
    camera = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
    camera |= {"w": SIZE[0], "h": SIZE[1]}
    (folder / "transforms.json").write_text(json.dumps(camera | {"frames": frames} | more))
    return folder
