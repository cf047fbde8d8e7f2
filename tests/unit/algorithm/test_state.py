"""The trajectory of a chunk of samples: three images that differ in everything, two samples of one of them.

What the chunk finds for a sample is what its image gives alone, and what the stages give one by one.
"""

import copy
import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr
from torch import Tensor

from geodiff_plugin.algorithm import edges, match_fitting, state
from geodiff_plugin.algorithm.depth_range import search_one_number
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.match_fitting import fit_depth, fit_target, local_error, off_edges, prior_error
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS, Adam, FiniteWatch, backpropagate, power_above
from geodiff_plugin.algorithm.schedule import count_steps, make_schedule
from geodiff_plugin.algorithm.solver import solve_field
from geodiff_plugin.algorithm.state import StepTime, Trajectory, chunk_views
from geodiff_plugin.algorithm.systems import FieldSystem, RobustField
from geodiff_plugin.algorithm.terms import Given, Loss
from geodiff_plugin.cameras import PosedViews, View
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.plan import RowTasks
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import Matches, known_fraction, reject_reflections, rows
from geodiff_plugin.matching.rows import (
    first_rectified_pair,
    half_occlusions,
    row_images,
    with_occluded,
)
from geodiff_plugin.result import median
from geodiff_plugin.result.expected_error import MATCH_NOISE_PX, expected_error
from geodiff_plugin.result.median import filter_depth
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.points import refine_to_matches, reliable_matches
from geodiff_plugin.scale.space import DepthRange, PriorMaps, smooth_floor
from tests.tiny import rows_of
from tests.views import view_of

GRID, MAP = (26, 34), (19, 28)
IMAGE_OF_SAMPLE = [0, 1, 1, 2]
#: Nearest and farthest depth of each image, metres.
ENDS = ((1.5, 6.0), (4.0, 30.0), (0.7, 2.0))


@pytest.fixture(autouse=True)
def _fewer_points(monkeypatch):
    """The search for a basin takes most of the time; these few points are enough here."""
    monkeypatch.setattr("geodiff_plugin.scale.sampling.BASIN_SAMPLES", 80)


def drawn(*shape: int, seed: int, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def smooth(*shape: int, seed: int) -> torch.Tensor:
    coarse = drawn(*shape[:-2], 4, 5, seed=seed)
    return F.interpolate(coarse, shape[-2:], mode="bicubic").clamp(0.0, 1.0)


def relative(image: int, size: tuple[int, int]) -> torch.Tensor:
    """The true map of an image, affine in inverse depth, on a grid ``(1, 1, h, w)``."""
    return F.interpolate(smooth(1, 1, 48, 60, seed=10 + image), size, mode="bilinear")


def depth(image: int, x: torch.Tensor) -> torch.Tensor:
    near, far = ENDS[image]
    return 1.0 / (1 / far + (1 / near - 1 / far) * x.clamp(0, 1))


def camera(size: tuple[int, int], fx: float, fy: float) -> torch.Tensor:
    return torch.tensor([[fx, 0.4, 0.45 * size[1]], [0, fy, 0.52 * size[0]], [0, 0, 1.0]])


def evidence_of(image: int, points: bool = True, matched: bool = True, unequal: bool = False) -> Evidence:
    """Matches with noise, a region of reflections and holes; every image has other views and points.

    Its views have the size of those of the other images unless ``unequal``.
    """
    true_m = depth(image, relative(image, GRID))[0]
    noise = 0.02 * torch.randn(1, *GRID, generator=torch.Generator().manual_seed(image))
    inverse = (1.0 / true_m) * noise.exp()
    inverse[:, 15:, 3 * image + 6 : 3 * image + 17] *= 0.35  # far behind the surface
    confidence = (drawn(1, *GRID, seed=20 + image, high=1.5) - 0.4 - 0.1 * image).clamp(0.0, 0.95)
    matches = Matches(inverse, confidence, 0.004 / true_m.mean())
    given = (drawn(1, *GRID, seed=30 + image) > 0.9).float()
    known = Matches(given / true_m, given, 0.01 / true_m.median())
    views = []
    for v in range(1 + (image != 1)):
        size = (24 + (5 * v + image) * unequal, 37 - 4 * image * unequal)
        T = torch.eye(4)
        turn = Rotation.from_euler("xyz", (3.0 - image, 4.0 * v, -2.0 + image), degrees=True)
        T[:3, :3] = torch.from_numpy(turn.as_matrix()).float()
        T[:3, 3] = torch.tensor([-0.05 - 0.02 * v, 0.01 * image, 0.02]) * ENDS[image][0]
        views.append(
            view_of(smooth(1, 3, *size, seed=40 + image + 3 * v)[0], camera(size, 38.0, 30.0 + image), T)
        )
    left = smooth(1, 3, *GRID, seed=50 + image)[0]
    grid = PosedViews(view_of(left, camera(GRID, 34.0 + 3 * image, 31.0)), tuple(views))
    given_matches = matches if matched else None
    reliable = reliable_matches(matches) if matched else None
    return Evidence(grid, grid, None, given_matches, known if points else None, reliable)


def maps_of(
    images=IMAGE_OF_SAMPLE, valid: bool = True, metric: bool = False
) -> tuple[torch.Tensor, PriorMaps]:
    """Estimates of the prior of each sample, wrong by some per cent, and what is known of them."""
    x = torch.cat([relative(image, MAP) for image in images])
    members = torch.arange(len(images)).view(-1, 1, 1, 1)
    x = 0.1 + 0.7 * x + 0.02 * members * x * (1 - x) + 0.03 * smooth(len(images), 1, *MAP, seed=60)
    inside = torch.cat([smooth(1, 1, 12, 15, seed=70 + image) > 0.25 for image in images])
    near, far = torch.tensor([ENDS[image] for image in images]).T
    range_m = (
        DepthRange(0.8 * near, 1.3 * far, torch.zeros(len(images), dtype=torch.bool)) if metric else None
    )
    return x, PriorMaps("disparity", inside if valid else None, range_m)


CONFIG = DEFAULT.changed(weights={"photometric": 1.0, "matches": 0.2, "points": 0.1, "affine_reg": 0.1})
Z0 = drawn(4, 4, 9, 12, seed=80)
NAMES = ("match_weight", "error", "rank_correlation", "prior_depth_m", "on_edge", "occluded")


def run(
    images=IMAGE_OF_SAMPLE, samples=slice(None), config=CONFIG, evidence=None, given=False, **maps
) -> Trajectory:
    """A trajectory of some of the samples that was prepared, and had its hidden pixels found."""
    x, known = maps_of(**maps)
    evidence = [evidence_of(image) for image in range(3)] if evidence is None else evidence
    of_range = known.depth_range and known.depth_range.of(samples)
    valid = None if known.valid is None else known.valid[samples]
    of_prior = PriorMaps(known.space, valid, of_range, given)
    trajectory = Trajectory(config, evidence, images[samples], of_prior, 0.1)
    trajectory.x = x[samples]
    trajectory.prepare(trajectory.x, Z0[samples])
    trajectory.find_occluded(trajectory.x)
    return trajectory


@cache
def _shared(valid: bool, metric: bool) -> Trajectory:
    return run(valid=valid, metric=metric)


def prepared(valid: bool = True, metric: bool = False) -> Trajectory:
    """A copy of a trajectory that was run on all samples."""
    trajectory = copy.copy(_shared(valid, metric))
    trajectory.history = []
    return trajectory


def test_a_sample_of_a_chunk_is_what_its_image_is_alone():
    maps = {"valid": True, "metric": True}
    together = prepared(**maps)
    for samples in (slice(1, 3), slice(3, 4)):
        alone = run(samples=samples, **maps)
        for name in NAMES:
            found, expected = getattr(together, name), getattr(alone, name)
            found = found[samples, : expected.shape[1]] if name == "occluded" else found[samples]
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5, msg=name)
        for name in ("s_hat", "t_hat", "g_s"):
            found, expected = getattr(together.affine, name), getattr(alone.affine, name)
            torch.testing.assert_close(found[samples], expected, rtol=1e-4, atol=1e-5)
        fitted = together.fitted(together.x)[samples], alone.fitted(alone.x)
        torch.testing.assert_close(*fitted, rtol=1e-3, atol=1e-4)
        both = (t.loss(t.x, t.affine, z0, z0 + 0.1) for t, z0 in ((together, Z0), (alone, Z0[samples])))
        losses = [(loss.total, *loss.terms.values(), loss.visible_fraction) for loss in both]
        for found, expected in zip(*losses, strict=True):
            torch.testing.assert_close(found[samples], expected, rtol=1e-3, atol=1e-4)
    numbers = torch.stack([together.rank_correlation, together.affine.g_s, together.error.flatten()])
    assert (numbers.diff(dim=1).abs() > 1e-5).all()  # no two samples are the same


