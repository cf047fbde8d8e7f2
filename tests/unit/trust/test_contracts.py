"""Properties of every check of ``CHECKS``. The test file of a new one lists its ``CASES`` of thresholds."""

import importlib
import json
import math
import pkgutil
import re
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import pytest

import geodiff_plugin.trust
from geodiff_plugin.findings import FINDINGS, GROUPS, Finding
from geodiff_plugin.trust import (
    CHECKS,
    KINDS,
    NO_ERROR,
    Agreement,
    Call,
    Check,
    Epipolar,
    FactSheet,
    KnownPoints,
    MatchedFraction,
    PoseUncertainty,
    confidence_factor,
    judge,
    match_error,
)
from geodiff_plugin.trust.depth_order import DepthOrder
from geodiff_plugin.trust.distortion import Distortion, ResidualDistortion
from geodiff_plugin.trust.epipolar import Residuals
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.identical_views import Difference, IdenticalViews
from geodiff_plugin.trust.known_points import Points
from geodiff_plugin.trust.length_units import Lengths, LengthUnits
from geodiff_plugin.trust.matched_fraction import Matched
from geodiff_plugin.trust.moving_objects import Moved, MovingObjects
from geodiff_plugin.trust.negative_disparity import Negative, NegativeDisparity
from geodiff_plugin.trust.occlusion_order import OcclusionOrder, Order
from geodiff_plugin.trust.order_ambiguity import Ambiguity, OrderAmbiguity
from geodiff_plugin.trust.pose_uncertainty import Uncertainty
from geodiff_plugin.trust.prior_correlation import Correlation, PriorCorrelation
from geodiff_plugin.trust.prior_scale import PriorScale, Ratio
from geodiff_plugin.trust.result_vs_matches import Deviation, ResultVsMatches
from geodiff_plugin.trust.rolling_shutter import RollingShutter, Shear
from geodiff_plugin.trust.search_edge import Edge
from geodiff_plugin.trust.search_range import Ends, SearchRange
from geodiff_plugin.trust.shifted_copy import DepthRange, ShiftedCopy
from tests.unit.trust.made_stages import made_result
from tests.unit.trust.sheets import Case, good, record_type, sheet

PAGE = Path(geodiff_plugin.trust.__file__).parents[2] / "docs" / "reference" / "messages.md"
EVERY = pytest.mark.parametrize("check", CHECKS, ids=[check.name() for check in CHECKS])


def status(facts: FactSheet) -> str:
    return judge(facts).status


def ruled_out(check: type[Check[Any]]) -> Callable[[FactSheet], bool]:
    """Whether few matches exclude the problem of a check."""
    return lambda facts: check.rules_out(facts[check])


def has_error(facts: FactSheet) -> bool:
    return match_error(facts) != NO_ERROR


def loses_confidence(facts: FactSheet) -> bool:
    return confidence_factor(facts) < 1.0


def misses(facts: FactSheet) -> bool:
    """Whether the given poses miss the matches by much."""
    return Epipolar.misses_by_px(facts) is not None


def counts_whole(facts: FactSheet) -> bool:
    """Whether more than a fraction of the change by another pose counts."""
    return (
        match_error(facts).relative
        > (PoseUncertainty.CHANGE_WEIGHT + 1e-9) * facts[PoseUncertainty].depth_change
    )


def residuals(
    used_px: float | None = 0.1, given_px: float | None = None, fit: str = "fits", warp_px: float = 0.0
) -> Residuals:
    return Residuals(fit, (given_px,), (used_px,), warp_px, 1.0, False, None, None)


def points(
    count: int = 99, cover: float = 0.5, ratio: float | None = 1.0, fraction_off: float = 0.0
) -> Points:
    return Points(count, 0, cover, ratio, fraction_off)


def compared(count: float) -> FactSheet:
    """Points twice as far as their matches, of which some are compared."""
    numbers = {"count": 99.0, "cover": 0.5, "ratio": 2.0, "off": 0.0, "compared": count}
    return good(KnownPoints.of_result(made_result(), numbers))


WHOLE = math.sqrt(1.0 - PoseUncertainty.CHANGE_WEIGHT**2)
#: Facts under which only the prior can be wrong about near and far, and a prior that is.
ORDER_KNOWN = Ambiguity(0.1), residuals(), Deviation(0.01), Matched(0.8, 0.85)
WRONG_PRIOR = Correlation(-0.9)

