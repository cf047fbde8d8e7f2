"""One rendered pair given as usual mistakes give it: what the package says, and what the depth becomes."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_prior
from geodiff_plugin._checks import InputError
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from tests.pictures.gallery import GALLERY_PX, save_webp


@dataclass(frozen=True)
class Given:
    """What a caller gives: two pictures ``(H, W, 3)`` uint8, K of each in pixels and the pose, metres."""

    left: np.ndarray
    right: np.ndarray
    K_left: np.ndarray
    K_right: np.ndarray
    E: np.ndarray


@dataclass(frozen=True)
class Outcome:
    """What came back: ``depth_m`` ``(H, W)`` or ``None`` if refused, the verdict's word, what was said."""

    title: str
    depth_m: np.ndarray | None
    status: str
    said: tuple[tuple[str, str], ...]  # code and sentence


def _baseline(given: Given, factor: float) -> Given:
    E = given.E.copy()
    E[:3, 3] *= factor
    return replace(given, E=E)


def _focal(given: Given, factor: float) -> Given:
    scale = np.diag((factor, factor, 1.0))
    return replace(given, K_left=given.K_left @ scale, K_right=given.K_right @ scale)


def _rolled(given: Given, degrees: float) -> Given:
    """The right picture turned about its centre, as if its camera had been bent; its pose stays as it was."""
    turned = Image.fromarray(given.right).rotate(degrees, Image.Resampling.BICUBIC)
    return replace(given, right=np.asarray(turned))


def _offset(given: Given, pixels: float) -> Given:
    """The centre of the right image is not where K says."""
    K = given.K_right.copy()
    K[0, 2] += pixels
    return replace(given, K_right=K)


#: What is given wrongly, and how; the first is right.
MISTAKES = {
    "as it is": lambda given: given,
    "baseline twice as long": lambda given: _baseline(given, 2.0),
    "baseline in millimetres": lambda given: _baseline(given, 1000.0),
    "left and right exchanged": lambda given: replace(given, left=given.right, right=given.left),
    "pose inverted": lambda given: replace(given, E=np.linalg.inv(given.E)),
    "K of a picture 1.5 times as large": lambda given: _focal(given, 1.5),
    "centre of the right image off by 10 px": lambda given: _offset(given, 10.0),
    "right picture turned by 3 degrees": lambda given: _rolled(given, 3.0),
    "right picture of another place": lambda given: replace(given, right=given.right[::-1, ::-1].copy()),
}


def _try(title: str, given: Given, pipe: Any) -> Outcome:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the output has them
        try:
            K = given.K_left, given.K_right
            guidance = GeometryGuidance(Image.fromarray(given.right), K, given.E)
            out = pipe(
                Image.fromarray(given.left), guidance=guidance, generator=torch.Generator().manual_seed(0)
            )
        except InputError as error:
            return Outcome(title, None, "refused", (("", str(error)),))
    said = {
        message.code: str(message) for message in (*out.verdict.reasons, *out.warnings, *out.verdict.remarks)
    }
    return Outcome(title, np.asarray(out.prediction)[0, ..., 0], out.verdict.status, tuple(said.items()))


def outcomes() -> list[Outcome]:
    """The demo pair, right and mistaken, with the bundled prior and seed 0."""
    pair, pipe = read_demo_pair(), enable_geometry_guidance(load_prior("bundled"))
    left, right = (in_8_bits(image) for image in (pair.left, pair.right))
    given = Given(left, right, pair.rig.K_left, pair.rig.K_right, pair.rig.E)
    return [_try(title, change(given), pipe) for title, change in MISTAKES.items()]


def _first(text: str) -> str:
    """The first sentence, which ends where another one starts with a capital."""
    return re.split(r"(?<=[.?]) (?=[A-Z])", text)[0]


def _row(outcome: Outcome, truth_m: np.ndarray, valid: np.ndarray) -> str:
    factor = "-"
    if outcome.depth_m is not None and outcome.title != "left and right exchanged":
        factor = f"{np.median(outcome.depth_m[valid] / truth_m[valid]):.2f}"
    said = (
        "<br>".join(f"`{code}` {_first(text)}" if code else text for code, text in outcome.said) or "nothing"
    )
    return f"| {outcome.title} | {outcome.status} | {factor} | {said.replace('|', ' ')} |"


TEXT = """# The same pair, mistaken

The pair of `geodiff demo`, given as people give pairs by mistake. Its depth is known: the third column is the
depth divided by the truth, its median over the picture. [Messages](../reference/messages.md) has every code,
with its cause and its cure.

    {command}

![The depth of every row, in the colours of the truth](../images/mistaken.webp)

| given | verdict | depth / truth | what was said |
| --- | --- | ---: | --- |
{rows}

A baseline or a focal length that is wrong by a factor changes nothing in the pictures of a rectified rig, so
they cannot show it. It is named where the depth is far from what the prior has ever seen; otherwise measure
one known distance.
"""


def write_mistaken(page: Path, images: Path, command: str) -> None:
    """Write the page and its picture."""
    pair, results = read_demo_pair(), outcomes()
    near, far = depth_range(pair.depth_m)
    blank = np.full((*pair.depth_m.shape, 3), 255, np.uint8)
    maps = [blank if each.depth_m is None else colour_depth(each.depth_m, near, far) for each in results]
    titles = [f"{each.title}: {each.status}" for each in results]
    save_webp(grid(maps, titles, columns=3, cell_width=GALLERY_PX), images / "mistaken.webp")
    rows = "\n".join(_row(each, pair.depth_m, pair.valid) for each in results)
    write_text(page, TEXT.format(command=command, rows=rows))
