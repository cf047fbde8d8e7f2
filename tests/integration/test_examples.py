"""Every example runs as it stands, on a tiny random prior to be quick."""

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.cli.conftest import write_pair
from tests.contracts.tiny_priors import make_depthmaster

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def prior(make_pipeline, tmp_path):
    make_pipeline().save_pretrained(tmp_path / "prior")
    return str(tmp_path / "prior")


@pytest.fixture
def pair(textured_plane, tmp_path, monkeypatch) -> list[str]:
    """Left image, right image and calibration, as paths in the working directory."""
    monkeypatch.chdir(tmp_path)
    files = write_pair(Path(), textured_plane)
    return [str(path) for path in (files.left, files.right, files.calib)]


@pytest.fixture
def run(tmp_path, monkeypatch, capsys):
    """Run an example in a fresh folder; what it printed."""
    monkeypatch.chdir(tmp_path)

    def go(name: str, *words: str) -> str:
        load(EXAMPLES / name).main(list(words))
        return capsys.readouterr().out

    return go


def test_every_example_is_tested():
    source = Path(__file__).read_text(encoding="utf-8")
    elsewhere = {"fitted_lora.py", "proof.py"}  # test_fitted_lora.py, test_proof.py
    for name in {path.name for path in EXAMPLES.glob("*.py")} - elsewhere:
        assert f'"{name}"' in source


def test_depth_from_stereo(run, prior, pair):
    said = run("depth_from_stereo.py", *pair, "--steps", "1", "--out", "depth", "--prior", prior)
    assert "median" in said and (np.load("depth.npy") > 0).all() and Path("depth.png").stat().st_size > 0


def test_marigold_v2_without_weights(run, pair):
    said = run("marigold_v2.py", *pair)
    assert "random weights" in said and "affine in log depth" in said and "median" in said
    assert (np.load("marigold_v2.npy") > 0).all()


def test_swap_prior(run, prior, pair):
    make_depthmaster().save_pretrained("one-step")
    said = run("swap_prior.py", *pair, "--prior", prior, "--prior", "one-step")
    assert "marigold; licence unknown" in said and "depthmaster; licence unknown" in said
    assert said.count("from the first prior's depth") == 2
    with Image.open("swap_prior.png") as picture:
        assert picture.width > 3 * 300  # left image and two maps


def test_posed_photographs(run, prior):
    said = run("posed_photographs.py", "--steps", "1", "--size", "64", "96", "--prior", prior)
    assert "seen by both cameras" in said
    E = np.eye(4)
    E[0, 3] = 0.3
    left, right = load(EXAMPLES / "posed_photographs.py").world_poses(E)
    np.testing.assert_allclose(np.linalg.inv(left) @ right, E, atol=1e-12)
    assert not np.allclose(left, np.eye(4))


@pytest.mark.slow
def test_photographs_without_pose(run, prior):
    pytest.importorskip("poselib")
    said = run("photographs_without_pose.py", "--steps", "1", "--prior", prior)
    assert "inliers" in said and " m\n" in said
    assert (np.load("photographs_without_pose.npy") > 0).all()


def test_sparse_points(run, prior, pair, textured_plane):
    points = np.zeros_like(textured_plane.depth_m)
    points[::4, ::4] = textured_plane.depth_m[::4, ::4]
    np.save("points.npy", points)
    np.savetxt("K.txt", textured_plane.K)
    run("sparse_points.py", pair[0], "points.npy", "K.txt", "--steps", "1", "--prior", prior)
    assert np.median(np.abs(np.load("sparse_points.npy") / textured_plane.depth_m - 1)) < 0.05


@pytest.mark.slow
def test_rig_video(run, prior):
    said = run("rig_video.py", *"--frames 2 --steps 1 --out depth.gif --prior".split(), prior)
    assert said.count("median") == 2
    with Image.open("depth.gif") as video:
        assert video.n_frames == 2


def test_rig_video_of_files(run, prior, pair, textured_plane):
    """A video that is shorter than what is asked for."""
    for side in ("left", "right"):
        frame = np.ascontiguousarray(getattr(textured_plane, side)[..., ::-1])
        writer = cv2.VideoWriter(f"{side}.avi", cv2.VideoWriter.fourcc(*"MJPG"), 10, frame.shape[1::-1])
        for _ in range(2):
            writer.write(frame)
        writer.release()
    words = "left.avi right.avi calib.txt --steps 1 --out depth.gif --frames 50 --prior".split()
    assert run("rig_video.py", *words, prior).count("median") == 2


def test_poses_of_networks_are_a_capture(run, tmp_path):
    """Scaled evenly but for rounding; cropped to a square, and padded to it."""
    example = load(EXAMPLES / "network_poses.py")
    assert run("network_poses.py").count("3 frames, unit None, 2 at [0.4 0.  0. ]") == 3
    K = np.array([[400.0, 0, 258.5], [0, 400.0, 258.5], [0, 0, 1]])
    for padded, focal in ((False, 400 * 480 / 518), (True, 400 * 640 / 518)):
        found = example.to_image(K, (518, 518), (480, 640), padded)
        np.testing.assert_allclose(found, [[focal, 0, 239.5], [0, focal, 319.5], [0, 0, 1]])
    path = example.stub("da3", tmp_path)
    (tmp_path / "1.png").unlink()
    with pytest.raises(SystemExit, match="3 poses for 2 images"):
        example.main(["da3", str(path), str(tmp_path)])


@pytest.mark.slow
def test_capture_folder(run, prior):
    pytest.importorskip("pycolmap")
    said = run("capture_folder.py", "--size", "96", "128", "--steps", "1", "--prior", prior)
    assert "AbsRel" in said
