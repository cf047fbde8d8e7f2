"""What every entry of DATASETS owes: found in its layout, in our conventions, with errors that name the file.

The layouts are written here from docs/how-to/evaluation.md, not from the loaders; of booster and robustmvd no
real sample was at hand, so that page is all that there is to check them by. The slow tests read real samples.
"""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.datasets import DATASETS, StereoSample, find_pairs, load, load_pairs
from geodiff_plugin.evaluation.datasets.changed import changed_ref
from geodiff_plugin.evaluation.datasets.posed import KEY_VIEWS, find_mvsnet, find_robustmvd
from geodiff_plugin.evaluation.datasets.sample import depth_to_disparity, disparity_to_depth
from geodiff_plugin.evaluation.experiment import cell_key
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.formats import write_depth_mm, write_pfm
from tests.contracts import factory_calibrations as factory

HEIGHT, WIDTH, F, CX, CY, BASELINE = 40, 64, 50.0, 31.0, 19.5, 0.2
FAR_HOLE = (slice(0, 5), slice(0, 7))
RNG = np.random.default_rng(0)


def picture(height=HEIGHT, width=WIDTH, channels=3):
    shape = (height, width, channels) if channels > 1 else (height, width)
    return RNG.integers(0, 256, shape, dtype=np.uint8)


def save(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(values).save(path)


def disparity(step=1 / 256):
    """A tilted plane, whole multiples of the step, 4 to 9 px."""
    plane = np.linspace(4.0, 8.0, WIDTH)[None] + np.linspace(0.0, 1.0, HEIGHT)[:, None]
    return np.round(plane / step) * step


def with_hole(values, unknown):
    values = values.copy()
    values[FAR_HOLE] = unknown
    return values


def write_kitti(folder, left, right, truth, calibration, prefix, numbers):
    save(folder / left / "000007_10.png", picture(channels=1 if left == "image_0" else 3))
    save(folder / right / "000007_10.png", picture(channels=1 if left == "image_0" else 3))
    save(folder / truth / "000007_10.png", np.rint(with_hole(disparity(), 0) * 256).astype(np.uint16))
    lines = []
    for number, shift in zip(numbers, (0.0, -F * BASELINE), strict=True):
        if prefix == "P_rect_0":
            lines.append(f"S_rect_0{number}: {WIDTH} {HEIGHT}\nR_rect_0{number}: 1 0 0 0 1 0 0 0 1")
        lines.append(f"{prefix}{number}: {F} 0 {CX} {shift} 0 {F} {CY} 0 0 0 1 0")
    path = folder / calibration / "000007.txt"
    path.parent.mkdir(parents=True)
    path.write_text("\n".join(lines) + "\n")


def kitti2015(root):
    write_kitti(root / "training", "image_2", "image_3", "disp_occ_0", "calib_cam_to_cam", "P_rect_0", (2, 3))


def kitti2012(root):
    folder = root / "data_stereo_flow" / "training"
    write_kitti(folder, "image_0", "image_1", "disp_noc", "calib", "P", (0, 1))


def write_middlebury(folder, truth, doffs):
    for name in ("im0.png", "im1.png"):
        save(folder / name, picture())
    truth.parent.mkdir(parents=True, exist_ok=True)
    write_pfm(truth, with_hole(disparity() - doffs, np.inf))
    (folder / "calib.txt").write_text(
        f"cam0=[{F} 0 {CX}; 0 {F} {CY}; 0 0 1]\ncam1=[{F} 0 {CX + doffs}; 0 {F} {CY}; 0 0 1]\n"
        f"doffs={doffs}\nbaseline={BASELINE * 1000}\nwidth={WIDTH}\nheight={HEIGHT}\nndisp=16\n"
    )


def middlebury2014(root):
    write_middlebury(root / "Scene-perfect", root / "Scene-perfect" / "disp0.pfm", 3.25)


def middeval3(root):
    scene = root / "MiddEval3" / "trainingQ" / "Scene"
    write_middlebury(scene, scene / "disp0GT.pfm", 1.5)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :4] = 128
    save(scene / "mask0nocc.png", mask)


