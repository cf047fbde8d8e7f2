"""What readers of data sets take from a folder, which samples are selected, how samples are changed."""

import json
import re
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER
from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation import datasets
from geodiff_plugin.evaluation.datasets import (
    DATASETS,
    SampleRef,
    find_pairs,
    in_split,
    layouts,
    load,
    select,
)
from geodiff_plugin.evaluation.datasets import sample as module
from geodiff_plugin.evaluation.datasets.sample import (
    ExtraView,
    StereoSample,
    changed_ref,
    depth_to_disparity,
    disparity_to_depth,
    make_sample,
    two_numbers,
    with_drifted_rig,
    with_perturbed_poses,
    with_scaled_rig,
)
from geodiff_plugin.evaluation.datasets.splits import SPLITS, split_of
from geodiff_plugin.evaluation.options import DirOptions, PairsOptions
from geodiff_plugin.formats import write_pfm
from tests.views import made_rig

SIZE = (12, 20)
LARGE = (36, 52)


def touch(root, *names):
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()


def named(root, ref):
    """The files of a reference below the root, as text."""
    return {k: str(v.relative_to(root)) if isinstance(v, Path) else v for k, v in ref.files.items()}


def test_the_protocol_of_every_set():
    assert list(DATASETS)[:9] == [
        *("kitti2015", "kitti2012", "middlebury2014", "middeval3", "eth3d", "booster"),
        *("mvsnet", "robustmvd", "folder"),
    ]
    caps = {name: dataset.cap_m for name, dataset in DATASETS.items() if dataset.cap_m is not None}
    assert caps == {"kitti2015": 80.0, "kitti2012": 80.0, "booster": 10.0, "scannet": 10.0}
    posed = {name for name, dataset in DATASETS.items() if set(dataset.options) == {"pairs", "pixel_centre"}}
    assert posed == {"mvsnet", "robustmvd"}
    assert all(dataset.needs_folder for name, dataset in DATASETS.items() if name != "synthetic")


def test_folders_are_listed_level_by_level_in_order(tmp_path):
    touch(tmp_path, "b/x/1/2/3/f", "a/y/f", "file")
    found = [str(p.relative_to(tmp_path)) for p in module.folders(tmp_path, 2)]
    assert found == [".", "a", "b", "a/y", "b/x"]
    assert len(module.folders(tmp_path, 1)) == 3 and module.folders(tmp_path / "file", 3) == []


def test_kitti_takes_colour_and_all_pixels_where_they_are_there(tmp_path):
    names = ("000001_10.png", "000002_10.png", "000001_11.png")
    touch(tmp_path, *(f"training/{f}/{n}" for f in ("image_0", "colored_0", "disp_noc") for n in names))
    touch(tmp_path, "training/disp_occ/000002_10.png")
    first, second = find_pairs(tmp_path, ["kitti2012"])
    assert (first.name, second.name) == ("000001", "000002")
    common = {"left": "training/colored_0/{}.png", "right": "training/colored_1/{}.png"}
    assert named(tmp_path, first) == {
        **{k: v.format("000001_10") for k, v in common.items()},
        **{"disparity": "training/disp_noc/000001_10.png", "noc": None, "cameras": (2, 3)},
        "calibration": "training/calib/000001.txt",
    }
    assert named(tmp_path, second) == {
        **{k: v.format("000002_10") for k, v in common.items()},
        **{"disparity": "training/disp_occ/000002_10.png", "noc": "training/disp_noc/000002_10.png"},
        **{"calibration": "training/calib/000002.txt", "cameras": (2, 3)},
    }
    touch(tmp_path / "grey", *(f"training/{f}/{names[0]}" for f in ("image_0", "disp_occ")))
    (grey,) = find_pairs(tmp_path / "grey", ["kitti2012"])
    assert grey.files["cameras"] == (0, 1) and grey.files["right"].parent.name == "image_1"
    touch(tmp_path / "2015", *(f"a/b/training/{f}/{names[0]}" for f in ("image_2", "disp_occ_0")))
    (found,) = find_pairs(tmp_path / "2015", ["kitti2015"])
    assert found.files["right"].parent.name == "image_3" and found.files["noc"] is None
    assert found.files["calibration"].parent.name == "calib_cam_to_cam"
    assert found.files["disparity"].parent.name == "disp_occ_0"
    touch(tmp_path / "bare", f"training/image_2/{names[0]}")  # neither kind of truth
    assert find_pairs(tmp_path / "bare", ["kitti2015"]) == []


