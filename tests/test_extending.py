"""Every block of docs/how-to/extending.md runs, and what it adds to the tables works."""

import re
from pathlib import Path
from types import FunctionType

import numpy as np
import pytest
import torch
from diffusers import UNet2DModel
from PIL import Image

from geodiff_plugin import load_prior
from geodiff_plugin.algorithm.optimizers import OPTIMIZERS
from geodiff_plugin.algorithm.terms import TERMS
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation.baselines import METHODS, PriorCache, Settings, find_method
from geodiff_plugin.evaluation.datasets import DATASETS, find_pairs, load
from geodiff_plugin.evaluation.metrics import align
from geodiff_plugin.formats import CALIBRATION_FORMATS, captures, read_calibration, read_capture
from geodiff_plugin.matching import points_to_matches
from geodiff_plugin.priors import PRIORS
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.scale.points import fit_to_points
from geodiff_plugin.scale.space import SPACES, MetricMap
from geodiff_plugin.trust import FactSheet, ImagesStage
from tests.tiny import guided_call, make_vae, quiet, seeded

(PAGE,) = (Path(__file__).resolve().parents[1] / "docs").rglob("extending.md")
#: Tables of the blocks that a reader takes alone, with all that they import.
ALONE = ("TERMS", "SPACES", "OPTIMIZERS", "CALIBRATION_FORMATS", "DATASETS", "METHODS")
BLOCKS = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.fixture
def page():
    """The names that the page's blocks define, the tables with what they add; all as before afterwards."""
    tables = (PRIORS, TERMS, OPTIMIZERS, SPACES, CALIBRATION_FORMATS, DATASETS, METHODS)
    before = [(table, dict(table)) for table in tables]
    layouts = captures.LAYOUTS
    names: dict = {}
    for block in BLOCKS:
        exec(compile(block, PAGE.name, "exec"), names)
    yield names
    for table, entries in before:
        table.clear()
        table.update(entries)
    captures.LAYOUTS = layouts


@pytest.mark.parametrize("table", ALONE)
def test_a_block_runs_in_a_file_of_its_own(page, table):
    (block,) = [block for block in BLOCKS if f"\n{table}[" in block]
    names: dict = {}
    exec(compile(block, PAGE.name, "exec"), names)
    missing = {
        name
        for value in names.values()
        if isinstance(value, FunctionType) and value.__code__.co_filename == PAGE.name
        for name in value.__code__.co_names
        if name in ("np", "torch", "dataclass") and name not in names
    }
    assert not missing


def test_the_capture_format_of_the_page_is_read(page, tmp_path):
    for name in ("a.png", "c.png"):
        Image.new("RGB", (640, 480)).save(tmp_path / name)
    pose = " ".join(map(str, np.eye(4).ravel()))
    (tmp_path / "ink.txt").write_text("".join(f"500 {pose} {name}.png\n" for name in "abc"))
    layout = page["read_ink_capture"](tmp_path)
    first, second, _ = layout.candidates
    np.testing.assert_array_equal(first.frame.E, np.eye(4))
    assert layout.unit == "m" and first.camera.K[0, 0] == 500 and second.problem
    assert page["read_ink_capture"](tmp_path / "nowhere") is None
    found = read_capture(tmp_path)
    assert found.kind == "ink" and [frame.name for frame in found.frames] == ["a", "c"]


def test_what_the_page_adds_works(page, textured_plane, tmp_path):
    torch.manual_seed(0)
    unet = UNet2DModel(
        in_channels=4,
        out_channels=4,
        block_out_channels=(8, 8),
        down_block_types=("DownBlock2D",) * 2,
        up_block_types=("UpBlock2D",) * 2,
        norm_num_groups=4,
    )
    tiny = page["InkPipeline"](unet, make_vae(), DirectScheduler(), default_processing_resolution=64)
    tiny.save_pretrained(tmp_path)
    index = tmp_path / "model_index.json"
    index.write_text(index.read_text().replace('"diffusers",\n    "UNet2DModel"', '"mine",\n    "MyUNet"'))
    pipe = quiet(load_prior(tmp_path))
    assert isinstance(pipe, page["InkPipeline"])
    weights = {"photometric": 1.0, "far_pull": 0.1}
    parameters = {"optimizer": "sign", "weights": weights, "guidance_steps": 2, "min_steps": 2}
    out = guided_call(pipe, textured_plane, parameters)
    assert (out.prediction > 0).all() and np.isfinite(out.prediction).all()
    assert "far_pull" in out.history[0].terms and len(out.history) == 2


def test_a_space_is_known_to_map_fit_and_alignment(page):
    x = torch.rand(1, 1, 24, 32, generator=seeded()) * 0.9 + 0.05
    metric, near, far = MetricMap("cube_root"), torch.tensor([1.5]), torch.tensor([9.0])
    depth_m = metric(x, metric.from_range(near, far))
    torch.testing.assert_close(metric.range_of(metric.from_range(near, far)), (near, far), rtol=2e-3, atol=0)
    left = Camera(np.array([[30.0, 0, 15.5], [0, 30.0, 11.5], [0, 0, 1]]), (32, 24))
    points, _ = points_to_matches(depth_m[0, 0], left, (24, 32))
    found = fit_to_points(x, points, metric)
    assert ((metric(x, metric.from_range(*found)) - depth_m).abs() / depth_m).median() < 0.1
    ground_truth = depth_m[0, 0].numpy()
    aligned = align(3 * np.cbrt(ground_truth) + 1, ground_truth, ground_truth > 0, "cube_root")
    np.testing.assert_allclose(aligned, ground_truth, rtol=1e-5)


def test_a_format_a_data_set_and_a_method(page, textured_plane, tmp_path):
    pair, folder = textured_plane, tmp_path / "one.ink"
    folder.mkdir()
    for name in ("left", "right"):
        Image.fromarray(getattr(pair, name)).save(folder / f"ink_{name}.png")
    np.save(folder / "depth.npy", pair.depth_m.astype(np.float32))
    K, E = pair.K, pair.E
    (folder / "cameras").write_text(f"ink 1\n{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]} {E[0, 3]}\n")
    np.testing.assert_allclose(read_calibration(folder / "cameras").E, E)
    (ref,) = find_pairs(tmp_path)
    sample = load(ref)
    assert sample.label == "ink/one" and sample.depth_m.shape == pair.depth_m.shape
    prediction = find_method("flat").run(sample, Settings(), PriorCache())
    assert (prediction.depth_m == 2.0).all()


def test_the_check_of_the_page_reports_what_it_measures(page):
    check = page["Darkness"]
    grey = np.full((8, 8), 200, np.uint8)
    for dark, codes in ((np.full_like(grey, 4), ["views.dark"]), (grey, [])):
        facts = FactSheet({check: check.of_images(ImagesStage([grey, dark], [8, 8]))})
        assert [finding.code for finding in check.findings(facts, ())] == codes
