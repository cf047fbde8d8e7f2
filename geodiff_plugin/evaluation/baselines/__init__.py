"""Registry of methods by name (paper S5.1, S5.3)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.config import DEFAULT, PAPER
from geodiff_plugin.evaluation.baselines.guided import GUIDED_METHODS, variant
from geodiff_plugin.evaluation.baselines.method import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.unguided import MAP_USES, STEREO_METHODS, files_method, hf_method

__all__ = ["FAMILIES", "METHODS", "Method", "NotApplicable", "Prediction", "PriorCache", "Settings"]
__all__ += ["find_method"]

#: All methods by name, in the order of the tables' columns.
METHODS: dict[str, Method] = {method.name: method for method in (*GUIDED_METHODS, *STEREO_METHODS)}
#: Methods with a parameter: ``name:parameter`` calls the function of ``name`` with the parameter.
FAMILIES: dict[str, Callable[[str], Method]] = {
    "guided": partial(variant, "guided", DEFAULT),
    "paper": partial(variant, "paper", PAPER),
    "hf": hf_method,
    "files": files_method,
    "prior-map": partial(files_method, use="prior-map"),
    "points-map": partial(files_method, use="points-map"),
}


def find_method(name: str) -> Method:
    """Return a method by name, such as ``guided``, ``hf:MODEL``, ``guided@org/prior#3``."""
    if name in METHODS:
        return METHODS[name]
    family, colon, parameter = name.partition(":")
    if colon and family in ("hf", *MAP_USES):  # their parameter may contain @ or #
        return FAMILIES[family](parameter)
    bare, _, seed = name.rpartition("#")
    if bare and seed.isdecimal():
        method, number = find_method(bare), int(seed)
        return _bound(method, f"#{number}", "METHOD#SEED", f"{method.title}, seed {number}", seed=number)
    bare, at, prior = name.rpartition("@")
    if at:
        method = find_method(bare)
        title = f"{method.title} ({prior.rstrip('/').rpartition('/')[2]})"
        return _bound(method, f"@{prior}", "METHOD@PRIOR", title, prior=prior)
    if colon and family in FAMILIES:
        return FAMILIES[family](parameter)
    bad_value("methods", f"one of {', '.join([*METHODS, *(f'{key}:...' for key in FAMILIES)])}", repr(name))


def _bound(method: Method, suffix: str, form: str, title: str, **to: Any) -> Method:
    if not (len(suffix) > 1 and method.uses_prior and method.seed is None):
        bad_value("methods", f"{form} with a method that uses a prior", method.name + suffix)
    return replace(method, name=method.name + suffix, title=title, **to)