#: Check -> what changes at each of its thresholds.
CASES: dict[type[Check[Any]], list[Case]] = {
    IdenticalViews: [
        Case("MAX_DIFFERENCE", lambda x: good(Difference(x, 0.9)), ["views.identical"], []),
        Case("MAX_OF_CONTRAST", lambda x: good(Difference(0.05 * x, 0.05)), ["views.identical"], []),
    ],
    LengthUnits: [
        Case("MIN_BASELINE_M", lambda x: good(Lengths(False, x, 1.0)), ["baseline.short"], []),
        Case("SUSPECT_BASELINE_M", lambda x: good(Lengths(False, x, 400.0)), [], ["pose.unit"]),
        Case("FAR_SCENE_M", lambda x: good(Lengths(False, 10.0, x)), [], ["pose.unit"]),
        Case("FAR_SCENE_OF_RIG_M", lambda x: good(Lengths(True, 10.0, x)), [], ["pose.unit"]),
        Case("MAX_BASELINES_AWAY", lambda x: good(Lengths(False, 10.0, 10.0 * x)), ["pose.unit"], []),
    ],
    PriorScale: [
        Case("REMARKED_LOG_RATIO", lambda x: good(Ratio(math.exp(x))), [], ["prior.metres"]),
        Case("REMARKED_LOG_RATIO", lambda x: good(Ratio(math.exp(-x))), [], ["prior.metres"]),
        Case("MAX_LOG_RATIO", lambda x: good(Ratio(math.exp(x))), ["prior.metres"], ["prior.unit"]),
        Case("MAX_LOG_RATIO", lambda x: good(Ratio(math.exp(-x))), ["prior.metres"], ["prior.unit"]),
    ],
    ShiftedCopy: [
        Case("MAX_LOG_RATIO", lambda x: good(DepthRange(x, 1.0)), ["views.shifted"], []),
        Case("MAX_PLANES", lambda x: good(DepthRange(0.1, x)), ["views.shifted"], []),
    ],
    SearchRange: [
        Case("MAX_FRACTION", lambda x: good(Ends(x)), [], ["depth.range"]),
        Case("MANY", lambda x: good(Ends(x), Edge(True)), [], ["depth.search-edge"]),
    ],
    KnownPoints: [
        Case("MIN_POINTS", lambda x: good(points(x)), ["points.few"], []),
        Case("MIN_JUDGED", lambda x: sheet(points(x, ratio=None)), "not judged", "trusted", status),
        Case("MIN_COVER", lambda x: sheet(points(cover=x, ratio=None)), "not judged", "trusted", status),
        Case("MIN_COMPARED", compared, [], ["points.factor"]),
        Case("REMARKED_LOG_RATIO", lambda x: good(points(ratio=math.exp(x))), [], ["points.differ"]),
        Case("REMARKED_LOG_RATIO", lambda x: good(points(ratio=math.exp(x))), False, True, loses_confidence),
        Case(
            "MAX_LOG_RATIO",
            lambda x: good(points(ratio=math.exp(-x))),
            ["points.differ"],
            ["points.factor"],
        ),
        Case("REMARKED_OFF", lambda x: good(points(fraction_off=x)), [], ["points.some-contradict"]),
        Case(
            "MAX_OFF",
            lambda x: good(points(fraction_off=x)),
            ["points.some-contradict"],
            ["points.contradict"],
        ),
    ],
    PoseUncertainty: [
        Case("MAX_DEPTH_CHANGE", lambda x: good(Uncertainty(None, x, True)), [], ["pose.unconstrained"]),
        Case(
            "MAX_TOGETHER",
            lambda x: good(Uncertainty(0.1 * x * math.sqrt(0.5), 0.16 * x * math.sqrt(0.5), True)),
            [],
            ["pose.unconstrained"],
        ),
        # What is beyond it is as much as that fraction of a change that is larger by this factor.
        Case("USUAL_CHANGE", lambda x: sheet(Uncertainty(None, x / WHOLE, True)), False, True, counts_whole),
    ],
    ResultVsMatches: [
        Case("MAX_DEVIATION", lambda x: good(Deviation(x)), [], ["depth.off-matches"]),
        Case("FOLLOWS", lambda x: sheet(Deviation(x)), True, False, ResultVsMatches.follows),
    ],
    PriorCorrelation: [
        Case(
            "MIN_CORRELATION",
            lambda x: sheet(Correlation(x), points(ratio=None)),
            ["depth.order-points"],
            [],
        ),
        Case("CONFIRMS", lambda x: sheet(Correlation(x)), False, True, PriorCorrelation.confirms),
        Case("WEAK_ERROR", lambda x: good(Correlation(0.1, x), Matched(0.45, 0.85)), ["depth.order"], []),
        Case("MAX_WEAK_ERROR", lambda x: good(Correlation(0.1, x), Matched(0.45, 0.85)), [], ["depth.order"]),
    ],
    OrderAmbiguity: [
        Case(
            "MAX_EXCLUDED", lambda x: sheet(Ambiguity(x)), True, False, OrderAmbiguity.excludes_inverted_order
        ),
        Case(
            "MAX_EXCLUDED", lambda x: sheet(Ambiguity(x)), False, True, OrderAmbiguity.allows_inverted_order
        ),
        Case("MAX_RULED_OUT", lambda x: sheet(Ambiguity(x)), True, False, ruled_out(OrderAmbiguity)),
    ],
    OcclusionOrder: [
        Case("MIN_ORDER", lambda x: sheet(Order(x)), False, True, OcclusionOrder.near_occludes_far),
        Case(
            "MIN_ORDER",
            lambda x: good(Order(-x), Ambiguity(0.9), Correlation(0.44)),
            [],
            ["depth.occlusion"],
        ),
    ],
    DepthOrder: [
        Case("MAX_INVERTED_CORRELATION", lambda x: good(Correlation(x)), ["depth.inverted-order"], []),
        Case("MAX_INVERTED_CORRELATION", lambda x: good(*ORDER_KNOWN, Correlation(x)), ["prior.order"], []),
        Case(
            "MIN_CORRELATION",
            lambda x: good(Correlation(x), Matched(0.45, 0.85)),
            ["depth.order"],
            [],
        ),
        Case("MIN_LOG_RATIO", lambda x: good(WRONG_PRIOR, DepthRange(x, 9.0)), [], ["depth.inverted-order"]),
    ],
    NegativeDisparity: [
        Case("MAX_FRACTION", lambda x: good(Negative(x, 3.0)), [], ["depth.negative-disparity"]),
        Case("USUAL_FRACTION", lambda x: sheet(Negative(x, 3.0)), False, True, has_error),
        Case("MAX_RULED_OUT", lambda x: sheet(Negative(x, 3.0)), True, False, ruled_out(NegativeDisparity)),
    ],
    MovingObjects: [
        Case("MAX_FRACTION", lambda x: good(Moved(x)), [], ["views.moved"]),
        Case("MAX_RULED_OUT", lambda x: sheet(Moved(x)), True, False, ruled_out(MovingObjects)),
    ],
    RollingShutter: [
        Case("MAX_SHEAR", lambda x: good(Shear(x, 640)), [], ["views.rolling-shutter"]),
        Case("MAX_SHEAR", lambda x: good(Shear(-x, 640)), [], ["views.rolling-shutter"]),
        Case("USUAL_SHEAR", lambda x: sheet(Shear(x, 640)), False, True, has_error),
        Case("USUAL_SHEAR", lambda x: sheet(Shear(-x, 640)), False, True, has_error),
    ],
    Distortion: [
        Case("MAX_K1", lambda x: good(ResidualDistortion(x, x, 0.4)), [], ["views.distorted"]),
        Case("MAX_K1", lambda x: good(ResidualDistortion(-x, -x, 0.4)), [], ["views.distorted"]),
        Case(
            "MAX_K1",
            lambda x: good(ResidualDistortion(0.3, x, 0.4)),
            ["views.residual-trend"],
            ["views.distorted"],
        ),
        Case("USUAL_K1", lambda x: sheet(ResidualDistortion(x, x, 0.4)), False, True, has_error),
        Case("USUAL_K1", lambda x: sheet(ResidualDistortion(-x, -x, 0.4)), False, True, has_error),
        Case(
            "MAX_RULED_OUT",
            lambda x: sheet(ResidualDistortion(0.0, 0.0, x)),
            True,
            False,
            ruled_out(Distortion),
        ),
    ],
    Epipolar: [
        Case("WARNS_PX", lambda x: good(residuals(0.1, x, "refined")), [], ["pose.refined"]),
        Case("WARNS_PX", lambda x: good(residuals(0.1, x, "kept")), [], ["pose.kept"]),
        Case("MAX_REMARKED_PX", lambda x: good(residuals(x)), [], ["pose.residual"]),
        Case("MAX_PX", lambda x: good(residuals(x)), ["pose.residual"], ["pose.epipolar-error"]),
        Case("MAX_PX", lambda x: sheet(residuals(0.1, x)), False, True, misses),
        Case("WEAK_PX", lambda x: good(residuals(x), Correlation(0.44)), [], ["views.inconsistent"]),
        Case("WEAK_PX", lambda x: sheet(residuals(x)), True, False, Epipolar.is_good),
        Case("USUAL_PX", lambda x: sheet(Lengths(True, 0.1, 1.0), residuals(x)), False, True, has_error),
        Case("USUAL_WARP_PX", lambda x: sheet(residuals(None, warp_px=x)), False, True, has_error),
    ],
    MatchedFraction: [
        Case("MIN_VISIBLE", lambda x: good(Matched(0.8, 0.85, x)), ["views.overlap"], []),
        Case("WELL_MATCHED", lambda x: sheet(Matched(x)), False, True, MatchedFraction.well_matched),
    ],
    Agreement: [
        Case("MIN_MATCHED", lambda x: good(Matched(x, 0.85)), ["views.inconsistent"], []),
        Case("WEAK_MATCHED", lambda x: good(Matched(x, 0.52)), ["views.inconsistent"], []),
        Case("MIN_CONFIDENCE", lambda x: good(Matched(0.8, x)), ["views.inconsistent"], []),
        Case("WEAK_CONFIDENCE", lambda x: good(Matched(0.35, x)), ["views.inconsistent"], []),
        Case(
            "WEAK_CORRELATION", lambda x: good(Matched(0.8, 0.52), Correlation(x)), ["views.inconsistent"], []
        ),
    ],
    FieldOfView: [
        Case("MIN_DEGREES", lambda x: good(ViewAngle(x)), ["camera.unconfirmed-field-of-view"], []),
        Case("MAX_DEGREES", lambda x: good(ViewAngle(x)), [], ["camera.unconfirmed-field-of-view"]),
    ],
}


