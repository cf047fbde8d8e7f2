"""What every adapter declares of itself: defaults, steps, draws, channels, components, and what it saves."""

import inspect
import json
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import pytest
import torch

from geodiff_plugin.priors import PRIORS, find_prior, prior_of
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import DepthDiffusionPipeline
from tests.contracts.tiny_priors import CALL, TINY


@dataclass(frozen=True)
class Facts:
    """As the authors' code has them; of defaults steps, resolution and space."""

    defaults: tuple[int, int, str | None]
    max_steps: int | None = None
    deterministic: bool = False
    sees_latents: bool = True
    takes_prompt: bool = False
    depth_channels: slice = field(default_factory=lambda: slice(None))
    resampling: str = "bilinear"
    options: dict[str, Any] = field(default_factory=dict)
    arguments: tuple[str, ...] = ()
    processed: tuple[int, int] = (56, 96)  # (H, W) of an image of 50 x 90


FACTS = {
    "marigold-v2": Facts((1, 768, "log"), 1, True, options={"sample_latent": False}, processed=(64, 96)),
    "geowizard": Facts(
        (10, 768, "depth"),
        depth_channels=slice(0, 4),
        options={"default_domain": "indoor"},
        arguments=("domain",),
    ),
    "lotus": Facts((1, 768, None), 1, resampling="nearest-exact", processed=(50, 90)),
    "depthmaster": Facts((1, 768, "sqrt_disparity"), 1, True, sees_latents=False),
    "depthfm": Facts((4, 768, "log"), options={"noising_step": 400}, processed=(64, 64)),
    "ppd": Facts((4, 1024, "log1p"), processed=(64, 96)),
    "transformers": Facts(
        (1, 768, None),
        1,
        True,
        sees_latents=False,
        options={"preparation": None},
        arguments=("prompt_depth",),
        processed=(50, 90),
    ),
    "map": Facts((1, 0, "depth"), 1, True, sees_latents=False, arguments=("depth_map",), processed=(50, 90)),
    "e2e-ft": Facts((1, 768, "depth"), 1, True, options={"initial_latents": "zeros"}, processed=(50, 90)),
    "marigold": Facts((2, 64, "depth"), processed=(50, 90)),
}
#: What may be chosen in place of these, where a folder must keep it.
OTHERS = {
    "marigold-v2": {"prediction_type": "disparity", "sample_latent": True},
    "geowizard": {"prediction_type": "disparity", "default_domain": "outdoor", "default_denoising_steps": 7},
    "lotus": {"prediction_type": "depth"},
    "depthmaster": {"prediction_type": "depth"},
    "depthfm": {"prediction_type": "depth", "noising_step": 0, "default_denoising_steps": 3},
    "ppd": {"prediction_type": "depth", "default_denoising_steps": 9},
    "transformers": {"prediction_type": "depth"},
    "map": {"prediction_type": "log1p"},
    "e2e-ft": {"prediction_type": "disparity"},
    "marigold": {"prediction_type": "disparity", "default_denoising_steps": 6},
}
OURS = [key for key, adapter in PRIORS.items() if issubclass(adapter, DepthDiffusionPipeline)]


@cache
def tiny(key):
    return TINY[key]()


def parts_of(pipe):
    """The components that its constructor takes."""
    taken = inspect.signature(type(pipe).__init__).parameters
    return {name: part for name, part in pipe.components.items() if name in taken}


def modules_of(pipe):
    return {name: part for name, part in pipe.components.items() if isinstance(part, torch.nn.Module)}


def test_the_table_is_whole():
    assert set(FACTS) == set(OTHERS) == set(PRIORS)


@pytest.mark.parametrize("key", PRIORS)
def test_every_adapter_declares_what_its_authors_do(key):
    facts, prior, adapter = FACTS[key], prior_of(tiny(key)), PRIORS[key]
    declared = prior.max_steps, prior.deterministic, prior.takes_prompt, prior.depth_channels
    assert declared == (facts.max_steps, facts.deterministic, facts.takes_prompt, facts.depth_channels)
    assert prior.metric_range is None and prior.valid is None or key == "map"
    if key == "marigold":
        return  # the stock pipeline's own
    made = getattr(adapter, "pipeline_class", adapter)
    parameters = inspect.signature(made.__init__).parameters
    names = ("default_denoising_steps", "default_processing_resolution", "prediction_type")
    assert tuple(parameters[name].default for name in names) == facts.defaults
    assert {name: parameters[name].default for name in facts.options} == facts.options


@pytest.mark.parametrize("key", PRIORS)
def test_a_pipeline_of_its_components_alone_has_the_declared_defaults(key):
    made, facts = tiny(key), FACTS[key]
    steps, resolution, space = facts.defaults
    needed = {"transformers": {"preparation": dict(made.config.get("preparation") or {})}}
    needed |= {"lotus": {"prediction_type": "depth"}, "marigold": {"prediction_type": "depth"}}
    pipe = type(made)(**parts_of(made), **needed.get(key, {}))
    if key != "marigold":
        assert (pipe.config.default_denoising_steps, pipe.config.default_processing_resolution) == (
            steps,
            resolution,
        )
    assert space is None or prior_of(pipe).space == space
    for name, value in facts.options.items():
        assert name == "preparation" or pipe.config[name] == value
    image, padding, size = pipe.image_processor.preprocess(torch.rand(1, 3, 50, 90), 0)
    assert (tuple(image.shape[-2:]), tuple(size)) == (facts.processed, (50, 90))
    resized = key in ("marigold-v2", "depthfm")
    assert padding == ((0, 0) if resized else (facts.processed[0] - 50, facts.processed[1] - 90))


