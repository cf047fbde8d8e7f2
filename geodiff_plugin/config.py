"""Defines all guidance parameters as one flat, frozen configuration, and its presets.

docs/reference/parameters.md, which is made from this module, lists which of them S5.1 and Algorithm 1 name.

Layer 1: imports ``settings``; everything above imports it.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

from geodiff_plugin._internal.checks import bad_type, bad_value, check_number, check_range, warn
from geodiff_plugin.findings import Finding
from geodiff_plugin.settings import Affects, setting, settings_of

#: Loss weights of the default preset.
DEFAULT_WEIGHTS = {"photometric": 1.0, "matches": 1.0, "points": 1.0, "affine_reg": 0.01, "anchor": 1.0}
#: Minimum of a number that must be positive.
TINY = 1e-9
EVIDENCE, RESULT = Affects.EVIDENCE, Affects.RESULT


class _FrozenDict(dict[str, Any]):
    """An immutable dict that compares equal to a dict with the same items."""

    def _forbid(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a configuration is immutable; create a new one with changed(...)")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _forbid

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type[_FrozenDict], tuple[dict[str, Any]]]:
        return _FrozenDict, (dict(self),)


def _text(values: str) -> dict[str, Any]:
    """Rules for a non-empty string, whose validity only the code that uses it can check."""

    def check(value: Any, name: str) -> str:
        text = str(value) if isinstance(value, Path) else value
        return text if isinstance(text, str) and text else bad_type(name, f"a string ({values})", value)

    return {"own_check": check, "own_values": values}


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else bad_type(name, "a dict that maps names to values", value)


def _check_weights(value: Any, name: str) -> _FrozenDict:
    """Check a dict that maps names of loss terms to weights >= 0."""
    weights = {}
    for key, weight in _mapping(value, name).items():
        if not isinstance(key, str):
            bad_value(f"a key of {name}", "a string", repr(key))
        weights[key] = float(check_number(weight, f"{name}[{key!r}]", 0.0, float("inf")))
    return _FrozenDict(weights)


#: Rules for a pair of numbers in metres; a list is converted to a tuple.
_PAIR: dict[str, Any] = {"own_check": check_range, "own_values": "pair with 0 < low < high, m"}
# The sections of the tables, in order.
_call, _term, _search, _fit, _update = (
    partial(setting, section=section, affects=RESULT)
    for section in (
        "Call",
        "Loss terms",
        "Plane sweep and scale search (S7.3)",
        "Match fitting",
        "Gradient updates (Algorithm 1)",
    )
)


class UpdatePlan(NamedTuple):
    """Gradient updates of a call: ``guidance_steps`` per denoising step.

    Denoising steps that end before the fraction ``updates_from`` of the schedule make no updates.
    """

    guidance_steps: int
    updates_from: float
    lr_latents: float


@dataclass(frozen=True)
class GuidanceConfig:
    """Parameters of guidance by a second view. Without arguments this is the default preset.

    Raises:
        InputError: A value has the wrong type or is out of range. The message names the parameter.
    """

    gradient: str = _call(
        "denoised",
        "What the gradient updates: `denoised`, the predicted clean latent (no gradient through the U-Net), "
        "or `full`, z_t (gradient through the U-Net)",
        choices=("denoised", "full"),
    )
    weights: Mapping[str, float] = _call(
        _FrozenDict(DEFAULT_WEIGHTS),
        "Weights of the loss terms; a term with weight 0 is not computed (gamma of Eq. 17 is `affine_reg`)",
        own_check=_check_weights,
        own_values="term -> >= 0",
    )
    min_steps: int = _call(
        4,
        "Minimum number of denoising steps when the call sets none and the pipeline's default is lower",
        low=1,
        high=1000,
        paper="{}, not given",
    )
    trailing_spacing: bool = _call(True, "Whether to run a leading DDIM schedule as trailing during guidance")
    sweep_pixels: int = _call(
        210_000,
        "Maximum number of pixels of the grid on which matches, match fitting and losses are computed",
        low=1024,
        high=1 << 32,
        affects=EVIDENCE,
        paper="{} (768 px, S9)",
    )
    depth_range: tuple[float, float] | None = _call(
        None,
        "Nearest and farthest depth of the plane sweep and of the scale search",
        **_PAIR,
        affects=EVIDENCE,
        paper="-",
        unset="from the nearest plane to a disparity of 0.3 px",
    )
    pose: str = _call(
        "refine",
        "Whether to `refine` poses that do not fit the matches, or to use them as `given` "
        "([poses](../how-to/poses.md))",
        choices=("refine", "given"),
        affects=EVIDENCE,
    )
    clean_images: bool = _call(
        True,
        "Whether to remove JPEG blocks and strong sensor noise before images are compared. The prior gets "
        "the original image; with `--distortion` it gets the cleaned and undistorted image",
        affects=EVIDENCE,
    )
    decoder: str = _call(
        "full",
        "Autoencoder for latents ([priors](../reference/priors.md))",
        **_text("`full`, `tiny`, a folder or a Hugging Face model ID"),
        paper="-",
    )
    ssim_weight: float = _term(
        0.85,
        "Weight of SSIM relative to L1 in the photometric term (Eq. 14)",
        low=0,
        high=1,
        paper="{}, not given",
    )
    pyramid_levels: int = _term(3, "Number of image pyramid levels of the photometric term", low=1, high=10)
    exposure: bool = _term(
        True,
        "Whether to match the right images' exposure to the left image (gain, bias and a smooth field) in "
        "the photometric term",
    )
    occlusion_mask: bool = _term(
        True, "Whether to exclude pixels that are occluded in a right view from the photometric term"
    )
    min_visible: float = _term(
        0.1, "Visible fraction of the image below which the photometric term is off", low=0, high=1
    )
    affine_reg_target: str = _term(
        "search",
        "Target of the regularization `affine_reg` of s_hat and t_hat (Eq. 17): the result of the scale "
        "search, or zero",
        choices=("search", "zero"),
    )
    points_loss: str = _term(
        "robust",
        "Loss at known points: `robust` (Cauchy in inverse depth, scaled by 1 % of the points' median) or "
        "`l1l2` (L1 + L2 in metres)",
        choices=("robust", "l1l2"),
        paper="-",
    )
    planes: int = _search(
        160,
        "Maximum number of planes of the sweep",
        low=24,
        high=4096,
        affects=EVIDENCE,
        paper="-",
    )
    search: str = _search(
        "volume",
        "How to search the scale: `volume` (joint near and far depth in the cost volume, then the basin "
        "that reliable matches prefer; without a right view a robust fit to the points), `one-number` "
        "(argmin over g_s, S7.3) or `points-range` (nearest and farthest point, Marigold-DC)",
        choices=("volume", "one-number", "points-range"),
        affects=EVIDENCE,
    )
    positive: str = _search(
        "softplus",
        "How raw scale and shift are mapped to positive values (Eq. 13); `square` also clips the map to [0, "
        "1]",
        choices=("softplus", "square"),
    )
    g_s_range: tuple[float, float] = _search(
        (1.0, 80.0),
        'Range of g_s in the `one-number` search; the paper states "a predefined depth range" (S7.3)',
        **_PAIR,
        paper="{}, not given",
    )
    g_s_candidates: int = _search(
        80,
        "Number of candidates in the `one-number` search",
        low=2,
        high=100_000,
        paper="{}, not given",
    )
    reject_reflections: bool = _fit(
        True, "Whether to reject regions of matches behind the first decoded estimate as reflections"
    )
    fit_matches: bool = _fit(
        True,
        "Whether to fit the decoded map to matches and points and to encode the change before gradient "
        "updates. Ignored if gradients pass through the network (SteeredMarigold, Gregorek and Nalpantidis "
        "2024)",
    )
    match_fits: int = _fit(
        2,
        "Maximum number of match fits, each in its own denoising step (or round of a one-step prior): one in "
        "the last step, made at full resolution with `refine_edges`, and the others spread over the second "
        "half of the schedule",
        low=1,
        high=10_000,
        paper="-",
    )
    even_ensemble: str = _fit(
        "mean",
        "How to take the median of an even number of members: the mean or the lower of the middle two",
        choices=("mean", "lower"),
        paper="-",
    )
    ensemble_at: str = _fit(
        "processing",
        "Size at which members are merged: the processing size, or the image size (Marigold-DC)",
        choices=("processing", "image"),
        paper="-",
    )
    refine_edges: bool = _fit(
        True,
        "Whether to sharpen depth edges and fit the map to the matches a last time, at full resolution "
        "([architecture](../explanation/architecture.md#edge-refinement))",
        affects=EVIDENCE,
    )
    smoothness: float = _fit(
        40.0,
        "Smoothness weight of match fitting relative to a match of full confidence, for a grid of 512 pixels "
        "and a prior with 5 % error; it decreases with the fourth power of that error",
        low=TINY,
        high=1e6,
        paper="-",
    )
    match_sigma: float = _fit(
        0.02, "Relative standard deviation of a perfect match", low=TINY, high=1e3, paper="-"
    )
    outlier_sigma: float = _fit(
        3.0,
        "Number of standard deviations from its region beyond which a match is down-weighted",
        low=TINY,
        high=1e6,
        paper="-",
    )
    optimizer: str = _update(
        "adam",
        "Optimizer of latent, scale and shift: `plain` gradient descent, `summed` (plain, but the latent's "
        "loss is multiplied by the number of pixels), `adam`, or `adam-norm` (Adam on the gradient scaled "
        "to the norm of the noise, Marigold-DC)",
        **_text("name of an optimizer"),
    )
    lr_latents: float | None = _update(
        None,
        "Learning rate of the latent",
        low=0,
        high=1e6,
        unset="0.03 after match fitting, else 0.1",
    )
    lr_affine: float = _update(0.01, "Learning rate of raw s_hat and t_hat", low=0, high=1e6)
    guidance_steps: int | None = _update(
        None,
        "Number of gradient updates per denoising step; after match fitting only the last quarter of the "
        "steps makes updates",
        low=0,
        high=10_000,
        unset="0 after match fitting, else 40",
    )
    optimize_latents: bool = _update(
        True, "Whether to update the latent; `False` updates only scale and shift (ablation in Table 4, S5.3)"
    )
    guidance_start: float = _update(
        0.0, "Fraction of the schedule at which gradient updates start", low=0, high=1
    )
    guidance_end: float = _update(
        1.0, "Fraction of the schedule at which gradient updates end", low=0, high=1
    )
    step_from: str = _update(
        "given",
        'With `gradient="full"`: whether to add the update after the scheduler step (`given`, Algorithm 1) '
        "or to start the scheduler step from the `updated` z_t (Marigold-DC)",
        choices=("given", "updated"),
    )

    def __post_init__(self) -> None:
        for name, parameter in settings_of(type(self)).items():
            object.__setattr__(self, name, parameter.check(getattr(self, name), name))
        check_number(self.guidance_start, "guidance_start", 0.0, self.guidance_end)

    def plan_updates(self, points_given: bool) -> UpdatePlan:
        """Resolve the automatic parameters of gradient updates for a call with or without points."""
        # Fitting matches or points brings the latent close to its target, so few small updates suffice.
        encoded = self.weights.get("matches") or (self.weights.get("points") and points_given)
        near = self.fit_matches and encoded and self.optimize_latents and self.gradient == "denoised"
        # Early steps rely on the matches, and late steps refine the estimate with the images.
        steps, start, size = (0, 0.75 * self.guidance_end, 0.03) if near else (40, 0.0, 0.1)
        return UpdatePlan(
            steps if self.guidance_steps is None else self.guidance_steps,
            start,
            size if self.lr_latents is None else self.lr_latents,
        )

    def needs_matches(self, points_given: bool) -> bool:
        """Whether a call uses matches: their weight is above 0, and fitting, refinement or updates are on."""
        used = self.fit_matches or self.refine_edges or self.plan_updates(points_given).guidance_steps > 0
        return used and bool(self.weights.get("matches"))

    def changed(self, **parameters: Any) -> Self:
        """Return a copy with other parameter values; ``InputError`` for an unknown name or a bad value."""
        for name in parameters:
            if name not in PARAMETERS:
                bad_value("a parameter", "an existing one", repr(name), close_names(name, PARAMETERS))
        return replace(self, **parameters)

    def to_dict(self) -> dict[str, Any]:
        """Return the parameters as JSON values; inverse of ``from_dict``."""
        values = {name: getattr(self, name) for name in PARAMETERS}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()} | {
            "weights": dict(self.weights)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Create a configuration from the output of ``to_dict``, also from earlier versions.

        Missing parameters have their default. A warning lists unknown parameters, which are ignored.
        ``InputError`` for a bad value or a misspelt parameter.
        """
        flat: dict[str, Any] = {}
        for name, value in _mapping(values, "the configuration").items():
            is_stage = name not in PARAMETERS and isinstance(value, Mapping)
            flat |= value if is_stage else {name: value}
        known = {
            n: v
            for n, v in flat.items()
            if n in PARAMETERS or difflib.get_close_matches(n, PARAMETERS, 1, 0.85)
        }
        if unknown := [name for name in flat if name not in known]:
            message = f"Unknown parameters are ignored: {', '.join(unknown)}. Save the configuration again."
            warn(Finding("config.unknown-parameters", message))
        return cls().changed(**known)

    def save(self, path: str | Path) -> None:
        """Write a JSON file."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a file written by ``save``; ``InputError`` as in ``from_dict``."""
        try:
            values = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            bad_value(f"the configuration {path}", "a JSON file written by GuidanceConfig.save", str(error))
        return cls.from_dict(values)


