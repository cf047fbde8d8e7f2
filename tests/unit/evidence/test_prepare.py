"""From a left image to its evidence: which views each stage gets, and when poses are refined."""

from dataclasses import FrozenInstanceError, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin._internal.threads import BackgroundTask
from geodiff_plugin.cameras import Camera, PosedViews, View, eroded
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.evidence import plan as plan_module
from geodiff_plugin.evidence import prepare as module
from geodiff_plugin.evidence.evidence import Evidence
from geodiff_plugin.evidence.inputs import Inputs
from geodiff_plugin.evidence.plan import CheckedRows, EvidencePlan
from geodiff_plugin.evidence.pose_check import CheckedPoses
from geodiff_plugin.evidence.prepare import BLEND_PX, cleaned, plan_evidence, prepare_evidence
from geodiff_plugin.matching import Matches
from geodiff_plugin.trust import FactSheet, MatchesStage
from geodiff_plugin.trust.field_of_view import FieldOfView, ViewAngle
from geodiff_plugin.trust.inverse_pose import InversePose, Preference
from geodiff_plugin.types import PoseReport
from tests.views import view_of

SIZE, GRID = (36, 48), (18, 30)
LEFT, *RIGHTS = torch.rand(3, 3, *SIZE, generator=torch.Generator().manual_seed(0))
K = np.array([[50.0, 0, 23.5], [0, 45.0, 17.5], [0, 0, 1]])
POINTS = torch.rand(9, 3, generator=torch.Generator().manual_seed(1)) + 1.0


def view(v: int, centre: float) -> View:
    T = np.eye(4)
    T[0, 3] = -centre
    return view_of(RIGHTS[v], (1 + v) * K, T)


VIEWS = view(0, 0.1), view(1, 0.3)
GIVEN = Inputs(Camera(K), VIEWS, (), POINTS)


def same_views(found: PosedViews, views, left=LEFT) -> bool:
    """Whether the images, cameras and poses are those of ``views``, in their order."""
    return torch.equal(found.left.image_01, left) and all(
        torch.equal(one.image_01, other.image_01)
        and np.array_equal(one.camera.K, other.camera.K)
        and np.array_equal(one.T_right_from_left, other.T_right_from_left)
        for one, other in zip(found.rights, views, strict=True)
    )


def test_images_are_cleaned_to_the_pixels_of_the_sweep_if_that_is_set(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "clean", lambda *given: asked.append(given) or "clean")
    images, masks = [LEFT, *RIGHTS], [None] * 3
    assert cleaned(images, masks, DEFAULT.changed(sweep_pixels=77_777)) == "clean"
    assert asked == [(images, 77_777, masks)]
    assert cleaned(images, masks, DEFAULT.changed(clean_images=False)) is images and len(asked) == 1


def test_flaws_are_measured_further_inside_than_the_blended_edge_of_borders(monkeypatch):
    asked = []
    monkeypatch.setattr(module, "clean", lambda images, pixels, masks: asked.append(masks) or images)
    valid = torch.ones(SIZE, dtype=torch.bool)
    valid[:, :6] = False
    posed = PosedViews(view_of(LEFT, K)._replace(valid=valid), VIEWS)
    assert module._with_clean_images(posed, DEFAULT) is posed
    ((of_left, *of_rights),) = asked
    assert of_rights == [None, None] and torch.equal(of_left, eroded(valid, BLEND_PX))


def test_clean_images_take_the_places_of_theirs_and_cameras_stay(monkeypatch):
    monkeypatch.setattr(
        module, "clean", lambda images, pixels, masks: [image + 1 + i for i, image in enumerate(images)]
    )
    posed = PosedViews(view_of(LEFT, K), VIEWS)
    found = module._with_clean_images(posed, DEFAULT)
    assert torch.equal(found.left.image_01, LEFT + 1) and found.left.camera is posed.left.camera
    for v, (one, other) in enumerate(zip(found.rights, VIEWS, strict=True)):
        assert torch.equal(one.image_01, RIGHTS[v] + 2 + v)
        assert one.camera is other.camera and one.T_right_from_left is other.T_right_from_left
    for changed in range(3):
        monkeypatch.setattr(
            module,
            "clean",
            lambda images, pixels, masks, changed=changed: [
                x + 1 if i == changed else x for i, x in enumerate(images)
            ],
        )
        assert module._with_clean_images(posed, DEFAULT) is not posed
    monkeypatch.setattr(module, "clean", lambda images, pixels, masks: list(images))
    assert module._with_clean_images(posed, DEFAULT) is posed


