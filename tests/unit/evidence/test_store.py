"""The cache of evidence: another value of any input is another entry, equal values are the same one."""

from dataclasses import fields, replace
from typing import ClassVar

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.cameras import Camera, View
from geodiff_plugin.config import PARAMETERS, GuidanceConfig
from geodiff_plugin.evidence import store as module
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import plan_evidence
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.settings import Affects, names_affecting
from tests.benchmarks.matching import textured_pair
from tests.views import view_of

#: A second value of every option on which evidence depends; others must not make an entry of their own.
OPTIONS = {
    "pose": "given",
    "refine_edges": False,
    "clean_images": False,
    "depth_range": (0.5, 9.0),
    "planes": 80,
    "sweep_pixels": 99_999,
    "search": "one-number",
}


@pytest.fixture
def made(monkeypatch):
    """What reaches ``plan_evidence``; its answers are numbered."""
    calls = []
    monkeypatch.setattr(module, "plan_evidence", lambda *given: calls.append(given) or len(calls))
    return calls


def pair():
    left, *rights = torch.rand(3, 3, 8, 12, generator=torch.Generator().manual_seed(0))
    K = np.array([[10.0, 0, 6], [0, 9, 4], [0, 0, 1]])
    views = tuple(
        view_of(right, factor * K, factor * np.eye(4))
        for factor, right in zip((1.0, 1.5), rights, strict=True)
    )
    points = torch.rand(5, 3, generator=torch.Generator().manual_seed(1))
    return left, Inputs(Camera(K), views, ("a rig",), points, "m", False)


def variants():
    """The pair with one changed input, by its name."""
    left, given = pair()
    yield "left image", left + 0.1, given
    yield "left image of another size", left[..., 1:], given
    yield "K_left", left, replace(given, left=Camera(given.left.K + np.diag([0.1, 0, 0])))
    yield "points", left, replace(given, points=given.points + 0.1)
    yield "other points", left, replace(given, points=given.points[1:])
    yield "no points", left, replace(given, points=None)
    yield "valid pixels", left, replace(given, valid=torch.zeros(8, 12, dtype=torch.bool))
    yield "unit", left, replace(given, unit=None)
    for v in range(2):
        changes = {
            "image_01": lambda view: view.image_01 + 0.1,
            "camera": lambda view: replace(view.camera, K=view.camera.K + np.float32(0.1)),
            "T_right_from_left": lambda view: view.T_right_from_left + np.float32(0.1),
            "valid": lambda view: torch.zeros(view.size, dtype=torch.bool),
        }
        assert changes.keys() == set(View._fields)
        for name, change in changes.items():
            views = list(given.views)
            views[v] = views[v]._replace(**{name: change(views[v])})
            yield f"{name} of view {v}", left, replace(given, views=tuple(views))
    yield "order of the views", left, replace(given, views=given.views[::-1])
    yield "number of views", left, replace(given, views=given.views[:1])


def test_another_value_of_any_input_is_another_entry(made):
    """What the result does not depend on, such as the rigs for reports, is no part of the key."""
    store, config = EvidenceStore(size=99), GuidanceConfig()
    first = store.get(*pair(), config)
    for number, (name, left, given) in enumerate(variants(), start=2):
        assert store.get(left, given, config) == number, name
        assert made[-1] == (left, given, config, False, None)
    left, given = pair()
    assert store.get(left, replace(given, rigs=(), shared_intrinsics=True), config) == first == 1
    assert store.get(left, given, config, True) == number + 1 and made[-1][3] is True
    assert store.get(left, replace(given, mask=np.ones((8, 12))), config) == 1  # read as ``valid``
    assert store.get(left, replace(given, detects_borders=False), config) == 1  # the same
    named = {
        "left",
        "views",
        "points",
        "unit",
        "rigs",
        "shared_intrinsics",
        "mask",
        "valid",
        "detects_borders",
    }
    assert {field.name for field in fields(Inputs)} == named, "a new field is part of the key, or is not read"


