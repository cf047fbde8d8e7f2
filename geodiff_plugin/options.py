"""An option is declared once, as a field of a dataclass, for command line, page, ComfyUI node and checks.

Nothing here imports torch: ``geodiff --help`` and what is wrong with an option are said at once.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable
from dataclasses import Field, dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from geodiff_plugin._checks import bad_value, check_choice, check_number, check_positive, refuse
from geodiff_plugin._lazy import imported
from geodiff_plugin.config import Affects

if TYPE_CHECKING:
    from geodiff_plugin.config import GuidanceConfig

# Titles of the groups of options in ``--help``. Each group fits one screen.
CAMERAS = "Cameras"
SAMPLES = "Data and methods"
OUTPUT = "Output"
PRIOR = "Prior"
GUIDANCE = "Guidance"
UNKNOWN_POSES = "Photographs without poses"
FURTHER_VIEWS = "Further views"
KNOWN_DEPTHS = "Known depths"
SEQUENCES = "Folders, videos and bags"
MACHINES = "Many machines"
SPEED = "Speed on a GPU"
#: The group of an option that is in none of these, as typer calls it.
OTHERS = "Options"
#: The order of the groups: most used first.
PANELS = (
    OTHERS,
    CAMERAS,
    SAMPLES,
    OUTPUT,
    PRIOR,
    GUIDANCE,
    UNKNOWN_POSES,
    FURTHER_VIEWS,
    KNOWN_DEPTHS,
    SEQUENCES,
    MACHINES,
    SPEED,
)
NOTHING, RESULT = Affects.NOTHING, Affects.RESULT
DTYPES = ("float32", "float16", "bfloat16")
#: Keys of ``scale.space.SPACES``, which cannot be imported without torch; a test keeps them the same.
SPACES = ("depth", "disparity", "log", "log1p", "sqrt_disparity")
PRESETS = ("default", "fast", "paper")
#: What works on many items.
ENGINES = ("local", "ray")


class Command(NamedTuple):
    """A command: its options (``None`` for a group, which ``run`` returns), its function and its help."""

    options: type | None
    run: Callable[[Any], Any]
    about: str


@dataclass(frozen=True)
class OptionRules:
    """What ``declare`` says of an option, beside the name, the type and the default of its field."""

    help: str
    flags: tuple[str, ...]  # as typed; empty for ``--name-with-dashes``
    panel: str  # its group in ``--help``
    low: float | None  # least value of a number
    high: float | None
    above_0: str  # the unit of a number that is finite and above 0; empty for other options
    choices: tuple[str, ...]  # empty for any value
    split: bool  # whether a tuple is typed with commas; otherwise its option is repeated
    metavar: str | None  # what it takes, in a word; ``None`` for the word of its type

    @property
    def is_argument(self) -> bool:
        """Whether it is typed without a name."""
        return self.flags == ("",)


def rules_of(field: Field[Any]) -> OptionRules | None:
    """The rules of an option; ``None`` for a field that ``declare`` did not make."""
    return field.metadata.get("rules")


def on_ray(name: str) -> Any:
    """A function of ``jobs.cluster``; ``InputError`` where Ray is not installed."""
    try:
        return imported(f"jobs.cluster.{name}")
    except ModuleNotFoundError as error:
        if error.name not in ("ray", "pyarrow"):
            raise
        refuse("--engine ray needs Ray, which is not installed. Run: pip install 'geodiff-plugin[ray]'.")


def declare(
    default: Any,
    help_text: str,
    *flags: str,
    panel: str = OTHERS,
    low: float | None = None,
    high: float | None = None,
    above_0: str = "",
    choices: tuple[str, ...] = (),
    split: bool = False,
    metavar: str | None = None,
    affects: Affects | None = None,
) -> Any:
    """A field of a dataclass of options: its default, ``MISSING`` where it must be given, and its help.

    ``flags`` are as typed, where that is not ``--name-with-dashes``, ``""`` for an argument without a name. A
    number lies between ``low`` and ``high``, or is finite and above 0, in the unit ``above_0``. A tuple is
    typed with commas where ``split``, otherwise its option is repeated. ``affects`` decides whether what is
    finished is kept when the value changes; commands that keep nothing need not declare it.
    """
    rules = OptionRules(help_text, flags, panel, low, high, above_0, choices, split, metavar)
    return dataclasses.field(default=default, metadata={"rules": rules, "affects": affects})


def flag_of(field: Field[Any]) -> str:
    """How an option is typed: ``--min-confidence``, or ``LEFT`` for an argument."""
    rules = rules_of(field)
    if rules is None or not rules.flags:
        return f"--{field.name.replace('_', '-')}"
    return field.name.upper() if rules.is_argument else rules.flags[0]


def help_of(name: str) -> str:
    """The sentence that says what an option of ``RunOptions`` is."""
    rules = rules_of(RunOptions.__dataclass_fields__[name])
    assert rules is not None
    return rules.help


def check_options(options: Any, name_of: Callable[[Field[Any]], str] = flag_of) -> None:
    """Hold every value of a dataclass of options against what its field declares, if ``declare`` made it."""
    for field in dataclasses.fields(options):
        rules, value, name = rules_of(field), getattr(options, field.name), name_of(field)
        if rules is None:
            continue
        for entry in value if isinstance(value, tuple) else (value,):
            if entry is None:
                continue
            if rules.choices:
                check_choice(entry, name, rules.choices)
            if rules.low is not None:
                assert rules.high is not None
                check_number(entry, name, rules.low, rules.high, integer="int" in str(field.type))
            if rules.above_0:
                check_positive(entry, name, rules.above_0)


def workers_option() -> Any:
    """How many processes of Ray hold the prior."""
    about = "With --engine ray: processes that hold the prior (default: as many as fit)."
    return declare(None, about, low=1, high=10**6, panel=MACHINES, affects=NOTHING)


def gpus_option() -> Any:
    """GPUs of each process of Ray."""
    about = "With --engine ray: GPUs of each process, also a fraction (default: 1 where there are any)."
    return declare(None, about, low=0, high=64, panel=MACHINES, affects=NOTHING)


def engine_option() -> Any:
    """What works on many items."""
    about = "local (this machine) or ray (Ray Data, on one machine or a cluster; extra 'ray')."
    return declare("local", about, choices=ENGINES, panel=MACHINES, affects=NOTHING)


def check_engine(options: Any) -> None:
    """Refuse options of Ray without it, and shards with it."""
    if options.engine == "ray" and getattr(options, "shard", None) is not None:
        refuse("--shard cannot be used with --engine ray, which divides the work by itself.")
    for name in ("workers", "gpus"):
        if options.engine != "ray" and getattr(options, name) is not None:
            refuse(f"--{name} needs --engine ray.")


_prior = partial(declare, panel=PRIOR, affects=RESULT)
_guidance = partial(declare, panel=GUIDANCE, affects=RESULT)


@dataclass(frozen=True, kw_only=True)
class PriorOptions:
    """Which prior runs, and where: what every command that runs one has in common."""

    prior: str = _prior(
        "bundled",
        "The prior: 'bundled', a hub id such as prs-eth/marigold-depth-v1-1, or a folder; KEY:FOLDER names "
        "the adapter of a folder.",
    )
    space: str | None = _prior(
        None,
        f"What the prior's map is affine in, where its folder does not say: {', '.join(SPACES)}.",
        choices=SPACES,
    )
    steps: int | None = _prior(
        None, "Denoising steps (default: the prior's own number, at least 4).", low=1, high=1000
    )
    seed: int = _prior(0, "Seed of the noise.", low=0, high=2**63 - 1)
    device: str = _prior("auto", "Where it runs: auto, cpu, cuda, cuda:N or mps.", affects=NOTHING)


@dataclass(frozen=True, kw_only=True)
class SpeedOptions:
    """How networks and stages run on a GPU; results are equal within rounding."""

    graphs: bool = declare(
        False,
        "Run the networks as CUDA graphs, with a faster group norm in half precision (for many pairs and "
        "captures this is done anyway).",
        panel=SPEED,
        affects=NOTHING,
    )
    no_kernels: bool = declare(
        False, "Run every stage in plain torch, without Triton kernels.", panel=SPEED, affects=NOTHING
    )


@dataclass(frozen=True, kw_only=True)
class RunOptions(PriorOptions):
    """How it runs: what ``geodiff depth``, the page and the ComfyUI node have in common."""

    option: tuple[str, ...] = _prior(
        (), "An option of the prior as NAME=VALUE, such as domain=outdoor of GeoWizard; repeatable."
    )
    ensemble: int = _prior(
        1,
        "Number of runs with different noise; the spread of two or more is the uncertainty.",
        low=1,
        high=1000,
    )
    resolution: int | None = _prior(
        None,
        "Longer side of the image for the prior, in pixels; 0 keeps its size (default: the prior's own).",
        low=0,
        high=8192,
    )
    near: float | None = _guidance(None, "Nearest depth to search, in metres.", above_0="metres")
    far: float | None = _guidance(None, "Farthest depth to search, in metres.", above_0="metres")
    dtype: str = _prior(
        "float32", "Number format of the prior: float32, float16 or bfloat16.", choices=DTYPES
    )
    preset: str = _guidance(
        "default",
        "default, fast (coarser matches, poses as given) or paper (Algorithm 1).",
        choices=PRESETS,
    )
    knob: tuple[str, ...] = _guidance(
        (), "A knob of the guidance, such as inner_steps=0; repeatable. geodiff info --knobs lists them."
    )

    def check(self, name_of: Callable[[Field[Any]], str] = flag_of) -> None:
        """Everything that can be said before a file is opened or torch is imported."""
        check_options(self, name_of)
        names = {field.name: name_of(field) for field in dataclasses.fields(self)}
        if (self.near is None) != (self.far is None):
            missing, given = ("near", "far") if self.near is None else ("far", "near")
            refuse(f"{names[given]} needs {names[missing]}. Give both, in metres.")
        if self.near is not None and self.far is not None and self.near >= self.far:
            got, cure = f"{self.near:g} and {self.far:g}", "Both are metres from the camera."
            bad_value(names["near"], f"less than {names['far']}", got, cure)
        if self.resolution is not None and (self.resolution % 8 or 0 < self.resolution < 32):
            cure = f"Try {max(32, round(self.resolution / 8) * 8)}."
            bad_value(names["resolution"], "a multiple of 8 from 32 on, or 0", self.resolution, cure)
        if not re.fullmatch(r"auto|cpu|mps|cuda(:\d{1,3})?", self.device):
            bad_value(names["device"], "auto, cpu, cuda, cuda:N or mps", repr(self.device))
        for entry in self.option:
            if not all(entry.partition("=")):
                bad_value(names["option"], "NAME=VALUE, such as domain=outdoor", repr(entry))

    def config(self) -> GuidanceConfig:
        """The preset with the range of depths and the knobs that were given; imports torch."""
        from geodiff_plugin.config import PRESETS as CONFIGS
        from geodiff_plugin.config import config_from_text

        base = CONFIGS[self.preset]
        config = config_from_text(self.knob, base, "--knob")
        if config.depth_range is not None:
            refuse("Give depth_range as --near and --far, in metres, not as --knob.")
        if self.near is None or self.far is None:
            return config
        # The paper's search is over one number, between the same two depths.
        name = "depth_range" if self.preset != "paper" else "g_s_range"
        given = name == "g_s_range" and config.g_s_range != base.g_s_range
        return config if given else config.changed(**{name: (self.near, self.far)})

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
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self), default=str))
        return plain
