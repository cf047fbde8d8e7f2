"""One job of the page: a visitor's request, run through the public API, to everything that is shown.

Paper: Algorithm 1, run by the pipeline.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_number
from geodiff_plugin.app.cameras import CAMERA_WAYS, CameraFields, Views
from geodiff_plugin.app.priors import Priors
from geodiff_plugin.cli.report import used_poses
from geodiff_plugin.cli.terminal import collected_warnings
from geodiff_plugin.formats import read_image
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.options import PRESETS, RunOptions
from geodiff_plugin.runtime.verdict import Verdict
from geodiff_plugin.types import MetricDepthOutput

__all__ = ["PRESETS", "Request", "Result", "Stopped", "run_job"]

MOST_STEPS, MOST_MEMBERS, LARGEST_RESOLUTION = 100, 20, 4096
#: What the page calls an option, where that is not its name.
FIELD_NAMES = {"near": "the nearest depth", "far": "the farthest depth", "ensemble": "members"}
Report = Callable[[float, str], None]


class Stopped(Exception):
    """The visitor asked to stop."""


@dataclass(frozen=True)
class Request:
    """What a visitor filled in.

    Attributes:
        left: path of the left photograph.
        right: path of the right one.
        third: path of a third one, or ``None``.
        way: key of ``CAMERA_WAYS``.
        cameras: what was filled in about cameras.
        prior: name, as ``load_prior`` takes it.
        preset: key of ``PRESETS``.
        steps: denoising steps; 0 for the prior's own.
        members: of the ensemble.
        resolution: longer side for the prior, pixels; 0 for the prior's own.
        near: metres, or ``None``.
        far: metres, or ``None``.
        seed: of the noise.
        show_prior: also run the prior without guidance, to show what it says alone.
    """

    left: str | None
    right: str | None
    third: str | None = None
    way: str = "file"
    cameras: CameraFields = field(default_factory=CameraFields)
    prior: str = "bundled"
    preset: str = "default"
    steps: int = 0
    members: int = 1
    resolution: int = 0
    near: float | None = None
    far: float | None = None
    seed: int = 0
    show_prior: bool = True


@dataclass(frozen=True, eq=False)
class Result:
    """What is shown and measured; maps are ``(H, W)`` at the left photograph's size.

    Attributes:
        views: the photographs.
        guidance: with the cameras as understood.
        depth_m: metres.
        K: ``(3, 3)`` pixels.
        Es: ``(4, 4)`` each, metres, poses of the further views as the call used them.
        prior_map: the prior's own map without guidance, or ``None``.
        confidence: [0, 1], or ``None``.
        uncertainty_m: metres, or ``None``.
        error: photometric error, [0, 1], or ``None``.
        visible: bool, or ``None``.
        verdict: of the call: ``trusted``, ``status`` and ``reasons``.
        warnings: sentences, what was assumed among them.
        seconds: by stage.
        request: what was asked.
    """

    views: Views
    guidance: GeometryGuidance
    depth_m: np.ndarray
    K: np.ndarray
    Es: tuple[np.ndarray, ...]
    prior_map: np.ndarray | None
    confidence: np.ndarray | None
    uncertainty_m: np.ndarray | None
    error: np.ndarray | None
    visible: np.ndarray | None
    verdict: Verdict
    warnings: list[str]
    seconds: dict[str, float]
    request: Request


def _given(path: str | None, name: str) -> str:
    if path is None:
        bad_value(name, "given", "nothing", "Drop a picture into its field.")
    return path


def _views(request: Request) -> tuple[Views, list[str]]:
    names = "the left photograph", "the right photograph", "the third photograph"
    paths = _given(request.left, names[0]), _given(request.right, names[1])
    left, notes = read_image(paths[0], names[0])
    right, of_right = read_image(paths[1], names[1])
    third, of_third = (None, []) if request.third is None else read_image(request.third, names[2])
    return Views(left, right, third, paths, request.third), [*notes, *of_right, *of_third]


def _knobs(request: Request) -> dict[str, Any]:
    """Keywords of the guidance."""
    return {"config": _run_options(request).config()}


def _run_options(request: Request) -> RunOptions:
    """The options of the run, checked.

    Raises:
        InputError: naming the field of the page.
    """
    for name, value, most in (
        ("steps", request.steps, MOST_STEPS),
        ("members", request.members, MOST_MEMBERS),
        ("resolution", request.resolution, LARGEST_RESOLUTION),
    ):
        check_number(value, name, 0, most, integer=True)
    options = RunOptions(
        prior=request.prior,
        preset=request.preset,
        steps=request.steps or None,
        ensemble=request.members,
        resolution=request.resolution or None,
        near=request.near,
        far=request.far,
        seed=request.seed,
    )
    options.check(lambda field: FIELD_NAMES.get(field.name, field.name))
    return options


def _call_options(request: Request) -> dict[str, Any]:
    """Keywords of the call that a guided and a plain one share."""
    call = _run_options(request).call()
    del call["output_uncertainty"]
    return call


def _map(value: Any) -> np.ndarray:
    """``(H, W)`` of one map of an output."""
    return np.asarray(value)[0, ..., 0]


def _map_if_any(value: Any) -> np.ndarray | None:
    return None if value is None else _map(value)


def _call(pipe: Any, request: Request, views: Views, **more: Any) -> MetricDepthOutput:
    generator = torch.Generator("cpu").manual_seed(request.seed)
    return pipe(views.left, generator=generator, **_call_options(request), **more)


def _result(
    request: Request,
    views: Views,
    guidance: GeometryGuidance,
    output: MetricDepthOutput,
    prior_map: np.ndarray | None,
    warnings: list[str],
    seconds: dict[str, float],
) -> Result:
    return Result(
        views=views,
        guidance=guidance,
        depth_m=_map(output.prediction).astype(np.float32),
        K=np.asarray(output.K)[0].astype(np.float64),
        Es=used_poses(output, guidance),
        prior_map=prior_map,
        confidence=_map_if_any(output.confidence),
        uncertainty_m=_map_if_any(output.uncertainty),
        error=_map_if_any(output.photometric_error),
        visible=_map_if_any(output.visible),
        verdict=output.verdict,
        warnings=warnings,
        seconds=seconds,
        request=request,
    )


def run_job(request: Request, priors: Priors, stop: threading.Event, report: Report) -> Result:
    """Read, estimate, and say how far it is; only one job runs at a time.

    Args:
        request: what was filled in.
        priors: what may be chosen.
        stop: looked at before every stage and after every denoising step.
        report: called with the share that is done, [0, 1], and the name of the stage.

    Raises:
        Stopped: ``stop`` was set.
        OSError, TypeError, ValueError: bad input, in one sentence.
    """

    def stage(share: float, name: str) -> None:
        if stop.is_set():
            raise Stopped
        report(share, name)

    warnings: list[str] = []
    seconds, started = {}, time.perf_counter()
    with collected_warnings(warnings.append):
        stage(0.0, "Reading the photographs and cameras")
        options = _call_options(request)
        views, notes = _views(request)
        guidance = CAMERA_WAYS[request.way].guide(views, request.cameras, _knobs(request))
        stage(0.05, "Loading the prior")
        pipe = priors.get(request.prior)
        steps = guidance.denoising_steps(options["num_inference_steps"], pipe.default_denoising_steps)
        total, done = steps * request.members, 0
        seconds["prepare"] = time.perf_counter() - started
        stage(0.1, "Comparing the views")

        def show(_pipe: Any, _step: int, _timestep: Any, _now: dict[str, Any]) -> dict[str, Any]:
            nonlocal done
            done += 1
            stage(0.2 + 0.6 * min(done / total, 1.0), f"Guided step {min(done, total)} of {total}")
            return {}

        uncertain = {"output_uncertainty": True} if request.members > 1 else {}
        output = _call(pipe, request, views, guidance=guidance, callback_on_step_end=show, **uncertain)
        seconds["guided call"] = time.perf_counter() - started - sum(seconds.values())
        prior_map = None
        if request.show_prior:
            stage(0.85, "The prior alone")
            prior_map = _map(_call(pipe, request, views).prediction).astype(np.float32)
            seconds["prior alone"] = time.perf_counter() - started - sum(seconds.values())
        stage(0.95, "Drawing")
    sentences = list(dict.fromkeys([*notes, *warnings, *output.warnings, *output.assumed]))
    return _result(request, views, guidance, output, prior_map, sentences, seconds)
