"""Options of the evaluation: defaults, ranges, and the command line that gives them again."""

import shlex
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from geodiff_plugin.evaluation import options as module
from geodiff_plugin.evaluation.baselines import METHODS, Settings
from geodiff_plugin.evaluation.figures import FIGURES
from geodiff_plugin.evaluation.options import (
    CHANGE_NO_NUMBER,
    COMMANDS,
    CaptureEvalOptions,
    DirOptions,
    FigureOptions,
    PairsOptions,
    PaperOptions,
    PosesOptions,
    command_line,
)
from geodiff_plugin.options import OUTPUT, PRIOR, SAMPLES
from geodiff_plugin.settings import DEFAULT_SECTION, settings_of

#: By command: its options next to those that all have, each with its default.
COMMON = {"seed": 0, "steps": None, "results": None, "quiet": False, "prior": "bundled", "dtype": "float32"}
OF_SAMPLES = COMMON | {
    **{"data": None, "methods": (), "datasets": (), "scenes": (), "limit": None, "ensemble": 1},
    **{"resolution": None, "views": 2, "perturb": None, "out": Path("geodiff-eval")},
}
OF_PAIRS = OF_SAMPLES | {
    **{"sample": None, "pairs": "default", "pixel_centre": None, "stop_on_broken": False},
    **{"save_depth": False},
}
PEERS = ("prior-aligned", "search-only", "paper", "guided", "sgbm")
DEFAULTS = {
    **dict.fromkeys(("table1", "table2", "table3", "ablation"), OF_PAIRS | {"ensemble": 10}),
    **dict.fromkeys(("parts", "flatness", "cost", "baseline"), OF_PAIRS),
    "pairs": OF_PAIRS
    | {"data": MISSING, "methods": PEERS, "split": "all", "engine": "local", "workers": None, "gpus": None},
    "figure": OF_SAMPLES
    | {"name": MISSING, "max": 80.0, "updates": (1, 2, 5, 10, 20, 40), "clouds": False, "results": None},
    "poses": COMMON
    | {"data": None, "limit": None, "exact": None, "perturb": "1.5,0.1", "drift": "0.3,1.5"}
    | {"resolution": None, "out": Path("geodiff-poses")},
    "capture": COMMON
    | {"data": MISSING, "frames": None, "count": None, "neighbours": (2, 3, 5)}
    | {"rows": ("given", "pairs", "capture"), "out": Path("geodiff-eval")},
}


@pytest.mark.parametrize("name", COMMANDS)
def test_defaults_are_those_of_the_documentation(name):
    found = {each.name: each.default for each in fields(COMMANDS[name].options)}
    assert {option: found.get(option, "no such option") for option in DEFAULTS[name]} == DEFAULTS[name]
    about = COMMANDS[name].about
    assert about[0].isupper() and about.endswith(".")


def test_the_commands_are_the_documented_ones_and_call_their_functions(monkeypatch):
    called = []
    monkeypatch.setattr(
        module, "imported", lambda where: lambda *given: called.append((where, given)) or "page"
    )
    where = {"pairs": "pairs.run_pairs", "cost": "pairs.run_cost", "figure": "figures.run_figure"}
    where |= {"poses": "poses.run_poses", "capture": "captures.run_capture_eval"}
    where["baseline"] = "baseline_scale.run_baseline_scale"
    where |= dict.fromkeys(("table1", "table2", "table3", "ablation"), "paper.run_paper_table")
    where |= dict.fromkeys(("parts", "flatness"), "pairs.run_changes")
    assert set(COMMANDS) == set(where) == set(DEFAULTS)
    for name, function in where.items():
        assert COMMANDS[name].run("given") == "page"
        assert called[-1] == (f"evaluation.{function}", (name, "given"))


def test_names_in_options_are_those_of_methods_and_figures():
    assert set(module.PEERS) <= set(METHODS) and set(module.FIGURES) == set(FIGURES)
    rows = {name: (row.poses, row.pose) for name, row in module.CAPTURE_ROWS.items()}
    assert rows == {
        "given": ("given", "given"),
        "pairs": ("given", "refine"),
        "capture": ("refined", "given"),
    }


PAIRS = {"out": Path("out")}
RANGES = [
    (PairsOptions, "steps", (1, 1000), (0, 1001)),
    (PairsOptions, "limit", (1, 10**9), (0,)),
    (PairsOptions, "sample", (1,), (0,)),
    (PairsOptions, "ensemble", (1, 1000), (0, 1001)),
    (PairsOptions, "resolution", (0, 8192), (-1, 8193)),
    (PairsOptions, "views", (2, 100), (1, 101)),
    (PaperOptions, "ensemble", (1, 1000), (0, 1001)),
    (PairsOptions, "pairs", ("default", "all"), ("some",)),
    (PairsOptions, "dtype", ("float32", "float16", "bfloat16"), ("int8",)),
    (PosesOptions, "limit", (1,), (0,)),
    (PosesOptions, "resolution", (0, 8192), (-1, 8193)),
    (CaptureEvalOptions, "count", (2, 9), (1,)),
    (CaptureEvalOptions, "neighbours", ((1, 32),), ((0,), (2, 33))),
    (CaptureEvalOptions, "rows", (("given",), ("capture", "pairs")), (("refined",),)),
    (FigureOptions, "max", (1.01, 1e6), (1.0, 1.1e6)),
    (FigureOptions, "updates", ((1, 10**4),), ((0,), (1, 10**4 + 1))),
]
NEEDED = {CaptureEvalOptions: {"data": (Path("d"),)}, FigureOptions: {"name": "gs-sweep"}}


