"""``geodiff depth --estimate-pose`` on a pair as from a phone."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from tests.cli.conftest import report_of
from tests.scenes import render_pair

pytestmark = pytest.mark.end_to_end

pytest.importorskip("poselib")


SIZE = (240, 320)
VIEWS = {"left": Path("left.png"), "right": Path("right.png")}


@pytest.fixture(scope="module")
def pair():
    return render_pair(3, size=SIZE, posed=True)


@pytest.fixture(scope="module")
def images(pair, tmp_path_factory):
    """Two JPEG files whose EXIF has the focal length in 35 mm equivalent and the size they were taken at."""
    folder = tmp_path_factory.mktemp("phone")
    focal_35 = float(pair.K_left[0, 0]) * math.hypot(36, 24) / math.hypot(*SIZE)
    paths = []
    for name, view in (("left", pair.left), ("right", pair.right)):
        image = Image.fromarray(np.rint(view.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8))
        exif = image.getexif()
        entries = exif.get_ifd(0x8769)
        entries[0xA405], entries[0xA002], entries[0xA003] = round(focal_35), SIZE[1], SIZE[0]
        paths.append(folder / f"{name}.jpg")
        image.save(paths[-1], exif=exif, quality=95)
    return paths


@pytest.fixture
def estimate(geodiff, images, prior, tmp_path, monkeypatch):
    """Run with as little of the guided call as there is; the answer, and the report where there is one."""
    monkeypatch.chdir(tmp_path)
    quick = "--steps 1 --set guidance_steps=0 --device cpu".split()

    def run(*words, ends=0):
        answer = geodiff("depth", *images, "--estimate-pose", "--prior", prior, *quick, *words)
        assert answer.code == ends, answer.err
        return answer, None if ends else report_of()

    return run


def test_a_pair_from_a_phone(estimate, pair):
    baseline = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    answer, report = estimate("--baseline", baseline)
    assert "35 mm equivalent in EXIF" in answer.err
    found = report["estimated_pose"]
    assert found["inliers"][0] > 50 and found["parallax_deg"][0] > 1 and found["residual_px"][0] < 1
    assert 0 < found["depth_spread"] < 0.06
    assert found["scale_from"] == "baseline" and report["unit"] == "m"
    assert report["inputs"]["baseline_m"] == pytest.approx(baseline)
    # EXIF has whole millimetres, so the focal length and with it the pose are known to a few per cent.
    assert report["inputs"]["K_left"][0][0] == pytest.approx(float(pair.K_left[0, 0]), rel=0.03)
    E, true = np.array(report["inputs"]["E"]), pair.E.numpy()
    turn = math.degrees(math.acos(min(1.0, (np.trace(E[:3, :3].T @ true[:3, :3]) - 1) / 2)))
    assert turn < 1.5 and E[:3, 3] @ true[:3, 3] > 0.98 * baseline**2


def test_without_a_length_there_is_no_unit(estimate, pair):
    fov = 2 * math.degrees(math.atan(SIZE[1] / 2 / float(pair.K_left[0, 0])))
    answer, report = estimate("--fov", fov)
    assert report["unit"] is None and report["estimated_pose"]["scale_from"] == "none"
    assert report["inputs"]["baseline_m"] == pytest.approx(1.0)
    assert "baselines (no unit)" in answer.out and " m to " not in answer.out
    assert b"no unit" in Path("geodiff-out/cloud.ply").read_bytes()[:600]


def test_a_known_length_gives_the_unit_behind_a_lens(estimate, pair):
    """Two pixels near the middle, and the distance of their points according to the rendered depth."""
    depth_m, K = pair.left.depth_m[0].double().numpy(), pair.K_left.numpy()
    ends = np.array([[110.0, 120.0], [210.0, 120.0]])
    rays = np.c_[ends, np.ones(2)] @ np.linalg.inv(K).T
    at = [rays[i] * depth_m[int(v), int(u)] for i, (u, v) in enumerate(ends)]
    text = ",".join(str(n) for n in (*ends.reshape(-1), float(np.linalg.norm(at[0] - at[1]))))
    _, report = estimate("--known-length", text, "--distortion", "0.001,0,0,0")
    assert report["undistorted"] and Path("geodiff-out/undistorted.png").is_file()
    assert report["estimated_pose"]["scale_from"] == "known length" and report["unit"] == "m"
    assert 0 <= report["estimated_pose"]["scale_rel_std"] < 0.5
    true = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    assert report["inputs"]["baseline_m"] == pytest.approx(true, rel=0.25)


def test_pose_estimation_gets_what_it_needs(pair_files, monkeypatch):
    """Points in metres and a known length, both where an also in the undistorted image them."""
    depth, ends = np.zeros((48, 64)), np.array([[10.0, 12.0], [50.0, 40.0]])
    depth[12, 10], depth[40, 50] = 2000.0, 3000.0
    np.save("mm.npy", depth)
    K, reported = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), {}

    def stop(_images, **options):
        reported.update(options)
        raise InterruptedError

    monkeypatch.setattr(GeometryGuidance, "from_unposed_images", stop)
    known = {"points": Path("mm.npy"), "points_scale": 1000.0, "known_length": "10,12,50,40,1.5"}
    known |= {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "cropped": True}
    for distortion in ((), ("0.2,0,0,0",)):
        options = DepthOptions(**VIEWS, device="cpu", estimate_pose=True, distortion=distortion, **known)
        with pytest.raises(InterruptedError):
            read_pair(options)
        assert reported["cropped"] is True
        if not distortion:
            assert reported["points"].shape == (48, 64) and reported["points"][12, 10] == 2.0
            assert reported["known_length"] == (10, 12, 50, 40, 1.5)
    at = cv2.undistortPoints(ends, K, np.array([0.2, 0, 0, 0]), P=K)[:, 0]
    rays = np.c_[at, np.ones(2)] @ np.linalg.inv(K).T
    np.testing.assert_allclose(reported["points"], rays * [[2.0], [3.0]], atol=1e-3)
    assert reported["known_length"] == pytest.approx((*at.reshape(-1), 1.5), abs=0.01)