def eth3d(root):
    truth = root / "two_view_training_gt" / "scene_1s" / "disp0GT.pfm"
    write_middlebury(root / "two_view_training" / "scene_1s", truth, 0)
    mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
    mask[:, :4] = 128
    save(truth.parent / "mask0nocc.png", mask)


def booster(root):
    scene = root / "train" / "balanced" / "Cup"
    for camera in ("camera_00", "camera_02"):
        save(scene / camera / "im0.png", picture(4 * HEIGHT, 4 * WIDTH))
    full = with_hole(disparity(), 0).repeat(4, 0).repeat(4, 1) * 4
    np.save(scene / "disp_00.npy", full.astype(np.float32))
    mask = np.full((4 * HEIGHT, 4 * WIDTH), 255, np.uint8)
    mask[:, :16] = 0
    save(scene / "mask_00.png", mask)
    save(scene / "mask_cat.png", np.full((4 * HEIGHT, 4 * WIDTH), 3, np.uint8))
    # A quarter of this K, half-pixel shift and all, is the K of the other fixtures.
    cx, cy = (4 * (c + 0.5) - 0.5 for c in (CX, CY))
    matrices = "".join(
        f'<{name} type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
        f"<data>{4 * F} 0. {cx} 0. {4 * F} {cy} 0. 0. 1.</data></{name}>"
        for name in ("proj_matL", "proj_matR")
    )
    (scene / "calib_00-02.xml").write_text(
        f'<?xml version="1.0"?><opencv_storage>{matrices}'
        f"<baselineLR>{BASELINE * 1000}</baselineLR></opencv_storage>"
    )


def mvsnet(root):
    group = root / "scan1"
    for view in range(3):
        save(group / "images" / f"{view:08d}.jpg", picture())
        # World-to-camera: all look along z, the camera of view n stands n baselines to the right.
        world_to_camera = f"1 0 0 {-BASELINE * view}\n0 1 0 0\n0 0 1 0\n0 0 0 1"
        path = group / "cams" / f"{view:08d}_cam.txt"
        path.parent.mkdir(exist_ok=True)
        path.write_text(
            f"extrinsic\n{world_to_camera}\n\nintrinsic\n{F} 0 {CX}\n0 {F} {CY}\n0 0 1\n\n9e9 9e9 192 9e9\n"
        )
    (group / "depths").mkdir()
    write_pfm(group / "depths" / "00000000.pfm", with_hole(F * BASELINE / disparity(), 0))
    (group / "pair.txt").write_text("3\n0\n2 1 10.0 2 5.0\n1\n1 0 10.0\n2\n1 0 5.0\n")


def robustmvd(root):
    """The scene Barn with key view 60, its best source 62 to the right of it, and 61 further to the right."""
    scene = root / "Barn"
    for place, view in enumerate((60, 62, 61)):
        save(scene / "images" / f"{view:08d}.jpg", picture())
        world_to_camera = f"1 0 0 {-BASELINE * place}\n0 1 0 0\n0 0 1 0\n0 0 0 1"
        path = scene / "cams" / f"{view:08d}_cam.txt"
        path.parent.mkdir(exist_ok=True)
        # COLMAP's convention: the first pixel's centre is at 0.5.
        K = f"{F} 0 {CX + 0.5}\n0 {F} {CY + 0.5}\n0 0 1"
        path.write_text(f"extrinsic\n{world_to_camera}\n\nintrinsic\n{K}\n")
    (scene / "depth").mkdir()
    depth_m = with_hole(F * BASELINE / disparity(), np.inf).astype(np.float32)
    np.savez_compressed(scene / "depth" / "000061.npz", depth_m)  # scans are counted from 1
    (scene / "pair.txt").write_text("1\n60\n2 62 10.0 61 5.0\n")


