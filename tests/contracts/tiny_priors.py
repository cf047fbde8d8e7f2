"""One tiny random pipeline per key of ``PRIORS``, for the contract tests and as folders to try."""

from __future__ import annotations

import numpy as np
from diffusers import DDIMScheduler, DiffusionPipeline, MarigoldDepthPipeline
from transformers import CLIPTokenizer

from examples.marigold_v2 import tiny_marigold_v2
from geodiff_plugin.priors import load_prior
from geodiff_plugin.priors.e2e_ft import E2EFTPipeline
from tests.conftest import SCHEDULER, make_text_encoder, make_unet, make_vae
from tests.contracts.tiny_depthfm import make_depthfm
from tests.contracts.tiny_depthmaster import make_depthmaster
from tests.contracts.tiny_geowizard import make_geowizard
from tests.contracts.tiny_lotus import make_lotus
from tests.contracts.tiny_ppd import make_ppd
from tests.contracts.tiny_transformers import make_transformers


def make_tokenizer() -> CLIPTokenizer:
    """Of the empty prompt and the letter a."""
    vocab = {"<|startoftext|>": 0, "<|endoftext|>": 1, "a</w>": 2, "a": 3}
    return CLIPTokenizer(vocab=vocab, merges=[], model_max_length=77)


def _marigold_parts() -> dict:
    return {
        "unet": make_unet().eval(),
        "vae": make_vae().eval(),
        "text_encoder": make_text_encoder().eval(),
        "tokenizer": make_tokenizer(),
        "prediction_type": "depth",
        "default_processing_resolution": 64,
    }


def make_marigold() -> MarigoldDepthPipeline:
    """Marigold v1-1's schedule, two steps."""
    scheduler = DDIMScheduler(**SCHEDULER)
    pipe = MarigoldDepthPipeline(**_marigold_parts(), scheduler=scheduler, default_denoising_steps=2)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def make_e2e_ft() -> E2EFTPipeline:
    """The same networks, one step from zeros."""
    scheduler = DDIMScheduler(**SCHEDULER | {"rescale_betas_zero_snr": False})
    pipe = E2EFTPipeline(**_marigold_parts(), scheduler=scheduler)
    pipe.set_progress_bar_config(disable=True)
    return pipe


def make_map() -> DiffusionPipeline:
    """Needs ``CALL["map"]`` in its call."""
    pipe = load_prior("map")
    pipe.set_progress_bar_config(disable=True)
    return pipe


TINY = {
    "marigold-v2": tiny_marigold_v2,
    "marigold": make_marigold,
    "e2e-ft": make_e2e_ft,
    "lotus": make_lotus,
    "geowizard": make_geowizard,
    "depthmaster": make_depthmaster,
    "depthfm": make_depthfm,
    "ppd": make_ppd,
    "transformers": make_transformers,
    "map": make_map,
}

_MAP = np.add.outer(np.linspace(3.0, 1.0, 21), 0.2 * np.sin(np.arange(33.0)))
_MAP[5:9, 20:25] = np.nan
#: What a call of a prior must be given beside the image.
CALL: dict[str, dict[str, np.ndarray]] = {"map": {"depth_map": _MAP}}
