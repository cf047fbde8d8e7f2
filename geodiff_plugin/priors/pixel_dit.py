"""Network of Pixel-Perfect Depth: a diffusion transformer on pixels, with semantic tokens half way."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from diffusers.configuration_utils import ConfigMixin, register_to_config
from diffusers.models.modeling_utils import ModelMixin
from torch import Tensor, nn

ROPE_BASE = 100.0
NORM_EPS = 1e-6


def _positions(rows: int, columns: int, device: torch.device) -> Tensor:
    """Row and column of every token of a grid, ``(rows * columns, 2)``."""
    return torch.cartesian_prod(torch.arange(rows, device=device), torch.arange(columns, device=device))


def _rotations(positions: Tensor, head_size: int, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Cosine and sine ``(n, head_size)``: one half of a head turns with rows, the other with columns."""
    half = head_size // 2
    steps = torch.arange(0, half, 2, device=positions.device).float() / half
    angles = positions[:, :, None].float() / ROPE_BASE**steps  # (n, 2, half / 2)
    angles = torch.cat([angles, angles], dim=-1).flatten(1).to(dtype)
    return angles.cos(), angles.sin()


def _rotate(tokens: Tensor, rotations: tuple[Tensor, Tensor]) -> Tensor:
    """Rotary embedding of ``(B, heads, n, head_size)``."""
    cosine, sine = rotations
    halves = tokens.unflatten(-1, (2, 2, -1))  # row and column, each in two parts
    turned = torch.stack([-halves[..., 1, :], halves[..., 0, :]], dim=-2).flatten(-3)
    return tokens * cosine + turned * sine


def _modulate(x: Tensor, shift: Tensor, scale: Tensor) -> Tensor:
    return x * (1 + scale[:, None]) + shift[:, None]


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


class _Mlp(nn.Module):
    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.fc1, self.fc2 = nn.Linear(width, hidden), nn.Linear(hidden, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x), approximate="tanh"))


class _TimeEmbedder(nn.Module):
    def __init__(self, width: int, frequencies: int = 256) -> None:
        super().__init__()
        self.frequencies = frequencies
        self.mlp = nn.Sequential(nn.Linear(frequencies, width), nn.SiLU(), nn.Linear(width, width))

    def forward(self, t: Tensor) -> Tensor:
        half = self.frequencies // 2
        rates = torch.exp(-math.log(10000.0) * torch.arange(half, device=t.device).float() / half)
        angles = t[:, None].float() * rates
        return self.mlp(torch.cat([angles.cos(), angles.sin()], dim=-1).to(next(self.mlp.parameters()).dtype))


class _Block(nn.Module):
    def __init__(self, width: int, heads: int, mlp_ratio: float) -> None:
        super().__init__()
        self.attn, self.mlp = _Attention(width, heads), _Mlp(width, int(width * mlp_ratio))
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 6 * width))

    def forward(self, x: Tensor, time: Tensor, rotations: tuple[Tensor, Tensor]) -> Tensor:
        shift_a, scale_a, gate_a, shift_m, scale_m, gate_m = self.adaLN_modulation(time).chunk(6, dim=1)
        normed = F.layer_norm(x, x.shape[-1:], eps=NORM_EPS)
        x = x + gate_a[:, None] * self.attn(_modulate(normed, shift_a, scale_a), rotations)
        normed = F.layer_norm(x, x.shape[-1:], eps=NORM_EPS)
        return x + gate_m[:, None] * self.mlp(_modulate(normed, shift_m, scale_m))


class _FinalLayer(nn.Module):
    def __init__(self, width: int, outputs: int) -> None:
        super().__init__()
        self.linear = nn.Linear(width, outputs)
        self.adaLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(width, 2 * width))

    def forward(self, x: Tensor, time: Tensor) -> Tensor:
        shift, scale = self.adaLN_modulation(time).chunk(2, dim=1)
        return self.linear(_modulate(F.layer_norm(x, x.shape[-1:], eps=NORM_EPS), shift, scale))


class PixelDiT(ModelMixin, ConfigMixin):
    """Cascaded diffusion transformer: half of the blocks on patches of twice the size, the rest on patches.

    Args:
        hidden_size: width of a token, a multiple of ``4 * num_heads``.
        depth: number of blocks, even.
        num_heads: of attention.
        patch_size: pixels of a fine patch; sides of the input are multiples of twice that.
        semantic_size: width of the semantic tokens.
        mlp_ratio: hidden width of a block's perceptron over ``hidden_size``.
    """

    _supports_gradient_checkpointing = True
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
        self.gradient_checkpointing = False
        self.x_embedder = nn.ModuleDict({"proj": nn.Conv2d(4, hidden_size, 2 * patch_size, 2 * patch_size)})
        self.t_embedder = _TimeEmbedder(hidden_size)
        self.blocks = nn.ModuleList(_Block(hidden_size, num_heads, mlp_ratio) for _ in range(depth))
        wide = 4 * hidden_size
        self.proj_fusion = nn.Sequential(
            nn.Linear(hidden_size + semantic_size, wide),
            nn.SiLU(),
            nn.Linear(wide, wide),
            nn.SiLU(),
            nn.Linear(wide, wide),
        )
        self.final_layer = _FinalLayer(hidden_size, patch_size**2)

    def forward(self, x: Tensor, semantics: Tensor, timestep: Tensor) -> Tensor:
        """Velocity ``noise - clean``.

        Args:
            x: ``(B, 4, H, W)``, noisy depth and image - 0.5; sides multiples of ``2 * patch_size``.
            semantics: ``(B, n, C)``, one token per coarse patch, row by row.
            timestep: ``(B,)`` or 0-d, in [0, 1000].

        Returns:
            ``(B, 1, H, W)``.
        """
        patch, head_size = self.config.patch_size, self.config.hidden_size // self.config.num_heads
        rows, columns = x.shape[-2] // (2 * patch), x.shape[-1] // (2 * patch)
        time = self.t_embedder(timestep.reshape(-1).expand(len(x)))
        tokens = self.x_embedder["proj"](x).flatten(2).transpose(1, 2)  # (B, n, D)
        coarse, fine = (
            _rotations(_positions(rows * k, columns * k, x.device), head_size, tokens.dtype) for k in (1, 2)
        )
        middle = len(self.blocks) // 2
        for block in self.blocks[:middle]:
            tokens = self._run(block, tokens, time, coarse)
        tokens = self.proj_fusion(torch.cat([tokens, F.normalize(semantics, dim=-1)], dim=-1))
        tokens = self._split(tokens, rows, columns)  # (B, 4 n, D)
        for block in self.blocks[middle:]:
            tokens = self._run(block, tokens, time, fine)
        pixels = self.final_layer(tokens, time)  # (B, 4 n, patch^2)
        return F.pixel_shuffle(pixels.transpose(1, 2).unflatten(2, (2 * rows, 2 * columns)), patch)

    def _run(
        self, block: nn.Module, tokens: Tensor, time: Tensor, rotations: tuple[Tensor, Tensor]
    ) -> Tensor:
        if torch.is_grad_enabled() and self.gradient_checkpointing:
            return self._gradient_checkpointing_func(block, tokens, time, rotations)
        return block(tokens, time, rotations)

    @staticmethod
    def _split(tokens: Tensor, rows: int, columns: int) -> Tensor:
        """Every coarse token ``4 D`` wide becomes the four fine ones of its patch, two by two."""
        fine = tokens.unflatten(2, (2, 2, -1)).unflatten(1, (rows, columns))  # (B, h, w, 2, 2, D)
        return fine.permute(0, 1, 3, 2, 4, 5).flatten(1, 4)
