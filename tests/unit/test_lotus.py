"""Lotus beside parity: which folder and name is what, what is drawn, and how its maps lie on the image."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from diffusers import PNDMScheduler
from safetensors.torch import load_file, save_file

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.lotus import LotusImageProcessor, LotusPipeline, LotusPrior, space_of_name
from tests.conftest import make_unet
from tests.contracts.tiny_lotus import make_lotus


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 255, (44, 60, 3), dtype=np.uint8)


def seeded(seed):
    return torch.Generator().manual_seed(seed)


def save_as_the_authors(pipe: LotusPipeline, folder) -> None:
    """Rewrite a saved folder as diffusers 0.28 and transformers 4.40 wrote the authors'."""
    pipe.save_pretrained(folder)
    PNDMScheduler(steps_offset=1, skip_prk_steps=True).save_pretrained(folder / "scheduler")
    index = json.loads((folder / "model_index.json").read_text())
    for name in ("prediction_type", "default_denoising_steps", "default_processing_resolution"):
        del index[name]
    index |= {name: [None, None] for name in ("feature_extractor", "image_encoder", "safety_checker")}
    index |= {"_class_name": "LotusGPipeline", "_diffusers_version": "0.28.0"}
    index |= {"scheduler": ["diffusers", "PNDMScheduler"], "requires_safety_checker": False}
    (folder / "model_index.json").write_text(json.dumps(index))
    weights = folder / "text_encoder" / "model.safetensors"
    prefixed = {f"text_model.{k.removeprefix('text_model.')}": v for k, v in load_file(weights).items()}
    save_file(prefixed, weights, metadata={"format": "pt"})


@pytest.mark.parametrize(
    ("name", "space"),
    [
        ("jingheya/lotus-depth-g-v1-0", "depth"),
        ("jingheya/lotus-depth-d-v1-0", "depth"),
        ("jingheya/lotus-depth-g-v2-1-disparity", "disparity"),
        ("jingheya/lotus-depth-d-v2-0-disparity", "disparity"),
        ("/disparity/lotus-depth-d-v1-0", "depth"),
        ("hub/models--jingheya--lotus-depth-d-v2-0-disparity/snapshots/1a2b", "disparity"),
    ],
)
def test_the_name_tells_the_space(name, space):
    assert space_of_name(name) == space


@pytest.mark.parametrize("name", ["my/finetune", "checkpoints/lotus", "some-disparity-model"])
def test_an_unknown_space_is_an_error_that_names_the_option(name):
    with pytest.raises(ValueError, match="--space"):
        space_of_name(name)


def test_normals_are_refused():
    with pytest.raises(ValueError, match="normals"):
        space_of_name("jingheya/lotus-normal-g-v1-1")


@pytest.mark.parametrize("kind", ["g", "d"])
def test_the_authors_folder_loads(kind, tmp_path, image):
    pipe = make_lotus(kind)
    folder = tmp_path / f"lotus-depth-{kind}-v1-0"
    save_as_the_authors(pipe, folder)
    layout = Layout(folder, str(folder))
    assert LotusPrior.recognises(layout)
    loaded = LotusPrior.load(layout, torch.float32, None)
    loaded.set_progress_bar_config(disable=True)
    assert loaded.config.prediction_type == "depth"
    maps = [p(image, processing_resolution=64, generator=seeded(0)).prediction for p in (pipe, loaded)]
    np.testing.assert_allclose(*maps, rtol=0, atol=1e-5)
    said = LotusPrior.load(layout, torch.float32, "disparity")
    assert LotusPrior(said).space == "disparity"
    plain = LotusPipeline.from_pretrained(folder, prediction_type="depth", local_files_only=True)
    assert plain.scheduler.config.timestep == 999


def test_other_unets_are_not_taken_for_lotus(tmp_path):
    make_unet().save_pretrained(tmp_path / "unet")
    assert not LotusPrior.recognises(Layout(tmp_path, "lotus-depth-g-v1-0"))
    with pytest.raises(ValueError, match="class embedding"):
        LotusPipeline(make_unet(), None, None, None, None, prediction_type="depth")
    with pytest.raises(ValueError, match="disparity versions"):
        LotusPipeline(make_unet(), None, None, None, None)


