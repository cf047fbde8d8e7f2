"""One image given twice: how the views differ, and when that is nothing but rounding."""

import numpy as np
import pytest
import torch

from geodiff_plugin._internal import strips
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import judge, measure_result
from geodiff_plugin.trust.field_of_view import ViewAngle
from geodiff_plugin.trust.identical_views import Difference, IdenticalViews
from geodiff_plugin.trust.inverse_pose import Preference
from geodiff_plugin.trust.negative_disparity import Negative
from geodiff_plugin.trust.shifted_copy import DepthRange
from tests.unit.trust.made_stages import FULL, made_result
from tests.unit.trust.sheets import codes, good
from tests.views import view_of


@pytest.mark.parametrize("strip", [1 << 20, 5 * FULL[1]])
def test_the_most_similar_view_counts_if_it_has_the_size_of_the_left_image(monkeypatch, strip):
    monkeypatch.setattr(strips, "STRIP_PIXELS", strip)
    rng = np.random.default_rng(2)
    left = rng.uniform(0.2, 0.7, (3, *FULL)).astype(np.float32)
    others = [left.copy() for _ in range(3)]
    others[0][1, 30, 50] += 0.2
    others[1][2, 3, 4] -= 0.1
    others[2][0, 36, 60] += 0.05
    images = [*map(torch.from_numpy, others), torch.from_numpy(left[:, :-1])]
    views = [view_of(image, torch.eye(3), torch.eye(4)) for image in images]

    def of_views(*indices: int) -> Difference | None:
        native = PosedViews(view_of(torch.from_numpy(left), torch.eye(3)), tuple(views[i] for i in indices))
        return measure_result(made_result(native=native))[IdenticalViews]

    for indices, least in (((0,), 0.2), ((0, 1), 0.1), ((1, 2, 0), 0.05), ((3, 0), 0.2)):
        found = of_views(*indices)
        assert (found.largest, found.contrast) == pytest.approx((least, np.ptp(left)), abs=1e-6)
    assert of_views(3) is None and of_views() is None


@pytest.mark.parametrize(
    ("largest", "contrast", "same"),
    [
        (0.0058, 0.9, True),
        (0.0059, 0.9, False),
        (0.0019, 0.04, True),
        (0.0021, 0.04, False),
        (0.0, 0.0, False),  # both are blank
    ],
)
def test_images_are_the_same_up_to_rounding_and_a_twentieth_of_their_contrast(largest, contrast, same):
    assert codes(good(Difference(largest, contrast))) == (["views.identical"] if same else [])


def test_nothing_else_that_is_wrong_matters_then_but_remarks_stay():
    wrong = Preference(True), Negative(0.9, 9.0), DepthRange(0.01, 1.0), ViewAngle(12.0)
    doubts = (Finding("baseline.long", "25 m."), Finding("camera.principal-point", "cx."))
    assert len(judge(good(*wrong, findings=doubts, calibrated=True)).reasons) > 3
    verdict = judge(good(Difference(0.0, 0.9), *wrong, findings=doubts, calibrated=True))
    assert [finding.code for finding in verdict.reasons] == ["views.identical"]
    assert [finding.code for finding in verdict.remarks] == ["camera.field-of-view"]
