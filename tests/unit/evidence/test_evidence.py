"""Evidence where a prior has no value: matches and points lose their confidence there."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.algorithm.state import chunk_views
from geodiff_plugin.algorithm.terms import Given, Objective
from geodiff_plugin.cameras import Camera
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evidence import store as evidence_store
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import prepare_evidence
from geodiff_plugin.evidence.store import EvidenceStore
from geodiff_plugin.geometry import plane_rays, warp_right_to_left
from geodiff_plugin.matching import Matches
from geodiff_plugin.scale.space import MetricMap
from tests.benchmarks.matching import textured_pair
from tests.tiny import render_plane
from tests.views import posed_of, view_of

GRID, OF_PRIOR = (12, 18), (8, 9)


def matches_of(seed: int, fraction: float) -> Matches:
    rng = np.random.default_rng(seed)
    confidence = rng.uniform(0.6, 1.0, GRID) * (rng.random(GRID) < fraction)
    tensors = [torch.from_numpy(x)[None].float() for x in (rng.uniform(0.1, 1.0, GRID), confidence)]
    return Matches(*tensors, torch.tensor(0.002))


def evidence_of(**parts) -> Evidence:
    native = posed_of(torch.zeros(3, *GRID), np.eye(3))
    return Evidence(native, native, None, **{"matches": None} | parts)


@pytest.mark.parametrize("has_matches", [True, False])
@pytest.mark.parametrize("has_points", [True, False])
def test_confidence_is_zero_outside_of_the_priors_map(has_matches, has_points):
    """On a coarser grid with other ratios along both axes."""
    valid = np.random.default_rng(2).random(OF_PRIOR) > 0.3
    inside = valid[
        np.ix_(*(((np.arange(n) + 0.5) * m / n).astype(int) for n, m in zip(GRID, OF_PRIOR, strict=True)))
    ]
    given = {
        "matches": matches_of(0, 0.9) if has_matches else None,
        "points": matches_of(1, 0.2) if has_points else None,
    }
    found = evidence_of(**given).within(torch.from_numpy(valid)[None])
    for name, before in given.items():
        after = getattr(found, name)
        if before is None:
            assert after is None
            continue
        np.testing.assert_array_equal(after.confidence[0], before.confidence[0].numpy() * inside)
        assert (
            torch.equal(after.inverse_depth, before.inverse_depth) and after.plane_step == before.plane_step
        )
    if has_matches:
        likely = (found.matches.confidence > 0.5).float()
        assert torch.equal(found.reliable.confidence, likely) and 50 <= likely.sum() < likely.numel()
    else:
        assert found.reliable is None


def test_points_stay_where_the_prior_is_silent_about_all_of_them():
    points, matches = matches_of(1, 0.2), matches_of(0, 0.9)
    nowhere = torch.zeros(1, *OF_PRIOR, dtype=torch.bool)
    found = evidence_of(points=points, matches=matches).within(nowhere)
    assert found.points is points
    assert not found.matches.confidence.any() and found.reliable is None
    alone = evidence_of(points=points).within(nowhere)
    assert alone.points is points and alone.matches is None
    one = torch.zeros(1, *GRID, dtype=torch.bool)
    row, column = (points.confidence[0] > 0).nonzero()[3]
    one[0, row, column] = True
    kept = evidence_of(points=points).within(one).points
    assert (kept.confidence > 0).sum() == 1 and kept.confidence[0, row, column] == points.confidence[
        0, row, column
    ]


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
    config = GuidanceConfig().changed(
        sweep_pixels=96 * 640, search="one-number", weights={"photometric": 1.0}
    )
    native = posed_of(images[0], K, (images[1], K_right, np.linalg.inv(E)))
    return prepare_evidence(native, None, config).evidence


@pytest.mark.parametrize(
    ("size_right", "focal_right"), [((120, 800), 600.0), ((180, 1200), 900.0), ((96, 640), 480.0)]
)
def test_above_the_grid_the_ground_truth_still_explains_the_left_image(size_right, focal_right):
    """Neither K may stay that of the image as given, nor the right image be finer than the left one."""
    ((left, (right,)),) = chunk_views([wide_pair(size_right, focal_right)])
    assert left.size == right.size == (96, 640)
    _, depth_m = render_plane(left.camera.K.astype(float), np.eye(4), left.size, NORMAL, OFFSET, 1)
    errors = []
    for factor in (1.0, 1.05):
        depth = factor * torch.from_numpy(depth_m)[None, None]
        rays = plane_rays(depth, [left.camera], [right.camera], [right.T_right_from_left])
        warped = warp_right_to_left(right.image_01[None], depth, rays)
        assert warped.visible.float().mean() > 0.8
        error = (warped.image - left.image_01).abs().mean(1, keepdim=True)
        errors.append(float(error[warped.visible].mean()))
    assert errors[0] < 0.3 * errors[1]


@pytest.mark.parametrize("min_visible", [0.0, 0.4, 0.8])
def test_below_min_visible_the_images_have_no_effect(min_visible):
    """At this depth the plane shows some 60 % of the left image to a right camera that far away."""
    views, metric = chunk_views([wide_pair((120, 800), 600.0, at_m=0.6)]), MetricMap("depth")
    parameters = {"weights": {"photometric": 1.0}, "pyramid_levels": 1, "exposure": False}
    objective = Objective(views, metric, GuidanceConfig(**parameters, min_visible=min_visible))
    affine = metric.from_range(torch.tensor([1.0]), torch.tensor([1.4]))
    x = torch.full((1, 1, 96, 640), 0.3, requires_grad=True)
    loss = objective(x, Given(affine, affine, x, x))
    fraction = float(loss.visible_fraction)
    (gradient,) = torch.autograd.grad(loss.total.sum(), x)
    assert 0.5 < fraction < 0.7
    heard = fraction >= min_visible
    assert (float(loss.total.detach()) > 0.01) == heard and (float(gradient.abs().sum()) > 0) == heard


SETTINGS = (GuidanceConfig(),)


@pytest.fixture
def made(monkeypatch):
    """The calls that reach ``plan_evidence``, answered by their number."""
    calls = []
    monkeypatch.setattr(evidence_store, "plan_evidence", lambda *given: calls.append(given) or len(calls))
    return calls


def pair(seed=0):
    """A left image, and what is given next to it."""
    left, right = torch.rand(2, 3, 8, 12, generator=torch.Generator().manual_seed(seed))
    K, T = np.array([[10.0, 0, 6], [0, 10, 4], [0, 0, 1]]), np.eye(4)
    return left, Inputs(Camera(K), (view_of(right, K, T),), (), None)


def test_equal_values_are_computed_once_and_any_other_again(made):
    store, (left, given) = EvidenceStore(size=20), pair()
    assert store.get(*pair(), *SETTINGS) == store.get(*pair(), *SETTINGS) == 1
    assert store.take_spared_seconds() > 0 and store.take_spared_seconds() == 0
    (view,), points = given.views, torch.ones(4, 3)
    others = [
        {"views": (view._replace(image_01=view.image_01 + 0.1),)},
        {"views": (view._replace(T_right_from_left=2 * view.T_right_from_left),)},
        {"views": (view, view)},
        {"left": Camera(2 * given.left.K)},
        {"points": points},
        {"points": 2 * points},
        {"unit": None},
    ]
    for image, changes in [(left + 0.1, {}), (left[:, :, :6], {}), *((left, c) for c in others)]:
        store.get(image, replace(given, **changes), *SETTINGS)
    store.get(left, given, GuidanceConfig(planes=80))
    store.get(left, given, *SETTINGS, True)  # a measured baseline
    store.get(left, given, GuidanceConfig(weights={"photometric": 1.0}))  # which has no matches
    store.get(left, given, GuidanceConfig(guidance_steps=0))  # nothing that evidence depends on
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
    (left, (right,)), _ = textured_pair((48, 64))
    E = np.linalg.inv(right.T_right_from_left)
    guidance, left = GeometryGuidance(right.image_01, right.camera.K, E), left.image_01
    (alone,) = guidance.prepare(left[None])
    guidance.evidence_store = EvidenceStore()
    (shared,), (again,) = guidance.plan_evidence(left[None]), guidance.plan_evidence(left[None])
    assert shared is again and shared.evidence.matches is not alone.matches
    assert torch.equal(shared.evidence.matches.confidence, alone.matches.confidence)
