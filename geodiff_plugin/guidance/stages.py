"""The stages of the configuration that a guided step goes through: terms, reflections, correction, updates.

Data flow: named values -> a stage, checked.
Paper: Algorithm 1, S5.1, S9 name some numbers; a leaf that the paper has no number or no place for says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from geodiff_plugin._checks import bad_type, check_number
from geodiff_plugin.guidance.fields import TINY, Checked, by_name, choice, flag, integer, key_of, number, pair

__all__ = ["CorrectionConfig", "ReflectionsConfig", "TermsConfig", "UpdatesConfig"]


def _option(value: Any, name: str) -> Any:
    """What an option of a term may be."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (list, tuple)):
        return tuple(_option(entry, name) for entry in value)
    if isinstance(value, (int, float)):
        return check_number(value, name, float("-inf"), float("inf"))
    return bad_type(name, "a number, a text, True, False, None or a list of these", value)


@dataclass(frozen=True)
class TermsConfig(Checked):
    """What the terms of the loss compare, and how."""

    eta: float = number(
        0.85, 0, 1, "SSIM against L1 in the photometric term (Eq. 14)", paper="{} (not given)"
    )
    pyramid_levels: int = integer(3, 1, 10, "image pyramid of the photometric term")
    exposure: bool = flag(
        True,
        "photographs are compared in the left one's exposure: gain and bias per channel and a slow field, in "
        "closed form",
    )
    exposure_gain: tuple[float, float] = pair(
        (0.2, 5.0), "gains beyond these say that two photographs do not show the same scene", paper="-"
    )
    exposure_rows: int = integer(
        4, 1, 1000, "rows of cells of the slow field: vignetting, sun from one side", paper="-"
    )
    exposure_columns: int = integer(5, 1, 1000, "columns of cells of the slow field", paper="-")
    exposure_prior: float = number(
        0.2,
        TINY,
        1e6,
        "share of a cell in view that counts as much as what is known of the whole image",
        paper="-",
    )
    z_test: bool = flag(
        True,
        "pixels that the estimate hides from a right camera take no part in the photometric term, as the "
        "right image shows something else there",
    )
    min_visible: float = number(0.1, 0, 1, "share in view below which the photometric term is off")
    pull_to: str = choice(
        "start",
        ("start", "zero"),
        "what `prior_pull` pulls s_hat, t_hat towards (Eq. 17): the search's result, or 0",
    )
    matches_cauchy: float = number(
        5.0,
        TINY,
        1e6,
        "residual of the matches, in planes, from which their pull falls: a wrong match must not win "
        "against its neighbours, but a surface that the prior put far away must still feel where it is",
        paper="-",
    )
    points_loss: str = choice(
        "robust",
        ("robust", "l1l2"),
        "error at known points: Cauchy in inverse depth, in units of 1 % of the points' median inverse "
        "depth, or L1 + L2 in metres (Marigold-DC, Eq. 4)",
        paper="-",
    )
    points_cauchy: float = number(
        5.0, TINY, 1e6, "residual of the points, in those units, from which their pull falls", paper="-"
    )
    anchor_floor: float = number(
        0.05, 0, 1, "share of the anchor's pull that remains where every pixel is matched", paper="-"
    )
    options: Mapping[str, Any] = by_name(
        {}, "TERM.OPTION -> value", _option, "options of terms beyond those of the package", paper="-"
    )


@dataclass(frozen=True)
class ReflectionsConfig(Checked):
    """Rejection of what is seen in mirrors and through glass, which S5.2 names as a second view's limit."""

    reject_reflections: bool = flag(
        True,
        "matches that lie behind the prior's first estimate, over a region and by more than the image's "
        "matches scatter around it, lose their weight: they are reflections in mirrors and glass",
    )
    reflection_region: float = number(
        0.08,
        0,
        1,
        "half the side of the window over which matches must agree, in image sides; with a smaller "
        "one, gaps that the prior misses would be taken for reflections",
        paper="-",
    )
    reflection_spreads: float = number(
        2.0, 0, 1e6, "how far behind, in spreads of the matches around the prior's log depth", paper="-"
    )
    reflection_floor: float = number(0.2, TINY, 1e3, "and at least this far, in log depth", paper="-")
    reflection_least_spread: float = number(
        0.05, 0, 1e3, "least spread that is assumed, in log depth", paper="-"
    )
    reflection_gone: float = number(
        1.6,
        1.0 + TINY,
        1e6,
        "from the threshold to this multiple of it, a match's weight falls to nothing",
        paper="-",
    )
    reflection_limit: float = number(
        1.5, TINY, 1e3, "larger differences in log depth count as this one", paper="-"
    )
    reflection_sure: float = number(
        0.3, 0, 1, "confidence above which a match counts in the spread", paper="-"
    )


