"""Parts of the guided call: schedule, gradient rules, least-squares fields, correction, last stage."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from geodiff_plugin.algorithm import correction, edges
from geodiff_plugin.algorithm.correction import correction_target, fit_depth, off_edges
from geodiff_plugin.algorithm.depth_range import search_one_number
from geodiff_plugin.algorithm.edges import sharpen_edges
from geodiff_plugin.algorithm.gradients import RULES, Adam, FiniteWatch, power_above, pull_back
from geodiff_plugin.algorithm.schedule import count_steps, make_schedule
from geodiff_plugin.algorithm.solver import FieldSystem, RobustField, solve_field
from geodiff_plugin.algorithm.terms import Given, Loss
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.prepare import rows_in_background
from geodiff_plugin.geometry import image_size
from geodiff_plugin.matching import Matches, known_share, rows
from geodiff_plugin.matching.rows import (
    hidden_strips,
    match_rows,
    rectified_pictures,
    row_pictures,
    with_hidden,
)
from geodiff_plugin.result import voting
from geodiff_plugin.result.misfit import MATCH_NOISE_PX, expected_error
from geodiff_plugin.result.voting import vote_depth
from geodiff_plugin.types import CameraView, PosedViews


def schedule(steps, config=DEFAULT, **options):
    return make_schedule(config, config.plan_updates(points_given=False), steps, **options)


@pytest.mark.parametrize(
    ("steps", "corrections", "knobs", "corrected"),
    [
        (10, 2, {}, [5, 9]),
        (9, 3, {}, [4, 6, 8]),
        (9, 1, {}, [8]),
        (1, 4, {}, [0]),
        (8, 2, {"start": 0.25, "stop": 0.75}, [4, 5]),
        (4, 3, {}, [1, 2, 3]),  # more than fit the second half reach further back
        (4, 9, {}, [0, 1, 2, 3]),
    ],
)
def test_corrections_are_spread_over_the_second_half_of_what_is_active(steps, corrections, knobs, corrected):
    found = schedule(steps, DEFAULT.changed(corrections=corrections, **knobs)).steps
    assert [i for i, rounds in enumerate(found) if any(r.corrects for r in rounds)] == corrected


def test_more_steps_than_a_prior_has_are_refused():
    with pytest.raises(ValueError, match="num_inference_steps must be at most 1 with this prior; got 4"):
        count_steps(4, 4, 1)


class OneNumber:
    """A loss that is least at one of the candidates for g_s, each of which shows a share of the image."""

    config = DEFAULT.changed(g_s_range=(0.5, 5.0), g_s_candidates=10, min_visible=0.2)

    def __init__(self, best: int, unseen: tuple[int, ...] = ()) -> None:
        self.candidates = torch.linspace(0.5, 5.0, 10)
        self.best, self.unseen = self.candidates[best], self.candidates[list(unseen)]

    def __call__(self, x: Tensor, given: Given) -> Loss:
        g_s = given.affine.g_s
        share = torch.where(torch.isin(g_s, self.unseen), 0.19, 0.9)
        return Loss(g_s, {"photometric": (g_s - self.best).abs()}, share)


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


@pytest.mark.parametrize("name", RULES)
def test_a_rule_goes_downhill_sample_by_sample_and_a_zero_gradient_moves_nothing(name):
    gradient, reference = torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2)
    together, alone = RULES[name](0.1), RULES[name](0.1)
    for _ in range(3):
        a, b = together.step(gradient, reference), alone.step(gradient[1:2], reference[1:2])
    torch.testing.assert_close(a[1:2], b)
    assert ((a * gradient).flatten(1).sum(1) < 0).all()
    assert RULES[name](0.1).step(torch.zeros_like(gradient), reference).abs().max() == 0
    step = RULES[name](0.1).step(torch.tensor([1.0, -2.0]))  # scalars per sample
    assert step.shape == (2,) and step[0] < 0 < step[1]


@pytest.mark.parametrize("sizes", [(1e-12, 1e-12), (1.0, 1.0), (1e-9, 1e9)])
def test_a_gradient_of_any_size_passes_float16_and_comes_out_at_its_own(sizes):
    z = torch.randn(2, 4, 3, 3, requires_grad=True)
    gradient = torch.randn(2, 4, 3, 3) * torch.tensor(sizes).view(2, 1, 1, 1)
    pulled = pull_back((z.half() * 3.0).float(), z, gradient)
    torch.testing.assert_close(pulled / gradient, torch.full_like(pulled, 3.0), rtol=0.02, atol=0.0)


def test_the_first_that_is_not_finite_is_named_with_its_step_and_the_cure():
    watch = FiniteWatch()
    watch.note("the decoded map", 0, torch.ones(3))
    watch.check(SimpleNamespace(dtype=torch.float16))
    watch.note("the encoded correction", 1, torch.tensor([1.0, torch.nan]))
    watch.note("the decoded map", 1, torch.tensor([torch.inf]))
    with pytest.raises(ValueError, match=r"encoded correction of denoising step 2 .* float16.*bfloat16"):
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
    expected = torch.linalg.solve(torch.stack(columns, 1), system.pull.flatten())
    torch.testing.assert_close(solve_field(system, 40).flatten(), expected, atol=2e-4, rtol=1e-3)


@pytest.mark.parametrize(("size", "link"), [((60, 83), 1.0), ((240, 331), 400.0), ((481, 640), 400.0)])
def test_few_steps_are_enough_at_any_size(size, link):
    system = _system(*size, link)
    found = solve_field(system, 12)
    residual = system.pull - applied(system, found)
    assert float(residual.norm() / system.pull.norm()) < 0.02


SIZE = (40, 60)
WEAK, STRONG = (torch.full((1, 1, 1, 1), error) for error in (0.3, 0.02))


def matches_at(depth_m: torch.Tensor, confidence: torch.Tensor) -> Matches:
    return Matches(1.0 / depth_m, confidence, torch.full((len(depth_m),), 1e-3))


def grey(value: float = 0.5) -> torch.Tensor:
    return torch.full((1, 3, *SIZE), value)


def test_a_correction_spreads_over_its_surface_and_stops_at_an_edge():
    left, truth = grey(0.2), torch.full((1, 1, *SIZE), 2.0)
    left[..., 30:] = 0.9  # another surface, of which nothing is known
    confidence = torch.zeros_like(truth)
    confidence[..., :, 5:10] = 1.0
    error = torch.full((1, 1, 1, 1), 0.1)
    depth_m, support, _ = fit_depth(1.2 * truth, matches_at(truth, confidence), left, error)
    own, other = depth_m[..., 10:14], depth_m[..., 31:]
    assert (own / 2.0 - 1.0).abs().max() < 0.09
    assert (other / 2.4 - 1.0).abs().max() < 0.09  # half of what the surface beside it moved by
    assert support[..., 10:14].min() > 0.3 and support[..., 31:].max() < 0.1


def test_a_correction_on_a_finer_grid_reaches_a_coarser_map_as_its_mean(monkeypatch):
    """Every third column of the matches' grid is corrected; the map has a third of its columns and rows."""
    columns = torch.zeros(1, 1, 36, 45)
    columns[..., 1::3] = 0.3
    monkeypatch.setattr(correction, "solve_robust", lambda *_, **__: RobustField(columns, columns, columns))
    depth, left = torch.full((1, 1, 12, 15), 2.0), torch.rand(1, 3, 36, 45)
    matches = matches_at(torch.full((1, 1, 36, 45), 2.0), torch.ones(1, 1, 36, 45))
    refined, support, change = fit_depth(depth, matches, left, STRONG)
    inner = (..., slice(1, -1), slice(1, -1))
    torch.testing.assert_close(refined[inner], torch.full_like(refined[inner], 2.0 * math.exp(-0.1)))
    torch.testing.assert_close(support[inner], torch.full_like(support[inner], 0.1))
    assert change is columns


