"""The search for the scale alone: no correction, no gradient updates, no refinement.

Data flow: ``StereoSample`` -> pipeline, scale and shift from the search -> metres.
Paper: S7.3 (the pre-selected g_s), extended to near and far.
"""

from __future__ import annotations

from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["SEARCH_ONLY"]

SEARCH_ONLY = guided_method(
    "search-only",
    "search only",
    "the search for the scale alone: no correction, no gradient updates, no refinement",
    GeometryGuidance.search_only,
)