def thresholds(check: type[Check[Any]]) -> set[str]:
    """The numeric constants of a check; weights have no two sides."""
    return {
        name
        for name, value in vars(check).items()
        if name.isupper() and type(value) in (int, float) and not name.endswith("_WEIGHT")
    }


def cases_of(check: type[Check[Any]]) -> list[Case]:
    """The cases of a check: those of its test file, or of the table above."""
    module = importlib.import_module(f"tests.unit.trust.test_{check.name()}")
    return getattr(module, "CASES", CASES.get(check, []))


@EVERY
def test_each_threshold_of_a_check_has_a_case(check):
    assert {case.threshold for case in cases_of(check)} == thresholds(check)


EACH = [
    pytest.param(check, case, id=f"{check.name()} {case.threshold}")
    for check in CHECKS
    for case in cases_of(check)
]


@pytest.mark.parametrize(("check", "case"), EACH)
def test_the_answer_changes_at_a_threshold(check, case):
    """A whole number is a minimum: it is enough itself."""
    threshold = getattr(check, case.threshold)
    is_whole = isinstance(threshold, int)
    step = 1 if is_whole else 1e-6 * abs(threshold)
    below, above = case.facts(threshold - step), case.facts(threshold if is_whole else threshold + step)
    assert case.answer(below) == case.below and case.answer(above) == case.above


