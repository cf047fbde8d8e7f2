"""Evidence is made once for one pair and one setting, and anew for everything else."""

from __future__ import annotations

import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.algorithm.evidence import EvidenceInputs
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.guidance import evidence_store
from geodiff_plugin.guidance.evidence_store import EvidenceStore
from tests.benchmarks.matching import textured_pair

SETTINGS = (GuidanceConfig(), True)


@pytest.fixture
def made(monkeypatch):
    """The calls that reach ``make_evidence``, answered by their number."""
    calls = []

    def count(*arguments, **settings):
        calls.append((arguments, settings))
        return len(calls)

    monkeypatch.setattr(evidence_store, "make_evidence", count)
    return calls


def pair(seed=0):
    generator = torch.Generator().manual_seed(seed)
    left, right = torch.rand(2, 3, 8, 12, generator=generator)
    K, T = torch.tensor([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]]), torch.eye(4)
    T[0, 3] = -0.1
    return left, [(right, K, T)], K, None


def test_equal_values_are_made_once(made):
    store = EvidenceStore()
    assert store.get(EvidenceInputs(*pair(), *SETTINGS)) == 1
    assert store.get(EvidenceInputs(*pair(), *SETTINGS)) == 1
    assert len(made) == 1 and store.take_spared_seconds() > 0 and store.take_spared_seconds() == 0


def test_any_other_value_is_made_anew(made):
    store, (left, rights, K, _) = EvidenceStore(size=20), pair()
    (right, K_right, T), points = rights[0], torch.ones(4, 3)
    others = [
        (left + 0.1, rights, K, None),
        (left, [(right + 0.1, K_right, T)], K, None),
        (left, [(right, 2 * K_right, T)], K, None),
        (left, [(right, K_right, 2 * T)], K, None),
        (left, rights + rights, K, None),
        (left, rights, 2 * K, None),
        (left, rights, K, points),
        (left, rights, K, 2 * points),
        (left[:, :, :6], rights, K, None),
    ]
    for given in [(left, rights, K, None), *others]:
        store.get(EvidenceInputs(*given, *SETTINGS))
    assert len(made) == 1 + len(others)
    store.get(EvidenceInputs(left, rights, K, None, GuidanceConfig().changed(loss_resolution=320), True))
    store.get(EvidenceInputs(left, rights, K, None, GuidanceConfig().changed(planes=80), True))
    # What happens after evidence is made says nothing of it.
    store.get(EvidenceInputs(left, rights, K, None, GuidanceConfig().changed(inner_steps=0), True))
    assert len(made) == 3 + len(others)


def test_an_image_changed_in_place_is_made_anew(made):
    store, given = EvidenceStore(), pair()
    store.get(EvidenceInputs(*given, *SETTINGS))
    given[0].mul_(0.5)
    assert store.get(EvidenceInputs(*given, *SETTINGS)) == 2


def test_the_oldest_is_forgotten(made):
    store = EvidenceStore(size=2)
    assert [store.get(EvidenceInputs(*pair(seed), *SETTINGS)) for seed in (0, 1, 2, 1, 0)] == [1, 2, 3, 2, 4]


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


def test_a_store_for_who_changes_nothing_keeps_the_images_themselves(made):
    store, given = EvidenceStore(1, copies=False), pair()
    for own in (given, pair()):
        assert store.get(EvidenceInputs(*own, *SETTINGS)) == 1
    assert store._entries[0].tensors[0] is given[0]
    assert EvidenceStore(1).get(EvidenceInputs(*given, *SETTINGS)) == 2
