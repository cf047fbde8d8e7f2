"""Semi-global aggregation: smooths matching costs along straight paths.

Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", Eq. 13.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin._internal.kernels import has_kernel
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.constants import (
    AXES,
    JUMP_CONTRAST,
    JUMP_PENALTY,
    NEVER,
    STEP_LEVELS,
    STEP_PENALTY,
)
from geodiff_plugin.matching.volume import Buffers


def _scan_rows(cost: Tensor, p1: int, p2: Tensor, total: Tensor, *, fresh: bool) -> None:
    """Add the downward path from the first row and the upward one from the last to ``total (D, N, M)`` int16.

    ``cost (D, N, M)`` is uint8. ``p1`` is the penalty of a step of one plane, ``p2 (N, M)`` int16 the penalty
    of any larger step between rows n - 1 and n. With ``fresh`` the content of ``total`` is undefined.
    """
    planes, count, breadth = cost.shape
    # Both directions advance together: entry 0 down, entry 1 up. The padded planes at both ends never win.
    padded = total.new_full((2, planes + 2, breadth), NEVER)
    path = padded[:, 1:-1]
    before = padded[:, :-2]
    after = padded[:, 2:]
    step = total.new_empty(2, planes, breadth)
    least = total.new_empty(2, 1, breadth)
    limits = torch.stack([p2[1:], p2[1:].flip(0)], dim=1)[:, :, None]
    for n in range(count):
        rows = (n, count - 1 - n)
        if n:
            torch.amin(path, dim=1, keepdim=True, out=least)
            torch.minimum(before, after, out=step).add_(p1)
            torch.minimum(step, path, out=step)
            torch.minimum(step, limits[n - 1] + least, out=step).sub_(least)
        for i, row in enumerate(rows):
            if fresh and 2 * n < count:
                total[:, row].zero_()
            path[i].copy_(cost[:, row])  # adding two dtypes would be slower
        if n:
            path.add_(step)
        for i, row in enumerate(rows):
            total[:, row].add_(path[i])


def jump_penalties(grey: Tensor, axes: Sequence[tuple[int, int]]) -> Tensor:
    """Compute the edge-adaptive P2 of each axis, ``(A, H, W)`` int16: low at edges of ``grey (H, W)``.

    Each pixel holds the penalty between it and the previous pixel along the axis, the same in both
    directions. It is 0 next to NaN, an invalid pixel, so that no path continues there. An axis is a step
    (rows, columns) with 0 or 1 rows and -1, 0 or 1 columns.
    """
    difference = grey.new_zeros(len(axes), *grey.shape)
    height, width = grey.shape
    for of_axis, (down, across) in zip(difference, axes, strict=True):
        # Overlapping crops: the pixels that have a previous one, and these previous ones.
        to_right = max(across, 0)
        to_left = max(-across, 0)
        here = slice(down, height), slice(to_right, width - to_left)
        previous = slice(0, height - down), slice(to_left, width - to_right)
        of_axis[here] = (grey[here] - grey[previous]).abs()
    limit = JUMP_PENALTY / (1.0 + difference / JUMP_CONTRAST)
    limit = limit.clamp_min(2.0 * STEP_PENALTY).nan_to_num(0.0)
    return (COST_LEVELS * limit).round().to(torch.int16)


@torch.no_grad()
@has_kernel("matching.kernels.aggregation.aggregate")
def aggregate(levels: Tensor, grey: Tensor, *, buffers: Buffers | None = None) -> Tensor:
    """Sum costs ``(D, H, W)`` uint8 along four paths; the sums ``(D, H, W)`` are below ``NEVER``.

    Sums are int16, from the kernel int32. A brightness edge in ``grey (H, W)``, the same view in [0, 1],
    lowers the penalty of a depth discontinuity; paths start again at NaN, an invalid pixel. The result is
    valid until the next use of ``buffers``.

    Source: Hirschmueller 2008, Eq. 13.
    """
    penalties = jump_penalties(grey, AXES)
    vertical = penalties[0]
    horizontal = penalties[1].T
    planes, height, width = levels.shape
    buffers = buffers or Buffers()
    paths = levels.new_empty(0, dtype=torch.int16)
    transposed = buffers.empty("turned", planes, (width, height), levels)
    sideways = buffers.empty("sideways", planes, (width, height), paths)
    total = buffers.empty("total", planes, (height, width), paths)
    # Making contiguous copies plane by plane speeds the transposition up several times.
    for plane, source in zip(transposed, levels, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(transposed, STEP_LEVELS, horizontal, sideways, fresh=True)
    for plane, source in zip(total, sideways, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(levels, STEP_LEVELS, vertical, total, fresh=False)
    return total