#: All parameters by name, in the order of the tables.
PARAMETERS = settings_of(GuidanceConfig)
# The docstring lists all parameters for ``help(GuidanceConfig)``.
_ATTRIBUTES = "".join(f"        {name}: {parameter.help}.\n" for name, parameter in PARAMETERS.items())
GuidanceConfig.__doc__ = (GuidanceConfig.__doc__ or "").replace(
    "    Raises:", f"    Attributes:\n{_ATTRIBUTES}\n    Raises:"
)

DEFAULT = GuidanceConfig()

#: Algorithm 1 with its printed numbers; docs/explanation/method.md settles what the paper leaves open.
PAPER = DEFAULT.changed(
    gradient="full",
    optimizer="summed",
    lr_latents=1e-2,
    lr_affine=1e-2,
    guidance_steps=1,
    min_steps=10,
    weights={"photometric": 1.0, "affine_reg": 0.01},
    ssim_weight=0.85,
    pyramid_levels=1,
    exposure=False,
    occlusion_mask=False,
    min_visible=0.0,
    affine_reg_target="zero",
    search="one-number",
    sweep_pixels=768 * 576,
    pose="given",
    clean_images=False,
    fit_matches=False,
    reject_reflections=False,
    refine_edges=False,
)

#: For rigs and videos: coarser matches, one match fit at the end, and the given pose.
FAST = DEFAULT.changed(sweep_pixels=80_000, match_fits=1, min_steps=1, pose="given")

