"""Evaluation crops by the names that papers use: Garg, Eigen, KITTI's benchmark.

Data flow: name, image size -> mask of the pixels that count.
Paper: none given for KITTI (S5.1); the names are those of the monocular depth literature.
"""

from __future__ import annotations

import numpy as np

from geodiff_plugin._checks import bad_value, check_choice

__all__ = ["CROPS", "crop_mask"]

#: Shares of the image: first and last row, first and last column.
_SHARES = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.0359477, 0.96405229),
}
#: Rows and columns that every image of KITTI's depth benchmark has.
_BENCHMARK = (352, 1216)
CROPS = ("none", "garg", "eigen", "benchmark")
"""The crops: all pixels, Garg's, Eigen's, and the 1216 x 352 pixels of KITTI's depth benchmark."""


def crop_mask(name: str, size: tuple[int, int]) -> np.ndarray:
    """Pixels inside of a crop; methods still see whole images.

    Args:
        name: one of ``CROPS``.
        size: ``(H, W)`` of the image.

    Returns:
        ``(H, W)`` bool. Of 375 x 1242 pixels, Garg's crop keeps rows 153 to 370 and columns 44 to 1196,
        Eigen's rows 124 to 341 and the same columns, the benchmark's rows 23 to 374 and columns 13 to 1228
        (at the bottom, in the middle).

    Raises:
        ValueError: an unknown name, or an image smaller than the benchmark's.

    Source: Marigold's evaluation of KITTI, which follows BTS and monodepth. Deviation: Marigold's tables take
        Eigen's crop of an image that was cut to the benchmark's before; here each stands alone.
    """
    check_choice(name, "crop", CROPS)
    height, width = size
    if name == "none":
        return np.ones(size, bool)
    if name == "benchmark":
        rows, columns = _BENCHMARK
        if height < rows or width < columns:
            cure = "It is for KITTI; leave --crop out."
            bad_value(
                "crop", f"'benchmark' for images of at least {columns} x {rows}", f"{width} x {height}", cure
            )
        top, left = height - rows, (width - columns) // 2
        bottom, right = top + rows, left + columns
    else:
        top, bottom, left, right = (
            int(share * side)
            for share, side in zip(_SHARES[name], (height, height, width, width), strict=True)
        )
    mask = np.zeros(size, bool)
    mask[top:bottom, left:right] = True
    return mask
