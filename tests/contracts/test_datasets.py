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

from geodiff_plugin.cameras import Camera
from geodiff_plugin.evaluation.baselines import Prediction
from geodiff_plugin.evaluation.datasets import DATASETS, StereoSample, find_pairs, load
from geodiff_plugin.evaluation.datasets.layouts import KEY_VIEWS
from geodiff_plugin.evaluation.datasets.sample import changed_ref, depth_to_disparity, disparity_to_depth
from geodiff_plugin.evaluation.experiment import cell_key, score
from geodiff_plugin.formats import as_image_01, write_pfm
from geodiff_plugin.geometry import plane_rays, warp_right_to_left
from tests.contracts.calibrations import SAMPLES

HEIGHT, WIDTH, F, CX, CY, BASELINE = 40, 64, 50.0, 31.0, 19.5, 0.2
RNG = np.random.default_rng(0)
WRITERS = {".npy": np.save, ".npz": np.savez_compressed, ".pfm": write_pfm}


def write(root, files):
    """Write text as is, and arrays by the suffix of their name, as images by default."""
    for name, content in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if isinstance(content, str):
            path.write_text(content)
        elif path.suffix in WRITERS:
            WRITERS[path.suffix](path, content.astype(np.float32))
        else:
            Image.fromarray(content).save(path)


def rgb(height=HEIGHT, width=WIDTH, *channels):
    return RNG.integers(0, 256, (height, width, *channels), dtype=np.uint8)


def with_hole(values, unknown):
    values = values.copy()
    values[:5, :7] = unknown
    return values


#: A tilted plane of 4 to 9 px, in whole multiples of 1 / 256.
DISPARITY = np.linspace(4.0, 8.0, WIDTH)[None] + np.linspace(0.0, 1.0, HEIGHT)[:, None]
DISPARITY = np.round(DISPARITY * 256) / 256
DEPTH_M = F * BASELINE / DISPARITY
LEFT, RIGHT, GREY = rgb(HEIGHT, WIDTH, 3), rgb(HEIGHT, WIDTH, 3), rgb()
HIDDEN = np.broadcast_to(np.arange(WIDTH) < 4, (HEIGHT, WIDTH))
MASK = np.where(HIDDEN, 128, 255).astype(np.uint8)


def kitti_png(values):
    return np.rint(values * 256).astype(np.uint16)


def kitti_calibration(prefix, numbers, cx=CX, head=""):
    rows = zip(numbers, (0.0, -F * BASELINE), strict=True)
    return "".join(head.format(n) + f"{prefix}{n}: {F} 0 {cx} {x} 0 {F} {CY} 0 0 0 1 0\n" for n, x in rows)


def scene_files(folder, ground_truth, doffs):
    calibration = (
        f"cam0=[{F} 0 {CX}; 0 {F} {CY}; 0 0 1]\ncam1=[{F} 0 {CX + doffs}; 0 {F} {CY}; 0 0 1]\n"
        f"doffs={doffs}\nbaseline={BASELINE * 1000}\nwidth={WIDTH}\nheight={HEIGHT}\nndisp=16\n"
    )
    files = {f"{folder}/im1.png": RIGHT, ground_truth: with_hole(DISPARITY - doffs, np.inf)}
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


#: Of every set its files, the right image, ground truth and its calibration first.
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
    "middlebury2021": scene_files("data/artroom1", "data/artroom1/disp0.pfm", 2.5),
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
    # Poses are camera to world, in a frame that is neither camera's; depth is in whole millimetres.
    "scannet": {
        "test/scene0700_00/color/000012.jpg": RIGHT,
        "test/scene0700_00/depth/000008.png": np.rint(1000 * with_hole(DEPTH_M, 0)).astype(np.uint16),
        "test/scene0700_00/intrinsic/intrinsic_depth.txt": f"{F} 0 {CX} 0\n0 {F} {CY} 0\n0 0 1 0\n0 0 0 1\n",
        "test/scene0700_00/color/000008.jpg": LEFT,
        "test/scene0700_00/pose/000008.txt": "0 0 1 5\n0 1 0 6\n-1 0 0 7\n0 0 0 1\n",
        "test/scene0700_00/pose/000012.txt": f"0 0 1 5\n0 1 0 6\n-1 0 0 {7 - BASELINE}\n0 0 0 1\n",
        "scannet_banet_test_pairs.txt": "scene0700_00 000008 000012\nscene0701_00 000001 000002\n",
    },
    "folder": {
        "mine/right.png": RIGHT,
        "mine/depth.npy": with_hole(DEPTH_M, np.nan),
        "mine/calib.txt": f"{F} 0 {CX} 0 {F} {CY} 0 0 1\n{BASELINE}\n",
        "mine/left.png": LEFT,
    },
}