#: Only the scale and shift from the search.
SEARCH_ONLY = DEFAULT.changed(
    guidance_steps=0, weights={"photometric": 1.0}, fit_matches=False, refine_edges=False
)

#: A plain call, followed by one match fit and edge refinement: the default without its guidance loop.
PRIOR_FIT = DEFAULT.changed(guidance_steps=0, fit_matches=False)

#: Marigold-DC (Viola et al. 2024, "Marigold-DC: zero-shot monocular depth completion with guided diffusion")
#: with the numbers of its code. Its loss is computed at the image resolution, so the grid is unbounded.
MARIGOLD_DC = DEFAULT.changed(
    gradient="full",
    optimizer="adam-norm",
    lr_latents=0.05,
    lr_affine=0.005,
    guidance_steps=1,
    min_steps=50,
    weights={"points": 1.0},
    points_loss="l1l2",
    positive="square",
    search="points-range",
    step_from="updated",
    even_ensemble="lower",
    ensemble_at="image",
    sweep_pixels=1 << 32,
    fit_matches=False,
    refine_edges=False,
)

#: All presets by name. ``geodiff depth --preset`` accepts the first three.
PRESETS = {
    "default": DEFAULT,
    "fast": FAST,
    "paper": PAPER,
    "marigold-dc": MARIGOLD_DC,
    "search-only": SEARCH_ONLY,
    "prior-fit": PRIOR_FIT,
}


