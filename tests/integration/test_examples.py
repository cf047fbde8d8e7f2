"""Every example runs as it stands, on a tiny random prior to be quick; and the notebook."""

import importlib
import importlib.util
import json
import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from examples import learned_stereo, lerobot_depth, network_poses, posed_images, proof
from examples.networks import psmnet
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from tests import lerobot_stand_in
from tests.cli.conftest import write_pair
from tests.contracts.tiny_priors import TINY
from tests.evaluating import write_scenes

pytestmark = pytest.mark.end_to_end

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "quickstart.ipynb"
#: Bytes of the notebook with its outputs: it is read in browsers.
MAX_BYTES = 400_000


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
    with Image.open("swap_prior.png") as image:
        assert image.width > 3 * 300  # left image and two maps


def test_posed_images(run, prior):
    said = run("posed_images", "--steps", 1, "--size", 64, 96, "--prior", prior)
    assert "visible in both views" in said
    E = np.eye(4)
    E[0, 3] = 0.3
    left, right = posed_images.world_poses(E)
    np.testing.assert_allclose(np.linalg.inv(left) @ right, E, atol=1e-12)
    assert not np.allclose(left, np.eye(4))


@pytest.mark.slow
def test_unposed_images(run, prior):
    pytest.importorskip("poselib")
    said = run("unposed_images", "--steps", 1, "--prior", prior)
    assert "inliers" in said and " m -> unposed_images.npy\n" in said
    assert (np.load("unposed_images.npy") > 0).all()


def as_seen(left, right):
    """A network: disparity 8 px within 0.01, surer on the left."""
    shape = left.shape[:2]
    assert right.shape == left.shape and left.dtype == np.uint8
    steps = np.broadcast_to(np.linspace(1, 0, shape[1]), shape)
    return 8.0 + 0.01 * steps, steps


def test_learned_stereo(run, prior, monkeypatch):
    monkeypatch.setitem(sys.modules, "my_network", sys.modules[__name__])
    write_scenes(Path("data"), "wall")
    words = ["data", "--network", "my_network:as_seen", "--prior", prior]
    with pytest.raises(SystemExit, match="0"):
        run("learned_stereo", *words)
    np.testing.assert_allclose(np.load("learned/middlebury2014_wall.npy"), 8, atol=0.011)
    assert np.load("learned/confidence/middlebury2014_wall.npy")[0, 0] == 1
    table = Path("geodiff-eval/table.md").read_text(encoding="utf-8")
    (row,) = re.findall(r"^\| middlebury2014/wall \| (.*) \|$", table, re.M)[:1]
    guided, peer, points, prior_map = (float(cell) for cell in row.split(" | "))
    assert peer < 0.002 and points < 0.01 and prior_map < 0.01 and guided < 0.1
    said = run("learned_stereo", *words, "--maps-only")
    assert "0 new maps" in said and "points-map:disparity:learned" in said
    wrong = [*words[:1], "--network", "my_network:too_small", "--out", "other", "--maps-only"]
    with pytest.raises(ValueError, match=r"middlebury2014/wall must have shape \(48, 144\); got \(4, 5\)"):
        run("learned_stereo", *wrong)
    with pytest.raises(ValueError, match="MODULE:NAME or pipeline:MODEL"):
        run("learned_stereo", "data", "--network", "my_network")


def too_small(left, right):
    return np.ones((4, 5))


def test_a_stand_in_for_the_network_matches(textured_plane):
    disparity = learned_stereo.semi_global(textured_plane.left, textured_plane.right)
    expected = textured_plane.K[0, 0] * textured_plane.E[0, 3] / textured_plane.depth_m
    assert np.isfinite(disparity).mean() > 0.5 and np.nanmedian(np.abs(disparity - expected)) < 0.5


def test_models_of_stereo_matching_are_called_as_in_its_readme(monkeypatch):
    def pipeline(task, model):
        assert (task, model) == ("stereo-matching", "raft-stereo")
        return lambda left, right: SimpleNamespace(
            disparity=np.asarray(left)[..., 0] - np.asarray(right)[..., 0]
        )

    monkeypatch.setitem(sys.modules, "stereo_matching", SimpleNamespace(pipeline=pipeline))
    network = learned_stereo.load_network("pipeline:raft-stereo", None)
    left, right = np.full((4, 5, 3), 9, np.uint8), np.full((4, 5, 3), 2, np.uint8)
    np.testing.assert_array_equal(network(left, right), np.full((4, 5), 7))


@pytest.mark.slow
def test_psmnet_reads_the_authors_checkpoint_without_executing_it(tmp_path):
    torch.manual_seed(0)
    network = psmnet.PSMNet()
    state = {f"module.{name}": tensor for name, tensor in network.state_dict().items()}
    torch.save({"state_dict": state}, tmp_path / "weights.tar")
    predictor = psmnet.load(tmp_path / "weights.tar")
    for name, tensor in predictor.network.state_dict().items():
        torch.testing.assert_close(tensor, network.state_dict()[name])
    left, right = np.random.default_rng(0).integers(0, 256, (2, 250, 260, 3), dtype=np.uint8)
    disparity, confidence = predictor(left, right)
    assert disparity.shape == confidence.shape == (250, 260)
    assert (disparity >= 0).all() and disparity.max() < 192 and 0 <= confidence.min() <= confidence.max() <= 1
    torch.save({"state_dict": state, "extra": Path("x")}, tmp_path / "code.tar")
    with pytest.raises(pickle.UnpicklingError, match="[Ww]eights"):
        psmnet.load(tmp_path / "code.tar")


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


