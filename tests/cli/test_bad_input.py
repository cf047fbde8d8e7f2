"""Every kind of bad input ends in one line, the one in ``bad_input.txt``; nothing loads or is written.

After a message was changed on purpose: ``GEODIFF_WRITE=1 pytest tests/cli/test_bad_input.py``, and read what
differs.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin.cli.app import COMMANDS
from geodiff_plugin.options import DTYPES, PRESETS, SPACES
from tests.cli.bad_inputs import KINDS
from tests.cli.conftest import never

TABLE = Path(__file__).with_name("bad_input.txt")
WRITE = bool(os.environ.get("GEODIFF_WRITE"))
#: Fails on the first import of what takes seconds.
WITHOUT_TORCH = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "diffusers", "transformers", "kornia"):
            raise SystemExit("imported " + name)

sys.meta_path.insert(0, Refuse())
from geodiff_plugin.cli.app import main

def run(words):
    try:
        main(words)
    except SystemExit as leaving:
        if isinstance(leaving.code, str):
            print(leaving.code, file=sys.stderr)
    print("END", file=sys.stderr, flush=True)
"""
MESSAGES = dict(line.split(": ", 1) for line in TABLE.read_text(encoding="utf-8").splitlines())


def test_each_kind_has_its_message():
    assert WRITE or list(MESSAGES) == list(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_bad_input(kind, geodiff, pair_files, monkeypatch):
    for module in ("depth", "many"):
        monkeypatch.setattr(f"geodiff_plugin.cli.{module}.load_guided_prior", never)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    words = KINDS[kind](pair_files.folder)
    before = sorted(pair_files.folder.rglob("*"))
    answer = geodiff(*words) if words[0] in COMMANDS else geodiff("depth", *words)
    assert (answer.code, answer.out) == (2, ""), answer
    *warned, line = answer.err.strip().splitlines()
    assert all(each.startswith("warning: ") for each in warned), answer.err
    assert line.startswith("geodiff: ") and len(line) < 2000, line
    assert sorted(pair_files.folder.rglob("*")) == before
    message = line.removeprefix("geodiff: ").replace(str(pair_files.folder), "DIR")
    if WRITE:
        MESSAGES[kind] = message
        kept = {name: MESSAGES[name] for name in KINDS if name in MESSAGES}
        TABLE.write_text("".join(f"{name}: {text}\n" for name, text in kept.items()), encoding="utf-8")
    assert message == MESSAGES[kind]


def test_what_the_option_parser_refuses_has_the_same_exit_code(geodiff, pair_files):
    for words in ([*pair_files.command, "--stepps", 3], [*pair_files.command, "--steps", "many"], ["dept"]):
        assert geodiff(*words).code == 2


def test_what_needs_no_torch_is_said_without_it(pair_files):
    """In one process: options, files, the folder; and that good ones do import it."""
    folder = pair_files.folder
    (folder / "geodiff-out").mkdir()
    np.save(folder / "geodiff-out" / "x.npy", np.ones(3))
    cases = [
        (["--steps", "0"], "--steps"),
        (["--out", "left.png"], "--out must be a folder; got the file left.png"),
        (["--out", "geodiff-out"], "--overwrite"),
        (["--near", "3"], "--far"),
        (["--view", "left.png"], "--view-E"),
        (["--calib", "nothing.txt"], "nothing.txt"),
        (["--fx", "60"], "one way"),
        ([], "imported"),  # the folder that is taken is numbered
    ]
    commands = [([*pair_files.command, *more], word) for more, word in cases]
    commands += [
        (["depth", "left.png", "calib.txt", "--calib", "calib.txt"], "RIGHT"),
        (["demo", "--out", "left.png"], "--out must be a folder; got the file left.png"),
        (["eval", "pairs", "synthetic:1", "--out", "left.png"], "--out must be a folder"),
    ]
    before = sorted(folder.iterdir())
    code = f"{WITHOUT_TORCH}\nfor words in {[words for words, _ in commands]!r}:\n    run(words)\n"
    answer = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
    said = answer.stderr.split("END\n")[:-1]
    for text, (words, word) in zip(said, commands, strict=True):
        assert word in text and text.count("\n") == 1, (words, text)
    assert sorted(folder.iterdir()) == before


def test_names_that_are_known_without_torch_are_those_with_it():
    import torch

    from geodiff_plugin.cli.results import BENCHMARKS
    from geodiff_plugin.config import PRESETS as CONFIGS
    from geodiff_plugin.scale import space

    assert set(SPACES) == set(space.SPACES) and set(PRESETS) <= set(CONFIGS)
    assert all(isinstance(getattr(torch, name), torch.dtype) for name in DTYPES)
    submit = COMMANDS["submit"][0].__dataclass_fields__["to"]
    assert set(submit.metadata["choices"]) == set(BENCHMARKS)


def test_help_imports_neither_torch_nor_numpy():
    words = [["--help"], ["--version"], ["depth", "--help"], ["eval", "pairs", "--help"]]
    code = WITHOUT_TORCH.replace('"torch",', '"torch", "numpy",')
    code += f"\nfor words in {words!r}:\n    run(words)\n"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stderr == "END\n" * 4, answer.stderr
