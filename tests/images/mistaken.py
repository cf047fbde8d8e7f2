"""The demo pair with common input errors: verdicts, messages and depth."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evaluation.datasets import StereoSample
from geodiff_plugin.findings import ASSUMPTION
from geodiff_plugin.formats.clouds import in_8_bits
from geodiff_plugin.formats.out import write_text
from geodiff_plugin.jobs.report import single_map
from geodiff_plugin.plotting import colour_depth, depth_range, grid
from tests.images.gallery import GALLERY_PX, save_webp
from tests.images.rooms import call, guidance_of
from tests.lab.trust import KINDS, Change, moved
from tests.pages import with_generated
from tests.views import made_rig


@dataclass(frozen=True)
class Outcome:
    """The result for one input."""

    title: str
    depth_m: np.ndarray | None  # (H, W); None if the input was rejected
    status: str  # of the verdict
    codes: tuple[str, ...]  # of reasons, remarks and warnings


def _twice_the_baseline(sample: StereoSample, _: StereoSample) -> StereoSample:
    return moved(sample, 2.0 * sample.E[:3, 3])


def _centre_off(sample: StereoSample, _: StereoSample) -> StereoSample:
    """cx of the right camera is 10 px too large, which brings the scene nearer."""
    K_right = sample.K_right.copy()
    K_right[0, 2] += 10.0
    return replace(sample, K_right=K_right)


def _turned(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right image is rotated about its centre; its pose is not."""
    turned = Image.fromarray(sample.right).rotate(3.0, Image.Resampling.BICUBIC)
    return replace(sample, right=np.asarray(turned))


def _upside_down(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right image is rotated by 180 degrees."""
    return replace(sample, right=sample.right[::-1, ::-1].copy())


#: Against its ground truth this depth means nothing: it is of the other image.
SWAPPED = "left and right swapped"
#: Input errors by title; the first entry is the correct input.
MISTAKES: dict[str, Change] = {
    "correct input": KINDS["right"].change,
    "baseline doubled": _twice_the_baseline,
    "baseline in millimetres": KINDS["millimetres"].change,
    SWAPPED: KINDS["swapped"].change,
    "E inverted": KINDS["inverse"].change,
    "focal lengths of K 1.5x too large": KINDS["K-1.5"].change,
    "right cx off by 10 px": _centre_off,
    "right image rotated by 3 degrees": _turned,
    "right image upside down": _upside_down,
}


def _try(title: str, sample: StereoSample) -> Outcome:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # they are read from the output
        try:
            out = call(
                sample.left, guidance_of(sample.right, made_rig(sample.K_left, sample.K_right, sample.E))
            )
        except InputError as error:
            return Outcome(title, None, f"rejected: {error}", ())
    findings = (*out.verdict.reasons, *(each for each in out.findings if each.severity is not ASSUMPTION))
    codes = dict.fromkeys(finding.code for finding in findings if finding != out.verdict.summary)
    return Outcome(title, single_map(out.prediction), out.verdict.status, tuple(codes))


def outcomes() -> list[Outcome]:
    """The demo pair, with and without input errors, with the bundled prior and seed 0."""
    pair = read_demo_pair()
    left, right = (in_8_bits(image) for image in (pair.left, pair.right))
    cameras = pair.rig.K_left, pair.rig.K_right, pair.rig.E
    sample = StereoSample("demo", "pair", left, right, *cameras, pair.depth_m, pair.valid)
    return [_try(title, change(sample, sample)) for title, change in MISTAKES.items()]


def _row(outcome: Outcome, ground_truth_m: np.ndarray, valid: np.ndarray) -> str:
    factor = "-"
    if outcome.depth_m is not None and outcome.title != SWAPPED:
        factor = f"{np.median(outcome.depth_m[valid] / ground_truth_m[valid]):.2f}"
    codes = ", ".join(f"`{code}`" for code in outcome.codes) or "none"
    return f"| {outcome.title} | {outcome.status} | {factor} | {codes} |"


#: The page has the table between these lines.
BEGIN, END = "<!-- begin: python -m tests.images mistaken -->\n\n", "\n<!-- end -->\n"
HEADER = "| input | verdict | depth / ground truth | codes |\n| --- | --- | ---: | --- |\n"


def with_table(page: str, table: str) -> str:
    """The text of a page with its table replaced."""
    return with_generated(page, BEGIN, table, END)


def write_mistaken(page: Path, images: Path) -> None:
    """Replace the table of the page, and write its image."""
    pair, results = read_demo_pair(), outcomes()
    near, far = depth_range(pair.depth_m)
    blank = np.full((*pair.depth_m.shape, 3), 255, np.uint8)
    maps = [blank if each.depth_m is None else colour_depth(each.depth_m, near, far) for each in results]
    titles = [f"{each.title}: {each.status}" for each in results]
    save_webp(grid(maps, titles, columns=3, cell_width=GALLERY_PX), images / "mistaken.webp")
    rows = "".join(f"{_row(each, pair.depth_m, pair.valid)}\n" for each in results)
    write_text(page, with_table(page.read_text(encoding="utf-8"), HEADER + rows))
