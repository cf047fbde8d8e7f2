"""Semi-global aggregation: neighbours vote for similar inverse depths along straight paths.

Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", Eq. 13.
"""

from __future__ import annotations

import torch
from torch import Tensor

from geodiff_plugin.matching.census import COST_LEVELS

#: Cost of a step of one plane between neighbouring pixels, in units of the largest matching cost.
STEP_PENALTY = 0.15
#: Of any larger step where the image is flat, and the difference in brightness that halves it.
JUMP_PENALTY, JUMP_CONTRAST = 1.2, 0.1
#: Up, down, left and right.
PATHS = 4
#: Above any sum over the paths: in a place that is not to win.
NEVER = 20_000


def cells(planes: int, size: tuple[int, int], dtype: torch.dtype, device: torch.device) -> Tensor:
    """Memory ``(planes, N, M)``, not filled, for ``size = (N, M)``, as a path from row to row reads it."""
    return torch.empty(size[0], planes, size[1], dtype=dtype, device=device).transpose(0, 1)


class Room:
    """Memory reused from one aggregation to the next: touching fresh memory costs as much as a path."""

    def __init__(self) -> None:
        self._held: dict[str, Tensor] = {}

    def cells(self, name: str, planes: int, size: tuple[int, int], like: Tensor) -> Tensor:
        """``cells`` in the memory of this name; what it held before is lost."""
        count, held = planes * size[0] * size[1], self._held.get(name)
        if held is None or held.numel() < count:
            held = self._held[name] = torch.empty(count, dtype=like.dtype, device=like.device)
        return held[:count].view(size[0], planes, size[1]).transpose(0, 1)


def _scan_rows(cost: Tensor, p1: int, p2: Tensor, total: Tensor) -> None:
    """Add the path from the first row down and that from the last row up to ``total (D, N, M)`` int16.

    ``cost (D, N, M)`` uint8; ``p1`` is the penalty of a step of one plane, ``p2 (N, M)`` int16 that of any
    larger one between row n - 1 and row n.
    """
    planes, count, breadth = cost.shape
    # Both directions advance together, entry 0 down and entry 1 up; a plane more at either end never wins.
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
            if n:
                torch.add(step[i], cost[:, row], out=path[i])
            else:
                path[i] = cost[:, row]
            total[:, row] += path[i]


def _limits(grey: Tensor) -> tuple[Tensor, Tensor]:
    """Edge-adaptive P2 for vertical ``(H, W)`` and horizontal ``(W, H)`` paths: cheap jumps at edges."""
    limits = []
    for image in (grey, grey.T):
        difference = torch.zeros_like(image)
        difference[1:] = (image[1:] - image[:-1]).abs()
        limit = JUMP_PENALTY / (1.0 + difference / JUMP_CONTRAST)
        limit = limit.clamp_min(2.0 * STEP_PENALTY)
        limits.append((COST_LEVELS * limit).round().to(torch.int16))
    return limits[0], limits[1]


@torch.no_grad()
def aggregate(levels: Tensor, grey: Tensor, *, room: Room | None = None) -> Tensor:
    """Sums ``(D, H, W)`` int16, below ``NEVER``, of costs ``(D, H, W)`` uint8 along four paths.

    A brightness edge in ``grey (H, W)``, the same view in [0, 1], makes a jump in depth cheaper. ``room`` is
    memory to work in, which holds the result until its next use.

    Source: Hirschmueller 2008, Eq. 13.
    """
    vertical, horizontal = _limits(grey)
    step = round(COST_LEVELS * STEP_PENALTY)
    planes, height, width = levels.shape
    room, paths = room or Room(), levels.new_empty(0, dtype=torch.int16)
    turned = room.cells("turned", planes, (width, height), levels)
    sideways = room.cells("sideways", planes, (width, height), paths)
    total = room.cells("total", planes, (height, width), paths)
    # Plane by plane and from piece to piece: so a transposition goes by blocks, several times as fast.
    for plane, source in zip(turned, levels, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(turned, step, horizontal, sideways.zero_())
    for plane, source in zip(total, sideways, strict=True):
        plane.copy_(source.contiguous().T.contiguous())
    _scan_rows(levels, step, vertical, total)
    return total
