"""What every entry of DATASETS owes: found in its layout, in our conventions, with errors that name the file.

The layouts are written here from docs/how-to/evaluation.md, not from the loaders; of booster and robustmvd no
real sample was at hand, so that page is all that there is to check them by. The slow tests read real samples.
"""

import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.datasets import DATASETS, StereoSample, find_pairs, load, load_pairs
from geodiff_plugin.evaluation.datasets.changed import changed_ref
from geodiff_plugin.evaluation.datasets.layouts import KEY_VIEWS, find_mvsnet, find_robustmvd
from geodiff_plugin.evaluation.datasets.sample import depth_to_disparity, disparity_to_depth
from geodiff_plugin.evaluation.experiment import cell_key
from geodiff_plugin.evaluation.scoring import score
from geodiff_plugin.formats import as_image_01, write_depth_mm, write_pfm
from geodiff_plugin.geometry import warp_right_to_left
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
    for name in (left, right):
        save(folder / name / "000007_10.png", picture(channels=1 if left == "image_0" else 3))
    save(folder / truth / "000007_10.png", np.rint(with_hole(disparity(), 0) * 256).astype(np.uint16))
    text = ""
    for number, shift in zip(numbers, (0.0, -F * BASELINE), strict=True):
        if prefix == "P_rect_0":
            text += f"S_rect_0{number}: {WIDTH} {HEIGHT}\nR_rect_0{number}: 1 0 0 0 1 0 0 0 1\n"
        text += f"{prefix}{number}: {F} 0 {CX} {shift} 0 {F} {CY} 0 0 0 1 0\n"
    (folder / calibration).mkdir(parents=True)
    (folder / calibration / "000007.txt").write_text(text)


def kitti2015(root):
    write_kitti(root / "training", "image_2", "image_3", "disp_occ_0", "calib_cam_to_cam", "P_rect_0", (2, 3))


def kitti2012(root):
    folder = root / "data_stereo_flow" / "training"
    write_kitti(folder, "image_0", "image_1", "disp_noc", "calib", "P", (0, 1))


def write_middlebury(folder, truth, doffs, mask=False):
    for name in ("im0.png", "im1.png"):
        save(folder / name, picture())
    truth.parent.mkdir(parents=True, exist_ok=True)
    write_pfm(truth, with_hole(disparity() - doffs, np.inf))
    (folder / "calib.txt").write_text(
        f"cam0=[{F} 0 {CX}; 0 {F} {CY}; 0 0 1]\ncam1=[{F} 0 {CX + doffs}; 0 {F} {CY}; 0 0 1]\n"
        f"doffs={doffs}\nbaseline={BASELINE * 1000}\nwidth={WIDTH}\nheight={HEIGHT}\nndisp=16\n"
    )
    if mask:
        save(
            truth.parent / "mask0nocc.png",
            np.where(np.arange(WIDTH) < 4, 128, 255)[None].repeat(HEIGHT, 0).astype(np.uint8),
        )


def middlebury2014(root):
    write_middlebury(root / "Scene-perfect", root / "Scene-perfect" / "disp0.pfm", 3.25)


def middeval3(root):
    scene = root / "MiddEval3" / "trainingQ" / "Scene"
    write_middlebury(scene, scene / "disp0GT.pfm", 1.5, mask=True)


def eth3d(root):
    truth = root / "two_view_training_gt" / "scene_1s" / "disp0GT.pfm"
    write_middlebury(root / "two_view_training" / "scene_1s", truth, 0, mask=True)


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


def write_posed(group, views, pixel_centre, ranges):
    """Cameras that look along z; each of the views stands a baseline to the right of the one before."""
    K = f"{F} 0 {CX + pixel_centre}\n0 {F} {CY + pixel_centre}\n0 0 1"
    (group / "cams").mkdir(parents=True)
    for place, view in enumerate(views):
        save(group / "images" / f"{view:08d}.jpg", picture())
        world_to_camera = f"1 0 0 {-BASELINE * place}\n0 1 0 0\n0 0 1 0\n0 0 0 1"
        text = f"extrinsic\n{world_to_camera}\n\nintrinsic\n{K}\n{ranges}"
        (group / "cams" / f"{view:08d}_cam.txt").write_text(text)


def mvsnet(root):
    write_posed(root / "scan1", range(3), 0.0, "\n9e9 9e9 192 9e9\n")
    (root / "scan1" / "depths").mkdir()
    write_pfm(root / "scan1" / "depths" / "00000000.pfm", with_hole(F * BASELINE / disparity(), 0))
    (root / "scan1" / "pair.txt").write_text("3\n0\n2 1 10.0 2 5.0\n1\n1 0 10.0\n2\n1 0 5.0\n")


