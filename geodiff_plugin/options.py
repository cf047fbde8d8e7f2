"""Defines the options that several commands, the web app and the ComfyUI node share, and checks them.

An option is a ``settings.setting`` field of a dataclass. Nothing here imports torch, so ``geodiff --help``
and option errors are immediate.

Layer 1: imports ``settings``; ``jobs``, ``evaluation``, ``app`` and ``cli`` import it.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

from geodiff_plugin._internal.checks import bad_value, raise_input_error
from geodiff_plugin.settings import DEFAULT_SECTION, Affects, Setting, check_settings, setting, settings_of

if TYPE_CHECKING:
    from geodiff_plugin.config import GuidanceConfig

# Section headings in ``--help``. Each section fits on one screen.
CAMERAS = "Cameras"
SAMPLES = "Data and methods"
OUTPUT = "Output"
PRIOR = "Prior"
GUIDANCE = "Guidance"
UNKNOWN_POSES = "Images without poses"
FURTHER_VIEWS = "Additional views"
KNOWN_DEPTHS = "Known depths"
MASKS = "Valid pixels"
SEQUENCES = "Folders, videos and bags"
MACHINES = "Distributed runs"
SPEED = "Speed on a GPU"
#: The order of the sections: most used first.
SECTIONS = (
    DEFAULT_SECTION,
    CAMERAS,
    SAMPLES,
    OUTPUT,
    PRIOR,
    GUIDANCE,
    UNKNOWN_POSES,
    FURTHER_VIEWS,
    KNOWN_DEPTHS,
    MASKS,
    SEQUENCES,
    MACHINES,
    SPEED,
)
NOTHING, RESULT = Affects.NOTHING, Affects.RESULT
DTYPES = ("float32", "float16", "bfloat16")
#: Keys of ``scale.space.SPACES``, which imports torch. A test keeps both in sync.
SPACES = ("depth", "disparity", "log", "log1p", "sqrt_disparity")
PRESETS = ("default", "fast", "paper")
#: ``min_steps`` of the default preset, which commands without ``--preset`` use. A test keeps both in sync.
MIN_STEPS = 4
#: Engines that process batches.
ENGINES = ("local", "ray")


class Command(NamedTuple):
    """A command: its options (``None`` for a group that ``run`` returns), its function and its help."""

    options: type | None
    run: Callable[[Any], Any]
    about: str


class Given(NamedTuple):
    """A condition: the option is given, with this value unless it is ``None``."""

    name: str
    value: str | None = None

    def holds(self, options: Any) -> bool:
        """Whether the condition holds for these options."""
        value = getattr(options, self.name)
        return bool(value != self._option(options).default if self.value is None else value == self.value)

    def typed(self, options: Any) -> str:
        """Return the option as typed on the command line."""
        flag = self._option(options).flag
        return flag if self.value is None else f"{flag} {self.value}"

    def _option(self, options: Any) -> Setting:
        return settings_of(type(options))[self.name]


class Needs(NamedTuple):
    """A rule: ``names`` require one of the other options."""

    names: tuple[str, ...]
    one_of: tuple[Given, ...]
    reason: str = ""

    def broken(self, options: Any) -> str:
        """Describe the violation, to follow the option's name; empty if the rule holds."""
        if any(other.holds(options) for other in self.one_of):
            return ""
        return f"needs {' or '.join(other.typed(options) for other in self.one_of)}"


class Excludes(NamedTuple):
    """A rule: ``names`` cannot be combined with another option."""

    names: tuple[str, ...]
    other: Given
    reason: str = ""

    def broken(self, options: Any) -> str:
        """Describe the violation, to follow the option's name; empty if the rule holds."""
        return f"cannot be used with {self.other.typed(options)}" if self.other.holds(options) else ""


def check_rules(options: Any, rules: Iterable[Needs | Excludes]) -> None:
    """Raise an error for the first option that violates a rule. Options that the record lacks never do."""
    known = settings_of(type(options))
    for rule in rules:
        given = [known[name].flag for name in rule.names if name in known and Given(name).holds(options)]
        if given and (words := rule.broken(options)):
            raise_input_error(f"{given[0]} {words}{': ' * bool(rule.reason)}{rule.reason}.")


_prior = partial(setting, section=PRIOR, affects=RESULT)
_guidance = partial(setting, section=GUIDANCE, affects=RESULT)
_speed, _machines = (partial(setting, section=section, affects=NOTHING) for section in (SPEED, MACHINES))


def _steps(minimum: str) -> Any:
    """Declare the number of denoising steps, whose default is at least ``minimum``."""
    help_text = (
        f"Number of denoising steps (default: the prior's default, but at least {minimum}). One-step priors "
        "allow only 1."
    )
    return _prior(None, help_text, low=1, high=1000)


@dataclass(frozen=True, kw_only=True)
class PriorOptions:
    """The prior and the device: options of every command that runs a prior."""

    prior: str = _prior(
        "bundled",
        "Depth prior: 'bundled', a Hugging Face model ID such as prs-eth/marigold-depth-v1-1, or a folder. "
        "KEY:FOLDER loads a folder with the adapter KEY, such as marigold.",
    )
    space: str | None = _prior(
        None,
        f"Quantity that the prior predicts up to scale and shift: {', '.join(SPACES[:-1])} or {SPACES[-1]} "
        "(default: from its config).",
        choices=SPACES,
    )
    steps: int | None = _steps(f"{MIN_STEPS}")
    seed: int = _prior(0, "Seed for the random noise.", low=0, high=2**63 - 1)
    dtype: str = _prior("float32", "Precision of the prior: float32, float16 or bfloat16.", choices=DTYPES)
    device: str = _prior("auto", "Device: auto, cpu, cuda, cuda:N or mps.", affects=NOTHING)


