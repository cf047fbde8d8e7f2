"""What is known of a view, on the grid of the evidence: images larger than the grid, little overlap."""

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm.evidence import chunk_views, prepare_evidence
from geodiff_plugin.algorithm.terms import Objective
from geodiff_plugin.config import GuidanceConfig
from geodiff_plugin.geometry import warp_right_to_left
from geodiff_plugin.scale.space import MetricMap
from geodiff_plugin.types import CameraView
from tests.conftest import render_plane

NORMAL, OFFSET = np.array([0.1, -0.2, 1.0]), 2.0


def camera(size, focal) -> np.ndarray:
    return np.array([[focal, 0, size[1] / 2 - 0.5], [0, focal, size[0] / 2 - 0.5], [0, 0, 1]])


def wide_pair(size_right, focal_right, at_m=0.1):
    """What is known of a left image of 800 pixels and a right one of any size."""
    E = np.eye(4)
    E[0, 3] = at_m
    size = (120, 800)
    K, K_right = camera(size, 600.0), camera(size_right, focal_right)
    left, _ = render_plane(K, np.eye(4), size, NORMAL, OFFSET, 1)
    right, _ = render_plane(K_right, E, size_right, NORMAL, OFFSET, 1)
    images = [torch.from_numpy(image).permute(2, 0, 1).float() / 255 for image in (left, right)]
    T = torch.from_numpy(np.linalg.inv(E)).float()
    views = [CameraView(images[1], torch.from_numpy(K_right).float(), T)]
    config = GuidanceConfig().changed(sweep_pixels=96 * 640, search="one-number")
    K_left = torch.from_numpy(K).float()
    return prepare_evidence(images[0], views, K_left, None, config, needs_matches=False)


@pytest.mark.parametrize(
    ("size_right", "focal_right"), [((120, 800), 600.0), ((180, 1200), 900.0), ((96, 640), 480.0)]
)
def test_above_the_grid_the_truth_still_explains_the_left_image(size_right, focal_right):
    """Neither K may stay that of the image as given, nor the right image be finer than the left one."""
    views = chunk_views([wide_pair(size_right, focal_right)])
    right = views.further[0]
    assert views.size == right.image_01.shape[-2:] == (96, 640)
    _, depth_m = render_plane(views.K_left[0].double().numpy(), np.eye(4), views.size, NORMAL, OFFSET, 1)
    cameras, errors = (views.K_left, right.K, right.T_right_from_left), []
    for factor in (1.0, 1.05):
        depth = factor * torch.from_numpy(depth_m)[None, None]
        warped = warp_right_to_left(right.image_01, depth, *cameras, rays=views.rays[0])
        assert warped.visible.float().mean() > 0.8
        error = (warped.image - views.left_01).abs().mean(1, keepdim=True)
        errors.append(float(error[warped.visible].mean()))
    assert errors[0] < 0.3 * errors[1]


@pytest.mark.parametrize("min_visible", [0.0, 0.4, 0.8])
def test_below_min_visible_the_photographs_have_no_say(min_visible):
    """At this depth the plane shows some 60 % of the left image to a right camera that far away."""
    views, metric = chunk_views([wide_pair((120, 800), 600.0, at_m=0.6)]), MetricMap("depth")
    knobs = {"weights": {"photometric": 1.0}, "pyramid_levels": 1, "exposure": False}
    objective = Objective(views, metric, GuidanceConfig(**knobs, min_visible=min_visible))
    affine = metric.from_range(torch.tensor([1.0]), torch.tensor([1.4]))
    x = torch.full((1, 1, 96, 640), 0.3, requires_grad=True)
    loss = objective(x, affine, affine, x, x, None)
    share = float(loss.visible_fraction)
    (gradient,) = torch.autograd.grad(loss.total.sum(), x)
    assert 0.5 < share < 0.7
    heard = share >= min_visible
    assert (float(loss.total.detach()) > 0.01) == heard and (float(gradient.abs().sum()) > 0) == heard
