"""The default preset.

Data flow: ``StereoSample`` -> guided pipeline -> metres.
Paper: S4; where the default departs from it, docs/reference/knobs.md says why.
"""

from __future__ import annotations

from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.guidance.guidance import GeometryGuidance

__all__ = ["GUIDED"]

GUIDED = guided_method("guided", "guided", "the prior guided with the default preset", GeometryGuidance)
