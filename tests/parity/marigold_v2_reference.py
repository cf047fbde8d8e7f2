"""Run Marigold V2's own step on a tiny Qwen-Image with named weights, and keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.marigold_v2_reference --authors marigold-v2 \
        --out tests/parity/fixtures/marigold_v2.npz

A dictionary replaces their registry. peft puts on the LoRA with their targets; weights load as theirs do.
"""

import importlib.util
import tempfile
import types
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch

from tests.parity import authors
from tests.parity.named_weights import draw, named_state

TRANSFORMER = {
    "num_layers": 2,
    "attention_head_dim": 16,
    "num_attention_heads": 2,
    "joint_attention_dim": 16,
    "axes_dims_rope": (4, 6, 6),
}
VAE = {"base_dim": 4, "dim_mult": [1, 2, 4, 4], "num_res_blocks": 1}
#: 128 in theirs, and alpha is the rank in every one of their configurations.
RANK = 4
#: Their list of targets, less ``proj_out``, which they filter out; not all of them are in this transformer.
TARGETS = (
    "img_in txt_in to_q to_k to_v to_out.0 attn.add_k_proj attn.add_v_proj attn.add_q_proj attn.to_add_out "
    "norm.linear a_to_out b_to_out img_mlp.net.0.proj img_mlp.net.2 txt_mlp.net.0.proj txt_mlp.net.2 "
    "ff_a.0 ff_a.2 ff_b.0 ff_b.2 norm_out.linear"
).split()
PREFIX = "qwen_edit_2509_qwen_depth_realimg512"
#: Tokens of the prompt, the last two of them padding; a batch of one takes the first of two contexts.
PROMPT, KNOWN = (2, 7, TRANSFORMER["joint_attention_dim"]), 5
SIZE = (48, 64)
#: Released checkpoint -> whether its decoder was trained too.
CHECKPOINTS = {
    "Log-stage1": False,
    "Log-stage2": True,
    "Log-layered": True,
    "Uniform-base": False,
    "Uniform-layered": False,
    "Disparity-base": True,
    "Disparity-layered": True,
}


def image() -> torch.Tensor:
    """``(1, 3, 48, 64)`` in [-1, 1]."""
    return torch.from_numpy(np.clip(0.4 * draw("image", (1, 3, *SIZE)), -1, 1))


def posterior(shape: tuple[int, ...]) -> torch.Tensor:
    """What is drawn for the sample of the image's latent."""
    return torch.from_numpy(draw("posterior", tuple(shape)))


def keep(x: torch.Tensor) -> np.ndarray:
    """The kept part of a map ``(..., H, W)``: every fifth row and column."""
    return x[..., ::5, ::5].float().numpy()


def keep_latent(z: torch.Tensor) -> np.ndarray:
    """The kept part of latents ``(..., h, w)``: every other row and column."""
    return z[..., ::2, ::2].float().numpy()


def prompts() -> tuple[torch.Tensor, torch.Tensor]:
    """Embedding and mask as their two ``.pt`` files hold them."""
    mask = torch.ones(PROMPT[:2], dtype=torch.long)
    mask[:, KNOWN:] = 0
    return torch.from_numpy(draw("prompt", PROMPT)), mask


def base_state(module: torch.nn.Module, prefix: str) -> dict[str, torch.Tensor]:
    """Weights of the base, by their names in it."""
    shapes = {prefix + name: tuple(p.shape) for name, p in module.named_parameters()}
    return {name.removeprefix(prefix): value for name, value in named_state(shapes).items()}


def trainables(name: str, transformer: torch.nn.Module, vae: torch.nn.Module) -> dict[str, torch.Tensor]:
    """What ``trainables.safetensors`` of a checkpoint holds: a LoRA and, where it was trained, a decoder.

    Args:
        name: of ``CHECKPOINTS``; another name is other weights.
        transformer: without a LoRA.
        vae: the autoencoder.
    """
    shapes = {}
    for module_name, module in transformer.named_modules():
        ends = any(module_name == t or module_name.endswith("." + t) for t in TARGETS)
        if ends and isinstance(module, torch.nn.Linear):
            place = f"Diffuser.{module_name}"
            shapes[f"{place}.lora_A.default.weight"] = (RANK, module.in_features)
            shapes[f"{place}.lora_B.default.weight"] = (module.out_features, RANK)
    if CHECKPOINTS[name]:
        shapes |= {f"VAE.decoder.{key}": tuple(p.shape) for key, p in vae.decoder.named_parameters()}
    drawn = named_state({f"{name}/{key}": shape for key, shape in shapes.items()})
    return {key.removeprefix(f"{name}/"): value for key, value in drawn.items()}


