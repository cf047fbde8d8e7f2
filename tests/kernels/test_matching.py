"""Kernels of the matching equal their references, and a walk along every path in NumPy."""

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.matching import aggregate, match_volume, sweep_planes
from geodiff_plugin.matching.aggregation import jump_penalties
from geodiff_plugin.matching.census import COST_LEVELS, grey
from geodiff_plugin.matching.constants import NEVER
from geodiff_plugin.matching.winner import winner, winner_positions
from geodiff_plugin.result.confidence import reprojection
from tests.kernels.drawn import drawn
from tests.tiny import render_plane
from tests.views import posed_of

SIZES = st.tuples(*(st.integers(1, most) for most in (37, 9, 11)))
FOUR, EIGHT = [(1, 0), (0, 1)], [(1, 0), (0, 1), (1, 1), (1, -1)]


@pytest.fixture(autouse=True)
def large_blocks(device, monkeypatch):
    """The interpreter runs one block after the other, and takes hardly longer for a larger one."""
    from geodiff_plugin.matching.kernels import consistency, sweep

    if device.type == "cpu":
        for module in (consistency, sweep):
            monkeypatch.setattr(module, "COST_BLOCK", (128, 16))


def random_volume(size: tuple[int, int, int], seed: int, device: torch.device):
    """Costs, where they are seen, and a grey image."""
    generator = torch.Generator().manual_seed(seed)
    levels = torch.randint(0, COST_LEVELS + 1, size, generator=generator).byte()
    in_view = torch.rand(size, generator=generator) > 0.2
    grey = torch.rand(size[1:], generator=generator).square()
    return levels.to(device), in_view.to(device), grey.to(device)


def walked(levels: np.ndarray, penalties: np.ndarray, step: int, axes) -> np.ndarray:
    """Sums over all paths, pixel by pixel; a penalty stands at the later pixel of the way forward."""
    total = np.zeros(levels.shape, int)
    _, height, width = levels.shape
    for penalty, (down, across) in zip(penalties, axes, strict=True):
        for way in (1, -1):
            path = np.zeros(levels.shape, int)
            columns = range(width) if way * across >= 0 else range(width - 1, -1, -1)
            rows = range(height) if way * down >= 0 else range(height - 1, -1, -1)
            for y in rows:
                for x in columns:
                    path[:, y, x] = levels[:, y, x]
                    v, u = y - way * down, x - way * across
                    if 0 <= v < height and 0 <= u < width:
                        before, at = path[:, v, u], (y, x) if way > 0 else (v, u)
                        sides = np.pad(before, 1, constant_values=10**6) + step
                        jump = np.full_like(before, before.min() + penalty[at])
                        path[:, y, x] += (
                            np.minimum.reduce([before, sides[2:], sides[:-2], jump]) - before.min()
                        )
            total += path
    return total


@drawn(5)
@given(SIZES, st.integers(0, 99))
@example((37, 9, 11), 0)
@example((600, 3, 4), 1)  # more planes than the registers of a warp hold
def test_aggregation_equals_its_reference(device, size, seed):
    levels, _, grey = random_volume(size, seed, device)
    with without_kernels():
        expected = aggregate(levels, grey)
    assert torch.equal(aggregate(levels, grey).short(), expected)


@pytest.mark.parametrize("axes", [FOUR, EIGHT, EIGHT[2:], EIGHT[3:]])
@pytest.mark.parametrize("size", [(5, 6, 9), (33, 9, 4), (1, 3, 3), (6, 1, 5), (6, 5, 1)])
def test_paths_in_any_direction(device, axes, size):
    from geodiff_plugin.matching.kernels.aggregation import jump_penalties, sum_paths

    levels, _, grey = random_volume(size, 1, device)
    penalties = jump_penalties(grey, axes)
    found = sum_paths(levels.mT.contiguous().mT, penalties, 34, axes)
    expected = walked(levels.cpu().numpy().astype(int), penalties.cpu().numpy().astype(int), 34, axes)
    np.testing.assert_array_equal(found.cpu().numpy(), expected)


