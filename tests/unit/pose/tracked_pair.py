"""Synthetic tracks: random points seen by several cameras, with noise and outliers."""

import numpy as np
from scipy.spatial.transform import Rotation

from geodiff_plugin.pose.tracks import Tracks

K = np.array([[500.0, 0, 255.5], [0, 500.0, 191.5], [0, 0, 1]])
SIZE = (384, 512)


def camera_pose(turn_deg, centre) -> np.ndarray:
    """``E`` of a camera turned by a rotation vector in degrees, at a place."""
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()
    E[:3, 3] = centre
    return E


def make_tracks(
    poses, noise_px=0.15, count=600, outliers=0.1, seed=0
) -> tuple[Tracks, np.ndarray, np.ndarray]:
    """Tracks of a cloud of points between 2 and 8 m, ``T_right_from_left`` of the poses, and the depths."""
    rng = np.random.default_rng(seed)
    left_px = rng.uniform((5, 5), (506, 378), (count, 2))
    depth_m = rng.uniform(2.0, 8.0, count)
    points = np.linalg.solve(K, np.c_[left_px, np.ones(count)].T) * depth_m
    Ts = np.stack([np.linalg.inv(E) for E in poses])
    right_px = []
    for T in Ts:
        p = K @ (T[:3, :3] @ points + T[:3, 3:])
        right_px.append((p[:2] / p[2]).T + noise_px * rng.normal(size=(count, 2)))
    right_px = np.stack(right_px)
    wild = rng.random(count) < outliers
    right_px[:, wild] += rng.uniform(-60, 60, (len(Ts), wild.sum(), 2))
    seen = np.ones(right_px.shape[:2], bool)
    return Tracks(left_px, right_px, seen, K, np.stack([K] * len(Ts))), Ts, depth_m


def angle_deg(R: np.ndarray) -> float:
    return float(np.degrees(np.linalg.norm(Rotation.from_matrix(R).as_rotvec())))


TRUE = camera_pose((1.0, -6.0, 2.0), (0.3, 0.05, -0.08))
