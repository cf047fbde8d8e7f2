"""The metric parametrisation against its formulas in NumPy, for batches whose states and maps all differ."""

import numpy as np
import pytest
import torch

from geodiff_plugin import InputError
from geodiff_plugin.scale.affine import AffineState
from geodiff_plugin.scale.space import (
    SPACES,
    DepthRange,
    MetricMap,
    cat_samples,
    inverse_softplus,
    smooth_floor,
)
from tests.unit.scale.references import tensor

#: Metres of ``v = s x + t`` in units of ``g``, as the docstring of ``MetricMap`` has them.
METRES = {
    "depth": lambda v, g: g * v,
    "disparity": lambda v, g: g / v,
    "log": lambda v, g: g * np.exp(v),
    "log1p": lambda v, g: g * (np.exp(v) - 1),
    "sqrt_disparity": lambda v, g: g / v**2,
}
NEAR, FAR = np.array([0.5, 4.0, 0.8]), np.array([0.9, 80.0, 60.0])
POSITIVE = ("softplus", "square")


def floor(x: np.ndarray) -> np.ndarray:
    return (x + np.sqrt(x**2 + 4 * 0.001**2)) / 2


def test_the_floor_is_the_identity_above_0_and_keeps_values_and_slopes_positive_below():
    x = np.array([-50.0, -1.0, -0.1, -1e-3, -1e-6, 0.0, 1e-6, 1e-3, 0.1, 1.0, 7.0])
    given = torch.tensor(x, requires_grad=True)
    found = smooth_floor(given)
    (slope,) = torch.autograd.grad(found.sum(), given)
    np.testing.assert_allclose(found.detach(), floor(x), rtol=1e-6)
    np.testing.assert_allclose(slope, floor(x) / np.sqrt(x**2 + 4e-6), rtol=1e-6)
    assert (slope > 0).all() and found[-1].item() == pytest.approx(7.0, rel=1e-6)
    single = smooth_floor(torch.tensor([-30.0, -29.9, -0.5]))
    assert (single.diff() > 0).all()  # also in float32, where the sum would cancel


@pytest.mark.parametrize("positive", POSITIVE)
@pytest.mark.parametrize("space", METRES)
def test_metres_of_relative_maps_are_by_the_formula_of_their_space_and_their_own_state(space, positive):
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.2, 1.2, (3, 1, 4, 5))
    s_hat, t_hat, g = np.array([0.3, -1.0, 1.7]), np.array([-0.5, 0.9, 0.2]), np.array([0.5, 3.0, 20.0])
    units = np.array([0.7, 1.9, 0.4]), np.array([0.2, 0.3, 1.1])
    square = positive == "square"
    s, t = (
        (s_hat**2 * units[0], t_hat**2 * units[1])
        if square
        else (np.log1p(np.exp(s_hat)), np.log1p(np.exp(t_hat)))
    )
    state = AffineState(*map(tensor, (s_hat, t_hat, g)), tuple(map(tensor, units)) if square else None)
    np.testing.assert_allclose(state.scale, s, rtol=1e-6)
    np.testing.assert_allclose(state.shift, t, rtol=1e-6)
    column = (slice(None), None, None, None)
    confined = np.clip(x, 0, 1) if square else floor(x)
    metric = MetricMap(space, positive)
    found = metric(tensor(x), state)
    np.testing.assert_allclose(found, METRES[space](s[column] * confined + t[column], g[column]), rtol=2e-5)
    np.testing.assert_allclose(metric.confine(tensor(x)), np.clip(x, 0, 1) if square else x, rtol=1e-6)
    # The way back, which for the floor ends at half of its width.
    back = metric.relative(found, state).numpy()
    inside = (x > 0.01) & (x < 0.99) if square else x > 0.01
    np.testing.assert_allclose(back[inside], x[inside], atol=2e-5)
    if square:
        np.testing.assert_allclose(back, np.clip(x, 0, 1), atol=2e-5)
    else:
        assert (np.abs(back[x < -0.05]) < 0.2).all()
    # Ends of each map, nearest and farthest.
    ends = METRES[space](t, g), METRES[space](s + t, g)
    near, far = metric.range_of(state)
    np.testing.assert_allclose(near, np.minimum(*ends), rtol=1e-5)
    np.testing.assert_allclose(far, np.maximum(*ends), rtol=1e-5)
    # A slice of the samples is the state of these samples.
    for samples in (slice(1, 2), slice(0, 3, 2)):
        part = state.of(samples)
        np.testing.assert_array_equal(metric(tensor(x[samples]), part), found[samples])


