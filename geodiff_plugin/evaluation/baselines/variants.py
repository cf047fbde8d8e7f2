"""A preset with some of its knobs set otherwise, as a method: ``guided:gradient=full``.

Hop: ``preset:knob=value+knob=value`` -> ``Method``.
Paper: S5.3, S7.3, S9 (ablations).
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable
from typing import Any

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines._guidance import guided_method
from geodiff_plugin.evaluation.baselines.base import Method
from geodiff_plugin.guidance import DEFAULT_WEIGHTS, GeometryGuidance
from geodiff_plugin.presets import PAPER_WEIGHTS

__all__ = ["default_variant", "paper_variant"]

_WEIGHT = "weights."
_POSITIONAL = {"self", "right", "K", "E", "points", "left_size", "weights"}
_KNOBS = tuple(
    name for name in inspect.signature(GeometryGuidance.__init__).parameters if name not in _POSITIONAL
)


def _changes(text: str, weights: dict[str, float]) -> dict[str, Any]:
    """Keywords of a guidance; values are JSON, or text where they are none."""
    changes: dict[str, Any] = {}
    for part in text.split("+"):
        knob, equals, written = part.partition("=")
        if not equals or not (knob in _KNOBS or knob.startswith(_WEIGHT)):
            bad_value(
                "methods",
                "of the form preset:knob=value+knob=value with knobs of GeometryGuidance, or weights.TERM",
                repr(text),
                f"Knobs: {', '.join(_KNOBS)}.",
            )
        try:
            value = json.loads(written)
        except ValueError:
            value = written
        if knob.startswith(_WEIGHT):
            changes["weights"] = changes.get("weights", weights) | {knob.removeprefix(_WEIGHT): value}
        else:
            changes[knob] = value
    return changes


def _variant(
    base: str, title: str, preset: Callable[..., GeometryGuidance], weights: dict[str, float], text: str
) -> Method:
    changes = _changes(text, weights)

    def changed(right: Any, K: Any, E: Any) -> GeometryGuidance:
        return preset(right, K, E, **changes)

    return guided_method(
        f"{base}:{text}", f"{title}, {text.replace('+', ', ')}", f"{title} with {text}", changed
    )


def default_variant(text: str) -> Method:
    """The default preset with some knobs changed.

    Args:
        text: ``knob=value``, several joined by ``+``; ``weights.matches=0`` changes one weight.

    Raises:
        ValueError: another form, or an unknown knob; values are checked when the guidance is made.
    """
    return _variant("guided", "guided", GeometryGuidance, DEFAULT_WEIGHTS, text)


def paper_variant(text: str) -> Method:
    """Algorithm 1 as printed with some knobs changed; argument and errors as ``default_variant``."""
    return _variant("paper", "paper", GeometryGuidance.paper, PAPER_WEIGHTS, text)
