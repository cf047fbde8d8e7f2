"""The constructors of a guidance, what each makes of its arguments, and what it rejects."""

import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.config import DEFAULT, PAPER, PRESETS, GuidanceConfig
from geodiff_plugin.evidence import guidance as module
from geodiff_plugin.evidence.guidance import SAME_CENTRE, GeometryGuidance, assumed_centre
from geodiff_plugin.findings import Finding
from tests.views import made_rig

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
    both = GeometryGuidance.from_baseline(WIDE, K, baseline_m, K_WIDE, guidance_steps=4)
    (rig,) = both.rigs
    np.testing.assert_array_equal(rig.E, pose((baseline_m, 0, 0)))
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_array_equal(rig.K_right, K_WIDE)
    assert both.measured_baseline is True and both.findings == [] and both.config.guidance_steps == 4
    shared = GeometryGuidance.from_baseline(RIGHT, K, baseline_m, measured_baseline=False)
    assert shared.measured_baseline is False and shared.findings == [SAME_CENTRE]
    np.testing.assert_array_equal(shared.rigs[0].K_right, K)
    limit_m = 1e6 * np.sign(baseline_m)
    assert GeometryGuidance.from_baseline(RIGHT, K, limit_m, unit=None).rigs[0].E[0, 3] == limit_m
    with pytest.raises(InputError, match="baseline_m must be between -1000000 and 1000000"):
        GeometryGuidance.from_baseline(RIGHT, K, limit_m * (1 + 1e-7), unit=None)


@pytest.fixture
def calibration(monkeypatch):
    """A calibration of cameras that differ in size, as a file of a tracker would have it."""
    asked = []
    sizes = SIZE[::-1], OTHER[::-1]
    rig = made_rig(K, K_WIDE, E1, sizes, source="calib.yaml", unit=None, measured=False)
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
        guidance_steps=4,
    )
    named = {"image_names": ("a.png", "b.png"), "image_size": (60, 40), "baseline_m": 0.4}
    assert calibration == [(("calib.yaml", (0, 2)), named)]
    (rig,) = found.rigs
    np.testing.assert_array_equal(rig.K_left, K)
    np.testing.assert_array_equal(rig.K_right, K_WIDE)
    np.testing.assert_allclose(rig.E, E1, atol=1e-12)
    assert found.unit is None and found.measured_baseline is False and found.config.guidance_steps == 4
    assert found.findings == [] and found.as_stored is False
    with pytest.raises(InputError, match="image must be 48x36 pixels, like the left view; got 60x40"):
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


def test_right_images_of_another_size_than_the_calibrations_are_rejected(calibration):
    with pytest.raises(InputError, match="right must be 60x40 pixels, as in calib.yaml; got 48x36. Scale K"):
        GeometryGuidance.from_calibration(RIGHT, "calib.yaml", cropped=True)
    assert calibration[-1][1]["image_size"] == (48, 36)
    several = GeometryGuidance.from_calibration([WIDE, WIDE], "calib.yaml")
    assert calibration[-1][1]["image_size"] is None and len(several.inputs) == 2
    with pytest.raises(InputError, match="right must be 60x40"):
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
    assert [finding.code for finding in found.findings] == ["baseline.long"]
    with pytest.warns(UserWarning, match="baseline of 25 m"):
        found = GeometryGuidance(RIGHT, K, far)
    assert [finding.code for finding in found.findings] == ["baseline.long"]
    assert GeometryGuidance(RIGHT, K, far, unit=None).findings == []


def test_further_findings_come_first_and_each_sentence_once():
    found = GeometryGuidance.from_baseline(RIGHT, K, 0.1)
    plane, exif = OF_PHOTOS
    found.add_findings([plane])
    found.add_findings((exif, plane, exif))
    assert found.findings == [exif, plane, SAME_CENTRE]


