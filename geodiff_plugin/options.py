"""An option is declared once, as a field of a dataclass, for command line, page, ComfyUI node and checks.

Nothing here imports torch: ``geodiff --help`` and what is wrong with an option are said at once.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from dataclasses import Field, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geodiff_plugin._checks import bad_value, check_choice, check_number, check_positive, refuse

if TYPE_CHECKING:
    from geodiff_plugin.config import GuidanceConfig

#: Headings of the help.
CAMERAS, RUN, OUTPUT = "Cameras", "Prior and run", "Output"
DTYPES = ("float32", "float16", "bfloat16")
#: Keys of ``scale.space.SPACES``, which cannot be imported without torch; a test keeps them the same.
SPACES = ("depth", "disparity", "log", "log1p", "sqrt_disparity")
#: The presets that two views suffice for.
PRESETS = ("default", "paper")


def declare(
    default: Any,
    help_text: str,
    *flags: str,
    panel: str = RUN,
    low: float | None = None,
    high: float | None = None,
    above_0: str = "",
    choices: tuple[str, ...] = (),
    split: bool = False,
    metavar: str | None = None,
) -> Any:
    """A field of a dataclass of options.

    Args:
        default: its value where nothing is given; ``dataclasses.MISSING`` where something must be.
        help_text: a sentence, with the unit.
        *flags: as typed, where that is not ``--name-with-dashes``; ``""`` for an argument without a name.
        panel: heading in the help.
        low: least number, with ``high``.
        high: largest number.
        above_0: unit of a number that is finite and above 0.
        choices: every value that it may have, besides ``None``.
        split: a tuple that is typed with commas; otherwise a tuple's option is repeated.
        metavar: what the help calls its value.
    """
    metadata = {"help": help_text, "flags": flags, "panel": panel, "split": split, "metavar": metavar}
    metadata |= {"low": low, "high": high, "above_0": above_0, "choices": choices}
    return dataclasses.field(default=default, metadata=metadata)


def flag_of(field: Field[Any]) -> str:
    """How an option is typed: ``--min-confidence``, or ``LEFT`` for an argument."""
    flags = field.metadata.get("flags") or (f"--{field.name.replace('_', '-')}",)
    return flags[0] or field.name.upper()


def help_of(name: str, options: type | None = None) -> str:
    """The sentence that says what an option of ``RunOptions``, or of another dataclass, is."""
    text: str = (options or RunOptions).__dataclass_fields__[name].metadata["help"]  # type: ignore[attr-defined]
    return text


def check_options(options: Any, name_of: Callable[[Field[Any]], str] = flag_of) -> None:
    """Hold every value of a dataclass of options against what its field declares.

    Args:
        options: of fields made by ``declare``; others are left alone.
        name_of: what a message calls a field.

    Raises:
        InputError: naming the option.
    """
    for field in dataclasses.fields(options):
        rules, value = field.metadata, getattr(options, field.name)
        for entry in value if isinstance(value, tuple) else (value,):
            if entry is None or not rules:
                continue
            if rules["choices"]:
                check_choice(entry, name_of(field), rules["choices"])
            if rules["low"] is not None:
                whole = "int" in str(field.type)
                check_number(entry, name_of(field), rules["low"], rules["high"], integer=whole)
            if rules["above_0"]:
                check_positive(entry, name_of(field), rules["above_0"])


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Which prior runs, and how: what ``geodiff depth``, the page and the ComfyUI node have in common."""

    prior: str = declare("bundled", "'bundled', a hub id or a folder; KEY:folder says which kind.")
    space: str | None = declare(
        None,
        "Space in which the prior's map is affine, if its folder does not say: depth, disparity ...",
        choices=SPACES,
    )
    option: tuple[str, ...] = declare(
        (), "An option that only this prior has, as NAME=VALUE (GeoWizard: domain=outdoor)."
    )
    steps: int | None = declare(
        None, "Denoising steps; by default the prior's own, at least 4.", low=1, high=1000
    )
    ensemble: int = declare(
        1, "Number of members; with 2 or more, their spread is written as uncertainty.", low=1, high=1000
    )
    resolution: int | None = declare(
        None, "Longer side at which the prior works, pixels; 0: the image's own.", low=0, high=8192
    )
    near: float | None = declare(None, "Nearest depth to search, metres.", above_0="metres")
    far: float | None = declare(None, "Farthest depth to search, metres.", above_0="metres")
    seed: int = declare(0, "Seed of the noise.", low=0, high=2**63 - 1)
    device: str = declare("auto", "auto, cpu, cuda, cuda:N or mps.")
    dtype: str = declare("float32", "float32, float16 or bfloat16.", choices=DTYPES)
    preset: str = declare("default", "default, or paper (Algorithm 1 as printed).", choices=PRESETS)
    knob: tuple[str, ...] = declare(
        (), "A knob of the guidance (geodiff info --knobs), as inner_steps=0; repeatable."
    )

    def check(self, name_of: Callable[[Field[Any]], str] = flag_of) -> None:
        """Everything that can be said before a file is opened or torch is imported.

        Raises:
            InputError: naming the option.
        """
        check_options(self, name_of)
        names = {field.name: name_of(field) for field in dataclasses.fields(self)}
        if (self.near is None) != (self.far is None):
            missing, given = ("near", "far") if self.near is None else ("far", "near")
            bad_value(names[missing], f"given together with {names[given]}", "none", "Both in metres.")
        if self.near is not None and self.far is not None and self.near >= self.far:
            cure = "Both are metres from the camera."
            bad_value(names["near"], f"less than {names['far']}", f"{self.near:g} and {self.far:g}", cure)
        if self.resolution is not None and (self.resolution % 8 or 0 < self.resolution < 32):
            cure = f"Try {max(32, round(self.resolution / 8) * 8)}."
            bad_value(names["resolution"], "a multiple of 8 from 32 on, or 0", self.resolution, cure)
        if not re.fullmatch(r"auto|cpu|mps|cuda(:\d{1,3})?", self.device):
            bad_value(names["device"], "auto, cpu, cuda, cuda:N or mps", repr(self.device))
        for entry in self.option:
            if not all(entry.partition("=")):
                bad_value(names["option"], "NAME=VALUE, such as domain=outdoor", repr(entry))

    def config(self) -> GuidanceConfig:
        """The preset with the range of depths and the knobs that were given; imports torch.

        Raises:
            InputError: a knob that does not exist, or the range given as one.
        """
        from geodiff_plugin.config import PRESETS as CONFIGS
        from geodiff_plugin.config import config_from_text

        base = CONFIGS[self.preset]
        config = config_from_text(self.knob, base, "--knob")
        if config.depth_range is not None:
            refuse("Give depth_range as --near and --far, in metres, not as --knob.")
        if self.near is None or self.far is None:
            return config
        if self.preset != "paper":
            return config.changed(depth_range=(self.near, self.far))
        # The paper's search is over one number, between the same two depths.
        given = config.g_s_range != base.g_s_range
        return config if given else config.changed(g_s_range=(self.near, self.far))

    def call(self) -> dict[str, Any]:
        """Keywords of the pipeline's call, without its generator."""
        return {
            **dict(entry.split("=", 1) for entry in self.option),
            "num_inference_steps": self.steps,
            "processing_resolution": self.resolution,
            "ensemble_size": self.ensemble,
            "output_uncertainty": self.ensemble > 1,
        }

    def as_json(self) -> dict[str, Any]:
        """The options as JSON can hold them."""
        return {name: _plain(value) for name, value in dataclasses.asdict(self).items()}


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_plain(entry) for entry in value]
    return str(value) if isinstance(value, Path) else value
