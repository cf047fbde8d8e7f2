"""Every number and switch of the guidance: one frozen configuration, nested by stage.

Data flow: names and values as given -> ``GuidanceConfig``, checked -> the stage that a function takes.
Paper: S5.1 and Algorithm 1 name some; docs/reference/knobs.md, which is made from here, says which.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

from geodiff_plugin._checks import bad_type, bad_value, check_number
from geodiff_plugin.guidance.correction_stages import CorrectionConfig, ReflectionsConfig
from geodiff_plugin.guidance.fields import (
    Checked,
    by_name,
    choice,
    close_names,
    flag,
    integer,
    number,
    pair,
    text,
)
from geodiff_plugin.guidance.loss_stages import TermsConfig, UpdatesConfig
from geodiff_plugin.guidance.scale_stages import FitConfig, MatchingConfig, SearchConfig, SweepConfig

__all__ = ["DEFAULT_WEIGHTS", "GuidanceConfig", "UpdatePlan"]
__all__ += ["CorrectionConfig", "FitConfig", "MatchingConfig", "ReflectionsConfig", "SearchConfig"]
__all__ += ["SweepConfig", "TermsConfig", "UpdatesConfig"]

#: Weights of the default preset.
DEFAULT_WEIGHTS = {"photometric": 1.0, "matches": 1.0, "points": 1.0, "prior_pull": 0.01, "anchor": 1.0}


def _weight(value: Any, name: str) -> float:
    return float(check_number(value, name, 0.0, float("inf")))


@dataclass(frozen=True)
class UpdatePlan:
    """What ``inner_steps``, ``updates_from`` and ``step_latents`` are in a call, none of them open."""

    inner_steps: int
    updates_from: float
    step_latents: float


@dataclass(frozen=True)
class GuidanceConfig(Checked):
    """How strongly, and by what, a second view steers the diffusion; with no argument the default preset.

    A leaf's name is unique over the stages, so that ``changed(smoothness=5.0)``, a keyword of
    ``GeometryGuidance`` and ``--knob smoothness=5`` need no stage.

    Raises:
        InputError: a value of the wrong type or out of range, naming the leaf.
    """

    gradient: str = choice(
        "denoised",
        ("denoised", "full"),
        "`full` goes through the U-Net to z_t; `denoised` stops at the clean latent and moves that: no U-Net "
        "backward",
    )
    weights: Mapping[str, float] = by_name(
        DEFAULT_WEIGHTS,
        "term -> >= 0",
        _weight,
        "the terms of the loss; a term of weight 0, or of none, costs nothing (gamma of Eq. 17 is "
        "`prior_pull`)",
    )
    min_steps: int = integer(
        4,
        1,
        1000,
        "denoising steps when the call names none and the pipeline's own default is lower; a one-step prior "
        "does the rounds of all of them in its one step",
        paper="{} (not given)",
    )
    respace: bool = flag(True, "a leading DDIM schedule runs as trailing while guided")
    warm_start: float = number(
        0.25,
        0.0,
        0.99,
        "share of the schedule that a call with `previous`, the output of the previous frame, skips; with 0 "
        "it takes over the scale alone ([sequences](../how-to/sequences.md))",
        paper="-",
    )
    loss_resolution: int = integer(
        640,
        32,
        1 << 16,
        "bound of the longer side of the grid that losses are computed on, px",
        paper="{} (S9, without saying for what)",
    )
    depth_range: tuple[float, float] | None = pair(
        None,
        "bounds of the sweep and of the nearest and farthest depth of the search",
        unit="m",
        paper="-",
        unset="from the nearest plane to a shift of 0.3 px",
    )
    pose: str = choice(
        "refine",
        ("refine", "given"),
        "poses that leave matches more than 0.3 px off their epipolar lines (0.45 px if they are rectified) "
        "are refined, all views together, and the right image is straightened ([poses](../how-to/poses.md))",
    )
    clean_photographs: bool = flag(
        True,
        "blocks of JPEG compression and strong sensor noise are removed before photographs are compared; the "
        "prior sees the image as it is, except with `--distortion`, which undistorts cleaned photographs",
    )
    decoder: str = text(
        "full",
        "`full`, `tiny`, a folder or a hub id",
        "what decodes and encodes between the steps: the prior's own autoencoder, the tiny one that is "
        "published for its latent, or another `AutoencoderTiny`; the result is always decoded by the "
        "prior's own ([priors](../reference/priors.md#a-tiny-decoder))",
        paper="-",
    )
    terms: TermsConfig = TermsConfig()
    sweep: SweepConfig = SweepConfig()
    matching: MatchingConfig = MatchingConfig()
    search: SearchConfig = SearchConfig()
    fit: FitConfig = FitConfig()
    reflections: ReflectionsConfig = ReflectionsConfig()
    correction: CorrectionConfig = CorrectionConfig()
    updates: UpdatesConfig = UpdatesConfig()

    def __post_init__(self) -> None:
        super().__post_init__()
        for stage in STAGES:
            given = getattr(self, stage)
            if not isinstance(given, STAGES[stage]):
                bad_type(stage, f"a {STAGES[stage].__name__}", given)

    def plan_updates(self, points_given: bool) -> UpdatePlan:
        """What is left open depends on the rest, and is settled when it is asked for; it is never saved.

        Args:
            points_given: whether known points come with the guidance.
        """
        # What matches and points can be encoded into is near already; else the gradient has the whole way.
        known = self.weights.get("matches") or (self.weights.get("points") and points_given)
        updates = self.updates
        near = self.correction.correct and known and updates.optimize_latents and self.gradient == "denoised"
        steps, late, size = (0, 0.75 * updates.stop, 0.03) if near else (40, 0.0, 0.1)
        return UpdatePlan(
            steps if updates.inner_steps is None else updates.inner_steps,
            late if updates.updates_from is None else updates.updates_from,
            size if updates.step_latents is None else updates.step_latents,
        )

    def leaves(self) -> dict[str, Any]:
        """Every leaf's value by its name, without the stages."""
        return {
            name: getattr(getattr(self, stage) if stage else self, name) for name, stage in LEAVES.items()
        }

    def changed(self, **leaves: Any) -> Self:
        """This configuration with some leaves set otherwise.

        Raises:
            InputError: no such leaf, or a value that it cannot have.
        """
        for name in leaves:
            if name not in LEAVES:
                bad_value("a knob", "one that exists", repr(name), close_names(name, LEAVES))
        stages = {
            stage: replace(getattr(self, stage), **{n: v for n, v in leaves.items() if LEAVES[n] == stage})
            for stage in {LEAVES[name] for name in leaves} - {""}
        }
        return replace(self, **stages, **{n: v for n, v in leaves.items() if not LEAVES[n]})

    def to_dict(self) -> dict[str, Any]:
        """JSON values, nested by stage; inverse of ``from_dict``."""
        own = {name: _plain(getattr(self, name)) for name, stage in LEAVES.items() if not stage}
        return own | {
            stage: {one.name: _plain(getattr(getattr(self, stage), one.name)) for one in fields(kind)}
            for stage, kind in STAGES.items()
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """What ``to_dict`` gave; what is missing is as in the default.

        Raises:
            InputError: a name that does not exist there, or a value that it cannot have.
        """
        values = _mapping(values, "the configuration")
        given: dict[str, Any] = {}
        for stage in ("", *STAGES):
            part = values if not stage else _mapping(values.get(stage, {}), stage)
            own = {name for name, of in LEAVES.items() if of == stage} | (set() if stage else set(STAGES))
            for name in part:
                if name not in own:
                    where = f"a name in {stage}" if stage else "a name in the configuration"
                    bad_value(where, "one that exists", repr(name), close_names(name, sorted(own)))
            given |= {name: value for name, value in part.items() if stage or name not in STAGES}
        return cls().changed(**given)

    def save(self, path: str | Path) -> None:
        """Write a JSON file, nested by stage."""
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read what ``save`` wrote.

        Raises:
            OSError, InputError: no such file, no JSON, or as ``from_dict``.
        """
        try:
            values = json.loads(Path(path).read_text(encoding="utf-8"))
        except ValueError as error:
            bad_value(f"the configuration {path}", "a JSON file that GuidanceConfig.save wrote", str(error))
        return cls.from_dict(values)


def _mapping(value: Any, name: str) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else bad_type(name, "a dict of values by name", value)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return dict(value)
    return list(value) if isinstance(value, tuple) else value


def _stages() -> Iterable[tuple[str, type[Any]]]:
    for one in fields(GuidanceConfig):
        if "knob" not in one.metadata:
            yield one.name, type(one.default)


#: Stage -> its class.
STAGES: dict[str, type[Any]] = dict(_stages())
#: Leaf -> the stage that it stands in, ``""`` for those above the stages.
LEAVES: dict[str, str] = {one.name: "" for one in fields(GuidanceConfig) if one.name not in STAGES}
LEAVES |= {one.name: stage for stage, kind in STAGES.items() for one in fields(kind)}
