"""Run DepthFM's own code on tiny networks with named weights, and keep slices of what it computes.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.depthfm_reference --authors depth-fm --out tests/parity/fixtures/depthfm.npz

The parity test builds our pipeline from the configurations below; PyTorch's attention stands in for xformers.
"""

import json
import tempfile
from pathlib import Path

import numpy as np
import torch

from tests.parity import authors
from tests.parity.named_weights import draw, fill

#: As in depthfm-v1.ckpt, but for fewer and narrower levels.
HPARAMS = {
    "image_size": 32,
    "in_channels": 8,
    "out_channels": 4,
    "model_channels": 32,
    "attention_resolutions": [2, 1],
    "num_res_blocks": 2,
    "channel_mult": [1, 2, 2],
    "num_heads": 4,
    "use_spatial_transformer": True,
    "use_linear_in_transformer": True,
    "transformer_depth": 1,
    "context_dim": 16,
    "legacy": False,
}
VAE = authors.WIDE_VAE
SIZE, NOISING_STEP, STEPS = (64, 128), 400, 3


def image_u8() -> np.ndarray:
    """``(H, W, 3)`` of noise."""
    return authors.image("image", SIZE, 50.0)


def prompt() -> np.ndarray:
    """``(1, 5, 16)`` in place of the empty prompt's embedding."""
    return draw("prompt", (1, 5, HPARAMS["context_dim"]))


def noise(shape: tuple[int, ...]) -> torch.Tensor:
    """What the start of the flow is noised with."""
    return torch.from_numpy(draw("noise", shape))


def make_model():
    """The authors' module with a small VAE and a small checkpoint, every weight by its name."""
    import depthfm  # noqa: F401 - puts its own folder on the path
    import dfm
    from diffusers import AutoencoderKL

    dfm.AutoencoderKL.from_pretrained = lambda *args, **kwargs: AutoencoderKL(**VAE)
    checkpoint = {
        "noising_step": NOISING_STEP,
        "empty_text_embedding": torch.from_numpy(prompt()),
        "ldm_hparams": HPARAMS,
        "state_dict": dfm.UNetModel(**HPARAMS).state_dict(),
    }
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "small.ckpt"
        torch.save(checkpoint, path)
        model = dfm.DepthFM(str(path))
    fill(model.model, "unet.")
    fill(model.vae, "vae.")
    return model.eval()


def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """Start of the flow, network output, its end, unclipped decode and final maps of one and two members."""
    authors.install(authors.XFORMERS)  # without it their code scales otherwise
    model = make_model()
    image = torch.from_numpy(image_u8()).permute(2, 0, 1)[None] / 127.5 - 1
    torch.randn_like = lambda x: noise(tuple(x.shape))
    velocities, decoded, ends = [], [], []
    model.model.register_forward_hook(lambda module, inputs, output: velocities.append(output))
    decode, generate = model.decode, model.generate

    def spy_decode(z):
        decoded.append(decode(z))
        return decoded[-1]

    def spy_generate(z, **kwargs):
        ends.extend((z, generate(z, **kwargs)))
        return ends[-1]

    model.decode, model.generate = spy_decode, spy_generate
    one = model.predict_depth(image, num_steps=STEPS, ensemble_size=1)
    two = model.predict_depth(image, num_steps=STEPS, ensemble_size=2)
    return {
        "start": ends[0].numpy(),
        "velocities": torch.cat(velocities[:STEPS]).numpy(),
        "end": ends[1].numpy(),
        "decoded": decoded[0].mean(1)[0, ::8, ::8].numpy(),
        "output": one[0, 0, ::8, ::8].numpy(),
        "output_of_two": two[0, 0, ::8, ::8].numpy(),
        "shapes": np.array(json.dumps({k: list(v.shape) for k, v in model.model.state_dict().items()})),
    }


if __name__ == "__main__":
    authors.write_fixture(run_authors)