#: Sets whose cameras do not depend on a file.
FIXED = {"middlebury2001", "middlebury2003", "middlebury2005", "middlebury2006"}
each_dataset = pytest.mark.parametrize(
    "name", [name for name in DATASETS if name not in FIXED and name != "synthetic"]
)


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
    rtol = 1e-3 if name == "scannet" else 1e-5
    np.testing.assert_allclose(sample.depth_m, np.where(known, DEPTH_M, 0), rtol=rtol)
    if name in ("middeval3", "eth3d", "booster"):
        np.testing.assert_array_equal(sample.occluded, known & HIDDEN)
    assert name != "booster" or (sample.material == 3).all()
    cameras = sample.K_left, sample.K_right, sample.E
    raw = depth_to_disparity(np.where(known, sample.depth_m, 1), *cameras)
    doffs = sample.K_right[0, 2] - sample.K_left[0, 2]
    np.testing.assert_allclose((raw + doffs)[known], DISPARITY[known], rtol=rtol)
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
    if name == "scannet" and damage is of_another_size:
        return  # images follow the depth map
    for ref in find_pairs(tmp_path, [name]):  # none where what makes the folder a sample is gone
        if (which, damage) == (TRUTH, Path.unlink) and name in ("mvsnet", "folder"):
            assert not load(ref).valid.any()
            continue
        with pytest.raises(error, match=path.stem.replace("disp0GT", "disp0")):
            load(ref)


def old_middlebury(names, height, width, grey_per_px, right_offset=0):
    """A plane 20 px away with a strip 5 px nearer; grey values of both views, 0 in unknown rows."""
    views, disparities = names
    suffix = ".ppm" if views[0] == "im2" and grey_per_px == 8 else ".png"
    left = np.full((height, width), 20.0)
    left[:, 40:50] = 25.0
    right = np.full((height, width), 20.0)
    right[:, 15:25] = 25.0
    right += right_offset
    files = {f"{view}{suffix}": rgb(height, width, 3) for view in views}
    for name, values in zip(disparities, (left, right), strict=True):
        values[:3] = 0
        files[f"{name}{'.pgm' if suffix == '.ppm' else '.png'}"] = np.rint(values * grey_per_px).astype(
            np.uint8
        )
    return files


EARLY, LATE = (("im2", "im6"), ("disp2", "disp6")), (("view1", "view5"), ("disp1", "disp5"))


