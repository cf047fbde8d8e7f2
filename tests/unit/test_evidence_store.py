"""Evidence is made once for one pair and one setting, and anew for everything else."""

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
    monkeypatch.setattr(evidence, "make_evidence", lambda *given: calls.append(given) or len(calls))
    return calls


def pair(seed=0):
    """A left image, and what is given beside it."""
    left, right = torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(seed))
    K, T = np.array([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]]), torch.eye(4)
    return left, Inputs(K, (CameraView(right, torch.tensor(K).float(), T),), (), None)


def test_equal_values_are_made_once_and_any_other_anew(made):
    store, (left, given) = EvidenceStore(size=20), pair()
    assert store.get(*pair(), *SETTINGS) == store.get(*pair(), *SETTINGS) == 1
    assert store.take_spared_seconds() > 0 and store.take_spared_seconds() == 0
    (view,), points = given.views, torch.ones(4, 3)
    others = [
        {"views": (view._replace(image_01=view.image_01 + 0.1),)},
        {"views": (view._replace(T_right_from_left=2 * view.T_right_from_left),)},
        {"views": (view, view)},
        {"K_left": 2 * given.K_left},
        {"points": points},
        {"points": 2 * points},
        {"unit": None},
    ]
    for image, changes in [(left + 0.1, {}), (left[:, :, :6], {}), *((left, c) for c in others)]:
        store.get(image, replace(given, **changes), *SETTINGS)
    store.get(left, given, GuidanceConfig(planes=80), True)
    store.get(left, given, *SETTINGS, True)  # a measured baseline
    store.get(left, given, GuidanceConfig(inner_steps=0), True)  # nothing that evidence depends on
    assert len(made) == 5 + len(others)


@pytest.mark.parametrize("copies", [True, False])
def test_images_changed_in_place_and_the_oldest(made, copies):
    store, (left, given) = EvidenceStore(size=2, copies=copies), pair()
    store.get(left, given, *SETTINGS)
    left.mul_(0.5)
    assert store.get(left, given, *SETTINGS) == (2 if copies else 1)
    first = len(made) + 1
    numbers = [store.get(*pair(seed), *SETTINGS) for seed in (5, 6, 7, 6, 5)]
    assert numbers == [first, first + 1, first + 2, first + 1, first + 3]


def test_guidance_asks_the_store_that_it_was_given():
    left, (right, K, T), _, _ = textured_pair((48, 64))
    guidance = GeometryGuidance(right, K, torch.linalg.inv(T))
    (alone,) = guidance.prepare(left[None])
    guidance.evidence_store = EvidenceStore()
    (shared,), (again,) = guidance.prepare(left[None]), guidance.prepare(left[None])
    assert shared is again is not alone
    assert torch.equal(shared.matches.confidence, alone.matches.confidence)
