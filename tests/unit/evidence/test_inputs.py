"""The user's input in each of its forms gives the cameras, images and points that it stands for."""

import warnings
from dataclasses import FrozenInstanceError, fields
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image
from PIL.ExifTags import IFD, Base

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.evidence.inputs import (
    Arguments,
    Inputs,
    _entry,
    _is_nested_matrix,
    as_points,
    left_images,
    read_inputs,
    split_views,
)
from tests.unit.error_sentences import check_error

SIZE = (36, 48)
RNG = np.random.default_rng(0)
IMAGES = [RNG.integers(0, 255, (*size, 3), np.uint8) for size in (SIZE, (40, 60), (48, 36), (34, 52))]
KS = [
    np.array(
        [[50.0 + i, 0.1 * i, image.shape[1] / 2 - i], [0, 40.0 + 2 * i, image.shape[0] / 2 + i], [0, 0, 1]]
    )
    for i, image in enumerate(IMAGES)
]
POINTS = [np.column_stack([RNG.normal(size=(n, 2)), RNG.uniform(1, 5, n)]) for n in (5, 6, 7)]


def turn(x: float, y: float, z: float) -> np.ndarray:
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).double()).numpy()


def pose(i: int) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = turn(0.1 * i, 0.2 - 0.1 * i, -0.05 * i)
    E[:3, 3] = 0.2 + 0.1 * i, -0.1 * i, 0.05
    return E


ES = [pose(i) for i in range(5)]


def read(right=None, K=None, E=None, points=None, confidence=None, **options) -> list[Inputs]:
    return read_inputs(Arguments(right, K, E, points, confidence), **options)


def same_image(image_01: torch.Tensor, image: np.ndarray) -> bool:
    return np.allclose(image_01.permute(1, 2, 0).numpy(), image / 255, atol=1e-6)


def check(found: Inputs, K_left, views, poses, shared: bool) -> None:
    """``views`` are numbers of images with their K; poses are those of right cameras in the left frame."""
    np.testing.assert_array_equal(found.left.K, K_left)
    assert len(found.views) == len(found.rigs) == len(views) and found.shared_intrinsics is shared
    for view, rig, (image, K), E in zip(found.views, found.rigs, views, poses, strict=True):
        assert same_image(view.image_01, IMAGES[image])
        np.testing.assert_array_equal(rig.K_left, K_left)
        np.testing.assert_array_equal(rig.K_right, K)
        np.testing.assert_allclose(rig.E, E, atol=1e-12)
        assert view.camera.K.dtype == view.T_right_from_left.dtype == np.float32
        assert view.camera.size == IMAGES[image].shape[1::-1]
        np.testing.assert_allclose(view.camera.K, K, rtol=1e-6)
        np.testing.assert_allclose(view.T_right_from_left, np.linalg.inv(E), atol=1e-6)


@pytest.mark.parametrize("cameras", [tuple, list])
def test_one_image_with_one_view(cameras):
    for E in (ES[1], ES[1].tolist(), cameras([ES[3], ES[3] @ ES[1]])):
        (found,) = read(IMAGES[1], cameras([KS[0], KS[1]]), E)
        check(found, KS[0], [(1, KS[1])], [ES[1]], shared=False)
        (alone,) = read(IMAGES[0], KS[0], E)
        check(alone, KS[0], [(0, KS[0])], [ES[1]], shared=True)
        assert found.points is None and found.unit == "m"
    for record, field in ((found, "points"), (Arguments(None, None, None, None, None), "points")):
        with pytest.raises(FrozenInstanceError):
            setattr(record, field, None)
        assert len({record}) == 1, "records of arrays are equal to themselves only"
    (found,) = read([IMAGES[1]], [(KS[0], KS[1])], [ES[1]], unit=None)
    check(found, KS[0], [(1, KS[1])], [ES[1]], shared=False)
    assert found.unit is None


@pytest.mark.parametrize("cameras", [tuple, list])
def test_one_image_with_several_views_has_poses_in_any_world(cameras):
    world = pose(4)
    Es = cameras([world, world @ ES[1], world @ ES[2]])
    (found,) = read((IMAGES[1], IMAGES[2]), cameras(KS[:3]), Es)
    check(found, KS[0], [(1, KS[1]), (2, KS[2])], ES[1:3], shared=False)
    (found,) = read((IMAGES[0], IMAGES[0]), KS[0], Es)
    check(found, KS[0], [(0, KS[0]), (0, KS[0])], ES[1:3], shared=True)


