"""The configuration: which values a parameter accepts, how it is saved, set on a command line, and shown."""

import copy
import dataclasses
import itertools
import json
import math
import pickle
import re
from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.config import (
    DEFAULT,
    FAST,
    MARIGOLD_DC,
    PAPER,
    PARAMETERS,
    PRESETS,
    PRIOR_FIT,
    SEARCH_ONLY,
    GuidanceConfig,
    close_names,
    config_from_text,
    parameter_lines,
    shown,
    value_of,
)
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions
from geodiff_plugin.settings import settings_of
from tests.pages import check_generated
from tests.unit.error_sentences import check_error

(PAGE,) = (Path(__file__).resolve().parents[2] / "docs").rglob("parameters.md")


@pytest.mark.parametrize("name", PARAMETERS)
def test_the_default_of_every_parameter_is_legal(name):
    parameter = PARAMETERS[name]
    assert "|" not in parameter.values
    assert parameter.check(parameter.default, name) == parameter.default
    assert bool(parameter.unset) == (parameter.default is None)


@pytest.mark.parametrize("record", [GuidanceConfig, DepthOptions, CaptureOptions])
def test_every_setting_declares_what_becomes_stale_when_it_changes(record):
    assert list(settings_of(record)) == [field.name for field in dataclasses.fields(record)]
    assert [name for name, setting in settings_of(record).items() if setting.affects is None] == []


#: What each preset changes: S5.1 and Algorithm 1 print it for the paper, the code of Marigold-DC for that.
CHANGED_BY = {
    "default": {},
    "fast": {"sweep_pixels": 80_000, "match_fits": 1, "min_steps": 1, "pose": "given"},
    "paper": {
        **{
            "gradient": "full",
            "optimizer": "summed",
            "lr_latents": 0.01,
            "guidance_steps": 1,
            "min_steps": 10,
        },
        **{"weights": {"photometric": 1.0, "affine_reg": 0.01}, "pyramid_levels": 1, "exposure": False},
        **{
            "occlusion_mask": False,
            "min_visible": 0.0,
            "affine_reg_target": "zero",
            "search": "one-number",
            "pose": "given",
        },
        **{"sweep_pixels": 442_368, "clean_images": False, "fit_matches": False, "refine_edges": False},
        "reject_reflections": False,
    },
    "marigold-dc": {
        **{"gradient": "full", "optimizer": "adam-norm", "lr_latents": 0.05, "lr_affine": 0.005},
        **{"guidance_steps": 1, "min_steps": 50, "weights": {"points": 1.0}, "points_loss": "l1l2"},
        **{"positive": "square", "search": "points-range", "step_from": "updated", "even_ensemble": "lower"},
        **{
            "ensemble_at": "image",
            "sweep_pixels": 4_294_967_296,
            "fit_matches": False,
            "refine_edges": False,
        },
    },
    "search-only": {
        "guidance_steps": 0,
        "weights": {"photometric": 1.0},
        "fit_matches": False,
        "refine_edges": False,
    },
    "prior-fit": {"guidance_steps": 0, "fit_matches": False},
}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_changes_what_its_source_prints_and_nothing_else(preset):
    default, values = DEFAULT.to_dict(), PRESETS[preset].to_dict()
    assert {name: value for name, value in values.items() if value != default[name]} == CHANGED_BY[preset]


def test_the_papers_numbers_that_are_the_defaults_too():
    assert (PAPER.ssim_weight, PAPER.lr_affine, PAPER.weights["affine_reg"]) == (0.85, 0.01, 0.01)
    assert DEFAULT.weights == {"photometric": 1, "matches": 1, "points": 1, "affine_reg": 0.01, "anchor": 1}


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_survives_saving_copying_and_pickling(preset, tmp_path):
    config = PRESETS[preset]
    config.save(tmp_path / "guidance.json")
    assert set(json.loads((tmp_path / "guidance.json").read_text())) == set(PARAMETERS)
    assert GuidanceConfig.load(tmp_path / "guidance.json") == config
    assert copy.deepcopy(config) == config == pickle.loads(pickle.dumps(config))
    assert hash(copy.deepcopy(config)) == hash(config)


