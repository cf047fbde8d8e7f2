"""What every entry of DATASETS owes: found in its layout, in our conventions, with errors that name the file.

The layouts are written here from docs/how-to/evaluation.md, not from the loaders; of booster and robustmvd no
real sample was at hand, so that page is all that there is to check them by. The slow tests read real samples.
"""

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.datasets import DATASETS, StereoSample, find_pairs, load
from geodiff_plugin.evaluation.datasets.layouts import KEY_VIEWS
from geodiff_plugin.evaluation.datasets.sample import changed_ref, depth_to_disparity, disparity_to_depth
from geodiff_plugin.evaluation.experiment import cell_key, score
from geodiff_plugin.formats import as_image_01, write_pfm
from geodiff_plugin.geometry import warp_right_to_left
from tests.contracts.calibrations import SAMPLES

HEIGHT, WIDTH, F, CX, CY, BASELINE = 40, 64, 50.0, 31.0, 19.5, 0.2
RNG = np.random.default_rng(0)
WRITERS = {".npy": np.save, ".npz": np.savez_compressed, ".pfm": write_pfm}


def write(root, files):
    """Text as it is, arrays by the suffix of their name; images unless that says otherwise."""
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, str):
            path.write_text(content)
        elif path.suffix in WRITERS:
            WRITERS[path.suffix](path, content.astype(np.float32))
        else:
            Image.fromarray(content).save(path)


def picture(height=HEIGHT, width=WIDTH, *channels):
    return RNG.integers(0, 256, (height, width, *channels), dtype=np.uint8)


def with_hole(values, unknown):
    values = values.copy()
    values[:5, :7] = unknown
    return values


#: A tilted plane of 4 to 9 px, in whole multiples of 1 / 256.
DISPARITY = np.linspace(4.0, 8.0, WIDTH)[None] + np.linspace(0.0, 1.0, HEIGHT)[:, None]
DISPARITY = np.round(DISPARITY * 256) / 256
DEPTH_M = F * BASELINE / DISPARITY
LEFT, RIGHT, GREY = picture(HEIGHT, WIDTH, 3), picture(HEIGHT, WIDTH, 3), picture()
HIDDEN = np.broadcast_to(np.arange(WIDTH) < 4, (HEIGHT, WIDTH))
MASK = np.where(HIDDEN, 128, 255).astype(np.uint8)


def kitti_png(values):
    return np.rint(values * 256).astype(np.uint16)


def kitti_calibration(prefix, numbers, cx=CX, head=""):
    rows = zip(numbers, (0.0, -F * BASELINE), strict=True)
    return "".join(head.format(n) + f"{prefix}{n}: {F} 0 {cx} {x} 0 {F} {CY} 0 0 0 1 0\n" for n, x in rows)


def scene_files(folder, truth, doffs):
    calibration = (
        f"cam0=[{F} 0 {CX}; 0 {F} {CY}; 0 0 1]\ncam1=[{F} 0 {CX + doffs}; 0 {F} {CY}; 0 0 1]\n"
        f"doffs={doffs}\nbaseline={BASELINE * 1000}\nwidth={WIDTH}\nheight={HEIGHT}\nndisp=16\n"
    )
    files = {f"{folder}/im1.png": RIGHT, truth: with_hole(DISPARITY - doffs, np.inf)}
    return files | {f"{folder}/calib.txt": calibration, f"{folder}/im0.png": LEFT}


def booster_calibration():
    """A quarter of this K, half-pixel shift and all, is the K of the other sets."""
    cx, cy = (4 * (c + 0.5) - 0.5 for c in (CX, CY))
    matrices = "".join(
        f'<{name} type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt>'
        f"<data>{4 * F} 0. {cx} 0. {4 * F} {cy} 0. 0. 1.</data></{name}>"
        for name in ("proj_matL", "proj_matR")
    )
    baseline = f"<baselineLR>{BASELINE * 1000}</baselineLR>"
    return f'<?xml version="1.0"?><opencv_storage>{matrices}{baseline}</opencv_storage>'


def posed_camera(place, pixel_centre=0.0):
    """World to camera: all look along z, each stands a baseline to the right of the one before."""
    K = f"{F} 0 {CX + pixel_centre}\n0 {F} {CY + pixel_centre}\n0 0 1"
    pose = f"1 0 0 {-BASELINE * place}\n0 1 0 0\n0 0 1 0\n0 0 0 1"
    return f"extrinsic\n{pose}\n\nintrinsic\n{K}\n\n9e9 9e9 192 9e9\n"  # depths that are never read


def enlarged(values):
    return values.repeat(4, 0).repeat(4, 1)