def test_scenes_are_of_the_set_that_ground_truth_and_folders_name(tmp_path):
    def scene(folder, *more):
        touch(tmp_path, f"{folder}/im0.png", f"{folder}/im1.png", f"{folder}/calib.txt", *more)

    scene("m/Old", "m/Old/disp0.pfm")
    scene("m/New", "m/New/disp0GT.pfm", "m/New/mask0nocc.png")
    scene("m/Both", "m/Both/disp0.pfm", "m/Both/disp0GT.pfm")
    scene("ETH3D/x", "ETH3D/x/disp0GT.pfm")
    scene("two_view_training/y", "two_view_training_gt/y/disp0GT.pfm", "two_view_training_gt/y/mask0nocc.png")
    scene("testH/z")
    scene("m/Nothing")
    touch(tmp_path, "m/Half/im0.png", "m/Half/disp0.pfm", "n/Half/calib.txt")
    found = {name: [ref.name for ref in find_pairs(tmp_path, [name])] for name in list(DATASETS)[2:5]}
    assert found == {"middlebury2014": ["Both", "Nothing", "Old"], "middeval3": ["New"], "eth3d": ["x", "y"]}
    (new,) = find_pairs(tmp_path, ["middeval3"])
    assert named(tmp_path, new) == {
        **{"left": "m/New/im0.png", "right": "m/New/im1.png", "calibration": "m/New/calib.txt"},
        **{"disparity": "m/New/disp0GT.pfm", "mask": "m/New/mask0nocc.png"},
    }
    other = named(tmp_path, find_pairs(tmp_path, ["eth3d"])[1])
    assert other["disparity"] == "two_view_training_gt/y/disp0GT.pfm" and other["left"].endswith(
        "training/y/im0.png"
    )
    assert other["mask"] == "two_view_training_gt/y/mask0nocc.png"


def test_the_depth_of_a_scene_follows_from_both_cameras(tmp_path):
    """Their principal points differ (doffs), and pixels that are occluded in the right view are marked."""
    rng = np.random.default_rng(0)
    disparity = rng.uniform(2, 6, LARGE).astype(np.float32)
    disparity[2, 3:6] = np.inf
    mask = np.full(LARGE, 255, np.uint8)
    mask[5, 1:4] = 128
    folder = tmp_path / "m/Scene"
    folder.mkdir(parents=True)
    write_pfm(folder / "disp0.pfm", disparity)
    Image.fromarray(mask).save(folder / "mask0nocc.png")
    for name in ("im0", "im1"):
        Image.fromarray(rng.integers(0, 255, (*LARGE, 3), dtype=np.uint8)).save(folder / f"{name}.png")
    (folder / "calib.txt").write_text(
        "cam0=[30 0 9.5; 0 30 5.5; 0 0 1]\ncam1=[30 0 12; 0 30 5.5; 0 0 1]\ndoffs=2.5\nbaseline=250\n"
        f"width={LARGE[1]}\nheight={LARGE[0]}\n"
    )
    sample = load(find_pairs(tmp_path, ["middlebury2014"])[0])
    known = np.isfinite(disparity)
    np.testing.assert_array_equal(sample.valid, known)
    np.testing.assert_allclose(sample.depth_m[known], 30 * 0.25 / (disparity[known] + 2.5), rtol=1e-5)
    np.testing.assert_array_equal(sample.occluded, mask == 128)


def test_booster_has_a_pair_of_every_lighting(tmp_path):
    touch(
        tmp_path,
        "Cup/camera_00/im1.png",
        "Cup/camera_00/im0.png",
        "Cup/camera_02/im0.png",
        "Mono/camera_00/im0.png",
    )
    first, second = find_pairs(tmp_path, ["booster"])
    assert (first.label, second.name) == ("booster/Cup-im0", "Cup-im1")
    assert named(tmp_path, second) == {
        **{"left": "Cup/camera_00/im1.png", "right": "Cup/camera_02/im1.png", "disparity": "Cup/disp_00.npy"},
        **{
            "occluded": "Cup/mask_00.png",
            "material": "Cup/mask_cat.png",
            "calibration": "Cup/calib_00-02.xml",
        },
    }


