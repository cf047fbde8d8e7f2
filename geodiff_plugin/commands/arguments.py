"""What ``geodiff depth`` was asked to do, and the checks that need no file.

Hop: options as typed -> ``DepthArguments`` -> ``Settings`` (device, dtype, range) or one clear error.
Paper: none.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin.knobs import DEFAULT_WEIGHTS, knobs_from_text
from geodiff_plugin.metric import SPACES
from geodiff_plugin.presets import PAPER_WEIGHTS

__all__ = [
    "DTYPES",
    "PRESETS",
    "DepthArguments",
    "Settings",
    "check_arguments",
    "check_positive",
    "pick_device",
]

DTYPES = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
PRESETS = ("default", "paper")
MOST_STEPS = 1000
MOST_MEMBERS = 1000
LARGEST_RESOLUTION = 8192


@dataclass(frozen=True)
class DepthArguments:
    """The options of ``geodiff depth`` as they were typed; help and units stand in ``cli.py``."""

    left: Path
    right: Path
    calib: tuple[Path, ...] = ()
    cameras: str | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    baseline: float | None = None
    k: Path | None = None
    e: Path | None = None
    k_right: Path | None = None
    view: tuple[Path, ...] = ()
    view_k: tuple[Path, ...] = ()
    view_e: tuple[Path, ...] = ()
    prior: str = "bundled"
    space: str | None = None
    option: tuple[str, ...] = ()
    steps: int | None = None
    ensemble: int = 1
    resolution: int | None = None
    points: Path | None = None
    near: float | None = None
    far: float | None = None
    seed: int = 0
    device: str = "auto"
    dtype: str = "float32"
    preset: str = "default"
    knob: tuple[str, ...] = ()
    min_confidence: float = 0.0
    out: Path = Path("geodiff-out")
    overwrite: bool = False
    quiet: bool = False
    json: bool = False

    def as_json(self) -> dict[str, Any]:
        """The options as JSON can hold them."""
        return {name: _plain(value) for name, value in asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value


@dataclass(frozen=True)
class Settings:
    """What was understood.

    Attributes:
        device: where the pipeline runs.
        dtype: of U-Net and VAE.
        depth_range: ``(near, far)`` metres, or ``None``.
        options: what ``--option`` gives to the prior's call.
        knobs: keywords of the guidance from ``--knob``, not checked.
        cameras: numbers of the left and the right camera in the calibration, or ``None``.
    """

    device: torch.device
    dtype: torch.dtype
    depth_range: tuple[float, float] | None
    options: dict[str, str]
    knobs: dict[str, Any]
    cameras: tuple[int, int] | None


def check_positive(value: float, name: str, unit: str, cure: str = "") -> None:
    """Refuse what is not a finite number above 0.

    Raises:
        ValueError: it is not.
    """
    if not (math.isfinite(value) and value > 0):
        bad_value(name, f"a finite number of {unit} above 0", value, cure)


def pick_device(name: str) -> torch.device:
    """The device of that name; ``"auto"`` takes CUDA, then MPS, then the CPU.

    Raises:
        ValueError: no such device on this machine.
    """
    if name == "auto":
        if torch.cuda.is_available():
            return torch.device("cuda")
        return torch.device("mps" if torch.backends.mps.is_available() else "cpu")
    expected = "auto, cpu, cuda, cuda:N or mps"
    try:
        device = torch.device(name)
    except RuntimeError:
        bad_value("--device", expected, repr(name))
    here = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    if device.type not in here:
        bad_value("--device", expected, repr(name))
    if not here[device.type]:
        bad_value("--device", "a device of this machine", repr(name), f"PyTorch finds no {device.type} here.")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        bad_value(
            "--device", f"one of the {torch.cuda.device_count()} CUDA devices of this machine", repr(name)
        )
    return device


def _check_cameras(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdigit() for part in parts):
        bad_value("--cameras", "two camera numbers with a comma, left first, such as 2,3", repr(text))
    left, right = (int(part) for part in parts)
    if left == right:
        bad_value("--cameras", "two different cameras", repr(text))
    return left, right


def _check_options(typed: tuple[str, ...]) -> dict[str, str]:
    pairs = [entry.partition("=") for entry in typed]
    for entry, (name, equals, value) in zip(typed, pairs, strict=True):
        if not (name and equals and value):
            bad_value("--option", "NAME=VALUE, such as domain=outdoor", repr(entry))
    return {name: value for name, _, value in pairs}


def _check_knobs(typed: tuple[str, ...], preset: str) -> dict[str, Any]:
    knobs = knobs_from_text(typed, PAPER_WEIGHTS if preset == "paper" else DEFAULT_WEIGHTS, "--knob")
    if "depth_range" in knobs:
        bad_value("--knob depth_range", "given as --near and --far", knobs["depth_range"])
    return knobs


def _check_depth_range(near: float | None, far: float | None) -> tuple[float, float] | None:
    if near is None and far is None:
        return None
    if near is None or far is None:
        missing, given = ("--near", "--far") if near is None else ("--far", "--near")
        bad_value(missing, f"given together with {given}", "none", "Both in metres.")
    check_positive(near, "--near", "metres")
    check_positive(far, "--far", "metres")
    if near >= far:
        bad_value("--near", "less than --far", f"{near:g} and {far:g}", "Both are metres from the camera.")
    return near, far


def _check_out(out: Path, overwrite: bool) -> None:
    if out.exists() and not out.is_dir():
        bad_value("--out", "a folder", f"the file {out}")
    if out.is_dir() and any(out.iterdir()) and not overwrite:
        bad_value(
            "--out", "a new or empty folder", f"{out}, which holds files", "Name another, or add --overwrite."
        )


def check_arguments(arguments: DepthArguments) -> Settings:
    """Everything that can be said of the options before a file is opened.

    Raises:
        TypeError, ValueError: naming the option.
    """
    if arguments.steps is not None:
        check_number(arguments.steps, "--steps", 1, MOST_STEPS, integer=True)
    check_number(arguments.ensemble, "--ensemble", 1, MOST_MEMBERS, integer=True)
    if arguments.resolution is not None:
        check_number(arguments.resolution, "--resolution", 0, LARGEST_RESOLUTION, integer=True)
        if arguments.resolution % 8 or 0 < arguments.resolution < 32:
            bad_value(
                "--resolution",
                "a multiple of 8 from 32 on, or 0 for the image's own size",
                arguments.resolution,
                f"Try {max(32, round(arguments.resolution / 8) * 8)}.",
            )
    if arguments.space is not None:
        check_choice(arguments.space, "--space", SPACES)
    check_number(arguments.seed, "--seed", 0, 2**63 - 1, integer=True)
    check_choice(arguments.dtype, "--dtype", DTYPES)
    check_choice(arguments.preset, "--preset", PRESETS)
    if arguments.preset == "paper":
        for option, what, given in (
            ("--points", "no points", arguments.points is not None),
            ("--view", "two views", bool(arguments.view)),
        ):
            if given:
                cure = f"Algorithm 1 has {what}."
                bad_value(option, "given with the default preset", "--preset paper", cure)
    check_number(arguments.min_confidence, "--min-confidence", 0.0, 1.0)
    _check_out(arguments.out, arguments.overwrite)
    return Settings(
        device=pick_device(arguments.device),
        dtype=DTYPES[arguments.dtype],
        depth_range=_check_depth_range(arguments.near, arguments.far),
        options=_check_options(arguments.option),
        knobs=_check_knobs(arguments.knob, arguments.preset),
        cameras=_check_cameras(arguments.cameras),
    )
