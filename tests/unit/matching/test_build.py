"""From views of unequal sizes to a cost volume: grids, the span of its planes, and swapped views."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin import geometry as g
from geodiff_plugin import matching as m
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import build
from geodiff_plugin.matching.aggregation import NEVER, Buffers
from geodiff_plugin.matching.build import build_cost_volume, coarse_volume, inverse_pose_preferred, to_grid
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.planes import parallax_of
from tests.benchmarks.matching import textured_pair
from tests.unit.matching import references as ref
from tests.views import posed_of, view_of

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
        view = ref.grey_view(np.zeros(size), K_view, T)
        views.append(view._replace(image_01=torch.from_numpy(rng.random((3, *size))).float()))
    left = torch.from_numpy(rng.random((3, *SIZE))).float()
    return PosedViews(view_of(left, K), tuple(views))


def rescaled(K: np.ndarray, size, new) -> np.ndarray:
    """Camera matrix of a resized image: outer edges stay where they are."""
    sx, sy = new[1] / size[1], new[0] / size[0]
    return np.array([[sx, 0, (sx - 1) / 2], [0, sy, (sy - 1) / 2], [0, 0, 1]]) @ K


def test_a_grid_has_so_many_pixels_and_right_views_are_no_finer_than_it(posed):
    grid = to_grid(posed, 1600)
    size = (32, 50)  # 64 x 100 has four times as many pixels
    assert grid.size == size
    np.testing.assert_allclose(grid.left.camera.K, rescaled(K, SIZE, size), rtol=1e-5)
    for view, (before, K_before, T) in zip(grid.rights, CAMERAS, strict=True):
        # Focal lengths of the grid are 43 and 39 px.
        wanted = tuple(
            round(side * min(1, focal / mine))
            for side, focal, mine in zip(before, (39.0, 43.0), (K_before[1, 1], K_before[0, 0]), strict=True)
        )
        assert view.size == view.camera.size[::-1] == wanted and view.image_01.shape[0] == 3
        np.testing.assert_allclose(view.camera.K, rescaled(K_before, before, wanted), rtol=1e-4)
        np.testing.assert_allclose(view.T_right_from_left, T, atol=1e-6)
    same = to_grid(posed, 10**6)
    assert same.size == SIZE and same.left is posed.left


def test_the_coarse_sweep_reaches_from_infinity_to_two_fifths_of_the_width(posed):
    volume = coarse_volume(posed)
    assert volume.size == SIZE
    assert math.prod(coarse_volume(posed, 1600).size) == 1600
    nearest = [view.inverse_depth_at(0.4 * SIZE[1]) for view in volume.parallax]
    assert nearest[0] > 1.5 * nearest[1]
    assert float(volume.inverse_depth[0]) == 0.0
    assert float(volume.inverse_depth[-1]) == pytest.approx(min(nearest[0], 3 * nearest[1]), rel=1e-5)
    grey = torch.tensor([0.299, 0.587, 0.114]) @ posed.left.image_01.flatten(1)
    torch.testing.assert_close(volume.left_01.flatten(), grey)
    one = coarse_volume(posed._replace(rights=posed.rights[1:]))
    moved = one.parallax[0].median_shift(float(one.inverse_depth[-1]))
    assert len(one.inverse_depth) == pytest.approx(moved + 1, abs=1)  # a pixel apart


def test_a_view_that_moves_far_less_than_another_does_not_draw_the_planes_near(posed):
    still = posed.rights[0]._replace(T_right_from_left=ref.right_from_left((0, 0, 0), (0.01, 0, 0)))
    volume = coarse_volume(posed._replace(rights=(still, posed.rights[1])))
    least = volume.parallax[1].inverse_depth_at(0.4 * SIZE[1])
    assert float(volume.inverse_depth[-1]) == pytest.approx(3 * least, rel=1e-5)


def test_the_coarse_sweep_has_160_planes_where_one_passes_behind_a_camera(posed):
    poses = [ref.right_from_left((0, 0, 0), centre) for centre in ((0.05, 0.0, 0.5), (0.1, 0.0, 0.0))]
    views = tuple(view._replace(T_right_from_left=T) for view, T in zip(posed.rights, poses, strict=True))
    volume = coarse_volume(posed._replace(rights=views))
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
    coarse = coarse_volume(posed)
    limit = float(coarse.inverse_depth[-1])
    expected = limit
    if matched > 0.03:
        least = min(view.inverse_depth_at(0.03 * SIZE[1]) for view in coarse.parallax)
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
def test_a_range_that_does_not_ascend_from_above_0_is_rejected(posed, ends):
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

    monkeypatch.setattr(build, "coarse_volume", swept)
    monkeypatch.setattr(build, "match_volume", lambda volume: volume)
    unsure = faked_matches(np.array([[0.1, 0.69]]), np.ones((1, 2)))
    assert inverse_pose_preferred(posed, unsure) is preferred
    assert seen[0][0] is posed and [pixels for _, pixels in seen] == [15_000, 15_000]
    for view, before in zip(seen[1][0].rights, posed.rights, strict=True):
        product = view.T_right_from_left.astype(float) @ before.T_right_from_left.astype(float)
        np.testing.assert_allclose(product, np.eye(4), atol=1e-6)
        assert view.image_01 is before.image_01 and view.camera is before.camera
    sure = faked_matches(np.array([[0.1, 0.71]]), np.ones((1, 2)))
    assert not inverse_pose_preferred(posed, sure) and len(seen) == 2


SIZE_MATCHING = (96, 144)
SIDEWAYS = (0.3, 0.0, 0.0)
POSES = [(0.0, SIDEWAYS), (0.06, (0.25, 0.1, 0.15)), (0.0, (0.0, 0.3, 0.0)), (-0.1, (0.1, 0.0, -0.3))]


def scene(turn=0.0, at=SIDEWAYS, size=SIZE_MATCHING):
    """A right texture, seen from the left at a known depth, for any pose; all on the CPU."""
    (left, (right,)), depth = textured_pair(size, seed=0)
    E = np.eye(4)
    E[0, 0] = E[2, 2] = math.cos(turn)
    E[0, 2], E[2, 0] = math.sin(turn), -math.sin(turn)
    E[:3, 3] = at
    right = right._replace(T_right_from_left=np.linalg.inv(E).astype(np.float32))
    warped = warped_by(depth[None], left, right)
    return PosedViews(left._replace(image_01=warped.image[0]), (right,)), depth, warped.visible[0]


def warped_by(depth, left, right) -> g.Warped:
    rays = g.plane_rays(depth, [left.camera], [right.camera], [right.T_right_from_left])
    return g.warp_right_to_left(right.image_01[None], depth, rays)


def find_matches(posed):
    return m.match_volume(m.build_cost_volume(posed))


def in_grey(posed: PosedViews) -> PosedViews:
    left, right = (
        view._replace(image_01=view.image_01.mean(0, keepdim=True)) for view in (posed.left, *posed.rights)
    )
    return PosedViews(left, (right,))


@pytest.mark.parametrize(
    ("size", "ahead", "sideways"),
    [(SIZE_MATCHING, 0.4, 0.0), (SIZE_MATCHING, -0.4, 0.1), ((94, 320), -0.4, 0.0), ((144, 96), 0.4, 0.1)],
)
def test_motion_along_the_view_gives_matches(size, ahead, sideways):
    """Behind the left camera no pixel moves further than to the epipole."""
    posed, depth, _ = scene(at=(sideways, 0.0, ahead), size=size)
    matches = find_matches(posed)
    ground_truth = torch.nn.functional.interpolate(depth[None], matches.size, mode="nearest-exact")[0]
    reliable = matches.confidence > 0.5
    assert reliable.float().mean() > 0.3
    assert ((matches.inverse_depth * ground_truth)[reliable] - 1.0).abs().median() < 0.1
    assert not m.inverse_pose_preferred(posed)


@pytest.mark.parametrize("size", [(500, 741), (1988, 2964), (375, 1242)])
def test_a_rectified_pair_stays_one_on_the_grid(size):
    image = torch.rand(1, *size, generator=torch.Generator().manual_seed(0))
    K, T = np.array([[700.0, 0, 300], [0, 700, 200], [0, 0, 1]]), np.eye(4)
    T[0, 3] = -0.2
    few = DEFAULT.changed(planes=24)
    same = posed_of(image, K, (image, K, T))
    assert m.build_cost_volume(same, depth_range=(2.0, 50.0), config=few).rectified


def plain_costs(posed, inverse_depth):
    """The definition: warp the right image by a plane, compare 16 neighbours in floating point."""
    warped = warped_by(torch.full((1, 1, *SIZE_MATCHING), 1 / inverse_depth), posed.left, posed.rights[0])
    votes = []
    for view in (posed.left.image_01, warped.image[0]):
        padded = torch.nn.functional.pad(view[None], (3, 3, 3, 3), mode="replicate")[0, 0]
        window = padded.unfold(0, 7, 1).unfold(1, 7, 1)
        votes.append(((window[:, :, ::2, ::2] - view[0, :, :, None, None]) * 255 / 6).clamp(-1, 1))
    return 0.5 * (votes[0] - votes[1]).abs().mean((-2, -1)), warped.visible[0, 0]


@pytest.mark.parametrize(("turn", "at"), POSES)
@pytest.mark.parametrize("count", [8, 60])
def test_costs_against_the_definition(turn, at, count):
    """``count``: few planes are warped one by one, many are shifted where the pair is rectified."""
    posed = in_grey(scene(turn, at)[0])
    volume = m.sweep_planes(posed, torch.linspace(0.0, 0.4, count))
    for k in (1, count // 2, count - 1):
        expected, visible = plain_costs(posed, float(volume.inverse_depth[k]))
        assert (volume.in_view[k] != visible).float().mean() < 0.03
        both = volume.in_view[k] & visible
        # Away from what is not seen: there, the two repeat different edges.
        both = -torch.nn.functional.max_pool2d(-both[None].float(), 7, 1, 3)[0] > 0
        error = (volume.levels[k] / COST_LEVELS - expected)[both]
        assert both.float().mean() > 0.2
        # A turned view is interpolated twice, and this texture is fine.
        assert error.abs().mean() < (0.02 if turn == 0 else 0.03) and error.mean().abs() < 0.01


@pytest.mark.parametrize("turn", [0.0, 0.06])
@pytest.mark.parametrize("at", [(0.1, 0.05, 0.5), (0.1, -0.05, -0.5)])
def test_what_a_right_camera_sees_of_planes_that_reach_behind_it(turn, at):
    """By projection: with a camera half a metre ahead, planes nearer than that are not seen."""
    grey = in_grey(scene(turn, at)[0])
    K, K_right, T = (
        torch.from_numpy(each)
        for each in (grey.left.camera.K, grey.rights[0].camera.K, grey.rights[0].T_right_from_left)
    )
    volume = m.sweep_planes(grey, torch.linspace(0.0, 8.0, 33))
    rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in SIZE_MATCHING), indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(K.double()).T
    at_infinity, camera = rays @ (K_right @ T[:3, :3]).double().T, (K_right @ T[:3, 3]).double()
    for w, seen in zip(volume.inverse_depth.tolist(), volume.in_view, strict=True):
        u, v, z = (at_infinity + w * camera).unbind(-1)
        inside = (
            (u >= 0)
            & (u <= z * (SIZE_MATCHING[1] - 1))
            & (v >= 0)
            & (v <= z * (SIZE_MATCHING[0] - 1))
            & (z > 0.02)
        )
        assert (seen != inside).float().mean() < 0.03, w
    assert volume.in_view[:6].any() and volume.in_view[-1].any() == (at[2] < 0)


@pytest.mark.parametrize(("turn", "at"), [*POSES[:3], (0.0, (-0.3, 0.0, 0.0))])
def test_matches_in_any_pose(turn, at):
    posed, depth, visible = scene(turn, at)
    matches = find_matches(posed)
    sure = matches.confidence > 0.5
    errors = ((matches.inverse_depth - 1 / depth).abs() / matches.plane_step)[visible & sure]
    assert errors.numel() > 0.4 * visible.sum()
    assert errors.median() < 0.4 and (errors > 3).float().mean() < 0.06
    assert matches.confidence.min() >= 0 and matches.confidence.max() <= 1
    assert torch.isfinite(matches.inverse_depth).all()
    unseen = ~visible & (depth < 5.9)  # off the edge by pixels, not by a rounding error
    assert not unseen.any() or sure[unseen].float().mean() < 0.25


def test_the_memory_of_an_aggregation_serves_the_next_and_the_worst_costs_do_not_overflow():
    generator, buffers = torch.Generator().manual_seed(0), Buffers()
    for planes, height, width in ((7, 6, 9), (2, 1, 8), (12, 9, 3)):
        grey = torch.rand(height, width, generator=generator)
        levels = torch.randint(0, COST_LEVELS + 1, (planes, height, width), generator=generator).byte()
        assert torch.equal(m.aggregate(levels, grey, buffers=buffers), m.aggregate(levels, grey))
    levels = torch.full((4, 30, 40), COST_LEVELS, dtype=torch.uint8)
    levels[0, ::2] = 0
    out = m.aggregate(levels, torch.rand(30, 40, generator=generator))
    assert out.dtype == torch.int16 and out.min() >= 0 and out.max() < NEVER


@pytest.mark.parametrize(("turn", "at"), [(0.0, SIDEWAYS), (0.06, (0.25, 0.1, 0.1))])
def test_swapped_views_and_inverted_poses_are_reported(monkeypatch, turn, at):
    posed, _, _ = scene(turn, at)
    left, (right,) = posed
    assert not m.inverse_pose_preferred(posed)
    inverted = right._replace(T_right_from_left=np.linalg.inv(right.T_right_from_left))
    swapped = right._replace(image_01=left.image_01)
    assert m.inverse_pose_preferred(posed._replace(rights=(inverted,)))
    assert m.inverse_pose_preferred(PosedViews(left._replace(image_01=right.image_01), (swapped,)))
    asked = []
    monkeypatch.setattr(build, "coarse_volume", lambda *given: asked.append(given) or coarse_volume(*given))
    matches = find_matches(posed)
    before = len(asked)
    assert not m.inverse_pose_preferred(posed, matches) and len(asked) == before
    unsure = replace(matches, confidence=0.1 * matches.confidence)
    assert not m.inverse_pose_preferred(posed, unsure) and len(asked) == before + 2


@pytest.mark.parametrize(("turn", "at"), POSES)
def test_a_plane_is_found_by_the_shift_of_the_median_pixel(turn, at):
    """Its inverse depth is rounded up to steps of .05 %, and the shift is that of a projection."""
    posed, _, _ = scene(turn, at)
    (right,), (view,) = posed.rights, parallax_of(posed)
    K, K_right, T = (
        each.astype(float) for each in (posed.left.camera.K, right.camera.K, right.T_right_from_left)
    )
    for wanted_px in (0.4, 3.0, 10.0):
        inverse_depth = view.inverse_depth_at(wanted_px)
        rows, columns = np.indices(SIZE_MATCHING)
        rays = np.stack([columns, rows, np.ones_like(rows)], -1).reshape(-1, 3) @ np.linalg.inv(K).T
        far, near = ((rays @ T[:3, :3].T + w * T[:3, 3]) @ K_right.T for w in (0.0, inverse_depth))
        shift = np.linalg.norm(near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:], axis=1)
        shift = np.where(near[:, 2] > 0, shift, np.inf)
        assert np.median(shift[::13]) == pytest.approx(wanted_px, rel=0.02)
        assert view.median_shift(inverse_depth) == pytest.approx(wanted_px, rel=2e-3)
        assert view.median_shift(inverse_depth / 1.001) < wanted_px <= view.median_shift(inverse_depth)


def test_errors_name_the_argument():
    posed, _, _ = scene()
    (right,) = posed.rights
    away = np.diag([-1.0, 1.0, -1.0, 1.0])
    away[0, 3] = 0.1
    for poses, message in (
        ([np.eye(4)], "E must be a pose with a baseline"),
        ([away], "E must be a pose under which the views overlap"),
        ([right.T_right_from_left, away], "E of right view 2 must be a pose under which the views overlap"),
    ):
        with pytest.raises(ValueError, match=message):
            views = tuple(right._replace(T_right_from_left=pose) for pose in poses)
            m.build_cost_volume(posed._replace(rights=views))
    with pytest.raises(ValueError, match="depth_range"):
        m.build_cost_volume(posed, depth_range=(3.0, 1.0))
