"""Cameras of images without poses: whose K is taken, and what gives the poses their unit."""

import math
from dataclasses import FrozenInstanceError
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base

from geodiff_plugin._internal.checks import InputError, UnknownPoseError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence import unposed as module
from geodiff_plugin.evidence.unposed import KnownLengths, estimate_rig
from geodiff_plugin.findings import Finding
from geodiff_plugin.pose.estimate import EstimatedPose
from geodiff_plugin.pose.tracks import Tracks

SIZES = (450, 832), (350, 550), (450, 832)  # of a left and two right images
KS = [
    np.array([[650.0, 0, 405.0], [0, 625.0, 235.0], [0, 0, 1]]),
    np.array([[450.0, 0, 270.0], [0, 465.0, 165.0], [0, 0, 1]]),
    np.array([[675.0, 0, 400.0], [0, 635.0, 220.0], [0, 0, 1]]),
]
FACTORS = 0.6, 0.8, 0.6  # of the grids on which matches are sought
BASELINE_M = 0.35
PHOTOS = [np.random.default_rng(i).integers(0, 255, (*size, 3), np.uint8) for i, size in enumerate(SIZES)]


def on_grid(K: np.ndarray, factor: float) -> np.ndarray:
    scaled = np.diag([factor, factor, 1.0]) @ K
    scaled[:2, 2] += 0.5 * factor - 0.5
    return scaled


def turn(x: float, y: float, z: float) -> np.ndarray:
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).double()).numpy()


def true_poses() -> list[np.ndarray]:
    """In metres; the first right camera is ``BASELINE_M`` from the left one."""
    poses = [np.eye(4), np.eye(4)]
    poses[0][:3, :3], poses[1][:3, :3] = turn(0.02, -0.05, 0.03), turn(-0.04, 0.1, 0.02)
    poses[0][:3, 3] = BASELINE_M * np.array([0.48, -0.64, 0.6])
    poses[1][:3, 3] = -0.5, 0.12, 0.1
    return poses


def scene(right_views: int = 2):
    """Tracks of a wall that recedes to the right, on the grids, and poses in units of the first baseline."""
    rng = np.random.default_rng(3)
    K = on_grid(KS[0], FACTORS[0])
    left_px = np.stack([rng.uniform(0, 498, 1500), rng.uniform(0, 269, 1500)], 1)
    rays = np.c_[left_px, np.ones(1500)] @ np.linalg.inv(K).T
    points = rays * wall_m(rays[:, 0])[:, None]
    Ts = [np.linalg.inv(E) for E in true_poses()[:right_views]]
    K_rights = np.stack([on_grid(K, f) for K, f in zip(KS[1:], FACTORS[1:], strict=True)][:right_views])
    right_px = []
    for T, K_right in zip(Ts, K_rights, strict=True):
        p = (points @ T[:3, :3].T + T[:3, 3]) @ K_right.T
        right_px.append(p[:, :2] / p[:, 2:])
    seen = np.ones((right_views, 1500), bool)
    units = np.stack(Ts)
    units[:, :3, 3] /= BASELINE_M
    return Tracks(left_px, np.stack(right_px), seen, K, K_rights), units


def wall_m(x: np.ndarray) -> np.ndarray:
    """Depth of the wall along rays ``(x, y, 1)``."""
    return 4.0 / (1 - 0.6 * x)


def posed(v: int, **changes) -> EstimatedPose:
    inliers = np.arange(1500) < (1100, 900)[v]
    of_view = {"parallax_deg": (4.5, 6.5)[v], "residual_px": (0.31, 0.42)[v], "rectified": False}
    findings = (Finding("estimate.parallax", f"View {v + 1}."),)
    return EstimatedPose(np.eye(4), inliers, **of_view | {"findings": findings} | changes)


