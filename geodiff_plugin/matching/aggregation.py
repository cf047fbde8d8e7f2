"""Semi-global aggregation: neighbours vote for similar inverse depths along straight paths.

Hop: cost volume (D, H, W) -> aggregated costs (D, H, W).
Paper: none (Hirschmueller 2008, "Stereo processing by semiglobal matching and mutual information", Eq. 13).
"""

from __future__ import annotations

import torch

__all__ = ["aggregate"]


def _scan_rows(cost: torch.Tensor, p1: float, p2: torch.Tensor, total: torch.Tensor) -> None:
    """Add the path from the first row down and the one from the last row up to ``total``.

    Args:
        cost: ``(D, N, M)``; paths run along N, side by side over M.
        p1: penalty of a step of one plane.
        p2: ``(N, M)`` penalty of any larger step between row n - 1 and row n.
        total: ``(D, N, M)``, changed in place.
    """
    count = cost.shape[1]
    # Both directions advance together: entry 0 goes down, entry 1 goes up.
    path = torch.stack([cost[:, 0], cost[:, -1]])  # (2, D, M)
    total[:, 0] += path[0]
    total[:, -1] += path[1]
    step = torch.empty_like(path)
    for n in range(1, count):
        up = count - 1 - n
        path -= path.amin(dim=1, keepdim=True)
        limit = torch.stack([p2[n], p2[up + 1]])[:, None]
        torch.add(path, p1, out=step)
        torch.minimum(path, limit, out=path)
        torch.minimum(path[:, 1:], step[:, :-1], out=path[:, 1:])
        torch.minimum(path[:, :-1], step[:, 1:], out=path[:, :-1])
        path[0] += cost[:, n]
        path[1] += cost[:, up]
        total[:, n] += path[0]
        total[:, up] += path[1]


def _limits(grey: torch.Tensor, p1: float, p2: float, contrast: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Edge-adaptive P2 for vertical ``(H, W)`` and horizontal ``(W, H)`` paths: cheap jumps at edges."""
    limits = []
    for image in (grey, grey.T):
        difference = torch.zeros_like(image)
        difference[1:] = (image[1:] - image[:-1]).abs()
        limits.append((p2 / (1.0 + difference / contrast)).clamp_min(2.0 * p1))
    return limits[0], limits[1]


@torch.no_grad()
def aggregate(
    cost: torch.Tensor, grey: torch.Tensor, *, p1: float = 0.15, p2: float = 1.2, contrast: float = 0.1
) -> torch.Tensor:
    """Semi-global aggregation along four paths.

    Args:
        cost: ``(D, H, W)`` float32, about [0, 1].
        grey: ``(H, W)`` of the same view in [0, 1]: a brightness edge makes a jump in depth cheaper there.
        p1: penalty of a step of one plane between neighbouring pixels.
        p2: penalty of any larger step where the image is flat.
        contrast: brightness difference that halves ``p2``.

    Returns:
        ``(D, H, W)`` mean over the paths; not differentiable.

    Source: Hirschmueller 2008, Eq. 13 with paths up, down, left, right.
    """
    vertical, horizontal = _limits(grey, p1, p2, contrast)
    total = torch.zeros_like(cost)
    _scan_rows(cost, p1, vertical, total)
    turned = cost.transpose(
        1, 2
    ).contiguous()  # (D, W, H): columns become rows, contiguous along the scan's other axis
    sideways = torch.zeros_like(turned)
    _scan_rows(turned, p1, horizontal, sideways)
    del turned
    total += sideways.transpose(1, 2)
    return total.mul_(0.25)
