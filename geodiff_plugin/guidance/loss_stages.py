"""The stages of the configuration of the gradient updates: the terms of the loss, and the steps it makes.

Data flow: named values -> a stage, checked.
Paper: Algorithm 1, S5.1, S9 name some numbers; a leaf that the paper has no number or no place for says so.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from geodiff_plugin._checks import bad_type, check_number
from geodiff_plugin.guidance.fields import TINY, Checked, by_name, choice, flag, integer, key_of, number, pair

__all__ = ["TermsConfig", "UpdatesConfig"]


def _option(value: Any, name: str) -> Any:
    """What an option of a term may be."""
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, (list, tuple)):
        return tuple(_option(entry, name) for entry in value)
    if isinstance(value, (int, float)):
        return check_number(value, name, float("-inf"), float("inf"))
    return bad_type(name, "a number, a text, True, False, None or a list of these", value)


@dataclass(frozen=True)
class TermsConfig(Checked):
    """What the terms of the loss compare, and how."""

    eta: float = number(
        0.85, 0, 1, "SSIM against L1 in the photometric term (Eq. 14)", paper="{} (not given)"
    )
    pyramid_levels: int = integer(3, 1, 10, "image pyramid of the photometric term")
    exposure: bool = flag(
        True,
        "photographs are compared in the left one's exposure: gain and bias per channel and a slow field, in "
        "closed form",
    )
    exposure_gain: tuple[float, float] = pair(
        (0.2, 5.0), "gains beyond these say that two photographs do not show the same scene", paper="-"
    )
    exposure_rows: int = integer(
        4, 1, 1000, "rows of cells of the slow field: vignetting, sun from one side", paper="-"
    )
    exposure_columns: int = integer(5, 1, 1000, "columns of cells of the slow field", paper="-")
    exposure_prior: float = number(
        0.2,
        TINY,
        1e6,
        "share of a cell in view that counts as much as what is known of the whole image",
        paper="-",
    )
    z_test: bool = flag(
        True,
        "pixels that the estimate hides from a right camera take no part in the photometric term of updates, "
        "as the right image shows something else there",
    )
    min_visible: float = number(0.1, 0, 1, "share in view below which the photometric term is off")
    pull_to: str = choice(
        "start",
        ("start", "zero"),
        "what `prior_pull` pulls s_hat, t_hat towards (Eq. 17): the search's result, or 0",
    )
    matches_cauchy: float = number(
        5.0,
        TINY,
        1e6,
        "residual of the matches, in planes, from which their pull falls: a wrong match must not win "
        "against its neighbours, but a surface that the prior put far away must still feel where it is",
        paper="-",
    )
    points_loss: str = choice(
        "robust",
        ("robust", "l1l2"),
        "error at known points: Cauchy in inverse depth, in units of 1 % of the points' median inverse "
        "depth, or L1 + L2 in metres (Marigold-DC, Eq. 4)",
        paper="-",
    )
    points_cauchy: float = number(
        5.0, TINY, 1e6, "residual of the points, in those units, from which their pull falls", paper="-"
    )
    anchor_floor: float = number(
        0.05, 0, 1, "share of the anchor's pull that remains where every pixel is matched", paper="-"
    )
    options: Mapping[str, Any] = by_name(
        {}, "TERM.OPTION -> value", _option, "options of terms beyond those of the package", paper="-"
    )


@dataclass(frozen=True)
class UpdatesConfig(Checked):
    """The gradient updates of latent, scale and shift (Algorithm 1)."""

    rule: str = key_of(
        "adam",
        "RULES",
        "how a gradient moves the latent: `plain`; `adam`; `norm` scales it to a share of the predicted "
        "noise; `adam-norm` scales it to the noise's norm before an Adam with the usual decays (Marigold-DC)",
    )
    affine_rule: str = key_of("adam", "RULES", "the same for scale and shift")
    step_latents: float | None = number(
        None, 0, 1e6, "step size of `rule`", unset="0.03 after a correction, else 0.1"
    )
    step_affine: float = number(0.01, 0, 1e6, "step size of `affine_rule` on raw s_hat, t_hat")
    inner_steps: int | None = integer(
        None,
        0,
        10_000,
        "updates in each denoising step that makes any; with 0 only the search and the correction remain",
        unset="0 after a correction, else 40",
    )
    updates_from: float | None = number(
        None,
        0,
        1,
        "steps that end by this fraction of the schedule make no updates: they leave the estimate to the "
        "matches, and later steps refine it by the photographs",
        unset="0.75 of `stop` after a correction, else 0",
    )
    optimize_latents: bool = flag(True, "`False` is Table 4's ablation: scale and shift only (S5.3)")
    start: float = number(0.0, 0, 1, "fraction of the schedule before which nothing is updated")
    stop: float = number(1.0, 0, 1, "fraction after which nothing is updated")
    step_from: str = choice(
        "given",
        ("given", "updated"),
        'with `gradient="full"`: add the update after the scheduler\'s step (Algorithm 1), or let the step '
        "start from the updated z_t (Marigold-DC)",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_number(self.start, "start", 0.0, self.stop)
