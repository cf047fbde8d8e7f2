"""Preparation of images for depth models of ``transformers``, and metric ranges, against references."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from transformers import (
    AutoModelForDepthEstimation,
    DPTImageProcessorPil,
    GLPNImageProcessorPil,
    PretrainedConfig,
    PreTrainedModel,
)
from transformers.models.auto.modeling_auto import MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES
from transformers.models.prompt_depth_anything.image_processing_pil_prompt_depth_anything import (
    PromptDepthAnythingImageProcessorPil,
)
from transformers.models.zoedepth.image_processing_pil_zoedepth import ZoeDepthImageProcessorPil

from geodiff_plugin.priors import find_prior, load_prior, prior_of
from geodiff_plugin.priors import transformers_depth as module
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.transformers_depth import (
    NO_DEPTH,
    Preparation,
    TransformersDepthPipeline,
    output_of,
    range_of,
    unit_range,
)
from tests.contracts.tiny_transformers import MODELS, make_transformers


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(0)


def prepare(kind, suffix="ImageProcessor", **options):
    return Preparation({"image_processor_type": f"{kind}{suffix}"} | options)


@pytest.mark.parametrize(
    ("kind", "options", "size", "expected"),
    [
        ("DPT", {}, (480, 640), (384, 384)),
        ("DPT", {"size": {"height": 100, "width": 200}}, (480, 640), (100, 200)),
        # The side that changes least decides: 518 / 640 is nearer to 1 than 518 / 400.
        ("DPT", {"size": 518, "keep_aspect_ratio": True, "ensure_multiple_of": 14}, (400, 640), (322, 518)),
        ("DPT", {"size": 518, "keep_aspect_ratio": True, "ensure_multiple_of": 14}, (500, 900), (518, 938)),
        ("DPT", {"size": 518, "keep_aspect_ratio": True, "ensure_multiple_of": 14}, (900, 500), (938, 518)),
        ("DPT", {"do_resize": False}, (75, 113), (75, 113)),
        ("GLPN", {}, (75, 113), (64, 96)),
        ("DepthPro", {}, (75, 113), (1536, 1536)),
        ("Tipsv2Dpt", {}, (75, 113), (448, 448)),
        (
            "PromptDepthAnything",
            {"size": 756, "keep_aspect_ratio": True, "ensure_multiple_of": 14},
            (480, 640),
            (560, 756),
        ),
        ("ZoeDepth", {"do_pad": False, "ensure_multiple_of": 32}, (480, 640), (384, 512)),
    ],
)
def test_the_network_sees_images_in_its_own_size(kind, options, size, expected):
    image = torch.rand(1, 3, *size, generator=torch.Generator().manual_seed(0))
    if kind == "DepthPro":
        assert prepare(kind, **options)._grid(*size) == ((0, 0), expected, [0, 0, 0, 0])
    else:
        assert tuple(prepare(kind, **options)(image).shape[-2:]) == expected


def test_normalisation_is_by_channel_and_what_is_padded_is_zero_after_it():
    mean, std = [0.1, 0.2, 0.3], [0.5, 0.25, 2.0]
    image = torch.rand(2, 3, 20, 30)
    reported = {"do_resize": False, "image_mean": mean, "image_std": std}
    shape = (1, 3, 1, 1)
    expected = (image - torch.tensor(mean).view(shape)) / torch.tensor(std).view(shape)
    torch.testing.assert_close(prepare("DPT", **reported)(image), expected)
    padded = prepare("DPT", **reported, do_pad=True, size_divisor=16)(image)
    assert padded.shape[-2:] == (32, 32)
    torch.testing.assert_close(padded[..., 6:26, 1:31], expected)
    padded[..., 6:26, 1:31] = 0
    assert not padded.any()
    assert prepare("GLPN", **reported, do_pad=True)(image).shape[-2:] == (20, 30)
    torch.testing.assert_close(prepare("GLPN", do_resize=False)(image), image)  # not normalised
    half = prepare("DPT", do_resize=False)(image)
    torch.testing.assert_close(half, 2 * image - 1)


def test_zoedepth_reflects_a_border_whose_width_grows_with_the_root_of_the_side():
    image = torch.rand(1, 3, 40, 60)
    reported = {"do_resize": False, "do_normalize": False}
    padded = prepare("ZoeDepth", **reported)(image)
    rows, columns = int(np.sqrt(20) * 3), int(np.sqrt(30) * 3)
    expected = np.pad(image[0].numpy(), ((0, 0), (rows, rows), (columns, columns)), mode="reflect")
    np.testing.assert_array_equal(padded[0], expected)
    values = torch.from_numpy(expected[:1])[None]
    back = prepare("ZoeDepth", **reported).remove_padding(values, 40, 60)
    torch.testing.assert_close(back, image[:, :1], atol=1e-5, rtol=0)
    assert prepare("ZoeDepth", **reported, do_pad=False)(image).shape[-2:] == (40, 60)


def test_maps_lose_what_was_padded_asymmetrically_and_others_stay():
    own = prepare("DPT", do_resize=False, do_pad=True, size_divisor=16)
    values = torch.rand(2, 1, 32, 48)
    torch.testing.assert_close(own.remove_padding(values, 27, 45), values[..., 2:29, 1:46])
    half = torch.nn.functional.avg_pool2d(values, 2)
    found = own.remove_padding(half, 27, 45)
    assert found.shape == (2, 1, 27, 45)
    wanted = torch.nn.functional.interpolate(half, (32, 48), mode="bicubic")[..., 2:29, 1:46]
    torch.testing.assert_close(found, wanted)
    assert prepare("DPT").remove_padding(values, 27, 45) is values


def test_processors_go_by_any_of_their_names_and_bad_files_are_named():
    for suffix in ("ImageProcessor", "ImageProcessorFast", "FeatureExtractor", "ImageProcessorPil"):
        assert prepare("DPT", suffix).kind == "DPT"
    assert Preparation({"feature_extractor_type": "GLPNFeatureExtractor"}).options["size_divisor"] == 32
    assert prepare("DPT", resample=None).options["resample"] == 3 and prepare("GLPN").options["resample"] == 2
    for options, words in (
        ({"image_processor_type": "ViTImageProcessor"}, "image_processor_type .*DPTImageProcessor.*got ViT"),
        ({"image_processor_type": "DPTImageProcessor", "resample": 0}, "resample .* 2 .* or 3"),
        (
            {"image_processor_type": "DPTImageProcessor", "size": {"shortest_edge": 3}},
            "size .* height and a width",
        ),
    ):
        with pytest.raises(ValueError, match=words):
            Preparation(options)
    with pytest.raises(
        ValueError, match="image must be at least as large as a patch of the network; got 31x40"
    ):
        prepare("GLPN")(torch.rand(1, 3, 40, 31))


def test_the_range_of_each_map_is_its_least_value_and_98_percent_quantile():
    maps = np.random.default_rng(0).gamma(2.0, size=(3, 1, 30, 40)).astype(np.float32) * [
        [[[1]]],
        [[[9]]],
        [[[4]]],
    ]
    low, high = range_of(torch.from_numpy(maps))
    np.testing.assert_allclose(low, maps.min((1, 2, 3)))
    np.testing.assert_allclose(high, np.quantile(maps.reshape(3, -1), 0.98, axis=1))
    for given, found in zip(maps, unit_range(torch.from_numpy(maps)), strict=True):
        span = np.quantile(given, 0.98) - given.min()
        np.testing.assert_allclose(found, (given - given.min()) / span, rtol=1e-5, atol=1e-6)
    assert not unit_range(torch.full((2, 1, 4, 4), 7.0)).any()
    large = torch.arange(2_000_000.0).view(1, 1, 1000, 2000)
    # Of every second value, which are a million.
    assert float(range_of(large)[1]) == pytest.approx(0.98 * 1_999_998, abs=0.3)


class Echo(PreTrainedModel):
    """A network whose depth is ten times the red channel that it is given."""

    config_class = PretrainedConfig

    def __init__(self, **more) -> None:
        super().__init__(PretrainedConfig())
        self.register_parameter("nothing", torch.nn.Parameter(torch.zeros(1)))
        self.more, self.batches = more, []

    def forward(self, pixel_values, **reported):
        self.batches.append((len(pixel_values), reported))
        return SimpleNamespace(predicted_depth=10 * pixel_values[:, 0] + self.nothing, **self.more)


def make(kind="DPT", name="Echo", space="depth", metric=False, **more):
    reported = {"image_processor_type": f"{kind}ImageProcessor", "image_mean": [0] * 3, "image_std": [1] * 3}
    model = type(name, (Echo,), {})(**more)
    pipe = TransformersDepthPipeline(model, DirectScheduler(0), reported | {"do_resize": False}, space)
    pipe.metric = metric
    return pipe


@pytest.mark.parametrize("space", ["depth", "disparity"])
def test_a_metric_model_knows_the_metres_at_both_ends_of_every_map(space):
    pipe = make(space=space, metric=True)
    images = torch.rand(3, 3, 20, 30, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [0.3, 1.0, 0.6]
    ).view(3, 1, 1, 1)
    found = pipe.prepare_condition(2 * images - 1, 2, 2, None)["image_latent"]
    assert [count for count, _ in pipe.model.batches] == [2, 1] and found.shape == (6, 1, 20, 30)
    for i, red in enumerate(10 * images[:, 0].numpy()):
        ends = np.array([red.min(), np.quantile(red, 0.98)])
        metres = ends if space == "depth" else 1 / np.clip(ends, 1e-4, 1e4)
        for k in (2 * i, 2 * i + 1):
            np.testing.assert_allclose(pipe.metric_range[k], np.maximum(metres, 1e-3), rtol=1e-3)
            np.testing.assert_allclose(found[k, 0], (red - ends[0]) / (ends[1] - ends[0]), atol=1e-4)
    nearest_first = pipe.maps_of(slice(2, 4)).depth_range
    np.testing.assert_allclose(nearest_first[0], pipe.metric_range[2:4].min(1).values)
    np.testing.assert_allclose(nearest_first[1], pipe.metric_range[2:4].max(1).values)
    pipe.metric = False
    pipe.prepare_condition(2 * images - 1, 1, 1, None)
    assert pipe.metric_range is None and pipe.maps_of(slice(0, 1)).depth_range is None


def test_metres_of_inverse_metres_are_limited_at_both_ends():
    pipe = make(space="disparity")
    found = pipe.metres(torch.tensor([0.0, 1e-5, 0.5, 4.0, 1e6]))
    np.testing.assert_allclose(found, [1e4, 1e4, 2.0, 0.25, 1e-4], rtol=1e-6)
    values = torch.tensor([3.0, -1.0])
    assert make().metres(values) is values


def test_a_field_of_view_turns_canonical_into_metric_inverse_depth():
    fov = torch.tensor([90.0, 53.13010235])
    pipe = make(space="disparity", field_of_view=fov)
    image = torch.rand(2, 3, 16, 20)
    found = pipe.predict(image, (16, 20))
    # Times the width over the focal length, 2 tan(fov / 2): 2 and 1.
    torch.testing.assert_close(found, 10 * image[:, :1] * torch.tensor([2.0, 1.0]).view(2, 1, 1, 1))


@pytest.mark.parametrize(
    ("kind", "mode"), [("DPT", "bicubic"), ("DepthPro", "bilinear"), ("Tipsv2Dpt", "bilinear")]
)
def test_maps_are_resampled_to_the_image_as_by_the_library(kind, mode):
    pipe, image = make(kind), torch.rand(1, 3, 16, 20)
    wanted = torch.nn.functional.interpolate(10 * image[:, :1], (33, 27), mode=mode)
    torch.testing.assert_close(pipe.predict(image, (33, 27)), wanted)


def test_a_prompt_is_given_from_0_to_1_and_maps_come_back_in_its_metres():
    pipe = make("PromptDepthAnything", module.PROMPTED)
    images = torch.rand(3, 3, 16, 20) * 0.1
    prompt = 2 + 5 * torch.rand(3, 1, 4, 5)
    prompt[2] = 3.0
    found = pipe.prepare_condition(2 * images - 1, 1, 2, None, prompt_depth=prompt)
    given = torch.cat([reported["prompt_depth"] for _, reported in pipe.model.batches])
    low, high = prompt.amin((1, 2, 3)), prompt.amax((1, 2, 3))
    for i in range(2):
        torch.testing.assert_close(given[i], (prompt[i] - low[i]) / (high[i] - low[i]))
        red = 10 * images[i, 0].numpy() * float(high[i] - low[i]) + float(low[i])
        np.testing.assert_allclose(pipe.metric_range[i], [red.min(), np.quantile(red, 0.98)], rtol=1e-4)
    assert float(given[2, 0, 0, 0]) == 1.0 and not given[2, 0, 1:].any()  # a flat prompt has no span
    np.testing.assert_allclose(pipe.metric_range[2], 3.0, atol=1e-4)
    assert found["image_latent"].shape == (3, 1, 16, 20)
    for wrong in (prompt[:2], prompt[:, 0]):
        with pytest.raises(ValueError, match=r"prompt_depth must be \(3, 1, h, w\) metres"):
            pipe.prepare_condition(2 * images - 1, 1, 2, None, prompt_depth=wrong)
    with pytest.raises(ValueError, match="prompt_depth must be omitted with this model"):
        make().prepare_condition(2 * images - 1, 1, 3, None, prompt_depth=prompt)
    assert pipe.takes_prompt and not make().takes_prompt
    assert pipe.call_options() == ["prompt_depth"]


@pytest.mark.parametrize(
    "processor",
    [
        DPTImageProcessorPil,
        GLPNImageProcessorPil,
        PromptDepthAnythingImageProcessorPil,
        ZoeDepthImageProcessorPil,
    ],
)
def test_what_a_file_leaves_out_is_as_the_library_has_it(processor):
    theirs = processor().to_dict()
    found = Preparation({"image_processor_type": theirs["image_processor_type"]}).options
    for name in set(found) & set(theirs) - {"image_processor_type", "size"}:
        assert found[name] == theirs[name] or found[name] == tuple(theirs[name]), name
    size, theirs_size = found["size"], theirs.get("size")
    assert theirs_size in (size, {"height": size, "width": size})
    assert found["do_normalize"] == bool(theirs.get("do_normalize"))


@pytest.mark.parametrize(("kind", "size"), [("DepthPro", 1536), ("Tipsv2Dpt", {"height": 448, "width": 448})])
def test_processors_that_need_torchvision_have_the_sizes_of_their_papers(kind, size):
    options = prepare(kind).options
    half = (0.5, 0.5, 0.5)
    assert (options["size"], options["resample"], options["do_pad"]) == (size, 2, False)
    assert (options["image_mean"], options["image_std"]) == (half, half)
    assert options["do_normalize"] == (kind == "DepthPro") and not options["keep_aspect_ratio"]


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        ("DPT", {"antialias": True}),
        ("GLPN", {"antialias": True}),
        ("ZoeDepth", {"align_corners": True}),
        ("DepthPro", {}),
        ("Tipsv2Dpt", {"antialias": True}),
    ],
)
@pytest.mark.parametrize("resample", [2, 3])
def test_images_are_resized_as_each_library_does(kind, how, resample):
    """With antialiasing they are bytes, which cannot overshoot; the others' may."""
    image = (torch.rand(1, 3, 64, 80) > 0.5).float()
    options = {
        "size": {"height": 32, "width": 64},
        "do_normalize": False,
        "do_pad": False,
        "resample": resample,
    }
    options |= {"keep_aspect_ratio": False, "ensure_multiple_of": 1}
    size = (64, 64) if kind == "GLPN" else (32, 64)
    mode = {2: "bilinear", 3: "bicubic"}[resample]
    wanted = torch.nn.functional.interpolate(image, size, mode=mode, **how)
    assert resample == 2 or (wanted > 1).any()
    wanted = wanted.clamp(0, 1) if "antialias" in how else wanted
    torch.testing.assert_close(prepare(kind, **options)(image), wanted)


