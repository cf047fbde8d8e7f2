"""Phase 3 of one image: the map each stage gets, the spread of an ensemble, and every field of the result."""

import math
from dataclasses import FrozenInstanceError, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.algorithm.match_fitting import DepthFit
from geodiff_plugin.algorithm.member import Member
from geodiff_plugin.cameras import PosedViews, resized_mask
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.findings import Finding
from geodiff_plugin.matching import Matches, known_fraction
from geodiff_plugin.matching.rows import RowMatches
from geodiff_plugin.result import finish as module
from geodiff_plugin.result.confidence import data_support, depth_confidence, reprojection
from geodiff_plugin.result.expected_error import remaining_confidence
from geodiff_plugin.result.finish import ResultOptions, finish, refine
from geodiff_plugin.scale.points import order_agreement
from geodiff_plugin.scale.space import MetricMap
from geodiff_plugin.trust import (
    Call,
    FactSheet,
    KnownPoints,
    MatchedFraction,
    PosesStage,
    confidence_factor,
    match_error,
    measure,
)
from geodiff_plugin.trust.length_units import LengthUnits
from geodiff_plugin.trust.letterbox import Letterbox, LetterboxWidth
from geodiff_plugin.trust.prior_correlation import PriorCorrelation
from geodiff_plugin.trust.prior_scale import PriorScale
from geodiff_plugin.trust.search_edge import SearchEdge
from geodiff_plugin.trust.search_range import SearchRange
from geodiff_plugin.types import PoseReport
from tests.contracts.tiny_transformers import make_transformers
from tests.scenes import render_pair
from tests.views import view_of

END_TO_END = pytest.mark.end_to_end

NATIVE, GRID, PROCESSING, OUTPUT = (50, 64), (26, 40), (24, 32), (42, 60)
K = torch.tensor([[60.0, 0.5, 30.0], [0, 52.0, 26.0], [0, 0, 1]])


def resized(x: torch.Tensor, size, **options) -> torch.Tensor:
    return F.interpolate(x, size, mode="bilinear", align_corners=False, **options)


def true_depth(size) -> np.ndarray:
    v, u = np.mgrid[: size[0], : size[1]]
    y, x = (v + 0.5) / size[0], (u + 0.5) / size[1]
    return 3.0 + 1.5 * x + 0.8 * y - 1.2 * (x + 0.3 * y > 0.75)


def as_map(x: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(np.asarray(x))[None, None].float()


def member(seed: int, **changes) -> Member:
    """A prior's map that is roughly right, at another scale than those of other seeds."""
    rng = np.random.default_rng(seed)
    x = (true_depth(PROCESSING) - 2.5) / 3.0 + 0.03 * rng.normal(size=PROCESSING)
    metric = MetricMap("depth")
    near, far = 2.5 * (1 + 0.03 * seed), 5.5 * (1 - 0.02 * seed)
    affine = metric.from_range(torch.tensor([near]), torch.tensor([far]))
    depth = metric(as_map(x), affine)
    own_depth = depth * (0.7 + 0.1 * seed)
    own_depth[..., 0, :2] = torch.tensor([0.0, 0.2])  # a prior's nearest pixels may be at 0
    made = Member(
        metric,
        affine,
        as_map(x),
        depth.amin().view(1, 1, 1, 1),
        depth.amax().view(1, 1, 1, 1),
        as_map(rng.uniform(0.3, 1.0, PROCESSING)),
        torch.full((1, 1, 1, 1), 0.05 + 0.02 * seed),
        as_map(rng.random(PROCESSING) > 0.1) > 0,
        torch.tensor([0.5 + 0.1 * seed]),
        torch.tensor([seed == 2]),
        own_depth,
    )
    return replace(made, **changes)


def evidence_of(*, views: bool = True, far_m: float = 1e3, **parts) -> Evidence:
    """Matches that are nearly exact; two right views of other sizes and cameras."""
    rng = np.random.default_rng(5)
    inverse = np.exp(0.01 * rng.normal(size=GRID)) / true_depth(GRID)
    confidence = rng.random(GRID) * (rng.random(GRID) > 0.2)
    deviation = rng.uniform(0.5, 6.0, GRID)
    tensors = [torch.from_numpy(x)[None].float() for x in (inverse, confidence, deviation)]
    matches = Matches(tensors[0], tensors[1], torch.tensor(0.004), tensors[2])
    images = [torch.from_numpy(rng.random((3, *size))).float() for size in (NATIVE, NATIVE, (40, 58))]
    T = torch.eye(4).repeat(2, 1, 1)
    T[:, :3, 3] = torch.tensor([[-0.3, 0.02, 0.01], [0.4, -0.1, 0.05]])
    T[1, :3, :3] = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.05, 0.1], [0.05, 0, -0.02], [-0.1, 0.02, 0.0]])
    )
    rights = tuple(
        view_of(*each) for each in zip(images[1:], (K, 0.9 * K + 0.1 * torch.eye(3)), T, strict=True)
    )
    native = PosedViews(view_of(images[0], K), rights if views else ())
    volume = (
        SimpleNamespace(reach_m=(0.5, far_m), inverse_depth=torch.linspace(0.01, 1.0, 80)) if views else None
    )
    return replace(Evidence(native, native, volume, matches), **parts)