@pytest.mark.parametrize("space", METRES)
def test_relative_is_bounded_below_0_and_the_inverse_of_the_floor(space):
    """A depth beyond the end at x = 0 has x = -1.5 eps, where the floor is 0.5 eps."""
    metric = MetricMap(space)
    state = metric.from_range(tensor(NEAR), tensor(FAR))
    ends = np.where(SPACES[space].grows_with_depth, NEAR, FAR)[:, None, None, None]
    beyond = ends * (0.7 if SPACES[space].grows_with_depth else 1.4)
    np.testing.assert_allclose(metric.relative(tensor(beyond), state).flatten(), [-1.5e-3] * 3, rtol=1e-3)
    x = np.linspace(-0.0012, 0.004, 9)
    depth = metric(tensor(np.tile(x, (3, 1))).view(3, 1, 1, 9), state)
    found = metric.relative(depth, state)[:, 0, 0].numpy()
    # Depth in float32 resolves x to about 1e-6 near 0 and worse where the shift is large.
    np.testing.assert_allclose(found, np.tile(x, (3, 1)), atol=5e-4)


@pytest.mark.parametrize("positive", POSITIVE)
@pytest.mark.parametrize("space", METRES)
def test_a_range_is_where_0_and_1_lie(space, positive):
    metric = MetricMap(space, positive)
    state = metric.from_range(tensor(NEAR), tensor(FAR))
    assert (state.scale > 0).all() and (state.shift > 0).all()
    x = tensor([[0.0, 1.0]] * 3).view(3, 1, 1, 2)
    depth = metric(x, state)[:, 0, 0].numpy()
    grows = space in ("depth", "log", "log1p")
    assert SPACES[space].grows_with_depth == grows
    # The floor lifts x = 0 by a thousandth of the range.
    expected = np.stack([NEAR, FAR] if grows else [FAR, NEAR], 1)
    np.testing.assert_allclose(depth[:, 1], expected[:, 1], rtol=2e-3)
    slack = 2e-3 if positive == "square" else 0.3
    np.testing.assert_allclose(depth[:, 0], expected[:, 0], rtol=slack)
    found = metric.range_of(state)
    np.testing.assert_allclose(found[0], NEAR, rtol=2e-3)
    np.testing.assert_allclose(found[1], FAR, rtol=2e-3)
    assert (state.units is None) == (positive == "softplus")


@pytest.mark.parametrize("positive", POSITIVE)
@pytest.mark.parametrize("space", METRES)
def test_an_empty_range_keeps_a_scale_above_0(space, positive):
    """A flat map is legal: its scale is 1e-4, which changes its metres by as little."""
    at = tensor([2.0, 0.3])
    state = MetricMap(space, positive).from_range(at, at)
    np.testing.assert_allclose(state.scale, 1e-4, rtol=1e-2)
    near, far = MetricMap(space, positive).range_of(state)
    np.testing.assert_allclose(near, at, rtol=1e-3)
    np.testing.assert_allclose(far, at, rtol=1e-3)


def test_gradients_reach_the_map_and_both_numbers_but_squares_clip():
    x = tensor([[-0.5, 0.5, 1.5]] * 2).view(2, 1, 1, 3)
    for positive, expected in (("softplus", [True, True, True]), ("square", [False, True, False])):
        metric, inputs = MetricMap("disparity", positive), x.clone().requires_grad_()
        state = metric.from_range(tensor([1.0, 2.0]), tensor([5.0, 9.0]))
        s, t = state.s_hat.clone().requires_grad_(), state.t_hat.clone().requires_grad_()
        depth = metric(inputs, AffineState(s, t, state.g_s, state.units))
        by_x, by_s, by_t = torch.autograd.grad(depth.sum(), (inputs, s, t))
        assert ((by_x != 0) == torch.tensor(expected)).all()
        assert (by_s < 0).all() and (by_t < 0).all()  # a larger disparity is nearer