#: Of every set its files, the right image, the truth and its calibration first.
LAYOUTS = {
    "kitti2015": {
        "training/image_3/000007_10.png": RIGHT,
        "training/disp_occ_0/000007_10.png": kitti_png(with_hole(DISPARITY, 0)),
        "training/calib_cam_to_cam/000007.txt": kitti_calibration(
            "P_rect_0", (2, 3), head=f"S_rect_0{{0}}: {WIDTH} {HEIGHT}\nR_rect_0{{0}}: 1 0 0 0 1 0 0 0 1\n"
        ),
        "training/image_2/000007_10.png": LEFT,
    },
    "kitti2012": {
        "data/training/image_1/000007_10.png": GREY,
        "data/training/disp_noc/000007_10.png": kitti_png(with_hole(DISPARITY, 0)),
        "data/training/calib/000007.txt": kitti_calibration("P", (0, 1)),
        "data/training/image_0/000007_10.png": GREY,
    },
    "middlebury2014": scene_files("Scene-perfect", "Scene-perfect/disp0.pfm", 3.25),
    "middeval3": {
        **scene_files("MiddEval3/trainingQ/Scene", "MiddEval3/trainingQ/Scene/disp0GT.pfm", 1.5),
        "MiddEval3/trainingQ/Scene/mask0nocc.png": MASK,
    },
    "eth3d": {
        **scene_files("two_view_training/scene_1s", "two_view_training_gt/scene_1s/disp0GT.pfm", 0),
        "two_view_training_gt/scene_1s/mask0nocc.png": MASK,
    },
    "booster": {
        "train/balanced/Cup/camera_02/im0.png": enlarged(RIGHT),
        "train/balanced/Cup/disp_00.npy": 4 * enlarged(with_hole(DISPARITY, 0)),
        "train/balanced/Cup/calib_00-02.xml": booster_calibration(),
        "train/balanced/Cup/camera_00/im0.png": enlarged(LEFT),
        "train/balanced/Cup/mask_00.png": enlarged(np.where(HIDDEN, 0, 255).astype(np.uint8)),
        "train/balanced/Cup/mask_cat.png": enlarged(np.full((HEIGHT, WIDTH), 3, np.uint8)),
    },
    "mvsnet": {
        "scan1/images/00000001.jpg": RIGHT,
        "scan1/depths/00000000.pfm": with_hole(DEPTH_M, 0),
        **{f"scan1/cams/0000000{view}_cam.txt": posed_camera(view) for view in (1, 0, 2)},
        **{f"scan1/images/0000000{view}.jpg": LEFT for view in (0, 2)},
        "scan1/pair.txt": "3\n0\n2 1 10.0 2 5.0\n1\n1 0 10.0\n2\n1 0 5.0\n",
    },
    # The key view 60, its best source 62 to the right of it, and 61 further to the right; scans start at 1.
    "robustmvd": {
        "Barn/images/00000062.jpg": RIGHT,
        "Barn/depth/000061.npz": with_hole(DEPTH_M, np.inf),
        **{f"Barn/cams/000000{62 - at}_cam.txt": posed_camera(1 + at, 0.5) for at in (0, 1)},
        "Barn/cams/00000060_cam.txt": posed_camera(0, 0.5),
        **{f"Barn/images/000000{view}.jpg": LEFT for view in (60, 61)},
        "Barn/pair.txt": "1\n60\n2 62 10.0 61 5.0\n",
    },
    "folder": {
        "mine/right.png": RIGHT,
        "mine/depth.npy": with_hole(DEPTH_M, np.nan),
        "mine/calib.txt": f"{F} 0 {CX} 0 {F} {CY} 0 0 1\n{BASELINE}\n",
        "mine/left.png": LEFT,
    },
}

each_dataset = pytest.mark.parametrize("name", [name for name in DATASETS if name != "synthetic"])


def sample_of(root, name) -> StereoSample:
    (ref,) = find_pairs(root, [name])
    return load(ref)