def points_of(factor: float = 1.0) -> Matches:
    """Known depths of every ninth pixel of a part of the image, ``factor`` times as far as they are."""
    known = np.zeros(GRID)
    known[1::3, 2:30:3] = 1.0
    inverse = known / true_depth(GRID) / factor
    tensors = [torch.from_numpy(x)[None].float() for x in (inverse, known)]
    return Matches(*tensors, torch.tensor(0.003))


def merged(members, size=OUTPUT, reduction=np.median) -> torch.Tensor:
    maps = torch.cat([resized(each.depth_m, size) for each in members]).numpy()
    return torch.from_numpy(reduction(maps, axis=0)[None])


MEMBERS = [member(0), member(1), member(2)]


@pytest.mark.parametrize("reduction", ["median", "mean"])
def test_the_spread_of_an_ensemble_is_that_of_the_results_of_its_members(reduction):
    """Each member finished alone, around the finished map of all."""
    evidence = evidence_of()
    options = ResultOptions(DEFAULT, reduction=reduction)
    of_all = merged(MEMBERS, reduction=getattr(np, reduction))
    found = finish(evidence, MEMBERS, of_all.clone(), torch.full_like(of_all, 9.0), options)
    alone = [
        finish(evidence, [each], resized(each.depth_m, OUTPUT), None, options).depth_m.numpy()
        for each in MEMBERS
    ]
    away = np.concatenate(alone) - found.depth_m.numpy()
    expected = np.median(np.abs(away), 0) if reduction == "median" else np.sqrt((away**2).mean(0))
    assert 0.001 < expected.mean() < 0.2
    np.testing.assert_allclose(found.uncertainty[0], expected, atol=2e-6)


def test_the_order_of_members_does_not_matter():
    order = [2, 0, 1]
    evidence, options = evidence_of(points=points_of()), ResultOptions(DEFAULT)
    spread = torch.ones(1, 1, *OUTPUT)
    one, other = (
        finish(evidence, members, merged(MEMBERS), spread, options)
        for members in (MEMBERS, [MEMBERS[i] for i in order])
    )
    for name in ("depth_m", "uncertainty", "confidence", "support", "relative", "prior_error"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-4, atol=1e-5)
    for name in ("scale", "shift", "global_scale", "over_prior"):
        torch.testing.assert_close(getattr(one, name)[order], getattr(other, name))
    correlations = [each.verdict.facts[PriorCorrelation].rank_correlation for each in (one, other)]
    assert correlations[0] == pytest.approx(correlations[1])