def test_views_take_their_size_from_the_first_unless_it_is_given():
    views = [(LEFT, K, E2), (RIGHT, K, E2 @ E1), (WIDE, K_WIDE, np.eye(4))]
    found = GeometryGuidance.from_views(views, points=POINTS, unit=None)
    np.testing.assert_allclose([rig.E for rig in found.rigs], [E1, np.linalg.inv(E2)], atol=1e-12)
    assert [rig.K_right[0, 0] for rig in found.rigs] == [50.0, 70.0] and found.unit is None
    assert [tuple(right.shape) for right in found.rights] == [(3, *SIZE), (3, *OTHER)]
    with pytest.raises(InputError, match="48x36 pixels"):
        found.check_left_images(torch.zeros(1, 3, *OTHER))
    free = GeometryGuidance.from_views([(None, K, E2), *views[1:]])
    free.check_left_images(torch.zeros(1, 3, 40, 50))
    with pytest.raises(InputError, match="50x40 pixels"):
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
        np.testing.assert_array_equal(made.inputs[0].left.K, K)


#: What the estimation of poses reports.
OF_PHOTOS = (Finding("estimate.plane", "One plane."), Finding("camera.from-exif", "Of EXIF."))


@pytest.fixture
def estimated(monkeypatch):
    """Two right cameras that matching would have found, and what was asked for."""
    asked = {}

    def estimate(images, known, **named):
        count = len(images)
        asked.update(images=images, known=known, named=named)
        return SimpleNamespace(
            size_left=(48, 36),
            Ks=(K, K, K_WIDE)[:count],
            Es=(E1, E2)[: count - 1],
            scale=SimpleNamespace(unit=asked.get("unit")),
            findings=OF_PHOTOS,
        )

    monkeypatch.setattr(module, "estimate_rig", estimate)
    return asked


@pytest.mark.parametrize("unit", ["m", None])
def test_images_become_views_with_the_estimated_cameras(estimated, unit):
    estimated["unit"] = unit
    length = (1.0, 2.0, 3.0, 4.0, 0.5)
    found = GeometryGuidance.from_unposed_images(
        [LEFT, RIGHT, WIDE],
        known_length=length,
        K=[K, K, K_WIDE],
        fov=55.0,
        points=POINTS,
        cropped=True,
        guidance_steps=4,
    )
    images = estimated["images"]
    assert len(images) == 3 and images[0] is LEFT and images[1] is RIGHT and images[2] is WIDE
    known = estimated["known"]
    assert known.baseline_m is None and known.known_length is length and known.points is POINTS
    named = estimated["named"]
    assert [matrix is given for matrix, given in zip(named["K"], (K, K, K_WIDE), strict=True)] == [True] * 3
    assert named["fov"] == 55.0 and named["cropped"] is True
    assert found.unit == unit and found.measured_baseline is True and found.config.guidance_steps == 4
    assert (found.inputs[0].points is None) == (unit is None)
    np.testing.assert_allclose([rig.E for rig in found.rigs], [E1, E2], atol=1e-12)
    assert [rig.K_right[0, 0] for rig in found.rigs] == [50.0, 70.0]
    assert found.estimated.size_left == (48, 36) and found.findings == list(OF_PHOTOS)
    with pytest.raises(InputError, match="48x36 pixels"):
        found.check_left_images(torch.zeros(1, 3, *OTHER))


