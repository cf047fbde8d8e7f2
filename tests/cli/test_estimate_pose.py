"""``geodiff depth --estimate-pose`` on a pair as from a phone; what goes through a lens on its way there."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.formats.lenses import distortion_from_text
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import _cameras_with_poses, _cameras_without_poses, lenses_of, read_pair
from geodiff_plugin.types import Rig
from tests.cli.conftest import report_of
from tests.scenes import render_pair

pytest.importorskip("poselib")


SIZE = (240, 320)
VIEWS = {"left": Path("left.png"), "right": Path("right.png")}


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
        paths.append(folder / f"{name}.jpg")
        image.save(paths[-1], exif=exif, quality=95)
    return paths


@pytest.fixture
def estimate(geodiff, photographs, prior, tmp_path, monkeypatch):
    """Run with as little of the guided call as there is; the answer, and the report where there is one."""
    monkeypatch.chdir(tmp_path)
    quick = "--steps 1 --knob inner_steps=0 --device cpu".split()

    def run(*words, ends=0):
        answer = geodiff("depth", *photographs, "--estimate-pose", "--prior", prior, *quick, *words)
        assert answer.code == ends, answer.err
        return answer, None if ends else report_of()

    return run


def test_a_pair_from_a_phone(estimate, pair):
    baseline = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    answer, report = estimate("--baseline", baseline)
    assert "35 mm equivalent by its EXIF" in answer.err
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
    """Two pixels near the middle, and how far apart the rendered depth says that their places are."""
    depth_m, K = pair.left.depth_m[0].double().numpy(), pair.K_left.numpy()
    ends = np.array([[110.0, 120.0], [210.0, 120.0]])
    rays = np.c_[ends, np.ones(2)] @ np.linalg.inv(K).T
    at = [rays[i] * depth_m[int(v), int(u)] for i, (u, v) in enumerate(ends)]
    text = ",".join(str(n) for n in (*ends.reshape(-1), float(np.linalg.norm(at[0] - at[1]))))
    _, report = estimate("--known-length", text, "--distortion", "0.001,0,0,0")
    assert report["undistorted"] and Path("geodiff-out/undistorted.png").is_file()
    assert report["estimated_pose"]["scale_from"] == "known length" and report["unit"] == "m"
    assert 0 <= report["estimated_pose"]["scale_spread"] < 0.5
    true = float(np.linalg.norm(pair.E.numpy()[:3, 3]))
    assert report["inputs"]["baseline_m"] == pytest.approx(true, rel=0.25)


def test_every_photograph_has_its_lens():
    """First coefficients, from the options, else from the calibration; a further view has the left one's."""

    def told(own=(None, None), **given) -> list[float | None]:
        rig = Rig(np.eye(3), np.eye(3), np.eye(4), source="calib.txt", distortion=own)
        lenses = lenses_of(DepthOptions(**VIEWS, **given), rig)
        return [None if lens is None else float(lens.coefficients[0]) for lens in lenses]

    view, two = (Path("v.png"),), (Path("v.png"), Path("w.png"))
    one, other, straight = "0.1,0,0,0", "0.2,0,0,0", "0,0,0,0"
    own = (distortion_from_text(one), distortion_from_text(straight))
    for expected, given in (
        ([None, None], {}),
        ([0.1, 0.2, 0.1, 0.1], {"distortion": (one, other), "view": two}),
        ([None, None, None, 0.2], {"view": two, "view_distortion": (straight, other)}),
        ([0.1, 0.1, None], {"distortion": (one,), "view": view, "view_distortion": (straight,)}),
        ([0.1, None, 0.2], {"own": own, "view": view, "view_k": view, "view_distortion": (other,)}),
    ):
        assert told(**given) == expected, given
    for error, given in (
        ("lens of each by --view-distortion", {"view": view, "view_k": view}),
        ("--prior-map cannot be used with a lens that distorts", {"prior_map": Path("map.npy")}),
    ):
        with pytest.raises(InputError, match=error):
            told(own=own, **given)


