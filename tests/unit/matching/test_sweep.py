"""The cost volume of a left view and several right views, and what it reports about itself."""

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._internal.camera_checks import check_intrinsics, check_size_of
from geodiff_plugin.cameras import Camera, PosedViews
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evaluation.figures import render_cloud
from geodiff_plugin.evidence.prepare import prepare_evidence
from geodiff_plugin.formats.clouds import write_ply
from geodiff_plugin.matching import build_cost_volume, match_volume, points_to_matches
from geodiff_plugin.matching.alignment import ComparedView, align_view
from geodiff_plugin.matching.build import coarse_volume, inverse_pose_preferred, to_grid
from geodiff_plugin.matching.census import census, grey_levels
from geodiff_plugin.matching.planes import parallax_of
from geodiff_plugin.matching.sweep import sweep_planes
from tests.tiny import textured
from tests.unit.matching import references as ref
from tests.unit.test_geometry import points_of
from tests.views import posed_of, view_of

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
    views = tuple(ref.grey_view(images[v], *CAMERAS[v][1:]) for v in which)
    return PosedViews(view_of(torch.from_numpy(left).float(), K), views)


PLANES = torch.linspace(0.1, 0.9, 35)


def test_a_cost_is_the_mean_over_the_views_that_see_the_pixel():
    views = posed(0, 1, 2)
    found = sweep_planes(views, PLANES)
    assert torch.equal(found.inverse_depth, PLANES) and torch.equal(found.left_01, views.left.image_01)
    assert found.size == SIZE and found.levels.dtype == torch.uint8
    padded = np.pad(views.left.image_01[0].numpy(), 3, mode="edge")
    described = census(grey_levels(torch.from_numpy(padded)))
    np.testing.assert_array_equal(described, ref.votes(padded))
    aligned = [align_view(view, views.left.camera, PLANES) for view in views.rights]
    each = [ComparedView(described, view) for view in aligned]
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
    far = ref.grey_view(np.zeros(SIZE), K, ref.right_from_left((0.0, 0.0, 0.0), (0.8, 0.0, 0.0)))
    near = posed(0)
    volume = sweep_planes(near._replace(rights=(*near.rights, far)), PLANES)
    assert volume.reach_m == pytest.approx((1 / 0.9, 50.0 * 0.8 / 0.3), rel=1e-3)
    assert sweep_planes(near, PLANES).reach_m == pytest.approx((1 / 0.9, 50.0 * 0.3 / 0.3), rel=1e-3)
    assert float(volume.plane_step) == pytest.approx(0.8 / 34, rel=1e-4)


def test_a_parallax_that_is_known_already_is_kept():
    views = posed(0, 1)
    given = parallax_of(views)
    assert sweep_planes(views, PLANES, given).parallax is given
    made = sweep_planes(views, PLANES).parallax
    assert [view.median_shift(0.5) for view in made] == [view.median_shift(0.5) for view in given]


SIZE_SKEW = (48, 64)
K_SKEW = np.array([[60.0, 14.0, 28.5], [0.0, 55.0, 24.5], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[66.0, -9.0, 33.5], [0.0, 58.0, 22.5], [0.0, 0.0, 1.0]])
STRAIGHT = np.where(np.abs(K_SKEW) == 14.0, 0.0, K_SKEW)
DEPTH = 1.5 + np.random.default_rng(0).uniform(size=SIZE_SKEW)


def test_shrinking_keeps_the_skew_of_the_image():
    image = torch.rand(3, *SIZE_SKEW)
    small = to_grid(posed_of(image, K_SKEW), 24 * 32).left
    assert small.size == (24, 32)
    np.testing.assert_allclose(small.camera.K, Camera(K_SKEW, SIZE_SKEW[::-1]).resized((32, 24)).K, rtol=1e-6)
    small = view_of(image, np.diag([2.0, 2.0, 1.0]) @ K_SKEW).as_fine_as(Camera(K_SKEW))
    assert small.size == (24, 32) and small.camera.K[0, 1] / small.camera.K[0, 0] == pytest.approx(14 / 60)