@pytest.mark.parametrize("form", ["two", "tuple"])
def test_two_images_have_one_K_or_one_each(estimated, monkeypatch, form):
    parallel = pose((0.2, 0, 0))
    monkeypatch.setattr(
        module,
        "estimate_rig",
        lambda images, known, **named: (
            estimated.update(known=known, named=named)
            or SimpleNamespace(
                size_left=(48, 36),
                Ks=(K, K),
                Es=(parallel,),
                scale=SimpleNamespace(unit="m"),
                findings=OF_PHOTOS,
            )
        ),
    )
    pair = (LEFT, RIGHT) if form == "two" else ((LEFT, RIGHT),)
    named = dict(zip(("left", "right"), pair, strict=False))
    found = GeometryGuidance.from_unposed_images(**named, K=K, baseline_m=0.2)
    assert estimated["named"]["K"] is K and estimated["known"].baseline_m == 0.2
    assert estimated["named"]["cropped"] is False and estimated["named"]["fov"] is None
    assert found.findings == [SAME_CENTRE, *OF_PHOTOS]
    found = GeometryGuidance.from_unposed_images(*pair, K=K, K_right=K_WIDE)
    first, second = estimated["named"]["K"]
    assert first is K and second is K_WIDE and found.findings == list(OF_PHOTOS)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(
    ("degrees", "parallel"), [(0.0, True), (0.80, True), (-0.80, True), (0.82, False), (-5.0, False)]
)
def test_the_right_centre_is_assumed_of_cameras_that_are_parallel_to_within_a_degree(axis, degrees, parallel):
    """The cosine of the angle is .9999 at .81 degrees."""
    rig, turned = (made_rig(K, K, pose((0.2, 0, 0), angle, axis)) for angle in (degrees, 20.0))
    for rigs in ([rig], [turned, rig], [rig, turned]):
        assert assumed_centre(rigs) == ([SAME_CENTRE] if parallel else [])
    assert assumed_centre([]) == []
    made = GeometryGuidance(RIGHT, K, rig.E)
    assert made.findings == assumed_centre([rig])
    for given in ((K, K), [K, K]):
        assert GeometryGuidance(RIGHT, given, rig.E).findings == []


def test_defaults_of_a_guidance():
    found = GeometryGuidance(RIGHT, K, E1)
    assert found.unit == "m" and found.measured_baseline is False and found.evidence_store is None
    assert found.estimated is None and found.as_stored is False and found.config == DEFAULT
    with pytest.raises(InputError, match="left_size"):
        GeometryGuidance(RIGHT, K, E1, left_size=(48,))
    with pytest.raises(InputError, match="optimizer must be one of"):
        GeometryGuidance(RIGHT, K, E1, optimizer="unknown")
    with pytest.raises(InputError, match="a key of weights must be one of"):
        GeometryGuidance(RIGHT, K, E1, weights={"matches": 1.0, "unknown": 0.0})


def test_holes_are_made_if_there_is_a_threshold_and_nothing_is_filled():
    for given, makes in (
        ({}, False),
        ({"min_confidence": 0.5}, True),
        ({"max_sigma": 0.1}, True),
        ({"min_confidence": 0.5, "fill": True}, False),
        ({"min_confidence": 0.0, "max_sigma": None, "fill": True}, False),
    ):
        found = GeometryGuidance(RIGHT, K, E1, **given)
        assert found.makes_holes is makes
        assert (found.min_confidence, found.max_sigma) == (
            given.get("min_confidence", 0.0),
            given.get("max_sigma"),
        )


@pytest.mark.parametrize(
    ("parameters", "latents", "network", "plan"),
    [
        ({}, False, False, (0, 0.75, 0.03)),
        ({"guidance_steps": 5}, True, False, (5, 0.75, 0.03)),
        ({"guidance_steps": 5, "gradient": "full"}, True, True, (5, 0.0, 0.1)),
        ({"guidance_steps": 5, "gradient": "full", "optimize_latents": False}, False, False, (5, 0.0, 0.1)),
        ({"guidance_steps": 0, "gradient": "full"}, False, False, (0, 0.0, 0.1)),
        ({"fit_matches": False}, True, False, (40, 0.0, 0.1)),
        ({"weights": {"photometric": 1.0, "points": 1.0}, "lr_latents": 0.2}, True, False, (40, 0.0, 0.2)),
    ],
)
def test_what_the_updates_move(parameters, latents, network, plan):
    found = GeometryGuidance(RIGHT, K, E1, **parameters)
    assert found.moves_latents is latents and found.through_network is network
    assert (found.updates.guidance_steps, found.updates.updates_from, found.updates.lr_latents) == plan
    run = found.as_run()
    assert (run.guidance_steps, run.lr_latents) == (plan[0], plan[2])
    assert run == found.config.changed(guidance_steps=plan[0], lr_latents=plan[2])