class _Torch(types.ModuleType):
    """torch, in which bfloat16 is float32 but for a number that they make in bfloat16: the time."""

    bfloat16 = torch.float32

    @staticmethod
    def full(*arguments, dtype, **options):
        return torch.full(*arguments, dtype=torch.bfloat16, **options)

    def __getattr__(self, name):
        return getattr(torch, name)


def authors_graph(folder: Path, embed_dir: str, components: dict) -> types.ModuleType:
    """Their module, with a registry that holds these components."""
    registry = {
        "REGISTRY": {"cfg": SimpleNamespace(paths=SimpleNamespace(embed_dir=embed_dir))},
        "get": lambda kind, name: components[name],
        "register": lambda kind: lambda cls: cls,
    }
    authors.install({"marigoldv2": {}, "marigoldv2.core": {}, "marigoldv2.core.registry": registry})
    path = folder / "marigoldv2/experiments/20260316_qwen_depth/network_graph.py"
    spec = importlib.util.spec_from_file_location("network_graph", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def load_theirs(name: str, dtype: torch.dtype) -> dict:
    """Their two components, weights loaded as in ``run_marigold_v2.py``."""
    from diffusers import AutoencoderKLQwenImage, QwenImageTransformer2DModel
    from peft import LoraConfig

    transformer, vae = QwenImageTransformer2DModel(**TRANSFORMER), AutoencoderKLQwenImage(**VAE)
    transformer.load_state_dict(base_state(transformer, "transformer."))
    vae.load_state_dict(base_state(vae, "vae."))
    checkpoint = trainables(name, transformer, vae)
    transformer.add_adapter(LoraConfig(r=RANK, lora_alpha=RANK, target_modules=TARGETS))
    parts = {"Diffuser": transformer, "VAE": vae}
    for key, module in parts.items():
        own = {k.removeprefix(f"{key}."): v for k, v in checkpoint.items() if k.startswith(f"{key}.")}
        missing, unexpected = module.load_state_dict(own, strict=False)
        assert not unexpected and not [k for k in missing if "lora" in k], (missing, unexpected)
        module.to(dtype).eval()
    return parts


@torch.no_grad()
def run_case(checkout: Path, name: str, dtype: torch.dtype, drawn: float) -> dict[str, np.ndarray]:
    """Latents before and after the step, decoded map before and after its clamp; 0 drawn is the mode."""
    from diffusers.models.autoencoders import vae as vae_module

    parts = load_theirs(name, dtype)
    with tempfile.TemporaryDirectory() as folder:
        embedding, mask = prompts()
        torch.save(embedding, Path(folder) / f"{PREFIX}_prompt_embeds.pt")
        torch.save(mask, Path(folder) / f"{PREFIX}_prompt_mask.pt")
        graph = authors_graph(checkout, folder, parts)
        if dtype == torch.float32:
            graph.torch = _Torch("torch")
        step = graph.QwenImageEdit2509Step({"prefix": PREFIX})
    vae_module.randn_tensor = lambda shape, dtype=None, **_: drawn * posterior(tuple(shape)).to(dtype)
    batch = {"rgb_norm": image(), "out": {}}
    graph.QwenImageEncode()(batch)
    image_latent = batch["out"]["lat_encoding"]
    step(batch)
    z0 = batch["out"]["lat_encoding"]
    graph.QwenImageDecode()(batch)
    graph.SelectChannel()(batch)
    clamp, torch.clamp = torch.clamp, lambda x, **_: x
    unclipped = {"out": {"lat_encoding": z0}}
    graph.QwenImageDecode()(unclipped)
    graph.SelectChannel()(unclipped)
    torch.clamp = clamp
    return {
        "image_latent": keep_latent(image_latent[0, :, 0]),
        "z0": keep_latent(z0[0, :, 0]),
        "unclipped": keep(unclipped["out"]["depth_rel_pred_m11"][0, 0]),
        "final": keep(batch["out"]["depth_rel_pred_m11"][0, 0]),
    }


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """The slices of every checkpoint in float32, and of one in bfloat16, which they ran in."""
    runs = [(name, name, torch.float32, 1.0) for name in CHECKPOINTS]
    runs.append(("mode", "Log-stage2", torch.float32, 0.0))
    runs.append(("bfloat16", "Log-stage2", torch.bfloat16, 0.0))
    return {
        f"{label}/{key}": value for label, *case in runs for key, value in run_case(folder, *case).items()
    }


if __name__ == "__main__":
    authors.write_fixture(run_authors)
