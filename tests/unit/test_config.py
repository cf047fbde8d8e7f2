"""The configuration: what a knob may be, how it is saved, typed on a command line, and told."""

import copy
import dataclasses
import itertools
import json
import math
import os
import pickle
import re
from pathlib import Path

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.config import (
    DEFAULT,
    FAST,
    KNOBS,
    MARIGOLD_DC,
    PAPER,
    PRESETS,
    PRIOR_FIT,
    SEARCH_ONLY,
    SECTIONS,
    GuidanceConfig,
    affected,
    close_names,
    config_from_text,
    knob_lines,
    sentences,
    shown,
    value_of,
)
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions

(PAGE,) = (Path(__file__).resolve().parents[2] / "docs").rglob("knobs.md")


@pytest.mark.parametrize("described", dataclasses.fields(GuidanceConfig), ids=lambda field: field.name)
def test_the_default_of_every_knob_is_legal(described):
    knob = described.metadata
    assert "|" not in knob["values"]
    assert knob["check"](described.default, described.name) == described.default
    assert bool(knob["unset"]) == (described.default is None)


@pytest.mark.parametrize("settings", [GuidanceConfig, DepthOptions, CaptureOptions])
def test_every_setting_declares_what_becomes_stale_when_it_changes(settings):
    assert [each.name for each in dataclasses.fields(settings) if affected(each) is None] == []


#: What each preset changes: S5.1 and Algorithm 1 print it for the paper, the code of Marigold-DC for that.
CHANGED_BY = {
    "default": {},
    "fast": {"sweep_pixels": 80_000, "corrections": 1, "min_steps": 1, "pose": "given"},
    "paper": {
        **{"gradient": "full", "rule": "summed", "step_latents": 0.01, "inner_steps": 1, "min_steps": 10},
        **{"weights": {"photometric": 1.0, "prior_pull": 0.01}, "pyramid_levels": 1, "exposure": False},
        **{"z_test": False, "min_visible": 0.0, "pull_to": "zero", "search": "one-number", "pose": "given"},
        **{"sweep_pixels": 442_368, "clean_photographs": False, "correct": False, "crisp": False},
        "reject_reflections": False,
    },
    "marigold-dc": {
        **{"gradient": "full", "rule": "adam-norm", "step_latents": 0.05, "step_affine": 0.005},
        **{"inner_steps": 1, "min_steps": 50, "weights": {"points": 1.0}, "points_loss": "l1l2"},
        **{"positive": "square", "search": "points-range", "step_from": "updated", "even_ensemble": "lower"},
        **{"ensemble_at": "image", "sweep_pixels": 4_294_967_296, "correct": False, "crisp": False},
    },
    "search-only": {"inner_steps": 0, "weights": {"photometric": 1.0}, "correct": False, "crisp": False},
    "prior-fit": {"inner_steps": 0, "correct": False},
}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_changes_what_its_source_prints_and_nothing_else(preset):
    default, values = DEFAULT.to_dict(), PRESETS[preset].to_dict()
    assert {name: value for name, value in values.items() if value != default[name]} == CHANGED_BY[preset]


def test_the_papers_numbers_that_are_the_defaults_too():
    assert (PAPER.eta, PAPER.step_affine, PAPER.weights["prior_pull"]) == (0.85, 0.01, 0.01)
    assert DEFAULT.weights == {"photometric": 1, "matches": 1, "points": 1, "prior_pull": 0.01, "anchor": 1}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_survives_saving_copying_and_pickling(preset, tmp_path):
    config = PRESETS[preset]
    config.save(tmp_path / "guidance.json")
    assert set(json.loads((tmp_path / "guidance.json").read_text())) == set(KNOBS)
    assert GuidanceConfig.load(tmp_path / "guidance.json") == config
    assert copy.deepcopy(config) == config == pickle.loads(pickle.dumps(config))
    assert hash(copy.deepcopy(config)) == hash(config)


def test_automatic_choices_are_settled_when_asked_and_never_saved():
    assert DEFAULT.to_dict()["inner_steps"] is None
    assert DEFAULT.plan_updates(False) == (0, 0.75, 0.03)
    assert DEFAULT.changed(correct=False).plan_updates(False) == (40, 0.0, 0.1)
    assert DEFAULT.changed(stop=0.5).plan_updates(False).updates_from == 0.375
    only_points = DEFAULT.changed(weights={"points": 1.0})
    assert [only_points.plan_updates(given).inner_steps for given in (False, True)] == [40, 0]
    assert PAPER.plan_updates(False).inner_steps == 1 and SEARCH_ONLY.plan_updates(False).inner_steps == 0
    assert MARIGOLD_DC.plan_updates(True).step_latents == 0.05


