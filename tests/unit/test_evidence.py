"""Evidence: what is known of a view on its grid, made once for one pair and one setting."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.algorithm.state import chunk_views
from geodiff_plugin.algorithm.terms import Given, Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence import prepare
from geodiff_plugin.evidence import store as evidence_store
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import prepare_evidence, rows_in_background
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.geometry import warp_right_to_left
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import MetricMap
from geodiff_plugin.types import CameraView, PosedViews
from tests.benchmarks.matching import textured_pair
from tests.tiny import render_plane

NORMAL, OFFSET = np.array([0.1, -0.2, 1.0]), 2.0


def camera(size, focal) -> np.ndarray:
    return np.array([[focal, 0, size[1] / 2 - 0.5], [0, focal, size[0] / 2 - 0.5], [0, 0, 1]])


def wide_pair(size_right, focal_right, at_m=0.1):
    """What is known of a left image of 800 pixels and a right one of any size."""
    E = np.eye(4)
    E[0, 3] = at_m
    size = (120, 800)
    K, K_right = camera(size, 600.0), camera(size_right, focal_right)
    left, _ = render_plane(K, np.eye(4), size, NORMAL, OFFSET, 1)
    right, _ = render_plane(K_right, E, size_right, NORMAL, OFFSET, 1)
    images = [torch.from_numpy(image).permute(2, 0, 1).float() / 255 for image in (left, right)]
    T = torch.from_numpy(np.linalg.inv(E)).float()
    views = (CameraView(images[1], torch.from_numpy(K_right).float(), T),)
    config = GuidanceConfig().changed(
        sweep_pixels=96 * 640, search="one-number", weights={"photometric": 1.0}
    )
    native = PosedViews(images[0], views, torch.from_numpy(K).float())
    return prepare_evidence(native, None, config)


@pytest.mark.parametrize(
    ("size_right", "focal_right"), [((120, 800), 600.0), ((180, 1200), 900.0), ((96, 640), 480.0)]
)
def test_above_the_grid_the_truth_still_explains_the_left_image(size_right, focal_right):
    """Neither K may stay that of the image as given, nor the right image be finer than the left one."""
    views = chunk_views([wide_pair(size_right, focal_right)])
    right = views.views[0]
    assert views.size == right.image_01.shape[-2:] == (96, 640)
    _, depth_m = render_plane(views.K_left[0].double().numpy(), np.eye(4), views.size, NORMAL, OFFSET, 1)
    cameras, errors = (views.K_left, right.K, right.T_right_from_left), []
    for factor in (1.0, 1.05):
        depth = factor * torch.from_numpy(depth_m)[None, None]
        warped = warp_right_to_left(right.image_01, depth, *cameras)
        assert warped.visible.float().mean() > 0.8
        error = (warped.image - views.left_01).abs().mean(1, keepdim=True)
        errors.append(float(error[warped.visible].mean()))
    assert errors[0] < 0.3 * errors[1]


@pytest.mark.parametrize("min_visible", [0.0, 0.4, 0.8])
def test_below_min_visible_the_photographs_have_no_say(min_visible):
    """At this depth the plane shows some 60 % of the left image to a right camera that far away."""
    views, metric = chunk_views([wide_pair((120, 800), 600.0, at_m=0.6)]), MetricMap("depth")
    knobs = {"weights": {"photometric": 1.0}, "pyramid_levels": 1, "exposure": False}
    objective = Objective(views, metric, GuidanceConfig(**knobs, min_visible=min_visible))
    affine = metric.from_range(torch.tensor([1.0]), torch.tensor([1.4]))
    x = torch.full((1, 1, 96, 640), 0.3, requires_grad=True)
    loss = objective(x, Given(affine, affine, x, x))
    share = float(loss.visible_fraction)
    (gradient,) = torch.autograd.grad(loss.total.sum(), x)
    assert 0.5 < share < 0.7
    heard = share >= min_visible
    assert (float(loss.total.detach()) > 0.01) == heard and (float(gradient.abs().sum()) > 0) == heard


SETTINGS = (GuidanceConfig(),)


@pytest.fixture
def made(monkeypatch):
    """The calls that reach ``make_evidence``, answered by their number."""
    calls = []
    monkeypatch.setattr(evidence_store, "make_evidence", lambda *given: calls.append(given) or len(calls))
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
    store.get(left, given, GuidanceConfig(planes=80))
    store.get(left, given, *SETTINGS, True)  # a measured baseline
    store.get(left, given, GuidanceConfig(weights={"photometric": 1.0}))  # which has no matches
    store.get(left, given, GuidanceConfig(inner_steps=0))  # nothing that evidence depends on
    assert len(made) == 6 + len(others)


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


@pytest.mark.parametrize(("of_match", "of_point"), [(0.5, 2.0), (2.0, 0.5), (2.0, None)])
def test_rows_are_sought_up_to_the_nearest_of_matches_and_known_points(monkeypatch, of_match, of_point):
    monkeypatch.setattr(prepare, "match_rows", lambda pictures, nearest_px: nearest_px)
    matches, points = (
        None
        if most is None
        else Matches(torch.tensor([[[[0.1, most]]]]), torch.ones(1, 1, 1, 2), torch.ones(1))
        for most in (of_match, of_point)
    )
    here = torch.device("cpu")
    pictures = SimpleNamespace(shift_px=lambda inverse_depth: 7.0 * inverse_depth, device=here)
    assert rows_in_background(pictures, matches, points).result() == 14.0
    assert rows_in_background(None, matches, points) is None
