"""What happens at each step of a guided call: left alone, corrected, updated, skipped."""

from __future__ import annotations

import pytest

from geodiff_plugin.algorithm.schedule import Round, count_steps, make_schedule
from geodiff_plugin.config import DEFAULT, PAPER, SEARCH_ONLY

CORRECT, SETTLE = Round(True, 0), Round(False, 0)


def schedule(steps, config=DEFAULT, points_given=False, **options):
    return make_schedule(config, config.plan_updates(points_given), steps, **options)


def corrected(steps, corrections=2, **knobs):
    config = DEFAULT.changed(corrections=corrections, **knobs)
    return [i for i, rounds in enumerate(schedule(steps, config).steps) if any(r.corrects for r in rounds)]


def test_corrections_are_spread_over_the_second_half_of_what_is_active():
    assert corrected(4) == [2, 3]
    assert corrected(1) == corrected(1, 4) == [0]
    assert corrected(10) == [5, 9]
    assert corrected(9, 3) == [4, 6, 8]
    assert corrected(9, 1) == [8]
    assert corrected(8, 2, start=0.25, stop=0.75) == [4, 5]


def test_more_corrections_than_fit_the_second_half_reach_further_back():
    assert corrected(4, 3) == [1, 2, 3]
    assert corrected(4, 4) == corrected(4, 9) == [0, 1, 2, 3]
    assert corrected(5, 4) == [1, 2, 3, 4]


@pytest.mark.parametrize("knobs", [{"correct": False}, {"optimize_latents": False}, {"start": 1.0}])
def test_without_corrections_the_last_step_still_settles_the_scale(knobs):
    found = schedule(4, DEFAULT.changed(inner_steps=0, **knobs))
    assert found.steps == ((), (), (), (SETTLE,))


def test_maps_that_cannot_be_encoded_are_not_corrected():
    assert not any(r.corrects for rounds in schedule(4, encodes=False).steps for r in rounds)


def test_every_step_of_the_paper_makes_one_update():
    assert schedule(3, PAPER).steps == ((Round(False, 1),),) * 3


def test_updates_after_a_correction_come_late():
    found = schedule(4, DEFAULT.changed(inner_steps=3))
    assert found.steps == ((), (), (CORRECT,), (Round(True, 3),))


def test_rounds_of_one_step_are_those_of_all_and_correct_once_without_updates():
    assert schedule(1, rounds=4).steps == ((CORRECT,),)
    updated = schedule(1, DEFAULT.changed(inner_steps=2, correct=False), rounds=4)
    assert updated.steps == ((Round(False, 2),) * 4,)


def test_skipped_steps_count_in_fractions_of_the_schedule():
    assert schedule(3, skipped=1).steps == schedule(4).steps[1:]


def test_it_prints_what_happens():
    lines = str(schedule(3, DEFAULT.changed(inner_steps=3), skipped=1)).splitlines()
    assert lines[0].startswith("step 1: skipped") and lines[1:] == [
        "step 2: leave",
        "step 3: correct",
        "step 4: correct and update 3 x, last",
    ]
    assert str(schedule(1, SEARCH_ONLY)) == "step 1: settle the scale, last"


def test_more_steps_than_a_prior_has_are_refused():
    with pytest.raises(ValueError, match="num_inference_steps must be at most 1 with this prior; got 4"):
        count_steps(4, 4, 1)
