"""Every example runs as it stands, on a tiny random prior to be quick."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

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
    return tmp_path / "prior"


@pytest.fixture
def pair(textured_plane, tmp_path) -> list[str]:
    """Left image, right image and calibration, as paths."""
    height, width = textured_plane.depth_m.shape
    for side in ("left", "right"):
        Image.fromarray(getattr(textured_plane, side)).save(tmp_path / f"{side}.png")
    K = textured_plane.K
    camera = f"[{K[0, 0]} 0 {K[0, 2]}; 0 {K[1, 1]} {K[1, 2]}; 0 0 1]"
    (tmp_path / "calib.txt").write_text(
        f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=120\nwidth={width}\nheight={height}\nndisp=32\n"
    )
    return [str(tmp_path / name) for name in ("left.png", "right.png", "calib.txt")]


def test_every_example_is_tested():
    source = Path(__file__).read_text(encoding="utf-8")
    elsewhere = {EXAMPLES / "fitted_lora.py", EXAMPLES / "proof.py"}  # test_fitted_lora.py, test_proof.py
    for path in set(EXAMPLES.glob("*.py")) - elsewhere:
        assert f'load(EXAMPLES / "{path.name}")' in source


def test_depth_from_stereo(prior, pair, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = [*pair, "--steps", "1", "--out", "depth", "--prior", str(prior)]
    load(EXAMPLES / "depth_from_stereo.py").main(arguments)
    assert "median" in capsys.readouterr().out
    assert (np.load("depth.npy") > 0).all() and Path("depth.png").stat().st_size > 0


def test_marigold_v2_without_weights(pair, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    load(EXAMPLES / "marigold_v2.py").main(pair)
    said = capsys.readouterr().out
    assert "random weights" in said and "affine in log depth" in said and "median" in said
    assert (np.load("marigold_v2.npy") > 0).all()


def test_swap_prior(prior, pair, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make_depthmaster().save_pretrained(tmp_path / "one-step")
    arguments = [*pair, "--prior", str(prior), "--prior", str(tmp_path / "one-step")]
    load(EXAMPLES / "swap_prior.py").main(arguments)
    said = capsys.readouterr().out
    assert "marigold; licence unknown" in said and "depthmaster; licence unknown" in said
    assert said.count("from the first prior's depth") == 2
    with Image.open("swap_prior.png") as picture:
        assert picture.width > 3 * 300  # left image and two maps


def test_posed_photographs(prior, capsys):
    arguments = ["--steps", "1", "--size", "64", "96", "--prior", str(prior)]
    load(EXAMPLES / "posed_photographs.py").main(arguments)
    assert "seen by both cameras" in capsys.readouterr().out


def test_world_poses_compose_to_the_relative_pose():
    E = np.eye(4)
    E[0, 3] = 0.3
    left, right = load(EXAMPLES / "posed_photographs.py").world_poses(E)
    np.testing.assert_allclose(np.linalg.inv(left) @ right, E, atol=1e-12)
    assert not np.allclose(left, np.eye(4))


@pytest.mark.slow
def test_photographs_without_pose(prior, tmp_path, monkeypatch, capsys):
    pytest.importorskip("poselib")
    monkeypatch.chdir(tmp_path)
    load(EXAMPLES / "photographs_without_pose.py").main(["--steps", "1", "--prior", str(prior)])
    said = capsys.readouterr().out
    assert "inliers" in said and " m\n" in said
    assert (np.load("photographs_without_pose.npy") > 0).all()


def test_sparse_points(prior, pair, textured_plane, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    points = np.zeros_like(textured_plane.depth_m)
    points[::4, ::4] = textured_plane.depth_m[::4, ::4]
    np.save("points.npy", points)
    np.savetxt("K.txt", textured_plane.K)
    load(EXAMPLES / "sparse_points.py").main(
        [pair[0], "points.npy", "K.txt", "--steps", "1", "--prior", str(prior)]
    )
    depth_m = np.load("sparse_points.npy")
    assert np.median(np.abs(depth_m / textured_plane.depth_m - 1)) < 0.05
    assert "where no point was given" not in capsys.readouterr().out


@pytest.mark.slow
def test_rig_video(prior, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arguments = ["--frames", "2", "--steps", "1", "--prior", str(prior), "--out", "depth.gif"]
    load(EXAMPLES / "rig_video.py").main(arguments)
    assert capsys.readouterr().out.count("median") == 2
    with Image.open("depth.gif") as video:
        assert video.n_frames == 2


def test_rig_video_of_files(prior, pair, textured_plane, tmp_path, monkeypatch, capsys):
    """A video that is shorter than what is asked for, and a calibration of another size."""
    monkeypatch.chdir(tmp_path)
    for side in ("left", "right"):
        frame = np.ascontiguousarray(getattr(textured_plane, side)[..., ::-1])
        writer = cv2.VideoWriter(f"{side}.avi", cv2.VideoWriter.fourcc(*"MJPG"), 10, frame.shape[1::-1])
        for _ in range(2):
            writer.write(frame)
        writer.release()
    options = ["--steps", "1", "--prior", str(prior), "--out", "depth.gif"]
    arguments = ["left.avi", "right.avi", pair[2], *options]
    load(EXAMPLES / "rig_video.py").main([*arguments, "--frames", "50"])
    assert capsys.readouterr().out.count("median") == 2
    Path(pair[2]).write_text(Path(pair[2]).read_text().replace("width=", "width=1"))
    with pytest.raises(ValueError, match="as the left view"):
        load(EXAMPLES / "rig_video.py").main(arguments)


def test_poses_of_networks_are_a_capture(tmp_path, capsys):
    """Scaled evenly but for rounding; cropped to a square, and padded to it."""
    example = load(EXAMPLES / "network_poses.py")
    example.main([])
    assert capsys.readouterr().out.count("3 frames, unit None, 2 at [0.4 0.  0. ]") == 3
    K = np.array([[400.0, 0, 258.5], [0, 400.0, 258.5], [0, 0, 1]])
    for padded, focal in ((False, 400 * 480 / 518), (True, 400 * 640 / 518)):
        found = example.to_image(K, (518, 518), (480, 640), padded)
        np.testing.assert_allclose(found, [[focal, 0, 239.5], [0, focal, 319.5], [0, 0, 1]])
    path = example.stub("da3", tmp_path)
    (tmp_path / "1.png").unlink()
    with pytest.raises(SystemExit, match="3 poses for 2 images"):
        example.main(["da3", str(path), str(tmp_path)])


@pytest.mark.slow
def test_capture_folder(prior, capsys):
    pytest.importorskip("pycolmap")
    load(EXAMPLES / "capture_folder.py").main(["--size", "96", "128", "--steps", "1", "--prior", str(prior)])
    assert "AbsRel" in capsys.readouterr().out