@dataclass(frozen=True)
class CorrectionConfig(Checked):
    """The edge-aware fit of a metric map to what is known, in the loop and on the result."""

    correct: bool = flag(
        True,
        "in `corrections` of the steps the decoded map is fitted to its matches and points and the change "
        'is encoded, before the updates; with `gradient="denoised"` only (after SteeredMarigold, Gregorek '
        "and Nalpantidis 2024)",
    )
    corrections: int = integer(
        2,
        1,
        10_000,
        "the most steps (or rounds of a prior with fewer steps) that are corrected: the last, and the others "
        "spread over the second half of the schedule, or over more of it if they do not fit there; a step "
        "with neither correction nor updates is left to the prior, and is not decoded",
        paper="-",
    )
    correction_scale: float = number(
        1.0,
        0.05,
        1,
        "side of the grid that corrections in the loop are solved on, as a share of that of the losses; "
        "the result is refined at full resolution in any case",
        paper="-",
    )
    refine: bool = flag(True, "the result is fitted to its matches and points once more, at full resolution")
    match_noise: float = number(
        0.02,
        TINY,
        1e3,
        "relative error of a perfect match: below it one match is as good as another",
        paper="-",
    )
    correction_cauchy: float = number(
        2.5,
        TINY,
        1e6,
        "residual, in standard deviations of a match, from which it counts for less",
        paper="-",
    )
    smoothness: float = number(
        40.0,
        TINY,
        1e6,
        "weight of the correction's slope against a sure match, on a grid 512 pixels long, for a prior that "
        "is wrong by 5 %; it falls with `stiffness_power` of that error",
        paper="-",
    )
    stiffness_power: float = number(
        4.0, 0, 10, "power of the prior's error that smoothness falls with", paper="-"
    )
    loosest: float = number(0.03, TINY, 1e6, "and never below this, however wrong the prior is", paper="-")
    stiffest: float = number(100.0, TINY, 1e6, "or above this", paper="-")
    inertia: float = number(
        0.015,
        TINY,
        1e6,
        "weight of the correction itself, for a prior that is wrong by 5 %: what is far from every match "
        "keeps its depth; it falls with the fourth power of that error",
        paper="-",
    )
    least_inertia: float = number(5e-4, TINY, 1e6, "and is never below this,", paper="-")
    most_inertia: float = number(0.03, TINY, 1e6, "or above this", paper="-")
    broad_smoothness: float = number(
        50.0,
        TINY,
        1e6,
        "smoothness of the first pass of a fit, if the prior's own is not above it: it corrects whole "
        "regions, with the pixels far from every match",
        paper="-",
    )
    broad_inertia: float = number(1e-4, TINY, 1e6, "least inertia of that pass", paper="-")
    passes: int = integer(
        3, 1, 100, "passes of a fit, in even ratios from `broad_smoothness` to the prior's own", paper="-"
    )
    outlier_width: float = number(
        3.0,
        TINY,
        1e6,
        "a match that differs from a wide region's by more than this many standard deviations, of its noise "
        "and of the prior's error, counts for less",
        paper="-",
    )
    stiff_smoothness: float = number(
        400.0,
        TINY,
        1e6,
        "smoothness of the fit that measures the prior and finds outliers among a region's matches",
        paper="-",
    )
    stiff_inertia: float = number(
        1.3e-3, TINY, 1e6, "inertia of that fit, as a share of this smoothness", paper="-"
    )
    block: float = number(
        0.08,
        TINY,
        1,
        "side of the blocks of matches left out to measure the prior, in image sides",
        paper="-",
    )
    least_error: float = number(
        0.01, TINY, 1, "least error that is assumed of a prior, in log depth", paper="-"
    )
    most_error: float = number(0.5, TINY, 10, "and the largest", paper="-")
    image_edge: float = number(
        0.1,
        TINY,
        1e6,
        "step in brightness across which a correction does not spread, on a grid 512 pixels long",
        paper="-",
    )
    depth_edge: float = number(0.1, TINY, 1e6, "the same in log depth", paper="-")
    edge_reach: float = number(
        0.006,
        TINY,
        1,
        "matches this close to a depth edge of the map have less weight; a share of the longer side",
        paper="-",
    )
    edge_step: float = number(
        0.3, TINY, 1e6, "step in log depth beside which that weight is halved", paper="-"
    )
    edge_error: float = number(
        0.11,
        TINY,
        10,
        "error of the prior above which that step grows, with its third power: such a prior does not know "
        "where edges are",
        paper="-",
    )
    least_link: float = number(1e-3, 0, 1, "share of the smoothness that remains across any edge", paper="-")
    reweightings: int = integer(3, 1, 1000, "robustly reweighted solves", paper="-")
    solver_steps: int = integer(
        12, 1, 100_000, "conjugate-gradient steps of each solve, on every level of its pyramid", paper="-"
    )


@dataclass(frozen=True)
class UpdatesConfig(Checked):
    """The gradient updates of latent, scale and shift (Algorithm 1)."""

    rule: str = key_of(
        "adam",
        "RULES",
        "how a gradient moves the latent: `plain`; `adam`; `norm` scales it to a share of the predicted "
        "noise; `adam-norm` scales it to the noise's norm before an Adam with the usual decays (Marigold-DC)",
    )
    affine_rule: str = key_of("adam", "RULES", "the same for scale and shift")
    step_latents: float | None = number(
        None, 0, 1e6, "step size of `rule`", unset="0.03 after a correction, else 0.1"
    )
    step_affine: float = number(0.01, 0, 1e6, "step size of `affine_rule` on raw s_hat, t_hat")
    inner_steps: int | None = integer(
        None,
        0,
        10_000,
        "updates in each denoising step that makes any; with 0 only the search and the correction remain",
        unset="0 after a correction, else 40",
    )
    updates_from: float | None = number(
        None,
        0,
        1,
        "steps that end by this fraction of the schedule make no updates: they leave the estimate to the "
        "matches, and later steps refine it by the photographs",
        unset="0.75 of `stop` after a correction, else 0",
    )
    optimize_latents: bool = flag(True, "`False` is Table 4's ablation: scale and shift only (S5.3)")
    start: float = number(0.0, 0, 1, "fraction of the schedule before which nothing is updated")
    stop: float = number(1.0, 0, 1, "fraction after which nothing is updated")
    step_from: str = choice(
        "given",
        ("given", "updated"),
        'with `gradient="full"`: add the update after the scheduler\'s step (Algorithm 1), or let the step '
        "start from the updated z_t (Marigold-DC)",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number(self.start, "start", 0.0, self.stop)
