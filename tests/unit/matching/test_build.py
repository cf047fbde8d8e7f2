"""From views of unequal sizes to a cost volume: grids, the span of its planes, and swapped views."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._checks import InputError
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import build
from geodiff_plugin.matching.build import build_cost_volume, inverse_pose_preferred, pilot_volume, to_grid
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.planes import parallax_of
from geodiff_plugin.types import PosedViews
from tests.unit.matching import references as ref

SIZE = (64, 100)
K = ref.matrix(86.0, 78.0, 47.0, 35.0, 1.0)
#: Right views finer and coarser than the left one, along one axis and along both.
CAMERAS = [
    (
        (132, 112),
        ref.matrix(129.0, 156.0, 53.0, 73.0),
        ref.right_from_left((2.0, -4.0, 3.0), (0.2, 0.05, 0.02)),
    ),
    (
        (40, 92),
        ref.matrix(172.0, 39.0, 44.0, 22.0),
        ref.right_from_left((-3.0, 2.0, -5.0), (-0.5, 0.1, 0.0)),
    ),
]


@pytest.fixture
def posed() -> PosedViews:
    rng = np.random.default_rng(0)
    views = []
    for size, K_view, T in CAMERAS:
        view = ref.view_of(np.zeros(size), K_view, T)
        views.append(view._replace(image_01=torch.from_numpy(rng.random((3, *size))).float()))
    left = torch.from_numpy(rng.random((3, *SIZE))).float()
    return PosedViews(left, tuple(views), torch.from_numpy(K).float())


def rescaled(K: np.ndarray, size, new) -> np.ndarray:
    """Camera matrix of a resized image: outer edges stay where they are."""
    sx, sy = new[1] / size[1], new[0] / size[0]
    return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]]) @ K


def test_a_grid_has_so_many_pixels_and_right_views_are_no_finer_than_it(posed):
    grid = to_grid(posed, 1600)
    size = (32, 50)  # 64 x 100 has four times as many pixels
    assert grid.size == size
    np.testing.assert_allclose(grid.K_left, rescaled(K, SIZE, size), rtol=1e-5)
    for view, (before, K_before, T) in zip(grid.views, CAMERAS, strict=True):
        # Focal lengths of the grid are 43 and 39 px.
        wanted = tuple(
            round(side * min(1, focal / mine))
            for side, focal, mine in zip(before, (39.0, 43.0), (K_before[1, 1], K_before[0, 0]), strict=True)
        )
        assert tuple(view.image_01.shape[-2:]) == wanted and view.image_01.shape[0] == 3
        np.testing.assert_allclose(view.K, rescaled(K_before, before, wanted), rtol=1e-4)
        np.testing.assert_allclose(view.T_right_from_left, T, atol=1e-6)
    same = to_grid(posed, 10**6)
    assert same.size == SIZE and torch.equal(same.left_01, posed.left_01)


def test_the_coarse_sweep_reaches_from_infinity_to_two_fifths_of_the_width(posed):
    volume = pilot_volume(posed)
    assert volume.size == SIZE
    assert math.prod(pilot_volume(posed, 1600).size) == 1600
    nearest = [view.inverse_depth_at(0.4 * SIZE[1]) for view in volume.parallax]
    assert nearest[0] > 1.5 * nearest[1]
    assert float(volume.inverse_depth[0]) == 0.0
    assert float(volume.inverse_depth[-1]) == pytest.approx(min(nearest[0], 3 * nearest[1]), rel=1e-5)
    grey = torch.tensor([0.299, 0.587, 0.114]) @ posed.left_01.flatten(1)
    torch.testing.assert_close(volume.left_01.flatten(), grey)
    one = pilot_volume(posed._replace(views=posed.views[1:]))
    moved = one.parallax[0].median_shift(float(one.inverse_depth[-1]))
    assert len(one.inverse_depth) == pytest.approx(moved + 1, abs=1)  # a pixel apart


def test_a_view_that_moves_far_less_than_another_does_not_draw_the_planes_near(posed):
    still = posed.views[0]._replace(
        T_right_from_left=torch.from_numpy(ref.right_from_left((0, 0, 0), (0.01, 0, 0))).float()
    )
    volume = pilot_volume(posed._replace(views=(still, posed.views[1])))
    least = volume.parallax[1].inverse_depth_at(0.4 * SIZE[1])
    assert float(volume.inverse_depth[-1]) == pytest.approx(3 * least, rel=1e-5)


def test_the_coarse_sweep_has_160_planes_where_one_passes_behind_a_camera(posed):
    poses = [ref.right_from_left((0, 0, 0), centre) for centre in ((0.05, 0.0, 0.5), (0.1, 0.0, 0.0))]
    views = tuple(
        view._replace(T_right_from_left=torch.from_numpy(T).float())
        for view, T in zip(posed.views, poses, strict=True)
    )
    volume = pilot_volume(posed._replace(views=views))
    last = float(volume.inverse_depth[-1])
    assert np.isinf(volume.parallax[0].median_shift(last)) and len(volume.inverse_depth) == 160


def faked_matches(confidence: np.ndarray, inverse_depth: np.ndarray) -> Matches:
    confidence, inverse_depth = (torch.from_numpy(x[None]).float() for x in (confidence, inverse_depth))
    return Matches(inverse_depth, confidence, torch.tensor(0.01))


@pytest.mark.parametrize(("matched", "nearest"), [(0.02, 0.6), (0.04, 0.6), (0.5, 0.01), (0.5, 9.0)])
def test_planes_end_a_quarter_nearer_than_the_nearest_certain_match(posed, monkeypatch, matched, nearest):
    rng = np.random.default_rng(1)
    confidence = np.where(rng.random(SIZE) < matched, 0.81, 0.79)
    inverse_depth = nearest * rng.random(SIZE)
    inverse_depth[confidence < 0.8] = 50.0
    monkeypatch.setattr(build, "match_volume", lambda _: faked_matches(confidence, inverse_depth))
    pilot = pilot_volume(posed)
    limit = float(pilot.inverse_depth[-1])
    expected = limit
    if matched > 0.03:
        least = min(view.inverse_depth_at(0.03 * SIZE[1]) for view in pilot.parallax)
        expected = 1.25 * np.sort(inverse_depth[confidence > 0.8])[int(0.995 * (confidence > 0.8).sum())]
        expected = min(max(expected, least), limit)
    config = DEFAULT.changed(planes=77, sweep_pixels=1600)
    volume = build_cost_volume(posed, config=config)
    assert volume.size == (32, 50) and float(volume.inverse_depth[0]) == 0.0
    # The coarse sweep sees the views on the grid of the volume, whose limit is that of the views themselves.
    assert float(volume.inverse_depth[-1]) == pytest.approx(expected, rel=0.02)
    moved = max(view.median_shift(float(volume.inverse_depth[-1])) for view in volume.parallax)
    assert len(volume.inverse_depth) == min(max(round(moved / 0.75) + 1, 24), 77)


def test_a_given_range_is_swept_from_far_to_near_whatever_the_images_show(posed, monkeypatch):
    monkeypatch.setattr(build, "match_volume", None)
    volume = build_cost_volume(posed, depth_range=(1.6, 12.5), config=DEFAULT.changed(planes=500))
    ends = volume.inverse_depth[[0, -1]].tolist()
    assert ends == pytest.approx([1 / 12.5, 1 / 1.6], rel=1e-5)
    moved = max(np.subtract(*(view.median_shift(w) for w in reversed(ends))) for view in volume.parallax)
    assert len(volume.inverse_depth) == max(24, round(moved / 0.75) + 1) > 24
    expected = parallax_of(to_grid(posed, DEFAULT.sweep_pixels))
    assert [v.median_shift(0.5) for v in volume.parallax] == [v.median_shift(0.5) for v in expected]


def test_a_range_is_given_by_its_name(posed):
    with pytest.raises(TypeError, match="positional"):
        build_cost_volume(posed, (1.6, 12.5))


@pytest.mark.parametrize("ends", [(2.0, 2.0), (3.0, 2.0), (0.0, 2.0), (-1.0, 2.0), (2.0, float("nan"))])
def test_a_range_that_does_not_ascend_from_above_0_is_refused(posed, ends):
    with pytest.raises(InputError, match=r"depth_range must be \(near, far\)"):
        build_cost_volume(posed, depth_range=ends)


@pytest.mark.parametrize(
    ("given", "inverse", "preferred"),
    [
        (0.2, 0.26, True),
        (0.2, 0.24, False),
        (0.2, None, False),
        (0.26, 0.2, False),
        (0.0, 0.1, True),
        (0.0, 0.0, False),
    ],
)
def test_the_inverse_pose_is_preferred_if_it_matches_a_quarter_more(
    posed, monkeypatch, given, inverse, preferred
):
    seen = []

    def swept(views: PosedViews, pixels: int) -> SimpleNamespace:
        seen.append((views, pixels))
        if len(seen) == 2 and inverse is None:
            raise InputError("these views do not overlap")
        mean = given if len(seen) == 1 else inverse
        return SimpleNamespace(confidence=torch.tensor([0.5 * mean, 1.5 * mean]))

    monkeypatch.setattr(build, "pilot_volume", swept)
    monkeypatch.setattr(build, "match_volume", lambda volume: volume)
    unsure = faked_matches(np.array([[0.1, 0.69]]), np.ones((1, 2)))
    assert inverse_pose_preferred(posed, unsure) is preferred
    assert seen[0][0] is posed and [pixels for _, pixels in seen] == [15_000, 15_000]
    for view, before in zip(seen[1][0].views, posed.views, strict=True):
        product = view.T_right_from_left.double() @ before.T_right_from_left.double()
        np.testing.assert_allclose(product, np.eye(4), atol=1e-6)
        assert view.image_01 is before.image_01 and view.K is before.K
    sure = faked_matches(np.array([[0.1, 0.71]]), np.ones((1, 2)))
    assert not inverse_pose_preferred(posed, sure) and len(seen) == 2