@pytest.mark.parametrize(("cls", "name", "good", "bad"), RANGES)
def test_values_out_of_range_are_rejected_by_their_flag(cls, name, good, bad):
    given = NEEDED.get(cls, {})
    for value in good:
        assert getattr(cls(**given, **{name: value}), name) == value
    for value in bad:
        with pytest.raises(ValueError, match=f"--{name}"):
            cls(**given, **{name: value})


def test_ray_has_workers_and_gpus_and_a_local_run_has_none():
    assert DirOptions(data=Path("d"), engine="ray", workers=3).workers == 3
    with pytest.raises(ValueError, match="--workers"):
        DirOptions(data=Path("d"), workers=3)
    with pytest.raises(ValueError, match="--engine"):
        DirOptions(data=Path("d"), engine="spark")


def test_methods_are_given_every_setting(monkeypatch):
    asked = []
    monkeypatch.setattr(
        "geodiff_plugin.runtime.machine.pick_device", lambda name: asked.append(name) or "cuda:1"
    )
    reported = {"prior": "x/y", "ensemble": 3, "seed": 5, "steps": 7, "resolution": 640, "dtype": "float16"}
    reported |= {"space": "log", "views": 4, "cuda_graphs": True, "no_triton": True}
    given = PairsOptions(**reported)
    assert given.settings == Settings(**reported, device="cuda:1") and asked == [given.device]
    default = PosesOptions().settings
    assert default == Settings(device="cuda:1")
    assert {f.name for f in fields(Settings)} == {*reported, "device"}


def samples_of(cls):
    """Options of a class, each with a value that is not its default."""
    values = {
        **{"prior": "x/y", "data": Path("my data"), "methods": ("a", "b"), "datasets": ("k", "l"), "seed": 5},
        **{"scenes": ("s",), "limit": 2, "ensemble": 3, "resolution": 640, "views": 4, "perturb": "1,0.2"},
        **{"sample": 6, "pairs": "all", "pixel_centre": 0.5, "steps": 9, "dtype": "float16", "space": "log"},
        **{"cuda_graphs": True, "no_triton": True, "name": "ablation", "max": 20.0, "updates": (3, 4)},
        **{
            "clouds": True,
            "exact": Path("e"),
            "drift": "0.1,2",
            "frames": "a,b",
            "count": 3,
            "device": "cpu",
        },
        **{"neighbours": (1, 7), "rows": ("pairs",), "quiet": True, "out": Path("o"), "save_depth": True},
    }
    if cls is CaptureEvalOptions:
        values["data"] = (Path("one"), Path("two"))
    return {f.name: values[f.name] for f in fields(cls) if f.name in values}


@pytest.mark.parametrize("cls", [PairsOptions, DirOptions, FigureOptions, PosesOptions, CaptureEvalOptions])
def test_the_command_line_names_all_that_changes_a_number(cls):
    values = samples_of(cls)
    words = shlex.split(command_line("NAME", cls(**values)))
    assert words[:3] == ["geodiff", "eval", "NAME"]
    found, positional = {}, []
    options = settings_of(cls)
    names = {option.flag: name for name, option in options.items()}
    words = words[3:]
    while words:
        word = words.pop(0)
        if word not in names:
            positional.append(word)
            continue
        value = getattr(cls(**values), names[word])
        found[names[word]] = None if value is True else words.pop(0)
    for name, option in options.items():
        value = values.get(name)
        if name not in values or name in CHANGE_NO_NUMBER:
            assert name not in found
        elif option.is_argument:
            each = value if isinstance(value, tuple) else (value,)
            assert {str(part) for part in each} <= set(positional)
        else:
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            assert found[name] == (None if value is True else text)
    needed = {name for name, option in options.items() if option.default is MISSING}
    given = {name: value for name, value in values.items() if name in needed}
    assert command_line("x", cls(**given)).startswith("geodiff eval x")
    assert len(shlex.split(command_line("x", cls(**given)))) == 3 + sum(
        len(v) if isinstance(v, tuple) else 1 for v in given.values()
    )


def test_what_changes_no_number_is_about_output_and_machines():
    assert {
        *("out", "results", "quiet", "stop_on_broken", "save_depth"),
        *("engine", "workers", "gpus"),
    } == CHANGE_NO_NUMBER


def test_options_are_shown_in_their_groups():
    groups = {
        OUTPUT: {"out", "results", "quiet", "stop_on_broken", "save_depth"},
        PRIOR: {"seed", "steps", "ensemble", "resolution", "dtype", "prior"},
        DEFAULT_SECTION: {"max", "updates", "clouds", "exact_", "name"},
    }
    samples = {"data", "methods", "datasets", "scenes", "limit", "views", "perturb", "sample", "pairs"}
    groups[SAMPLES] = samples | {"pixel_centre", "frames", "count", "neighbours", "rows", "exact"}
    for cls in (PairsOptions, PaperOptions, DirOptions, FigureOptions, CaptureEvalOptions):
        for name, option in settings_of(cls).items():
            for group, names in groups.items():
                if name in names and not option.is_argument:
                    assert option.section == group, f"{cls.__name__}.{name}"
    assert settings_of(PairsOptions)["perturb"].metavar == "DEGREES,FRACTION"
    poses = settings_of(PosesOptions)
    metavars = {name: poses[name].metavar for name in ("perturb", "drift", "data", "exact")}
    assert metavars == {
        "perturb": "DEGREES,FRACTION",
        "drift": "DEGREES,PIXELS",
        "data": "DIR",
        "exact": "DIR",
    }