def test_points_count_among_what_the_updates_can_be_spared_for():
    weights = {"photometric": 1.0, "points": 1.0}
    with_points = GeometryGuidance(RIGHT, K, E1, points=POINTS, weights=weights)
    assert with_points.updates.guidance_steps == 0
    assert GeometryGuidance(RIGHT, K, E1, weights=weights).updates.guidance_steps == 40


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
    with pytest.raises(InputError, match="image must be 48x36 pixels, like the left view; got 36x48"):
        sized.check_left_images(torch.zeros(1, 3, 48, 36))


def test_K_of_the_left_image_is_checked_by_its_principal_point_unless_the_right_image_was_reported():
    off = K.copy()
    off[0, 2] = 55.0  # within 60 columns, not within 48
    batch = GeometryGuidance([WIDE, RIGHT], [(off, K_WIDE), (K, K)], [E1, E2])
    with pytest.raises(
        InputError, match=r"K\[0\] has its principal point at \(55.0, 17.5\), outside the left image \(48x36"
    ):
        batch.check_left_images(torch.zeros(2, 3, *SIZE))
    other = GeometryGuidance([RIGHT, WIDE], [(K, K), (off, K_WIDE)], [E1, E2])
    with pytest.raises(InputError, match=r"K\[1\] has"):
        other.check_left_images(torch.zeros(2, 3, *SIZE))
    single = GeometryGuidance(WIDE, (off, K_WIDE), E1)
    with pytest.raises(InputError, match=r"^K has its principal point"):
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

    def plan(*given):
        calls.append(given)
        number = len(calls)
        return SimpleNamespace(complete=lambda: f"complete {number}")

    monkeypatch.setattr(module, "plan_evidence", plan)
    found = GeometryGuidance([RIGHT, WIDE], [K, (K, K_WIDE)], [E1, E2], measured_baseline=True)
    if has_store:
        monkeypatch.setattr(module, "plan_evidence", None)
        found.evidence_store = SimpleNamespace(get=plan)
    lefts = torch.rand(2, 3, *SIZE)
    assert found.prepare(lefts) == ["complete 1", "complete 2"]
    for i, (left, given, config, measured, checked) in enumerate(calls):
        assert torch.equal(left, lefts[i]) and given is found.inputs[i]
        assert config is found.config and measured is True and checked is None
    with pytest.raises(InputError, match="right must be a list of 1 images"):
        found.prepare(lefts[:1])
    assert len(calls) == 2


VIEWS, KNOWN = {"right": RIGHT, "K": K, "E": E1}, {"right": None, "K": K, "E": None, "points": POINTS}
BOTH = VIEWS | {"points": POINTS}


@pytest.mark.parametrize(
    ("given", "parameters", "refused"),
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
            "weights must be above 0 for a term supported by the given input",
        ),
        (KNOWN, {"weights": {"matches": 1.0}, "guidance_steps": 0}, None),
        (KNOWN, {"weights": {"matches": 1.0}, "guidance_steps": 3}, "weights must be above 0"),
        (KNOWN, {"weights": {"matches": 1.0, "points": 0.1}}, None),
        (KNOWN, {"weights": {"matches": 1.0, "points": 0.0}}, "weights must be above 0"),
        (KNOWN, {"weights": {"affine_reg": 1.0}}, None),
        (VIEWS, {"weights": {"points": 1.0}}, "weights must be above 0"),
        (VIEWS, {"weights": {"points": 1.0}, "guidance_steps": 0}, None),
        (VIEWS, {"weights": {"photometric": 1.0}}, None),
        (VIEWS, {"weights": {"matches": 1.0}}, None),
        (VIEWS, {"weights": {}}, "weights must be above 0"),
        (BOTH, {"weights": {"points": 1.0}}, None),
    ],
)
def test_search_and_terms_need_what_they_work_on(given, parameters, refused):
    if refused is None:
        assert GeometryGuidance(**given, **parameters).config == DEFAULT.changed(**parameters)
        return
    with pytest.raises(InputError, match=refused):
        GeometryGuidance(**given, **parameters)