def test_the_sweep_and_all_that_is_made_of_it():
    """A textured plane 2 m away, seen by two cameras of different skew."""

    def image(matrix: np.ndarray, at: float) -> torch.Tensor:
        points = points_of(np.full(SIZE_SKEW, 2.0), matrix) + np.array([at, 0, 0])[:, None, None]
        return torch.from_numpy(textured(points[:2].transpose(1, 2, 0), 3)).permute(2, 0, 1).float()

    T = np.eye(4)
    T[0, 3] = -0.15
    images = image(K_SKEW, 0.0), image(K_RIGHT, 0.15)
    greys = (each.mean(0, keepdim=True) for each in images)
    posed, grey = (posed_of(left, K_SKEW, (right, K_RIGHT, T)) for left, right in (images, greys))
    planes = torch.linspace(0.2, 1.0, 24)
    volumes = (
        coarse_volume(posed),
        build_cost_volume(posed),
        sweep_planes(grey, planes),
    )
    config = GuidanceConfig().changed(sweep_pixels=36 * 48)
    evidence = prepare_evidence(posed, None, config).evidence
    for matches in (*(match_volume(v) for v in volumes), evidence.matches):
        reliable = matches.confidence > 0.5
        assert reliable.float().mean() > 0.3
        assert float((1 / matches.inverse_depth[reliable]).median()) == pytest.approx(2.0, rel=0.04)
    assert not inverse_pose_preferred(posed)
    small = Camera(K_SKEW, SIZE_SKEW[::-1]).resized((48, 36)).K
    np.testing.assert_allclose(evidence.grid.left.camera.K, small, rtol=1e-6)


def test_points_and_clouds(tmp_path):
    points = torch.from_numpy(
        points_of(np.full(SIZE_SKEW, 2.0), K_SKEW)[:, 5:40:7, 3:60:9].reshape(3, -1).T
    ).float()
    given, left_out = points_to_matches(points, Camera(K_SKEW, SIZE_SKEW[::-1]), SIZE_SKEW)
    expected = np.zeros(SIZE_SKEW, bool)
    expected[5:40:7, 3:60:9] = True
    assert left_out == 0 and np.array_equal(given.confidence[0] > 0, expected)
    write_ply(tmp_path / "cloud.ply", DEPTH, np.zeros((*SIZE_SKEW, 3)), K_SKEW)
    body = (tmp_path / "cloud.ply").read_bytes().split(b"end_header\n", 1)[1]
    written = np.frombuffer(body, [("p", "<f4", 3), ("colour", "u1", 3)])["p"].T.reshape(3, *SIZE_SKEW)
    np.testing.assert_allclose(written, points_of(DEPTH, K_SKEW), rtol=1e-5, atol=1e-6)
    image, T = np.random.default_rng(0).integers(0, 255, (*SIZE_SKEW, 3), dtype=np.uint8), np.eye(4)
    T[:3, 3] = -0.12, 0.01, 0.02
    assert not np.array_equal(*(render_cloud(DEPTH, image, matrix, T) for matrix in (K_SKEW, STRAIGHT)))


def test_a_guidance_keeps_it():
    right, pose = np.zeros((*SIZE_SKEW, 3), np.uint8), np.eye(4)
    pose[0, 3] = 0.12
    assert np.array_equal(check_intrinsics(K_SKEW), K_SKEW)
    check_size_of(K_SKEW, SIZE_SKEW, "K", "the image")
    for guidance in (
        GeometryGuidance(right, (K_SKEW, K_RIGHT), pose),
        GeometryGuidance.from_baseline(right, K_SKEW, 0.1, K_right=K_RIGHT),
        GeometryGuidance.from_views([(None, K_SKEW, np.eye(4)), (right, K_RIGHT, pose)]),
    ):
        assert np.array_equal([guidance.rigs[0].K_left, guidance.rigs[0].K_right], [K_SKEW, K_RIGHT])
