"""Methods beside guidance: maps made elsewhere, depth models of transformers, guidance without a network."""

import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from geodiff_plugin.evaluation.baselines.constant import constant_method
from geodiff_plugin.evaluation.datasets.folder import find_folder, load_folder
from PIL import Image
from transformers import DPTConfig, DPTForDepthEstimation, GLPNConfig, GLPNForDepthEstimation

from geodiff_plugin.algorithm.terms import Objective
from geodiff_plugin.evaluation.baselines import (
    FAMILIES,
    METHODS,
    NotApplicable,
    PriorCache,
    Settings,
    constant,
    find_method,
)
from geodiff_plugin.evaluation.baselines.guided import guided_prediction
from geodiff_plugin.evaluation.baselines.outside import map_name
from geodiff_plugin.evaluation.baselines.stereo import native_depth
from geodiff_plugin.evaluation.datasets.sample import StereoSample
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.formats import write_depth_mm, write_pfm
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.scale.space import SPACES

SHAPE = (32, 48)


def make_sample(rectified=True) -> StereoSample:
    image = np.random.default_rng(0).integers(0, 256, (*SHAPE, 3), dtype=np.uint8)
    K = np.array([[30.0, 0, 23.5], [0, 30.0, 15.5], [0, 0, 1]])
    K_right = K.copy()
    K_right[0, 2] += 2  # doffs
    E = np.eye(4)
    E[0, 3] = 0.2
    depth_m = np.linspace(1.0, 2.5, SHAPE[1], dtype=np.float32)[None].repeat(SHAPE[0], 0)
    return StereoSample(
        "folder", "mine", image, image, K, K_right, E, depth_m, depth_m > 0, rectified=rectified
    )


def run(name, sample):
    return find_method(name).run(sample, Settings(), PriorCache())


def disparity_of(sample):
    return 30.0 * 0.2 / sample.depth_m - 2


def with_hole(values, unknown):
    values = values.copy()
    values[:3, :3] = unknown
    return values


def png16(path, values):
    Image.fromarray(np.rint(values).astype(np.uint16)).save(path)


@pytest.mark.parametrize(
    ("kind", "write", "tolerance"),
    [
        ("depth", lambda f, s: np.save(f / "folder_mine.npy", with_hole(s.depth_m, np.nan)), 1e-6),
        ("depth", lambda f, s: write_pfm(f / "folder_mine.pfm", with_hole(s.depth_m, 0)), 1e-6),
        ("depth", lambda f, s: write_depth_mm(f / "folder_mine.png", with_hole(s.depth_m, 0)), 1e-3),
        ("disparity", lambda f, s: np.save(f / "folder_mine.npy", with_hole(disparity_of(s), np.inf)), 1e-5),
        (
            "disparity",
            lambda f, s: write_pfm(f / "folder_mine.pfm", with_hole(disparity_of(s), np.nan)),
            1e-5,
        ),
        (
            "disparity",
            lambda f, s: png16(f / "folder_mine.png", with_hole(256 * disparity_of(s), 0)),
            2e-3,
        ),
    ],
)
def test_metric_maps_are_read_and_holes_stay(tmp_path, kind, write, tolerance):
    sample = make_sample()
    write(tmp_path, sample)
    prediction = run(f"files:{kind}:{tmp_path}", sample)
    assert np.isnan(prediction.depth_m[:3, :3]).all()
    np.testing.assert_allclose(prediction.depth_m[3:], sample.depth_m[3:], rtol=tolerance)
    assert score(sample, prediction, None)["all_pixels"]["raw"]["coverage"] == pytest.approx(
        1 - 9 / np.prod(SHAPE)
    )