def test_automatic_choices_are_settled_when_asked_and_never_saved():
    assert DEFAULT.to_dict()["guidance_steps"] is None
    assert DEFAULT.plan_updates(False) == (0, 0.75, 0.03)
    assert DEFAULT.changed(fit_matches=False).plan_updates(False) == (40, 0.0, 0.1)
    assert DEFAULT.changed(guidance_end=0.5).plan_updates(False).updates_from == 0.375
    only_points = DEFAULT.changed(weights={"points": 1.0})
    assert [only_points.plan_updates(given).guidance_steps for given in (False, True)] == [40, 0]
    assert (
        PAPER.plan_updates(False).guidance_steps == 1 and SEARCH_ONLY.plan_updates(False).guidance_steps == 0
    )
    assert MARIGOLD_DC.plan_updates(True).lr_latents == 0.05


def test_a_configuration_does_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT.planes = 2
    with pytest.raises(TypeError, match="is immutable"):
        DEFAULT.weights["matches"] = 0.0
    assert DEFAULT.changed(weights=DEFAULT.weights | {"matches": 0.0}).weights["matches"] == 0.0


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        ({"fit_matches": 1}, TypeError, "fit_matches must be True or False; got int"),
        ({"smoothness": float("nan")}, ValueError, "smoothness.*nan"),
        ({"guidance_steps": 2.0}, TypeError, "guidance_steps must be an integer"),
        ({"depth_range": [2.0, 1.0]}, ValueError, "depth_range"),
        ({"weights": {"matches": float("nan")}}, ValueError, "matches"),
        ({"guidance_start": 0.9, "guidance_end": 0.5}, ValueError, "guidance_start"),
        ({"colour": 1}, ValueError, "'colour'.*Available: gradient"),
    ],
)
def test_invalid_values_of_a_parameter_are_rejected(parameters, error, message):
    with pytest.raises(error, match=message) as caught:
        DEFAULT.changed(**parameters)
    assert isinstance(caught.value, InputError)


def test_a_saved_configuration_with_a_strange_name_is_rejected(tmp_path):
    with pytest.raises(InputError, match="'smothness'.*Did you mean smoothness"):
        GuidanceConfig.from_dict({"smothness": 1.0})
    with pytest.raises(InputError, match="the configuration must be a dict"):
        GuidanceConfig.from_dict([3])
    (tmp_path / "guidance.json").write_text("{")
    with pytest.raises(InputError, match="a JSON file"):
        GuidanceConfig.load(tmp_path / "guidance.json")
    assert GuidanceConfig.from_dict({"guidance_end": 0.5}) == DEFAULT.changed(guidance_end=0.5)
    former = {"correction": {"smoothness": 3.0, "passes": 3}, "loss_resolution": 512}
    with pytest.warns(UserWarning, match="are ignored: passes, loss_resolution"):
        assert GuidanceConfig.from_dict(former) == DEFAULT.changed(smoothness=3.0)


def test_parameters_as_typed():
    assert DEFAULT.changed(g_s_range=[1, 2], decoder=Path("tiny")).g_s_range == (1.0, 2.0)
    typed = ["smoothness=5", "weights.matches=0", "weights.far_pull=2", "g_s_range=[1,2]", "optimizer=plain"]
    config = config_from_text([*typed, "guidance_steps=null"], PAPER, "--set")
    assert config.smoothness == 5.0 and config.optimizer == "plain"
    assert config.weights == {"photometric": 1.0, "affine_reg": 0.01, "matches": 0.0, "far_pull": 2.0}
    assert config.g_s_range == (1.0, 2.0) and config.guidance_steps is None


@pytest.mark.parametrize("typed", ["speed=9", "weights=1", "pose.x=1", "updates.stop=1", "=1"])
def test_an_unknown_parameter_is_reported_with_the_existing_ones(typed):
    with pytest.raises(InputError, match="--set must be NAME=VALUE.*guidance_steps.*weights.NAME"):
        config_from_text([typed], DEFAULT, "--set")


