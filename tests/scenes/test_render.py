"""Depth, materials and light of hand-made scenes, textures, and what the camera adds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.benchmarks.rendering import main, measure
from tests.scenes import Camera, CameraEffects, Material, render_views, sample_scene
from tests.scenes.builder import Builder, Look
from tests.scenes.cameras import intrinsics, tile, untile
from tests.scenes.effects import apply_effects, sample_effects
from tests.scenes.layouts.ground import crossing, drives, parcels, repairs
from tests.scenes.layouts.plants import thicket
from tests.scenes.layouts.spot import Spot, camera_pose
from tests.scenes.patterns import LAYERS, TEXELS, bake_layer
from tests.scenes.photos import PHOTOS, cover_with_photos
from tests.scenes.render import expose, render_linear, soften
from tests.scenes.scene import Scene, Shape
from tests.scenes.textures import atlas, sample_atlas

GREY = Look("plain", np.full((3, 3), 0.5), macro=0.0)
SIZE = (40, 56)
K = torch.tensor([[50.0, 0, 27.3], [0, 55.0, 18.1], [0, 0, 1]], dtype=torch.float64)


def scene_of(build, pose=None, **rest) -> Scene:
    b = Builder(np.random.default_rng(0))
    build(b)
    t = torch.full((3,), 0.4)
    fields = dict(
        ambient_up=t, ambient_down=t, ao_length_m=1.0, sky=torch.ones(3, 3), sky_clouds=0.0, fog_density=0.0,
        fog_colour=t, fov_deg=60.0, baseline_m=0.1, kind="room", seed=0,
    )  # fmt: skip
    return b.finish(np.eye(4) if pose is None else pose, 0.0, **{**fields, **rest})


def rays() -> torch.Tensor:
    v, u = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    return torch.linalg.inv(K) @ torch.stack([u, v, torch.ones_like(u)]).double().reshape(3, -1)


def test_ground_marks_change_colour_and_not_depth():
    """A camera at a car's height over bare ground and over every kind of mark."""
    pose = camera_pose(0.0, -1.6, 0.0, 0.0, 0.2, 0.0)

    def bare(b):
        b.quad((0, 0, 0), 300, 300, GREY, fixed=True)

    def marked(b):
        bare(b)
        repairs(b, 3.0, 0.0, 5)
        crossing(b, 3.0, 0.0)
        for s in (-1, 1):
            parcels(b, s, 3.0, 0.0, 4)
            drives(b, s, 3.0, 0.0, 3)

    scenes = [scene_of(build, pose) for build in (bare, marked)]
    plain, changed = (render_views(s, [Camera(K, s.T_world_from_camera)], SIZE)[0] for s in scenes)
    ground = plain.valid & (plain.depth_m < 80)
    torch.testing.assert_close(changed.depth_m[ground], plain.depth_m[ground], rtol=0.06, atol=0)
    difference = (changed.image_01 - plain.image_01).abs().amax(0, keepdim=True)
    assert (difference[ground] > 0.05).float().mean() > 0.1


def test_a_thicket_covers_its_slab_and_no_more():
    scene = scene_of(
        lambda b: thicket(Spot(b, 0.0, 12.0, np.pi / 2), 10.0, 3.0, 1.0), camera_pose(0, -1.6, 0, 0, 0, 0)
    )
    view = render_views(scene, [Camera(K, scene.T_world_from_camera)], SIZE)[0]
    seen = view.depth_m[view.valid]
    assert view.valid.float().mean() > 0.2
    assert seen.min() > 9 and seen.max() < 15
    assert seen.std() > 0.1  # ragged, not a wall


def test_depth_of_a_plane_is_exact():
    """Ground 1.5 m under a camera that looks down by 0.4 rad and is turned."""
    pose = camera_pose(0.3, -1.5, -0.2, 0.3, 0.4, 0.1)
    scene = scene_of(lambda b: b.quad((0, 0, 0), 300, 300, GREY, fixed=True), pose)
    view = render_views(scene, [Camera(K, scene.T_world_from_camera)], SIZE)[0]
    down = torch.from_numpy(pose[:3, :3]) @ rays()
    expected = (1.5 / down[1]).reshape(1, *SIZE)
    near = (expected > 0) & (expected < 100)
    assert near.float().mean() > 0.5
    torch.testing.assert_close(view.depth_m[near].double(), expected[near], rtol=2e-5, atol=0)
    sky = expected <= 0
    assert torch.isinf(view.depth_m[sky]).all()
    assert not view.valid[sky].any()
    assert (view.material[sky] == Material.SKY).all()
    assert (view.material[near] == Material.DIFFUSE).all()


