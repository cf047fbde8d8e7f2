"""Preparation of images for depth models of ``transformers``, and metric ranges, against references."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from transformers import PretrainedConfig, PreTrainedModel

from geodiff_plugin.priors import transformers_depth as module
from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.transformers_depth import (
    Preparation,
    TransformersDepthPipeline,
    range_of,
    unit_range,
)


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
    told = {"do_resize": False, "image_mean": mean, "image_std": std}
    shape = (1, 3, 1, 1)
    expected = (image - torch.tensor(mean).view(shape)) / torch.tensor(std).view(shape)
    torch.testing.assert_close(prepare("DPT", **told)(image), expected)
    padded = prepare("DPT", **told, do_pad=True, size_divisor=16)(image)
    assert padded.shape[-2:] == (32, 32)
    torch.testing.assert_close(padded[..., 6:26, 1:31], expected)
    padded[..., 6:26, 1:31] = 0
    assert not padded.any()
    assert prepare("GLPN", **told, do_pad=True)(image).shape[-2:] == (20, 30)
    torch.testing.assert_close(prepare("GLPN", do_resize=False)(image), image)  # not normalised
    half = prepare("DPT", do_resize=False)(image)
    torch.testing.assert_close(half, 2 * image - 1)


def test_zoedepth_reflects_a_border_whose_width_grows_with_the_root_of_the_side():
    image = torch.rand(1, 3, 40, 60)
    told = {"do_resize": False, "do_normalize": False}
    padded = prepare("ZoeDepth", **told)(image)
    rows, columns = int(np.sqrt(20) * 3), int(np.sqrt(30) * 3)
    expected = np.pad(image[0].numpy(), ((0, 0), (rows, rows), (columns, columns)), mode="reflect")
    np.testing.assert_array_equal(padded[0], expected)
    values = torch.from_numpy(expected[:1])[None]
    back = prepare("ZoeDepth", **told).on_the_image(values, 40, 60)
    torch.testing.assert_close(back, image[:, :1], atol=1e-5, rtol=0)
    assert prepare("ZoeDepth", **told, do_pad=False)(image).shape[-2:] == (40, 60)


def test_maps_lose_what_was_padded_asymmetrically_and_others_stay():
    own = prepare("DPT", do_resize=False, do_pad=True, size_divisor=16)
    values = torch.rand(2, 1, 32, 48)
    torch.testing.assert_close(own.on_the_image(values, 27, 45), values[..., 2:29, 1:46])
    half = torch.nn.functional.avg_pool2d(values, 2)
    found = own.on_the_image(half, 27, 45)
    assert found.shape == (2, 1, 27, 45)
    wanted = torch.nn.functional.interpolate(half, (32, 48), mode="bicubic")[..., 2:29, 1:46]
    torch.testing.assert_close(found, wanted)
    assert prepare("DPT").on_the_image(values, 27, 45) is values


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
    assert float(range_of(large)[1]) == pytest.approx(1_960_000, rel=1e-4)


class Echo(PreTrainedModel):
    """A network whose depth is ten times the red channel that it is given."""

    config_class = PretrainedConfig

    def __init__(self, **more) -> None:
        super().__init__(PretrainedConfig())
        self.register_parameter("nothing", torch.nn.Parameter(torch.zeros(1)))
        self.more, self.batches = more, []

    def forward(self, pixel_values, **told):
        self.batches.append((len(pixel_values), told))
        return SimpleNamespace(predicted_depth=10 * pixel_values[:, 0], **self.more)


def make(kind="DPT", name="Echo", space="depth", metric=False, **more):
    told = {"image_processor_type": f"{kind}ImageProcessor", "image_mean": [0] * 3, "image_std": [1] * 3}
    model = type(name, (Echo,), {})(**more)
    pipe = TransformersDepthPipeline(model, DirectScheduler(0), told | {"do_resize": False}, space)
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
    given = torch.cat([told["prompt_depth"] for _, told in pipe.model.batches])
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
    with pytest.raises(ValueError, match="prompt_depth must be left out with this model"):
        make().prepare_condition(2 * images - 1, 1, 3, None, prompt_depth=prompt)
    assert pipe.takes_prompt and not make().takes_prompt
    assert pipe.call_options() == ["prompt_depth"]
