from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._checks import InputError
from geodiff_plugin.config import DEFAULT, PAPER, PRESETS, GuidanceConfig

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
E = np.eye(4)
E[0, 3] = 0.12
RIGHT = np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)
changed_K = np.array([[60.0, 0, 900.0], [0, 60.0, 23.5], [0, 0, 1]])


def test_knobs_are_fields_of_the_configuration(tmp_path):
    guidance = GeometryGuidance(RIGHT, K, E, inner_steps=10, smoothness=5.0)
    assert guidance.config == DEFAULT.changed(inner_steps=10, smoothness=5.0)
    assert GeometryGuidance(RIGHT, K, E, config=PAPER).config == PAPER
    for name in ("default", "paper", "search-only", "prior-fit"):
        assert GeometryGuidance(RIGHT, K, E, preset=name).config == PRESETS[name]
    guidance.config.save(tmp_path / "guidance.json")
    again = GeometryGuidance(RIGHT, K, E, config=GuidanceConfig.load(tmp_path / "guidance.json"), eta=0.5)
    assert again.config == guidance.config.changed(eta=0.5)


def test_what_is_left_open_is_settled_for_what_is_given():
    points = np.array([[0.0, 0.0, 2.0]])
    guidance = GeometryGuidance(RIGHT, K, E)
    assert guidance.config.inner_steps is None and guidance.updates.inner_steps == 0
    assert guidance.as_run().inner_steps == 0
    only_points = {"weights": {"points": 1.0, "photometric": 1.0}}
    assert GeometryGuidance(RIGHT, K, E, **only_points).updates.inner_steps == 40
    assert GeometryGuidance(RIGHT, K, E, points=points, **only_points).updates.inner_steps == 0


def test_names_of_tables_above_the_configuration_are_checked():
    with pytest.raises(InputError, match="smoothnes.*Did you mean smoothness"):
        GeometryGuidance(RIGHT, K, E, smoothnes=1.0)
    with pytest.raises(InputError, match="config must be a GuidanceConfig"):
        GeometryGuidance(RIGHT, K, E, config={"gradient": "full"})
    with pytest.raises(InputError, match="preset must be one of default"):
        GeometryGuidance(RIGHT, K, E, preset="fast")
    with pytest.raises(InputError, match="preset must be None beside config"):
        GeometryGuidance(RIGHT, K, E, preset="paper", config=PAPER)


@pytest.mark.parametrize(
    "right",
    [
        RIGHT,
        RIGHT.astype(np.float32) / 255,
        RIGHT.astype(np.uint16) * 257,
        Image.fromarray(RIGHT),
        torch.from_numpy(RIGHT).permute(2, 0, 1),
        torch.from_numpy(RIGHT).permute(2, 0, 1) / 255,
    ],
    ids=["uint8", "float", "uint16", "pil", "torch-uint8", "torch-float"],
)
def test_right_image_of_any_kind(right):
    (image,) = GeometryGuidance(right, K, E).rights
    assert image.shape == (3, 48, 64) and image.dtype == torch.float32
    torch.testing.assert_close(image, torch.from_numpy(RIGHT).permute(2, 0, 1) / 255, atol=1e-5, rtol=0)


def test_baseline_constructor_pins_the_sign():
    guidance = GeometryGuidance.from_baseline(RIGHT, K, 0.12)
    assert guidance.rigs[0].E[0, 3] == pytest.approx(0.12)
    assert guidance.rigs[0].T_right_from_left[0, 3] == pytest.approx(-0.12)


def test_refinement_alone_asks_for_matches_too(textured_plane):
    pair = textured_plane
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, inner_steps=0, correct=False)
    left_01 = torch.from_numpy(pair.left).permute(2, 0, 1)[None] / 255
    assert guidance.prepare(left_01)[0].sweep_matches is not None


def test_one_number_search_needs_something_to_compare():
    with pytest.raises(ValueError, match="photometric weight"):
        GeometryGuidance(RIGHT, K, E, search="one-number", weights={"matches": 1.0})


def test_a_principal_point_near_the_border_is_told():
    """K of an image of twice the size passes every other check, and makes depth wrong by 2."""
    twice = K.copy()
    twice[:2] = 2 * K[:2] + np.array([[0, 0, 0.5], [0, 0, 0.5]])
    with pytest.warns(UserWarning, match="another resolution"):
        GeometryGuidance(RIGHT, twice, E)


