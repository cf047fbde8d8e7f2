"""The cost volume of a left view and several right views, and what it reports about itself."""

import numpy as np
import pytest
import torch

from geodiff_plugin.matching.alignment import ComparedView, align_view
from geodiff_plugin.matching.census import census, grey_levels
from geodiff_plugin.matching.planes import parallax_of
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.types import PosedViews
from tests.unit.matching import references as ref

SIZE = (31, 44)
K = ref.matrix(50.0, 44.0, 20.0, 17.0)
SHIFTED = K + np.array([[0, 0, -3.0], [0, 0, 0], [0, 0, 0]])
#: A rectified view, one that is not, and one that looks away from a part of the scene.
CAMERAS = [
    (SIZE, SHIFTED, ref.right_from_left((0.0, 0.0, 0.0), (0.3, 0.0, 0.0))),
    ((25, 52), ref.matrix(55.0, 40.0, 30.0, 11.0), ref.right_from_left((3.0, -5.0, 8.0), (-0.2, 0.1, 0.05))),
    ((38, 29), K, ref.right_from_left((0.0, 20.0, 0.0), (0.2, 0.05, 0.0))),
]


def posed(*which: int) -> PosedViews:
    rng = np.random.default_rng(0)
    left, images = rng.random((1, *SIZE)), [rng.random(size) for size, _, _ in CAMERAS]
    views = tuple(ref.view_of(images[v], *CAMERAS[v][1:]) for v in which)
    return PosedViews(torch.from_numpy(left).float(), views, torch.from_numpy(K).float())


PLANES = torch.linspace(0.1, 0.9, 35)


def test_a_cost_is_the_mean_over_the_views_that_see_the_pixel():
    views = posed(0, 1, 2)
    found = sweep_planes(views, PLANES)
    assert torch.equal(found.inverse_depth, PLANES) and torch.equal(found.left_01, views.left_01)
    assert found.size == SIZE and found.levels.dtype == torch.uint8
    padded = np.pad(views.left_01[0].numpy(), 3, mode="edge")
    described = census(grey_levels(torch.from_numpy(padded)))
    np.testing.assert_array_equal(described, ref.votes(padded))
    each = [ComparedView(described, align_view(view, views.K_left, SIZE, PLANES)) for view in views.views]
    seen_by = np.zeros(4, int)
    for k in range(len(PLANES)):
        costs = np.stack([view.cost(k).numpy() for view in each]).astype(float)
        seen = np.stack([view.seen(k).numpy() for view in each])
        count = seen.sum(0)
        mean = np.where(count > 0, (costs * seen).sum(0) / np.maximum(count, 1), 78)
        np.testing.assert_array_equal(found.in_view[k], count > 0)
        assert np.abs(found.levels[k].numpy() - mean).max() <= 0.5 + 1e-6
        seen_by += np.bincount(count.ravel(), minlength=4)
    assert (seen_by > 0).all()
    one = sweep_planes(posed(1), PLANES)
    alone = ComparedView(described, one.aligned[0])
    for k in range(len(PLANES)):
        seen = alone.seen(k).numpy()
        np.testing.assert_array_equal(one.levels[k], np.where(seen, alone.cost(k).numpy(), 78))


def test_the_order_of_the_views_does_not_matter():
    one, other = sweep_planes(posed(0, 1, 2), PLANES), sweep_planes(posed(2, 0, 1), PLANES)
    assert torch.equal(one.levels, other.levels) and torch.equal(one.in_view, other.in_view)


def test_a_volume_reports_the_cost_of_pixels_by_their_number():
    volume = sweep_planes(posed(0, 1), PLANES)
    index = torch.tensor([0, 43, 44, 5 * 44 + 7, 31 * 44 - 1])
    cost, in_view = volume.at_pixels(index)
    levels, seen = volume.levels.numpy(), volume.in_view.numpy()
    for column, (v, u) in enumerate([(0, 0), (0, 43), (1, 0), (5, 7), (30, 43)]):
        np.testing.assert_allclose(cost[:, column], levels[:, v, u] / 224, rtol=1e-6)
        np.testing.assert_array_equal(in_view[:, column], seen[:, v, u])
    assert 0 < in_view.float().mean() < 1


@pytest.mark.parametrize(
    ("which", "rectified"), [((0,), True), ((1,), False), ((0, 1), False), ((1, 0), False)]
)
def test_a_volume_is_rectified_if_all_views_are(which, rectified):
    assert sweep_planes(posed(*which), PLANES).rectified is rectified


def test_the_reach_is_from_the_nearest_plane_to_a_shift_of_a_third_of_a_pixel_in_the_view_that_moves_most():
    """Rectified, a shift is ``f b / z``: of views 0.3 m and 0.8 m to the side the second reaches farther."""
    far = ref.view_of(np.zeros(SIZE), K, ref.right_from_left((0.0, 0.0, 0.0), (0.8, 0.0, 0.0)))
    near = posed(0)
    volume = sweep_planes(near._replace(views=(*near.views, far)), PLANES)
    assert volume.reach_m == pytest.approx((1 / 0.9, 50.0 * 0.8 / 0.3), rel=1e-3)
    assert sweep_planes(near, PLANES).reach_m == pytest.approx((1 / 0.9, 50.0 * 0.3 / 0.3), rel=1e-3)
    assert float(volume.plane_step) == pytest.approx(0.8 / 34, rel=1e-4)


def test_a_parallax_that_is_known_already_is_kept():
    views = posed(0, 1)
    given = parallax_of(views)
    assert sweep_planes(views, PLANES, given).parallax is given
    made = sweep_planes(views, PLANES).parallax
    assert [view.median_shift(0.5) for view in made] == [view.median_shift(0.5) for view in given]
