"""How often a wrong calibration is detected, and a right one is not trusted: ``geodiff eval trust``.

The folder keeps the signs of every call, so that other thresholds need no new calls.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError, bad_value
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, guided_configuration
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load
from geodiff_plugin.evaluation.experiment import Experiment, Page, cell_key, last_of
from geodiff_plugin.evaluation.options import TrustOptions, real_and_rendered
from geodiff_plugin.evaluation.tables import Table, count_of_pairs
from geodiff_plugin.guidance.guidance import GeometryGuidance
from geodiff_plugin.runner import Item, Record
from geodiff_plugin.runtime.verdict import Indicators, judge

PURPOSE = "How many wrong calibrations a run detects, and how many correct ones it does not trust."
#: The ten kinds of wrong calibration that every pair is given with.
TEN = (
    *("swapped", "inverse", "axis", "tilted", "mirrored"),
    *("millimetres", "thousandth", "K-1.5", "K-2", "K-0.67"),
)
#: A depth further off than this, as a share of the truth at the median pixel, is wrong enough to be told.
OFF = 0.2
NOTE = (
    "Median error of the depth as a share of the truth; left and right exchanged, there is no truth. A wrong "
    "focal length of a rectified pair scales the depth and changes nothing else: two views cannot show it."
)
#: Known points of the cases about points: so many of the truth.
POINTS = 200

Other = Callable[[], StereoSample]
Change = Callable[[StereoSample, Other], StereoSample]


def _scaled_baseline(factor: float) -> Change:
    return lambda sample, other: replace(sample, E=_moved(sample.E, sample.E[:3, 3] * factor))


def _moved(E: np.ndarray, centre: np.ndarray) -> np.ndarray:
    moved = E.copy()
    moved[:3, 3] = centre
    return moved


def _scaled_K(factor: float) -> Change:
    """Focal lengths of another size, and the principal point in the middle, where it says nothing."""
    scale = np.array([[factor, factor, 1.0], [factor, factor, 1.0], [1.0, 1.0, 1.0]])
    return lambda s, other: replace(s, K_left=s.K_left * scale, K_right=s.K_right * scale)


def _tilted(sample: StereoSample, other: Other) -> StereoSample:
    """As if not rectified: the right camera nods by two degrees."""
    nod = np.eye(4)
    nod[:3, :3] = Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    return replace(sample, E=sample.E @ nod)


def _unrelated(sample: StereoSample, other: Other) -> StereoSample:
    given = other()
    return replace(sample, right=given.right, K_right=given.K_right)


def _shifted(sample: StereoSample, other: Other) -> StereoSample:
    """The right picture is the left one, moved: every disparity is the same."""
    shift = max(2, sample.left.shape[1] // 20)
    return replace(sample, right=np.roll(sample.left, -shift, axis=1), K_right=sample.K_left)


WRONG: dict[str, tuple[str, Change]] = {
    "swapped": ("left and right images exchanged", lambda s, _: replace(s, left=s.right, right=s.left)),
    "inverse": ("E is world-to-camera", lambda s, _: replace(s, E=np.linalg.inv(s.E))),
    "axis": ("E along y where it is along x", lambda s, _: replace(s, E=_moved(s.E, s.E[[1, 0, 2], 3]))),
    "millimetres": ("baseline in millimetres", _scaled_baseline(1000.0)),
    "thousandth": ("baseline divided by 1000 once too often", _scaled_baseline(0.001)),
    "K-1.5": ("K of an image 1.5 times as large, centred", _scaled_K(1.5)),
    "K-2": ("K of an image twice as large, centred", _scaled_K(2.0)),
    "K-0.67": ("K of an image 0.67 times as large, centred", _scaled_K(0.67)),
    "tilted": ("not rectified: 2 degrees of pitch", _tilted),
    "mirrored": (
        "right image mirrored",
        lambda s, _: replace(s, right=np.ascontiguousarray(s.right[:, ::-1])),
    ),
    "unrelated": ("right image of another scene", _unrelated),
    "one-picture": (
        "the left image twice",
        lambda s, _: replace(s, right=s.left.copy(), K_right=s.K_left),
    ),
    "shifted": ("right image a shifted copy of the left one", _shifted),
}
"""Kind -> what it is, and how a sample becomes so (given another sample too)."""

#: What becomes of true points: KITTI's 1/256 m read as millimetres, millimetres as metres, a wrong unit.
WRONG_POINTS = {"points-256": 0.256, "points-mm": 1000.0, "points-3": 3.0}


def _points(sample: StereoSample, seed: int = 0) -> np.ndarray:
    """``(POINTS, 3)`` of the truth, metres in the left camera's frame."""
    rows, columns = np.nonzero(sample.valid)
    some = np.random.default_rng(seed).permutation(len(rows))[:POINTS]
    z = sample.depth_m[rows[some], columns[some]].astype(np.float64)
    rays = np.stack([columns[some], rows[some], np.ones(len(some))], axis=1) @ np.linalg.inv(sample.K_left).T
    return rays * z[:, None]


