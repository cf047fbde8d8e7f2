"""Plane sweep, aggregation, left-right check: closed forms on made-up pairs."""

import math
from dataclasses import replace

import pytest
import torch
from kornia.geometry.linalg import inverse_transformation, relative_transformation

from geodiff_plugin import geometry as g
from geodiff_plugin import matching as m
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import build
from geodiff_plugin.matching.aggregation import NEVER, Buffers
from geodiff_plugin.matching.build import pilot_volume
from geodiff_plugin.matching.census import COST_LEVELS
from geodiff_plugin.matching.planes import parallax_of
from geodiff_plugin.types import CameraView, PosedViews
from tests.benchmarks.matching import textured_pair

SIZE = (96, 144)
SIDEWAYS = (0.3, 0.0, 0.0)
POSES = [(0.0, SIDEWAYS), (0.06, (0.25, 0.1, 0.15)), (0.0, (0.0, 0.3, 0.0)), (-0.1, (0.1, 0.0, -0.3))]


def scene(turn=0.0, at=SIDEWAYS, size=SIZE):
    """A right texture, seen from the left at a known depth, for any pose; all on the CPU."""
    _, (texture, K, _), _, depth = textured_pair(size, seed=0)
    E = torch.eye(4)
    E[0, 0] = E[2, 2] = math.cos(turn)
    E[0, 2], E[2, 0] = math.sin(turn), -math.sin(turn)
    E[:3, 3] = torch.tensor(at)
    T = relative_transformation(E[None], torch.eye(4)[None])[0]
    warped = g.warp_right_to_left(texture[None], depth[None], K[None], K[None], T[None])
    return warped.image[0], CameraView(texture, K, T), K, depth, warped.visible[0]


def find_matches(left, rights, K):
    return m.match_volume(m.build_cost_volume(PosedViews(left, tuple(rights), K)))


@pytest.mark.parametrize(
    ("size", "ahead", "sideways"),
    [(SIZE, 0.4, 0.0), (SIZE, -0.4, 0.1), ((94, 320), -0.4, 0.0), ((144, 96), 0.4, 0.1)],
)
def test_motion_along_the_view_gives_matches(size, ahead, sideways):
    """Behind the left camera no pixel moves further than to the epipole."""
    left, right, K, depth, _ = scene(at=(sideways, 0.0, ahead), size=size)
    matches = find_matches(left, [right], K)
    truth = torch.nn.functional.interpolate(depth[None], matches.size, mode="nearest-exact")[0]
    reliable = matches.confidence > 0.5
    assert reliable.float().mean() > 0.3
    assert ((matches.inverse_depth * truth)[reliable] - 1.0).abs().median() < 0.1
    assert not m.inverse_pose_preferred(PosedViews(left, (right,), K))


