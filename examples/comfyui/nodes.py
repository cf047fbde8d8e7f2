"""Three ComfyUI nodes: calibration, guided depth, point cloud.

A ComfyUI ``IMAGE`` is ``(B, H, W, 3)`` float32 in [0, 1], a ``MASK`` is ``(B, H, W)``. This file adds two
types: ``GEODIFF_RIG`` is a ``geodiff_plugin.Rig``, ``GEODIFF_DEPTH`` a dict with the arrays of one batch.
"""

from __future__ import annotations

from pathlib import Path

import comfy.model_management
import comfy.utils
import folder_paths
import numpy as np
import torch

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior, read_calibration
from geodiff_plugin.formats import (
    file_digest,
    flying_points,
    make_cloud,
    rig_from_parameters,
    write_glb,
    write_ply,
)
from geodiff_plugin.options import RunOptions
from geodiff_plugin.plotting import colour_depth
from geodiff_plugin.settings import settings_of

CATEGORY = "GeoDiff"
CALIBRATIONS = (".txt", ".yaml", ".yml", ".json", ".xml", ".conf")
NUMBERS = "(parameters below)"
#: Help texts and choices of the depth node's inputs, shared with the command line.
OPTIONS = settings_of(RunOptions)
#: The most recently used prior and its device, cached because a graph is run repeatedly.
_LOADED: dict[tuple[str, str], object] = {}


def _prior(name: str) -> object:
    device = comfy.model_management.get_torch_device()
    key = (name, str(device))
    if key not in _LOADED:
        _LOADED.clear()
        pipe = load_prior(name)
        parts = [part for part in pipe.components.values() if isinstance(part, torch.nn.Module)]
        needed = sum(weight.nbytes for part in parts for weight in part.parameters())
        comfy.model_management.free_memory(2 * needed, device)  # unload ComfyUI's models
        pipe.to(device).set_progress_bar_config(disable=True)
        _LOADED[key] = enable_geometry_guidance(pipe)
    return _LOADED[key]


def _input_file(name: str) -> Path:
    """Return a file in ComfyUI's input folder; raise for any other path."""
    folder = Path(folder_paths.get_input_directory()).resolve()
    path = (folder / name).resolve()
    if folder not in path.parents:
        raise ValueError(f"The calibration must be in ComfyUI's input folder; got {name}.")
    return path


class GeoDiffCalibration:
    """Cameras of a stereo pair, from a calibration file or parameters."""

    CATEGORY, FUNCTION = CATEGORY, "read"
    RETURN_TYPES, RETURN_NAMES = ("GEODIFF_RIG",), ("rig",)

    @classmethod
    def INPUT_TYPES(cls):  # noqa: D102, N802
        number = {"default": 0.0, "min": 0.0, "max": 1e6, "step": 0.01}
        folder = Path(folder_paths.get_input_directory())
        files = sorted(path.name for path in folder.iterdir() if path.suffix.lower() in CALIBRATIONS)
        return {
            "required": {
                "file": ([NUMBERS, *files], {"tooltip": "Calibration file in ComfyUI's input folder."})
            },
            "optional": {
                "fx": ("FLOAT", number | {"tooltip": "Focal length in pixels."}),
                "cx": ("FLOAT", number | {"tooltip": "Principal point in pixels (0: image centre)."}),
                "cy": ("FLOAT", number | {"tooltip": "Principal point in pixels (0: image centre)."}),
                "baseline_m": ("FLOAT", number | {"tooltip": "Distance between the cameras in metres."}),
                "image": (
                    "IMAGE",
                    {
                        "tooltip": "Left image: sets the default cx and cy, and selects one of a file's "
                        "image sizes."
                    },
                ),
                "cx_right": (
                    "FLOAT",
                    number | {"tooltip": "cx of the right image, cx + doffs (0: same as cx)."},
                ),
            },
        }

    def read(self, file, fx=0.0, cx=0.0, cy=0.0, baseline_m=0.0, image=None, cx_right=0.0):
        """Read the file, or build a rectified rig from the parameters."""
        size = None if image is None else (image.shape[2], image.shape[1])
        if file != NUMBERS:
            return (read_calibration(_input_file(file), image_size=size, baseline_m=baseline_m or None),)
        if not (cx and cy) and size is None:
            raise ValueError("cx and cy are missing. Connect the left image, or enter them.")
        cx, cy = cx or (size[0] - 1) / 2, cy or (size[1] - 1) / 2
        return (rig_from_parameters(fx, fx, cx, cy, baseline_m, cx_right=cx_right or None),)

    @classmethod
    def IS_CHANGED(cls, file, **_):  # noqa: D102, N802
        return "" if file == NUMBERS else file_digest(_input_file(file))


