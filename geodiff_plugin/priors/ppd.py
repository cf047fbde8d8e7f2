"""Pixel-Perfect Depth: a flow in pixel space with semantic tokens halfway (arXiv 2510.07316)."""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from diffusers import FlowMatchEulerDiscreteScheduler
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.embeddings import get_timestep_embedding
from diffusers.models.modeling_utils import ModelMixin
from diffusers.pipelines.marigold.marigold_image_processing import MarigoldImageProcessor
from diffusers.utils.accelerate_utils import apply_forward_hook
from torch import Tensor, nn
from transformers import Dinov2Model

from geodiff_plugin.priors.loading import Layout
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, upcast

#: Sides are multiples of this, pixels; each such square has one semantic token.
SIDE = 16
LAST_TIMESTEP = 1000
#: Ratio of the shorter to the longer side of the training images: 1024 x 768.
TRAINING_RATIO = 0.75
#: ImageNet mean of red, green and blue, which the encoder subtracts.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
#: ImageNet standard deviation of red, green and blue, by which the encoder divides.
IMAGENET_STD = (0.229, 0.224, 0.225)
#: Base of the rotary embedding.
ROPE_BASE = 100.0
#: Size of the time embedding.
TIME_FREQUENCIES = 256
#: Lower bound of norms.
NORM_EPS = 1e-6
#: DINOv2 scales its position embeddings by (n + 0.1) / old instead of n / old.
POSITION_OFFSET = 0.1


def sampling_timesteps(steps: int) -> list[float]:
    """Return rounded timesteps from 1000 in steps of 1001 / n, without the authors' occasional -1."""
    step = -(LAST_TIMESTEP + 1) / steps
    times = torch.arange(LAST_TIMESTEP, -1, step, dtype=torch.float32, device="cpu")
    return times.round()[:steps].tolist()


class AreaImageProcessor(MarigoldImageProcessor):
    """Resizes to a given area with sides that are multiples of 16, so the axes have different scales."""

    @staticmethod
    def resize_to_max_edge(image: Tensor, max_edge_sz: int, mode: str) -> Tensor:
        """Resize to the area of ``max_edge_sz x 0.75 max_edge_sz``, with the authors' interpolation modes."""
        height, width = image.shape[-2:]
        scale = (max_edge_sz**2 * TRAINING_RATIO / (height * width)) ** 0.5
        size = tuple(max(SIDE, round(side * scale / SIDE) * SIDE) for side in (height, width))
        if scale < 1 and size[0] <= height and size[1] <= width:
            views = [view.permute(1, 2, 0).float().cpu().numpy() for view in image]
            downscaled = [cv2.resize(view, size[::-1], interpolation=cv2.INTER_AREA) for view in views]
            return torch.from_numpy(np.stack(downscaled)).permute(0, 3, 1, 2).to(image)
        return F.interpolate(image, size, mode="bicubic", align_corners=False).clamp(-1.0, 1.0)


@apply_forward_hook
def semantic_tokens(encoder: Dinov2Model, image_01: Tensor) -> Tensor:
    """Compute normalized patch tokens ``(B, n, C)`` of Depth Anything V2's encoder, one per 16 x 16 pixels.

    The parts of ``encoder.forward`` are called one by one; the hook brings an offloaded encoder back.
    """
    mean, std = (image_01.new_tensor(v).view(1, 3, 1, 1) for v in (IMAGENET_MEAN, IMAGENET_STD))
    rows, columns = image_01.shape[-2] // SIDE, image_01.shape[-1] // SIDE
    patch = encoder.config.patch_size
    embeddings = encoder.embeddings
    view = F.interpolate((image_01 - mean) / std, (rows * patch, columns * patch), mode="bicubic")
    patches = embeddings.patch_embeddings(view)  # (B, n, C)
    tokens = torch.cat([embeddings.cls_token.expand(len(patches), -1, -1), patches], dim=1)
    tokens = tokens + _position_embeddings(embeddings.position_embeddings, rows, columns)
    return encoder.layernorm(encoder.encoder(tokens).last_hidden_state)[:, 1:]


