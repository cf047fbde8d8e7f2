"""Run GeoWizard's own code on tiny networks with named weights, and keep slices of what it computes.

``docs/how-to/parity.md`` tells how to make the environment; then, from the root of this repository::

    python -m tests.parity.geowizard_reference --authors GeoWizard/geowizard \
        --out tests/parity/fixtures/geowizard.npz

The configurations below are what the parity test builds our pipeline from. Their code is imported, not
copied; torchvision's resize and xformers' attention are replaced by the torch functions they wrap.
"""

import argparse
import json
import sys
import tempfile
from enum import Enum
from pathlib import Path

import numpy as np

from tests.parity import stub_modules, tiny_configs

UNET = tiny_configs.UNET | {"in_channels": 8, "class_embed_type": "projection"}
VAE = tiny_configs.VAE
SCHEDULER = tiny_configs.SCHEDULER
ENCODER = {"hidden_size": 8, "intermediate_size": 16, "num_attention_heads": 2, "num_hidden_layers": 2}
VISION = ENCODER | {"image_size": 32, "patch_size": 8, "projection_dim": 8}
TEXT = ENCODER | {"vocab_size": 54, "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
CROP = {"height": 32, "width": 32}
STEPS = 10
SIZE = (48, 64)
#: case -> (class embedding width, domain)
CASES = {"v1_indoor": (10, "indoor"), "v1_object": (10, "object"), "v2_outdoor": (4, "outdoor")}


def write_tokenizer(folder: Path) -> Path:
    """A tokenizer that knows the lower-case letters and no merges."""
    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    tokens = ["<|startoftext|>", "<|endoftext|>", *letters, *(letter + "</w>" for letter in letters)]
    (folder / "vocab.json").write_text(json.dumps({token: i for i, token in enumerate(tokens)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    return folder


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    from tests.parity.named_weights import draw

    return np.clip(draw("geowizard/image", (*SIZE, 3)) * 60 + 128, 0, 255).astype(np.uint8)


def noise() -> np.ndarray:
    """``(1, 4, h, w)``, what both halves start from."""
    from tests.parity.named_weights import draw

    return draw("geowizard/noise", (1, 4, SIZE[0] // 8, SIZE[1] // 8))


def _stand_ins() -> None:
    """torchvision's resize and xformers' attention as the torch functions that they wrap."""
    import torch.nn.functional as F

    class InterpolationMode(Enum):
        BICUBIC = "bicubic"

    def resize(img, size, interpolation, antialias):
        return F.interpolate(img, size, mode=interpolation.value, align_corners=False, antialias=antialias)

    def attention(query, key, value, attn_bias=None):
        return F.scaled_dot_product_attention(query, key, value, attn_mask=attn_bias)

    contents = {
        "torchvision": {},
        "torchvision.transforms": {"InterpolationMode": InterpolationMode},
        "torchvision.transforms.functional": {"resize": resize},
        "xformers": {},
        "xformers.ops": {"memory_efficient_attention": attention},
    }
    stub_modules.install(contents)


def run_case(case: str, coupled: bool) -> dict[str, np.ndarray]:
    """One call of the authors' pipeline; the network's first output, unclipped decode, final output."""
    import torch
    from diffusers import AutoencoderKL, DDIMScheduler
    from models import geowizard_pipeline, geowizard_v2_pipeline
    from models.attention import CustomJointAttention
    from models.unet_2d_condition import UNet2DConditionModel
    from PIL import Image
    from transformers import (
        CLIPImageProcessor,
        CLIPTextConfig,
        CLIPTextModel,
        CLIPTokenizer,
        CLIPVisionConfig,
        CLIPVisionModelWithProjection,
    )

    from tests.parity.named_weights import fill

    width, domain = CASES[case]
    parts = {
        "unet": fill(UNet2DConditionModel(**UNET, projection_class_embeddings_input_dim=width), "unet."),
        "vae": fill(AutoencoderKL(**VAE), "vae."),
        "scheduler": DDIMScheduler(**SCHEDULER),
    }
    if case.startswith("v1"):
        encoder = CLIPVisionModelWithProjection(CLIPVisionConfig(**VISION))
        parts["image_encoder"] = fill(encoder, "image_encoder.")
        parts["feature_extractor"] = CLIPImageProcessor(crop_size=CROP)
        pipe = geowizard_pipeline.DepthNormalEstimationPipeline(**parts)
    else:
        encoder = CLIPTextModel(CLIPTextConfig(**TEXT))
        parts["text_encoder"] = fill(
            encoder, "text_encoder.", rename=lambda name: name.removeprefix("text_model.")
        )
        with tempfile.TemporaryDirectory() as folder:
            write_tokenizer(Path(folder))
            parts["tokenizer"] = CLIPTokenizer(f"{folder}/vocab.json", f"{folder}/merges.txt")
        pipe = geowizard_v2_pipeline.DepthNormalEstimationPipeline(**parts)
    if coupled:  # theirs refuses to without CUDA, and run_infer.py swallows that
        for module in pipe.unet.modules():
            if isinstance(module, CustomJointAttention):
                module.set_use_memory_efficient_attention_xformers(True)

    outputs, conditions, decoded = [], [], {}
    pipe.unet.register_forward_hook(lambda module, args, out: outputs.append(out.sample))
    pipe.unet.register_forward_pre_hook(
        lambda module, args, kwargs: conditions.append(kwargs["encoder_hidden_states"]), with_kwargs=True
    )

    def spied(name, own):
        def spy(latent):
            decoded[name] = own(latent).clone()
            return decoded[name].clone()

        return spy

    pipe.decode_depth = spied("depth", pipe.decode_depth)
    pipe.decode_normal = spied("normal", pipe.decode_normal)
    own_randn, torch.randn = torch.randn, lambda *args, **kwargs: torch.from_numpy(noise())
    try:
        result = pipe(
            Image.fromarray(image_u8()),
            denoising_steps=STEPS,
            ensemble_size=1,
            processing_res=0,
            domain=domain,
            show_progress_bar=False,
        )
    finally:
        torch.randn = own_randn
    return {
        "condition": conditions[0][0].numpy(),  # (tokens, width)
        "network_output": outputs[0].numpy()[:, :, ::2, ::2],  # (2, 4, h, w): depth, normals
        "last_output": outputs[-1].numpy()[:, :, ::2, ::2],
        "depth_unclipped": decoded["depth"][0, 0].numpy()[::8, ::8],
        "normals_unscaled": decoded["normal"][0].numpy()[:, ::8, ::8],
        "depth": result.depth_np[::8, ::8],
        "normals": np.moveaxis(result.normal_np, -1, 0)[:, ::8, ::8],
    }


def main() -> None:
    """Write the slices of every case, and the output without the cross-domain attention of one."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--authors", required=True, help="folder geowizard/ of their repository")
    parser.add_argument("--out", required=True)
    arguments = parser.parse_args()
    sys.path.insert(0, arguments.authors)
    _stand_ins()
    found = {f"{case}/{name}": x for case in CASES for name, x in run_case(case, coupled=True).items()}
    found["uncoupled/network_output"] = run_case("v1_indoor", coupled=False)["network_output"]
    np.savez_compressed(arguments.out, **{name: x.astype(np.float32) for name, x in found.items()})


if __name__ == "__main__":
    main()
