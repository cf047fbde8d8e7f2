"""The configuration: what a leaf may be, how it is named, saved, typed on a command line, and told."""

from __future__ import annotations

import copy
import dataclasses
import json
import pickle
from pathlib import Path

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.guidance.config import LEAVES, STAGES, GuidanceConfig
from geodiff_plugin.guidance.fields import Knob
from geodiff_plugin.guidance.knobs import config_from_text, knob_lines, value_of, with_tables
from geodiff_plugin.guidance.presets import DEFAULT, MARIGOLD_DC, PAPER, PRESETS, SEARCH_ONLY

(PAGE,) = (Path(__file__).resolve().parents[2] / "docs").rglob("knobs.md")


def described():
    """Every leaf with its field."""
    kinds = [GuidanceConfig, *STAGES.values()]
    return [one for kind in kinds for one in dataclasses.fields(kind) if "knob" in one.metadata]


def test_a_leaf_has_one_name_over_all_stages():
    names = [one.name for one in described()]
    assert len(names) == len(set(names)) == len(LEAVES)
    # A stage may share the name of a leaf in it, never that of one above the stages.
    assert not {name for name, stage in LEAVES.items() if not stage} & set(STAGES)


def test_every_leaf_is_described_and_its_default_is_legal():
    for one in described():
        knob = Knob.of(one)
        assert knob.doc and knob.doc[-1] != "." and "|" not in knob.doc + knob.values, one.name
        assert knob.check(one.default, one.name) == one.default
        assert bool(knob.unset) == (one.default is None), one.name


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_survives_saving_copying_and_pickling(preset, tmp_path):
    config = PRESETS[preset]
    config.save(tmp_path / "guidance.json")
    nested = json.loads((tmp_path / "guidance.json").read_text())
    assert set(STAGES) <= set(nested) and "rule" in nested["updates"]
    assert GuidanceConfig.load(tmp_path / "guidance.json") == config
    assert copy.deepcopy(config) == config == pickle.loads(pickle.dumps(config))
    assert hash(copy.deepcopy(config)) == hash(config)


def test_what_is_open_is_settled_when_asked_and_never_saved():
    assert DEFAULT.to_dict()["updates"]["inner_steps"] is None
    near, far = DEFAULT.plan_updates(False), DEFAULT.changed(correct=False).plan_updates(False)
    assert (near.inner_steps, near.updates_from, near.step_latents) == (0, 0.75, 0.03)
    assert (far.inner_steps, far.updates_from, far.step_latents) == (40, 0.0, 0.1)
    assert DEFAULT.changed(stop=0.5).plan_updates(False).updates_from == 0.375
    assert PAPER.plan_updates(False).inner_steps == 1 and SEARCH_ONLY.plan_updates(False).inner_steps == 0
    assert MARIGOLD_DC.plan_updates(True).step_latents == 0.05


def test_a_configuration_does_not_change():
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT.loss_resolution = 2
    with pytest.raises(dataclasses.FrozenInstanceError):
        DEFAULT.correction.smoothness = 2.0
    with pytest.raises(TypeError, match="does not change"):
        DEFAULT.weights["matches"] = 0.0
    assert DEFAULT.changed(weights=DEFAULT.weights | {"matches": 0.0}).weights["matches"] == 0.0