#: What the made-up stages of ``stages`` find.
OF_POSES = FactSheet({FieldOfView: ViewAngle(50.0)})
OF_MATCHES = FactSheet({InversePose: Preference(False)})
ROWS = BackgroundTask.known(CheckedRows("rows", FactSheet()))


@pytest.fixture
def stages(monkeypatch):
    """Stages that note what they get: cleaning adds .01 to images, the check of the poses moves each view."""
    calls = SimpleNamespace(prepared=[], checked=[], greys=[], fits=True, surely=True, moved=True, fails=0)

    def prepared(native, points, config):
        calls.prepared.append((native, points, config))
        if len(calls.prepared) <= calls.fails:
            raise InputError("the views do not overlap")
        return EvidencePlan(Evidence(native, native, None, None, facts=OF_MATCHES), ROWS)

    def checked(posed, fit, images, measured):
        calls.checked.append((posed, fit, images, measured))
        moved = tuple(view._replace(T_right_from_left=view.T_right_from_left + 0.5) for view in posed.rights)
        return CheckedPoses(moved if calls.moved else posed.rights, "report", OF_POSES)

    def greys(posed):
        calls.greys.append(posed)
        return SimpleNamespace(posed=posed)

    def fit(given, small=None):
        return SimpleNamespace(fits=calls.fits, greys=given, small=small)

    def small(given):
        return SimpleNamespace(surely=calls.surely, greys=given)

    monkeypatch.setattr(module, "prepare_evidence", prepared)
    monkeypatch.setattr(module, "check_poses", checked)
    monkeypatch.setattr(plan_module, "fit_of_small", small)
    for each in (module, plan_module):
        monkeypatch.setattr(each, "posed_greys", greys)
        monkeypatch.setattr(each, "measure_fit", fit)
        monkeypatch.setattr(each, "image_facts", lambda given: ("facts of", given))
    monkeypatch.setattr(module, "clean", lambda images, pixels, masks: [image + 0.01 for image in images])
    return calls


@pytest.mark.parametrize("measured", [True, False])
def test_poses_are_checked_by_clean_images_before_anything_is_matched(stages, measured):
    plan = plan_evidence(LEFT, GIVEN, DEFAULT, measured)
    ((posed, fit, images, reported),) = stages.checked
    ((native, points, config),) = stages.prepared
    clear = [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS]
    assert same_views(posed, clear, LEFT + 0.01) and reported is measured
    assert fit.greys.posed is posed and stages.greys == [posed] and images == ("facts of", fit.greys)
    moved = [each._replace(T_right_from_left=each.T_right_from_left + 0.5) for each in clear]
    assert same_views(native, moved, LEFT + 0.01) and plan.evidence.native is native
    assert torch.equal(points, POINTS) and config is DEFAULT
    found = plan.complete()
    assert (found.report, found.rows, found.facts) == ("report", "rows", OF_MATCHES | OF_POSES)
    assert plan.evidence.report is None and plan.evidence.facts == OF_MATCHES
    np.testing.assert_allclose(native.left.camera.K, K, rtol=1e-6)
    plan_evidence(LEFT, GIVEN, DEFAULT)
    assert stages.checked[-1][3] is False


def test_given_poses_are_neither_checked_nor_changed(stages):
    plan = plan_evidence(LEFT, GIVEN, DEFAULT.changed(pose="given"), True)
    ((native, _, _),) = stages.prepared
    assert stages.checked == stages.greys == []
    assert same_views(native, [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS], LEFT + 0.01)
    _, report, facts, _ = plan.poses.result()
    assert isinstance(report, PoseReport) and report.status == "given" and facts == FactSheet()
    for E, E_given, each in zip(report.E, report.E_given, VIEWS, strict=True):
        np.testing.assert_allclose(E, np.linalg.inv(each.T_right_from_left), atol=1e-6)
        np.testing.assert_allclose(E_given, E)


def test_poses_of_an_earlier_frame_are_used_without_another_check(stages):
    moved = tuple(each._replace(T_right_from_left=each.T_right_from_left + 0.25) for each in VIEWS)
    checked = CheckedPoses(moved, "report", OF_POSES)
    plan = plan_evidence(LEFT, GIVEN, DEFAULT, True, checked)
    ((native, _, _),) = stages.prepared
    assert stages.checked == stages.greys == []
    assert same_views(native, [each._replace(image_01=each.image_01 + 0.01) for each in moved], LEFT + 0.01)
    _, report, facts, _ = plan.poses.result()
    assert report == "report" and facts == OF_POSES


