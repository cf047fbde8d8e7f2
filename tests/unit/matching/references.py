"""NumPy references for the matching, written from its definition, and views that differ in every respect."""

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from geodiff_plugin.cameras import View
from tests.views import view_of

#: Cost where no right view sees a pixel, and the largest cost.
UNSEEN, LARGEST = 78, 224


def matrix(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> np.ndarray:
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def right_from_left(angles_deg, centre) -> np.ndarray:
    """``T_right_from_left`` of a right camera at ``centre`` in the left frame, turned about x, y and z."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("xyz", angles_deg, degrees=True).as_matrix().T
    T[:3, 3] = -T[:3, :3] @ np.asarray(centre)
    return T


def grey_view(image: np.ndarray, K: np.ndarray, T: np.ndarray) -> View:
    """A grey right view of an image ``(H, W)``."""
    return view_of(torch.from_numpy(np.asarray(image)[None]).float(), K, T)


def projected(columns, rows, inverse_depth: float, K: np.ndarray, K_right: np.ndarray, T: np.ndarray):
    """Right column, row and depth times inverse depth of left pixels on a plane."""
    columns, rows = np.broadcast_arrays(np.asarray(columns, float), np.asarray(rows, float))
    rays = np.linalg.inv(K) @ np.stack([columns.ravel(), rows.ravel(), np.ones(columns.size)])
    u, v, z = K_right @ (T[:3, :3] @ rays + inverse_depth * T[:3, 3:])
    return (each.reshape(columns.shape) for each in (u / z, v / z, z))


def sampled(image: np.ndarray, rows: np.ndarray, columns: np.ndarray, order: int = 1) -> np.ndarray:
    """The image at every row and column, its edges repeated."""
    at = np.meshgrid(rows, columns, indexing="ij")
    return map_coordinates(image.astype(float), at, order=order, mode="nearest")


def votes(grey: np.ndarray) -> np.ndarray:
    """Soft census ``(16, H, W)`` of a grey image ``(H + 6, W + 6)`` in [0, 1]: 6 grey levels are 7 votes."""
    levels = np.rint(grey * 7 * 255 / 6).astype(int)
    height, width = (side - 6 for side in grey.shape)
    centre = levels[3 : 3 + height, 3 : 3 + width]
    neighbours = [levels[i : i + height, j : j + width] for i in (0, 2, 4, 6) for j in (0, 2, 4, 6)]
    return np.clip(np.stack(neighbours) - centre, -7, 7)


def cost(left_votes: np.ndarray, right_votes: np.ndarray) -> np.ndarray:
    return np.abs(left_votes - right_votes).sum(0)


def jump_penalties(grey: np.ndarray, down: int, across: int) -> np.ndarray:
    """The penalty between every pixel and the one a step before it; that of no edge where there is none."""
    height, width = grey.shape
    penalty = np.zeros((height, width))
    for v, u in np.ndindex(height, width):
        before = (v - down, u - across)
        inside = 0 <= before[0] < height and 0 <= before[1] < width
        edge = abs(grey[v, u] - grey[before]) if inside else 0.0
        penalty[v, u] = LARGEST * max(1.2 / (1.0 + edge / 0.1), 0.3)
    return np.rint(penalty).astype(int)


def aggregated(levels: np.ndarray, grey: np.ndarray) -> np.ndarray:
    """Hirschmueller's Eq. 13 along four paths."""
    return walked(levels, [jump_penalties(grey, 1, 0), jump_penalties(grey, 0, 1)], 34)


def walked(levels: np.ndarray, penalties, step: int) -> np.ndarray:
    """Sums over paths down, up, right and left, one line of pixels at a time."""
    levels, total = levels.astype(int), np.zeros(levels.shape, int)
    for axis, penalty in enumerate(penalties):
        lines, limits = np.moveaxis(levels, axis + 1, 0), np.moveaxis(penalty, axis, 0)
        sums = np.moveaxis(total, axis + 1, 0)
        for way in (1, -1):
            before = None
            for n in range(len(lines))[::way]:
                path = lines[n].copy()
                if before is not None:
                    least, sides = (
                        before.min(0),
                        np.pad(before, ((1, 1), (0, 0)), constant_values=10**6) + step,
                    )
                    jump = least + limits[n if way == 1 else n + 1]
                    path += np.minimum(np.minimum(before, jump), np.minimum(sides[2:], sides[:-2])) - least
                sums[n] += path
                before = path
    return total


def positions(total: np.ndarray) -> np.ndarray:
    """Planes of least sum, moved by a parabola through three sums where there are three."""
    index, found = total.argmin(0), np.zeros(total.shape[1:])
    for (y, x), k in np.ndenumerate(index):
        found[y, x] = k
        if 0 < k < len(total) - 1:
            below, best, above = (float(total[k + i, y, x]) for i in (-1, 0, 1))
            curvature = below + above - 2 * best
            found[y, x] += np.clip((below - above) / (2 * curvature), -0.5, 0.5) if curvature else 0.0
    return found


def window_mean(values: np.ndarray, radius: int) -> np.ndarray:
    """Mean over the part of a square window that lies inside the map ``(H, W)``."""
    found = np.zeros(values.shape)
    for v, u in np.ndindex(*values.shape):
        window = values[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1]
        found[v, u] = window.mean()
    return found
