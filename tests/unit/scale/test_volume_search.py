"""The search for a range in a plane-sweep volume against brute force, on volumes with a known answer."""

import math

import numpy as np
import pytest
import torch

from geodiff_plugin import matching as m
from geodiff_plugin.scale import volume_search as v
from geodiff_plugin.scale.points import refine_to_matches
from geodiff_plugin.scale.space import DepthRange
from geodiff_plugin.scale.volume_search import search_scale
from tests.benchmarks.matching import textured_pair
from tests.unit.scale.references import TO, metres, tensor

SIZE = (24, 30)
PLANES = np.linspace(0.02, 0.9, 45)


class Volume:
    """Costs that grow with the distance from the true plane; more pixels are out of view on near planes."""

    def __init__(
        self, depth: np.ndarray, rectified: bool = False, seed: int = 0, hidden: float = 0.1
    ) -> None:
        rng = np.random.default_rng(seed)
        planes = PLANES[:, None, None]
        off = np.abs(planes - 1 / depth) / 0.15
        self.cost = np.clip(off + rng.normal(0, 0.02, (len(PLANES), *SIZE)), 0, 1).astype(np.float32)
        self.seen = rng.random(self.cost.shape) >= hidden + 0.5 * planes**2
        self.size, self.rectified, self.inverse_depth = SIZE, rectified, tensor(PLANES)
        self.reach_m = (1 / PLANES[-1], 40.0)

    def at_pixels(self, at: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rows, columns = at.numpy() // SIZE[1], at.numpy() % SIZE[1]
        return torch.from_numpy(self.cost[:, rows, columns]), torch.from_numpy(self.seen[:, rows, columns])


class Reference:
    """The search of the docstring, over groups of pixels of similar value."""

    def __init__(self, volume: Volume, x: np.ndarray, space: str, at: np.ndarray) -> None:
        rows, columns = at // SIZE[1], at % SIZE[1]
        order = np.argsort(x[rows, columns], kind="stable")
        each = int(np.ceil(len(at) / 512))
        self.groups = [order[k : k + each] for k in range(0, len(at), each)]
        self.values = np.array([x[rows, columns][group].mean() for group in self.groups])
        cost, seen = volume.cost[:, rows, columns], volume.seen[:, rows, columns]
        capped = np.minimum(cost, 0.35) * seen
        self.cost = np.stack([capped[:, group].sum(1) for group in self.groups], 1)
        self.seen = np.stack([seen[:, group].sum(1) for group in self.groups], 1)
        self.size = np.array([len(group) for group in self.groups])
        self.space, self.least, self.pixels = space, 0.6 if volume.rectified else 0.25, len(at)

    def mean_cost(self, near, far) -> np.ndarray:
        """Of as many pairs as there are."""
        near, far = (np.atleast_1d(end)[:, None] for end in (near, far))
        place = (1 / metres(self.values, near, far, self.space) - PLANES[0]) / (PLANES[1] - PLANES[0])
        inside = (place >= -1e-9) & (place <= len(PLANES) - 1 + 1e-9)
        below = np.clip(np.floor(place), 0, len(PLANES) - 2).astype(int)
        weight, k = np.clip(place - below, 0, 1), np.arange(len(self.values))
        cost, seen = (
            (1 - weight) * each[below, k] + weight * each[below + 1, k] for each in (self.cost, self.seen)
        )
        total = np.where(inside, cost, 0.35 * self.size).sum(1)
        count = np.where(inside, seen, self.size).sum(1)
        return total / np.maximum(count, 1) + (count / self.pixels < self.least)

    def best(self, low: float, high: float) -> tuple[float, float, float]:
        grid = np.geomspace(low, high, 48)
        pairs = np.array([(a, b) for i, a in enumerate(grid) for b in grid[i + 1 :]])
        radius = np.log(high / low) / 47
        for _ in range(3):
            costs = self.mean_cost(*pairs.T)
            near, far = pairs[costs.argmin()]
            shift = np.exp(radius * np.linspace(-1, 1, 13))
            pairs = np.array([np.sort(np.clip([near * a, far * b], low, high)) for a in shift for b in shift])
            radius /= 6
        return costs.min(), near, far


def every_pixel() -> np.ndarray:
    return np.arange(SIZE[0] * SIZE[1])


def scene(space: str, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A relative map, and the depth that it has between 1.8 and 11 m."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    x = 0.5 + 0.3 * np.sin(rows / 6 + seed) + 0.2 * np.cos(columns / 9)
    return x, metres(x, 1.8, 11.0, space)


@pytest.mark.parametrize(
    ("space", "rectified"), list(zip(TO, [False, True, False, True, False], strict=True))
)
def test_the_best_range_is_that_of_brute_force(space, rectified):
    x, depth = scene(space)
    maps = np.stack([x, 0.3 + 0.5 * x, 1 - x])
    volume = Volume(depth, rectified)
    found = v.search_scale(volume, tensor(maps)[:, None], space)
    for b in range(3):
        reference = Reference(volume, maps[b], space, every_pixel())
        cost, near, far = reference.best(*volume.reach_m)
        ends = float(found.near_m[b]), float(found.far_m[b])
        assert reference.mean_cost(*ends)[0] == pytest.approx(cost, abs=2e-5)
        if b < 2:
            np.testing.assert_allclose(ends, (near, far), rtol=5e-3)
    np.testing.assert_allclose([found.near_m[0], found.far_m[0]], [1.8, 11.0], rtol=0.08)


def test_pairs_that_keep_too_few_pixels_in_view_lose_unless_all_do():
    """A posed pair may lose three quarters of its pixels, a rectified one two fifths."""
    x, depth = scene("depth")
    for rectified, hidden, usual in (
        (True, 0.3, True),
        (True, 0.5, False),
        (False, 0.5, True),
        (False, 0.65, True),
        (False, 0.9, False),
    ):
        volume = Volume(depth, rectified, hidden=0)
        volume.seen[:] = np.random.default_rng(0).random(volume.seen.shape) >= hidden
        volume.seen[:4] = True  # far away everything is in view, at a high cost
        volume.cost[:4] = 0.3
        near, far, _ = v.search_scale(volume, tensor(x)[None, None], "depth")
        right = abs(float(near) / 1.8 - 1) < 0.25 and abs(float(far) / 11 - 1) < 0.25
        assert right == usual, (rectified, hidden)


@pytest.mark.parametrize(("more", "stays"), [(1.5e-3, True), (2.5e-3, False)])
def test_a_range_in_use_stays_unless_another_is_better_by_a_margin(more, stays):
    """Of two maps the second is in use near its best range. Its ends may come in either order."""
    x, depth = scene("disparity")
    maps, volume = np.stack([x, 0.2 + 0.6 * x]), Volume(depth)
    best = v.search_scale(volume, tensor(maps)[:, None], "disparity")
    reference = Reference(volume, maps[0], "disparity", every_pixel())
    near, far = float(best.near_m[0]), float(best.far_m[0])
    farther = far * np.linspace(1, 3, 2001)
    costs = reference.mean_cost(np.full(2001, near), farther)
    farther = farther[np.argmax(costs > costs[0] + more)]
    second = tensor([1.0005 * best.near_m[1], 1.0005 * best.far_m[1]])
    current = DepthRange(tensor([near, second[1]]), tensor([farther, second[0]]), torch.tensor([True, True]))
    found = v.search_scale(volume, tensor(maps)[:, None], "disparity", current=current)
    assert found.far_m[0].item() == pytest.approx(farther if stays else far, rel=1e-5)
    np.testing.assert_allclose([found.near_m[1], found.far_m[1]], second, rtol=1e-5)


@pytest.mark.parametrize(
    ("bounds", "edge"),
    [
        (None, False),
        ((1.0, 20.0), False),
        ((1.0, 8.0), True),
        ((2.6, 20.0), True),
        ((1.0, 11.1), True),
        ((1.775, 20.0), True),
    ],
)
def test_ranges_on_the_edge_of_the_bounds_are_reported_for_each_map(bounds, edge):
    """The second map ends at half of its range, so that its far end would be at 67 m."""
    x, depth = scene("log")
    volume, maps = Volume(depth), np.stack([x, 0.5 * x])
    found = v.search_scale(volume, tensor(maps)[:, None], "log", depth_range=bounds)
    assert found.on_edge.tolist() == [edge, True]
    low, high = bounds or volume.reach_m
    assert (found.near_m >= low * 0.999).all() and (found.far_m <= high * 1.001).all()
    if bounds is None:  # the near end of a volume cuts nothing off, its far end does
        close = Volume(np.full(SIZE, 1 / PLANES[-1]))
        assert not v.search_scale(close, tensor(maps)[:1, None], "log").on_edge.any()
        away = Volume(np.full(SIZE, 45.0))
        assert v.search_scale(away, tensor(maps)[:1, None], "log").on_edge.all()


def test_pixels_that_are_not_counted_have_no_effect():
    """Half of the map is nonsense. The mask is on a grid of its own, twice as fine."""
    x, depth = scene("depth")
    wrong = x.copy()
    wrong[:, 15:] = np.random.default_rng(0).random((24, 15)) * 0.3
    valid = torch.zeros(1, 1, 48, 60, dtype=torch.bool)
    valid[..., :30] = True
    volume = Volume(depth)
    found = v.search_scale(volume, tensor(wrong)[None, None], "depth", valid=valid)
    kept = every_pixel()[every_pixel() % 30 < 15]
    _, near, far = Reference(volume, wrong, "depth", kept).best(*volume.reach_m)
    np.testing.assert_allclose([found.near_m[0], found.far_m[0]], [near, far], rtol=5e-3)
    none = v.search_scale(volume, tensor(wrong)[None, None], "depth", valid=torch.zeros_like(valid))
    everything = v.search_scale(volume, tensor(wrong)[None, None], "depth")
    assert none.near_m == everything.near_m and none.far_m == everything.far_m != found.far_m


@pytest.mark.parametrize(("size", "stride"), [((30, 44), 1), ((80, 75), 1), ((150, 100), 2), ((240, 320), 4)])
def test_pixels_are_sampled_evenly_from_the_middle_of_their_cells(size, stride):
    expected = [
        row * size[1] + column
        for row in range(stride // 2, size[0], stride)
        for column in range(stride // 2, size[1], stride)
    ]
    assert v._sampled(size, None, torch.zeros(1)).tolist() == expected
    assert 3500 < len(expected) < 8000 or stride == 1


def test_maps_of_another_size_are_read_at_the_pixels_of_the_volume():
    x, depth = scene("depth")
    volume = Volume(depth)
    half = x.reshape(12, 2, 15, 2).mean((1, 3))
    whole, found = (v.search_scale(volume, tensor(each)[None, None], "depth") for each in (x, half))
    np.testing.assert_allclose(
        [found.near_m[0], found.far_m[0]], [whole.near_m[0], whole.far_m[0]], rtol=0.08
    )


def test_a_depth_that_is_no_number_looks_up_the_farthest_plane():
    groups = v.Groups(
        torch.zeros(2),
        torch.tensor([3.0, 1.0]),
        torch.tensor([[3.0, 0.0], [2.0, 1.0]]),
        torch.tensor([[0.3, 0.0], [0.6, 0.2]]),
    )
    planes = torch.tensor([0.25, 0.5])
    cost, fraction = v.look_up(groups, planes, torch.tensor([[4.0, 2.0], [8.0 / 3, 8.0 / 3], [1.0, 4.0]]))
    np.testing.assert_allclose(cost, [(0.3 + 0.2) / 4, (0.45 + 0.1) / 3, 0.35 * 3 / 3], rtol=1e-6)
    np.testing.assert_allclose(fraction, [1.0, 0.75, 0.75], rtol=1e-6)
    unknown, _ = v.look_up(groups, planes, torch.tensor([[float("nan"), 2.0]]))
    assert unknown.isfinite().all()


def test_groups_hold_pixels_of_similar_value_and_the_last_may_be_smaller():
    rng, count = np.random.default_rng(0), 1300
    x, cost, seen = rng.random(count), rng.random((3, count)), rng.random((3, count)) < 0.6
    groups = v.group_pixels(tensor(x), tensor(cost), torch.from_numpy(seen))
    parts = [np.argsort(x)[k : k + 3] for k in range(0, count, 3)]
    np.testing.assert_allclose(groups.mean, [x[part].mean() for part in parts], rtol=1e-5)
    np.testing.assert_array_equal(groups.size, [len(part) for part in parts])
    np.testing.assert_array_equal(groups.seen, [[row[part].sum() for part in parts] for row in seen])
    capped = np.minimum(cost, 0.35) * seen
    np.testing.assert_allclose(
        groups.cost, [[row[part].sum() for part in parts] for row in capped], rtol=1e-5
    )
    assert groups.size[-1] == 1


#: Of every space: from depth, and back.
SPACES = {
    "depth": (lambda z: z, lambda v: v),
    "disparity": (lambda z: 1 / z, lambda v: 1 / v),
    "log": (torch.log, torch.exp),
    "log1p": (torch.log1p, torch.expm1),
    "sqrt_disparity": (lambda z: z**-0.5, lambda v: v**-2),
}
SIZE_SCALE_SEARCH = (96, 144)


def relative(depth: torch.Tensor, space: str, low: float = 0.0, high: float = 1.0) -> torch.Tensor:
    """The map a perfect prior would give: affine in its space, two quantiles at 0 and 1."""
    value = SPACES[space][0](depth)
    ends = torch.quantile(value.flatten(), torch.tensor([low, high]))
    return ((value - ends[0]) / (ends[1] - ends[0])).clamp(0, 1)[None]


def error_of(
    x: torch.Tensor, near: torch.Tensor, far: torch.Tensor, space: str, depth: torch.Tensor
) -> float:
    """Mean relative error of a map between two ends, written independently of the package."""
    forward, back = SPACES[space]
    at_zero, at_one = (far, near) if "disparity" in space else (near, far)
    value = forward(at_zero) + (forward(at_one) - forward(at_zero)) * x[0]
    return float((back(value) / depth - 1.0).abs().mean())


@pytest.fixture(scope="module")
def scene_of_scale_search():
    posed, depth = textured_pair(SIZE_SCALE_SEARCH)
    return m.build_cost_volume(posed), depth


@pytest.mark.parametrize("space", SPACES)
def test_true_relative_map_gives_the_true_metres(scene_of_scale_search, space):
    volume, depth = scene_of_scale_search
    x = relative(depth, space)
    near, far, _ = search_scale(volume, x, space)
    assert error_of(x, near, far, space, depth) < 0.03
    assert float(near) == pytest.approx(float(depth.min()), rel=0.05)


@pytest.mark.parametrize(
    ("low", "high", "on_edge"),
    [(0.5, 2.0, False), (1.3, 2.0, True), (0.5, 0.7, True), (None, None, False)],
)
def test_a_search_that_ends_at_either_edge_of_a_given_range_is_reported(
    scene_of_scale_search, low, high, on_edge
):
    """``low`` is a fraction of the nearest depth, ``high`` of the farthest."""
    volume, depth = scene_of_scale_search
    bounds = None if low is None else (low * float(depth.min()), high * float(depth.max()))
    found = search_scale(volume, relative(depth, "depth"), "depth", depth_range=bounds)
    assert found.on_edge.tolist() == [on_edge], found


@pytest.mark.parametrize("space", SPACES)
def test_refinement_finds_the_ground_truth_among_outliers(scene_of_scale_search, space):
    volume, depth = scene_of_scale_search
    x = relative(depth, space, 0.02, 0.98)
    generator = torch.Generator().manual_seed(0)
    wrong = torch.rand(depth.shape, generator=generator) < 0.1
    outlier = volume.inverse_depth[-1] * torch.rand(depth.shape, generator=generator)
    target = torch.where(wrong, outlier, 1 / depth)
    matches = m.Matches(target, torch.ones_like(depth), volume.plane_step / 4)
    ends = torch.quantile(depth.flatten(), torch.tensor([0.02, 0.98]))
    start = (ends[:1] * 1.08, ends[1:] * 0.9)
    refined = refine_to_matches(x, matches, *start, space)
    before, after = (error_of(x, *ends, space, depth) for ends in (start, refined))
    assert after < 0.5 * before and after < 0.06


@pytest.mark.parametrize("seed", range(3))
def test_noise_of_far_matches_does_not_pull_the_far_end_nearer(seed):
    """Half of a street lies within two planes of infinity, where matches err by one."""
    step, generator = torch.tensor(0.004), torch.Generator().manual_seed(seed)
    inverse = step * torch.cat([torch.linspace(0.5, 2.0, 48 * 144), torch.linspace(2.0, 60.0, 48 * 144)])
    noisy = (
        (inverse + step * torch.randn(inverse.shape, generator=generator))
        .clamp_min(0.0)
        .view(1, *SIZE_SCALE_SEARCH)
    )
    matches = m.Matches(noisy, torch.full_like(noisy, 0.96), step)
    depth = (1.0 / inverse).view(1, *SIZE_SCALE_SEARCH)
    nearest, farthest = depth.amin()[None], depth.amax()[None]
    x = relative(depth, "disparity")
    near, far = refine_to_matches(x, matches, nearest * 1.05, farthest * 0.8, "disparity")
    assert float(near) == pytest.approx(float(nearest), rel=0.02)
    assert float(far) == pytest.approx(float(farthest), rel=0.1)


@pytest.mark.parametrize(
    ("start", "reached"),
    [
        ((1.0 * math.exp(1.35), 10.0), (1.0, 10.0)),
        ((1.0 * math.exp(1.5), 10.0), (math.exp(0.1), None)),  # near moves by a log factor of 1.4 at most
        ((0.5 * math.exp(-0.65), 10.0), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(0.65)), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(0.9)), (None, 10.0 * math.exp(0.2))),  # far by one of .7
        ((1.0, 10.0 * math.exp(-0.65)), (1.0, 10.0)),
        ((1.0, 10.0 * math.exp(-0.9)), (None, 10.0 * math.exp(-0.2))),
    ],
)
def test_a_fit_moves_near_and_far_as_far_as_its_basin_reaches(start, reached):
    """Exact matches of a map from 1 to 10 m."""
    x = torch.linspace(0.0, 1.0, SIZE_SCALE_SEARCH[0] * SIZE_SCALE_SEARCH[1]).view(1, 1, *SIZE_SCALE_SEARCH)
    depth = 1.0 + 9.0 * x[0]
    matches = m.Matches(1.0 / depth, torch.full_like(depth, 0.99), torch.tensor(0.001))
    found = refine_to_matches(x, matches, *(torch.tensor([end]) for end in start), "depth")
    for end, expected in zip(found, reached, strict=True):
        assert expected is None or float(end) == pytest.approx(expected, rel=0.01)
