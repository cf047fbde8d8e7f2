"""Tracks: projection, epipolar lines, inverse depth and shared errors; features, flow, and their pixels."""

from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import Camera
from geodiff_plugin.pose import tracks as tracks_module
from geodiff_plugin.pose.tracks import (
    Tracks,
    blocks,
    coarse_depth,
    dense_tracks,
    epipolar,
    grey_image,
    grey_views,
    match_features,
    median_residuals,
    merge_tracks,
    project_tracks,
    residuals_px,
    sift_features,
    solve_inverse_depth,
    sparse_tracks,
    split_residuals,
)
from tests.tiny import render_plane
from tests.unit.pose.posed_scene import (
    K_LEFT,
    K_RIGHTS,
    POSES,
    camera,
    make_scene,
    off_lines,
    pose,
    projected,
)
from tests.views import grey_of, posed_of

VIEWS = pytest.mark.parametrize("v", [0, 1])
SKEWED = (K_LEFT + [[0, 2.5, 0], [0, 0, 0], [0, 0, 0]], K_RIGHTS + [[0, -4.0, 0], [0, 0, 0], [0, 0, 0]])


@VIEWS
def test_points_project_into_each_right_camera_with_exact_derivatives(v):
    scene = make_scene(30, Ks=SKEWED)
    rays, w, K, T = scene.tracks.rays, scene.inverse_depth, SKEWED[1][v], scene.Ts[v]
    np.testing.assert_allclose(rays, scene.points / scene.points[:, 2:], rtol=1e-12)
    at = project_tracks(rays, w, K, T)
    np.testing.assert_allclose(at.px, projected(scene.points, K, T), rtol=1e-10)
    in_right = scene.points @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(at.scaled, in_right * w[:, None], rtol=1e-10)

    def px_of_scaled(scaled: np.ndarray) -> np.ndarray:
        return projected(scaled, K, np.eye(4))

    step = 1e-6
    for axis, along in enumerate(np.eye(3)):
        slope = (px_of_scaled(at.scaled + step * along) - px_of_scaled(at.scaled - step * along)) / (2 * step)
        np.testing.assert_allclose(at.by_point[:, :, axis], slope, rtol=1e-5, atol=1e-5)
    ahead, behind = (projected(rays / (w + change)[:, None], K, T) for change in (step, -step))
    np.testing.assert_allclose(at.by_inverse_depth, (ahead - behind) / (2 * step), rtol=1e-5, atol=1e-5)
    far = project_tracks(rays, np.zeros(30), K, T).px
    np.testing.assert_allclose(far, projected(rays * 1e9, K, T), atol=1e-5)
    in_its_plane = project_tracks(np.array([[1.0, 0.0, 0.0]]), np.zeros(1), K, np.eye(4))
    assert np.isfinite(in_its_plane.px).all() and np.isfinite(in_its_plane.by_point).all()


@VIEWS
def test_the_nearest_point_of_each_epipolar_line_is_found_with_its_depth(v):
    scene = make_scene(60, noise_px=3.0, Ks=SKEWED)
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    at = epipolar(tracks, T)
    nearest = projected(tracks.rays / at.inverse_depth[:, None], SKEWED[1][v], T)
    np.testing.assert_allclose(tracks.right_px[0] + at.off_px[:, None] * at.normals, nearest, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(at.normals, axis=1), 1.0)
    further = projected(tracks.rays / (at.inverse_depth + 0.01)[:, None], SKEWED[1][v], T)
    np.testing.assert_allclose(((further - nearest) * at.normals).sum(1), 0.0, atol=1e-9)
    distance = off_lines(tracks.left_px, tracks.right_px[0], SKEWED[0], SKEWED[1][v], T)
    np.testing.assert_allclose(np.abs(at.off_px), distance, atol=1e-8)
    np.testing.assert_allclose(residuals_px(tracks, T[None])[0], distance, atol=1e-8)
    assert (at.off_px > 0.5).any() and (at.off_px < -0.5).any()


def test_an_epipolar_line_that_is_a_point_leaves_all_values_zero():
    """The camera moves straight ahead, and the match is in the direction that it moves in."""
    at_epipole = K_LEFT[:2, 2][None]
    tracks = Tracks(at_epipole, K_RIGHTS[:1, None, :2, 2], np.ones((1, 1), bool), K_LEFT, K_RIGHTS[:1])
    ahead = np.linalg.inv(pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.5)))
    for values in epipolar(tracks, ahead):
        np.testing.assert_allclose(values, 0.0, atol=1e-6)