@pytest.fixture
def lerobot(monkeypatch):
    """LeRobot, or a stand-in if it is not installed."""
    if importlib.util.find_spec("lerobot") is None:
        for name in ("lerobot", "lerobot.configs", "lerobot.datasets"):
            module = ModuleType(name)
            module.__dict__.update(vars(lerobot_stand_in))
            monkeypatch.setitem(sys.modules, name, module)


@pytest.mark.usefixtures("lerobot")
def test_depth_is_added_to_a_lerobot_dataset(run, prior):
    pair = read_demo_pair()
    left, right = (np.rint(image * 255).astype(np.uint8) for image in (pair.left, pair.right))
    lerobot_depth.record(Path("recorded"), [1, 1], left, right)
    words = ["--steps", 1, "--prior", prior, "--min-confidence", 0.9, "--out"]
    words = ["recorded", "--calib", DEMO_PAIR_FOLDER / "calib.txt", *words]
    said = run("lerobot_depth", *words, "video")
    assert "episode 1, frame 1: " in said and "unknown, stored as 0.01 m" in said
    assert "differs by at most 0.0 mm" in run("lerobot_depth", *words, "tiff", "--tiff")
    run("lerobot_depth", *words, "near", "--max-depth", 0.5)
    source, video, tiff, near = map(lerobot_depth.open_dataset, ("recorded", "video", "tiff", "near"))
    assert [int(video[i]["episode_index"]) for i in range(len(video))] == [0, 1]
    for i in range(2):
        for key in ("observation.state", "task"):
            assert video[i][key] == source[i][key]
        images = [each[i]["observation.images.left"].float() for each in (source, video)]
        assert images[1].shape == images[0].shape and (images[1] - images[0]).abs().mean() < 5
        exact, coded, clipped = (each[i]["observation.depth"][0].numpy() for each in (tiff, video, near))
        known = exact > 0
        assert 0.1 < known.mean() < 1
        assert np.median(np.abs(exact / pair.depth_m - 1)[known & pair.valid]) < 0.05
        # Half of one of 4095 steps of log(depth + 3.5 m)
        half_step = (exact + 3.5) * np.log(13.5 / 3.51) / 8190
        assert (np.abs(coded - exact) < half_step + 1e-5)[known].all()
        np.testing.assert_allclose(coded[~known], 0.01, atol=1e-5)
        np.testing.assert_allclose(clipped[known], 0.5, atol=1e-5)


@pytest.mark.usefixtures("lerobot")
def test_lerobot_example_reports_what_it_cannot_use_and_leaves_nothing(run, prior, capsys, monkeypatch):
    image = np.zeros((8, 12, 3), np.uint8)
    lerobot_depth.record(Path("recorded"), [1], image, image)
    calibrated = "recorded", "--calib", DEMO_PAIR_FOLDER / "calib.txt"
    for words, said in (
        (["recorded"], "expected a dataset and its calibration"),
        ([*calibrated, "--out", "recorded"], "--out recorded exists"),
        (
            [*calibrated, "--right", "r"],
            "--right r is not in the dataset; its images are observation.images.left",
        ),
    ):
        with pytest.raises(SystemExit):
            run("lerobot_depth", *words, "--prior", prior)
        assert said in capsys.readouterr().err
    monkeypatch.setattr(lerobot_depth, "live", lambda *_, **__: iter([None]))
    with pytest.raises(AttributeError):
        run("lerobot_depth", "--prior", prior, "--out", "copy")
    assert not Path("copy").exists()


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


def test_the_proof_states_what_was_run_and_what_was_not(run, textured_plane, tmp_path, monkeypatch):
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
    assert "## Not available on this machine" in text and "- nobody/nothing: prior must be" in text
    assert "diffusers" in text and "Pairs: plane." in text


def _said(cells) -> list[str]:
    """What every cell of code printed and showed, images by their names."""
    outputs = [[*cell["outputs"]] for cell in cells if cell["cell_type"] == "code"]
    return ["".join("".join(o.get("text", "image\n")) for o in each) for each in outputs]


def test_the_notebook_is_kept_with_outputs_that_nothing_of_one_machine_is_in():
    text = NOTEBOOK.read_text(encoding="utf-8")
    cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] and not cell["metadata"] for cell in cells)
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert all(output.get("name", "stdout") == "stdout" for output in outputs)
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) == 3
    assert len(text) < MAX_BYTES and "site-packages" not in text and "/tmp" not in text


@pytest.mark.slow
def test_the_notebook_still_prints_its_stored_outputs(tmp_path):
    for name in ("nbclient", "nbformat", "ipykernel"):
        pytest.importorskip(name, reason=f"{name} is not installed")
    copy = tmp_path / NOTEBOOK.name
    shutil.copy(NOTEBOOK, copy)
    command = [sys.executable, "-m", "tests.images", "notebook", "--path", str(copy)]
    root = NOTEBOOK.parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-3000:]
    kept, now = (_said(json.loads(path.read_text())["cells"]) for path in (NOTEBOOK, copy))
    number = r"\d+(?:\.\d+)?"
    assert [re.sub(number, "N", said) for said in kept] == [re.sub(number, "N", said) for said in now]
    for before, after in zip(kept, now, strict=True):  # as far as rounding of another machine allows
        numbers = ([float(n) for n in re.findall(number, said)] for said in (before, after))
        assert next(numbers) == pytest.approx(next(numbers), rel=0.05, abs=0.02), (
            "python -m tests.images notebook"
        )
