"""Metric depth from a diffusion prior and a second view (GeoDiff, arXiv 2510.18291), as a diffusers plugin.

Reading order, which is the path of one image: ``types``, ``geometry``, ``guidance.config``, ``matching``,
``scale``, ``algorithm``, ``guidance``, ``priors``, ``runtime``.

>>> pipe = load_bundled_prior()
>>> enable_geometry_guidance(pipe)
>>> out = pipe(left, guidance=GeometryGuidance(right, K, E))
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"

#: Public name -> module, imported on first use so that ``import geodiff_plugin`` stays quick.
_MODULE_OF = {
    "GeometryGuidance": "geodiff_plugin.guidance.guidance",
    "GuidanceConfig": "geodiff_plugin.guidance.config",
    "GuidedMarigoldDepthPipeline": "geodiff_plugin.runtime.pipeline",
    "InputError": "geodiff_plugin._checks",
    "MetricDepthOutput": "geodiff_plugin.types",
    "PRIORS": "geodiff_plugin.priors",
    "Rig": "geodiff_plugin.types",
    "disable_geometry_guidance": "geodiff_plugin.runtime.pipeline",
    "enable_geometry_guidance": "geodiff_plugin.runtime.pipeline",
    "guide_both_views": "geodiff_plugin.runtime.both_views",
    "load_bundled_prior": "geodiff_plugin.bundled",
    "load_prior": "geodiff_plugin.priors",
    "read_calibration": "geodiff_plugin.formats",
    "render_pair": "geodiff_plugin.synthetic",
}

__all__ = sorted(_MODULE_OF)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(_MODULE_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