def test_helpers_of_states_and_ranges():
    y = tensor([1e-4, 0.1, 1.0, 30.0])
    np.testing.assert_allclose(np.log1p(np.exp(inverse_softplus(y).double().numpy())), y, rtol=1e-4)
    one, two = torch.arange(2.0), torch.arange(3.0)
    assert cat_samples([one]) is one and cat_samples([two, one]).tolist() == [0, 1, 2, 0, 1]
    searched = DepthRange(tensor([1, 2, 3]), tensor([4, 5, 6]), torch.tensor([True, False, True]))
    part = searched.of(slice(1, 3))
    assert [each.tolist() for each in part] == [[2, 3], [5, 6], [False, True]]
    assert DepthRange(tensor([1, 2]), tensor([3, 4])).of(slice(0, 1)).on_edge is None
    with pytest.raises(InputError, match=r"space must be one of depth, .*; got 'metres'"):
        MetricMap("metres")
    assert MetricMap() == MetricMap("depth", "softplus")


@pytest.mark.parametrize("space", METRES)
def test_depth_between_two_ends_is_linear_in_the_space(space):
    x = np.linspace(0, 1, 5)
    found = SPACES[space].depth_at(tensor(x), tensor(NEAR)[:, None], tensor(FAR)[:, None]).numpy()
    to = {
        "depth": lambda z: z,
        "disparity": lambda z: 1 / z,
        "log": np.log,
        "log1p": np.log1p,
        "sqrt_disparity": lambda z: z**-0.5,
    }
    a, b = (NEAR, FAR) if space in ("depth", "log", "log1p") else (FAR, NEAR)
    ends = to[space](a)[:, None], to[space](b)[:, None]
    np.testing.assert_allclose(to[space](found), ends[0] + (ends[1] - ends[0]) * x, rtol=1e-4)


NEAR_METRIC, FAR_METRIC = torch.tensor([0.5, 4.0, 0.8]), torch.tensor([0.9, 80.0, 60.0])


@pytest.mark.parametrize("space", SPACES)
def test_the_formulas_of_a_space_belong_together(space):
    kind, near, far = SPACES[space], NEAR_METRIC.double(), FAR_METRIC.double()
    depth = torch.stack([near, torch.sqrt(near * far), far])
    g = torch.tensor([0.5, 2.0, 30.0], dtype=torch.float64)
    torch.testing.assert_close(kind.forward(kind.inverse(depth / g), g), depth)
    v = kind.inverse(depth)
    assert ((v[1:] > v[:-1]) == kind.grows_with_depth).all()
    s, t, unit = kind.from_ends(*kind.ends(near, far))
    at_zero, at_one = kind.ends(kind.forward(t, unit), kind.forward(s + t, unit))
    torch.testing.assert_close((at_zero, at_one), (near, far))
    assert (s > 0).all() and (t > 0).all()
    x = torch.linspace(0, 1, 9, dtype=torch.float64)
    between = kind.depth_at(x, near[:, None], far[:, None])
    torch.testing.assert_close(between, kind.forward(s[:, None] * x + t[:, None], unit[:, None]))
    torch.testing.assert_close(kind.ends(between[:, 0], between[:, -1]), (near, far))


@pytest.mark.parametrize("space", SPACES)
def test_squares_start_at_one_and_clip(space):
    metric = MetricMap(space, "square")
    affine = metric.from_range(NEAR_METRIC, FAR_METRIC)
    assert torch.equal(affine.s_hat, torch.ones(3)) and torch.equal(affine.t_hat, torch.ones(3))
    torch.testing.assert_close(metric.range_of(affine), (NEAR_METRIC, FAR_METRIC), rtol=2e-3, atol=0)
    beyond = torch.tensor([-0.5, 1.5]).view(1, 1, 1, 2).requires_grad_()
    depth = metric(beyond.expand(3, -1, -1, -1), affine)
    ends = SPACES[space].ends(*depth.flatten(1).unbind(1))
    torch.testing.assert_close(ends, metric.range_of(affine))
    assert torch.autograd.grad(depth.sum(), beyond)[0].abs().max() == 0
