"""``EvidenceStore``: caches evidence for further calls with the same images, cameras and settings."""

from __future__ import annotations

import time
from itertools import chain
from typing import Any, NamedTuple

import torch
from torch import Tensor

from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.plan import EvidencePlan
from geodiff_plugin.evidence.pose_check import CheckedPoses
from geodiff_plugin.evidence.prepare import plan_evidence
from geodiff_plugin.settings import Affects, names_affecting

#: Settings that evidence depends on; others matter only through whether matches are needed.
_OF_EVIDENCE = names_affecting(GuidanceConfig, Affects.EVIDENCE)


class _Entry(NamedTuple):
    """Evidence, the data it was made from, and the seconds that took."""

    tensors: list[Tensor | None]
    settings: tuple[Any, ...]
    checked: CheckedPoses | None
    plan: EvidencePlan
    seconds: float


class EvidenceStore:
    """A cache of evidence, keyed by the values it was made from; several guidances may share it."""

    def __init__(self, size: int = 2, copies: bool = True) -> None:
        """Keep the last ``size`` images, about 100 MB each; without ``copies`` they must not be modified."""
        self._size, self._copies, self._spared = size, copies, 0.0
        self._entries: list[_Entry] = []

    def get(
        self,
        left_01: Tensor,
        given: Inputs,
        config: GuidanceConfig,
        measured_baseline: bool = False,
        checked: CheckedPoses | None = None,
    ) -> EvidencePlan:
        """Return the result of ``plan_evidence`` for these arguments; the caller must not modify it."""
        of_views = [(view.camera.K, view.T_right_from_left) for view in given.views]
        cameras = [torch.from_numpy(each) for each in (given.left.K, *chain(*of_views))]
        masks = [given.valid, *(view.valid for view in given.views)]
        tensors = [left_01, given.points, *(view.image_01 for view in given.views), *cameras, *masks]
        needs_matches = config.needs_matches(given.points is not None)
        settings = tuple(getattr(config, name) for name in _OF_EVIDENCE)
        settings = (*settings, needs_matches, measured_baseline, given.unit)
        for entry in self._entries:
            same = entry.settings == settings and entry.checked is checked
            if same and len(entry.tensors) == len(tensors) and all(map(_equal, entry.tensors, tensors)):
                self._spared += entry.seconds
                return entry.plan
        start = time.perf_counter()
        plan = plan_evidence(left_01, given, config, measured_baseline, checked)
        # Copies detect an image that was modified in place since.
        held = [value.clone() if self._copies and value is not None else value for value in tensors]
        self._entries.insert(0, _Entry(held, settings, checked, plan, time.perf_counter() - start))
        del self._entries[self._size :]
        return plan

    def take_spared_seconds(self) -> float:
        """Return the seconds saved by the cache since the last call of this method, for benchmarks."""
        spared = self._spared
        self._spared = 0.0
        return spared


def _equal(a: Tensor | None, b: Tensor | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.device == b.device and a.shape == b.shape and torch.equal(a, b)
