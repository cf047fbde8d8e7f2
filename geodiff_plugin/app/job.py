"""One job of the page: converts the form to options of ``geodiff depth``, runs it and writes its files."""

from __future__ import annotations

import filecmp
import importlib.util
import math
import re
import secrets
import tempfile
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from PIL import Image

from geodiff_plugin._internal.checks import InputError, check_choice
from geodiff_plugin.app.lenses import LENSES
from geodiff_plugin.app.messages import PageError, check_inside
from geodiff_plugin.app.sessions import Stopped
from geodiff_plugin.app.shown import Pixels
from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, REAL_PAIRS_FOLDER, example_name
from geodiff_plugin.cameras import Size, field_of_view_deg
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import OutFolder, intrinsics_from_exif, upright_size
from geodiff_plugin.jobs import (
    DepthOptions,
    JobLog,
    PairResult,
    PairRun,
    collected_warnings,
    load_guided_prior,
    read_pair,
    run_pair,
    silent,
    write_pair,
)

#: Upper limits of options that the page restricts more than the command.
LIMITS = {"steps": 100, "ensemble": 20, "resolution": 4096}
#: Sources of camera parameters, in the order of the page.
CAMERA_INPUTS = {
    "images": "Estimate from the images",
    "file": "Calibration file",
    "numbers": "Focal length and baseline",
}
#: Sources of the focal length if the cameras are estimated, before the lenses of ``LENSES``.
FOCAL_INPUTS = {
    "exif": "As stated in the image files",
    "fov": "Enter the field of view",
    "fx": "Enter fx in pixels",
}
#: Sources of the scale if the cameras are estimated.
SCALE_INPUTS = {
    "measured": "Measured distance between the two positions",
    "known": "Known length in the left image",
    "guess": "Only a rough distance",
}
#: Rough distances between the two positions: metres, and their standard deviation relative to them.
GUESSES = {
    "A hand's width to the side, about 12 cm": (0.12, 0.3),
    "A forearm's length to the side, about 30 cm": (0.3, 0.25),
    "One step to the side, about 70 cm": (0.7, 0.25),
    "Two steps to the side, about 1.4 m": (1.4, 0.25),
}
#: Name of the field in messages.
BASELINE_NAME = "The distance between the cameras"
#: Matches one coordinate of the end points of the known length.
ENDS = re.compile(r"-?\d+(?:\.\d+)?")
#: Larger images are not decoded. At this size the page's process peaks at 4.2 GB; each further megapixel
#: adds about 200 MB (``python -m tests.benchmarks.page``).
MAX_MEGAPIXELS = 16
#: Maximum number of points in the point clouds for download.
MAX_CLOUD_POINTS = 500_000
#: Folder of results within the folder for temporary files; the page serves no other one.
RESULTS = "results"
PAIRS_FOLDER = Path(__file__).resolve().parent / "pairs"
NO_POSELIB = (
    "This server cannot estimate the cameras, because PoseLib is not installed. Use a calibration file, or "
    "ask its operator to run: pip install 'geodiff-plugin[app]'."
)


@dataclass(frozen=True)
class Example:
    """An example pair: its folder, and the extension of its images."""

    folder: Path
    ending: str

    @property
    def label(self) -> str:
        """Name of the example on the page."""
        return example_name(self.folder)

    @property
    def left(self) -> Path:
        """Path of the left image."""
        return self.folder / f"left.{self.ending}"

    @property
    def right(self) -> Path:
        """Path of the right image."""
        return self.folder / f"right.{self.ending}"


#: Real pairs first; ``tests.scenes.make_examples`` renders the others.
EXAMPLES = (
    Example(REAL_PAIRS_FOLDER / "toy", "png"),
    Example(REAL_PAIRS_FOLDER / "cycles", "png"),
    Example(REAL_PAIRS_FOLDER / "donkey_toy", "png"),
    Example(DEMO_PAIR_FOLDER, "png"),
    Example(PAIRS_FOLDER / "street", "jpg"),
)


