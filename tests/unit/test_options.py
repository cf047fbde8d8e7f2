"""Options are declared once: their flags, their checks, and what is common to all that runs a prior."""

import json
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from types import UnionType
from typing import get_args, get_origin, get_type_hints

import pytest

from geodiff_plugin import options as module
from geodiff_plugin._checks import InputError
from geodiff_plugin.cli.app import COMMANDS as CLI_COMMANDS
from geodiff_plugin.config import PRESETS
from geodiff_plugin.evaluation.options import COMMANDS as EVAL_COMMANDS
from geodiff_plugin.options import (
    PANELS,
    PriorOptions,
    RunOptions,
    SpeedOptions,
    check_engine,
    check_options,
    declare,
    engine_option,
    flag_of,
    gpus_option,
    help_of,
    on_ray,
    rules_of,
    workers_option,
)
from geodiff_plugin.scale.space import SPACES


@dataclass(frozen=True)
class Some:
    """Options with every kind of rule; ``plain`` is none."""

    plain: int = 3
    source: Path = declare(None, "A source.", "")
    first_side: float = declare(1.0, "A number.", low=0.5, high=2.0)
    whole: int | None = declare(None, "A whole number.", low=1, high=9)
    length: float | None = declare(None, "A length.", above_0="metres")
    kinds: tuple[str, ...] = declare((), "Kinds.", "--kind", "-k", choices=("a", "b"))
    sizes: tuple[int, ...] = declare((), "Sizes.", low=2, high=4)
    other: int = field(default=4, metadata={"unit": "m"})


OF_SOME = {each.name: each for each in fields(Some)}


def test_a_flag_is_that_of_the_rules_or_the_name_with_dashes():
    flags = {name: flag_of(each) for name, each in OF_SOME.items()}
    assert flags["first_side"] == "--first-side" and flags["plain"] == "--plain"
    assert flags["source"] == "SOURCE" and flags["kinds"] == "--kind"
    assert rules_of(OF_SOME["plain"]) is rules_of(OF_SOME["other"]) is None
    assert rules_of(OF_SOME["source"]).is_argument and not rules_of(OF_SOME["kinds"]).is_argument


def test_a_declaration_keeps_what_it_is_given():
    made = declare(
        5,
        "Help.",
        "--flag",
        "-f",
        panel="Panel",
        low=1.0,
        high=9.0,
        above_0="metres",
        choices=("x",),
        split=True,
        metavar="WORD",
    )
    rules = made.metadata["rules"]
    assert made.default == 5 and (rules.help, rules.flags, rules.panel) == (
        "Help.",
        ("--flag", "-f"),
        "Panel",
    )
    assert (rules.low, rules.high, rules.above_0) == (1.0, 9.0, "metres")
    assert (rules.choices, rules.split, rules.metavar) == (("x",), True, "WORD")
    bare = declare(MISSING, "Help.")
    rules = bare.metadata["rules"]
    assert bare.default is MISSING and rules.flags == rules.choices == () and rules.panel == "Options"
    assert rules.low is rules.high is rules.metavar is None and rules.above_0 == "" and not rules.split


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"first_side": 0.49}, "--first-side must be between 0.5 and 2"),
        ({"first_side": 2.01}, "--first-side must be between 0.5 and 2"),
        ({"first_side": "1"}, "--first-side must be a number"),
        ({"whole": 0}, "--whole must be between 1 and 9"),
        ({"whole": 2.0}, "--whole must be an integer"),
        ({"length": 0.0}, "--length must be a finite number of metres above 0"),
        ({"kinds": ("a", "c")}, "--kind must be one of a, b"),
        ({"sizes": (3, 5)}, "--sizes must be between 2 and 4"),
    ],
)
def test_values_are_held_against_what_is_declared(given, said):
    with pytest.raises(InputError, match=said):
        check_options(Some(**given))
    with pytest.raises(InputError, match="^<"):
        check_options(Some(**given), lambda each: f"<{each.name}>")


def test_values_within_the_rules_pass():
    check_options(Some())
    check_options(Some("anything", None, 2, 9, 1e-9, ("b", "a"), (2, 4), None))


