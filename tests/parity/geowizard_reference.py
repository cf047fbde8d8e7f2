"""Run GeoWizard's own code on tiny networks with named weights, and keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.geowizard_reference --authors GeoWizard/geowizard \
        --out tests/parity/fixtures/geowizard.npz

The parity test builds our pipeline from the configurations below; torch replaces torchvision and xformers.
"""

import string
import tempfile
from pathlib import Path

import numpy as np

from tests.parity import authors
from tests.parity.authors import ENCODER, SCHEDULER, TEXT, VAE
from tests.parity.named_weights import draw, fill

UNET = authors.UNET | {"in_channels": 8, "class_embed_type": "projection"}
VISION = ENCODER | {"image_size": 32, "patch_size": 8, "projection_dim": 8}
CROP = {"height": 32, "width": 32}
STEPS = 10
SIZE = (48, 64)
#: case -> (class embedding width, domain)
CASES = {"v1_indoor": (10, "indoor"), "v1_object": (10, "object"), "v2_outdoor": (4, "outdoor")}


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` uint8."""
    return authors.image("geowizard/image", SIZE)


def noise() -> np.ndarray:
    """``(1, 4, h, w)``, what both halves start from."""
    return draw("geowizard/noise", (1, 4, SIZE[0] // 8, SIZE[1] // 8))


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
            files = authors.write_tokenizer(folder, string.ascii_lowercase)
            parts["tokenizer"] = CLIPTokenizer(*files)
        pipe = geowizard_v2_pipeline.DepthNormalEstimationPipeline(**parts)
    if coupled:  # theirs fails without CUDA, and run_infer.py swallows that
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


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """The slices of every case, and the output without the cross-domain attention of one."""
    authors.install(authors.TORCHVISION | authors.XFORMERS)
    found = {f"{case}/{name}": x for case in CASES for name, x in run_case(case, coupled=True).items()}
    return found | {"uncoupled/network_output": run_case("v1_indoor", coupled=False)["network_output"]}


if __name__ == "__main__":
    authors.write_fixture(run_authors)