def test_a_quarter_of_an_image_is_the_mean_of_squares_and_keeps_its_rays():
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (24, 40, 3), dtype=np.uint8)
    K = np.array([[77.0, 0, 18.25], [0, 69.0, 13.75], [0, 0, 1]])
    small, camera = layouts._quartered(image, Camera(K))
    blocks = image.reshape(6, 4, 10, 4, 3).astype(float).mean((1, 3))
    np.testing.assert_array_equal(small, np.rint(blocks))
    # The centre of a square of four pixels from 4 i on is 4 i + 1.5.
    for u, v in ((3, 2), (9, 0)):
        ray = np.linalg.inv(K) @ [4 * u + 1.5, 4 * v + 1.5, 1]
        np.testing.assert_allclose(np.linalg.inv(camera.K) @ [u, v, 1], ray, rtol=1e-9)
    values = np.arange(24 * 40).reshape(24, 40)
    np.testing.assert_array_equal(values[layouts._EVERY], values[2::4, 2::4])


def test_the_step_of_ground_truth_is_its_smallest_gap_if_that_is_coarse():
    assert module.step_px(np.array([1.0, 3.0, 3.5, 1.0, 9.0])) == 0.5
    assert module.step_px(np.array([1.0, 1.0 + 1 / 16, 3.0])) == 0.0
    assert module.step_px(np.array([1.0, 1.07])) == pytest.approx(0.07)
    assert module.step_px(np.array([4.0])) == module.step_px(np.array([])) == 0.0


def write_pair_txt(folder, text):
    touch(folder, "images/x", "cams/x")
    (folder / "pair.txt").write_text(text)


PAIR_TXT = "3\n4\n6 9 90 7 80 2 70 1 60 5 50 3 40\n\n9\n2 4 10 7 5\n7\n0\n"


def test_posed_pairs_take_sources_in_order_and_at_most_four_further_views(tmp_path):
    folder = tmp_path / "scan"
    write_pair_txt(folder, PAIR_TXT)
    assert layouts._sources_of(folder / "pair.txt") == {4: [9, 7, 2, 1, 5, 3], 9: [4, 7], 7: []}
    touch(folder, "images/00000001.jpeg", "images/00000002.jpg", "images/00000002.png")
    (first,) = find_pairs(tmp_path, ["mvsnet"])
    assert (
        first.name == "scan"
        and first.files["views"] == (1, 2, 3, 4, 5, 7)
        and first.files["pixel_centre"] == 0.0
    )
    files = named(tmp_path, first)
    assert files["left"] == "scan/images/00000001.jpeg" and files["right"] == "scan/images/00000002.png"
    assert (
        files["image 3"] == "scan/images/00000003.png" and files["camera 7"] == "scan/cams/00000007_cam.txt"
    )
    assert (
        files["calibration"] == "scan/cams/00000001_cam.txt" and files["truth"] == "scan/depths/00000001.pfm"
    )
    assert files["calibration_right"] == "scan/cams/00000002_cam.txt"
    every = find_pairs(tmp_path, ["mvsnet"], pairs="all", pixel_centre=0.25)
    assert [(ref.name, ref.files["views"]) for ref in every] == [
        *((f"scan-4-{j}", (4, j, *rest)) for j, rest in ((9, (7, 2, 1, 5)), (7, (9, 2, 1, 5)))),
        *((f"scan-4-{j}", (4, j, 9, 7, *[k for k in (2, 1, 5) if k != j][:2])) for j in (2, 1, 5, 3)),
        *(("scan-9-4", (9, 4, 7)), ("scan-9-7", (9, 7, 4))),
    ]
    assert every[0].files["pixel_centre"] == 0.25
    with pytest.raises(ValueError, match="pairs must be one of"):
        find_pairs(tmp_path, ["mvsnet"], pairs="some")
    (folder / "pair.txt").write_text("1\n3\n0\n")
    assert find_pairs(tmp_path, ["mvsnet"]) == []
    for text in ("2\n1\n1 2 9\n", "x\n", "1\n1\n"):
        (folder / "pair.txt").write_text(text)
        with pytest.raises(ValueError, match=r"pair.txt must be a pair.txt \(count"):
            find_pairs(tmp_path, ["mvsnet"])


