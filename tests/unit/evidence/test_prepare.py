"""From a left image to its evidence: which views each stage gets, and when poses are refined."""

from dataclasses import FrozenInstanceError, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._checks import InputError
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence import prepare as module
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.prepare import cleaned, make_evidence, prepare_evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.pose.mistakes import INVERSE
from geodiff_plugin.pose.refine import CheckedViews
from geodiff_plugin.types import CameraView, PosedViews, PoseReport

SIZE, GRID = (36, 48), (18, 30)
LEFT, *RIGHTS = torch.rand(3, 3, *SIZE, generator=torch.Generator().manual_seed(0))
K = np.array([[50.0, 0, 23.5], [0, 45.0, 17.5], [0, 0, 1]])
POINTS = torch.rand(9, 3, generator=torch.Generator().manual_seed(1)) + 1.0


def view(v: int, centre: float) -> CameraView:
    T = torch.eye(4)
    T[0, 3] = -centre
    return CameraView(RIGHTS[v], torch.from_numpy((1 + v) * K).float(), T)


VIEWS = view(0, 0.1), view(1, 0.3)
GIVEN = Inputs(K, VIEWS, (), POINTS)


def same_views(found: PosedViews, views, left=LEFT) -> bool:
    pairs = zip(found.views, views, strict=True)
    return torch.equal(found.left_01, left) and all(
        all(torch.equal(a, b) for a, b in zip(one, other, strict=True)) for one, other in pairs
    )


def test_images_are_cleaned_to_the_pixels_of_the_sweep_if_that_is_set(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "clean", lambda images, pixels: asked.append((images, pixels)) or "clean")
    images = [LEFT, *RIGHTS]
    assert cleaned(images, DEFAULT.changed(sweep_pixels=77_777)) == "clean" and asked == [(images, 77_777)]
    assert cleaned(images, DEFAULT.changed(clean_photographs=False)) is images and len(asked) == 1


def test_clean_images_take_the_places_of_theirs_and_cameras_stay(monkeypatch):
    monkeypatch.setattr(
        module, "clean", lambda images, pixels: [image + 1 + i for i, image in enumerate(images)]
    )
    posed = PosedViews(LEFT, VIEWS, torch.from_numpy(K).float())
    found = module._with_clean_images(posed, DEFAULT)
    assert torch.equal(found.left_01, LEFT + 1) and found.K_left is posed.K_left
    for v, (one, other) in enumerate(zip(found.views, VIEWS, strict=True)):
        assert torch.equal(one.image_01, RIGHTS[v] + 2 + v)
        assert one.K is other.K and one.T_right_from_left is other.T_right_from_left
    for changed in range(3):
        monkeypatch.setattr(
            module,
            "clean",
            lambda images, pixels, changed=changed: [
                x + 1 if i == changed else x for i, x in enumerate(images)
            ],
        )
        assert module._with_clean_images(posed, DEFAULT) is not posed
    monkeypatch.setattr(module, "clean", lambda images, pixels: list(images))
    assert module._with_clean_images(posed, DEFAULT) is posed


@pytest.fixture
def stages(monkeypatch):
    """Stages that note what they get: cleaning adds .01 to images, refining moves each view."""
    calls = SimpleNamespace(prepared=[], refined=[], greys=[], fits=True, surely=True, moved=True, fails=0)

    def prepared(native, points, config):
        calls.prepared.append((native, points, config))
        if len(calls.prepared) <= calls.fails:
            raise InputError("the views do not overlap")
        return Evidence(native, native, None, None)

    def refined(posed, fit, measured):
        calls.refined.append((posed, fit, measured))
        moved = tuple(view._replace(T_right_from_left=view.T_right_from_left + 0.5) for view in posed.views)
        return CheckedViews(moved if calls.moved else posed.views, "report")

    def greys(posed):
        calls.greys.append(posed)
        return SimpleNamespace(signs=None, posed=posed)

    def fit(given, small=None):
        return SimpleNamespace(fits=calls.fits, greys=given, small=small)

    monkeypatch.setattr(module, "prepare_evidence", prepared)
    monkeypatch.setattr(module, "refine_views", refined)
    monkeypatch.setattr(module, "posed_greys", greys)
    monkeypatch.setattr(module, "measure_fit", fit)
    monkeypatch.setattr(
        module, "fit_of_small", lambda given: SimpleNamespace(surely=calls.surely, greys=given)
    )
    monkeypatch.setattr(module, "clean", lambda images, pixels: [image + 0.01 for image in images])
    return calls


@pytest.mark.parametrize("measured", [True, False])
def test_poses_are_refined_by_clean_images_before_anything_is_matched(stages, measured):
    found = make_evidence(LEFT, GIVEN, DEFAULT, measured)
    ((posed, fit, told),) = stages.refined
    ((native, points, config),) = stages.prepared
    clear = [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS]
    assert same_views(posed, clear, LEFT + 0.01) and told is measured
    assert fit.greys.posed is posed and stages.greys == [posed]
    moved = [each._replace(T_right_from_left=each.T_right_from_left + 0.5) for each in clear]
    assert same_views(native, moved, LEFT + 0.01) and found.native is native
    assert torch.equal(points, POINTS) and config is DEFAULT and found.report.result() == "report"
    np.testing.assert_allclose(native.K_left, K, rtol=1e-6)
    make_evidence(LEFT, GIVEN, DEFAULT)
    assert stages.refined[-1][2] is False


