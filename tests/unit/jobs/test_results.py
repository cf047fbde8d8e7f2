"""Submissions to benchmarks and videos, from folders of results whose disparity is known."""

import json

import cv2
import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs import results
from geodiff_plugin.jobs.results import write_submission, write_video

K_LEFT = np.array([[70.0, 0, 21.0], [0, 70.0, 15.0], [0, 0, 1]])
#: The right camera's principal point lies farther right: Middlebury's ``doffs``.
K_RIGHT = np.array([[70.0, 0, 24.5], [0, 70.0, 15.0], [0, 0, 1]])
BASELINE_M = 0.16


def write_result(folder, scene, disparity, seconds=3.456):
    """A result with the depth of a disparity map."""
    folder.mkdir(parents=True)
    E = np.eye(4)
    E[0, 3] = BASELINE_M
    with np.errstate(divide="ignore"):
        depth_m = K_LEFT[0, 0] * BASELINE_M / (disparity + K_RIGHT[0, 2] - K_LEFT[0, 2])
    np.save(folder / "depth.npy", depth_m.astype(np.float32))
    report = {
        "inputs": {"K_left": K_LEFT.tolist(), "K_right": K_RIGHT.tolist(), "E": E.tolist()},
        "arguments": {"left": str(scene / "im0.png")},
        "seconds": {"load": 9.0, "guided call": seconds, "write": 1.0},
    }
    (folder / "report.json").write_text(json.dumps(report))


def disparities() -> np.ndarray:
    return 4.0 + 0.1 * np.arange(42)[None] + 0.07 * np.arange(30)[:, None]


@pytest.fixture
def two(tmp_path):
    for number, name in enumerate(("Adirondack", "Piano")):
        scene = tmp_path / "training" / name
        write_result(tmp_path / "out" / name, scene, disparities() + number, 2.5 + number)
    return tmp_path


def read_pfm(path) -> np.ndarray:
    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


def test_middlebury_gets_disparities_and_the_seconds_of_the_call(two):
    assert write_submission([two / "out"], "middlebury", two / "zip", "Mine2") == 2
    written = {
        path.relative_to(two / "zip").as_posix() for path in (two / "zip").rglob("*") if path.is_file()
    }
    assert (
        written
        == {
            "training/Adirondack/disp0Mine2.pfm",
            "training/Adirondack/timeMine2.txt",
            "training/Piano/disp0Mine2.pfm",
            "training/Piano/timeMine2.txt",
        }
        or "training/Piano/disp0Mine2_s.pfm" in written
    )
    np.testing.assert_allclose(
        read_pfm(two / "zip/training/Adirondack/disp0Mine2.pfm"), disparities(), rtol=1e-5
    )
    assert (two / "zip/training/Adirondack/timeMine2.txt").read_text() == "2.50\n"
    assert (two / "zip/training/Piano/timeMine2.txt").read_text() == "3.50\n"


def test_a_map_with_holes_has_a_name_that_states_this(tmp_path):
    disparity = disparities()
    write_result(tmp_path / "out", tmp_path / "training/Piano", disparity)
    depth_m = np.load(tmp_path / "out/depth.npy")
    depth_m[3, 5] = 0.0
    np.save(tmp_path / "out/depth.npy", depth_m)
    write_submission([tmp_path / "out"], "middlebury", tmp_path / "zip")
    written = read_pfm(tmp_path / "zip/training/Piano/disp0GeoDiff_s.pfm")
    assert np.isinf(written[3, 5]) and np.isfinite(np.delete(written.ravel(), 3 * 42 + 5)).all()
    assert not (tmp_path / "zip/training/Piano/disp0GeoDiff.pfm").exists()


def test_eth3d_gets_a_map_and_a_time_by_scene(two):
    assert write_submission([two / "out/Piano", two / "out/Adirondack"], "eth3d", two / "zip") == 2
    folder = two / "zip/low_res_two_view"
    assert sorted(path.name for path in folder.iterdir()) == [
        "Adirondack.pfm",
        "Adirondack.txt",
        "Piano.pfm",
        "Piano.txt",
    ]
    np.testing.assert_allclose(read_pfm(folder / "Adirondack.pfm"), disparities(), rtol=1e-5)
    assert (folder / "Piano.txt").read_text() == "runtime 3.50\n"


