"""Plane sweep, aggregation, left-right check: closed forms on made-up pairs."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from kornia.geometry.linalg import inverse_transformation, relative_transformation

from geodiff_plugin import geometry as g
from geodiff_plugin import matching as m
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import build
from geodiff_plugin.matching.aggregation import NEVER, Room
from geodiff_plugin.matching.alignment import align_view
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.census import COST_LEVELS, VOTE_LEVELS, census, census_cost, grey_levels
from geodiff_plugin.matching.sweep import inverse_depth_at_shift, median_shift
from tests.benchmarks.matching import textured_pair

SIZE = (96, 144)


def scene(turn=0.0, at=(0.3, 0.0, 0.0), size=SIZE, seed=0, focal=None):
    """A right texture, seen from the left at a known depth, for any pose; all on the CPU."""
    _, (texture, K, _), _, depth = textured_pair(size, seed=seed)
    E = torch.eye(4)
    E[0, 0] = E[2, 2] = math.cos(turn)
    E[0, 2], E[2, 0] = math.sin(turn), -math.sin(turn)
    E[:3, 3] = torch.tensor(at)
    T = relative_transformation(E[None], torch.eye(4)[None])[0]
    warped = g.warp_right_to_left(texture[None], depth[None], K[None], K[None], T[None])
    return warped.image[0], (texture, K, T), K, depth, warped.visible[0]


@pytest.fixture(scope="module")
def rectified():
    left, right, K, depth, visible = scene()
    volume = m.build_cost_volume(left, [right], K)
    return left, right, K, depth, visible, volume, m.match_volume(volume)


def find_matches(left, rights, K):
    return m.match_volume(m.build_cost_volume(left, rights, K))


def relative_errors(matches, depth, mask):
    mask = mask & (matches.confidence > 0.5)
    return ((matches.inverse_depth - 1 / depth).abs() / matches.plane_step)[mask]


MOTIONS = [(SIZE, 0.4, 0.0), (SIZE, -0.4, 0.1), ((94, 320), -0.4, 0.0), ((144, 96), 0.4, 0.1)]


@pytest.mark.parametrize(("size", "ahead", "sideways"), MOTIONS)
def test_motion_along_the_view_gives_matches(size, ahead, sideways):
    """Behind the left camera no pixel moves further than to the epipole."""
    left, right, K, depth, visible = scene(at=(sideways, 0.0, ahead), size=size)
    matches = find_matches(left, [right], K)
    truth = torch.nn.functional.interpolate(depth[None], matches.size, mode="nearest-exact")[0]
    reliable = matches.confidence > 0.5
    assert reliable.float().mean() > 0.3
    assert ((matches.inverse_depth * truth)[reliable] - 1.0).abs().median() < 0.1
    assert not m.mirrored_pose_preferred(left, [right], K)


@pytest.mark.parametrize("size", [(500, 741), (1988, 2964), (375, 1242)])
def test_a_rectified_pair_stays_one_on_the_grid(size):
    image = torch.rand(1, *size, generator=torch.Generator().manual_seed(0))
    K, T = torch.tensor([[700.0, 0, 300], [0, 700, 200], [0, 0, 1]]), torch.eye(4)
    T[0, 3] = -0.2
    assert m.build_cost_volume(
        image, [(image, K, T)], K, depth_range=(2.0, 50.0), config=DEFAULT.changed(planes=24)
    ).rectified


def test_a_range_behind_the_right_camera_is_swept():
    left, right, K, _, _ = scene(at=(0.5, 0.0, 5.0))
    assert m.build_cost_volume(left, [right], K, depth_range=(1.0, 4.0)).cost.isfinite().all()


def described(image):
    """``census`` of a grey image ``(1, H, W)``, its edges repeated."""
    padded = torch.nn.functional.pad(image[None], (3, 3, 3, 3), mode="replicate")[0, 0]
    return census(grey_levels(padded))


def test_census_ignores_exposure():
    image = torch.rand(1, 20, 30, generator=torch.Generator().manual_seed(0)) * 0.4
    votes = described(image)
    assert votes.shape == (16, 20, 30) and votes.abs().max() == VOTE_LEVELS
    assert (described(image + 0.3) - votes).abs().max() <= 1  # by rounding
    assert census_cost(votes, votes).max() == 0
    assert census_cost(votes, described(1.3 * image + 0.05)).float().mean() < 0.03 * COST_LEVELS
    other = described(torch.rand(1, 20, 30, generator=torch.Generator().manual_seed(1)))
    cost = census_cost(votes, other)
    # pure noise; real texture that differs: about 0.35
    assert cost.dtype == torch.uint8 and 0.4 < cost.float().mean() / COST_LEVELS < 0.6
    assert torch.equal(census_cost(votes.to(torch.int8), other.to(torch.int8)), cost)
    worst = torch.full((16, 2, 2), VOTE_LEVELS, dtype=torch.int8)
    assert (census_cost(worst, -worst) == COST_LEVELS).all() and COST_LEVELS <= 255


POSES = [(0.0, (0.3, 0.0, 0.0)), (0.06, (0.25, 0.1, 0.15)), (0.0, (0.0, 0.3, 0.0)), (-0.1, (0.1, 0.0, -0.3))]


@pytest.mark.parametrize(("turn", "at"), POSES)
def test_rows_and_columns_of_planes_against_the_projection(turn, at):
    """What scale and shift read of an aligned view is what the projection reads of the right image."""
    left, right, K, _, _ = scene(turn, at)
    planes = torch.tensor([0.0, 0.1, 0.3])
    view = align_view((right[0][:1], *right[1:]), K, SIZE, planes)
    ramp = torch.stack(torch.meshgrid(*(torch.arange(n) / n for n in SIZE), indexing="ij"))
    rays = g.plane_rays(K[None], right[1][None], right[2][None], SIZE)
    for axis in (0, 1):  # an image that is its own coordinates says where it was read
        turned = align_view((ramp[1 - axis][None], *right[1:]), K, SIZE, planes)
        columns, rows = turned.positions(SIZE[1], 0), turned.positions(SIZE[0], 1)
        for k in (1, 2):
            uv, _ = g.project_rays(torch.full((1, 1, *SIZE), 1 / float(planes[k])), rays)
            expected = g.sample_at(ramp[1 - axis][None, None], uv)[0, 0]
            grid = torch.stack(torch.meshgrid(rows[k], columns[k], indexing="ij")[::-1], -1)
            read = g.sample_at(turned.grey[None, None], grid[None])[0, 0]
            inside = turned.inside(rows, 1)[k][:, None] & turned.inside(columns, 0)[k]
            if turned.valid is not None:
                inside &= g.sample_at(turned.valid[None, None].float(), grid[None])[0, 0] > 0.999
            assert inside.float().mean() > 0.3
            assert ((read - expected).abs()[inside] * SIZE[1 - axis]).max() < 0.1  # pixels
    assert (view.valid is None) == (turn == 0.0)


@pytest.mark.parametrize(("turn", "at"), POSES)
def test_the_way_back_from_an_aligned_view(turn, at):
    _, right, K, _, _ = scene(turn, at)
    view = align_view((right[0][:1], *right[1:]), K, SIZE, torch.tensor([0.05, 0.2]))
    for axis, count in ((0, SIZE[1]), (1, SIZE[0])):
        there, back = view.positions(count, axis), view.sources(count, axis)
        for k in (0, 1):
            shown = back[k] < count
            assert shown.sum() > 0.3 * count
            lines = torch.arange(len(shown))[shown]
            assert (there[k][back[k][shown]] - lines).abs().max() <= 0.51 * float(view.scale[k])


def plain_costs(left, right, K, inverse_depth):
    """The definition: warp the right image by a plane, compare 16 neighbours in floating point."""
    image, K_right, T = right
    depth = torch.full((1, 1, *SIZE), 1 / inverse_depth)
    warped = g.warp_right_to_left(image[None], depth, K[None], K_right[None], T[None])
    votes = []
    for view in (left, warped.image[0]):
        padded = torch.nn.functional.pad(view[None], (3, 3, 3, 3), mode="replicate")[0, 0]
        window = padded.unfold(0, 7, 1).unfold(1, 7, 1)
        votes.append(((window[:, :, ::2, ::2] - view[0, :, :, None, None]) * 255 / 6).clamp(-1, 1))
    return 0.5 * (votes[0] - votes[1]).abs().mean((-2, -1)), warped.visible[0, 0]


@pytest.mark.parametrize(("turn", "at"), POSES)
@pytest.mark.parametrize("count", [8, 60])
def test_costs_against_the_definition(turn, at, count):
    """``count``: few planes are warped one by one, many are shifted where the pair is rectified."""
    left, (image, K_right, T), K, _, _ = scene(turn, at)
    left, right = left.mean(0, keepdim=True), (image.mean(0, keepdim=True), K_right, T)
    volume = m.sweep_planes(left, [right], K, torch.linspace(0.0, 0.4, count))
    for k in (1, count // 2, count - 1):
        expected, visible = plain_costs(left, right, K, float(volume.inverse_depth[k]))
        assert (volume.in_view[k] != visible).float().mean() < 0.03
        both = volume.in_view[k] & visible
        # Away from what is not seen: there, the two repeat different edges.
        both = -torch.nn.functional.max_pool2d(-both[None].float(), 7, 1, 3)[0] > 0
        error = (volume.cost[k] - expected)[both]
        assert both.float().mean() > 0.2
        # A turned view is interpolated twice, and this texture is fine.
        assert error.abs().mean() < (0.02 if turn == 0 else 0.03) and error.mean().abs() < 0.01


def test_median_shift_is_f_b_over_z_and_does_not_count_rotation():
    _, (_, K, T), _, _, _ = scene()
    expected = K[0, 0] * 0.3 * torch.tensor([0.0, 0.25, 1.0])
    rays = g.plane_rays(K[None], K[None], T[None], SIZE)
    torch.testing.assert_close(
        median_shift(rays, torch.tensor([0.0, 0.25, 1.0])), expected, atol=1e-2, rtol=1e-3
    )
    assert float(inverse_depth_at_shift(rays, 10.0) * K[0, 0] * 0.3) == pytest.approx(10.0, rel=0.01)
    _, (_, _, turned), _, _, _ = scene(turn=0.2)
    shifts = median_shift(g.plane_rays(K[None], K[None], turned[None], SIZE), torch.tensor([0.0, 0.25]))
    assert shifts[0] == 0 and shifts[1] == pytest.approx(float(expected[1]), rel=0.3)


def test_planes_reach_what_is_there_and_not_much_further(rectified):
    _, _, _, depth, visible, volume, _ = rectified
    nearest = 1 / depth[visible].min()
    assert nearest < volume.inverse_depth[-1] < 2.5 * nearest


@pytest.mark.parametrize(
    ("turn", "at"),
    [(0.0, (0.3, 0.0, 0.0)), (0.0, (-0.3, 0.0, 0.0)), (0.06, (0.25, 0.1, 0.15)), (0.0, (0.0, 0.3, 0.0))],
)
def test_matches_in_any_pose(turn, at):
    left, right, K, depth, visible = scene(turn, at)
    matches = find_matches(left, [right], K)
    errors = relative_errors(matches, depth, visible)
    assert errors.numel() > 0.4 * visible.sum()
    assert errors.median() < 0.4 and (errors > 3).float().mean() < 0.06
    assert matches.confidence.min() >= 0 and matches.confidence.max() <= 1
    assert torch.isfinite(matches.inverse_depth).all()


def test_what_the_right_view_does_not_see_has_no_confidence(rectified):
    _, _, _, depth, visible, _, matches = rectified
    unseen = ~visible & (depth < 5.9)  # off the edge by pixels, not by a rounding error
    assert unseen.any()
    assert (matches.confidence[unseen] > 0.5).float().mean() < 0.25
    assert (matches.confidence[visible] > 0.5).float().mean() > 0.6


def test_noise_has_few_matches():
    generator = torch.Generator().manual_seed(0)
    left, right = torch.rand(2, 3, *SIZE, generator=generator)
    _, (_, K, T), _, _, _ = scene()
    matches = find_matches(left, [(right, K, T)], K)
    assert matches.confidence.mean() < 0.2


def test_other_size_and_intrinsics_of_the_right_view():
    left, (texture, K, T), _, depth, visible = scene()
    large = torch.nn.functional.interpolate(texture[None], scale_factor=2, mode="bicubic")[0].clamp(0, 1)
    K_large = g.resize_intrinsics(K[None], SIZE, (2 * SIZE[0], 2 * SIZE[1]))[0]
    matches = find_matches(left, [(large, K_large, T)], K)
    errors = relative_errors(matches, depth, visible)
    assert errors.numel() > 0.4 * visible.sum() and errors.median() < 0.5


def test_large_images_are_shrunk_and_K_with_them():
    left, (texture, K, T), _, _, _ = scene()
    bounded = m.build_cost_volume(left, [(texture, K, T)], K, config=DEFAULT.changed(sweep_pixels=4000))
    assert bounded.size[0] * bounded.size[1] <= 4100
    volume = m.build_cost_volume(left, [(texture, K, T)], K, config=DEFAULT.changed(sweep_pixels=48 * 72))
    assert volume.size == (48, 72) and volume.left_01.shape == (1, 48, 72)
    torch.testing.assert_close(volume.K, g.resize_intrinsics(K[None], SIZE, (48, 72))[0])
    assert volume.rights[0][0].shape == (1, 48, 72)


def test_depth_range_and_number_of_planes(monkeypatch):
    left, right, K, _, _ = scene()
    monkeypatch.setattr(build, "PLANE_STEP_PX", 0.1)
    volume = m.build_cost_volume(left, [right], K, depth_range=(1.0, 20.0), config=DEFAULT.changed(planes=40))
    assert len(volume.inverse_depth) == 40
    assert volume.inverse_depth[0] == pytest.approx(0.05) and volume.inverse_depth[-1] == pytest.approx(1.0)


def test_a_third_view_sees_what_the_second_does_not():
    """Left and right of the left camera: together they cover both edges."""
    _, (texture, K, _), _, depth = textured_pair(SIZE)
    pairs = [scene(at=(x, 0.0, 0.0)) for x in (0.3, -0.3)]
    # one left image for both: re-render each right view from it where it is seen, noise elsewhere
    left = pairs[0][0]
    right = pairs[0][1]
    T_other = pairs[1][1][2]
    other = forward_view(left, depth, K, T_other)
    two = find_matches(left, [right], K)
    three = find_matches(left, [right, (other, K, T_other)], K)
    unseen = ~pairs[0][4] & (depth < 5.9)
    assert (three.confidence[unseen] > 0.5).float().mean() > (
        two.confidence[unseen] > 0.5
    ).float().mean() + 0.2
    errors = relative_errors(three, depth, torch.ones_like(unseen))
    assert errors.median() < 0.5 and (errors > 3).float().mean() < 0.1


def forward_view(left, depth, K, T):
    """Nearest-pixel splat of the left image into another view, far to near; noise in the holes."""
    uv, z = g.project_rays(depth[None], g.plane_rays(K[None], K[None], T[None], SIZE))
    image = torch.rand(3, SIZE[0] * SIZE[1], generator=torch.Generator().manual_seed(9))
    order = z.flatten().argsort(descending=True)
    column, row = uv[0].round().long().flatten(0, 1)[order].unbind(-1)
    inside = (column >= 0) & (column < SIZE[1]) & (row >= 0) & (row < SIZE[0])
    for at, source in zip((row * SIZE[1] + column)[inside].tolist(), order[inside].tolist(), strict=True):
        image[:, at] = left.flatten(1)[:, source]
    return image.view(3, *SIZE)


def test_the_memory_of_an_aggregation_serves_the_next_and_the_worst_costs_do_not_overflow():
    generator, room = torch.Generator().manual_seed(0), Room()
    for planes, height, width in ((7, 6, 9), (5, 4, 6), (2, 1, 8), (12, 9, 3)):
        grey = torch.rand(height, width, generator=generator)
        levels = torch.randint(0, COST_LEVELS + 1, (planes, height, width), generator=generator).byte()
        out = m.aggregate(levels, grey, room=room)
        assert out.dtype == torch.int16 and torch.equal(out, m.aggregate(levels, grey))
    levels = torch.full((4, 30, 40), COST_LEVELS, dtype=torch.uint8)
    levels[0, ::2] = 0
    out = m.aggregate(levels, torch.rand(30, 40, generator=generator))
    assert out.min() >= 0 and out.max() < NEVER


def test_with_few_reliable_matches_the_planes_reach_as_near_as_the_coarse_sweep(monkeypatch):
    left, right, K, _, _ = scene()

    def nearest() -> float:
        return float(m.build_cost_volume(left, [right], K).inverse_depth[-1])

    usual = nearest()
    monkeypatch.setattr(build, "PILOT_LEAST_SHARE", 1.0)
    assert nearest() > usual


def test_a_pose_that_matches_plainly_is_not_turned(rectified, monkeypatch):
    left, right, K, *_, matches = rectified
    asked = []
    monkeypatch.setattr(build, "pilot_volume", lambda *given: asked.append(given) or pilot_volume(*given))
    assert not m.mirrored_pose_preferred(left, [right], K, matches) and not asked
    unsure = replace(matches, confidence=0.1 * matches.confidence)
    assert not m.mirrored_pose_preferred(left, [right], K, unsure) and len(asked) == 2


@pytest.mark.parametrize(("turn", "at"), [(0.0, (0.3, 0.0, 0.0)), (0.06, (0.25, 0.1, 0.1))])
def test_swapped_views_and_inverted_poses_are_told(turn, at):
    left, (texture, K, T), _, _, _ = scene(turn, at)
    assert not m.mirrored_pose_preferred(left, [(texture, K, T)], K)
    inverse = inverse_transformation(T)
    assert m.mirrored_pose_preferred(left, [(texture, K, inverse)], K)
    assert m.mirrored_pose_preferred(texture, [(left, K, T)], K)


def test_errors_name_the_argument():
    left, (texture, K, T), _, _, _ = scene()
    with pytest.raises(ValueError, match="E must be a pose with a baseline"):
        m.build_cost_volume(left, [(texture, K, torch.eye(4))], K)
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away[0, 3] = 0.1
    with pytest.raises(ValueError, match="E must be a pose under which the views overlap"):
        m.build_cost_volume(left, [(texture, K, away)], K)
    with pytest.raises(ValueError, match="E of right view 2 must be a pose under which the views overlap"):
        m.build_cost_volume(left, [(texture, K, T), (texture, K, away)], K)
    with pytest.raises(ValueError, match="depth_range"):
        m.build_cost_volume(left, [(texture, K, T)], K, depth_range=(3.0, 1.0))


def test_blank_images_fall_back_to_the_whole_range():
    _, (_, K, T), _, _, _ = scene()
    blank = torch.full((3, *SIZE), 0.5)
    volume = m.build_cost_volume(blank, [(blank, K, T)], K)
    whole = pilot_volume(blank, [(blank, K, T)], K)
    assert volume.inverse_depth[-1] == pytest.approx(float(whole.inverse_depth[-1]), rel=0.02)
    matches = m.match_volume(volume)
    assert torch.isfinite(matches.inverse_depth).all() and matches.confidence.mean() < 0.1
