"""Run the command line inside the test's process, and write a small pair for it to read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.cli.app import main


@dataclass(frozen=True)
class Answer:
    code: int
    out: str
    err: str


@dataclass(frozen=True)
class PairFiles:
    """Files of a rendered plane: two images, a calibration, and the arguments that name them."""

    folder: Path
    left: Path
    right: Path
    calib: Path

    @property
    def images(self) -> list[str]:
        return ["depth", str(self.left), str(self.right)]

    @property
    def command(self) -> list[str]:
        return [*self.images, "--calib", str(self.calib)]

    def write_calibration(self, K: np.ndarray, baseline_m: float, size: tuple[int, int]) -> None:
        """In Middlebury's format; ``size`` is (width, height)."""
        camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
        self.calib.write_text(
            f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * baseline_m}\n"
            f"width={size[0]}\nheight={size[1]}\nndisp=64\n"
        )


def write_pair(folder: Path, pair) -> PairFiles:
    files = PairFiles(folder, folder / "left.png", folder / "right.png", folder / "calib.txt")
    Image.fromarray(pair.left).save(files.left)
    Image.fromarray(pair.right).save(files.right)
    files.write_calibration(pair.K, pair.E[0, 3], (pair.left.shape[1], pair.left.shape[0]))
    return files


@pytest.fixture(scope="session")
def prior(make_pipeline, tmp_path_factory) -> Path:
    """Folder of a tiny random Marigold."""
    folder = tmp_path_factory.mktemp("prior")
    make_pipeline().save_pretrained(folder)
    return folder


@pytest.fixture
def pair_files(tmp_path, textured_plane, monkeypatch) -> PairFiles:
    """The pair in a fresh folder, which is also the working directory."""
    monkeypatch.chdir(tmp_path)
    return write_pair(tmp_path, textured_plane)


def call(words) -> int:
    """Run the command in this process; its exit code."""
    with pytest.raises(SystemExit) as leaving:
        main([str(word) for word in words])
    return leaving.value.code or 0


@pytest.fixture
def geodiff(capsys):
    """Call it with arguments; returns exit code, stdout and stderr."""

    def run(*arguments: object) -> Answer:
        capsys.readouterr()
        code = call(arguments)
        captured = capsys.readouterr()
        return Answer(code, captured.out, captured.err)

    return run


@pytest.fixture(scope="session")
def result(prior, textured_plane, tmp_path_factory):
    """The folder of a pair and of its result ``geodiff-out``, made once: to be looked at, or copied."""
    folder = tmp_path_factory.mktemp("result")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_pair(folder, textured_plane)
        words = [
            "depth",
            "left.png",
            "right.png",
            "--calib",
            "calib.txt",
            "--prior",
            prior,
            "--device",
            "cpu",
        ]
        assert call([*words, "--export", "glb", "--export", "colmap", "-q"]) == 0
    return folder