def test_the_benchmark_uses_its_key_views_and_counts_ground_truth_from_one(tmp_path):
    folder = tmp_path / "Ignatius"
    write_pair_txt(folder, "2\n37\n2 12 9 40 8\n18\n1 17 9\n")
    assert [ref.dataset for ref in find_pairs(tmp_path)] == ["mvsnet"]  # without the benchmark's truth
    touch(folder, "depth/x")
    (ref,) = find_pairs(tmp_path)
    assert (ref.label, ref.files["views"]) == ("robustmvd/Ignatius-37-12", (37, 12, 40))
    assert ref.files["truth"] == folder / "depth" / "000038.npz" and ref.files["pixel_centre"] == 0.5
    assert layouts.KEY_VIEWS["Barn"][::17] == (60, 400) and layouts.KEY_VIEWS["Church"][::24] == (10, 490)
    assert layouts.KEY_VIEWS["Ignatius"][::12] == (17, 257)


def test_own_folders_prefer_png_and_report_what_is_missing(tmp_path):
    touch(
        tmp_path,
        "a/left.jpg",
        "a/left.png",
        "a/left.txt",
        "a/right.webp",
        "a/calib.yaml",
        "a/calib.yml",
        "a/depth.pfm",
        "a/depth.png",
    )
    touch(
        tmp_path,
        "b/left.png",
        "b/calib_left.txt",
        "b/calib_right.txt",
        "c/left.png",
        "d/right.png",
        "d/calib.txt",
    )
    touch(
        tmp_path, "e/left.png", "e/calib_left.txt", "left.png", "right.png", "x/y/left.png", "x/y/right.png"
    )
    found = {ref.name: named(tmp_path, ref) for ref in find_pairs(tmp_path, ["folder"])}
    assert list(found) == [tmp_path.name, "a", "b", "d"]
    assert found["a"] == {
        **{"left": "a/left.png", "right": "a/right.webp", "calibration": "a/calib.yaml"},
        **{"calibration_right": None, "depth": "a/depth.pfm"},
    }
    assert found["b"] == {
        **{"left": "b/left.png", "right": "b/right.png", "calibration": "b/calib_left.txt"},
        **{"calibration_right": "b/calib_right.txt", "depth": None},
    }
    assert found["d"]["left"] == "d/left.png" and found[tmp_path.name]["calibration"] == "calib.txt"


@pytest.mark.parametrize("suffix", ["npy", "pfm", "png", "mm"])
def test_own_depth_is_read_in_metres_with_its_holes(tmp_path, suffix):
    rng = np.random.default_rng(0)
    depth = np.round(rng.uniform(1, 6, LARGE), 3).astype(np.float32)
    depth[3, 4:7] = 0
    for side in ("left", "right"):
        Image.fromarray(rng.integers(0, 255, (*LARGE, 3), dtype=np.uint8)).save(tmp_path / f"{side}.png")
    (tmp_path / "calib.txt").write_text("30 0 9.5 0 31 5.5 0 0 1\n0.25\n")
    path = tmp_path / ("depth_mm.png" if suffix == "mm" else f"depth.{suffix}")
    if suffix in ("png", "mm"):
        Image.fromarray(np.rint(1000 * depth).astype(np.uint16)).save(path)
    else:
        (np.save if suffix == "npy" else write_pfm)(path, depth)
    sample = load(find_pairs(tmp_path, ["folder"])[0])
    np.testing.assert_allclose(sample.depth_m, depth, atol=1e-6)
    np.testing.assert_array_equal(sample.valid, depth > 0)
    assert (
        sample.notes == {"truth": path.name}
        and sample.label == f"folder/{tmp_path.name}"
        and sample.rectified
    )
    path.unlink()
    sample = load(find_pairs(tmp_path, ["folder"])[0])
    assert not sample.valid.any() and sample.depth_m.shape == LARGE
    words = f"no depth.npy, depth.pfm, depth.png or depth_mm.png in {tmp_path}"
    assert sample.notes == {"truth": words}
    with pytest.raises(ValueError, match=r"known for at least one pixel; got none \(no depth.npy"):
        sample.check_ground_truth()
    if suffix == "npy":
        np.save(path, np.rint(1000 * depth).astype(np.int32))
        with pytest.raises(ValueError, match="int32"):
            load(find_pairs(tmp_path, ["folder"])[0])


def test_a_file_of_another_size_is_named_with_both_sizes(tmp_path):
    with pytest.raises(ValueError, match=r"f.png must be for 20 x 12 pixels as the right image; got 12 x 20"):
        module.check_size(Path("f.png"), (20, 12), (12, 20, 3), "right")
    module.check_size(Path("f.png"), (12, 20), (12, 20, 3))
    values = np.ones(SIZE)
    assert module.like(np.ones((*SIZE, 3)), Path("f"), values) is values


