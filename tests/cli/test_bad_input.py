"""Every kind of bad input ends in one line, the one in ``bad_input.txt``; nothing loads or is written.

That table has a command, in a folder with the files below, and its message, indented. After a message was
changed on purpose: ``GEODIFF_WRITE=1 pytest tests/cli/test_bad_input.py``, and read what differs.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.cli.app import COMMANDS
from geodiff_plugin.formats import CALIBRATION_FORMATS
from geodiff_plugin.options import DTYPES, PRESETS, SPACES
from geodiff_plugin.settings import settings_of
from tests.cli.conftest import never

TABLE = Path(__file__).with_name("bad_input.txt")
WRITE = bool(os.environ.get("GEODIFF_WRITE"))
LINES = TABLE.read_text(encoding="utf-8").splitlines()
MESSAGES = dict(zip(LINES[::2], map(str.strip, LINES[1::2]), strict=True))
#: What a word of the table stands for.
WORDS = {
    "PAIR": "left.png right.png",
    "GOOD": "left.png right.png --calib calib.txt",
    "CAMERA": "--fx 60 --fy 60 --cx 31.5 --cy 23.5",
    "LONG": "x" * 300,
}
NERF = """{"fl_x": 60, "w": 64, "h": 48, "frames": [
{"file_path": "./left.png", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]},
{"file_path": "./right.png", "transform_matrix": [[1, 0, 0, 0.12], [0, 1, 0, 0], [0, 0, 1, 0]]}]}"""
K, E, MAP = np.array([[60, 0, 31.5], [0, 60, 23.5], [0, 0, 1]]), np.eye(4), np.ones((48, 64), np.float32)
E[0, 3] = 0.12
EMPTY = ("empty.png", "l/a.png", "l/b.png", "r/b.png", "texts/a.md", "theirs/model.safetensors")
FILES: dict[str, Any] = dict.fromkeys(EMPTY, "") | {
    # cameras
    "K.txt": K,
    "K-numbers.txt": "60 60 31.5 23.5\n",
    "K-nan.txt": np.where(K == 0, np.nan, K),
    "K-last-row.txt": K.T,
    "K-commas.txt": "60,5 0 31,5\n0 60,5 23,5\n0 0 1\n",
    "K-outside.txt": "60 0 500\n0 60 23.5\n0 0 1\n",
    "words.txt": "my camera is a good one\n",
    "E.txt": E,
    "E-transposed.txt": E.T,
    "E-still.txt": np.eye(4),
    "large.json": NERF.replace("64", "128").replace("48", "96"),
    "walk.json": NERF,
    # images
    "cut.png": lambda path: path.write_bytes(Path("left.png").read_bytes()[:1000]),
    "small.png": Image.new("RGB", (64, 31)).save,
    "third.png": Image.new("RGB", (64, 48)).save,
    "pipe": os.mkfifo,
    # known depths
    "commas.txt": "1,5;2,5;3,0\n",
    "pixels.txt": "u,v,depth\n10,20,3\n",
    "car.txt": "1 2 3\n1 2 car\n",
    "two-columns.txt": "1 2\n3 4\n",
    "points.txt": "0 0 2\n",
    "pickled.npy": b"\x80\x04K\x01.",
    "unknown.npy": 0 * MAP,
    "earlier/depth.npy": MAP,
    # many pairs
    "empty.csv": "\n",
    "short.csv": "a.png\n",
    "pairs.csv": "left.png,right.png\n",
    "two.csv": "left.png,right.png\nthird.png,right.png\n",
    "mine/pairs.csv": "left.png,right.png\n",
    "drive.mcap": b"\0" * 99,
    # other commands
    "map.npy": MAP,
    "small.npy": MAP[:4, :4],
    "integers.npy": MAP.astype(int),
    "earlier.webp": "a video",
}


def words_of(typed: str) -> list[str]:
    return " ".join(WORDS.get(word, word) for word in typed.split()).split()


def write_files() -> None:
    for name, content in FILES.items():
        path = Path(name)
        path.parent.mkdir(exist_ok=True)
        if isinstance(content, np.ndarray):
            (np.save if path.suffix == ".npy" else np.savetxt)(path, content)
        elif callable(content):
            content(path)
        else:
            path.write_bytes(content if isinstance(content, bytes) else content.encode())


#: Fails on the first import of what takes seconds.
WITHOUT_TORCH = """
import sys