@pytest.mark.parametrize(
    ("name", "config", "output"),
    [
        ("DepthAnything", {"depth_estimation_type": "relative"}, ("disparity", False)),
        ("DepthAnything", {"depth_estimation_type": "metric"}, ("depth", True)),
        ("DPT", {"add_projection": False}, ("disparity", False)),
        ("DPT", {"add_projection": True}, ("depth", True)),
        ("DepthPro", {"use_fov_model": True}, ("disparity", True)),
        ("DepthPro", {"use_fov_model": False}, ("disparity", False)),
        ("PromptDepthAnything", {}, ("depth", False)),
        *((name, {}, ("depth", True)) for name in ("ZoeDepth", "GLPN", "Tipsv2Dpt")),
    ],
)
def test_what_a_class_predicts_is_known_and_a_saved_space_that_agrees_keeps_its_unit(name, config, output):
    model = type(f"{name}ForDepthEstimation", (Echo,), {})()
    for entry, value in config.items():
        setattr(model.config, entry, value)
    assert module.output_of(model) == output
    reported = {"image_processor_type": "GLPNImageProcessor"}
    other = {"depth": "disparity", "disparity": "depth"}[output[0]]
    for space, expected in ((None, output), (output[0], output), (other, (other, False))):
        pipe = TransformersDepthPipeline(model, DirectScheduler(0), reported, space)
        assert (pipe.space, pipe.metric) == expected and pipe.takes_prompt == name.startswith("Prompt")
    with pytest.raises(ValueError, match="space must be one of"):
        TransformersDepthPipeline(model, DirectScheduler(0), reported, "log")


