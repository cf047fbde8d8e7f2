"""Pixel-Perfect Depth: a flow in pixel space with semantic tokens (arXiv 2510.07316)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.accelerate_utils import apply_forward_hook
from diffusers.utils.torch_utils import randn_tensor
from torch import Tensor
from transformers import Dinov2Model

from geodiff_plugin.priors.base import DepthPrior
from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators
from geodiff_plugin.priors.pixel_dit import PixelDiT

#: Sides are multiples of this; one semantic token for each such square.
SIDE = 16
LAST_TIMESTEP = 1000
#: Shorter over longer side of the training images: 1024 x 768.
TRAINING_RATIO = 0.75
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: DINOv2 stretches its position embeddings by (n + 0.1) / old and not by n / old.
POSITION_OFFSET = 0.1


def sampling_timesteps(steps: int) -> list[float]:
    """1000 and on in steps of 1001 / n, rounded.

    For some n (29, 49, 58, ...) floating point gives the authors one more, -1; here there are n.
    """
    step = -(LAST_TIMESTEP + 1) / steps
    times = torch.arange(LAST_TIMESTEP, -1, step, dtype=torch.float32, device="cpu")
    return times.round()[:steps].tolist()


def _coverage(before: int, after: int) -> Tensor:
    """``(after, before)``: what part of a new pixel lies on each old one; rows sum to 1."""
    ends = torch.arange(after + 1, dtype=torch.float64, device="cpu") * (before / after)
    old = torch.arange(before, dtype=torch.float64, device="cpu")
    overlap = torch.minimum(ends[1:, None], old + 1) - torch.maximum(ends[:-1, None], old)
    return (overlap.clamp_min(0) * (after / before)).float()


def area_resize(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Mean over the exact area of every new pixel, for ``(B, C, H, W)`` that shrinks to ``size``."""
    sides = zip(image.shape[-2:], size, strict=True)
    rows, columns = (_coverage(before, after).to(image.device) for before, after in sides)
    return (rows @ image.float() @ columns.T).to(image.dtype)


class AreaImageProcessor(MarigoldImageProcessor):
    """Resizes to a given area with sides that are multiples of 16, so that the two axes scale differently."""

    @staticmethod
    def resize_to_max_edge(image: Tensor, max_edge_sz: int, mode: str) -> Tensor:
        """The image at the area of ``max_edge_sz x 0.75 max_edge_sz``, whatever its aspect ratio.

        ``max_edge_sz`` is the longer side that an image of 4:3 gets; 1024 is what the network was trained at.
        As the authors, the mean over areas where it shrinks and cubic where it grows.
        """
        height, width = image.shape[-2:]
        scale = (max_edge_sz**2 * TRAINING_RATIO / (height * width)) ** 0.5
        size = tuple(max(SIDE, round(side * scale / SIDE) * SIDE) for side in (height, width))
        if scale < 1 and size[0] <= height and size[1] <= width:
            return area_resize(image, size)
        return F.interpolate(image, size, mode="bicubic", align_corners=False).clamp(-1.0, 1.0)


