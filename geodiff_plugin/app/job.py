"""One job of the page: what a visitor filled in, as options of ``geodiff depth``, and its run."""

from __future__ import annotations

import re
import secrets
import tempfile
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from geodiff_plugin._checks import InputError, bad_value, check_choice, check_number, refuse
from geodiff_plugin.app.keeping import Stopped
from geodiff_plugin.formats.files import upright_size
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pair import run_pair
from geodiff_plugin.jobs.prior import load_guided_prior
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.records import JobLog, PairResult
from geodiff_plugin.jobs.telling import collected_warnings, silent
from geodiff_plugin.jobs.writing import write_pair

#: What the page allows of an option, where that is less than the command does.
LIMITS = {"steps": 100, "ensemble": 20, "resolution": 4096}
#: What the page calls an option, where that is not its name.
FIELD_NAMES = {"near": "the nearest depth", "far": "the farthest depth", "ensemble": "members"}
#: Ways to give the cameras, in the order of the page.
CAMERA_WAYS = {
    "file": "Calibration file",
    "numbers": "Focal length and baseline",
    "photographs": "Estimate from the photographs",
}
#: A coordinate of an end of the known length.
ENDS = re.compile(r"-?\d+(?:\.\d+)?")
#: A photograph of more is not decoded: at this size the process of the page peaks at 4.2 GB, and at some
#: 200 MB more for every further megapixel (``python -m tests.benchmarks.page``).
MOST_MEGAPIXELS = 16
#: Folder of results below that of temporary files, the only one whose files the page hands out.
RESULTS = "results"


class Priors:
    """The priors that a page offers by name, each loaded once for all visitors, when it is first used."""

    def __init__(self, names: tuple[str, ...], device: torch.device) -> None:
        self.names, self.device = names, device
        self._loaded: dict[str, Any] = {}

    def get(self, name: str) -> Any:
        """The pipeline, with guidance enabled and its bars off."""
        check_choice(name, "prior", self.names)
        if name not in self._loaded:
            self._loaded[name] = load_guided_prior(name, self.device)
        return self._loaded[name]


def photograph_size(path: str, name: str) -> tuple[int, int]:
    """Width and height of a photograph as it is shown.

    Raises:
        InputError: no picture, one that cannot be read here, or one of more than ``MOST_MEGAPIXELS``.
    """
    try:
        width, height = upright_size(path, name)
    except InputError as error:
        if isinstance(error.__context__, Image.DecompressionBombError):
            refuse(f"{name} is far too large: at most {MOST_MEGAPIXELS} megapixels can be used here.")
        raise
    if width * height > MOST_MEGAPIXELS * 1_000_000:
        expected = f"an image of at most {MOST_MEGAPIXELS} megapixels"
        got = f"{width}x{height}, which is {width * height / 1e6:.0f} megapixels"
        bad_value(name, expected, got, "Scale both photographs down, and the calibration with them.")
    return width, height


@dataclass(frozen=True)
class CameraFields:
    """What a visitor says of the cameras; ``None`` is an empty field."""

    way: str  # a key of ``CAMERA_WAYS``
    calib: tuple[str, ...] = ()
    lens: dict[str, float | None] = field(default_factory=dict)  # fx, fy, cx, cy in pixels
    cx_right: float | None = None
    baseline: float | None = None  # metres
    known_length: float | None = None  # metres, between the pixels ``ends``
    ends: str | None = None


def options_of(left: str | None, right: str | None, cameras: CameraFields, **run: Any) -> DepthOptions:
    """The fields of a visitor as options of ``geodiff depth``; ``None`` is an empty field."""
    paths = []
    for name, path in (("the left photograph", left), ("the right photograph", right)):
        if path is None:
            refuse(f"{name} is missing: drop a picture into its field.")
        photograph_size(path, name)
        paths.append(Path(path))
    return DepthOptions(
        left=paths[0], right=paths[1], export=("glb", "mesh"), **_options_of_cameras(cameras), **run
    )


