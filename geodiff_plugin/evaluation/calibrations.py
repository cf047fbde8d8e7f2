"""Calibrations that are not exact: what they cost (``eval poses``), whether a run tells (``eval trust``)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._checks import InputError, bad_value, check_choice
from geodiff_plugin.capture.agreement import DepthFrame
from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, guided_configuration
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, load, real_and_rendered
from geodiff_plugin.evaluation.datasets.sample import changed_ref, two_numbers
from geodiff_plugin.evaluation.experiment import Page, run_experiment
from geodiff_plugin.evaluation.options import PosesOptions, TrustOptions
from geodiff_plugin.evaluation.tables import CellOf, Table, count_of_pairs, headline, label_of
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs.runner import Item, Record

#: An error above this is of the kind that a wrong scale makes, and must be said.
BY_A_FACTOR = 0.25
#: Heading of a column -> references, and the pose that they are given.
Columns = Mapping[str, tuple[Sequence[SampleRef], str]]


def poses_table(title: str, columns: Mapping[str, Sequence[Record]], note: str) -> Table:
    """AbsRel of the same pairs with their poses given in several ways, and how often nothing was said."""

    def mean(values: list[float | None], digits: int) -> str:
        count = len(values) - values.count(None)
        return tables.mean_cell(values, digits) + (f" of {count}" if 0 < count < len(values) else "")

    def silently_off(record: Record) -> bool:
        off = (headline(record) or 0.0) > BY_A_FACTOR
        return off and not record["notes"]["method"].get("warnings")

    # Changed samples, in the same order, have other names.
    names = [{"dataset": r["dataset"], "sample": r["sample"]} for r in next(iter(columns.values()))]
    shown = [[r | like for r, like in zip(records, names, strict=True)] for records in columns.values()]
    table = tables.per_pair_table(title, zip(columns, shown, strict=True), headline, 3, note, mean)
    missing = (str(sum(headline(record) is None for record in records)) for records in shown)
    unwarned = (str(sum(map(silently_off, records))) for records in shown)
    more = ("without a result", *missing), (f"off by more than {BY_A_FACTOR:g}, no warning", *unwarned)
    return replace(table, rows=(*table.rows, *more))


def _residual(name: str, group: Sequence[Record]) -> str:
    """One number a right view, a dash for none."""
    return " / ".join(f"{px:.2f}" for px in tables.value_at(group[0], f"notes.method.{name}") or []) or "-"


_RESIDUALS: dict[str, CellOf] = {
    "pair": lambda group: label_of(group[0]),
    "refined, as given": partial(_residual, "residual_px_given"),
    "refined, as used": partial(_residual, "residual_px"),
}
RESIDUAL_NOTE = "Median distance of the matches from their epipolar lines, pixels; one number a right view."


def run_poses(name: str, options: PosesOptions) -> Page | None:
    """Measure two views, three where there are some, rectified pairs drifted, and rendered ones perturbed."""
    change, drift = two_numbers(options.perturb, "--perturb"), two_numbers(options.drift, "--drift")
    real, rendered = real_and_rendered(options, "synthetic-posed")
    cells, notes = list[Item](), dict[str, str]()

    def add(kind: str, what: str, note: str, columns: Columns, views: int = 2) -> None:
        count = len(next(iter(columns.values()))[0])
        title = f"AbsRel of {count_of_pairs(count, kind)}, {what}"
        notes[title], settings = note, replace(options.settings, views=views)
        for column, (refs, pose) in columns.items():
            for cell in experiment.method_cells(refs, (f"guided:pose={pose}",), settings, options.out):
                cells.append(replace(cell, head={**cell.head, "table": title, "column": column}))

    samples = [(ref, load(ref)) for ref in real]
    several = [ref for ref, sample in samples if sample.extra_views]
    rectified = [ref for ref, sample in samples if sample.rectified and any(drift)]
    drifted = [changed_ref(ref, "drifted", drift) for ref in rectified]
    perturbed = [changed_ref(ref, "perturbed", change) for ref in rendered]
    withheld = "'estimated' has the poses withheld but for the length of the first baseline."
    poses = {"refined": "refine", "given": "given", "estimated": "estimated"}
    add("real ", "two views", withheld, {column: (real, pose) for column, pose in poses.items()})
    add("real ", "three views", "", {column: (several, pose) for column, pose in poses.items()}, views=3)
    turned = f"The right camera has turned by {drift[0]:g} degrees and its image has moved by {drift[1]:g} px"
    of_drifted = {"true, given": (rectified, "given"), "drifted, given": (drifted, "given")}
    of_drifted |= {"drifted, refined": (drifted, "refine")}
    add("rectified ", "the rig drifted", f"{turned} up or down.", of_drifted)
    moved = f"Turned by up to {change[0]:g} degrees and shifted by up to {100 * change[1]:g} %"
    of_rendered = {"true, given": (rendered, "given"), "perturbed, given": (perturbed, "given")}
    of_rendered |= {"perturbed, refined": (perturbed, "refine"), "estimated": (rendered, "estimated")}
    add("rendered ", "poses perturbed", f"{moved} of the baseline.", of_rendered)

    def page_tables(records: list[Record]) -> list[Table]:
        shown = []
        for title, group in tables.grouped(records, "table").items():
            columns = tables.grouped(group, "column")
            shown.append(poses_table(title, columns, notes[title]))
            if title.endswith("two views"):
                of_pairs = (columns["refined"], ("key",), _RESIDUALS, RESIDUAL_NOTE)
                shown.append(tables.table_of_groups("Residuals", *of_pairs))
        return shown

    said = f"Prior {options.prior}, seed {options.seed}. All pixels with truth, metres as they come out."
    journal, title = experiment.RECORDS_NAME, "Results by pose"
    return run_experiment(name, options, title, cells, page_tables, lambda _: [said], journal)


#: A depth further off than this, as a share of the truth at the median pixel, is wrong enough to be told.
OFF = 0.2
TRUST_NOTE = (
    "Median error of the depth as a share of the truth; left and right exchanged, there is no truth. A wrong "
    "focal length of a rectified pair scales the depth and changes nothing else: two views cannot show it."
)
#: Known points of the kinds about points: so many of the truth.
POINTS = 200
Change = Callable[[StereoSample, StereoSample], StereoSample]


def _moved(sample: StereoSample, centre: np.ndarray) -> StereoSample:
    E = sample.E.copy()
    E[:3, 3] = centre
    return replace(sample, E=E)


def _scaled(sample: StereoSample, factor: float) -> StereoSample:
    """Focal lengths of another size; the principal point stays in the middle, where it says nothing."""
    scale = np.diag((factor, factor, 1.0))
    return replace(sample, K_left=sample.K_left @ scale, K_right=sample.K_right @ scale)


def _tilted(sample: StereoSample, _: StereoSample) -> StereoSample:
    """As if not rectified: the right camera nods by two degrees."""
    nod = np.eye(4)
    nod[:3, :3] = Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    return replace(sample, E=sample.E @ nod)


def _shifted(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right picture is the left one, moved: every disparity is the same."""
    shift = max(2, sample.left.shape[1] // 20)
    return replace(sample, right=np.roll(sample.left, -shift, axis=1), K_right=sample.K_left)


def _as_it_is(sample: StereoSample, _: StereoSample) -> StereoSample:
    return sample


#: Kind -> what it is, how a sample becomes so beside another one, and what true points are multiplied by.
KINDS: dict[str, tuple[str, Change, float | None]] = {
    "right": ("correct", _as_it_is, None),
    "right, points": ("correct, points", _as_it_is, 1.0),
    "swapped": ("left and right images exchanged", lambda s, _: replace(s, left=s.right, right=s.left), None),
    "inverse": ("E is world-to-camera", lambda s, _: replace(s, E=np.linalg.inv(s.E)), None),
    "axis": ("E along y where it is along x", lambda s, _: _moved(s, s.E[[1, 0, 2], 3]), None),
    "tilted": ("not rectified: 2 degrees of pitch", _tilted, None),
    "mirrored": ("right image mirrored", lambda s, _: replace(s, right=s.right[:, ::-1].copy()), None),
    "millimetres": ("baseline in millimetres", lambda s, _: _moved(s, s.E[:3, 3] * 1000.0), None),
    "thousandth": (
        "baseline divided by 1000 once too often",
        lambda s, _: _moved(s, s.E[:3, 3] * 0.001),
        None,
    ),
    "K-1.5": ("K of an image 1.5 times as large, centred", lambda s, _: _scaled(s, 1.5), None),
    "K-2": ("K of an image twice as large, centred", lambda s, _: _scaled(s, 2.0), None),
    "K-0.67": ("K of an image 0.67 times as large, centred", lambda s, _: _scaled(s, 0.67), None),
    "unrelated": (
        "right image of another scene",
        lambda s, other: replace(s, right=other.right, K_right=other.K_right),
        None,
    ),
    "one-picture": ("the left image twice", lambda s, _: replace(s, right=s.left, K_right=s.K_left), None),
    "shifted": ("right image a shifted copy of the left one", _shifted, None),
    "points-256": ("points in 1/256 m read as millimetres", _as_it_is, 0.256),
    "points-mm": ("points in millimetres read as metres", _as_it_is, 1000.0),
    "points-3": ("points 3 times too far", _as_it_is, 3.0),
}
RIGHT = [kind for kind in KINDS if kind.startswith("right")]
WRONG = [kind for kind in KINDS if kind not in RIGHT]


def _points(sample: StereoSample) -> np.ndarray:
    """``(POINTS, 3)`` of the truth, metres in the left camera's frame."""
    frame = DepthFrame("left", sample.depth_m, sample.valid, sample.K_left, np.eye(4))
    points = frame.world(sample.valid)
    return points[np.random.default_rng(0).permutation(len(points))[:POINTS]]


def _measure(ref: SampleRef, other: SampleRef, kind: str, read: Any, pipe: Any, settings: Settings) -> Record:
    """One guided call, what was said of it, and how far it is off."""
    original = read(ref).check_truth()
    _, change, factor = KINDS[kind]
    sample = change(original, read(other))
    points = None if factor is None else factor * _points(original)
    head = {"rectified": original.rectified}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            K = sample.K_left, sample.K_right
            guidance = GeometryGuidance(sample.right, K, sample.E, points=points)
            out = pipe(Image.fromarray(sample.left), guidance=guidance, **call_arguments(settings))
        except InputError as error:
            return head | {"status": "refused", "said": [str(error)], "off": None}
        said = [str(warning.message) for warning in caught if warning.category is UserWarning]
    verdict, depth_m = out.verdicts[0], out.prediction[0, ..., 0]
    said += [sentence for sentence in out.warnings if sentence not in {verdict.sentence, *verdict.remarks}]
    errors = np.abs(depth_m[sample.valid] / sample.depth_m[sample.valid] - 1.0)
    off = None if kind == "swapped" else float(np.median(errors))  # the truth is the other image's there
    signs = {name: None if value != value else value for name, value in asdict(verdict.indicators).items()}
    said += [*verdict.reasons, *verdict.remarks]
    return head | {"status": verdict.status, "said": said, "off": off, "signs": signs}


def _share(group: Sequence[Record], *, told: bool = True, off: bool = False) -> str:
    """Of records, or of those whose depth is off, how many were told, or else not trusted."""
    counted = [record for record in group if not off or record["off"] is None or record["off"] > OFF]
    part = sum(record["status"] != "trusted" or (told and bool(record["said"])) for record in counted)
    return f"{part} of {len(counted)} ({100 * part // len(counted)} %)" if counted else "-"


def _median(group: Sequence[Record]) -> str:
    known = [record["off"] for record in group if record["off"] is not None]
    return f"{np.median(known):.2f}" if known else "-"


_COLUMNS: dict[str, CellOf] = {
    "given as": lambda group: KINDS[group[0]["kind"]][0],
    "median error": _median,
    "not trusted": partial(_share, told=False),
    "anything said": _share,
    f"said, of those > {OFF:.0%} off": partial(_share, off=True),
}


def _table(source: str, records: Sequence[Record]) -> Table:
    """A row a kind, then all wrong ones, with and without those that two views cannot show."""
    pairs = count_of_pairs(len({record["sample"] for record in records}), f"{source} ")
    title = f"Wrong calibrations detected, right ones not trusted: {pairs}"
    table = tables.table_of_groups(title, records, ("kind",), _COLUMNS, TRUST_NOTE)
    wrong = [record for record in records if record["kind"] in WRONG]
    # Rectified rows stay rows under any focal length.
    seen = [record for record in wrong if not (record["rectified"] and record["kind"].startswith("K-"))]
    sums = {"all wrong ones": wrong, "without focal lengths of rectified pairs": seen}
    more = ((name, "", "", "", _share(group, off=True)) for name, group in sums.items())
    return replace(table, rows=(*table.rows, *more))


def run_trust(name: str, options: TrustOptions) -> Page | None:
    """Measure, write ``trust.jsonl`` and the table; errors as ``run_experiment``."""
    for kind in options.kinds:
        check_choice(kind, "--kinds", WRONG)
    wrong = options.kinds or WRONG
    right = RIGHT if any(KINDS[kind][2] for kind in wrong) else RIGHT[:1]
    pairs = real_and_rendered(options, "synthetic")
    if "unrelated" in options.kinds and any(len(refs) == 1 for refs in pairs):
        bad_value("--kinds", "without 'unrelated' where a pair is alone", "it", "Give two pairs or more.")
    settings, priors, read = options.settings, PriorCache(), lru_cache(maxsize=2)(load)
    configuration = guided_configuration(GeometryGuidance, settings)
    pipe, prior = priors.get(settings), f"{settings.prior} {priors.fingerprint(settings)}"
    cells = []
    for source, refs in zip(("real", "rendered"), pairs, strict=True):
        for ref, following in zip(refs, (*refs[1:], *refs[:1]), strict=True):
            for kind in (*right, *wrong):
                unrelated = kind == "unrelated"
                if unrelated and len(refs) == 1:
                    continue
                beside = {"other": experiment.cell_key(following, "", {})} if unrelated else {}
                head = {"kind": kind, "group": source, "sample": ref.label}
                work = partial(_measure, ref, following if unrelated else ref, kind, read, pipe, settings)
                key = experiment.cell_key(ref, kind, configuration | beside, prior)
                cells.append(Item(key, work, name=f"{ref.label}, {kind}", head=head))

    def page_tables(records: list[Record]) -> list[Table]:
        return [_table(source, group) for source, group in tables.grouped(records, "group").items()]

    return run_experiment(name, options, "Trust", cells, page_tables)
