"""The trajectory of a chunk of samples: three images that differ in everything, two samples of one of them.

What the chunk finds for a sample is what its image gives alone, and what the stages give one by one.
"""

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy.spatial.transform import Rotation
from scipy.stats import spearmanr

from geodiff_plugin.algorithm import state
from geodiff_plugin.algorithm.correction import correction_target, fit_depth, local_error, prior_error
from geodiff_plugin.algorithm.state import StepTime, Trajectory, chunk_views
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.geometry import resize_image
from geodiff_plugin.matching import Matches, reject_reflections
from geodiff_plugin.scale.points import reliable_matches
from geodiff_plugin.scale.space import AffineState, DepthRange, PriorMaps
from geodiff_plugin.types import CameraView, PosedViews

GRID, MAP = (26, 34), (19, 28)
IMAGE_OF_SAMPLE = [0, 1, 1, 2]
#: Nearest and farthest depth of each image, metres.
ENDS = ((1.5, 6.0), (4.0, 30.0), (0.7, 2.0))


@pytest.fixture(autouse=True)
def _fewer_points(monkeypatch):
    """The search for a basin takes most of the time; these few points are enough here."""
    monkeypatch.setattr("geodiff_plugin.scale.points.BASIN_SAMPLES", 80)


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
            CameraView(smooth(1, 3, *size, seed=40 + image + 3 * v)[0], camera(size, 38.0, 30.0 + image), T)
        )
    left = smooth(1, 3, *GRID, seed=50 + image)[0]
    grid = PosedViews(left, tuple(views), camera(GRID, 34.0 + 3 * image, 31.0))
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


CONFIG = DEFAULT.changed(weights={"photometric": 1.0, "matches": 0.2, "points": 0.1, "prior_pull": 0.1})
Z0 = drawn(4, 4, 9, 12, seed=80)
NAMES = ("reflection_weight", "error", "rank_correlation", "prior_depth_m", "on_edge", "hidden")


def run(images=IMAGE_OF_SAMPLE, samples=slice(None), config=CONFIG, evidence=None, **maps) -> Trajectory:
    """A trajectory of some of the samples that was prepared, and had its hidden pixels found."""
    x, known = maps_of(**maps)
    given = [evidence_of(image) for image in range(3)] if evidence is None else evidence
    of_range = known.depth_range and known.depth_range.of(samples)
    valid = None if known.valid is None else known.valid[samples]
    trajectory = Trajectory(config, given, images[samples], PriorMaps(known.space, valid, of_range), 0.1)
    trajectory.x = x[samples]
    trajectory.prepare(trajectory.x, Z0[samples])
    trajectory.find_hidden(trajectory.x)
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
            found = found[samples, : expected.shape[1]] if name == "hidden" else found[samples]
            torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5, msg=name)
        for name in ("s_hat", "t_hat", "g_s"):
            found, expected = getattr(together.affine, name), getattr(alone.affine, name)
            torch.testing.assert_close(found[samples], expected, rtol=1e-4, atol=1e-5)
        corrected = together.corrected(together.x)[samples], alone.corrected(alone.x)
        torch.testing.assert_close(*corrected, rtol=1e-3, atol=1e-4)
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
    metric, views = trajectory.metric, trajectory.objective.views
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
    truth = torch.cat([depth(image, relative(image, GRID)) for image in IMAGE_OF_SAMPLE])
    assert ((depth_m / truth).log().abs().flatten(1).median(1).values < 0.05).all()
    matches = Matches.stack([image.matches for image in given])
    points = Matches.stack([image.points for image in given])
    judged = matches.within(maps.valid) if valid else matches
    weight = reject_reflections(judged, depth_m)
    if valid:
        inside = F.interpolate(maps.valid.float(), GRID, mode="nearest-exact") > 0
        weight = torch.where(inside, weight, torch.ones_like(weight))
        assert (~inside).any() and (trajectory.reflection_weight[~inside] == 1).all()
    torch.testing.assert_close(trajectory.reflection_weight, weight)
    assert (weight < 0.5).any() and (weight > 0.9).float().mean() > 0.5
    target = correction_target(matches, points, weight, None, depth_m)
    target = target.within(maps.valid) if valid else target
    error = prior_error(depth_m, target, views.left_01, CONFIG)
    torch.testing.assert_close(trajectory.error, error)
    # What is hidden, and the correction, likewise.
    hidden = trajectory.objective.hidden(x, trajectory.affine)
    assert torch.equal(trajectory.hidden, hidden) and hidden.any()
    local = local_error(error, maps.valid)
    later = correction_target(matches, points, weight, local, depth_m)
    fit = fit_depth(depth_m, later, views.left_01, local, CONFIG)
    change = F.interpolate(fit.correction, MAP, mode="bilinear", antialias=True)
    corrected = trajectory.corrected(x.clone().requires_grad_())
    assert not corrected.requires_grad
    found = metric(corrected, trajectory.affine).log() - metric(x, trajectory.affine).log()
    torch.testing.assert_close(found, -change, atol=1e-3, rtol=0)
    loss = trajectory.loss(x, trajectory.affine, Z0, Z0)
    of_matches = replace(matches, confidence=weight * matches.confidence)
    given = state.Given(trajectory.affine, trajectory.affine, Z0, Z0, of_matches, points, hidden)
    expected = trajectory.objective(x, given)
    torch.testing.assert_close(loss.total, expected.total)