@pytest.mark.parametrize("valid", [True, False])
def test_what_is_found_of_the_first_estimate_is_what_its_stages_find(valid):
    trajectory = prepared(valid=valid, metric=True)
    x, maps = maps_of(valid=valid, metric=True)
    given = [evidence_of(image) for image in IMAGE_OF_SAMPLE]
    metric, objective = trajectory.metric, trajectory.objective
    near, far, _ = maps.depth_range
    torch.testing.assert_close(trajectory.prior_depth_m, metric(x, metric.from_range(near, far)))
    on_grid = F.interpolate(x, GRID, mode="bilinear")
    for b, image in enumerate(given):
        inside = np.ones(GRID, bool)
        if valid:
            inside = (
                F.interpolate(maps.valid[b : b + 1].float(), GRID, mode="nearest-exact")[0, 0].numpy() > 0
            )
        chosen = inside & (image.matches.confidence[0].numpy() > 0.5)
        expected = spearmanr(on_grid[b, 0][chosen], image.matches.inverse_depth[0][chosen]).statistic
        assert trajectory.rank_correlation[b].item() == pytest.approx(expected, abs=1e-3)
    # The range fits matches and points: the depth is right to some per cent where no reflection is.
    depth_m = trajectory.objective.metric_depth(x, trajectory.affine)
    ground_truth = torch.cat([depth(image, relative(image, GRID)) for image in IMAGE_OF_SAMPLE])
    assert ((depth_m / ground_truth).log().abs().flatten(1).median(1).values < 0.05).all()
    matches = Matches.stack([image.matches for image in given])
    points = Matches.stack([image.points for image in given])
    judged = matches.within(maps.valid) if valid else matches
    weight = reject_reflections(judged, depth_m)
    if valid:
        inside = F.interpolate(maps.valid.float(), GRID, mode="nearest-exact") > 0
        weight = torch.where(inside, weight, torch.ones_like(weight))
        assert (~inside).any() and (trajectory.match_weight[~inside] == 1).all()
    torch.testing.assert_close(trajectory.match_weight, weight)
    assert (weight < 0.5).any() and (weight > 0.9).float().mean() > 0.5
    target = fit_target(matches, points, weight, None, depth_m)
    target = target.within(maps.valid) if valid else target
    error = prior_error(depth_m, target, objective.left_01, CONFIG)
    torch.testing.assert_close(trajectory.error, error)
    # What is hidden, and the correction, likewise.
    occluded = trajectory.objective.occluded(x, trajectory.affine)
    assert torch.equal(trajectory.occluded, occluded) and occluded.any()
    local = local_error(error, maps.valid)
    later = fit_target(matches, points, weight, local, depth_m)
    fit = fit_depth(depth_m, later, objective.left_01, local, CONFIG)
    change = F.interpolate(fit.log_change, MAP, mode="bilinear", antialias=True)
    fitted = trajectory.fitted(x.clone().requires_grad_())
    assert not fitted.requires_grad
    found = metric(fitted, trajectory.affine).log() - metric(x, trajectory.affine).log()
    torch.testing.assert_close(found, -change, atol=1e-3, rtol=0)
    loss = trajectory.loss(x, trajectory.affine, Z0, Z0)
    of_matches = replace(matches, confidence=weight * matches.confidence)
    given = state.Given(trajectory.affine, trajectory.affine, Z0, Z0, of_matches, points, occluded)
    expected = trajectory.objective(x, given)
    torch.testing.assert_close(loss.total, expected.total)