@pytest.mark.parametrize(("far_m", "ratio"), [(1e3, 1.0), (4.2, 1.15)])
def test_every_field_is_made_of_its_own_stage(far_m, ratio):
    """With points that contradict matches, a pose that does not fit, and depth beyond the cameras' reach."""
    report = PoseReport("refined", (), (), residual_px=(1.2,), residual_px_given=(3.0,), scale_rel_std=0.05)
    of_poses = measure(PosesStage(report, None, np.eye(4)[None], NATIVE))
    evidence = evidence_of(far_m=far_m, points=points_of(ratio), report=report, points_outside=4)
    evidence = replace(evidence, facts=of_poses | FactSheet({Letterbox: LetterboxWidth(0.1)}))
    doubt = Finding("calibration.assumed-metres", "Metres?")
    options = ResultOptions(DEFAULT, call=Call(findings=(doubt,)))
    found = finish(evidence, MEMBERS, merged(MEMBERS), torch.ones(1, 1, *OUTPUT), options)
    left = resized(evidence.native.left.image_01[None], OUTPUT, antialias=True)
    of_all = refine(evidence, MEMBERS, merged(MEMBERS), left, DEFAULT)
    torch.testing.assert_close(found.depth_m, of_all.depth_m.clamp(max=far_m), rtol=1e-5, atol=0)
    scale = torch.tensor([OUTPUT[1] / NATIVE[1], OUTPUT[0] / NATIVE[0], 1.0])
    expected_K = scale[:, None] * K
    expected_K[:2, 2] += 0.5 * scale[:2] - 0.5
    assert found.camera.size == OUTPUT[::-1]
    np.testing.assert_allclose(found.camera.K, expected_K, rtol=1e-6)
    relative = np.median(torch.cat([each.relative for each in MEMBERS]).numpy(), 0)[None]
    torch.testing.assert_close(found.relative, resized(torch.from_numpy(relative), OUTPUT))
    for name, number in (("scale", "scale"), ("shift", "shift"), ("global_scale", "g_s")):
        expected = torch.cat([getattr(each.affine, number) for each in MEMBERS])
        assert torch.equal(getattr(found, name), expected)
    errors = torch.stack([each.error for each in MEMBERS]).mean(0)
    valid = torch.cat([each.valid for each in MEMBERS]).any(0)[None]
    torch.testing.assert_close(found.prior_error, torch.where(valid, errors, 0.5))
    torch.testing.assert_close(found.support, of_all.support)
    left_view = evidence.native.left.resized(OUTPUT)
    visible, error = reprojection(evidence.native.rights, found.depth_m, left_view)
    assert torch.equal(found.visible, visible) and torch.equal(found.photometric_error, error)
    seen = found.verdict.facts
    fraction = seen[MatchedFraction].visible
    assert fraction == pytest.approx(float(visible.float().mean())) and 0.3 < fraction < 1
    over = resized(found.depth_m, PROCESSING) / torch.cat([each.prior_depth_m for each in MEMBERS]).clamp_min(
        1e-6
    )
    torch.testing.assert_close(found.over_prior, over.flatten(1))
    before = depth_confidence(of_all.features, found.uncertainty / found.depth_m, found.prior_error)
    error, factor = match_error(seen), confidence_factor(seen)
    kept = factor * (found.depth_m < far_m)
    kept = kept * remaining_confidence(found.depth_m, found.camera, evidence.native.rights, error)
    assert error.px > 0.5 and error.relative > 0 and (factor < 1) == (ratio > 1.1)
    assert ((found.confidence == 0).any() and (found.depth_m == far_m).any()) == (far_m == 4.2)
    torch.testing.assert_close(found.confidence, before * kept, rtol=1e-4, atol=1e-6)
    assert seen[MatchedFraction].confidence == pytest.approx(float(before.mean()), rel=1e-5)
    assert seen[PriorCorrelation].rank_correlation == pytest.approx(0.6) and seen[SearchEdge].on_edge
    assert seen[PriorScale].ratio == pytest.approx(float(np.quantile(over, 0.5, method="lower")))
    assert seen.call is options.call and doubt in found.verdict.reasons
    assert (seen[KnownPoints].count, seen[KnownPoints].outside) == (90, 4)
    for check in (*of_poses.as_record(), Letterbox.name()):
        assert seen.as_record()[check] == evidence.facts.as_record()[check], "the facts of phase 1 are kept"
    assert found.evidence is evidence and len({found}) == 1
    for record, field in ((found, "depth_m"), (options, "config")):
        with pytest.raises(FrozenInstanceError):
            setattr(record, field, None)