def test_beside_an_edge_of_a_good_map_a_match_counts_for_less_and_a_point_does_not():
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
    beside = correction_target(target, points, kept, STRONG, depth).confidence[0, 0]
    assert beside[6, 29] == kept.numel() and beside[5, 29] < 0.3
    # No match counts before the first estimate.
    assert correction_target(target, None, None, None, depth) is None
    assert int((correction_target(target, points, None, WEAK, depth).confidence > 0).sum()) == 1


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
    truth = F.interpolate(box(), scale_factor=spacing, mode="nearest")
    soft = 1.0 / F.interpolate(1.0 / blurred(box()), scale_factor=spacing, mode="bilinear")
    picture = (0.2 + contrast * (truth < 4.0)).float().expand(-1, 3, -1, -1)
    sharp = sharpen_edges(soft, picture, spacing)
    assert between(soft) > 0.05 and between(sharp) < 0.25 * between(soft)
    error, before = ((each / truth - 1.0).abs().mean() for each in (sharp, soft))
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
    monkeypatch.setattr("geodiff_plugin._strips.STRIP_PIXELS", 5 * 64)
    monkeypatch.setattr(edges, "STRIP", 7)
    assert torch.equal(sharpen_edges(soft, left, 2), whole)


#: Cameras of ``scene``: a shift of 9 px at 2 m, of 3 px at 6 m.
CAMERA = torch.tensor([[90.0, 0.0, 47.5], [0.0, 90.0, 35.5], [0.0, 0.0, 1.0]])
BASELINE_M = 0.2