def test_given_poses_are_neither_checked_nor_changed(stages):
    found = make_evidence(LEFT, GIVEN, DEFAULT.changed(pose="given"), True)
    ((native, _, _),) = stages.prepared
    assert stages.refined == stages.greys == []
    assert same_views(native, [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS], LEFT + 0.01)
    report = found.report.result()
    assert isinstance(report, PoseReport) and report.status == "given"
    for E, E_given, each in zip(report.E, report.E_given, VIEWS, strict=True):
        np.testing.assert_allclose(E, np.linalg.inv(each.T_right_from_left), atol=1e-6)
        np.testing.assert_allclose(E_given, E)


@pytest.mark.parametrize("pose", ["given", "auto"])
def test_without_a_right_view_the_image_is_used_as_it_is(stages, pose):
    config = DEFAULT if pose == "auto" else DEFAULT.changed(pose=pose)
    found = make_evidence(LEFT, replace(GIVEN, views=()), config)
    ((native, points, _),) = stages.prepared
    assert native.left_01 is LEFT and native.views == () and torch.equal(points, POINTS)
    assert found.report is None and stages.refined == []


@pytest.fixture
def beside(stages, monkeypatch):
    """As on a device that leaves the CPU free: the check runs while the views are matched as given."""
    monkeypatch.setattr(module, "leaves_cpu_free", lambda device: True)
    return stages