@pytest.mark.parametrize(("check", "case"), EACH)
def test_checks_make_only_findings_that_they_declare(check, case):
    for facts in (case.facts(getattr(check, case.threshold) + sign) for sign in (-1e-3, 1e-3)):
        for other in CHECKS:
            for finding in other.findings(facts, ()):
                assert finding.kind in other.kinds and len(finding) > 20, finding


def made(annotation: Any, number: int = 2) -> Any:
    """A value of an annotation of a record; no two numbers of it are alike."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType):
        return made(next(each for each in arguments if each is not NoneType), number)
    if origin is tuple:
        return tuple(made(arguments[0], number + k) for k in range(3))
    if is_dataclass(annotation):
        hints = get_type_hints(annotation)
        return annotation(
            **{f.name: made(hints[f.name], number + 3 * k) for k, f in enumerate(fields(annotation))}
        )
    plain = {float: number + 0.1, int: number, bool: True, str: f"word {number}"}
    assert annotation in plain, f"records hold plain data, not {annotation}"
    return plain[annotation]


def restored(annotation: Any, plain: Any) -> Any:
    """A value of an annotation from what JSON has of it."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if plain is None or annotation in (float, int, bool, str):
        return plain
    if origin in (Union, UnionType):
        return restored(next(each for each in arguments if each is not NoneType), plain)
    if origin is tuple:
        return tuple(restored(arguments[0], each) for each in plain)
    hints = get_type_hints(annotation)
    return annotation(**{name: restored(hints[name], value) for name, value in plain.items()})


