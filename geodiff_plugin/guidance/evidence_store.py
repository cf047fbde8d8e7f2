"""Cache of cost volumes and matches, for several guided calls on one pair.

Data flow: views and points as given, configuration -> ``Evidence``, made or remembered.
Paper: none.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from geodiff_plugin.algorithm.evidence import Evidence, EvidenceInputs, prepare_evidence
from geodiff_plugin.guidance.posing import cleaned_views, pose_views

__all__ = ["EvidenceStore", "make_evidence"]


def make_evidence(given: EvidenceInputs) -> Evidence:
    """Photographs cleaned, poses as the knob ``pose`` says, then ``prepare_evidence``."""
    if not given.views:
        return prepare_evidence(given)
    left_01, views = cleaned_views(given.left_01, given.views, given.config)
    views, report = pose_views(left_01, views, given.K_left, given.config, given.unit, given.measured)
    return prepare_evidence(replace(given, left_01=left_01, views=views), report)


def _settings(given: EvidenceInputs) -> tuple[Any, ...]:
    """What of a configuration evidence depends on."""
    config, swept = given.config, given.config.search == "volume"
    return (
        *(config.pose, config.clean_photographs, config.loss_resolution, config.depth_range),
        *(config.planes, config.sweep_pixels),
        *(swept, given.needs_matches, given.unit, given.measured),
    )


@dataclass(frozen=True)
class _Entry:
    tensors: list[Tensor | None]
    settings: tuple[Any, ...]
    evidence: Evidence
    seconds: float

    def fits(self, tensors: list[Tensor | None], settings: tuple[Any, ...]) -> bool:
        """Whether it was made from the same values with the same settings on the same device."""
        if self.settings != settings or len(self.tensors) != len(tensors):
            return False
        return all(_equal(own, given) for own, given in zip(self.tensors, tensors, strict=True))


def _equal(one: Tensor | None, other: Tensor | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.device == other.device and one.shape == other.shape and torch.equal(one, other)


class EvidenceStore:
    """Remembers evidence by the values that it was made from: images, cameras, points and settings.

    Give one to the ``GeometryGuidance`` of every call that is to share: ``guidance.evidence_store = store``.
    """

    def __init__(self, size: int = 2, copies: bool = True) -> None:
        """Keep the evidence of the last ``size`` images; about 100 MB each with its cost volume.

        ``copies=False`` keeps the images themselves, for who changes none in place.
        """
        self._size, self._copies, self._spared = size, copies, 0.0
        self._entries: list[_Entry] = []

    def get(self, given: EvidenceInputs) -> Evidence:
        """What ``make_evidence`` gives for these inputs; not to be changed by who gets it."""
        tensors = [
            given.left_01,
            given.K_left,
            given.points,
            *(value for view in given.views for value in view),
        ]
        settings = _settings(given)
        for entry in self._entries:
            if entry.fits(tensors, settings):
                self._spared += entry.seconds
                return entry.evidence
        start = time.perf_counter()
        evidence = make_evidence(given)
        # Copies, so that who changes an image in place asks anew.
        held = [value.clone() if self._copies and value is not None else value for value in tensors]
        entry = _Entry(held, settings, evidence, time.perf_counter() - start)
        self._entries = [entry, *self._entries][: self._size]
        return evidence

    def take_spared_seconds(self) -> float:
        """Seconds that remembering has spared since this was last asked; a fair account adds them."""
        spared, self._spared = self._spared, 0.0
        return spared
