"""All checks are asked at each stage; what they find together."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.trust import (
    CHECKS,
    NO_ERROR,
    Call,
    Check,
    FactSheet,
    ImagesStage,
    MatchError,
    MatchesStage,
    RowsStage,
    confidence_factor,
    match_error,
    measure,
    measure_result,
    measuring,
    rules_out_everything,
)
from geodiff_plugin.trust.distortion import Distortion, ResidualDistortion
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.known_points import KnownPoints, Points
from geodiff_plugin.trust.moving_objects import Moved, MovingObjects
from geodiff_plugin.trust.negative_disparity import Negative, NegativeDisparity
from geodiff_plugin.trust.order_ambiguity import Ambiguity, OrderAmbiguity
from geodiff_plugin.trust.pose_errors import FoundErrors, PoseError
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.trust.rolling_shutter import Shear
from geodiff_plugin.types import PoseReport
from tests.unit.pose.posed_scene import make_scene
from tests.unit.trust.made_stages import (
    FULL,
    GRID,
    made_result,
    matches_of,
    poses_stage,
    right_view,
    tracks_stage,
)
from tests.unit.trust.sheets import good, sheet
from tests.views import view_of


@dataclass(frozen=True)
class Asked:
    """Which methods of a check were asked for its facts."""

    method: str


class Everything(Check[Asked]):
    """It measures at every stage."""

    @classmethod
    def of_images(cls, stage):
        return Asked("of_images")

    @classmethod
    def of_tracks(cls, stage):
        return Asked("of_tracks")

    @classmethod
    def of_poses(cls, stage):
        return Asked("of_poses")

    @classmethod
    def of_matches(cls, stage):
        return Asked("of_matches")

    @classmethod
    def of_rows(cls, stage):
        return Asked("of_rows")

    @classmethod
    def scalars(cls, stage):
        return {"one": torch.tensor(1.25), "two": torch.tensor(True)}

    @classmethod
    def of_result(cls, stage, numbers):
        return Asked(f"of_result {numbers}")


class Alike(Everything):
    """Its numbers have the names of the other one's."""

    @classmethod
    def scalars(cls, stage):
        return {"one": torch.tensor(3, dtype=torch.int64)}


class Nothing(Check[Asked]):
    """It measures at no stage."""


@pytest.fixture
def made_up(monkeypatch):
    monkeypatch.setattr(measuring, "CHECKS", (Everything, Alike, Nothing))


SCENE = make_scene(3)
NOTHING = np.zeros((3, 3))
STAGES = {
    "of_images": ImagesStage([], []),
    "of_tracks": tracks_stage(SCENE.tracks, SCENE.Ts),
    "of_poses": poses_stage(PoseReport("fits", (), ())),
    "of_matches": MatchesStage(PosedViews(view_of(torch.zeros(3, 8, 9), torch.eye(3)), ()), None),
    "of_rows": RowsStage(NOTHING, NOTHING, NOTHING, None, NOTHING, (3, 3)),
}


@pytest.mark.parametrize("method", STAGES)
def test_each_stage_asks_the_method_of_its_name_of_all_checks(made_up, method):
    assert measure(STAGES[method]) == FactSheet({Everything: Asked(method), Alike: Asked(method)})


def test_numbers_of_all_checks_are_read_from_the_device_once_and_each_gets_its_own(made_up, monkeypatch):
    read, stack = [], torch.stack
    monkeypatch.setattr(measuring.torch, "stack", lambda tensors: read.append(len(tensors)) or stack(tensors))
    call = Call(range_given=True)
    found = measure_result(made_result(call=call))
    assert read == [3] and found.call is call
    assert found[Everything] == Asked("of_result {'one': 1.25, 'two': 1.0}")
    assert found[Alike] == Asked("of_result {'one': 3.0}") and found[Nothing] is None


def test_without_numbers_nothing_is_read(monkeypatch):
    monkeypatch.setattr(measuring.torch, "stack", None)
    assert measuring.read_numbers({}) == {}


