"""One job of the page: a visitor's request, run through the public API, to everything that is shown."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageOps

from geodiff_plugin._camera_checks import check_calibrated_size
from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin.cli.report import single_map
from geodiff_plugin.cli.terminal import collected_warnings
from geodiff_plugin.formats import read_calibration, read_image, rig_from_parameters
from geodiff_plugin.formats.exif import warn_of_other_lens
from geodiff_plugin.formats.files import open_image
from geodiff_plugin.guidance.guidance import GeometryGuidance, assume_same_centre
from geodiff_plugin.options import RunOptions
from geodiff_plugin.priors import load_prior
from geodiff_plugin.runtime.pipeline import enable_geometry_guidance
from geodiff_plugin.types import MetricDepthOutput, Rig

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
    """The priors that a page offers by name, each loaded once for all visitors when it is first used."""

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
    """What a visitor filled in; ``None`` is an empty field.

    ``left``, ``right`` and ``calibration``, one file or one a camera, are paths; ``way`` is a key of
    ``CAMERA_WAYS``; ``fx`` to ``cx_right`` are pixels: fy is fx, cx and cy the middle of the image, and the
    right camera's cx that of the left one where they are empty.
    """

    left: str | None
    right: str | None
    way: str = "file"
    calibration: tuple[str, ...] = ()
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    cx_right: float | None = None
    baseline_m: float | None = None
    run: RunOptions = field(default_factory=RunOptions)

    def files(self) -> list[Path]:
        """What was uploaded."""
        return [Path(path) for path in (self.left, self.right, *self.calibration) if path is not None]

    @property
    def photographs(self) -> tuple[str, str]:
        """Paths of the left and the right one; ``InputError`` where one is missing."""
        for path, name in ((self.left, "the left photograph"), (self.right, "the right photograph")):
            if path is None:
                bad_value(name, "given", "nothing", "Drop a picture into its field.")
        assert self.left is not None and self.right is not None
        return self.left, self.right

    def K(self, size: tuple[int, int]) -> np.ndarray:
        """``(3, 3)`` of a photograph of ``size`` ``(width, height)``."""
        fy = self.fx if self.fy is None else self.fy
        cx, cy = (
            (side - 1) / 2 if c is None else c for c, side in zip((self.cx, self.cy), size, strict=True)
        )
        return np.array([[self.fx, 0, cx], [0, fy, cy], [0, 0, 1]])


@dataclass(frozen=True, eq=False)
class Result:
    """What is shown and measured.

    ``left`` is the photograph, ``(H, W, 3)`` float32 in [0, 1]; ``guidance`` has the cameras as understood;
    ``warnings`` are sentences, what was assumed among them; ``seconds`` are by stage, files in ``folder``.
    """

    left: np.ndarray
    guidance: GeometryGuidance
    output: MetricDepthOutput
    warnings: list[str]
    seconds: dict[str, float]
    request: Request
    folder: Path

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


def _guidance_of_rig(request: Request, left: np.ndarray, right: np.ndarray, rig: Rig) -> GeometryGuidance:
    cure = "Use the photographs that the calibration is for, or give the numbers scaled to these."
    sides = (("left", left, rig.K_left, rig.size_left), ("right", right, rig.K_right, rig.size_right))
    for path, (side, image, K, size) in zip(request.photographs, sides, strict=True):
        name = f"the {side} photograph"
        check_calibrated_size(image.shape[1::-1], size, name, Path(rig.source).name, cure)
        warn_of_other_lens(path, K, name)
    posed = [(left, rig.K_left, np.eye(4)), (right, rig.K_right, rig.E)]
    return GeometryGuidance.from_views(posed, config=request.run.config())


def _from_file(request: Request, left: np.ndarray, right: np.ndarray) -> GeometryGuidance:
    if not request.calibration:
        cure = "Choose one, or give focal length and baseline."
        bad_value("calibration", "a calibration file", "none", cure)
    # The page keeps what is dropped in a folder of its own, so only the names themselves say something.
    first, second = (Path(path).name for path in request.photographs)
    rig = read_calibration(
        list(request.calibration),
        image_names=(first, second),
        image_size=left.shape[1::-1],
        baseline_m=request.baseline_m,
    )
    if rig.unit is None:  # lengths are what the page is for
        cure = "This file has no unit: measure how far the two cameras were from each other, in metres."
        bad_value("the distance of the cameras", "given", "nothing", cure)
    return _guidance_of_rig(request, left, right, rig)


def _from_numbers(request: Request, left: np.ndarray, right: np.ndarray) -> GeometryGuidance:
    given = {"fx": request.fx, "baseline": request.baseline_m}
    if missing := [name for name, value in given.items() if value is None]:
        bad_value(" and ".join(missing), "given", "nothing", "fx is in pixels, the baseline in metres.")
    K = request.K(left.shape[1::-1])
    lens = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    rig = rig_from_parameters(*lens, request.baseline_m, cx_right=request.cx_right)
    guidance = _guidance_of_rig(request, left, right, rig)
    if request.cx_right is None:
        assume_same_centre(guidance)
    return guidance


def _from_photographs(request: Request, left: np.ndarray, _: np.ndarray) -> GeometryGuidance:
    if request.baseline_m is None:
        cure = "Photographs have no unit: measure how far the two cameras were from each other, in metres."
        bad_value("the distance of the cameras", "given", "nothing", cure)
    K, more = None, dict[str, Any]()  # without fx, K of the EXIF of the photographs
    if request.fx is not None:
        K = request.K(left.shape[1::-1])
        if request.cx_right is not None:
            more["K_right"] = np.array([[K[0, 0], 0, request.cx_right], K[1], K[2]])
    photographs = [ImageOps.exif_transpose(Image.open(path)) for path in request.photographs]
    more |= {"baseline_m": request.baseline_m, "K": K, "config": request.run.config()}
    return GeometryGuidance.from_photographs(photographs, **more)


#: Ways to give the cameras, in the order of the page: what it calls them, and
#: ``(request, left, right) -> GeometryGuidance`` of photographs ``(H, W, 3)`` in [0, 1].
CAMERA_WAYS = {
    "file": ("Calibration file", _from_file),
    "numbers": ("Focal length and baseline", _from_numbers),
    "photographs": ("Estimate from the photographs", _from_photographs),
}


def _read(path: str, name: str) -> tuple[np.ndarray, list[str]]:
    with open_image(path, name) as image:  # the head alone
        width, height = image.size
    if width * height > MOST_MEGAPIXELS * 1_000_000:
        expected = f"an image of at most {MOST_MEGAPIXELS} megapixels"
        bad_value(name, expected, f"{width}x{height}", "Scale it down first, and K with it.")
    return read_image(path, name)


def run_job(request: Request, priors: Priors, stop: threading.Event, report: Report) -> Result:
    """Read, estimate, and say how far it is; only one job runs at a time.

    ``stop`` is looked at before every stage and after every denoising step; ``report`` is called with the
    share that is done, [0, 1], and the name of the stage.

    Raises:
        Stopped: ``stop`` was set.
        OSError, TypeError, ValueError: bad input, in one sentence.
    """

    def stage(share: float, name: str) -> None:
        if stop.is_set():
            raise Stopped
        report(share, name)

    run, warnings, seconds = request.run, list[str](), dict[str, float]()
    started = time.perf_counter()
    with collected_warnings(warnings.append):
        stage(0.0, "Reading the photographs and cameras")
        for name, most in LIMITS.items():
            check_number(getattr(run, name) or 0, FIELD_NAMES.get(name, name), 0, most, integer=True)
        run.check(lambda field: FIELD_NAMES.get(field.name, field.name))
        paths = request.photographs
        (left, notes), (right, more) = (
            _read(path, f"the {side} photograph") for path, side in zip(paths, ("left", "right"), strict=True)
        )
        guidance = CAMERA_WAYS[request.way][1](request, left, right)
        stage(0.05, "Loading the prior")
        pipe = priors.get(run.prior)
        total = guidance.denoising_steps(run.steps, pipe.default_denoising_steps) * run.ensemble
        seconds["prepare"] = time.perf_counter() - started
        stage(0.1, "Comparing the views")
        done = 0

        def show(_pipe: Any, _step: int, _timestep: Any, _now: dict[str, Any]) -> dict[str, Any]:
            nonlocal done
            done += 1
            stage(0.2 + 0.7 * min(done / total, 1.0), f"Guided step {min(done, total)} of {total}")
            return {}

        generator = torch.Generator("cpu").manual_seed(run.seed)
        output = pipe(left, guidance=guidance, generator=generator, callback_on_step_end=show, **run.call())
        seconds["guided call"] = time.perf_counter() - started - seconds["prepare"]
        stage(0.95, "Drawing")
    sentences = list(dict.fromkeys([*notes, *more, *warnings, *output.warnings, *output.assumed]))
    folder = Path(tempfile.mkdtemp(prefix="geodiff-"))
    return Result(left, guidance, output, sentences, seconds, request, folder)