def scene(side: int = 1, doffs: float = 0.0) -> tuple[Tensor, Tensor, CameraView]:
    """Depth ``(1, 1, 72, 96)``, left image and a view to its right (``side`` 1) or left of a textured box."""
    truth = box(72, 96)
    generator = torch.Generator().manual_seed(5)
    wall, front = (0.1 * torch.rand(1, 3, 72, 160, generator=generator) + low for low in (0.1, 0.6))

    def seen(shift_near: int, shift_far: int) -> Tensor:
        columns = torch.arange(96) + 32
        inside = torch.roll(truth, -shift_near, -1) < 4.0
        return torch.where(inside, front[..., columns + shift_near], wall[..., columns + shift_far])

    T = torch.eye(4)
    T[0, 3] = -side * BASELINE_M
    K_right = CAMERA.clone()
    K_right[0, 2] -= doffs
    moved = [round(side * shift + doffs) for shift in (9, 3)]
    return truth, seen(0, 0), CameraView(seen(*moved)[0], K_right, T)


def voted(map_m: Tensor, left: Tensor, views, matched_m: Tensor, confidence: float, error=0.4, *spacing):
    target = Matches(1.0 / matched_m, torch.full_like(matched_m, confidence), torch.full((1,), 2e-3))
    native = PosedViews(left[0], tuple(views), CAMERA)
    evidence = Evidence(
        native, native, None, target, rows=rows_in_background(rectified_pictures(native), target, None)
    )
    return vote_depth(map_m, evidence, target, known_share(target), torch.full((1, 1, 1, 1), error), *spacing)


@pytest.mark.parametrize(("side", "doffs"), [(1, 0.0), (-1, 0.0), (1, 4.0), (-1, 4.0)])
def test_rows_are_matched_whatever_side_and_principal_point_the_view_has(side, doffs):
    truth, left, view = scene(side, doffs)
    found = match_rows(row_pictures(left[0], view, CAMERA), 9.0)
    seen, gaps = found.matched > 0, found.filled > 0
    right = (found.shift - 18.0 / truth[0, 0]).abs()[seen] < 0.5
    assert seen.float().mean() > 0.6 and right.float().mean() > 0.9
    assert gaps.any() and not (gaps & seen).any()


@pytest.mark.parametrize("side", [1, -1])
def test_the_strip_beside_a_near_surface_gets_the_depth_behind_it(side):
    truth, left, view = scene(side)
    rows = match_rows(row_pictures(left[0], view, CAMERA), 9.0)
    assert (rows.hidden > 0).any() and not (rows.hidden * (rows.matched + rows.filled)).any()
    sure = (rows.matched * (18.0 / truth[0, 0] - rows.shift).abs().lt(0.5)).view_as(truth)
    matches = Matches(1.0 / truth, 0.9 * sure, torch.tensor([2e-3]))
    found = with_hidden(matches, hidden_strips(rows, matches.size, float(CAMERA[0, 0])))
    put = found.confidence != matches.confidence
    assert put.any() and bool((put == ((rows.hidden > 0) & (sure == 0))).all())
    right = (found.inverse_depth * truth - 1.0).abs()[put] < 0.1
    assert right.float().mean() > 0.8
    kept = ~put
    assert torch.equal(found.inverse_depth[kept], matches.inverse_depth[kept])