def test_each_check_of_a_result_gets_its_own_numbers():
    """No two numbers of this result are alike, so that none can take another's place."""
    rng = np.random.default_rng(0)
    inverse, confidence = rng.uniform(0.1, 0.7, GRID), rng.random(GRID)
    K = torch.tensor([[70.0, 0, 30.0], [0, 60.0, 18.0], [0, 0, 1]])
    left = torch.from_numpy(rng.uniform(0.2, 0.7, (3, *FULL))).float()
    view = right_view(K, (1.0, 0, 0, -0.3), (0, 1, 0, 0), (0, 0, 1, 0))._replace(image_01=left + 0.05)
    stage = made_result(
        matches_of(inverse, confidence),
        matches_of(1.3 * inverse, (rng.random(GRID) < 0.1) * 1.0),
        rng.uniform(2.0, 3.0, FULL),
        native=PosedViews(view_of(left, K), (view,)),
        call=Call(range_given=True),
        planes=torch.linspace(0.1, 0.7, 61),
        points_outside=3,
        confidence=torch.full((1, 1, *FULL), 0.81),
        visible=torch.from_numpy(rng.random((1, 1, *FULL)) < 0.77),
        rank_correlation=torch.tensor(-0.32),
        on_edge=torch.tensor(True),
        over_prior=torch.tensor([[1.83]]),
    )
    together = measure_result(stage)
    for check in CHECKS:
        numbers = {name: float(number) for name, number in check.scalars(stage).items()}
        assert together[check] == check.of_result(stage, numbers), check
        assert together[check] is not None or not numbers, check


def test_causes_of_an_error_are_independent():
    residuals = Residuals("fits", (0.4,), (0.4,), 1.25, 2.0, False, None, None)
    records = (
        residuals,
        Negative(0.5, 1.2),
        Shear(0.004, 416),
        ResidualDistortion(0.2, 0.2, 0.3),
        Uncertainty(0.1, 0.2, True),
    )
    alone = [match_error(sheet(record)) for record in records]
    assert all(max(error) > 0.08 for error in alone)
    px = math.hypot(2 * 0.4, 2 * 0.75, 1.2, 0.004 * 416 / math.sqrt(3))
    expected = MatchError(px, 0.12, math.hypot(0.085, math.sqrt(0.0175)))
    assert match_error(sheet(*records)) == pytest.approx(expected)
    assert match_error(good()) == match_error(sheet()) == NO_ERROR


def test_factors_on_the_confidence_multiply(monkeypatch):
    points = Points(99, 0, 0.5, 1.2, 0.0)
    assert confidence_factor(sheet()) == 1.0
    assert (
        confidence_factor(sheet(points))
        == KnownPoints.confidence_factor(sheet(points))
        == pytest.approx(0.25)
    )
    monkeypatch.setattr(KnownPoints.__mro__[1], "confidence_factor", classmethod(lambda cls, facts: 0.9))
    assert confidence_factor(sheet()) == pytest.approx(0.9 ** (len(CHECKS) - 1))


#: What few matches of a pair show that exclude every problem.
USUAL = Moved(0.0), Negative(0.0, 0.0), ResidualDistortion(0.0, 0.0, 0.05), Ambiguity(0.1), FoundErrors(())


def test_everything_is_ruled_out_only_if_each_problem_is():
    assert rules_out_everything(sheet(*USUAL))
    for unusual in (
        Moved(0.08),
        Negative(0.021, 0.0),
        ResidualDistortion(0.0, 0.0, 0.081),
        Ambiguity(0.16),
        FoundErrors((PoseError("pose.mixed"),)),
    ):
        assert not rules_out_everything(sheet(*USUAL) | sheet(unusual)), unusual
    for unknown in USUAL[:-1]:
        assert not rules_out_everything(sheet(*(each for each in USUAL if each is not unknown))), unknown


def test_limits_for_few_matches_are_stricter_than_those_of_a_result():
    """That of the distortion is one for its upper bound, which has two standard errors in it."""
    disparity, distortion = NegativeDisparity, Distortion
    assert min(disparity.USUAL_FRACTION, disparity.MAX_FRACTION) >= 2.0 * disparity.MAX_RULED_OUT
    assert min(distortion.USUAL_K1, distortion.MAX_K1) >= distortion.MAX_RULED_OUT
    assert 2.0 * MovingObjects.MAX_RULED_OUT <= MovingObjects.MAX_FRACTION
    assert 2.0 * OrderAmbiguity.MAX_RULED_OUT <= OrderAmbiguity.MAX_EXCLUDED