@dataclass(frozen=True, kw_only=True)
class ServerOptions:
    """Address of a page that a command serves."""

    host: str = setting(
        "127.0.0.1",
        "Address to listen on; 0.0.0.0 accepts connections from other machines, without a password.",
    )
    port: int | None = setting(None, "Port (default: first free port).", low=1, high=65535)


@dataclass(frozen=True, kw_only=True)
class SpeedOptions:
    """Options for running networks and stages on a GPU. Results are equal within rounding."""

    cuda_graphs: bool = _speed(
        False,
        "Run the networks as CUDA graphs; in half precision, also use a faster group norm. Always enabled "
        "for batches and captures on a CUDA device.",
    )
    no_triton: bool = _speed(False, "Disable the Triton kernels and run all stages in plain PyTorch.")


@dataclass(frozen=True, kw_only=True)
class MachineOptions:
    """Options for distributing a batch."""

    engine: str = _machines(
        "local",
        "Where to run: local (this machine) or ray (Ray Data, one machine or a cluster; needs the extra "
        "'ray').",
        choices=ENGINES,
    )
    workers: int | None = _machines(
        None,
        "With --engine ray: number of workers, each with a copy of the prior (default: as many as fit).",
        low=1,
        high=10**6,
    )
    gpus: float | None = _machines(
        None,
        "With --engine ray: GPUs per worker; may be fractional (default: 1 if a GPU is available).",
        low=0,
        high=64,
    )


RAY = Given("engine", "ray")
MACHINE_RULES = (
    Needs(("workers", "gpus"), (RAY,)),
    Excludes(("shard",), RAY, "Ray distributes the work itself"),
)


@dataclass(frozen=True, kw_only=True)
class RunOptions(PriorOptions):
    """Run options that ``geodiff depth``, the web app and the ComfyUI node share."""

    steps: int | None = _steps("the preset's min_steps")
    option: tuple[str, ...] = _prior(
        (), "Prior-specific option as NAME=VALUE, such as domain=outdoor for GeoWizard; repeatable."
    )
    ensemble: int = _prior(
        1,
        "Number of ensemble predictions, each with different noise; the result is their median. geodiff "
        "depth also writes their spread to uncertainty.npy.",
        low=1,
        high=1000,
    )
    resolution: int | None = _prior(
        None,
        "Longer side of the prior's input in pixels; 0 keeps the image size (default: the prior's default).",
        low=0,
        high=8192,
    )
    near: float | None = _guidance(None, "Nearest depth to search, in metres; needs --far.", above_0="metres")
    far: float | None = _guidance(
        None, "Farthest depth to search, in metres; needs --near.", above_0="metres"
    )
    preset: str = _guidance(
        "default",
        "Preset: default, fast (coarser matches, a single fit to the matches, the prior's default number of "
        "steps, poses used as given) or paper (Algorithm 1).",
        choices=PRESETS,
    )
    parameter: tuple[str, ...] = _guidance(
        (),
        "Set a guidance parameter, such as guidance_steps=10; repeatable. geodiff info --parameters lists "
        "all parameters.",
        "--set",
        metavar="NAME=VALUE",
    )

    def check(self, name_of: Callable[[Setting], str] = lambda option: option.flag) -> None:
        """Check all options that can be checked before a file is opened or torch is imported."""
        check_settings(self, name_of)
        names = {name: name_of(option) for name, option in settings_of(type(self)).items()}
        if (self.near is None) != (self.far is None):
            missing, given = ("near", "far") if self.near is None else ("far", "near")
            raise_input_error(f"{names[given]} needs {names[missing]}. Set both, in metres.")
        if self.near is not None and self.far is not None and self.near >= self.far:
            got = f"{self.near:g} and {self.far:g}"
            hint = "Both are depths in metres."
            bad_value(names["near"], f"less than {names['far']}", got, hint)
        if self.resolution is not None and (self.resolution % 8 or 0 < self.resolution < 32):
            hint = f"Try {max(32, round(self.resolution / 8) * 8)}."
            bad_value(names["resolution"], "0 or a multiple of 8, at least 32", self.resolution, hint)
        if not re.fullmatch(r"auto|cpu|mps|cuda(:\d{1,3})?", self.device):
            bad_value(names["device"], "auto, cpu, cuda, cuda:N or mps", repr(self.device))
        for entry in self.option:
            if not all(entry.partition("=")):
                bad_value(names["option"], "NAME=VALUE, such as domain=outdoor", repr(entry))

    def config(self) -> GuidanceConfig:
        """Return the preset with the given depth range and parameters; imports torch."""
        from geodiff_plugin.config import PRESETS as CONFIGS
        from geodiff_plugin.config import config_from_text

        base = CONFIGS[self.preset]
        config = config_from_text(self.parameter, base, "--set")
        if config.depth_range is not None:
            raise_input_error("depth_range cannot be set with --set. Use --near and --far, in metres.")
        if self.near is None or self.far is None:
            return config
        # The paper preset searches a single number within the same depth range.
        name = "depth_range" if self.preset != "paper" else "g_s_range"
        given = name == "g_s_range" and config.g_s_range != base.g_s_range
        return config if given else config.changed(**{name: (self.near, self.far)})

    def call(self) -> dict[str, Any]:
        """Return the keyword arguments of the pipeline call, without its generator."""
        return {
            **dict(entry.split("=", 1) for entry in self.option),
            "num_inference_steps": self.steps,
            "processing_resolution": self.resolution,
            "ensemble_size": self.ensemble,
            "output_uncertainty": self.ensemble > 1,
        }

    def as_json(self) -> dict[str, Any]:
        """Return the options as JSON values."""
        plain: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(self), default=str))
        return plain
