"""Preparation and map of ``transformers`` depth models against its processors that need no torchvision."""

import importlib
import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from transformers import DPTImageProcessorPil, GLPNImageProcessorPil
from transformers.models.prompt_depth_anything.image_processing_pil_prompt_depth_anything import (
    PromptDepthAnythingImageProcessorPil,
)
from transformers.models.zoedepth.image_processing_pil_zoedepth import ZoeDepthImageProcessorPil

from geodiff_plugin.priors.components import DirectScheduler
from geodiff_plugin.priors.transformers_depth import Preparation, TransformersDepthPipeline
from tests.contracts.tiny_transformers import MODELS, spread

PATCH_OF_14 = {"keep_aspect_ratio": True, "ensure_multiple_of": 14}
IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
PROCESSORS = {
    "dpt": DPTImageProcessorPil(),
    "depth anything": DPTImageProcessorPil(size={"height": 70, "width": 70}, **PATCH_OF_14, **IMAGENET),
    "dinov2's dpt": DPTImageProcessorPil(do_resize=False, do_pad=True, size_divisor=14, **IMAGENET),
    "glpn": GLPNImageProcessorPil(),
    "zoedepth": ZoeDepthImageProcessorPil(size={"height": 64, "width": 96}, ensure_multiple_of=32),
    "zoedepth as it comes": ZoeDepthImageProcessorPil(),
    "zoedepth without border": ZoeDepthImageProcessorPil(do_pad=False),
    "prompt depth anything": PromptDepthAnythingImageProcessorPil(
        size={"height": 70, "width": 70}, **PATCH_OF_14, **IMAGENET
    ),
}
ROUNDING = 1.2 / 255  # half a grey level after either axis, and the second one overshoots


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    """``(75, 113, 3)`` uint8, mid-grey: what the library cuts off at 0 and 255 is not what is compared."""
    return np.random.default_rng(0).integers(90, 160, (75, 113, 3), dtype=np.uint8)


def as_tensor(image: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None] / 255.0


def made(kind: str) -> tuple:
    """A model, what prepares its images, and the pipeline of it."""
    torch.manual_seed(0)
    model, config = MODELS[kind]()
    spread(model)
    return model, Preparation(config), TransformersDepthPipeline(model, DirectScheduler(0), config)


@pytest.mark.parametrize("name", PROCESSORS)
def test_preparation(name, image):
    processor = PROCESSORS[name]
    theirs = processor(image, return_tensors="pt")["pixel_values"]
    preparation = Preparation(processor.to_dict())
    ours = preparation(as_tensor(image))
    deviation = min(preparation.options["image_std"]) if preparation.options["do_normalize"] else 1.0
    # They round to bytes after either axis; ZoeDepth and what is not resized are never rounded.
    exact = "zoedepth" in name or "dinov2" in name
    torch.testing.assert_close(ours, theirs, rtol=0, atol=1e-6 if exact else ROUNDING / deviation)


@pytest.mark.parametrize("kind", ["depth_anything", "dpt", "glpn"])
def test_map(kind, image):
    model, preparation, pipe = made(kind)
    processor = (GLPNImageProcessorPil if kind == "glpn" else DPTImageProcessorPil)()
    with torch.no_grad():
        output = model(pixel_values=preparation(as_tensor(image)))
    theirs = processor.post_process_depth_estimation(output, [image.shape[:2]])[0]["predicted_depth"]
    ours = pipe.predict(as_tensor(image), image.shape[:2])
    assert theirs.std() > 0
    torch.testing.assert_close(ours[0, 0], theirs, rtol=0, atol=1e-6)


def theirs_without_torchvision(kind: str, monkeypatch):
    """A processor's class out of a module that imports torchvision, of which its ending needs nothing."""
    for name in ("torchvision", "torchvision.transforms", "torchvision.transforms.v2"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    sys.modules["torchvision.transforms.v2"].functional = SimpleNamespace()
    path = f"transformers.models.{kind}.image_processing_{kind}"
    monkeypatch.delitem(sys.modules, path, raising=False)
    module = importlib.import_module(path)
    modes = {2: SimpleNamespace(value="bilinear"), 3: SimpleNamespace(value="bicubic")}
    monkeypatch.setattr(module, "pil_torch_interpolation_mapping", modes, raising=False)
    monkeypatch.delitem(sys.modules, path)
    return next(v for k, v in vars(module).items() if k.lower() == kind.replace("_", "") + "imageprocessor")


@pytest.mark.parametrize("kind", ["depth_pro", "prompt_depth_anything", "tipsv2"])
@torch.no_grad()
def test_metres_by_the_librarys_own_ending(kind, image, monkeypatch):
    (model, preparation, pipe), reported = made(kind), {}
    if kind == "prompt_depth_anything":
        reported["prompt_depth"] = torch.rand(1, 1, 12, 16) * 3 + 1
    output = model(pixel_values=preparation(as_tensor(image)), **reported)
    ending = theirs_without_torchvision(
        {"tipsv2": "tipsv2_dpt"}.get(kind, kind), monkeypatch
    ).post_process_depth_estimation
    theirs = ending(SimpleNamespace(resample=2), output, [image.shape[:2]])[0]["predicted_depth"]
    ours = pipe.metres(pipe.predict(as_tensor(image), image.shape[:2], reported.get("prompt_depth")))
    assert theirs.std() > 0
    torch.testing.assert_close(ours[0, 0], theirs, rtol=1e-5, atol=1e-5)