def robustmvd(root):
    """The scene Barn with key view 60, its best source 62 to the right of it, and 61 further to the right."""
    write_posed(root / "Barn", (60, 62, 61), 0.5, "")  # COLMAP's: the first pixel's centre is at 0.5
    (root / "Barn" / "depth").mkdir()
    depth_m = with_hole(F * BASELINE / disparity(), np.inf).astype(np.float32)
    np.savez_compressed(root / "Barn" / "depth" / "000061.npz", depth_m)  # scans are counted from 1
    (root / "Barn" / "pair.txt").write_text("1\n60\n2 62 10.0 61 5.0\n")


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
    "mvsnet": (mvsnet, "*/images/00000001.jpg", "*/depths/00000000.pfm", "*/cams/00000001_cam.txt"),
    "robustmvd": (robustmvd, "*/images/00000062.jpg", "*/depth/000061.npz", "*/cams/00000062_cam.txt"),
    "folder": (folder, "mine/right.png", "mine/depth.npy", "mine/calib.txt"),
}

each_dataset = pytest.mark.parametrize("name", [name for name in DATASETS if name != "synthetic"])


def one(root, name) -> StereoSample:
    (ref,) = find_pairs(root, [name])
    return load(ref)


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
    if name in ("middeval3", "eth3d", "booster"):
        np.testing.assert_array_equal(sample.occluded, known & (np.arange(WIDTH) < 4))
    assert name != "booster" or (sample.material == 3).all()
    cameras = sample.K_left, sample.K_right, sample.E
    raw = depth_to_disparity(np.where(known, sample.depth_m, 1), *cameras)
    doffs = sample.K_right[0, 2] - sample.K_left[0, 2]
    np.testing.assert_allclose((raw + doffs)[known], disparity()[known], rtol=1e-5)
    np.testing.assert_allclose(disparity_to_depth(raw, *cameras)[known], sample.depth_m[known], rtol=1e-5)


def of_another_size(path):
    write = {".png": save, ".pfm": write_pfm, ".npy": np.save, ".npz": np.savez}[path.suffix]
    write(path, np.ones((HEIGHT, WIDTH - 2), np.uint16 if path.suffix == ".png" else np.float32))