def test_the_scale_of_a_given_map_is_refined_without_reflections():
    networks, given = run(valid=False), run(valid=False, given=True)
    ranges = torch.stack(networks.metric.range_of(networks.affine), 1)
    matches = [evidence_of(image).matches for image in IMAGE_OF_SAMPLE]
    weight = networks.match_weight
    for _ in range(2):
        ends = []
        for b, image in enumerate(IMAGE_OF_SAMPLE):
            first = weight[IMAGE_OF_SAMPLE.index(image)]  # of the image's samples
            weighted = replace(matches[b], confidence=first * matches[b].confidence)
            x = smooth_floor(given.x[b : b + 1])
            ends.append(torch.cat(refine_to_matches(x, weighted, *ranges[b : b + 1].T, "disparity")))
        ranges = torch.stack(ends)
        depth_m = given.objective.metric_depth(given.x, given.metric.from_range(*ranges.T))
        weight = reject_reflections(Matches.stack(matches), depth_m)
    found = torch.stack(given.metric.range_of(given.affine), 1)
    torch.testing.assert_close(found, ranges, rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(given.match_weight, weight, rtol=1e-2, atol=1e-2)
    assert (found / torch.stack(networks.metric.range_of(networks.affine), 1)).log().abs().max() > 2e-3


@pytest.mark.parametrize("given", [True, False])
def test_only_a_given_map_has_an_error_per_pixel(monkeypatch, given):
    trajectory = run(valid=False, given=given)
    of_all, trajectory.error = trajectory.error, None
    assert of_all.shape == (4, 1, 1, 1)  # there is no volume
    trajectory.evidence = [replace(each, volume=str(b)) for b, each in enumerate(trajectory.evidence)]
    monkeypatch.setattr(state, "regional_error", lambda measured, target, volumes: (measured, volumes))
    error = trajectory._regional_error(trajectory.x, trajectory._measure_error(trajectory.x))
    if given:
        measured, volumes = error
        assert volumes == list("0123") and measured.deviation.shape == (4, 1, *GRID)
        error = measured.error
    torch.testing.assert_close(error, of_all)


def own_scale_of(true_m, off, wrong=0.0, seed=0):
    """Trajectories of given maps in metres of a plane, all depths ``off``, and with a smooth error.

    Matches and points are 2 % too far, with noise. The first trajectory does not know the ends in metres.
    """
    rng = torch.Generator().manual_seed(seed)
    inverse = (1 + 0.01 * torch.randn(1, *GRID, generator=rng)) / (1.02 * true_m[0])
    matches = Matches(inverse, torch.full_like(inverse, 0.95), 0.03 / true_m.mean())
    own_m = true_m * off * torch.exp(wrong * (2 * smooth(1, 1, *GRID, seed=9) - 1))
    low, high = own_m.min(), own_m.max()
    at = (torch.rand(1, *GRID, generator=rng) > 0.95).float()
    points = Matches(at * inverse, at, 0.03 / true_m.mean())  # without views, they find the scale
    evidence = replace(evidence_of(0), matches=matches, reliable=reliable_matches(matches), points=points)
    found = []
    for ends in (None, DepthRange(low[None], high[None])):
        maps = PriorMaps("depth", None, given=True, own_range=ends)
        trajectory = Trajectory(CONFIG, [evidence], [0], maps, 0.1)
        trajectory.x = (own_m - low) / (high - low)
        trajectory.prepare(trajectory.x, Z0[:1])
        found.append(trajectory)
    return found


@pytest.mark.parametrize(
    ("off", "wrong", "kept"),
    [(1.0, 0.0, True), (1.0, 0.01, True), (1.25, 0.0, False), (0.8, 0.01, False), (100.0, 0.0, False)],
)
def test_a_given_map_in_metres_keeps_a_scale_that_fits_the_matches(off, wrong, kept):
    true_m = 2.0 + torch.linspace(0, 3, GRID[1]).expand(1, 1, *GRID)
    fitted, own = own_scale_of(true_m, off, wrong)
    assert fitted.own_scale is None and own.own_scale.flatten().tolist() == [float(kept)]
    found = [t.objective.metric_depth(t.x, t.affine) / true_m for t in (fitted, own)]
    assert float(found[0].median()) == pytest.approx(1.02, abs=0.01), "the fit follows the matches"
    if kept:
        assert float(found[1].median()) == pytest.approx(off, abs=0.01)
        results = [t.metric(t.fitted(t.x), t.affine) / true_m for t in (fitted, own)]
        errors = [float((result.log() - math.log(off)).abs().mean()) for result in results]
        assert errors[1] < 0.7 * errors[0], "matches with a common error do not move an accurate map as far"
    else:
        torch.testing.assert_close(found[1], found[0])
        torch.testing.assert_close(own.error, fitted.error)
        torch.testing.assert_close(own.match_weight, fitted.match_weight)
    for trajectory in (fitted, own):  # the next step of the same map
        before = trajectory.affine
        trajectory.prepare(trajectory.x, Z0[:1])
        assert trajectory.affine is before


def test_only_pixels_of_a_given_map_count_in_a_median():
    """The rest is extrapolated; a map may be coarser, and without any pixel the median is unknown."""
    valid = torch.zeros(3, 1, 2, 4, dtype=torch.bool)
    valid[0, ..., :1], valid[1, ..., 2:] = True, True
    maps = PriorMaps("depth", None, given=True)
    trajectory = Trajectory(CONFIG, [evidence_of(0)] * 3, [0, 1, 2], maps, 0.1)
    values = torch.arange(8.0).repeat(3, 1, 4, 1)
    trajectory.maps = replace(maps, valid=valid)
    found = trajectory._median_where_valid(values)
    assert found[:2].tolist() == [0.0, 5.0] and found[2].isnan()
    trajectory.maps = replace(maps, valid=None)
    assert trajectory._median_where_valid(values).tolist() == [3.0] * 3


@pytest.mark.parametrize(
    ("matched", "points", "parameters"),
    [
        (True, False, {}),
        (False, True, {}),
        (True, True, {"reject_reflections": False}),
        (True, True, {"fit_matches": False, "refine_edges": False, "occlusion_mask": False}),
        (False, True, {"weights": {"points": 1.0}, "fit_matches": False}),
    ],
)
def test_what_is_not_asked_for_is_not_found(matched, points, parameters):
    config = CONFIG.changed(**parameters)
    given = [evidence_of(image, points, matched) for image in range(3)]
    if not points:
        config = config.changed(search="one-number", g_s_range=(1.0, 9.0), g_s_candidates=3)
    trajectory = run(config=config, evidence=given)
    assert (trajectory.match_weight is not None) == matched
    if not config.reject_reflections:
        assert (trajectory.match_weight == 1).all()
    assert (trajectory.error is not None) == (config.fit_matches or config.refine_edges)
    compared = config.occlusion_mask and "photometric" in config.weights
    assert (trajectory.occluded is not None) == compared
    x = trajectory.x
    assert (trajectory.fitted(x) is x) == (trajectory.error is None)
    loss = trajectory.loss(x, trajectory.affine, Z0, Z0)
    assert ("matches" in loss.terms) == (matched and "matches" in config.weights) and (
        "points" in loss.terms
    ) == points
    assert (~trajectory.rank_correlation.isnan()).all()
    assert trajectory.prior_depth_m is None


def test_without_matches_and_points_nothing_is_judged():
    given = [evidence_of(image, False, False) for image in range(3)]
    config = CONFIG.changed(search="one-number", g_s_range=(2.0, 8.0), g_s_candidates=3)
    trajectory = run(config=config, evidence=given)
    assert trajectory.error is None and trajectory.match_weight is None
    assert trajectory.rank_correlation.shape == (4,) and trajectory.rank_correlation.isnan().all()
    assert trajectory.fitted(trajectory.x) is trajectory.x


def test_matches_are_judged_at_the_first_estimate_alone():
    trajectory = prepared(True, True)
    before = {name: getattr(trajectory, name) for name in ("error", "match_weight", "rank_correlation")}
    trajectory.prepare(1.0 - trajectory.x, Z0)
    assert all(getattr(trajectory, name) is value for name, value in before.items())


def test_later_searches_start_from_the_updated_scale(monkeypatch):
    """The range in use, whether it was on the edge, and where each image's prior is valid."""
    asked = []

    def search(x, evidence, metric, config, current, valid):
        asked.append((x, evidence, current, valid))
        base = torch.full((len(x),), 2.0 + len(asked))
        edges = torch.arange(len(x)) % 2 == 0
        return DepthRange(base, 3.0 * base, edges)

    monkeypatch.setattr(state, "fit_depth_range", search)
    x, maps = maps_of(metric=True)
    given = [evidence_of(image) for image in range(3)]
    trajectory = Trajectory(CONFIG, given, IMAGE_OF_SAMPLE, maps)
    trajectory.find_scale(x)
    near, far = trajectory.metric.range_of(trajectory.affine)
    torch.testing.assert_close(near, torch.tensor([3.0, 4.0, 4.0, 5.0]))
    torch.testing.assert_close(far, 3.0 * near)
    assert trajectory.on_edge.tolist() == [True, True, False, True]
    for (part, evidence, current, valid), samples in zip(asked, ([0], [1, 2], [3]), strict=True):
        assert torch.equal(part, x[samples]) and torch.equal(valid, maps.valid[samples[:1]])
        own = given[IMAGE_OF_SAMPLE[samples[0]]].within(maps.valid[samples[0]])
        assert torch.equal(evidence.matches.confidence, own.matches.confidence)
        assert torch.equal(current.near_m, maps.depth_range.near_m[samples])
    start = trajectory.affine
    moved = replace(start, s_hat=start.s_hat + 0.2, t_hat=start.t_hat - 0.1)
    trajectory.affine = moved
    asked.clear()
    trajectory.find_scale(x)
    expected = trajectory.metric.range_of(moved)
    for (_, _, current, _), samples in zip(asked, ([0], [1, 2], [3]), strict=True):
        assert torch.equal(current.near_m, expected[0][samples]) and torch.equal(
            current.far_m, expected[1][samples]
        )
        assert current.on_edge.tolist() == [[True], [True, False], [True]][IMAGE_OF_SAMPLE[samples[0]]]
    # The pull of the loss is to the newest result of the search.
    loss = trajectory.loss(x, moved, Z0, Z0)
    pull = (moved.s_hat - trajectory.affine.s_hat) ** 2 + (moved.t_hat - trajectory.affine.t_hat) ** 2
    torch.testing.assert_close(loss.terms["affine_reg"], pull)
    assert (pull > 1e-3).all()


@pytest.mark.parametrize("search", ["one-number", "points-range"])
def test_other_searches_are_done_once(search):
    config = CONFIG.changed(search=search, g_s_range=(2.0, 20.0), g_s_candidates=4)
    trajectory = run(config=config)
    if search == "points-range":
        spans = []
        for image in IMAGE_OF_SAMPLE:
            points = evidence_of(image).points
            inverse = points.inverse_depth[points.confidence > 0]
            spans.append((1 / inverse.max(), 1 / inverse.min()))
        ends = torch.stack(trajectory.metric.range_of(trajectory.affine), 1)
        torch.testing.assert_close(ends, torch.tensor(spans), rtol=1e-3, atol=0)
        assert not trajectory.on_edge.any()
    else:
        assert torch.isin(trajectory.affine.g_s, torch.tensor([2.0, 8.0, 14.0, 20.0])).all()
    moved = replace(trajectory.affine, s_hat=trajectory.affine.s_hat + 0.3)
    start, trajectory.affine = trajectory.affine, moved
    trajectory.find_scale(trajectory.x)
    assert trajectory.affine is moved
    pulled = trajectory.loss(trajectory.x, moved, Z0, Z0).terms["affine_reg"]
    torch.testing.assert_close(pulled, (moved.s_hat - start.s_hat) ** 2)


def test_a_report_holds_each_number_under_its_name():
    trajectory = prepared(metric=True)
    trajectory.affine = AffineState(*(torch.arange(4.0) + 10 * k for k in range(1, 4)))
    trajectory.step = StepTime(7, 249.0)
    trajectory.report(None)
    x = trajectory.x.clone().requires_grad_()
    loss = trajectory.loss(x, trajectory.affine, Z0, Z0)
    trajectory.report(loss)
    without, with_loss = trajectory.history
    for report in trajectory.history:
        assert (report.step, report.timestep) == (7, 249.0)
        numbers = report.s_hat, report.t_hat, report.g_s
        assert [number.tolist() for number in numbers] == [[10 * k + b for b in range(4)] for k in (1, 2, 3)]
    assert without.loss is None and without.visible_fraction is None and without.terms == {}
    assert torch.equal(with_loss.loss, loss.total) and not with_loss.loss.requires_grad
    assert set(with_loss.terms) == set(CONFIG.weights)
    for name, value in with_loss.terms.items():
        assert torch.equal(value, loss.terms[name]) and not value.requires_grad
    assert torch.equal(with_loss.visible_fraction, loss.visible_fraction)


@pytest.mark.parametrize("metric", [True, False])
def test_members_hold_what_was_found_of_their_own_sample(metric):
    trajectory = prepared(metric, metric)
    padded = F.pad(trajectory.x, (0, 3, 0, 2), mode="replicate")
    depth_m = trajectory.result(padded)
    torch.testing.assert_close(depth_m, trajectory.metric(padded, trajectory.affine))
    members = trajectory.members(trajectory.x, depth_m)
    assert len(members) == 4
    for b, member in enumerate(members):
        assert member.metric is trajectory.metric and torch.equal(member.relative, trajectory.x[b : b + 1])
        assert member.near_m.shape == member.far_m.shape == (1, 1, 1, 1)
        assert (member.near_m.item(), member.far_m.item()) == (
            depth_m[b].min().item(),
            depth_m[b].max().item(),
        )
        for name in ("s_hat", "t_hat", "g_s"):
            found, whole = getattr(member.affine, name), getattr(trajectory.affine, name)
            assert torch.equal(found, whole[b : b + 1])
        for name in ("match_weight", "error", "rank_correlation", "on_edge", "prior_depth_m"):
            found, whole = getattr(member, name), getattr(trajectory, name)
            assert (found is None) == (whole is None) == (not metric and name == "prior_depth_m")
            assert found is None or torch.equal(found, whole[b : b + 1])
        assert (
            member.valid is None
            if not metric
            else torch.equal(member.valid, trajectory.maps.valid[b : b + 1])
        )
        torch.testing.assert_close(member.depth_m, depth_m[b : b + 1, :, : MAP[0], : MAP[1]])


def test_views_of_a_chunk_have_one_size_and_as_many_cameras_as_the_image_with_most():
    given = [evidence_of(image, unequal=True) for image in IMAGE_OF_SAMPLE]
    for posed, evidence in zip(chunk_views(given), given, strict=True):
        assert len(posed.rights) == 2 and posed.size == GRID and posed.left is evidence.grid.left
        for v, view in enumerate(posed.rights):
            own = evidence.grid.rights[v if v < len(evidence.grid.rights) else 0]
            sizes = [e.grid.rights[min(v, len(e.grid.rights) - 1)].size for e in given]
            expected = own.resized(tuple(np.max(sizes, 0).tolist()))
            assert torch.equal(view.image_01, expected.image_01)
            np.testing.assert_array_equal(view.camera.K, expected.camera.K)
            np.testing.assert_array_equal(view.T_right_from_left, own.T_right_from_left)


@pytest.mark.parametrize(("optimizer", "factor"), [("plain", 1), ("summed", GRID[0] * GRID[1])])
def test_step_sizes_are_those_of_the_latent_and_of_scale_and_shift(optimizer, factor):
    config = CONFIG.changed(optimizer=optimizer, lr_affine=0.25)
    trajectory = Trajectory(config, [evidence_of(0)], [0], maps_of([0])[1], 0.03)
    one = torch.ones(1, 4, 2, 2)
    torch.testing.assert_close(trajectory.latent_optimizer.step(one, one), -0.03 * factor * one)
    for affine_rule in (trajectory.scale_optimizer, trajectory.shift_optimizer):
        assert affine_rule.step(torch.ones(1)).item() == pytest.approx(-0.25)
    assert trajectory.scale_optimizer is not trajectory.shift_optimizer


def test_what_is_not_finite_is_named_with_its_step():
    trajectory = prepared(True, True)
    trajectory.watch = type(trajectory.watch)()
    trajectory.step = StepTime(2, 499.0)
    trajectory.record("the latent", torch.tensor([1.0, torch.inf]))
    pipe = type("Pipe", (), {"dtype": torch.float32})()
    with pytest.raises(ValueError, match="the latent of denoising step 3"):
        trajectory.watch.check(pipe)
    for name in ("network's clean latent", "decoded map"):
        x, z0 = trajectory.x.clone(), Z0.clone()
        (z0 if "latent" in name else x)[-1, 0, 0, 0] = torch.nan
        fresh = Trajectory(CONFIG, trajectory.evidence, list(range(4)), trajectory.maps)
        fresh.error = torch.ones(4, 1, 1, 1)
        fresh.rank_correlation = torch.ones(4)
        fresh.find_scale = lambda x: None
        fresh.prepare(x, z0)
        with pytest.raises(ValueError, match=name):
            fresh.watch.check(pipe)
    trajectory.watch = type(trajectory.watch)()
    trajectory.result(torch.full((4, 1, 3, 3), torch.nan))
    with pytest.raises(ValueError, match="map of the final latent"):
        trajectory.watch.check(pipe)


def schedule(steps, config=DEFAULT, **options):
    return make_schedule(config, config.plan_updates(points_given=False), steps, **options)


@pytest.mark.parametrize(
    ("steps", "match_fits", "parameters", "corrected"),
    [
        (10, 2, {}, [5, 9]),
        (9, 3, {}, [4, 6, 8]),
        (9, 1, {}, [8]),
        (1, 4, {}, [0]),
        (8, 2, {"guidance_start": 0.25, "guidance_end": 0.75}, [4, 5]),
        (4, 3, {}, [1, 2, 3]),  # more than fit the second half reach further back
        (4, 9, {}, [0, 1, 2, 3]),
    ],
)
def test_corrections_are_spread_over_the_second_half_of_what_is_active(
    steps, match_fits, parameters, corrected
):
    found = schedule(steps, DEFAULT.changed(match_fits=match_fits, **parameters)).steps
    assert [i for i, rounds in enumerate(found) if any(r.fits_matches for r in rounds)] == corrected


def test_more_steps_than_a_prior_has_are_rejected():
    with pytest.raises(ValueError, match="num_inference_steps must be at most 1 with this prior; got 4"):
        count_steps(4, 4, 1)


class OneNumber:
    """A loss that is least at one of the candidates for g_s, each of which shows a fraction of the image."""

    config = DEFAULT.changed(g_s_range=(0.5, 5.0), g_s_candidates=10, min_visible=0.2)

    def __init__(self, best: int, unseen: tuple[int, ...] = ()) -> None:
        self.candidates = torch.linspace(0.5, 5.0, 10)
        self.best, self.unseen = self.candidates[best], self.candidates[list(unseen)]

    def __call__(self, x: Tensor, given: Given) -> Loss:
        g_s = given.affine.g_s
        fraction = torch.where(torch.isin(g_s, self.unseen), 0.19, 0.9)
        return Loss(g_s, {"photometric": (g_s - self.best).abs()}, fraction)


@pytest.mark.parametrize(
    ("best", "unseen", "found", "on_edge"),
    [
        (0, (), 0, True),
        (1, (), 1, False),
        (8, (), 8, False),
        (9, (), 9, True),
        (4, (4, 5), 3, False),  # what hardly any pixel of the right image shows does not win
        (8, (7, 8), 9, True),
    ],
)
def test_the_one_number_is_that_of_least_loss_and_either_end_is_an_edge(best, unseen, found, on_edge):
    objective = OneNumber(best, unseen)
    affine, edge = search_one_number(torch.zeros(2, 1, 4, 4), objective)
    assert affine.g_s.tolist() == [pytest.approx(float(objective.candidates[found]))] * 2
    assert edge.tolist() == [on_edge] * 2 and not affine.s_hat.any() and not affine.t_hat.any()


def test_adam_equals_torch_adam():
    target = torch.randn(3, 4)
    ours, theirs = torch.zeros(3, 4), torch.nn.Parameter(torch.zeros(3, 4))
    rule = Adam(0.05)
    optimiser = torch.optim.Adam([theirs], lr=0.05, betas=rule.betas, eps=1e-10)
    for _ in range(7):
        ours = ours + rule.step(2 * (ours - target))
        optimiser.zero_grad()
        (theirs - target).pow(2).sum().backward()
        optimiser.step()
    torch.testing.assert_close(ours, theirs.detach())


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_a_rule_goes_downhill_sample_by_sample_and_a_zero_gradient_moves_nothing(name):
    gradient, reference = torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2)
    together, alone = OPTIMIZERS[name](0.1), OPTIMIZERS[name](0.1)
    for _ in range(3):
        a, b = together.step(gradient, reference), alone.step(gradient[1:2], reference[1:2])
    torch.testing.assert_close(a[1:2], b)
    assert ((a * gradient).flatten(1).sum(1) < 0).all()
    assert OPTIMIZERS[name](0.1).step(torch.zeros_like(gradient), reference).abs().max() == 0
    step = OPTIMIZERS[name](0.1).step(torch.tensor([1.0, -2.0]))  # scalars per sample
    assert step.shape == (2,) and step[0] < 0 < step[1]


