"""Options are declared once: their flags, their checks, and what is common to all that runs a prior."""

import json
from dataclasses import MISSING, dataclass, fields
from types import UnionType
from typing import get_args, get_origin, get_type_hints

import pytest

from geodiff_plugin import options as module
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cli.app import COMMANDS as CLI_COMMANDS
from geodiff_plugin.config import PRESETS
from geodiff_plugin.evaluation.options import COMMANDS as EVAL_COMMANDS
from geodiff_plugin.options import (
    MACHINE_RULES,
    SECTIONS,
    Excludes,
    Given,
    MachineOptions,
    Needs,
    PriorOptions,
    RunOptions,
    SpeedOptions,
    check_rules,
)
from geodiff_plugin.scale.space import SPACES
from geodiff_plugin.settings import check_settings, setting, settings_of


def test_what_all_commands_that_run_a_prior_have_in_common():
    assert set(module.SPACES) == set(SPACES) and set(module.PRESETS) <= set(PRESETS)
    for record in (PriorOptions, SpeedOptions, RunOptions, MachineOptions):
        assert list(settings_of(record)) == [field.name for field in fields(record)]
        assert {option.section for option in settings_of(record).values()} <= set(SECTIONS)
    assert PRESETS["default"].min_steps == module.MIN_STEPS
    assert settings_of(RunOptions)["seed"].help == "Seed for the random noise."
    assert len(set(SECTIONS)) == len(SECTIONS)


def run(**given) -> RunOptions:
    return RunOptions(**given)


def test_a_call_has_the_options_of_the_prior_and_of_the_pipeline():
    made = run(option=("domain=outdoor", "mode=a=b"), steps=3, resolution=64, ensemble=2)
    assert made.call() == {
        "domain": "outdoor",
        "mode": "a=b",
        "num_inference_steps": 3,
        "processing_resolution": 64,
        "ensemble_size": 2,
        "output_uncertainty": True,
    }
    assert run().call() == {
        "num_inference_steps": None,
        "processing_resolution": None,
        "ensemble_size": 1,
        "output_uncertainty": False,
    }


def test_a_range_of_depths_goes_to_the_search_that_the_preset_has():
    depths = {"near": 1.5, "far": 9.0}
    assert run(**depths).config() == PRESETS["default"].changed(depth_range=(1.5, 9.0))
    assert run(**depths, preset="fast").config() == PRESETS["fast"].changed(depth_range=(1.5, 9.0))
    paper = run(**depths, preset="paper").config()
    assert paper == PRESETS["paper"].changed(g_s_range=(1.5, 9.0))
    typed = run(**depths, preset="paper", parameter=("g_s_range=[2,3]", "planes=99")).config()
    assert typed.g_s_range == (2.0, 3.0) and typed.planes == 99 and typed.depth_range is None
    assert run(preset="paper").config() == PRESETS["paper"]
    with pytest.raises(InputError, match="depth_range cannot be set with --set. Use --near and --far"):
        run(parameter=("depth_range=[1,2]",)).config()
    with pytest.raises(InputError, match="--set must be"):
        run(parameter=("planes",)).config()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"near": 2.0}, "<near> needs <far>"),
        ({"far": 2.0}, "<far> needs <near>"),
        ({"near": 3.0, "far": 2.5}, "<near> must be less than <far>; got 3 and 2.5"),
        ({"resolution": 60}, "<resolution> must be 0 or a multiple of 8, at least 32; got 60. Try 64"),
        ({"resolution": 8}, "<resolution> must be .*Try 32"),
        ({"device": "gpu"}, "<device> must be"),
        ({"option": ("x",)}, "<option> must be NAME=VALUE"),
        ({"dtype": "float8"}, "<dtype> must be one of"),
        ({"preset": "slow"}, "<preset> must be one of"),
        ({"space": "metres"}, "<space> must be one of"),
    ],
)
def test_contradictions_are_reported_with_the_names_of_the_caller(given, said):
    with pytest.raises(InputError, match=said):
        run(**given).check(lambda option: f"<{option.name}>")


