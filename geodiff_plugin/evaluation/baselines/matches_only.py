"""The default preset without the photometric error: matches between the views are the only evidence.

Data flow: ``StereoSample`` -> pipeline guided by matches alone -> metres.
Paper: none.
"""

from __future__ import annotations

from typing import Any

from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["MATCHES_ONLY"]


def _preset(right: Any, K: Any, E: Any) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, weights=DEFAULT.weights | {"photometric": 0.0})


MATCHES_ONLY = guided_method(
    "matches-only", "matches", "the default preset without the photometric error", _preset
)