def cost_of_depth(scene, w: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Weighted squared reprojection error ``(N,)`` of the observations that are seen."""
    tracks, total = scene.tracks, np.zeros(len(w))
    for v, (K, T) in enumerate(zip(tracks.K_rights, scene.Ts, strict=True)):
        off = projected(tracks.rays / w[:, None], K, T) - tracks.right_px[v]
        total += np.where(tracks.seen[v], weights[v] * (off**2).sum(1), 0.0)
    return total


def test_the_inverse_depth_from_all_views_minimises_the_weighted_reprojection_error():
    scene = make_scene(150, noise_px=2.0, unseen=0.4)
    scene.tracks.right_px[~scene.tracks.seen] = 1e5  # unseen pixels must not count
    ones = np.ones((2, 150))
    weights = np.random.default_rng(1).uniform(0.2, 5.0, ones.shape)
    for used, found in (
        (ones, solve_inverse_depth(scene.tracks, scene.Ts)),
        (weights, solve_inverse_depth(scene.tracks, scene.Ts, weights)),
    ):
        here = cost_of_depth(scene, found, used)
        for change in (2e-4, -2e-4):
            assert (cost_of_depth(scene, found * (1 + change), used) > here).all()
    clean = make_scene(150, unseen=0.4)
    np.testing.assert_allclose(solve_inverse_depth(clean.tracks, clean.Ts), clean.inverse_depth, rtol=1e-6)
    start = tracks_module._linear_inverse_depth(clean.tracks, clean.Ts)
    np.testing.assert_allclose(start, clean.inverse_depth, rtol=1e-6)
    one = solve_inverse_depth(scene.tracks.alone(1), scene.Ts[1:])
    assert (one[~scene.tracks.seen[1]] == 0.0).all() and (one[scene.tracks.seen[1]] > 0.0).all()


def test_residuals_of_several_views_are_reprojection_errors_and_unknown_where_nothing_is_seen():
    scene = make_scene(90, noise_px=0.8, unseen=0.3)
    found = residuals_px(scene.tracks, scene.Ts)
    w = solve_inverse_depth(scene.tracks, scene.Ts)
    for v, (K, T) in enumerate(zip(K_RIGHTS, scene.Ts, strict=True)):
        off = projected(scene.tracks.rays / w[:, None], K, T) - scene.tracks.right_px[v]
        seen = scene.tracks.seen[v]
        np.testing.assert_allclose(found[v, seen], np.linalg.norm(off, axis=1)[seen], atol=1e-8)
        assert np.isnan(found[v, ~seen]).all()


def test_the_median_residual_of_each_view_needs_forty_matches():
    scene = make_scene(90, noise_px=0.8)
    scene.tracks.seen[0, 40:], scene.tracks.seen[1, :51] = False, False  # 40 and 39 of them
    found = median_residuals(scene.tracks, scene.Ts)
    tracks = scene.tracks
    off = off_lines(tracks.left_px[:40], tracks.right_px[0, :40], K_LEFT, K_RIGHTS[0], scene.Ts[0])
    assert found[0] == pytest.approx(np.median(off)) and np.isnan(found[1])


def test_parts_of_tracks_keep_what_belongs_together():
    scene = make_scene(12, unseen=0.5)
    tracks = scene.tracks
    tracks.seen[:, 5] = False
    picked = tracks.kept(np.array([7, 2, 5]))
    np.testing.assert_array_equal(picked.left_px, tracks.left_px[[7, 2, 5]])
    np.testing.assert_array_equal(picked.right_px, tracks.right_px[:, [7, 2, 5]])
    np.testing.assert_array_equal(picked.seen, tracks.seen[:, [7, 2, 5]])
    assert len(tracks.seen_anywhere()) == 11 and tracks.left_px[5] not in tracks.seen_anywhere().left_px
    for v in range(2):
        alone, view = tracks.alone(v), tracks.view(v)
        assert len(alone) == 12 and len(view) == tracks.seen[v].sum() and view.seen.all()
        np.testing.assert_array_equal(alone.right_px, tracks.right_px[v : v + 1])
        np.testing.assert_array_equal(view.right_px[0], tracks.right_px[v, tracks.seen[v]])
        np.testing.assert_array_equal(view.left_px, tracks.left_px[tracks.seen[v]])
        np.testing.assert_array_equal(view.K_rights, K_RIGHTS[v : v + 1])
    both = merge_tracks([picked, tracks.kept(slice(3))])
    np.testing.assert_array_equal(both.left_px, tracks.left_px[[7, 2, 5, 0, 1, 2]])
    np.testing.assert_array_equal(both.right_px, tracks.right_px[:, [7, 2, 5, 0, 1, 2]])
    np.testing.assert_array_equal(both.seen, tracks.seen[:, [7, 2, 5, 0, 1, 2]])


def test_blocks_are_a_tenth_of_the_width_and_numbered_row_by_row():
    scene = make_scene(300)
    side = 2 * K_LEFT[0, 2] / 10  # the principal point is near the middle
    cells = np.floor(scene.tracks.left_px[:, ::-1] / side)
    _, expected = np.unique(cells, axis=0, return_inverse=True)
    np.testing.assert_array_equal(blocks(scene.tracks), expected.ravel())


@VIEWS
def test_residuals_are_split_into_own_noise_and_errors_that_neighbours_share(v):
    scene, rng = make_scene(4000, seed=v), np.random.default_rng(v)
    tracks, T = scene.tracks.alone(v), scene.Ts[v]
    normals = epipolar(tracks, T).normals
    block = blocks(tracks)
    for own, shared in ((0.3, 0.2), (0.3, 0.0), (0.1, 0.5)):
        off = own * rng.normal(size=4000) + shared * rng.normal(size=block.max() + 1)[block]
        off[:200] = 5.0 * np.hypot(own, shared)  # wrong matches
        found = split_residuals(replace(tracks, right_px=tracks.right_px + off[:, None] * normals), T)
        means = [
            off[200:][block[200:] == k].mean() for k in range(block.max() + 1) if (block[200:] == k).any()
        ]
        assert found.faults_px == pytest.approx(np.std(means) if shared else 0.0, abs=0.04)
        per_block = 3800 / (block.max() + 1)
        expected = (own**2 + shared**2) / (own**2 + per_block * shared**2)
        assert found.trust == pytest.approx(expected, rel=0.35) and found.trust <= 1.0


def test_too_few_blocks_leave_all_of_the_residual_to_shared_errors():
    scene = make_scene(400, poses=POSES[:1])
    tracks, T = scene.tracks, scene.Ts[0]
    side, rng = 2 * K_LEFT[0, 2] / 10, np.random.default_rng(0)
    off = rng.normal(size=40) * 0.5
    for cells, is_split in ((2, False), (3, True)):
        corner = np.c_[np.arange(40) % cells, np.full(40, 2)] * side
        left_px = corner + rng.uniform(1, side - 1, (40, 2))
        rays = np.linalg.solve(K_LEFT, np.c_[left_px, np.ones(40)].T).T
        few = Tracks(
            left_px, projected(rays * 4.0, K_RIGHTS[0], T)[None], tracks.seen[:, :40], K_LEFT, K_RIGHTS[:1]
        )
        normals = epipolar(few, T).normals
        few = replace(few, right_px=few.right_px + off[:, None] * normals)
        faults_px = split_residuals(few, T).faults_px
        kept = off[np.abs(off) < 3 * 1.4826 * np.median(np.abs(off))]
        is_all = faults_px == pytest.approx(np.sqrt((kept**2).mean()), rel=1e-6)
        assert bool(is_all) is not is_split


@pytest.mark.parametrize("channels", [1, 3])
def test_a_shrunk_image_keeps_its_outer_edges_and_its_brightness(channels):
    """Sizes do not divide evenly: 101 x 67 becomes 40 x 27."""
    image = torch.full((channels, 67, 101), 0.25)
    image[:, :33] = 0.75
    K = camera(90.0, 110.0, 47.0, 36.0)
    grey, shrunk, _ = grey_image(image, Camera(K), 0.4)
    assert grey.shape == (27, 40) and grey.dtype == np.uint8
    assert (grey[:13] == 191).all() and (grey[14:] == 64).all()
    for corner, at in (((-0.5, -0.5), (-0.5, -0.5)), ((100.5, 66.5), (39.5, 26.5))):
        rays = [np.linalg.solve(k, [*px, 1.0]) for k, px in ((K, corner), (shrunk.K, at))]
        np.testing.assert_allclose(*rays)
    assert shrunk.size == (40, 27)
    same, camera_same, _ = grey_image(image, Camera(K), 1.0)
    assert same.shape == (67, 101) == camera_same.size[::-1] and np.array_equal(camera_same.K, K)
    assert grey_image(image[:, :2], Camera(K), 0.2).grey.shape == (1, 20)


@pytest.mark.parametrize(
    ("right", "focal", "expected"),
    [
        ((10, 900), 1500.0, (6, 499)),  # finer: 832 / 500 px of the focal length are left
        ((10, 300), 400.0, (10, 300)),  # coarser
        ((10, 2000), 832.0, (8, 1664)),  # as fine, and very wide
        ((2000, 20), 832.0, (1664, 17)),
    ],
)
def test_right_images_are_shrunk_to_the_pixels_per_radian_of_the_left_one(right, focal, expected):
    """The left image is 1,000 px wide with a focal length of 1,000 px, of which 832 are used."""
    K_left, K_right = camera(1000.0, 990.0, 480.0, 4.0), camera(focal, 1.1 * focal, right[1] / 2, 5.0)
    rights = (torch.zeros(3, *right), K_right, np.eye(4)), (torch.zeros(3, 10, 500), K_left, np.eye(4))
    views = grey_views(posed_of(torch.zeros(3, 10, 1000), K_left, *rights))
    assert [view.grey.shape for view in views] == [(8, 832), expected, (8, 416)]
    each = zip(views, (K_left, K_right, K_left), (1000, right[1], 500), strict=True)
    for (grey, shrunk, _), K_given, width in each:
        assert shrunk.K[0, 0] == pytest.approx(K_given[0, 0] * grey.shape[1] / width)


def blob(size: tuple[int, int], x: float, y: float, sigma: float = 4.0) -> np.ndarray:
    v, u = np.mgrid[: size[0], : size[1]]
    spot = np.exp(-((u - x) ** 2 + 1.6 * (v - y) ** 2) / (2 * sigma**2))
    return np.clip(40 + 180 * spot, 0, 255).astype(np.uint8)


def test_features_have_their_place_size_angle_and_unit_descriptors():
    grey = blob((90, 120), 71.3, 38.6)
    points, root = sift_features(grey)
    nearest = np.linalg.norm(points[:, :2] - (71.3, 38.6), axis=1).argmin()
    assert points[nearest, :2] == pytest.approx((71.3, 38.6), abs=0.3)
    assert 5.0 < points[nearest, 2] < 20.0  # diameter
    theirs, descriptors = cv2.SIFT.create(contrastThreshold=0.01).detectAndCompute(grey, None)
    assert points[:, 3] == pytest.approx([point.angle for point in theirs])
    np.testing.assert_allclose(root, np.sqrt(descriptors / descriptors.sum(1, keepdims=True)), rtol=1e-4)
    np.testing.assert_allclose((root**2).sum(1), 1.0, rtol=1e-4)
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.integers(0, 256, (90, 120)).astype(np.uint8), (0, 0), 1.0)
    assert len(sift_features(noise, 10)[0]) <= 12 < len(sift_features(noise)[0])
    faint = (128 + (noise.astype(float) - 128) * 0.3).astype(np.uint8)
    assert len(sift_features(faint, contrast=0.06)[0]) < len(sift_features(faint)[0])
    theirs = cv2.SIFT.create(contrastThreshold=0.01).detect(faint, None)
    assert (
        len(sift_features(faint)[0])
        == len(theirs)
        < len(cv2.SIFT.create(contrastThreshold=0).detect(faint, None))
    )
    none = sift_features(np.zeros((40, 40), np.uint8))
    assert none[0].shape == (0, 4) and none[1].shape == (0, 128) and none[1].dtype == np.float32


def test_features_match_if_each_is_nearest_and_the_second_nearest_is_clearly_further():
    rng = np.random.default_rng(4)

    def unit(values: np.ndarray) -> np.ndarray:
        return (values / np.linalg.norm(values, axis=1, keepdims=True)).astype(np.float32)

    shared = rng.random((60, 128))
    left = unit(np.concatenate([shared, rng.random((25, 128))]))
    right = unit(
        np.concatenate(
            [
                (shared + np.linspace(0.3, 2.5, 60)[:, None] * rng.random((60, 128)))[::-1],
                rng.random((40, 128)),
            ]
        )
    )
    none = np.zeros((100, 4))
    found = match_features((none[: len(left)], left), (none, right))
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(left, right, 2)
    back = cv2.BFMatcher(cv2.NORM_L2).match(right, left)
    mutual = {(m.trainIdx, m.queryIdx) for m in back}
    expected = [
        [first.queryIdx, first.trainIdx]
        for first, second in pairs
        if first.distance < 0.8 * second.distance and (first.queryIdx, first.trainIdx) in mutual
    ]
    assert found.tolist() == expected and 5 < len(expected) < 60
    one = (none[:1], right[:1])
    assert match_features((none[: len(left)], left), one).shape == (0, 2)
    assert match_features(one, (none, right)).shape == (0, 2)
    assert len(match_features((none[:2], left[:2]), (none, right))) == (found[:, 0] < 2).sum()


def speckles(size: tuple[int, int], seed: int = 0, sigma: float = 2.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    image = cv2.GaussianBlur(rng.normal(size=size), (0, 0), sigma)
    return cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


@pytest.mark.parametrize("scale", [1.0, 0.6])
def test_sparse_matches_of_several_views_are_in_pixels_of_each_image(scale):
    """Cut out of one image at different places and in different sizes; the last view shows a third of it."""
    whole = speckles((170, 230), sigma=3.0)
    corners, ends = ((12, 9), (3, 20), (110, 4)), ((207, 151), (229, 169), (201, 166))
    cuts = [whole[y:y1, x:x1] for (x, y), (x1, y1) in zip(corners, ends, strict=True)]
    views = [grey_of(np.ascontiguousarray(cut), K) for cut, K in zip(cuts, (K_LEFT, *K_RIGHTS), strict=True)]
    tracks = sparse_tracks(views, scale)
    np.testing.assert_array_equal(tracks.K_left, K_LEFT)
    np.testing.assert_array_equal(tracks.K_rights, K_RIGHTS)
    assert tracks.seen.any(0).all() and (tracks.seen.sum(1) > 12).all()
    for v, corner in enumerate(corners[1:]):
        seen = tracks.seen[v]
        off = tracks.right_px[v, seen] - tracks.left_px[seen] - np.subtract(corners[0], corner)
        assert np.abs(np.median(off, axis=0)).max() < 0.06
        assert np.abs(off).max(1)[np.abs(off).max(1) < 3.0].size > 0.9 * seen.sum()
    assert 4 * tracks.seen[1].sum() < 3 * tracks.seen[0].sum()


def test_pixels_of_a_small_image_keep_the_outer_edges_of_the_large_one():
    large, small = np.zeros((101, 203)), tracks_module._downscaled(np.zeros((101, 203), np.uint8), 0.25)
    assert small.shape == (25, 51)
    found = tracks_module._upscaled(np.array([[-0.5, -0.5], [50.5, 24.5], [25.0, 12.0]]), small, large)
    np.testing.assert_allclose(found, [[-0.5, -0.5], [202.5, 100.5], [101.0, 50.0]])
    assert tracks_module._downscaled(np.zeros((4, 50), np.uint8), 0.1).shape == (1, 5)


def test_flow_leads_from_each_pixel_of_the_source_to_the_target():
    source = speckles((80, 100))
    target = np.roll(source, (2, 5), axis=(0, 1))
    flow = tracks_module._flow(source, target)
    assert np.median(flow[20:-20, 20:-20], axis=(0, 1)) == pytest.approx((5.0, 2.0), abs=0.1)
    v, u = np.mgrid[:80, :100].astype(np.float32)
    ramp = np.stack([2 * u - v, 3 * v], axis=-1)
    at = np.array([[10.25, 20.5], [98.9, 3.0], [0.0, 79.0]])
    expected = np.stack([2 * at[:, 0] - at[:, 1], 3 * at[:, 1]], axis=1)
    np.testing.assert_allclose(tracks_module._read(ramp, at), expected, atol=0.1)


@pytest.mark.parametrize(
    ("there", "back", "spread", "hidden", "holds"),
    [
        ((6.0, -3.0), (-6.0, 3.0), 40.0, False, True),
        ((6.0, -3.0), (-5.6, 3.28), 40.0, False, True),  # comes back to within 0.49 px
        ((6.0, -3.0), (-5.6, 3.32), 40.0, False, False),
        ((23.0, -6.5), (-23.0, 6.5), 40.0, False, True),  # 23.9 px long
        ((23.0, -7.5), (-23.0, 7.5), 40.0, False, False),
        ((6.0, -3.0), (-6.0, 3.0), 2.1, False, True),
        ((6.0, -3.0), (-6.0, 3.0), 1.9, False, False),
        ((6.0, -3.0), (-6.0, 3.0), 40.0, True, False),
    ],
)
def test_a_match_of_flow_has_to_come_back_near_where_it_started_on_texture(
    there, back, spread, hidden, holds, monkeypatch
):
    fields = [np.full((90, 120, 2), each, np.float32) for each in (there, back)]
    flows = iter(zip(fields, ("there", "back"), strict=True))

    def flow(source, target):
        field, way = next(flows)
        assert (source is image, target is image) == (way == "there", way == "back")
        return field

    monkeypatch.setattr(tracks_module, "_flow", flow)
    v, u = np.mgrid[:90, :120].astype(np.float32)
    steps = np.random.default_rng(0).permuted(np.tile([-1, 1], 5400)).reshape(90, 120)
    left = np.clip(np.rint(128 + spread * steps), 0, 255) if spread > 3 else 128 + spread * steps
    visible = np.ones((90, 120), bool)
    centre = np.array([[60, 45]])
    landed = centre + there
    if hidden:
        visible[round(landed[0, 1]), round(landed[0, 0])] = False
    uv = np.stack([1.5 * u + 4.0, 0.5 * v - 2.0], axis=-1)
    image = left.astype(np.float32)
    px, found = tracks_module._dense_matches(image, image.copy(), uv, visible, centre)
    assert found.tolist() == [holds]
    np.testing.assert_allclose(px, landed * [1.5, 0.5] + [4.0, -2.0], atol=1e-3)


def test_flow_that_leaves_the_image_is_no_match(monkeypatch):
    flow = np.zeros((90, 120, 2), np.float32)
    flow[..., 0], flow[..., 1] = 8.0, -5.0
    flows = iter([flow, -flow])
    monkeypatch.setattr(tracks_module, "_flow", lambda *_: next(flows))
    left = speckles((90, 120), sigma=1.0)
    v, u = np.mgrid[:90, :120].astype(np.float32)
    centres = np.array([[111, 45], [112, 45], [60, 5], [60, 4], [3, 80]])
    visible = np.ones((90, 120), bool)
    _, found = tracks_module._dense_matches(left, left, np.stack([u, v], -1), visible, centres)
    assert found.tolist() == [True, False, True, False, True]


PLANE = (np.array([0.25, -0.35, 1.0]), 2.0)
PLANE_K = camera(130.0, 120.0, 61.0, 43.0)
PLANE_K_RIGHTS = (camera(120.0, 135.0, 70.0, 41.0), camera(140.0, 130.0, 52.0, 47.0))
PLANE_SIZES = ((90, 120), (84, 130), (96, 110))
PLANE_POSES = np.stack(
    [pose((1.0, -3.0, 2.0), (0.14, 0.02, 0.01)), pose((-1.5, 2.0, -2.5), (-0.1, 0.06, -0.02))]
)


def plane_views():
    """A tilted plane in three cameras of different sizes, with its depth in the left one."""
    rendered = [
        render_plane(K, E, size, *PLANE, seed=5)
        for K, E, size in zip((PLANE_K, *PLANE_K_RIGHTS), (np.eye(4), *PLANE_POSES), PLANE_SIZES, strict=True)
    ]
    return [image for image, _ in rendered], rendered[0][1]


def test_dense_matches_of_several_views_are_where_the_scene_has_them():
    images, depth = plane_views()
    views = [
        grey_of(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), K)
        for image, K in zip(images, (PLANE_K, *PLANE_K_RIGHTS), strict=True)
    ]
    Ts = np.linalg.inv(PLANE_POSES)
    rough = torch.from_numpy(1.02 * depth)[None, None]
    tracks = dense_tracks(views, rough, Ts)
    np.testing.assert_array_equal(tracks.K_left, PLANE_K)
    np.testing.assert_array_equal(tracks.K_rights, np.stack(PLANE_K_RIGHTS))
    assert set(tracks.left_px[:, 0]) <= set(range(5, 120, 10)) and set(tracks.left_px[:, 1]) <= set(
        range(5, 90, 10)
    )
    at = tracks.left_px.astype(int)
    points = tracks.rays * depth[at[:, 1], at[:, 0], None]
    for v, (K, size) in enumerate(zip(PLANE_K_RIGHTS, PLANE_SIZES[1:], strict=True)):
        seen, px = tracks.seen[v], projected(points, K, Ts[v])
        inside = ((px > 3) & (px < np.array(size[::-1]) - 4)).all(1)
        assert seen.sum() > 0.75 * inside.sum() > 40
        off = np.linalg.norm(tracks.right_px[v] - px, axis=1)[seen]
        assert np.median(off) < 0.1 and np.quantile(off, 0.95) < 0.4
        outside = ((px < -1) | (px > np.array(size[::-1]))).any(1)
        assert not (seen & outside).any()
    turned = np.linalg.inv(pose((0.0, 180.0, 0.0), (0.1, 0.0, 0.0)))  # the plane is behind this camera
    assert not dense_tracks(views[:2], rough, turned[None]).seen.any()


def test_flow_is_asked_only_where_a_right_image_shows_what_is_in_front_of_its_camera(monkeypatch):
    images, depth = plane_views()
    greys = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in images]
    views = [grey_of(*each) for each in zip(greys, (PLANE_K, *PLANE_K_RIGHTS), strict=True)]
    v, u = np.mgrid[:90, :120]
    points = np.linalg.solve(PLANE_K, np.stack([u, v, np.ones_like(u)]).reshape(3, -1)).T * depth.reshape(
        -1, 1
    )
    # The last camera looks back: it would show points mirrored through its centre.
    Ts = np.linalg.inv(np.stack([PLANE_POSES[0], PLANE_POSES[1] @ np.diag([-1.0, 1.0, -1.0, 1.0])]))
    asked = []

    def matches(left, right, uv, visible, centres):
        asked.append((right, uv, visible))
        return np.zeros((len(centres), 2)), np.ones(len(centres), bool)

    monkeypatch.setattr(tracks_module, "_dense_matches", matches)
    dense_tracks(views, torch.from_numpy(depth)[None, None], Ts)
    for (right, uv, visible), K, T, grey in zip(asked, PLANE_K_RIGHTS, Ts, greys[1:], strict=True):
        assert right is grey
        z = points @ T[2, :3] + T[2, 3]
        px = projected(points, K, T)
        inside = ((px >= 0) & (px <= np.array(grey.shape[::-1]) - 1)).all(1)
        assert inside.any()
        if (z > 0).all():
            np.testing.assert_allclose(uv.reshape(-1, 2), px, atol=1e-2)
        assert (visible.ravel() != (inside & (z > 0))).mean() < 0.002


def plain_spread(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Means over growing windows, each with a hundredth of the last one's weight, then over 5 x 5."""

    def mean(of: np.ndarray, window: int) -> np.ndarray:
        half, out = window // 2, np.zeros_like(of)
        for y, x in np.ndindex(of.shape):
            out[y, x] = of[max(y - half, 0) : y + half + 1, max(x - half, 0) : x + half + 1].mean()
        return out

    above, below = values * weight, weight.copy()
    for number, window in enumerate((3, 7, 15, 31, 63), 1):
        above += 0.01**number * mean(values * weight, window)
        below += 0.01**number * mean(weight, window)
    return mean(above / below, 5)


def test_a_rough_depth_spreads_confident_matches_into_holes(monkeypatch):
    rng = np.random.default_rng(0)
    inverse, confidence = rng.uniform(0.1, 0.9, (9, 11)), rng.uniform(0.2, 1.0, (9, 11))
    confidence[2:7, 3:8] = 0.0
    inverse[:, 9:] = 0.0  # the sky: no depth is further than a thousand times the nearest one
    found = Matches(*(torch.from_numpy(each)[None] for each in (inverse, confidence)))
    monkeypatch.setattr(tracks_module, "coarse_volume", lambda posed: posed)
    monkeypatch.setattr(tracks_module, "match_volume", lambda volume: found)
    depth = coarse_depth("views", (9, 11))[0, 0].numpy()
    spread = plain_spread(inverse, confidence**2 + 1e-9)
    np.testing.assert_allclose(depth, 1 / np.maximum(spread, 1e-3 * spread.max()), rtol=1e-4)
    inverse[:] = 0.0
    inverse[0, 0] = 1.0
    confidence[:] = 1.0
    depth = coarse_depth("views", (9, 11))[0, 0].numpy()
    assert depth.max() == pytest.approx(1e3 * depth.min(), rel=1e-4)
    finer = coarse_depth("views", (18, 22))[0, 0].numpy()
    assert finer.shape == (18, 22) and finer[0, 0] == pytest.approx(depth[0, 0])


class Matches(NamedTuple):
    inverse_depth: torch.Tensor
    confidence: torch.Tensor


def test_the_rough_depth_is_that_of_the_scene_without_holes():
    images, depth = plane_views()
    tensors = [torch.from_numpy(image).permute(2, 0, 1).float() / 255 for image in images]
    rights = zip(tensors[1:], PLANE_K_RIGHTS, np.linalg.inv(PLANE_POSES), strict=True)
    found = coarse_depth(posed_of(tensors[0], PLANE_K, *rights), (45, 60))
    assert found.shape == (1, 1, 45, 60) and (found > 0).all()
    ratio = found[0, 0].numpy() / depth.reshape(45, 2, 60, 2).mean((1, 3))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.03) and np.quantile(np.abs(ratio - 1), 0.9) < 0.12


