"""Put members together that are in metres already.

Hop: ``(E, 1, H, W)`` metres -> median and median absolute deviation.
Paper: S5.1 (an ensemble of 10).

Marigold's own ``ensemble_depth`` renormalises to [0, 1], which would throw the metres away.
"""

from __future__ import annotations

from torch import Tensor

from geodiff_plugin._checks import check_choice

__all__ = ["REDUCTIONS", "ensemble_metric", "median"]

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
    if reduction == "mean":
        return depth_m.mean(0, keepdim=True), depth_m.std(0, keepdim=True, correction=0)
    middle = median(depth_m, 0)[None]
    return middle, median((depth_m - middle).abs(), 0)[None]


def median(x: Tensor, dim: int) -> Tensor:
    """The median along ``dim``, which is dropped: of an even number the mean of the middle two.

    ``torch.median`` takes the lower one, which makes metres too near, and the spread of two members 0.
    """
    ordered, count = x.sort(dim=dim).values, x.shape[dim]
    return 0.5 * (ordered.select(dim, (count - 1) // 2) + ordered.select(dim, count // 2))