def test_of_several_images_every_argument_is_its_own_entry_or_serves_all():
    rights, Ks, Es = IMAGES[1:4], [(KS[0], KS[1]), (KS[3], KS[2]), (KS[2], KS[3])], ES[1:4]
    confidences = [np.linspace(0.2, 0.9, len(points)) for points in POINTS]
    found = read(rights, Ks, Es, POINTS, confidences)
    for i, each in enumerate(found):
        check(each, Ks[i][0], [(i + 1, Ks[i][1])], [Es[i]], shared=False)
        np.testing.assert_allclose(each.points, np.c_[POINTS[i], confidences[i]], rtol=1e-6)
    shared = read([IMAGES[0]] * 3, KS[0], ES[1], points=POINTS[0])
    for each in shared:
        check(each, KS[0], [(0, KS[0])], [ES[1]], shared=True)
        np.testing.assert_allclose(each.points, POINTS[0], rtol=1e-6)
    by_points = read(None, KS[:2], None, POINTS[:2])
    assert [len(each.points) for each in by_points] == [5, 6]
    for each, K in zip(by_points, KS[:2], strict=True):
        check(each, K, [], [], shared=True)


def test_one_right_image_serves_all_lists_of_points():
    found = read(IMAGES[0], [KS[0]] * 2, ES[1:3], points=POINTS[:2])
    for i, each in enumerate(found):
        check(each, KS[0], [(0, KS[0])], [ES[1 + i]], shared=True)
        np.testing.assert_allclose(each.points, POINTS[i], rtol=1e-6)


ERRORS = [
    ({"right": None}, "right must be an image, or None together with points; got None without points"),
    ({"confidence": np.ones(5)}, "points_confidence must be passed together with points; got no points"),
    ({"right": []}, "right must be an image or a list with one image per left image; got an empty list"),
    (
        {"right": [IMAGES[0]] * 2, "K": [KS[0]] * 3},
        r"K must be a list of 2 entries, one per left image; got 3 entries",
    ),
    (
        {"right": [IMAGES[0]] * 2, "points": [POINTS[0], None]},
        "points must be passed for every left image or for none; got None for 1",
    ),
    (
        {"right": [IMAGES[0], None], "K": KS[0], "E": [ES[1], None], "points": POINTS[0]},
        "right must be passed for every left image or for none; got None for 1",
    ),
    ({"right": None, "points": POINTS[0]}, "E must be None without a right view; got a pose. Points are in"),
    (
        {"right": (IMAGES[0], IMAGES[0]), "E": ES[1]},
        r"E must be a tuple \(E_left, E_right, ...\) of camera-to-world poses for several",
    ),
    ({"E": (ES[0], ES[1], ES[2])}, "E must be a tuple .*; got a tuple of 3, with right views: 1. Put"),
    (
        {"K": (KS[0],)},
        r"a 3x3 matrix or a tuple \(K_left, K_right\), left one first; got a tuple of 1, with right views: 1",
    ),
    (
        {"right": (IMAGES[0], IMAGES[0]), "K": (KS[0], KS[0]), "E": tuple(ES[:3])},
        r"a tuple \(K_left, K_right, ...\), left one first; got a tuple of 2, with right views: 2",
    ),
    ({"K": (np.zeros((3, 3)), KS[0])}, r"K\[left\]"),
    ({"K": (KS[0], np.zeros((3, 3)))}, r"K\[right\]\[0, 0\]"),
    (
        {"right": (IMAGES[0], IMAGES[0]), "K": (*KS[:1] * 2, np.zeros((3, 3))), "E": tuple(ES[:3])},
        r"K\[right view 2\]\[0, 0\]",
    ),
    ({"right": [IMAGES[0]] * 2, "K": [KS[0], np.zeros((3, 3))]}, r"K\[1\]\[0, 0\]"),
    ({"E": (np.ones((4, 4)), ES[1])}, r"E\[left\] must be rigid"),
    ({"E": (ES[1], np.ones((4, 4)))}, r"E\[right\] must be rigid"),
    ({"E": np.ones((4, 4))}, r"E must be rigid"),
    (
        {"right": (IMAGES[0], IMAGES[0]), "E": (ES[0], ES[1], np.ones((4, 4)))},
        r"E\[right view 2\] must be rigid",
    ),
    (
        {"right": (IMAGES[0], IMAGES[0]), "E": (ES[1], ES[2], ES[1])},
        r"E\[right view 2\] must be a pose with a baseline",
    ),
    ({"E": np.eye(4)}, "E must be a pose with a baseline"),
    (
        {"right": [IMAGES[0]] * 2, "E": [ES[1], np.eye(4)]},
        r"E\[1\] must be a pose with a baseline",
    ),
    ({"right": IMAGES[0].astype(float)}, r"right must be floats in \[0, 1\]"),
    ({"right": (IMAGES[0], IMAGES[0].astype(float)), "E": tuple(ES[:3])}, r"right, view 2, must be floats"),
    ({"right": [IMAGES[0], IMAGES[0].astype(float)]}, r"right\[1\] must be floats"),
    (
        {"right": [IMAGES[0], (IMAGES[0], IMAGES[0].astype(float))], "E": [ES[1], tuple(ES[:3])]},
        r"right\[1\], view 2, must be floats",
    ),
]


