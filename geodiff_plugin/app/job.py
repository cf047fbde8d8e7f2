"""One job of the page: a visitor's request, run through the public API, to everything that is shown."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin.app.cameras import CAMERA_WAYS, CameraFields, Views
from geodiff_plugin.cli.report import single_map
from geodiff_plugin.cli.terminal import collected_warnings
from geodiff_plugin.formats import read_image
from geodiff_plugin.formats.files import open_image
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.options import RunOptions
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput

#: What the page allows of an option, where that is less than the command does.
LIMITS = {"steps": 100, "ensemble": 20, "resolution": 4096}
#: What the page calls an option, where that is not its name.
FIELD_NAMES = {"near": "the nearest depth", "far": "the farthest depth", "ensemble": "members"}
#: A photograph of more is not decoded.
MOST_MEGAPIXELS = 50
Report = Callable[[float, str], None]


class Stopped(Exception):
    """The visitor asked to stop."""


class Priors:
    """The priors that a page offers, each loaded once for all visitors, when it is first used.

    Args:
        names: as ``load_prior`` takes them; a visitor can choose among these alone.
        device: where they run.
    """

    def __init__(self, names: tuple[str, ...], device: torch.device) -> None:
        self.names, self.device = names, device
        self._loaded: dict[str, Any] = {}

    def get(self, name: str) -> Any:
        """The pipeline, with guidance enabled and its bars off."""
        check_choice(name, "prior", self.names)
        if name not in self._loaded:
            pipe = load_prior(name).to(self.device)
            pipe.set_progress_bar_config(disable=True)
            self._loaded[name] = enable_geometry_guidance(pipe)
        return self._loaded[name]


@dataclass(frozen=True)
class Request:
    """What a visitor filled in.

    Attributes:
        left: path of the left photograph.
        right: path of the right one.
        third: path of a third one, or ``None``.
        way: key of ``CAMERA_WAYS``.
        cameras: what was filled in about cameras.
        run: prior and settings.
        show_prior: also run the prior without guidance, to show what it says alone.
    """

    left: str | None
    right: str | None
    third: str | None = None
    way: str = "file"
    cameras: CameraFields = field(default_factory=CameraFields)
    run: RunOptions = field(default_factory=RunOptions)
    show_prior: bool = True

    def files(self) -> Iterator[Path]:
        """What was uploaded."""
        cameras = self.cameras
        paths = (self.left, self.right, self.third, cameras.calibration, cameras.second_calibration)
        return (Path(path) for path in paths if path is not None)


@dataclass(frozen=True, eq=False)
class Result:
    """What is shown and measured.

    Attributes:
        views: the photographs.
        guidance: with the cameras as understood.
        output: of the guided call, at the left photograph's size.
        prior_map: ``(H, W)`` the prior's own map without guidance, or ``None``.
        warnings: sentences, what was assumed among them.
        seconds: by stage.
        request: what was asked.
    """

    views: Views
    guidance: GeometryGuidance
    output: MetricDepthOutput
    prior_map: np.ndarray | None
    warnings: list[str]
    seconds: dict[str, float]
    request: Request

    def map(self, name: str) -> np.ndarray | None:
        """``(H, W)`` of a map of the output, or ``None``."""
        value = getattr(self.output, name)
        return None if value is None else single_map(value)

    @property
    def depth_m(self) -> np.ndarray:
        """``(H, W)`` float32 metres."""
        return single_map(self.output.prediction).astype(np.float32)

    @property
    def K(self) -> np.ndarray:
        """``(3, 3)`` pixels."""
        return np.asarray(self.output.K)[0].astype(np.float64)


def _read(path: str | None, name: str) -> tuple[np.ndarray, list[str]]:
    if path is None:
        bad_value(name, "given", "nothing", "Drop a picture into its field.")
    with open_image(path, name) as image:  # the head alone
        width, height = image.size
    if width * height > MOST_MEGAPIXELS * 1_000_000:
        expected = f"an image of at most {MOST_MEGAPIXELS} megapixels"
        bad_value(name, expected, f"{width}x{height}", "Scale it down first, and K with it.")
    return read_image(path, name)


def _views(request: Request) -> tuple[Views, list[str]]:
    left, notes = _read(request.left, "the left photograph")
    right, of_right = _read(request.right, "the right photograph")
    third, of_third = (None, []) if request.third is None else _read(request.third, "the third photograph")
    assert request.left is not None and request.right is not None
    views = Views(left, right, third, (request.left, request.right), request.third)
    return views, [*notes, *of_right, *of_third]


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

    run, warnings = request.run, list[str]()
    seconds, started = {}, time.perf_counter()
    with collected_warnings(warnings.append):
        stage(0.0, "Reading the photographs and cameras")
        for name, most in LIMITS.items():
            check_number(getattr(run, name) or 0, FIELD_NAMES.get(name, name), 0, most, integer=True)
        run.check(lambda field: FIELD_NAMES.get(field.name, field.name))
        views, notes = _views(request)
        guidance = CAMERA_WAYS[request.way].guide(views, request.cameras, {"config": run.config()})
        stage(0.05, "Loading the prior")
        pipe = priors.get(run.prior)
        total = guidance.denoising_steps(run.steps, pipe.default_denoising_steps) * run.ensemble
        seconds["prepare"] = time.perf_counter() - started
        stage(0.1, "Comparing the views")
        done = 0

        def show(_pipe: Any, _step: int, _timestep: Any, _now: dict[str, Any]) -> dict[str, Any]:
            nonlocal done
            done += 1
            stage(0.2 + 0.6 * min(done / total, 1.0), f"Guided step {min(done, total)} of {total}")
            return {}

        def call(**more: Any) -> MetricDepthOutput:
            return pipe(views.left, generator=torch.Generator("cpu").manual_seed(run.seed), **more)

        output = call(guidance=guidance, callback_on_step_end=show, **run.call())
        seconds["guided call"] = time.perf_counter() - started - sum(seconds.values())
        prior_map = None
        if request.show_prior:
            stage(0.85, "The prior alone")
            plain = run.call() | {"output_uncertainty": False}
            prior_map = single_map(call(**plain).prediction).astype(np.float32)
            seconds["prior alone"] = time.perf_counter() - started - sum(seconds.values())
        stage(0.95, "Drawing")
    sentences = list(dict.fromkeys([*notes, *warnings, *output.warnings, *output.assumed]))
    return Result(views, guidance, output, prior_map, sentences, seconds, request)
