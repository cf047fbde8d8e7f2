"""What a camera does to an image: white balance, contrast, vignetting, blur, noise, JPEG, grey.

Data flow: a clean sRGB image -> the same image as a real camera would have written it.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

__all__ = ["CameraEffects", "apply_effects", "indoor_cameras", "sample_effects"]


@dataclass(frozen=True)
class CameraEffects:
    """One camera's imperfections; the defaults change nothing.

    Attributes:
        gain: exposure relative to the automatic one (applied before the tone curve).
        white_balance: factors of red, green and blue.
        gamma: exponent on the sRGB image.
        contrast: around mid grey.
        saturation: 0 grey, 1 unchanged.
        vignette: darkening in the corners, in [0, 1].
        blur_px: sigma of a Gaussian.
        noise: standard deviation of the sensor noise at mid grey.
        jpeg_quality: 1 to 95; 0 for none.
        seed: of the noise.
    """

    gain: float = 1.0
    white_balance: tuple[float, float, float] = (1.0, 1.0, 1.0)
    gamma: float = 1.0
    contrast: float = 1.0
    saturation: float = 1.0
    vignette: float = 0.0
    blur_px: float = 0.0
    noise: float = 0.0
    jpeg_quality: int = 0
    seed: int = 0


def sample_effects(rng: np.random.Generator, size: tuple[int, int], grey: float = 0.2) -> CameraEffects:
    """Draw plausible imperfections.

    Args:
        rng: source of randomness.
        size: ``(H, W)``; a small image is an image scaled down, with less blur and noise left.
        grey: share of grey images.
    """
    scale = min(1.0, max(size) / 320)
    tint = 1 + rng.normal(0, 0.05, 3) if rng.random() < 0.7 else np.ones(3)
    return CameraEffects(
        gain=float(np.exp(rng.normal(0, 0.25))),
        white_balance=tuple(float(x) for x in np.clip(tint / tint.mean(), 0.8, 1.25)),
        gamma=float(np.exp(rng.normal(0, 0.12))),
        contrast=float(rng.uniform(0.85, 1.25) if rng.random() < 0.6 else rng.uniform(1.1, 1.6)),
        saturation=0.0 if rng.random() < grey else float(rng.uniform(0.4, 1.25)),
        vignette=float(rng.uniform(0, 0.35)) if rng.random() < 0.4 else 0.0,
        blur_px=scale * float(rng.uniform(0.3, 1.2)) if rng.random() < 0.65 else 0.0,
        noise=scale * float(0.002 + 0.038 * rng.random() ** 2) if rng.random() < 0.7 else 0.0,
        jpeg_quality=int(rng.integers(35, 95)) if rng.random() < 0.35 else 0,
        seed=int(rng.integers(1 << 31)),
    )


def indoor_cameras(seed: int) -> tuple[CameraEffects, CameraEffects]:
    """Both cameras of a small stereo rig in a dim room: noisy, soft, darker in the corners, mostly grey.

    Args:
        seed: what they are drawn from; the cameras differ in their noise alone.
    """
    rng = np.random.default_rng([seed, 54])
    left = CameraEffects(
        contrast=float(rng.uniform(0.9, 1.1)),
        saturation=0.0 if rng.random() < 0.7 else 1.0,
        vignette=float(rng.uniform(0.1, 0.35)),
        blur_px=float(rng.uniform(0.3, 0.8)),
        noise=float(rng.uniform(0.004, 0.016)),
        jpeg_quality=int(rng.integers(70, 95)) if rng.random() < 0.35 else 0,
        seed=int(rng.integers(1 << 31)),
    )
    return left, replace(left, seed=left.seed + 1)


def _blurred(image: torch.Tensor, sigma: float) -> torch.Tensor:
    radius = max(1, min(int(np.ceil(2.5 * sigma)), min(image.shape[-2:]) - 1))
    x = torch.arange(-radius, radius + 1, device=image.device, dtype=image.dtype)
    kernel = torch.exp(-(x * x) / (2 * sigma * sigma))
    kernel = kernel / kernel.sum()
    out = F.pad(image[:, None], (radius, radius, radius, radius), mode="replicate")
    out = F.conv2d(out, kernel.view(1, 1, 1, -1))
    return F.conv2d(out, kernel.view(1, 1, -1, 1))[:, 0]


def _jpeg(image: torch.Tensor, quality: int) -> torch.Tensor:
    array = (image.clamp(0, 1) * 255).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "JPEG", quality=quality)
    with Image.open(io.BytesIO(buffer.getvalue())) as back:
        decoded = np.asarray(back.convert("RGB"), dtype=np.float32) / 255
    return torch.from_numpy(decoded).permute(2, 0, 1).to(image.device)


def apply_effects(image_01: torch.Tensor, effects: CameraEffects) -> torch.Tensor:
    """Apply everything but ``gain`` (which belongs before the tone curve, see ``render.expose``).

    Args:
        image_01: ``(3, H, W)`` float32 in [0, 1], sRGB.
        effects: what to apply.

    Returns:
        ``(3, H, W)`` float32 in [0, 1].
    """
    e, x = effects, image_01
    x = x * x.new_tensor(e.white_balance)[:, None, None]
    if e.saturation != 1:
        luma = (x * x.new_tensor((0.299, 0.587, 0.114))[:, None, None]).sum(0, keepdim=True)
        x = luma + (x - luma) * e.saturation
    if e.contrast != 1:
        x = 0.45 + (x - 0.45) * e.contrast
    x = x.clamp(0, 1)
    if e.gamma != 1:
        x = x.clamp_min(1e-4).pow(e.gamma)
    if e.vignette > 0:
        height, width = x.shape[-2:]
        u = torch.linspace(-1, 1, width, device=x.device)
        v = torch.linspace(-1, 1, height, device=x.device)
        x = x * (1 - e.vignette * 0.5 * (u[None] ** 2 + v[:, None] ** 2))
    if e.blur_px > 0:
        x = _blurred(x, e.blur_px)
    if e.noise > 0:
        # Drawn on the CPU so that every device gets the same noise; shot noise grows with the signal.
        draw = torch.randn(x.shape, generator=torch.Generator().manual_seed(e.seed)).to(x.device)
        if e.saturation == 0:
            draw = draw[:1]
        x = x + draw * e.noise * (0.4 + 1.2 * x).sqrt()
    x = x.clamp(0, 1)
    return _jpeg(x, e.jpeg_quality) if e.jpeg_quality else x
