"""Run the authors' Pixel-Perfect Depth on named weights, and keep slices of what it answers.

``docs/appendix/parity.md`` describes the environment. Then, from the root of this repository::

    python -m tests.parity.ppd_reference --authors pixel-perfect-depth --out tests/parity/fixtures/ppd.npz

Their networks, sampler and resizing are imported, not copied; torchvision, timm and omegaconf are replaced by
empty modules, since nothing of them is called here but a helper that makes a pair of a number.
"""

from functools import partial
from pathlib import Path

import numpy as np
import torch

from tests.parity import authors
from tests.parity.named_weights import draw, named_state

#: A small DiT; the width of the semantic tokens, 1024, is fixed in their code.
DIT = {"hidden_size": 32, "depth": 4, "num_heads": 2}
SEMANTICS = {"img_size": 70, "embed_dim": 1024, "depth": 1, "num_heads": 16, "mlp_ratio": 1.0}
#: Multiples of 16, not square, and another grid than the 5 x 5 positions.
SIZE = (48, 80)
STEPS = 4
MIDDLE = 500
COUNTS = (1, 2, 3, 4, 5, 7, 10, 20, 50)
#: One of more and one of less pixels than 1024 x 768.
PHOTOS = {"large": (900, 1300), "small": (75, 113)}
#: Two parts of a map; of a resized image every 97th pixel. A few kB in all.
CORNERS = ((slice(None), slice(None), slice(0, 12), slice(0, 12)), (..., slice(30, 42), slice(66, 78)))


def image() -> torch.Tensor:
    """``(1, 3, 48, 80)`` in [0, 1]."""
    return torch.from_numpy(np.clip(0.5 + 0.2 * draw("image", (1, 3, *SIZE)), 0, 1))


def noise() -> torch.Tensor:
    """``(1, 1, 48, 80)``, where they draw."""
    return torch.from_numpy(draw("noise", (1, 1, *SIZE)))


def photo(kind: str) -> np.ndarray:
    """``(H, W, 3)`` uint8, RGB, smooth with some noise."""
    height, width = PHOTOS[kind]
    rows, columns = np.mgrid[:height, :width][..., None]
    waves = 90 * np.sin(rows / 9.0 + np.arange(3)) * np.cos(columns / 13.0)
    return np.clip(128 + waves + 8 * draw(kind, (height, width, 3)), 0, 255).astype(np.uint8)


def corners(values: torch.Tensor) -> np.ndarray:
    """The kept parts of a map, in one row."""
    return torch.cat([values[corner].flatten() for corner in CORNERS]).numpy()


def semantic_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of ``depth_anything_v2_vitl.pth``, smaller and without its depth head."""
    width, hidden = SEMANTICS["embed_dim"], int(SEMANTICS["embed_dim"] * SEMANTICS["mlp_ratio"])
    shapes = {
        "cls_token": (1, 1, width),
        "pos_embed": (1, (SEMANTICS["img_size"] // 14) ** 2 + 1, width),
        "mask_token": (1, width),
        "patch_embed.proj.weight": (width, 3, 14, 14),
        "patch_embed.proj.bias": (width,),
        "norm.weight": (width,),
        "norm.bias": (width,),
    }
    linear = {"attn.qkv": (3 * width, width), "attn.proj": (width, width)}
    linear |= {"mlp.fc1": (hidden, width), "mlp.fc2": (width, hidden)}
    for i in range(SEMANTICS["depth"]):
        for name in ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias", "ls1.gamma", "ls2.gamma"):
            shapes[f"blocks.{i}.{name}"] = (width,)
        for name, shape in linear.items():
            shapes |= {f"blocks.{i}.{name}.weight": shape, f"blocks.{i}.{name}.bias": shape[:1]}
    return {f"pretrained.{name}": shape for name, shape in shapes.items()}


def authors_model() -> torch.nn.Module:
    """Their ``PixelPerfectDepth``, whose constructor would read two files, with small networks."""
    from ppd.models.depth_anything_v2.dinov2 import DinoVisionTransformer
    from ppd.models.depth_anything_v2.dinov2_layers import MemEffAttention, NestedTensorBlock
    from ppd.models.depth_anything_v2.dpt import DepthAnythingV2
    from ppd.models.dit import DiT
    from ppd.models.ppd import PixelPerfectDepth

    model, encoder = PixelPerfectDepth.__new__(PixelPerfectDepth), DepthAnythingV2.__new__(DepthAnythingV2)
    torch.nn.Module.__init__(model)
    torch.nn.Module.__init__(encoder)
    block = partial(NestedTensorBlock, attn_class=MemEffAttention)
    options = {"patch_size": 14, "init_values": 1.0, "block_chunks": 0, "block_fn": block}
    encoder.pretrained = DinoVisionTransformer(**SEMANTICS, **options)
    encoder.load_state_dict(named_state(semantic_shapes()))  # strict: these are their names and shapes
    model.sem_encoder, model.dit = encoder, DiT(**DIT)
    model.device, model.sampling_steps = torch.device("cpu"), STEPS
    model.configure_diffusion()
    state = named_state({f"dit.{name}": tuple(v.shape) for name, v in model.dit.state_dict().items()})
    model.dit.load_state_dict({name: state[f"dit.{name}"] for name in model.dit.state_dict()})
    return model.eval()


#: In the place of what their files import on the way.
STAND_INS = {
    "torchvision": {},
    "torchvision.transforms": {"Compose": None},
    "timm": {},
    "timm.layers": {},
    "timm.layers.grn": {"GlobalResponseNorm": None},
    "timm.layers.helpers": {"to_2tuple": lambda x: x if isinstance(x, tuple) else (x, x)},
    "omegaconf": {"DictConfig": dict},
}


@torch.no_grad()
def run_authors(folder: Path) -> dict[str, np.ndarray]:
    """Slices of networks, sampler and resizing."""
    authors.install(STAND_INS)
    from ppd.utils.diffusion.timesteps import Timesteps
    from ppd.utils.transform import image2tensor, resize_keep_aspect

    model, kept = authors_model(), {}
    semantics = model.semantics_prompt(image())
    joined = torch.cat([noise(), image() - 0.5], dim=1)
    kept["semantics"] = semantics[:, :, ::64].numpy()
    kept["velocity"] = corners(model.dit(x=joined, semantics=semantics, timestep=torch.tensor(MIDDLE)))
    drawn, torch.randn = torch.randn, lambda size: noise()
    kept["final"] = corners(model.forward_test(image()))
    torch.randn = drawn
    for count in COUNTS:
        kept[f"timesteps_{count}"] = Timesteps(1000, count).timesteps.numpy()
    for kind in PHOTOS:
        resized = image2tensor(resize_keep_aspect(photo(kind)[:, :, ::-1].copy()))
        kept[f"{kind}_size"] = np.array(resized.shape[-2:])
        kept[kind] = resized[:, :, ::97, ::97].numpy()
    return kept


if __name__ == "__main__":
    authors.write_fixture(run_authors)
