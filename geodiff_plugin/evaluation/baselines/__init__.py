"""Methods side by side, by name (paper S5.1, S5.3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from geodiff_plugin._checks import bad_value
from geodiff_plugin.evaluation.baselines.base import Method, NotApplicable, Prediction, PriorCache, Settings
from geodiff_plugin.evaluation.baselines.constant import NO_DIFFUSION, REPROJECTION_ONLY
from geodiff_plugin.evaluation.baselines.guided import GUIDED_METHODS, default_variant, paper_variant
from geodiff_plugin.evaluation.baselines.outside import files_method, hf_method
from geodiff_plugin.evaluation.baselines.stereo import STEREO_METHODS

__all__ = [
    "FAMILIES",
    "METHODS",
    "Method",
    "NotApplicable",
    "Prediction",
    "PriorCache",
    "Settings",
    "find_method",
    "with_poses",
    "with_priors",
    "with_seeds",
]

METHODS: dict[str, Method] = {
    method.name: method for method in (*GUIDED_METHODS, REPROJECTION_ONLY, NO_DIFFUSION, *STEREO_METHODS)
}
"""Every method by name, in the order of the tables' columns."""

FAMILIES: dict[str, Callable[[str], Method]] = {
    "guided": default_variant,
    "paper": paper_variant,
    "hf": hf_method,
    "files": files_method,
    "prior-map": partial(files_method, guided=True),
}
"""Methods with a parameter: ``name:parameter`` is what the function of ``name`` makes of the parameter."""

PRIORLESS = ("hf", "files", "prior-map")
"""Families that use no prior, so that an @ in their parameter is part of it."""


def find_method(name: str) -> Method:
    """The method of a name.

    Args:
        name: a key of ``METHODS``, or ``family:parameter`` with a key of ``FAMILIES``; a method that uses a
            prior may be bound to one other than the settings', to another seed, or to both, the seed last:
            ``guided@prs-eth/marigold-depth-v1-1#3``. Digits after the last # are always a seed.

    Raises:
        ValueError: neither; a prior or a seed for a method without a prior; one bound twice; or the family's
            own error about its parameter.
    """
    if name in METHODS:
        return METHODS[name]
    family, colon, parameter = name.partition(":")
    if colon and family in PRIORLESS:
        return FAMILIES[family](parameter)
    bare, _, seed = name.rpartition("#")
    if bare and seed.isdecimal():
        return _seeded(find_method(bare), int(seed))
    bare, at, prior = name.rpartition("@")
    if at:
        return _bound(find_method(bare), prior)
    if colon and family in FAMILIES:
        return FAMILIES[family](parameter)
    known = [*METHODS, *(f"{key}:..." for key in FAMILIES)]
    bad_value("methods", f"one of {', '.join(known)}", repr(name))


def _bound(method: Method, prior: str) -> Method:
    if not (prior and method.uses_prior and method.seed is None):
        bad_value("methods", "METHOD@PRIOR with a method that uses a prior", f"{method.name}@{prior}")
    title = f"{method.title} ({prior.rstrip('/').rpartition('/')[2]})"
    return replace(method, name=f"{method.name}@{prior}", title=title, prior=prior)


def _seeded(method: Method, seed: int) -> Method:
    if not (method.uses_prior and method.seed is None):
        bad_value("methods", "METHOD#SEED with a method that uses a prior", f"{method.name}#{seed}")
    title = f"{method.title}, seed {seed}"
    return replace(method, name=f"{method.name}#{seed}", title=title, seed=seed)


def with_priors(methods: Sequence[str], priors: Sequence[str]) -> tuple[str, ...]:
    """The methods, then those of them that use a prior once more for every further prior.

    Args:
        methods: names.
        priors: further priors, beside the settings' own.

    Raises:
        ValueError: as ``find_method``.
    """
    bound = [f"{name}@{prior}" for prior in priors for name in methods if find_method(name).uses_prior]
    return (*methods, *bound)


def with_poses(methods: Sequence[str], poses: Sequence[str]) -> tuple[str, ...]:
    """The methods, with ``guided`` once for each of the named poses.

    Args:
        methods: names.
        poses: of ``POSES``; none leaves the methods as they are.
    """
    rows = [
        [f"guided:pose={pose}" for pose in poses] if name == "guided" and poses else [name]
        for name in methods
    ]
    return tuple(name for row in rows for name in row)


def with_seeds(methods: Sequence[str], first: int, count: int) -> tuple[str, ...]:
    """The methods, then those of them that use a prior once more for every further seed.

    Args:
        methods: names; one that is bound to a seed already is not run with others.
        first: the settings' own seed.
        count: how many seeds, ``first`` counted, at least 1.

    Raises:
        ValueError: no seed; else as ``find_method``.
    """
    if count < 1:
        bad_value("seeds", "at least 1", count)
    noisy = [name for name in methods if find_method(name).uses_prior and find_method(name).seed is None]
    bound = [f"{name}#{first + i}" for i in range(1, count) for name in noisy]
    return tuple(dict.fromkeys((*methods, *bound)))