@pytest.mark.parametrize("sizes", [(1e-12, 1e-12), (1.0, 1.0), (1e-9, 1e9)])
def test_a_gradient_of_any_size_passes_float16_and_comes_out_at_its_own(sizes):
    z = torch.randn(2, 4, 3, 3, requires_grad=True)
    gradient = torch.randn(2, 4, 3, 3) * torch.tensor(sizes).view(2, 1, 1, 1)
    pulled = backpropagate((z.half() * 3.0).float(), z, gradient)
    torch.testing.assert_close(pulled / gradient, torch.full_like(pulled, 3.0), rtol=0.02, atol=0.0)


def test_the_first_non_finite_value_is_reported_with_its_step_and_a_hint():
    watch = FiniteWatch()
    watch.record("the decoded map", 0, torch.ones(3))
    watch.check(SimpleNamespace(dtype=torch.float16))
    watch.record("the encoded match fit", 1, torch.tensor([1.0, torch.nan]))
    watch.record("the decoded map", 1, torch.tensor([torch.inf]))
    with pytest.raises(ValueError, match=r"encoded match fit of denoising step 2 .* float16.*bfloat16"):
        watch.check(SimpleNamespace(dtype=torch.float16))
    with pytest.raises(ValueError, match="weights"):
        watch.check(SimpleNamespace(dtype=torch.float32))