@pytest.mark.parametrize("pose", ["given", "auto"])
def test_without_a_right_view_the_image_is_used_as_it_is(stages, pose):
    config = DEFAULT if pose == "auto" else DEFAULT.changed(pose=pose)
    plan = plan_evidence(LEFT, replace(GIVEN, views=()), config)
    ((native, points, _),) = stages.prepared
    assert native.left.image_01 is LEFT and native.rights == () and torch.equal(points, POINTS)
    assert plan.poses is None and stages.checked == []


@pytest.fixture
def during(stages, monkeypatch):
    """As on a device that leaves the CPU free: the poses are checked while the views are matched as given."""
    monkeypatch.setattr(module, "leaves_cpu_free", lambda device: True)
    return stages


@pytest.mark.parametrize(("fits", "surely"), [(True, True), (True, False), (False, True)])
@pytest.mark.parametrize("clean", [True, False])
def test_during_the_check_views_that_fit_are_matched_once(during, fits, surely, clean):
    during.fits, during.surely = fits, surely
    config = DEFAULT.changed(clean_images=clean)
    plan = plan_evidence(LEFT, GIVEN, config, True)
    ((native, points, given),) = during.prepared
    added = 0.01 if clean else 0.0
    clear = [each._replace(image_01=each.image_01 + added) for each in VIEWS]
    assert same_views(native, clear, LEFT + added) and torch.equal(points, POINTS) and given is config
    found = plan.complete()
    assert found.native is native and (found.report, found.rows) == ("report", "rows")
    assert found.facts == OF_MATCHES | OF_POSES
    ((posed, fit, images, measured),) = during.checked
    assert same_views(posed, clear, LEFT + added) and measured is True
    assert same_views(fit.greys.posed, clear, LEFT + added), "the check looks at clean images"
    assert images == ("facts of", fit.greys)
    assert fit.small().greys is fit.greys and len(during.greys) == 1 + clean
    assert same_views(during.greys[0], VIEWS)


def test_during_the_check_refined_views_are_matched_again(during):
    during.fits = during.surely = False
    plan = plan_evidence(LEFT, GIVEN, DEFAULT, False)
    (first, _, _), (native, points, config) = during.prepared
    clear = [each._replace(image_01=each.image_01 + 0.01) for each in VIEWS]
    assert same_views(first, clear, LEFT + 0.01)
    moved = [each._replace(T_right_from_left=each.T_right_from_left + 0.5) for each in clear]
    assert same_views(native, moved, LEFT + 0.01) and plan.evidence.native is native
    assert torch.equal(points, POINTS) and config is DEFAULT and plan.complete().report == "report"
    ((posed, _, _, measured),) = during.checked
    assert same_views(posed, clear, LEFT + 0.01) and measured is False


def test_during_the_check_views_that_stay_as_they_are_are_not_matched_again(during):
    during.fits = during.surely = during.moved = False
    plan = plan_evidence(LEFT, GIVEN, DEFAULT)
    assert len(during.prepared) == 1 and plan.complete().report == "report"


def test_during_the_check_views_without_overlap_fail_unless_a_refined_pose_mends_them(during):
    during.fails, during.fits, during.surely = 1, False, False
    assert plan_evidence(LEFT, GIVEN, DEFAULT).complete().report == "report"
    assert len(during.prepared) == 2
    during.prepared.clear()
    during.fails, during.fits = 2, True
    with pytest.raises(InputError, match="do not overlap"):
        plan_evidence(LEFT, GIVEN, DEFAULT)


def matches_of(nearest: float, seed: int = 0) -> Matches:
    rng = np.random.default_rng(seed)
    inverse = rng.uniform(0.1, nearest, GRID)
    inverse[3, 4] = nearest
    tensors = [torch.from_numpy(x)[None].float() for x in (inverse, rng.uniform(0.0, 1.0, GRID))]
    return Matches(*tensors, torch.tensor(0.002))


@pytest.fixture
def matched(monkeypatch):
    """The parts of matching, each of which notes what it gets."""
    calls = SimpleNamespace(left_out=0, given={}, points=matches_of(2.0, 1))
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
        "to_grid": PosedViews(view_of(torch.zeros(3, *GRID), np.eye(3)), ()),
        "points_to_matches": lambda: (calls.points, calls.left_out),
        "build_cost_volume": volume,
        "match_volume": matches,
    }
    monkeypatch.setattr(
        module, "matching", SimpleNamespace(**{n: note(n, value) for n, value in parts.items()})
    )
    monkeypatch.setattr(module, "first_rectified_pair", note("first_rectified_pair", "pictures"))

    def searched(found, of_volume):
        assert found is matches and of_volume is volume
        return found

    monkeypatch.setattr(module, "with_repetition", searched)
    monkeypatch.setattr(module, "if_repeated", lambda found: found)
    row_tasks = SimpleNamespace(match=note("RowTasks.match", "rows"))
    monkeypatch.setattr(module, "RowTasks", note("RowTasks", row_tasks))
    monkeypatch.setattr(module, "measure", note("measure", OF_MATCHES))
    calls.volume, calls.matches, calls.grid = volume, matches, parts["to_grid"]
    return calls


