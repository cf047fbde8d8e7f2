"""One plain call, its scale and shift fitted to the matches, one edge-aware fit: no guided denoising step.

Data flow: ``StereoSample`` -> plain call -> robust affine fit -> ``refine_depth`` -> metres.
Paper: none; what the loop of guided steps has to beat.
"""

from __future__ import annotations

from geodiff_plugin.config import PRIOR_FIT
from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["PRIOR_FIT_METHOD"]


def _fitted(right: object, K: object, E: object, **leaves: object) -> GeometryGuidance:
    return GeometryGuidance(right, K, E, config=PRIOR_FIT, **leaves)


PRIOR_FIT_METHOD = guided_method(
    "prior-fit", "prior fit", "a plain call, fitted to the matches and refined once: no guided step", _fitted
)
