"""Every example runs as it stands, on a tiny random prior to be quick; and the notebook."""

import importlib
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from examples import network_poses, posed_photographs, proof
from tests.cli.conftest import write_pair
from tests.contracts.tiny_priors import TINY

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "quickstart.ipynb"
#: Bytes of the notebook with its outputs: it is read in browsers.
MOST_BYTES = 400_000


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

    def go(name: str, *words: object) -> str:
        importlib.import_module(f"examples.{name}").main([str(word) for word in words])
        return capsys.readouterr().out

    return go


def test_every_example_is_tested():
    source = Path(__file__).read_text(encoding="utf-8")
    for path in Path(proof.__file__).parent.glob("*.py"):
        assert f'run("{path.stem}"' in source or path.stem == "fitted_lora"  # test_marigold_v2.py


def test_depth_from_stereo(run, prior, pair):
    said = run("depth_from_stereo", *pair, "--steps", 1, "--out", "depth", "--prior", prior)
    assert "median" in said and (np.load("depth.npy") > 0).all() and Path("depth.png").stat().st_size > 0


def test_marigold_v2_without_weights(run, pair):
    said = run("marigold_v2", *pair)
    assert "random weights" in said and "affine in log depth" in said and "median" in said
    assert (np.load("marigold_v2.npy") > 0).all()


def test_swap_prior(run, prior, pair):
    TINY["depthmaster"]().save_pretrained("one-step")
    said = run("swap_prior", *pair, "--prior", prior, "--prior", "one-step")
    assert "marigold; licence unknown" in said and "depthmaster; licence unknown" in said
    assert said.count("from the first prior's depth") == 1
    with Image.open("swap_prior.png") as picture:
        assert picture.width > 3 * 300  # left image and two maps


def test_posed_photographs(run, prior):
    said = run("posed_photographs", "--steps", 1, "--size", 64, 96, "--prior", prior)
    assert "seen by both cameras" in said
    E = np.eye(4)
    E[0, 3] = 0.3
    left, right = posed_photographs.world_poses(E)
    np.testing.assert_allclose(np.linalg.inv(left) @ right, E, atol=1e-12)
    assert not np.allclose(left, np.eye(4))


@pytest.mark.slow
def test_photographs_without_pose(run, prior):
    pytest.importorskip("poselib")
    said = run("photographs_without_pose", "--steps", 1, "--prior", prior)
    assert "inliers" in said and " m -> photographs_without_pose.npy\n" in said
    assert (np.load("photographs_without_pose.npy") > 0).all()


def test_sparse_points(run, prior, pair, textured_plane):
    points = np.zeros_like(textured_plane.depth_m)
    points[::4, ::4] = textured_plane.depth_m[::4, ::4]
    np.save("points.npy", points)
    np.savetxt("K.txt", textured_plane.K)
    run("sparse_points", pair[0], "points.npy", "K.txt", "--steps", 1, "--prior", prior)
    assert np.median(np.abs(np.load("sparse_points.npy") / textured_plane.depth_m - 1)) < 0.05


@pytest.mark.slow
def test_rig_video(run, prior):
    said = run("rig_video", *"--frames 2 --steps 1 --out depth.gif --prior".split(), prior)
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
    assert run("rig_video", *words, prior).count("median") == 2


def test_poses_of_networks_are_a_capture(run, tmp_path):
    """Scaled evenly but for rounding; cropped to a square, and padded to it."""
    assert run("network_poses").count("3 frames, unit None, 2 at [0.4 0.  0. ]") == 3
    K = np.array([[400.0, 0, 258.5], [0, 400.0, 258.5], [0, 0, 1]])
    for padded, focal in ((False, 400 * 480 / 518), (True, 400 * 640 / 518)):
        found = network_poses.to_image(K, (518, 518), (480, 640), padded)
        np.testing.assert_allclose(found, [[focal, 0, 239.5], [0, focal, 319.5], [0, 0, 1]])
    path = network_poses.stub("da3", tmp_path)
    (tmp_path / "1.png").unlink()
    with pytest.raises(SystemExit, match="3 poses for 2 images"):
        run("network_poses", "da3", path, tmp_path)


@pytest.mark.slow
def test_capture_folder(run, prior):
    pytest.importorskip("pycolmap")
    assert "AbsRel" in run("capture_folder", "--size", 96, 128, "--steps", 1, "--prior", prior)


def test_the_proof_tells_what_was_run_and_what_was_not(run, textured_plane, tmp_path, monkeypatch):
    pair = textured_plane
    known = np.ones(pair.depth_m.shape, bool)
    plane = proof.Pair("plane", pair.left, pair.right, (pair.K, pair.K), pair.E, pair.depth_m, known)
    bundled = next(proof.pairs_of(None, None))
    assert bundled.name == "bundled"
    assert bundled.left.shape[:2] == bundled.depth_m.shape == bundled.valid.shape
    monkeypatch.setattr(proof, "pairs_of", lambda data, most: iter([plane]))
    keys = ["marigold", "depthmaster", "transformers"]
    for key in keys:
        TINY[key]().save_pretrained(tmp_path / key)
    folders = [str(tmp_path / key) for key in keys]
    monkeypatch.setitem(proof.PUBLISHED, folders[0], "NYU 5.5")
    run("proof", *folders, "nobody/nothing", "--device", "cpu", "--out", "proof.md")
    text = Path("proof.md").read_text()
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(f"| {tmp_path}")]
    assert [row[1] for row in rows] == keys
    assert len({row[3] for row in rows}) == 3 and all(len(row[3]) == 16 for row in rows)
    assert all(0 < float(row[5]) < 1 for row in rows) and rows[0][6] == "NYU 5.5" and rows[1][6] == "-"
    assert "## Not on this machine" in text and "- nobody/nothing: prior must be" in text
    assert "diffusers" in text and "Pairs: plane." in text


def _said(cells) -> list[str]:
    """What every cell of code printed and showed, pictures by their names."""
    outputs = [[*cell["outputs"]] for cell in cells if cell["cell_type"] == "code"]
    return ["".join("".join(o.get("text", "picture\n")) for o in each) for each in outputs]


def test_the_notebook_is_kept_with_outputs_that_nothing_of_one_machine_is_in():
    text = NOTEBOOK.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] and not cell["metadata"] for cell in cells)
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert all(output.get("name", "stdout") == "stdout" for output in outputs)
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) == 3
    assert len(text) < MOST_BYTES and "site-packages" not in text and "/tmp" not in text


@pytest.mark.slow
def test_the_notebook_still_says_what_is_kept_in_it(tmp_path):
    for name in ("nbclient", "nbformat", "ipykernel"):
        pytest.importorskip(name, reason=f"{name} is not installed")
    copy = tmp_path / NOTEBOOK.name
    shutil.copy(NOTEBOOK, copy)
    command = [sys.executable, "-m", "tests.pictures", "notebook", "--path", str(copy)]
    root = NOTEBOOK.parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    kept, now = (_said(json.loads(path.read_text())["cells"]) for path in (NOTEBOOK, copy))
    number = r"\d+(?:\.\d+)?"
    assert [re.sub(number, "N", said) for said in kept] == [re.sub(number, "N", said) for said in now]
    for before, after in zip(kept, now, strict=True):  # as far as rounding of another machine allows
        numbers = ([float(n) for n in re.findall(number, said)] for said in (before, after))
        assert next(numbers) == pytest.approx(next(numbers), rel=0.05, abs=0.02), (
            "python -m tests.pictures notebook"
        )
