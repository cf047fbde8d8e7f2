"""``EvidenceStore``: evidence kept for further calls with the same images, cameras and settings."""

from __future__ import annotations

import time
from dataclasses import fields
from typing import Any, NamedTuple

import torch
from torch import Tensor

from geodiff_plugin.config import Affects, GuidanceConfig, affected
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import make_evidence

#: The settings that evidence is made by; the others count where they decide whether it needs matches.
_OF_EVIDENCE = [field.name for field in fields(GuidanceConfig) if affected(field) is Affects.EVIDENCE]


class _Entry(NamedTuple):
    """Evidence, what it was made from, and how long that took."""

    tensors: list[Tensor | None]
    settings: tuple[Any, ...]
    evidence: Evidence
    seconds: float


class EvidenceStore:
    """A cache of evidence by the values that it was made from; several guidances may share it."""

    def __init__(self, size: int = 2, copies: bool = True) -> None:
        """Keep the last ``size`` images, some 100 MB each; without ``copies`` they must not be changed."""
        self._size, self._copies, self._spared = size, copies, 0.0
        self._entries: list[_Entry] = []

    def get(
        self,
        left_01: Tensor,
        given: Inputs,
        config: GuidanceConfig,
        measured_baseline: bool = False,
    ) -> Evidence:
        """What ``make_evidence`` gives for these arguments; the caller must not change it."""
        views = [value for view in given.views for value in view]
        tensors = [left_01, torch.from_numpy(given.K_left), given.points, *views]
        needs_matches = config.needs_matches(given.points is not None)
        settings = tuple(getattr(config, name) for name in _OF_EVIDENCE)
        settings = (*settings, needs_matches, measured_baseline, given.unit)
        for entry in self._entries:
            comparable = entry.settings == settings and len(entry.tensors) == len(tensors)
            if comparable and all(map(_equal, entry.tensors, tensors)):
                self._spared += entry.seconds
                return entry.evidence
        start = time.perf_counter()
        evidence = make_evidence(left_01, given, config, measured_baseline)
        # Copies, so that an image that was changed in place since is not taken for the same.
        held = [value.clone() if self._copies and value is not None else value for value in tensors]
        self._entries.insert(0, _Entry(held, settings, evidence, time.perf_counter() - start))
        del self._entries[self._size :]
        return evidence

    def take_spared_seconds(self) -> float:
        """Seconds that the cache saved since the last call of this method; benchmarks add them."""
        spared, self._spared = self._spared, 0.0
        return spared


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.device == b.device and a.shape == b.shape and torch.equal(a, b)