NATIVE = PosedViews(view_of(LEFT, K), VIEWS)
ROW_PARTS = {"first_rectified_pair", "RowTasks", "RowTasks.match"}
EVERYTHING = {
    "to_grid",
    "build_cost_volume",
    "match_volume",
    "measure",
    *ROW_PARTS,
}


def test_views_and_points_become_evidence(matched):
    config = DEFAULT.changed(depth_range=(0.7, 60.0), sweep_pixels=99_999)
    plan = prepare_evidence(NATIVE, POINTS, config)
    given, found = matched.given, plan.evidence
    assert given.keys() == EVERYTHING | {"points_to_matches"}
    assert given["to_grid"] == ((NATIVE, 99_999), {})
    points, camera, grid = given["points_to_matches"][0]
    assert points is POINTS and camera is NATIVE.left.camera and grid == GRID
    assert camera.size == SIZE[::-1]
    assert given["build_cost_volume"] == ((NATIVE,), {"depth_range": (0.7, 60.0), "config": config})
    assert given["match_volume"] == ((matched.volume,), {})
    assert given["measure"] == ((MatchesStage(NATIVE, matched.matches),), {})
    assert given["first_rectified_pair"] == ((NATIVE,), {})
    assert given["RowTasks"] == (("pictures", SIZE), {})
    assert given["RowTasks.match"] == ((matched.matches, matched.points), {})
    assert found.native is NATIVE and found.grid is matched.grid and found.volume is matched.volume
    assert found.matches is matched.matches and found.points is matched.points and plan.rows == "rows"
    likely = (matched.matches.confidence > 0.5) & (matched.matches.inverse_depth > 0.002)
    assert torch.equal(found.reliable.confidence, likely.float()) and found.facts == OF_MATCHES
    assert found.report is None and found.rows is None and plan.poses is None
    with pytest.raises(FrozenInstanceError):
        found.points = None
    # What waits for the device is read before any step would wait for it.
    assert matched.points._above.keys() == {0.0, 0.5} and matched.volume.read == {"reach_m", "rectified"}


@pytest.mark.parametrize(
    ("parameters", "views", "missing"),
    [
        ({}, VIEWS, set()),
        ({"refine_edges": False}, VIEWS, ROW_PARTS),
        (
            {"refine_edges": False, "fit_matches": False, "guidance_steps": 0},
            VIEWS,
            {"match_volume"} | ROW_PARTS,
        ),
        ({"weights": {"photometric": 1.0}}, VIEWS, {"match_volume"} | ROW_PARTS),
        ({"weights": {"photometric": 1.0}, "search": "one-number"}, VIEWS, EVERYTHING - {"to_grid"}),
        ({"search": "one-number"}, VIEWS, set()),
        ({}, (), EVERYTHING - {"to_grid"}),
    ],
)
def test_only_what_the_configuration_needs_is_made(matched, parameters, views, missing):
    plan = prepare_evidence(NATIVE._replace(rights=views), None, DEFAULT.changed(**parameters))
    found = plan.evidence
    assert matched.given.keys() == EVERYTHING - missing
    assert (found.volume is None) == ("build_cost_volume" in missing)
    assert (found.matches is None) == (found.reliable is None) == ("match_volume" in missing)
    assert (plan.rows is None) == ("RowTasks.match" in missing) and found.points is None
    assert (found.facts == FactSheet()) == ("measure" in missing)
    if "match_volume" in missing and found.volume is not None:
        assert matched.given["measure"][0][0].matches is None


def test_no_rows_are_matched_of_a_pair_that_is_not_rectified(matched, monkeypatch):
    monkeypatch.setattr(module, "first_rectified_pair", lambda native: None)
    plan = prepare_evidence(NATIVE, POINTS, DEFAULT)
    assert plan.rows is None and matched.given.keys() == EVERYTHING - ROW_PARTS | {"points_to_matches"}


@pytest.mark.parametrize("left_out", [0, 7])
def test_points_outside_of_the_image_are_counted(matched, left_out):
    matched.left_out = left_out
    assert prepare_evidence(NATIVE, POINTS, DEFAULT).evidence.points_outside == left_out
