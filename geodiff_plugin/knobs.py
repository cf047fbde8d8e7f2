"""What the hyperparameters of ``GeometryGuidance`` may be, and what those left open become.

Hop: keywords as given -> the same, checked and complete.
Paper: S5.1 and Algorithm 1 name some; docs/knobs.md says which, and how flat each one's optimum is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from geodiff_plugin._checks import bad_type, bad_value, check_choice, check_number, check_range
from geodiff_plugin.metric import POSITIVE
from geodiff_plugin.terms import TERMS
from geodiff_plugin.terms.points import POINTS_LOSSES
from geodiff_plugin.updates import RULES

__all__ = ["CHECKS", "DEFAULT_WEIGHTS", "check_knobs", "knobs_from_text"]

#: Weights of the default preset.
DEFAULT_WEIGHTS = {"photometric": 1.0, "matches": 1.0, "points": 1.0, "prior_pull": 0.01, "anchor": 1.0}

Check = Callable[[Any, str], Any]


def _number(low: float, high: float, integer: bool = False) -> Check:
    return lambda value, name: check_number(value, name, low, high, integer=integer)


def _choice(choices: Collection[str]) -> Check:
    return lambda value, name: check_choice(value, name, choices)  # a table may grow until then


def _flag(value: Any, name: str) -> bool:
    return bool(value)


def _weights(value: Mapping[str, float], name: str) -> dict[str, float]:
    if not isinstance(value, Mapping):
        bad_type(name, "a dict of numbers by term", value)
    for term, weight in value.items():
        check_choice(term, f"a key of {name}", TERMS)
        check_number(weight, f"{name}[{term!r}]", 0.0, float("inf"))
    return dict(value)


CHECKS: dict[str, Check] = {
    "gradient": _choice(("denoised", "full")),
    "rule": _choice(RULES),
    "affine_rule": _choice(RULES),
    "step_latents": _number(0.0, 1e6),
    "step_affine": _number(0.0, 1e6),
    "inner_steps": _number(0, 10_000, integer=True),
    "updates_from": _number(0.0, 1.0),
    "min_steps": _number(1, 1000, integer=True),
    "optimize_latents": _flag,
    "start": _number(0.0, 1.0),
    "stop": _number(0.0, 1.0),
    "weights": _weights,
    "eta": _number(0.0, 1.0),
    "pyramid_levels": _number(1, 10, integer=True),
    "exposure": _flag,
    "z_test": _flag,
    "min_visible": _number(0.0, 1.0),
    "pull_to": _choice(("start", "zero")),
    "search": _choice(("volume", "one-number", "points-range")),
    "g_s_range": check_range,
    "depth_range": check_range,
    "gate": _number(1.0, 1e6),
    "loss_resolution": _number(32, 1 << 16, integer=True),
    "correct": _flag,
    "doubt": _flag,
    "refine": _flag,
    "respace": _flag,
    "points_loss": _choice(POINTS_LOSSES),
    "positive": _choice(POSITIVE),
    "step_from": _choice(("given", "updated")),
}
"""What turns a value into a checked one, by knob; each is a keyword of ``GeometryGuidance``."""


def check_knobs(given: Mapping[str, Any], points_given: bool) -> dict[str, Any]:
    """Every knob with a value that it may have.

    Args:
        given: a value for every key of ``CHECKS``; ``None`` for ``weights``, ``inner_steps``,
            ``updates_from`` and ``step_latents`` asks for the default, which depends on the others.
        points_given: whether known points come with the guidance.

    Returns:
        The same keys, none left open.

    Raises:
        TypeError, ValueError: a value of the wrong type or out of range, naming the knob.
    """
    knobs = dict(given)
    if knobs["weights"] is None:
        knobs["weights"] = DEFAULT_WEIGHTS
    weights = CHECKS["weights"](knobs["weights"], "weights")
    # What matches and points can be encoded into is near already; else the gradient has the whole way.
    known = weights.get("matches") or (weights.get("points") and points_given)
    near = knobs["correct"] and known and knobs["optimize_latents"] and knobs["gradient"] == "denoised"
    late = 0.75 * CHECKS["stop"](knobs["stop"], "stop")
    settled = (5, late, 0.03) if near else (40, 0.0, 0.1)
    for name, value in zip(("inner_steps", "updates_from", "step_latents"), settled, strict=True):
        if knobs[name] is None:
            knobs[name] = value
    checked = {name: check(knobs[name], name) for name, check in CHECKS.items()}
    check_number(checked["start"], "start", 0.0, checked["stop"])
    return checked


def knobs_from_text(entries: Iterable[str], weights: Mapping[str, float], name: str) -> dict[str, Any]:
    """Keywords of a guidance as they are written on a command line.

    Args:
        entries: ``KNOB=VALUE`` each; ``weights.TERM=VALUE`` changes one weight.
        weights: those of the preset that they change.
        name: the option, for messages.

    Returns:
        Keywords; a value is JSON, or text where it is none. It is checked when the guidance is made.

    Raises:
        ValueError: another form, or a knob that does not exist.
    """
    known, knobs = [knob for knob in CHECKS if knob != "weights"], {}
    for entry in entries:
        knob, equals, written = entry.partition("=")
        of, _, term = knob.partition(".")
        if not equals or (knob not in known and not (of == "weights" and term in TERMS)):
            cure = f"Knobs: {', '.join(known)}, and weights.TERM with {', '.join(TERMS)}."
            bad_value(name, "KNOB=VALUE with a knob of GeometryGuidance", repr(entry), cure)
        try:
            value = json.loads(written)
        except ValueError:
            value = written
        if term:
            knobs["weights"] = knobs.get("weights", dict(weights)) | {term: value}
        else:
            knobs[knob] = value
    return knobs