SIZE_GUIDANCE = (48, 64)
K_GUIDANCE = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
I4, E, E2_GUIDANCE, UP = np.eye(4), np.eye(4), np.eye(4), np.eye(4)
E[0, 3], E2_GUIDANCE[0, 3], UP[1, 3] = 0.12, 0.2, -0.2
RIGHT_GUIDANCE = np.random.default_rng(0).integers(0, 255, (*SIZE_GUIDANCE, 3), dtype=np.uint8)
POINTS_GUIDANCE = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [0.0, 0.1, 4.0]])


def put(matrix, index, value):
    matrix = np.array(matrix)
    matrix[index] = value
    return matrix


K_OFF, K_SHIFTED = put(K_GUIDANCE, (0, 2), 900.0), put(K_GUIDANCE, (0, 2), 36.5)


def said_by(make) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize(
    ("K_given", "E_given"),
    [
        (K_GUIDANCE.tolist(), E.tolist()),
        ([K_GUIDANCE.tolist(), K_GUIDANCE.tolist()], [I4.tolist(), E.tolist()]),
        (K_GUIDANCE, E[:3].tolist()),
        (K_GUIDANCE, (UP, UP @ E)),
        (K_GUIDANCE, put(E, (slice(3), slice(3)), 1.0004 * np.eye(3))),  # nearly rigid
        (torch.from_numpy(K_GUIDANCE).half(), torch.from_numpy(E).bfloat16()),
    ],
)
def test_forms_of_the_cameras(K_given, E_given):
    given = GeometryGuidance(RIGHT_GUIDANCE, K_given, E_given)
    (rig,), ((view,),) = given.rigs, [entry.views for entry in given.inputs]
    np.testing.assert_allclose(rig.K_left, K_GUIDANCE, atol=1e-2)
    np.testing.assert_allclose(rig.E, E, atol=1e-3)
    np.testing.assert_allclose(rig.E[:3, :3] @ rig.E[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(view.T_right_from_left @ rig.E, I4, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "lengths"),
    [
        (
            {
                "right": [RIGHT_GUIDANCE, RIGHT_GUIDANCE],
                "K": [K_GUIDANCE, (K_GUIDANCE, K_GUIDANCE)],
                "E": [E, E2_GUIDANCE],
            },
            [0.12, 0.2],
        ),
        (
            {
                "right": RIGHT_GUIDANCE,
                "K": [K_GUIDANCE, K_GUIDANCE],
                "E": [E, E2_GUIDANCE],
                "points": [POINTS_GUIDANCE, POINTS_GUIDANCE],
            },
            [0.12, 0.2],
        ),
        (
            {
                "right": [(RIGHT_GUIDANCE, RIGHT_GUIDANCE), (RIGHT_GUIDANCE,)],
                "K": K_GUIDANCE,
                "E": [(I4, E, E2_GUIDANCE), (I4, E)],
            },
            [0.12, 0.2, 0.12],
        ),
    ],
)
def test_a_list_has_one_entry_per_left_image(arguments, lengths):
    assert [rig.E[0, 3] for rig in GeometryGuidance(**arguments).rigs] == lengths


def test_views_in_any_world_frame():
    world = put(I4, (slice(3), 3), 3.0)
    views = [
        (RIGHT_GUIDANCE, K_GUIDANCE, world),
        (RIGHT_GUIDANCE, K_GUIDANCE, world @ E),
        (RIGHT_GUIDANCE, K_SHIFTED, world @ UP),
    ]
    guidance = GeometryGuidance.from_views(views, guidance_steps=3)
    assert guidance.config.guidance_steps == 3 and guidance.rigs[1].K_right[0, 2] == 36.5
    np.testing.assert_allclose([rig.E for rig in guidance.rigs], [E, UP], atol=1e-12)
    with pytest.raises(ValueError, match="at least two; got 1. A single image has no metric scale"):
        GeometryGuidance.from_views(views[:1])
    with pytest.raises(ValueError, match="image must be 64x48 pixels, like the left view; got 32x24"):
        guidance.prepare(torch.zeros(1, 3, 24, 32))
    with pytest.raises(ValueError, match="right must be a list of 2 images"):
        guidance.prepare(torch.rand(2, 3, *SIZE_GUIDANCE))
    with pytest.raises(ValueError, match="as the images differ in size; got one matrix"):
        GeometryGuidance(RIGHT_GUIDANCE, K_GUIDANCE, E).prepare(torch.zeros(1, 3, 24, 32))


def test_points_of_either_form():
    sparse = np.zeros(SIZE_GUIDANCE)
    sparse[3, 4], sparse[5, 6], sparse[7, 8] = 2.0, np.nan, np.inf
    cloud = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, torch.nan]])
    both = GeometryGuidance(None, K_GUIDANCE, points=[sparse, cloud])
    assert [tuple(given.points.shape) for given in both.inputs] == [SIZE_GUIDANCE, (1, 3)]
    assert both.inputs[0].points.sum() == 2.0
    (typed,) = GeometryGuidance.from_points(
        [[0, 0, 2], [1, 0, 3]], K_GUIDANCE
    ).inputs  # whole metres typed by hand
    np.testing.assert_array_equal(typed.points.numpy(), [[0.0, 0.0, 2.0], [1.0, 0.0, 3.0]])
    for points, hint in (
        ([[0, 0, 2]], "Metres as integers are truncated: pass floats"),
        (np.full(SIZE_GUIDANCE, 2), "1000 for millimetres"),
    ):
        with pytest.raises(InputError, match=f"points must be metres as floats; got dtype .*{hint}"):
            GeometryGuidance.from_points(torch.from_numpy(np.asarray(points, np.int64)), K_GUIDANCE)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"K": "calib.txt"}, TypeError, "K must be"),
        ({"K": K_OFF}, ValueError, "a different resolution"),
        ({"E": put(E, (0, 0), 2.0)}, ValueError, "rigid"),
        ({"right": RIGHT_GUIDANCE.astype(np.float32)}, ValueError, "right"),
        ({"right": None}, ValueError, "right must be an image, or None together with points"),
        ({"right": None, "points": POINTS_GUIDANCE}, ValueError, "E must be None without a right view"),
        ({"right": [RIGHT_GUIDANCE, RIGHT_GUIDANCE], "E": [E]}, ValueError, "E must be a list of 2 entries"),
        ({"right": (RIGHT_GUIDANCE, RIGHT_GUIDANCE)}, TypeError, "E must be a tuple"),
        (
            {"right": (RIGHT_GUIDANCE, RIGHT_GUIDANCE), "E": (I4, E)},
            ValueError,
            "right views: 2. Put np.eye",
        ),
        (
            {"right": [RIGHT_GUIDANCE, None], "E": [E, None], "points": [POINTS_GUIDANCE] * 2},
            ValueError,
            "right must be passed",
        ),
        ({"left_size": "64x48"}, TypeError, "left_size must be"),
        ({"unit": "mm"}, ValueError, "unit must be 'm' or None"),
        ({"min_confidence": 80}, ValueError, "min_confidence must be between 0 and 1; got 80"),
        ({"min_confidence": "0.8"}, TypeError, "min_confidence must be"),
        ({"max_sigma": 0}, ValueError, "max_sigma must be a finite number of metres above 0"),
        ({"max_sigma": -1, "fill": True}, ValueError, "max_sigma must be a finite number of metres above 0"),
        (
            {"max_sigma": 0.1, "preset": "search-only"},
            ValueError,
            "need a confidence, which is not computed with refine_edges=False. Use a preset",
        ),
        ({"config": {"gradient": "full"}}, TypeError, "config must be a GuidanceConfig"),
        ({"preset": "best"}, ValueError, "preset must be one of default"),
        ({"preset": "paper", "config": PAPER}, ValueError, "preset must be None if config is given"),
        ({"search": "one-number", "weights": {"matches": 1.0}}, ValueError, "photometric weight"),
        ({"search": "points-range"}, ValueError, "'points-range' needs points"),
        (
            {"right": None, "E": None, "points": POINTS_GUIDANCE, "weights": {"matches": 1}},
            ValueError,
            "weights must",
        ),
    ],
)
def test_bad_input_names_the_argument(changes, error, message):
    with pytest.raises(error, match=message) as caught:
        GeometryGuidance(**({"right": RIGHT_GUIDANCE, "K": K_GUIDANCE, "E": E} | changes))
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize(
    ("fx", "fy", "cx", "cy", "words"),
    [
        (120, 120, 63.5, 47.5, "a different resolution"),
        (120, 120, 47.5, 35.5, "an image 1.5 times the size"),
        (60, 600, 31.5, 23.5, "pixels are usually square"),
        (60, 60, 38, 17, None),  # of a rig with converging axes
        (60, 40, 31.5, 23.5, None),  # of an image that was stretched
    ],
)
def test_intrinsics_of_another_size_or_mistyped(fx, fy, cx, cy, words):
    odd = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    sentences = said_by(lambda: GeometryGuidance(RIGHT_GUIDANCE, odd, E))
    assert [words in sentence for sentence in sentences] == ([] if words is None else [True])