def tables():
    """Markdown tables of every parameter, one per section, and of what the presets change."""
    lines = []
    for section, parameters in itertools.groupby(PARAMETERS.values(), lambda parameter: parameter.section):
        lines += ["", f"### {section}", ""]
        lines += ["| parameter | default | paper | values | meaning |", "| --- | --- | --- | --- | --- |"]
        for parameter in parameters:
            default = f"`None`: {parameter.unset}" if parameter.unset else shown(parameter.default)
            paper = parameter.paper.format(shown(value_of(parameter.name, PAPER)))
            paper = "" if paper in ("-", shown(parameter.default)) else paper
            values = "`True`, `False`" if parameter.kind is bool else parameter.values
            lines.append(f"| `{parameter.name}` | {default} | {paper} | {values} | {parameter.help} |")
    lines += ["", "## Presets", "", "| preset | changes to the default |", "| --- | --- |"]
    for name, preset in PRESETS.items():
        values = {key: getattr(preset, key) for key in PARAMETERS}
        changed = [f"`{k}` {shown(v)}" for k, v in values.items() if v != getattr(DEFAULT, k)]
        lines += [f"| `{name}` | {'; '.join(changed)} |"] if changed else []
    return "\n".join([*lines, ""])


def test_the_page_of_parameters_is_up_to_date():
    """``GEODIFF_WRITE=1 pytest tests/unit/test_config.py`` regenerates its tables."""
    check_generated(PAGE, "<!-- tables of tests/unit/test_config.py -->\n", tables(), "\n<!-- end -->")


def test_parameters_are_few_and_each_has_a_line_for_the_terminal():
    assert len(PARAMETERS) <= 45
    sections = [
        section for section, _ in itertools.groupby(PARAMETERS.values(), lambda parameter: parameter.section)
    ]
    assert len(sections) == len(set(sections)) and set(sections) <= set(parameter_lines())
    assert all(
        f"{name}: {parameter.help}." in GuidanceConfig.__doc__ for name, parameter in PARAMETERS.items()
    )
    reported = [line for line in parameter_lines() if line.startswith("  ")]
    assert [line.split()[0] for line in reported] == list(PARAMETERS)
    assert all(len(line.partition("]  ")[2]) > 20 and "](" not in line for line in reported)


#: Changes of each preset to the default, from the parameter reference, the paper and Marigold-DC's code.
CHANGES = {
    "default": {},
    "fast": {"sweep_pixels": 80_000, "match_fits": 1, "min_steps": 1, "pose": "given"},
    "search-only": {
        "guidance_steps": 0,
        "weights": {"photometric": 1.0},
        "fit_matches": False,
        "refine_edges": False,
    },
    "prior-fit": {"guidance_steps": 0, "fit_matches": False},
    "paper": {
        "gradient": "full",
        "optimizer": "summed",
        "lr_latents": 0.01,
        "guidance_steps": 1,
        "min_steps": 10,
        "weights": {"photometric": 1.0, "affine_reg": 0.01},
        "pyramid_levels": 1,
        "exposure": False,
        "occlusion_mask": False,
        "min_visible": 0.0,
        "affine_reg_target": "zero",
        "search": "one-number",
        "sweep_pixels": 768 * 576,
        "pose": "given",
        "clean_images": False,
        "fit_matches": False,
        "reject_reflections": False,
        "refine_edges": False,
    },
    "marigold-dc": {
        "gradient": "full",
        "optimizer": "adam-norm",
        "lr_latents": 0.05,
        "lr_affine": 0.005,
        "guidance_steps": 1,
        "min_steps": 50,
        "weights": {"points": 1.0},
        "points_loss": "l1l2",
        "positive": "square",
        "search": "points-range",
        "step_from": "updated",
        "even_ensemble": "lower",
        "ensemble_at": "image",
        "sweep_pixels": 2**32,
        "fit_matches": False,
        "refine_edges": False,
    },
}


def test_presets_differ_from_the_default_as_documented():
    assert set(CHANGES) == set(PRESETS)
    for name, config in PRESETS.items():
        default, values = DEFAULT.to_dict(), config.to_dict()
        assert {k: v for k, v in values.items() if v != default[k]} == CHANGES[name], name
    assert list(PRESETS.values()) == [DEFAULT, FAST, PAPER, MARIGOLD_DC, SEARCH_ONLY, PRIOR_FIT]


