"""Algorithm 1 of the paper as printed.

Data flow: ``StereoSample`` -> pipeline guided with the paper's numbers -> metres.
Paper: Algorithm 1, S5.1, S7.3.
"""

from __future__ import annotations

from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["PAPER"]

PAPER = guided_method(
    "paper", "paper", "the prior guided with the paper's own numbers", GeometryGuidance.paper
)