def folder(root):
    save(root / "mine" / "left.png", picture())
    save(root / "mine" / "right.png", picture())
    (root / "mine" / "calib.txt").write_text(f"{F} 0 {CX} 0 {F} {CY} 0 0 1\n{BASELINE}\n")
    depth_m = with_hole(F * BASELINE / disparity(), np.nan)
    np.save(root / "mine" / "depth.npy", depth_m.astype(np.float32))


#: Data set -> (writes its layout, its image, its truth, its calibration), paths relative to the root.
LAYOUTS = {
    "kitti2015": (kitti2015, "training/image_3/*", "training/disp_occ_0/*", "training/calib_cam_to_cam/*"),
    "kitti2012": (kitti2012, "*/training/image_1/*", "*/training/disp_noc/*", "*/training/calib/*"),
    "middlebury2014": (middlebury2014, "Scene-perfect/im1.png", "*/disp0.pfm", "*/calib.txt"),
    "middeval3": (middeval3, "*/*/Scene/im1.png", "*/*/Scene/disp0GT.pfm", "*/*/Scene/calib.txt"),
    "eth3d": (eth3d, "two_view_training/*/im1.png", "two_view_training_gt/*/disp0GT.pfm", "*/*/calib.txt"),
    "booster": (booster, "*/*/*/camera_02/im0.png", "*/*/*/disp_00.npy", "*/*/*/calib_00-02.xml"),
    "mvsnet": (
        mvsnet,
        "scan1/images/00000001.jpg",
        "scan1/depths/00000000.pfm",
        "scan1/cams/00000001_cam.txt",
    ),
    "robustmvd": (
        robustmvd,
        "Barn/images/00000062.jpg",
        "Barn/depth/000061.npz",
        "Barn/cams/00000062_cam.txt",
    ),
    "folder": (folder, "mine/right.png", "mine/depth.npy", "mine/calib.txt"),
}

each_dataset = pytest.mark.parametrize("name", LAYOUTS)


def one(root, name) -> StereoSample:
    (ref,) = find_pairs(root, [name])
    return load(ref)


def only_file(root: Path, pattern: str) -> Path:
    (path,) = root.glob(pattern)
    return path


def test_every_data_set_has_a_fixture():
    assert set(DATASETS) - {"synthetic"} == set(LAYOUTS)


@each_dataset
def test_sample_is_in_our_conventions_and_metric(tmp_path, name):
    LAYOUTS[name][0](tmp_path)
    sample, size = one(tmp_path, name), (HEIGHT, WIDTH)
    assert sample.dataset == name and sample.label == f"{name}/{sample.name}" and sample.rectified
    for image in (sample.left, sample.right):
        assert image.dtype == np.uint8 and image.shape == (*size, 3)
    assert sample.depth_m.dtype == np.float32 and sample.valid.dtype == bool
    np.testing.assert_allclose(sample.K_left, [[F, 0, CX], [0, F, CY], [0, 0, 1]], atol=1e-9)
    # The right camera stands to the right: +x in the left camera's frame, in metres.
    np.testing.assert_allclose(sample.E[:3, 3], [BASELINE, 0, 0], atol=1e-9)
    np.testing.assert_allclose(sample.E[:3, :3], np.eye(3), atol=1e-9)
    known = with_hole(np.ones(size, bool), False)
    np.testing.assert_array_equal(sample.valid, known)
    np.testing.assert_allclose(sample.depth_m[known], (F * BASELINE / disparity())[known], rtol=1e-5)
    assert (sample.depth_m[~known] == 0).all()
    # Disparity moves left pixels to the left.
    cameras = sample.K_left, sample.K_right, sample.E
    raw = depth_to_disparity(np.where(known, sample.depth_m, 1), *cameras)
    doffs = sample.K_right[0, 2] - sample.K_left[0, 2]
    np.testing.assert_allclose((raw + doffs)[known], disparity()[known], rtol=1e-5)
    np.testing.assert_allclose(disparity_to_depth(raw, *cameras)[known], sample.depth_m[known], rtol=1e-5)


