"""Marigold as modular diffusers blocks with geometry blocks; this folder can be published on the hub.

    from block import GuidedMarigoldBlocks

    pipe = GuidedMarigoldBlocks().init_pipeline()
    pipe.update_components(**load_prior("bundled").components)
    state = pipe(image=left, right=right, K=K, E=E, prediction_type="disparity")
    depth_m, confidence = state.get("depth_m"), state.get("confidence")

``MarigoldBlocks`` is the stock pipeline, stage by stage; ``GuidedMarigoldBlocks`` adds geometry:
evidence before the loop, guidance after the denoiser, metric depth after the loop. Both reproduce the classic
calls bit for bit. They guide the clean latent (``gradient="denoised"``) of one image without an ensemble, and
use the scheduler's timestep spacing.
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
    """A leaf block: its inputs, its outputs, and ``run``, without branches.

    Attributes:
        components: components used by ``run``.
        needs: descriptions of required inputs by name; those in ``optional`` may be missing.
        gives: descriptions of outputs by name.
    """

    model_name = "marigold-depth"
    components: tuple[ComponentSpec, ...] = ()
    needs: dict[str, str] = {}
    optional: dict[str, str] = {}
    gives: dict[str, str] = {}
    _requirements = {"geodiff_plugin": ">=0.1"}

    @property
    def description(self) -> str:
        """Return the first line of the class's docstring."""
        return (inspect.getdoc(type(self)) or "").split("\n")[0]

    @property
    def expected_components(self) -> list[ComponentSpec]:
        """Return ``components``."""
        return list(self.components)

    @property
    def inputs(self) -> list[InputParam]:
        """Return ``needs`` and ``optional``."""
        needs = [InputParam(name, required=True, description=text) for name, text in self.needs.items()]
        return needs + [InputParam(name, description=text) for name, text in self.optional.items()]

    @property
    def intermediate_outputs(self) -> list[OutputParam]:
        """Return ``gives``."""
        return [OutputParam(name, description=text) for name, text in self.gives.items()]

    def run(self, components: Any, block_state: Any) -> None:
        """Read inputs from ``block_state``, and write the outputs to it."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, components: Any, state: Any) -> tuple[Any, Any]:
        """Call ``run`` with the block's part of the pipeline's state."""
        block_state = self.get_block_state(state)
        self.run(components, block_state)
        self.set_block_state(state, block_state)
        return components, state


class LoopBlock(Block):
    """A leaf block of the denoising loop, called with step number and timestep."""

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """Perform one step."""
        raise NotImplementedError

    @torch.no_grad()
    def __call__(self, components: Any, block_state: Any, i: int, t: torch.Tensor) -> tuple[Any, Any]:
        """Call ``step`` from the loop."""
        self.step(components, block_state, t)
        return components, block_state


class TextStep(Block):
    """Embeds the empty prompt."""

    components = (TOKENIZER, TEXT_ENCODER)
    gives = {"prompt_embeds": "(1, 2, C) embedding of the empty prompt"}

    def run(self, components: Any, block_state: Any) -> None:
        """Tokenise and embed."""
        length = components.tokenizer.model_max_length
        options = {"padding": "do_not_pad", "max_length": length, "truncation": True, "return_tensors": "pt"}
        ids = components.tokenizer("", **options).input_ids
        block_state.prompt_embeds = components.text_encoder(ids.to(components.text_encoder.device))[0]


class ImageStep(Block):
    """Resizes and pads the image, and encodes it."""

    components = (VAE, PROCESSOR)
    needs = {"image": "reference (left) image"}
    optional = {"processing_resolution": "longer side for the prior, px (default: 768)"}
    gives = {
        "image_latent": "(1, C, h, w)",
        "padding": "number of padded rows and columns",
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
    """Draws the initial noise."""

    needs = {"image_latent": "(1, C, h, w)"}
    optional = {"generator": "random generator"}
    gives = {"latents": "(1, C, h, w) noise"}

    def run(self, components: Any, block_state: Any) -> None:
        """Draw noise in the size of the image latent."""
        like = block_state.image_latent
        block_state.latents = randn_tensor(
            like.shape, generator=block_state.generator, device=like.device, dtype=like.dtype
        )


class TimestepsStep(Block):
    """Sets the scheduler's timesteps."""

    components = (SCHEDULER,)
    needs = {"image_latent": "determines the device"}
    optional = {"num_inference_steps": "number of denoising steps (default: 4)"}
    gives = {"timesteps": "timesteps of the denoising loop"}

    def run(self, components: Any, block_state: Any) -> None:
        """Set the timesteps with the scheduler's spacing."""
        steps = block_state.num_inference_steps or 4
        components.scheduler.set_timesteps(steps, device=block_state.image_latent.device)
        block_state.timesteps = components.scheduler.timesteps


