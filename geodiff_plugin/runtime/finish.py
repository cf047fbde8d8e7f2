"""From decoded maps to the result: ensembles reduced, matches fitted once more, edges made crisp.

Ensembles are of metric maps (S5.1): median and median absolute deviation, without alignment. Marigold's own
``ensemble_depth`` renormalises to [0, 1], which would lose the metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from torch import Tensor

from geodiff_plugin._checks import check_choice
from geodiff_plugin.algorithm.correction import correction_target, refine_depth
from geodiff_plugin.algorithm.evidence import Evidence
from geodiff_plugin.algorithm.finish import sharpen_edges, vote_depth
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry import image_size, resize_intrinsics
from geodiff_plugin.matching import Matches
from geodiff_plugin.runtime.run import GuidedRun

REDUCTIONS = ("median", "mean")


def finish(
    depth_m: Tensor,
    evidence: Evidence,
    kept: Tensor | None,
    error: Tensor | None,
    left: Tensor,
    spacing: int,
    config: GuidanceConfig,
) -> tuple[Tensor, Tensor] | None:
    """A decoded depth map refined to the result: fitted to matches and points, with crisp edges.

    Ramps first: a fit that finds edges steep does not carry the depth of a surface over to the next one. Then
    the fit, and the votes of matches, colours and the fitted map.

    Args:
        depth_m: ``(1, 1, H, W)`` metres on the grid of the output.
        evidence: of the image.
        kept: ``(1, 1, h, w)``, the share of each match's confidence that remains once reflections are
            rejected.
        error: of the prior, in log depth, as ``correction.local_error`` gives it.
        left: ``(1, 3, H, W)`` in [0, 1], the left image on that grid.
        spacing: pixels of that grid to a pixel of the decoded map, >= 1.
        config: hyperparameters.

    Returns:
        ``(1, 1, H, W)`` metres, and the support by matches and points in [0, 1]; ``None`` where there are
        none.
    """
    matches, points = Matches.stack([evidence.matches]), Matches.stack([evidence.points])
    if matches is not None or points is not None:
        depth_m = sharpen_edges(depth_m, left, spacing)
    target = correction_target(matches, points, kept, error, depth_m)
    if target is None or error is None:
        return None
    fitted_m, support, _ = refine_depth(depth_m, target, evidence.native_left[None], error, config)
    if matches is not None:
        target = correction_target(matches, points, kept, error, fitted_m)
        assert target is not None
        native = evidence.native_left[None]
        K = resize_intrinsics(evidence.K_left[None], image_size(evidence.left_01), image_size(native))[0]
        measured = error.amin((2, 3), keepdim=True)  # where the prior says something
        fitted_m = vote_depth(fitted_m, native, K, evidence.native, target, measured)
    return fitted_m, support


def finish_images(run: GuidedRun, depth_m: Tensor, lefts: Tensor) -> tuple[Tensor, Tensor | None]:
    """The result of every image, and how far matches and points decided it.

    Args:
        run: the finished run.
        depth_m: ``(N, 1, H, W)`` metres on the grid of the output.
        lefts: ``(N, 3, H, W)`` in [0, 1] on that grid.

    Returns:
        ``(N, 1, H, W)`` metres, and support in [0, 1]; the depth as it was given and ``None`` where the
        result is not to be refined, or some image has neither matches nor points.
    """
    if not run.config.crisp:
        return depth_m, None
    results = []
    for i, (depth, left) in enumerate(zip(depth_m.split(1), lefts.split(1), strict=True)):
        result = finish(
            depth, run.evidence[i], *run.kept_and_error(i), left, _spacing(run, depth), run.config
        )
        if result is None:
            return depth_m, None
        results.append(result)
    depths, supports = zip(*results, strict=True)
    return torch.cat(depths), torch.cat(supports)


def spread_of_members(run: GuidedRun, depth_m: Tensor, lefts: Tensor, call: Mapping[str, Any]) -> Tensor:
    """How far the members of every ensemble, finished one by one, lie from its result: ``(N, 1, H, W)`` m.

    It costs a fit per member: their spread before it is that of a map that is not given out. Arguments as
    ``finish_images``; ``call`` has those of the stock call by name.
    """
    size, method = image_size(depth_m), call["resample_method_output"]
    reduction = (call["ensembling_kwargs"] or {}).get("reduction", "median")
    spreads = []
    for i, members in enumerate(run.members):
        members = members.float().to(depth_m.device)
        if image_size(members) != size:  # as the stock call brings the ensemble to its output
            members = MarigoldImageProcessor.resize_antialias(members, size, method, is_aa=False)
            members = run.within_range(members, i)
        left, spacing = lefts[i : i + 1], _spacing(run, depth_m)
        results = [
            finish(member, run.evidence[i], *run.kept_and_error(i, m), left, spacing, run.config)
            for m, member in enumerate(members.split(1))
        ]
        finished = torch.cat([result[0] for result in results if result is not None])
        spreads.append(spread_around(depth_m[i : i + 1], finished, reduction))
    return torch.cat(spreads)


def _spacing(run: GuidedRun, depth_m: Tensor) -> int:
    return max(1, round(max(image_size(depth_m)) / max(run.grid.content)))


def ensemble_metric(depth_m: Tensor, reduction: str = "median", lower: bool = False) -> tuple[Tensor, Tensor]:
    """Reduce members ``(E, 1, H, W)`` metres pixel by pixel to a map and its uncertainty, ``(1, 1, H, W)`` m.

    ``"median"`` (as ``median``) has the median absolute deviation, ``"mean"`` the standard deviation; another
    ``reduction`` is an ``InputError``.
    """
    check_choice(reduction, "ensembling_kwargs['reduction']", REDUCTIONS)
    middle = depth_m.mean(0, keepdim=True) if reduction == "mean" else median(depth_m, 0, lower)[None]
    return middle, spread_around(middle, depth_m, reduction)


def spread_around(middle: Tensor, depth_m: Tensor, reduction: str = "median") -> Tensor:
    """How far members ``(E, 1, H, W)`` lie from a map ``(1, 1, H, W)``, pixel by pixel, metres.

    ``reduction`` is ``"median"`` for the median absolute deviation, ``"mean"`` for the root mean square.
    """
    away = depth_m - middle
    if reduction == "mean":
        return away.square().mean(0, keepdim=True).sqrt()
    return median(away.abs(), 0)[None]


def median(x: Tensor, dim: int, lower: bool = False) -> Tensor:
    """The median along ``dim``, which is dropped: of an even number the mean of the middle two, or the lower.

    ``torch.median``, and so Marigold-DC, takes the lower of the two, which makes metres too near, and the
    spread of two members 0.
    """
    ordered, count = x.sort(dim=dim).values, x.shape[dim]
    below = ordered.select(dim, (count - 1) // 2)
    return below if lower else 0.5 * (below + ordered.select(dim, count // 2))