@pytest.mark.parametrize(("fits", "surely"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("clean", [True, False])
def test_beside_the_check_views_that_fit_are_matched_once(beside, fits, surely, clean):
    beside.fits, beside.surely = fits, surely
    config = DEFAULT.changed(clean_photographs=clean)
    found = make_evidence(LEFT, GIVEN, config, True)
    ((native, points, given),) = beside.prepared
    added = 0.01 if clean else 0.0
    clear = [each._replace(image_01=each.image_01 + added) for each in VIEWS]
    assert same_views(native, clear, LEFT + added) and torch.equal(points, POINTS) and given is config
    assert found.native is native and found.report.result() == "report"
    ((posed, fit, measured),) = beside.refined
    assert same_views(posed, clear, LEFT + added) and measured is True
    assert same_views(fit.greys.posed, clear, LEFT + added), "the check looks at clean images"
    assert fit.small().greys is fit.greys and len(beside.greys) == 1 + clean
    assert same_views(beside.greys[0], VIEWS)


def test_beside_the_check_refined_views_are_matched_again(beside):
    beside.fits = beside.surely = False
    found = make_evidence(LEFT, GIVEN, DEFAULT, False)
    (first, _, _), (native, points, config) = beside.prepared
    clear = [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS]
    assert same_views(first, clear, LEFT + 0.01)
    moved = [each._replace(T_right_from_left=each.T_right_from_left + 0.5) for each in clear]
    assert same_views(native, moved, LEFT + 0.01) and found.native is native
    assert torch.equal(points, POINTS) and config is DEFAULT and found.report.result() == "report"
    ((posed, _, measured),) = beside.refined
    assert same_views(posed, clear, LEFT + 0.01) and measured is False


def test_beside_the_check_views_that_stay_as_they_are_are_not_matched_again(beside):
    beside.fits = beside.surely = beside.moved = False
    found = make_evidence(LEFT, GIVEN, DEFAULT)
    assert len(beside.prepared) == 1 and found.report.result() == "report"


def test_beside_the_check_views_without_overlap_fail_unless_a_refined_pose_mends_them(beside):
    beside.fails, beside.fits, beside.surely = 1, False, False
    assert make_evidence(LEFT, GIVEN, DEFAULT).report.result() == "report"
    assert len(beside.prepared) == 2
    beside.prepared.clear()
    beside.fails, beside.fits = 2, True
    with pytest.raises(InputError, match="do not overlap"):
        make_evidence(LEFT, GIVEN, DEFAULT)


def matches_of(nearest: float, seed: int = 0) -> Matches:
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.1, nearest, GRID)
    inverse[3, 4] = nearest
    tensors = [torch.from_numpy(x)[None].float() for x in (inverse, rng.uniform(0.0, 1.0, GRID))]
    return Matches(*tensors, torch.tensor(0.002))


@pytest.fixture
def matched(monkeypatch):
    """The parts of matching, each of which notes what it gets."""
    calls = SimpleNamespace(inverse=False, left_out=0, given={}, points=matches_of(2.0, 1))
    matches = matches_of(0.5)

    class Volume:
        """What is read of it once is known from then on."""

        read = set()

        def __getattr__(self, name):
            Volume.read.add(name)
            return (0.5, 90.0)

    volume = Volume()

    def note(name, value):
        def called(*given, **named):
            calls.given[name] = given, named
            return value() if callable(value) else value

        return called

    parts = {
        "to_grid": PosedViews(torch.zeros(3, *GRID), (), torch.eye(3)),
        "points_to_matches": lambda: (calls.points, calls.left_out),
        "build_cost_volume": volume,
        "match_volume": matches,
        "inverse_pose_preferred": lambda: calls.inverse,
    }
    monkeypatch.setattr(
        module, "matching", SimpleNamespace(**{n: note(n, value) for n, value in parts.items()})
    )
    monkeypatch.setattr(module, "rectified_pictures", note("rectified_pictures", "pictures"))
    monkeypatch.setattr(module, "rows_in_background", note("rows_in_background", "rows"))
    calls.volume, calls.matches, calls.grid = volume, matches, parts["to_grid"]
    return calls


NATIVE = PosedViews(LEFT, VIEWS, torch.from_numpy(K).float())
EVERYTHING = {
    "to_grid",
    "build_cost_volume",
    "match_volume",
    "inverse_pose_preferred",
    "rectified_pictures",
    "rows_in_background",
}


def test_views_and_points_become_evidence(matched):
    config = DEFAULT.changed(depth_range=(0.7, 60.0), sweep_pixels=99_999)
    found = prepare_evidence(NATIVE, POINTS, config)
    given = matched.given
    assert given.keys() == EVERYTHING | {"points_to_matches"}
    assert given["to_grid"] == ((NATIVE, 99_999), {})
    points, K_left, size, grid = given["points_to_matches"][0]
    assert points is POINTS and K_left is NATIVE.K_left and (size, grid) == (SIZE, GRID)
    assert given["build_cost_volume"] == ((NATIVE,), {"depth_range": (0.7, 60.0), "config": config})
    assert given["match_volume"] == ((matched.volume,), {})
    assert given["inverse_pose_preferred"] == ((NATIVE, matched.matches), {})
    assert given["rectified_pictures"] == ((NATIVE,), {})
    assert given["rows_in_background"] == (("pictures", matched.matches, matched.points), {})
    assert found.native is NATIVE and found.grid is matched.grid and found.volume is matched.volume
    assert found.matches is matched.matches and found.points is matched.points and found.rows == "rows"
    likely = (matched.matches.confidence > 0.5) & (matched.matches.inverse_depth > 0.002)
    assert (
        torch.equal(found.reliable.confidence, likely.float())
        and found.noticed == ()
        and found.report is None
    )
    with pytest.raises(FrozenInstanceError):
        found.points = None
    # What waits for the device is read before any step would wait for it.
    assert matched.points._above.keys() == {0.0, 0.5} and matched.volume.read == {"reach_m", "rectified"}


@pytest.mark.parametrize(
    ("knobs", "views", "missing"),
    [
        ({}, VIEWS, set()),
        ({"crisp": False}, VIEWS, {"rectified_pictures"}),
        (
            {"crisp": False, "correct": False, "inner_steps": 0},
            VIEWS,
            {"rectified_pictures", "match_volume", "rows_in_background"},
        ),
        (
            {"weights": {"photometric": 1.0}},
            VIEWS,
            {"rectified_pictures", "match_volume", "rows_in_background"},
        ),
        ({"weights": {"photometric": 1.0}, "search": "one-number"}, VIEWS, EVERYTHING - {"to_grid"}),
        ({"search": "one-number"}, VIEWS, set()),
        ({}, (), EVERYTHING - {"to_grid"}),
    ],
)
def test_only_what_the_configuration_needs_is_made(matched, knobs, views, missing):
    found = prepare_evidence(NATIVE._replace(views=views), None, DEFAULT.changed(**knobs))
    assert matched.given.keys() == EVERYTHING - missing
    assert (found.volume is None) == ("build_cost_volume" in missing)
    assert (found.matches is None) == (found.reliable is None) == ("match_volume" in missing)
    assert (found.rows is None) == ("rows_in_background" in missing) and found.points is None
    if "rectified_pictures" in missing and found.rows is not None:
        assert matched.given["rows_in_background"][0] == (None, matched.matches, None)
    if "match_volume" in missing and found.volume is not None:
        assert matched.given["inverse_pose_preferred"][0][1] is None


def test_what_the_matching_warns_of(matched):
    matched.inverse, matched.left_out = True, 7
    found = prepare_evidence(NATIVE, POINTS, DEFAULT)
    assert found.noticed == (INVERSE, "7 points outside the left image are left out: is their frame right?")
    assert [message.code for message in found.noticed] == [INVERSE.code, "points.outside"]
    matched.inverse = False
    assert [message.code for message in prepare_evidence(NATIVE, POINTS, DEFAULT).noticed] == [
        "points.outside"
    ]
    matched.left_out = 0
    assert prepare_evidence(NATIVE, POINTS, DEFAULT).noticed == ()
