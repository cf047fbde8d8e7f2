"""The constructors of a guidance, what each makes of its arguments, and what it refuses."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._checks import InputError
from geodiff_plugin.config import DEFAULT, PRESETS
from geodiff_plugin.evidence import guidance as module
from geodiff_plugin.evidence.guidance import SAME_CENTRE, GeometryGuidance, assumed_centre
from geodiff_plugin.types import Rig

SIZE, OTHER = (36, 48), (40, 60)
LEFT, RIGHT, WIDE = (
    np.random.default_rng(i).integers(0, 255, (*size, 3), np.uint8)
    for i, size in enumerate((SIZE, SIZE, OTHER))
)
K = np.array([[50.0, 0, 23.5], [0, 45.0, 17.5], [0, 0, 1]])
K_WIDE = np.array([[70.0, 0, 29.5], [0, 65.0, 19.5], [0, 0, 1]])
POINTS = np.random.default_rng(3).uniform(0.5, 2.0, (60, 3))


def turn(degrees: float, axis: int = 1) -> np.ndarray:
    vector = np.zeros(3)
    vector[axis] = np.radians(degrees)
    x, y, z = vector
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).double()).numpy()


def pose(centre, degrees: float = 0.0, axis: int = 1) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = turn(degrees, axis), centre
    return E


E1, E2 = pose((0.2, 0.05, -0.1), 6.0), pose((-0.3, 0.1, 0.2), -9.0, 0)


@pytest.mark.parametrize("baseline_m", [0.12, -0.3])
def test_a_baseline_is_to_the_right_and_measured(baseline_m):
    both = GeometryGuidance.from_baseline(WIDE, K, baseline_m, K_WIDE, inner_steps=4)
    (rig,) = both.rigs
    np.testing.assert_array_equal(rig.E, pose((baseline_m, 0, 0)))
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_array_equal(rig.K_right, K_WIDE)
    assert both.measured_baseline is True and both.assumed == [] and both.config.inner_steps == 4
    shared = GeometryGuidance.from_baseline(RIGHT, K, baseline_m, measured_baseline=False)
    assert shared.measured_baseline is False and shared.assumed == [SAME_CENTRE]
    np.testing.assert_array_equal(shared.rigs[0].K_right, K)
    limit_m = 1e6 * np.sign(baseline_m)
    assert GeometryGuidance.from_baseline(RIGHT, K, limit_m, unit=None).rigs[0].E[0, 3] == limit_m
    with pytest.raises(InputError, match="baseline_m must be between -1000000 and 1000000"):
        GeometryGuidance.from_baseline(RIGHT, K, limit_m * (1 + 1e-7), unit=None)


@pytest.fixture
def calibration(monkeypatch):
    """A calibration of cameras that differ in size, as a file of a tracker would have it."""
    asked = []
    sizes = {"size_left": SIZE[::-1], "size_right": OTHER[::-1]}
    rig = Rig(K, K_WIDE, E1, **sizes, source="calib.yaml", unit=None, measured=False)
    monkeypatch.setattr(
        module, "read_calibration", lambda *given, **named: asked.append((given, named)) or rig
    )
    monkeypatch.setattr(module, "is_as_stored", lambda path: False)
    return asked


def test_a_calibration_gives_cameras_sizes_unit_and_how_far_its_lengths_hold(calibration):
    found = GeometryGuidance.from_calibration(
        right=WIDE,
        path="calib.yaml",
        cameras=(0, 2),
        image_names=("a.png", "b.png"),
        baseline_m=0.4,
        inner_steps=4,
    )
    named = {"image_names": ("a.png", "b.png"), "image_size": (60, 40), "baseline_m": 0.4}
    assert calibration == [(("calib.yaml", (0, 2)), named)]
    (rig,) = found.rigs
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_array_equal(rig.K_right, K_WIDE)
    np.testing.assert_allclose(rig.E, E1, atol=1e-12)
    assert found.unit is None and found.measured_baseline is False and found.config.inner_steps == 4
    assert found.assumed == [] and found.warned == [] and found.as_stored is False
    with pytest.raises(InputError, match="image must be of 48x36 pixels, as the left view; got 60x40"):
        found.check_left_images(torch.zeros(1, 3, *OTHER))
    found.check_left_images(torch.zeros(1, 3, *SIZE))
    other = GeometryGuidance.from_calibration(
        WIDE, "calib.yaml", unit="m", measured_baseline=True, left_size=(60, 40)
    )
    assert other.unit == "m" and other.measured_baseline is True
    assert calibration[-1] == (
        ("calib.yaml", None),
        {"image_names": None, "image_size": (60, 40), "baseline_m": None},
    )
    other.check_left_images(torch.zeros(1, 3, *OTHER))


def test_right_images_of_another_size_than_the_calibrations_are_refused(calibration):
    with pytest.raises(
        InputError, match="right must be of 60x40 pixels, as calib.yaml says; got 48x36. Scale K"
    ):
        GeometryGuidance.from_calibration(RIGHT, "calib.yaml", cropped=True)
    assert calibration[-1][1]["image_size"] == (48, 36)
    several = GeometryGuidance.from_calibration([WIDE, WIDE], "calib.yaml")
    assert calibration[-1][1]["image_size"] is None and len(several.inputs) == 2
    with pytest.raises(InputError, match="right must be of 60x40"):
        GeometryGuidance.from_calibration([WIDE, RIGHT], "calib.yaml", cropped=True)


@pytest.mark.parametrize("stored", [True, False])
def test_images_are_taken_as_files_store_them_where_the_calibration_is(calibration, monkeypatch, stored):
    monkeypatch.setattr(module, "is_as_stored", lambda path: stored and path == "model")
    monkeypatch.setattr(module, "in_stored_pixels", lambda image: 255 - image)
    found = GeometryGuidance.from_calibration(WIDE, "model")
    assert found.as_stored is stored
    expected = (255 - WIDE if stored else WIDE) / 255
    np.testing.assert_allclose(found.rights[0].permute(1, 2, 0), expected, atol=1e-6)


def test_warnings_of_the_construction_are_kept_once():
    far = pose((25.0, 0, 0), 6.0)
    with pytest.warns(UserWarning, match="baseline of 25 m"):
        found = GeometryGuidance.from_views([(LEFT, K, np.eye(4)), (RIGHT, K, far)])
    assert [message.code for message in found.warned] == ["baseline.long"]
    with pytest.warns(UserWarning, match="baseline of 25 m"):
        found = GeometryGuidance(RIGHT, K, far)
    assert [message.code for message in found.warned] == ["baseline.long"]
    assert GeometryGuidance(RIGHT, K, far, unit=None).warned == []


def test_views_take_their_size_from_the_first_unless_it_is_given():
    views = [(LEFT, K, E2), (RIGHT, K, E2 @ E1), (WIDE, K_WIDE, np.eye(4))]
    found = GeometryGuidance.from_views(views, points=POINTS, unit=None)
    np.testing.assert_allclose([rig.E for rig in found.rigs], [E1, np.linalg.inv(E2)], atol=1e-12)
    assert [rig.K_right[0, 0] for rig in found.rigs] == [50.0, 70.0] and found.unit is None
    assert [tuple(right.shape) for right in found.rights] == [(3, *SIZE), (3, *OTHER)]
    with pytest.raises(InputError, match="of 48x36 pixels"):
        found.check_left_images(torch.zeros(1, 3, *OTHER))
    free = GeometryGuidance.from_views([(None, K, E2), *views[1:]])
    free.check_left_images(torch.zeros(1, 3, 40, 50))
    with pytest.raises(InputError, match="of 50x40 pixels"):
        GeometryGuidance.from_views(views, left_size=(50, 40)).check_left_images(torch.zeros(1, 3, *SIZE))
    off = K.copy()
    off[0, 2] = -5.0
    with pytest.raises(InputError, match=r"K\[left\]"):
        GeometryGuidance.from_views([(LEFT, off, E2), *views[1:]])
    assert (
        GeometryGuidance.from_views([(LEFT, off, E2), *views[1:]], cropped=True).rigs[0].K_left[0, 2] == -5.0
    )


def test_named_constructors_have_their_presets_and_pass_other_arguments_on():
    for made, preset in (
        (GeometryGuidance.from_points(POINTS, K, unit=None), "default"),
        (GeometryGuidance.marigold_dc(POINTS, K, unit=None), "marigold-dc"),
        (GeometryGuidance.paper(RIGHT, K, E1, unit=None), "paper"),
        (GeometryGuidance.search_only(RIGHT, K, E1, unit=None), "search-only"),
    ):
        assert made.config == PRESETS[preset] and made.unit is None
        assert (made.inputs[0].points is None) == (made.rights != [])
        if made.rights:
            np.testing.assert_allclose(made.rigs[0].E, E1, atol=1e-12)
        else:
            np.testing.assert_allclose(made.inputs[0].points, POINTS, rtol=1e-6)
        np.testing.assert_array_equal(made.inputs[0].K_left, K)


@pytest.fixture
def estimated(monkeypatch):
    """Two right cameras that matching would have found, and what was asked for."""
    asked = {}

    def estimate(photographs, known, **named):
        count = len(photographs)
        asked.update(photographs=photographs, known=known, named=named)
        return SimpleNamespace(
            size_left=(48, 36),
            Ks=(K, K, K_WIDE)[:count],
            Es=(E1, E2)[: count - 1],
            scale=SimpleNamespace(unit=asked.get("unit")),
        )

    monkeypatch.setattr(module, "estimate_rig", estimate)
    return asked


@pytest.mark.parametrize("unit", ["m", None])
def test_photographs_become_views_with_the_estimated_cameras(estimated, unit):
    estimated["unit"] = unit
    length = (1.0, 2.0, 3.0, 4.0, 0.5)
    found = GeometryGuidance.from_photographs(
        [LEFT, RIGHT, WIDE],
        known_length=length,
        K=[K, K, K_WIDE],
        fov=55.0,
        points=POINTS,
        cropped=True,
        inner_steps=4,
    )
    photographs = estimated["photographs"]
    assert (
        len(photographs) == 3
        and photographs[0] is LEFT
        and photographs[1] is RIGHT
        and photographs[2] is WIDE
    )
    known = estimated["known"]
    assert known.baseline_m is None and known.known_length is length and known.points is POINTS
    named = estimated["named"]
    assert [matrix is given for matrix, given in zip(named["K"], (K, K, K_WIDE), strict=True)] == [True] * 3
    assert named["fov"] == 55.0 and named["cropped"] is True
    assert found.unit == unit and found.measured_baseline is True and found.config.inner_steps == 4
    assert (found.inputs[0].points is None) == (unit is None)
    np.testing.assert_allclose([rig.E for rig in found.rigs], [E1, E2], atol=1e-12)
    assert [rig.K_right[0, 0] for rig in found.rigs] == [50.0, 70.0]
    assert found.estimated.size_left == (48, 36) and found.warned == [] and found.assumed == []
    with pytest.raises(InputError, match="of 48x36 pixels"):
        found.check_left_images(torch.zeros(1, 3, *OTHER))


@pytest.mark.parametrize("form", ["two", "tuple"])
def test_two_photographs_have_one_K_or_one_each(estimated, monkeypatch, form):
    parallel = pose((0.2, 0, 0))
    monkeypatch.setattr(
        module,
        "estimate_rig",
        lambda photographs, known, **named: (
            estimated.update(known=known, named=named)
            or SimpleNamespace(size_left=(48, 36), Ks=(K, K), Es=(parallel,), scale=SimpleNamespace(unit="m"))
        ),
    )
    pair = (LEFT, RIGHT) if form == "two" else ((LEFT, RIGHT),)
    named = dict(zip(("left", "right"), pair, strict=False))
    found = GeometryGuidance.from_photographs(**named, K=K, baseline_m=0.2)
    assert estimated["named"]["K"] is K and estimated["known"].baseline_m == 0.2
    assert estimated["named"]["cropped"] is False and estimated["named"]["fov"] is None
    assert found.assumed == [SAME_CENTRE]
    found = GeometryGuidance.from_photographs(*pair, K=K, K_right=K_WIDE)
    first, second = estimated["named"]["K"]
    assert first is K and second is K_WIDE and found.assumed == []


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("degrees", "parallel"), [(0.0, True), (0.80, True), (-0.80, True), (0.82, False), (-5.0, False)]
)
def test_the_right_centre_is_assumed_of_cameras_that_are_parallel_to_within_a_degree(axis, degrees, parallel):
    """The cosine of the angle is .9999 at .81 degrees."""
    rig, turned = (Rig(K, K, pose((0.2, 0, 0), angle, axis)) for angle in (degrees, 20.0))
    for rigs in ([rig], [turned, rig], [rig, turned]):
        assert assumed_centre(rigs) == ([SAME_CENTRE] if parallel else [])
    assert assumed_centre([]) == []
    made = GeometryGuidance(RIGHT, K, rig.E)
    assert made.assumed == assumed_centre([rig])
    for given in ((K, K), [K, K]):
        assert GeometryGuidance(RIGHT, given, rig.E).assumed == []


def test_defaults_of_a_guidance():
    found = GeometryGuidance(RIGHT, K, E1)
    assert found.unit == "m" and found.measured_baseline is False and found.evidence_store is None
    assert found.estimated is None and found.as_stored is False and found.config == DEFAULT
    with pytest.raises(InputError, match="left_size"):
        GeometryGuidance(RIGHT, K, E1, left_size=(48,))
    with pytest.raises(InputError, match="rule must be one of"):
        GeometryGuidance(RIGHT, K, E1, rule="unknown")
    with pytest.raises(InputError, match="a key of weights must be one of"):
        GeometryGuidance(RIGHT, K, E1, weights={"matches": 1.0, "unknown": 0.0})


@pytest.mark.parametrize(
    ("knobs", "latents", "network", "plan"),
    [
        ({}, False, False, (0, 0.75, 0.03)),
        ({"inner_steps": 5}, True, False, (5, 0.75, 0.03)),
        ({"inner_steps": 5, "gradient": "full"}, True, True, (5, 0.0, 0.1)),
        ({"inner_steps": 5, "gradient": "full", "optimize_latents": False}, False, False, (5, 0.0, 0.1)),
        ({"inner_steps": 0, "gradient": "full"}, False, False, (0, 0.0, 0.1)),
        ({"correct": False}, True, False, (40, 0.0, 0.1)),
        ({"weights": {"photometric": 1.0, "points": 1.0}, "step_latents": 0.2}, True, False, (40, 0.0, 0.2)),
    ],
)
def test_what_the_updates_move(knobs, latents, network, plan):
    found = GeometryGuidance(RIGHT, K, E1, **knobs)
    assert found.moves_latents is latents and found.through_network is network
    assert (found.updates.inner_steps, found.updates.updates_from, found.updates.step_latents) == plan
    run = found.as_run()
    assert (run.inner_steps, run.step_latents) == (plan[0], plan[2])
    assert run == found.config.changed(inner_steps=plan[0], step_latents=plan[2])


def test_points_count_among_what_the_updates_can_be_spared_for():
    weights = {"photometric": 1.0, "points": 1.0}
    with_points = GeometryGuidance(RIGHT, K, E1, points=POINTS, weights=weights)
    assert with_points.updates.inner_steps == 0
    assert GeometryGuidance(RIGHT, K, E1, weights=weights).updates.inner_steps == 40


@pytest.mark.parametrize(
    ("requested", "default", "steps"),
    [(7, 4, 7), (1, 99, 1), (0, 99, 0), (None, 50, 50), (None, 4, 10), (None, None, 10)],
)
def test_the_number_of_denoising_steps(requested, default, steps):
    assert GeometryGuidance(RIGHT, K, E1, min_steps=10).denoising_steps(requested, default) == steps
    assert GeometryGuidance(RIGHT, K, E1, min_steps=1).denoising_steps(None, None) == 1


def test_left_images_have_to_belong_to_the_views_and_to_K():
    lefts = torch.zeros(2, 3, *SIZE)
    two = GeometryGuidance([RIGHT, WIDE], [K, (K, K_WIDE)], [E1, E2])
    two.check_left_images(lefts)
    with pytest.raises(
        InputError,
        match="right must be a list of 1 images .a tuple for several right views., one per left image; got 2",
    ):
        two.check_left_images(lefts[:1])
    by_points = GeometryGuidance(None, K, points=[POINTS, POINTS])
    by_points.check_left_images(lefts)
    with pytest.raises(InputError, match="points must be a list of 3 entries, one per left image; got 2"):
        by_points.check_left_images(torch.zeros(3, 3, *SIZE))
    sized = GeometryGuidance(RIGHT, (K, K), E1, left_size=(48, 36))
    sized.check_left_images(lefts[:1])
    with pytest.raises(InputError, match="image must be of 48x36 pixels, as the left view; got 36x48"):
        sized.check_left_images(torch.zeros(1, 3, 48, 36))


def test_K_of_the_left_image_is_checked_by_its_place_unless_the_right_image_told_already():
    off = K.copy()
    off[0, 2] = 55.0  # within 60 columns, not within 48
    batch = GeometryGuidance([WIDE, RIGHT], [(off, K_WIDE), (K, K)], [E1, E2])
    with pytest.raises(
        InputError, match=r"K\[0\] puts the principal point \(55.0, 17.5\) outside the left image of 48x36"
    ):
        batch.check_left_images(torch.zeros(2, 3, *SIZE))
    other = GeometryGuidance([RIGHT, WIDE], [(K, K), (off, K_WIDE)], [E1, E2])
    with pytest.raises(InputError, match=r"K\[1\] puts"):
        other.check_left_images(torch.zeros(2, 3, *SIZE))
    single = GeometryGuidance(WIDE, (off, K_WIDE), E1)
    with pytest.raises(InputError, match=r"^K puts"):
        single.check_left_images(torch.zeros(1, 3, *SIZE))
    GeometryGuidance(WIDE, (off, K_WIDE), E1, cropped=True).check_left_images(torch.zeros(1, 3, *SIZE))
    shared = GeometryGuidance(WIDE, K_WIDE, E1)
    with pytest.raises(
        InputError,
        match=r"K must be a tuple \(K_left, K_right\), as the images differ in size; got one matrix",
    ):
        shared.check_left_images(torch.zeros(1, 3, *SIZE))
    shared.check_left_images(torch.zeros(1, 3, *OTHER))
    unlike = GeometryGuidance((RIGHT, WIDE), K, (np.eye(4), E1, E2))
    with pytest.raises(InputError, match="as the images differ in size"):
        unlike.check_left_images(torch.zeros(1, 3, *SIZE))


@pytest.mark.parametrize(("same_K", "warns"), [(True, False), (False, True)])
def test_a_doubtful_K_is_warned_of_once(same_K, warns):
    """By the right image if it has the size and the K of the left one, and otherwise by the left image."""
    doubtful = K.copy()
    doubtful[0, 2] = 6.0
    Ks = (doubtful, doubtful if same_K else K)
    if same_K:
        with pytest.warns(UserWarning, match="near the border of the right image"):
            found = GeometryGuidance(RIGHT, Ks, E1)
        found.check_left_images(torch.zeros(1, 3, *SIZE))
    else:
        found = GeometryGuidance(RIGHT, Ks, E1)
        with pytest.warns(
            UserWarning, match="K has its principal point .* near the border of the left image"
        ):
            found.check_left_images(torch.zeros(1, 3, *SIZE))


@pytest.mark.parametrize("has_store", [True, False])
def test_each_left_image_meets_its_own_input(monkeypatch, has_store):
    calls = []

    def make(*given):
        calls.append(given)
        return len(calls)

    monkeypatch.setattr(module, "make_evidence", make)
    found = GeometryGuidance([RIGHT, WIDE], [K, (K, K_WIDE)], [E1, E2], measured_baseline=True)
    if has_store:
        monkeypatch.setattr(module, "make_evidence", None)
        found.evidence_store = SimpleNamespace(get=make)
    lefts = torch.rand(2, 3, *SIZE)
    assert found.prepare(lefts) == [1, 2]
    for i, (left, given, config, measured) in enumerate(calls):
        assert torch.equal(left, lefts[i]) and given is found.inputs[i]
        assert config is found.config and measured is True
    with pytest.raises(InputError, match="right must be a list of 1 images"):
        found.prepare(lefts[:1])
    assert len(calls) == 2


VIEWS, KNOWN = {"right": RIGHT, "K": K, "E": E1}, {"right": None, "K": K, "E": None, "points": POINTS}
BOTH = VIEWS | {"points": POINTS}


@pytest.mark.parametrize(
    ("given", "knobs", "refused"),
    [
        (VIEWS, {"search": "one-number"}, None),
        (
            VIEWS,
            {"search": "one-number", "weights": {"matches": 1.0, "photometric": 0.0}},
            "needs a right view and a photo",
        ),
        (KNOWN, {"search": "one-number"}, "needs a right view and a photometric weight"),
        (VIEWS, {"search": "points-range"}, "'points-range' needs points. search='volume' works"),
        (BOTH, {"search": "points-range"}, None),
        (KNOWN, {"search": "points-range"}, None),
        (
            KNOWN,
            {"weights": {"matches": 1.0, "photometric": 1.0}},
            "weights must be above 0 for a term that can work",
        ),
        (KNOWN, {"weights": {"matches": 1.0}, "inner_steps": 0}, None),
        (KNOWN, {"weights": {"matches": 1.0}, "inner_steps": 3}, "weights must be above 0"),
        (KNOWN, {"weights": {"matches": 1.0, "points": 0.1}}, None),
        (KNOWN, {"weights": {"matches": 1.0, "points": 0.0}}, "weights must be above 0"),
        (KNOWN, {"weights": {"prior_pull": 1.0}}, None),
        (VIEWS, {"weights": {"points": 1.0}}, "weights must be above 0"),
        (VIEWS, {"weights": {"points": 1.0}, "inner_steps": 0}, None),
        (VIEWS, {"weights": {"photometric": 1.0}}, None),
        (VIEWS, {"weights": {"matches": 1.0}}, None),
        (VIEWS, {"weights": {}}, "weights must be above 0"),
        (BOTH, {"weights": {"points": 1.0}}, None),
    ],
)
def test_search_and_terms_need_what_they_work_on(given, knobs, refused):
    if refused is None:
        assert GeometryGuidance(**given, **knobs).config == DEFAULT.changed(**knobs)
        return
    with pytest.raises(InputError, match=refused):
        GeometryGuidance(**given, **knobs)
