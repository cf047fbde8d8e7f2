"""How far pixels move with their depth, against projections of all pixels, and the planes made of it."""

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, PosedViews, View
from geodiff_plugin.matching.planes import Parallax, even_planes, parallax_of
from tests.unit.matching import references as ref
from tests.views import view_of

#: More pixels than are sampled, on a grid whose width shares factors with the steps of the samples.
SIZE = (60, 96)
K = ref.matrix(90.0, 70.0, 44.0, 33.0, 2.5)
K_RIGHT = ref.matrix(75.0, 85.0, 50.0, 24.0, -3.0)
POSES = {
    "beside": ref.right_from_left((0.0, 0.0, 0.0), (0.3, 0.02, 0.0)),
    "turned": ref.right_from_left((6.0, -9.0, 14.0), (-0.25, 0.15, 0.1)),
    "ahead": ref.right_from_left((-3.0, 5.0, 20.0), (0.05, -0.04, 0.4)),
    "behind": ref.right_from_left((4.0, 2.0, -8.0), (0.1, 0.05, -0.5)),
}


def parallax(T: np.ndarray, K_right: np.ndarray = K_RIGHT, size=SIZE) -> Parallax:
    image = torch.zeros(1, 1, 1)  # of which only the camera counts
    return Parallax(Camera(K, size[::-1]), View(image, Camera(K_right), T), "E")


def shifts(T: np.ndarray, inverse_depth: float) -> np.ndarray:
    """Pixels from its place at infinity of every pixel; infinite behind the right camera."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    far, near = (list(ref.projected(columns, rows, w, K, K_RIGHT, T)) for w in (0.0, inverse_depth))
    assert (far[2] > 0).all()
    shift = np.hypot(near[0] - far[0], near[1] - far[1])
    return np.where(near[2] > 1e-4, shift, np.inf)


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("inverse_depth", [0.05, 0.4, 1.7])
def test_the_median_pixel_moves_as_in_a_projection_of_all_pixels(name, inverse_depth):
    T = POSES[name]
    expected = np.median(shifts(T, inverse_depth))
    assert parallax(T).median_shift(inverse_depth) == pytest.approx(expected, rel=0.01)


def test_the_median_of_samples_is_the_lower_one_and_every_sample_is_a_pixel():
    """Few pixels, all of which are sampled: two of them, of which one moves less, and an odd number."""
    T = POSES["ahead"]
    for size in ((1, 2), (3, 3), (31, 33), (33, 62)):
        rows, columns = np.mgrid[: size[0], : size[1]]
        u, v, _ = ref.projected(columns, rows, 0.0, K, K_RIGHT, T)
        near_u, near_v, _ = ref.projected(columns, rows, 0.9, K, K_RIGHT, T)
        every = np.sort(np.hypot(near_u - u, near_v - v).ravel())
        expected = every[(len(every) - 1) // 2]
        assert parallax(T, size=size).median_shift(0.9) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", POSES)
@pytest.mark.parametrize("wanted_px", [0.3, 2.0, 7.0])
def test_the_inverse_depth_of_a_shift_is_found_to_a_twentieth_of_a_per_cent(name, wanted_px):
    view = parallax(POSES[name])
    most = view.median_shift(1e5)
    found = view.inverse_depth_at(wanted_px)
    reached = min(wanted_px, 0.5 * most)
    assert view.median_shift(found) >= reached * (1 - 1e-9)
    assert view.median_shift(found / 1.0005) <= reached * (1 + 1e-9)
    steps = (np.log10(found) + 8) / 13 * 2**16  # one of 65536 steps of the exponent from -8 to 5
    assert steps == pytest.approx(round(steps), abs=1e-3)


def test_a_camera_behind_the_other_bounds_the_shift_by_half_of_the_way_to_the_epipole():
    view = parallax(POSES["behind"])
    most = view.median_shift(1e5)
    assert np.isfinite(most)
    assert view.median_shift(view.inverse_depth_at(10 * most)) == pytest.approx(0.5 * most, rel=2e-3)


def test_a_plane_behind_the_camera_ahead_ends_the_search_before():
    """The camera 0.4 m ahead, whose epipole is near the image's centre: half of the pixels hardly move."""
    T = ref.right_from_left((0.0, 0.0, 0.0), (0.0, 0.0, 0.4))
    view = parallax(T, K)
    found = view.inverse_depth_at(1e6)
    assert 1 / 0.4 * 0.999 < found < 1 / 0.4 * 1.001
    assert view.median_shift(2.6) == np.inf


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (ref.right_from_left((10.0, 5.0, 0.0), (0.0, 0.0, 0.0)), "E must be a pose with a baseline"),
        (ref.right_from_left((0.0, 180.0, 0.0), (0.1, 0.0, 0.0)), "E must be a pose under which the views"),
    ],
)
def test_poses_without_parallax_raise_an_error(T, message):
    with pytest.raises(InputError, match=message):
        parallax(T).inverse_depth_at(1.0)


def test_a_baseline_counts_from_a_third_of_a_pixel_on():
    for baseline_m, enough in ((0.1, True), (2e-8, False)):
        T = ref.right_from_left((0.0, 0.0, 0.0), (baseline_m, 0.0, 0.0))
        view = parallax(T)
        if enough:
            assert view.inverse_depth_at(0.1) > 0
        else:  # 1e5 / m shift it by less than 0.3 px
            assert view.median_shift(1e5) < 0.3
            with pytest.raises(InputError, match="baseline"):
                view.inverse_depth_at(0.1)


def test_every_view_has_the_parallax_of_its_own_camera():
    images = [np.zeros((40, 50)), np.zeros((70, 44)), np.zeros((30, 30))]
    cameras = [(K_RIGHT, POSES["turned"]), (K, POSES["beside"]), (K_RIGHT, POSES["behind"])]
    views = tuple(ref.grey_view(image, *camera) for image, camera in zip(images, cameras, strict=True))
    posed = PosedViews(view_of(torch.zeros(1, *SIZE), K), views)
    found = parallax_of(posed)
    for view, (K_right, T) in zip(found, cameras, strict=True):
        assert view.median_shift(0.6) == pytest.approx(parallax(T, K_right).median_shift(0.6), rel=1e-5)
    assert [view._name for view in found] == [f"E of right view {v}" for v in (1, 2, 3)]
    assert [view._name for view in parallax_of(posed._replace(rights=views[1:2]))] == ["E"]


@pytest.mark.parametrize("names", [("beside",), ("turned", "beside"), ("beside", "turned")])
def test_planes_are_even_and_as_many_as_the_view_that_moves_most_asks_for(names):
    views = [parallax(POSES[name]) for name in names]
    span = 0.11, 0.83
    moved = max(np.subtract(*(np.median(shifts(POSES[name], w)) for w in reversed(span))) for name in names)
    for step_px in (0.75, 0.4):
        planes = even_planes(views, span, step_px, 3, 500)
        assert planes.dtype == torch.float32
        assert len(planes) == pytest.approx(moved / step_px + 1, rel=0.02, abs=0.6)
        np.testing.assert_allclose(planes, np.linspace(*span, len(planes)), rtol=1e-5)
    assert len(even_planes(views, span, 0.75, 300, 500)) == 300
    assert len(even_planes(views, span, 0.75, 3, 7)) == 7
    assert len(even_planes([parallax(POSES["ahead"])], (0.1, 4.0), 0.75, 3, 61)) == 61
