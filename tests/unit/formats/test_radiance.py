"""Inputs of radiance field programs: three images from three cameras."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import radiance
from tests.unit.formats.calibrated_pair import words
from tests.unit.formats.posed_images import (
    CORNER,
    KS,
    POSES,
    SIZES,
    assert_is_read,
    central,
    numbers,
    write_images,
)

NAMES = ["a.png", "b.png", "c.png"]


def splat(n: int) -> dict:
    return {
        "img_name": NAMES[n][0],
        "position": POSES[n][:3, 3].tolist(),
        "rotation": POSES[n][:3, :3].tolist(),
        "fx": 61.5 + n,
        "fy": 57.5 - n,
        "width": SIZES[n][0],
        "height": SIZES[n][1],
    }


def test_splat_cameras_are_camera_to_world_and_central(scan):
    files = write_images(scan / "images", NAMES)
    (scan / "model").mkdir()
    (scan / "model" / "cameras_0.json").write_text('[{"img_name": "a"}]')
    (scan / "model" / "cameras_1.json").write_text("[]")
    assert radiance.read_splat_cameras(scan / "model") is None
    (scan / "model" / "cameras_2.json").write_text(json.dumps([splat(n) for n in range(3)]))
    Ks = [central(n, 61.5 + n, 57.5 - n) for n in range(3)]
    for layout in (
        radiance.read_splat_cameras(scan / "model"),
        radiance.read_splat_cameras(scan / "model" / "cameras_2.json", scan / "images"),
    ):
        assert_is_read(layout, "3D Gaussian splatting", None, files, Ks=Ks)
    mixed = [splat(0), {**splat(1), "fy": None}]
    del mixed[1]["fy"]
    (scan / "model" / "cameras_2.json").write_text(json.dumps(mixed))
    assert radiance.read_splat_cameras(scan / "model") is None


def llff_rows() -> np.ndarray:
    """LLFF columns: down, right, backward, position, (height, width, focal length), then near and far."""
    rows = []
    for n, E in enumerate(POSES):
        right, down, forward, place = E[:3].T
        columns = [down, right, -forward, place, (SIZES[n][1], SIZES[n][0], 60.5 + 10 * n)]
        rows.append([*np.column_stack(columns).ravel(), 0.5, 90.0])
    return np.array(rows)


def test_llff_rows_follow_the_image_names_as_text(scan):
    """In text order, 10 comes before 9."""
    files = write_images(scan / "images_4", ["i10.png", "i8.png", "i9.png"])
    write_images(scan / "images", ["i8.png"])
    write_images(scan / "input", ["x.png", "y.png"])
    np.save(scan / "poses_bounds.npy", llff_rows())
    Ks = [central(n, 60.5 + 10 * n) for n in range(3)]
    for path in (scan, scan / "poses_bounds.npy"):
        assert_is_read(radiance.read_llff(path), "LLFF", None, files, Ks=Ks)
    files[0].unlink()
    sentence = r"\Aposes_bounds\.npy must be an array with one row per image \(1, 2, 2\); got 3\. Its poses "
    with pytest.raises(
        InputError, match=sentence + r"have no names, so images/ must contain exactly those images\."
    ):
        radiance.read_llff(scan)
    np.save(scan / "poses_bounds.npy", llff_rows()[:, :16])
    with pytest.raises(
        InputError,
        match=r"\Aposes_bounds\.npy must be an array with rows of 17 numbers; got shape \(3, 16\) in ",
    ):
        radiance.read_llff(scan)
    np.save(scan / "poses_bounds.npy", llff_rows()[0])
    with pytest.raises(
        InputError, match=r"\Aposes_bounds\.npy must be an array with rows of 17 numbers; got shape \(17,\)"
    ):
        radiance.read_llff(scan)
    (scan / "poses_bounds.npy").unlink()
    assert radiance.read_llff(scan) is None
    np.save(scan / "poses_bounds.npy", llff_rows())
    for folder in ("images", "images_4", "input"):
        for file in (scan / folder).iterdir():
            file.unlink()
    with pytest.raises(InputError, match=r"an array with one row per image \(none\); got 3\."):
        radiance.read_llff(scan)


@pytest.mark.parametrize(
    ("name", "folder"),
    [
        ("cameras_sphere.npz", "image"),
        ("cameras.npz", "images"),
        ("cameras_large.npz", "rgb"),
        ("cameras.npz", ""),
    ],
)
def test_neus_projections_may_be_scaled(scan, name, folder):
    files = write_images(scan / folder, ["10.png", "8.png", "9.png"])
    Ks = [K + [[0, 2.5 - n, 0], [0, 0, 0], [0, 0, 0]] for n, K in enumerate(KS)]
    factors = (0.7, -1.9, 35.0)
    matrices = {}
    for n, (K, E) in enumerate(zip(Ks, POSES, strict=True)):
        P = np.eye(4)
        P[:3] = factors[n] * K @ np.linalg.inv(E)[:3]
        matrices |= {f"world_mat_{n}": P, f"scale_mat_{n}": np.diag([3.0, 3, 3, 1])}
    np.savez(scan / name, **matrices)
    for path in (scan, scan / name):
        assert_is_read(radiance.read_neus(path), "NeuS", None, files, Ks=Ks, sizes=None)
    assert radiance.read_neus(scan / "nowhere") is None
    del matrices["world_mat_1"]
    np.savez(scan / name, **matrices)
    problems = [each.problem for each in radiance.read_neus(scan).candidates]
    assert problems == ["", "its entries cannot be read (KeyError: 'world_mat_1')", ""]
    for file in files:
        file.unlink()
    assert radiance.read_neus(scan) is None


def test_sdfstudio_frames_have_their_own_intrinsics(scan):
    files = write_images(scan, NAMES)
    frames = []
    for n in range(3):
        matrix = np.eye(4)
        matrix[:3, :3] = KS[n] + CORNER + [[0, 1.25, 0], [0, 0, 0], [0, 0, 0]]
        frames.append({"rgb_path": NAMES[n], "camtoworld": POSES[n].tolist(), "intrinsics": matrix.tolist()})
    (scan / "meta_data.json").write_text(json.dumps({"width": 82, "height": 61, "frames": frames}))
    Ks = [K + [[0, 1.25, 0], [0, 0, 0], [0, 0, 0]] for K in KS]
    layout = radiance.read_sdfstudio(scan)
    assert_is_read(layout, "SDFStudio", None, files, Ks=Ks, sizes=[SIZES[0]] * 3)
    moved = write_images(scan / "other", NAMES)
    given = radiance.read_sdfstudio(scan, scan / "other")
    assert [each.frame.image for each in given.candidates] == moved
    for content in ("[]", '{"frames": []}', '{"frames": [{"rgb_path": "a", "camtoworld": 1}]}', "{}"):
        (scan / "meta_data.json").write_text(content)
        assert radiance.read_sdfstudio(scan) is None


def nerfies_camera(n: int, **changes) -> dict:
    fx, fy, *centre = numbers(n, 0.5)
    entries = {"orientation": POSES[n][:3, :3].T.tolist(), "position": POSES[n][:3, 3].tolist()}
    entries |= {"focal_length": fx, "pixel_aspect_ratio": fy / fx, "principal_point": centre, "skew": 0.5 + n}
    entries |= {"image_size": SIZES[n], "radial_distortion": [0.1, 0.2 + n, 0.3]}
    entries |= {"tangential_distortion": [0.4 + n, 0.5]} | changes
    return {key: value for key, value in entries.items() if value is not None}


@pytest.mark.parametrize("folder", ["rgb/1x", "rgb/2x", "rgb/4x", "rgb/8x", "rgb/16x"])
def test_nerfies_orientation_is_world_to_camera(scan, folder):
    files = write_images(scan / folder, NAMES)
    (scan / "camera").mkdir()
    cameras = [nerfies_camera(n) for n in range(3)]
    cameras[1]["tangential"] = cameras[1].pop("tangential_distortion")
    for name, entries in zip(NAMES, cameras, strict=True):
        (scan / "camera" / name).with_suffix(".json").write_text(json.dumps(entries))
    Ks = [K + [[0, 0.5 + n, 0], [0, 0, 0], [0, 0, 0]] for n, K in enumerate(KS)]
    lenses = [(0.1, 0.2 + n, 0.4 + n, 0.5, 0.3) for n in range(3)]
    assert_is_read(radiance.NERFIES(scan), "Nerfies", None, files, Ks=Ks, lenses=lenses)


def test_nerfies_cameras_may_omit_zero_entries(scan):
    files = write_images(scan / "rgb" / "1x", NAMES)
    write_images(scan / "rgb" / "2x", NAMES)
    (scan / "camera").mkdir()
    assert radiance.NERFIES(scan) is None
    bare = nerfies_camera(
        2, skew=None, pixel_aspect_ratio=None, radial_distortion=[], tangential_distortion=None
    )
    (scan / "camera" / "c.json").write_text(json.dumps(bare))
    (scan / "camera" / "b.json").write_text('{"orientation": 1, "position": 2}')
    layout = radiance.NERFIES(scan)
    assert [each.frame.image for each in layout.candidates] == files
    assert layout.candidates[1].problem == (
        "the camera of b must be a camera of Nerfies; got no focal_length, image_size, principal_point."
    )
    assert "the camera of a" in layout.candidates[0].problem
    camera = layout.candidates[2].camera
    fx, _, cx, cy = numbers(2)
    np.testing.assert_allclose(camera.K, [[fx, 0, cx], [0, fx, cy], [0, 0, 1]])
    assert not np.any(camera.coefficients) and len(camera.coefficients) == 5


@pytest.mark.parametrize(
    ("same_names", "lenses"), [(True, "one"), (True, "each"), (True, "both"), (False, "one"), (False, "each")]
)
def test_nsvf_poses_follow_the_order_of_names(scan, same_names, lenses):
    files = write_images(scan / "rgb", ["i10.png", "i8.png", "i9.png"])
    (scan / "pose").mkdir()
    names = ["i10", "i8", "i9"] if same_names else ["1", "2", "3"]
    for name, E in zip(names, POSES, strict=True):
        (scan / "pose" / f"{name}.txt").write_text("\n".join(words(row) for row in E))

    def matrix(K) -> str:
        whole = np.eye(4)
        whole[:3, :3] = K
        return words(whole)

    own, one = np.array(KS), np.diag([9.0, 8, 1])
    if lenses != "one":
        (scan / "intrinsics").mkdir()
        for name, K in zip(names, own, strict=True):
            (scan / "intrinsics" / f"{name}.txt").write_text(matrix(K))
    if lenses != "each" or not same_names:
        (scan / "intrinsics.txt").write_text(matrix(one))
    Ks = own if lenses != "one" and same_names else [one] * 3
    assert_is_read(radiance.read_nsvf(scan), "NSVF", None, files, Ks=Ks, sizes=None)


def test_nsvf_needs_images_poses_and_a_camera(scan):
    files = write_images(scan / "rgb", NAMES)
    (scan / "pose").mkdir()
    (scan / "intrinsics.txt").write_text(words(KS[0]))
    assert radiance.read_nsvf(scan) is None
    for n in range(2):
        (scan / "pose" / f"{n}.txt").write_text(words(POSES[n]))
    with pytest.raises(
        InputError, match=r"\Apose/ must be a folder of 3 files, one per image in rgb/; got 2\. NSVF"
    ):
        radiance.read_nsvf(scan)
    (scan / "intrinsics.txt").unlink()
    assert radiance.read_nsvf(scan) is None
    (scan / "intrinsics.txt").write_text(words(KS[0]))
    for file in files:
        file.unlink()
    assert radiance.read_nsvf(scan) is None
