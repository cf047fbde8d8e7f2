"""Every kind of scene keeps the renderer's promises."""

from __future__ import annotations

import pytest
import torch

from tests.scenes import KINDS, Camera, Material, render_views, sample_scene
from tests.scenes.cameras import intrinsics
from tests.scenes.layouts import LAYOUTS
from tests.scenes.scene import Shape

SIZE = (48, 64)
SEEDS = range(3)


@pytest.fixture(scope="module")
def rendered():
    views = {}
    for kind in LAYOUTS:
        for seed in SEEDS:
            scene = sample_scene(seed, kind)
            camera = Camera(intrinsics(SIZE, scene.fov_deg), scene.T_world_from_camera)
            views[kind, seed] = scene, render_views(scene, [camera], SIZE, antialias=False)[0]
    return views


def test_kinds_are_the_table():
    assert KINDS == ("room", "street", "tabletop", "corridor", "terrain")
    assert set(LAYOUTS) == {*KINDS, "plain", "repeated"}
    assert {sample_scene(seed).kind for seed in range(40)} == set(KINDS)


@pytest.mark.parametrize("kind", LAYOUTS)
def test_same_seed_same_scene(kind):
    first, second, other = sample_scene(5, kind), sample_scene(5, kind), sample_scene(6, kind)
    for name, value in vars(first).items():
        twin = getattr(second, name)
        assert torch.equal(value, twin) if torch.is_tensor(value) else value == twin
    assert other.shape.shape != first.shape.shape or not torch.equal(
        other.world_to_local, first.world_to_local
    )


@pytest.mark.parametrize("kind", LAYOUTS)
def test_image_depth_and_masks_are_sound(kind, rendered):
    for seed in SEEDS:
        scene, view = rendered[kind, seed]
        assert scene.kind == kind
        assert torch.isfinite(view.image_01).all()
        assert view.image_01.min() >= 0
        assert view.image_01.max() <= 1
        assert 0.1 < view.image_01.mean() < 0.9
        assert view.image_01.std() > 0.03
        assert torch.equal(view.valid, torch.isfinite(view.depth_m))
        assert torch.equal(view.valid, view.material != int(Material.SKY))
        assert view.valid.float().mean() > 0.25
        assert (view.depth_m > 0.15).float().mean() >= 0.95
        near, far = view.depth_m[view.valid].quantile(0.02), view.depth_m[view.valid].quantile(0.98)
        assert far > 1.2 * near


@pytest.mark.parametrize("kind", LAYOUTS)
def test_camera_stands_in_nothing(kind):
    for seed in range(20):
        scene = sample_scene(seed, kind)
        eye = scene.T_world_from_camera[:3, 3]
        local = scene.world_to_local[:, :, :3] @ eye + scene.world_to_local[:, :, 3]
        solid = scene.shape != int(Shape.QUAD)
        inside = (local.abs() < 1).all(-1) & solid
        ball = scene.shape == int(Shape.SPHERE)
        inside &= ~ball | (local.square().sum(-1) < 1)
        assert not inside.any()
        assert eye[1] < 0  # above the ground


@pytest.mark.parametrize("kind", ["room", "corridor", "tabletop", "plain", "repeated"])
def test_indoors_is_closed(kind, rendered):
    for seed in SEEDS:
        assert rendered[kind, seed][1].valid.all()


def test_sky_is_above_the_ground(rendered):
    for kind in ("street", "terrain"):
        sky = torch.stack([~rendered[kind, seed][1].valid[0] for seed in SEEDS]).float().mean((0, 2))
        assert sky[:8].mean() > sky[-8:].mean()
        assert sky[-4:].max() == 0


def test_all_material_classes_occur(rendered):
    seen = {int(m) for _, view in rendered.values() for m in view.material.unique()}
    for seed in range(12):
        seen |= {int(m) for m in sample_scene(seed, "tabletop").material.unique()}
    assert seen == {int(m) for m in Material}
