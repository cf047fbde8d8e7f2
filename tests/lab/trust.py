"""Wrong calibrations made on purpose: whether a run detects them, and whether it trusts correct ones.

The page is docs/appendix/results-trust.md.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, bad_value, check_choice
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation import experiment, tables
from geodiff_plugin.evaluation.baselines import PriorCache, Settings
from geodiff_plugin.evaluation.baselines.guided import call_arguments, guided_configuration
from geodiff_plugin.evaluation.datasets import SampleRef, StereoSample, find_pairs, load, some_pairs
from geodiff_plugin.evaluation.experiment import Experiment, Page, run_experiment
from geodiff_plugin.evaluation.tables import CellOf, Table, count_of_pairs
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.findings import ASSUMPTION
from geodiff_plugin.jobs.journal import Item, Record
from geodiff_plugin.jobs.report import used_poses
from geodiff_plugin.result.confidence import RIGHT_WITHIN
from geodiff_plugin.result.expected_error import expected_error
from geodiff_plugin.result.output import MetricDepthOutput
from geodiff_plugin.trust import PoseUncertainty, match_error
from tests.lab.options import TrustOptions

#: Median relative error above which a run must report a problem.
OFF = 0.2
TRUST_NOTE = (
    "Errors are relative to ground truth, which swapped images do not have. A wrong focal length "
    "of a rectified pair only scales the depth, which two views cannot reveal. Confidence and expected error "
    "(its median, relative to the depth) are over the pixels with ground truth."
)
#: Coefficient k1 of the distortion that is not removed.
BARREL = -0.25
#: Known points of the kinds about points: so many of ground truth.
POINTS = 200
Change = Callable[[StereoSample, StereoSample], StereoSample]


def moved(sample: StereoSample, centre: np.ndarray) -> StereoSample:
    """The sample with its right camera at ``centre (3,)``, metres."""
    E = sample.E.copy()
    E[:3, 3] = centre
    return replace(sample, E=E)


def _scaled(sample: StereoSample, factor: float) -> StereoSample:
    """Scale the focal lengths; the principal point stays in the centre, where it reveals nothing."""
    scale = np.diag((factor, factor, 1.0))
    return replace(sample, K_left=sample.K_left @ scale, K_right=sample.K_right @ scale)


def _tilted(sample: StereoSample, _: StereoSample) -> StereoSample:
    """As if not rectified: the right camera nods by two degrees."""
    nod = np.eye(4)
    nod[:3, :3] = Rotation.from_euler("x", 2.0, degrees=True).as_matrix()
    return replace(sample, E=sample.E @ nod)


def _shifted(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right image is the left one, moved: every disparity is the same."""
    shift = max(2, sample.left.shape[1] // 20)
    return replace(sample, right=np.roll(sample.left, -shift, axis=1), K_right=sample.K_left)


def _px(sample: StereoSample, px: float) -> float:
    """Convert pixels of an image 640 wide to pixels of the sample."""
    return px * sample.left.shape[1] / 640


def _barrel(image: np.ndarray, K: np.ndarray) -> np.ndarray:
    """An image or a map as a lens with k1 = ``BARREL`` would have taken it, under the same K."""
    v, u = np.indices(image.shape[:2], dtype=np.float64)
    bent = np.stack([u.ravel(), v.ravel()], -1)[:, None]
    straight = cv2.undistortPoints(bent, K, np.array([BARREL, 0, 0, 0]), P=K).reshape(*image.shape[:2], 2)
    way = cv2.INTER_LINEAR if image.ndim == 3 else cv2.INTER_NEAREST
    return cv2.remap(image, straight.astype(np.float32), None, way)


def _distorted(sample: StereoSample, _: StereoSample) -> StereoSample:
    """Distortion that was not removed, in both views; ground truth is bent as the left one."""
    depth_m = _barrel(np.where(sample.valid, sample.depth_m, 0), sample.K_left)
    return replace(
        sample,
        left=_barrel(sample.left, sample.K_left),
        right=_barrel(sample.right, sample.K_right),
        depth_m=depth_m,
        valid=depth_m > 0,
    )


def _moved_part(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The middle third of the rows of the right image has moved along them."""
    right, third = sample.right.copy(), len(sample.right) // 3
    right[third : 2 * third] = np.roll(right[third : 2 * third], round(_px(sample, 30)), axis=1)
    return replace(sample, right=right)


def _rolled(sample: StereoSample, _: StereoSample) -> StereoSample:
    """A rolling shutter: rows of the right image shift the more the lower they lie."""
    v, u = np.indices(sample.right.shape[:2], dtype=np.float32)
    shift = np.float32(_px(sample, 15)) * v / len(v)
    return replace(sample, right=cv2.remap(sample.right, u + shift, v, cv2.INTER_LINEAR))


def _off_centre(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right principal point is off, so that what is far lies at negative disparity."""
    K_right = sample.K_right.copy()
    K_right[0, 2] -= _px(sample, 10)
    return replace(sample, K_right=K_right)


def _stretched(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right image without a tenth of its columns, stretched to its size."""
    height, width = sample.right.shape[:2]
    part = sample.right[:, : width - width // 10]
    return replace(sample, right=cv2.resize(part, (width, height)))


def _yawed(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The right camera is turned by a degree: between parallel cameras nearly a shift of cx."""
    yaw = np.eye(4)
    yaw[:3, :3] = Rotation.from_euler("y", 1.0, degrees=True).as_matrix()
    return replace(sample, E=sample.E @ yaw)


def _off_pose(
    sample: StereoSample, _: StereoSample, *, turn_deg: float, shift: float, length: float = 0.0
) -> StereoSample:
    """``E`` turned about, and moved along, axes that chance takes: all errors are independent of each other.

    ``shift`` is in baselines. The baseline then gets its own length again, plus the fraction ``length``.
    """
    rng = np.random.default_rng(list(sample.E.tobytes()))
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    turn, centre = np.eye(4), sample.E[:3, 3]
    turn[:3, :3] = Rotation.from_rotvec(np.radians(turn_deg) * axis).as_matrix()
    baseline_m = np.linalg.norm(centre)
    off = centre + shift * baseline_m * way
    return moved(replace(sample, E=sample.E @ turn), off * (1.0 + length) * baseline_m / np.linalg.norm(off))


def _moved_across(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The middle of the right image, an ellipse of two fifths of it, has moved across the rows as well."""
    height, width = sample.right.shape[:2]
    v, u = np.indices((height, width))
    inside = ((u - width / 2) / (0.36 * width)) ** 2 + ((v - height / 2) / (0.44 * height)) ** 2 < 1
    shift = np.array([[1, 0, _px(sample, 5)], [0, 1, _px(sample, 6)]], np.float32)
    warped = cv2.warpAffine(sample.right, shift, (width, height), borderMode=cv2.BORDER_REFLECT)
    return replace(sample, right=np.where(inside[..., None], warped, sample.right))


def _between_bars(sample: StereoSample, _: StereoSample) -> StereoSample:
    """Both images are squeezed to three quarters of their width, between black bars; K is not."""

    def squeezed(image: np.ndarray, way: int = cv2.INTER_AREA) -> np.ndarray:
        height, width = image.shape[:2]
        narrow = cv2.resize(image, (width * 3 // 4, height), interpolation=way)
        bar = (width - narrow.shape[1]) // 2
        made = np.zeros_like(image)
        made[:, bar : bar + narrow.shape[1]] = narrow
        return made

    depth_m = squeezed(np.where(sample.valid, sample.depth_m, 0), cv2.INTER_NEAREST)
    images = {"left": squeezed(sample.left), "right": squeezed(sample.right)}
    return replace(sample, **images, depth_m=depth_m, valid=depth_m > 0)


def _upside_down(sample: StereoSample, _: StereoSample) -> StereoSample:
    """Both images are turned by 180 degrees, and ground truth with the left one."""
    names = ("left", "right", "depth_m", "valid")
    return replace(sample, **{name: getattr(sample, name)[::-1, ::-1].copy() for name in names})


def _saved_twice(sample: StereoSample, _: StereoSample) -> StereoSample:
    """The left image as it is, and as a JPEG."""
    again = cv2.imdecode(cv2.imencode(".jpg", sample.left, [cv2.IMWRITE_JPEG_QUALITY, 70])[1], 1)
    return replace(sample, right=again, K_right=sample.K_left)


def _as_it_is(sample: StereoSample, _: StereoSample) -> StereoSample:
    return sample


@dataclass(frozen=True)
class Kind:
    """A calibration: what it is, how a sample comes to have it next to another sample, given points' factor.

    ``points`` is what true points are multiplied by, ``None`` where no points are given.
    """

    title: str
    change: Change = _as_it_is
    points: float | None = None


KINDS: dict[str, Kind] = {
    "right": Kind("correct"),
    "right, points": Kind("correct, points", points=1.0),
    "swapped": Kind("left and right images swapped", lambda s, _: replace(s, left=s.right, right=s.left)),
    "inverse": Kind("E is world-to-camera", lambda s, _: replace(s, E=np.linalg.inv(s.E))),
    "axis": Kind("baseline along y instead of x", lambda s, _: moved(s, s.E[[1, 0, 2], 3])),
    "tilted": Kind("right camera pitched by 2 degrees, not rectified", _tilted),
    "mirrored": Kind("right image mirrored", lambda s, _: replace(s, right=s.right[:, ::-1].copy())),
    "millimetres": Kind("baseline in millimetres", lambda s, _: moved(s, s.E[:3, 3] * 1000.0)),
    "thousandth": Kind("baseline 1000 times too short", lambda s, _: moved(s, s.E[:3, 3] * 0.001)),
    "K-1.5": Kind("focal lengths for an image 1.5x as large", lambda s, _: _scaled(s, 1.5)),
    "K-2": Kind("focal lengths for an image 2x as large", lambda s, _: _scaled(s, 2.0)),
    "K-0.67": Kind("focal lengths for an image 0.67x as large", lambda s, _: _scaled(s, 0.67)),
    "unrelated": Kind(
        "right image of another scene",
        lambda s, other: replace(s, right=other.right, K_right=other.K_right),
    ),
    "one-image": Kind("the left image twice", lambda s, _: replace(s, right=s.left, K_right=s.K_left)),
    "shifted": Kind("right image a shifted copy of the left one", _shifted),
    "distorted": Kind("distortion of k1 = -0.25 in both views", _distorted),
    "moved-part": Kind("a third of the right image's rows shifted by 30 px", _moved_part),
    "rolling": Kind("rolling shutter of 15 px", _rolled),
    "centre": Kind("right cx off by 10 px, negative disparities far away", _off_centre),
    "stretched": Kind("right image cropped by a tenth and stretched", _stretched),
    "moved-across": Kind("two fifths of the right image shifted by (5, 6) px", _moved_across),
    "letterbox": Kind("both images squeezed and letterboxed", _between_bars),
    "upside-down": Kind("both images upside down", _upside_down),
    "saved-twice": Kind("the left image twice, once as a JPEG", _saved_twice),
    "feet": Kind("baseline in feet", lambda s, _: moved(s, s.E[:3, 3] / 0.3048)),
    "yaw": Kind("E rotated by 1 degree of yaw", _yawed),
    "pose-slight": Kind(
        "E off by 0.15 degrees and 3 % of the baseline", partial(_off_pose, turn_deg=0.15, shift=0.03)
    ),
    "pose-rough": Kind(
        "E off by 0.6 degrees and 8 % of the baseline", partial(_off_pose, turn_deg=0.6, shift=0.08)
    ),
    "pose-far": Kind(
        "E off by 2 degrees and 20 % of the baseline", partial(_off_pose, turn_deg=2.0, shift=0.2)
    ),
    "pose-rough-long": Kind(
        "E off by 0.6 degrees and 8 %, baseline 12 % too long",
        partial(_off_pose, turn_deg=0.6, shift=0.08, length=0.12),
    ),
    "long": Kind("baseline 12 % too long", lambda s, _: moved(s, 1.12 * s.E[:3, 3])),
    "points-256": Kind("points in 1/256 m read as millimetres", points=0.256),
    "points-mm": Kind("points in millimetres read as metres", points=1000.0),
    "points-3": Kind("points 3 times too far", points=3.0),
}
RIGHT = [kind for kind in KINDS if kind.startswith("right")]
WRONG = [kind for kind in KINDS if kind not in RIGHT]


def _points(sample: StereoSample) -> np.ndarray:
    """``(POINTS, 3)`` of ground truth, metres in the left camera's frame."""
    points = Camera(sample.K_left).unproject(sample.depth_m)[sample.valid]
    return points[np.random.default_rng(0).permutation(len(points))[:POINTS]]


def _measure(ref: SampleRef, other: SampleRef, kind: str, read: Any, pipe: Any, settings: Settings) -> Record:
    """Make one guided call, and return its messages and its error."""
    original = read(ref).check_ground_truth()
    made = KINDS[kind]
    sample = made.change(original, read(other))
    points = None if made.points is None else made.points * _points(original)
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
    said += [
        str(each) for each in out.findings if each.severity is not ASSUMPTION and each != verdict.summary
    ]
    errors = np.abs(depth_m[sample.valid] / sample.depth_m[sample.valid] - 1.0)
    off = None if kind == "swapped" else float(np.median(errors))  # the truth is the other image's there
    head |= {"codes": [reason.code for reason in verdict.reasons], "facts": verdict.facts.as_record()}
    head |= {"status": verdict.status, "said": said, "off": off}
    return head if off is None else head | _promise(sample, out, guidance, errors)


def _promise(
    sample: StereoSample, out: MetricDepthOutput, guidance: GeometryGuidance, errors: np.ndarray
) -> Record:
    """Compare predicted and observed accuracy; ``errors`` are relative to ground truth."""
    depth_m, confidence = out.prediction[0, ..., 0], out.confidence
    facts = out.verdict.facts
    errors_of = PoseUncertainty.scale_rel_std(facts), match_error(facts)
    expected_m = expected_error(depth_m, sample.K_left, used_poses(out, guidance), *errors_of)
    return {
        "abs_rel": float(errors.mean()),
        "kept": float((errors < RIGHT_WITHIN).mean()),
        "promised": None if confidence is None else float(confidence[0, ..., 0][sample.valid].mean()),
        "expected": float(np.median((expected_m / depth_m)[sample.valid])),
    }


def _share(group: Sequence[Record], *, reported: bool = True, off: bool = False) -> str:
    """Count records, or those whose depth is off, that have a message or are not trusted."""
    counted = [record for record in group if not off or record["off"] is None or record["off"] > OFF]
    part = sum(record["status"] != "trusted" or (reported and bool(record["said"])) for record in counted)
    return f"{part} of {len(counted)} ({100 * part // len(counted)} %)" if counted else "-"


def _median(group: Sequence[Record]) -> str:
    known = [record["off"] for record in group if record["off"] is not None]
    return f"{np.median(known):.2f}" if known else "-"


def _mean_of(name: str, group: Sequence[Record]) -> str:
    """Mean of what was measured against ground truth; an AbsRel above 10 counts as 10."""
    return tables.mean_cell((None if (x := r.get(name)) is None else min(x, 10.0) for r in group), 2)


_COLUMNS: dict[str, CellOf] = {
    "input": lambda group: KINDS[group[0]["kind"]].title,
    "median error": _median,
    "AbsRel": partial(_mean_of, "abs_rel"),
    "within 10 %": partial(_mean_of, "kept"),
    "confidence": partial(_mean_of, "promised"),
    "expected error": partial(_mean_of, "expected"),
    "not trusted": partial(_share, reported=False),
    "any message": _share,
    f"flagged, of errors > {OFF:.0%}": partial(_share, off=True),
}


def _table(source: str, records: Sequence[Record]) -> Table:
    """A row a kind, then all wrong ones, with and without those that two views cannot show."""
    pairs = count_of_pairs(len({record["sample"] for record in records}), f"{source} ")
    title = f"Wrong calibrations detected, correct ones not trusted: {pairs}"
    table = tables.table_of_groups(title, records, ("kind",), _COLUMNS, TRUST_NOTE)
    wrong = [record for record in records if record["kind"] in WRONG]
    # Rectified rows stay rows under any focal length.
    seen = [record for record in wrong if not (record["rectified"] and record["kind"].startswith("K-"))]
    sums = {"all wrong inputs": wrong, "all but focal lengths of rectified pairs": seen}
    empty = [""] * (len(_COLUMNS) - 2)
    more = ((name, *empty, _share(group, off=True)) for name, group in sums.items())
    return replace(table, rows=(*table.rows, *more))


def _real_and_rendered(options: TrustOptions) -> dict[str, list[SampleRef]]:
    """Return the first pairs of ``--data``, and ``--rendered`` rendered ones."""
    if options.data is None and not options.rendered:
        bad_value("--data", "set, or --rendered above 0", "neither")
    real = [] if options.data is None else some_pairs(find_pairs(options.data), options.data)
    of_size = f"synthetic:{options.rendered}@{options.width}x{options.width * 3 // 4}"
    rendered = find_pairs(of_size, ["synthetic"]) if options.rendered else []
    return {"real": real[: options.limit], "rendered": rendered}


def _cells(
    pairs: dict[str, list[SampleRef]], kinds: Sequence[str], settings: Settings, priors: PriorCache
) -> list[Item]:
    """A cell for every pair and kind; a pair that is alone has none of another scene."""
    read, cells = lru_cache(maxsize=2)(load), list[Item]()
    configuration = guided_configuration(GeometryGuidance, settings)
    pipe, prior = priors.get(settings), f"{settings.prior} {priors.fingerprint(settings)}"
    for source, refs in pairs.items():
        for ref, following in zip(refs, (*refs[1:], *refs[:1]), strict=True):
            for kind in kinds:
                unrelated = kind == "unrelated"
                if unrelated and len(refs) == 1:
                    continue
                beside = {"other": experiment.cell_key(following, "", {})} if unrelated else {}
                head = {"kind": kind, "group": source, "sample": ref.label}
                work = partial(_measure, ref, following if unrelated else ref, kind, read, pipe, settings)
                key = experiment.cell_key(ref, kind, configuration | beside, prior)
                cells.append(Item(key, work, name=f"{ref.label}, {kind}", head=head))
    return cells


def run(name: str, options: TrustOptions) -> Page | None:
    """Measure, write ``trust.jsonl`` and the table; errors as ``run_experiment``."""
    for kind in options.kinds:
        check_choice(kind, "--kinds", KINDS)
    asked = options.kinds or WRONG
    right = RIGHT if any(KINDS[kind].points for kind in asked) else RIGHT[:1]
    pairs = _real_and_rendered(options)
    if "unrelated" in options.kinds and any(len(refs) == 1 for refs in pairs.values()):
        bad_value("--kinds", "without 'unrelated' if there is only one pair", "it", "Give two pairs or more.")
    cells = _cells(pairs, tuple(dict.fromkeys((*right, *asked))), options.settings, PriorCache())

    def page_tables(records: list[Record]) -> list[Table]:
        return [_table(source, group) for source, group in tables.grouped(records, "group").items()]

    return run_experiment(name, options, Experiment("Trust", cells, page_tables))
