"""``Schedule``: plans what a guided call does at every denoising step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from geodiff_plugin._internal.checks import bad_value
from geodiff_plugin.config import GuidanceConfig, UpdatePlan


class Round(NamedTuple):
    """An optional match fit, then ``updates`` gradient updates; with neither, only the scale is found."""

    fits_matches: bool
    updates: int


@dataclass(frozen=True)
class Schedule:
    """Guidance rounds of every denoising step (empty if unguided), and whether they change latents."""

    steps: tuple[tuple[Round, ...], ...]
    updates_latents: bool = True

    def is_last(self, step: int) -> bool:
        """Return whether no step follows, so that a fitted map is the result."""
        return step == len(self.steps) - 1

    def updates_at(self, step: int) -> bool:
        """Return whether guidance changes the latent at this step."""
        return self.updates_latents and any(r.fits_matches or r.updates for r in self.steps[step])


def count_steps(wanted: int, requested: int | None, max_steps: int | None) -> tuple[int, int]:
    """Return the number of denoising steps of a guided call and of rounds in each.

    A prior limited to ``max_steps`` steps runs the rounds of all ``wanted`` steps within them. ``InputError``
    if the user ``requested`` more steps than that.
    """
    if max_steps is None or wanted <= max_steps:
        return wanted, 1
    if requested is not None:
        hint = "Omit it: the prior was trained for this number of steps."
        bad_value("num_inference_steps", f"at most {max_steps} with this prior", requested, hint)
    return max_steps, -(-wanted // max_steps)


def make_schedule(
    config: GuidanceConfig, plan: UpdatePlan, steps: int, *, rounds: int = 1, encodes: bool = True
) -> Schedule:
    """Make the schedule of ``steps`` steps with ``rounds`` rounds each.

    Early estimates are vague, and later fits replace earlier ones. So the last active round has a match fit,
    and the others are spread over the second half of the active rounds, or over more of them if they do not
    fit there. An estimate that was fitted in a round without updates is not fitted again in the same step: a
    second fit to the same matches would follow their noise. There are no fits unless a map can be encoded
    (``encodes``), which is not possible while guidance updates z_t.
    """
    count = steps * rounds
    active = [i for i in range(count) if config.guidance_start <= i / count < config.guidance_end]
    fits_matches = config.fit_matches and config.optimize_latents and encodes
    chosen = _spread(active, config.match_fits) if fits_matches and active else set()
    made = []
    for step in range(steps):
        current: list[Round] = []
        is_fitted = False  # fitted, and not updated since
        for i in range(step * rounds, (step + 1) * rounds):
            if i not in active:
                continue
            updates = plan.guidance_steps if (i + 1) / count > plan.updates_from else 0
            fits = i in chosen and not is_fitted
            if fits or updates:
                current.append(Round(fits, updates))
                is_fitted = (fits or is_fitted) and updates == 0
        made.append(tuple(current))
    if not any(made):  # the output needs a scale, even if no step changes anything
        made[-1] = (Round(False, 0),)
    return Schedule(tuple(made), config.optimize_latents)


def _spread(active: list[int], wanted: int) -> set[int]:
    """Choose the last round and ``wanted - 1`` others, spread over the second half if they fit there."""
    wanted = min(wanted, len(active))
    first = min(len(active) // 2, len(active) - wanted)
    step = (len(active) - 1 - first) / max(wanted - 1, 1)
    return {active[len(active) - 1 - round(k * step)] for k in range(wanted)}
