"""A skew ``K[0, 1]`` is obeyed by every function that takes a camera matrix; one that does not know it fails.

The oracle is the definition: ``z (u, v, 1) = K p``, in numpy.
"""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import pkgutil

import numpy as np
import pytest
import torch

import geodiff_plugin
from geodiff_plugin import GeometryGuidance, geometry
from geodiff_plugin._camera_checks import check_intrinsics, check_intrinsics_fit, warn_of_other_size
from geodiff_plugin.algorithm.evidence import as_fine_as, prepare_evidence, resize_long_edge
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evaluation.datasets.sample import depth_to_disparity, disparity_to_depth
from geodiff_plugin.evaluation.figures.maps import render_cloud
from geodiff_plugin.formats.clouds import write_ply
from geodiff_plugin.matching import build_cost_volume, find_matches, points_to_matches
from geodiff_plugin.matching.alignment import align_view
from geodiff_plugin.matching.build import mirrored_pose_preferred, pilot_volume
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.types import CameraView
from tests.conftest import textured
from tests.scenes import render_pair

SIZE = (48, 64)
K = np.array([[60.0, 14.0, 28.5], [0.0, 55.0, 24.5], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[66.0, -9.0, 33.5], [0.0, 58.0, 22.5], [0.0, 0.0, 1.0]])
T = np.array([[1.0, 0, 0, -0.12], [0, 1, 0, 0.01], [0, 0, 1, 0.02], [0, 0, 0, 1]])
DEPTH = 1.5 + np.random.default_rng(0).uniform(size=SIZE)

#: The page's modules import gradio, an extra.
HAS_GRADIO = importlib.util.find_spec("gradio") is not None
#: Functions that hand a camera matrix on or read no coordinate of it, beside those with a test below.
HAND_ON = {
    "_camera_checks.check_intrinsics_fit",  # the principal point alone
    "_camera_checks.check_size_of",
    "algorithm.evidence.prepare_evidence",
    "_camera_checks.warn_of_other_size",
    "evaluation.datasets.booster._quarter_intrinsics",  # by resize_intrinsics
    "formats.rigs.make_rig",
    "guidance.inputs.read_inputs",
    "matching.build.mirrored_pose_preferred",
    "matching.build.find_matches",
    "matching.build.pilot_volume",
    "algorithm.finish.vote_depth",  # by plane_rays
    "capture.fusion.normals_of",  # by unproject
    "formats.captures.read_capture",  # for images that come without
    "pose.capture.solve_capture",  # to pycolmap
    "runtime.confidence.reprojection",  # to warp_right_to_left
    "cli.inputs.pinhole",  # to OpenCV
    "cli.inputs._read_known",
    "formats.exif.warn_of_other_lens",  # the focal length alone
    "app.measure.read_pixel",
    "formats.distortion.undistorted",
    "formats.distortion.undistorted_pixels",
    "formats.distortion.undistorted_points",
    "formats.clouds.make_cloud",
    "guidance.photographs.estimate_rig",
    "guidance.evidence.coarse_depth",
    "guidance.evidence.pose_views",
    "pose.refine.polished",
    "pose.refine.refine_views",
    "pose.tracks.project_tracks",
    "pose.matches.grey_views",
    "runtime.verdict.read_indicators",
}


def tensor(x) -> torch.Tensor:
    return torch.as_tensor(np.asarray(x), dtype=torch.float64)[None]