class Priors:
    """Priors offered by the page; each is loaded on first use and shared by all visitors."""

    def __init__(self, names: tuple[str, ...], device: torch.device, dtype: str = "float32") -> None:
        self.names, self.device, self.dtype = names, device, dtype
        self._loaded: dict[str, Any] = {}

    def get(self, name: str) -> Any:
        """Return the pipeline with guidance enabled and progress bars disabled."""
        check_choice(name, "prior", self.names)
        if name not in self._loaded:
            self._loaded[name] = load_guided_prior(name, self.device, dtype=self.dtype)
        return self._loaded[name]


def can_estimate() -> bool:
    """Whether the requirements for estimating the cameras are installed."""
    return importlib.util.find_spec("poselib") is not None


def image_size(path: str, name: str) -> tuple[int, int]:
    """Return width and height of an image in its display orientation.

    Raises:
        InputError: not a readable image, or one of more than ``MAX_MEGAPIXELS``.
    """
    limit = f"This page takes images of at most {MAX_MEGAPIXELS} megapixels. Downscale both images."
    try:
        width, height = upright_size(path, name)
    except InputError as error:
        if isinstance(error.__context__, Image.DecompressionBombError):
            raise PageError(f"{name.capitalize()} is too large. {limit}") from error
        raise
    if width * height > MAX_MEGAPIXELS * 1_000_000:
        megapixels = width * height / 1e6
        raise PageError(
            f"{name.capitalize()} has {width} x {height} pixels, {megapixels:.0f} megapixels. {limit}"
        )
    return width, height


def states_focal_length(path: str) -> bool:
    """Whether an image file states its focal length in EXIF data that is valid for it."""
    try:
        intrinsics_from_exif(path, "the image")
    except InputError:
        return False
    return True


@dataclass(frozen=True)
class CameraFields:
    """Fields of the form about the cameras; ``None`` is an empty field."""

    camera_input: str  # a key of ``CAMERA_INPUTS``
    calib: tuple[str, ...] = ()
    lens: dict[str, float | None] = field(default_factory=dict)  # fx, fy, cx, cy in pixels
    cx_right: float | None = None
    baseline: float | None = None  # metres
    camera: str = "exif"  # a key of ``FOCAL_INPUTS`` or ``LENSES``
    fov: float | None = None  # degrees, horizontal
    scale_input: str = "measured"  # a key of ``SCALE_INPUTS``
    baseline_error: float | None = None  # standard deviation of the measured baseline, metres
    known_length: float | None = None  # metres, between the pixels ``ends``
    ends: str | None = None
    guess: str = next(iter(GUESSES))


@dataclass(frozen=True)
class Request:
    """What a visitor asked for.

    Attributes:
        options: options of ``geodiff depth``.
        name: name of the pair on the page.
        assumptions: what the page assumed.
        scale_rel_std: relative standard deviation of the scale; ``None`` if unknown.
        pixels: ends of the known length, which are measured in the result.
        camera_input: source of the cameras, a key of ``CAMERA_INPUTS``.
    """

    options: DepthOptions
    name: str
    assumptions: tuple[Finding, ...] = ()
    scale_rel_std: float | None = None
    pixels: Pixels = field(default_factory=list)
    camera_input: str = ""


def pair_name(left: Path, right: Path) -> str:
    """Return the name of a pair: the example that it is a copy of, or its file names."""
    for example in EXAMPLES:
        both = ((left, example.left), (right, example.right))
        if all(filecmp.cmp(path, own, shallow=False) for path, own in both):
            return example.label
    return f"{left.name} and {right.name}"


def request_of(left: str | None, right: str | None, cameras: CameraFields, **run: Any) -> Request:
    """Convert the fields to a request; ``None`` is an empty field.

    Raises:
        PageError: A field is missing or wrong.
    """
    paths, sizes = [], []
    for name, path in (("the left image", left), ("the right image", right)):
        if path is None:
            raise PageError(f"{name.capitalize()} is missing. Drop a file into its field.")
        sizes.append(image_size(path, name))
        paths.append(Path(path))
    _check_settings(run)
    make = {"file": _of_file, "numbers": _of_numbers, "images": _of_images}[cameras.camera_input]
    request = make(cameras, sizes)
    options = replace(request.options, left=paths[0], right=paths[1], export=("glb", "mesh"), **run)
    return replace(request, options=options, name=pair_name(*paths), camera_input=cameras.camera_input)