def test_every_photograph_has_its_k(tmp_path):
    """Those of ``--K``, ``--K-right`` and, in order, ``--view-K``; without the latter two the left one's."""
    files = [tmp_path / f"{focal}.txt" for focal in (100, 110, 120, 130)]
    for path in files:
        np.savetxt(path, [[float(path.stem), 0, 31.5], [0, float(path.stem), 23.5], [0, 0, 1]])
    of_left, of_right, *further = files
    options = DepthOptions(**VIEWS, view=(Path("v.png"), Path("w.png")), estimate_pose=True, k=of_left)
    sizes = [(64, 48)] * 4
    for given, focals in (
        ({}, [100, 100, 100, 100]),
        ({"k_right": of_right}, [100, 110, 100, 100]),
        ({"k_right": of_right, "view_k": tuple(further)}, [100, 110, 120, 130]),
        ({"view_k": tuple(further)}, [100, 100, 120, 130]),
    ):
        found = _cameras_without_poses(replace(options, **given), sizes).Ks
        assert [K[0, 0] for K in found] == focals, given


def test_a_further_posed_view_has_the_left_ones_k_unless_it_is_given(tmp_path):
    for focal in (100, 110, 120):
        np.savetxt(tmp_path / f"{focal}.txt", [[focal, 0, 31.5], [0, focal, 23.5], [0, 0, 1]])
    E = np.eye(4)
    E[0, 3] = 0.1
    np.savetxt(tmp_path / "E.txt", E)
    poses = {"e": tmp_path / "E.txt", "view": (Path("v.png"),), "view_e": (tmp_path / "E.txt",)}
    Ks = {"k": tmp_path / "100.txt", "k_right": tmp_path / "110.txt"}
    options, images = DepthOptions(**VIEWS, **poses, **Ks), [np.zeros((48, 64, 3))] * 3
    for given, focals in (({}, [100, 110, 100]), ({"view_k": (tmp_path / "120.txt",)}, [100, 110, 120])):
        found = _cameras_with_poses(replace(options, **given), images, None, of_files=False)
        assert [K[0, 0] for K in found.Ks] == focals


def test_the_estimation_of_poses_is_told_what_it_needs(pair_files, monkeypatch):
    """Points in metres and a known length, both where an image without lens distortion has them."""
    depth, ends = np.zeros((48, 64)), np.array([[10.0, 12.0], [50.0, 40.0]])
    depth[12, 10], depth[40, 50] = 2000.0, 3000.0
    np.save("mm.npy", depth)
    K, told = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]]), {}

    def stop(_images, **options):
        told.update(options)
        raise InterruptedError

    monkeypatch.setattr(GeometryGuidance, "from_photographs", stop)
    known = {"points": Path("mm.npy"), "points_scale": 1000.0, "known_length": "10,12,50,40,1.5"}
    known |= {"fx": 60.0, "fy": 60.0, "cx": 31.5, "cy": 23.5, "cropped": True}
    for distortion in ((), ("0.2,0,0,0",)):
        options = DepthOptions(**VIEWS, device="cpu", estimate_pose=True, distortion=distortion, **known)
        with pytest.raises(InterruptedError):
            read_pair(options)
        assert told["cropped"] is True
        if not distortion:
            assert told["points"].shape == (48, 64) and told["points"][12, 10] == 2.0
            assert told["known_length"] == (10, 12, 50, 40, 1.5)
    at = cv2.undistortPoints(ends, K, np.array([0.2, 0, 0, 0]), P=K)[:, 0]
    rays = np.c_[at, np.ones(2)] @ np.linalg.inv(K).T
    np.testing.assert_allclose(told["points"], rays * [[2.0], [3.0]], atol=1e-3)
    assert told["known_length"] == pytest.approx((*at.reshape(-1), 1.5), abs=0.01)
