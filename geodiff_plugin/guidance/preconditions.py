"""Checks of a configuration before it is used: names exist, and active terms have input.

Data flow: ``GuidanceConfig``, what is given -> nothing, or an ``InputError``.
Paper: none.
"""

from __future__ import annotations

from geodiff_plugin._checks import bad_value, check_choice, refuse
from geodiff_plugin.algorithm.gradients import RULES
from geodiff_plugin.algorithm.terms import TERMS
from geodiff_plugin.config import GuidanceConfig, UpdatePlan

__all__ = ["check_fed", "check_names"]


def check_names(config: GuidanceConfig) -> None:
    """Refuse names of rules and terms that do not exist.

    Raises:
        InputError: naming what does.
    """
    check_choice(config.rule, "rule", RULES)
    for name in config.weights:
        check_choice(name, "a key of weights", TERMS)


def check_fed(config: GuidanceConfig, updates: UpdatePlan, *, views: bool, points: bool) -> None:
    """Refuse a configuration that asks for what was not given.

    Args:
        config: what is asked for.
        updates: how many updates there are.
        views: whether there is a further view.
        points: whether there are known points.

    Raises:
        InputError: the search, or every weighted term, lacks what it works on.
    """
    search = config.search
    if search == "one-number" and not (views and config.weights.get("photometric")):
        refuse("search='one-number' needs a right view and a photometric weight; search='volume' does not.")
    if search == "points-range" and not points:
        refuse("search='points-range' needs points. search='volume' works without them.")
    lacking = {"needs_warp": not views, "needs_matches": not views, "needs_points": not points}
    weighted = [name for name, weight in config.weights.items() if weight]
    idle = [
        name
        for name in weighted
        if any(absent and getattr(TERMS[name], need) for need, absent in lacking.items())
    ]
    makes_updates = updates.inner_steps or config.inner_steps is None
    if makes_updates and len(idle) == len(weighted):
        cure = "photometric and matches need a right view, points needs points; inner_steps=0 needs none."
        bad_value("weights", "above 0 for a term that can work on what is given", dict(config.weights), cure)
