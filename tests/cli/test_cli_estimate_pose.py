"""``geodiff depth --estimate-pose`` end to end, on a rendered pair that was written as a phone would."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.scenes import render_pair

pytest.importorskip("poselib")

SIZE = (240, 320)
#: As little of the guided call as there is: what is tested is everything before and after it.
QUICK = ["--steps", 1, "--knob", "inner_steps=0", "--device", "cpu", "-q"]


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=SIZE, posed=True)


@pytest.fixture(scope="module")
def photographs(pair, tmp_path_factory):
    """Two JPEG files whose EXIF has the focal length in 35 mm equivalent and the size they were taken at."""
    folder = tmp_path_factory.mktemp("phone")
    focal_35 = float(pair.K_left[0, 0]) * math.hypot(36, 24) / math.hypot(*SIZE)
    paths = []
    for name, view in (("left", pair.left), ("right", pair.right)):
        image = Image.fromarray(np.rint(view.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
        exif = image.getexif()
        entries = exif.get_ifd(0x8769)
        entries[0xA405], entries[0xA002], entries[0xA003] = round(focal_35), SIZE[1], SIZE[0]
        path = folder / f"{name}.jpg"
        image.save(path, exif=exif, quality=95)
        paths.append(path)
    return paths


@pytest.fixture
def command(photographs, make_pipeline, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_pipeline().save_pretrained(tmp_path / "prior")
    return ["depth", *photographs, "--estimate-pose", "--prior", tmp_path / "prior", *QUICK]


def report_of(folder) -> dict:
    return json.loads((folder / "report.json").read_text())


def test_a_pair_from_a_phone(geodiff, command, pair, tmp_path):
    baseline = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    answer = geodiff(*command, "--baseline", baseline, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    assert "35 mm equivalent by its EXIF" in answer.err
    report = report_of(tmp_path / "out")
    found = report["estimated_pose"]
    assert found["inliers"][0] > 50 and found["parallax_deg"][0] > 1 and found["residual_px"][0] < 1
    assert 0 < found["depth_spread"] < 0.06
    assert found["scale_from"] == "baseline" and report["unit"] == "m"
    assert report["inputs"]["baseline_m"] == pytest.approx(baseline)
    # EXIF has whole millimetres, so the focal length and with it the pose are known to a few per cent.
    K = np.array(report["inputs"]["K_left"])
    assert K[0, 0] == pytest.approx(float(pair.K_left[0, 0]), rel=0.03)
    E, true = np.array(report["inputs"]["E"]), pair.E.numpy()
    turn = math.degrees(math.acos(min(1.0, (np.trace(E[:3, :3].T @ true[:3, :3]) - 1) / 2)))
    assert turn < 1.5
    assert E[:3, 3] @ true[:3, 3] > 0.98 * baseline**2
    assert np.isfinite(np.load(tmp_path / "out" / "depth.npy")).all()


def test_without_a_length_there_is_no_unit(geodiff, command, tmp_path):
    command = [word for word in command if word != "-q"]
    answer = geodiff(*command, "--export", "colmap", "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    report = report_of(tmp_path / "out")
    assert report["unit"] is None and report["estimated_pose"]["scale_from"] == "none"
    assert report["inputs"]["baseline_m"] == pytest.approx(1.0)
    assert "baselines (no unit)" in answer.out and " m to " not in answer.out
    assert b"no unit" in (tmp_path / "out" / "cloud.ply").read_bytes()[:600]


def test_poses_of_structure_from_motion_have_none_either(geodiff, prior, pair_files, textured_plane):
    K, axes = textured_plane.K, np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": path.name, "transform_matrix": (pose @ axes).tolist()}
        for path, pose in ((pair_files.left, np.eye(4)), (pair_files.right, textured_plane.E))
    ]
    lens = {"fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5, "w": 64, "h": 48}
    path = pair_files.folder / "transforms.json"
    path.write_text(json.dumps(lens | {"frames": frames}))
    views = [pair_files.left, pair_files.right, "--calib", path, "--prior", prior, "--device", "cpu"]
    for options, unit, said in (
        ([], None, "the calibration's lengths (no unit)"),
        (["--baseline", "0.12"], "m", " m to "),
    ):
        answer = geodiff("depth", *views, "--steps", 1, "--preset", "paper", *options, "--overwrite")
        assert answer.code == 0 and said in answer.out, answer
        assert report_of(Path("geodiff-out"))["unit"] == unit


def test_a_known_length_gives_the_unit_and_a_lens_is_taken_out_before(geodiff, command, pair, tmp_path):
    """Two pixels near the middle, and how far apart the rendered depth says that their places are."""
    depth_m, K = pair.left.depth_m[0].double().numpy(), pair.K_left.numpy()
    ends = np.array([[110.0, 120.0], [210.0, 120.0]])
    rays = np.c_[ends, np.ones(2)] @ np.linalg.inv(K).T
    at = [rays[i] * depth_m[int(v), int(u)] for i, (u, v) in enumerate(ends)]
    length = float(np.linalg.norm(at[0] - at[1]))
    text = ",".join(str(n) for n in (*ends.reshape(-1), length))
    lens = ["--distortion", "0.001,0,0,0"]
    answer = geodiff(*command, "--known-length", text, *lens, "--out", tmp_path / "out")
    assert answer.code == 0, answer.err
    report = report_of(tmp_path / "out")
    assert report["estimated_pose"]["scale_from"] == "known length" and report["unit"] == "m"
    assert 0 <= report["estimated_pose"]["scale_spread"] < 0.5
    true = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    assert report["inputs"]["baseline_m"] == pytest.approx(true, rel=0.25)
    assert report["undistorted"] and (tmp_path / "out" / "undistorted.png").is_file()
