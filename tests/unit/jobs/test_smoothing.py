"""Depth of a video that is averaged over frames: what is written and reported of each frame."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cameras import Camera, PosedCamera
from geodiff_plugin.formats.clouds import flying_points
from geodiff_plugin.formats.points import read_ply_points
from geodiff_plugin.jobs import smoothing
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.smoothing import write_smoothed_frames
from geodiff_plugin.jobs.writing import write_reprojected
from geodiff_plugin.types import DepthFrame
from tests.unit.jobs import made_runs
from tests.unit.jobs.test_writing import target


def smoothed_maps(n: int) -> dict[str, np.ndarray]:
    confidence = np.full((36, 50), 0.7, np.float32)
    confidence[5:7] = 0.0
    sigma = np.where(confidence > 0, 0.2, np.nan).astype(np.float32)
    sigma[20:24] = 0.3
    return {"depth": made_runs.depth_map() + np.float32(n + 0.1), "confidence": confidence, "sigma": sigma}


def report_in(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Folders of finished frames; averaging adds a tenth of a metre, and leaves two rows without a depth.

    Depths of more than 2.5 m beyond the number of the frame are too far to be measured.
    """
    names = [f"{n:06d}" for n in range(12)]
    for n, name in enumerate(names):
        (tmp_path / name).mkdir()
        K = made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0])
        files = {"names": ["cloud.glb", "cloud.ply", "depth.npy", "report.json"], "cloud_points": 7}
        report = {"K": [K.tolist()], "unit": "m", "files": files, "n": n, "measurable_m": 2.5 + n}
        report |= {"depth": {"median_m": 9.0, "visible_fraction": 0.625}, "sigma_median_m": 0.75}
        (tmp_path / name / "report.json").write_text(json.dumps(report))
        np.save(tmp_path / name / "depth.npy", made_runs.depth_map() + n)
    asked = {"read": [], "scenes": [0] * 12}

    def write(frames, image, holes):
        asked["frames"], asked["holes"] = frames, holes
        for n in range(len(frames)):
            image(n)
        for n, frame in enumerate(frames):
            maps = smoothed_maps(n)
            for name, values in maps.items():
                np.save(frame.folder / f"{name}.npy", values)
            Image.new("RGB", (40, 30), (n, 90, 10)).save(frame.folder / "depth.png")
            camera = PosedCamera(frame.K, (50, 36), E=np.eye(4))
            yield asked["scenes"][n], DepthFrame(frame.folder.name, camera=camera, measurable=2.5 + n, **maps)

    def read_pair(options, views, packing=None):
        asked["read"].append(f"{options.left} {options.out.name} {views}")
        return SimpleNamespace(left=np.full((36, 50, 3), 0.5, np.float32))

    monkeypatch.setattr(smoothing, "write_smoothed", write)
    monkeypatch.setattr(smoothing, "read_pair", read_pair)
    asked["refs"] = [PairRef(name, Path("v.mp4"), None, frame=n) for n, name in enumerate(names)]
    asked["options"] = DepthOptions(left=Path("v.mp4"), out=tmp_path, reproject=target(tmp_path))
    return asked


def test_every_frame_is_averaged_with_its_own_camera_and_lists_its_files(run, tmp_path):
    reported = []
    write_smoothed_frames(run["options"], run["refs"][:3], lambda ref: f"views {ref.frame}", reported.append)
    assert run["read"] == [f"v.mp4 00000{n} views {n}" for n in range(3)] * 2 and reported == []
    for n, frame in enumerate(run["frames"]):
        assert frame.folder == tmp_path / f"00000{n}" and frame.unit == "m"
        np.testing.assert_allclose(frame.K, made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0]))
        report = report_in(frame.folder)
        assert report["temporal_smoothing"]["scene"] == 0 and report["n"] == n
        names = report["files"]["names"]
        assert names == sorted(set(names))
        assert {
            "depth.npy",
            "report.json",
            "depth_alone.npy",
            "confidence_alone.npy",
            "confirmed.npy",
            "observers.npy",
            "sigma_mm.png",
            "depth.png",
            "overview.png",
            "confidence.png",
        } <= set(names)


