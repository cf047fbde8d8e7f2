"""Matches all over the image: optical flow between the left view and the right one warped by a first depth.

Data flow: left image, right image, first depth, pose -> one checked match a cell of the left image.
Paper: none; Kroeger et al. 2016 (DIS flow).
"""

from __future__ import annotations

import cv2
import numpy as np

__all__ = ["cell_centres", "dense_matches"]

#: One match a cell of so many pixels a side.
CELL_PX = 10
#: Flow there and back may differ by this much, pixels.
THERE_AND_BACK_PX = 0.5
#: Flow further than this is no correction of a warp but a wrong match, pixels.
FARTHEST_PX = 24.0
#: Contrast that a cell must have for its flow to mean anything: standard deviation of grey, of 255.
LEAST_CONTRAST = 2.0


def cell_centres(size: tuple[int, int]) -> np.ndarray:
    """``(N, 2)`` whole pixels (column, row), the centres of the cells of an image ``(H, W)``."""
    rows, columns = (np.arange(CELL_PX // 2, side, CELL_PX) for side in size)
    return np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)


def _flow(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    return dis.calc(one, other, None)


def _read(field: np.ndarray, px: np.ndarray) -> np.ndarray:
    """Values of a map ``(H, W, 2)`` at pixels ``(N, 2)``, bilinear."""
    at = px.astype(np.float32)[:, None]
    return cv2.remap(field, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[:, 0]


def dense_matches(
    left: np.ndarray, right: np.ndarray, uv: np.ndarray, visible: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Right pixels of the cells' centres.

    Args:
        left: ``(H, W)`` uint8 grey.
        right: ``(Hr, Wr)`` uint8 grey.
        uv: ``(H, W, 2)`` float32, the right pixel of every left one by pose and first depth.
        visible: ``(H, W)`` bool, where ``uv`` lies inside the right image.

    Returns:
        ``(N, 2)`` right pixels of ``cell_centres`` and ``(N,)`` bool, which of them hold.
    """
    warped = cv2.remap(right, uv, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    there, back = _flow(left, warped), _flow(warped, left)
    centres = cell_centres(left.shape)
    flow = _read(there, centres)
    landed = centres + flow
    off = np.linalg.norm(flow + _read(back, landed), axis=1)
    column, row = np.clip(np.rint(landed), 0, (left.shape[1] - 1, left.shape[0] - 1)).astype(int).T
    values = left.astype(np.float32)
    spread = cv2.blur(values**2, (CELL_PX + 1,) * 2) - cv2.blur(values, (CELL_PX + 1,) * 2) ** 2
    holds = (off < THERE_AND_BACK_PX) & (np.linalg.norm(flow, axis=1) < FARTHEST_PX) & visible[row, column]
    holds &= spread[centres[:, 1], centres[:, 0]] > LEAST_CONTRAST**2
    holds &= ((landed >= 0) & (landed <= np.array(left.shape[::-1]) - 1)).all(1)
    return _read(uv, landed).astype(np.float64), holds
