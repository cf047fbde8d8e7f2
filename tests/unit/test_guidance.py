"""``GeometryGuidance``: the forms of its arguments, refusals, warnings, constructors and presets."""

import warnings

import numpy as np
import pytest
import torch

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
        ([K.tolist(), K.tolist()], [I4.tolist(), E.tolist()]),
        (K, E[:3].tolist()),
        (K, (UP, UP @ E)),
        (K, put(E, (slice(3), slice(3)), 1.0004 * np.eye(3))),  # nearly rigid
        (torch.from_numpy(K).half(), torch.from_numpy(E).bfloat16()),
    ],
)
def test_forms_of_the_cameras(K_given, E_given):
    given = GeometryGuidance(RIGHT, K_given, E_given)
    (rig,), ((view,),) = given.rigs, [entry.views for entry in given.inputs]
    np.testing.assert_allclose(rig.K_left, K, atol=1e-2)
    np.testing.assert_allclose(rig.E, E, atol=1e-3)
    np.testing.assert_allclose(rig.E[:3, :3] @ rig.E[:3, :3].T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(view.T_right_from_left.numpy() @ rig.E, I4, atol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "lengths"),
    [
        ({"right": [RIGHT, RIGHT], "K": [K, (K, K)], "E": [E, E2]}, [0.12, 0.2]),
        ({"right": RIGHT, "K": [K, K], "E": [E, E2], "points": [POINTS, POINTS]}, [0.12, 0.2]),
        ({"right": [(RIGHT, RIGHT), (RIGHT,)], "K": K, "E": [(I4, E, E2), (I4, E)]}, [0.12, 0.2, 0.12]),
    ],
)
def test_a_list_has_one_entry_per_left_image(arguments, lengths):
    assert [rig.E[0, 3] for rig in GeometryGuidance(**arguments).rigs] == lengths


def test_views_in_any_world_frame():
    world = put(I4, (slice(3), 3), 3.0)
    views = [(RIGHT, K, world), (RIGHT, K, world @ E), (RIGHT, K_SHIFTED, world @ UP)]
    guidance = GeometryGuidance.from_views(views, inner_steps=3)
    assert guidance.config.inner_steps == 3 and guidance.rigs[1].K_right[0, 2] == 36.5
    np.testing.assert_allclose([rig.E for rig in guidance.rigs], [E, UP], atol=1e-12)
    with pytest.raises(ValueError, match="two at least; got 1. One view alone does not tell metres"):
        GeometryGuidance.from_views(views[:1])
    with pytest.raises(ValueError, match="image must be of 64x48 pixels, as the left view; got 32x24"):
        guidance.prepare(torch.zeros(1, 3, 24, 32))
    with pytest.raises(ValueError, match="right must be a list of 2 images"):
        guidance.prepare(torch.rand(2, 3, *SIZE))
    with pytest.raises(ValueError, match="as the images differ in size; got one matrix"):
        GeometryGuidance(RIGHT, K, E).prepare(torch.zeros(1, 3, 24, 32))