def test_an_unknown_class_needs_a_space():
    with pytest.raises(
        ValueError, match=r"the prior must be a depth model with a known output space; got Echo"
    ):
        module.output_of(Echo())
    pipe = make(space="disparity")
    assert (pipe.space, pipe.metric, pipe.max_steps) == ("disparity", False, 1)


@pytest.mark.parametrize("file", module.PREPARATION_FILES)
@pytest.mark.parametrize("nested", [False, True])
def test_a_folder_of_the_hub_is_a_model_and_how_its_images_are_prepared(tmp_path, monkeypatch, file, nested):
    preparation = {"image_processor_type": "DPTImageProcessor", "size": 40}
    content = {"image_processor": preparation} if nested else preparation
    (tmp_path / file).write_text(json.dumps(content))
    (tmp_path / "config.json").write_text(json.dumps({"architectures": ["DPTForDepthEstimation"]}))
    layout, asked, model = Layout(tmp_path, "x"), [], Echo()
    monkeypatch.setattr(
        module, "load_component", lambda *given, **reported: asked.append((given, reported)) or model
    )
    pipe = TransformersDepthPipeline.load(layout, torch.float16, "disparity")
    assert asked == [((layout, "", AutoModelForDepthEstimation, torch.float16), {"unread": module.UNREAD})]
    assert pipe.model is model and not any(p.requires_grad for p in model.parameters())
    assert pipe.prepare.options["size"] == 40 and pipe.config.preparation == preparation
    assert (pipe.space, pipe.scheduler.timesteps.tolist()) == ("disparity", [0])
    assert TransformersDepthPipeline.recognises(layout)
    (tmp_path / file).unlink()
    with pytest.raises(ValueError, match=r"must be a folder with preprocessor_config.json; got none"):
        TransformersDepthPipeline.load(layout, torch.float16, None)