@pytest.fixture
def solved(monkeypatch):
    """Poses and tracks of the scene in place of those that matching would find, and what was asked for."""
    asked = {}
    tracks, units = scene()

    def solve(photos, Ks, matcher):
        asked.update(images=photos.images, valid=photos.valid, Ks=Ks, matcher=matcher)
        return module._Solved(units, [posed(0), posed(1)], tracks, 0.034)

    monkeypatch.setattr(
        module, "cleaned", lambda images, masks, config: asked.update(raw=images, config=config) or "clean"
    )
    monkeypatch.setattr(module, "_solve", solve)
    return asked


def point_at(pixel: np.ndarray) -> np.ndarray:
    ray = np.linalg.solve(KS[0], (*pixel, 1.0))
    return ray * wall_m(ray[0])


PIXELS = np.array([[150.0, 100.0], [650.0, 350.0]])
LENGTH_M = float(np.linalg.norm(point_at(PIXELS[0]) - point_at(PIXELS[1])))


def cloud() -> np.ndarray:
    """Points on the wall, metres, and one behind the camera."""
    v, u = np.mgrid[10:440:20, 10:820:20]
    return np.array(
        [point_at(pixel) for pixel in zip(u.ravel(), v.ravel(), strict=True)] + [(0.0, 0.0, -2.0)]
    )


def sparse_map(size: tuple[int, int]) -> np.ndarray:
    """Depths of some pixels of a map of another resolution than the left image's."""
    depth = np.zeros(size, np.float32)
    for row in range(3, size[0], 9):
        for column in range(3, size[1], 9):
            u, v = ((np.array([column, row]) + 0.5) * np.array(SIZES[0][::-1]) / size[::-1]) - 0.5
            depth[row, column] = point_at((u, v))[2]
    return depth


@pytest.mark.parametrize(
    ("known", "source", "rel"),
    [
        (KnownLengths(BASELINE_M, None, None), "baseline", 1e-9),
        (KnownLengths(None, (*PIXELS.ravel(), LENGTH_M), None), "known length", 0.02),
        (KnownLengths(None, None, cloud().astype(np.float32)), "points", 5e-3),
        (KnownLengths(None, None, sparse_map((225, 400))), "points", 5e-3),
        (KnownLengths(BASELINE_M, None, cloud().astype(np.float32)), "baseline", 1e-9),
        (KnownLengths(None, None, None), "none", 1e-9),
    ],
)
def test_each_length_gives_all_poses_their_metres(solved, known, source, rel):
    """Pixels and depths are those of the images, which are larger than the grids of the tracks."""
    rig = estimate_rig(PHOTOS, known, K=KS)
    unit = 1.0 if source != "none" else 1 / BASELINE_M
    for E, expected in zip(rig.Es, true_poses(), strict=True):
        np.testing.assert_allclose(E[:3, :3], expected[:3, :3], atol=1e-9)
        np.testing.assert_allclose(E[:3, 3], expected[:3, 3] * unit, rtol=rel)
    assert rig.scale.source == source and rig.scale.unit == (None if source == "none" else "m")
    assert len({rig}) == 1
    with pytest.raises(FrozenInstanceError):
        rig.scale = None
    assert rig.size_left == (832, 450) and rig.inliers == (1100, 900)
    assert rig.parallax_deg == (4.5, 6.5) and rig.residual_px == (0.31, 0.42) and rig.depth_spread == 0.034
    assert all(np.array_equal(*both) for both in zip(rig.Ks, KS, strict=True))
    assert rig.findings[:2] == ("View 1.", "View 2.") and len(rig.findings) == (3 if source == "none" else 2)
    assert solved["images"] == "clean" and solved["config"] is DEFAULT and solved["matcher"] is None
    for image, photo in zip(solved["raw"], PHOTOS, strict=True):
        np.testing.assert_allclose(image.permute(1, 2, 0), photo / 255, atol=1e-6)