@pytest.mark.parametrize("kind", ["g", "d"])
def test_the_image_latent_is_drawn_from_the_generator(kind, image):
    pipe = make_lotus(kind)
    first, again, other = (pipe(image, generator=seeded(s), output_latent=True).latent for s in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    members = pipe(image, generator=seeded(0), ensemble_size=2, output_latent=True).latent
    assert not torch.equal(members[0], members[1])


def test_g_sees_its_noise_and_d_has_none():
    padded = torch.rand(1, 3, 40, 64) * 2 - 1
    for kind in ("g", "d"):
        pipe = make_lotus(kind)
        condition = pipe.prepare_condition(padded, 1, 1, seeded(0))
        z = pipe.prepare_latents(condition, seeded(1))
        moved = pipe.denoise(z + 0.1, torch.tensor(999), condition) - pipe.denoise(
            z, torch.tensor(999), condition
        )
        assert bool(moved.abs().max() > 0) == pipe.sees_latents == (kind == "g")
        assert bool(z.abs().max() > 0) == (kind == "g")


def test_the_relative_map_lies_pixel_to_pixel_on_an_image_of_odd_size(image):
    pipe = make_lotus("d")
    out = pipe(image[:43, :59], processing_resolution=0, match_input_resolution=False, output_latent=True)
    assert out.prediction.shape == (1, 40, 56, 1)  # theirs: whole cells, to be stretched
    x = _guided(enable_geometry_guidance(pipe), image[:43, :59]).relative
    assert x.shape == (1, 43, 59, 1)
    np.testing.assert_array_equal(x[:, 40:], x[:, 39:40].repeat(3, 1))
    np.testing.assert_array_equal(x[:, :, 56:], x[:, :, 55:56].repeat(3, 2))


def _guided(pipe, image, callback=None):
    """Without updates, at the image's own size."""
    camera = np.array([[60.0, 0, 29.5], [0, 60.0, 21.5], [0, 0, 1]])
    guidance = GeometryGuidance.from_points(
        np.array([[0.1, 0.1, 2.0], [0.2, 0.0, 3.0]]), camera, inner_steps=0, correct=False, refine=False
    )
    call = {"processing_resolution": 0, "match_input_resolution": False, "generator": seeded(0)}
    return pipe(image, guidance=guidance, callback_on_step_end=callback, **call)


@pytest.mark.parametrize("other", [(41, 60), (64, 64)])
def test_a_call_of_another_size_within_a_guided_one_changes_nothing(image, other):
    pipe = enable_geometry_guidance(make_lotus("d"))
    alone = _guided(pipe, image[:43, :59])
    another = np.resize(image, (*other, 3))
    beside = _guided(
        pipe, image[:43, :59], lambda p, *_: p(another, processing_resolution=0, generator=seeded(1)) and None
    )
    np.testing.assert_array_equal(alone.prediction, beside.prediction)


@pytest.mark.parametrize("kind", ["g", "d"])
def test_the_layout_of_a_tensor_changes_nothing(kind):
    pipe = make_lotus(kind)
    plain = torch.rand(1, 3, 96, 128, generator=seeded(0))
    maps = [
        pipe(x, generator=seeded(0), processing_resolution=0).prediction
        for x in (plain, plain.to(memory_format=torch.channels_last))
    ]
    np.testing.assert_array_equal(*maps)


def test_sides_are_rounded_as_the_authors_do():
    wide = torch.zeros(1, 1, 8, 1226)
    assert LotusImageProcessor.resize_to_max_edge(wide, 768, "bilinear").shape == (1, 1, 5, 767)
    with pytest.raises(ValueError, match="aspect"):
        LotusImageProcessor.resize_to_max_edge(wide, 64, "bilinear")


def test_d_is_guided_on_an_image_of_odd_size(textured_plane):
    pair, losses = textured_plane, []
    pipe = enable_geometry_guidance(make_lotus("d"))
    fast = {"inner_steps": 3, "min_steps": 2, "loss_resolution": 64, "refine": False, "correct": False}
    for steps in ({"step_latents": 0.0, "step_affine": 0.0}, {}):
        guidance = GeometryGuidance(pair.right[:45], pair.K, pair.E, **fast, **steps)
        out = pipe(pair.left[:45], guidance=guidance, generator=seeded(0))
        losses.append(float(out.history[-1].loss))
    assert out.prediction.shape == (1, 45, 64, 1)
    assert np.isfinite(out.prediction).all() and (out.prediction > 0).all()
    assert losses[1] < losses[0]