def test_a_configuration_does_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT.planes = 2
    with pytest.raises(TypeError, match="does not change"):
        DEFAULT.weights["matches"] = 0.0
    assert DEFAULT.changed(weights=DEFAULT.weights | {"matches": 0.0}).weights["matches"] == 0.0


@pytest.mark.parametrize(
    ("knobs", "error", "message"),
    [
        ({"correct": 1}, TypeError, "correct must be True or False; got int"),
        ({"smoothness": float("nan")}, ValueError, "smoothness.*nan"),
        ({"inner_steps": 2.0}, TypeError, "inner_steps must be an integer"),
        ({"depth_range": [2.0, 1.0]}, ValueError, "depth_range"),
        ({"weights": {"matches": float("nan")}}, ValueError, "matches"),
        ({"start": 0.9, "stop": 0.5}, ValueError, "start"),
        ({"colour": 1}, ValueError, "'colour'.*There are: gradient"),
    ],
)
def test_what_a_knob_cannot_be_is_refused(knobs, error, message):
    with pytest.raises(error, match=message) as caught:
        DEFAULT.changed(**knobs)
    assert isinstance(caught.value, InputError)


def test_a_saved_configuration_with_a_strange_name_is_refused(tmp_path):
    with pytest.raises(InputError, match="'smothness'.*Did you mean smoothness"):
        GuidanceConfig.from_dict({"smothness": 1.0})
    with pytest.raises(InputError, match="the configuration must be a dict"):
        GuidanceConfig.from_dict([3])
    (tmp_path / "guidance.json").write_text("{")
    with pytest.raises(InputError, match="a JSON file"):
        GuidanceConfig.load(tmp_path / "guidance.json")
    assert GuidanceConfig.from_dict({"stop": 0.5}) == DEFAULT.changed(stop=0.5)
    former = {"correction": {"smoothness": 3.0, "passes": 3}, "loss_resolution": 512}
    with pytest.warns(UserWarning, match="left out: passes, loss_resolution"):
        assert GuidanceConfig.from_dict(former) == DEFAULT.changed(smoothness=3.0)


def test_knobs_as_typed():
    assert DEFAULT.changed(g_s_range=[1, 2], decoder=Path("tiny")).g_s_range == (1.0, 2.0)
    typed = ["smoothness=5", "weights.matches=0", "weights.far_pull=2", "g_s_range=[1,2]", "rule=plain"]
    config = config_from_text([*typed, "inner_steps=null"], PAPER, "--knob")
    assert config.smoothness == 5.0 and config.rule == "plain"
    assert config.weights == {"photometric": 1.0, "prior_pull": 0.01, "matches": 0.0, "far_pull": 2.0}
    assert config.g_s_range == (1.0, 2.0) and config.inner_steps is None


@pytest.mark.parametrize("typed", ["speed=9", "weights=1", "pose.x=1", "updates.stop=1", "=1"])
def test_what_is_no_knob_is_told_with_those_that_are(typed):
    with pytest.raises(InputError, match="--knob must be KNOB=VALUE.*inner_steps.*weights.NAME"):
        config_from_text([typed], DEFAULT, "--knob")


def tables():
    """Markdown tables of every knob, a section each."""
    lines, said = [], sentences()
    for described in dataclasses.fields(GuidanceConfig):
        name, knob = described.name, described.metadata
        if name in SECTIONS:
            lines += ["", f"### {SECTIONS[name]}", ""]
            lines += ["| knob | default | what it does; range |", "| --- | --- | --- |"]
        default = f"`None`: {knob['unset']}" if knob["unset"] else shown(described.default)
        paper = knob["paper"].format(shown(value_of(name, PAPER)))
        default += f" (paper: {paper})" if paper not in ("-", shown(described.default)) else ""
        values = "" if knob["values"] == "bool" else f"; {knob['values']}"
        lines.append(f"| `{name}` | {default} | {said[name]}{values} |")
    return "\n".join([*lines, ""])