def case_kinds(kinds: tuple[str, ...]) -> tuple[str, ...]:
    """The right sample, with points too where some kind is about them, and then the kinds."""
    pointed = any(kind in WRONG_POINTS for kind in kinds)
    return ("right", *(("right, points",) if pointed else ()), *kinds)


def make_case(kind: str, sample: StereoSample, other: Other) -> tuple[StereoSample, np.ndarray | None]:
    """A sample, right or wrong in one way, and ``(N, 3)`` points in metres that go with it, or ``None``.

    Args:
        kind: of ``case_kinds``.
        sample: right.
        other: gives another one, whose right image is "unrelated".
    """
    if kind in WRONG:
        return WRONG[kind][1](sample, other), None
    if kind == "right":
        return sample, None
    return sample, WRONG_POINTS.get(kind, 1.0) * _points(sample)


def _measure(
    ref: SampleRef,
    other: SampleRef,
    kind: str,
    read: Callable[[SampleRef], StereoSample],
    pipe: Any,
    settings: Settings,
) -> Record:
    """One guided call, what was said of it, and how far it is off."""
    original = read(ref).check_truth()
    sample, points = make_case(kind, original, partial(load, other))
    head = {"rectified": original.rectified}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            cameras = (sample.K_left, sample.K_right), sample.E
            guidance = GeometryGuidance(sample.right, *cameras, points=points)
            out = pipe(Image.fromarray(sample.left), guidance=guidance, **call_arguments(settings))
        except InputError as error:
            return head | {"status": "refused", "said": [str(error)], "off": None}
        said = [str(warning.message) for warning in caught if warning.category is UserWarning]
    verdict, depth_m = out.verdicts[0], out.prediction[0, ..., 0]
    said += [sentence for sentence in out.warnings if sentence not in {verdict.sentence, *verdict.remarks}]
    errors = np.abs(depth_m[sample.valid] / sample.depth_m[sample.valid] - 1.0)
    off = None if kind == "swapped" else float(np.median(errors))  # the truth is the other image's there
    signs = {name: None if value != value else value for name, value in asdict(verdict.indicators).items()}
    return head | {"status": "finished", "said": said, "off": off, "signs": signs}


def _judged(record: Record) -> Record:
    """The record with what today's verdict makes of its signs."""
    if record["status"] == "refused":
        return record
    signs: dict[str, Any] = {n: math.nan if value is None else value for n, value in record["signs"].items()}
    sentences = {name: tuple(signs.get(name, ())) for name in ("doubts", "mistakes")}
    verdict = judge(Indicators(**signs | sentences))
    return record | {"status": verdict.status, "said": [*record["said"], *verdict.reasons, *verdict.remarks]}


def _share(part: int, whole: int) -> str:
    return "-" if whole == 0 else f"{part} of {whole} ({100 * part // whole} %)"