def test_numbers_that_no_member_has_stay_unknown():
    nothing = {
        "rank_correlation": torch.tensor([math.nan]),
        "on_edge": None,
        "prior_depth_m": None,
        "error": None,
    }
    found = finish(evidence_of(), [member(1, **nothing)], merged(MEMBERS), None, ResultOptions(DEFAULT))
    seen = found.verdict.facts
    assert seen[PriorCorrelation] is seen[PriorScale] is seen[SearchEdge] is None
    assert seen[MatchedFraction].confidence is None
    assert (
        found.over_prior
        is found.prior_error
        is found.confidence
        is found.support
        is found.uncertainty
        is None
    )
    two = [member(0, rank_correlation=torch.tensor([math.nan])), member(1, on_edge=torch.tensor([False]))]
    two[0] = replace(two[0], prior_depth_m=None)
    seen = finish(evidence_of(), two, merged(two), None, ResultOptions(DEFAULT)).verdict.facts
    assert seen[PriorCorrelation].rank_correlation == pytest.approx(0.6)
    assert seen[PriorScale] is None and not seen[SearchEdge].on_edge


def test_a_prior_that_is_wrong_outside_of_the_mask_does_not_change_its_ratio():
    valid = torch.zeros(NATIVE, dtype=torch.bool)
    valid[:, : NATIVE[1] // 3] = True
    evidence = evidence_of()
    masked = replace(
        evidence, native=evidence.native._replace(left=evidence.native.left._replace(valid=valid))
    )
    inside = resized_mask(resized_mask(valid, OUTPUT), PROCESSING)
    wrong = [
        replace(each, prior_depth_m=torch.where(inside, each.prior_depth_m, 50 * each.prior_depth_m))
        for each in MEMBERS
    ]
    plain, found = (
        finish(masked, each, merged(MEMBERS), None, ResultOptions(DEFAULT)) for each in (MEMBERS, wrong)
    )
    torch.testing.assert_close(found.over_prior, plain.over_prior, equal_nan=True)
    assert torch.equal(found.over_prior.isnan(), ~inside.flatten().expand(len(MEMBERS), -1))
    assert found.verdict.facts[PriorScale] == plain.verdict.facts[PriorScale]
    unmasked = finish(evidence, wrong, merged(MEMBERS), None, ResultOptions(DEFAULT))
    assert unmasked.verdict.facts[PriorScale].ratio < 0.1 * plain.verdict.facts[PriorScale].ratio


def test_without_a_unit_the_priors_metres_do_not_judge():
    for has_unit in (True, False):
        options = ResultOptions(DEFAULT, call=Call(has_unit=has_unit))
        found = finish(evidence_of(), MEMBERS, merged(MEMBERS), None, options)
        seen = found.verdict.facts
        assert (seen[PriorScale] is not None) is (seen[LengthUnits].baseline_m is not None) is has_unit
        assert found.over_prior is not None


@pytest.mark.parametrize("config", [DEFAULT, DEFAULT.changed(refine_edges=False)])
def test_without_matches_and_points_the_members_map_stays(config):
    """Clamped to what the members reach; no view sees anything, and nothing is judged."""
    evidence = evidence_of(views=False, matches=None)
    given = merged(MEMBERS)
    given[..., 0], given[..., 1] = 0.1, 99.0
    found = finish(evidence, MEMBERS, given.clone(), torch.full((1, 1, *OUTPUT), 0.3), ResultOptions(config))
    near, far = (
        float(f([getattr(each, n) for each in MEMBERS])) for f, n in ((min, "near_m"), (max, "far_m"))
    )
    torch.testing.assert_close(found.depth_m, given.clamp(near, far))
    assert (found.uncertainty == 0.3).all() and found.verdict.facts[MatchedFraction] is None
    assert found.visible is found.photometric_error is found.confidence is found.support is None
    assert found.verdict.status == "not judged"


@pytest.mark.parametrize("reduction", ["median", "mean"])
@pytest.mark.parametrize("even", ["mean", "lower"])
@pytest.mark.parametrize("resampling", ["bilinear", "nearest", "bicubic"])
def test_members_are_reduced_at_the_size_of_the_image_if_that_is_asked_for(reduction, even, resampling):
    """Of an even number, each within its own range; resized without antialiasing, as the stock call does."""
    members = [*MEMBERS, member(3)]
    config = DEFAULT.changed(ensemble_at="image", even_ensemble=even, refine_edges=False)
    options = ResultOptions(config, resampling=resampling, reduction=reduction)
    evidence, given = evidence_of(views=False, matches=None), torch.full((1, 1, 20, 60), 4.0)
    align = {} if resampling == "nearest" else {"align_corners": False}
    maps = []
    for each in members:
        large = F.interpolate(each.depth_m, (20, 60), mode=resampling, **align)
        maps.append(large.clamp(float(each.near_m), float(each.far_m)).numpy())
    maps = np.concatenate(maps)
    middle = (
        maps.mean(0)
        if reduction == "mean"
        else np.quantile(maps, 0.5, 0, method="lower" if even == "lower" else "linear")
    )
    away = np.abs(maps - middle)
    spread = np.sqrt((away**2).mean(0)) if reduction == "mean" else np.median(away, 0)
    found = finish(evidence, members, given.clone(), torch.ones_like(given), options)
    np.testing.assert_allclose(found.depth_m[0], middle, rtol=1e-5)
    np.testing.assert_allclose(found.uncertainty[0], spread, atol=1e-5)
    assert finish(evidence, members, given.clone(), None, options).uncertainty is None
    single = finish(evidence, members[:1], given.clone(), torch.ones_like(given), options)
    assert (single.depth_m == 4.0).all() and (single.uncertainty == 1.0).all()


@pytest.mark.parametrize(
    ("reach_m", "depth_range", "farthest_m"),
    [(4.0, None, 4.0), (3.9, (1.0, 4.2), 4.2), (4.2, (1.0, 3.0), 4.2)],
)
def test_depth_ends_where_the_cameras_or_the_stated_range_do(reach_m, depth_range, farthest_m):
    config = DEFAULT.changed(depth_range=depth_range)
    volume = SimpleNamespace(reach_m=(0.5, reach_m), inverse_depth=torch.linspace(0.24, 0.3, 16))
    evidence = evidence_of(volume=volume)
    call = Call(range_given=depth_range is not None)
    found = finish(evidence, MEMBERS, merged(MEMBERS), None, ResultOptions(config, call=call))
    inverse = evidence.matches.inverse_depth[evidence.matches.confidence > 0.5]
    at_end = ((inverse - 0.24).abs() < 0.003) | ((inverse - 0.3).abs() < 0.003)
    ends = found.verdict.facts[SearchRange]
    assert at_end.any() and (ends is None) is (depth_range is None)
    assert ends is None or ends.fraction == pytest.approx(float(at_end.float().mean()))
    assert float(found.depth_m.max()) == pytest.approx(farthest_m)
    assert torch.equal(found.confidence == 0, found.depth_m == found.depth_m.max())


def rows_of(rng) -> RowMatches:
    """Rows on a grid of their own, with a few hidden strips."""
    size = (33, 48)
    shift = rng.uniform(1.0, 5.0, size)
    occluded = rng.random(size) < 0.3
    layers = [torch.from_numpy(np.asarray(x, np.float32)) for x in (shift, ~occluded, occluded, 0 * shift)]
    return RowMatches(*layers, torch.tensor(0.25))


@pytest.fixture
def stages(monkeypatch):
    """Every stage of ``refine`` notes what it is given, and gives a map of its own."""
    calls, maps = {}, iter(torch.rand(9, 1, 1, *OUTPUT, generator=torch.Generator().manual_seed(0)) + 1.0)

    def stage(name, made=None):
        def called(*given):
            value = made(*given) if made else next(maps)
            calls.setdefault(name, []).append((given, value))
            return value

        return called

    targets = iter(
        [Matches(*torch.rand(2, 1, 1, *GRID), torch.tensor([0.1]), torch.ones(1, 1, *GRID)) for _ in range(2)]
    )
    made = {
        "sharpen_edges": None,
        "filter_depth": None,
        "flatten": None,
        "fit_target": lambda *_: next(targets),
        "fit_depth": lambda *_: DepthFit(next(maps), next(maps), next(maps)),
        "features_of": lambda *_: "grounds",
        "with_occluded": lambda target, strips: replace(target, confidence=0.5 * target.confidence),
    }
    for name, value in made.items():
        monkeypatch.setattr(module, name, stage(name, value))
    return calls


@pytest.mark.parametrize("has_rows", [True, False])
def test_each_stage_works_on_what_the_stage_before_it_made(stages, has_rows):
    rows = rows_of(np.random.default_rng(7)) if has_rows else None
    evidence = evidence_of(points=points_of(), rows=rows)
    left, denoised = torch.rand(1, 3, *OUTPUT), merged(MEMBERS)
    found = refine(evidence, MEMBERS, denoised, left, DEFAULT)
    ((sharpening, sharp),) = stages["sharpen_edges"]
    assert sharpening[0] is denoised and sharpening[1] is left and sharpening[2] == 2  # 60 px of 32
    (first, target), (second, last_target) = stages["fit_target"]
    weights = torch.cat([each.match_weight for each in MEMBERS]).mean(0, keepdim=True)
    error = torch.stack([each.error for each in MEMBERS]).mean(0)
    valid = torch.cat([each.valid for each in MEMBERS]).any(0)[None]
    local = torch.where(valid, error, 0.5)
    ((fitting, fit),) = stages["fit_depth"]
    for given, depth in ((first, sharp), (second, fit.depth_m)):
        assert torch.equal(given[0].confidence[0], evidence.matches.confidence)
        assert torch.equal(given[1].confidence[0], evidence.points.confidence)
        torch.testing.assert_close(given[2], weights)
        torch.testing.assert_close(given[3], local)
        assert given[4] is depth
    occluded = stages.get("with_occluded", [])
    assert [each[0][0] for each in occluded] == ([target, last_target] if has_rows else [])
    completed = [each[1] for each in occluded] or [target, last_target]
    assert fitting[0] is sharp and fitting[1] is completed[0] and fitting[4] is DEFAULT
    assert torch.equal(fitting[2][0], evidence.native.left.image_01)
    torch.testing.assert_close(fitting[3], local)
    ((voting, voted),) = stages["filter_depth"]
    known = known_fraction(completed[1])
    assert voting[0] is fit.depth_m and voting[1] is evidence and voting[2] is completed[1]
    torch.testing.assert_close(voting[3], known)
    torch.testing.assert_close(voting[4], error)
    assert voting[5] == 60 / 32
    ((flattening, flat),) = stages["flatten"]
    assert flattening[0] is voted and flattening[1] is completed[1] and flattening[2] is left
    torch.testing.assert_close(flattening[3], error)
    assert flattening[4] is denoised
    (((*features, support), _),) = stages["features_of"]
    assert features[0] is denoised and features[1] is flat and features[2] is last_target
    assert support is fit.support and found.depth_m is flat and found.features == "grounds"
    torch.testing.assert_close(found.support, fit.support * data_support(known, OUTPUT))
    if has_rows:
        strips = occluded[0][0][1]
        inverse = rows.shift / (60.0 * 48 / 64 * 0.25)
        torch.testing.assert_close(
            strips.inverse_depth, F.interpolate(inverse[None, None], GRID, mode="nearest-exact")
        )
        inside = F.interpolate(rows.occluded[None, None], GRID, mode="nearest-exact") > 0
        assert torch.equal(strips.inside, inside)


def test_points_alone_are_fitted_to_and_nothing_is_voted_on(stages):
    rows = rows_of(np.random.default_rng(7))
    evidence = evidence_of(matches=None, points=points_of(), rows=rows)
    found = refine(evidence, MEMBERS, merged(MEMBERS), torch.rand(1, 3, *OUTPUT), DEFAULT)
    assert stages.keys() == {"sharpen_edges", "fit_target", "fit_depth", "features_of"}
    ((given, target),) = stages["fit_target"]
    assert given[0] is None
    ((_, fit),) = stages["fit_depth"]
    assert found.depth_m is fit.depth_m and found.support is fit.support
    assert stages["features_of"][0][0][2] is target
    assert (
        refine(evidence_of(matches=None), MEMBERS, merged(MEMBERS), torch.rand(1, 3, *OUTPUT), DEFAULT)
        is None
    )
    unmeasured = [replace(each, error=None) for each in MEMBERS]
    assert refine(evidence, unmeasured, merged(MEMBERS), torch.rand(1, 3, *OUTPUT), DEFAULT) is None


@pytest.mark.parametrize("has_volume", [True, False])
def test_a_run_without_matches_is_judged_by_matches_made_for_that(monkeypatch, has_volume):
    """Its rank correlation is then that of the median map; points are not counted twice."""
    whole = evidence_of()
    asked = {}
    volume = whole.volume if has_volume else None
    made = SimpleNamespace(reach_m=(0.5, 90.0), inverse_depth=torch.linspace(0.01, 1.0, 80))

    def build(native, **given):
        asked.update(given, native=native)
        return made

    monkeypatch.setattr(module, "build_cost_volume", build)
    monkeypatch.setattr(module, "match_volume", lambda of: asked.update(volume=of) or whole.matches)
    config = DEFAULT.changed(depth_range=(0.8, 90.0), refine_edges=False)
    evidence = replace(whole, volume=volume, matches=None, points=points_of(), points_outside=3)
    found = finish(evidence, MEMBERS, merged(MEMBERS), None, ResultOptions(config))
    seen = found.verdict.facts
    assert asked["volume"] is (volume or made)
    if not has_volume:
        assert asked["native"] is evidence.native
        assert asked["depth_range"] == (0.8, 90.0) and asked["config"] is config
    relative = np.median(torch.cat([each.relative for each in MEMBERS]).numpy(), 0)[None]
    correlation = order_agreement(torch.from_numpy(relative), whole.matches, "depth")
    measured = seen[PriorCorrelation].rank_correlation
    assert measured == pytest.approx(float(correlation)) and measured > 0.8
    matched = float((whole.matches.confidence > 0.5).float().mean())
    assert seen[MatchedFraction].matched == pytest.approx(matched)
    assert seen[KnownPoints].count == 0 and found.evidence is evidence
    assert [finding.code for finding in found.verdict.findings] == ["points.outside"]


def test_views_that_do_not_overlap_are_not_judged(monkeypatch):
    def raise_input_error(*_, **__):
        raise InputError("the views do not overlap")

    monkeypatch.setattr(module, "build_cost_volume", raise_input_error)
    evidence = replace(evidence_of(), volume=None, matches=None, points=points_of())
    found = finish(
        evidence, MEMBERS, merged(MEMBERS), None, ResultOptions(DEFAULT.changed(refine_edges=False))
    )
    seen = found.verdict.facts
    assert not MatchedFraction.has_matches(seen)
    assert seen[PriorCorrelation].rank_correlation == pytest.approx(0.6)
    assert seen[KnownPoints].count == int((points_of().confidence > 0).sum()) == 90


FAST = {"guidance_steps": 1, "min_steps": 1}


def knowing(kind, depth_m, factor=1.0):
    """A model that returns ground truth, in its own unit, times a factor; for a prompt, the prompt."""
    pipe, answer = make_transformers(kind), torch.from_numpy(depth_m)[None] * factor

    def forward(pixel_values, prompt_depth=None):
        values, fov = answer, {}
        if kind == "depth_pro":
            values, fov = 1 / answer, {"field_of_view": torch.tensor([2 * np.degrees(np.arctan(0.5))])}
        elif prompt_depth is not None:
            values = torch.nn.functional.interpolate(prompt_depth, answer.shape[1:], mode="bilinear")[:, 0]
        return type("Output", (), {"predicted_depth": values, **fov})()

    pipe.model.forward = forward
    return enable_geometry_guidance(pipe)


def guided(pipe, pair, **parameters):
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **FAST | parameters)
    return pipe(Image.fromarray(pair.left), guidance=guidance, processing_resolution=64)


