from __future__ import annotations

import pytest
import torch
from transformers import DepthAnythingConfig, DepthAnythingForDepthEstimation, Dinov2Config

from geodiff_plugin.cli.convert import run_convert
from geodiff_plugin.priors.folders import Layout
from geodiff_plugin.priors.pipelines.pixel_dit import PixelDiT
from geodiff_plugin.priors.ppd import AreaImageProcessor, PPDPrior, area_resize
from tests.contracts.tiny_ppd import make_ppd


@pytest.mark.parametrize("size", [(75, 113), (113, 75), (20, 300), (400, 300)])
def test_grid_keeps_the_area_and_scales_each_axis_by_its_own_factor(size):
    resized, padding, given = AreaImageProcessor(vae_scale_factor=16).preprocess(torch.rand(1, 3, *size), 128)
    height, width = resized.shape[-2:]
    assert padding == (0, 0) and tuple(given) == size
    assert height % 16 == width % 16 == 0
    exact = (128 * 96 / (size[0] * size[1])) ** 0.5
    assert abs(height - exact * size[0]) <= 8 and abs(width - exact * size[1]) <= 8
    assert resized.min() >= -1 and resized.max() <= 1


def test_native_resolution_is_padded_to_the_patches():
    image = torch.rand(1, 3, 75, 113)
    padded, padding, _ = AreaImageProcessor(vae_scale_factor=16).preprocess(image, 0)
    assert tuple(padded.shape[-2:]) == (80, 128) and padding == (5, 15)
    torch.testing.assert_close(padded[:, :, :75, :113], image * 2 - 1)


def test_area_resize_is_the_mean_of_whole_blocks_and_keeps_a_constant():
    image = torch.rand(1, 2, 12, 18)
    torch.testing.assert_close(area_resize(image, (4, 6)), torch.nn.functional.avg_pool2d(image, 3))
    torch.testing.assert_close(area_resize(torch.ones(1, 1, 37, 51), (16, 32)), torch.ones(1, 1, 16, 32))


def test_map_is_the_size_of_the_image_and_half_precision_is_finite():
    pipe = make_ppd().to(torch.bfloat16)
    out = pipe(torch.rand(1, 3, 50, 81), output_type="pt", generator=torch.Generator().manual_seed(0))
    assert tuple(out.prediction.shape) == (1, 1, 50, 81)
    assert out.prediction.dtype == torch.float32 and out.prediction.isfinite().all()


def test_gradient_checkpointing_changes_nothing():
    dit, gradients = make_ppd().dit, []
    torch.manual_seed(0)
    image, tokens = torch.rand(1, 3, 32, 48), torch.rand(1, 6, 64)
    for enabled in (False, True):
        if enabled:
            dit.enable_gradient_checkpointing()
        z = torch.ones(1, 1, 32, 48, requires_grad=True)
        output = dit(torch.cat([z, image], dim=1), tokens, torch.tensor(500.0))
        gradients.append(torch.autograd.grad(output.square().sum(), z)[0])
    torch.testing.assert_close(*gradients)
    assert gradients[0].abs().sum() > 0


def save_depth_anything(folder) -> DepthAnythingForDepthEstimation:
    """A small Depth Anything V2 as transformers saves it."""
    torch.manual_seed(0)
    vit = {"hidden_size": 64, "num_hidden_layers": 4, "num_attention_heads": 1, "mlp_ratio": 1}
    stages = {"out_features": [f"stage{i}" for i in range(1, 5)], "reshape_hidden_states": False}
    backbone = Dinov2Config(**vit, **stages, image_size=28, patch_size=14)
    sizes = {"reassemble_hidden_size": 64, "neck_hidden_sizes": [8] * 4, "fusion_hidden_size": 8}
    model = DepthAnythingForDepthEstimation(DepthAnythingConfig(backbone_config=backbone, **sizes))
    model.save_pretrained(folder)
    return model


def save_checkpoint(file, semantic_size: int) -> PixelDiT:
    """A small ppd.pth."""
    dit = PixelDiT(hidden_size=16, depth=2, num_heads=2, semantic_size=semantic_size)
    torch.save({f"dit.{name}": value for name, value in dit.state_dict().items()}, file)
    return dit


def test_the_encoder_may_come_from_a_folder_of_transformers(tmp_path):
    model, dit = save_depth_anything(tmp_path / "da2"), save_checkpoint(tmp_path / "ppd.pth", 64)
    run_convert([tmp_path / "ppd.pth", tmp_path / "out"], str(tmp_path / "da2"))
    pipe = PPDPrior.load(Layout(tmp_path / "out", "out"), torch.float32, None)
    torch.testing.assert_close(dict(pipe.dit.state_dict()), dict(dit.state_dict()))
    wanted = model.backbone.state_dict()
    for name, value in pipe.semantic_encoder.state_dict().items():
        torch.testing.assert_close(value, wanted[name])


def test_an_encoder_of_another_width_is_refused(tmp_path):
    save_depth_anything(tmp_path / "da2"), save_checkpoint(tmp_path / "ppd.pth", 128)
    with pytest.raises(ValueError, match="128 wide"):
        run_convert([tmp_path / "ppd.pth", tmp_path / "out"], str(tmp_path / "da2"))


def test_a_folder_of_another_network_is_refused(tmp_path):
    save_checkpoint(tmp_path / "ppd.pth", 64)
    make_ppd().dit.save_pretrained(tmp_path / "encoder")
    with pytest.raises(ValueError, match="--with"):
        run_convert([tmp_path / "ppd.pth", tmp_path / "out"], str(tmp_path / "encoder"))
