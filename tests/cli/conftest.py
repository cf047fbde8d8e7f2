"""Run the command line inside the test's process, and write a small pair for it to read."""

import json
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from PIL import Image

from geodiff_plugin.cli.app import main
from geodiff_plugin.jobs.prior import load_quiet_prior

#: One update of one step: for tests of everything but the depth.
QUICK = ["--steps", "1", "--preset", "paper", "--device", "cpu"]


@cache
def loaded(name: str, device: torch.device) -> Any:
    return load_quiet_prior(name, device)


@pytest.fixture
def one_prior(monkeypatch):
    """The prior is loaded once for all cases."""

    def load(name, device, *_):
        return loaded(name, device)

    monkeypatch.setattr("geodiff_plugin.jobs.prior.load_quiet_prior", load)


def never(*_, **__):
    raise AssertionError("the work was begun")


def stop(*_, **__):
    raise KeyboardInterrupt


def report_of(folder: str | Path = "geodiff-out") -> dict:
    return json.loads(Path(folder, "report.json").read_text())


def write_pair(folder: Path, pair) -> SimpleNamespace:
    """Images, a calibration in Middlebury's format, and the arguments that name them."""
    files = SimpleNamespace(folder=folder, left=folder / "left.png", right=folder / "right.png")
    files.calib, files.images = folder / "calib.txt", ["depth", str(files.left), str(files.right)]
    files.command = [*files.images, "--calib", str(files.calib)]
    Image.fromarray(pair.left).save(files.left)
    Image.fromarray(pair.right).save(files.right)
    K, (height, width) = pair.K, pair.left.shape[:2]
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    files.calib.write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * pair.E[0, 3]}\n"
        f"width={width}\nheight={height}\nndisp=64\n"
    )
    return files


@pytest.fixture
def pair_files(tmp_path, textured_plane, monkeypatch) -> SimpleNamespace:
    """The pair in a fresh folder, which is also the working directory."""
    monkeypatch.chdir(tmp_path)
    return write_pair(tmp_path, textured_plane)


@pytest.fixture
def command(pair_files, prior) -> list[str]:
    return [*pair_files.command, "--prior", prior, "--device", "cpu"]


def call(words) -> int:
    """Run the command in this process; its exit code."""
    with pytest.raises(SystemExit) as leaving:
        main([str(word) for word in words])
    return leaving.value.code or 0


@pytest.fixture
def geodiff(capsys):
    """Call it with arguments; returns exit code, stdout and stderr."""

    def run(*arguments: object) -> SimpleNamespace:
        capsys.readouterr()
        code = call(arguments)
        captured = capsys.readouterr()
        return SimpleNamespace(code=code, out=captured.out, err=captured.err)

    return run
