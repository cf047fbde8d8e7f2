"""Every number and switch of the guidance: one flat, frozen configuration, and its presets.

docs/reference/knobs.md, which is made from this module, says which of them S5.1 and Algorithm 1 name.
"""

from __future__ import annotations

import difflib
import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple, Self

from geodiff_plugin._checks import (
    bad_type,
    bad_value,
    check_choice,
    check_flag,
    check_number,
    check_range,
    number_text,
    warn,
)
from geodiff_plugin.messages import Message

#: Weights of the default preset.
DEFAULT_WEIGHTS = {"photometric": 1.0, "matches": 1.0, "points": 1.0, "prior_pull": 0.01, "anchor": 1.0}
#: The least value where 0 is not allowed.
TINY = 1e-9


class Affects(StrEnum):
    """What becomes stale with another value of a setting, as every field of settings declares."""

    NOTHING = "nothing"  # of what is stored, or only its rounding
    INPUTS = "inputs"  # through the files that it names, which count by their content
    POSES = "poses"  # of a capture, and every result made with them
    EVIDENCE = "evidence"  # what act 1 finds in the views, and every result made from it
    RESULT = "result"


EVIDENCE, RESULT = Affects.EVIDENCE, Affects.RESULT


def affected(described: Field[Any]) -> Affects | None:
    """What a field declares that it affects; ``None`` if it declares nothing."""
    return described.metadata.get("affects")


class _FrozenDict(dict[str, Any]):
    """A dict that cannot be changed, so that a configuration can hold it; equal to a dict of its items."""

    def _refuse(self, *_: Any, **__: Any) -> Any:
        raise TypeError("a configuration does not change; make another one with changed(...)")

    __setitem__ = __delitem__ = __ior__ = clear = pop = popitem = setdefault = update = _refuse

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(frozenset(self.items()))

    def __reduce__(self) -> tuple[type[_FrozenDict], tuple[dict[str, Any]]]:
        return _FrozenDict, (dict(self),)


def _knob(
    default: Any,
    values: str,
    check: Callable[[Any, str], Any],
    *,
    affects: Affects,
    paper: str = "{}",
    unset: str = "",
) -> Any:
    """A field with what is known about it beside the sentence on what it does.

    ``values`` are its range in words; ``check`` gives the value as it is kept; ``paper`` is what the paper
    says of it, with ``"{}"`` for the value of ``PAPER``; ``unset`` what ``None`` becomes, empty for no value.
    """

    def checked(value: Any, name: str) -> Any:
        return None if unset and value is None else check(value, name)

    values += ", or `None`" if unset else ""
    metadata = {"values": values, "check": checked, "paper": paper, "unset": unset, "affects": affects}
    return field(default=default, metadata=metadata)


def _number(default: float | None, low: float, high: float, kind: type = float, **more: Any) -> Any:
    """A finite number in ``[low, high]``, or a whole one."""
    whole = kind is int
    values = f"{'integer, ' * whole}[{number_text(low)}, {number_text(high)}]"
    return _knob(
        default, values, lambda v, name: kind(check_number(v, name, low, high, integer=whole)), **more
    )


def _flag(default: bool, **more: Any) -> Any:
    return _knob(default, "bool", check_flag, **more)


def _choice(*choices: str, **more: Any) -> Any:
    """One of some names, the default first."""
    values = ", ".join(f"`{name}`" for name in choices)
    return _knob(choices[0], values, lambda v, name: check_choice(v, name, choices), **more)


def _text(default: str, values: str, **more: Any) -> Any:
    """A text that is not empty; only the code that uses it can say whether the text is valid."""

    def check(value: Any, name: str) -> str:
        text = str(value) if isinstance(value, Path) else value
        return text if isinstance(text, str) and text else bad_type(name, f"a text ({values})", value)

    return _knob(default, values, check, **more)


def _pair(default: tuple[float, float] | None, **more: Any) -> Any:
    """Two numbers in metres, ``0 < low < high``; a list is taken for a tuple."""
    return _knob(default, "pair with 0 < low < high, m", check_range, **more)


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else bad_type(name, "a dict of values by name", value)