@apply_forward_hook
def semantic_tokens(encoder: Dinov2Model, image_01: Tensor) -> Tensor:
    """Normed patch tokens of Depth Anything V2's encoder, one for each 16 x 16 pixels.

    The parts of ``encoder.forward`` are called one by one; the hook brings an offloaded encoder back.

    Args:
        encoder: ``Dinov2Model`` with patches of 14.
        image_01: ``(B, 3, H, W)`` in [0, 1], sides multiples of 16.

    Returns:
        ``(B, (H / 16) (W / 16), C)``.
    """
    mean, std = (image_01.new_tensor(v).view(1, 3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    rows, columns = image_01.shape[-2] // SIDE, image_01.shape[-1] // SIDE
    patch, embeddings = encoder.config.patch_size, encoder.embeddings
    view = F.interpolate((image_01 - mean) / std, (rows * patch, columns * patch), mode="bicubic")
    patches = embeddings.patch_embeddings(view)  # (B, n, C)
    tokens = torch.cat([embeddings.cls_token.expand(len(patches), -1, -1), patches], dim=1)
    tokens = tokens + _position_embeddings(embeddings.position_embeddings, rows, columns)
    return encoder.layernorm(encoder.encoder(tokens).last_hidden_state)[:, 1:]


def _position_embeddings(learned: Tensor, rows: int, columns: int) -> Tensor:
    """Of the class token and of a grid; transformers leaves the authors' offset out, which moves them all."""
    side = round((learned.shape[1] - 1) ** 0.5)
    if (rows, columns) == (side, side):
        return learned
    grid = learned[:, 1:].float().unflatten(1, (side, side)).permute(0, 3, 1, 2)
    scale = ((rows + POSITION_OFFSET) / side, (columns + POSITION_OFFSET) / side)
    grid = F.interpolate(grid, scale_factor=scale, mode="bicubic").flatten(2).transpose(1, 2)
    return torch.cat([learned[:, :1], grid.to(learned.dtype)], dim=1)


class PPDPipeline(DepthDiffusionPipeline):
    """Pixel-Perfect Depth.

    Its latents are depth itself, ``(B, 1, H, W)`` on the processing grid, about [-0.5, 0.5].
    ``processing_resolution`` is the longer side that an image of 4:3 gets; others get the same area.

    Args:
        dit: the diffusion transformer.
        semantic_encoder: encoder of Depth Anything V2 Large.
        scheduler: ``FlowMatchEulerDiscreteScheduler`` without shift.
        prediction_type: ``"log1p"``.
        default_denoising_steps: 4 in the authors' ``run.py``, 20 where they measure points.
        default_processing_resolution: see above.
    """

    model_cpu_offload_seq = "semantic_encoder->dit"

    def __init__(
        self,
        dit: PixelDiT,
        semantic_encoder: Dinov2Model,
        scheduler: FlowMatchEulerDiscreteScheduler,
        prediction_type: str = "log1p",
        default_denoising_steps: int = 4,
        default_processing_resolution: int = 1024,
    ) -> None:
        super().__init__()
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        modules = {"dit": dit, "semantic_encoder": semantic_encoder, "scheduler": scheduler}
        self.register_prior(modules, *defaults, AreaImageProcessor(vae_scale_factor=SIDE))

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators, **options: Any
    ) -> Condition:
        """The image in [-0.5, 0.5] and its semantic tokens, one per member."""
        tokens = [semantic_tokens(self.semantic_encoder, part / 2 + 0.5) for part in image.split(batch_size)]
        condition = {"image": image / 2, "semantics": torch.cat(tokens)}
        return {name: value.repeat_interleave(ensemble_size, dim=0) for name, value in condition.items()}

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Gaussian noise of one channel, ``(N * E, 1, H, W)``."""
        like = condition["image"][:, :1]
        return randn_tensor(like.shape, generator=generator, device=like.device, dtype=like.dtype)

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """The authors' own spacing."""
        timesteps = sampling_timesteps(num_inference_steps)
        sigmas = [t / LAST_TIMESTEP for t in timesteps]
        self.scheduler.set_timesteps(sigmas=sigmas, timesteps=timesteps, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Velocity, noise minus clean depth."""
        joined = torch.cat([latents.to(condition["image"].dtype), condition["image"]], dim=1)
        return self.dit(joined, condition["semantics"], timestep)

    def decode_relative(self, z0: Tensor) -> Tensor:
        """Clean depth is the map, but for its offset."""
        return z0.to(torch.promote_types(z0.dtype, torch.float32)) + 0.5

    def encode_relative(self, x: Tensor) -> Tensor:
        """The map, but for its offset."""
        return x - 0.5

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """As the authors end: not clipped."""
        return self.decode_relative(latents)


LICENCE = "apache-2.0, and cc-by-nc-4.0 for the encoder of Depth Anything V2 Large"


class PPDPrior(DepthPrior):
    """Adapter of ``PPDPipeline``: no VAE, so that decoding is an offset and the gradient its own."""

    pipeline_class = PPDPipeline
    component_classes = {"dit": PixelDiT, "semantic_encoder": Dinov2Model}
    licence = {"gangweix/Pixel-Perfect-Depth": LICENCE}

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """A transformer on semantic tokens, beside the encoder that computes them."""
        semantic_size = layout.config("dit").get("semantic_size")
        encoder = layout.config("semantic_encoder")
        return semantic_size is not None and encoder.get("model_type") == "dinov2"