def test_a_map_of_known_depths_becomes_points_of_its_own_pixels():
    """Skew, rectangular pixels and another ratio of the sizes along each axis."""
    K = np.array([[90.0, 3.0, 41.0], [0, 70.0, 22.0], [0, 0, 1]])
    depth = np.zeros((20, 60), np.float32)
    depth[3, 50], depth[17, 4] = 2.5, 7.0
    found = module._as_cloud(torch.from_numpy(depth), Camera(K, (80, 40)).single())
    expected = []
    for (row, column), z in (((3, 50), 2.5), ((17, 4), 7.0)):
        pixel = (column + 0.5) * 80 / 60 - 0.5, (row + 0.5) * 40 / 20 - 0.5
        expected.append(z * np.linalg.solve(K, (*pixel, 1.0)))
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    points = np.random.default_rng(0).normal(size=(4, 3))
    np.testing.assert_array_equal(module._as_cloud(torch.from_numpy(points), Camera(np.eye(3))), points)


def test_an_uncertain_pose_and_a_baseline_out_of_range_are_reported(solved, monkeypatch):
    monkeypatch.setattr(
        module, "unconstrained_pose", lambda spread: (Finding("estimate.unconstrained", f"{spread}"),)
    )
    rig = estimate_rig(PHOTOS, KnownLengths(None, None, None), K=KS)
    assert [finding.code for finding in rig.findings] == [
        "estimate.parallax",
        "estimate.parallax",
        "estimate.unconstrained",
        "scale.none",
    ]
    assert rig.findings[2] == "0.034"
    for wrong in (0.9e-6, 1.0000001e6, -1.0):
        with pytest.raises(InputError, match="baseline_m must be between 1e-06 and 1000000"):
            estimate_rig(PHOTOS, KnownLengths(wrong, None, None), K=KS)
    for allowed in (1e-6, 1e6):
        assert estimate_rig(PHOTOS, KnownLengths(allowed, None, None), K=KS).scale.factor == pytest.approx(
            allowed
        )
    with pytest.raises(TypeError, match="images must be two or more images"):
        estimate_rig(PHOTOS[:1], KnownLengths(None, None, None), K=KS)
    with pytest.raises(InputError, match="right image 2"):
        estimate_rig([*PHOTOS[:2], PHOTOS[2].astype(np.float32)], KnownLengths(None, None, None), K=KS)


def test_a_K_that_does_not_fit_is_rejected_unless_the_images_are_crops(solved):
    off = KS[0].copy()
    off[1, 2] = 451.0
    given = PHOTOS, KnownLengths(BASELINE_M, None, None)
    for options in ({}, {"cropped": False}):
        with pytest.raises(InputError, match=r"K of the left image .*outside the left image \(832x450"):
            estimate_rig(*given, K=[off, *KS[1:]], **options)
    assert estimate_rig(*given, K=[off, *KS[1:]], cropped=True).Ks[0][1, 2] == 451.0
    assert estimate_rig(*given, fov=50.0).Ks[1][0, 0] == pytest.approx(275 / math.tan(math.radians(25)))


def test_a_baseline_does_not_ask_for_known_depths_that_fit(solved):
    """Known points of any kind are read, and rejected by their own name."""
    with pytest.raises(InputError, match="points must be"):
        estimate_rig(PHOTOS, KnownLengths(None, None, np.zeros((4, 3, 2))), K=KS)


def with_exif(size: tuple[int, int], focal_35: float) -> Image.Image:
    image = Image.new("RGB", size[::-1])
    exif = Image.Exif()
    exif.get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = focal_35
    image.getexif().update(exif)
    image.getexif().get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = focal_35
    return image


def cameras(K=None, fov=None, cropped=False, unposed=None):
    unposed = [np.zeros((*size, 3), np.uint8) for size in SIZES] if unposed is None else unposed
    images = [torch.zeros(3, *size) for size in SIZES]
    return module._cameras(unposed, images, K, fov, cropped)


@pytest.mark.parametrize("kind", [list, tuple])
def test_one_matrix_is_every_images_and_a_list_has_one_each(kind):
    for given, expected in ((KS[1], [KS[1]] * 3), (kind(KS), KS), ([k.tolist() for k in KS], KS)):
        found, assumed = cameras(given, fov=50.0)
        assert assumed == [] and all(np.array_equal(*both) for both in zip(found, expected, strict=True))
    typed, _ = cameras(KS[1].tolist())
    assert all(np.array_equal(K, KS[1]) for K in typed)
    with pytest.raises(InputError, match="K must be one matrix, or 3 of them; got 2"):
        cameras(kind(KS[:2]))


