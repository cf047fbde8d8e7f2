"""Hyperparameters that reproduce published methods, and the ablation without gradients.

Hop: preset -> keywords of ``GeometryGuidance``.
Paper: Algorithm 1, S5.1, S7.3, S9; Marigold-DC (Viola et al. 2024, "Marigold-DC: zero-shot monocular depth
completion with guided diffusion") and its published code.
"""

from __future__ import annotations

from typing import Any

__all__ = ["MARIGOLD_DC", "PAPER", "PAPER_WEIGHTS", "SEARCH_ONLY"]

PAPER_WEIGHTS = {"photometric": 1.0, "prior_pull": 0.01}

#: What the paper leaves open is settled in docs/paper-map.md.
PAPER: dict[str, Any] = {
    "gradient": "full",
    "rule": "plain",
    "affine_rule": "plain",
    "step_latents": 1e-2,
    "step_affine": 1e-2,
    "inner_steps": 1,
    "min_steps": 10,
    "weights": PAPER_WEIGHTS,
    "eta": 0.85,
    "pyramid_levels": 1,
    "exposure": False,
    "z_test": False,
    "min_visible": 0.0,
    "pull_to": "zero",
    "search": "one-number",
    "correct": False,
    "doubt": False,
    "refine": False,
}

SEARCH_ONLY: dict[str, Any] = {
    "inner_steps": 0,
    "weights": {"photometric": 1.0},
    "correct": False,
    "refine": False,
}

#: The published code's numbers; its loss is taken at the image's own resolution, hence no bound on it.
MARIGOLD_DC: dict[str, Any] = {
    "gradient": "full",
    "rule": "adam-norm",
    "affine_rule": "adam-norm",
    "step_latents": 0.05,
    "step_affine": 0.005,
    "inner_steps": 1,
    "min_steps": 50,
    "weights": {"points": 1.0},
    "points_loss": "l1l2",
    "positive": "square",
    "search": "points-range",
    "step_from": "updated",
    "loss_resolution": 1 << 16,
    "correct": False,
    "refine": False,
}
