"""A scene seen by a left camera and two right ones that all differ, projected without the package."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.pose.fit import PosedGreys, PoseFit
from geodiff_plugin.pose.tracks import Tracks, median_residuals
from tests.views import grey_of, posed_of

#: ``(height, width)`` of the left and of the right images.
SIZES = ((500, 640), (600, 560), (420, 700))


def camera(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> np.ndarray:
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


K_LEFT = camera(520.0, 476.0, 310.2, 257.9)
K_RIGHTS = np.stack([camera(640.0, 610.0, 265.3, 311.7), camera(430.0, 455.0, 361.1, 202.4)])


def pose(turn_deg, centre) -> np.ndarray:
    """Camera-to-world pose of a camera turned by a rotation vector in degrees, at a place."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    E[:3, 3] = centre
    return E


#: Right cameras turned about all axes, and shifted along all of them.
POSES = np.stack([pose((3.0, -6.0, 4.0), (0.35, -0.08, 0.12)), pose((-5.0, 4.0, 8.0), (-0.22, 0.3, -0.1))])


def projected(points: np.ndarray, K: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Pixels ``(N, 2)`` of points ``(N, 3)`` in the frame that ``T`` maps to the camera's."""
    p = np.c_[points, np.ones(len(points))] @ (K @ T[:3]).T
    return p[:, :2] / p[:, 2:]


@dataclass
class Scene:
    tracks: Tracks
    Ts: np.ndarray  # (V, 4, 4) T_right_from_left
    points: np.ndarray  # (N, 3) in the left frame

    @property
    def inverse_depth(self) -> np.ndarray:
        return 1.0 / self.points[:, 2]


def make_scene(
    count: int = 200,
    noise_px: float = 0.0,
    outliers: float = 0.0,
    unseen: float = 0.0,
    poses: np.ndarray = POSES,
    seed: int = 0,
    Ks: tuple[np.ndarray, np.ndarray] = (K_LEFT, K_RIGHTS),
) -> Scene:
    """Points between 2 and 8 m; a fraction of them is wrong in all views, or unseen in each view but one."""
    rng = np.random.default_rng(seed)
    left_px = rng.uniform((4, 4), (SIZES[0][1] - 5, SIZES[0][0] - 5), (count, 2))
    depth_m = rng.uniform(2.0, 8.0, count)
    K_left, K_rights = Ks[0], Ks[1][: len(poses)]
    points = np.linalg.solve(K_left, np.c_[left_px, np.ones(count)].T).T * depth_m[:, None]
    Ts = np.linalg.inv(poses)
    right_px = np.stack([projected(points, K, T) for K, T in zip(K_rights, Ts, strict=True)])
    right_px += noise_px * rng.normal(size=right_px.shape)
    wild = rng.random(count) < outliers
    right_px[:, wild] += rng.uniform(-60, 60, (len(poses), wild.sum(), 2))
    seen = rng.random((len(poses), count)) >= unseen
    seen[rng.integers(len(poses), size=count), np.arange(count)] = True
    return Scene(Tracks(left_px, right_px, seen, K_left, K_rights), Ts, points)


def moved(T: np.ndarray, step: np.ndarray) -> np.ndarray:
    """The camera ``T`` turned about its own centre by a rotation vector, its origin then shifted."""
    by = np.eye(4)
    by[:3, :3] = Rotation.from_rotvec(step[:3]).as_matrix()
    out = by @ T
    out[:3, 3] = out[:3, 3] + step[3:]
    return out


def off_lines(left_px: np.ndarray, right_px: np.ndarray, K_left, K_right, T) -> np.ndarray:
    """Distance of right pixels from their epipolar lines, each drawn through two points of its ray."""
    rays = np.linalg.solve(K_left, np.c_[left_px, np.ones(len(left_px))].T).T
    first, second = (projected(rays * z, K_right, T) for z in (3.0, 6.0))
    along = (second - first) / np.linalg.norm(second - first, axis=1, keepdims=True)
    off = right_px - first
    return np.abs(off[:, 0] * along[:, 1] - off[:, 1] * along[:, 0])


def posed_fit(
    tracks: Tracks, given: np.ndarray, images: list[torch.Tensor] | None = None
) -> tuple[PosedViews, PoseFit]:
    """The views of a scene with these poses, and how their matches fit; the images are smaller than it."""
    images = images or [torch.zeros(3, 30, 28), torch.zeros(3, 21, 35)]
    Ks = [tracks.K_left, *tracks.K_rights]
    greys = [grey_of(np.zeros(size, np.uint8), K) for size, K in zip(SIZES, Ks, strict=False)]
    rights = zip(images, tracks.K_rights, given, strict=False)
    posed = posed_of(torch.zeros(3, 25, 32), K_LEFT, *rights)
    fit = PoseFit(PosedGreys(greys, given, [500, 600, 420]), tracks, median_residuals(tracks, given))
    return posed, fit