class GeoDiffDepth:
    """Metric depth of the left image, guided by the right image."""

    CATEGORY, FUNCTION, OUTPUT_NODE = CATEGORY, "estimate", True  # displays the verdict
    RETURN_TYPES = ("GEODIFF_DEPTH", "IMAGE", "IMAGE", "MASK", "STRING")
    RETURN_NAMES = ("depth", "coloured", "near_is_white", "confidence", "verdict")

    @classmethod
    def INPUT_TYPES(cls):  # noqa: D102, N802
        return {
            "required": {
                "left": ("IMAGE",),
                "right": ("IMAGE",),
                "rig": ("GEODIFF_RIG",),
                "prior": ("STRING", {"default": "bundled", "tooltip": OPTIONS["prior"].help}),
                "steps": ("INT", {"default": 0, "min": 0, "max": 100, "tooltip": OPTIONS["steps"].help}),
                "ensemble": ("INT", {"default": 1, "min": 1, "max": 20, "tooltip": OPTIONS["ensemble"].help}),
                "preset": (list(OPTIONS["preset"].choices), {"tooltip": OPTIONS["preset"].help}),
                "seed": (
                    "INT",
                    {"default": 0, "min": 0, "max": 2**64 - 1, "tooltip": OPTIONS["seed"].help},
                ),
            }
        }

    def estimate(self, left, right, rig, prior, steps, ensemble, preset, seed):
        """Run one guided call over the batch."""
        # ComfyUI runs nodes in inference mode, which disables the gradients that guidance needs.
        with torch.inference_mode(False):
            return self._estimate(left, right, rig, prior, steps, ensemble, preset, seed)

    def _estimate(self, left, right, rig, prior, steps, ensemble, preset, seed):
        pipe = _prior(prior)
        lefts, rights = (list(batch.cpu().numpy()) for batch in (left, right))
        make = GeometryGuidance.paper if preset == "paper" else GeometryGuidance
        same = rig.source == "arguments" and np.array_equal(rig.K_left, rig.K_right)
        guidance = make(rights, rig.K_left if same else (rig.K_left, rig.K_right), rig.E)
        count = guidance.denoising_steps(steps or None, pipe.default_denoising_steps)
        bar = comfy.utils.ProgressBar(count * len(lefts) * ensemble)

        def show(*_):
            comfy.model_management.throw_exception_if_processing_interrupted()
            bar.update(1)
            return {}

        out = pipe(
            lefts,
            guidance=guidance,
            num_inference_steps=steps or None,
            ensemble_size=ensemble,
            generator=torch.Generator("cpu").manual_seed(seed % 2**63),
            callback_on_step_end=show,
        )
        depth_m = out.prediction[..., 0].astype(np.float32)
        depth = {"depth_m": depth_m, "K": np.asarray(out.K), "image": np.stack(lefts), "rig": rig}
        confidence = (
            np.ones_like(depth_m) if out.confidence is None else out.confidence[..., 0].astype(np.float32)
        )
        depth["confidence"] = confidence
        coloured = np.stack([colour_depth(each) for each in depth_m]).astype(np.float32) / 255.0
        verdict = " ".join([f"{out.verdict.status.capitalize()}.", *out.findings])
        result = (
            depth,
            torch.from_numpy(coloured),
            _near_is_white(depth_m),
            torch.from_numpy(confidence),
            verdict,
        )
        return {"ui": {"text": [verdict]}, "result": result}


def _near_is_white(depth_m: np.ndarray) -> torch.Tensor:
    """Return inverse depth from 0 to 1, ``(B, H, W, 3)``, as depth ControlNets expect it."""
    inverse = 1.0 / depth_m
    low, high = (np.percentile(inverse, fraction, axis=(1, 2), keepdims=True) for fraction in (1, 99))
    grey = np.clip((inverse - low) / np.maximum(high - low, 1e-9), 0, 1).astype(np.float32)
    return torch.from_numpy(grey)[..., None].repeat(1, 1, 1, 3)


class GeoDiffPointCloud:
    """Point cloud of the first image in ComfyUI's output folder; ``Preview 3D`` displays the GLB."""

    CATEGORY, FUNCTION, OUTPUT_NODE = CATEGORY, "write", True
    RETURN_TYPES, RETURN_NAMES = ("STRING",), ("model_file",)

    @classmethod
    def INPUT_TYPES(cls):  # noqa: D102, N802
        return {
            "required": {
                "depth": ("GEODIFF_DEPTH",),
                "min_confidence": ("FLOAT", {"default": 0.5, "min": 0.0, "max": 1.0, "step": 0.05}),
                "format": (["glb", "ply"],),
                "filename_prefix": ("STRING", {"default": "geodiff/cloud"}),
            }
        }

    def write(self, depth, min_confidence, format, filename_prefix):
        """Write one file with the prefix, numbered like ComfyUI's images."""
        depth_m, image, K = depth["depth_m"][0], depth["image"][0], depth["K"][0]
        keep = ~flying_points(depth_m) & (depth["confidence"][0] >= min_confidence)
        folder, name, counter, subfolder, _ = folder_paths.get_save_image_path(
            filename_prefix, folder_paths.get_output_directory()
        )
        path = Path(folder) / f"{name}_{counter:05}_.{format}"
        if format == "ply":
            write_ply(path, depth_m, image, K, keep)
        else:
            size = (image.shape[1], image.shape[0])
            rig = depth["rig"]
            cameras = [(K, np.eye(4), size), (rig.K_right, rig.E, rig.size_right or size)]
            write_glb(path, make_cloud(depth_m, image, K, keep), cameras)
        shown = {"filename": path.name, "subfolder": subfolder, "type": "output"}
        return {"ui": {"3d": [shown]}, "result": (str(Path(subfolder) / path.name),)}


NODE_CLASS_MAPPINGS = {
    "GeoDiffCalibration": GeoDiffCalibration,
    "GeoDiffDepth": GeoDiffDepth,
    "GeoDiffPointCloud": GeoDiffPointCloud,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "GeoDiffCalibration": "GeoDiff calibration",
    "GeoDiffDepth": "GeoDiff guided depth",
    "GeoDiffPointCloud": "GeoDiff point cloud",
}
