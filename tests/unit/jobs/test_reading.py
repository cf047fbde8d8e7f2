"""The files of a pair become its images, cameras, lenses and known depths: each view with its own."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from geodiff_plugin._checks import InputError
from geodiff_plugin.evidence.guidance import GeometryGuidance
from geodiff_plugin.jobs import reading
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import lenses_of, read_pair, read_rig
from geodiff_plugin.types import Distortion, Rig
from tests.unit.jobs.made_runs import pose

#: ``(width, height)`` of the left image, the right one and two further views.
SIZES = ((54, 40), (60, 46), (64, 50), (48, 36))
KS = [
    np.array([[50.0 + n, 0, (w - 1) / 2 + 1.5], [0, 47.0 - n, (h - 1) / 2 - 0.5], [0, 0, 1]])
    for n, (w, h) in enumerate(SIZES)
]
ES = [
    np.eye(4),
    pose((1, -3, 2), (0.11, 0.02, -0.01)),
    pose((2, 4, -1), (-0.2, 0.1, 0.03)),
    pose((0, 0, 3), (0.1, -0.3, 0)),
]
LENSES = ("-0.2,0.05,0.001,0", "-0.1,0.02,0,0.002", "fisheye:0.05,0.01,0,0")
NAMES = ("left", "right", "third", "fourth")


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder, rng = tmp_path_factory.mktemp("reading"), np.random.default_rng(1)
    for name, (width, height), K, E in zip(NAMES, SIZES, KS, ES, strict=True):
        smooth = cv2.resize(rng.random((9, 11, 3)), (width, height), interpolation=cv2.INTER_CUBIC)
        image = np.clip(smooth * 200 + 20, 0, 255).astype(np.uint8)
        Image.fromarray(image).save(folder / f"{name}.png")
        np.savetxt(folder / f"K-{name}.txt", K)
        np.save(folder / f"E-{name}.npy", E)
    return folder


def image_of(files, name) -> np.ndarray:
    return np.asarray(Image.open(files / f"{name}.png"), np.float32) / 255


def options(files, *views: str, **more) -> DepthOptions:
    """Of a pair given by matrices, with further views."""
    given = {
        "left": files / "left.png",
        "right": files / "right.png",
        "k": files / "K-left.txt",
        "k_right": files / "K-right.txt",
        "e": files / "E-right.npy",
        "view": tuple(files / f"{name}.png" for name in views),
        "view_e": tuple(files / f"E-{name}.npy" for name in views),
        "view_k": tuple(files / f"K-{name}.txt" for name in views),
    }
    return DepthOptions(**given | more)


BARE = {"k": None, "k_right": None, "e": None}
NUMBERS = BARE | {"fx": 50.0, "baseline": 0.12}


def test_every_view_has_its_own_image_camera_and_pose(files):
    pair = read_pair(options(files, "third", "fourth", knob=("planes=99",), preset="fast"))
    guidance = pair.guidance
    np.testing.assert_allclose(guidance.inputs[0].K_left, KS[0])
    assert len(guidance.rigs) == 3
    for number, (rig, right) in enumerate(zip(guidance.rigs, guidance.rights, strict=True), 1):
        np.testing.assert_allclose(rig.K_left, KS[0])
        np.testing.assert_allclose(rig.K_right, KS[number])
        np.testing.assert_allclose(rig.E, ES[number], atol=1e-12)
        np.testing.assert_allclose(right.permute(1, 2, 0), image_of(files, NAMES[number]), atol=1e-6)
    np.testing.assert_allclose(pair.left, image_of(files, "left"), atol=1e-6)
    assert (pair.rig.size_left, pair.rig.size_right) == SIZES[:2]
    assert pair.rig.source == str(files / "K-left.txt") and not pair.rig.measured
    assert not guidance.measured_baseline and guidance.unit == "m"
    assert (guidance.config.planes, guidance.config.pose) == (99, "given")
    assert guidance.assumed == [] and not pair.undistorted and pair.notes == () and pair.prior_map is None


def test_what_is_not_given_of_a_view_is_that_of_the_left_one(files, tmp_path):
    np.save(tmp_path / "parallel.npy", np.eye(4) + 0.1 * np.eye(4, k=3))
    given = options(files, "third", k_right=None, view_k=(), e=tmp_path / "parallel.npy")
    pair = read_pair(given)
    for rig in pair.guidance.rigs:
        np.testing.assert_allclose(rig.K_right, KS[0])
    assert [message.code for message in pair.guidance.assumed] == ["camera.same-centre"]
    pair = read_pair(replace(given, k_right=files / "K-left.txt"))
    assert pair.guidance.assumed == [], "it is given, and the same"


def test_numbers_that_are_left_out_are_filled_in_and_said(files):
    (width, height), pair = SIZES[0], read_pair(options(files, **NUMBERS))
    K = pair.guidance.inputs[0].K_left
    expected = np.array([[50.0, 0, (width - 1) / 2], [0, 50.0, (height - 1) / 2], [0, 0, 1]])
    np.testing.assert_allclose(K, expected)
    np.testing.assert_allclose(pair.rig.K_right, expected)
    np.testing.assert_allclose(pair.rig.E, np.eye(4) + 0.12 * np.eye(4, k=3))
    said = " ".join(pair.guidance.assumed)
    assert "fy is assumed to be fx; cx and cy are assumed to be the middle" in said
    assert "(--fy, --cx, --cy)" in said and pair.guidance.measured_baseline
    given = {"fy": 46.0, "cx": 25.0, "cy": 18.0, "cx_right": 28.0}
    pair = read_pair(options(files, **NUMBERS, **given))
    np.testing.assert_allclose(pair.rig.K_left, [[50, 0, 25], [0, 46, 18], [0, 0, 1]])
    np.testing.assert_allclose(pair.rig.K_right, [[50, 0, 28], [0, 46, 18], [0, 0, 1]])
    assert pair.guidance.assumed == []
    pair = read_pair(options(files, **NUMBERS, cx=25.0, fy=46.0))
    assert "cy is assumed to be the middle of the image. Give the calibrated numbers (--cy)." in " ".join(
        pair.guidance.assumed
    )


def test_a_calibration_is_for_images_of_its_size(files, tmp_path):
    (width, height), camera = SIZES[0], "[50 0 28; 0 50 19; 0 0 1]"
    text = f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline=110\nwidth={{}}\nheight={height}\nndisp=9\n"
    same = files / "left.png"
    other = tmp_path / "other.png"
    Image.open(same).transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(other)
    calib = tmp_path / "calib.txt"
    calib.write_text(text.format(width))
    base = options(files, **BARE, right=other, calib=(calib,))
    pair = read_pair(base)
    assert pair.rig.E[0, 3] == pytest.approx(0.11) and pair.rig.rectified
    assert read_pair(replace(base, baseline=0.3)).rig.E[0, 3] == pytest.approx(0.3)
    with pytest.raises(InputError, match=r"the right image \S*right.png must be of 54x40 pixels"):
        read_pair(replace(base, right=files / "right.png"))
    calib.write_text(text.format(width + 1))
    with pytest.raises(InputError, match=r"the left image \S*left.png must be of 55x40 pixels"):
        read_pair(base)


def test_known_depths_alone_need_one_camera(files, tmp_path):
    np.save(tmp_path / "points.npy", np.array([[0.1, 0.2, 2.5], [0.0, -0.1, 3000.0]]))
    np.save(tmp_path / "sure.npy", np.array([0.25, 0.75]))
    alone = {"right": None, "k_right": None, "e": None, "points": tmp_path / "points.npy"}
    pair = read_pair(options(files, **alone, points_scale=1000.0, points_confidence=tmp_path / "sure.npy"))
    assert pair.guidance.rights == [] and pair.rig.size_right is None
    np.testing.assert_allclose(pair.rig.E, np.eye(4))
    points = pair.guidance.inputs[0].points.numpy()
    np.testing.assert_allclose(points[:, :3] * 1000, [[0.1, 0.2, 2.5], [0.0, -0.1, 3000.0]], rtol=1e-6)
    np.testing.assert_allclose(points[:, 3], [0.25, 0.75])
    np.testing.assert_allclose(pair.guidance.inputs[0].K_left, KS[0])
    by_numbers = read_pair(options(files, **alone | {"k": None}, fx=50.0))
    np.testing.assert_allclose(by_numbers.rig.E, np.eye(4))
    outside = np.array([[50.0, 0, 90], [0, 50, 19], [0, 0, 1]])
    np.savetxt(tmp_path / "K.txt", outside)
    with pytest.raises(InputError, match="K "):
        read_pair(options(files, **alone | {"k": tmp_path / "K.txt"}))
    read_pair(options(files, **alone | {"k": tmp_path / "K.txt"}, cropped=True))


def test_disparities_become_depths_by_the_rig(files, tmp_path):
    width, height = SIZES[0]
    disparity = np.full((height, width), 4.0, np.float32)
    disparity[3, 5] = 8.0
    np.save(tmp_path / "disparity.npy", disparity * 16)
    more = {
        "right": None,
        "disparity": tmp_path / "disparity.npy",
        "points_scale": 16.0,
        "cx": 26.0,
        "cy": 19.0,
    }
    pair = read_pair(options(files, **NUMBERS | more, fy=50.0, cx_right=29.0))
    known = pair.guidance.inputs[0].points.numpy()
    assert known.shape == (height, width)
    np.testing.assert_allclose(known[3, 5], 50 * 0.12 / (8 + 3), rtol=1e-5)
    np.testing.assert_allclose(known[20, 30], 50 * 0.12 / (4 + 3), rtol=1e-5)
    with pytest.raises(InputError, match="--disparity needs a calibrated rectified rig"):
        reading._read_known(options(files, **NUMBERS | more), KS[0], None, SIZES[0])


def test_images_are_undistorted_by_the_lens_of_each_view(files):
    first, second, third = LENSES
    pair = read_pair(
        options(
            files,
            "third",
            "fourth",
            distortion=(first, second),
            view_distortion=(third, "0,0,0,0"),
            knob=("clean_photographs=false",),
        )
    )
    assert pair.undistorted
    found = [pair.left, *(right.permute(1, 2, 0).numpy() for right in pair.guidance.rights)]
    for number, (image, lens) in enumerate(zip(found, (first, second, third, None), strict=True)):
        taken = image_of(files, NAMES[number])
        if lens is None:
            np.testing.assert_allclose(image, taken, atol=1e-6)
            continue
        numbers = np.array(lens.rpartition(":")[2].split(","), float)
        height, width = taken.shape[:2]
        v, u = np.mgrid[:height, :width]
        rays = np.stack([u, v, np.ones(u.shape)], -1) @ np.linalg.inv(KS[number]).T
        if lens.startswith("fisheye"):
            flat = np.ascontiguousarray(rays[..., :2].reshape(-1, 1, 2))
            at = cv2.fisheye.distortPoints(flat, KS[number], numbers)
        else:
            at, _ = cv2.projectPoints(rays.reshape(-1, 3), np.zeros(3), np.zeros(3), KS[number], numbers)
        at = at.reshape(height, width, 2).astype(np.float32)
        expected = cv2.remap(taken, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        inside = (at >= 1).all(-1) & (at[..., 0] < width - 2) & (at[..., 1] < height - 2)
        assert np.abs(expected - taken)[inside].max() > 0.02
        np.testing.assert_allclose(image[inside], expected[inside], atol=0.02)


def lens(text: str | None) -> Distortion | None:
    return None if text is None else Distortion("opencv", np.array(text.split(","), float))


def numbers_of(lenses) -> list[str | None]:
    return [None if each is None else ",".join(f"{x:g}" for x in each.coefficients) for each in lenses]


FLAT = "0,0,0,0"
A, B, C = "-0.2,0.05,0.001,0", "-0.1,0.02,0,0.002", "0.3,0,0,0"


@pytest.mark.parametrize(
    ("typed", "further", "of_rig", "views", "expected"),
    [
        ((), (), (None, None), 0, [None, None]),
        ((A,), (), (None, None), 0, [A, A]),
        ((A, B), (), (None, None), 2, [A, B, A, A]),
        ((A, FLAT), (C, FLAT), (None, None), 2, [A, None, C, None]),
        ((), (), (A, B), 1, [A, B, A]),
        ((C,), (), (A, B), 1, [C, C, C]),
        ((FLAT,), (B,), (A, A), 1, [None, None, B]),
    ],
)
def test_every_view_has_the_lens_that_is_typed_else_that_of_the_rig(
    files, typed, further, of_rig, views, expected
):
    names = ("third", "fourth")[:views]
    rig = Rig(KS[0], KS[1], ES[1], distortion=tuple(map(lens, of_rig)))
    given = options(files, *names, distortion=typed, view_distortion=further)
    given = replace(given, view_k=given.view_k if further else ())
    assert numbers_of(lenses_of(given, rig)) == expected
    if of_rig == (None, None):
        assert numbers_of(lenses_of(given)) == expected


def test_lenses_that_contradict_something_are_refused(files):
    rectified = Rig(KS[0], KS[1], ES[1], rectified=True, source="calib.txt")
    path = files / "left.png"
    for given, rig, said in (
        ({"distortion": (A, B, C)}, None, "--distortion is given 3 times"),
        ({"distortion": (FLAT, A)}, rectified, "calib.txt is for rectified images"),
        ({"distortion": (A,), "points_confidence": path}, None, "--points-confidence cannot be used"),
        ({"distortion": (A,), "disparity": path}, None, "--disparity cannot be used"),
        ({"distortion": (A,), "prior_map": path}, None, "--prior-map cannot be used"),
    ):
        with pytest.raises(InputError, match=said):
            lenses_of(options(files, **given), rig)
    with pytest.raises(InputError, match="--view-K is given, and the lens of LEFT distorts"):
        lenses_of(options(files, "third", distortion=(FLAT, A)))
    with pytest.raises(InputError, match="--view-distortion must be"):
        lenses_of(options(files, "third", view_distortion=("1",)))
    lenses_of(options(files, distortion=(FLAT,)), rectified)
    lenses_of(options(files, distortion=(FLAT, A), prior_map=path))  # the left lens does not distort
    lenses_of(options(files, "third", distortion=(FLAT, FLAT)))


def test_a_map_of_known_depths_becomes_points_behind_a_lens(files, tmp_path):
    (width, height), rng = SIZES[0], np.random.default_rng(3)
    depth_m = np.where(rng.random((height, width)) < 0.2, rng.uniform(1, 3, (height, width)), 0.0)
    np.save(tmp_path / "map.npy", depth_m.astype(np.float32))
    given = options(files, points=tmp_path / "map.npy")
    np.testing.assert_allclose(reading._read_known(given, KS[0], None, SIZES[0]), depth_m, rtol=1e-6)
    points = reading._read_known(given, KS[0], lens(A), SIZES[0])
    pixels, _ = cv2.projectPoints(
        points.astype(float), np.zeros(3), np.zeros(3), KS[0], lens(A).coefficients.astype(float)
    )
    v, u = np.nonzero(depth_m)
    np.testing.assert_allclose(pixels[:, 0], np.stack([u, v], 1), atol=0.01)
    np.testing.assert_allclose(points[:, 2], depth_m[v, u], rtol=1e-5)
    with pytest.raises(InputError, match="a map of the left image's 40x54 pixels; got 54x40"):
        reading._read_known(given, KS[0], lens(A), SIZES[0][::-1])
    cloud = np.array([[0.1, 0.2, 2.0]])
    np.save(tmp_path / "cloud.npy", cloud)
    np.testing.assert_allclose(
        reading._read_known(options(files, points=tmp_path / "cloud.npy"), KS[0], lens(A), SIZES[0]), cloud
    )
    assert reading._read_known(options(files), KS[0], None, SIZES[0]) is None
    with pytest.raises(InputError, match="--points-scale must be left out"):
        reading._read_known(options(files, points=Path("a.BIN"), points_scale=2.0), KS[0], None, SIZES[0])


def test_a_known_length_is_moved_to_the_undistorted_image(files):
    given = options(files, known_length="10,7, 44,31,1.5")
    assert reading._known_length(given, KS[0], None) == (10.0, 7.0, 44.0, 31.0, 1.5)
    taken, coefficients = np.array([[[10.0, 7.0]], [[44.0, 31.0]]]), lens(A).coefficients
    expected = cv2.undistortPoints(taken, KS[0], coefficients, P=KS[0])
    found = reading._known_length(given, KS[0], lens(A))
    np.testing.assert_allclose(found, [*expected.ravel(), 1.5], atol=1e-3)
    assert reading._known_length(options(files), KS[0], None) is None
    for wrong in ("1,2,3,4", "1,2,3,4,x", "1,2,3,4,5,6"):
        with pytest.raises(InputError, match="--known-length must be X1,Y1,X2,Y2,METRES"):
            reading._known_length(options(files, known_length=wrong), KS[0], None)


@pytest.fixture
def estimated(monkeypatch):
    """The arguments with which cameras would be estimated."""
    calls = []

    def from_photographs(images, **given):
        calls.append((images, given))
        views = zip(images, given["K"], ES, strict=False)
        return GeometryGuidance.from_views(list(views))

    monkeypatch.setattr(reading.GeometryGuidance, "from_photographs", from_photographs)
    return calls


def test_cameras_of_photographs_without_poses_are_those_that_are_given(files, estimated, tmp_path):
    base = {"e": None, "view_e": (), "estimate_pose": True}
    pair = read_pair(options(files, "third", "fourth", **base, baseline=0.25, cropped=True))
    (images, given), *_ = estimated
    for image, name in zip(images, NAMES, strict=True):
        np.testing.assert_allclose(image, image_of(files, name), atol=1e-6)
    np.testing.assert_allclose(given["K"][0], KS[0])
    for K, expected in zip(given["K"][1:], KS[1:], strict=True):
        np.testing.assert_allclose(K, expected)
    assert (given["baseline_m"], given["known_length"], given["cropped"]) == (0.25, None, True)
    assert given["points"] is None and given["config"].planes == 160
    assert (pair.rig.size_left, pair.rig.size_right, pair.rig.source) == (*SIZES[:2], "estimated")

    read_pair(options(files, "third", **base | {"view_k": (), "k_right": None}, known_length="1,2,3,4,5"))
    _, given = estimated[-1]
    np.testing.assert_allclose(given["K"], [KS[0]] * 3)
    assert given["known_length"] == (1.0, 2.0, 3.0, 4.0, 5.0)

    read_pair(options(files, "third", **base | BARE | {"view_k": ()}, fov=70.0))
    _, given = estimated[-1]
    for K, (width, height) in zip(given["K"], SIZES, strict=False):
        assert 2 * np.degrees(np.arctan(width / 2 / K[0, 0])) == pytest.approx(70.0)
        np.testing.assert_allclose(K[:2, 2], [(width - 1) / 2, (height - 1) / 2])

    pair = read_pair(options(files, **base | BARE | {"view_k": ()}, fx=50.0, cy=18.0))
    _, given = estimated[-1]
    np.testing.assert_allclose(given["K"][1], [[50, 0, 29.5], [0, 50, 18], [0, 0, 1]])
    assert len(set(pair.notes)) == 1 and pair.notes[0].code == "camera.filled-in"

    exif = Image.Exif()
    exif[0x8769] = {0xA405: 35}  # focal length in 35 mm equivalent
    for name in NAMES[:2]:
        Image.open(files / f"{name}.png").save(tmp_path / f"{name}.png", exif=exif)
    paths = {name: tmp_path / f"{name}.png" for name in NAMES[:2]}
    pair = read_pair(options(files, **base | BARE | paths | {"view_k": ()}))
    _, given = estimated[-1]
    for K, (width, height) in zip(given["K"], SIZES, strict=False):
        assert K[0, 0] == pytest.approx(35 * np.hypot(width, height) / np.hypot(36, 24), rel=1e-6)
    assert [note.code for note in pair.notes] == ["camera.from-exif"] * 2


def test_views_that_are_no_files_take_the_place_of_the_images(files):
    frames = [image_of(files, "fourth"), image_of(files, "third")]
    pair = read_pair(options(files), frames)
    np.testing.assert_array_equal(pair.left, frames[0])
    np.testing.assert_allclose(pair.guidance.rights[0].permute(1, 2, 0), frames[1], atol=1e-6)
    assert (pair.rig.size_left, pair.rig.size_right) == (SIZES[3], SIZES[2])


def test_both_halves_of_one_picture_are_left_and_right(files, tmp_path):
    left = image_of(files, "left")
    both = np.concatenate([left, left[::-1]], axis=1)
    Image.fromarray(np.rint(both * 255).astype(np.uint8)).save(tmp_path / "both.png")
    more = {"left": tmp_path / "both.png", "right": None, "side_by_side": True}
    pair = read_pair(options(files, "third", **more))
    np.testing.assert_allclose(pair.left, left, atol=1e-6)
    np.testing.assert_allclose(pair.guidance.rights[0].permute(1, 2, 0), left[::-1], atol=1e-6)
    np.testing.assert_allclose(pair.guidance.rights[1].permute(1, 2, 0), image_of(files, "third"), atol=1e-6)


def test_a_prior_map_and_names_for_colmap_are_read_before_the_work(files, tmp_path):
    values = np.linspace(0.1, 0.9, 20 * 30, dtype=np.float32).reshape(20, 30)
    np.save(tmp_path / "prior.npy", values)
    pair = read_pair(options(files, prior_map=tmp_path / "prior.npy"))
    np.testing.assert_array_equal(pair.prior_map, values)
    blank = tmp_path / "le ft.png"
    Image.open(files / "left.png").save(blank)
    with pytest.raises(InputError, match="le ft.png"):
        read_pair(options(files, left=blank, export=("colmap",)))
    read_pair(options(files, left=blank, export=("glb",)))


def test_matrices_are_checked_and_named_by_their_options(files, tmp_path):
    np.savetxt(tmp_path / "bad.txt", np.zeros((3, 3)))
    np.save(tmp_path / "bad-pose.npy", 2 * np.eye(4))
    for given, said in (
        ({"k": tmp_path / "bad.txt"}, "--K"),
        ({"k_right": tmp_path / "bad.txt"}, "--K-right"),
        ({"e": tmp_path / "bad-pose.npy"}, "--E"),
        ({"view_k": (tmp_path / "bad.txt",)}, f"--view-K {tmp_path / 'bad.txt'}"),
        ({"view_e": (tmp_path / "bad-pose.npy",)}, f"--view-E {tmp_path / 'bad-pose.npy'}"),
    ):
        with pytest.raises(InputError) as caught:
            read_pair(options(files, "third", **given))
        assert said in str(caught.value)


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_a_rig_is_read_for_images_that_have_other_names_in_its_calibration(files, tmp_path):
    """Of a model with three images: the pair is the one that is named."""
    lines = ["# Camera list", f"1 PINHOLE {SIZES[0][0]} {SIZES[0][1]} 50 50 27 20"]
    (tmp_path / "cameras.txt").write_text("\n".join(lines) + "\n")
    images = [f"{n} 1 0 0 0 {-0.1 * n} 0 0 1 {name}.png\n" for n, name in enumerate("abc", 1)]
    (tmp_path / "images.txt").write_text("# Image list\n" + "\n".join(images) + "\n")
    given = options(files, **BARE, calib=(tmp_path,))
    rig = read_rig(given, SIZES[0], names=("a.png", "c.png"))
    assert rig.E[0, 3] == pytest.approx(0.2) and rig.unit is None
    assert read_rig(given, SIZES[0], names=("c.png", "b.png")).E[0, 3] == pytest.approx(-0.1)
    renamed = replace(given, left=Path("x/b.png"), right=Path("x/a.png"))
    assert read_rig(renamed, SIZES[0]).E[0, 3] == pytest.approx(-0.1)
    assert rig.size_left == SIZES[0] and rig.size_right is None