@each_dataset
@pytest.mark.parametrize("which", [1, 2, 3], ids=["image", "truth", "calibration"])
def test_missing_file_is_named_or_leaves_nothing_valid(tmp_path, name, which):
    LAYOUTS[name][0](tmp_path)
    gone = only_file(tmp_path, LAYOUTS[name][which])
    gone.unlink()
    refs = find_pairs(tmp_path, [name])
    if which == 2 and name in ("mvsnet", "folder"):
        assert not load(refs[0]).valid.any()
        return
    for ref in refs:  # none where what makes the folder a sample is gone with it
        with pytest.raises(FileNotFoundError, match=gone.stem.replace("disp0GT", "disp0")):
            load(ref)


def of_another_size(path):
    size = (HEIGHT, WIDTH - 2)
    if path.suffix == ".png":
        save(path, np.ones(size, np.uint16))
    elif path.suffix == ".pfm":
        write_pfm(path, np.ones(size))
    else:
        write = np.save if path.suffix == ".npy" else np.savez
        write(path, np.ones(size, np.float32))


def cut_off(path):
    os.truncate(path, path.stat().st_size // 2)


@each_dataset
@pytest.mark.parametrize(("which", "damage"), [(1, cut_off), (2, cut_off), (2, of_another_size)])
def test_damaged_file_is_named(tmp_path, name, which, damage):
    LAYOUTS[name][0](tmp_path)
    path = only_file(tmp_path, LAYOUTS[name][which])
    damage(path)
    with pytest.raises(ValueError, match=path.name.replace(".", r"\.")):
        one(tmp_path, name)


@pytest.mark.parametrize("name", ["kitti2015", "middlebury2014", "eth3d"])
def test_calibration_for_another_size_is_named(tmp_path, name):
    LAYOUTS[name][0](tmp_path)
    path = only_file(tmp_path, LAYOUTS[name][3])
    text = path.read_text().replace(f"width={WIDTH}", "width=99").replace(f": {WIDTH} {HEIGHT}", ": 99 40")
    path.write_text(text)
    with pytest.raises(ValueError, match=path.name):
        one(tmp_path, name)


def test_sets_below_one_root_are_told_apart_and_ordered(tmp_path):
    for name in ("mvsnet", "eth3d", "kitti2012", "middlebury2014", "kitti2015"):
        LAYOUTS[name][0](tmp_path / name)
    found = [ref.dataset for ref in find_pairs(tmp_path)]
    assert found == ["kitti2015", "kitti2012", "middlebury2014", "eth3d", "mvsnet"]
    assert [sample.dataset for sample in load_pairs(tmp_path, ["eth3d"])] == ["eth3d"]


def test_kitti2012_prefers_colour_and_all_pixels_and_says_so(tmp_path):
    kitti2012(tmp_path)
    training = tmp_path / "data_stereo_flow" / "training"
    assert one(tmp_path, "kitti2012").notes["truth"] == "disp_noc"
    seen_by_both = disparity()
    seen_by_both[:, :10] = 0
    save(training / "disp_noc" / "000007_10.png", np.rint(seen_by_both * 256).astype(np.uint16))
    save(training / "disp_occ" / "000007_10.png", np.rint(disparity() * 256).astype(np.uint16))
    for name in ("colored_0", "colored_1"):
        save(training / name / "000007_10.png", picture())
    with open(training / "calib" / "000007.txt", "a") as file:
        file.write(f"P2: {F} 0 {CX + 1} 0 0 {F} {CY} 0 0 0 1 0\n")
        file.write(f"P3: {F} 0 {CX + 1} {-F * BASELINE} 0 {F} {CY} 0 0 0 1 0\n")
    sample = one(tmp_path, "kitti2012")
    assert sample.notes["truth"] == "disp_occ" and sample.valid.all()
    assert sample.K_left[0, 2] == CX + 1  # colour cameras 2 and 3
    np.testing.assert_array_equal(sample.occluded, seen_by_both == 0)


@pytest.mark.parametrize("name", ["middeval3", "eth3d", "booster"])
def test_occlusion_masks_are_read(tmp_path, name):
    LAYOUTS[name][0](tmp_path)
    sample = one(tmp_path, name)
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[:, :4] = True
    np.testing.assert_array_equal(sample.occluded, expected & sample.valid)
    assert name != "booster" or (sample.material == 3).all()


def test_test_scenes_without_truth_belong_to_no_set(tmp_path):
    """The archive of the images has them beside the training scenes."""
    middeval3(tmp_path)
    training, test = (tmp_path / "MiddEval3" / name for name in ("trainingQ", "testQ"))
    shutil.copytree(training, test)
    (test / "Scene" / "disp0GT.pfm").unlink()
    assert [ref.label for ref in find_pairs(tmp_path)] == ["middeval3/Scene"]
    (training / "Scene" / "disp0GT.pfm").unlink()  # a training scene whose truth is missing is no silent gap
    with pytest.raises(FileNotFoundError, match=r"disp0\.pfm"):
        load(find_pairs(tmp_path)[0])


@pytest.mark.parametrize("changed", ["depths/00000000.pfm", "cams/00000001_cam.txt", "images/00000002.jpg"])
def test_a_posed_pair_is_another_one_when_a_file_of_its_group_changes(tmp_path, changed):
    mvsnet(tmp_path)

    def key():
        return cell_key(find_mvsnet(tmp_path)[0], "guided", {})

    before = key()
    assert key() == before
    with open(tmp_path / "scan1" / changed, "ab") as file:
        file.write(b" ")
    assert key() != before


def test_a_pair_without_truth_cannot_be_perturbed(tmp_path):
    mvsnet(tmp_path)
    for path in (tmp_path / "scan1" / "depths").iterdir():
        path.unlink()
    with pytest.raises(ValueError, match="the truth of mvsnet/scan1-turn1-shift0.1 must be known"):
        load(changed_ref(find_mvsnet(tmp_path)[0], "perturbed", (1.0, 0.1)))
    with pytest.raises(ValueError, match=r"got none \(no .*00000000\.pfm\)"):
        blind = load(find_mvsnet(tmp_path)[0])
        score(blind, Prediction(np.ones(blind.depth_m.shape)), None)


def test_coarse_middlebury_truth_says_how_coarse(tmp_path):
    middlebury2014(tmp_path)
    assert one(tmp_path, "middlebury2014").notes["disparity_step_px"] == 0
    write_pfm(tmp_path / "Scene-perfect" / "disp0.pfm", disparity(step=1.0) + 0.5)
    assert one(tmp_path, "middlebury2014").notes["disparity_step_px"] == 1


def test_mvsnet_pairs_extra_views_and_pixel_centre(tmp_path):
    mvsnet(tmp_path)
    every = find_mvsnet(tmp_path, pairs="all")
    assert [(ref.files["left"], ref.files["right"]) for ref in every] == [(0, 1), (0, 2), (1, 0), (2, 0)]
    backwards = load(every[2])
    np.testing.assert_allclose(backwards.E[:3, 3], [-BASELINE, 0, 0], atol=1e-9)
    ((image, K, E),) = one(tmp_path, "mvsnet").extra_views
    assert image.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(E[:3, 3], [2 * BASELINE, 0, 0], atol=1e-9)
    colmap = load(find_mvsnet(tmp_path, pixel_centre=0.5)[0])
    assert colmap.K_left[0, 2] == CX - 0.5 and colmap.K_right[1, 2] == CY - 0.5
    assert colmap.K_left[0, 0] == F and K[0, 2] == CX


@pytest.mark.parametrize("depths", ["1 2", "0.5 0.01 192 2.5"])
def test_mvsnet_depth_numbers_change_nothing(tmp_path, depths):
    mvsnet(tmp_path)
    before = one(tmp_path, "mvsnet")
    for path in (tmp_path / "scan1" / "cams").iterdir():
        path.write_text(path.read_text().replace("9e9 9e9 192 9e9", depths))
    after = one(tmp_path, "mvsnet")
    for name in ("K_left", "E", "depth_m"):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))


