"""A skew ``K[0, 1]`` is obeyed by every function that reads a camera matrix."""

import numpy as np
import pytest
import torch

from geodiff_plugin import GeometryGuidance, geometry
from geodiff_plugin._camera_checks import check_intrinsics, check_size_of
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.evaluation.figures import render_cloud
from geodiff_plugin.evidence.prepare import prepare_evidence
from geodiff_plugin.formats.clouds import write_ply
from geodiff_plugin.matching import build_cost_volume, match_volume, points_to_matches
from geodiff_plugin.matching.build import inverse_pose_preferred, pilot_volume, to_grid
from geodiff_plugin.matching.sweep import sweep_planes
from geodiff_plugin.types import CameraView, PosedViews
from tests.tiny import textured
from tests.unit.test_geometry import points_of, tensor

SIZE = (48, 64)
K = np.array([[60.0, 14.0, 28.5], [0.0, 55.0, 24.5], [0.0, 0.0, 1.0]])
K_RIGHT = np.array([[66.0, -9.0, 33.5], [0.0, 58.0, 22.5], [0.0, 0.0, 1.0]])
STRAIGHT = np.where(np.abs(K) == 14.0, 0.0, K)
DEPTH = 1.5 + np.random.default_rng(0).uniform(size=SIZE)


def test_shrinking_keeps_the_skew_of_the_image():
    image = torch.rand(3, *SIZE)
    small, _, K_small = to_grid(PosedViews(image, (), tensor(K)[0]), 24 * 32)
    assert small.shape[-2:] == (24, 32)
    np.testing.assert_allclose(K_small, geometry.resize_intrinsics(tensor(K), SIZE, (24, 32))[0])
    twice = tensor(K)[0] * torch.tensor([2.0, 2.0, 1.0]).view(3, 1)
    small, K_small = geometry.as_fine_as(image, twice, tensor(K)[0])
    assert small.shape[-2:] == (24, 32) and float(K_small[0, 1] / K_small[0, 0]) == pytest.approx(14 / 60)


def test_the_sweep_and_all_that_is_made_of_it():
    """A textured plane 2 m away, seen by two cameras of different skew."""

    def image(matrix: np.ndarray, at: float) -> torch.Tensor:
        points = points_of(np.full(SIZE, 2.0), matrix) + np.array([at, 0, 0])[:, None, None]
        return torch.from_numpy(textured(points[:2].transpose(1, 2, 0), 3)).permute(2, 0, 1).float()

    T = torch.eye(4)
    T[0, 3] = -0.15
    left, camera = image(K, 0.0), torch.from_numpy(K).float()
    right = CameraView(image(K_RIGHT, 0.15), torch.from_numpy(K_RIGHT).float(), T)
    posed = PosedViews(left, (right,), camera)
    grey_right = right._replace(image_01=right.image_01.mean(0, keepdim=True))
    grey = PosedViews(left.mean(0, keepdim=True), (grey_right,), camera)
    planes = torch.linspace(0.2, 1.0, 24)
    volumes = (
        pilot_volume(posed),
        build_cost_volume(posed),
        sweep_planes(grey, planes),
    )
    config = GuidanceConfig().changed(sweep_pixels=36 * 48)
    evidence = prepare_evidence(posed, None, config)
    for matches in (*(match_volume(v) for v in volumes), evidence.matches):
        reliable = matches.confidence > 0.5
        assert reliable.float().mean() > 0.3
        assert float((1 / matches.inverse_depth[reliable]).median()) == pytest.approx(2.0, rel=0.04)
    assert not inverse_pose_preferred(posed)
    small = geometry.resize_intrinsics(tensor(K), SIZE, (36, 48))[0]
    np.testing.assert_allclose(evidence.grid.K_left, small, rtol=1e-6)


def test_points_and_clouds(tmp_path):
    points = torch.from_numpy(points_of(np.full(SIZE, 2.0), K)[:, 5:40:7, 3:60:9].reshape(3, -1).T).float()
    given, left_out = points_to_matches(points, torch.from_numpy(K).float(), SIZE, SIZE)
    expected = np.zeros(SIZE, bool)
    expected[5:40:7, 3:60:9] = True
    assert left_out == 0 and np.array_equal(given.confidence[0] > 0, expected)
    write_ply(tmp_path / "cloud.ply", DEPTH, np.zeros((*SIZE, 3)), K)
    body = (tmp_path / "cloud.ply").read_bytes().split(b"end_header\n", 1)[1]
    written = np.frombuffer(body, [("p", "<f4", 3), ("colour", "u1", 3)])["p"].T.reshape(3, *SIZE)
    np.testing.assert_allclose(written, points_of(DEPTH, K), rtol=1e-5, atol=1e-6)
    image, T = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8), np.eye(4)
    T[:3, 3] = -0.12, 0.01, 0.02
    assert not np.array_equal(*(render_cloud(DEPTH, image, matrix, T) for matrix in (K, STRAIGHT)))


def test_a_guidance_keeps_it():
    right, pose = np.zeros((*SIZE, 3), np.uint8), np.eye(4)
    pose[0, 3] = 0.12
    assert np.array_equal(check_intrinsics(K), K)
    check_size_of(K, SIZE, "K", "the image")
    for guidance in (
        GeometryGuidance(right, (K, K_RIGHT), pose),
        GeometryGuidance.from_baseline(right, K, 0.1, K_right=K_RIGHT),
        GeometryGuidance.from_views([(None, K, np.eye(4)), (right, K_RIGHT, pose)]),
    ):
        assert np.array_equal([guidance.rigs[0].K_left, guidance.rigs[0].K_right], [K, K_RIGHT])