def _told(records: Sequence[Record]) -> tuple[int, int]:
    """Of the depths that are off, how many were told, and how many there are."""
    off = [r for r in records if r["off"] is None or r["off"] > OFF]
    return sum(_is_told(r) for r in off), len(off)


def _is_told(record: Record) -> bool:
    return record["status"] != "trusted" or bool(record["said"])


def _table(group: str, records: Sequence[Record], kinds: Sequence[str]) -> Table:
    """A row a kind, then all wrong ones, with and without those that two views cannot show."""
    names = {kind: WRONG[kind][0] for kind in kinds if kind in WRONG}
    names |= {kind: f"points {WRONG_POINTS[kind]:g} times too far" for kind in kinds if kind in WRONG_POINTS}
    rows = []
    for kind in ("right", "right, points", *kinds):
        own = [record for record in records if record["kind"] == kind]
        if own:
            known = [r["off"] for r in own if r["off"] is not None]
            median = f"{np.median(known):.2f}" if known else "-"
            shares = [sum(r["status"] != "trusted" for r in own), sum(map(_is_told, own))]
            cells = [_share(count, len(own)) for count in shares] + [_share(*_told(own))]
            rows.append((names.get(kind, kind), median, *cells))
    wrong = [record for record in records if not record["kind"].startswith("right")]
    # Rectified rows stay rows under any focal length.
    seen = [record for record in wrong if not (record["rectified"] and record["kind"].startswith("K-"))]
    for name, some in (("all wrong ones", wrong), ("without focal lengths of rectified pairs", seen)):
        rows.append((name, "", "", "", _share(*_told(some))))
    head = ("given as", "median error", "not trusted", "anything said", f"said, of those > {OFF:.0%} off")
    pairs = count_of_pairs(len({record["sample"] for record in records}), f"{group} ")
    return Table(f"Wrong calibrations detected, right ones not trusted: {pairs}", head, tuple(rows), NOTE)


def run_trust(name: str, options: TrustOptions) -> Page | None:
    """Measure, write ``trust.jsonl`` and the table.

    Raises:
        InputError: an unknown kind, no pairs, a pair without truth, or one alone that has no unrelated one.
    """
    kinds = options.kinds or TEN
    for kind in kinds:
        if kind not in WRONG and kind not in WRONG_POINTS:
            bad_value("--kinds", f"some of {', '.join((*WRONG, *WRONG_POINTS))}", repr(kind))
    pairs = real_and_rendered(options, f"synthetic:{{}}@{options.width}x{options.width * 3 // 4}")
    groups = dict(zip(("real", "rendered"), pairs, strict=True))
    if "unrelated" in kinds and any(len(refs) == 1 for refs in groups.values()):
        bad_value("--kinds", "without 'unrelated' where a pair is alone", "it", "Give two pairs or more.")
    settings, priors, read = options.settings, PriorCache(), last_of(load)
    configuration = guided_configuration(GeometryGuidance, settings)
    pipe, prior = priors.get(settings), f"{settings.prior} {priors.fingerprint(settings)}"
    cells = []
    for group, refs in groups.items():
        for ref, other in zip(refs, (*refs[1:], *refs[:1]), strict=True):
            for kind in case_kinds(kinds):
                beside = {"other": cell_key(other, "", {})} if kind == "unrelated" else {}
                head = {"kind": kind, "group": group, "sample": ref.label}
                work = partial(_measure, ref, other, kind, read, pipe, settings)
                key = cell_key(ref, kind, configuration | beside, prior)
                cells.append(Item(key, work, name=f"{ref.label}, {kind}", head=head))

    def tables(records: list[Record]) -> list[Table]:
        judged = [_judged(record) for record in records]
        there = dict.fromkeys(record["group"] for record in judged)
        return [_table(group, [r for r in judged if r["group"] == group], kinds) for group in there]

    return Experiment(name, "Trust", cells, tables, purpose=PURPOSE).run(name, options)