@each_dataset
def test_sample_is_in_our_conventions_and_metric(tmp_path, name):
    write(tmp_path, LAYOUTS[name])
    sample, size = sample_of(tmp_path, name), (HEIGHT, WIDTH)
    assert sample.dataset == name and sample.rectified
    assert sample.left.shape == sample.right.shape == (*size, 3)
    dtypes = [array.dtype for array in (sample.left, sample.right, sample.depth_m, sample.valid)]
    assert dtypes == [np.uint8, np.uint8, np.float32, bool]
    np.testing.assert_allclose(sample.K_left, [[F, 0, CX], [0, F, CY], [0, 0, 1]], atol=1e-9)
    # The right camera stands to the right: +x in the left camera's frame, in metres.
    np.testing.assert_allclose(sample.E[:3], np.c_[np.eye(3), [BASELINE, 0, 0]], atol=1e-9)
    known = with_hole(np.ones(size, bool), False)
    np.testing.assert_array_equal(sample.valid, known)
    np.testing.assert_allclose(sample.depth_m, np.where(known, DEPTH_M, 0), rtol=1e-5)
    if name in ("middeval3", "eth3d", "booster"):
        np.testing.assert_array_equal(sample.occluded, known & HIDDEN)
    assert name != "booster" or (sample.material == 3).all()
    cameras = sample.K_left, sample.K_right, sample.E
    raw = depth_to_disparity(np.where(known, sample.depth_m, 1), *cameras)
    doffs = sample.K_right[0, 2] - sample.K_left[0, 2]
    np.testing.assert_allclose((raw + doffs)[known], DISPARITY[known], rtol=1e-5)
    np.testing.assert_allclose(disparity_to_depth(raw, *cameras)[known], sample.depth_m[known], rtol=1e-5)


IMAGE, TRUTH, CALIBRATION = range(3)


def of_another_size(path):
    dtype = np.uint16 if path.suffix == ".png" else np.float32
    write(path.parent, {path.name: np.ones((HEIGHT, WIDTH - 2), dtype)})


