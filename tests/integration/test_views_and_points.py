"""More than two views, known points, and both: end to end on a rendered scene and the bundled prior."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_bundled_prior
from tests.scenes import Camera, render_views, sample_scene
from tests.scenes.cameras import intrinsics

SIZE = (72, 96)
FAST = {"inner_steps": 4, "min_steps": 1}


@dataclass(frozen=True)
class Group:
    images: list[np.ndarray]  # (H, W, 3) uint8: left, right, below
    K: np.ndarray
    poses: list[np.ndarray]  # camera-to-world
    depth_m: np.ndarray
    sparse: np.ndarray  # (H, W), 0 where unknown


@pytest.fixture(scope="module")
def group() -> Group:
    scene = sample_scene(1, "room")
    K, world = intrinsics(SIZE, scene.fov_deg), scene.T_world_from_camera.double()
    poses = [world]
    for axis in (0, 1):
        E = torch.eye(4, dtype=torch.float64)
        E[axis, 3] = scene.baseline_m
        poses.append(world @ E)
    views = render_views(scene, [Camera(K, pose) for pose in poses], SIZE)
    images = [(view.image_01.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for view in views]
    depth_m = views[0].depth_m[0].numpy()
    known = np.isfinite(depth_m) & (np.random.default_rng(0).random(SIZE) < 0.03)
    return Group(images, K.numpy(), [pose.numpy() for pose in poses], depth_m, np.where(known, depth_m, 0))


@pytest.fixture(scope="module")
def pipe():
    return enable_geometry_guidance(load_bundled_prior())


def views(group, count):
    return [(image, group.K, pose) for image, pose in zip(group.images, group.poses, strict=True)][:count]


def run(pipe, group, guidance, **kwargs):
    return pipe(
        Image.fromarray(group.images[0]),
        guidance=guidance,
        num_inference_steps=1,
        generator=torch.Generator().manual_seed(0),
        **kwargs,
    )


@pytest.fixture(scope="module")
def of_views(pipe, group):
    """Results of the first so many views."""
    return cache(lambda count: run(pipe, group, GeometryGuidance.from_views(views(group, count), **FAST)))


@pytest.fixture(scope="module")
def of_points(pipe, group):
    return run(pipe, group, GeometryGuidance.from_points(group.sparse, group.K, **FAST))


def abs_rel(out, group):
    known = np.isfinite(group.depth_m)
    return np.mean(np.abs(out.prediction[0, ..., 0] / group.depth_m - 1.0)[known])


def test_points_instead_of_a_second_view(of_points, group):
    out = of_points
    assert out.visible is None and out.photometric_error is None and not out.warnings
    np.testing.assert_allclose(out.K[0], group.K, rtol=1e-5)
    assert abs_rel(out, group) < 0.2
    assert set(out.history[0].terms) == {"points", "anchor", "prior_pull"}


def test_a_cloud_is_the_map_that_it_projects_to(pipe, group, of_points):
    rows, columns = group.sparse.nonzero()
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(group.K).T
    cloud = np.concatenate([rays * group.sparse[rows, columns, None], [[0.0, 0.0, -1.0]]])
    as_cloud = run(pipe, group, GeometryGuidance.from_points(cloud, group.K, **FAST))
    np.testing.assert_allclose(as_cloud.prediction, of_points.prediction, rtol=1e-3)
    assert as_cloud.warnings == ["1 points lie behind the left camera or outside its image: left out."]


def test_points_beside_a_second_view(pipe, group, of_views):
    guidance = GeometryGuidance.from_views(views(group, 2), points=group.sparse, **FAST)
    both = run(pipe, group, guidance)
    assert {"points", "matches", "photometric"} <= set(both.history[0].terms)
    assert abs_rel(both, group) < abs_rel(of_views(2), group)
    off = np.abs(both.prediction[0, ..., 0] / np.where(group.sparse > 0, group.sparse, np.nan) - 1.0)
    assert np.nanmedian(off) < 0.02


def test_points_of_another_size_than_the_image(pipe, group):
    with pytest.raises(ValueError, match="points must be a map of the left image's 96x72 pixels; got 48x36"):
        run(pipe, group, GeometryGuidance.from_points(group.sparse[::2, ::2] + 1.0, group.K, **FAST))
    two = GeometryGuidance(None, group.K, points=[group.sparse, group.sparse], **FAST)
    with pytest.raises(ValueError, match="points must be a list of 1 entries"):
        run(pipe, group, two)