@END_TO_END
@pytest.mark.parametrize("kind", ["zoedepth", "glpn", "tipsv2", "depth_pro"])
def test_a_run_reports_the_deviation_of_the_priors_metres(kind, textured_plane):
    out = guided(knowing(kind, textured_plane.depth_m, factor=0.5), textured_plane)
    assert out.prior_scale.shape == (1, 1) and float(out.prior_scale) == pytest.approx(2.0, rel=0.02)
    assert any("2 times the metric prior's depth" in sentence for sentence in out.findings)
    assert np.median(out.prediction[0, ..., 0] / textured_plane.depth_m) == pytest.approx(1.0, rel=0.01)


@END_TO_END
def test_prompt_depth_anything_is_given_what_is_known_unless_it_is_given_depths(textured_plane):
    pipe = knowing("prompt_depth_anything", textured_plane.depth_m)
    out = guided(pipe, textured_plane)
    assert float(out.prior_scale) == pytest.approx(1.0, abs=0.01)  # its map is in metres with a prompt
    call = {"image": Image.fromarray(textured_plane.left), "processing_resolution": 64}
    pipe(**call)
    assert pipe.metric_range is None  # without guidance it is a relative prior
    own = torch.linspace(7.0, 9.0, 24).view(1, 1, 4, 6)
    pipe(**call, prompt_depth=own)
    assert pipe.metric_range[0].tolist() == pytest.approx([7.0, 9.0], abs=0.1)
    with pytest.raises(ValueError, match="prompt_depth"):
        make_transformers("zoedepth")(**call, prompt_depth=own)