def unknown(record: Any) -> Any:
    """The record without what may be unknown."""
    hints = get_type_hints(type(record))
    optional = {name for name, hint in hints.items() if NoneType in get_args(hint)}
    return type(record)(**{name: None if name in optional else getattr(record, name) for name in hints})


@pytest.mark.parametrize("check", [check for check in CHECKS if record_type(check) is not None])
def test_facts_come_back_from_json(check):
    record = made(record_type(check))
    for each in (record, unknown(record)):
        plain = json.loads(json.dumps(asdict(each), allow_nan=False))
        assert restored(type(each), plain) == each
        assert FactSheet({check: each}).as_record() == {check.name(): asdict(each)}


def entries() -> dict[str, list[str]]:
    """Code -> the cells of its row on the page of messages."""
    rows = re.findall(r"^\| `([a-z.-]+)` \| (.+) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    return {code: cells.split(" | ") for code, cells in rows}


@EVERY
def test_each_kind_of_finding_has_a_title_a_cause_a_hint_and_an_entry_on_the_page(check):
    page = entries()
    for kind in check.kinds:
        assert kind is KINDS[kind.code] and re.fullmatch(r"[a-z]+\.[a-z]+(-[a-z]+)*", kind.code)
        assert kind.code.partition(".")[0] in GROUPS
        assert kind.title and kind.cause.endswith(".") and kind.hint.endswith(".")
        title, cause, hint = page[kind.code]
        assert title.startswith(f"{kind.title}.") and (cause, hint) == (kind.cause, kind.hint)


def test_no_two_kinds_have_one_code_or_title():
    kinds = {kind for check in CHECKS for kind in check.kinds}  # two checks may make one kind of finding
    kinds |= set(FINDINGS.values())
    assert len({kind.code for kind in kinds}) == len({kind.title for kind in kinds}) == len(kinds)


@EVERY
def test_codes_that_a_check_explains_or_reviews_exist(check):
    for kind in check.kinds:
        assert set(kind.explains) <= {*KINDS, "*"} - {kind.code}, kind.code
    assert set(check.reviews) <= set(FINDINGS)


@EVERY
@pytest.mark.parametrize("call", [Call(), Call(has_unit=False, range_given=True)], ids=["usual", "other"])
def test_without_facts_a_check_finds_nothing_and_changes_nothing(check, call):
    facts = FactSheet(call=call)
    earlier = (Finding("camera.principal-point", "cx is far off."),)
    assert list(check.findings(facts, ())) == list(check.findings(facts, earlier)) == []
    assert check.match_error(facts) == NO_ERROR and check.confidence_factor(facts) == 1.0
    assert isinstance(check.rules_out(None), bool)


def defined_checks() -> set[type[Check[Any]]]:
    """The checks of all modules of the package, except of those that import Triton."""
    package = geodiff_plugin.trust
    names = [
        each.name for each in pkgutil.iter_modules(package.__path__) if not each.name.endswith("_kernels")
    ]
    modules = [importlib.import_module(f"{package.__name__}.{name}") for name in names]
    return {
        value
        for module in modules
        for value in vars(module).values()
        if isinstance(value, type) and issubclass(value, Check) and value.__module__ == module.__name__
    }


def test_every_check_is_registered_once_and_has_a_test_file():
    assert defined_checks() - {Check} == set(CHECKS) and len(set(CHECKS)) == len(CHECKS)
    assert len({check.name() for check in CHECKS}) == len(CHECKS)
    for check in CHECKS:
        assert (Path(__file__).parent / f"test_{check.name()}.py").is_file(), check
