"""What happens at each step of a guided call: left alone, corrected, updated, skipped."""

import pytest

from geodiff_plugin.algorithm.schedule import count_steps, make_schedule
from geodiff_plugin.config import DEFAULT, SEARCH_ONLY


def schedule(steps, config=DEFAULT, **options):
    return make_schedule(config, config.plan_updates(points_given=False), steps, **options)


@pytest.mark.parametrize(
    ("steps", "corrections", "knobs", "corrected"),
    [
        (10, 2, {}, [5, 9]),
        (9, 3, {}, [4, 6, 8]),
        (9, 1, {}, [8]),
        (1, 4, {}, [0]),
        (8, 2, {"start": 0.25, "stop": 0.75}, [4, 5]),
        (4, 3, {}, [1, 2, 3]),  # more than fit the second half reach further back
        (4, 9, {}, [0, 1, 2, 3]),
    ],
)
def test_corrections_are_spread_over_the_second_half_of_what_is_active(steps, corrections, knobs, corrected):
    found = schedule(steps, DEFAULT.changed(corrections=corrections, **knobs)).steps
    assert [i for i, rounds in enumerate(found) if any(r.corrects for r in rounds)] == corrected


def test_it_prints_what_happens():
    lines = str(schedule(3, DEFAULT.changed(inner_steps=3), skipped=1)).splitlines()
    told = ["step 2: leave", "step 3: correct", "step 4: correct and update 3 x, last"]
    assert lines[0].startswith("step 1: skipped") and lines[1:] == told
    assert str(schedule(1, SEARCH_ONLY)) == "step 1: settle the scale, last"


def test_more_steps_than_a_prior_has_are_refused():
    with pytest.raises(ValueError, match="num_inference_steps must be at most 1 with this prior; got 4"):
        count_steps(4, 4, 1)
