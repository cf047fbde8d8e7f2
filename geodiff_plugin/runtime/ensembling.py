"""Ensembles of metric maps: median and median absolute deviation, without alignment.

Data flow: ``(E, 1, H, W)`` metres -> median and median absolute deviation.
Paper: S5.1 (an ensemble of 10).

Marigold's own ``ensemble_depth`` renormalises to [0, 1], which would throw the metres away.
"""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin._checks import check_choice

__all__ = ["REDUCTIONS", "ensemble_metric", "median", "spread_around"]

REDUCTIONS = ("median", "mean")


def ensemble_metric(depth_m: Tensor, reduction: str = "median") -> tuple[Tensor, Tensor]:
    """Reduce the members pixel by pixel.

    Args:
        depth_m: ``(E, 1, H, W)`` metres.
        reduction: ``"median"`` with the median absolute deviation, or ``"mean"`` with the standard deviation.

    Returns:
        prediction and uncertainty, ``(1, 1, H, W)`` metres each.

    Raises:
        ValueError: unknown reduction.
    """
    check_choice(reduction, "ensembling_kwargs['reduction']", REDUCTIONS)
    middle = depth_m.mean(0, keepdim=True) if reduction == "mean" else median(depth_m, 0)[None]
    return middle, spread_around(middle, depth_m, reduction)


def spread_around(middle: Tensor, depth_m: Tensor, reduction: str = "median") -> Tensor:
    """How far the members lie from a map, pixel by pixel.

    Args:
        middle: ``(1, 1, H, W)`` metres.
        depth_m: ``(E, 1, H, W)`` metres.
        reduction: ``"median"`` for the median absolute deviation, ``"mean"`` for the root mean square.

    Returns:
        ``(1, 1, H, W)`` metres.
    """
    away = depth_m - middle
    if reduction == "mean":
        return away.square().mean(0, keepdim=True).sqrt()
    return median(away.abs(), 0)[None]


def median(x: Tensor, dim: int) -> Tensor:
    """The median along ``dim``, which is dropped: of an even number the mean of the middle two.

    ``torch.median`` takes the lower one, which makes metres too near, and the spread of two members 0.
    """
    ordered, count = x.sort(dim=dim).values, x.shape[dim]
    return 0.5 * (ordered.select(dim, (count - 1) // 2) + ordered.select(dim, count // 2))
