"""Checks of the options of ``geodiff depth`` that need neither files nor torch.

Data flow: ``DepthArguments`` -> the same, or one clear error in under a second.
Paper: none.
"""

from __future__ import annotations

import math
import re

from geodiff_plugin._checks import bad_value, check_choice, check_number
from geodiff_plugin.cli.arguments import DepthArguments

__all__ = [
    "DTYPES",
    "LARGEST_SEED",
    "PRESETS",
    "SPACES",
    "camera_pair",
    "check_arguments",
    "check_positive",
    "check_resolution",
]

DTYPES = ("float32", "float16", "bfloat16")
#: Keys of ``scale.space.SPACES``, which cannot be imported without torch; a test keeps them the same.
SPACES = ("depth", "disparity", "log", "log1p", "sqrt_disparity")
#: Those that two views suffice for.
PRESETS = ("default", "paper")
MOST_STEPS = 1000
MOST_MEMBERS = 1000
LARGEST_RESOLUTION = 8192
LARGEST_SEED = 2**63 - 1


def check_positive(value: float, name: str, unit: str, cure: str = "") -> None:
    """Refuse what is not a finite number above 0.

    Raises:
        ValueError: it is not.
    """
    if not (math.isfinite(value) and value > 0):
        bad_value(name, f"a finite number of {unit} above 0", value, cure)


def _check_device_name(name: str) -> None:
    if not re.fullmatch(r"auto|cpu|mps|cuda(:\d{1,3})?", name):
        bad_value("--device", "auto, cpu, cuda, cuda:N or mps", repr(name))


def _check_depth_range(near: float | None, far: float | None) -> None:
    if near is None and far is None:
        return
    if near is None or far is None:
        missing, given = ("--near", "--far") if near is None else ("--far", "--near")
        bad_value(missing, f"given together with {given}", "none", "Both in metres.")
    check_positive(near, "--near", "metres")
    check_positive(far, "--far", "metres")
    if near >= far:
        bad_value("--near", "less than --far", f"{near:g} and {far:g}", "Both are metres from the camera.")


def check_resolution(value: int, name: str, largest: int, meaning_of_0: str) -> None:
    """Refuse a processing resolution, in pixels, that no latent has.

    Raises:
        ValueError: out of range, or neither 0 nor a multiple of 8 from 32 on.
    """
    check_number(value, name, 0, largest, integer=True)
    if value % 8 or 0 < value < 32:
        cure = f"Try {max(32, round(value / 8) * 8)}."
        bad_value(name, f"a multiple of 8 from 32 on, or 0 for {meaning_of_0}", value, cure)


def _check_numbers(arguments: DepthArguments) -> None:
    if arguments.steps is not None:
        check_number(arguments.steps, "--steps", 1, MOST_STEPS, integer=True)
    check_number(arguments.ensemble, "--ensemble", 1, MOST_MEMBERS, integer=True)
    if arguments.resolution is not None:
        check_resolution(arguments.resolution, "--resolution", LARGEST_RESOLUTION, "the image's own size")
    check_number(arguments.seed, "--seed", 0, LARGEST_SEED, integer=True)
    check_number(arguments.min_confidence, "--min-confidence", 0.0, 1.0)
    if arguments.points_scale is not None:
        check_positive(arguments.points_scale, "--points-scale", "units per metre")
    _check_depth_range(arguments.near, arguments.far)


def _check_words(arguments: DepthArguments) -> None:
    _check_device_name(arguments.device)
    check_choice(arguments.dtype, "--dtype", DTYPES)
    check_choice(arguments.preset, "--preset", PRESETS)
    if arguments.space is not None:
        check_choice(arguments.space, "--space", SPACES)
    if arguments.cameras is not None:
        camera_pair(arguments.cameras)
    for entry in arguments.option:
        name, equals, value = entry.partition("=")
        if not (name and equals and value):
            bad_value("--option", "NAME=VALUE, such as domain=outdoor", repr(entry))


def camera_pair(text: str) -> tuple[int, int]:
    """The two numbers of ``--cameras``.

    Raises:
        ValueError: not two different numbers with a comma.
    """
    parts = text.split(",")
    if len(parts) != 2 or not all(part.strip().isdecimal() and len(part) < 10 for part in parts):
        bad_value("--cameras", "two camera numbers with a comma, left first, such as 2,3", repr(text))
    left, right = (int(part) for part in parts)
    if left == right:
        bad_value("--cameras", "two different cameras", repr(text))
    return left, right


def _check_together(arguments: DepthArguments) -> None:
    """Options that exclude or need each other."""
    if arguments.preset == "paper":
        for option, what, given in (
            ("--points", "no points", arguments.points is not None),
            ("--view", "two views", bool(arguments.view)),
        ):
            if given:
                cure = f"Algorithm 1 has {what}."
                bad_value(option, "given with the default preset", "--preset paper", cure)
        if arguments.warm_start:
            cure = "Its scale is settled once, by a search over one number."
            bad_value("--warm-start", "given with the default preset", "--preset paper", cure)
    for option, given in (
        ("--fov", arguments.fov is not None),
        ("--known-length", arguments.known_length is not None),
        ("--matcher", arguments.matcher is not None),
    ):
        if given and not arguments.estimate_pose:
            bad_value(option, "given together with --estimate-pose", "no --estimate-pose")
    for option, given in (
        ("--points-scale", arguments.points_scale is not None),
        ("--points-calib", bool(arguments.points_calib)),
    ):
        if given and arguments.points is None:
            bad_value(option, "given with --points", "no --points")
    if arguments.right is None:
        _check_alone(arguments)
    for option, files, counts in (
        ("--view-E", arguments.view_e, {0 if arguments.estimate_pose else len(arguments.view)}),
        ("--view-K", arguments.view_k, {0, len(arguments.view)}),
        ("--view-distortion", arguments.view_distortion, {0, len(arguments.view)}),
    ):
        if len(files) not in counts:
            bad_value(option, f"given once for each of {len(arguments.view)} --view", f"{len(files)} times")


def _check_alone(arguments: DepthArguments) -> None:
    """LEFT without RIGHT: known points, and nothing that is of a second camera."""
    if arguments.points is None:
        cure = "One photograph alone does not tell metres: give a second one, or known depths with --points."
        bad_value("RIGHT", "given, or --points instead of it", "neither", cure)
    for option, given in (
        ("--baseline", arguments.baseline is not None),
        ("--E", arguments.e is not None),
        ("--K-right", arguments.k_right is not None),
        ("--view", bool(arguments.view)),
        ("--estimate-pose", arguments.estimate_pose),
        ("--preset paper", arguments.preset == "paper"),
    ):
        if given:
            bad_value(option, "given with RIGHT", "no RIGHT", "It belongs to a second view.")


def check_arguments(arguments: DepthArguments) -> None:
    """Everything that can be said of the options before a file is opened or torch is imported.

    Knobs, and whether a device is there, are checked when torch is: ``settings.read_settings``.

    Raises:
        TypeError, ValueError: naming the option.
    """
    _check_numbers(arguments)
    _check_words(arguments)
    _check_together(arguments)