def test_a_power_of_two_above_is_the_one_of_the_exponent():
    """Against numpy's frexp, at every exponent, and at powers of two and their neighbours."""
    exact = np.exp2(np.arange(-126, 127, dtype=np.float64)).astype(np.float32)
    some = exact * np.random.default_rng(0).uniform(1.0, 2.0, exact.shape).astype(np.float32)
    below, above = np.nextafter(exact[1:], np.float32(0)), np.nextafter(exact, np.float32(np.inf))
    values = np.concatenate([exact, below, above, some])
    expected = np.ldexp(np.float32(1), np.frexp(values)[1])
    np.testing.assert_array_equal(power_above(torch.from_numpy(values)).numpy(), expected)
    subnormal = power_above(torch.tensor([0.0, 1e-42]))
    assert (subnormal == 2.0 * torch.finfo(torch.float32).tiny).all()
    for dtype in (torch.float16, torch.bfloat16, torch.float64):
        assert power_above(torch.tensor([3.0], dtype=dtype)).item() == 4.0


def _system(height: int, width: int, link: float, seed: int = 0) -> FieldSystem:
    generator = torch.Generator().manual_seed(seed)
    weight = (torch.rand(1, 1, height, width, generator=generator) > 0.7).float() + 1e-3
    data = torch.randn(1, 1, height, width, generator=generator)
    across, down = torch.full((1, 1, height, width - 1), link), torch.full((1, 1, height - 1, width), link)
    return FieldSystem(weight, weight * data, across, down)


