"""``GeometryGuidance``: the forms of its arguments, refusals, warnings, constructors and presets."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError
from geodiff_plugin.config import DEFAULT, PAPER, PRESETS, GuidanceConfig

SIZE = (48, 64)
K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
I4, E, E2, UP = np.eye(4), np.eye(4), np.eye(4), np.eye(4)
E[0, 3], E2[0, 3], UP[1, 3] = 0.12, 0.2, -0.2
RIGHT = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), dtype=np.uint8)
POINTS = np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 3.0], [0.0, 0.1, 4.0]])


def put(matrix, index, value):
    matrix = np.array(matrix)
    matrix[index] = value
    return matrix


K_OFF, K_SHIFTED = put(K, (0, 2), 900.0), put(K, (0, 2), 36.5)


def said_by(make) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    return [str(warning.message) for warning in caught]


@pytest.mark.parametrize(
    ("K_given", "E_given"),
    [
        (K.tolist(), E.tolist()),
        ([list(row) for row in K.astype(np.float32)], E),
        ([K, K], E),
        ([K.tolist(), K.tolist()], [I4.tolist(), E.tolist()]),
        ((K, K), [I4, E]),
        (K, E[:3]),
        (K, E[:3].tolist()),
        (K, (I4[:3], E[:3])),
        (K, (UP, UP @ E)),
        (K, put(E, (slice(3), slice(3)), 1.0004 * np.eye(3))),  # nearly rigid
        (K, torch.from_numpy(E).bfloat16()),
        (torch.from_numpy(K).half(), torch.from_numpy(E).float()),
    ],
)
def test_forms_of_the_cameras(K_given, E_given):
    given = GeometryGuidance(RIGHT, K_given, E_given)
    (rig,), ((view,),) = given.rigs, [entry.views for entry in given.inputs]
    assert rig.K_left is not K_given  # the caller may go on to change theirs
    np.testing.assert_allclose(rig.K_left, K, atol=1e-2)
    np.testing.assert_allclose(rig.E, E, atol=1e-3)
    np.testing.assert_allclose(rig.E[:3, :3] @ rig.E[:3, :3].T, np.eye(3), atol=1e-9)
    assert view.K.dtype == view.T_right_from_left.dtype == torch.float32
    np.testing.assert_allclose(view.T_right_from_left.numpy() @ rig.E, I4, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "lengths", "focals"),
    [
        ({"right": [RIGHT, RIGHT], "K": [K, (K, K)], "E": [E, E2]}, [0.12, 0.2], [60, 60]),
        ({"right": [RIGHT, RIGHT], "K": [K, np.diag([2, 2, 1]) @ K - K_OFF * 0], "E": E}, [0.12] * 2, None),
        ({"right": RIGHT, "K": [K, K], "E": [E, E2], "points": [POINTS, POINTS]}, [0.12, 0.2], [60, 60]),
        (
            {"right": [(RIGHT, RIGHT), (RIGHT,) * 3], "K": K, "E": [(I4, E, E2), (I4, E, E2, E)]},
            [0.12, 0.2, 0.12, 0.2, 0.12],
            [60] * 5,
        ),
        ({"right": RIGHT, "K": (K, K_SHIFTED), "E": E}, [0.12], [60]),
    ],
    ids=["lists", "sizes", "points", "views", "two-K"],
)
@pytest.mark.filterwarnings("ignore:K.*principal point")
def test_a_list_has_one_entry_per_left_image(arguments, lengths, focals):
    rigs = GeometryGuidance(**arguments).rigs
    assert [rig.E[0, 3] for rig in rigs] == lengths
    assert focals is None or [rig.K_left[0, 0] for rig in rigs] == focals


def test_views_in_any_world_frame():
    world = put(I4, (slice(3), 3), 3.0)
    views = [(RIGHT, K, world), (RIGHT, K, world @ E), (RIGHT, K_SHIFTED, world @ UP)]
    guidance = GeometryGuidance.from_views(views, inner_steps=3)
    assert guidance.config.inner_steps == 3 and len(guidance.rights) == 2
    np.testing.assert_allclose([rig.E for rig in guidance.rigs], [E, UP], atol=1e-12)
    assert guidance.rigs[1].K_right[0, 2] == 36.5 and guidance.rigs[1].K_left[0, 2] == 31.5
    with pytest.raises(ValueError, match="image must be of 64x48 pixels, as the left view; got 32x24"):
        guidance.prepare(torch.zeros(1, 3, 24, 32))


def test_points_of_either_form():
    sparse = np.zeros(SIZE)
    sparse[3, 4], sparse[5, 6], sparse[7, 8] = 2.0, np.nan, np.inf
    (given,) = GeometryGuidance.from_points(sparse, K).inputs
    assert given.views == () and given.points.shape == SIZE and given.points.sum() == 2.0
    cloud = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, torch.nan]])
    (given,) = GeometryGuidance(RIGHT, K, E, points=cloud).inputs
    assert given.points.shape == (1, 3) and len(given.views) == 1
    both = GeometryGuidance(None, K, points=[sparse, cloud])
    assert [tuple(given.points.shape) for given in both.inputs] == [SIZE, (1, 3)]
    (typed,) = GeometryGuidance.from_points([[0, 0, 2], [1, 0, 3]], K).inputs  # whole metres typed by hand
    np.testing.assert_array_equal(typed.points.numpy(), [[0.0, 0.0, 2.0], [1.0, 0.0, 3.0]])


@pytest.mark.parametrize("dtype", [np.int64, np.uint16])
@pytest.mark.parametrize(
    ("points", "cure"),
    [
        ([[0, 0, 2], [1, 0, 3]], "keep them floats"),
        ([[0, 0, 2, 9], [1, 0, 3, 9]], "keep them floats"),
        (np.full(SIZE, 2), "1000 for millimetres"),
    ],
)
def test_integer_points_are_refused_as_an_integer_map_is(dtype, points, cure):
    array = np.asarray(points, dtype)
    for value in (array, torch.from_numpy(array)):
        with pytest.raises(InputError, match=f"points must be metres as floats; got dtype .*{cure}"):
            GeometryGuidance.from_points(value, K)
    with pytest.raises(InputError, match=r"points\[1\] must be metres as floats"):
        GeometryGuidance.from_points([np.ones((2, 3)), array], K)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"K": np.eye(4)}, ValueError, "K must be a 3x3"),
        ({"K": np.zeros((2, 3, 3))}, ValueError, "K must be a 3x3"),
        ({"K": "calib.txt"}, TypeError, "K must be"),
        ({"K": put(K, (0, 0), 0.0)}, ValueError, "focal"),
        ({"K": K_OFF}, ValueError, "another resolution"),
        ({"K": put(K, (1, 1), np.nan)}, ValueError, "finite"),
        ({"E": np.eye(3)}, ValueError, "E must be a 4x4"),
        ({"E": [[1, 0, 0, 0.1], [0, 1, 0], [0, 0, 1, 0]]}, TypeError, "E must be a 4x4 matrix.*got list"),
        ({"E": I4}, ValueError, "baseline"),
        ({"E": put(E, (0, 0), 2.0)}, ValueError, "rigid"),
        ({"E": put(E, (0, 0), -1.0)}, ValueError, "rigid"),
        ({"E": put(E, (3, 0), 0.1)}, ValueError, "last row"),
        ({"E": put(E, (1, 3), np.inf)}, ValueError, "finite"),
        ({"right": RIGHT.astype(np.float32)}, ValueError, "right"),
        ({"right": []}, ValueError, "right"),
        ({"right": None}, ValueError, "right must be an image, or None together with points"),
        ({"right": None, "points": POINTS}, ValueError, "E must be None without a right view"),
        ({"right": [RIGHT, RIGHT], "E": [E]}, ValueError, "E must be a list of 2 entries"),
        ({"right": (RIGHT, RIGHT)}, TypeError, "E must be a tuple"),
        ({"right": (RIGHT, RIGHT), "E": (I4, E)}, ValueError, "a tuple of 2 for 2 right views"),
        ({"right": (RIGHT,) * 2, "K": (K, K), "E": (I4, E, E)}, ValueError, "a tuple of 2 for 2 right"),
        (
            {"right": [RIGHT, None], "E": [E, None], "points": [POINTS] * 2},
            ValueError,
            "right must be given for every left image or for none",
        ),
        (
            {"right": [RIGHT] * 2, "points": [POINTS, None]},
            ValueError,
            "points must be given for every left image or for none",
        ),
        ({"points": "cloud.ply"}, TypeError, "points"),
        ({"points": np.ones((4, 2))}, ValueError, "points must be a sparse depth map"),
        ({"points": np.zeros(SIZE)}, ValueError, "at least one of them known"),
        ({"left_size": "64x48"}, TypeError, "left_size must be"),
        ({"left_size": (64,)}, TypeError, "left_size must be"),
        ({"left_size": (64, 0)}, ValueError, "left_size must be"),
        ({"left_size": (6.5, 4)}, TypeError, "left_size must be"),
        ({"unit": "mm"}, ValueError, "unit must be 'm' or None"),
        ({"rule": "sgd"}, ValueError, "rule"),
        ({"pose": np.zeros(3)}, ValueError, "pose must be one of"),
        ({"weights": {"smooth": 1.0}}, ValueError, "weights"),
        ({"smoothnes": 1.0}, ValueError, "smoothnes.*Did you mean smoothness"),
        ({"config": {"gradient": "full"}}, TypeError, "config must be a GuidanceConfig"),
        ({"preset": "fast"}, ValueError, "preset must be one of default"),
        ({"preset": "paper", "config": PAPER}, ValueError, "preset must be None beside config"),
        ({"search": "one-number", "weights": {"matches": 1.0}}, ValueError, "photometric weight"),
        ({"search": "points-range"}, ValueError, "'points-range' needs points"),
        ({"previous": 3}, TypeError, "previous must be a MetricDepthOutput"),
    ],
)
def test_bad_input_names_the_argument(changes, error, message):
    with pytest.raises(error, match=message) as caught:
        GeometryGuidance(**({"right": RIGHT, "K": K, "E": E} | changes))
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize(
    ("knobs", "message"),
    [
        ({"weights": {"photometric": 1.0, "matches": 1.0}}, "weights must be above 0 for a term"),
        ({"search": "one-number"}, "'one-number' needs a right view"),
    ],
)
def test_points_alone_do_not_feed_every_configuration(knobs, message):
    with pytest.raises(ValueError, match=message):
        GeometryGuidance.from_points(POINTS, K, **knobs)


@pytest.mark.parametrize(
    ("views", "error", "message"),
    [
        ([(RIGHT, K, I4)], ValueError, "views must be a list"),
        ({"left": RIGHT}, TypeError, "views must be a list"),
        ([(RIGHT, K, I4), (RIGHT, K)], ValueError, "views must be a list"),
        ([(RIGHT, K_OFF, I4), (RIGHT, K, E)], ValueError, r"K\[left\] must be for the left view's"),
        ([(None, K, I4), (RIGHT, K, E), (RIGHT, K_OFF, E)], ValueError, r"K\[right view 2\]"),
        ([(None, K, E), (RIGHT, K, E)], ValueError, "baseline"),
    ],
)
def test_bad_views_are_named(views, error, message):
    with pytest.raises(error, match=message):
        GeometryGuidance.from_views(views)


@pytest.mark.parametrize(
    ("fx", "fy", "cx", "cy", "words"),
    [
        (120, 120, 63.5, 47.5, "another resolution"),
        (120, 120, 47.5, 35.5, "an image 1.5 times the size"),
        (40, 40, 15.5, 11.5, "an image 0.48 times the size"),
        (60, 600, 31.5, 23.5, "mistyped"),
        (60, 60, 38, 17, None),  # of a rig with converging axes
        (60, 40, 31.5, 23.5, None),  # of an image that was stretched
    ],
)
def test_intrinsics_of_another_size_or_mistyped(fx, fy, cx, cy, words):
    odd = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    sentences = said_by(lambda: GeometryGuidance(RIGHT, odd, E))
    assert [words in sentence for sentence in sentences] == ([] if words is None else [True])


@pytest.mark.parametrize(
    ("rights", "cameras", "names"),
    [
        (RIGHT, lambda K: K, ["K"]),
        (RIGHT, lambda K: (K, K), ["K[right]"]),
        ((RIGHT, RIGHT), lambda K: K, ["K", "K"]),
        ((RIGHT, RIGHT), lambda K: (K, K, K), ["K[right view 1]", "K[right view 2]"]),
        ([RIGHT, RIGHT], lambda K: K, ["K[0]", "K[1]"]),
    ],
)
def test_warnings_and_errors_name_the_camera_matrix_that_was_given(rights, cameras, names):
    poses = (I4, E, E) if isinstance(rights, tuple) else E
    border = K - [[0, 0, 25], [0, 0, 19], [0, 0, 0]]
    sentences = said_by(lambda: GeometryGuidance(rights, cameras(border), poses))
    assert [sentence.split(" has its principal point")[0] for sentence in sentences] == names
    with pytest.raises(InputError) as refused:
        GeometryGuidance(rights, cameras(K + [[0, 0, 90], [0, 0, 0], [0, 0, 0]]), poses)
    assert str(refused.value).startswith(f"{names[0]} must be for the right image")


def test_what_else_is_suspected():
    assert "millimetres" in said_by(lambda: GeometryGuidance.from_baseline(RIGHT, K, 120.0))[0]
    assert not said_by(lambda: GeometryGuidance.from_baseline(RIGHT, K, 120.0, unit=None))
    dark = RIGHT.astype(np.uint16) * 4
    (sentence,) = said_by(lambda: GeometryGuidance.from_views([(dark, K, I4), (dark, K, E)]))
    assert sentence.startswith("right is a 16-bit image that is nearly black")
    picture = Image.fromarray(RIGHT)
    picture.getexif().get_ifd(0x8769)[0xA405] = 32  # 59 px for 64x48
    assert not said_by(lambda: GeometryGuidance(picture, K, E))
    wrong = K * np.array([[1.5, 1.5, 1], [1.5, 1.5, 1], [1, 1, 1]])
    (sentence,) = said_by(lambda: GeometryGuidance(picture, wrong, E))
    assert "right, 1.53 times the 59 px of its EXIF" in sentence or "right, 1.5" in sentence


def test_a_crop_says_so():
    off, lefts = put(K, (0, 2), -40.0), torch.rand(1, 3, *SIZE)
    views, points = [(RIGHT, off, I4), (RIGHT, off, E)], np.full(SIZE, 2.0)
    for make, message in (
        (lambda **more: GeometryGuidance(RIGHT, off, E, **more), "outside"),
        (lambda **more: GeometryGuidance.from_views(views, **more), "the left view's image"),
        (lambda **more: GeometryGuidance.from_points(points, off, **more), "K must be for the left image"),
    ):
        with pytest.raises(ValueError, match=message):
            make().prepare(lefts)
        assert len(make(cropped=True).prepare(lefts)) == 1


def test_the_left_size_is_asked_for_and_may_be_a_list():
    assert len(GeometryGuidance(RIGHT, K, E, left_size=[64, 48]).prepare(torch.rand(1, 3, *SIZE))) == 1
    with pytest.raises(ValueError, match="right must be a list of 2 images"):
        GeometryGuidance(RIGHT, K, E).prepare(torch.rand(2, 3, *SIZE))


def test_from_calibration_picks_the_cameras_and_checks_sizes(tmp_path):
    lines = []
    for number, shift in enumerate((0.0, 0.5, 0.0, 0.3)):
        row = [60.0, 0, 31.5, -60.0 * shift, 0, 60.0, 23.5, 0, 0, 0, 1, 0]
        lines.append(f"P{number}: " + " ".join(map(str, row)))
    (tmp_path / "kitti.txt").write_text("\n".join(lines) + "\n")
    for cameras, baseline in (((0, 1), 0.5), ((2, 3), 0.3)):
        guidance = GeometryGuidance.from_calibration(RIGHT, tmp_path / "kitti.txt", cameras)
        assert guidance.rigs[0].E[0, 3] == pytest.approx(baseline)
        np.testing.assert_allclose(guidance.rigs[0].K_left, K)
    camera, file = "[120 0 63.5; 0 120 47.5; 0 0 1]", tmp_path / "calib.txt"
    file.write_text(f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=120\nwidth=128\nheight=96\n")
    with (
        pytest.warns(UserWarning, match="near the border"),
        pytest.raises(ValueError, match="right must be of 128x96 pixels.*64x48"),
    ):
        GeometryGuidance.from_calibration(RIGHT, file)
    whole = GeometryGuidance.from_calibration(np.zeros((96, 128, 3), np.uint8), file)
    with pytest.raises(ValueError, match="image must be of 128x96 pixels"):
        whole.prepare(torch.rand(1, 3, *SIZE))


def test_knobs_and_presets(tmp_path):
    guidance = GeometryGuidance(RIGHT, K, E, inner_steps=10, smoothness=5.0)
    assert guidance.config == DEFAULT.changed(inner_steps=10, smoothness=5.0)
    assert GeometryGuidance(RIGHT, K, E, config=PAPER).config == PAPER
    for name in ("default", "paper", "search-only", "prior-fit"):
        assert GeometryGuidance(RIGHT, K, E, preset=name).config == PRESETS[name]
    assert GeometryGuidance.paper(RIGHT, K, E).config == PAPER
    assert GeometryGuidance.search_only(RIGHT, K, E).config == PRESETS["search-only"]
    assert GeometryGuidance.marigold_dc(POINTS, K).config == PRESETS["marigold-dc"]
    guidance.config.save(tmp_path / "guidance.json")
    again = GeometryGuidance(RIGHT, K, E, config=GuidanceConfig.load(tmp_path / "guidance.json"), eta=0.5)
    assert again.config == guidance.config.changed(eta=0.5)


def test_automatic_choices_are_settled_for_what_is_given(textured_plane):
    guidance = GeometryGuidance(RIGHT, K, E)
    assert guidance.config.inner_steps is None and guidance.updates.inner_steps == 0
    assert guidance.as_run().inner_steps == 0
    only_points = {"weights": {"points": 1.0, "photometric": 1.0}}
    assert GeometryGuidance(RIGHT, K, E, **only_points).updates.inner_steps == 40
    assert GeometryGuidance(RIGHT, K, E, points=POINTS, **only_points).updates.inner_steps == 0
    pair, knobs = textured_plane, {"inner_steps": 0, "correct": False}
    left_01 = torch.from_numpy(pair.left).permute(2, 0, 1)[None] / 255
    for crisp in (True, False):  # the last stage alone asks for matches too
        (evidence,) = GeometryGuidance(pair.right, pair.K, pair.E, **knobs, crisp=crisp).prepare(left_01)
        assert (evidence.matches is not None) == crisp


def test_the_numbers_of_published_presets():
    config = PRESETS["marigold-dc"]
    assert (config.gradient, config.rule, config.min_steps) == ("full", "adam-norm", 50)
    assert (config.step_latents, config.step_affine, config.inner_steps) == (0.05, 0.005, 1)
    assert (config.positive, config.points_loss, config.weights) == ("square", "l1l2", {"points": 1.0})
    assert (PAPER.gradient, PAPER.rule, PAPER.inner_steps) == ("full", "summed", 1)
    assert PAPER.step_latents == PAPER.step_affine == 1e-2
    assert (PAPER.weights, PAPER.eta) == ({"photometric": 1.0, "prior_pull": 1e-2}, 0.85)
    assert (PAPER.pull_to, PAPER.search, PAPER.g_s_range) == ("zero", "one-number", (1.0, 80.0))