def _options_of_cameras(given: CameraFields) -> dict[str, Any]:
    """The fields of the cameras as options; those that another way needs are left out."""
    lens = {name: value for name, value in given.lens.items() if value is not None}
    if given.way == "file":
        if not given.calib:
            refuse("The calibration file is missing: choose one, or give focal length and baseline.")
        return {"baseline": given.baseline, "calib": tuple(map(Path, given.calib))}
    lens = lens if "fx" in lens else {}
    if given.way == "numbers":
        needed = {"fx": lens.get("fx"), "baseline": given.baseline}
        if missing := [name for name, value in needed.items() if value is None]:
            refuse(f"Give {' and '.join(missing)} as well: fx is in pixels, the baseline in metres.")
        return {"baseline": given.baseline, "cx_right": given.cx_right} | lens
    known_length = _length_of_photographs(given)
    return {"baseline": given.baseline, "estimate_pose": True, "known_length": known_length} | lens


def _length_of_photographs(given: CameraFields) -> str | None:
    """The known length as ``--known-length`` takes it, ``None`` where the baseline is given instead."""
    lengths = "the distance between the cameras, or a length in the left photograph"
    if given.baseline is None and given.known_length is None:
        refuse(f"Photographs have no unit: measure {lengths}.")
    if given.baseline is not None and given.known_length is not None:
        refuse(f"Give {lengths}, not both.")
    if given.known_length is None:
        return None
    numbers = ENDS.findall(given.ends or "")
    if len(numbers) != 4:
        cure = "tap both on the left photograph, or type x1, y1, x2, y2"
        refuse(f"The ends of the known length are two pixels: {cure}.")
    return ",".join([*numbers, f"{given.known_length}"])


def results_folder() -> Path:
    """Where the folders of all results are."""
    return Path(tempfile.gettempdir(), RESULTS)


def _new_folder() -> Path:
    results_folder().mkdir(parents=True, exist_ok=True)
    return results_folder() / secrets.token_hex(16)


def run_job(
    options: DepthOptions, priors: Priors, stop: threading.Event, report: Callable[[float, str], None]
) -> PairResult:
    """Read, estimate, write; ``Stopped`` before a stage or step after ``stop`` was set.

    ``report`` is called with the share that is done, [0, 1], and the name of the stage.
    """

    def stage(share: float, name: str) -> None:
        if stop.is_set():
            raise Stopped
        report(share, name)

    for name, most in LIMITS.items():
        check_number(getattr(options, name) or 0, FIELD_NAMES.get(name, name), 0, most)
    options.check(lambda option: FIELD_NAMES.get(option.name, option.name))
    folder, log = OutFolder(_new_folder()), JobLog()
    with collected_warnings(silent), folder:  # the log has them
        stage(0.0, "Reading the photographs and cameras")
        # The page keeps what is dropped in folders of its own, so only the names say something.
        names = options.left.name, Path(str(options.right)).name
        with log.stage("calibration"):
            inputs = read_pair(options, names=names)
        guidance = inputs.guidance
        if guidance.unit is None:  # lengths are what the page is for
            refuse("This file has no unit: give the distance between the two cameras in metres.")
        stage(0.05, "Loading the prior")
        pipe = priors.get(options.prior)
        total = guidance.denoising_steps(options.steps, pipe.default_denoising_steps) * options.ensemble
        stage(0.1, "Comparing the views")
        done = 0

        def show(_pipe: Any, _step: int, _timestep: Any, _now: dict[str, Any]) -> dict[str, Any]:
            nonlocal done
            done += 1
            stage(0.2 + 0.7 * min(done / total, 1.0), f"Guided step {min(done, total)} of {total}")
            return {}

        run = run_pair(pipe, options, inputs, log, callback_on_step_end=show)
        stage(0.95, "Drawing")
        log.add(run.output.assumed)
        return write_pair(folder, run)
