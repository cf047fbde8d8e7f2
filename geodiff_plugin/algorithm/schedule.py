"""``Schedule``: what a guided call does at every denoising step, decided once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from geodiff_plugin._checks import bad_value
from geodiff_plugin.config import GuidanceConfig, UpdatePlan


class Round(NamedTuple):
    """One optional correction, then ``updates`` gradient updates; with neither, only the scale is found."""

    corrects: bool
    updates: int


@dataclass(frozen=True)
class Schedule:
    """Rounds of every denoising step of a guided call (empty: left alone); whether they move latents."""

    steps: tuple[tuple[Round, ...], ...]
    moves: bool = True

    def is_last(self, step: int) -> bool:
        """Whether no step follows, so that a corrected map is the result."""
        return step == len(self.steps) - 1

    def moves_at(self, step: int) -> bool:
        """Whether guidance changes the latent at this step."""
        return self.moves and any(r.corrects or r.updates for r in self.steps[step])


def count_steps(wanted: int, requested: int | None, most: int | None) -> tuple[int, int]:
    """Denoising steps of a guided call, and rounds in each.

    A prior that takes at most ``most`` steps runs the rounds of all ``wanted`` steps within them.
    ``InputError`` if the user ``requested`` more steps than that.
    """
    if most is None or wanted <= most:
        return wanted, 1
    if requested is not None:
        cure = "Leave it out: the prior was trained for so few."
        bad_value("num_inference_steps", f"at most {most} with this prior", requested, cure)
    return most, -(-wanted // most)


def make_schedule(
    config: GuidanceConfig, plan: UpdatePlan, steps: int, *, rounds: int = 1, encodes: bool = True
) -> Schedule:
    """The schedule of ``steps`` steps with ``rounds`` rounds each.

    Early estimates are vague, and later corrections replace what earlier ones did. So the last active round
    is corrected, and the others are spread over the second half of the active rounds, or over more of them if
    they do not fit there. An estimate that was corrected in a round without updates is not corrected again in
    the same step: a second fit to the same matches would follow their noise. Nothing is corrected unless a
    map can be encoded (``encodes``), which it cannot while guidance moves z_t.
    """
    count = steps * rounds
    active = [i for i in range(count) if config.start <= i / count < config.stop]
    corrects = config.correct and config.optimize_latents and encodes
    chosen = _spread(active, config.corrections) if corrects and active else set()
    made = []
    for step in range(steps):
        current: list[Round] = []
        fresh = False  # corrected, and not moved since
        for i in range(step * rounds, (step + 1) * rounds):
            if i not in active:
                continue
            updates = plan.inner_steps if (i + 1) / count > plan.updates_from else 0
            corrected = i in chosen and not fresh
            if corrected or updates:
                current.append(Round(corrected, updates))
                fresh = (corrected or fresh) and updates == 0
        made.append(tuple(current))
    if not any(made):  # the output needs a scale, even if no step corrects or moves anything
        made[-1] = (Round(False, 0),)
    return Schedule(tuple(made), config.optimize_latents)


def _spread(active: list[int], wanted: int) -> set[int]:
    """The last round, and the other ``wanted`` ones spread over the second half if they fit there."""
    wanted = min(wanted, len(active))
    first = min(len(active) // 2, len(active) - wanted)
    step = (len(active) - 1 - first) / max(wanted - 1, 1)
    return {active[len(active) - 1 - round(k * step)] for k in range(wanted)}