def test_robustmvd_takes_key_views_and_belongs_to_no_other_set(tmp_path):
    robustmvd(tmp_path)
    assert [ref.label for ref in find_pairs(tmp_path)] == ["robustmvd/Barn-60-62"]
    every = find_robustmvd(tmp_path, pairs="all")
    assert [ref.name for ref in every] == ["Barn-60-62", "Barn-60-61"]
    ((_, K, E),) = load(every[0]).extra_views
    assert K[0, 2] == CX
    np.testing.assert_allclose(E[:3, 3], [2 * BASELINE, 0, 0], atol=1e-9)
    assert [len(views) for views in KEY_VIEWS.values()] == [18, 25, 13, 13]
    with open(tmp_path / "Barn" / "pair.txt", "w") as file:
        file.write("1\n61\n1 60 10.0\n")  # no key view
    assert find_pairs(tmp_path) == []


def test_options_left_open_are_the_sets_own(tmp_path):
    robustmvd(tmp_path / "benchmark")
    mvsnet(tmp_path)
    refs = find_pairs(tmp_path, pixel_centre=None, pairs="default")
    own = [(ref.dataset, ref.files["pixel_centre"]) for ref in refs]
    assert own == [("mvsnet", 0.0), ("robustmvd", 0.5)]


def test_folder_takes_depth_in_three_formats(tmp_path):
    folder(tmp_path)
    expected, mine = one(tmp_path, "folder").depth_m, tmp_path / "mine"
    (mine / "depth.npy").unlink()
    write_pfm(mine / "depth.pfm", np.where(expected > 0, expected, np.inf))
    np.testing.assert_array_equal(one(tmp_path, "folder").depth_m, expected)
    (mine / "depth.pfm").unlink()
    write_depth_mm(mine / "depth.png", expected)
    np.testing.assert_allclose(one(tmp_path, "folder").depth_m, expected, atol=5.1e-4)
    (mine / "depth.png").unlink()
    names = "depth.npy, depth.pfm, depth.png or depth_mm.png"
    said = f"at least one pixel; got none (no {names} in {mine})"
    with pytest.raises(ValueError, match=re.escape(said)):
        score(one(tmp_path, "folder"), Prediction(np.ones((HEIGHT, WIDTH))), None)


