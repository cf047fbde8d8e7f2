from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES

from geodiff_plugin.priors import PRIORS, find_adapter
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.hf_model import NO_DEPTH, DepthMap, HFDepthModel, Preparation, output_of
from geodiff_plugin.priors.transformers_depth import TransformersDepthPrior, unit_range
from tests.contracts.tiny_transformers import MODELS, depth_anything, make_transformers

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


def save_as_transformers(pipe, folder: Path) -> None:
    """The folder that a user has from the hub."""
    pipe.model.save_pretrained(folder)
    (folder / "preprocessor_config.json").write_text(json.dumps(dict(pipe.config.preparation)))


class Echo:
    """A network whose depth is the red channel that it is given."""

    dtype = torch.float32

    def __call__(self, pixel_values):
        return SimpleNamespace(predicted_depth=pixel_values[:, 0])


ECHOES = {
    "dpt": {"image_processor_type": "DPTImageProcessor", "size": 64},
    "patches": {"image_processor_type": "DPTImageProcessor", "size": 70, "ensure_multiple_of": 14},
    "padded": {
        "image_processor_type": "DPTImageProcessor",
        "do_resize": False,
        "do_pad": True,
        "size_divisor": 14,
    },
    "glpn": {"image_processor_type": "GLPNImageProcessor"},
    "zoedepth": {"image_processor_type": "ZoeDepthImageProcessor", "ensure_multiple_of": 32},
    "depth pro": {"image_processor_type": "DepthProImageProcessorFast", "size": {"height": 96, "width": 96}},
}


@pytest.mark.parametrize("name", ECHOES)
@pytest.mark.parametrize("size", [None, (75, 113), (60, 40)])
def test_the_map_lies_over_the_image_whatever_was_padded(name, size):
    config = {"image_mean": [0, 0, 0], "image_std": [1, 1, 1], **ECHOES[name]}
    model = HFDepthModel(Echo(), Preparation.from_config(config), space="depth")
    image = ramps(75, 113)
    found = model(image, size=size).values
    expected = model.grid(75, 113) if size is None else size
    assert tuple(found.shape[-2:]) == tuple(expected)
    wanted = torch.nn.functional.interpolate(image[:, :1], expected, mode="bilinear", antialias=True)
    # ZoeDepth's library aligns corners on the way in and not on the way out: up to half a pixel.
    torch.testing.assert_close(found, wanted, rtol=0, atol=0.02)


@pytest.mark.parametrize("kind", MODELS)
@pytest.mark.parametrize("layout_of", ["transformers", "ours"])
def test_both_layouts_load_and_answer_the_same(kind, layout_of, tmp_path):
    pipe = make_transformers(kind)
    image = ramps(40, 52)
    before = pipe(image, output_type="pt", processing_resolution=64).prediction
    save_as_transformers(pipe, tmp_path) if layout_of == "transformers" else pipe.save_pretrained(tmp_path)
    layout = Layout(tmp_path, "tiny")
    assert [key for key, prior in PRIORS.items() if prior.recognises(layout)] == ["transformers"]
    loaded = TransformersDepthPrior.load(layout, torch.float32, None)
    loaded.set_progress_bar_config(disable=True)
    resolution = 64 if layout_of == "transformers" else None  # which only ours remembers
    after = loaded(image, output_type="pt", processing_resolution=resolution).prediction
    torch.testing.assert_close(after, before)
    prior = find_adapter(loaded)(loaded)
    assert (prior.space, prior.max_steps, prior.deterministic) == (OUTPUTS[kind][0], 1, True)
    assert before.std() > 1e-3


@pytest.mark.parametrize("kind", MODELS)
def test_what_each_class_predicts(kind):
    assert output_of(MODELS[kind]()[0]) == OUTPUTS[kind]


def test_every_class_of_the_library_is_guided_or_refused():
    guided = {type(MODELS[kind]()[0]).__name__ for kind in MODELS}
    assert guided | set(NO_DEPTH) == set(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values())


@pytest.mark.parametrize("space", [None, "depth"])
def test_canopy_height_is_refused_with_the_reason(space):
    class CHMv2ForDepthEstimation(Echo):
        config = None

    preparation = Preparation.from_config({"image_processor_type": "GLPNImageProcessor"})
    with pytest.raises(ValueError, match="height of trees"):
        HFDepthModel(CHMv2ForDepthEstimation(), preparation, space)


def test_a_folder_of_canopy_height_is_refused_before_its_image_processor(tmp_path):
    (tmp_path / "config.json").write_text(
        '{"architectures": ["CHMv2ForDepthEstimation"], "model_type": "dpt"}'
    )
    (tmp_path / "preprocessor_config.json").write_text('{"image_processor_type": "CHMv2ImageProcessor"}')
    with pytest.raises(ValueError, match="height of trees"):
        HFDepthModel.from_pretrained(tmp_path)