@pytest.mark.parametrize(
    ("leaves", "error", "message"),
    [
        ({"correct": 1}, TypeError, "correct must be True or False; got int"),
        ({"correct": "no"}, TypeError, "correct must be True or False"),
        ({"smoothness": float("nan")}, ValueError, "smoothness.*nan"),
        ({"smoothness": float("inf")}, ValueError, "smoothness"),
        ({"smoothness": True}, TypeError, "smoothness must be a number"),
        ({"inertia": None}, TypeError, "inertia"),
        ({"inner_steps": 2.0}, TypeError, "inner_steps must be an integer"),
        ({"g_s_range": None}, TypeError, "g_s_range"),
        ({"g_s_range": "18"}, TypeError, "g_s_range"),
        ({"depth_range": [2.0, 1.0]}, ValueError, "depth_range"),
        ({"gradient": ["full"]}, ValueError, "gradient"),
        ({"rule": 3}, TypeError, "rule"),
        ({"weights": {"matches": float("nan")}}, ValueError, "matches"),
        ({"weights": {"matches": True}}, TypeError, "matches"),
        ({"options": {"far_pull.power": float("inf")}}, ValueError, "far_pull.power"),
        ({"start": 0.9, "stop": 0.5}, ValueError, "start"),
        ({"colour": 1}, ValueError, "'colour'.*There are: gradient"),
        ({"correction": DEFAULT.correction}, ValueError, "'correction'"),
    ],
)
def test_what_a_leaf_cannot_be_is_refused(leaves, error, message):
    with pytest.raises(error, match=message) as caught:
        DEFAULT.changed(**leaves)
    assert isinstance(caught.value, InputError)


def test_values_take_one_form():
    config = DEFAULT.changed(g_s_range=[1, 2], inertia=1, weights={"matches": 1})
    assert config.search.g_s_range == (1.0, 2.0) and isinstance(config.correction.inertia, float)
    assert DEFAULT.changed(depth_range=None).depth_range is None


def test_a_stage_of_another_kind_is_refused():
    with pytest.raises(InputError, match="correction must be a CorrectionConfig"):
        GuidanceConfig(correction=DEFAULT.updates)


def test_a_saved_configuration_with_a_strange_name_is_refused(tmp_path):
    with pytest.raises(InputError, match="a name in updates.*'smoothness'"):
        GuidanceConfig.from_dict({"updates": {"smoothness": 1.0}})
    with pytest.raises(InputError, match="a name in the configuration.*'inner_steps'"):
        GuidanceConfig.from_dict({"inner_steps": 3})
    (tmp_path / "guidance.json").write_text("{")
    with pytest.raises(InputError, match="a JSON file"):
        GuidanceConfig.load(tmp_path / "guidance.json")
    assert GuidanceConfig.from_dict({"updates": {"stop": 0.5}}) == DEFAULT.changed(stop=0.5)


def test_knobs_as_typed():
    typed = ["smoothness=5", "weights.matches=0", "weights.far_pull=2", "g_s_range=[1,2]", "rule=plain"]
    config = config_from_text([*typed, "inner_steps=null", "options.far_pull.power=2"], PAPER, "--knob")
    assert config.correction.smoothness == 5.0 and config.updates.rule == "plain"
    assert config.weights == {"photometric": 1.0, "prior_pull": 0.01, "matches": 0.0, "far_pull": 2.0}
    assert config.search.g_s_range == (1.0, 2.0) and config.updates.inner_steps is None
    assert config.terms.options == {"far_pull.power": 2}


@pytest.mark.parametrize("typed", ["speed=9", "smoothness", "weights=1", "pose.x=1", "updates.stop=1", "=1"])
def test_what_is_no_knob_is_told_with_those_that_are(typed):
    with pytest.raises(InputError, match="--knob must be KNOB=VALUE.*inner_steps.*weights.NAME"):
        config_from_text([typed], DEFAULT, "--knob")


def test_a_value_by_name():
    assert value_of("smoothness", DEFAULT) == 40.0 and value_of("weights.matches", DEFAULT) == 1.0
    assert value_of("inner_steps", DEFAULT) == 0
    with pytest.raises(InputError, match="smoothnes"):
        value_of("smoothnes", DEFAULT)


def test_the_page_of_knobs_is_up_to_date():
    """Else: ``python -m geodiff_plugin.guidance.knobs`` with the page."""
    page = PAGE.read_text(encoding="utf-8")
    assert with_tables(page) == page


def test_every_knob_has_a_line_for_the_terminal():
    told = "\n".join(knob_lines())
    assert all(f"  {name} = " in told for name in LEAVES)