def test_a_non_submission_is_rejected(two):
    with pytest.raises(InputError, match="--method must be letters and digits"):
        write_submission([two / "out"], "middlebury", two / "zip", "my method")
    assert write_submission([two / "out"], "eth3d", two / "zip", "my method") == 2
    with pytest.raises(InputError, match="No result"):
        write_submission([two / "training"], "eth3d", two / "zip2")
    write_result(two / "again/Piano", two / "training/Piano", disparities())
    with pytest.raises(
        InputError, match=r"out/Piano and \S*again/Piano are both results of scene \S*training/Piano"
    ):
        write_submission([two / "out", two / "again"], "eth3d", two / "zip3")
    (two / "out/Piano/report.json").write_text("{}")
    with pytest.raises(InputError, match=r"Piano/report.json is not a report"):
        write_submission([two / "out"], "eth3d", two / "zip4")
    assert not (two / "zip3").exists() and not (two / "zip4").exists()


def test_the_frames_of_a_video_are_maps_of_one_size_in_their_order(tmp_path, monkeypatch):
    drawn = {}

    def note(depths_m, near, far, unit):
        drawn.update(depths=[np.array(depth) for depth in depths_m], near=near, far=far, unit=unit)
        return iter(())

    def written(out, images, fps):
        drawn.update(out=out, fps=fps)

    monkeypatch.setattr(results.plotting, "depth_frames", note)
    monkeypatch.setattr(results.plotting, "write_depth_video", written)
    maps = [np.full((5, 7), 1.5 + number, np.float32) for number in range(3)]
    np.save(tmp_path / "first.npy", maps[0])
    for number in (1, 2):
        (tmp_path / f"f{number}").mkdir()
        np.save(tmp_path / f"f{number}/depth.npy", maps[number])
        (tmp_path / f"f{number}/report.json").write_text(json.dumps({"unit": "m"}))
    frames, out = [tmp_path / "first.npy", tmp_path / "f2", tmp_path / "f1"], tmp_path / "v.gif"
    assert write_video(frames, out, 4.0, near=1.25, far=8.5) == 0.75
    np.testing.assert_array_equal(drawn["depths"], [maps[0], maps[2], maps[1]])
    assert (drawn["near"], drawn["far"], drawn["unit"]) == (1.25, 8.5, "m")
    assert (drawn["out"], drawn["fps"]) == (out, 4.0)
    (tmp_path / "f2/report.json").write_text(json.dumps({"unit": None}))
    write_video(frames, out, 4.0)
    assert drawn["unit"] is None and drawn["near"] is drawn["far"] is None

    np.save(tmp_path / "f1/depth.npy", np.zeros((7, 5), np.float32))
    with pytest.raises(InputError, match=r"7x5 in \S*first.npy, 5x7 in \S*f1"):
        write_video(frames, out, 4.0)
    out.write_text("a file")
    with pytest.raises(InputError, match="v.gif"):
        write_video(frames[:1], out, 4.0)
    assert write_video(frames[:1], out, 4.0, overwrite=True) == 0.25


@pytest.mark.parametrize(
    "values", [np.zeros((2, 3, 4), np.float32), np.zeros((4, 5), int), np.zeros((0, 5), np.float32)]
)
def test_what_is_no_depth_map_is_no_frame(tmp_path, values):
    np.save(tmp_path / "map.npy", values)
    with pytest.raises(InputError, match="FRAME must be a depth map"):
        write_video([tmp_path / "map.npy"], tmp_path / "v.gif", 4.0)


def test_a_sky_and_invalid_pixels_do_not_stretch_the_colours_of_a_video(tmp_path, monkeypatch):
    ends = []
    monkeypatch.setattr(
        results.plotting, "depth_frames", lambda *_, near, far, unit: ends.append((near, far)) or iter(())
    )
    monkeypatch.setattr(results.plotting, "write_depth_video", lambda *_: None)
    folders = [tmp_path / name for name in ("a", "b")]
    for number, folder in enumerate(folders):
        folder.mkdir()
        depth, confidence = np.full((80, 96), 2.0 + number, np.float32), np.ones((80, 96), np.float32)
        depth[:24] = 500.0  # sky
        depth[40:64], confidence[40:64] = 0.1, 0.0
        np.save(folder / "depth.npy", depth)
        np.save(folder / "confidence.npy", confidence)
        (folder / "report.json").write_text(json.dumps({"unit": "m", "measurable_m": 50.0}))
    write_video(folders, tmp_path / "v.gif", 4.0)
    assert ends[0] == pytest.approx((2.0, 3.0), rel=0.01)
    write_video(folders, tmp_path / "near.gif", 4.0, near=1.0)
    write_video(folders, tmp_path / "far.gif", 4.0, far=9.0)
    assert ends[1:] == [(1.0, ends[0][1]), (ends[0][0], 9.0)]
