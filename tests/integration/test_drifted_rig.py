"""A rectified rig that has drifted by 0.3 degrees and 1.5 px comes back."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_bundled_prior
from geodiff_plugin.guidance.evidence import pose_views
from geodiff_plugin.types import CameraView
from tests.scenes import render_pair


def drifted(seed: int, size: tuple[int, int]):
    """A rectified pair, and the same scene with a right camera that has turned and whose image has moved."""
    right = render_pair(seed, size=size)
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    E, K_right = right.E.numpy().copy(), right.K_right.numpy().copy()
    E[:3, :3] = Rotation.from_rotvec(axis / np.linalg.norm(axis) * np.radians(0.3)).as_matrix()
    K_right[1, 2] += 1.5
    return right, render_pair(seed, size=size, E=E, K_right=K_right)


@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 6])
def test_rows_agree_again(seed: int) -> None:
    rig, off = drifted(seed, (240, 320))
    T = torch.from_numpy(np.linalg.inv(rig.E.numpy())).float()
    rights = [CameraView(off.right.image_01.float(), rig.K_right.float(), T)]
    _, report = pose_views(off.left.image_01.float(), rights, rig.K_left.float(), measured=True)
    assert report.status == "refined"
    assert report.residual_px[0] < 0.3 < 0.45 < report.residual_px_given[0]
    assert np.linalg.norm(report.E[0][:3, 3]) == pytest.approx(float(rig.E[0, 3]), rel=0.03)


@pytest.mark.slow
def test_a_drifted_rig_is_as_good_as_a_true_one() -> None:
    pipe = enable_geometry_guidance(load_bundled_prior())
    pipe.set_progress_bar_config(disable=True)
    errors = []
    for seed in (2, 6, 8):
        rig, off = drifted(seed, (384, 512))
        K, E = (rig.K_left.numpy(), rig.K_right.numpy()), rig.E.numpy()
        truth, valid = rig.left.depth_m[0].numpy(), rig.left.valid[0].numpy()
        row = []
        for pair in (rig, off):
            generator = torch.Generator().manual_seed(0)
            guidance = GeometryGuidance(pair.right.image_01, K, E)
            depth_m = pipe(pair.left.image_01, guidance=guidance, generator=generator).prediction[0, ..., 0]
            row.append(float(np.mean(np.abs(depth_m - truth)[valid] / truth[valid])))
        errors.append(row)
    true, refined = np.mean(errors, axis=0)
    assert refined < 1.1 * true
