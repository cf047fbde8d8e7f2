"""Guidance terms: functions from what an estimate is compared with to one number per sample, and their table.

A new term is a function and one line in ``TERMS``. ``photometric`` and ``prior_pull`` are Eq. 14
(eq:geo-loss) and Eq. 17; the others go beyond the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm.photometric import masked_mean, photometric
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import AffineState

#: Errors at points up to this share of the unit are float32's rounding and pull no more: a rule that gives
#: every gradient the same length would follow their sign.
ROUNDING = 1e-3
#: Residual of matches, in planes, and of points, in their unit, from which their pull falls: a wrong match
#: must not win against its neighbours, but a surface that the prior put far away must still feel where it is.
CAUCHY = 5.0
#: Share of the anchor's pull that remains where every pixel is matched.
ANCHOR_FLOOR = 0.05


@dataclass(frozen=True)
class Compared:
    """One metric estimate on the loss grid, and what the terms compare it with.

    Attributes:
        depth_m: ``(B, 1, H, W)`` metres, carries the graph.
        left_01: ``(B, 3, H, W)`` the left image.
        warped_01: ``(B, V, 3, H, W)`` every right image seen from the left through ``depth_m``.
        visible: ``(B, V, 1, H, W)`` bool: in view of that camera, and not known to be hidden from it.
        affine: current scale, shift, g_s; carries the graph.
        affine_start: where the search put them; no graph.
        z0: ``(B, C, h, w)`` current clean latent, carries the graph.
        z0_prior: ``(B, C, h, w)`` the network's own clean latent of this step; no graph.
        matches: those that are believed, or ``None``.
        points: depths that the user knows, or ``None``.
    """

    depth_m: Tensor
    left_01: Tensor
    warped_01: Tensor
    visible: Tensor
    affine: AffineState
    affine_start: AffineState
    z0: Tensor
    z0_prior: Tensor
    matches: Matches | None
    points: Matches | None = None


@dataclass(frozen=True)
class Term:
    """One entry of ``TERMS``: a term whose input a call lacks is left out.

    Attributes:
        function: ``Compared`` -> ``(B,)``.
        options: fields of the configuration that it takes as keywords.
        needs_warp: it reads ``warped_01``.
        needs_matches: it reads ``matches``.
        needs_points: it reads ``points``.
    """

    function: Callable[..., Tensor]
    options: tuple[str, ...] = ()
    needs_warp: bool = False
    needs_matches: bool = False
    needs_points: bool = False


def cauchy(e: Tensor, width: float) -> Tensor:
    """``width^2 / 2 log(1 + (e / width)^2)``: ``e^2 / 2`` near 0, its gradient falls as 1 / e beyond."""
    return 0.5 * width**2 * ((e / width) ** 2).log1p()


def _relative_error(depth_m: Tensor, target: Matches) -> Tensor:
    """Error in inverse depth, in units of the target's step."""
    return (1.0 / depth_m - target.inverse_depth) / target.plane_step.view(-1, 1, 1, 1)


def photometric_term(
    compared: Compared,
    *,
    eta: float = DEFAULT.eta,
    pyramid_levels: int = DEFAULT.pyramid_levels,
    exposure: bool = DEFAULT.exposure,
) -> Tensor:
    """``photometric`` of the right images seen from the left, over the pixels that some right camera sees."""
    return photometric(
        compared.left_01,
        compared.warped_01,
        compared.visible,
        eta=eta,
        pyramid_levels=pyramid_levels,
        exposure=exposure,
    )


def matches_term(compared: Compared) -> Tensor:
    """Robust distance from the matches, in inverse depth, in units of one plane of the sweep.

    Far and near pixels weigh alike, because one plane is one step of shift in the right image.

    Returns:
        ``(B,)``, confidence-weighted mean; 0 where a sample has no match.
    """
    target = compared.matches
    assert target is not None  # Term.needs_matches
    return masked_mean(cauchy(_relative_error(compared.depth_m, target), CAUCHY), target.confidence)


def points_term(compared: Compared, *, points_loss: str = DEFAULT.points_loss) -> Tensor:
    """Error at depths that the user knows: lidar, structure from motion, a tape measure.

    Robust, far and near points weigh alike and a wrong point (seen through a window, from the other side of
    an edge) does not win against the rest; in metres the far ones decide.

    Args:
        compared: needs ``depth_m`` and ``points``.
        points_loss: ``"robust"``: the Cauchy loss of the matches, with 1 % of the points' median inverse
        depth
            as the unit; ``"l1l2"``: mean absolute plus mean squared error, metres (Marigold-DC, Viola et al.
            2024, Eq. 4).

    Returns:
        ``(B,)``; 0 where a sample has no point on the grid.
    """
    target = compared.points
    assert target is not None  # Term.needs_points
    if points_loss == "robust":
        e = _relative_error(compared.depth_m, target)
        return masked_mean(cauchy(F.hardshrink(e, ROUNDING), CAUCHY), target.confidence)
    given = target.confidence > 0
    e = (compared.depth_m - 1.0 / target.inverse_depth.where(given, target.inverse_depth.new_ones(()))).abs()
    return masked_mean(e + e * e, given)


def prior_pull(compared: Compared, *, pull_to: str = DEFAULT.pull_to) -> Tensor:
    """Squared distance of the raw scale and shift from an anchor, ``||s_hat - s*||^2 + ||t_hat - t*||^2``.

    Args:
        compared: needs ``affine`` and ``affine_start``.
        pull_to: ``"zero"`` is the paper's; ``"start"`` is the search's result.

    Returns:
        ``(B,)``, to be weighted by gamma.

    Source: Eq. 17. Deviation: ``"start"``, because the paper's pull of the raw values towards 0 makes
    softplus(0) = 0.693 for both, that is far / near = 2 for every scene.
    """
    s, t = compared.affine.s_hat, compared.affine.t_hat
    if pull_to == "start":
        s = s - compared.affine_start.s_hat
        t = t - compared.affine_start.t_hat
    return s * s + t * t


def anchor(compared: Compared) -> Tensor:
    """Mean squared distance of the clean latent from the network's own, where the views say nothing.

    With several inner updates it keeps unmatched regions with the prior, and leaves matched ones to the
    matches: the proximal form of one diffusion posterior step (S3.2 takes a single gradient step instead).

    Args:
        compared: needs ``z0`` and ``z0_prior``; with ``matches`` the pull falls as their confidence rises.

    Returns:
        ``(B,)``.
    """
    square = (compared.z0 - compared.z0_prior).pow(2).mean(1, keepdim=True)  # (B, 1, h, w)
    if compared.matches is not None:
        matched = F.interpolate(compared.matches.confidence, square.shape[-2:], mode="area")
        square = square * (1.0 - matched).clamp_min(ANCHOR_FLOOR)
    return square.flatten(1).mean(1)


TERMS: dict[str, Term] = {
    "photometric": Term(photometric_term, ("eta", "pyramid_levels", "exposure"), needs_warp=True),
    "matches": Term(matches_term, needs_matches=True),
    "points": Term(points_term, ("points_loss",), needs_points=True),
    "prior_pull": Term(prior_pull, ("pull_to",)),
    "anchor": Term(anchor),
}
