"""What holds of all parts: no gradients, no dependence on torch's defaults, records that do not change."""

from dataclasses import FrozenInstanceError, replace

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.matching import (
    build_cost_volume,
    clean,
    inverse_pose_preferred,
    known_fraction,
    known_shape,
    match_volume,
    points_to_matches,
    reject_reflections,
    sweep_planes,
    with_points,
)
from geodiff_plugin.matching.alignment import align_view, even_shifts
from geodiff_plugin.matching.build import coarse_volume
from geodiff_plugin.matching.matches import Matches
from geodiff_plugin.matching.rows import half_occlusions, row_images, with_occluded
from geodiff_plugin.matching.winner import winner
from tests.tiny import rows_of
from tests.unit.matching import references as ref
from tests.views import posed_of

SIZE = (30, 48)
K = ref.matrix(40.0, 36.0, 22.0, 16.0)


def pair(*angles: float) -> PosedViews:
    """A colour image and the same one moved by four columns."""
    image = np.random.default_rng(0).random((3, SIZE[0], SIZE[1] + 4))
    left, right = (torch.from_numpy(x).float() for x in (image[..., :-4], image[..., 4:]))
    T = ref.right_from_left(angles or (0.0, 0.0, 0.0), (0.2, 0.0, 0.0))
    return posed_of(left, K, (right, K, T))


def on_cpu(*values) -> torch.Tensor:
    """A float32 tensor, whatever torch's defaults are."""
    return torch.from_numpy(np.array(values, np.float32))


def maps(seed: int = 1) -> list[torch.Tensor]:
    return list(torch.from_numpy(np.random.default_rng(seed).random((3, 1, 1, *SIZE))).float())


def batch() -> Matches:
    inverse, confidence, deviation = maps()
    return Matches(inverse, confidence, on_cpu(0.02), 1 + deviation)


def every_result() -> dict[str, torch.Tensor]:
    """What all parts make of one scene."""
    posed = pair(0.0, 2.0, 1.0)
    volume = build_cost_volume(posed)
    found = match_volume(volume)
    depth_m, surface, _ = maps(2)
    points, _ = points_to_matches(on_cpu([0.1, 0.0, 2.0], [-0.3, 0.2, 1.5]), posed.left.camera, SIZE)
    given = Matches.stack([points])
    straight = pair()
    rows = rows_of(row_images(straight.left, straight.rights[0]), 12.0)
    strips = half_occlusions(rows, (15, 24), 40.0)
    small = Matches(*(x[..., ::2, ::2] for x in maps()[:2]), on_cpu(0.1), maps()[2][..., ::2, ::2])
    hidden = with_occluded(small, strips)
    noisy = (
        straight.left.image_01 + 0.1 * torch.from_numpy(np.random.default_rng(3).normal(size=SIZE)).float()
    )
    return {
        "planes": volume.inverse_depth,
        "levels": volume.levels,
        "in view": volume.in_view,
        "inverse depth": found.inverse_depth,
        "confidence": found.confidence,
        "deviation": found.deviation,
        "plane step": found.plane_step,
        "points": points.confidence,
        "unit of points": points.plane_step,
        "with points": with_points(batch(), given).deviation,
        "within": batch().within(surface[0] > 0.5).confidence,
        "above": batch().above(0.5),
        "known": known_fraction(batch()),
        "known shape": known_shape(batch(), surface),
        "remains": reject_reflections(batch(), 1 + depth_m),
        "shift": rows.shift,
        "matched": rows.matched,
        "baseline": rows.baseline_m,
        "strips": strips.inverse_depth,
        "inside": strips.inside,
        "hidden": hidden.confidence,
        "hidden deviation": hidden.deviation,
        "clean": clean([noisy.clamp(0, 1)], 500)[0],
        "inverse pose": torch.asarray(inverse_pose_preferred(posed), device="cpu"),
    }


def test_results_do_not_depend_on_the_default_device_and_type_of_torch():
    expected = every_result()
    with torch.device("meta"):
        elsewhere = every_result()
    torch.set_default_dtype(torch.float64)
    try:
        doubled = every_result()
    finally:
        torch.set_default_dtype(torch.float32)
    for name, value in expected.items():
        for other in (elsewhere[name], doubled[name]):
            assert other.device.type == "cpu" and other.dtype == value.dtype, name
            torch.testing.assert_close(other, value, msg=name)


def test_nothing_takes_gradients():
    posed = pair(0.0, 2.0, 1.0)
    watched = posed._replace(left=posed.left._replace(image_01=posed.left.image_01.requires_grad_()))
    inverse, confidence, deviation = (x.requires_grad_() for x in maps())
    given = Matches(inverse, confidence, on_cpu(0.02), deviation + 1)
    noise = torch.from_numpy(np.random.default_rng(3).normal(0, 0.1, SIZE)).float()
    noisy = (posed.left.image_01 + noise).clamp(0, 1)
    turned = pair(0.0, 2.0, 1.0).rights[0]
    turned = turned._replace(image_01=turned.image_01[:1].requires_grad_())
    grey = PosedViews(posed.left._replace(image_01=posed.left.image_01[:1]), (turned,))
    made = [
        sweep_planes(grey, torch.linspace(0.0, 1.0, 5)).aligned[0].grey,
        build_cost_volume(watched, depth_range=(0.5, 9.0)).left_01,
        coarse_volume(watched).left_01,
        known_fraction(given),
        known_shape(given, inverse),
        reject_reflections(given, 1 + inverse),
        clean([noisy], 500)[0],
    ]
    assert noisy.requires_grad and not any(each.requires_grad for each in made)


def test_records_do_not_change_and_a_changed_copy_reads_its_own_pixels():
    volume = build_cost_volume(pair(), depth_range=(0.5, 9.0))
    left, (right,) = pair()
    view = align_view(right._replace(image_01=left.image_01[:1]), left.camera, torch.zeros(40))
    records = {
        "levels": volume,
        "grey": view,
        "columns": even_shifts(view, SIZE[1]),
        "confidence": batch(),
        "best": winner(
            torch.zeros(3, 2, 2, dtype=torch.int16), volume.levels[:3, :2, :2], volume.in_view[:3, :2, :2]
        ),
    }
    for name, record in records.items():
        with pytest.raises(FrozenInstanceError):
            setattr(record, name, getattr(record, name))
    given = batch()
    before = given.above(0.5)
    assert "_above" not in repr(given) and replace(given) == given  # what was read is no part of them
    other = replace(given, confidence=1 - given.confidence)
    assert set(before.tolist()).isdisjoint(other.above(0.5).tolist()) and other.above(0.5).numel()