@END_TO_END
def test_without_a_length_the_metres_are_those_of_a_metric_prior():
    """An estimated pose has no unit; the prior knows the depth in metres, so everything is in metres."""
    pytest.importorskip("poselib")
    pair = render_pair(0, posed=True)  # 8 degrees of parallax, so that the estimated pose is accurate
    depth_m, E = pair.left.depth_m[0].numpy(), pair.E.numpy()
    left, right = (
        np.rint(v.image_01.permute(1, 2, 0).numpy() * 255).astype(np.uint8) for v in (pair.left, pair.right)
    )
    runs = {}
    for kind in ("zoedepth", "depth_anything"):
        guidance = GeometryGuidance.from_unposed_images(left, right, K=pair.K_left.numpy(), **FAST)
        call = {"guidance": guidance, "processing_resolution": 64}
        runs[kind] = knowing(kind, depth_m)(Image.fromarray(left), **call)
    metric, relative = runs["zoedepth"], runs["depth_anything"]
    baseline = float(np.linalg.norm(E[:3, 3]))
    assert metric.unit == "m" and metric.scale_from == "prior" and 0 < metric.scale_rel_std < 0.1
    assert metric.rescaled == pytest.approx(baseline, rel=0.03)
    assert np.median(metric.prediction[0, ..., 0] / depth_m) == pytest.approx(1.0, rel=0.025)
    assert np.linalg.norm(metric.poses[0].E[0][:3, 3]) == pytest.approx(metric.rescaled, rel=1e-5)
    assert float(metric.prior_scale) == pytest.approx(1.0, rel=1e-5)
    assert any("scale is the metric prior's" in sentence for sentence in metric.findings)
    assert not any("no unit" in sentence for sentence in metric.findings)
    assert relative.unit is None and relative.scale_from == "none" and relative.rescaled == 1.0
    assert any("no unit" in sentence for sentence in relative.findings)


@END_TO_END
def test_given_poses_without_a_unit_get_the_metres_of_a_metric_prior(textured_plane):
    scaled = textured_plane.E.copy()
    scaled[:3, 3] *= 0.001 / np.linalg.norm(scaled[:3, 3])  # as a model of COLMAP might have it
    pair = replace(textured_plane, E=scaled)
    metric, relative = (
        guided(knowing(kind, pair.depth_m), pair, unit=None) for kind in ("zoedepth", "depth_anything")
    )
    assert metric.unit == "m" and metric.scale_from == "prior"
    assert np.median(metric.prediction[0, ..., 0] / pair.depth_m) == pytest.approx(1.0, rel=0.03)
    assert sum("scale is the metric prior's" in sentence for sentence in metric.findings) == 1
    assert relative.unit is None and not any(" mm" in sentence for sentence in relative.findings)
