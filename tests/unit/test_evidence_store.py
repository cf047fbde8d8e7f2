"""Evidence is made once for one pair and one setting, and anew for everything else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.guidance import evidence
from geodiff_plugin.guidance.evidence import EvidenceStore
from geodiff_plugin.guidance.inputs import Inputs
from geodiff_plugin.types import CameraView
from tests.benchmarks.matching import textured_pair

SETTINGS = (GuidanceConfig(), True)


@pytest.fixture
def made(monkeypatch):
    """The calls that reach ``make_evidence``, answered by their number."""
    calls = []

    def count(*arguments):
        calls.append(arguments)
        return len(calls)

    monkeypatch.setattr(evidence, "make_evidence", count)
    return calls


def pair(seed=0, **changes):
    """A left image, and what is given beside it."""
    generator = torch.Generator().manual_seed(seed)
    left, right = torch.rand(2, 3, 8, 12, generator=generator)
    K, T = np.array([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]]), torch.eye(4)
    T[0, 3] = -0.1
    return left, replace(Inputs(K, (CameraView(right, torch.tensor(K).float(), T),), (), None), **changes)


def test_equal_values_are_made_once(made):
    store = EvidenceStore()
    assert store.get(*pair(), *SETTINGS) == store.get(*pair(), *SETTINGS) == 1
    assert len(made) == 1 and store.take_spared_seconds() > 0 and store.take_spared_seconds() == 0


def test_any_other_value_is_made_anew(made):
    store, (left, given) = EvidenceStore(size=20), pair()
    (view,), points = given.views, torch.ones(4, 3)
    others = [
        {"views": (view._replace(image_01=view.image_01 + 0.1),)},
        {"views": (view._replace(K=2 * view.K),)},
        {"views": (view._replace(T_right_from_left=2 * view.T_right_from_left),)},
        {"views": (view, view)},
        {"K_left": 2 * given.K_left},
        {"points": points},
        {"points": 2 * points},
        {"unit": None},
    ]
    for image, changes in [(left, {}), (left + 0.1, {}), (left[:, :, :6], {}), *((left, c) for c in others)]:
        store.get(image, replace(given, **changes), *SETTINGS)
    assert len(made) == 3 + len(others)
    for changes in ({"loss_resolution": 320}, {"planes": 80}):
        store.get(left, given, GuidanceConfig(**changes), True)
    store.get(left, given, *SETTINGS, True)  # a measured baseline
    store.get(left, given, GuidanceConfig(inner_steps=0), True)  # nothing that evidence depends on
    assert len(made) == 6 + len(others)


def test_an_image_changed_in_place_is_made_anew(made):
    store, (left, given) = EvidenceStore(), pair()
    store.get(left, given, *SETTINGS)
    left.mul_(0.5)
    assert store.get(left, given, *SETTINGS) == 2


def test_the_oldest_is_forgotten(made):
    store = EvidenceStore(size=2)
    assert [store.get(*pair(seed), *SETTINGS) for seed in (0, 1, 2, 1, 0)] == [1, 2, 3, 2, 4]


def test_guidance_asks_the_store_that_it_was_given():
    left, (right, K, T), _, _ = textured_pair((48, 64))
    guidance = GeometryGuidance(right, K, torch.linalg.inv(T))
    alone, again = guidance.prepare(left[None])[0], guidance.prepare(left[None])[0]
    assert alone is not again
    store = EvidenceStore()
    first, second = (GeometryGuidance(right, K, torch.linalg.inv(T)) for _ in range(2))
    first.evidence_store = second.evidence_store = store
    shared = first.prepare(left[None])[0]
    assert second.prepare(left[None])[0] is shared
    assert torch.equal(shared.matches.confidence, alone.matches.confidence)
    second = GeometryGuidance(right, K, torch.linalg.inv(T), depth_range=(1.0, 20.0))
    second.evidence_store = store
    assert second.prepare(left[None])[0] is not shared


def test_a_store_without_copies_keeps_the_images_themselves(made):
    store, (left, given) = EvidenceStore(1, copies=False), pair()
    store.get(left, given, *SETTINGS)
    left.mul_(0.5)
    assert store.get(left, given, *SETTINGS) == 1