@pytest.mark.parametrize("second", [None, Path("b.txt")])
def test_calibrations_are_read_for_the_names_and_the_size_of_the_images(monkeypatch, second):
    """The left image is 20 x 12 pixels, the right one 30 x 16; a calibration of other sizes is rejected."""
    images = {Path("l.png"): np.zeros((12, 20, 3), np.uint8), Path("r.png"): np.zeros((16, 30, 3), np.uint8)}
    monkeypatch.setattr(layouts, "read_rgb", lambda path, name: images[path])
    asked, sizes = [], ((20, 12), (30, 16))
    rig = made_rig(np.eye(3), np.eye(3), np.eye(4), sizes)
    monkeypatch.setattr(
        layouts, "read_calibration", lambda *given, **more: asked.append((given, more)) or rig
    )
    files = {"left": Path("l.png"), "right": Path("r.png"), "calibration": Path("a.txt")}
    ref = SampleRef("d", "n", files | {"calibration_right": second, "cameras": (2, 3)})
    (left, right), found = layouts._read_pair(ref)
    assert left is images[files["left"]] and right is images[files["right"]] and found is rig
    paths = Path("a.txt") if second is None else (Path("a.txt"), second)
    named = {"image_names": ("l.png", "r.png"), "image_size": (20, 12)}
    assert asked == [((paths, (2, 3), "l.png"), named)]
    for side, file in (("left", "a.txt"), ("right", "a.txt" if second is None else "b.txt")):
        turned = ((12, 20), sizes[1]) if side == "left" else (sizes[0], (12, 20))
        rig = made_rig(np.eye(3), np.eye(3), np.eye(4), turned)
        with pytest.raises(
            ValueError, match=f"{file} must be for .* pixels as the {side} image; got 12 x 20"
        ):
            layouts._read_pair(ref)


K_LEFT = np.array([[50.0, 0, 11.0], [0, 60.0, 7.0], [0, 0, 1]])
K_RIGHT = np.array([[50.0, 0, 14.5], [0, 60.0, 7.0], [0, 0, 1]])


def test_disparity_and_depth_are_inverse_with_offset_principal_points():
    E = np.eye(4)
    E[0, 3] = 0.3
    disparity = np.array([[2.0, 10.0, -1.0, -3.5, -4.0, np.nan, np.inf]])
    depth = disparity_to_depth(disparity, K_LEFT, K_RIGHT, E)
    np.testing.assert_allclose(depth, [[15 / 5.5, 15 / 13.5, 15 / 2.5, 0, 0, 0, 0]], rtol=1e-6)
    assert depth.dtype == np.float32
    np.testing.assert_allclose(
        depth_to_disparity(depth[:, :3], K_LEFT, K_RIGHT, E), disparity[:, :3], atol=1e-5
    )
    E[0, 3] = 0.0
    with pytest.raises(ValueError, match=r"E\[0, 3\] must be positive"):
        disparity_to_depth(disparity, K_LEFT, K_RIGHT, E)


def random_sample(rectified=True) -> StereoSample:
    rng, E = np.random.default_rng(2), np.eye(4)
    E[:3, 3] = (0.3, 0, 0) if rectified else (0.3, -0.1, 0.05)
    if not rectified:
        E[:3, :3] = Rotation.from_euler("xyz", (5, -8, 3), degrees=True).as_matrix()
    depth = rng.uniform(2, 4, SIZE)
    depth[:2] = np.inf
    depth[2] = -1
    images = tuple(
        cv2.GaussianBlur(rng.integers(0, 255, (*s, 3), dtype=np.uint8), (5, 5), 2) for s in (SIZE, (40, 60))
    )
    K = K_LEFT if rectified else K_LEFT * [[1], [1.1], [1]]
    return make_sample(SampleRef("d", "n", {}), images, made_rig(K_LEFT, K, E), depth, {"truth": "t"})


def test_a_made_sample_holds_what_it_is_given_and_zero_for_unknown_depth():
    for rectified in (True, False):
        sample = random_sample(rectified)
        assert sample.rectified is rectified and sample.label == "d/n" and sample.notes == {"truth": "t"}
        assert not sample.valid[:3].any() and sample.valid[3:].all()
        assert (sample.depth_m[:3] == 0).all() and sample.depth_m.dtype == np.float32
        assert sample.left.shape == (*SIZE, 3) and sample.right.shape == (40, 60, 3)
        assert sample.E_scored is sample.E and sample.check_ground_truth() is sample
        assert (sample.occluded, sample.material, sample.extra_views, sample.E_true) == (None, None, (), None)
        other = replace(sample, E_true=2 * sample.E)
        assert other.E_scored is other.E_true
    given = {"left": sample.left, "right": sample.right, "K_left": K_LEFT, "K_right": K_LEFT, "E": np.eye(4)}
    assert StereoSample("d", "n", **given, depth_m=sample.depth_m, valid=sample.valid).rectified is False


