"""The configuration: what a knob may be, how it is saved, typed on a command line, and told."""

import copy
import dataclasses
import json
import os
import pickle
from pathlib import Path

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.config import (
    DEFAULT,
    KNOBS,
    MARIGOLD_DC,
    PAPER,
    PRESETS,
    SEARCH_ONLY,
    SECTIONS,
    GuidanceConfig,
    config_from_text,
    knob_lines,
    sentences,
    shown,
    value_of,
)

(PAGE,) = (Path(__file__).resolve().parents[2] / "docs").rglob("knobs.md")


@pytest.mark.parametrize("described", dataclasses.fields(GuidanceConfig), ids=lambda field: field.name)
def test_the_default_of_every_knob_is_legal(described):
    knob = described.metadata
    assert "|" not in knob["values"]
    assert knob["check"](described.default, described.name) == described.default
    assert bool(knob["unset"]) == (described.default is None)


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