@pytest.mark.parametrize(
    ("name", "scene", "names", "size", "grey"),
    [
        ("middlebury2001", "venus", EARLY, (40, 60), 8),
        ("middlebury2003", "cones", EARLY, (40, 450), 4),
        ("middlebury2003", "teddyF", EARLY, (40, 1800), 1),
        ("middlebury2005", "Art", LATE, (370, 60), 3),
        ("middlebury2006", "Aloe", LATE, (555, 60), 2),
        ("middlebury2006", "Rocks2", LATE, (1110, 60), 1),
    ],
)
def test_old_middlebury_has_the_published_cameras_or_nominal_ones(tmp_path, name, scene, names, size, grey):
    files = old_middlebury(names, *size, grey)
    published = names is LATE
    write(tmp_path / "x" / scene, files | ({"dmin.txt": "270\n"} if published else {}))
    (ref,) = find_pairs(tmp_path)
    assert ref.label == f"{name}/{scene}"
    sample = load(ref)
    assert sample.rectified and sample.left.shape == (*size, 3) and sample.notes["calibration"]
    f, baseline, offset = (3740 / grey, 0.16, 270 / grey) if published else (size[1], 0.1, 0)
    assert sample.K_left[0, 0] == f and sample.E[0, 3] == baseline
    assert sample.K_right[0, 2] - sample.K_left[0, 2] == pytest.approx(offset)
    expected = np.full(size, f * baseline / (20 + offset))
    expected[:, 40:50] = f * baseline / (25 + offset)
    expected[:3] = 0
    np.testing.assert_allclose(sample.depth_m, expected, rtol=1e-6)
    # The strip hides the five pixels to the left of it, and 20 px at the border are not in the right view.
    hidden = np.isin(np.arange(size[1]), [*range(20), *range(35, 40)])
    np.testing.assert_array_equal(sample.occluded[3:], np.broadcast_to(hidden, (size[0] - 3, size[1])))
    assert not sample.occluded[:3].any()


def test_old_middlebury_names_what_is_missing_or_of_another_size(tmp_path):
    folder = tmp_path / "Aloe"
    write(folder, old_middlebury(LATE, 370, 60, 3))
    with pytest.raises(FileNotFoundError, match="dmin.txt"):
        sample_of(tmp_path, "middlebury2006")
    write(folder, {"dmin.txt": "many\n"})
    with pytest.raises(ValueError, match=r"dmin\.txt must be one number; got 'many'"):
        sample_of(tmp_path, "middlebury2006")
    (folder / "disp5.png").unlink()
    write(folder, {"dmin.txt": "200\n"})
    assert sample_of(tmp_path, "middlebury2006").occluded is None
    write(folder, old_middlebury(LATE, 400, 60, 3))
    with pytest.raises(ValueError, match=r"view1\.png must be of height 1110, 555, 370; got 400"):
        sample_of(tmp_path, "middlebury2006")
    write(folder, old_middlebury(LATE, 370, 60, 3) | {"disp1.png": np.ones((370, 62), np.uint8)})
    with pytest.raises(ValueError, match=r"disp1\.png must be for 60 x 370 pixels"):
        sample_of(tmp_path, "middlebury2006")
    (folder / "disp1.png").unlink()  # a test scene
    assert find_pairs(tmp_path) == []


def test_scannet_counts_half_a_metre_to_ten_and_names_lost_frames(tmp_path):
    write(tmp_path, LAYOUTS["scannet"])
    base = tmp_path / "test" / "scene0700_00"
    depth = np.full((HEIGHT, WIDTH), 2000, np.uint16)
    depth[0, :3] = 500, 501, 10000
    write(base, {"depth/000008.png": depth, "color/000008.jpg": rgb(2 * HEIGHT, 2 * WIDTH, 3)})
    sample = sample_of(tmp_path, "scannet")
    assert sample.valid[0, :4].tolist() == [False, True, False, True] and sample.left.shape == (
        HEIGHT,
        WIDTH,
        3,
    )
    for text, words in (("-inf " * 16, "finite; got infinite"), ("1 2 3", "16 numbers")):
        write(base, {"pose/000012.txt": text})
        with pytest.raises(ValueError, match=f"000012.txt must be {words}"):
            sample_of(tmp_path, "scannet")
    write(tmp_path, {"scannet_banet_test_pairs.txt": "scene0700_00 000008\n"})
    with pytest.raises(ValueError, match=r"scannet_banet_test_pairs\.txt must be lines of"):
        find_pairs(tmp_path)


def test_pixels_that_kitti_does_not_list_as_visible_are_not_known_to_be_bad(tmp_path):
    write(tmp_path, LAYOUTS["kitti2012"])
    sample = sample_of(tmp_path, "kitti2012")
    assert sample.notes["noc_only"] and not sample.occluded.any()
    write(tmp_path, LAYOUTS["kitti2015"])
    sample = sample_of(tmp_path, "kitti2015")
    assert not sample.notes["noc_only"] and sample.occluded is None


