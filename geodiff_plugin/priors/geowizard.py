"""GeoWizard v1 and v2: depth and normals from the same noise (Fu et al., ECCV 2024)."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from diffusers import AutoencoderKL, DDIMScheduler, UNet2DConditionModel
from diffusers.models.attention_processor import Attention, AttnProcessor2_0
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer, CLIPVisionModelWithProjection
from transformers.image_utils import OPENAI_CLIP_MEAN, OPENAI_CLIP_STD

from geodiff_plugin._internal.checks import bad_value, check_choice
from geodiff_plugin.priors.loading import Layout, build_pipeline, load_component
from geodiff_plugin.priors.pipeline import Condition, DepthDiffusionPipeline, Generators, normalized

DOMAINS = ("indoor", "outdoor", "object")
#: Width of the class embedding of a U-Net that is also conditioned on the image (v1).
IMAGE_EMBEDDING = 10
#: Width of the class embedding of a U-Net that is also conditioned on the domain as text (v2).
TEXT_PROMPT = 4
#: The authors' subfolder of the second version.
UNET_V2 = "unet_v2"
#: Added to the length of a decoded normal before dividing by it.
EPS_LENGTH = 1e-5


class PairAttention(AttnProcessor2_0):
    """Self-attention over both members of a pair: every token attends to depth and normal tokens."""

    def __call__(self, attn: Attention, hidden_states: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        """Attend to tokens ``(2B, n, c)``, all depth before all normals, as ``(B, 2n, c)``."""
        pair = torch.cat(hidden_states.chunk(2), dim=1)
        return torch.cat(super().__call__(attn, pair, *args, **kwargs).chunk(2, dim=1))


class GeoWizardPipeline(DepthDiffusionPipeline):
    """GeoWizard v1 (conditioned on the image through CLIP) and v2 (on the domain as text).

    Guidance changes only the depth half.

    Convention:
        Normals are unit vectors in the left camera's frame (x right, y down, z forward) on the visible side
        of the surface: a wall facing the camera has ``(0, 0, -1)``. GeoWizard's own files contain the
        opposite vectors. They are resized with nearest-neighbour sampling, which keeps their length.
    """

    depth_channels = slice(0, 4)
    normal_channels = slice(4, 8)
    model_cpu_offload_seq = "image_encoder->text_encoder->unet->vae"
    _optional_components = ["image_encoder", "text_encoder", "tokenizer"]

    def __init__(
        self,
        unet: UNet2DConditionModel,
        vae: AutoencoderKL,
        scheduler: DDIMScheduler,
        image_encoder: CLIPVisionModelWithProjection | None = None,
        text_encoder: CLIPTextModel | None = None,
        tokenizer: CLIPTokenizer | None = None,
        prediction_type: str = "depth",
        default_denoising_steps: int = 10,
        default_processing_resolution: int = 768,
        default_domain: str = "indoor",
    ) -> None:
        super().__init__()
        parts = {"image_encoder": image_encoder, "text_encoder": text_encoder, "tokenizer": tokenizer}
        needed = {IMAGE_EMBEDDING: ["image_encoder"], TEXT_PROMPT: ["text_encoder", "tokenizer"]}
        wanted = needed.get(unet.config.projection_class_embeddings_input_dim)
        if wanted is None or any(parts[name] is None for name in wanted):
            got = [name for name, part in parts.items() if part is not None]
            bad_value("components", f"a U-Net of GeoWizard v1 or v2 with {wanted}", got)
        couple_pairs(unet)
        defaults = prediction_type, default_denoising_steps, default_processing_resolution
        domain = check_choice(default_domain, "default_domain", DOMAINS)
        modules = {"unet": unet, "vae": vae, "scheduler": scheduler, **parts}
        self.register_prior(modules, *defaults, default_domain=domain)

    @staticmethod
    def recognises(layout: Layout) -> bool:
        """Recognise a U-Net from 8 to 4 channels with a class embedding of width 10 (v1) or 4 (v2).

        A Lotus-G has the latter too, so v2 also needs its subfolder's name or the saved domain.
        """
        unet = layout.config(_unet_folder(layout))
        if (unet.get("in_channels"), unet.get("out_channels")) != (8, 4):
            return False
        width = unet.get("projection_class_embeddings_input_dim")
        is_v2 = _unet_folder(layout) == UNET_V2 or "default_domain" in layout.index
        return width == IMAGE_EMBEDDING or (width == TEXT_PROMPT and is_v2)

    @classmethod
    def load(cls, layout: Layout, dtype: torch.dtype, space: str | None) -> GeoWizardPipeline:
        """Load this package's folder or the authors', whose v2 has ``unet_v2`` and parts of SD 2."""
        unet = None
        if _unet_folder(layout) == UNET_V2:
            unet = load_component(layout, UNET_V2, UNet2DConditionModel, dtype)
        return build_pipeline(cls, layout, dtype, unet=unet, prediction_type=space)

    def prepare_condition(
        self,
        image: Tensor,
        ensemble_size: int,
        batch_size: int,
        generator: Generators,
        domain: str | None = None,
    ) -> Condition:
        """Return latent, prompt and labels ``(N * E, 2, 10 or 4)`` of both halves."""
        domain = check_choice(domain or self.config.default_domain, "domain", DOMAINS)
        couple_pairs(self.unet)  # again: with other processors depth and normals are decoupled
        of_image = self.unet.config.projection_class_embeddings_input_dim == IMAGE_EMBEDDING
        prompt = self._image_prompt(image) if of_image else self.prompt_embedding(image, f"{domain} geometry")
        labels = class_embedding(domain if of_image else None).to(image)
        return {
            "image_latent": self.image_latents(image, ensemble_size, batch_size),
            "prompt": prompt.repeat_interleave(ensemble_size, dim=0),
            "class_labels": labels.expand(len(image) * ensemble_size, -1, -1),
        }

    def _image_prompt(self, image: Tensor) -> Tensor:
        """Compute CLIP's embedding of the whole image resized to its square, ``(N, 1, width)``."""
        size = (self.image_encoder.config.image_size,) * 2
        statistics = OPENAI_CLIP_MEAN, OPENAI_CLIP_STD
        mean, std = (image.new_tensor(v, dtype=torch.float32)[:, None, None] for v in statistics)
        image_01 = (image.float() + 1.0) / 2.0
        small = F.interpolate(image_01, size, mode="bicubic", align_corners=False, antialias=True)
        embeds = self.image_encoder(((small - mean) / std).to(image.dtype)).image_embeds
        return embeds[:, None].to(image.dtype)

    def prepare_latents(self, condition: Condition, generator: Generators) -> Tensor:
        """Draw the same Gaussian noise for depth and normals, ``(N * E, 8, h, w)``."""
        return super().prepare_latents(condition, generator).repeat(1, 2, 1, 1)

    def denoise(self, latents: Tensor, timestep: Tensor, condition: Condition) -> Tensor:
        """Run the U-Net on both halves, ``(B, 8, h, w)``."""
        geometry = torch.cat([latents[:, self.depth_channels], latents[:, self.normal_channels]])
        of_pairs = {
            "prompt": condition["prompt"].repeat(2, 1, 1),
            "class_labels": torch.cat(condition["class_labels"].unbind(dim=1)),
        }
        sample = torch.cat([condition["image_latent"].repeat(2, 1, 1, 1), geometry], dim=1)
        output = self.run_unet(sample, timestep, of_pairs)  # (2B, 4, h, w)
        return torch.cat(output.chunk(2), dim=1)

    def decode_prediction(self, latents: Tensor) -> Tensor:
        """Decode like the authors: clipped, then normalized so that every map spans [0, 1]."""
        return normalized(super().decode_prediction(latents))

    def decode_extras(self, latents: Tensor, ensemble_size: int) -> dict[str, Tensor]:
        """Decode ``{"normals": (N, 3, H, W)}`` of every image: the member closest to the mean of all."""
        halves = latents[:, self.normal_channels].split(1)
        normals = torch.cat([self.decode_image(half) for half in halves])
        normals = normals / (normals.norm(dim=1, keepdim=True) + EPS_LENGTH)
        return {"normals": torch.cat([closest_to_mean(m) for m in normals.split(ensemble_size)])}


