"""The default preset without matches: the paper's evidence with our updates.

Data flow: ``StereoSample`` -> pipeline guided by the photometric error alone -> metres.
Paper: Eq. 14 (eq:geo-loss) as the only evidence.
"""

from __future__ import annotations

from typing import Any

from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["PHOTOMETRIC_ONLY"]


def _preset(right: Any, K: Any, E: Any) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, weights=DEFAULT.weights | {"matches": 0.0})


PHOTOMETRIC_ONLY = guided_method(
    "photometric-only", "photometric", "the default preset without matches", _preset
)
