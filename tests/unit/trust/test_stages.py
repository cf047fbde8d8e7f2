"""What the stages of a call offer."""

import numpy as np
import pytest

from geodiff_plugin.trust import Call
from geodiff_plugin.types import PoseReport
from tests.unit.pose.posed_scene import make_scene
from tests.unit.trust.made_stages import poses_stage, tracks_stage


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