def _check_settings(run: dict[str, Any]) -> None:
    near, far = run.get("near"), run.get("far")
    if any(value is not None and value <= 0 for value in (near, far)):
        raise PageError("The nearest and the farthest depth must be above 0.")
    if near is not None and far is not None and near >= far:
        raise PageError("The nearest depth must be less than the farthest one. Correct or clear them.")
    for name, limit in LIMITS.items():
        if not 0 <= (run.get(name) or 0) <= limit:
            raise PageError(f"{name.capitalize()} must be between 0 and {limit}.")


def _request(**options: Any) -> Request:
    """Return a request whose images and name are filled in later."""
    return Request(DepthOptions(left=Path(), **options), "")


def _of_file(given: CameraFields, sizes: Sequence[Size]) -> Request:
    if not given.calib:
        raise PageError(
            "The calibration file is missing. Choose one, or estimate the camera positions from the images."
        )
    _check_positive(given.baseline, BASELINE_NAME)
    return _request(baseline=given.baseline, calib=tuple(map(Path, given.calib)))


def _of_numbers(given: CameraFields, sizes: Sequence[Size]) -> Request:
    needed = {"fx in pixels": given.lens.get("fx"), "the distance between the cameras": given.baseline}
    if missing := [name for name, value in needed.items() if value is None]:
        raise PageError(f"Enter {' and '.join(missing)} as well.")
    _check_positive(given.baseline, BASELINE_NAME)
    _check_within(given.cx_right, "The right camera's cx", sizes[1][0])
    return _request(baseline=given.baseline, cx_right=given.cx_right, **_lens(given, sizes[0]))


def _check_positive(value: float | None, name: str) -> None:
    if value is not None and not 0 < value < math.inf:
        raise PageError(f"{name} must be above 0.")


def _check_within(value: float | None, name: str, pixels: int) -> None:
    if value is not None and not 0 <= value <= pixels:
        raise PageError(f"{name} must be inside the image: between 0 and {pixels} pixels.")


def _lens(given: CameraFields, size: Size) -> dict[str, float]:
    """Return the entries of the focal length and the optical centre that are filled in."""
    lens = {name: value for name, value in given.lens.items() if value is not None}
    for name in ("fx", "fy"):
        _check_positive(lens.get(name), name)
    for name, pixels in zip(("cx", "cy"), size, strict=True):
        _check_within(lens.get(name), name, pixels)
    return lens


def _of_images(given: CameraFields, sizes: Sequence[Size]) -> Request:
    """Return the request to estimate the cameras: their focal length, and the scale."""
    if not can_estimate():
        raise PageError(NO_POSELIB)
    focal, assumed = _focal(given, sizes[0])
    make = {"measured": _by_baseline, "known": _by_length, "guess": _by_guess}[given.scale_input]
    scaled = make(given, sizes[0])
    options = replace(scaled.options, estimate_pose=True, **focal)
    return replace(scaled, options=options, assumptions=(*assumed, *scaled.assumptions))


def _focal(given: CameraFields, size: Size) -> tuple[dict[str, Any], tuple[Finding, ...]]:
    """Return the options of the focal length, and what is assumed about it."""
    if given.camera == "exif":
        return {}, ()
    if given.camera == "fx":
        if given.lens.get("fx") is None:
            raise PageError("Enter fx, the focal length in pixels, or choose your camera in the list.")
        return _lens(given, size), ()
    if given.camera == "fov":
        if given.fov is None or not 1 <= given.fov <= 170:
            raise PageError("Enter the field of view across the width of the image, 1 to 170 degrees.")
        text = f"The field of view is assumed to be {given.fov:g} degrees, as entered."
        return {"fov": given.fov}, (Finding("camera.from-fov", text),)
    check_choice(given.camera, "camera", LENSES)
    lens = LENSES[given.camera]
    fov = field_of_view_deg(size[0], lens.fx(size))
    focal = f"{lens.equivalent_mm:.0f} mm (35 mm equivalent), as its manufacturer states"
    text = f"The focal length is assumed from the camera {lens.name}: {focal}."
    return {"fov": fov}, (Finding("camera.from-list", text),)


