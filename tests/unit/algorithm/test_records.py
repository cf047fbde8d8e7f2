"""Records that several stages and threads share."""

from dataclasses import FrozenInstanceError, fields

import pytest

from geodiff_plugin.algorithm.denoising import NoiseLevel
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.algorithm.schedule import Schedule
from geodiff_plugin.algorithm.systems import FieldSystem, RobustSystem
from geodiff_plugin.runtime.codec import ProcessingGrid
from geodiff_plugin.runtime.hooks import Layers


@pytest.mark.parametrize(
    "record", [FieldSystem, Layers, Member, NoiseLevel, ProcessingGrid, RobustSystem, Schedule]
)
def test_a_record_cannot_be_changed_by_one_of_its_readers(record):
    for field in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(object.__new__(record), field.name, None)


def test_a_prediction_type_that_is_not_known_is_rejected():
    for known in ("epsilon", "sample", "v_prediction", "flow_prediction"):
        NoiseLevel(None, None, known)
    with pytest.raises(ValueError, match="prediction_type must be one of .*; got 'velocity'"):
        NoiseLevel(None, None, "velocity")