def test_the_report_describes_the_smoothed_maps_and_keeps_the_values_of_the_frame_alone(run, tmp_path):
    """Also after the same call again."""
    alone = {"depth": {"median_m": 9.0, "visible_fraction": 0.625}, "sigma_median_m": 0.75}
    for _ in range(2):
        found = write_smoothed_frames(run["options"], run["refs"][:2], lambda ref: None)
        for n, report in enumerate(found):
            assert report == report_in(tmp_path / f"00000{n}")
            maps = smoothed_maps(n)
            depth_m, valid = maps["depth"], maps["confidence"] > 0
            near = valid & (depth_m <= 2.5 + n)
            assert report["depth"] == {
                "min_m": pytest.approx(depth_m[valid].min()),
                "median_m": pytest.approx(np.median(depth_m[valid])),
                "mean_m": pytest.approx(depth_m[valid].mean()),
                "max_m": pytest.approx(depth_m[near].max()),
                "beyond_m": 2.5 + n,
                "beyond_fraction": pytest.approx((depth_m > 2.5 + n).mean()),
                "width": 50,
                "height": 36,
                "invalid_pixels": (~valid).sum(),
                "visible_fraction": 0.625,
            }
            assert report["sigma_median_m"] == pytest.approx(0.2)
            known = depth_m > 0
            assert report["temporal_smoothing"] == {
                "confidence_mean": pytest.approx(maps["confidence"][known].mean()),
                "alone": alone,
                "scene": 0,
                "unchanged_files": ["cloud.glb"],
            }


def test_maps_with_removed_depths_have_no_mean_confidence(run):
    """The confidence of removed depths is removed as well, so a mean would describe only the best pixels."""
    options = replace(run["options"], holes=True, min_confidence=0.5)
    for report in write_smoothed_frames(options, run["refs"][:2], lambda ref: None):
        assert report["temporal_smoothing"]["confidence_mean"] is None


def test_images_and_cloud_are_written_again(run, tmp_path, monkeypatch):
    drawn = []
    options = replace(run["options"], max_sigma=0.25)
    monkeypatch.setattr(
        plotting, "overview", lambda *given: drawn.append(given) or Image.new("RGB", (9, 8), "red")
    )
    (report,) = write_smoothed_frames(options, run["refs"][:1], lambda ref: None)
    ((left, depth, _, error),) = drawn
    assert left.shape == (36, 50, 3) and (left == 128).all() and error is None
    assert np.asarray(depth).reshape(-1, 3).mean(0) == pytest.approx((0, 90, 10), abs=1), "depth.png"
    with Image.open(tmp_path / "000000/overview.png") as overview:
        assert overview.size == (9, 8)
    maps = smoothed_maps(0)
    points = read_ply_points(tmp_path / "000000/cloud.ply")
    sure = (maps["depth"] > 0) & (maps["sigma"] <= 0.25)
    kept = sure & ~flying_points(maps["depth"])
    np.testing.assert_allclose(points[:, 2], maps["depth"][kept], rtol=1e-6)
    assert report["files"] == report["files"] | {
        "cloud_points": kept.sum(),
        "doubtful_points": 4 * 50,
        "points_out_of_reach": 2 * 50,
        "flying_points": flying_points(maps["depth"]).sum(),
        "depth_mm_zero_pixels": 2 * 50,
    }


def test_an_interrupted_run_leaves_no_report_that_contradicts_its_maps(run, tmp_path, monkeypatch):
    """The second frame fails; the same call again completes both."""
    before = report_in(tmp_path / "000001")
    calls, write = [], smoothing.write_previews

    def fails(frame, *given):
        calls.append(frame.folder.name)
        if frame.folder.name == "000001":
            raise OSError(28, "No space left on device")
        return write(frame, *given)

    with monkeypatch.context() as patched, pytest.raises(InputError, match="the same command again"):
        patched.setattr(smoothing, "write_previews", fails)
        write_smoothed_frames(run["options"], run["refs"][:3], lambda ref: None)
    assert calls == ["000000", "000001"], "each frame is completed before the next"
    assert "temporal_smoothing" in report_in(tmp_path / "000000")
    left = report_in(tmp_path / "000001")
    assert "temporal_smoothing" not in left and left["depth"] == before["depth"]
    reports = write_smoothed_frames(run["options"], run["refs"][:3], lambda ref: None)
    for report in reports:
        assert report["temporal_smoothing"]["alone"]["depth"]["median_m"] == 9.0


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
        known = smoothed_maps(n)["depth"]
        known[5:7] = 0.0
        K = made_runs.K_LEFT + n * np.diag([1.0, 1.0, 0])
        sigma_m = np.load(folder / "sigma.npy")
        reported = write_reprojected(tmp_path, known, sigma_m, Camera(K), run["options"].target_camera())
        for name in ("depth_reprojected.npy", "sigma_reprojected.npy"):
            np.testing.assert_array_equal(np.load(folder / name), np.load(tmp_path / name))
        report = report_in(folder)
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
        yield

    monkeypatch.setattr(smoothing, "write_smoothed", full)
    with pytest.raises(InputError, match=r"--temporal-smoothing failed for \S+ \(No space left on device\)"):
        write_smoothed_frames(run["options"], run["refs"][:2], lambda ref: None)