def close_names(name: str, names: Iterable[str]) -> str:
    """Suggest existing names similar to ``name``, then list all names."""
    names = list(names)
    *others, last = difflib.get_close_matches(name, names, 3, 0.6) or [""]
    hint = f"Did you mean {', '.join(others)}{' or ' * bool(others)}{last}? " if last else ""
    return f"{hint}Available: {', '.join(names)}."


def config_from_text(entries: Iterable[str], base: GuidanceConfig, name: str) -> GuidanceConfig:
    """Return ``base`` changed by entries ``NAME=VALUE`` of the command-line option ``name``.

    A value is parsed as JSON, or used as a string if it is not JSON. ``weights.TERM=VALUE`` changes one
    weight. ``InputError`` for another form, an unknown parameter or a bad value.
    """
    changes: dict[str, Any] = {}
    for entry in entries:
        written, equals, text = entry.partition("=")
        parameter, _, term = written.partition(".")
        if not equals or parameter not in PARAMETERS or (parameter == "weights") != bool(term):
            hint = close_names(written, [*(n for n in PARAMETERS if n != "weights"), "weights.NAME"])
            hint = f"Write {written}=VALUE." if parameter in PARAMETERS and not equals else hint
            bad_value(name, "NAME=VALUE with a guidance parameter", repr(entry), hint)
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        changes[parameter] = changes.get(parameter, base.weights) | {term: value} if term else value
    return base.changed(**changes)