@pytest.mark.parametrize(("changes", "message"), ERRORS)
def test_the_argument_that_is_wrong_is_named_with_its_place(changes, message):
    with pytest.raises(InputError, match=message):
        read(**{"right": IMAGES[0], "K": KS[0], "E": ES[1]} | changes)


@pytest.mark.parametrize(
    ("right", "K", "E", "name"),
    [
        (0, "off", 1, "K has its principal point"),
        (0, ("good", "off"), 1, r"K\[right\] has its principal point"),
        (0, ("off", "off"), 1, "K has its principal point"),
        ((0, 0), ("good", "good", "off"), (0, 1, 2), r"K\[right view 2\] has its principal point"),
        ([0, 0], ["good", "off"], [1, 2], r"K\[1\] has its principal point"),
        ([0, 0], ["good", ("good", "off")], [1, 2], r"K\[1\]\[right\] has its principal point"),
    ],
)
def test_the_K_that_does_not_fit_its_right_image_is_named_unless_that_is_a_crop(right, K, E, name):
    off = KS[0].copy()
    off[0, 2] = 49.0

    def put(value, table):
        return (
            type(value)(put(each, table) for each in value)
            if isinstance(value, (tuple, list))
            else table[value]
        )

    given = put(right, IMAGES), put(K, {"good": KS[0], "off": off}), put(E, ES)
    with pytest.raises(InputError, match=name):
        read(*given)
    assert read(*given, cropped=True)


def with_exif(focal_35: float) -> Image.Image:
    image = Image.fromarray(IMAGES[0])
    image.getexif().get_ifd(IFD.Exif)[Base.FocalLengthIn35mmFilm] = focal_35
    return image


def codes_of(make) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        make()
    messages = [each.message.args[0] for each in caught]
    return [f"{message.code}: {message}" for message in messages]


def test_warnings_about_lenses_points_and_baselines_name_their_argument():
    right = 36.06 * 51 / 50, 100.0  # in 35 mm equivalent of the focal length of K, and another one
    assert codes_of(lambda: read(with_exif(right[0]), (KS[2], KS[0]), ES[1])) == []
    (found,) = codes_of(lambda: read((IMAGES[0], with_exif(right[1])), KS[0], tuple(ES[:3])))
    assert found.startswith("camera.focal-mismatch: K has a focal length of 50 px for right, view 2")
    far = [POINTS[0] * 1000, POINTS[1]]
    (found,) = codes_of(lambda: read(None, KS[0], None, far))
    assert found.startswith("points.far: points[0] has depths of")
    assert codes_of(lambda: read(None, KS[0], None, far, unit=None)) == []
    E = ES[1].copy()
    E[:3, 3] *= 1000
    (found,) = codes_of(lambda: read([IMAGES[0]] * 2, KS[0], [ES[1], E]))
    assert found.startswith("baseline.long: E[1] has an implausible baseline of")
    assert codes_of(lambda: read([IMAGES[0]] * 2, KS[0], [ES[1], E], unit=None)) == []
    assert codes_of(lambda: read(IMAGES[0], KS[0], ES[1], POINTS[0])) == []