def test_data_sets_below_one_root_are_distinguished_and_ordered(tmp_path):
    names = ["kitti2015", "kitti2012", "middlebury2014", "eth3d", "mvsnet"]
    for name in reversed(names):
        write(tmp_path / name, LAYOUTS[name])
    assert [ref.dataset for ref in find_pairs(tmp_path)] == names
    with pytest.raises(ValueError, match=r"root \(DIR, --data\) must be an existing folder"):
        find_pairs(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="datasets must be one of kitti2015"):
        find_pairs(tmp_path, ["kitty"])


def test_kitti2012_prefers_colour_and_all_pixels_and_reports_this(tmp_path):
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


def test_middleburys_test_scenes_are_skipped_and_coarse_ground_truth_has_its_step(tmp_path):
    write(tmp_path, LAYOUTS["middeval3"])
    ground_truth = "MiddEval3/trainingQ/Scene/disp0GT.pfm"
    without = {name: content for name, content in LAYOUTS["middeval3"].items() if name != ground_truth}
    write(tmp_path, {name.replace("training", "test"): content for name, content in without.items()})
    assert [ref.label for ref in find_pairs(tmp_path)] == ["middeval3/Scene"]
    assert sample_of(tmp_path, "middeval3").notes["disparity_step_px"] == 0
    write(tmp_path, {ground_truth: np.round(DISPARITY)})
    assert sample_of(tmp_path, "middeval3").notes["disparity_step_px"] == 1


@pytest.mark.parametrize("name", ["mvsnet", "folder"])
def test_a_pair_without_ground_truth_is_neither_scored_nor_perturbed(tmp_path, name):
    write(tmp_path, LAYOUTS[name])
    (tmp_path / list(LAYOUTS[name])[TRUTH]).unlink()
    (ref,) = find_pairs(tmp_path, [name])
    with pytest.raises(ValueError, match=rf"the ground truth of {name}/.*-turn1-shift0.1 must be known"):
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
    images = {f"{side}.jpg": np.zeros((480, 640, 3), np.uint8) for side in ("left", "right")}
    colmap = zip(("calib_left.txt", "calib_right.txt"), SAMPLES["colmap"], strict=True)
    write(tmp_path / "mine", images | dict(colmap))
    sample = sample_of(tmp_path, "folder")
    assert (sample.K_left[0, 0], sample.E[0, 3]) == pytest.approx((700.0, 0.5))


REAL = Path(os.environ.get("GEODIFF_TEST_DATA", Path(__file__).resolve().parents[3] / "shared" / "data"))


def photometric_error(sample, factor):
    """Mean absolute difference of left image and right image, warped by ``factor`` times ground truth."""
    left, right = (as_image_01(image, "image")[None] for image in (sample.left, sample.right))
    depth_m = torch.from_numpy(np.where(sample.valid, sample.depth_m, 1) * np.float32(factor))[None, None]
    left_camera, right_camera = Camera(sample.K_left), Camera(sample.K_right)
    rays = plane_rays(depth_m, [left_camera], [right_camera], [np.linalg.inv(sample.E)])
    warped = warp_right_to_left(right, depth_m, rays)
    seen = warped.visible & torch.from_numpy(sample.valid)
    return ((warped.image - left).abs().mean(1, keepdim=True) * seen).sum() / seen.sum()


@pytest.mark.slow
@pytest.mark.skipif(not REAL.is_dir(), reason="no real samples")
def test_the_thirteen_real_pairs_are_found_and_their_ground_truth_warps_right_to_left():
    expected = ["kitti2015"] + ["kitti2012"] * 5 + ["middlebury2014", "eth3d"] + ["mvsnet"] * 5
    refs = find_pairs(REAL)
    assert [ref.dataset for ref in refs] == expected
    for ref in refs:
        sample = load(ref)
        assert sample.rectified == (sample.dataset != "mvsnet")
        true, nearer, farther = (photometric_error(sample, factor) for factor in (1.0, 0.8, 1.2))
        assert true < nearer and true < farther, ref.label
