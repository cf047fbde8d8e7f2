"""What is wrong with options and files is said before torch and diffusers are imported."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.cli.arguments import demo_arguments
from geodiff_plugin.cli.checks import DTYPES, SPACES
from geodiff_plugin.scale import space

#: Fails on the first import of what takes seconds.
WITHOUT_TORCH = """
import sys

class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "diffusers", "transformers", "kornia"):
            raise SystemExit("imported " + name)

sys.meta_path.insert(0, Refuse())
from geodiff_plugin.cli.app import main
main(sys.argv[1:])
"""


def run(*arguments, cwd) -> subprocess.CompletedProcess:
    words = [sys.executable, "-c", WITHOUT_TORCH, *map(str, arguments)]
    return subprocess.run(words, cwd=cwd, capture_output=True, text=True, env=os.environ | {"COLUMNS": "200"})


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["--steps", "0"], "--steps"),
        (["--seed", "-1"], "--seed"),
        (["--seed", str(10**30)], "--seed"),
        (["--device", "tpu"], "--device"),
        (["--space", "banana"], "--space"),
        (["--out", "left.png"], "--out"),
        (["--out", "left.png/out"], "--out"),
        (["--out", "."], "--overwrite"),
        (["--near", "3"], "--far"),
        (["--cameras", "2"], "--cameras"),
        (["--points", "nothing.npy"], "--points"),
        (["--points", "empty.npy"], "empty"),
        (["--points-scale", "256"], "--points"),
        (["--view", "left.png"], "--view-E"),
        (["--calib", "nothing.txt"], "nothing.txt"),
        (["--fx", "60"], "one way"),
        (["--option", "domain"], "--option"),
    ],
)
def test_said_without_torch(pair_files, more, word):
    (pair_files.folder / "empty.npy").write_bytes(b"")
    before = sorted(pair_files.folder.iterdir())
    answer = run(*pair_files.command, *more, cwd=pair_files.folder)
    assert answer.returncode == 2, answer.stderr
    assert answer.stderr.startswith("geodiff: ") and answer.stderr.count("\n") == 1 and word in answer.stderr
    assert sorted(pair_files.folder.iterdir()) == before


def test_images_and_the_demo_too(pair_files):
    calib = ["--calib", pair_files.calib]
    for left, right, word in (
        ("nothing.png", "right.png", "LEFT"),
        ("left.png", "calib.txt", "RIGHT"),
        ("left.png", "left.png", "another photograph"),
    ):
        answer = run("depth", left, right, *calib, cwd=pair_files.folder)
        assert answer.returncode == 2 and word in answer.stderr, answer.stderr
    for command in ("demo", "eval pairs synthetic:1"):
        answer = run(*command.split(), "--out", "left.png", cwd=pair_files.folder)
        assert answer.returncode == 2 and "--out must be a folder; got the file left.png" in answer.stderr


def test_good_options_do_import_it(pair_files):
    """So that the tests above can fail."""
    answer = run(*pair_files.command, cwd=pair_files.folder)
    assert "imported" in answer.stderr


def test_names_that_are_known_without_torch_are_those_with_it():
    import torch

    assert set(SPACES) == set(space.SPACES)
    assert all(isinstance(getattr(torch, name), torch.dtype) for name in DTYPES)
    assert demo_arguments(None, False, False).left == DEMO_PAIR_FOLDER / "left.png"


def test_a_numbered_folder_for_a_command_run_twice(pair_files):
    np.save(pair_files.folder / "x.npy", np.ones(3))
    (pair_files.folder / "geodiff-out").mkdir()
    (pair_files.folder / "x.npy").rename(pair_files.folder / "geodiff-out" / "x.npy")
    answer = run(*pair_files.command, cwd=pair_files.folder)
    assert "--overwrite" not in answer.stderr and "imported" in answer.stderr
    answer = run(*pair_files.command, "--out", "geodiff-out", cwd=pair_files.folder)
    assert answer.returncode == 2 and "--overwrite" in answer.stderr