def test_dark_images_are_stretched_and_others_are_matched_as_they_are():
    """A twelfth of the light, in whole grey levels with noise: the same places are found again."""
    rng = np.random.default_rng(4)
    bright = speckles((240, 320), seed=2, sigma=2.5)
    dark = np.clip(np.rint(bright * 0.12 + rng.normal(size=bright.shape) * 0.7), 0, 255).astype(np.uint8)
    found, plain = (
        len(match_features(sift_features(bright), other))
        for other in (sift_features(dark), _plain_features(dark))
    )
    assert found > 60 and found > 1.3 * plain
    for level in (64, 255):  # the brightest percent decides
        image = np.minimum(bright, level).astype(np.uint8)
        assert tracks_module._stretched_if_dark(image) is image
    stretched = tracks_module._stretched_if_dark(np.minimum(bright, 63))
    assert stretched.max() == 255 and stretched.min() == 0 and stretched.dtype == np.uint8


def _plain_features(grey):
    points, descriptors = cv2.SIFT.create(nfeatures=4000, contrastThreshold=0.01).detectAndCompute(grey, None)
    root = np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
    return cv2.KeyPoint.convert(points), root


def test_features_that_reach_into_invalid_pixels_are_dropped():
    valid = np.ones((40, 60), bool)
    valid[:, :20] = False
    view = grey_of(np.zeros((40, 60), np.uint8), PLANE_K)
    px = np.array([[10.0, 20.0], [23.0, 20.0], [23.0, 20.0], [50.0, 5.0]])
    diameter, descriptors = np.array([2.0, 2.0, 9.0, 9.0]), np.arange(8.0).reshape(4, 2)
    for mask, kept in ((valid, [1, 3]), (None, [0, 1, 2, 3])):
        found = tracks_module._valid_features(px, diameter, descriptors, view._replace(valid=mask))
        np.testing.assert_array_equal(found[0], px[kept])
        np.testing.assert_array_equal(found[1], descriptors[kept])