@pytest.mark.parametrize(
    ("folder", "architectures", "expected"),
    [
        ("", ["DPTForDepthEstimation"], True),
        ("model", ["Other", "GLPNForDepthEstimation"], True),
        ("model", ["Tipsv2DptForDensePrediction"], True),
        ("", ["DPTForSemanticSegmentation"], False),
        ("other", ["DPTForDepthEstimation"], False),
        ("", None, False),
    ],
)
def test_a_folder_is_recognised_by_the_architecture_of_its_model(tmp_path, folder, architectures, expected):
    (tmp_path / folder).mkdir(exist_ok=True)
    (tmp_path / folder / "config.json").write_text(json.dumps({"architectures": architectures}))
    assert TransformersDepthPipeline.recognises(Layout(tmp_path, "x")) is expected


def test_the_network_works_in_its_own_type_and_the_map_is_single_precision():
    pipe, image = make(), torch.rand(1, 3, 8, 9)
    pipe.model.to(torch.bfloat16)
    seen = []
    own = pipe.model.forward
    pipe.model.forward = lambda pixel_values, **reported: (
        seen.append(pixel_values.dtype) or own(pixel_values, **reported)
    )
    found = pipe.prepare_condition((2 * image - 1).bfloat16(), 1, 1, None)["image_latent"]
    assert seen == [torch.bfloat16] and found.dtype == torch.float32
    red = image[0, 0].numpy()
    wanted = (red - red.min()) / (np.quantile(red, 0.98) - red.min())
    np.testing.assert_allclose(found[0, 0], wanted, atol=0.03)
    assert not found.requires_grad


