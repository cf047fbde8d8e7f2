"""The stages of the configuration that find metres: sweep, matches of it, search in it, fit to points.

Data flow: named values -> a stage, checked.
Paper: S7.3 has a search and a range, no numbers of it; a leaf that the paper has no place for says so.
"""

from __future__ import annotations

from dataclasses import dataclass

from geodiff_plugin.guidance.fields import TINY, Checked, choice, integer, number, pair

__all__ = ["FitConfig", "MatchingConfig", "SearchConfig", "SweepConfig"]


@dataclass(frozen=True)
class SweepConfig(Checked):
    """The plane sweep that search and matches are based on."""

    planes: int = integer(160, 24, 4096, "the most planes", paper="-")
    plane_step_px: float = number(
        0.75, TINY, 1e6, "how far the median pixel moves from one plane to the next, px", paper="-"
    )
    sweep_side: int = integer(828, 32, 1 << 16, "bound of the longer side of the sweep's grid, px", paper="-")
    sweep_pixels: int = integer(
        210_000,
        1024,
        1 << 32,
        "bound of the number of its pixels: 828 x 250 for KITTI, 530 x 397 for 4:3",
        paper="-",
    )
    pilot_pixels: int = integer(
        20_000,
        1024,
        1 << 32,
        "the same for the coarse sweep that comes first and finds how near the planes must reach",
        paper="-",
    )
    pilot_planes: int = integer(160, 24, 4096, "the most planes of the coarse sweep", paper="-")
    pilot_step_px: float = number(
        1.0, TINY, 1e6, "how far the median pixel moves from one of them to the next, px", paper="-"
    )
    pilot_shift: float = number(
        0.4, TINY, 1, "shift of the nearest depth that the coarse sweep looks at, in image widths", paper="-"
    )
    pilot_sure: float = number(
        0.8, 0, 1, "confidence above which a match of the coarse sweep is sure", paper="-"
    )
    pilot_quantile: float = number(
        0.995,
        0,
        1,
        "quantile of the inverse depths of its sure matches that counts as the nearest",
        paper="-",
    )
    pilot_least_sure: float = number(
        0.03,
        0,
        1,
        "share of its pixels that must be sure; else the planes reach as near as it looked",
        paper="-",
    )
    headroom: float = number(
        1.25, TINY, 1e3, "the planes reach this factor nearer than the nearest of its matches", paper="-"
    )
    least_shift: float = number(
        0.03, 0, 1, "the planes reach at least to the depth of this shift, in image widths", paper="-"
    )


@dataclass(frozen=True)
class MatchingConfig(Checked):
    """The matches of the sweep: aggregation of its costs, and the check of one view by the other."""

    step_penalty: float = number(
        0.15,
        0,
        7.5,
        "cost of a step of one plane between neighbouring pixels, in units of the largest matching cost",
        paper="-",
    )
    jump_penalty: float = number(
        1.2, 0, 15, "the same for any larger step where the image is flat", paper="-"
    )
    jump_contrast: float = number(
        0.1, TINY, 1e6, "difference in brightness that halves the cost of such a step", paper="-"
    )
    agreement_planes: float = number(
        1.5, 0, 1e6, "planes by which the matches of the two views may differ", paper="-"
    )
    contrast_reach: int = integer(
        15,
        0,
        1000,
        "half the window over which a match's plane must be better than the mean plane, px; without this, "
        "aggregation would carry matches across blank walls without limit",
        paper="-",
    )
    least_contrast: float = number(
        0.03, TINY, 1, "and by how much, as a share of the largest cost, for full confidence", paper="-"
    )


@dataclass(frozen=True)
class SearchConfig(Checked):
    """The search for the metres of a relative map (S7.3)."""

    search: str = choice(
        "volume",
        ("volume", "one-number", "points-range"),
        "joint (near, far) in a plane-sweep volume, then the basin that sure matches prefer (a robust fit "
        "to the points where there is no right view); the argmin over g_s (S7.3); or the nearest and the "
        "farthest point (Marigold-DC)",
    )
    positive: str = choice(
        "softplus",
        ("softplus", "square"),
        "how raw scale and shift become positive (Eq. 13); `square` also clips the relative map to [0, 1] "
        "(Marigold-DC, Eq. 2)",
    )
    g_s_range: tuple[float, float] = pair(
        (1.0, 80.0), "candidates of the one-number search", unit="m", paper='{} (a "predefined range")'
    )
    g_s_candidates: int = integer(
        80, 2, 100_000, "how many of them; the paper's figures step through 1..80", paper="{} (not given)"
    )
    cost_clamp: float = number(
        0.35,
        TINY,
        1,
        "cost beyond which a pixel is an outlier: occluded, mirrored, mistaken by the prior",
        paper="-",
    )
    search_samples: int = integer(6000, 16, 1 << 32, "pixels that the search looks at", paper="-")
    coarse_samples: int = integer(
        1500, 16, 1 << 32, "of these, those that tell basins apart in the coarse grid", paper="-"
    )
    coarse_grid: int = integer(48, 3, 1000, "values of near, and of far, in the coarse grid", paper="-")
    fine_grid: int = integer(13, 3, 1000, "the same in each of the two finer grids", paper="-")
    keep_margin: float = number(
        2e-3,
        0,
        1,
        "a current state this close to the best cost stays: a new one restarts the updates of scale and "
        "shift",
        paper="-",
    )
    min_in_view_rectified: float = number(
        0.6, 0, 1, "least share of the pixels that must stay in view of a rectified pair", paper="-"
    )
    min_in_view_posed: float = number(0.25, 0, 1, "the same for any other pose", paper="-")


@dataclass(frozen=True)
class FitConfig(Checked):
    """The fit of a relative map's metres to matches and known points."""

    basin_candidates: int = integer(
        48, 3, 1000, "values of near, and of far, that are tried against sure matches or points", paper="-"
    )
    basin_reach: float = number(
        4.0, 1, 1e3, "how far beyond the points' own range they reach, as a factor", paper="-"
    )
    basin_samples: int = integer(1500, 16, 1 << 32, "points that tell basins apart", paper="-")
    basin_cauchy: float = number(
        32.0,
        TINY,
        1e6,
        "width of their Cauchy cost in units of the points, about a prior's own error",
        paper="-",
    )
    basin_keep: float = number(
        1.05, 1, 1e3, "a current state within this factor of the best cost stays", paper="-"
    )
    sure_confidence: float = number(0.5, 0, 1, "confidence above which a match is sure", paper="-")
    min_sure: int = integer(50, 1, 1 << 32, "sure matches that make a basin or a quantile", paper="-")
    fit_iterations: int = integer(12, 0, 1000, "reweighted Gauss-Newton steps on near and far", paper="-")
    fit_samples: int = integer(20_000, 16, 1 << 32, "matches that the fit looks at", paper="-")
    fit_noise: float = number(
        0.5, 0, 1e3, "standard deviation of a match of confidence .96 in the fit, planes", paper="-"
    )
    fit_floor: float = number(
        4e-3,
        TINY,
        1,
        "least standard deviation of a match in the fit, in log depth, for what a map leaves over",
        paper="-",
    )
    fit_cauchy: float = number(
        2.0,
        TINY,
        1e6,
        "width of the fit's Cauchy weight, in standard deviations of a match and of what the map leaves over",
        paper="-",
    )
    fit_near_reach: float = number(1.4, 0, 10, "how far near may move, as a log factor", paper="-")
    fit_far_reach: float = number(0.7, 0, 10, "how far far may move, as a log factor", paper="-")