@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_views_and_points_go_to_the_device_of_the_left_image(device):
    (found,) = read((IMAGES[1], IMAGES[2]), tuple(KS[:3]), tuple(ES[:3]), POINTS[0].astype(np.float32))
    left = torch.zeros(3, *SIZE, device=device, dtype=torch.float64)
    posed, as_read = found.posed_views(left), found.with_left(left)
    assert posed.left.image_01 is as_read.left.image_01 is left and as_read.rights is found.views
    for one, other in zip(posed.rights, found.views, strict=True):
        assert one.image_01.device.type == device and one.image_01.dtype == torch.float32
        assert one.image_01.shape == other.image_01.shape
        assert one.camera is other.camera and one.T_right_from_left is other.T_right_from_left
    for each in (posed, as_read):
        assert each.left.camera.K.dtype == np.float32 and each.left.camera.size == SIZE[::-1]
        np.testing.assert_allclose(each.left.camera.K, KS[0], rtol=1e-6)
        np.testing.assert_array_equal(each.left.T_right_from_left, np.eye(4))
    points = found.points_on(torch.device(device))
    assert points.device.type == device and points.dtype == torch.float32 and points.shape == (5, 3)
    (bare,) = read(IMAGES[0], KS[0], ES[1])
    assert bare.points_on(torch.device(device)) is None
    given = {"right", "K", "E", "points", "points_confidence", "mask", "right_mask"}
    assert {field.name for field in fields(Arguments)} == given


CLOUD = np.array(
    [[0.1, 0.2, 2.0], [np.nan, 0.1, 3.0], [0.3, 0.4, np.inf], [-0.5, 0.6, 4.0], [0.7, 0.8, -1.0]]
)
MAP = np.array([[0.0, 2.0, np.nan, -1.0], [np.inf, 0.5, 3.0, 1.0]])


@pytest.mark.parametrize(
    "kind", [np.asarray, torch.from_numpy, lambda x: torch.from_numpy(x).bfloat16(), lambda x: x.tolist()]
)
def test_known_points_keep_their_finite_rows_and_their_confidence(kind):
    found = as_points(kind(CLOUD), "points")
    assert found.dtype == torch.float32 and found.is_contiguous()
    np.testing.assert_allclose(found, CLOUD[[0, 3, 4]], rtol=0.01)
    confidence = np.array([0.5, 0.6, 0.7, 0.0, np.nan])
    np.testing.assert_allclose(as_points(kind(CLOUD), "points", confidence), [[*CLOUD[0], 0.5]], rtol=0.01)
    coloured = np.c_[CLOUD, np.full((5, 3), 9.0)]
    for columns in (4, 6):
        np.testing.assert_allclose(
            as_points(kind(coloured[:, :columns]), "points"), CLOUD[[0, 3, 4]], rtol=0.01
        )
    assert as_points(kind(np.ones((2, 5))), "points").shape == (2, 5), "a map of five columns"


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_a_sparse_map_is_zero_where_nothing_is_known(kind):
    wide = np.tile(MAP, (1, 2))
    found = as_points(kind(wide), "points")
    expected = np.tile([[0.0, 2.0, 0.0, 0.0], [0.0, 0.5, 3.0, 1.0]], (1, 2))
    np.testing.assert_array_equal(found, expected)
    confidence = np.linspace(0.0, 1.0, 16).reshape(2, 8)
    confidence[1, 2] = 0.0
    with_it = as_points(kind(wide), "points", kind(confidence))
    known = (expected > 0) & (confidence > 0)
    np.testing.assert_allclose(with_it[..., 0], expected * known)
    np.testing.assert_allclose(with_it[..., 1], confidence * known, rtol=1e-6)


@pytest.mark.parametrize(
    ("value", "confidence", "message"),
    [
        (np.ones((4, 2)), None, r"points must be .*; got shape \(4, 2\)"),
        (np.ones(4), None, r"points must be .*; got shape \(4,\)"),
        (np.ones((2, 3, 4)), None, r"points must be .*; got shape \(2, 3, 4\)"),
        (np.ones((3, 3), bool), None, "points must be a sparse depth map"),
        (np.full((3, 3), "a"), None, "points must be a sparse depth map"),
        ([[1, 2], [3]], None, "points must be a sparse depth map"),
        (np.ones((4, 3), int), None, "points must be metres as floats"),
        (np.ones((4, 8), np.uint16), None, "points must be metres as floats"),
        ([[2] * 8] * 3, None, "points must be metres as floats"),
        (np.zeros((4, 8)), None, "points must be .*, at least one of them known; got only"),
        (np.full((4, 3), np.nan), None, "points must be .*, at least one of them known; got only"),
        (np.ones((4, 3)), np.ones((4, 3)), r"points_confidence must be of shape \(4,\), like the points"),
        (np.ones((4, 8)), np.ones(4), r"points_confidence must be of shape \(4, 8\), like the points"),
        (
            np.ones((4, 3)),
            [0.1, 1.01, 0, 0],
            r"points_confidence must be in \[0, 1\]; got values from 0 to 1.01",
        ),
        (
            np.ones((4, 3)),
            [0.1, -0.01, 0, 0],
            r"points_confidence must be in \[0, 1\]; got values from -0.01 to 0.1",
        ),
        (np.ones((4, 3)), ["a"] * 4, r"points_confidence must be numbers of shape \(4,\)"),
        (np.ones((4, 3)), np.zeros(4), "points must be .*, at least one of them known"),
    ],
)
def test_what_are_no_points(value, confidence, message):
    with pytest.raises(InputError, match=message):
        as_points(value, "points", confidence)


