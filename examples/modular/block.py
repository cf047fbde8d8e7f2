"""Marigold as modular blocks of diffusers, with geometry as blocks of its own; this folder goes to the hub.

    from block import GuidedMarigoldBlocks

    pipe = GuidedMarigoldBlocks().init_pipeline()
    pipe.update_components(**load_prior("bundled").components)
    state = pipe(image=left, right=right, K=K, E=E, prediction_type="disparity")
    depth_m, confidence = state.get("depth_m"), state.get("confidence")

``MarigoldBlocks`` is the stock pipeline, stage by stage; ``GuidedMarigoldBlocks`` has three blocks more:
evidence before the loop, guidance after the denoiser, metres after the loop. Both equal the classic calls bit
for bit. They guide the clean latent (``gradient="denoised"``) of one image without an ensemble, and leave the
spacing of the timesteps to the scheduler.
"""

from __future__ import annotations

import inspect
from typing import Any

import torch
from diffusers import (
    AutoencoderKL,
    DDIMScheduler,
    LoopSequentialPipelineBlocks,
    MarigoldDepthPipeline,
    ModularPipelineBlocks,
    SequentialPipelineBlocks,
    UNet2DConditionModel,
)
from diffusers.configuration_utils import FrozenDict
from diffusers.modular_pipelines import ComponentSpec, InputParam, OutputParam
from diffusers.pipelines.marigold import MarigoldDepthOutput
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.torch_utils import randn_tensor
from transformers import CLIPTextModel, CLIPTokenizer

from geodiff_plugin import GeometryGuidance
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.priors import prior_of
from geodiff_plugin.runtime.codec import MapCodec, ProcessingGrid
from geodiff_plugin.runtime.guided_call import count_guided_steps
from geodiff_plugin.runtime.hooks import frozen_weights
from geodiff_plugin.runtime.run import GuidedRun

UNET = ComponentSpec("unet", UNet2DConditionModel)
VAE = ComponentSpec("vae", AutoencoderKL)
SCHEDULER = ComponentSpec("scheduler", DDIMScheduler)
TOKENIZER = ComponentSpec("tokenizer", CLIPTokenizer)
TEXT_ENCODER = ComponentSpec("text_encoder", CLIPTextModel)
PROCESSOR = ComponentSpec(
    "image_processor",
    MarigoldImageProcessor,
    config=FrozenDict({"vae_scale_factor": 8}),
    default_creation_method="from_config",
)


class Block(ModularPipelineBlocks):
    """A leaf: what it needs, what it gives, and ``run`` between the two, without branches.

    Attributes:
        components: that ``run`` uses.
        needs: inputs by name, with what each is; those in ``optional`` may be missing.
        gives: outputs by name.
    """

    model_name = "marigold-depth"
    components: tuple[ComponentSpec, ...] = ()
    needs: dict[str, str] = {}
    optional: dict[str, str] = {}
    gives: dict[str, str] = {}
    _requirements = {"geodiff_plugin": ">=0.1"}

    @property
    def description(self) -> str:
        """The first line of the class's docstring."""
        return (inspect.getdoc(type(self)) or "").split("\n")[0]

    @property
    def expected_components(self) -> list[ComponentSpec]:
        """As ``components``."""
        return list(self.components)

    @property
    def inputs(self) -> list[InputParam]:
        """As ``needs`` and ``optional``."""
        needs = [InputParam(name, required=True, description=text) for name, text in self.needs.items()]
        return needs + [InputParam(name, description=text) for name, text in self.optional.items()]

    @property
    def intermediate_outputs(self) -> list[OutputParam]:
        """As ``gives``."""
        return [OutputParam(name, description=text) for name, text in self.gives.items()]

    def run(self, components: Any, block_state: Any) -> None:
        """Read from ``block_state``, and write what the block gives."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, components: Any, state: Any) -> tuple[Any, Any]:
        """``run`` on the part of the pipeline's state that the block names."""
        block_state = self.get_block_state(state)
        self.run(components, block_state)
        self.set_block_state(state, block_state)
        return components, state


