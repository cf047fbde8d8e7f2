"""Reduces an ensemble in metres per pixel (S5.1); Marigold's own reduction renormalizes to [0, 1]."""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin._internal.checks import check_choice


def ensemble_metric(depth_m: Tensor, reduction: str = "median", lower: bool = False) -> tuple[Tensor, Tensor]:
    """Reduce members ``(E, 1, H, W)`` metres per pixel to a map and its uncertainty, ``(1, 1, H, W)`` m.

    The uncertainty of ``"median"`` is the median absolute deviation, and of ``"mean"`` the standard
    deviation.
    """
    check_choice(reduction, "ensembling_kwargs['reduction']", ("median", "mean"))
    middle = depth_m.mean(0, keepdim=True) if reduction == "mean" else median(depth_m, 0, lower)[None]
    return middle, spread_around(middle, depth_m, reduction)


def spread_around(middle: Tensor, depth_m: Tensor, reduction: str) -> Tensor:
    """Compute the spread of members ``(E, 1, H, W)`` around a map ``(1, 1, H, W)`` per pixel, metres."""
    away = depth_m - middle
    if reduction == "mean":
        return away.square().mean(0, keepdim=True).sqrt()
    return median(away.abs(), 0)[None]


def median(x: Tensor, dim: int, lower: bool = False) -> Tensor:
    """Compute the median along ``dim``; for even counts the mean of the middle two, or the ``lower`` one.

    ``torch.median``, and therefore Marigold-DC, takes the lower one, which biases depth towards the camera.
    """
    count = x.shape[dim]
    if count == 1:
        return x.select(dim, 0)
    ordered = x.sort(dim=dim).values
    below = ordered.select(dim, (count - 1) // 2)
    return below if lower else 0.5 * (below + ordered.select(dim, count // 2))