def applied(system: FieldSystem, u: torch.Tensor) -> torch.Tensor:
    """The left-hand side of the normal equations."""
    flow_x, flow_y = system.across * u.diff(dim=-1), system.down * u.diff(dim=-2)
    pad = torch.nn.functional.pad
    beside = pad(flow_x, (1, 0)) - pad(flow_x, (0, 1)) + pad(flow_y, (0, 0, 1, 0)) - pad(flow_y, (0, 0, 0, 1))
    return system.weight * u + beside


@pytest.mark.parametrize("link", [0.1, 30.0])
def test_a_small_system_is_solved_as_by_a_dense_solver(link):
    system = _system(7, 9, link)
    basis = torch.eye(63).view(63, 1, 7, 9)
    columns = [applied(system, unit[None]).flatten() for unit in basis]
    expected = torch.linalg.solve(torch.stack(columns, 1), system.rhs.flatten())
    torch.testing.assert_close(solve_field(system, 40).flatten(), expected, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize(("size", "link"), [((60, 83), 1.0), ((240, 331), 400.0), ((481, 640), 400.0)])
def test_few_steps_are_enough_at_any_size(size, link):
    system = _system(*size, link)
    found = solve_field(system, 12)
    residual = system.rhs - applied(system, found)
    assert float(residual.norm() / system.rhs.norm()) < 0.02


SIZE = (40, 60)
WEAK, STRONG = (torch.full((1, 1, 1, 1), error) for error in (0.3, 0.02))


def matches_at(depth_m: torch.Tensor, confidence: torch.Tensor) -> Matches:
    return Matches(1.0 / depth_m, confidence, torch.full((len(depth_m),), 1e-3))


def grey(value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 3, *SIZE), value)


def test_a_correction_spreads_over_its_surface_and_stops_at_an_edge():
    left, ground_truth = grey(0.2), torch.full((1, 1, *SIZE), 2.0)
    left[..., 30:] = 0.9  # another surface, of which nothing is known
    confidence = torch.zeros_like(ground_truth)
    confidence[..., :, 5:10] = 1.0
    error = torch.full((1, 1, 1, 1), 0.1)
    depth_m, support, _ = fit_depth(1.2 * ground_truth, matches_at(ground_truth, confidence), left, error)
    own, other = depth_m[..., 10:14], depth_m[..., 31:]
    assert (own / 2.0 - 1.0).abs().max() < 0.09
    assert (other / 2.4 - 1.0).abs().max() < 0.09  # half of what the surface next to it moved by
    assert support[..., 10:14].min() > 0.3 and support[..., 31:].max() < 0.1


def test_a_correction_on_a_finer_grid_reaches_a_coarser_map_as_its_mean(monkeypatch):
    """Every third column of the matches' grid is corrected; the map has a third of its columns and rows."""
    columns = torch.zeros(1, 1, 36, 45)
    columns[..., 1::3] = 0.3
    monkeypatch.setattr(
        match_fitting, "solve_robust", lambda *_, **__: RobustField(columns, columns, columns)
    )
    depth, left = torch.full((1, 1, 12, 15), 2.0), torch.rand(1, 3, 36, 45)
    matches = matches_at(torch.full((1, 1, 36, 45), 2.0), torch.ones(1, 1, 36, 45))
    refined, support, change = fit_depth(depth, matches, left, STRONG)
    inner = (..., slice(1, -1), slice(1, -1))
    torch.testing.assert_close(refined[inner], torch.full_like(refined[inner], 2.0 * math.exp(-0.1)))
    torch.testing.assert_close(support[inner], torch.full_like(support[inner], 0.1))
    assert change is columns


