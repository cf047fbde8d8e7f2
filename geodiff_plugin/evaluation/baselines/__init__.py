"""Methods side by side, one file each, one table.

Hop: ``StereoSample`` -> every method's ``Prediction``.
Paper: S5.1 (compared methods), S5.3 (ablation).
"""

from __future__ import annotations

from collections.abc import Callable

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines.base import (
    Method,
    NotApplicable,
    Prediction,
    PriorCache,
    Settings,
)
from geodiff_plugin.evaluation.baselines.guided import GUIDED
from geodiff_plugin.evaluation.baselines.paper import PAPER
from geodiff_plugin.evaluation.baselines.plane_sweep import PLANE_SWEEP
from geodiff_plugin.evaluation.baselines.prior_aligned import PRIOR_ALIGNED
from geodiff_plugin.evaluation.baselines.scale_shift_only import SCALE_SHIFT_ONLY
from geodiff_plugin.evaluation.baselines.search_only import SEARCH_ONLY
from geodiff_plugin.evaluation.baselines.sgbm import SGBM
from geodiff_plugin.evaluation.baselines.sweep_sgm import SWEEP_SGM
from geodiff_plugin.evaluation.baselines.variants import default_variant, paper_variant

__all__ = [
    "FAMILIES",
    "METHODS",
    "Method",
    "NotApplicable",
    "Prediction",
    "PriorCache",
    "Settings",
    "find_method",
]

METHODS: dict[str, Method] = {
    method.name: method
    for method in (
        PRIOR_ALIGNED,
        SEARCH_ONLY,
        SCALE_SHIFT_ONLY,
        PAPER,
        GUIDED,
        SGBM,
        PLANE_SWEEP,
        SWEEP_SGM,
    )
}
"""Every method by name, in the order of the tables' columns."""

FAMILIES: dict[str, Callable[[str], Method]] = {
    "guided": default_variant,
    "paper": paper_variant,
}
"""Methods with a parameter: ``name:parameter`` is what the function of ``name`` makes of the parameter."""


def find_method(name: str) -> Method:
    """The method of a name.

    Args:
        name: a key of ``METHODS``, or ``family:parameter`` with a key of ``FAMILIES``.

    Raises:
        ValueError: neither; or the family's own error about its parameter.
    """
    if name in METHODS:
        return METHODS[name]
    family, colon, parameter = name.partition(":")
    if colon and family in FAMILIES:
        return FAMILIES[family](parameter)
    known = [*METHODS, *(f"{key}:..." for key in FAMILIES)]
    bad_value("methods", f"one of {', '.join(known)}", repr(name))