@pytest.mark.parametrize(("degrees", "fraction"), [(12.0, 0.5), (3.0, 0.05)])
def test_wrong_poses_are_within_what_was_asked_keep_the_baseline_and_are_of_two_kinds(degrees, fraction):
    sample = random_sample(rectified=False)
    view = ExtraView(sample.right, K_RIGHT, np.linalg.inv(sample.E))
    sample = replace(sample, extra_views=(view,))
    depth, kinds, turns = float(np.median(sample.depth_m[sample.valid])), [], []
    for name in map(str, range(24)):
        wrong = with_perturbed_poses(sample, (degrees, fraction), name)
        assert wrong.name == name and wrong.E_true is sample.E and wrong.E_scored is sample.E
        assert wrong.extra_views[0].image is view.image and wrong.extra_views[0].K is view.K
        for E, given in ((sample.E, wrong.E), (view.E, wrong.extra_views[0].E)):
            np.testing.assert_allclose(given[3], [0, 0, 0, 1])
            baseline, kept = np.linalg.norm(E[:3, 3]), np.linalg.norm(given[:3, 3])
            assert kept == pytest.approx(baseline)
            turn = Rotation.from_matrix(E[:3, :3].T @ given[:3, :3]).as_rotvec()
            turns.append(np.degrees(np.linalg.norm(turn)))
            # The direction of the moved centre, in the camera, up to its length.
            ideal = -np.cross(turn, (0, 0, depth))
            ideal *= min(1.0, fraction * baseline / np.linalg.norm(ideal))
            moved = E[:3, 3] + E[:3, :3] @ ideal
            kinds.append(np.allclose(given[:3, 3], moved * baseline / np.linalg.norm(moved), atol=1e-9))
            angle = np.arccos(np.clip(E[:3, 3] @ given[:3, 3] / baseline**2, -1, 1))
            assert angle <= np.arcsin(fraction) + 1e-6
    assert 0.3 * degrees - 1e-9 <= min(turns) < 0.4 * degrees and 0.9 * degrees < max(turns) <= degrees + 1e-9
    assert 10 < sum(kinds) < 38
    again = with_perturbed_poses(wrong, (degrees, fraction), "again")
    assert again.E_true is sample.E


def test_a_drifted_rig_is_a_turned_camera_with_its_image_up_or_down():
    """A dot of the right image is where the turned camera sees its ray, then the shift."""
    sample = random_sample()
    sample = replace(sample, K_right=np.array([[52.0, 0, 27.0], [0, 47.0, 21.0], [0, 0, 1]]))
    signs = set()
    for name in ("a", "b", "c", "d", "e", "f"):
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        axis = rng.normal(size=3)
        R = Rotation.from_rotvec(np.radians(4.0) * axis / np.linalg.norm(axis)).as_matrix()
        dots = np.zeros((40, 60, 3), np.uint8)
        dots[18:23, 25:30] = 255
        moved = with_drifted_rig(replace(sample, right=dots), (4.0, 3.0), name)
        assert moved.name == name and moved.E is sample.E and moved.right.shape == (40, 60, 3)
        weight = moved.right[..., 0].astype(float)
        v, u = np.mgrid[:40, :60]
        centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
        x, y, z = sample.K_right @ R @ np.linalg.inv(sample.K_right) @ [27, 20, 1]
        assert centre[0] == pytest.approx(x / z, abs=0.2)
        shift = centre[1] - y / z
        assert abs(shift) == pytest.approx(3, abs=0.2)
        signs.add(np.sign(shift))
    assert signs == {-1, 1}
    still = with_drifted_rig(sample, (0.0, 0.0), "x")
    np.testing.assert_array_equal(still.right, sample.right)