@pytest.mark.parametrize("method", ["sparse", "dense"])
def test_masked_images_are_matched_at_valid_pixels_only(method):
    """Whatever the images show elsewhere: an overlay there would match itself."""
    images, depth = plane_views()
    masks, views = [], []
    overlay = np.random.default_rng(0).integers(0, 255, (90, 30), np.uint8)
    for image, K in zip(images[:2], (PLANE_K, PLANE_K_RIGHTS[0]), strict=True):
        grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        grey[:, :30] = overlay[: len(grey)]
        valid = np.ones(grey.shape, bool)
        valid[:, :30] = False
        masks.append(valid)
        views.append(grey_of(grey, K)._replace(valid=valid))
    Ts = np.linalg.inv(PLANE_POSES[:1])
    if method == "sparse":
        tracks, plain = (
            sparse_tracks(each) for each in (views, [view._replace(valid=None) for view in views])
        )
        assert (plain.left_px[:, 0] < 30).any()
    else:
        tracks = dense_tracks(views, torch.from_numpy(depth)[None, None], Ts)
    assert len(tracks) > 12
    for px, valid in zip((tracks.left_px, tracks.right_px[0]), masks, strict=True):
        column, row = np.rint(px[tracks.seen[0]]).astype(int).T
        assert valid[row, column].all()
