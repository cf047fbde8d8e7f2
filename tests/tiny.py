"""A tiny random Marigold, one that knows the depth, and a pair of renderings of a tilted, textured plane."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from diffusers import AutoencoderKL, DDIMScheduler, MarigoldDepthPipeline, ModelMixin, UNet2DConditionModel
from diffusers.configuration_utils import ConfigMixin, register_to_config
from transformers import CLIPTextConfig, CLIPTextModel, CLIPTokenizer

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin.cameras import PosedViews
from geodiff_plugin.evidence.pose_check import CheckedPoses, check_poses, image_facts
from geodiff_plugin.matching.rows import RowImages, RowMatches, match_rows, row_matches
from geodiff_plugin.pose.fit import measure_fit, posed_greys

SCHEDULER = {
    "beta_schedule": "scaled_linear",
    "beta_start": 0.00085,
    "beta_end": 0.012,
    "prediction_type": "v_prediction",
    "timestep_spacing": "trailing",
    "rescale_betas_zero_snr": True,
    "clip_sample": False,
    "set_alpha_to_one": False,
}


def make_unet(seed: int = 0) -> UNet2DConditionModel:
    torch.manual_seed(seed)
    return UNet2DConditionModel(
        sample_size=16,
        in_channels=8,
        out_channels=4,
        block_out_channels=(8, 16),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=8,
        attention_head_dim=4,
        norm_num_groups=4,
    )


def make_vae(seed: int = 1) -> AutoencoderKL:
    torch.manual_seed(seed)
    return AutoencoderKL(
        block_out_channels=(8, 16),
        in_channels=3,
        out_channels=3,
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        latent_channels=4,
        norm_num_groups=4,
        scaling_factor=0.5,
    )


def make_text_encoder(seed: int = 2) -> CLIPTextModel:
    torch.manual_seed(seed)
    size = {"hidden_size": 8, "intermediate_size": 8, "num_attention_heads": 2, "num_hidden_layers": 1}
    return CLIPTextModel(CLIPTextConfig(**size, vocab_size=4))


def make_tokenizer(letters: str = "a") -> CLIPTokenizer:
    """Of the empty prompt and some letters."""
    tokens = ["<|startoftext|>", "<|endoftext|>"]
    tokens += ["a</w>", "a"] if letters == "a" else [*letters, *(letter + "</w>" for letter in letters)]
    return CLIPTokenizer(vocab={t: i for i, t in enumerate(tokens)}, merges=[], model_max_length=77)


def quiet(pipe: Any) -> Any:
    """Without progress bars."""
    pipe.set_progress_bar_config(disable=True)
    return pipe


def make_marigold(scheduler=None, **config) -> MarigoldDepthPipeline:
    """Marigold v1-1's schedule, two steps."""
    networks = make_unet().eval(), make_vae().eval(), scheduler or DDIMScheduler(**SCHEDULER)
    config = {"default_denoising_steps": 2, "default_processing_resolution": 64} | config
    text = make_text_encoder().eval(), make_tokenizer()
    return quiet(MarigoldDepthPipeline(*networks, *text, **{"prediction_type": "depth"} | config))


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def guided_call(pipe, pair, parameters=(), **call):
    """The output of a seeded call on a pair, guided by ``parameters`` or by a guidance that is made."""
    if not isinstance(parameters, GeometryGuidance):
        parameters = GeometryGuidance(pair.right, pair.K, pair.E, **dict(parameters))
    drawn = {} if "latents" in call else {"generator": seeded()}
    return enable_geometry_guidance(pipe)(pair.left, guidance=parameters, **drawn | call)


@dataclass(frozen=True)
class PlanePair:
    left: np.ndarray  # (H, W, 3) uint8
    right: np.ndarray
    K: np.ndarray
    E: np.ndarray
    depth_m: np.ndarray  # (H, W)


