"""An ensemble in metres, reduced pixel by pixel (S5.1); Marigold's own reduction renormalises to [0, 1]."""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin._checks import check_choice


def ensemble_metric(depth_m: Tensor, reduction: str = "median", lower: bool = False) -> tuple[Tensor, Tensor]:
    """Reduce members ``(E, 1, H, W)`` metres pixel by pixel to a map and its uncertainty, ``(1, 1, H, W)`` m.

    ``"median"`` has the median absolute deviation, ``"mean"`` the standard deviation.
    """
    check_choice(reduction, "ensembling_kwargs['reduction']", ("median", "mean"))
    middle = depth_m.mean(0, keepdim=True) if reduction == "mean" else median(depth_m, 0, lower)[None]
    return middle, spread_around(middle, depth_m, reduction)


def spread_around(middle: Tensor, depth_m: Tensor, reduction: str) -> Tensor:
    """How far members ``(E, 1, H, W)`` lie from a map ``(1, 1, H, W)``, pixel by pixel, metres."""
    away = depth_m - middle
    if reduction == "mean":
        return away.square().mean(0, keepdim=True).sqrt()
    return median(away.abs(), 0)[None]


def median(x: Tensor, dim: int, lower: bool = False) -> Tensor:
    """The median along ``dim``, which is dropped: of an even number the mean of the middle two, or the lower.

    ``torch.median``, and so Marigold-DC, takes the lower, which makes metres too near.
    """
    count = x.shape[dim]
    if count == 1:
        return x.select(dim, 0)
    ordered = x.sort(dim=dim).values
    below = ordered.select(dim, (count - 1) // 2)
    return below if lower else 0.5 * (below + ordered.select(dim, count // 2))
