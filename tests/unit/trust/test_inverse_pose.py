"""Whether dense matching prefers the inverse pose; ``PoseErrors`` reports it."""

import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.trust import MatchesStage, inverse_pose, measure
from geodiff_plugin.trust.inverse_pose import InversePose, Preference
from tests.views import view_of

NATIVE = PosedViews(view_of(torch.zeros(3, 8, 9), torch.eye(3)), ())


@pytest.mark.parametrize("preferred", [True, False])
def test_it_is_what_matching_prefers(monkeypatch, preferred):
    asked = []

    def prefers(native, matches):
        asked.append((native, matches))
        return preferred

    monkeypatch.setattr(inverse_pose, "inverse_pose_preferred", prefers)
    assert measure(MatchesStage(NATIVE, None))[InversePose] == Preference(preferred)
    assert asked == [(NATIVE, None)]
