"""The stages of the configuration of the correction: which matches it leaves out, how it follows the rest.

Data flow: named values -> a stage, checked.
Paper: S5.2 names reflections as a limit; it has no correction.
"""

from __future__ import annotations

from dataclasses import dataclass

from geodiff_plugin.guidance.fields import TINY, Checked, flag, integer, number

__all__ = ["CorrectionConfig", "ReflectionsConfig"]


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
    reflection_floor: float = number(
        0.2, TINY, 1e3, "least distance behind the prior that counts as a reflection, in log depth", paper="-"
    )
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
    sharpen: bool = flag(
        True,
        "before the result is refined, pixels that hang in the air between a near and a far surface get the "
        "depth of one of them, the weighted median of their neighbours (after Ma et al. 2013)",
        paper="-",
    )
    ramp_step: float = number(
        0.02,
        TINY,
        1e3,
        "least relative step in inverse depth from a pixel that hangs in the air to each of two opposite "
        "neighbours",
        paper="-",
    )
    ramp_contrast: float = number(
        2.0,
        0,
        1e6,
        "how many times steeper than the surfaces on both sides the slope must be at a pixel that hangs in "
        "the air",
        paper="-",
    )
    ramp_slope: float = number(
        0.04,
        TINY,
        1e3,
        "slope in log depth, for each pixel of the prior's grid, at which a neighbour counts half in the "
        "median of `sharpen`",
        paper="-",
    )
    sharpen_colour: float = number(
        0.12,
        TINY,
        1e6,
        "difference in brightness at which a neighbour's weight in the median of `sharpen` falls to a third",
        paper="-",
    )
    sharpen_reach: float = number(
        1.5,
        TINY,
        1e3,
        "distance, in pixels of the prior's grid, over which a neighbour's weight in the median of `sharpen` "
        "falls: the standard deviation of a Gaussian, in a window of five by five",
        paper="-",
    )
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
    loosest: float = number(0.03, TINY, 1e6, "smallest smoothness, however wrong the prior is", paper="-")
    stiffest: float = number(100.0, TINY, 1e6, "largest smoothness", paper="-")
    inertia: float = number(
        0.015,
        TINY,
        1e6,
        "weight of the correction itself, for a prior that is wrong by 5 %: what is far from every match "
        "keeps its depth; it falls with the fourth power of that error",
        paper="-",
    )
    least_inertia: float = number(5e-4, TINY, 1e6, "smallest inertia", paper="-")
    most_inertia: float = number(0.03, TINY, 1e6, "largest inertia", paper="-")
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
    most_error: float = number(
        0.5, TINY, 10, "largest error that is assumed of a prior, in log depth", paper="-"
    )
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