def class_embedding(domain: str | None) -> Tensor:
    """Embed one-hot codes of depth and normals as sines and cosines, ``(2, 10)`` or ``(2, 4)``."""
    here: dict[str, Any] = {"dtype": torch.float32, "device": "cpu"}
    codes = [torch.tensor([[0.0, 1.0], [1.0, 0.0]], **here)]
    if domain is not None:
        codes.append(torch.eye(len(DOMAINS), **here)[[DOMAINS.index(domain)] * 2])
    return torch.cat([f(code) for code in codes for f in (torch.sin, torch.cos)], dim=1)


def closest_to_mean(normals: Tensor) -> Tensor:
    """Return the member of unit vectors ``(E, 3, H, W)`` closest in angle to their mean, ``(1, 3, H, W)``."""
    mean = F.normalize(normals.mean(dim=0, keepdim=True), dim=1)
    angle = torch.acos((normals * mean).sum(dim=1).clamp(-1.0, 1.0)).sum(dim=(1, 2))  # (E,)
    return normals[angle.argmin()][None]


def couple_pairs(unet: UNet2DConditionModel) -> None:
    """Let every self-attention of the transformer blocks attend to the pair; it has no weights of its own."""
    names = (name for name in unet.attn_processors if name.endswith("attn1.processor"))
    unet.set_attn_processor(unet.attn_processors | dict.fromkeys(names, PairAttention()))


def _unet_folder(layout: Layout) -> str:
    """Return the authors' folder of v2 if it is the only U-Net folder."""
    both = ((layout.folder / name).exists() for name in ("unet", UNET_V2))
    return UNET_V2 if tuple(both) == (False, True) else "unet"
