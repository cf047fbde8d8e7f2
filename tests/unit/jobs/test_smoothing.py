"""Depth of a video that is averaged over frames: what is written and reported of each frame."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.jobs import smoothing
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.smoothing import write_smoothed_frames
from geodiff_plugin.jobs.writing import write_reprojected
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

    def write(frames, image, holes):
        asked["frames"], asked["holes"] = frames, holes
        for n, frame in enumerate(frames):
            asked["read"].append(image(n))
            confidence = np.full((36, 50), 0.7, np.float32)
            confidence[5:7] = 0.0
            np.save(frame.folder / "depth.npy", made_runs.depth_map() + n + 0.1)
            np.save(frame.folder / "confidence.npy", confidence)
            np.save(frame.folder / "sigma.npy", np.where(confidence > 0, 0.2, np.nan).astype(np.float32))
        return asked["scenes"][: len(frames)]

    def read_pair(options, views, packing=None):
        class Inputs:
            left = f"{options.left} {options.out.name} {views}"

        return Inputs

    monkeypatch.setattr(smoothing, "write_smoothed", write)
    monkeypatch.setattr(smoothing, "read_pair", read_pair)
    asked["refs"] = [PairRef(name, Path("v.mp4"), None, frame=n) for n, name in enumerate(names)]
    asked["options"] = DepthOptions(left=Path("v.mp4"), out=tmp_path, reproject=target(tmp_path))
    return asked


def test_every_frame_is_averaged_with_its_own_camera_and_lists_its_files(run, tmp_path):
    reported = []
    write_smoothed_frames(run["options"], run["refs"][:3], lambda ref: f"views {ref.frame}", reported.append)
    assert run["read"] == [f"v.mp4 00000{n} views {n}" for n in range(3)] and reported == []
    for n, frame in enumerate(run["frames"]):
        assert frame.folder == tmp_path / f"00000{n}" and frame.unit == "m"
        np.testing.assert_allclose(frame.K, made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0]))
        report = json.loads((frame.folder / "report.json").read_text())
        assert report["temporal_smoothing"] == {"scene": 0} and report["n"] == n
        names = report["files"]["names"]
        assert names == sorted(set(names))
        assert {
            "depth.npy",
            "report.json",
            "depth_alone.npy",
            "confidence_alone.npy",
            "confirmed.npy",
            "observers.npy",
        } <= set(names)


def test_the_thresholds_of_holes_apply_to_the_smoothed_depth(run):
    limits = {"min_confidence": 0.4, "max_sigma": 0.05}
    for holes, expected in ((False, None), (True, (0.4, 0.05))):
        write_smoothed_frames(
            replace(run["options"], **limits, holes=holes), run["refs"][:2], lambda ref: None
        )
        assert run["holes"] == expected


def test_another_camera_sees_the_averaged_depth_where_there_is_one(run, tmp_path):
    write_smoothed_frames(run["options"], run["refs"][:2], lambda ref: None)
    for n in range(2):
        folder = tmp_path / f"00000{n}"
        seen_m = np.load(folder / "depth_reprojected.npy")
        known = made_runs.depth_map() + n + 0.1
        known[5:7] = 0.0
        K = made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0])
        sigma_m = np.load(folder / "sigma.npy")
        reported = write_reprojected(tmp_path, known, sigma_m, Camera(K), run["options"].target_camera())
        for name in ("depth_reprojected.npy", "sigma_reprojected.npy"):
            np.testing.assert_array_equal(np.load(folder / name), np.load(tmp_path / name))
        report = json.loads((folder / "report.json").read_text())
        assert report["reproject"] == reported
        assert {"depth_reprojected.npy", "sigma_reprojected_mm.png"} <= set(report["files"]["names"])
        millimetres = np.asarray(Image.open(folder / "depth_reprojected_mm.png"))
        np.testing.assert_array_equal(millimetres > 0, seen_m > 0)


@pytest.mark.parametrize(
    ("scenes", "begins"),
    [
        ([0] * 12, []),
        ([0, 0, 1, 1, 1, 2, 2, 2, 2, 2, 2, 2], ["000002", "000005"]),
        (list(range(12)), [f"00000{n}" for n in range(1, 5)] + ["000005 and 6 more"]),
    ],
)
def test_the_starts_of_segments_are_reported_except_the_first(run, scenes, begins):
    reported = []
    run["scenes"] = scenes
    write_smoothed_frames(run["options"], run["refs"], lambda ref: None, reported.append)
    expected = (
        f"--temporal-smoothing: scenes start at {', '.join(begins)}; depth is not averaged across them."
    )
    assert reported == ([expected] if begins else [])


def test_a_disk_that_is_full_ends_it_with_a_sentence(run, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(smoothing, "write_smoothed", full)
    with pytest.raises(InputError, match=r"--temporal-smoothing failed \(No space left on device\)"):
        write_smoothed_frames(run["options"], run["refs"][:2], lambda ref: None)