def test_depth_of_a_sphere_is_exact():
    scene = scene_of(lambda b: b.ball((0.2, -0.1, 3), 0.8, GREY))
    view = render_views(scene, [Camera(K, torch.eye(4))], SIZE)[0]
    d = rays()
    centre = torch.tensor([0.2, -0.1, 3.0], dtype=torch.float64)[:, None]
    b, a = (d * centre).sum(0), (d * d).sum(0)
    disc = b * b - a * ((centre**2).sum() - 0.64)
    expected = torch.where(disc > 0, (b - disc.clamp_min(0).sqrt()) / a, float("inf")).reshape(1, *SIZE)
    assert torch.equal(torch.isfinite(expected), view.valid)
    torch.testing.assert_close(view.depth_m.double(), expected, rtol=1e-4, atol=0)


def test_depth_is_that_of_mirror_and_glass_surfaces():
    def build(b):
        b.box((0, 0, 6), (20, 20, 0.2), GREY)
        for x, material in ((-1, Material.MIRROR), (1, Material.GLASS)):
            b.box((x, 0, 3), (1, 1, 0.1), Look("plain", np.full((3, 3), 0.5), material=material, gloss=1.0))

    view = render_views(scene_of(build), [Camera(K, torch.eye(4))], SIZE)[0]
    for material in (Material.MIRROR, Material.GLASS):
        mine = view.material == material
        assert mine.sum() > 50
        # The front face; a few pixels see the sides.
        torch.testing.assert_close(view.depth_m[mine].median(), torch.tensor(2.95), rtol=1e-5, atol=0)
        assert view.depth_m[mine].max() < 3.06


def test_mirror_shows_what_is_behind_the_camera():
    red = Look("plain", np.array([[0.9, 0.0, 0.0]] * 3), macro=0.0)

    def build(b):
        b.box(
            (0, 0, 3), (6, 6, 0.1), Look("plain", np.full((3, 3), 0.1), material=Material.MIRROR, gloss=1.0)
        )
        b.box((0, 0, -3), (30, 30, 0.1), red)

    image = render_views(scene_of(build), [Camera(K, torch.eye(4))], SIZE)[0].image_01
    assert image[0].mean() > 3 * image[1].mean()


def test_lamp_lights_the_near_side_and_a_box_casts_a_shadow():
    def build(b):
        b.quad((0, 0, 4), 10, 10, GREY, fixed=True)
        b.box((0, -0.5, 4), (1, 1, 1), GREY)
        b.light((-3, -2, 4), (4, 4, 4))

    pose = camera_pose(0, -4, 0, 0, 0.8, 0)
    scene = scene_of(build, pose, ambient_up=torch.full((3,), 0.05), ambient_down=torch.full((3,), 0.05))
    view = render_linear(
        [scene], [Camera(intrinsics((96, 96), 60), scene.T_world_from_camera)], [0], (96, 96)
    )
    light = view.radiance[0].mean(0)
    row = int(96 * 0.5) + 2
    left, right = light[row, 30:36].mean(), light[row, 62:68].mean()
    assert left > 4 * right


def test_batch_of_scenes_equals_one_by_one():
    scenes = [sample_scene(1, "room"), sample_scene(2, "street"), sample_scene(5, "corridor")]
    cameras = [Camera(intrinsics(SIZE, s.fov_deg), s.T_world_from_camera) for s in scenes]
    together = render_linear(scenes, cameras, [0, 1, 2], SIZE)
    for i, (s, c) in enumerate(zip(scenes, cameras, strict=True)):
        alone = render_linear([s], [c], [0], SIZE)
        torch.testing.assert_close(together.depth_m[i], alone.depth_m[0], rtol=1e-5, atol=1e-5)
        difference = (expose(together.radiance[i : i + 1])[0] - expose(alone.radiance)[0]).abs()
        assert (difference < 1e-3).float().mean() > 0.999


def test_antialiasing_changes_outlines_only():
    scene = sample_scene(3, "tabletop")
    camera = Camera(intrinsics(SIZE, scene.fov_deg), scene.T_world_from_camera)
    plain = render_linear([scene], [camera], [0], SIZE)
    fine = render_linear([scene], [camera], [0], SIZE, antialias=True)
    assert torch.equal(plain.depth_m, fine.depth_m)
    changed = (plain.radiance != fine.radiance).any(1, keepdim=True)
    assert 0.02 < changed.float().mean() < 0.6
    assert not (changed & ~plain.edges).any()
    image = torch.rand(1, 3, *SIZE)
    assert torch.equal(soften(image, torch.zeros(1, 1, *SIZE, dtype=torch.bool)), image)


def test_tiles_round_trip():
    x = torch.rand(2, 3, 21, 30)
    assert torch.equal(untile(tile(x), 2, (21, 30)), x)


def test_render_views_rejects_nonsense():
    scene = sample_scene(0, "room")
    with pytest.raises(ValueError, match="views must be a list of at least one Camera"):
        render_views(scene, [])
    with pytest.raises(ValueError, match="size must be"):
        render_views(scene, [Camera(K, torch.eye(4))], (0, 8))