def test_a_crop_is_reported():
    off, lefts = put(K_GUIDANCE, (0, 2), -40.0), torch.rand(1, 3, *SIZE_GUIDANCE)
    views, points = [(RIGHT_GUIDANCE, off, I4), (RIGHT_GUIDANCE, off, E)], np.full(SIZE_GUIDANCE, 2.0)
    for make, message in (
        (lambda **more: GeometryGuidance(RIGHT_GUIDANCE, off, E, **more), "outside"),
        (lambda **more: GeometryGuidance.from_views(views, **more), "the left view's image"),
        (lambda **more: GeometryGuidance.from_points(points, off, **more), "outside the left image"),
    ):
        with pytest.raises(ValueError, match=message):
            make().prepare(lefts)
        assert len(make(cropped=True).prepare(lefts)) == 1


def test_from_calibration_checks_sizes_and_remembers_warnings(tmp_path):
    camera, file = "[120 0 63.5; 0 120 47.5; 0 0 1]", tmp_path / "calib.txt"
    file.write_text(f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=120\nwidth=128\nheight=96\n")
    with (
        pytest.warns(UserWarning, match="near the border"),
        pytest.raises(ValueError, match="right must be 128x96 pixels.*64x48"),
    ):
        GeometryGuidance.from_calibration(RIGHT_GUIDANCE, file)
    whole = GeometryGuidance.from_calibration(np.zeros((96, 128, 3), np.uint8), file)
    with pytest.raises(ValueError, match="image must be 128x96 pixels"):
        whole.prepare(torch.rand(1, 3, *SIZE_GUIDANCE))
    with pytest.warns(UserWarning, match="baseline"):
        guidance = GeometryGuidance.from_views(
            [(None, K_GUIDANCE, I4), (RIGHT_GUIDANCE, K_GUIDANCE, put(E, (0, 3), 120.0))]
        )
    assert [message.code for message in guidance.findings] == ["baseline.long"]


def test_parameters_and_presets(tmp_path):
    guidance = GeometryGuidance(RIGHT_GUIDANCE, K_GUIDANCE, E, guidance_steps=10, smoothness=5.0)
    assert guidance.config == DEFAULT.changed(guidance_steps=10, smoothness=5.0)
    assert GeometryGuidance(RIGHT_GUIDANCE, K_GUIDANCE, E).as_run().guidance_steps == 0
    for name in ("default", "paper", "search-only", "prior-fit"):
        assert GeometryGuidance(RIGHT_GUIDANCE, K_GUIDANCE, E, preset=name).config == PRESETS[name]
    assert GeometryGuidance.paper(RIGHT_GUIDANCE, K_GUIDANCE, E).config == PAPER
    assert GeometryGuidance.search_only(RIGHT_GUIDANCE, K_GUIDANCE, E).config == PRESETS["search-only"]
    assert GeometryGuidance.marigold_dc(POINTS_GUIDANCE, K_GUIDANCE).config == PRESETS["marigold-dc"]
    guidance.config.save(tmp_path / "guidance.json")
    again = GeometryGuidance(
        RIGHT_GUIDANCE, K_GUIDANCE, E, config=GuidanceConfig.load(tmp_path / "guidance.json"), ssim_weight=0.5
    )
    assert again.config == guidance.config.changed(ssim_weight=0.5)