RANGE_IN_WORDS = {name: parameter.values for name, parameter in PARAMETERS.items()}


def parameters_of(pattern: str) -> list[str]:
    """Parameters whose range looks like this on the page."""
    return [name for name, values in RANGE_IN_WORDS.items() if re.match(pattern, values)]


def test_every_parameter_is_a_number_a_choice_a_flag_a_pair_a_text_or_the_weights():
    kinds = (
        parameters_of(r"(integer, )?\["),
        parameters_of("`"),
        parameters_of("bool"),
        parameters_of("pair"),
        ["weights", "optimizer"],
    )
    assert sorted(itertools.chain(*kinds)) == sorted(PARAMETERS)


@pytest.mark.parametrize("name", PARAMETERS)
def test_a_parameter_is_none_only_if_its_range_allows_it(name):
    if RANGE_IN_WORDS[name].endswith(", or `None`"):
        assert getattr(DEFAULT.changed(**{name: None}), name) is None
    else:
        with pytest.raises(InputError, match=name):
            DEFAULT.changed(**{name: None})


@pytest.mark.parametrize("name", parameters_of(r"(integer, )?\["))
def test_a_number_is_taken_up_to_the_ends_of_its_range(name):
    low, high = map(float, re.search(r"\[([^,]+), ([^]]+)\]", RANGE_IN_WORDS[name]).groups())
    whole = RANGE_IN_WORDS[name].startswith("integer")
    kind, step = (int, 1) if whole else (float, 1e-6 * high)
    related = {"guidance_start": {"guidance_end": 1.0}, "guidance_end": {"guidance_start": 0.0}}.get(name, {})
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


@pytest.mark.parametrize("name", [name for name in parameters_of("`") if name != "decoder"])
def test_a_choice_is_one_of_those_in_its_range_the_first_by_default(name):
    choices = re.findall(r"`([^`]+)`", RANGE_IN_WORDS[name])
    assert choices[0] == getattr(DEFAULT, name) and len(choices) > 1
    for choice in choices:
        assert getattr(DEFAULT.changed(**{name: choice}), name) == choice
    with pytest.raises(InputError, match=name):
        DEFAULT.changed(**{name: "another"})


def test_flags_pairs_and_texts_are_nothing_else():
    for name in parameters_of("bool"):
        other = not getattr(DEFAULT, name)
        assert getattr(DEFAULT.changed(**{name: other}), name) is other
    wrong = [(name, value) for name in parameters_of("bool") for value in (0, "true")]
    for name in parameters_of("pair"):
        assert getattr(DEFAULT.changed(**{name: [0.5, 7]}), name) == (0.5, 7.0)
        wrong += [(name, value) for value in ((0.0, 1.0), (2.0, 2.0), (1.0,), 3.0)]
    for name in ("decoder", "optimizer"):
        assert getattr(DEFAULT.changed(**{name: "a folder"}), name) == "a folder"
        wrong += [(name, value) for value in ("", 3)]
    for name, value in wrong:
        with pytest.raises(InputError, match=name):
            DEFAULT.changed(**{name: value})


#: Least and largest value of every number.
NUMBERS = {
    "min_steps": "integer, [1, 1000]",
    "sweep_pixels": "integer, [1024, 4294967296]",
    "ssim_weight": "[0, 1]",
    "pyramid_levels": "integer, [1, 10]",
    "min_visible": "[0, 1]",
    "planes": "integer, [24, 4096]",
    "g_s_candidates": "integer, [2, 100000]",
    "match_fits": "integer, [1, 10000]",
    "smoothness": "[1e-09, 1000000]",
    "match_sigma": "[1e-09, 1000]",
    "outlier_sigma": "[1e-09, 1000000]",
    "lr_latents": "[0, 1000000], or `None`",
    "lr_affine": "[0, 1000000]",
    "guidance_steps": "integer, [0, 10000], or `None`",
    "guidance_start": "[0, 1]",
    "guidance_end": "[0, 1]",
}