def test_next_to_an_edge_of_a_good_map_a_match_counts_less_and_a_point_does_not():
    depth = torch.full((1, 1, *SIZE), 2.0)
    depth[..., 30:] = 4.0
    target, kept = matches_at(depth, torch.ones_like(depth)), torch.ones_like(depth)
    doubted = off_edges(target, depth, STRONG).confidence
    assert doubted[..., 29:31].max() < 0.2
    assert doubted[..., :29].min() == doubted[..., 31:].min() == 1.0
    # A map that is wrong by a third does not know where edges are. Nor is a slope an edge.
    assert off_edges(target, depth, WEAK).confidence.min() > 0.9
    slope = torch.linspace(2.0, 4.0, SIZE[1]).expand(1, 1, *SIZE)
    assert off_edges(target, slope, STRONG).confidence.min() > 0.95
    points = matches_at(depth, torch.zeros_like(depth))
    points.confidence[0, 0, 6, 29] = 1.0
    beside = fit_target(target, points, kept, STRONG, depth).confidence[0, 0]
    assert beside[6, 29] == kept.numel() and beside[5, 29] < 0.3
    # No match counts before the first estimate.
    assert fit_target(target, None, None, None, depth) is None
    assert int((fit_target(target, points, None, WEAK, depth).confidence > 0).sum()) == 1


K = np.array([[80.0, 0, 20.5], [0, 95.0, 11.0], [0, 0, 1]])


def pose(x: float, y: float, z: float) -> np.ndarray:
    E = np.eye(4)
    E[:3, 3] = x, y, z
    return E


@pytest.mark.parametrize("moved", [(0.12, 0, 0), (0, -0.2, 0), (0.1, 0.05, 0.3), (0.02, 0.01, -0.4)])
def test_a_match_shifted_by_its_noise_gives_it(moved):
    E, row, column, z = pose(*moved), 3, 35, 4.0

    def seen(depth):
        x = np.linalg.inv(K) @ [column, row, 1] * depth - E[:3, 3]
        return (K @ x / x[2])[:2]

    pixels_a_metre = np.linalg.norm(seen(z + 1e-5) - seen(z - 1e-5)) / 2e-5
    error = expected_error(np.full((24, 40), z), K, [E])[row, column]
    assert error == pytest.approx(MATCH_NOISE_PX / pixels_a_metre, rel=1e-6)


NEAR, FAR = 2.0, 6.0