def test_views_are_split_into_the_constructors_arguments():
    views = list(zip(IMAGES[:3], KS[:3], ES[:3], strict=True))
    found = split_views(views)
    assert found.left_size == (48, 36) and len(found.rights) == 2
    assert found.rights[0] is IMAGES[1] and found.rights[1] is IMAGES[2]
    assert all(one is other for one, other in zip(found.Ks + found.Es, KS[:3] + ES[:3], strict=True))
    without = split_views([(None, "not looked at", ES[0]), *views[1:]])
    assert without.left_size is None and without.Ks[0] == "not looked at"
    assert split_views(tuple(map(list, views[:2]))).left_size == (48, 36)


@pytest.mark.parametrize(
    ("views", "message"),
    [
        ("views", "views must be a list"),
        ([], "views must be .*, at least two; got 0"),
        ([(IMAGES[0], KS[0], ES[0])], "views must be .*, at least two; got 1"),
        ([(IMAGES[0], KS[0], ES[0]), (IMAGES[1], KS[1])], r"2 entries of lengths \[3, 2\]. Pass three"),
        ([(IMAGES[0], KS[0], ES[0]), 5], r"2 entries of lengths \[3, 'int'\]"),
        ([(IMAGES[0], np.zeros((3, 3)), ES[0]), (IMAGES[1], KS[1], ES[1])], r"K\[left\]"),
        ([("image.png", KS[0], ES[0]), (IMAGES[1], KS[1], ES[1])], "the left view's image"),
    ],
)
def test_what_are_no_views(views, message):
    with pytest.raises(InputError, match=message):
        split_views(views)


def test_the_left_views_K_has_to_fit_its_image_unless_it_is_a_crop():
    off = KS[0].copy()
    off[1, 2] = 37.0  # of 36 rows, and within 48
    views = [(IMAGES[0], off, ES[0]), (IMAGES[1], KS[1], ES[1])]
    with pytest.raises(InputError, match=r"K\[left\] has .* outside the left view's image \(48x36"):
        split_views(views)
    assert split_views(views, cropped=True).left_size == (48, 36)
    (found,) = codes_of(lambda: split_views([(with_exif(100.0), KS[0], ES[0]), views[1]]))
    assert "for the left view's image" in found


def test_left_images_in_every_form_of_a_batch():
    images = [RNG.integers(0, 255, (*SIZE, 3), np.uint8) for _ in range(3)]
    expected = np.stack(images).transpose(0, 3, 1, 2) / 255
    tensors = torch.from_numpy(expected).float()
    for batch in (
        images,
        np.stack(images),
        tensors,
        list(tensors),
        [images[0], images[1:]],
        [np.stack(images[:2]), images[2]],
    ):
        found = left_images(batch)
        assert found.dtype == torch.float32
        np.testing.assert_allclose(found, expected, atol=1e-6)
    for single in (
        images[0],
        images[0][None],
        tensors[0],
        tensors[:1],
        [images[0]],
        Image.fromarray(images[0]),
    ):
        np.testing.assert_allclose(left_images(single), expected[:1], atol=1e-6)
    grey = images[0][..., 0]
    for one in (grey, torch.from_numpy(grey / 255.0)):
        np.testing.assert_allclose(left_images(one), np.repeat(grey[None, None] / 255, 3, 1), atol=1e-6)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        ([], "image must be an image or a list of images; got an empty list or batch"),
        (
            np.zeros((0, *SIZE, 3), np.uint8),
            "image must be an image or a list of images; got an empty list or batch",
        ),
        (
            [IMAGES[0], IMAGES[1]],
            r"image\[1\] must be 48x36 pixels, like image\[0\]; got 60x40. Use one call",
        ),
        (
            [[IMAGES[0]], [IMAGES[0], IMAGES[2]]],
            r"image\[1\]\[1\] must be 48x36 pixels, like image\[0\]\[0\]; got 36x48",
        ),
        ([IMAGES[0], IMAGES[0].astype(float)], r"image\[1\] must be floats"),
        (IMAGES[0].astype(float), r"image must be floats"),
    ],
)
def test_left_images_that_are_none_are_named_by_their_index(image, message):
    with pytest.raises(InputError, match=message):
        left_images(image)