@pytest.mark.parametrize("key", OURS)
def test_declarations_to_guidance_and_callers_match_the_pipeline(key):
    pipe, facts = tiny(key), FACTS[key]
    assert pipe.sees_latents is facts.sees_latents and pipe.output_resampling == facts.resampling
    assert pipe.network_input == (facts.depth_channels if facts.sees_latents else None)
    assert pipe.network() == (pipe, "denoise") and prior_of(pipe) is pipe
    assert tuple(pipe.call_options()) == facts.arguments
    offloaded = (getattr(pipe, "model_cpu_offload_seq", None) or "").split("->")
    optional = set(type(pipe)._optional_components)
    assert set(offloaded) - {""} - optional == {n for n in modules_of(pipe) if n != "prompt"} - optional
    assert optional <= set(inspect.signature(type(pipe).__init__).parameters)


@pytest.mark.parametrize("key", OURS)
@torch.no_grad()
def test_a_deterministic_prior_draws_nothing_and_others_draw_of_the_callers_generator(key):
    pipe = tiny(key)
    image = torch.rand(1, 3, 32, 64, generator=torch.Generator().manual_seed(0)) * 2 - 1

    def start(seed):
        drawn = torch.Generator().manual_seed(seed)
        condition = pipe.prepare_condition(image, 1, 1, drawn, **CALL.get(key, {}))
        return [*condition.values(), pipe.prepare_latents(condition, drawn)]

    first, again, other = start(0), start(0), start(1)
    assert all(torch.equal(one, two) for one, two in zip(first, again, strict=True))
    same = all(torch.equal(one, two) for one, two in zip(first, other, strict=True))
    assert same is pipe.deterministic
    assert all(len(part) == 1 for part in first) and not any(part.requires_grad for part in first)


@pytest.mark.parametrize("key", PRIORS)
def test_other_options_than_the_defaults_are_kept_by_a_saved_folder(key, tmp_path):
    reported = {"default_processing_resolution": 96} | OTHERS[key]
    made = tiny(key)
    kept = {"preparation": dict(made.config.preparation)} if key == "transformers" else {}
    pipe = type(made)(**parts_of(made), **kept, **reported)
    pipe.save_pretrained(tmp_path)
    index = json.loads((tmp_path / "model_index.json").read_text())
    assert {name: index[name] for name in reported} == reported
    found = find_prior(f"{key}:{tmp_path}")
    loaded = found.load()
    assert found.key == key and type(loaded) is type(pipe)
    assert {name: loaded.config[name] for name in reported} == reported
    assert loaded.config._name_or_path == str(tmp_path)
    for name in ("default_denoising_steps", "default_processing_resolution"):
        assert getattr(loaded, name) == getattr(pipe, name) == pipe.config[name]
    for name, part in modules_of(pipe).items():
        theirs = getattr(loaded, name).state_dict()
        assert all(torch.equal(value, theirs[entry]) for entry, value in part.state_dict().items()), name
        assert not getattr(loaded, name).training
    prior = prior_of(loaded)
    assert prior.space == reported["prediction_type"] and prior.deterministic == prior_of(pipe).deterministic
    assert type(loaded.scheduler) is type(pipe.scheduler)


@pytest.mark.parametrize("key", [key for key in PRIORS if key != "map"])
def test_networks_are_loaded_in_the_type_that_is_asked_for(key, tmp_path):
    tiny(key).save_pretrained(tmp_path)
    space = prior_of(tiny(key)).space
    loaded = find_prior(f"{key}:{tmp_path}").load("cpu", torch.bfloat16, space)
    assert {p.dtype for part in modules_of(loaded).values() for p in part.parameters()} == {torch.bfloat16}
    assert prior_of(loaded).space == space


@pytest.mark.parametrize("key", PRIORS)
def test_a_live_prior_can_be_asked_of_any_folder(key, tmp_path):
    assert prior_of(tiny(key)).recognises(Layout(tmp_path, "x")) is False


@pytest.mark.parametrize("key", OURS)
def test_schedules_and_draws_are_on_the_device_of_the_networks(key):
    """A device that is there on every machine."""
    pipe, there = TINY[key](), torch.device("meta")
    pipe.set_timesteps(1, there)
    assert pipe.scheduler.timesteps.device.type == "meta"
    latent = torch.empty(2, 4, 8, 8, device=there, dtype=torch.float16)
    start = pipe.prepare_latents({"image_latent": latent, "image": latent}, None)
    assert start.device.type == "meta" and start.dtype == torch.float16 and len(start) == 2
