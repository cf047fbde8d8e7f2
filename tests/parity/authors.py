"""What the scripts that run authors' code share: tiny networks, stand-ins for packages, the fixture's file.

Needs numpy and torch only, of any age.
"""

import argparse
import json
import sys
import types
from collections.abc import Callable
from enum import Enum
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from tests.parity.named_weights import draw

UNET = {
    "sample_size": 8,
    "out_channels": 4,
    "block_out_channels": (8, 16),
    "layers_per_block": 1,
    "down_block_types": ("CrossAttnDownBlock2D", "DownBlock2D"),
    "up_block_types": ("UpBlock2D", "CrossAttnUpBlock2D"),
    "cross_attention_dim": 8,
    "attention_head_dim": (2, 4),
    "norm_num_groups": 4,
    "use_linear_projection": True,
}
VAE = {
    "block_out_channels": (4, 8, 8, 8),
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "layers_per_block": 1,
    "latent_channels": 4,
    "norm_num_groups": 4,
}
WIDE_VAE = VAE | {"block_out_channels": (32,) * 4, "norm_num_groups": 32}
SCHEDULER = {
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "prediction_type": "v_prediction",
    "clip_sample": False,
    "set_alpha_to_one": False,
    "steps_offset": 1,
}
ENCODER = {"hidden_size": 8, "intermediate_size": 16, "num_attention_heads": 2, "num_hidden_layers": 2}
#: Encoders of texts, for tokenizers of 1 and of 26 letters.
TEXT_1, TEXT = (
    ENCODER | {"vocab_size": size, "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    for size in (4, 54)
)


def write_tokenizer(folder: Path | str, letters: str) -> tuple[str, str]:
    """The files that ``CLIPTokenizer`` needs, with some letters and no merges."""
    vocabulary, merges = Path(folder) / "vocab.json", Path(folder) / "merges.txt"
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(letter + "</w>" for letter in letters)]
    vocabulary.write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    merges.write_text("#version: 0.2\n")
    return str(vocabulary), str(merges)


def image(name: str, size: tuple[int, int], spread: float = 60.0) -> np.ndarray:
    """``(H, W, 3)`` uint8 of noise."""
    return np.clip(draw(name, (*size, 3)) * spread + 128, 0, 255).astype(np.uint8)


def install(contents: dict[str, dict[str, Any]]) -> None:
    """Put modules, name -> attributes, parents first, into ``sys.modules`` and each into its parent."""
    for name, content in contents.items():
        module = types.ModuleType(name)
        module.__spec__ = ModuleSpec(name, None)  # diffusers looks for it
        module.__dict__.update(content)
        module.__path__ = []
        sys.modules[name] = module
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)


class InterpolationMode(Enum):
    NEAREST_EXACT, BILINEAR, BICUBIC = "nearest-exact", "bilinear", "bicubic"


def _resize(img, size, interpolation=None, antialias=True):
    if tuple(img.shape[-2:]) == tuple(size):
        return img
    smooth = interpolation is not InterpolationMode.NEAREST_EXACT
    flags = {"align_corners": False, "antialias": antialias} if smooth else {}
    return F.interpolate(img, size, mode=interpolation.value, **flags)


def _attention(query, key, value, attn_bias=None, op=None):
    return F.scaled_dot_product_attention(query, key, value, attn_mask=attn_bias)


#: torchvision's functions and xformers' attention, as the torch functions that they wrap.
TORCHVISION = {
    "torchvision": {},
    "torchvision.transforms": {"InterpolationMode": InterpolationMode},
    "torchvision.transforms.functional": {
        "InterpolationMode": InterpolationMode,
        "pil_to_tensor": lambda image: torch.from_numpy(np.array(image)).permute(2, 0, 1),
        "resize": _resize,
    },
}
XFORMERS = {"xformers": {}, "xformers.ops": {"memory_efficient_attention": _attention}}


def write_fixture(run: Callable[[Path], dict[str, np.ndarray]]) -> None:
    """``--authors FOLDER --out FILE``: what ``run(folder)`` computes with the authors' code."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--authors", type=Path, required=True, help="folder of their code")
    parser.add_argument("--out", type=Path, required=True)
    arguments = parser.parse_args()
    sys.path.insert(0, str(arguments.authors))
    kept = run(arguments.authors)
    np.savez_compressed(
        arguments.out, **{k: x.astype(np.float32) if x.dtype.kind == "f" else x for k, x in kept.items()}
    )