def test_changes_are_named_by_their_numbers():
    ref = SampleRef("d", "n", {"left": 1})
    changed = changed_ref(ref, "perturbed", (1.5, 0.1)), changed_ref(ref, "drifted", (0.25, 2.0))
    assert [c.label for c in changed] == ["d/n-turn1.5-shift0.1", "d/n-drift0.25-2px"]
    assert changed[0].files == {"left": 1, "perturbed": (1.5, 0.1)}
    assert changed[1].files == {"left": 1, "drifted": (0.25, 2.0)} and ref.files == {"left": 1}


@pytest.mark.parametrize(
    ("text", "option", "expected"),
    [
        *(
            (" 1.5 , .1 ", "--perturb", (1.5, 0.1)),
            ("30,0.9", "--perturb", (30, 0.9)),
            ("0,0", "--drift", (0, 0)),
        ),
        *(("5,20", "--drift", (5, 20)), ("30.1,0", "--perturb", None), ("0,0.91", "--perturb", None)),
        *(
            ("5.1,0", "--drift", None),
            ("0,20.1", "--drift", None),
            ("-1,0", "--drift", None),
            ("1", "--drift", None),
        ),
    ],
)
def test_two_numbers_are_read_within_their_ranges(text, option, expected):
    if expected is not None:
        assert two_numbers(text, option) == expected
        return
    words = (
        r"DEGREES,FRACTION.*\[0, 30\] and \[0, 0.9\]"
        if option == "--perturb"
        else r"DEGREES,PIXELS.*\[0, 5\] and \[0, 20\]"
    )
    with pytest.raises(ValueError, match=f"{option} must be {words}; got '{text}'"):
        two_numbers(text, option)


REFS = [SampleRef("d", f"{word}{i}", {}) for i in range(5) for word in ("room", "yard")]


def options(**changes):
    return PairsOptions(data=Path("data"), **changes)


def test_scenes_then_a_draw_then_the_limit_then_wrong_poses(monkeypatch):
    asked = []
    monkeypatch.setattr(datasets, "find_pairs", lambda *given, **more: asked.append((*given, more)) or REFS)
    reported = {"scenes": ("room",), "sample": 4, "limit": 2, "perturb": "2,0.5", "seed": 3}
    drawn = [r.name for r in select(options(scenes=("room",), sample=4, seed=3))]
    assert len(drawn) == 4 and drawn == sorted(drawn) and {n[:4] for n in drawn} == {"room"}
    assert asked[-1] == (Path("data"), None, {"pairs": "default", "pixel_centre": None})
    assert [r.name for r in select(options(**reported))] == [f"{n}-turn2-shift0.5" for n in drawn[:2]]
    assert select(options(**reported))[0].files == {"perturbed": (2.0, 0.5)}
    assert select(options()) == REFS and select(options(limit=3)) == REFS[:3]
    assert len({tuple(r.name for r in select(options(sample=4, seed=s))) for s in range(5)}) > 1
    assert select(options(scenes=("room1", "d/yard2"))) == [REFS[2], REFS[5]]
    assert select(options(), REFS[4:6]) == REFS[4:6] and len(select(options(sample=10))) == 10
    with pytest.raises(ValueError, match="--sample must be at most 10, the number of samples found; got 11"):
        select(options(sample=11))
    select(options(datasets=("kitti2015",), pairs="all", pixel_centre=0.5))
    assert asked[-1] == (Path("data"), ("kitti2015",), {"pairs": "all", "pixel_centre": 0.5})
    datasets.all_refs(options(datasets=("kitti2015",)), ("eth3d",))
    assert asked[-1][1] == ("eth3d",)
    select(PairsOptions())
    assert asked[-1][0] == DEMO_PAIR_FOLDER


def test_no_sample_and_two_of_one_name_are_rejected():
    with pytest.raises(
        ValueError, match=r"a folder with a sample with cave in its name; got f with d/room0, d/yard0"
    ):
        datasets.some_pairs(REFS, Path("f"), ("cave",))
    with pytest.raises(ValueError, match="a folder with a sample; got f with no sample of any known dataset"):
        datasets.some_pairs([], Path("f"))
    with pytest.raises(ValueError, match="one sample of each name; got f with several d/yard3"):
        datasets.some_pairs([*REFS, REFS[7]], Path("f"))