def cut_off(path):
    os.truncate(path, path.stat().st_size // 2)


@each_dataset
@pytest.mark.parametrize(
    ("which", "damage", "error"),
    [
        *((which, Path.unlink, FileNotFoundError) for which in (1, 2, 3)),
        *((1, cut_off, ValueError), (2, cut_off, ValueError), (2, of_another_size, ValueError)),
    ],
)
def test_a_file_that_is_missing_or_damaged_is_named(tmp_path, name, which, damage, error):
    LAYOUTS[name][0](tmp_path)
    (path,) = tmp_path.glob(LAYOUTS[name][which])
    damage(path)
    for ref in find_pairs(tmp_path, [name]):  # none where what makes the folder a sample is gone
        if (which, damage) == (2, Path.unlink) and name in ("mvsnet", "folder"):
            assert not load(ref).valid.any()
            continue
        with pytest.raises(error, match=path.stem.replace("disp0GT", "disp0")):
            load(ref)


@pytest.mark.parametrize("name", ["kitti2015", "middlebury2014", "eth3d"])
def test_calibration_for_another_size_is_named(tmp_path, name):
    LAYOUTS[name][0](tmp_path)
    (path,) = tmp_path.glob(LAYOUTS[name][3])
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


@pytest.mark.parametrize(
    ("name", "truth", "sought"),
    [
        ("mvsnet", "scan1/depths/00000000.pfm", r"no .*00000000\.pfm"),
        ("folder", "mine/depth.npy", r"no depth\.npy, depth\.pfm, depth\.png or depth_mm\.png in .*mine"),
    ],
)
def test_a_pair_without_truth_is_neither_scored_nor_perturbed(tmp_path, name, truth, sought):
    LAYOUTS[name][0](tmp_path)
    (tmp_path / truth).unlink()
    (ref,) = find_pairs(tmp_path, [name])
    with pytest.raises(ValueError, match=rf"the truth of {name}/.*-turn1-shift0.1 must be known"):
        load(changed_ref(ref, "perturbed", (1.0, 0.1)))
    with pytest.raises(ValueError, match=rf"got none \({sought}\)"):
        score(load(ref), Prediction(np.ones((HEIGHT, WIDTH))), None)


def test_coarse_middlebury_truth_says_how_coarse(tmp_path):
    middlebury2014(tmp_path)
    assert one(tmp_path, "middlebury2014").notes["disparity_step_px"] == 0
    write_pfm(tmp_path / "Scene-perfect" / "disp0.pfm", disparity(step=1.0) + 0.5)
    assert one(tmp_path, "middlebury2014").notes["disparity_step_px"] == 1


def test_mvsnet_pairs_extra_views_and_pixel_centre(tmp_path):
    robustmvd(tmp_path / "benchmark")
    mvsnet(tmp_path)
    every = find_mvsnet(tmp_path, pairs="all")
    assert [ref.files["views"][:2] for ref in every] == [(0, 1), (0, 2), (1, 0), (2, 0)]
    further = tmp_path / "scan1" / "images" / "00000002.jpg"
    before, _ = cell_key(every[0], "guided", {}), further.write_bytes(further.read_bytes() + b" ")
    assert cell_key(every[0], "guided", {}) != before  # another result
    backwards = load(every[2])
    np.testing.assert_allclose(backwards.E[:3, 3], [-BASELINE, 0, 0], atol=1e-9)
    ((image, K, E),) = one(tmp_path, "mvsnet").extra_views
    assert image.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(E[:3, 3], [2 * BASELINE, 0, 0], atol=1e-9)
    refs = find_pairs(tmp_path, pixel_centre=None, pairs="default")
    centres = [(ref.dataset, ref.files["pixel_centre"]) for ref in refs]
    assert centres == [("mvsnet", 0.0), ("robustmvd", 0.5)]  # what is left open is the set's own
    colmap = load(find_mvsnet(tmp_path, pixel_centre=0.5)[0])
    assert colmap.K_left[0, 2] == CX - 0.5 and colmap.K_right[1, 2] == CY - 0.5
    assert colmap.K_left[0, 0] == F and K[0, 2] == CX


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


def test_folder_takes_depth_in_three_formats(tmp_path):
    folder(tmp_path)
    expected, mine = one(tmp_path, "folder").depth_m, tmp_path / "mine"
    (mine / "depth.npy").unlink()
    write_pfm(mine / "depth.pfm", np.where(expected > 0, expected, np.inf))
    np.testing.assert_array_equal(one(tmp_path, "folder").depth_m, expected)
    (mine / "depth.pfm").unlink()
    write_depth_mm(mine / "depth.png", expected)
    np.testing.assert_allclose(one(tmp_path, "folder").depth_m, expected, atol=5.1e-4)


@pytest.mark.parametrize("suffixes", [(".JPG", ".jpeg"), (".tif", ".bmp"), (".webp", ".PNG")])
def test_folder_takes_every_image_that_pillow_reads_and_a_png_before_its_copies(tmp_path, suffixes):
    folder(tmp_path)
    mine = tmp_path / "mine"
    for side, suffix in zip(("left", "right"), suffixes, strict=True):
        (mine / f"{side}.png").unlink()
        save(mine / f"{side}{suffix}", picture())
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
    ids=["RealSense", "OAK-D", "transforms.json", "COLMAP"],
)
@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_folder_takes_calibrations_that_go_by_size_or_name(
    tmp_path, calibrations, size, focal_px, baseline_m
):
    for side in ("left", "right"):
        save(tmp_path / "mine" / f"{side}.jpg", np.zeros((*size[::-1], 3), np.uint8))
    for name, text in calibrations.items():
        (tmp_path / "mine" / name).write_text(text)
    sample = one(tmp_path, "folder")
    assert (sample.K_left[0, 0], sample.E[0, 3]) == pytest.approx((focal_px, baseline_m))


def test_root_must_be_a_folder(tmp_path):
    with pytest.raises(ValueError, match="root must be an existing folder"):
        find_pairs(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="datasets must be one of kitti2015"):
        find_pairs(tmp_path, ["kitty"])


REAL = Path(os.environ.get("GEODIFF_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))
REAL_REFS = find_pairs(REAL) if REAL.is_dir() else []


def photometric_error(sample, factor):
    """Mean absolute difference to the left image of the right one, warped by ``factor`` times the truth."""
    left, right = (as_image_01(image, "image")[None] for image in (sample.left, sample.right))
    depth_m = torch.from_numpy(np.where(sample.valid, sample.depth_m, 1) * np.float32(factor))[None, None]
    matrices = (sample.K_left, sample.K_right, np.linalg.inv(sample.E))
    warped = warp_right_to_left(right, depth_m, *(torch.from_numpy(m).float()[None] for m in matrices))
    seen = warped.visible & torch.from_numpy(sample.valid)
    return ((warped.image - left).abs().mean(1, keepdim=True) * seen).sum() / seen.sum()


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="no real samples")
def test_the_thirteen_real_pairs_are_found():
    expected = ["kitti2015"] + ["kitti2012"] * 5 + ["middlebury2014", "eth3d"] + ["mvsnet"] * 5
    assert [ref.dataset for ref in REAL_REFS] == expected


@pytest.mark.slow
@pytest.mark.parametrize("ref", REAL_REFS, ids=lambda ref: ref.label)
def test_real_truth_warps_right_to_left(ref):
    sample = load(ref)
    assert sample.rectified == (sample.dataset != "mvsnet")
    true, nearer, farther = (photometric_error(sample, factor) for factor in (1.0, 0.8, 1.2))
    assert true < nearer and true < farther