@drawn(5)
@given(SIZES, st.integers(0, 99))
@example((1, 9, 11), 0)
@example((1, 40, 31), 1)
def test_penalties_equal_their_reference(device, size, seed):
    from geodiff_plugin.matching.kernels import aggregation as kernels

    _, _, grey = random_volume(size, seed, device)
    assert torch.equal(kernels.jump_penalties(grey, EIGHT), jump_penalties(grey, EIGHT))
    masked = torch.where(grey > 0.5, grey, torch.nan)
    assert torch.equal(kernels.jump_penalties(masked, EIGHT), jump_penalties(masked, EIGHT))
    by_rows, rows = kernels.jump_penalties(grey[::2], FOUR), grey[::2].contiguous()
    assert torch.equal(by_rows, kernels.jump_penalties(rows, FOUR))


@drawn(5)
@given(SIZES, st.integers(0, 99))
@example((37, 9, 11), 0)
@example((600, 3, 4), 1)
def test_the_winner_equals_its_reference(device, size, seed):
    levels, in_view, grey = random_volume(size, seed, device)
    total = aggregate(levels, grey)
    total[:, ::3] = total[:1, ::3]  # ties: the first plane wins
    found, position = winner(total, levels, in_view), winner_positions(total)
    with without_kernels():
        expected = winner(total.short(), levels, in_view)
        expected_position = winner_positions(total.short())
    for name in ("position", "best", "second_best"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    for name in ("gain", "sharpness"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-7)
    assert torch.equal(position, expected_position)


#: Metres of the right camera's place, and its turn to the side in radians.
POSES = {
    "rectified": ((0.12, 0.0, 0.0), 0.0),
    "a little out of the row": ((0.12, 0.01, 0.0), 0.0),
    "turned": ((0.15, 0.05, 0.04), 0.12),
    "ahead": ((0.05, 0.0, 0.3), 0.0),
}


def views_of(names, size: tuple[int, int], device: torch.device) -> PosedViews:
    """A rendered left view and its right views under these poses, all grey."""
    height, width = size
    K = np.array([[1.1 * width, 0, 0.49 * width], [0, 1.12 * width, 0.48 * height], [0, 0, 1]])
    surface = size, np.array([0.25, -0.35, 1.0]), 2.0, 0
    views, left = [], render_plane(K, np.eye(4), *surface)[0]
    for place, turn in (POSES[name] for name in names):
        E = np.eye(4)
        E[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
        E[:3, 3] = place
        views.append((as_grey(render_plane(K, E, *surface)[0], device), K, np.linalg.inv(E)))
    return posed_of(as_grey(left, device), K, *views)


def as_grey(image: np.ndarray, device: torch.device) -> torch.Tensor:
    return grey(torch.from_numpy(image).permute(2, 0, 1).float().to(device) / 255.0)


VIEWS = [(name,) for name in POSES] + [("rectified", "turned"), ("turned", "a little out of the row")]


@pytest.mark.parametrize("names", VIEWS)
@pytest.mark.parametrize(("size", "count"), [((15, 21), 35), ((9, 14), 7)])
def test_a_sweep_equals_its_reference(device, names, size, count):
    posed = views_of(names, size, device)
    planes = torch.linspace(0.0, 1.1, count)
    found = sweep_planes(posed, planes)
    with without_kernels():
        expected = sweep_planes(posed, planes)
    assert torch.equal(found.in_view, expected.in_view)
    assert torch.equal(found.levels, expected.levels)
    assert 0 < found.in_view.float().mean() < 1


def test_a_large_canvas_is_interpolated_in_parts(device, monkeypatch):
    from geodiff_plugin.matching.kernels import sweep as kernels

    posed = views_of(("turned",), (9, 14), device)
    whole = sweep_planes(posed, torch.linspace(0.0, 1.1, 40))
    monkeypatch.setattr(kernels, "_SAMPLES_AT_ONCE", 3 * 15 * whole.aligned[0].size[1])
    parts = sweep_planes(posed, torch.linspace(0.0, 1.1, 40))
    assert torch.equal(parts.levels, whole.levels)


@pytest.mark.parametrize("names", [("rectified",), ("rectified", "turned")])
def test_matches_equal_their_reference(device, names):
    posed = views_of(names, (11, 16), device)
    planes = torch.linspace(0.0, 1.1, 7)
    found = match_volume(sweep_planes(posed, planes))
    with without_kernels():
        expected = match_volume(sweep_planes(posed, planes))
    torch.testing.assert_close(found.inverse_depth, expected.inverse_depth, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(found.confidence, expected.confidence, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.deviation, expected.deviation, rtol=1e-5, atol=1e-5)
    assert expected.confidence.max() > 0


def test_few_planes_have_no_runner_up(device):
    levels, in_view, grey = random_volume((3, 4, 5), 2, device)
    levels[1] = 0
    assert (winner(aggregate(levels, grey), levels, in_view).second_best == NEVER).all()


def with_holes(posed: PosedViews, seed: int, right_only: bool = False) -> PosedViews:
    """Views whose left and right pixels are invalid in blocks and in a border."""
    generator = torch.Generator().manual_seed(seed)

    def masked(view):
        height, width = view.size
        blocks = torch.rand(-(-height // 3), -(-width // 3), generator=generator) > 0.2
        valid = blocks.repeat_interleave(3, 0).repeat_interleave(3, 1)[:height, :width].contiguous()
        valid[:, :2] = False
        return view._replace(valid=valid.to(view.image_01.device))

    left = posed.left if right_only else masked(posed.left)
    return PosedViews(left, tuple(masked(view) for view in posed.rights))


@pytest.mark.parametrize(("names", "right_only"), [(("rectified",), True), (("rectified", "turned"), False)])
def test_a_sweep_and_matches_of_masked_views_equal_their_reference(device, names, right_only):
    plain = views_of(names, (11, 16), device)
    posed, planes = with_holes(plain, 2, right_only), torch.linspace(0.0, 1.1, 7)
    found = sweep_planes(posed, planes)
    with without_kernels():
        expected, unmasked = sweep_planes(posed, planes), sweep_planes(plain, planes)
    assert torch.equal(found.in_view, expected.in_view) and torch.equal(found.levels, expected.levels)
    assert found.in_view.sum() < unmasked.in_view.sum()
    assert posed.left.valid is None or not found.in_view[:, ~posed.left.valid].any()
    matches = match_volume(found)
    with without_kernels():
        reference = match_volume(expected)
    torch.testing.assert_close(matches.inverse_depth, reference.inverse_depth, rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(matches.confidence, reference.confidence, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(matches.deviation, reference.deviation, rtol=1e-5, atol=1e-5)


def test_the_reprojection_of_masked_views_equals_its_reference(device):
    posed = with_holes(views_of(("rectified", "turned"), (20, 28), device), 3)
    left, *rights = (
        view._replace(image_01=view.image_01.expand(3, -1, -1).contiguous())
        for view in (posed.left, *posed.rights)
    )
    depth_m = 2.0 + 0.3 * torch.rand(1, 1, *left.size, generator=torch.Generator().manual_seed(0))
    visible, error = reprojection(rights, depth_m.to(device), left)
    with without_kernels():
        expected_visible, expected_error = reprojection(rights, depth_m.to(device), left)
    assert (visible != expected_visible).float().mean() <= 4e-3 and not visible[0, 0, ~left.valid].any()
    both = visible & expected_visible
    assert both.any() and ((error - expected_error).abs()[both] > 1e-3).float().mean() <= 1e-2