def test_depth_pro_without_its_field_of_view_is_relative():
    model = MODELS["depth_pro"]()[0]
    model.config.use_fov_model = False
    assert output_of(model) == ("disparity", False)


def test_metric_depth_anything_and_dinov2s_dpt_give_metres():
    assert output_of(depth_anything("metric")[0]) == ("depth", True)
    model = MODELS["dpt"]()[0]
    model.config.add_projection = True
    assert output_of(model) == ("depth", True)


def test_a_space_that_the_user_says_wins_and_an_unknown_class_needs_one():
    class Unheard(torch.nn.Module):
        config = None

    preparation = Preparation.from_config({"image_processor_type": "GLPNImageProcessor"})
    with pytest.raises(ValueError, match="--space"):
        HFDepthModel(Unheard(), preparation)
    assert HFDepthModel(Unheard(), preparation, space="depth").space == "depth"
    assert HFDepthModel(MODELS["dpt"]()[0], preparation, space="depth").space == "depth"


def test_depth_pro_gives_inverse_metres_by_its_own_field_of_view():
    class Camera(Echo):
        def __call__(self, pixel_values):
            output = super().__call__(pixel_values)
            output.field_of_view = torch.tensor([90.0])  # width over focal length is 2
            return output

    config = ECHOES["depth pro"] | {"image_mean": [0] * 3, "image_std": [1] * 3, "size": 16}
    model = HFDepthModel(Camera(), Preparation.from_config(config), space="disparity")
    values = model(torch.full((1, 3, 16, 16), 0.25)).values
    torch.testing.assert_close(values, torch.full_like(values, 0.5))
    torch.testing.assert_close(DepthMap(values, "disparity", True).metres(), torch.full_like(values, 2.0))


def test_a_relative_map_has_no_metres():
    with pytest.raises(ValueError, match="relative"):
        DepthMap(torch.ones(1, 1, 2, 2), "disparity", False).metres()


def test_unit_range_keeps_the_low_end_and_is_not_led_by_a_stray_pixel():
    values = torch.linspace(3, 5, 1000).view(1, 1, 20, 50).clone()
    values[0, 0, -1, -1] = 1e6
    ranged = unit_range(values)
    assert ranged.min() == 0 and 0.97 < ranged.flatten()[:-1].max() < 1.05
    assert (unit_range(torch.full((1, 1, 4, 4), 7.0)) == 0).all()


def test_processors_and_resamplings_that_are_not_known_are_refused():
    with pytest.raises(ValueError, match="image_processor_type"):
        Preparation.from_config({"image_processor_type": "CLIPImageProcessor"})
    with pytest.raises(ValueError, match="resample"):
        Preparation.from_config({"image_processor_type": "GLPNImageProcessor", "resample": 0})
    with pytest.raises(ValueError, match="size"):
        Preparation.from_config({"image_processor_type": "DPTImageProcessor", "size": {"shortest_edge": 9}})


def test_an_image_smaller_than_a_patch_is_refused():
    preparation = Preparation.from_config({"image_processor_type": "GLPNImageProcessor"})
    with pytest.raises(ValueError, match="patch"):
        preparation(torch.zeros(1, 3, 20, 90))


def test_missing_weights_are_listed_but_for_those_that_nothing_reads(tmp_path):
    save_as_transformers(make_transformers("dpt"), tmp_path)
    weights = load_file(tmp_path / "model.safetensors")
    unread = [name for name in weights if "fusion_stage.layers.0.residual_layer1." in name]
    kept = {name: v for name, v in weights.items() if name not in unread}
    save_file(kept, tmp_path / "model.safetensors", metadata={"format": "pt"})
    HFDepthModel.from_pretrained(tmp_path)  # as Intel/dpt-large comes
    kept.pop("head.head.0.bias")
    save_file(kept, tmp_path / "model.safetensors", metadata={"format": "pt"})
    with pytest.raises(ValueError, match=r"missing: head\.head\.0\.bias"):
        HFDepthModel.from_pretrained(tmp_path)


def test_a_folder_that_lacks_a_file_is_refused_by_its_name(tmp_path):
    pipe = make_transformers("dpt")
    pipe.model.save_pretrained(tmp_path)
    with pytest.raises(ValueError, match="preprocessor_config"):
        TransformersDepthPrior.load(Layout(tmp_path, "tiny"), torch.float32, None)
    save_as_transformers(pipe, tmp_path)
    (tmp_path / "model.safetensors").rename(tmp_path / "pytorch_model.bin")
    with pytest.raises(ValueError, match="geodiff convert"):
        TransformersDepthPrior.load(Layout(tmp_path, "tiny"), torch.float32, None)
