"""Photographs without poses: cameras, poses, scale, and what cannot be had."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.formats.images import intrinsics_from_exif, intrinsics_from_fov
from geodiff_plugin.pose.estimate import EstimatedPose, _same_unit, estimate_pose, find_scale
from geodiff_plugin.pose.solve import (
    MOST_SPREAD,
    SCALE_PX,
    PosePrior,
    depth_spread,
    solve_poses,
    undetermined_pose,
)
from geodiff_plugin.pose.tracks import Tracks, match_features, solve_inverse_depth
from tests.scenes import render_pair
from tests.unit.test_pose_refine import TRUE, K, angle_deg, make_tracks, pose

pytest.importorskip("poselib")


def test_rotation_and_direction_come_back() -> None:
    tracks, Ts, _ = make_tracks([TRUE], outliers=0.3)
    found = estimate_pose(tracks)
    assert angle_deg(found.T[:3, :3] @ Ts[0, :3, :3].T) < 0.3
    assert found.T[:3, 3] @ Ts[0, :3, 3] / np.linalg.norm(Ts[0, :3, 3]) > 0.999
    assert 0.6 < found.inliers.mean() < 0.8 and found.residual_px < 0.5 and not found.warnings
    assert not found.rectified
    by = np.array([[1.0, 0.08, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # a skew changes nothing
    pixels, Ks = (tracks.left_px @ by[:2, :2].T, tracks.right_px @ by[:2, :2].T), (by @ K, (by @ K)[None])
    np.testing.assert_allclose(estimate_pose(Tracks(*pixels, tracks.seen, *Ks)).T, found.T, atol=1e-6)


def test_a_rectified_pair_is_taken_for_one() -> None:
    tracks, _, _ = make_tracks([pose((0, 0, 0), (0.2, 0, 0))], noise_px=0.3)
    found = estimate_pose(tracks)
    assert found.rectified
    np.testing.assert_array_equal(found.T, [[1, 0, 0, -1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def test_what_carries_no_depth_is_refused() -> None:
    turned, _, _ = make_tracks([pose((1, -6, 2), (1e-5, 0, 0))])
    unrelated, _, _ = make_tracks([TRUE], outliers=1.0, seed=3)
    unrelated.right_px[0] = np.random.default_rng(0).uniform(0, 380, (len(unrelated), 2))
    for tracks, said in (
        (turned, "only turned"),
        (unrelated, "one scene that stands still"),
        (unrelated.kept(slice(12)), "at least 30 matches; got 12"),
        (two_motions(0.45), "two motions"),
    ):
        with pytest.raises(ValueError, match=said):
            estimate_pose(tracks)


def flattened(tracks: Tracks, T: np.ndarray) -> Tracks:
    """The tracks as they would be of a plane 4 m away, parallel to the left image."""
    p = (tracks.rays * 4.0 @ T[:3, :3].T + T[:3, 3]) @ K.T
    return replace(tracks, right_px=(p[:, :2] / p[:, 2:])[None])


def two_motions(share: float) -> Tracks:
    """Tracks of which this share moved on its own: as if another camera had seen them."""
    tracks, _, _ = make_tracks([TRUE, pose((4.0, 3.0, -2.0), (-0.1, 0.25, 0.05))], outliers=0.05)
    apart = np.random.default_rng(0).random(len(tracks)) < share
    right_px = np.where(apart[:, None], tracks.right_px[1], tracks.right_px[0])
    return Tracks(tracks.left_px, right_px[None], tracks.seen[:1], K, tracks.K_rights[:1])


def test_a_plane_little_parallax_and_a_moving_part_are_told() -> None:
    tracks, Ts, _ = make_tracks([TRUE], noise_px=0.2, outliers=0.0)
    near, _, _ = make_tracks([pose((1, -2, 0.5), (0.05, 0.01, 0))], noise_px=0.05, outliers=0.0)
    moved = estimate_pose(two_motions(0.25))
    assert angle_deg(moved.T[:3, :3] @ np.linalg.inv(TRUE)[:3, :3].T) < 0.3, "the larger part decides"
    for warnings, said in (
        (estimate_pose(flattened(tracks, Ts[0])).warnings, "one plane"),
        (estimate_pose(near).warnings, "parallax"),
        (moved.warnings, "motion of their own"),
    ):
        assert any(said in sentence for sentence in warnings)
    assert not any("motion of their own" in sentence for sentence in estimate_pose(two_motions(0.0)).warnings)


def test_each_known_length_gives_the_scale() -> None:
    tracks, Ts, depth_m = make_tracks([TRUE], noise_px=0.05, outliers=0.0, count=900)
    true = float(np.linalg.norm(Ts[0, :3, 3]))
    units = Ts.copy()
    units[0, :3, 3] /= true
    assert find_scale(tracks, units, 1.0, 0.25, None, None).factor == pytest.approx(0.25)
    by_points = find_scale(tracks, units, 1.0, None, None, (tracks.rays * depth_m[:, None])[::10])
    assert by_points.factor == pytest.approx(true, rel=0.02) and by_points.spread < 0.02
    # 200 px of a plane 4 m away and parallel to the image are 200 / 500 * 4 m.
    length = find_scale(flattened(tracks, Ts[0]), units, 1.0, None, (150, 190, 350, 190, 1.6), None)
    assert length.factor == pytest.approx(true, rel=0.01) and length.unit == "m"
    nothing = find_scale(tracks, units, 1.0, None, None, None)
    assert nothing.unit is None and "no unit" in nothing.warnings[0]
    with pytest.raises(ValueError, match=r"got \(9000, 150\) with 0 nearby"):  # as it was typed
        find_scale(tracks, units, 0.5, None, (9000, 150, 350, 190, 1.6), None)
    with pytest.raises(ValueError, match="given once"):
        find_scale(tracks, units, 1.0, 0.25, (0, 0, 1, 1, 1), None)


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=(240, 320), exposure=True, posed=True)


def as_pil(view) -> Image.Image:
    return Image.fromarray(np.rint(view.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8))


def test_photographs_become_a_guidance(pair) -> None:
    E = pair.E.numpy()
    baseline = float(np.linalg.norm(E[:3, 3]))
    photographs = as_pil(pair.left), as_pil(pair.right)
    guidance = GeometryGuidance.from_photographs(*photographs, baseline_m=baseline, K=pair.K_left.numpy())
    found = guidance.rigs[0].E
    assert angle_deg(found[:3, :3].T @ E[:3, :3]) < 0.3
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(baseline, rel=1e-6)
    assert found[:3, 3] @ E[:3, 3] / baseline**2 > 0.995
    assert guidance.unit == "m" and guidance.estimated.inliers[0] > 30
    with pytest.raises(ValueError, match="320x240"):
        guidance.prepare(torch.rand(1, 3, 120, 160))


def test_without_a_length_there_is_no_unit_and_without_K_no_pose(pair) -> None:
    fov = math.degrees(2 * math.atan(160 / float(pair.K_left[0, 0])))
    photographs = as_pil(pair.left), as_pil(pair.right)
    guidance = GeometryGuidance.from_photographs(*photographs, fov=fov)
    assert guidance.unit is None and np.linalg.norm(guidance.rigs[0].E[:3, 3]) == pytest.approx(1.0)
    assert any("no unit" in sentence for sentence in guidance.estimated.warnings)
    assert undetermined_pose(MOST_SPREAD) == ()
    assert "do not determine the estimated pose" in undetermined_pose(1.1 * MOST_SPREAD)[0]
    with pytest.raises(ValueError, match="field of view"):
        GeometryGuidance.from_photographs(*photographs, baseline_m=0.1)


THIRD = pose((2.0, 5.0, -1.0), (-0.25, 0.1, 0.05))


def fitted(tracks: Tracks, Ts: np.ndarray) -> np.ndarray:
    """Poses that nothing but the matches holds, the first baseline as long as it was."""
    free = PosePrior(np.full(len(Ts), 1e3), turned_rad=1.0, shifted_share=10.0, longer_share=1.0)
    solved = solve_poses(tracks, Ts, free, scale_px=SCALE_PX)
    solved[:, :3, 3] *= np.linalg.norm(Ts[0, :3, 3]) / np.linalg.norm(solved[0, :3, 3])
    return solved


@pytest.mark.parametrize(("poses", "noise_px"), [([TRUE], 0.1), ([TRUE, THIRD], 0.4)])
def test_the_spread_is_the_scatter_of_depths_over_photographs(poses, noise_px: float) -> None:
    clean, Ts, _ = make_tracks(poses, 0.0, count=300, outliers=0.0)
    rng = np.random.default_rng(0)
    noise = noise_px * rng.normal(size=(30, *clean.right_px.shape))
    drawn = [replace(clean, right_px=clean.right_px + by_px) for by_px in noise]
    solved = [fitted(tracks, Ts) for tracks in drawn]
    # Depths of the clean matches: what differs is the pose alone.
    inverse = np.stack([solve_inverse_depth(clean, Ts) for Ts in solved])
    scatter = float(np.median((inverse / inverse.mean(0)).std(0)))
    said = np.median([depth_spread(tracks, Ts) for tracks, Ts in zip(drawn, solved, strict=True)])
    assert 0.6 * scatter < said < 1.7 * scatter


def with_exif(size, focal35=None, taken=None) -> Image.Image:
    """A photograph whose EXIF has a focal length in 35 mm equivalent, and the size that it was taken at."""
    image = Image.new("RGB", size)
    entries = image.getexif().get_ifd(0x8769)
    if focal35 is not None:
        entries[0xA405] = focal35
    if taken is not None:
        entries[0xA002], entries[0xA003] = taken
    return image


def test_focal_lengths_of_photographs(tmp_path) -> None:
    found, notes = intrinsics_from_exif(with_exif((2000, 1500), 26, (4000, 3000)), "left")
    assert found[0, 0] == pytest.approx(13 * 5000 / math.hypot(36, 24)) and "26 mm" in notes[0]
    with pytest.raises(ValueError, match="cropped"):
        intrinsics_from_exif(with_exif((3000, 3000), 26, (4000, 3000)), "left")
    with pytest.raises(ValueError, match="no focal length.*--fov"):
        intrinsics_from_exif(with_exif((400, 300)), "left")
    image = with_exif((400, 300), 30)
    exif = image.getexif()
    exif[0x0112] = 6
    image.save(tmp_path / "turned.jpg", exif=exif)
    found, _ = intrinsics_from_exif(tmp_path / "turned.jpg", "left")
    assert (found[0, 2], found[1, 2]) == (149.5, 199.5)
    found = intrinsics_from_fov(90.0, (640, 480))
    assert found[0, 0] == pytest.approx(320.0) and found[1, 2] == 239.5
    with pytest.raises(ValueError, match="fov"):
        intrinsics_from_fov(0.1, (640, 480))


@pytest.mark.parametrize(("ratio", "kept"), [(0.79, True), (0.81, False)])
def test_a_match_is_nearer_than_four_fifths_of_the_next_nearest(ratio: float, kept: bool) -> None:
    """Lowe's test, of distances between unit vectors and not of their squares."""

    def at_distance(distance: float, up: float = 0.0) -> np.ndarray:
        angle = 2 * np.arcsin(distance / 2)
        return np.array([np.cos(angle), np.sin(angle), up], np.float32)

    none = np.zeros((2, 4))
    left = none, np.stack([at_distance(0.0), np.array([0, 0, 1], np.float32)])
    right = none, np.stack([at_distance(0.5), at_distance(0.5 * ratio)])
    assert match_features(left, right).tolist() == ([[0, 1]] if kept else [])


def test_baselines_of_several_views_are_in_units_of_the_first() -> None:
    """Of cameras 0.3 m and 0.75 m away, both estimated with a baseline of 1."""
    at_m = (0.3, 0.75)
    tracks, Ts, _ = make_tracks([pose((0, 2.0 * x, 0), (x, 0.0, 0.1 * x)) for x in at_m], outliers=0.0)
    lengths = np.linalg.norm(Ts[:, :3, 3], axis=1)
    estimated = []
    for T, length in zip(Ts, lengths, strict=True):
        T = T.copy()
        T[:3, 3] /= length
        estimated.append(EstimatedPose(T, np.ones(len(tracks), bool), 1.0, 0.1, False, ()))
    found = _same_unit(tracks, estimated, 1).T
    assert np.linalg.norm(found[:3, 3]) == pytest.approx(lengths[1] / lengths[0], rel=0.01)
    np.testing.assert_allclose(found[:3, :3], Ts[1, :3, :3])