def value_of(name: str, config: GuidanceConfig) -> Any:
    """Return the value of a parameter or of ``weights.TERM``, with automatic values resolved for matches.

    ``InputError`` for an unknown parameter, ``KeyError`` for an unknown term.
    """
    parameter, _, term = name.partition(".")
    if parameter not in PARAMETERS:
        bad_value("a parameter", "an existing one", repr(name), close_names(name, PARAMETERS))
    value = getattr(config, parameter)
    if term:
        return value[term]
    return getattr(config.plan_updates(points_given=False), parameter, None) if value is None else value


def shown(value: Any) -> str:
    """Format a parameter value for the tables."""
    if isinstance(value, tuple):
        return f"({', '.join(map(shown, value))})"
    if isinstance(value, dict):
        return ", ".join(f"{name} {shown(v)}" for name, v in value.items()) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def parameter_lines() -> list[str]:
    """Format the sections and one line per parameter (default, range, help) for a terminal."""
    lines: list[str] = []
    section = ""
    for name, parameter in PARAMETERS.items():
        lines += ["", parameter.section] if parameter.section != section else []
        section = parameter.section
        # Links and Markdown quotes are removed for the terminal.
        sentence = re.sub(r" \(\[[^]]*\]\([^)]*\)\)", "", parameter.help)
        default = parameter.unset if parameter.default is None else shown(parameter.default)
        lines.append(f"  {name} = {default}  [{parameter.values}]  {sentence}".replace("`", ""))
    return lines[1:]