def test_relative_maps_are_aligned_only_and_depth_is_the_default_kind(tmp_path):
    sample = make_sample()
    np.save(tmp_path / "folder_mine.npy", 7 - 3 / sample.depth_m)  # no map of inverse depth falls with it
    record = score(sample, run(f"files:relative-disparity:{tmp_path}", sample), None)
    assert record["all_pixels"]["raw"] is None
    assert record["all_pixels"]["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6)
    np.save(tmp_path / "folder_mine.npy", sample.depth_m)
    np.testing.assert_array_equal(run(f"files:{tmp_path}", sample).depth_m, sample.depth_m)


def test_disparity_of_another_size_is_resized_in_value_too(tmp_path):
    sample = make_sample()
    plane = np.full((2 * SHAPE[0], 2 * SHAPE[1]), 2 * 3.0)
    np.save(tmp_path / "folder_mine.npy", plane)
    np.testing.assert_allclose(run(f"files:disparity:{tmp_path}", sample).depth_m, 6.0 / (3 + 2), rtol=1e-6)


def test_samples_without_a_map_and_posed_disparity_do_not_apply(tmp_path):
    with pytest.raises(NotApplicable, match="no map"):
        run(f"files:{tmp_path}", make_sample())
    np.save(tmp_path / "folder_mine.npy", np.ones(SHAPE))
    with pytest.raises(NotApplicable, match="not rectified"):
        run(f"files:disparity:{tmp_path}", make_sample(rectified=False))


@pytest.mark.parametrize("space", ["log", "log1p", "sqrt_disparity"])
def test_guided_metres_are_aligned_in_the_space_of_the_prior(make_pipeline, space):
    """A map that is right up to scale and shift in the prior's space is right once it is aligned."""
    sample = make_sample()
    pipe = enable_geometry_guidance(make_pipeline(prediction_type=space))
    guidance = GeometryGuidance.search_only(
        sample.right, (sample.K_left, sample.K_right), sample.E, min_steps=1
    )
    prediction = guided_prediction(pipe, sample, guidance, {"num_inference_steps": 1})
    assert prediction.space == space
    value = torch.from_numpy(SPACES[space].inverse(torch.from_numpy(sample.depth_m).double()).numpy())
    stretched = SPACES[space].forward(1.7 * value + 0.2, torch.ones((), dtype=torch.float64)).numpy()
    record = score(sample, replace(prediction, depth_m=stretched), None)["all_pixels"]
    assert record["aligned"]["abs_rel"] == pytest.approx(0, abs=1e-6) and record["raw"]["abs_rel"] > 0.1


def test_integers_are_no_metres(tmp_path):
    sample = make_sample()
    np.save(tmp_path / f"{map_name(sample.dataset, sample.name)}.npy", np.full(sample.depth_m.shape, 2000))
    with pytest.raises(ValueError, match=r"map must be metres as floats.*int64.*1000 for millimetres"):
        run(f"files:{tmp_path}", sample)
    assert run(f"files:relative-depth:{tmp_path}", sample).relative is not None


def test_bad_folders_of_maps_are_named(tmp_path):
    with pytest.raises(ValueError, match="files:DIR or files:KIND:DIR with an existing folder"):
        find_method(f"files:{tmp_path / 'nowhere'}")
    (tmp_path / "folder_mine.npy").write_bytes(b"no array")
    with pytest.raises(ValueError, match=r"folder_mine\.npy"):
        run(f"files:{tmp_path}", make_sample())


def test_changed_maps_are_another_configuration(tmp_path):
    np.save(tmp_path / "folder_mine.npy", np.ones(SHAPE))
    method = find_method(f"files:{tmp_path}")
    before = method.configuration(Settings())
    assert method.configuration(Settings(seed=1)) == before
    np.save(tmp_path / "folder_other.npy", np.ones(SHAPE))
    assert method.configuration(Settings()) != before


def save_dpt(folder):
    """A relative depth model (MiDaS's kind) of random weights."""
    torch.manual_seed(0)
    config = DPTConfig(
        hidden_size=8,
        num_hidden_layers=2,
        num_attention_heads=2,
        intermediate_size=8,
        image_size=32,
        patch_size=16,
        backbone_out_indices=[0, 1],
        is_hybrid=False,
        neck_hidden_sizes=[4, 4],
        reassemble_factors=[1, 0.5],
        fusion_hidden_size=4,
        head_in_index=-1,
        use_auxiliary_head=False,
    )
    DPTForDepthEstimation(config).save_pretrained(folder)
    options = {"image_processor_type": "DPTImageProcessor", "size": {"height": 32, "width": 32}}
    (folder / "preprocessor_config.json").write_text(json.dumps(options))


def save_glpn(folder):
    """A metric depth model of random weights."""
    torch.manual_seed(0)
    config = GLPNConfig(
        num_encoder_blocks=4,
        depths=[1] * 4,
        hidden_sizes=[8] * 4,
        num_attention_heads=[1] * 4,
        decoder_hidden_size=8,
        max_depth=10,
    )
    GLPNForDepthEstimation(config).save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text('{"image_processor_type": "GLPNImageProcessor"}')


@pytest.mark.parametrize(("save", "metric"), [(save_dpt, False), (save_glpn, True)])
def test_depth_models_of_transformers_answer(tmp_path, save, metric):
    folder, sample = tmp_path / "tiny-model", make_sample()
    folder.mkdir()
    save(folder)
    method, cache = find_method(f"hf:{folder}"), PriorCache()
    prediction = method.run(sample, Settings(), cache)
    assert method.title == "tiny-model" and not method.uses_prior
    assert (prediction.depth_m is not None) == metric
    assert prediction.space == ("depth" if metric else "disparity")
    assert prediction.relative.shape == SHAPE and np.isfinite(prediction.relative).all()
    if metric:
        assert (prediction.depth_m > 0).all() and (prediction.depth_m < 10).all()
    assert cache.depth_model(str(folder), Settings()) is cache.depth_model(str(folder), Settings())
    before = method.configuration(Settings())
    (folder / "note.txt").write_text("trained further")
    assert method.configuration(Settings()) != before


def test_depth_model_needs_a_name():
    with pytest.raises(ValueError, match="hf:MODEL"):
        find_method("hf:")


def test_families_are_not_taken_for_methods_with_a_prior(tmp_path):
    folder = tmp_path / "maps@work"
    folder.mkdir()
    assert find_method(f"files:{folder}").title == "maps@work"
    numbered = tmp_path / "maps#3"
    numbered.mkdir()
    assert find_method(f"files:{numbered}").seed is None
    assert find_method("guided:inner_steps=1@org/other").prior == "org/other"
    bound = find_method("guided:inner_steps=1@org/other#3")
    assert (bound.prior, bound.seed) == ("org/other", 3) and find_method(bound.name).name == bound.name
    assert bound.base_name == "guided:inner_steps=1" and bound.seedless_name == f"{bound.base_name}@org/other"
    own = bound.own_settings(Settings(seed=1, ensemble=2))
    assert own == Settings("org/other", seed=3, ensemble=2)
    assert find_method("guided@folder#a").prior == "folder#a"
    assert set(FAMILIES) == {"guided", "paper", "hf", "files", "prior-map"}


class OnePipe(PriorCache):
    """A cache that holds one pipeline, whatever it is asked for."""

    def __init__(self, pipe):
        super().__init__()
        self._pipe = enable_geometry_guidance(pipe)

    def get(self, settings):
        return self._pipe


def plane_sample(pair) -> StereoSample:
    valid = np.ones(pair.depth_m.shape, bool)
    views = (pair.left, pair.right, pair.K, pair.K, pair.E)
    return StereoSample("folder", "plane", *views, pair.depth_m, valid, rectified=True)


@pytest.mark.parametrize(("steps", "updates"), [(None, 4), (2, 2)])
def test_no_diffusion_makes_the_updates_of_the_default_without_the_network(
    make_pipeline, textured_plane, monkeypatch, steps, updates
):
    pipe, counted, stock = make_pipeline(), [], Objective.__call__
    monkeypatch.setattr(Objective, "__call__", lambda s, *args: counted.append(args[4]) or stock(s, *args))
    monkeypatch.setattr(pipe.unet, "forward", None)
    # The method with fewer updates a round, for the sake of time.
    short = constant_method(
        "short",
        "short",
        "short",
        partial(GeometryGuidance, inner_steps=3, correct=False),
        constant._ramp,
    )
    prediction = short.run(plane_sample(textured_plane), Settings(steps=steps), OnePipe(pipe))
    assert prediction.depth_m.shape == textured_plane.depth_m.shape and (prediction.depth_m > 0).all()
    assert len(counted) == updates * 3
    # Every update is anchored to the latent of the ramp.
    ramp = torch.linspace(1, -1, counted[0].shape[-2] * 2).view(1, 1, -1, 1).expand(1, 3, -1, 64)
    with torch.no_grad():
        latent = pipe.vae.encode(ramp).latent_dist.mode() * pipe.vae.config.scaling_factor
    for anchor in counted:
        torch.testing.assert_close(anchor, latent)


def test_reprojection_only_starts_from_the_map_of_the_prior_and_moves_its_pixels(
    make_oracle, textured_plane, monkeypatch
):
    depth_m = textured_plane.depth_m
    relative = (depth_m - depth_m.min()) / (depth_m.max() - depth_m.min())
    seen, stock = [], Objective.__call__
    monkeypatch.setattr(Objective, "__call__", lambda self, x, *args: seen.append(x) or stock(self, x, *args))
    sample = plane_sample(textured_plane)
    prediction = METHODS["reprojection-only"].run(sample, Settings(), OnePipe(make_oracle(relative)))
    assert len(seen) == 50
    torch.testing.assert_close(seen[0][0, 0].detach(), torch.from_numpy(relative), atol=1e-5, rtol=0)
    moved = (seen[-1] - seen[0]).abs()
    assert 0.01 < moved.max() and (moved > 0).float().mean() > 0.9
    assert np.median(np.abs(prediction.depth_m / depth_m - 1)) < 0.05


def written_pair(folder, right_shape=SHAPE):
    """Two grey images of one camera, 0.2 m apart, in the layout of own pairs."""
    folder.mkdir(parents=True)
    Image.new("RGB", SHAPE[::-1]).save(folder / "left.png")
    Image.new("RGB", right_shape[::-1]).save(folder / "right.png")
    (folder / "calib.txt").write_text(
        "cam0=[30 0 23.5; 0 30 15.5; 0 0 1]\ncam1=[30 0 23.5; 0 30 15.5; 0 0 1]\ndoffs=0\nbaseline=200\n"
        f"width={SHAPE[1]}\nheight={SHAPE[0]}\n"
    )
    return folder


@pytest.mark.parametrize("missing", ["left.png", "right.png", "calib.txt"])
def test_an_own_pair_with_a_missing_file_is_no_silent_gap(tmp_path, missing):
    (written_pair(tmp_path / "data" / "one") / missing).unlink()
    (ref,) = find_folder(tmp_path / "data")
    with pytest.raises(FileNotFoundError, match=missing):
        load_folder(ref)


def test_a_folder_that_is_no_pair_is_none(tmp_path):
    folder = written_pair(tmp_path / "data" / "one")
    (folder / "left.png").unlink()
    (folder / "right.png").unlink()
    assert find_folder(tmp_path / "data") == []


def test_own_right_images_have_the_size_of_their_calibration(tmp_path):
    (ref,) = find_folder(written_pair(tmp_path / "data" / "one", (40, 56)).parent)
    with pytest.raises(ValueError, match="calib.txt must be for 56 x 40 pixels as the right image"):
        load_folder(ref)


def test_sgbm_does_not_apply_to_views_of_different_sizes():
    sample = make_sample()
    with pytest.raises(NotApplicable, match="different sizes"):
        run("sgbm", replace(sample, right=sample.right[:16]))


def test_a_coarse_grid_is_read_at_the_nearest_of_its_pixels():
    """Four cells over six pixels, which have their centres at 0.33, 1, 1.67, ... cells from the edge."""
    volume = SimpleNamespace(plane_step=torch.tensor(0.001))
    found = native_depth(torch.tensor([[1.0, 2.0, 3.0, 4.0]]), volume, (1, 6), "nearest-exact")
    np.testing.assert_allclose(1.0 / found[0], [1, 2, 2, 3, 4, 4])