def test_without_a_prompt_its_model_is_relative_and_with_one_of_half_precision_it_is_metric():
    pipe = make("PromptDepthAnything", module.PROMPTED)
    image = torch.rand(1, 3, 16, 20) * 0.1
    assert pipe.prepare_condition(2 * image - 1, 1, 1, None) and pipe.metric_range is None
    assert pipe.model.batches[-1] == (1, {})
    pipe.prepare_condition(2 * image - 1, 3, 1, None, prompt_depth=torch.tensor([[[[2, 4], [6, 10]]]]))
    given = pipe.model.batches[-1][1]["prompt_depth"]
    torch.testing.assert_close(given, torch.tensor([[[[0, 0.25], [0.5, 1]]]]))
    assert pipe.metric_range.shape == (3, 2) and torch.equal(pipe.metric_range[0], pipe.metric_range[2])


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


class EchoingModel(PreTrainedModel):
    """A network whose depth is the red channel that it is given, and that may know its field of view."""

    config_class = PretrainedConfig

    def __init__(self, **more) -> None:
        super().__init__(PretrainedConfig())
        self.register_parameter("nothing", torch.nn.Parameter(torch.zeros(1)))
        self.more = more

    def forward(self, pixel_values):
        return SimpleNamespace(predicted_depth=pixel_values[:, 0], **self.more)


def echo(kind, space="depth", model=None, **options):
    reported = {"image_processor_type": f"{kind}ImageProcessor", "image_mean": [0] * 3, "image_std": [1] * 3}
    return TransformersDepthPipeline(model or EchoingModel(), DirectScheduler(0), reported | options, space)


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


def test_every_class_of_the_library_is_guided_or_rejected():
    guided = {type(MODELS[kind]()[0]).__name__ for kind in MODELS}
    assert guided | {NO_DEPTH} == set(MODEL_FOR_DEPTH_ESTIMATION_MAPPING_NAMES.values())
    with pytest.raises(ValueError, match="prior must be a depth model; got .*canopy height"):
        echo("GLPN", model=type(NO_DEPTH, (EchoingModel,), {})())


def test_a_given_space_takes_precedence_and_an_unknown_class_needs_one():
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