def test_points_of_either_form():
    sparse = np.zeros(SIZE)
    sparse[3, 4], sparse[5, 6], sparse[7, 8] = 2.0, np.nan, np.inf
    cloud = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, torch.nan]])
    both = GeometryGuidance(None, K, points=[sparse, cloud])
    assert [tuple(given.points.shape) for given in both.inputs] == [SIZE, (1, 3)]
    assert both.inputs[0].points.sum() == 2.0
    (typed,) = GeometryGuidance.from_points([[0, 0, 2], [1, 0, 3]], K).inputs  # whole metres typed by hand
    np.testing.assert_array_equal(typed.points.numpy(), [[0.0, 0.0, 2.0], [1.0, 0.0, 3.0]])
    for points, cure in (([[0, 0, 2]], "keep them floats"), (np.full(SIZE, 2), "1000 for millimetres")):
        with pytest.raises(InputError, match=f"points must be metres as floats; got dtype .*{cure}"):
            GeometryGuidance.from_points(torch.from_numpy(np.asarray(points, np.int64)), K)


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"K": "calib.txt"}, TypeError, "K must be"),
        ({"K": K_OFF}, ValueError, "another resolution"),
        ({"E": put(E, (0, 0), 2.0)}, ValueError, "rigid"),
        ({"right": RIGHT.astype(np.float32)}, ValueError, "right"),
        ({"right": None}, ValueError, "right must be an image, or None together with points"),
        ({"right": None, "points": POINTS}, ValueError, "E must be None without a right view"),
        ({"right": [RIGHT, RIGHT], "E": [E]}, ValueError, "E must be a list of 2 entries"),
        ({"right": (RIGHT, RIGHT)}, TypeError, "E must be a tuple"),
        (
            {"right": (RIGHT, RIGHT), "E": (I4, E)},
            ValueError,
            "right views: 2. Put np.eye",
        ),
        ({"right": [RIGHT, None], "E": [E, None], "points": [POINTS] * 2}, ValueError, "right must be given"),
        ({"left_size": "64x48"}, TypeError, "left_size must be"),
        ({"unit": "mm"}, ValueError, "unit must be 'm' or None"),
        ({"config": {"gradient": "full"}}, TypeError, "config must be a GuidanceConfig"),
        ({"preset": "best"}, ValueError, "preset must be one of default"),
        ({"preset": "paper", "config": PAPER}, ValueError, "preset must be None beside config"),
        ({"search": "one-number", "weights": {"matches": 1.0}}, ValueError, "photometric weight"),
        ({"search": "points-range"}, ValueError, "'points-range' needs points"),
        ({"right": None, "E": None, "points": POINTS, "weights": {"matches": 1}}, ValueError, "weights must"),
    ],
)
def test_bad_input_names_the_argument(changes, error, message):
    with pytest.raises(error, match=message) as caught:
        GeometryGuidance(**({"right": RIGHT, "K": K, "E": E} | changes))
    assert isinstance(caught.value, InputError)


@pytest.mark.parametrize(
    ("fx", "fy", "cx", "cy", "words"),
    [
        (120, 120, 63.5, 47.5, "another resolution"),
        (120, 120, 47.5, 35.5, "an image 1.5 times the size"),
        (60, 600, 31.5, 23.5, "mistyped"),
        (60, 60, 38, 17, None),  # of a rig with converging axes
        (60, 40, 31.5, 23.5, None),  # of an image that was stretched
    ],
)
def test_intrinsics_of_another_size_or_mistyped(fx, fy, cx, cy, words):
    odd = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    sentences = said_by(lambda: GeometryGuidance(RIGHT, odd, E))
    assert [words in sentence for sentence in sentences] == ([] if words is None else [True])


def test_a_crop_says_so():
    off, lefts = put(K, (0, 2), -40.0), torch.rand(1, 3, *SIZE)
    views, points = [(RIGHT, off, I4), (RIGHT, off, E)], np.full(SIZE, 2.0)
    for make, message in (
        (lambda **more: GeometryGuidance(RIGHT, off, E, **more), "outside"),
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
        pytest.raises(ValueError, match="right must be of 128x96 pixels.*64x48"),
    ):
        GeometryGuidance.from_calibration(RIGHT, file)
    whole = GeometryGuidance.from_calibration(np.zeros((96, 128, 3), np.uint8), file)
    with pytest.raises(ValueError, match="image must be of 128x96 pixels"):
        whole.prepare(torch.rand(1, 3, *SIZE))
    with pytest.warns(UserWarning, match="baseline"):
        guidance = GeometryGuidance.from_views([(None, K, I4), (RIGHT, K, put(E, (0, 3), 120.0))])
    assert [message.code for message in guidance.warned] == ["baseline.long"]


def test_knobs_and_presets(tmp_path):
    guidance = GeometryGuidance(RIGHT, K, E, inner_steps=10, smoothness=5.0)
    assert guidance.config == DEFAULT.changed(inner_steps=10, smoothness=5.0)
    assert GeometryGuidance(RIGHT, K, E).as_run().inner_steps == 0
    for name in ("default", "paper", "search-only", "prior-fit"):
        assert GeometryGuidance(RIGHT, K, E, preset=name).config == PRESETS[name]
    assert GeometryGuidance.paper(RIGHT, K, E).config == PAPER
    assert GeometryGuidance.search_only(RIGHT, K, E).config == PRESETS["search-only"]
    assert GeometryGuidance.marigold_dc(POINTS, K).config == PRESETS["marigold-dc"]
    guidance.config.save(tmp_path / "guidance.json")
    again = GeometryGuidance(RIGHT, K, E, config=GuidanceConfig.load(tmp_path / "guidance.json"), eta=0.5)
    assert again.config == guidance.config.changed(eta=0.5)
