"""The schedule against its description: which rounds are active, corrected and updated."""

from itertools import product

import pytest

from geodiff_plugin.algorithm.schedule import Round, Schedule, count_steps, make_schedule
from geodiff_plugin.config import DEFAULT, UpdatePlan


def expected(
    config, plan: UpdatePlan, steps: int, rounds: int, encodes: bool
) -> tuple[tuple[Round, ...], ...]:
    """The rounds of every step, by the sentences of the docstring."""
    total = steps * rounds
    active = [i for i in range(total) if config.guidance_start * total <= i < config.guidance_end * total]
    fitted: set[int] = set()
    if config.fit_matches and config.optimize_latents and encodes and active:
        wanted = min(config.match_fits, len(active))
        # The others are spread evenly from the middle on, or from as early as they need to fit.
        first = min(len(active) // 2, len(active) - wanted)
        places = [len(active) - 1]
        if wanted > 1:
            gap = (len(active) - 1 - first) / (wanted - 1)
            places = [len(active) - 1 - round(k * gap) for k in range(wanted)]
        fitted = {active[place] for place in places}
    made = []
    for step in range(steps):
        of_step, unchanged_since_correction = [], False
        for i in (i for i in active if i // rounds == step):
            updates = plan.guidance_steps if (i + 1) > plan.updates_from * total else 0
            fits_matches = i in fitted and not unchanged_since_correction
            if fits_matches or updates:
                of_step.append(Round(fits_matches, updates))
                unchanged_since_correction = not updates and (fits_matches or unchanged_since_correction)
        made.append(tuple(of_step))
    if not any(made):
        made[-1] = (Round(False, 0),)
    return tuple(made)


def test_schedules_of_all_kinds_are_those_of_the_description():
    cases = 0
    for steps, rounds, corrections, (start, stop), (inner, since), correct, encodes in product(
        (1, 2, 5, 8),
        (1, 3),
        (1, 2, 4),
        ((0.0, 1.0), (0.25, 0.75), (0.5, 0.5)),
        ((0, 0.0), (3, 0.0), (2, 0.75), (2, 0.5)),
        (True, False),
        (True, False),
    ):
        config = DEFAULT.changed(
            match_fits=corrections, guidance_start=start, guidance_end=stop, fit_matches=correct
        )
        plan = UpdatePlan(inner, since, 0.03)
        made = make_schedule(config, plan, steps, rounds=rounds, encodes=encodes)
        assert made.steps == expected(config, plan, steps, rounds, encodes) and made.updates_latents
        cases += bool(sum(map(len, made.steps)) > 1)
    assert cases > 200


def test_rounds_and_whether_a_map_can_be_encoded_are_given_by_name():
    assert make_schedule(DEFAULT, UpdatePlan(0, 0.0, 0.1), 1).steps == ((Round(True, 0),),)
    with pytest.raises(TypeError, match="positional"):
        make_schedule(DEFAULT, UpdatePlan(0, 0.0, 0.1), 1, 2)


def test_a_round_after_a_correction_without_updates_is_not_corrected_again():
    """Eight rounds in two steps, all to be corrected: one a step, unless updates come between."""
    config = DEFAULT.changed(match_fits=8)
    without = make_schedule(config, UpdatePlan(0, 0.0, 0.1), 2, rounds=4).steps
    assert without == ((Round(True, 0),),) * 2
    late = make_schedule(config, UpdatePlan(5, 0.75, 0.1), 2, rounds=4).steps
    assert late == ((Round(True, 0),), (Round(True, 0), Round(False, 5), Round(True, 5)))


@pytest.mark.parametrize("updates_latents", [True, False])
def test_latents_move_where_a_round_corrects_or_updates(updates_latents):
    config = DEFAULT.changed(optimize_latents=updates_latents)
    made = make_schedule(config, UpdatePlan(0, 0.0, 0.1), 3)
    assert made.updates_latents == updates_latents
    schedule = Schedule(
        ((), (Round(False, 0),), (Round(True, 0),), (Round(False, 2), Round(False, 0))), updates_latents
    )
    assert [schedule.updates_at(i) for i in range(4)] == [False, False, updates_latents, updates_latents]
    assert [schedule.is_last(i) for i in range(4)] == [False, False, False, True]


@pytest.mark.parametrize(
    ("wanted", "requested", "most", "found"),
    [
        (10, None, None, (10, 1)),
        (10, 10, None, (10, 1)),
        (4, 4, 4, (4, 1)),
        (3, None, 4, (3, 1)),
        (10, None, 4, (4, 3)),
        (8, None, 4, (4, 2)),
        (7, None, 1, (1, 7)),
    ],
)
def test_rounds_of_all_wanted_steps_are_run_within_the_steps_of_the_prior(wanted, requested, most, found):
    assert count_steps(wanted, requested, most) == found
    if most is not None and wanted > most:
        with pytest.raises(
            ValueError,
            match=rf"^num_inference_steps must be at most {most} with this prior; got {wanted}\. Omit it",
        ):
            count_steps(wanted, wanted, most)