@pytest.mark.parametrize(
    ("fx", "fy", "cx", "cy", "said"),
    [
        (120, 120, 47.5, 35.5, "an image 1.5 times the size"),
        (40, 40, 15.5, 11.5, "an image 0.48 times the size"),
        (60, 600, 31.5, 23.5, "mistyped"),
        (60, 60, 38, 17, None),  # of a rig with converging axes
        (60, 40, 31.5, 23.5, None),  # of an image that was stretched
    ],
)
def test_intrinsics_of_another_size_or_mistyped(fx, fy, cx, cy, said):
    odd = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        GeometryGuidance(RIGHT, odd, E)
    assert [said in str(warning.message) for warning in caught] == ([] if said is None else [True])


def test_an_array_is_no_choice():
    with pytest.raises(ValueError, match="pose must be one of"):
        GeometryGuidance(RIGHT, K, E, pose=np.zeros(3))


def test_a_focal_length_that_the_exif_contradicts():
    picture = Image.fromarray(RIGHT)
    picture.getexif().get_ifd(0x8769)[0xA405] = 32  # 59 px for 64x48
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GeometryGuidance(picture, K, E)
    wrong = K * np.array([[1.5, 1.5, 1], [1.5, 1.5, 1], [1, 1, 1]])
    with pytest.warns(UserWarning, match=r"right, 1.5. times the 59 px of its EXIF"):
        GeometryGuidance(picture, wrong, E)


@pytest.mark.filterwarnings("ignore:K.*near the border")
def test_a_calibration_of_another_size_is_refused(tmp_path):
    camera = "[120 0 63.5; 0 120 47.5; 0 0 1]"
    file = tmp_path / "calib.txt"
    file.write_text(f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=120\nwidth=128\nheight=96\n")
    with pytest.raises(ValueError, match="right must be of 128x96 pixels.*64x48"):
        GeometryGuidance.from_calibration(RIGHT, file)
    whole = np.zeros((96, 128, 3), np.uint8)
    with pytest.raises(ValueError, match="image must be of 128x96 pixels"):
        GeometryGuidance.from_calibration(whole, file).prepare(torch.rand(1, 3, 48, 64))


def test_the_left_size_may_be_a_list():
    guidance = GeometryGuidance(RIGHT, K, E, left_size=[64, 48])
    assert len(guidance.prepare(torch.rand(1, 3, 48, 64))) == 1


def test_pair_of_poses_is_composed():
    left = np.eye(4)
    left[:3, 3] = 3.0
    guidance = GeometryGuidance(RIGHT, K, (left, left @ E))
    np.testing.assert_allclose(guidance.rigs[0].E, E, atol=1e-12)


def test_pair_of_intrinsics():
    K_right = K.copy()
    K_right[0, 2] += 5
    rig = GeometryGuidance(RIGHT, (K, K_right), E).rigs[0]
    assert rig.K_left[0, 2] == 31.5 and rig.K_right[0, 2] == 36.5


def test_lists_have_one_entry_per_image():
    E2 = E.copy()
    E2[0, 3] = 0.2
    guidance = GeometryGuidance([RIGHT, RIGHT], [K, (K, K)], [E, E2])
    assert [rig.E[0, 3] for rig in guidance.rigs] == [0.12, 0.2]
    with pytest.raises(ValueError, match="E must be a list of 2 entries"):
        GeometryGuidance([RIGHT, RIGHT], K, [E])


def test_nested_lists_are_matrices():
    rig = GeometryGuidance(RIGHT, K.tolist(), E.tolist()).rigs[0]
    np.testing.assert_array_equal(rig.K_left, K)


def test_nearly_rigid_pose_is_projected():
    E2 = E.copy()
    E2[:3, :3] *= 1.0004
    R = GeometryGuidance(RIGHT, K, E2).rigs[0].E[:3, :3]
    np.testing.assert_allclose(R, np.eye(3), atol=1e-9)


def bad(**changes):
    return {"right": RIGHT, "K": K, "E": E} | changes


def changed(matrix, index, value):
    matrix = matrix.copy()
    matrix[index] = value
    return matrix


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (bad(K=np.eye(4)), ValueError, "K must be a 3x3"),
        (bad(K=np.zeros((2, 3, 3))), ValueError, "K must be a 3x3"),
        (bad(K="calib.txt"), (TypeError, ValueError), "K"),
        (bad(K=changed(K, (0, 0), 0.0)), ValueError, "focal"),
        (bad(K=changed(K, (0, 2), 900.0)), ValueError, "another resolution"),
        (bad(K=changed(K, (1, 1), np.nan)), ValueError, "finite"),
        (bad(E=np.eye(3)), ValueError, "E must be a 4x4"),
        (bad(E=np.eye(4)), ValueError, "baseline"),
        (bad(E=changed(E, (0, 0), 2.0)), ValueError, "rigid"),
        (bad(E=changed(E, (0, 0), -1.0)), ValueError, "rigid"),
        (bad(E=changed(E, (3, 0), 0.1)), ValueError, "last row"),
        (bad(E=changed(E, (1, 3), np.inf)), ValueError, "finite"),
        (bad(right=RIGHT.astype(np.float32)), ValueError, "right"),
        (bad(right=[]), ValueError, "right"),
        (bad(gradient="half"), ValueError, "gradient"),
        (bad(rule="sgd"), ValueError, "rule"),
        (bad(inner_steps=1.5), TypeError, "inner_steps"),
        (bad(inner_steps=-1), ValueError, "inner_steps"),
        (bad(start=0.8, stop=0.2), ValueError, "start"),
        (bad(depth_range=(3.0, 1.0)), ValueError, "depth_range"),
        (bad(weights=["photometric"]), TypeError, "weights must be a dict"),
        (bad(weights={"smooth": 1.0}), ValueError, "weights"),
        (bad(weights={"photometric": -1.0}), ValueError, "photometric"),
        (bad(right=None), ValueError, "right must be an image, or None together with points"),
        (bad(right=None, points=np.ones((4, 3))), ValueError, "E must be None without a right view"),
        (bad(points="cloud.ply"), TypeError, "points"),
        (bad(points=np.ones((4, 2))), ValueError, "points must be a sparse depth map"),
        (bad(points=np.zeros((48, 64))), ValueError, "at least one of them known"),
        (bad(points=np.ones((48, 64), np.uint16)), ValueError, "metres as floats"),
        (bad(points_loss="l2"), ValueError, "points_loss"),
        (bad(positive="exp"), ValueError, "positive"),
        (bad(step_from="next"), ValueError, "step_from"),
    ],
)
def test_bad_input_names_the_argument(arguments, error, message):
    with pytest.raises(error, match=message):
        GeometryGuidance(**arguments)