def pixels() -> np.ndarray:
    """``(3, H, W)`` homogeneous."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    return np.stack([u, v, np.ones_like(u)])


def points_of(depth_m: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """``(3, H, W)`` by the definition."""
    return np.einsum("ij,jhw->ihw", np.linalg.inv(camera), pixels()) * depth_m


def uv_of(points: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """``(2, H, W)`` by the definition."""
    seen = np.einsum("ij,jhw->ihw", camera, points)
    return seen[:2] / seen[2]


def in_right() -> np.ndarray:
    return np.einsum("ij,jhw->ihw", T[:3, :3], points_of(DEPTH, K)) + T[:3, 3, None, None]


def plane_views(camera: np.ndarray, right: np.ndarray, offset_m: float = 2.0):
    """A textured plane at one depth, seen by both cameras: images ``(3, H, W)`` in [0, 1]."""
    to_right = np.eye(4)
    to_right[0, 3] = -0.15

    def image(own: np.ndarray, at: float) -> torch.Tensor:
        points = points_of(np.full(SIZE, offset_m), own) + np.array([at, 0, 0])[:, None, None]
        return torch.from_numpy(textured(points[:2].transpose(1, 2, 0), 3)).permute(2, 0, 1).float()

    return image(camera, 0.0), image(right, 0.15), torch.from_numpy(to_right).float()


def test_unproject():
    found = geometry.unproject(tensor(DEPTH)[None], tensor(K))[0].permute(2, 0, 1)
    np.testing.assert_allclose(found, points_of(DEPTH, K), atol=1e-12)


def test_project():
    uv, _ = geometry.project(tensor(in_right().transpose(1, 2, 0)), tensor(K_RIGHT))
    np.testing.assert_allclose(uv[0].permute(2, 0, 1), uv_of(in_right(), K_RIGHT), atol=1e-9)


def test_plane_rays_warp_and_occlusion():
    cameras = tensor(K), tensor(K_RIGHT), tensor(T)
    rays = geometry.plane_rays(*cameras, SIZE)
    expected = uv_of(in_right(), K_RIGHT)
    uv, _ = geometry.project_rays(tensor(DEPTH)[None], rays)
    np.testing.assert_allclose(uv[0].permute(2, 0, 1), expected, atol=1e-9)
    ramp = tensor(pixels()[:2])
    warped = geometry.warp_right_to_left(ramp, tensor(DEPTH)[None], *cameras)
    seen = warped.visible[0, 0].numpy()
    np.testing.assert_allclose(warped.image[0].numpy()[:, seen], expected[:, seen], atol=1e-9)
    # A step of depth hides, in the right view, what lies behind it where the skewed cameras put it.
    step = np.where(pixels()[0] > 30, 1.0, 3.0)
    straight = np.where(np.abs(K) == 14.0, 0.0, K)
    hidden = geometry.hidden_in_right(tensor(step)[None], *cameras, SIZE)
    other = geometry.hidden_in_right(tensor(step)[None], tensor(straight), *cameras[1:], SIZE)
    assert hidden.any() and not torch.equal(hidden, other)


@pytest.mark.parametrize("size", [(24, 32), (30, 100)])
def test_resizing_and_padding(size):
    """A point falls where the resized image shows what it fell on before."""
    moved = geometry.resize_intrinsics(tensor(K), SIZE, size)[0].numpy()
    scale = np.array([size[1] / SIZE[1], size[0] / SIZE[0]])[:, None, None]
    points = points_of(DEPTH, K)
    np.testing.assert_allclose(uv_of(points, moved), (pixels()[:2] + 0.5) * scale - 0.5, atol=1e-9)


def test_shrinking_keeps_the_skew_of_the_image():
    image = torch.rand(3, *SIZE)
    small, own = resize_long_edge(image, tensor(K)[0], 32)
    assert small.shape[-2:] == (24, 32)
    np.testing.assert_allclose(own, geometry.resize_intrinsics(tensor(K), SIZE, (24, 32))[0])
    small, own = as_fine_as(image, tensor(K)[0] * torch.tensor([2.0, 2.0, 1.0]).view(3, 1), tensor(K)[0])
    assert small.shape[-2:] == (24, 32) and float(own[0, 1] / own[0, 0]) == pytest.approx(14 / 60)


def test_only_equal_skews_are_rectified():
    pose = np.eye(4)
    pose[0, 3] = -0.1
    straight = np.where(np.abs(K) == 14.0, 0.0, K)
    assert geometry.is_rectified(tensor(K), tensor(K), tensor(pose)).all()
    assert not geometry.is_rectified(tensor(K), tensor(straight), tensor(pose)).any()
    # With equal skews a shift along the row says everything.
    E = np.linalg.inv(pose)
    shift = depth_to_disparity(DEPTH, K, K, E)
    expected = pixels()[0] - uv_of(points_of(DEPTH, K) + pose[:3, 3, None, None], K)[0]
    np.testing.assert_allclose(shift, expected, atol=1e-9)
    np.testing.assert_allclose(disparity_to_depth(shift, K, K, E), DEPTH, rtol=1e-6)


def test_the_sweep_and_all_that_is_made_of_it():
    left, right, to_right = plane_views(K, K_RIGHT)
    rights = [CameraView(right, torch.from_numpy(K_RIGHT).float(), to_right)]
    camera = torch.from_numpy(K).float()
    for volume in (
        pilot_volume(left, rights, camera),
        build_cost_volume(left, rights, camera),
        sweep_planes(
            left.mean(0, keepdim=True),
            [(right.mean(0, keepdim=True), *rights[0][1:])],
            camera,
            torch.linspace(0.2, 1.0, 24),
        ),
    ):
        found = find_matches(left, rights, camera, volume=volume)
        sure = found.confidence > 0.5
        assert sure.float().mean() > 0.3
        assert float((1 / found.inverse_depth[sure]).median()) == pytest.approx(2.0, rel=0.04)
    assert not mirrored_pose_preferred(left, rights, camera)
    config = GuidanceConfig().changed(loss_resolution=48)
    known = prepare_evidence(left, rights, camera, None, config, needs_matches=True)
    matched = known.sweep_matches.confidence > 0.5
    assert float((1 / known.sweep_matches.inverse_depth[matched]).median()) == pytest.approx(2.0, rel=0.04)
    np.testing.assert_allclose(
        known.K_left, geometry.resize_intrinsics(tensor(K), SIZE, (36, 48))[0], rtol=1e-6
    )


def test_a_plane_seen_from_above_moves_along_the_skewed_rows():
    above = torch.eye(4, dtype=torch.float64)
    above[:3, 3] = torch.tensor([-0.1, 0.15, 0.0])
    camera, w = tensor(K)[0], torch.tensor([0.2, 0.5])
    view = align_view((torch.rand(1, *SIZE), camera, above), camera, SIZE, w)
    for k, inverse_depth in enumerate(w.tolist()):
        points = points_of(np.full(SIZE, 1 / inverse_depth), K) + above[:3, 3, None, None].numpy()
        expected = uv_of(points, K)
        np.testing.assert_allclose(view.positions(SIZE[1], 0)[k], expected[0, 0], atol=1e-3)
        np.testing.assert_allclose(view.positions(SIZE[0], 1)[k], expected[1, :, 0], atol=1e-3)


def test_points_fall_where_the_camera_sees_them():
    camera = torch.from_numpy(K).float()
    points = torch.from_numpy(points_of(np.full(SIZE, 2.0), K)[:, 5:40:7, 3:60:9].reshape(3, -1).T).float()
    found, left_out = points_to_matches(points, camera, SIZE, SIZE)
    expected = np.zeros(SIZE, bool)
    expected[5:40:7, 3:60:9] = True
    assert left_out == 0
    np.testing.assert_array_equal(found.confidence[0] > 0, expected)


def test_point_clouds(tmp_path):
    write_ply(tmp_path / "cloud.ply", DEPTH, np.zeros((*SIZE, 3)), K)
    body = (tmp_path / "cloud.ply").read_bytes().split(b"end_header\n", 1)[1]
    kind = [("p", "<f4", 3), ("colour", "u1", 3)]
    np.testing.assert_allclose(
        np.frombuffer(body, kind)["p"].T.reshape(3, *SIZE), points_of(DEPTH, K), rtol=1e-5, atol=1e-6
    )
    straight = np.where(np.abs(K) == 14.0, 0.0, K)
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
    drawn = [render_cloud(DEPTH, image, own, T) for own in (K, straight)]
    assert not np.array_equal(*drawn)


def test_rendered_pairs_agree_with_their_own_cameras():
    pair = render_pair(0, size=SIZE, K_left=K, K_right=K_RIGHT, exposure=False)
    assert np.allclose(pair.K_left, K)
    depth_m, T_right = pair.left.depth_m[None].double(), torch.linalg.inv(pair.E.double())[None]
    seen = (pair.left.valid & ~pair.occluded & pair.in_view)[0]
    errors = []
    upright = [camera - np.outer([camera[0, 1], 0, 0], [0, 1, 0]) for camera in (K, K_RIGHT)]
    for camera, camera_right in ((K, K_RIGHT), upright):
        cameras = tensor(camera), tensor(camera_right), T_right
        warped = geometry.warp_right_to_left(pair.right.image_01[None].double(), depth_m, *cameras)
        errors.append(float((warped.image[0] - pair.left.image_01).abs().mean(0)[seen].mean()))
    assert errors[0] < 0.5 * errors[1]


def test_a_guidance_keeps_it():
    right = np.zeros((*SIZE, 3), np.uint8)
    pose = np.linalg.inv(T)
    assert np.array_equal(check_intrinsics(K), K)
    check_intrinsics_fit(K, SIZE[1], SIZE[0])
    warn_of_other_size(K, SIZE[1], SIZE[0], "K", "the image")
    for guidance in (
        GeometryGuidance(right, (K, K_RIGHT), pose),
        GeometryGuidance.paper(right, (K, K_RIGHT), pose),
        GeometryGuidance.from_baseline(right, K, 0.1, K_right=K_RIGHT),
        GeometryGuidance.from_views([(None, K, np.eye(4)), (right, K_RIGHT, pose)]),
    ):
        assert np.array_equal(guidance.rigs[0].K_left, K)
        assert np.array_equal(guidance.rigs[0].K_right, K_RIGHT)


def test_no_function_that_takes_a_camera_matrix_is_left_out():
    tested = {"_camera_checks.check_intrinsics"} | {
        f"{f.__module__.removeprefix('geodiff_plugin.')}.{f.__name__}"
        for f in (
            *(geometry.unproject, geometry.project, geometry.plane_rays, geometry.warp_right_to_left),
            *(geometry.hidden_in_right, geometry.resize_intrinsics),
            *(geometry.is_rectified, resize_long_edge, as_fine_as, build_cost_volume, sweep_planes),
            *(align_view, points_to_matches, write_ply, render_cloud),
            *(disparity_to_depth, depth_to_disparity),
        )
    }
    found = set()
    for module in pkgutil.walk_packages(geodiff_plugin.__path__, "geodiff_plugin."):
        if module.name.endswith("__main__") or (
            module.name.startswith("geodiff_plugin.app.") and not HAS_GRADIO
        ):
            continue
        for name, value in vars(importlib.import_module(module.name)).items():
            if inspect.isfunction(value) and value.__module__ == module.name:
                takes = {"K", "K_left", "K_right", "K_grid"} & set(inspect.signature(value).parameters)
                if takes and not name.startswith("_"):
                    found.add(f"{module.name.removeprefix('geodiff_plugin.')}.{name}")
    tested = {name for name in tested if not name.startswith("tests.")}
    assert found - HAND_ON == tested