def cut_off(path):
    os.truncate(path, path.stat().st_size // 2)


@each_dataset
@pytest.mark.parametrize(
    ("which", "damage", "error"),
    [
        *((which, Path.unlink, FileNotFoundError) for which in (IMAGE, TRUTH, CALIBRATION)),
        *((IMAGE, cut_off, ValueError), (TRUTH, cut_off, ValueError), (TRUTH, of_another_size, ValueError)),
    ],
)
def test_a_file_that_is_missing_or_damaged_is_named(tmp_path, name, which, damage, error):
    write(tmp_path, LAYOUTS[name])
    path = tmp_path / list(LAYOUTS[name])[which]
    damage(path)
    for ref in find_pairs(tmp_path, [name]):  # none where what makes the folder a sample is gone
        if (which, damage) == (TRUTH, Path.unlink) and name in ("mvsnet", "folder"):
            assert not load(ref).valid.any()
            continue
        with pytest.raises(error, match=path.stem.replace("disp0GT", "disp0")):
            load(ref)


def test_sets_below_one_root_are_told_apart_and_ordered(tmp_path):
    names = ["kitti2015", "kitti2012", "middlebury2014", "eth3d", "mvsnet"]
    for name in reversed(names):
        write(tmp_path / name, LAYOUTS[name])
    assert [ref.dataset for ref in find_pairs(tmp_path)] == names
    with pytest.raises(ValueError, match=r"root \(DIR, --data\) must be an existing folder"):
        find_pairs(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="datasets must be one of kitti2015"):
        find_pairs(tmp_path, ["kitty"])


def test_kitti2012_prefers_colour_and_all_pixels_and_says_so(tmp_path):
    write(tmp_path, LAYOUTS["kitti2012"])
    assert sample_of(tmp_path, "kitti2012").notes["truth"] == "disp_noc"
    files = {
        "disp_noc/000007_10.png": kitti_png(np.where(HIDDEN, 0, DISPARITY)),
        "disp_occ/000007_10.png": kitti_png(DISPARITY),
        **{f"colored_{camera}/000007_10.png": LEFT for camera in (0, 1)},
        "calib/000007.txt": kitti_calibration("P", (0, 1)) + kitti_calibration("P", (2, 3), CX + 1),
    }
    write(tmp_path / "data" / "training", files)
    sample = sample_of(tmp_path, "kitti2012")
    assert sample.notes["truth"] == "disp_occ" and sample.valid.all()
    assert sample.K_left[0, 2] == CX + 1  # colour cameras 2 and 3
    np.testing.assert_array_equal(sample.occluded, HIDDEN)


def test_middleburys_test_scenes_are_left_out_and_coarse_truth_says_how_coarse(tmp_path):
    write(tmp_path, LAYOUTS["middeval3"])
    truth = "MiddEval3/trainingQ/Scene/disp0GT.pfm"
    without = {name: content for name, content in LAYOUTS["middeval3"].items() if name != truth}
    write(tmp_path, {name.replace("training", "test"): content for name, content in without.items()})
    assert [ref.label for ref in find_pairs(tmp_path)] == ["middeval3/Scene"]
    assert sample_of(tmp_path, "middeval3").notes["disparity_step_px"] == 0
    write(tmp_path, {truth: np.round(DISPARITY)})
    assert sample_of(tmp_path, "middeval3").notes["disparity_step_px"] == 1


@pytest.mark.parametrize("name", ["mvsnet", "folder"])
def test_a_pair_without_truth_is_neither_scored_nor_perturbed(tmp_path, name):
    write(tmp_path, LAYOUTS[name])
    (tmp_path / list(LAYOUTS[name])[TRUTH]).unlink()
    (ref,) = find_pairs(tmp_path, [name])
    with pytest.raises(ValueError, match=rf"the truth of {name}/.*-turn1-shift0.1 must be known"):
        load(changed_ref(ref, "perturbed", (1.0, 0.1)))
    with pytest.raises(ValueError, match=r"got none \(no .*dep"):
        score(load(ref), Prediction(np.ones((HEIGHT, WIDTH))), None)


def test_mvsnet_pairs_extra_views_and_pixel_centre(tmp_path):
    write(tmp_path, LAYOUTS["mvsnet"] | LAYOUTS["robustmvd"])
    every = find_pairs(tmp_path, ["mvsnet"], pairs="all")
    assert [ref.files["views"][:2] for ref in every] == [(0, 1), (0, 2), (1, 0), (2, 0)]
    before = cell_key(every[0], "guided", {})
    write(tmp_path, {"scan1/images/00000002.jpg": RIGHT})
    assert cell_key(every[0], "guided", {}) != before  # a further view has changed
    np.testing.assert_allclose(load(every[2]).E[:3, 3], [-BASELINE, 0, 0], atol=1e-9)
    ((image, K, E),) = sample_of(tmp_path, "mvsnet").extra_views
    assert image.shape == (HEIGHT, WIDTH, 3) and K[0, 2] == CX
    np.testing.assert_allclose(E[:3, 3], [2 * BASELINE, 0, 0], atol=1e-9)
    centres = [ref.files["pixel_centre"] for ref in find_pairs(tmp_path, pixel_centre=None)]
    assert centres == [0.0, 0.5]  # what is left open is the set's own
    colmap = load(find_pairs(tmp_path, ["mvsnet"], pixel_centre=0.5)[0])
    assert (colmap.K_left[0, 2], colmap.K_right[1, 2]) == (CX - 0.5, CY - 0.5)


def test_robustmvd_takes_key_views_and_belongs_to_no_other_set(tmp_path):
    write(tmp_path, LAYOUTS["robustmvd"])
    assert [ref.label for ref in find_pairs(tmp_path)] == ["robustmvd/Barn-60-62"]
    every = find_pairs(tmp_path, ["robustmvd"], pairs="all")
    assert [ref.name for ref in every] == ["Barn-60-62", "Barn-60-61"]
    np.testing.assert_allclose(load(every[0]).extra_views[0][2][:3, 3], [2 * BASELINE, 0, 0], atol=1e-9)
    assert [len(views) for views in KEY_VIEWS.values()] == [18, 25, 13, 13]
    write(tmp_path, {"Barn/pair.txt": "1\n61\n1 60 10.0\n"})  # no key view
    assert find_pairs(tmp_path) == []


@pytest.mark.parametrize("missing", ["left.png", "right.png", "calib.txt"])
def test_a_folder_of_two_of_three_is_no_silent_gap_and_one_of_less_is_no_pair(tmp_path, missing):
    write(tmp_path, LAYOUTS["folder"])
    (tmp_path / "mine" / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        sample_of(tmp_path, "folder")
    for side in ("left", "right"):
        (tmp_path / "mine" / f"{side}.png").unlink(missing_ok=True)
    assert find_pairs(tmp_path, ["folder"]) == []


@pytest.mark.filterwarnings("ignore:.*has no unit")
def test_folder_takes_two_calibrations_that_go_by_the_names_of_images(tmp_path):
    pictures = {f"{side}.jpg": np.zeros((480, 640, 3), np.uint8) for side in ("left", "right")}
    colmap = zip(("calib_left.txt", "calib_right.txt"), SAMPLES["colmap"], strict=True)
    write(tmp_path / "mine", pictures | dict(colmap))
    sample = sample_of(tmp_path, "folder")
    assert (sample.K_left[0, 0], sample.E[0, 3]) == pytest.approx((700.0, 0.5))


REAL = Path(os.environ.get("GEODIFF_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


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
def test_the_thirteen_real_pairs_are_found_and_their_truth_warps_right_to_left():
    expected = ["kitti2015"] + ["kitti2012"] * 5 + ["middlebury2014", "eth3d"] + ["mvsnet"] * 5
    refs = find_pairs(REAL)
    assert [ref.dataset for ref in refs] == expected
    for ref in refs:
        sample = load(ref)
        assert sample.rectified == (sample.dataset != "mvsnet")
        true, nearer, farther = (photometric_error(sample, factor) for factor in (1.0, 0.8, 1.2))
        assert true < nearer and true < farther, ref.label
