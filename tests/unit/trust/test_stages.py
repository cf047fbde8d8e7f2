"""What the stages of a call offer."""

import numpy as np
import pytest
import torch

from geodiff_plugin.trust import Call
from geodiff_plugin.types import PoseReport
from tests.unit.pose.posed_scene import make_scene
from tests.unit.trust.made_stages import FULL, made_result, poses_stage, tracks_stage


@pytest.mark.parametrize(
    ("size", "px"), [((100, 832), 1.0), ((1248, 900), 1.5), ((900, 1248), 1.5), ((60, 80), 1.0)]
)
def test_poses_are_checked_on_832_pixels_of_the_longer_side(size, px):
    scene = make_scene(3)
    assert tracks_stage(scene.tracks, scene.Ts, size=size).grid_px == pytest.approx(px)
    assert poses_stage(PoseReport("fits", (), ()), used=np.eye(4)[None], size=size).grid_px == pytest.approx(
        px
    )


def test_a_call_has_a_unit_and_no_range_unless_specified():
    assert Call() == Call(has_unit=True, range_given=False, findings=())


def test_means_and_fractions_of_a_masked_image_are_those_of_its_valid_pixels():
    values = torch.rand(1, 1, 10, 12, generator=torch.Generator().manual_seed(0))
    plain = made_result()
    assert plain.valid_fraction == 1.0 and torch.equal(plain.mean(values), values.mean())
    valid = torch.zeros(FULL, dtype=torch.bool)
    valid[:, FULL[1] // 2 :] = True
    native = plain.native._replace(left=plain.native.left._replace(valid=valid))
    masked = made_result(native=native)
    assert float(masked.valid_fraction) == pytest.approx(float(valid.float().mean()))
    assert float(masked.mean(values)) == pytest.approx(float(values[..., 6:].mean()))
    seen = values > 0.5
    assert float(masked.mean(seen)) == pytest.approx(float(seen[..., 6:].float().mean()))
