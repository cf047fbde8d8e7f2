"""Metric depth as a block for modular pipelines of diffusers; this folder is what goes to the hub.

    from block import GuidedDepthBlock

    pipe = GuidedDepthBlock().init_pipeline()
    pipe.load_components()  # the small prior of the package; or pipe.update_components(prior=load_prior(...))
    found = pipe(image=left, right=right, K=K, E=E, output=["depth_m", "confidence"])

The guided call is the package's own: ``GeometryGuidance`` on a pipeline that ``load_prior`` gave.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from diffusers import ModularPipelineBlocks
from diffusers.modular_pipelines import ComponentSpec, InputParam, OutputParam
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior

INPUTS = {
    "image": "left image, which gets the depth",
    "right": "right image, or a tuple of several; none with points alone",
    "K": "3x3 intrinsics in pixels, or a tuple of one per view; not with calibration",
    "E": "4x4 pose of the right camera in the left camera's frame, metres; not with calibration",
    "calibration": "file that holds K and E, in any format that the package reads",
    "points": "known depths, a sparse map (H, W) or (N, 3) points, metres",
    "knobs": "hyperparameters of GeometryGuidance, as a dict",
    "generator": "source of everything that is drawn",
    "num_inference_steps": "denoising steps, the prior's own for none",
    "processing_resolution": "longer side for the prior, pixels",
}


class Prior:
    """How modular diffusers loads the component: anything that ``load_prior`` takes."""

    @classmethod
    def from_pretrained(cls, name: str, subfolder: str = "", **options: Any) -> Any:
        """The pipeline, ready to be guided; ``options`` are ``variant`` and ``revision``."""
        given = {key: value for key, value in options.items() if value is not None}
        return enable_geometry_guidance(load_prior(name, **given))


class GuidedDepthBlock(ModularPipelineBlocks):
    """Metric depth of one image from a second view, points, or both.

    Args:
        picture_as: name of the output with the depth as a grey picture, near is white: ``"control_image"``
            hands it to blocks of a ControlNet, ``"image"`` to those that go on with an image.
    """

    _requirements = {"geodiff_plugin": ">=0.1"}

    def __init__(self, picture_as: str = "depth_image") -> None:
        super().__init__()
        self.picture_as = picture_as

    @property
    def description(self) -> str:
        """What the block does."""
        return "Metric depth of an image, from a second view with a known camera or from known points."

    @property
    def expected_components(self) -> list[ComponentSpec]:
        """The prior; by default the small one that comes with the package."""
        return [ComponentSpec("prior", Prior, pretrained_model_name_or_path="bundled")]

    @property
    def inputs(self) -> list[InputParam]:
        """As in ``INPUTS``."""
        return [InputParam(name, required=name == "image", description=text) for name, text in INPUTS.items()]

    @property
    def intermediate_outputs(self) -> list[OutputParam]:
        """Depth, confidence, a picture, and everything else that is known."""
        return [
            OutputParam("depth_m", np.ndarray, "(H, W) metres"),
            OutputParam("confidence", np.ndarray, "(H, W) probability that the depth is within 10 %"),
            OutputParam(self.picture_as, Image.Image, "the depth in grey, near is white"),
            OutputParam("guided_output", Any, "MetricDepthOutput of the guided call"),
        ]

    def __call__(self, components: Any, state: Any) -> tuple[Any, Any]:
        """Run the guided call; modular pipelines do so without gradients, guidance asks for its own."""
        block_state = self.get_block_state(state)
        knobs = {**(block_state.knobs or {}), "points": block_state.points}
        if block_state.calibration is not None:
            guidance = GeometryGuidance.from_calibration(block_state.right, block_state.calibration, **knobs)
        else:
            guidance = GeometryGuidance(block_state.right, block_state.K, block_state.E, **knobs)
        out = enable_geometry_guidance(components.prior)(
            block_state.image,
            guidance=guidance,
            generator=block_state.generator,
            num_inference_steps=block_state.num_inference_steps,
            processing_resolution=block_state.processing_resolution,
        )
        block_state.depth_m = out.prediction[0, ..., 0]
        block_state.confidence = None if out.confidence is None else out.confidence[0, ..., 0]
        block_state.guided_output = out
        setattr(block_state, self.picture_as, _picture(block_state.depth_m))
        self.set_block_state(state, block_state)
        return components, state


def _picture(depth_m: np.ndarray) -> Image.Image:
    """Inverse depth between its 2 % and 98 % quantile, in three equal channels."""
    inverse = 1.0 / depth_m
    low, high = np.quantile(inverse, [0.02, 0.98])
    grey = np.clip((inverse - low) / max(high - low, 1e-9), 0.0, 1.0)
    return Image.fromarray((grey * 255).round().astype(np.uint8)).convert("RGB")