def test_the_ranges_of_numbers_are_those_of_the_manual():
    reported = "\n".join(parameter_lines())
    assert all(f"  [{values.replace('`', '')}]  " in reported for values in NUMBERS.values())
    assert {name: RANGE_IN_WORDS[name] for name in parameters_of(r"(integer, )?\[")} == NUMBERS


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
        with pytest.raises(TypeError, match="is immutable"):
            change(config.weights)
    assert hash(config) == hash(DEFAULT.changed(weights={"points": 0.0, "matches": 2.0}))


def test_the_start_of_updates_lies_before_their_stop():
    assert DEFAULT.changed(guidance_start=0.5, guidance_end=0.5).guidance_start == 0.5
    with pytest.raises(InputError, match="guidance_start must be between 0 and 0.4"):
        DEFAULT.changed(guidance_start=0.5, guidance_end=0.4)


def test_updates_come_late_and_small_where_matches_or_points_bring_the_latent_close():
    """For every combination of what decides it."""
    weights = [{"photometric": 1.0}, {"matches": 0.5}, {"points": 0.5}, {"matches": 0.0, "points": 2.0}]
    flags = itertools.product(weights, (True, False), (True, False), ("denoised", "full"), (True, False))
    for weight, correct, latents, gradient, points in flags:
        config = DEFAULT.changed(
            weights=weight, fit_matches=correct, optimize_latents=latents, gradient=gradient, guidance_end=0.6
        )
        encoded = weight.get("matches", 0) > 0 or (weight.get("points", 0) > 0 and points)
        near = encoded and correct and latents and gradient == "denoised"
        plan = config.plan_updates(points)
        assert plan == ((0, pytest.approx(0.45), 0.03) if near else (40, 0.0, 0.1))
        given = config.changed(guidance_steps=7, lr_latents=0.25).plan_updates(points)
        assert (given.guidance_steps, given.lr_latents) == (7, 0.25)
        assert given.updates_from == plan.updates_from
        assert config.changed(guidance_steps=0, lr_latents=0.0).plan_updates(points)[::2] == (0, 0.0)


def test_matches_are_needed_where_they_weigh_and_move_something():
    for weight, correct, refine_edges, steps in itertools.product(
        (0.0, 0.7), (True, False), (True, False), (0, 3)
    ):
        config = DEFAULT.changed(
            weights={"matches": weight}, fit_matches=correct, refine_edges=refine_edges, guidance_steps=steps
        )
        assert config.needs_matches(False) == (weight > 0 and (correct or refine_edges or steps > 0))
    late = DEFAULT.changed(weights={"matches": 1.0, "points": 1.0}, fit_matches=False, refine_edges=False)
    assert late.needs_matches(True), "40 updates are made"


def test_a_configuration_is_json_and_comes_back():
    config = DEFAULT.changed(depth_range=(1, 9), weights={"matches": 3.0}, guidance_steps=4)
    values = json.loads(json.dumps(config.to_dict()))
    assert values["depth_range"] == [1.0, 9.0] and values["weights"] == {"matches": 3.0}
    assert list(values) == list(PARAMETERS) and GuidanceConfig.from_dict(values) == config
    assert isinstance(config.to_dict()["g_s_range"], list)


def test_names_that_look_alike_come_first():
    names = ["planes", "pose", "smoothness", "match_fits", "match_sigma"]
    assert close_names("match_sigm", names).startswith("Did you mean match_sigma")
    assert close_names("match_", names).startswith("Did you mean match_")
    assert " or match_" in close_names("match_s", names)
    assert close_names("xyz", names) == f"Available: {', '.join(names)}."


def test_the_value_of_a_parameter_is_settled_and_that_of_a_weight_is_its_terms():
    assert value_of("weights.matches", PAPER.changed(weights={"matches": 4.0})) == 4.0
    assert value_of("guidance_steps", DEFAULT) == 0 and value_of("lr_latents", DEFAULT) == 0.03
    assert value_of("guidance_steps", DEFAULT.changed(guidance_steps=5)) == 5
    assert value_of("depth_range", DEFAULT) is None and value_of("planes", FAST) == 160
    with pytest.raises(KeyError):
        value_of("weights.nothing", DEFAULT)
    with pytest.raises(InputError, match="'plane'.*Did you mean planes"):
        value_of("plane", DEFAULT)