def test_the_page_of_knobs_is_up_to_date():
    """``GEODIFF_WRITE=1 pytest tests/unit/test_config.py`` makes its tables anew."""
    page = PAGE.read_text(encoding="utf-8")
    before, begin, rest = page.partition("<!-- tables of tests/unit/test_config.py -->\n")
    _, end, after = rest.partition("\n<!-- end -->")
    assert begin and end
    made = f"{before}{begin}{tables()}{end}{after}"
    if os.environ.get("GEODIFF_WRITE"):
        PAGE.write_text(made, encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == made


def test_knobs_are_few_and_each_has_a_line_for_the_terminal():
    assert len(KNOBS) <= 45 and set(SECTIONS) <= set(KNOBS)
    told = [line for line in knob_lines() if line.startswith("  ")]
    assert [line.split()[0] for line in told] == list(KNOBS)
    assert all(len(line.partition("]  ")[2]) > 20 and "](" not in line for line in told)


#: What each preset changes of the default, from the page of knobs, the paper and the code of Marigold-DC.
CHANGES = {
    "default": {},
    "fast": {"sweep_pixels": 80_000, "corrections": 1, "min_steps": 1, "pose": "given"},
    "search-only": {"inner_steps": 0, "weights": {"photometric": 1.0}, "correct": False, "crisp": False},
    "prior-fit": {"inner_steps": 0, "correct": False},
    "paper": {
        "gradient": "full",
        "rule": "summed",
        "step_latents": 0.01,
        "inner_steps": 1,
        "min_steps": 10,
        "weights": {"photometric": 1.0, "prior_pull": 0.01},
        "pyramid_levels": 1,
        "exposure": False,
        "z_test": False,
        "min_visible": 0.0,
        "pull_to": "zero",
        "search": "one-number",
        "sweep_pixels": 768 * 576,
        "pose": "given",
        "clean_photographs": False,
        "correct": False,
        "reject_reflections": False,
        "crisp": False,
    },
    "marigold-dc": {
        "gradient": "full",
        "rule": "adam-norm",
        "step_latents": 0.05,
        "step_affine": 0.005,
        "inner_steps": 1,
        "min_steps": 50,
        "weights": {"points": 1.0},
        "points_loss": "l1l2",
        "positive": "square",
        "search": "points-range",
        "step_from": "updated",
        "even_ensemble": "lower",
        "ensemble_at": "image",
        "sweep_pixels": 2**32,
        "correct": False,
        "crisp": False,
    },
}


def test_presets_differ_from_the_default_by_what_they_are_said_to():
    assert set(CHANGES) == set(PRESETS)
    for name, config in PRESETS.items():
        default, values = DEFAULT.to_dict(), config.to_dict()
        assert {k: v for k, v in values.items() if v != default[k]} == CHANGES[name], name
    assert list(PRESETS.values()) == [DEFAULT, FAST, PAPER, MARIGOLD_DC, SEARCH_ONLY, PRIOR_FIT]


RANGE_IN_WORDS = {name: GuidanceConfig.__dataclass_fields__[name].metadata["values"] for name in KNOBS}


def knobs_of(pattern: str) -> list[str]:
    """Knobs whose range, as the page has it, looks like this."""
    return [name for name, values in RANGE_IN_WORDS.items() if re.match(pattern, values)]


def test_every_knob_is_a_number_a_choice_a_flag_a_pair_a_text_or_the_weights():
    kinds = (
        knobs_of(r"(integer, )?\["),
        knobs_of("`"),
        knobs_of("bool"),
        knobs_of("pair"),
        ["weights", "rule"],
    )
    assert sorted(itertools.chain(*kinds)) == sorted(KNOBS)


@pytest.mark.parametrize("name", KNOBS)
def test_a_knob_is_none_only_where_its_range_says_so(name):
    if RANGE_IN_WORDS[name].endswith(", or `None`"):
        assert getattr(DEFAULT.changed(**{name: None}), name) is None
    else:
        with pytest.raises(InputError, match=name):
            DEFAULT.changed(**{name: None})


@pytest.mark.parametrize("name", knobs_of(r"(integer, )?\["))
def test_a_number_is_taken_up_to_the_ends_of_its_range(name):
    low, high = map(float, re.search(r"\[([^,]+), ([^]]+)\]", RANGE_IN_WORDS[name]).groups())
    whole = RANGE_IN_WORDS[name].startswith("integer")
    kind, step = (int, 1) if whole else (float, 1e-6 * high)
    related = {"start": {"stop": 1.0}, "stop": {"start": 0.0}}.get(name, {})
    for end in (low, high):
        found = getattr(DEFAULT.changed(**related | {name: kind(end)}), name)
        assert found == end and isinstance(found, kind)
    assert isinstance(getattr(DEFAULT.changed(**related | {name: math.ceil(low)}), name), kind)
    for beyond in (kind(low - step), kind(high + step), math.nan, True, "1"):
        with pytest.raises(InputError, match=name):
            DEFAULT.changed(**related | {name: beyond})
    if whole:
        with pytest.raises(InputError, match="integer"):
            DEFAULT.changed(**{name: low + 0.5})


@pytest.mark.parametrize("name", [name for name in knobs_of("`") if name != "decoder"])
def test_a_choice_is_one_of_those_in_its_range_the_first_by_default(name):
    choices = re.findall(r"`([^`]+)`", RANGE_IN_WORDS[name])
    assert choices[0] == getattr(DEFAULT, name) and len(choices) > 1
    for choice in choices:
        assert getattr(DEFAULT.changed(**{name: choice}), name) == choice
    with pytest.raises(InputError, match=name):
        DEFAULT.changed(**{name: "another"})


def test_flags_pairs_and_texts_are_nothing_else():
    for name in knobs_of("bool"):
        other = not getattr(DEFAULT, name)
        assert getattr(DEFAULT.changed(**{name: other}), name) is other
    wrong = [(name, value) for name in knobs_of("bool") for value in (0, "true")]
    for name in knobs_of("pair"):
        assert getattr(DEFAULT.changed(**{name: [0.5, 7]}), name) == (0.5, 7.0)
        wrong += [(name, value) for value in ((0.0, 1.0), (2.0, 2.0), (1.0,), 3.0)]
    for name in ("decoder", "rule"):
        assert getattr(DEFAULT.changed(**{name: "a folder"}), name) == "a folder"
        wrong += [(name, value) for value in ("", 3)]
    for name, value in wrong:
        with pytest.raises(InputError, match=name):
            DEFAULT.changed(**{name: value})


#: Least and largest value of every number.
NUMBERS = {
    "min_steps": "integer, [1, 1000]",
    "sweep_pixels": "integer, [1024, 4294967296]",
    "eta": "[0, 1]",
    "pyramid_levels": "integer, [1, 10]",
    "min_visible": "[0, 1]",
    "planes": "integer, [24, 4096]",
    "g_s_candidates": "integer, [2, 100000]",
    "corrections": "integer, [1, 10000]",
    "smoothness": "[1e-09, 1000000]",
    "match_noise": "[1e-09, 1000]",
    "outlier_width": "[1e-09, 1000000]",
    "step_latents": "[0, 1000000], or `None`",
    "step_affine": "[0, 1000000]",
    "inner_steps": "integer, [0, 10000], or `None`",
    "start": "[0, 1]",
    "stop": "[0, 1]",
}


def test_the_ranges_of_numbers_are_those_of_the_manual():
    told = "\n".join(knob_lines())
    assert all(f"  [{values.replace('`', '')}]  " in told for values in NUMBERS.values())
    assert {name: RANGE_IN_WORDS[name] for name in knobs_of(r"(integer, )?\[")} == NUMBERS


def test_weights_are_numbers_from_0_by_names_and_stay_as_they_are():
    given = {"matches": 2, "points": 0.0}
    config = DEFAULT.changed(weights=given)
    given["matches"] = 9.0
    assert config.weights == {"matches": 2.0, "points": 0.0} and isinstance(config.weights["matches"], float)
    for wrong in ({"matches": -0.1}, {3: 1.0}, [("matches", 1.0)], {"matches": math.inf}, {"matches": True}):
        with pytest.raises(InputError, match="weights"):
            DEFAULT.changed(weights=wrong)
    for change in (
        lambda weights: weights.pop("matches"),
        lambda weights: weights.update(matches=1.0),
        lambda weights: weights.setdefault("new", 1.0),
        lambda weights: weights.clear(),
        lambda weights: weights.__delitem__("matches"),
    ):
        with pytest.raises(TypeError, match="does not change"):
            change(config.weights)
    assert hash(config) == hash(DEFAULT.changed(weights={"points": 0.0, "matches": 2.0}))


def test_the_start_of_updates_lies_before_their_stop():
    assert DEFAULT.changed(start=0.5, stop=0.5).start == 0.5
    with pytest.raises(InputError, match="start must be between 0 and 0.4"):
        DEFAULT.changed(start=0.5, stop=0.4)


def test_updates_come_late_and_small_where_matches_or_points_bring_the_latent_close():
    """For every combination of what decides it."""
    weights = [{"photometric": 1.0}, {"matches": 0.5}, {"points": 0.5}, {"matches": 0.0, "points": 2.0}]
    flags = itertools.product(weights, (True, False), (True, False), ("denoised", "full"), (True, False))
    for weight, correct, latents, gradient, points in flags:
        config = DEFAULT.changed(
            weights=weight, correct=correct, optimize_latents=latents, gradient=gradient, stop=0.6
        )
        encoded = weight.get("matches", 0) > 0 or (weight.get("points", 0) > 0 and points)
        near = encoded and correct and latents and gradient == "denoised"
        plan = config.plan_updates(points)
        assert plan == ((0, pytest.approx(0.45), 0.03) if near else (40, 0.0, 0.1))
        given = config.changed(inner_steps=7, step_latents=0.25).plan_updates(points)
        assert (given.inner_steps, given.step_latents) == (7, 0.25)
        assert given.updates_from == plan.updates_from
        assert config.changed(inner_steps=0, step_latents=0.0).plan_updates(points)[::2] == (0, 0.0)


def test_matches_are_needed_where_they_weigh_and_move_something():
    for weight, correct, crisp, steps in itertools.product((0.0, 0.7), (True, False), (True, False), (0, 3)):
        config = DEFAULT.changed(weights={"matches": weight}, correct=correct, crisp=crisp, inner_steps=steps)
        assert config.needs_matches(False) == (weight > 0 and (correct or crisp or steps > 0))
    late = DEFAULT.changed(weights={"matches": 1.0, "points": 1.0}, correct=False, crisp=False)
    assert late.needs_matches(True), "40 updates are made"


def test_a_configuration_is_json_and_comes_back():
    config = DEFAULT.changed(depth_range=(1, 9), weights={"matches": 3.0}, inner_steps=4)
    values = json.loads(json.dumps(config.to_dict()))
    assert values["depth_range"] == [1.0, 9.0] and values["weights"] == {"matches": 3.0}
    assert list(values) == list(KNOBS) and GuidanceConfig.from_dict(values) == config
    assert isinstance(config.to_dict()["g_s_range"], list)


def test_names_that_look_alike_come_first():
    names = ["planes", "pose", "smoothness", "match_noise", "match_sigma"]
    assert close_names("match_nois", names).startswith("Did you mean match_noise")
    assert close_names("match_", names).startswith("Did you mean match_")
    assert " or match_" in close_names("match_n", names)
    assert close_names("xyz", names) == f"There are: {', '.join(names)}."


def test_the_value_of_a_knob_is_settled_and_that_of_a_weight_is_its_terms():
    assert value_of("weights.matches", PAPER.changed(weights={"matches": 4.0})) == 4.0
    assert value_of("inner_steps", DEFAULT) == 0 and value_of("step_latents", DEFAULT) == 0.03
    assert value_of("inner_steps", DEFAULT.changed(inner_steps=5)) == 5
    assert value_of("depth_range", DEFAULT) is None and value_of("planes", FAST) == 160
    with pytest.raises(KeyError):
        value_of("weights.nothing", DEFAULT)
    with pytest.raises(InputError, match="'plane'.*Did you mean planes"):
        value_of("plane", DEFAULT)


def test_several_weights_are_typed_one_after_the_other():
    config = config_from_text(["weights.points=3", "weights.matches=0.5", "planes=90"], DEFAULT, "--knob")
    assert config.weights == DEFAULT.weights | {"points": 3.0, "matches": 0.5} and config.planes == 90
    assert config_from_text([], PAPER, "--knob") is not None
    assert config_from_text(['decoder="a=b"'], DEFAULT, "--knob").decoder == "a=b"
    assert config_from_text(["decoder=a=b"], DEFAULT, "--knob").decoder == "a=b"
    assert config_from_text(["decoder=" + "[" * 100_000], DEFAULT, "--knob").decoder.startswith("[[")
    with pytest.raises(InputError, match="Write planes=VALUE"):
        config_from_text(["planes"], DEFAULT, "--knob")


def test_values_are_shown_as_people_write_them():
    assert shown((1.0, 80.0)) == "(1, 80)" and shown(0.25) == "0.25" and shown(160) == "160"
    assert shown({"a": 1.0, "b": 0.5}) == "a 1, b 0.5" and shown({}) == "none" and shown(None) == "None"