def test_samples_are_changed_as_their_reference_asks(monkeypatch):
    sample, changed = random_sample(), []
    own = replace(DATASETS["folder"], load=lambda ref: sample)
    monkeypatch.setitem(DATASETS, "folder", own)
    for key in module.CHANGES:
        made = (module.CHANGES[key][0], lambda *given, key=key: changed.append((key, *given)) or given[0])
        monkeypatch.setitem(module.CHANGES, key, made)
    ref = SampleRef("folder", "n", {})
    assert load(ref) is sample and changed == []
    drifted = changed_ref(ref, "drifted", (0.5, 2))
    load(drifted)
    assert changed == [("drifted", sample, (0.5, 2), "n-drift0.5-2px")]
    assert json.dumps([*module.CHANGES]) == '["perturbed", "drifted", "scaled"]'


@pytest.mark.parametrize(("factor", "zoom"), [(0.5, 1.0), (2.0, 1.0), (1.0, 0.5), (3.0, 2.0)])
def test_a_scaled_rig_shows_the_same_pixels_of_a_scaled_scene(factor, zoom):
    """A point of the scaled scene is seen in the right image at the resized place of the original point."""
    sample = random_sample(rectified=False)
    view = ExtraView(sample.right, K_RIGHT, np.linalg.inv(sample.E))
    sample = replace(sample, extra_views=(view,))
    scaled = with_scaled_rig(sample, (factor, zoom), "new")
    assert scaled.name == "new" and scaled.left is sample.left and scaled.E_scored is scaled.E
    assert scaled.right.shape == (round(40 * zoom), round(60 * zoom), 3)
    np.testing.assert_allclose(scaled.depth_m, factor * sample.depth_m, rtol=1e-6)
    point = np.array([0.2, -0.1, 2.5])

    def project(K, E, point):
        u, v, w = K @ (np.linalg.inv(E) @ [*point, 1])[:3]
        return np.array([u / w, v / w])

    before = project(sample.K_right, sample.E, point)
    after = project(scaled.K_right, scaled.E, factor * point)
    np.testing.assert_allclose(after + 0.5, zoom * (before + 0.5), atol=1e-9)
    assert scaled.extra_views[0].K is K_RIGHT
    np.testing.assert_allclose(
        project(K_RIGHT, scaled.extra_views[0].E, factor * point), project(K_RIGHT, view.E, point), atol=1e-9
    )
    assert with_scaled_rig(random_sample(), (factor, zoom), "n").rectified == (zoom == 1)


def test_no_pair_is_in_both_splits_or_twice_in_one():
    listed = [(dataset, name) for split in SPLITS.values() for dataset in split for name in split[dataset]]
    assert len(set(listed)) == len(listed)
    assert {dataset for dataset, _ in listed} <= set(DATASETS)
    assert split_of("kitti2012", "000013") == "tuned" and split_of("kitti2012", "000015") == "unseen"
    assert split_of("kitti2012", "000014") is None and split_of("folder", "000015") is None


def test_the_thirteen_pairs_of_the_results_are_the_tuned_ones():
    assert sum(map(len, SPLITS["tuned"].values())) == 13


def test_unseen_scenes_are_those_of_the_downloads():
    unseen = SPLITS["unseen"]
    assert {name: len(scenes) for name, scenes in unseen.items()} == {
        **{"kitti2015": 20, "kitti2012": 19, "eth3d": 25, "middlebury2021": 24},
        **{"middlebury2001": 6, "middlebury2003": 2, "middlebury2005": 6, "middlebury2006": 21},
    }
    assert {re.sub(r"\d", "", name) for name in unseen["middlebury2021"]} == set(layouts._SCENES_2021)
    assert all(re.fullmatch(r"0001\d5|0000\d5", name) for name in unseen["kitti2012"] + unseen["kitti2015"])
    assert not any(name.startswith("terrace") for name in unseen["eth3d"])  # the place of a tuned pair


def test_a_split_selects_its_pairs_and_names_what_was_found_instead(tmp_path):
    refs = [SampleRef("kitti2012", name, {}) for name in ("000000", "000005", "000006")]
    options = DirOptions(data=tmp_path, split="unseen")
    assert [ref.name for ref in select(options, refs)] == ["000005"]
    assert [ref.name for ref in select(DirOptions(data=tmp_path, split="tuned"), refs)] == ["000000"]
    assert len(select(DirOptions(data=tmp_path), refs)) == 3
    with pytest.raises(ValueError, match=r"of the split 'unseen'; got .*kitti2012/000000.*splits\.toml"):
        in_split(refs[:1], "unseen", tmp_path)
    with pytest.raises(ValueError, match="--split must be one of all, tuned, unseen"):
        DirOptions(data=tmp_path, split="test")