def test_several_weights_are_typed_one_after_the_other():
    config = config_from_text(["weights.points=3", "weights.matches=0.5", "planes=90"], DEFAULT, "--set")
    assert config.weights == DEFAULT.weights | {"points": 3.0, "matches": 0.5} and config.planes == 90
    assert config_from_text([], PAPER, "--set") is not None
    assert config_from_text(['decoder="a=b"'], DEFAULT, "--set").decoder == "a=b"
    assert config_from_text(["decoder=a=b"], DEFAULT, "--set").decoder == "a=b"
    assert config_from_text(["decoder=" + "[" * 100_000], DEFAULT, "--set").decoder.startswith("[[")
    with pytest.raises(InputError, match="Write planes=VALUE"):
        config_from_text(["planes"], DEFAULT, "--set")


def test_values_are_shown_as_people_write_them():
    assert shown((1.0, 80.0)) == "(1, 80)" and shown(0.25) == "0.25" and shown(160) == "160"
    assert shown({"a": 1.0, "b": 0.5}) == "a 1, b 0.5" and shown({}) == "none" and shown(None) == "None"


@pytest.mark.parametrize(
    ("call", "name", "expected", "found", "hint"),
    [
        (
            lambda p: DEFAULT.changed(speed=1),
            "a parameter",
            "an existing one",
            "'speed'",
            "Available: gradient",
        ),
        (
            lambda p: value_of("speed", DEFAULT),
            "a parameter",
            "an existing one",
            "'speed'",
            "Available: gradient",
        ),
        (
            lambda p: DEFAULT.changed(weights={1: 0.5}),
            "a key of weights",
            "a string",
            "1",
            "",
        ),
        (lambda p: DEFAULT.changed(weights=3), "weights", "a dict that maps names to values", "int", ""),
        (lambda p: DEFAULT.changed(weights={"matches": -1}), "weights['matches']", "between 0", "-1", ""),
        (lambda p: DEFAULT.changed(planes=3), "planes", "between 24 and 4096", "3", ""),
        (lambda p: DEFAULT.changed(planes="many"), "planes", "an integer", "the string 'many'", ""),
        (lambda p: DEFAULT.changed(exposure=1), "exposure", "True or False", "int", ""),
        (lambda p: DEFAULT.changed(pose="both"), "pose", "one of given, refine", "'both'", ""),
        (
            lambda p: DEFAULT.changed(optimizer=""),
            "optimizer",
            "a string (name of an optimizer)",
            "the string ''",
            "",
        ),
        (lambda p: DEFAULT.changed(g_s_range=(2, 1)), "g_s_range", "a pair with 0 < low", "(2.0, 1.0)", ""),
        (lambda p: DEFAULT.changed(g_s_range=(2, 3, 4)), "g_s_range", "a pair of numbers", "tuple", ""),
        (
            lambda p: DEFAULT.changed(guidance_end=0.25, guidance_start=0.5),
            "guidance_start",
            "between 0 and 0.25",
            "0.5",
            "",
        ),
        (
            lambda p: GuidanceConfig.from_dict([1]),
            "the configuration",
            "a dict that maps names to values",
            "list",
            "",
        ),
        (
            lambda p: GuidanceConfig.load(p),
            "the configuration ",
            "",
            "Expecting value: line 1",
            "",
        ),
        (
            lambda p: config_from_text(["speed=3"], DEFAULT, "--set"),
            "--set",
            "NAME=VALUE with a guidance parameter",
            "'speed=3'",
            "Available: gradient",
        ),
        (
            lambda p: config_from_text(["planes"], DEFAULT, "--set"),
            "--set",
            "NAME=VALUE with a guidance parameter",
            "'planes'",
            "Write planes=VALUE.",
        ),
    ],
)
def test_errors_state_what_was_expected_and_what_was_found(tmp_path, call, name, expected, found, hint):
    (tmp_path / "broken.json").write_text("broken")
    path = tmp_path / "broken.json"
    if name == "the configuration ":
        name, expected = f"the configuration {path}", "a JSON file written by GuidanceConfig.save"
    check_error(lambda: call(path), name, expected, found, hint)