def _weights(default: Mapping[str, float]) -> Any:
    """A dict of weights >= 0 by the name of a term."""

    def check(value: Any, name: str) -> _FrozenDict:
        weights = {}
        for key, weight in _mapping(value, name).items():
            if not isinstance(key, str):
                bad_value(f"a key of {name}", "a text", repr(key))
            weights[key] = float(check_number(weight, f"{name}[{key!r}]", 0.0, float("inf")))
        return _FrozenDict(weights)

    return _knob(_FrozenDict(default), "term -> >= 0", check, affects=RESULT)


class UpdatePlan(NamedTuple):
    """Gradient updates of a call: ``inner_steps`` in each denoising step that makes any.

    Steps that end by the fraction ``updates_from`` of the schedule make none.
    """

    inner_steps: int
    updates_from: float
    step_latents: float


@dataclass(frozen=True)
class GuidanceConfig:
    """How strongly, and by what, a second view steers the diffusion; with no argument the default preset.

    The tables of knobs take their sentences from here.

    Attributes:
        gradient: `full` goes through the U-Net to z_t; `denoised` stops at the clean latent and moves that.
        weights: the terms of the loss; a term of weight 0 costs nothing (gamma of Eq. 17 is `prior_pull`).
        min_steps: denoising steps when the call names none and the pipeline's default is lower.
        respace: a leading DDIM schedule runs as trailing while guided.
        sweep_pixels: upper bound on the pixels of the grid of matches, corrections and losses.
        depth_range: bounds of the sweep and of the nearest and farthest depth of the search.
        pose: poses that do not fit the matches are refined ([poses](../how-to/poses.md#given-poses)).
        clean_photographs: JPEG blocks and strong sensor noise are removed before photographs are compared;
            the prior sees the image as it is, except that `--distortion` undistorts cleaned ones.
        decoder: what decodes and encodes latents ([priors](../reference/priors.md#a-tiny-decoder)).
        eta: SSIM against L1 in the photometric term (Eq. 14).
        pyramid_levels: levels of the image pyramid of the photometric term.
        exposure: photographs are compared in the left one's exposure: gain, bias and a slow field.
        z_test: pixels that the estimate occludes in a right view do not count in the photometric term.
        min_visible: share in view below which the photometric term is off.
        pull_to: what `prior_pull` pulls s_hat, t_hat towards (Eq. 17): the search's result, or 0.
        points_loss: at points: Cauchy in inverse depth over 1 % of the points' median, or L1 + L2 in metres.
        planes: upper bound on the number of planes of the sweep.
        search: joint (near, far) in the cost volume, then the basin that reliable matches prefer (a robust
            fit to the points without a right view); the argmin over g_s (S7.3); or the nearest and the
            farthest point (Marigold-DC).
        positive: how raw scale and shift become positive (Eq. 13); `square` also clips the map to [0, 1].
        g_s_range: candidates of the one-number search; the paper says "a predefined depth range" (S7.3).
        g_s_candidates: the number of these candidates.
        reject_reflections: regions of matches behind the first decoded estimate count as reflections.
        correct: the decoded map is fitted to its matches and points and the change is encoded, before the
            updates, unless these go through the network (SteeredMarigold, Gregorek and Nalpantidis 2024).
        corrections: upper bound on the number of steps (or rounds of a one-step prior) that are corrected:
            the last, and the others spread over the second half of the schedule where they fit.
        even_ensemble: median of an even number of members: mean of the middle two, or the lower of them.
        ensemble_at: size at which members become one map: the processing size, or the image's (Marigold-DC).
        crisp: the result is finished at full resolution
            ([dataflow](../explanation/dataflow.md#how-edges-become-crisp)).
        smoothness: weight of the correction's slope against a match of full confidence, on a grid 512 pixels
            long, for a prior that is wrong by 5 %; it falls with the fourth power of that error.
        match_noise: relative error of a perfect match.
        outlier_width: standard deviations from its region beyond which a match counts for less.
        rule: how a gradient moves the latent, scale and shift: `plain`; `summed`, plain, but the latent
            follows the loss times the number of pixels; `adam`; `adam-norm`, Adam on the gradient scaled to
            the noise's norm (Marigold-DC).
        step_latents: step size of `rule` on the latent.
        step_affine: step size of `rule` on raw s_hat, t_hat.
        inner_steps: updates in a denoising step; after a correction only the last quarter of steps makes any.
        optimize_latents: `False` is Table 4's ablation: scale and shift only (S5.3).
        start: fraction of the schedule before which nothing is updated.
        stop: fraction after which nothing is updated.
        step_from: with `gradient="full"`: add the update after the scheduler's step (Algorithm 1), or let the
            step start from the updated z_t (Marigold-DC).

    Raises:
        InputError: a value of the wrong type or out of range, naming the knob.
    """

    gradient: str = _choice("denoised", "full", affects=RESULT)
    weights: Mapping[str, float] = _weights(DEFAULT_WEIGHTS)
    min_steps: int = _number(4, 1, 1000, int, affects=RESULT, paper="{}, not given")
    respace: bool = _flag(True, affects=RESULT)
    sweep_pixels: int = _number(210_000, 1024, 1 << 32, int, affects=EVIDENCE, paper="{} (768 px, S9)")
    depth_range: tuple[float, float] | None = _pair(
        None, affects=EVIDENCE, paper="-", unset="from the nearest plane to a shift of 0.3 px"
    )
    pose: str = _choice("refine", "given", affects=EVIDENCE)
    clean_photographs: bool = _flag(True, affects=EVIDENCE)
    decoder: str = _text("full", "`full`, `tiny`, a folder or a hub id", affects=RESULT, paper="-")
    eta: float = _number(0.85, 0, 1, affects=RESULT, paper="{}, not given")
    pyramid_levels: int = _number(3, 1, 10, int, affects=RESULT)
    exposure: bool = _flag(True, affects=RESULT)
    z_test: bool = _flag(True, affects=RESULT)
    min_visible: float = _number(0.1, 0, 1, affects=RESULT)
    pull_to: str = _choice("start", "zero", affects=RESULT)
    points_loss: str = _choice("robust", "l1l2", affects=RESULT, paper="-")
    planes: int = _number(160, 24, 4096, int, affects=EVIDENCE, paper="-")
    search: str = _choice("volume", "one-number", "points-range", affects=EVIDENCE)
    positive: str = _choice("softplus", "square", affects=RESULT)
    g_s_range: tuple[float, float] = _pair((1.0, 80.0), affects=RESULT, paper="{}, not given")
    g_s_candidates: int = _number(80, 2, 100_000, int, affects=RESULT, paper="{}, not given")
    reject_reflections: bool = _flag(True, affects=RESULT)
    correct: bool = _flag(True, affects=RESULT)
    corrections: int = _number(2, 1, 10_000, int, affects=RESULT, paper="-")
    even_ensemble: str = _choice("mean", "lower", affects=RESULT, paper="-")
    ensemble_at: str = _choice("processing", "image", affects=RESULT, paper="-")
    crisp: bool = _flag(True, affects=EVIDENCE)
    smoothness: float = _number(40.0, TINY, 1e6, affects=RESULT, paper="-")
    match_noise: float = _number(0.02, TINY, 1e3, affects=RESULT, paper="-")
    outlier_width: float = _number(3.0, TINY, 1e6, affects=RESULT, paper="-")
    rule: str = _text("adam", "key of `RULES`", affects=RESULT)
    step_latents: float | None = _number(
        None, 0, 1e6, affects=RESULT, unset="0.03 after a correction, else 0.1"
    )
    step_affine: float = _number(0.01, 0, 1e6, affects=RESULT)
    inner_steps: int | None = _number(
        None, 0, 10_000, int, affects=RESULT, unset="0 after a correction, else 40"
    )
    optimize_latents: bool = _flag(True, affects=RESULT)
    start: float = _number(0.0, 0, 1, affects=RESULT)
    stop: float = _number(1.0, 0, 1, affects=RESULT)
    step_from: str = _choice("given", "updated", affects=RESULT)

    def __post_init__(self) -> None:
        for described in fields(self):
            value = described.metadata["check"](getattr(self, described.name), described.name)
            object.__setattr__(self, described.name, value)
        check_number(self.start, "start", 0.0, self.stop)

    def plan_updates(self, points_given: bool) -> UpdatePlan:
        """The updates of a call, with points or without; what is left open depends on the other knobs."""
        # Matches and points that can be encoded bring the latent close; else the gradient has the whole way.
        encoded = self.weights.get("matches") or (self.weights.get("points") and points_given)
        near = self.correct and encoded and self.optimize_latents and self.gradient == "denoised"
        # Early estimates are left to the matches; late ones are refined by the photographs.
        steps, start, size = (0, 0.75 * self.stop, 0.03) if near else (40, 0.0, 0.1)
        return UpdatePlan(
            steps if self.inner_steps is None else self.inner_steps,
            start,
            size if self.step_latents is None else self.step_latents,
        )

    def needs_matches(self, points_given: bool) -> bool:
        """Whether a call uses matches of its views: they have a weight, and something is moved by it."""
        moved = self.correct or self.crisp or self.plan_updates(points_given).inner_steps > 0
        return moved and bool(self.weights.get("matches"))

    def changed(self, **knobs: Any) -> Self:
        """This configuration with some knobs set otherwise; ``InputError`` for no such knob, or its value."""
        for name in knobs:
            if name not in KNOBS:
                bad_value("a knob", "one that exists", repr(name), close_names(name, KNOBS))
        return replace(self, **knobs)

    def to_dict(self) -> dict[str, Any]:
        """JSON values by knob; inverse of ``from_dict``."""
        values = {name: getattr(self, name) for name in KNOBS}
        return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()} | {
            "weights": dict(self.weights)
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """What ``to_dict`` gave, also in former versions; what is missing is as in the default.

        A warning names what is no knob any more. ``InputError`` for a value, or a knob that is misspelt.
        """
        flat: dict[str, Any] = {}
        for name, value in _mapping(values, "the configuration").items():
            is_stage = name not in KNOBS and isinstance(value, Mapping)
            flat |= value if is_stage else {name: value}
        known = {n: v for n, v in flat.items() if n in KNOBS or difflib.get_close_matches(n, KNOBS, 1, 0.85)}
        if gone := [name for name in flat if name not in known]:
            warn(Message("config.former-knobs", f"No longer knobs, and left out: {', '.join(gone)}."))
        return cls().changed(**known)

    def save(self, path: str | Path) -> None:
        """Write a JSON file."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what ``save`` wrote; ``InputError`` as ``from_dict``."""
        try:
            values = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            bad_value(f"the configuration {path}", "a JSON file that GuidanceConfig.save wrote", str(error))
        return cls.from_dict(values)


#: All knobs, in the order of the tables.
KNOBS = tuple(described.name for described in fields(GuidanceConfig))

DEFAULT = GuidanceConfig()

#: Algorithm 1 with its printed numbers; docs/reference/paper-map.md settles what the paper leaves open.
PAPER = DEFAULT.changed(
    gradient="full",
    rule="summed",
    step_latents=1e-2,
    step_affine=1e-2,
    inner_steps=1,
    min_steps=10,
    weights={"photometric": 1.0, "prior_pull": 0.01},
    eta=0.85,
    pyramid_levels=1,
    exposure=False,
    z_test=False,
    min_visible=0.0,
    pull_to="zero",
    search="one-number",
    sweep_pixels=768 * 576,
    pose="given",
    clean_photographs=False,
    correct=False,
    reject_reflections=False,
    crisp=False,
)

#: For rigs and videos: coarser matches, a fit at the end alone, the rig's pose as it is.
FAST = DEFAULT.changed(sweep_pixels=80_000, corrections=1, min_steps=1, pose="given")

#: Scale and shift of the search alone.
SEARCH_ONLY = DEFAULT.changed(inner_steps=0, weights={"photometric": 1.0}, correct=False, crisp=False)

#: A plain call that is fitted to the matches and refined once: the default without its loop.
PRIOR_FIT = DEFAULT.changed(inner_steps=0, correct=False)

#: Marigold-DC (Viola et al. 2024, "Marigold-DC: zero-shot monocular depth completion with guided diffusion")
#: with the numbers of its code, whose loss is taken at the image's own resolution: no bound on it.
MARIGOLD_DC = DEFAULT.changed(
    gradient="full",
    rule="adam-norm",
    step_latents=0.05,
    step_affine=0.005,
    inner_steps=1,
    min_steps=50,
    weights={"points": 1.0},
    points_loss="l1l2",
    positive="square",
    search="points-range",
    step_from="updated",
    even_ensemble="lower",
    ensemble_at="image",
    sweep_pixels=1 << 32,
    correct=False,
    crisp=False,
)

#: All presets by name; ``geodiff depth --preset`` takes the first three.
PRESETS = {
    "default": DEFAULT,
    "fast": FAST,
    "paper": PAPER,
    "marigold-dc": MARIGOLD_DC,
    "search-only": SEARCH_ONLY,
    "prior-fit": PRIOR_FIT,
}


def close_names(name: str, names: Iterable[str]) -> str:
    """Names that exist, those that look like ``name`` first, as a sentence."""
    names = list(names)
    *others, last = difflib.get_close_matches(name, names, 3, 0.6) or [""]
    hint = f"Did you mean {', '.join(others)}{' or ' * bool(others)}{last}? " if last else ""
    return f"{hint}There are: {', '.join(names)}."


def config_from_text(entries: Iterable[str], base: GuidanceConfig, name: str) -> GuidanceConfig:
    """``base`` with knobs set otherwise, ``KNOB=VALUE`` each, as typed behind the option ``name``.

    A value is JSON, or text where it is none; ``weights.TERM=VALUE`` changes one weight. ``InputError`` for
    another form, a knob that does not exist, a value that it cannot have.
    """
    changes: dict[str, Any] = {}
    for entry in entries:
        written, equals, text = entry.partition("=")
        knob, _, term = written.partition(".")
        if not equals or knob not in KNOBS or (knob == "weights") != bool(term):
            cure = close_names(written, [*(n for n in KNOBS if n != "weights"), "weights.NAME"])
            cure = f"Write {written}=VALUE." if knob in KNOBS and not equals else cure
            bad_value(name, "KNOB=VALUE with a knob of GeometryGuidance", repr(entry), cure)
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        changes[knob] = changes.get(knob, base.weights) | {term: value} if term else value
    return base.changed(**changes)


def value_of(name: str, config: GuidanceConfig) -> Any:
    """A knob's value, or that of ``weights.TERM``; automatic choices as they are made with matches.

    ``InputError`` for no such knob, ``KeyError`` for no such term.
    """
    knob, _, term = name.partition(".")
    if knob not in KNOBS:
        bad_value("a knob", "one that exists", repr(name), close_names(name, KNOBS))
    value = getattr(config, knob)
    if term:
        return value[term]
    return getattr(config.plan_updates(points_given=False), knob, None) if value is None else value


#: Sections of the tables of knobs, by the first knob of each.
SECTIONS = {
    "gradient": "The call",
    "eta": "Terms of the loss",
    "planes": "Plane sweep and search of the scale (S7.3)",
    "reject_reflections": "Correction by matches and points",
    "rule": "Gradient updates of latent, scale and shift (Algorithm 1)",
}


def sentences() -> dict[str, str]:
    """What every knob does, from the docstring of ``GuidanceConfig``."""
    lines = inspect.cleandoc(GuidanceConfig.__doc__ or "").partition("Attributes:\n")[2]
    entries = re.findall(r"^    (\w+): (.*(?:\n     +.*)*)", lines, re.MULTILINE)
    return {name: " ".join(text.split()).rstrip(".") for name, text in entries}


def shown(value: Any) -> str:
    """A value of a knob as the tables show it."""
    if isinstance(value, tuple):
        return f"({', '.join(map(shown, value))})"
    if isinstance(value, dict):
        return ", ".join(f"{name} {shown(v)}" for name, v in value.items()) or "none"
    return f"{value:g}" if isinstance(value, float) else str(value)


def knob_lines() -> list[str]:
    """For a terminal: the sections, and of every knob a line with its default, range and what it does."""
    lines: list[str] = []
    for described in fields(GuidanceConfig):
        name, knob, value = described.name, described.metadata, getattr(DEFAULT, described.name)
        lines += ["", SECTIONS[name]] if name in SECTIONS else []
        # A terminal has no use for links and marks.
        sentence = re.sub(r" \(\[[^]]*\]\([^)]*\)\)", "", sentences().get(name, ""))
        default = knob["unset"] if value is None else shown(value)
        lines.append(f"  {name} = {default}  [{knob['values']}]  {sentence}".replace("`", ""))
    return lines[1:]