def test_a_map_of_another_size_takes_its_edges_from_the_same_rows():
    truth, left, view = scene()
    found = match_rows(row_pictures(left[0], view, CAMERA), 9.0)
    for factor in (0.5, 2.0):
        small_m = F.interpolate(truth, scale_factor=factor, mode="nearest-exact")
        resized = voting._rows_on(image_size(small_m), found)
        assert resized.matched.mean() == pytest.approx(float(found.matched.mean()), abs=0.02)
        off = (resized.shift - factor * 18.0 / small_m[0, 0]).abs()[resized.matched > 0]
        assert (off < 0.5 * factor).float().mean() > 0.9
        moved = torch.roll(small_m, round(-4 * factor), 3)
        wrong, mended = (
            float(((depth_m / small_m - 1.0).abs() > 0.1).float().mean())
            for depth_m in (moved, voted(moved, left, [view], truth, 0.95))
        )
        assert mended < 0.6 * wrong


def test_a_weak_map_takes_its_edges_from_the_views_and_their_colours(monkeypatch):
    truth, left, view = scene()
    moved = torch.roll(truth, (3, -4), (2, 3))

    def wrong(depth_m: Tensor) -> float:
        """Share of the pixels that both views see that are off by more than 10 %."""
        return float(((depth_m / truth - 1.0).abs() > 0.1)[..., 12:-12].float().mean())

    assert wrong(moved) > 0.05
    assert wrong(voted(moved, left, [view], truth, 0.0)) < 0.4 * wrong(moved)
    assert wrong(voted(moved, left, [view], truth, 0.95)) < 0.12 * wrong(moved)
    turned = view._replace(T_right_from_left=view.T_right_from_left.roll(1, 0))
    for views in ([], [turned], [view._replace(image_01=view.image_01[..., 1:])]):  # none is rectified
        assert voted(moved, left, views, truth, 0.95) is moved
    monkeypatch.setattr(voting, "STRIP", 700)
    monkeypatch.setattr(rows, "MOST_PIXELS", 36 * 48)
    large = voted(truth, left, [view], truth, 0.95)  # which takes its edges from its colours
    assert ((large < 3.5) != (truth < 3.5))[..., 12:-12].float().mean() < 0.02


def test_a_good_map_keeps_its_edges_only_if_they_are_crisp():
    truth, left, view = scene()
    crisp = torch.roll(truth, 4, 3)
    soft = F.avg_pool2d(F.pad(crisp, (3,) * 4, mode="replicate"), 7, 1)
    kept, followed = (voted(map_m, left, [view], truth, 0.95, error=0.02) for map_m in (crisp, soft))
    assert (kept / crisp - 1.0).abs().mean() < 1e-3
    coarse = voted(crisp, left, [view], truth, 0.95, 0.02, 4.0)
    for map_m in (followed, coarse):
        assert ((map_m / truth - 1.0).abs() > 0.1)[..., 12:-12].float().mean() < 0.01
    # A box filter of the log depth makes steps of as many pixels; a slope to the border is no step.
    assert voting._crispness(torch.linspace(0.0, 2.0, 96).exp().expand(72, 96)) == 1.0
    for pixels in (1, 2, 3, 5):
        blurred = F.avg_pool2d(F.pad(truth.log(), (pixels // 2,) * 4, mode="replicate"), pixels, 1).exp()
        share = float(voting._crispness(blurred[0, 0]))
        assert share == pytest.approx(min(1.0, 2.5 / pixels), rel=0.05)


def test_median_filter_is_opencvs_on_any_device() -> None:
    values = torch.rand(17, 23)
    assert torch.equal(voting._median_of_windows(values), voting._median_filtered(values))