class LoopBlock(Block):
    """A leaf of the denoising loop, which gets the number of the step and its timestep."""

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """One step's work."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, components: Any, block_state: Any, i: int, t: torch.Tensor) -> tuple[Any, Any]:
        """As the loop calls it."""
        self.step(components, block_state, t)
        return components, block_state


class TextStep(Block):
    """Embeds the empty prompt."""

    components = (TOKENIZER, TEXT_ENCODER)
    gives = {"prompt_embeds": "(1, 2, C) embedding of no words"}

    def run(self, components: Any, block_state: Any) -> None:
        """Tokenise and embed."""
        length = components.tokenizer.model_max_length
        options = {"padding": "do_not_pad", "max_length": length, "truncation": True, "return_tensors": "pt"}
        ids = components.tokenizer("", **options).input_ids
        block_state.prompt_embeds = components.text_encoder(ids.to(components.text_encoder.device))[0]


class ImageStep(Block):
    """Resizes and pads the image, and encodes it."""

    components = (VAE, PROCESSOR)
    needs = {"image": "the left image, which gets the depth"}
    optional = {"processing_resolution": "longer side for the prior, px; 768 by default"}
    gives = {
        "image_latent": "(1, C, h, w)",
        "padding": "rows and columns that were added",
        "original_resolution": "(H, W) of the image",
        "content": "(H, W) of the processing grid without padding",
    }

    def run(self, components: Any, block_state: Any) -> None:
        """Preprocess and encode."""
        vae, asked = components.vae, block_state.processing_resolution
        resolution = 768 if asked is None else asked
        image, block_state.padding, block_state.original_resolution = components.image_processor.preprocess(
            block_state.image, resolution, "bilinear", vae.device, vae.dtype
        )
        rows, columns = block_state.padding
        block_state.content = image.shape[-2] - rows, image.shape[-1] - columns
        block_state.image_latent = vae.encode(image).latent_dist.mode() * vae.config.scaling_factor


class NoiseStep(Block):
    """Draws the noise that the loop begins with."""

    needs = {"image_latent": "(1, C, h, w)"}
    optional = {"generator": "source of everything that is drawn"}
    gives = {"latents": "(1, C, h, w) noise"}

    def run(self, components: Any, block_state: Any) -> None:
        """As large as the image's latent."""
        like = block_state.image_latent
        block_state.latents = randn_tensor(
            like.shape, generator=block_state.generator, device=like.device, dtype=like.dtype
        )


class TimestepsStep(Block):
    """Sets the scheduler's timesteps."""

    components = (SCHEDULER,)
    needs = {"image_latent": "says the device"}
    optional = {"num_inference_steps": "4 by default"}
    gives = {"timesteps": "of the denoising loop"}

    def run(self, components: Any, block_state: Any) -> None:
        """As the scheduler spaces them."""
        steps = block_state.num_inference_steps or 4
        components.scheduler.set_timesteps(steps, device=block_state.image_latent.device)
        block_state.timesteps = components.scheduler.timesteps