@pytest.mark.parametrize("suffixes", [(".JPG", ".jpeg"), (".tif", ".bmp"), (".webp", ".PNG")])
def test_folder_takes_every_image_that_pillow_reads_and_a_png_before_its_copies(tmp_path, suffixes):
    folder(tmp_path)
    mine = tmp_path / "mine"
    for side, suffix in zip(("left", "right"), suffixes, strict=True):
        with Image.open(mine / f"{side}.png") as image:
            image.save(mine / f"own{suffix}")
        (mine / f"{side}.png").unlink()
        (mine / f"own{suffix}").rename(mine / f"{side}{suffix}")
    (mine / "left.txt").write_text("notes")
    assert one(tmp_path, "folder").left.shape == (HEIGHT, WIDTH, 3)
    save(mine / "left.png", picture(HEIGHT, WIDTH - 2))
    with pytest.raises(ValueError, match="depth.npy must be for 62 x 40 pixels as the left image"):
        one(tmp_path, "folder")


@pytest.mark.parametrize("missing", ["left.png", "right.png", "calib.txt"])
def test_a_folder_of_two_of_three_is_no_silent_gap_and_one_of_less_is_no_pair(tmp_path, missing):
    folder(tmp_path)
    (tmp_path / "mine" / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        one(tmp_path, "folder")
    for side in ("left", "right"):
        (tmp_path / "mine" / f"{side}.png").unlink(missing_ok=True)
    assert find_pairs(tmp_path, ["folder"]) == []


TWO_SIZES = factory.REALSENSE_PRINTED.replace(
    "Intrinsic Parameters:\n",
    "Intrinsic Parameters:\n"
    + "".join(
        f'\n Intrinsic of "Infrared {camera}" / 320x240 / {{Y8}}\n  Width: 320\n  Height: 240\n  PPX: 150\n'
        "  PPY: 100\n  Fx: 350\n  Fy: 350\n  Distortion: Brown Conrady\n  Coeffs: 0 0 0 0 0\n"
        for camera in (1, 2)
    ),
)


@pytest.mark.parametrize(
    ("calibrations", "size", "focal_px", "baseline_m"),
    [
        ({"calib.txt": TWO_SIZES}, (640, 480), 700.0, 0.12),
        ({"calib.txt": TWO_SIZES}, (320, 240), 350.0, 0.12),
        ({"calib.json": factory.OAK}, (640, 400), 350.0, 0.12),
        ({"calib.json": factory.NERF}, (640, 480), 700.0, 0.5),
        (
            {"calib_left.txt": factory.COLMAP_CAMERAS, "calib_right.txt": factory.COLMAP_IMAGES},
            (640, 480),
            700.0,
            0.5,
        ),
    ],
    ids=["RealSense", "RealSense-small", "OAK-D", "transforms.json", "COLMAP"],
)
@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_folder_takes_calibrations_that_go_by_size_or_name(
    tmp_path, calibrations, size, focal_px, baseline_m
):
    (tmp_path / "mine").mkdir()
    for side in ("left", "right"):
        Image.new("RGB", size).save(tmp_path / "mine" / f"{side}.jpg")
    for name, text in calibrations.items():
        (tmp_path / "mine" / name).write_text(text)
    sample = one(tmp_path, "folder")
    assert sample.K_left[0, 0] == pytest.approx(focal_px)
    assert sample.E[0, 3] == pytest.approx(baseline_m)


def test_root_must_be_a_folder(tmp_path):
    with pytest.raises(ValueError, match="root must be an existing folder"):
        find_pairs(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="datasets must be one of kitti2015"):
        find_pairs(tmp_path, ["kitty"])


REAL = Path(os.environ.get("GEODIFF_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def real_refs():
    return find_pairs(REAL) if REAL.is_dir() else []


def photometric_error(sample, factor):
    """Mean absolute difference to the left image of the right one, warped by ``factor`` times the truth."""
    from geodiff_plugin.geometry import warp_right_to_left

    left, right = (
        torch.from_numpy(image.astype(np.float32) / 255).permute(2, 0, 1)[None]
        for image in (sample.left, sample.right)
    )
    depth_m = torch.from_numpy(np.where(sample.valid, sample.depth_m, 1) * np.float32(factor))[None, None]
    matrices = (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    cameras = (torch.from_numpy(matrix).float()[None] for matrix in matrices)
    warped = warp_right_to_left(right, depth_m, *cameras)
    seen = warped.visible & torch.from_numpy(sample.valid)
    return ((warped.image - left).abs().mean(1, keepdim=True) * seen).sum() / seen.sum()


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="no real samples")
def test_the_thirteen_real_pairs_are_found():
    refs = real_refs()
    assert [ref.dataset for ref in refs] == (
        ["kitti2015"] + ["kitti2012"] * 5 + ["middlebury2014", "eth3d"] + ["mvsnet"] * 5
    )


@pytest.mark.slow
@pytest.mark.parametrize("ref", real_refs(), ids=lambda ref: ref.label)
def test_real_truth_warps_right_to_left(ref):
    sample = load(ref)
    assert sample.rectified == (sample.dataset != "mvsnet")
    true, nearer, farther = (photometric_error(sample, factor) for factor in (1.0, 0.8, 1.2))
    assert true < nearer and true < farther