class Reject:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in ("torch", "diffusers", "transformers", "kornia"):
            raise SystemExit("imported " + name)

sys.meta_path.insert(0, Reject())
from geodiff_plugin.cli.app import main

def run(words):
    try:
        main(words)
    except SystemExit as leaving:
        if isinstance(leaving.code, str):
            print(leaving.code, file=sys.stderr)
    print("END", file=sys.stderr, flush=True)
"""


@pytest.mark.parametrize("typed", MESSAGES)
def test_bad_input(typed, geodiff, pair_files, monkeypatch):
    monkeypatch.setattr("geodiff_plugin.jobs.prior.find_prior", never)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    write_files()
    before = sorted(pair_files.folder.rglob("*"))
    answer = geodiff(*words_of(typed))
    assert (answer.code, answer.out) == (2, ""), answer
    *warned, line = answer.err.strip().splitlines()
    assert all(each.startswith("warning: ") for each in warned), answer.err
    assert line.startswith("geodiff: ") and len(line) < 2000, line
    assert sorted(pair_files.folder.rglob("*")) == before
    message = line.removeprefix("geodiff: ").replace(str(pair_files.folder), "DIR").replace("x" * 300, "LONG")
    message = message.replace(", ".join(CALIBRATION_FORMATS), "FORMATS")  # which grow in number
    if WRITE:
        MESSAGES[typed] = message
        TABLE.write_text("".join(f"{words}\n    {said}\n" for words, said in MESSAGES.items()), "utf-8")
    assert message == MESSAGES[typed]


def test_errors_that_need_no_torch_are_raised_without_it(pair_files):
    """In one process: options, files, the folder; and that good ones do import it."""
    write_files()
    Path("geodiff-out").mkdir()
    Path("geodiff-out", "x.npy").touch()
    rows = ["--steps 0", "--out left.png", "--out .", "--near 1", "--view third.png", "--fx 60"]
    rows = [f"depth GOOD {row}" for row in rows] + ["depth PAIR --calib nothing.txt"]
    commands = [(words_of(row), MESSAGES[row]) for row in rows]
    commands += [
        (words_of("depth GOOD"), "imported"),  # the folder that is taken is numbered
        (["demo", "--out", "left.png"], "--out must be a folder; got the file left.png"),
        (["eval", "pairs", "synthetic:1", "--out", "left.png"], "--out must be a folder"),
    ]
    before = sorted(Path().iterdir())
    code = f"{WITHOUT_TORCH}\nfor words in {[words for words, _ in commands]!r}:\n    run(words)\n"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    for text, (words, word) in zip(answer.stderr.split("END\n")[:-1], commands, strict=True):
        assert word in text and text.count("\n") == 1, (words, text)
    assert sorted(Path().iterdir()) == before


def test_names_that_are_known_without_torch_are_those_with_it():
    import torch

    from geodiff_plugin.config import PRESETS as CONFIGS
    from geodiff_plugin.jobs.results import BENCHMARKS
    from geodiff_plugin.scale import space

    assert set(SPACES) == set(space.SPACES) and set(PRESETS) <= set(CONFIGS)
    assert all(isinstance(getattr(torch, name), torch.dtype) for name in DTYPES)
    assert set(settings_of(COMMANDS["submit"].options)["to"].choices) == set(BENCHMARKS)


def test_help_imports_neither_torch_nor_numpy():
    words = [["--help"], ["--version"], ["depth", "--help"], ["eval", "pairs", "--help"]]
    code = WITHOUT_TORCH.replace('"torch",', '"torch", "numpy",')
    code += f"\nfor words in {words!r}:\n    run(words)\n"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert answer.stderr == "END\n" * 4, answer.stderr
