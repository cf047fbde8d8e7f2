"""Records shared by all layers: poses, reports of steps, verdicts of several images, depth elsewhere."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from geodiff_plugin.findings import Finding
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.trust import KINDS, FactSheet, Verdict
from geodiff_plugin.types import StepReport
from tests.unit.jobs.made_runs import K_LEFT, pose
from tests.views import made_rig, posed_frame

E = pose((3.0, -7.0, 11.0), (0.12, -0.05, 0.2))
REASON = Finding(KINDS["depth.inverted-order"], "The inverse pose fits.")


def test_a_rig_maps_points_of_the_left_camera_to_the_right_one():
    rig = made_rig(K_LEFT, K_LEFT, E)
    point = np.array([0.3, -0.2, 2.0, 1.0])
    in_right = rig.T_right_from_left @ point
    np.testing.assert_allclose(E[:3, :3] @ in_right[:3] + E[:3, 3], point[:3])
    np.testing.assert_allclose(rig.T_right_from_left @ np.append(E[:3, 3], 1.0), [0, 0, 0, 1], atol=1e-15)


def test_resizing_a_rectified_rig_resizes_the_cameras_before_rectification():
    rig, taken = (made_rig(K_LEFT, K, E, ((64, 48), (64, 48))) for K in (K_LEFT, K_LEFT + np.eye(3)))
    rig = replace(rig, as_taken=taken.sized(None, None))
    found = rig.resized((32, 24), (128, 96))
    for each, before in ((found, rig), (found.as_taken, taken)):
        assert (each.size_left, each.size_right) == ((32, 24), (128, 96))
        np.testing.assert_array_equal(each.K_left, before.left.resized((32, 24)).K)
        np.testing.assert_array_equal(each.K_right, before.right.resized((128, 96)).K)
    assert rig.resized((64, 48), (64, 48)) is rig


def test_a_step_report_keeps_every_value_on_its_way_to_the_cpu():
    values = {name: torch.tensor([float(n), n + 0.5]) for n, name in enumerate(("s_hat", "t_hat", "g_s"), 1)}
    report = StepReport(3, 250.0, **values, loss=torch.tensor([0.7, 0.8]), terms={"a": torch.tensor([9.0])})
    moved = report.cpu()
    assert (moved.step, moved.timestep) == (3, 250.0) and moved.visible_fraction is None
    for name in ("s_hat", "t_hat", "g_s", "loss"):
        assert torch.equal(getattr(moved, name), getattr(report, name)), name
    assert moved.terms == {"a": torch.tensor([9.0])}
    on_meta = StepReport(0, 1.0, *(torch.zeros(2) for _ in range(3)), terms={"a": torch.zeros(2)})
    assert on_meta.cpu().terms["a"].device.type == "cpu"


def verdict(status: str, *findings: Finding) -> Verdict:
    return Verdict(status, findings, FactSheet())


@pytest.mark.parametrize(
    ("statuses", "worst"),
    [
        (("trusted", "not judged", "not trusted", "not trusted"), 2),
        (("trusted", "not judged", "trusted"), 1),
        (("trusted", "trusted"), 0),
        (("not judged", "trusted"), 0),
    ],
)
def test_the_verdict_on_a_batch_is_that_of_the_first_of_the_worst_images(statuses, worst):
    verdicts = [verdict(status) for status in statuses]
    output = MetricDepthOutput(np.ones((len(statuses), 2, 2, 1)), verdicts=verdicts)
    assert output.verdict is verdicts[worst]
    with pytest.raises(AttributeError, match="no verdict"):
        _ = MetricDepthOutput(np.ones((1, 2, 2, 1))).verdict


def plane(K: np.ndarray, height: int, width: int, offset: float) -> np.ndarray:
    """Depth of the plane ``n . x = offset`` with a tilted normal."""
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    return (offset / (rays @ [0.1, -0.05, 1.0])).astype(np.float32)


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_depth_in_another_camera_is_made_of_each_image_with_its_own_k(kind):
    """Of two planes, taken by different cameras; one image has a hole, the other pixels out of reach."""
    Ks = np.stack([K_LEFT, K_LEFT @ np.diag([1.2, 1.15, 1.0])]).astype(np.float32)
    depths = np.stack([plane(K, 48, 64, offset) for K, offset in zip(Ks, (2.0, 3.5), strict=True)])
    confidence = np.full_like(depths, 0.8)
    depths[0, 10:20, 15:30] = 0.0
    confidence[1, 30:40, 35:50] = 0.0
    into = pose((0, 0, 0), (0.1, 0.02, -0.05))
    K_into = np.array([[40.0, 0, 15.0], [0, 44.0, 12.0], [0, 0, 1]])
    prediction, sure, K = depths[..., None], confidence[..., None], Ks
    if kind == "torch":
        prediction, sure = (torch.from_numpy(x[:, None]) for x in (depths, confidence))
        K = torch.from_numpy(Ks)
    output = MetricDepthOutput(prediction, confidence=sure, K=K)
    assert output.valid.shape == prediction.shape
    np.testing.assert_array_equal(
        np.asarray(output.valid).reshape(depths.shape), (depths > 0) & (confidence > 0)
    )
    maps = output.reproject(K_into, into, (32, 26))
    for each in maps:
        assert tuple(each.shape) == ((2, 26, 32, 1) if kind == "numpy" else (2, 1, 26, 32))
        assert each.dtype == output.prediction.dtype
    seen, sigma = (np.asarray(each).reshape(2, 26, 32) for each in maps)
    np.testing.assert_array_equal(np.isfinite(sigma), seen > 0)
    v, u = np.mgrid[:26, :32]
    rays = np.stack([(u - 15.0) / 40, (v - 12.0) / 44, np.ones(u.shape)], -1)
    normal = np.array([0.1, -0.05, 1.0])
    for number, offset in enumerate((2.0, 3.5)):
        expected = (offset - normal @ into[:3, 3]) / (rays @ normal)
        known = seen[number] > 0
        assert 0.5 < known.mean() < 0.97, "what is unknown there has no depth"
        np.testing.assert_allclose(seen[number][known], expected[known], rtol=0.01)
        own = np.asarray(output.sigma).reshape(depths.shape)[number] / depths[number]
        assert np.nanmin(own) * 0.95 < np.nanmin(sigma[number] / expected)
        assert np.nanmax(sigma[number] / expected) < np.nanmax(own) * 1.05
    without = MetricDepthOutput(prediction)
    np.testing.assert_array_equal(np.asarray(without.valid).reshape(depths.shape), depths > 0)
    with pytest.raises(AttributeError, match="no K"):
        without.reproject(K_into, into, (32, 26))


def test_an_output_is_shown_by_its_size_range_and_verdicts():
    depth = np.array([[1.5, math.nan], [7.25, 3.0]], np.float32)[None, ..., None]
    output = MetricDepthOutput(
        depth,
        verdicts=[verdict("not trusted", REASON), verdict("trusted")],
        findings=[REASON] * 3,
    )
    text = repr(output)
    assert text.splitlines() == [
        "MetricDepthOutput(depth (1, 2, 2, 1), 1.5 to 7.25 m",
        f"  not trusted: {REASON}",
        "  trusted",
        "  3 findings)",
    ]
    assert repr(MetricDepthOutput(torch.ones(1, 1, 2, 2), unit=None)).splitlines()[0].endswith("1 to 1")


def test_the_points_of_a_frame_are_those_of_its_pixels_in_the_world():
    height, width = 5, 7
    depth = np.linspace(1.0, 3.0, height * width).reshape(height, width)
    frame = posed_frame("a", depth, np.ones_like(depth), K_LEFT, E)
    every = frame.world()
    for v, u in ((0, 0), (1, 5), (4, 2)):
        z = depth[v, u]
        x, y = (u - K_LEFT[0, 2]) / K_LEFT[0, 0] * z, (v - K_LEFT[1, 2]) / K_LEFT[1, 1] * z
        np.testing.assert_allclose(every[v, u], E[:3, :3] @ [x, y, z] + E[:3, 3])