def test_views_in_any_world_frame():
    world = np.eye(4)
    world[:3, 3] = 3.0
    up = np.eye(4)
    up[1, 3] = -0.2
    K_third = K.copy()
    K_third[0, 2] += 5
    views = [(RIGHT, K, world), (RIGHT, K, world @ E), (RIGHT, K_third, world @ up)]
    guidance = GeometryGuidance.from_views(views, inner_steps=3)
    assert guidance.config.inner_steps == 3 and len(guidance.rights) == 2
    np.testing.assert_allclose([rig.E for rig in guidance.rigs], [E, up], atol=1e-12)
    assert guidance.rigs[1].K_right[0, 2] == 36.5 and guidance.rigs[1].K_left[0, 2] == 31.5
    with pytest.raises(ValueError, match="image must be of 64x48 pixels, as the left view; got 32x24"):
        guidance.prepare(torch.zeros(1, 3, 24, 32))


def test_a_batch_with_several_views_each():
    E2 = E.copy()
    E2[0, 3] = 0.2
    guidance = GeometryGuidance(
        [(RIGHT, RIGHT), (RIGHT, RIGHT, RIGHT)],
        K,
        [(np.eye(4), E, E2), (np.eye(4), E, E2, E)],
    )
    assert [len(own.rights) for own in guidance.inputs] == [2, 3]
    assert [rig.E[0, 3] for rig in guidance.rigs] == [0.12, 0.2, 0.12, 0.2, 0.12]


@pytest.mark.parametrize(
    ("views", "error", "message"),
    [
        ([(RIGHT, K, np.eye(4))], ValueError, "views must be a list"),
        ({"left": RIGHT}, TypeError, "views must be a list"),
        ([(RIGHT, K, np.eye(4)), (RIGHT, K)], ValueError, "views must be a list"),
        (
            [(RIGHT, changed_K, np.eye(4)), (RIGHT, K, E)],
            ValueError,
            r"K\[left\] must be for the left view's",
        ),
        ([(None, K, np.eye(4)), (RIGHT, K, E), (RIGHT, changed_K, E)], ValueError, r"K\[right view 2\]"),
        ([(None, K, E), (RIGHT, K, E)], ValueError, "baseline"),
    ],
)
def test_bad_views_are_named(views, error, message):
    with pytest.raises(error, match=message):
        GeometryGuidance.from_views(views)