@pytest.mark.parametrize("name", ["K", "E", "points", "confidence"])
@pytest.mark.parametrize("length", [1, 2, 4])
def test_a_list_of_another_length_than_there_are_left_images_is_rejected_by_its_name(name, length):
    """As many as the list of right images, or else of points, has entries."""
    whole = {"right": [IMAGES[0]] * 3, "K": [KS[0]] * 3, "E": ES[1:4], "points": POINTS}
    whole |= {"confidence": [np.ones(len(points)) for points in POINTS]}
    assert len(read(**whole)) == 3
    wrong = (whole[name] * 2)[:length]
    given = {"confidence": "points_confidence"}.get(name, name)
    sentence = "a list of 3 entries, one per left image", f"{length} entries"
    check_error(lambda: read(**whole | {name: wrong}), given, *sentence)
    if name not in ("E", "points"):
        by_points = {"right": None, "E": None}
        check_error(lambda: read(**whole | by_points | {name: wrong}), given, *sentence)


@pytest.mark.parametrize("name", ["right", "points"])
@pytest.mark.parametrize("missing", [(0,), (1,), (2,), (0, 1), (1, 2), (0, 1, 2)])
def test_right_images_and_points_are_given_for_every_left_image_or_for_none(name, missing):
    whole = {"right": [IMAGES[0]] * 3, "K": KS[0], "E": ES[1:4], "points": list(POINTS)}
    holes = {name: [None if i in missing else each for i, each in enumerate(whole[name])]}
    if name == "right":
        holes["E"] = [None if i in missing else each for i, each in enumerate(whole["E"])]
    if len(missing) < 3:
        expected = "passed for every left image or for none"
        check_error(lambda: read(**whole | holes), name, expected, f"None for {missing[0]}")
        return
    found = read(**whole | holes)
    assert [len(each.views) for each in found] == ([0] * 3 if name == "right" else [1] * 3)
    assert all((each.points is None) == (name == "points") for each in found)


def test_every_view_of_a_list_has_an_image_a_K_and_an_E():
    whole = [(IMAGES[0], KS[0], ES[0]), (IMAGES[0], KS[0], ES[1]), (IMAGES[0], KS[0], ES[2])]
    assert len(split_views(whole).rights) == 2
    form = "a list [(image, K, E), ...] with the left view first"
    for i in range(3):
        for wrong, kind in (((IMAGES[0], KS[0]), 2), ((*whole[0], 1), 4), (IMAGES[0], "'ndarray'")):
            kinds = [3, 3, 3]
            kinds[i] = kind
            got = f"3 entries of lengths [{', '.join(map(str, kinds))}]"
            views = [*whole[:i], wrong, *whole[i + 1 :]]
            check_error(partial(split_views, views), "views", form, got, "three")
    check_error(lambda: split_views(whole[:1]), "views", f"{form}, at least two", "1", "no metric scale")


@pytest.mark.parametrize(
    ("matrix", "is_one"),
    [
        ([[1, 2], [3, 4]], True),
        ([(1, 2.5), (3, 4)], True),
        ([[1, 2], [3, np.float32(4)]], True),
        ([[1, 2], "ab"], False),
        ([[1, 2], [3, "a"]], False),
        ([np.ones(2), np.ones(2)], False),
        ([np.eye(3), np.eye(3)], False),
        ([], False),
    ],
)
def test_rows_of_numbers_are_one_matrix_and_other_lists_have_an_entry_per_image(matrix, is_one):
    assert _is_nested_matrix(matrix) is is_one
    entries = [_entry(matrix, "K", i, len(matrix)) for i in range(len(matrix))]
    assert all(entry is (matrix if is_one else matrix[i]) for i, entry in enumerate(entries))


def test_confidence_above_1_from_rounding_is_1():
    points = as_points(np.ones((3, 3)), "points", [0.5, np.nextafter(np.float32(1), np.float32(2)), 1 + 9e-7])
    assert points[:, 3].tolist() == [0.5, 1.0, 1.0]
    with pytest.raises(InputError, match=r"got values from 0\.5 to 1\.00001"):
        as_points(np.ones((2, 3)), "points", [0.5, 1.00001])