def test_what_all_commands_that_run_a_prior_have_in_common():
    assert set(module.SPACES) == set(SPACES) and set(module.PRESETS) <= set(PRESETS)
    for kind in (PriorOptions, SpeedOptions, RunOptions):
        assert all(rules_of(each) and rules_of(each).panel in PANELS for each in fields(kind))
    assert help_of("device").startswith("Where it runs") and help_of("seed") == "Seed of the noise."
    assert len(set(PANELS)) == len(PANELS)


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
    typed = run(**depths, preset="paper", knob=("g_s_range=[2,3]", "planes=99")).config()
    assert typed.g_s_range == (2.0, 3.0) and typed.planes == 99 and typed.depth_range is None
    assert run(preset="paper").config() == PRESETS["paper"]
    with pytest.raises(InputError, match="Give depth_range as --near and --far"):
        run(knob=("depth_range=[1,2]",)).config()
    with pytest.raises(InputError, match="--knob must be"):
        run(knob=("planes",)).config()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"near": 2.0}, "<near> needs <far>"),
        ({"far": 2.0}, "<far> needs <near>"),
        ({"near": 3.0, "far": 2.5}, "<near> must be less than <far>; got 3 and 2.5"),
        ({"resolution": 60}, "<resolution> must be a multiple of 8 from 32 on, or 0; got 60. Try 64"),
        ({"resolution": 8}, "<resolution> must be .*Try 32"),
        ({"device": "gpu"}, "<device> must be"),
        ({"option": ("x",)}, "<option> must be NAME=VALUE"),
        ({"dtype": "float8"}, "<dtype> must be one of"),
        ({"preset": "slow"}, "<preset> must be one of"),
        ({"space": "metres"}, "<space> must be one of"),
    ],
)
def test_what_contradicts_itself_is_said_with_the_names_of_the_caller(given, said):
    with pytest.raises(InputError, match=said):
        run(**given).check(lambda each: f"<{each.name}>")


def test_what_fits_passes():
    for given in ({"near": 1.0, "far": 2.0}, {"resolution": 0}, {"resolution": 40}, {"option": ("a=b",)}):
        run(**given).check()
    for device in ("auto", "cpu", "mps", "cuda", "cuda:0", "cuda:123"):
        run(device=device).check()
    for space in module.SPACES:
        run(space=space).check()


def test_options_are_json():
    plain = run(knob=("a=1",), near=1.5, far=2.0).as_json()
    assert json.loads(json.dumps(plain)) == plain
    assert (
        plain["knob"] == ["a=1"]
        and plain["near"] == 1.5
        and set(plain) == {each.name for each in fields(RunOptions)}
    )


@dataclass(frozen=True)
class OnMachines:
    engine: str = engine_option()
    workers: int | None = workers_option()
    gpus: float | None = gpus_option()
    shard: str | None = None


def test_options_of_ray_need_it_and_shards_exclude_it():
    check_engine(OnMachines("ray", 2, 0.0))
    check_engine(OnMachines("local", shard="0/2"))
    for made, said in (
        (OnMachines("local", 2), "--workers needs --engine ray"),
        (OnMachines("local", None, 0.0), "--gpus needs --engine ray"),
        (OnMachines("ray", shard="0/2"), "--shard cannot be used with --engine ray"),
    ):
        with pytest.raises(InputError, match=said):
            check_engine(made)
    for made, passes in (
        (OnMachines("ray", 10**6, 64), True),
        (OnMachines("ray", 1, 0), True),
        (OnMachines("ray", 0), False),
        (OnMachines("ray", 10**6 + 1), False),
        (OnMachines("ray", 1, 64.5), False),
        (OnMachines("spark"), False),
    ):
        if passes:
            check_options(made)
        else:
            with pytest.raises(InputError):
                check_options(made)
    assert OnMachines().engine == "local"


def test_without_ray_its_extra_is_named_and_other_errors_stay(monkeypatch):
    def missing(name):
        def imported(where):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

        return imported

    for name in ("ray", "pyarrow"):
        monkeypatch.setattr(module, "imported", missing(name))
        with pytest.raises(InputError, match=r"geodiff-plugin\[ray\]"):
            on_ray("pairs_to_folders")
    monkeypatch.setattr(module, "imported", missing("numpy"))
    with pytest.raises(ModuleNotFoundError):
        on_ray("pairs_to_folders")
    monkeypatch.setattr(module, "imported", lambda where: where)
    assert on_ray("pairs_to_folders") == "jobs.cluster.pairs_to_folders"


def dataclasses_of_options() -> list[type]:
    commands = [*CLI_COMMANDS.values(), *EVAL_COMMANDS.values()]
    return [command.options for command in commands if command.options is not None]


@pytest.mark.parametrize("kind", dataclasses_of_options(), ids=lambda kind: kind.__name__)
def test_the_default_of_every_option_has_its_type_and_its_help_is_a_sentence(kind):
    hints = get_type_hints(kind)
    for each in fields(kind):
        if rules_of(each) is None:
            continue
        about = rules_of(each).help
        assert about.endswith((".", ")", "].")) and " " in about, each.name
        if each.default is not MISSING:
            allowed = get_args(hints[each.name]) if get_origin(hints[each.name]) is UnionType else ()
            allowed = [get_origin(one) or one for one in allowed or (hints[each.name],)]
            assert isinstance(each.default, tuple(allowed)), f"{each.name}: {each.default!r}"
            if rules_of(each).choices and isinstance(each.default, str):
                assert each.default in rules_of(each).choices, each.name