class DenoiserStep(LoopBlock):
    """Predicts the noise."""

    components = (UNET,)
    needs = {"latents": "z_t", "image_latent": "latent of the image", "prompt_embeds": "empty prompt"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """Run the network once."""
        both = torch.cat([block_state.image_latent, block_state.latents], dim=1)
        text = block_state.prompt_embeds.to(both.dtype)
        block_state.noise_pred = components.unet(both, t, encoder_hidden_states=text, return_dict=False)[0]


class GeometryStep(LoopBlock):
    """Guides the prediction of the network towards consistency with the views.

    Reads and writes only ``latents`` and ``noise_pred``, so it works in any loop with these two.
    """

    needs = {"latents": "z_t", "geometry": "from GeometryEvidenceStep"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """Replace network output and noisy latent so that the scheduler yields the guided latent."""
        run = block_state.geometry
        with frozen_weights(run.pipe):
            output, z_t, _ = run.guide(block_state.noise_pred, t.cpu(), block_state.latents)
        block_state.noise_pred, block_state.latents = output, z_t


class SchedulerStep(LoopBlock):
    """Performs the scheduler's step."""

    components = (SCHEDULER,)
    needs = {"latents": "z_t"}
    optional = {"generator": "random generator"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """Step from z_t to z_{t-1}."""
        block_state.latents = components.scheduler.step(
            block_state.noise_pred, t, block_state.latents, generator=block_state.generator
        ).prev_sample


class AfterStep(LoopBlock):
    """Ends the guidance of a step."""

    needs = {"latents": "z_{t-1}", "geometry": "from GeometryEvidenceStep"}

    def step(self, components: Any, block_state: Any, t: torch.Tensor) -> None:
        """Advance the guidance to the next step."""
        block_state.latents = block_state.geometry.after_step(t, block_state.latents)


class DenoiseLoop(LoopSequentialPipelineBlocks):
    """Denoises; ``sub_blocks`` are the operations of a step."""

    model_name = "marigold-depth"
    block_classes = [DenoiserStep, SchedulerStep]
    block_names = ["denoiser", "scheduler"]

    @property
    def description(self) -> str:
        """Return the description of the loop."""
        return "Denoising loop: its sub-blocks run in order at every timestep."

    @property
    def loop_inputs(self) -> list[InputParam]:
        """Return the timesteps."""
        return [InputParam("timesteps", required=True, description="from TimestepsStep")]

    @property
    def loop_intermediate_outputs(self) -> list[OutputParam]:
        """Return the clean latent."""
        return [OutputParam("latents", description="(1, C, h, w)")]

    @torch.no_grad()
    def __call__(self, components: Any, state: Any) -> tuple[Any, Any]:
        """Run every sub-block at every timestep."""
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
    """Unpad a map ``(1, 1, h, w)`` and resize it to the image."""
    values = processor.unpad_image(values, block_state.padding)
    return processor.resize_antialias(values, block_state.original_resolution, "bilinear", is_aa=False)


class DecodeStep(Block):
    """Decodes the relative depth like the stock pipeline."""

    components = (VAE, PROCESSOR)
    needs = {"latents": "clean latents", "padding": "padding to remove", "original_resolution": "(H, W)"}
    gives = {"relative_depth": "(1, H, W, 1) in [0, 1]"}

    def run(self, components: Any, block_state: Any) -> None:
        """Decode, unpad, resize."""
        vae, processor = components.vae, components.image_processor
        decoded = vae.decode(block_state.latents / vae.config.scaling_factor, return_dict=False)[0]
        map_01 = (torch.clip(decoded.mean(dim=1, keepdim=True), -1.0, 1.0) + 1.0) / 2.0
        block_state.relative_depth = processor.pt_to_numpy(_at_image_size(processor, map_01, block_state))


class GeometryEvidenceStep(Block):
    """Computes cost volume, matches and poses once before the loop, and plans the guided steps."""

    components = (UNET, VAE, SCHEDULER, TOKENIZER, TEXT_ENCODER)
    needs = {"image": "the left image", "content": "from ImageStep", "padding": "from ImageStep"}
    optional = {
        "right": "right image, or a tuple of several; omitted with points only",
        "K": "3x3 intrinsics in pixels, or a tuple of one per view",
        "E": "4x4 pose of the right camera in the left camera's frame, metres",
        "points": "known depths, a sparse map (H, W) or (N, 3) points, metres",
        "parameters": "parameters of GeometryGuidance, as a dict",
        "num_inference_steps": "denoising steps",
        "prediction_type": "prediction space of the prior: depth (default) or disparity",
    }
    gives = {
        "geometry": "state of the guided call",
        "guidance": "GeometryGuidance",
        "call": "arguments of the classic call, by name",
        "num_inference_steps": "at least the parameter min_steps",
    }

    def run(self, components: Any, block_state: Any) -> None:
        """Prepare the guided run on the same networks."""
        parts = {spec.name: getattr(components, spec.name) for spec in self.components}
        host = MarigoldDepthPipeline(**parts, prediction_type=block_state.prediction_type or "depth")
        parameters = {**(block_state.parameters or {}), "points": block_state.points}
        guidance = GeometryGuidance(block_state.right, block_state.K, block_state.E, **parameters)
        asked = block_state.num_inference_steps
        steps, rounds = count_guided_steps(host, guidance, asked)
        lefts_01 = left_images(block_state.image).to(host.vae.device)
        guidance.check_left_images(lefts_01)
        plans = guidance.plan_evidence(lefts_01)
        signature = inspect.signature(host.__call__)
        call = {name: value.default for name, value in signature.parameters.items()}
        call |= {"image": lefts_01, "num_inference_steps": steps}
        grid = ProcessingGrid(block_state.content, block_state.padding)
        codec = MapCodec(host, prior_of(host), grid)
        block_state.geometry = GuidedRun(codec, guidance, lambda: plans, call, rounds)
        block_state.guidance, block_state.call, block_state.num_inference_steps = guidance, call, steps


class GeometryBeginStep(Block):
    """Plans which steps of the loop fit matches or update latents."""

    needs = {"geometry": "from GeometryEvidenceStep", "timesteps": "from TimestepsStep"}

    def run(self, components: Any, block_state: Any) -> None:
        """Compute the schedule."""
        block_state.geometry.begin(block_state.timesteps.cpu())


class MetresStep(Block):
    """Decodes metric depth, fits it to the matches at image resolution, and computes the verdict."""

    components = (PROCESSOR,)
    needs = {
        "latents": "clean latents",
        "geometry": "from GeometryEvidenceStep",
        "guidance": "from GeometryEvidenceStep",
        "call": "from GeometryEvidenceStep",
        "padding": "padding to remove",
        "original_resolution": "(H, W)",
    }
    gives = {
        "depth_m": "(H, W) metres",
        "confidence": "(H, W) probability that the depth error is below 10 % if the calibration is correct",
        "guided_output": "MetricDepthOutput of the guided call",
    }

    def run(self, components: Any, block_state: Any) -> None:
        """Finish the call like the guided pipeline."""
        run, processor = block_state.geometry, components.image_processor
        depth_m = _at_image_size(processor, run.metric_prediction(block_state.latents), block_state)
        stock = MarigoldDepthOutput(depth_m, None, None)
        out = run.output(stock, block_state.guidance.findings)
        block_state.guided_output = out
        block_state.depth_m = out.prediction[0, ..., 0]
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
