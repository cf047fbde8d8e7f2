"""Fixtures of the tests of jobs."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.jobs import capture as whole
from geodiff_plugin.jobs import capture_frame, capture_frames, capture_poses
from tests.unit.jobs import made_runs
from tests.unit.jobs.made_captures import again, solved, write_capture
from tests.unit.jobs.pair_files import write_files


@pytest.fixture(scope="session")
def files(tmp_path_factory) -> Path:
    """The folder with the files of a pair and two further views."""
    return write_files(tmp_path_factory.mktemp("pair"))


@pytest.fixture
def capture(tmp_path) -> Capture:
    """Three frames, solved in the unit of their poses."""
    return write_capture(tmp_path)


@pytest.fixture
def solving(monkeypatch):
    """How often poses are solved, and in which way."""
    asked = []

    def solve(self, poses=None, *, threads=None):
        if self.solved is None:
            asked.append((poses, threads))
            self.solved = solved()
        return self.solved

    monkeypatch.setattr(Capture, "solve", solve)
    monkeypatch.setattr(capture_poses, "available_cores", lambda: 7)
    for name in ("RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    return asked


@pytest.fixture
def run(capture, tmp_path, solving, monkeypatch):
    """What a run over the capture calls, with outputs that are made up; ``f1`` fails if it is to."""
    asked = SimpleNamespace(fails=set(), pipes=[], depths=[])
    capture.solved = None

    def depth(found, pipe, name, given, points="none"):
        asked.depths.append((name, points))
        if name in asked.fails:
            raise InputError(f"{name} is torn")
        return made_runs.output(unit=found.unit)

    monkeypatch.setattr(capture_frame, "depth_of_frame", depth)
    monkeypatch.setattr(capture_frames, "prior_of_capture", lambda given: asked.pipes.append(given) or "pipe")
    for module in (whole, capture_poses):
        monkeypatch.setattr(module, "open_capture", lambda given: again(capture))
    monkeypatch.setattr(Capture, "neighbours", lambda self, name, count: [f"{name}'s {count}"])
    monkeypatch.setattr(Capture, "image", lambda self, name: np.zeros((36, 50, 3), np.float32))
    monkeypatch.setattr(
        capture_frame, "write_maps", lambda *given: asked.__dict__.update(maps=given) or {"n": 1}
    )
    monkeypatch.setattr(whole, "compile_for", lambda *given: None)
    asked.agreed, asked.holes = [], []

    def write_agreement(found, out, names, holes):
        asked.agreed.append(names)
        asked.holes.append(holes)
        return {"share": 1}

    monkeypatch.setattr(whole, "write_agreement", write_agreement)

    def write_results(found, out, names, export, doubted, original, thresholds):
        asked.results, asked.thresholds = (names, export, doubted, original), thresholds
        return {"cloud.ply": 3}

    monkeypatch.setattr(whole, "write_results", write_results)
    monkeypatch.setattr(
        whole, "write_agreed_frame", lambda found, name, folder: asked.holes.append(name) or {"agreed": name}
    )
    asked.folder = tmp_path
    return asked
