"""``python -m tests.lab``: the commands of ``geodiff eval`` on rendered pairs, and the laboratories."""

import json
import os

import numpy as np
import pytest
from click.testing import CliRunner

from geodiff_plugin.cli.eval import eval_app
from geodiff_plugin.evaluation.datasets import find_pairs, load
from geodiff_plugin.evaluation.pairs import fresh_process
from tests.lab.__main__ import EXPERIMENTS, PROGRAM, lab_app

pytestmark = pytest.mark.end_to_end


def typed(*words):
    return CliRunner().invoke(lab_app, list(map(str, words)))


def test_pages_name_the_command_that_made_them(tmp_path):
    words = ("pairs", "synthetic:1@96x72", "--methods", "sgbm")
    done = typed(*words, "--out", tmp_path)
    assert done.exit_code == 0 and f"{PROGRAM} {' '.join(words)}" in done.stdout
    assert json.loads((tmp_path / "table.json").read_text())["command"] == f"{PROGRAM} {' '.join(words)}"


@pytest.mark.slow
def test_a_process_of_its_own_knows_the_rendered_pairs():
    (ref,) = find_pairs("synthetic:1@64x48")
    with fresh_process() as process:
        sample = process.submit(load, ref).result()
        assert process.submit(os.getpid).result() != os.getpid()
    assert np.array_equal(sample.left, load(ref).left)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_has_help_and_is_not_in_the_wheel(name):
    helped = typed(name, "--help")
    assert helped.exit_code == 0 and f"{name} [OPTIONS]" in helped.stdout
    assert CliRunner().invoke(eval_app, [name, "--help"]).exit_code == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("trust", "--data must be set, or --rendered above 0"),
        ("trust --rendered 1 --width 16", "--width must be between 64"),
        ("trust --rendered 1 --kinds bent", "--kinds must be one of K-0.67"),
        ("trust --rendered 1 --kinds unrelated", "without 'unrelated' if there is only one pair"),
        ("strength --methods prior-fit@other", "--methods must be methods that use a prior"),
        ("strength --methods sgbm", "--methods must be methods that use a prior"),
        ("strength --strengths 7%", "--strengths"),
        ("strength --data EMPTY", "--data must be a folder with pairs"),
    ],
)
def test_bad_options_are_named(tmp_path, words, said):
    (tmp_path / "empty").mkdir()
    done = typed(*(tmp_path / "empty" if w == "EMPTY" else w for w in words.split()), "-o", tmp_path / "out")
    assert done.exit_code == 2 and said in done.stderr
