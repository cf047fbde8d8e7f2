"""Prompt embeddings for U-Nets with cross-attention: encoded, or saved with the weights."""

from __future__ import annotations

import torch
from diffusers import ModelMixin
from diffusers.configuration_utils import ConfigMixin, register_to_config
from torch import Tensor
from transformers import CLIPTextModel, CLIPTokenizer

__all__ = ["FixedPrompt", "text_embedding"]


def text_embedding(
    tokenizer: CLIPTokenizer, text_encoder: CLIPTextModel, device: torch.device, prompt: str = ""
) -> Tensor:
    """Embedding of a prompt, not padded, as Marigold and its descendants were trained with.

    Args:
        tokenizer: of the text encoder.
        text_encoder: its weights may be offloaded.
        device: where it computes.
        prompt: its words; empty for most depth priors, which leaves the start and the end token.

    Returns:
        ``(1, n, C)`` of the text encoder's dtype.
    """
    tokens = tokenizer(
        prompt,
        padding="do_not_pad",
        max_length=tokenizer.model_max_length,
        truncation=True,
        return_tensors="pt",
    )
    return text_encoder(tokens.input_ids.to(device))[0]


class FixedPrompt(ModelMixin, ConfigMixin):
    """A text embedding that was saved instead of the text encoder that made it.

    Args:
        length: tokens n.
        width: channels C.

    Attributes:
        embedding: ``(1, n, C)``.
    """

    @register_to_config
    def __init__(self, length: int = 77, width: int = 1024) -> None:
        super().__init__()
        self.embedding = torch.nn.Parameter(torch.zeros(1, length, width), requires_grad=False)

    def forward(self) -> Tensor:
        """The embedding; a call brings it back where it is offloaded."""
        return self.embedding
