"""Depth models of ``transformers``: what each class says, how its map lies on the image, and its folders."""

import json
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import PretrainedConfig, PreTrainedModel
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

from geodiff_plugin.priors import find_prior, load_prior, prior_of
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.transformers_depth import NO_DEPTH, TransformersDepthPipeline, output_of
from tests.contracts.tiny_transformers import MODELS, make_transformers

OUTPUTS = {
    "depth_anything": ("disparity", False),
    "dpt": ("disparity", False),
    "glpn": ("depth", True),
    "zoedepth": ("depth", True),
    "depth_pro": ("disparity", True),
    "prompt_depth_anything": ("depth", False),
    "tipsv2": ("depth", True),
}


def ramps(height: int, width: int) -> torch.Tensor:
    """``(1, 3, H, W)``, smooth, different everywhere."""
    rows, columns = torch.linspace(0, 1, height)[:, None], torch.linspace(0, 1, width)
    red = 0.25 + 0.25 * rows + 0.4 * columns**2
    return torch.stack([red, red.flip(0), red.flip(1)])[None]


def save_as_transformers(pipe, folder) -> None:
    """The folder that a user has from the hub."""
    pipe.model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(dict(pipe.config.preparation)))


class Echo(PreTrainedModel):
    """A network whose depth is the red channel that it is given, and that may know its field of view."""

    config_class = PretrainedConfig

    def __init__(self, **more) -> None:
        super().__init__(PretrainedConfig())
        self.register_parameter("nothing", torch.nn.Parameter(torch.zeros(1)))
        self.more = more

    def forward(self, pixel_values):
        return SimpleNamespace(predicted_depth=pixel_values[:, 0], **self.more)


def echo(kind, space="depth", model=None, **options):
    told = {"image_processor_type": f"{kind}ImageProcessor", "image_mean": [0] * 3, "image_std": [1] * 3}
    return TransformersDepthPipeline(model or Echo(), DirectScheduler(0), told | options, space)


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("DPT", {"size": 64}),
        ("DPT", {"size": 70, "ensure_multiple_of": 14}),
        ("DPT", {"do_resize": False, "do_pad": True, "size_divisor": 14}),
        ("GLPN", {}),
        ("ZoeDepth", {"ensure_multiple_of": 32}),
        ("DepthPro", {"size": {"height": 96, "width": 96}}),
    ],
)
@pytest.mark.parametrize("size", [(75, 113), (60, 40)])
def test_the_map_lies_over_the_image_whatever_was_padded(kind, options, size):
    image = ramps(75, 113)
    values = echo(kind, **options).predict(image, size)
    wanted = torch.nn.functional.interpolate(image[:, :1], size, mode="bilinear", antialias=True)
    # ZoeDepth's library aligns corners on the way in and not on the way out: up to half a pixel.
    torch.testing.assert_close(values, wanted, rtol=0, atol=0.02)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("layout_of", ["transformers", "ours"])
def test_both_layouts_load_and_answer_the_same(kind, layout_of, tmp_path):
    pipe, image = make_transformers(kind), ramps(40, 52)
    assert output_of(pipe.model) == OUTPUTS[kind]
    before = pipe(image, output_type="pt", processing_resolution=64).prediction
    save_as_transformers(pipe, tmp_path) if layout_of == "transformers" else pipe.save_pretrained(tmp_path)
    assert find_prior(tmp_path).key == "transformers"
    loaded = load_prior(tmp_path)
    loaded.set_progress_bar_config(disable=True)
    resolution = 64 if layout_of == "transformers" else None  # which only ours remembers
    after = loaded(image, output_type="pt", processing_resolution=resolution).prediction
    torch.testing.assert_close(after, before)
    prior = prior_of(loaded)
    assert (prior.space, prior.max_steps, prior.deterministic) == (OUTPUTS[kind][0], 1, True)
    assert before.std() > 1e-3 and loaded.metric == OUTPUTS[kind][1]


def test_every_class_of_the_library_is_guided_or_refused():
    guided = {type(MODELS[kind]()[0]).__name__ for kind in MODELS}
    assert guided | {NO_DEPTH} == set(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values())
    with pytest.raises(ValueError, match="height of trees"):
        echo("GLPN", model=type(NO_DEPTH, (Echo,), {})())


def test_a_space_that_the_user_says_wins_and_an_unknown_class_needs_one():
    assert echo("GLPN").config.prediction_type == "depth"
    said = echo("GLPN", "disparity", MODELS["glpn"]()[0])
    assert said.config.prediction_type == "disparity" and not said.metric
    for space, sentence in ((None, "--space"), ("log", "space must be one of")):
        with pytest.raises(ValueError, match=sentence):
            echo("GLPN", space)


def test_missing_weights_are_listed_but_for_those_that_nothing_reads(tmp_path):
    pipe, file = make_transformers("dpt"), tmp_path / "model.safetensors"
    pipe.model.save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="preprocessor_config"):
        load_prior(tmp_path)
    save_as_transformers(pipe, tmp_path)
    kept = {k: v for k, v in load_file(file).items() if "fusion_stage.layers.0.residual_layer1." not in k}
    save_file(kept, file, metadata={"format": "pt"})
    load_prior(tmp_path)  # as Intel/dpt-large comes
    kept.pop("head.head.0.bias")
    save_file(kept, file, metadata={"format": "pt"})
    with pytest.raises(ValueError, match=r"missing: head\.head\.0\.bias"):
        load_prior(tmp_path)
    file.rename(tmp_path / "pytorch_model.bin")
    with pytest.raises(ValueError, match="geodiff convert"):
        load_prior(tmp_path)