class DenoiserStep(LoopBlock):
    """Predicts the noise."""

    components = (UNET,)
    needs = {"latents": "z_t", "image_latent": "of the image", "prompt_embeds": "of no words"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """One pass of the network."""
        both = torch.cat([block_state.image_latent, block_state.latents], dim=1)
        text = block_state.prompt_embeds.to(both.dtype)
        block_state.noise_pred = components.unet(both, t, encoder_hidden_states=text, return_dict=False)[0]


class GeometryStep(LoopBlock):
    """Moves what the network predicted towards what the views say.

    It reads and writes ``latents`` and ``noise_pred`` alone, so any loop with these two may hold it.
    """

    needs = {"latents": "z_t", "geometry": "of GeometryEvidenceStep"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """The network output and noisy latent under which the scheduler gives the guided latent."""
        run = block_state.geometry
        with frozen_weights(run.pipe):
            output, z_t, _ = run.guide(block_state.noise_pred, t.cpu(), block_state.latents)
        block_state.noise_pred, block_state.latents = output, z_t


class SchedulerStep(LoopBlock):
    """The scheduler's own step."""

    components = (SCHEDULER,)
    needs = {"latents": "z_t"}
    optional = {"generator": "source of everything that is drawn"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """From z_t to z_{t-1}."""
        block_state.latents = components.scheduler.step(
            block_state.noise_pred, t, block_state.latents, generator=block_state.generator
        ).prev_sample


class AfterStep(LoopBlock):
    """Tells the guidance that the step is over."""

    needs = {"latents": "z_{t-1}", "geometry": "of GeometryEvidenceStep"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """The next call of ``guide`` is of the next step."""
        block_state.latents = block_state.geometry.after_step(t, block_state.latents)


class DenoiseLoop(LoopSequentialPipelineBlocks):
    """Denoises; ``sub_blocks`` says what a step does."""

    model_name = "marigold-depth"
    block_classes = [DenoiserStep, SchedulerStep]
    block_names = ["denoiser", "scheduler"]

    @property
    def description(self) -> str:
        """The loop over the timesteps."""
        return "Denoising loop: its sub-blocks run in order at every timestep."

    @property
    def loop_inputs(self) -> list[InputParam]:
        """The timesteps."""
        return [InputParam("timesteps", required=True, description="of TimestepsStep")]

    @property
    def loop_intermediate_outputs(self) -> list[OutputParam]:
        """The clean latent."""
        return [OutputParam("latents", description="(1, C, h, w)")]

    @torch.no_grad()
    def __call__(self, components: Any, state: Any) -> tuple[Any, Any]:
        """Every sub-block at every timestep."""
        block_state = self.get_block_state(state)
        with self.progress_bar(total=len(block_state.timesteps)) as bar:
            for i, t in enumerate(block_state.timesteps):
                components, block_state = self.loop_step(components, block_state, i=i, t=t)
                bar.update()
        self.set_block_state(state, block_state)
        return components, state


class GuidedDenoiseLoop(DenoiseLoop):
    """Denoises, with geometry between the denoiser and the scheduler."""

    block_classes = [DenoiserStep, GeometryStep, SchedulerStep, AfterStep]
    block_names = ["denoiser", "geometry", "scheduler", "after"]


def _at_image_size(processor: Any, values: torch.Tensor, block_state: Any) -> Any:
    """A map ``(1, 1, h, w)``, unpadded and resized to the image."""
    values = processor.unpad_image(values, block_state.padding)
    return processor.resize_antialias(values, block_state.original_resolution, "bilinear", is_aa=False)


class DecodeStep(Block):
    """Decodes the relative depth, as the stock pipeline does."""

    components = (VAE, PROCESSOR)
    needs = {"latents": "clean", "padding": "to remove", "original_resolution": "of the image"}
    gives = {"relative_depth": "(1, H, W, 1) in [0, 1]"}

    def run(self, components: Any, block_state: Any) -> None:
        """Decode, unpad, resize."""
        vae, processor = components.vae, components.image_processor
        decoded = vae.decode(block_state.latents / vae.config.scaling_factor, return_dict=False)[0]
        map_01 = (torch.clip(decoded.mean(dim=1, keepdim=True), -1.0, 1.0) + 1.0) / 2.0
        block_state.relative_depth = processor.pt_to_numpy(_at_image_size(processor, map_01, block_state))


class GeometryEvidenceStep(Block):
    """Compares the views, once before the loop: cost volume, matches, poses; and plans the steps."""

    components = (UNET, VAE, SCHEDULER, TOKENIZER, TEXT_ENCODER)
    needs = {"image": "the left image", "content": "of ImageStep", "padding": "of ImageStep"}
    optional = {
        "right": "right image, or a tuple of several; none with points alone",
        "K": "3x3 intrinsics in pixels, or a tuple of one per view",
        "E": "4x4 pose of the right camera in the left camera's frame, metres",
        "points": "known depths, a sparse map (H, W) or (N, 3) points, metres",
        "knobs": "hyperparameters of GeometryGuidance, as a dict",
        "num_inference_steps": "denoising steps",
        "prediction_type": "what the prior's map is affine in: depth (the default) or disparity",
    }
    gives = {
        "geometry": "state of the guided call",
        "guidance": "GeometryGuidance",
        "call": "arguments of the classic call, by name",
        "num_inference_steps": "at least the knob min_steps",
    }

    def run(self, components: Any, block_state: Any) -> None:
        """Prepare the guided run on the same networks."""
        parts = {spec.name: getattr(components, spec.name) for spec in self.components}
        host = MarigoldDepthPipeline(**parts, prediction_type=block_state.prediction_type or "depth")
        knobs = {**(block_state.knobs or {}), "points": block_state.points}
        guidance = GeometryGuidance(block_state.right, block_state.K, block_state.E, **knobs)
        asked = block_state.num_inference_steps
        steps, rounds = count_guided_steps(host, guidance, asked)
        lefts_01 = left_images(block_state.image).to(host.vae.device)
        evidence = guidance.prepare(lefts_01)
        signature = inspect.signature(host.__call__)
        call = {name: value.default for name, value in signature.parameters.items()}
        call |= {"image": lefts_01, "num_inference_steps": steps}
        grid = ProcessingGrid(block_state.content, block_state.padding)
        codec = MapCodec(host, prior_of(host), grid)
        block_state.geometry = GuidedRun(codec, guidance, lambda: evidence, call, rounds)
        block_state.guidance, block_state.call, block_state.num_inference_steps = guidance, call, steps


class GeometryBeginStep(Block):
    """Plans which of the loop's steps are corrected or updated."""

    needs = {"geometry": "of GeometryEvidenceStep", "timesteps": "of TimestepsStep"}

    def run(self, components: Any, block_state: Any) -> None:
        """Make the schedule."""
        block_state.geometry.begin(block_state.timesteps.cpu())


class MetresStep(Block):
    """Decodes metric depth, fits it to the matches at the image's size, and judges it."""

    components = (PROCESSOR,)
    needs = {
        "latents": "clean",
        "geometry": "of GeometryEvidenceStep",
        "guidance": "of GeometryEvidenceStep",
        "call": "of GeometryEvidenceStep",
        "padding": "to remove",
        "original_resolution": "of the image",
    }
    gives = {
        "depth_m": "(H, W) metres",
        "confidence": "(H, W) probability that the depth is within 10 %",
        "guided_output": "MetricDepthOutput of the guided call",
    }

    def run(self, components: Any, block_state: Any) -> None:
        """As the guided pipeline ends a call."""
        run, processor = block_state.geometry, components.image_processor
        depth_m = _at_image_size(processor, run.metric_prediction(block_state.latents), block_state)
        stock = MarigoldDepthOutput(depth_m, None, None)
        out = run.output(stock, block_state.guidance.warned)
        block_state.guided_output, block_state.depth_m = out, out.prediction[0, ..., 0]
        block_state.confidence = out.confidence[0, ..., 0]
        run.release()


class MarigoldBlocks(SequentialPipelineBlocks):
    """Relative depth of an image: the stock pipeline in blocks."""

    model_name = "marigold-depth"
    block_classes = [TextStep, ImageStep, NoiseStep, TimestepsStep, DenoiseLoop, DecodeStep]
    block_names = ["text", "image", "noise", "timesteps", "denoise", "decode"]


class GuidedMarigoldBlocks(SequentialPipelineBlocks):
    """Metric depth of an image, from a second view with a known camera or from known points."""

    model_name = "marigold-depth"
    block_classes = [
        *(TextStep, ImageStep, NoiseStep, GeometryEvidenceStep, TimestepsStep, GeometryBeginStep),
        *(GuidedDenoiseLoop, MetresStep),
    ]
    block_names = ["text", "image", "noise", "evidence", "timesteps", "plan", "denoise", "metres"]
    _requirements = {"geodiff_plugin": ">=0.1"}