def textured(xy: np.ndarray, seed: int) -> np.ndarray:
    """A smooth random texture on a plane: sums of plane waves, (..., 3) in [0, 1]."""
    rng = np.random.default_rng(seed)
    value = np.zeros((*xy.shape[:-1], 3))
    for _ in range(24):
        direction, phase = rng.normal(size=2) * rng.uniform(2.0, 14.0), rng.uniform(0, 2 * np.pi, 3)
        value += np.sin((xy @ direction)[..., None] + phase)
    return 0.5 + 0.5 * np.tanh(value / 4.0)


def render_plane(K, camera_to_world, size, normal, offset, seed):
    """Intersect pixel rays with ``normal . p = offset``; returns image and planar depth."""
    height, width = size
    v, u = np.mgrid[:height, :width].astype(np.float64)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ camera_to_world[:3, :3].T
    origin = camera_to_world[:3, 3]
    depth = (offset - normal @ origin) / (rays @ normal)
    points = origin + rays * depth[..., None]
    image = textured(points[..., :2], seed)
    return (image * 255).round().astype(np.uint8), depth.astype(np.float32)


def plane_pair(
    size=(48, 64), baseline=0.12, rotation_y=0.0, seed=0, focal=60.0, normal=(0.25, -0.35, 1.0)
) -> PlanePair:
    K = np.array([[focal, 0, size[1] / 2 - 0.5], [0, focal, size[0] / 2 - 0.5], [0, 0, 1]])
    E = np.eye(4)
    c, s = np.cos(rotation_y), np.sin(rotation_y)
    E[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    E[0, 3] = baseline
    left, depth = render_plane(K, np.eye(4), size, np.array(normal), 2.0, seed)
    right, _ = render_plane(K, E, size, np.array(normal), 2.0, seed)
    return PlanePair(left, right, K, E, depth)


class OracleVAE(ModelMixin, ConfigMixin):
    """Latent = map: channel 0 holds the relative depth, no compression."""

    @register_to_config
    def __init__(self, block_out_channels=(1,), latent_channels=4, scaling_factor=1.0):
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(()))

    def encode(self, x):
        latent = torch.cat([x, torch.zeros_like(x[:, :1])], dim=1) * self.unit
        return SimpleNamespace(latent_dist=SimpleNamespace(mode=lambda: latent))

    def decode(self, z, return_dict=False):
        return ((2.0 * z[:, :1] - 1.0).repeat(1, 3, 1, 1) * self.unit,)


class OracleUNet(ModelMixin, ConfigMixin):
    """Predicts the clean latent of a known relative depth ("sample" prediction)."""

    @register_to_config
    def __init__(self):
        super().__init__()
        self.unit = torch.nn.Parameter(torch.ones(()))
        self.relative = None  # (1, 1, H, W)

    def forward(self, sample, t, encoder_hidden_states=None, return_dict=False):
        z0 = self.relative.to(sample).expand(sample.shape[0], 4, -1, -1)
        return (z0 * self.unit + 0.0 * sample[:, 4:],)


def make_oracle(relative: np.ndarray, prediction_type: str = "depth") -> MarigoldDepthPipeline:
    """A Marigold whose denoiser knows the relative depth ``(H, W)`` up to an affine map."""
    unet = OracleUNet()
    unet.relative = torch.from_numpy(relative)[None, None].float()
    clean = {"prediction_type": "sample", "rescale_betas_zero_snr": False, "set_alpha_to_one": True}
    parts = unet, OracleVAE(), DDIMScheduler(**SCHEDULER | clean), make_text_encoder(), make_tokenizer()
    reported = {"default_denoising_steps": 2, "default_processing_resolution": 0}
    return quiet(MarigoldDepthPipeline(*parts, prediction_type=prediction_type, **reported))


def checked_views(posed: PosedViews, measured: bool = False) -> CheckedPoses:
    """What ``check_poses`` makes of views whose fit is measured first."""
    greys = posed_greys(posed)
    return check_poses(posed, measure_fit(greys), image_facts(greys), measured)


def rows_of(images: RowImages, nearest_px: float) -> RowMatches:
    """The matches along the rows of a pair; ``nearest_px`` is the largest shift of the search."""
    return row_matches(images, match_rows(images, images.greys(images.levels.cpu()), nearest_px))
