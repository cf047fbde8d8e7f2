"""More than two views, known points, and both: end to end on a rendered scene and the bundled prior."""

import numpy as np
import pytest

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_bundled_prior
from tests.scenes import Camera, render_views, sample_scene
from tests.scenes.cameras import intrinsics
from tests.tiny import seeded

pytestmark = pytest.mark.end_to_end

SIZE = (72, 96)
FAST = {"guidance_steps": 4, "min_steps": 1, "sweep_pixels": 96 * 72}


@pytest.fixture(scope="module")
def group():
    """Views ``(image, K, camera-to-world)``: left, right, below; depth; some of it, 0 where unknown."""
    scene = sample_scene(1, "room")
    K, world = intrinsics(SIZE, scene.fov_deg), scene.T_world_from_camera.double()
    poses = [world, world.clone(), world.clone()]
    for axis in (0, 1):
        poses[1 + axis][:3, 3] += scene.baseline_m * world[:3, axis]
    rendered = render_views(scene, [Camera(K, pose) for pose in poses], SIZE)
    images = [(view.image_01.permute(1, 2, 0).numpy() * 255).round().astype(np.uint8) for view in rendered]
    views = [(image, K.numpy(), pose.numpy()) for image, pose in zip(images, poses, strict=True)]
    depth_m = rendered[0].depth_m[0].numpy()
    known = np.isfinite(depth_m) & (np.random.default_rng(0).random(SIZE) < 0.03)
    return views, depth_m, np.where(known, depth_m, 0)


@pytest.fixture(scope="module")
def run(group):
    """Guided calls on the left view of the group."""
    pipe, left = enable_geometry_guidance(load_bundled_prior()), group[0][0][0]
    return lambda guidance: pipe(left, guidance=guidance, num_inference_steps=1, generator=seeded())


def abs_rel(out, depth_m):
    return np.nanmean(np.abs(out.prediction[0, ..., 0] / np.where(np.isfinite(depth_m), depth_m, np.nan) - 1))


def test_further_views_and_points_in_addition(run, group):
    views, depth_m, sparse = group
    two, twice, three = (
        run(GeometryGuidance.from_views(given, **FAST))
        for given in (views[:2], [*views[:2], views[1]], views)
    )
    np.testing.assert_allclose(twice.prediction, two.prediction, rtol=1e-3)  # a repetition changes nothing
    assert three.visible.mean() > two.visible.mean() and abs_rel(three, depth_m) < 0.2
    both = run(GeometryGuidance.from_views(views[:2], points=sparse, **FAST))
    assert {"points", "matches", "photometric"} <= set(both.history[0].terms)
    assert abs_rel(both, depth_m) < abs_rel(two, depth_m)
    assert abs_rel(both, np.where(sparse > 0, sparse, np.nan)) < 0.05


def test_points_instead_of_a_second_view_as_a_map_or_as_the_cloud_that_projects_to_it(run, group):
    (_, K, _), sparse = group[0][0], group[2]
    out = run(GeometryGuidance.from_points(sparse, K, **FAST))
    assert out.visible is None and out.photometric_error is None and not out.findings
    assert abs_rel(out, group[1]) < 0.2
    assert set(out.history[0].terms) == {"points", "anchor", "affine_reg"}
    rows, columns = sparse.nonzero()
    rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(K).T
    cloud = np.concatenate([rays * sparse[rows, columns, None], [[0.0, 0.0, -1.0]]])
    as_cloud = run(GeometryGuidance.from_points(cloud, K, **FAST))
    np.testing.assert_allclose(as_cloud.prediction, out.prediction, rtol=1e-3)
    outside = "1 points outside the left image are ignored. Check that they are in the left camera's frame."
    assert as_cloud.findings == [outside]


def test_points_of_another_size_than_the_image(run, group):
    (_, K, _), sparse = group[0][0], group[2]
    with pytest.raises(ValueError, match="points must be a map of the left image's 96x72 pixels; got 48x36"):
        run(GeometryGuidance.from_points(sparse[::2, ::2] + 1.0, K, **FAST))
    with pytest.raises(ValueError, match="points must be a list of 1 entries"):
        run(GeometryGuidance(None, K, points=[sparse, sparse], **FAST))