@pytest.mark.parametrize(
    ("matched", "points", "knobs"),
    [
        (True, False, {}),
        (False, True, {}),
        (True, True, {"reject_reflections": False}),
        (True, True, {"correct": False, "crisp": False, "z_test": False}),
        (False, True, {"weights": {"points": 1.0}, "correct": False}),
    ],
)
def test_what_is_not_asked_for_is_not_found(matched, points, knobs):
    config = CONFIG.changed(**knobs)
    given = [evidence_of(image, points, matched) for image in range(3)]
    if not points:
        config = config.changed(search="one-number", g_s_range=(1.0, 9.0), g_s_candidates=3)
    trajectory = run(config=config, evidence=given)
    assert (trajectory.reflection_weight is not None) == matched
    if not config.reject_reflections:
        assert (trajectory.reflection_weight == 1).all()
    assert (trajectory.error is not None) == (config.correct or config.crisp)
    compared = config.z_test and "photometric" in config.weights
    assert (trajectory.hidden is not None) == compared
    x = trajectory.x
    assert (trajectory.corrected(x) is x) == (trajectory.error is None)
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
    assert trajectory.error is None and trajectory.reflection_weight is None
    assert trajectory.rank_correlation.shape == (4,) and trajectory.rank_correlation.isnan().all()
    assert trajectory.corrected(trajectory.x) is trajectory.x


def test_matches_are_judged_at_the_first_estimate_alone():
    trajectory = prepared(True, True)
    before = {name: getattr(trajectory, name) for name in ("error", "reflection_weight", "rank_correlation")}
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
    for (part, evidence, current, valid), rows in zip(asked, ([0], [1, 2], [3]), strict=True):
        assert torch.equal(part, x[rows]) and torch.equal(valid, maps.valid[rows[:1]])
        own = given[IMAGE_OF_SAMPLE[rows[0]]].within(maps.valid[rows[0]])
        assert torch.equal(evidence.matches.confidence, own.matches.confidence)
        assert torch.equal(current.near_m, maps.depth_range.near_m[rows])
    start = trajectory.affine
    moved = replace(start, s_hat=start.s_hat + 0.2, t_hat=start.t_hat - 0.1)
    trajectory.affine = moved
    asked.clear()
    trajectory.find_scale(x)
    expected = trajectory.metric.range_of(moved)
    for (_, _, current, _), rows in zip(asked, ([0], [1, 2], [3]), strict=True):
        assert torch.equal(current.near_m, expected[0][rows]) and torch.equal(
            current.far_m, expected[1][rows]
        )
        assert current.on_edge.tolist() == [[True], [True, False], [True]][IMAGE_OF_SAMPLE[rows[0]]]
    # The pull of the loss is to the newest result of the search.
    loss = trajectory.loss(x, moved, Z0, Z0)
    pull = (moved.s_hat - trajectory.affine.s_hat) ** 2 + (moved.t_hat - trajectory.affine.t_hat) ** 2
    torch.testing.assert_close(loss.terms["prior_pull"], pull)
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
    pulled = trajectory.loss(trajectory.x, moved, Z0, Z0).terms["prior_pull"]
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
        for name in ("reflection_weight", "error", "rank_correlation", "on_edge", "prior_depth_m"):
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
    views = chunk_views(given)
    assert len(views.views) == 2 and views.size == GRID
    for b, evidence in enumerate(given):
        assert torch.equal(views.left_01[b], evidence.grid.left_01)
        assert torch.equal(views.K_left[b], evidence.grid.K_left)
        for v, view in enumerate(views.views):
            own = evidence.grid.views[v if v < len(evidence.grid.views) else 0]
            height = max(e.grid.views[min(v, len(e.grid.views) - 1)].image_01.shape[1] for e in given)
            width = max(e.grid.views[min(v, len(e.grid.views) - 1)].image_01.shape[2] for e in given)
            image, K = resize_image(own.image_01, own.K, (height, width))
            assert torch.equal(view.image_01[b], image) and torch.equal(view.K[b], K)
            assert torch.equal(view.T_right_from_left[b], own.T_right_from_left)


@pytest.mark.parametrize(("rule", "factor"), [("plain", 1), ("summed", GRID[0] * GRID[1])])
def test_step_sizes_are_those_of_the_latent_and_of_scale_and_shift(rule, factor):
    config = CONFIG.changed(rule=rule, step_affine=0.25)
    trajectory = Trajectory(config, [evidence_of(0)], [0], maps_of([0])[1], 0.03)
    one = torch.ones(1, 4, 2, 2)
    torch.testing.assert_close(trajectory.latent_rule.step(one, one), -0.03 * factor * one)
    for affine_rule in (trajectory.scale_rule, trajectory.shift_rule):
        assert affine_rule.step(torch.ones(1)).item() == pytest.approx(-0.25)
    assert trajectory.scale_rule is not trajectory.shift_rule


def test_what_is_not_finite_is_named_with_its_step():
    trajectory = prepared(True, True)
    trajectory.watch = type(trajectory.watch)()
    trajectory.step = StepTime(2, 499.0)
    trajectory.note("the latent", torch.tensor([1.0, torch.inf]))
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