def box(height: int = 48, width: int = 64) -> Tensor:
    """A box at 2 m before a wall at 6 m."""
    depth = torch.full((1, 1, height, width), FAR)
    depth[..., height // 4 : 3 * height // 4, width // 4 : 3 * width // 4] = NEAR
    return depth


def blurred(depth_m: Tensor, rounds: int = 1) -> Tensor:
    """Inverse depth under a 3 by 3 box filter, as autoencoders blur what they store."""
    inverse = 1.0 / depth_m
    for _ in range(rounds):
        inverse = F.avg_pool2d(F.pad(inverse, (1,) * 4, mode="replicate"), 3, 1)
    return 1.0 / inverse


def between(depth_m: Tensor) -> float:
    """Share of the pixels that are on neither surface."""
    return float((((depth_m / NEAR - 1).abs() > 0.03) & ((depth_m / FAR - 1).abs() > 0.03)).float().mean())


@pytest.mark.parametrize("contrast", [0.0, 0.5])
@pytest.mark.parametrize("spacing", [1, 3])
def test_blurred_edges_become_steep(contrast, spacing):
    ground_truth = F.interpolate(box(), scale_factor=spacing, mode="nearest")
    soft = 1.0 / F.interpolate(1.0 / blurred(box()), scale_factor=spacing, mode="bilinear")
    image = (0.2 + contrast * (ground_truth < 4.0)).float().expand(-1, 3, -1, -1)
    sharp = sharpen_edges(soft, image, spacing)
    assert between(soft) > 0.05 and between(sharp) < 0.25 * between(soft)
    error, before = ((each / ground_truth - 1.0).abs().mean() for each in (sharp, soft))
    assert error < 0.4 * before


@pytest.mark.parametrize("spacing", [1, 4])
def test_planes_thin_posts_and_steep_edges_stay_bit_for_bit(spacing):
    v = torch.arange(96.0).view(1, 1, -1, 1).expand(-1, -1, -1, 80)
    ground = 1.6 * 100.0 / (v + 4.0)  # a camera 1.6 m above it; it changes by a fifth a row at the horizon
    post = torch.full((1, 1, 40, 60), FAR)
    post[..., 28 : 28 + spacing] = NEAR
    for depth_m in (ground, post, F.interpolate(box(), scale_factor=2, mode="nearest")):
        assert torch.equal(sharpen_edges(depth_m, torch.rand(1, 3, *depth_m.shape[-2:]), spacing), depth_m)


def test_sharpening_gives_depths_that_are_there_whatever_the_strips(monkeypatch):
    generator = torch.Generator().manual_seed(1)
    soft = torch.cat([blurred(box(), rounds) for rounds in (1, 2)])
    soft = soft * (1.0 + 0.01 * torch.rand(soft.shape, generator=generator))
    left = torch.rand(2, 3, 48, 64, generator=generator)
    whole = sharpen_edges(soft, left, 2)
    assert not torch.equal(whole, soft) and torch.isin(whole, soft).all()
    monkeypatch.setattr("geodiff_plugin._internal.strips.STRIP_PIXELS", 5 * 64)
    monkeypatch.setattr(edges, "STRIP", 7)
    assert torch.equal(sharpen_edges(soft, left, 2), whole)


#: Cameras of ``scene``: a shift of 9 px at 2 m, of 3 px at 6 m.
CAMERA = torch.tensor([[90.0, 0.0, 47.5], [0.0, 90.0, 35.5], [0.0, 0.0, 1.0]])
BASELINE_M = 0.2


def scene(side: int = 1, doffs: float = 0.0) -> tuple[Tensor, Tensor, View]:
    """Depth ``(1, 1, 72, 96)``, left image and a view to its right (``side`` 1) or left of a textured box."""
    ground_truth = box(72, 96)
    generator = torch.Generator().manual_seed(5)
    wall, front = (0.1 * torch.rand(1, 3, 72, 160, generator=generator) + low for low in (0.1, 0.6))

    def seen(shift_near: int, shift_far: int) -> Tensor:
        columns = torch.arange(96) + 32
        inside = torch.roll(ground_truth, -shift_near, -1) < 4.0
        return torch.where(inside, front[..., columns + shift_near], wall[..., columns + shift_far])

    T = np.eye(4)
    T[0, 3] = -side * BASELINE_M
    K_right = CAMERA.clone()
    K_right[0, 2] -= doffs
    moved = [round(side * shift + doffs) for shift in (9, 3)]
    return ground_truth, seen(0, 0), view_of(seen(*moved)[0], K_right, T)


def voted(map_m: Tensor, left: Tensor, views, matched_m: Tensor, confidence: float, error=0.4, *spacing):
    target = Matches(1.0 / matched_m, torch.full_like(matched_m, confidence), torch.full((1,), 2e-3))
    native = PosedViews(view_of(left[0], CAMERA), tuple(views))
    images = first_rectified_pair(native)
    rows = images and RowTasks(images, native.size).match(target, None).result().matches
    evidence = Evidence(native, native, None, target, rows=rows)
    return filter_depth(
        map_m, evidence, target, known_fraction(target), torch.full((1, 1, 1, 1), error), *spacing
    )


@pytest.mark.parametrize(("side", "doffs"), [(1, 0.0), (-1, 0.0), (1, 4.0), (-1, 4.0)])
def test_rows_are_matched_whatever_side_and_principal_point_the_view_has(side, doffs):
    ground_truth, left, view = scene(side, doffs)
    found = rows_of(row_images(view_of(left[0], CAMERA), view), 9.0)
    seen, gaps = found.matched > 0, found.filled > 0
    right = (found.shift - 18.0 / ground_truth[0, 0]).abs()[seen] < 0.5
    assert seen.float().mean() > 0.6 and right.float().mean() > 0.9
    assert gaps.any() and not (gaps & seen).any()


@pytest.mark.parametrize("side", [1, -1])
def test_the_strip_next_to_a_near_surface_gets_the_depth_behind_it(side):
    ground_truth, left, view = scene(side)
    rows = rows_of(row_images(view_of(left[0], CAMERA), view), 9.0)
    assert (rows.occluded > 0).any() and not (rows.occluded * (rows.matched + rows.filled)).any()
    sure = (rows.matched * (18.0 / ground_truth[0, 0] - rows.shift).abs().lt(0.5)).view_as(ground_truth)
    matches = Matches(1.0 / ground_truth, 0.9 * sure, torch.tensor([2e-3]))
    found = with_occluded(matches, half_occlusions(rows, matches.size, float(CAMERA[0, 0])))
    put = found.confidence != matches.confidence
    assert put.any() and bool((put == ((rows.occluded > 0) & (sure == 0))).all())
    right = (found.inverse_depth * ground_truth - 1.0).abs()[put] < 0.1
    assert right.float().mean() > 0.8
    kept = ~put
    assert torch.equal(found.inverse_depth[kept], matches.inverse_depth[kept])


def test_a_map_of_another_size_takes_its_edges_from_the_same_rows():
    ground_truth, left, view = scene()
    found = rows_of(row_images(view_of(left[0], CAMERA), view), 9.0)
    for factor in (0.5, 2.0):
        small_m = F.interpolate(ground_truth, scale_factor=factor, mode="nearest-exact")
        resized = median._rows_on(image_size(small_m), found)
        assert resized.matched.mean() == pytest.approx(float(found.matched.mean()), abs=0.02)
        off = (resized.shift - factor * 18.0 / small_m[0, 0]).abs()[resized.matched > 0]
        assert (off < 0.5 * factor).float().mean() > 0.9
        moved = torch.roll(small_m, round(-4 * factor), 3)
        wrong, mended = (
            float(((depth_m / small_m - 1.0).abs() > 0.1).float().mean())
            for depth_m in (moved, voted(moved, left, [view], ground_truth, 0.95))
        )
        assert mended < 0.6 * wrong


def test_a_weak_map_takes_its_edges_from_the_views_and_their_colours(monkeypatch):
    ground_truth, left, view = scene()
    moved = torch.roll(ground_truth, (3, -4), (2, 3))

    def wrong(depth_m: Tensor) -> float:
        """Share of the pixels that both views see that are off by more than 10 %."""
        return float(((depth_m / ground_truth - 1.0).abs() > 0.1)[..., 12:-12].float().mean())

    assert wrong(moved) > 0.05
    assert wrong(voted(moved, left, [view], ground_truth, 0.0)) < 0.4 * wrong(moved)
    assert wrong(voted(moved, left, [view], ground_truth, 0.95)) < 0.12 * wrong(moved)
    turned = view._replace(T_right_from_left=np.roll(view.T_right_from_left, 1, 0))
    for views in ([], [turned], [view._replace(image_01=view.image_01[..., 1:])]):  # none is rectified
        assert voted(moved, left, views, ground_truth, 0.95) is moved
    monkeypatch.setattr(median, "STRIP", 700)
    monkeypatch.setattr(rows, "MAX_PIXELS", 36 * 48)
    large = voted(ground_truth, left, [view], ground_truth, 0.95)  # which takes its edges from its colours
    assert ((large < 3.5) != (ground_truth < 3.5))[..., 12:-12].float().mean() < 0.02


def test_a_good_map_keeps_its_edges_only_if_they_are_sharp():
    ground_truth, left, view = scene()
    refine_edges = torch.roll(ground_truth, 4, 3)
    soft = F.avg_pool2d(F.pad(refine_edges, (3,) * 4, mode="replicate"), 7, 1)
    kept, followed = (
        voted(map_m, left, [view], ground_truth, 0.95, error=0.02) for map_m in (refine_edges, soft)
    )
    assert (kept / refine_edges - 1.0).abs().mean() < 1e-3
    coarse = voted(refine_edges, left, [view], ground_truth, 0.95, 0.02, 4.0)
    for map_m in (followed, coarse):
        assert ((map_m / ground_truth - 1.0).abs() > 0.1)[..., 12:-12].float().mean() < 0.01
    # A box filter of the log depth makes steps of as many pixels; a slope to the border is no step.
    assert median._edge_sharpness(torch.linspace(0.0, 2.0, 96).exp().expand(72, 96)) == 1.0
    for pixels in (1, 2, 3, 5):
        blurred = F.avg_pool2d(
            F.pad(ground_truth.log(), (pixels // 2,) * 4, mode="replicate"), pixels, 1
        ).exp()
        fraction = float(median._edge_sharpness(blurred[0, 0]))
        assert fraction == pytest.approx(min(1.0, 2.5 / pixels), rel=0.05)


def test_median_filter_is_opencvs_on_any_device() -> None:
    values = torch.rand(17, 23)
    assert torch.equal(median._median_of_windows(values), median._median_filtered(values))