def test_textures_repeat_without_a_seam():
    """The step over the border of a noise tile is like any other step."""
    for name in ("plain", "fbm", "asphalt", "rock"):
        tone = bake_layer(name, LAYERS[name])[..., 0]
        inner = np.abs(np.diff(tone, axis=1)).mean()
        assert np.abs(tone[:, 0] - tone[:, -1]).mean() < 2 * inner


def test_atlas_lookup_is_bilinear_and_mipmapped():
    table = atlas()
    layer = torch.tensor([LAYERS["fbm"]] * 2)
    texels = torch.tensor([[10.5, 10.0], [20.5, 20.5]]) / TEXELS  # on a texel; half-way between two
    base = torch.from_numpy(bake_layer("fbm", LAYERS["fbm"])).float()
    sharp = sample_atlas(table, layer, texels, torch.full((2,), 1 / TEXELS))
    torch.testing.assert_close(sharp[0], base[20, 10])
    torch.testing.assert_close(sharp[1], (base[20, 9] + base[20, 10]) / 2)
    coarse = sample_atlas(table, layer, texels, torch.full((2,), 10.0))
    assert (coarse[:, 0] - base[..., 0].mean()).abs().max() < 0.2
    whole = sample_atlas(table, layer, texels + 3.0, torch.full((2,), 1 / TEXELS))
    torch.testing.assert_close(whole, sharp, atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", list(LAYERS))
def test_every_layer_is_in_range(name):
    texels = bake_layer(name, LAYERS[name])
    assert texels.shape == (TEXELS, TEXELS, 4)
    assert np.isfinite(texels).all()
    assert texels.min() >= 0
    assert texels.max() <= 1
    assert texels[..., 3].mean() > 0.1


def test_real_images_only_on_request_and_never_the_benchmark_pair():
    assert not any("motorcycle" in name for name in PHOTOS)
    scene = sample_scene(0, "room")
    assert int(scene.layer.max()) < len(LAYERS)
    covered = cover_with_photos(scene, np.random.default_rng(0), 0.5)
    fraction = (covered.layer >= len(LAYERS)).float().mean()
    assert 0.3 < fraction < 0.6
    assert torch.equal(covered.world_to_local, scene.world_to_local)


def test_image_textures_render():
    pytest.importorskip("skimage")
    scene = scene_of(lambda b: b.box((0, 0, 3), (4, 4, 0.1), GREY))
    scene = cover_with_photos(scene, np.random.default_rng(0), 1.0)
    view = render_linear([scene], [Camera(K, torch.eye(4))], [0], SIZE, images=True)
    assert torch.isfinite(view.radiance).all()
    assert view.radiance.std() > 0.01


def test_effects_defaults_change_nothing():
    image = torch.rand(3, 20, 24)
    torch.testing.assert_close(apply_effects(image, CameraEffects()), image)


@pytest.mark.parametrize(
    "change",
    [
        {"white_balance": (1.1, 1.0, 0.9)},
        {"gamma": 1.3},
        {"contrast": 1.4},
        {"saturation": 0.0},
        {"vignette": 0.5},
        {"blur_px": 0.8},
        {"noise": 0.05},
        {"jpeg_quality": 40},
    ],
)
def test_each_effect_acts_and_stays_in_range(change):
    image = torch.rand(3, 32, 40, generator=torch.Generator().manual_seed(0))
    effects = replace(CameraEffects(), **change)
    out = apply_effects(image, effects)
    assert out.shape == image.shape
    assert out.min() >= 0
    assert out.max() <= 1
    assert not torch.allclose(out, image, atol=1e-3)
    assert torch.equal(out, apply_effects(image, effects))
    if change.get("saturation") == 0:
        torch.testing.assert_close(out[0], out[2])


def test_sampled_effects_vary():
    drawn = [sample_effects(np.random.default_rng(i), (96, 128)) for i in range(40)]
    assert 0 < sum(e.saturation == 0 for e in drawn) < 25
    assert len({e.gain for e in drawn}) == 40


def test_frustum_hangs_where_it_is_put():
    """A pole of 2 m on the ground reaches from y = 0 to y = -2."""
    b = Builder(np.random.default_rng(0))
    b.add(Shape.FRUSTUM, (0, -1, 5), (0.1, 1, 0.1), GREY)
    assert b.rows[0][2] == -1
    scene = scene_of(lambda b: b.add(Shape.FRUSTUM, (0, -1, 5), (0.1, 1, 0.1), GREY))
    view = render_views(scene, [Camera(K, torch.eye(4))], SIZE)[0]
    rows = view.valid[0].any(1).nonzero().flatten()
    assert int(rows.max()) == pytest.approx(18.1, abs=1)
    assert int(rows.min()) == 0


def test_benchmark_measures_and_prints(capsys):
    assert set(measure((16, 24), scenes=4)) == {"sample_scene", "render_mono", "render_pair"}
    main(["--sizes", "16x24", "--scenes", "4", "--kind", "corridor"])
    assert "16x24" in capsys.readouterr().out
    with pytest.raises(ValueError, match="scenes must be at least 4"):
        measure((16, 24), scenes=2)
