"""Depth of a video that is averaged over frames: what is written and reported of each frame."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.jobs import steady
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.steady import write_steady_frames
from geodiff_plugin.jobs.writing import write_into
from tests.unit.jobs import made_runs
from tests.unit.jobs.test_writing import target


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Folders of finished frames; averaging adds a tenth of a metre, and leaves two rows without a depth."""
    names = [f"{n:06d}" for n in range(12)]
    for n, name in enumerate(names):
        (tmp_path / name).mkdir()
        K = made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0])
        report = {"K": [K.tolist()], "unit": "m", "files": {"names": ["depth.npy", "report.json"]}, "n": n}
        (tmp_path / name / "report.json").write_text(json.dumps(report))
        np.save(tmp_path / name / "depth.npy", made_runs.depth_map() + n)
    asked = {"read": [], "scenes": [0] * 12}

    def write(frames, picture):
        asked["frames"] = frames
        for n, frame in enumerate(frames):
            asked["read"].append(picture(n))
            confidence = np.full((36, 50), 0.7, np.float32)
            confidence[5:7] = 0.0
            np.save(frame.folder / "depth.npy", made_runs.depth_map() + n + 0.1)
            np.save(frame.folder / "confidence.npy", confidence)
        return asked["scenes"][: len(frames)]

    def read_pair(options, views):
        class Inputs:
            left = f"{options.left} {options.out.name} {views}"

        return Inputs

    monkeypatch.setattr(steady, "write_steady", write)
    monkeypatch.setattr(steady, "read_pair", read_pair)
    asked["refs"] = [PairRef(name, Path("v.mp4"), None, frame=n) for n, name in enumerate(names)]
    asked["options"] = DepthOptions(left=Path("v.mp4"), out=tmp_path, into=target(tmp_path))
    return asked


def test_every_frame_is_averaged_with_its_own_camera_and_lists_its_files(run, tmp_path):
    told = []
    write_steady_frames(run["options"], run["refs"][:3], lambda ref: f"views {ref.frame}", told.append)
    assert run["read"] == [f"v.mp4 00000{n} views {n}" for n in range(3)] and told == []
    for n, frame in enumerate(run["frames"]):
        assert frame.folder == tmp_path / f"00000{n}" and frame.unit == "m"
        np.testing.assert_allclose(frame.K, made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0]))
        report = json.loads((frame.folder / "report.json").read_text())
        assert report["steady"] == {"scene": 0} and report["n"] == n
        names = report["files"]["names"]
        assert names == sorted(set(names))
        assert {
            "depth.npy",
            "report.json",
            "depth_alone.npy",
            "confidence_alone.npy",
            "confirmed.npy",
        } <= set(names)


def test_another_camera_sees_the_averaged_depth_where_there_is_one(run, tmp_path):
    write_steady_frames(run["options"], run["refs"][:2], lambda ref: None)
    for n in range(2):
        folder = tmp_path / f"00000{n}"
        seen_m = np.load(folder / "depth_into.npy")
        known = made_runs.depth_map() + n + 0.1
        known[5:7] = 0.0
        K = made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0])
        told = write_into(tmp_path, known, K, run["options"].into)
        np.testing.assert_array_equal(seen_m, np.load(tmp_path / "depth_into.npy"))
        assert json.loads((folder / "report.json").read_text())["into"] == told
        millimetres = np.asarray(Image.open(folder / "depth_into_mm.png"))
        np.testing.assert_array_equal(millimetres > 0, seen_m > 0)


@pytest.mark.parametrize(
    ("scenes", "begins"),
    [
        ([0] * 12, []),
        ([0, 0, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2], ["000002", "000005"]),
        (list(range(12)), [f"00000{n}" for n in range(1, 10)]),
    ],
)
def test_the_beginnings_of_scenes_are_told_but_that_of_the_first(run, scenes, begins):
    told = []
    run["scenes"] = scenes
    write_steady_frames(run["options"], run["refs"], lambda ref: None, told.append)
    expected = f"--steady: scenes begin at {', '.join(begins)}; depth is not averaged across them."
    assert told == ([expected] if begins else [])


def test_a_disk_that_is_full_ends_it_with_a_sentence(run, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(steady, "write_steady", full)
    with pytest.raises(InputError, match=r"--steady ended \(No space left on device\)"):
        write_steady_frames(run["options"], run["refs"][:2], lambda ref: None)
