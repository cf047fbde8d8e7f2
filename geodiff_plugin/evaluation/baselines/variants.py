"""A preset with some of its knobs set otherwise, as a method: ``guided:gradient=full``.

Hop: ``preset:knob=value+knob=value`` -> ``Method``.
Paper: S5.3, S7.3, S9 (ablations).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

from geodiff_plugin import point_scale, refinement, scale_search
from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines._guidance import guided_configuration, guided_method
from geodiff_plugin.evaluation.baselines.base import Method, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.guidance import GeometryGuidance
from geodiff_plugin.knobs import DEFAULT_WEIGHTS, knobs_from_text
from geodiff_plugin.matching import contradiction
from geodiff_plugin.presets import PAPER_WEIGHTS

__all__ = ["default_variant", "number_of", "paper_variant"]

CONSTANTS = {
    module.__name__.rpartition(".")[2]: module
    for module in (contradiction, point_scale, refinement, scale_search)
}
"""Modules whose constants an ablation may change for its own calls: numbers that are no knobs."""

_WEIGHT = "weights."


def _constant(name: str) -> tuple[Any, str] | None:
    """Module and attribute of a constant ``module.NAME``; ``None`` for any other name."""
    module, _, constant = name.partition(".")
    there = constant.isupper() and hasattr(CONSTANTS.get(module), constant)
    return (CONSTANTS[module], constant) if there else None


def number_of(name: str) -> float:
    """A number of the default preset: a knob, ``weights.TERM``, or a constant ``module.NAME``."""
    constant = _constant(name)
    if constant is not None:
        return getattr(*constant)
    if name.startswith(_WEIGHT):
        return DEFAULT_WEIGHTS[name.removeprefix(_WEIGHT)]
    return guided_configuration(GeometryGuidance, Settings())["guidance"][name]


@contextmanager
def _constants(changed: Mapping[str, float]) -> Iterator[None]:
    """Module constants set otherwise, and back afterwards."""
    before = {name: number_of(name) for name in changed}
    try:
        for name, value in changed.items():
            setattr(*_constant(name), value)
        yield
    finally:
        for name, value in before.items():
            setattr(*_constant(name), value)


def _changes(text: str, weights: dict[str, float]) -> tuple[dict[str, Any], dict[str, float]]:
    """Keywords of a guidance, and constants."""
    parts = text.split("+")
    for name in (part.partition("=")[0] for part in parts):
        if "." in name and not name.startswith(_WEIGHT) and not _constant(name):
            bad_value("methods", "a constant module.NAME", repr(name), f"Modules: {', '.join(CONSTANTS)}.")
    ours = [part for part in parts if _constant(part.partition("=")[0])]
    constants = {}
    for part in ours:
        name, _, written = part.partition("=")
        try:
            constants[name] = float(written)
        except ValueError:
            bad_value(f"methods: {name}", "a number", repr(written))
    knobs = knobs_from_text([part for part in parts if part not in ours], weights, "methods")
    return knobs, constants


def _variant(
    base: str, title: str, preset: Callable[..., GeometryGuidance], weights: dict[str, float], text: str
) -> Method:
    changes, constants = _changes(text, weights)

    def changed(right: Any, K: Any, E: Any) -> GeometryGuidance:
        return preset(right, K, E, **changes)

    method = guided_method(
        f"{base}:{text}", f"{title}, {text.replace('+', ', ')}", f"{title} with {text}", changed
    )
    if not constants:
        return method

    def run(sample: StereoSample, settings: Settings, priors: PriorCache) -> Prediction:
        with _constants(constants):
            return method.run(sample, settings, priors)

    return replace(method, run=run)


def default_variant(text: str) -> Method:
    """The default preset with some knobs changed.

    Args:
        text: ``knob=value``, several joined by ``+``; ``weights.matches=0`` changes one weight,
            ``refinement.CAUCHY=4`` a constant of a module.

    Raises:
        ValueError: another form, or an unknown knob; values are checked when the guidance is made.
    """
    return _variant("guided", "guided", GeometryGuidance, DEFAULT_WEIGHTS, text)


def paper_variant(text: str) -> Method:
    """Algorithm 1 as printed with some knobs changed; argument and errors as ``default_variant``."""
    return _variant("paper", "paper", GeometryGuidance.paper, PAPER_WEIGHTS, text)
