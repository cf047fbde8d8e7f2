"""Semi-global aggregation: neighbours vote for similar inverse depths along straight paths.

Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", Eq. 13.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from geodiff_plugin._kernels import use_kernel
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.winner import NEVER

#: Cost of a step of one plane between neighbouring pixels, in units of the largest matching cost.
STEP_PENALTY = 0.15
#: Cost of any larger step where the image is flat.
JUMP_PENALTY = 1.2
#: Difference in brightness that halves this cost: depth steps where the image does.
JUMP_CONTRAST = 0.1
#: Steps (rows, columns) along which paths run both ways: down and up, right and left.
AXES = ((1, 0), (0, 1))
PATHS = 2 * len(AXES)


def empty_volume(planes: int, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Uninitialised ``(planes, N, M)`` for ``size = (N, M)``, laid out for paths from row to row."""
    return torch.empty(size[0], planes, size[1], dtype=dtype, device=device).transpose(0, 1)


class Buffers:
    """Buffers reused from one aggregation to the next: touching fresh memory costs as much as a path."""

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def empty(self, name: str, planes: int, size: tuple[int, int], like: Tensor) -> Tensor:
        """``empty_volume`` in the buffer of this name, whose former content is lost."""
        count, held = planes * size[0] * size[1], self._held.get(name)
        if held is None or held.numel() < count:
            held = self._held[name] = torch.empty(count, dtype=like.dtype, device=like.device)
        return held[:count].view(size[0], planes, size[1]).transpose(0, 1)


def _scan_rows(cost: Tensor, p1: int, p2: Tensor, total: Tensor, *, fresh: bool) -> None:
    """Add the path from the first row down and that from the last row up to ``total (D, N, M)`` int16.

    ``cost (D, N, M)`` uint8; ``p1`` is the penalty of a step of one plane, ``p2 (N, M)`` int16 that of any
    larger one between row n - 1 and row n. A ``fresh`` total has no content yet.
    """
    planes, count, breadth = cost.shape
    # Both directions advance together, entry 0 down and entry 1 up; the padding at both ends never wins.
    padded = total.new_full((2, planes + 2, breadth), NEVER)
    path, before, after = padded[:, 1:-1], padded[:, :-2], padded[:, 2:]
    step, least = total.new_empty(2, planes, breadth), total.new_empty(2, 1, breadth)
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
            path[i].copy_(cost[:, row])  # a sum of two types would cost more
        if n:
            path.add_(step)
        for i, row in enumerate(rows):
            total[:, row].add_(path[i])


def jump_penalties(grey: Tensor, axes: Sequence[tuple[int, int]]) -> Tensor:
    """Edge-adaptive P2 of each axis, ``(A, H, W)`` int16: jumps at edges of ``grey (H, W)`` are cheap.

    At a pixel stands the penalty between it and the one a step of the axis before it, which is the same both
    ways. An axis is a step (rows, columns) of 0, 1 or -1 along rows and of 0 or 1 down.
    """
    if use_kernel(grey):
        from geodiff_plugin.matching import kernels

        return kernels.jump_penalties(grey, axes)
    difference = grey.new_zeros(len(axes), *grey.shape)
    height, width = grey.shape
    for of_axis, (down, across) in zip(difference, axes, strict=True):
        left, right = max(across, 0), max(-across, 0)
        later, before = grey[down:, left : width - right], grey[: height - down, right : width - left]
        of_axis[down:, left : width - right] = (later - before).abs()
    limit = JUMP_PENALTY / (1.0 + difference / JUMP_CONTRAST)
    limit = limit.clamp_min(2.0 * STEP_PENALTY)
    return (COST_LEVELS * limit).round().to(torch.int16)


@torch.no_grad()
def aggregate(levels: Tensor, grey: Tensor, *, buffers: Buffers | None = None) -> Tensor:
    """Sums ``(D, H, W)`` below ``NEVER`` of costs ``(D, H, W)`` uint8 along four paths.

    They are int16, from the kernel int32. A brightness edge in ``grey (H, W)``, the same view in [0, 1],
    makes a jump in depth cheaper. The result stays in ``buffers`` until their next use.

    Source: Hirschmueller 2008, Eq. 13.
    """
    penalties, step = jump_penalties(grey, AXES), round(COST_LEVELS * STEP_PENALTY)
    if use_kernel(levels):
        from geodiff_plugin.matching import kernels

        return kernels.aggregate(levels, penalties, step, AXES)
    vertical, horizontal = penalties[0], penalties[1].T
    planes, height, width = levels.shape
    buffers, paths = buffers or Buffers(), levels.new_empty(0, dtype=torch.int16)
    turned = buffers.empty("turned", planes, (width, height), levels)
    sideways = buffers.empty("sideways", planes, (width, height), paths)
    total = buffers.empty("total", planes, (height, width), paths)
    # Contiguous copies plane by plane make the transposition several times as fast.
    for plane, source in zip(turned, levels, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(turned, step, horizontal, sideways, fresh=True)
    for plane, source in zip(total, sideways, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(levels, step, vertical, total, fresh=False)
    return total
