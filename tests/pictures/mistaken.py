"""One rendered pair given as usual mistakes give it: what the package says, and what the depth becomes."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin import Rig
from geodiff_plugin._checks import InputError
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from tests.lab.trust import KINDS, Change, moved
from tests.pictures.gallery import GALLERY_PX, save_webp
from tests.pictures.rooms import call, guidance_of


@dataclass(frozen=True)
class Outcome:
    """What came back: ``depth_m`` ``(H, W)`` or ``None`` if refused, the verdict's word, what was said."""

    title: str
    depth_m: np.ndarray | None
    status: str
    said: tuple[tuple[str, str], ...]  # code and sentence


def _twice_the_baseline(sample: StereoSample, _: StereoSample) -> StereoSample:
    return moved(sample, 2.0 * sample.E[:3, 3])


def _centre_off(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The centre of the right image is 10 px from where K says, on the side that brings the scene nearer."""
    K_right = sample.K_right.copy()
    K_right[0, 2] += 10.0
    return replace(sample, K_right=K_right)


def _turned(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right picture turned about its centre, as if its camera had been bent; its pose stays as it was."""
    turned = Image.fromarray(sample.right).rotate(3.0, Image.Resampling.BICUBIC)
    return replace(sample, right=np.asarray(turned))


def _upside_down(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right picture turned by half a turn: nothing is where the pose would have it."""
    return replace(sample, right=sample.right[::-1, ::-1].copy())


#: What is given wrongly, and how; the first is right.
MISTAKES: dict[str, Change] = {
    "as it is": KINDS["right"].change,
    "baseline twice as long": _twice_the_baseline,
    "baseline in millimetres": KINDS["millimetres"].change,
    "left and right exchanged": KINDS["swapped"].change,
    "pose inverted": KINDS["inverse"].change,
    "K of a picture 1.5 times as large": KINDS["K-1.5"].change,
    "centre of the right image off by 10 px": _centre_off,
    "right picture turned by 3 degrees": _turned,
    "right picture upside down": _upside_down,
}


def _try(title: str, sample: StereoSample) -> Outcome:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the output has them
        try:
            out = call(sample.left, guidance_of(sample.right, Rig(sample.K_left, sample.K_right, sample.E)))
        except InputError as error:
            return Outcome(title, None, "refused", (("", str(error)),))
    messages = (*out.verdict.reasons, *out.verdict.remarks, *out.warnings)
    said = {message.code: str(message) for message in messages if message != out.verdict.message}
    return Outcome(title, single_map(out.prediction), out.verdict.status, tuple(said.items()))


def outcomes() -> list[Outcome]:
    """The demo pair, right and mistaken, with the bundled prior and seed 0."""
    pair = read_demo_pair()
    left, right = (in_8_bits(image) for image in (pair.left, pair.right))
    cameras = pair.rig.K_left, pair.rig.K_right, pair.rig.E
    sample = StereoSample("demo", "pair", left, right, *cameras, pair.depth_m, pair.valid)
    return [_try(title, change(sample, sample)) for title, change in MISTAKES.items()]


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

*The depth of every row below, from left to right and down, in the colours of the truth: yellow is near, blue
is far.*

| given | verdict | depth / truth | what was said |
| --- | --- | ---: | --- |
{rows}

A baseline or a focal length that is wrong by a factor changes nothing in the pictures of a rectified rig, so
they cannot show it; nor can they show a centre that is off, unless it puts things behind infinity. So these
rows are trusted, and wrong. A length is named where it is implausible, as millimetres are; otherwise measure
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