def test_what_fits_passes():
    for given in ({"near": 1.0, "far": 2.0}, {"resolution": 0}, {"resolution": 40}, {"option": ("a=b",)}):
        run(**given).check()
    for device in ("auto", "cpu", "mps", "cuda", "cuda:0", "cuda:123"):
        run(device=device).check()
    for space in module.SPACES:
        run(space=space).check()


def test_options_are_json():
    plain = run(parameter=("a=1",), near=1.5, far=2.0).as_json()
    assert json.loads(json.dumps(plain)) == plain
    assert (
        plain["parameter"] == ["a=1"]
        and plain["near"] == 1.5
        and set(plain) == {each.name for each in fields(RunOptions)}
    )


@dataclass(frozen=True, kw_only=True)
class OnMachines(MachineOptions):
    shard: str | None = setting(None, "A part.")


def test_options_of_ray_need_it_and_shards_exclude_it():
    check_rules(OnMachines(engine="ray", workers=2, gpus=0.0), MACHINE_RULES)
    check_rules(OnMachines(shard="0/2"), MACHINE_RULES)
    check_rules(MachineOptions(engine="ray"), MACHINE_RULES)  # shards are no option of it
    for made, said in (
        (OnMachines(workers=2), "--workers needs --engine ray.$"),
        (OnMachines(gpus=0.0), "--gpus needs --engine ray.$"),
        (OnMachines(engine="ray", shard="0/2"), "--shard cannot be used with --engine ray: Ray distributes"),
    ):
        with pytest.raises(InputError, match=said):
            check_rules(made, MACHINE_RULES)


@pytest.mark.parametrize(
    ("given", "passes"),
    [
        ({"engine": "ray", "workers": 10**6, "gpus": 64}, True),
        ({"engine": "ray", "workers": 1, "gpus": 0}, True),
        ({"engine": "ray", "workers": 0}, False),
        ({"engine": "ray", "workers": 10**6 + 1}, False),
        ({"engine": "ray", "workers": 1, "gpus": 64.5}, False),
        ({"engine": "spark"}, False),
    ],
)
def test_workers_and_gpus_have_ranges(given, passes):
    if passes:
        check_settings(MachineOptions(**given))
    else:
        with pytest.raises(InputError):
            check_settings(MachineOptions(**given))


@dataclass(frozen=True)
class Meal:
    """Options that need and exclude each other."""

    dish: str = setting("", "What.", "")
    sauce: str | None = setting(None, "Sauce.")
    spoons: int = setting(0, "Spoons.", "--spoon", "-s")
    raw: bool = setting(False, "Raw.")


def test_a_rule_names_the_option_and_what_it_needs_or_excludes():
    needs = Needs(("spoons", "sauce"), (Given("dish", "soup"), Given("raw")), "it is for soup")
    excludes = Excludes(("sauce",), Given("spoons"))
    for meal in (Meal(), Meal("soup", "soy"), Meal(raw=True, spoons=2), Meal(sauce=None)):
        check_rules(meal, [needs, excludes])
    for meal, said in (
        (Meal("fish", spoons=1), "--spoon needs DISH soup or --raw: it is for soup."),
        (Meal(sauce="soy"), "--sauce needs DISH soup or --raw: it is for soup."),
        (Meal("soup", "soy", 1), "--sauce cannot be used with --spoon."),
    ):
        with pytest.raises(InputError) as refused:
            check_rules(meal, [needs, excludes])
        assert str(refused.value) == said


def dataclasses_of_options() -> list[type]:
    commands = [*CLI_COMMANDS.values(), *EVAL_COMMANDS.values()]
    return [command.options for command in commands if command.options is not None]


@pytest.mark.parametrize("kind", dataclasses_of_options(), ids=lambda kind: kind.__name__)
def test_the_default_of_every_option_has_its_type_and_its_help_is_a_sentence(kind):
    hints = get_type_hints(kind)
    for name, option in settings_of(kind).items():
        assert option.help.endswith((".", ")", "].")) and " " in option.help, name
        if option.default is not MISSING:
            allowed = get_args(hints[name]) if get_origin(hints[name]) is UnionType else ()
            allowed = [get_origin(one) or one for one in allowed or (hints[name],)]
            assert isinstance(option.default, tuple(allowed)), f"{name}: {option.default!r}"
            if option.choices and isinstance(option.default, str):
                assert option.default in option.choices, name