def test_poses_of_another_check_are_another_entry(made):
    store, config, check = EvidenceStore(size=9), GuidanceConfig(), object()
    assert [store.get(*pair(), config, False, each) for each in (None, check, None, check)] == [1, 2, 1, 2]
    assert made[-1][4] is check


def test_another_value_of_an_option_is_another_entry_if_evidence_depends_on_it(made):
    store, left_and_given = EvidenceStore(size=99), pair()
    default = GuidanceConfig()
    store.get(*left_and_given, default)
    for number, (name, value) in enumerate(OPTIONS.items(), start=2):
        assert getattr(default, name) != value
        assert store.get(*left_and_given, default.changed(**{name: value})) == number, name
    without_matches = default.changed(refine_edges=False, fit_matches=False, guidance_steps=0)
    assert store.get(*left_and_given, without_matches) == number + 1
    assert not without_matches.needs_matches(True)
    others = {"ssim_weight": 0.3, "seed": 1, "smoothness": 7.0, "min_steps": 9, "outlier_sigma": 3.0}
    for name, value in others.items():
        if name in PARAMETERS:
            assert store.get(*left_and_given, default.changed(**{name: value})) == 1, name
    assert set(OPTIONS) == set(names_affecting(GuidanceConfig, Affects.EVIDENCE))
    assert len(made) == len(OPTIONS) + 2


class Watched(GuidanceConfig):
    """A configuration that records which of its settings are read."""

    read: ClassVar[set[str]] = set()

    def __getattribute__(self, name: str):
        if name in PARAMETERS:
            Watched.read.add(name)
        return super().__getattribute__(name)


@pytest.mark.parametrize("pose", ["refine", "given"])
def test_evidence_reads_exactly_the_settings_that_are_part_of_the_key(pose):
    posed, _ = textured_pair((48, 64))
    left, (right,) = posed.left.image_01, posed.rights
    (given,) = GeometryGuidance(right.image_01, right.camera.K, np.linalg.inv(right.T_right_from_left)).inputs
    config = Watched(pose=pose)
    Watched.read.clear()
    assert config.needs_matches(False)  # part of the key as a whole
    of_needs = set(Watched.read)
    plan_evidence(left, given, config)
    assert Watched.read == OPTIONS.keys() | of_needs


@pytest.mark.parametrize("size", [1, 2, 3])
def test_the_last_entries_are_kept_and_used_ones_are_not_moved(made, size):
    store, config, (_, given) = EvidenceStore(size), GuidanceConfig(), pair()
    images = [torch.full((3, 8, 12), float(i)) for i in range(4)]
    for image in images:
        store.get(image, given, config)
    for i, image in reversed(list(enumerate(images[-size:], start=5 - size))):
        assert store.get(image, given, config) == i
    assert len(made) == 4
    assert store.get(images[-size - 1], given, config) == 5


def test_by_default_two_entries_are_kept_as_copies(made):
    store, config, (left, given) = EvidenceStore(), GuidanceConfig(), pair()
    for image in (left, left + 1, left):
        store.get(image, given, config)
    assert len(made) == 2
    store.get(left + 2, given, config)
    assert store.get(left, given, config) == 4
    given.views[1].camera.K[0, 0] += 1.0  # changed in place
    assert store.get(left, given, config) == 5


def test_spared_seconds_are_those_that_the_entry_took(made, monkeypatch):
    clock = iter([10.0, 13.0, 20.0, 24.5])
    monkeypatch.setattr(module.time, "perf_counter", lambda: next(clock))
    store, config, (left, given) = EvidenceStore(), GuidanceConfig(), pair()
    store.get(left, given, config)
    store.get(left + 1, given, config)
    assert store.take_spared_seconds() == 0.0
    for image, times in ((left, 2), (left + 1, 1)):
        for _ in range(times):
            store.get(image, given, config)
    assert store.take_spared_seconds() == 3.0 * 2 + 4.5
    assert store.take_spared_seconds() == 0.0