def test_a_field_of_view_is_that_of_each_images_own_width():
    found, assumed = cameras(fov=50.0)
    for K, (height, width) in zip(found, SIZES, strict=True):
        focal = width / 2 / math.tan(math.radians(25))
        np.testing.assert_allclose(K, [[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])
    assert assumed == []


def test_exif_serves_where_nothing_else_is_given():
    unposed = [with_exif(size, 26.0 + i) for i, size in enumerate(SIZES)]
    found, assumed = cameras(unposed=unposed)
    for i, (K, size) in enumerate(zip(found, SIZES, strict=True)):
        assert K[0, 0] == pytest.approx((26 + i) * math.hypot(*size) / math.hypot(36, 24))
    assert [finding.code for finding in assumed] == ["camera.from-exif"] * 3
    assert [
        "the left image" in assumed[0],
        "right image 1" in assumed[1],
        "right image 2" in assumed[2],
    ] == [True] * 3
    mixed, assumed = cameras([KS[0], None, KS[2]], unposed=unposed)
    assert np.array_equal(mixed[0], KS[0]) and np.array_equal(mixed[2], KS[2])
    np.testing.assert_array_equal(mixed[1], found[1])
    assert len(assumed) == 1
    by_fov, assumed = cameras(fov=50.0, unposed=unposed)
    assert by_fov[0][0, 0] == pytest.approx(416 / math.tan(math.radians(25))) and assumed == []
    with pytest.raises(InputError, match="K of right image 1 must be known; got an array without EXIF"):
        cameras([KS[0], None, KS[2]])


def test_a_pose_that_is_not_found_names_the_focal_length_and_its_source(monkeypatch):
    def fails(images, Ks, matcher):
        raise InputError("the two images must be taken from two positions; got a purely rotating camera.")

    monkeypatch.setattr(module, "_solve", fails)
    nothing = KnownLengths(None, None, None)
    unposed = [with_exif(size, 26.0) for size in SIZES]
    said = r"rotating camera\. The left image has fx (\d+) px \(\d+ degrees wide\)\. K of the left image: 26"
    with pytest.raises(UnknownPoseError, match=said + r".* \1 px\. EXIF is outdated if"):
        estimate_rig(unposed, nothing)
    with pytest.raises(UnknownPoseError, match=r"has fx 650 px \(65 degrees wide\)\.\Z"):
        estimate_rig(PHOTOS, nothing, K=KS)


def test_the_image_whose_K_is_wrong_is_named_unless_it_is_a_crop():
    off = KS[1].copy()
    off[0, 2] = 551.0
    with pytest.raises(InputError, match=r"K of right image 1 .*outside right image 1 \(550x350"):
        cameras([KS[0], off, KS[2]])
    found, _ = cameras([KS[0], off, KS[2]], cropped=True)
    assert found[1][0, 2] == 551.0
    with pytest.raises(InputError, match="K of the left image"):
        cameras([np.zeros((3, 3)), KS[1], KS[2]])


@pytest.mark.parametrize("rectified", [(False, False), (True, False), (False, True), (True, True)])
def test_poses_are_polished_by_dense_matches_unless_all_pairs_are_rectified(monkeypatch, rectified):
    """Each step gets the views with the cameras that belong to it."""
    images = [torch.zeros(3, *size) for size in SIZES]
    tracks, units = scene()
    tracks.seen[:, ::3] = False
    poses = [SimpleNamespace(T=T, rectified=one) for T, one in zip(units, rectified, strict=True)]
    calls = {}

    def grey(posed):
        calls["grey"] = posed
        return [SimpleNamespace(grey=np.zeros(size)) for size in ((7, 9), (5, 6), (4, 3))]

    monkeypatch.setattr(module, "grey_views", grey)

    def estimate(views, matcher):
        calls.update(views=views, matcher=matcher)
        return tracks, poses

    monkeypatch.setattr(module, "estimate_poses", estimate)
    monkeypatch.setattr(
        module, "coarse_depth", lambda posed, size: calls.update(coarse=posed, size=size) or "depth"
    )

    def polish(views, Ts, depth_m, sparse):
        calls.update(polished=(views, Ts, depth_m, sparse))
        return 2 * Ts, "dense tracks"

    monkeypatch.setattr(module, "polished", polish)
    monkeypatch.setattr(module, "depth_spread", lambda tracks, Ts: calls.update(spread=(tracks, Ts)) or 0.05)
    masks = [None, torch.ones(SIZES[1], dtype=torch.bool), None]
    found = module._solve(module._Images(images, masks), KS, "matcher")
    assert calls["matcher"] == "matcher"
    for view, image, K in zip((calls["grey"].left, *calls["grey"].rights), images, KS, strict=True):
        assert view.image_01 is image
        np.testing.assert_array_equal(view.camera.K, K.astype(np.float32))
        np.testing.assert_array_equal(view.T_right_from_left, np.eye(4))
    assert [view.valid for view in (calls["grey"].left, *calls["grey"].rights)] == masks
    assert found.poses is poses
    if all(rectified):
        assert found.tracks is tracks and found.spread is None and "coarse" not in calls
        np.testing.assert_array_equal(found.Ts, units)
        return
    for v, view in enumerate(calls["coarse"].rights):
        assert view.image_01 is images[v + 1]
        np.testing.assert_array_equal(view.camera.K, KS[v + 1].astype(np.float32))
        np.testing.assert_allclose(view.T_right_from_left, units[v], rtol=1e-6)
    assert calls["coarse"].left.image_01 is images[0] and tuple(calls["size"]) == (7, 9)
    views, Ts, depth_m, sparse = calls["polished"]
    assert views is calls["views"] and depth_m == "depth" and len(sparse) == 1000
    np.testing.assert_array_equal(Ts, units)
    assert calls["spread"][0] == found.tracks == "dense tracks" and found.spread == 0.05
    np.testing.assert_array_equal(found.Ts, 2 * units)
    np.testing.assert_array_equal(calls["spread"][1], 2 * units)


def test_masks_and_alpha_channels_reach_the_estimate(solved):
    mask = np.arange(SIZES[1][1])[None].repeat(SIZES[1][0], 0) > 40
    four = np.dstack([PHOTOS[2], np.zeros(SIZES[2], np.uint8)])
    four[10:, :, 3] = 255
    with pytest.warns(UserWarning, match="alpha"):
        estimate_rig([*PHOTOS[:2], four], KnownLengths(0.1, None, None), K=KS, masks=(None, (mask, None)))
    left, first, second = solved["valid"]
    assert (
        left is None and np.array_equal(first.numpy(), mask) and second[10:].all() and not second[:10].any()
    )


@pytest.mark.parametrize(("name", "folder"), [("xfeat", None), ("xfeat:of/weights", Path("of/weights"))])
def test_a_named_matcher_reaches_the_estimate_with_its_weights(solved, monkeypatch, name, folder):
    asked = []
    loaded = SimpleNamespace(tracks="tracks of XFeat")
    monkeypatch.setattr(module.XFeatMatcher, "load", lambda given: asked.append(given) or loaded)
    estimate_rig(PHOTOS, KnownLengths(0.1, None, None), K=KS, matcher=name)
    assert solved["matcher"] == "tracks of XFeat" and asked == [folder]


@pytest.mark.parametrize("name", ["xfeat:", "sift:folder", "orb", ""])
def test_a_matcher_has_one_of_the_known_names(solved, name):
    with pytest.raises(InputError, match="matcher must be sift, xfeat or xfeat:FOLDER"):
        estimate_rig(PHOTOS, KnownLengths(0.1, None, None), K=KS, matcher=name)
    assert solved == {}
