"""Presets: the default, two published methods, and variants without the loop or without gradients.

Data flow: ``GuidanceConfig()`` -> the same with some leaves set otherwise.
Paper: Algorithm 1, S5.1, S7.3, S9; Marigold-DC (Viola et al. 2024, "Marigold-DC: zero-shot monocular depth
completion with guided diffusion") and its published code.
"""

from __future__ import annotations

from geodiff_plugin.guidance.config import GuidanceConfig

__all__ = ["DEFAULT", "MARIGOLD_DC", "PAPER", "PRESETS", "PRIOR_FIT", "SEARCH_ONLY"]

DEFAULT = GuidanceConfig()

#: What the paper leaves open is settled in docs/reference/paper-map.md.
PAPER = DEFAULT.changed(
    gradient="full",
    rule="plain",
    affine_rule="plain",
    step_latents=1e-2,
    step_affine=1e-2,
    inner_steps=1,
    min_steps=10,
    weights={"photometric": 1.0, "prior_pull": 0.01},
    eta=0.85,
    pyramid_levels=1,
    exposure=False,
    z_test=False,
    min_visible=0.0,
    pull_to="zero",
    search="one-number",
    loss_resolution=768,
    pose="given",
    clean_photographs=False,
    correct=False,
    reject_reflections=False,
    refine=False,
)

SEARCH_ONLY = DEFAULT.changed(inner_steps=0, weights={"photometric": 1.0}, correct=False, refine=False)

#: A plain call that is fitted to the matches and refined once: the default without its loop.
PRIOR_FIT = DEFAULT.changed(inner_steps=0, correct=False)

#: The published code's numbers; its loss is taken at the image's own resolution, hence no bound on it.
MARIGOLD_DC = DEFAULT.changed(
    gradient="full",
    rule="adam-norm",
    affine_rule="adam-norm",
    step_latents=0.05,
    step_affine=0.005,
    inner_steps=1,
    min_steps=50,
    weights={"points": 1.0},
    points_loss="l1l2",
    positive="square",
    search="points-range",
    step_from="updated",
    loss_resolution=1 << 16,
    correct=False,
    refine=False,
)

#: All presets by name; ``geodiff depth --preset`` takes the first two.
PRESETS = {
    "default": DEFAULT,
    "paper": PAPER,
    "marigold-dc": MARIGOLD_DC,
    "search-only": SEARCH_ONLY,
    "prior-fit": PRIOR_FIT,
}