def _position_embeddings(learned: Tensor, rows: int, columns: int) -> Tensor:
    """Return embeddings of class token and grid, with the authors' offset, which transformers omits."""
    side = round((learned.shape[1] - 1) ** 0.5)
    if (rows, columns) == (side, side):
        return learned
    grid = learned[:, 1:].float().unflatten(1, (side, side)).permute(0, 3, 1, 2)
    scale = ((rows + POSITION_OFFSET) / side, (columns + POSITION_OFFSET) / side)
    grid = F.interpolate(grid, scale_factor=scale, mode="bicubic").flatten(2).transpose(1, 2)
    return torch.cat([learned[:, :1], grid.to(learned.dtype)], dim=1)


def _rotations(rows: int, columns: int, head_size: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Compute cosine and sine ``(n, head_size)`` of a grid: half a head for rows, half for columns."""
    row, column, half = (torch.arange(n, device=like.device) for n in (rows, columns, head_size // 2))
    positions = torch.cartesian_prod(row, column)  # (n, 2)
    angles = positions[:, :, None].float() / ROPE_BASE ** (half[::2].float() / len(half))  # (n, 2, half / 2)
    angles = torch.cat([angles, angles], dim=-1).flatten(1).to(like.dtype)
    return angles.cos(), angles.sin()


def _rotate(tokens: Tensor, rotations: tuple[Tensor, Tensor]) -> Tensor:
    """Apply the rotary embedding to ``(B, heads, n, head_size)``."""
    cosine, sine = rotations
    halves = tokens.unflatten(-1, (2, 2, -1))  # row and column, each in two parts
    rotated = torch.stack([-halves[..., 1, :], halves[..., 0, :]], dim=-2).flatten(-3)
    return tokens * cosine + rotated * sine


def _modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    """Normalize tokens, then scale and shift them by the time embedding."""
    normed = F.layer_norm(x, x.shape[-1:], eps=NORM_EPS)
    return normed * (1 + scale[:, None]) + shift[:, None]


class _Attention(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm, self.k_norm = nn.LayerNorm(width // heads), nn.LayerNorm(width // heads)
        self.proj = nn.Linear(width, width)

    def forward(self, x: Tensor, rotations: tuple[Tensor, Tensor]) -> Tensor:
        qkv = self.qkv(x).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        q, k = _rotate(self.q_norm(qkv[0]), rotations), _rotate(self.k_norm(qkv[1]), rotations)
        return self.proj(F.scaled_dot_product_attention(q, k, qkv[2]).transpose(1, 2).flatten(2))


class _Block(nn.Module):
    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.attn = _Attention(width, heads)
        hidden = int(width * mlp_ratio)
        layers = {"fc1": nn.Linear(width, hidden), "act": nn.GELU("tanh"), "fc2": nn.Linear(hidden, width)}
        self.mlp = nn.Sequential(OrderedDict(layers))
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, time: Tensor, rotations: tuple[Tensor, Tensor]) -> Tensor:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.adaLN_modulation(time).chunk(6, dim=1)
        x = x + gate_a[:, None] * self.attn(_modulate(x, shift_a, scale_a), rotations)
        return x + gate_m[:, None] * self.mlp(_modulate(x, shift_m, scale_m))


class PixelDiT(ModelMixin, ConfigMixin):
    """Cascaded diffusion transformer: half of the blocks on patches of twice the size, half on patches."""

    _no_split_modules = ["_Block"]

    @register_to_config
    def __init__(
        self,
        hidden_size: int = 1024,
        depth: int = 24,
        num_heads: int = 16,
        patch_size: int = 8,
        semantic_size: int = 1024,
        mlp_ratio: float = 4.0,
    ) -> None:
        super().__init__()
        self.x_embedder = nn.ModuleDict({"proj": nn.Conv2d(4, hidden_size, 2 * patch_size, 2 * patch_size)})
        of_time = nn.Linear(TIME_FREQUENCIES, hidden_size), nn.SiLU(), nn.Linear(hidden_size, hidden_size)
        self.t_embedder = nn.ModuleDict({"mlp": nn.Sequential(*of_time)})
        self.blocks = nn.ModuleList(_Block(hidden_size, num_heads, mlp_ratio) for _ in range(depth))
        wide = 4 * hidden_size
        fusion = nn.Linear(hidden_size + semantic_size, wide), nn.SiLU(), nn.Linear(wide, wide), nn.SiLU()
        self.proj_fusion = nn.Sequential(*fusion, nn.Linear(wide, wide))
        self.final_layer = nn.ModuleDict({"linear": nn.Linear(hidden_size, patch_size**2)})
        self.final_layer["adaLN_modulation"] = nn.Sequential(
            nn.SiLU(), nn.Linear(hidden_size, 2 * hidden_size)
        )

    def forward(self, x: Tensor, semantics: Tensor, timestep: Tensor) -> Tensor:
        """Predict the velocity ``noise - clean (B, 1, H, W)``; ``x`` is noisy depth and image - 0.5.

        ``semantics`` are ``(B, n, C)``, one token per coarse patch; ``timestep`` is in [0, 1000].
        """
        patch = self.config.patch_size
        head_size = self.config.hidden_size // self.config.num_heads
        rows, columns = x.shape[-2] // (2 * patch), x.shape[-1] // (2 * patch)
        angles = timestep.reshape(-1).expand(len(x)), TIME_FREQUENCIES
        time = get_timestep_embedding(*angles, flip_sin_to_cos=True, downscale_freq_shift=0)
        time = self.t_embedder["mlp"](time.to(x.dtype))
        tokens = self.x_embedder["proj"](x).flatten(2).transpose(1, 2)  # (B, n, D)
        coarse, fine = (_rotations(rows * k, columns * k, head_size, tokens) for k in (1, 2))
        middle = len(self.blocks) // 2
        for block in self.blocks[:middle]:
            tokens = block(tokens, time, coarse)
        tokens = self.proj_fusion(torch.cat([tokens, F.normalize(semantics, dim=-1)], dim=-1))
        # Every coarse token, now of width 4 D, becomes the four fine tokens of its patch, two by two.
        tokens = tokens.unflatten(2, (2, 2, -1)).unflatten(1, (rows, columns))  # (B, h, w, 2, 2, D)
        tokens = tokens.permute(0, 1, 3, 2, 4, 5).flatten(1, 4)  # (B, 4 n, D)
        for block in self.blocks[middle:]:
            tokens = block(tokens, time, fine)
        shift_and_scale = self.final_layer["adaLN_modulation"](time).chunk(2, dim=1)
        pixels = self.final_layer["linear"](_modulate(tokens, *shift_and_scale))  # (B, 4 n, patch^2)
        return F.pixel_shuffle(pixels.transpose(1, 2).unflatten(2, (2 * rows, 2 * columns)), patch)


class PPDPipeline(DepthDiffusionPipeline):
    """Pixel-Perfect Depth: its latents are depth itself, ``(B, 1, H, W)``, about [-0.5, 0.5].

    ``processing_resolution`` is the longer side for a 4:3 image; other images get the same area. The authors
    use 4 steps, or 20 when evaluating points.
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

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a transformer on semantic tokens with the encoder that computes them."""
        encoder = layout.config("semantic_encoder")
        return "semantic_size" in layout.config("dit") and encoder.get("model_type") == "dinov2"

    def prepare_condition(
        self, image: Tensor, ensemble_size: int, batch_size: int, generator: Generators
    ) -> Condition:
        """Return the image in [-0.5, 0.5] and its semantic tokens, one set per member."""
        tokens = [semantic_tokens(self.semantic_encoder, part / 2 + 0.5) for part in image.split(batch_size)]
        condition = {"image": image / 2, "semantics": torch.cat(tokens)}
        return {name: value.repeat_interleave(ensemble_size, dim=0) for name, value in condition.items()}

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Draw Gaussian noise of one channel, ``(N * E, 1, H, W)``."""
        return super().prepare_latents({"image_latent": condition["image"][:, :1]}, generator)

    def set_timesteps(self, num_inference_steps: int, device: torch.device) -> None:
        """Set the authors' own timestep spacing."""
        timesteps = sampling_timesteps(num_inference_steps)
        sigmas = [t / LAST_TIMESTEP for t in timesteps]
        self.scheduler.set_timesteps(sigmas=sigmas, timesteps=timesteps, device=device)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Predict the velocity, noise minus clean depth."""
        model_input = torch.cat([latents.to(condition["image"].dtype), condition["image"]], dim=1)
        return self.dit(model_input, condition["semantics"], timestep)

    def decode(self, z0: Tensor) -> Tensor:
        """Add the offset to clean depth, which is the map."""
        return upcast(z0) + 0.5

    def encode(self, x: Tensor) -> Tensor:
        """Subtract the offset from the map."""
        return x - 0.5

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode like the authors, without clipping."""
        return self.decode(latents)