@pytest.mark.parametrize("size", [(500, 741), (1988, 2964), (375, 1242)])
def test_a_rectified_pair_stays_one_on_the_grid(size):
    image = torch.rand(1, *size, generator=torch.Generator().manual_seed(0))
    K, T = torch.tensor([[700.0, 0, 300], [0, 700, 200], [0, 0, 1]]), torch.eye(4)
    T[0, 3] = -0.2
    few = DEFAULT.changed(planes=24)
    same = PosedViews(image, (CameraView(image, K, T),), K)
    assert m.build_cost_volume(same, depth_range=(2.0, 50.0), config=few).rectified


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
    left, right = left.mean(0, keepdim=True), CameraView(image.mean(0, keepdim=True), K_right, T)
    volume = m.sweep_planes(PosedViews(left, (right,), K), torch.linspace(0.0, 0.4, count))
    for k in (1, count // 2, count - 1):
        expected, visible = plain_costs(left, right, K, float(volume.inverse_depth[k]))
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
    left, (image, K_right, T), K, _, _ = scene(turn, at)
    grey = PosedViews(left.mean(0)[None], (CameraView(image.mean(0)[None], K_right, T),), K)
    volume = m.sweep_planes(grey, torch.linspace(0.0, 8.0, 33))
    rows, columns = torch.meshgrid(*(torch.arange(n).double() for n in SIZE), indexing="ij")
    rays = torch.stack([columns, rows, torch.ones_like(rows)], -1) @ torch.linalg.inv(K.double()).T
    at_infinity, camera = rays @ (K_right @ T[:3, :3]).double().T, (K_right @ T[:3, 3]).double()
    for w, seen in zip(volume.inverse_depth.tolist(), volume.in_view, strict=True):
        u, v, z = (at_infinity + w * camera).unbind(-1)
        inside = (u >= 0) & (u <= z * (SIZE[1] - 1)) & (v >= 0) & (v <= z * (SIZE[0] - 1)) & (z > 0.02)
        assert (seen != inside).float().mean() < 0.03, w
    assert volume.in_view[:6].any() and volume.in_view[-1].any() == (at[2] < 0)


@pytest.mark.parametrize(("turn", "at"), [*POSES[:3], (0.0, (-0.3, 0.0, 0.0))])
def test_matches_in_any_pose(turn, at):
    left, right, K, depth, visible = scene(turn, at)
    matches = find_matches(left, [right], K)
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
def test_swapped_views_and_inverted_poses_are_told(monkeypatch, turn, at):
    left, right, K, _, _ = scene(turn, at)
    posed, inverse = PosedViews(left, (right,), K), inverse_transformation(right.T_right_from_left)
    assert not m.inverse_pose_preferred(posed)
    inverted = right._replace(T_right_from_left=inverse)
    swapped = right._replace(image_01=left)
    assert m.inverse_pose_preferred(posed._replace(views=(inverted,)))
    assert m.inverse_pose_preferred(PosedViews(right.image_01, (swapped,), K))
    asked = []
    monkeypatch.setattr(build, "pilot_volume", lambda *given: asked.append(given) or pilot_volume(*given))
    matches = find_matches(left, [right], K)
    before = len(asked)
    assert not m.inverse_pose_preferred(posed, matches) and len(asked) == before
    unsure = replace(matches, confidence=0.1 * matches.confidence)
    assert not m.inverse_pose_preferred(posed, unsure) and len(asked) == before + 2


@pytest.mark.parametrize(("turn", "at"), POSES)
def test_a_plane_is_found_by_the_shift_of_the_median_pixel(turn, at):
    """Its inverse depth is rounded up to steps of .05 %, and the shift is that of a projection."""
    left, right, K, _, _ = scene(turn, at)
    (view,) = parallax_of(PosedViews(left, (right,), K))
    for wanted_px in (0.4, 3.0, 10.0):
        inverse_depth = view.inverse_depth_at(wanted_px)
        rows, columns = torch.meshgrid(*(torch.arange(n) for n in SIZE), indexing="ij")
        pixels = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1).double().reshape(-1, 3)
        rays = pixels @ torch.linalg.inv(K.double()).T
        places = [
            rays @ right[2][:3, :3].double().T + w * right[2][:3, 3].double() for w in (0.0, inverse_depth)
        ]
        far, near = (p @ right[1].double().T for p in places)
        shift = (near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:]).norm(dim=-1)
        shift = torch.where(near[:, 2] > 0, shift, math.inf)
        assert float(shift[::13].median()) == pytest.approx(wanted_px, rel=0.02)
        assert view.median_shift(inverse_depth) == pytest.approx(wanted_px, rel=2e-3)
        assert view.median_shift(inverse_depth / 1.001) < wanted_px <= view.median_shift(inverse_depth)


def test_errors_name_the_argument():
    left, (texture, K, T), _, _, _ = scene()
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0]))
    away[0, 3] = 0.1
    for poses, message in (
        ([torch.eye(4)], "E must be a pose with a baseline"),
        ([away], "E must be a pose under which the views overlap"),
        ([T, away], "E of right view 2 must be a pose under which the views overlap"),
    ):
        with pytest.raises(ValueError, match=message):
            views = tuple(CameraView(texture, K, pose) for pose in poses)
            m.build_cost_volume(PosedViews(left, views, K))
    with pytest.raises(ValueError, match="depth_range"):
        views = (CameraView(texture, K, T),)
        m.build_cost_volume(PosedViews(left, views, K), depth_range=(3.0, 1.0))