def _by_baseline(given: CameraFields, size: Size) -> Request:
    if given.baseline is None:
        raise PageError(
            "Images alone have no scale. Enter the measured distance between the two positions, or choose a "
            "different way to set the scale."
        )
    for value, name in ((given.baseline, "The measured distance"), (given.baseline_error, "Its accuracy")):
        _check_positive(value, name)
    error = given.baseline_error
    return replace(
        _request(baseline=given.baseline), scale_rel_std=None if error is None else error / given.baseline
    )


def _by_length(given: CameraFields, size: Size) -> Request:
    """Return the request with the known length in the format of ``--known-length``."""
    if given.known_length is None:
        raise PageError("Images alone have no scale. Enter the known length.")
    _check_positive(given.known_length, "The known length")
    numbers = ENDS.findall(given.ends or "")
    if len(numbers) != 4:
        raise PageError("Mark both ends of the known length: tap them in the left image below its field.")
    x1, y1, x2, y2 = (math.floor(float(number) + 0.5) for number in numbers)
    ends = [(x1, y1), (x2, y2)]
    for end in ends:
        check_inside(end, size, f"The end {end} of the known length")
    known = ",".join([*numbers, f"{given.known_length}"])
    return replace(_request(known_length=known), pixels=ends)


def _by_guess(given: CameraFields, size: Size) -> Request:
    check_choice(given.guess, "guess", GUESSES)
    metres, spread = GUESSES[given.guess]
    text = f"The distance between the cameras is a guess of {metres:g} m, ± {100 * spread:.0f} %."
    assumed = Finding("scale.guessed", text)
    return replace(_request(baseline=metres), assumptions=(assumed,), scale_rel_std=spread)


def results_folder() -> Path:
    """Return the parent folder of all results."""
    return Path(tempfile.gettempdir(), RESULTS)


def _new_folder() -> Path:
    results_folder().mkdir(parents=True, exist_ok=True)
    return results_folder() / secrets.token_hex(16)


def run_job(
    request: Request, priors: Priors, stop: threading.Event, report: Callable[[float, str], None]
) -> PairRun:
    """Read the inputs and estimate depth.

    Calls ``report`` with the completed fraction in [0, 1] and the name of the stage.

    Raises:
        Stopped: before the next stage or step after ``stop`` was set.
    """

    def stage(fraction: float, name: str) -> None:
        if stop.is_set():
            raise Stopped
        report(fraction, name)

    options = request.options
    log = JobLog()
    with collected_warnings(silent):  # warnings are in the log
        stage(0.0, "Reading images and cameras")
        # Uploads are stored in temporary folders, so reports name the files without their folders.
        names = options.left.name, Path(str(options.right)).name
        with log.stage("calibration"):
            inputs = read_pair(options, names=names)
        guidance = inputs.guidance
        guidance.add_findings(request.assumptions)
        if guidance.unit is None:  # the page always measures lengths
            raise PageError("The calibration has no unit. Enter the distance between the cameras in metres.")
        stage(0.05, "Loading the prior")
        pipe = priors.get(options.prior)
        total = guidance.denoising_steps(options.steps, pipe.default_denoising_steps) * options.ensemble
        stage(0.1, "Matching the views")
        done = 0

        def show(_pipe: Any, _step: int, _timestep: Any, _now: dict[str, Any]) -> dict[str, Any]:
            nonlocal done
            done += 1
            stage(0.2 + 0.75 * min(done / total, 1.0), f"Guided step {min(done, total)} of {total}")
            return {}

        return run_pair(pipe, options, inputs, log, callback_on_step_end=show)


def write_job(run: PairRun) -> PairResult:
    """Write the files of a result into a new folder, without the server's folders in its report."""
    with collected_warnings(silent), OutFolder(_new_folder()) as folder:
        return write_pair(folder, run, max_points=MAX_CLOUD_POINTS)