def test_points_of_either_form():
    sparse = np.zeros((48, 64))
    sparse[3, 4], sparse[5, 6], sparse[7, 8] = 2.0, np.nan, np.inf
    (own,) = GeometryGuidance.from_points(sparse, K).inputs
    assert own.rights == () and own.points.shape == (48, 64) and own.points.sum() == 2.0
    cloud = torch.tensor([[0.0, 0.0, 2.0], [0.0, 0.0, torch.nan]])
    (own,) = GeometryGuidance(RIGHT, K, E, points=cloud).inputs
    assert own.points.shape == (1, 3) and len(own.rights) == 1
    both = GeometryGuidance(None, K, points=[sparse, cloud])
    assert [tuple(own.points.shape) for own in both.inputs] == [(48, 64), (1, 3)]


def test_several_right_views_need_as_many_cameras():
    with pytest.raises(TypeError, match="E must be a tuple"):
        GeometryGuidance((RIGHT, RIGHT), K, E)
    with pytest.raises(ValueError, match="a tuple of 2 for 2 right views"):
        GeometryGuidance((RIGHT, RIGHT), K, (np.eye(4), E))
    with pytest.raises(ValueError, match="a tuple of 2 for 2 right views"):
        GeometryGuidance((RIGHT, RIGHT), (K, K), (np.eye(4), E, E))


def test_every_image_of_a_batch_is_given_the_same_kind():
    points = np.array([[0.0, 0.0, 2.0]])
    with pytest.raises(ValueError, match="right must be given for every left image or for none"):
        GeometryGuidance([RIGHT, None], K, [E, None], points=[points, points])
    with pytest.raises(ValueError, match="points must be given for every left image or for none"):
        GeometryGuidance([RIGHT, RIGHT], K, E, points=[points, None])


def test_what_is_given_must_feed_what_is_asked():
    points = np.array([[0.0, 0.0, 2.0]])
    with pytest.raises(ValueError, match="weights must be above 0 for a term"):
        GeometryGuidance.from_points(points, K, weights={"photometric": 1.0, "matches": 1.0})
    with pytest.raises(ValueError, match="'one-number' needs a right view"):
        GeometryGuidance.from_points(points, K, search="one-number")
    with pytest.raises(ValueError, match="'points-range' needs points"):
        GeometryGuidance(RIGHT, K, E, search="points-range")


def test_marigold_dc_preset_is_the_published_one():
    config = GeometryGuidance.marigold_dc(np.array([[0.0, 0.0, 2.0]]), K).config
    assert (config.gradient, config.rule) == ("full", "adam-norm")
    assert (config.step_latents, config.step_affine) == (0.05, 0.005)
    assert (config.positive, config.points_loss, config.min_steps) == ("square", "l1l2", 50)
    assert config.inner_steps == 1
    assert config.weights == {"points": 1.0}


def test_millimetres_are_suspected():
    with pytest.warns(UserWarning, match="millimetres"):
        GeometryGuidance.from_baseline(RIGHT, K, 120.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GeometryGuidance.from_baseline(RIGHT, K, 120.0, unit=None)


def test_paper_preset_is_the_paper():
    config = GeometryGuidance.paper(RIGHT, K, E).config
    assert (config.gradient, config.rule) == ("full", "plain")
    assert config.step_latents == config.step_affine == 1e-2
    assert config.weights == {"photometric": 1.0, "prior_pull": 1e-2}
    assert (config.eta, config.inner_steps, config.pull_to) == (0.85, 1, "zero")
    assert (config.search, config.g_s_range) == ("one-number", (1.0, 80.0))


def test_from_calibration_picks_the_cameras(tmp_path):
    lines = []
    for number, shift in enumerate((0.0, 0.5, 0.0, 0.3)):
        row = [60.0, 0, 31.5, -60.0 * shift, 0, 60.0, 23.5, 0, 0, 0, 1, 0]
        lines.append(f"P{number}: " + " ".join(map(str, row)))
    (tmp_path / "calib.txt").write_text("\n".join(lines) + "\n")
    for cameras, baseline in (((0, 1), 0.5), ((2, 3), 0.3)):
        guidance = GeometryGuidance.from_calibration(RIGHT, tmp_path / "calib.txt", cameras)
        assert guidance.rigs[0].E[0, 3] == pytest.approx(baseline)
        np.testing.assert_allclose(guidance.rigs[0].K_left, K)


def test_cameras_are_copied():
    K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
    E = np.eye(4)
    E[0, 3] = 0.1
    guidance = GeometryGuidance(np.zeros((48, 64, 3)), K, E)
    K[0] *= 2.0
    E[0, 3] = 1.0
    assert guidance.rigs[0].K_left[0, 0] == 60.0 and guidance.rigs[0].E[0, 3] == 0.1
