"""The folder of a result: every file and count against the maps of the run, and exports read by others."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin import plotting
from geodiff_plugin.cameras import Camera
from geodiff_plugin.formats.out import OutFolder
from geodiff_plugin.formats.target import read_target_camera
from geodiff_plugin.jobs import writing
from geodiff_plugin.jobs.records import PairOrigin
from geodiff_plugin.jobs.report import build_report
from geodiff_plugin.jobs.writing import (
    cameras_of,
    pixels_of,
    write_maps,
    write_pair,
    write_reprojected,
    write_row,
)
from tests.unit.jobs import made_runs

MIN_CONFIDENCE = 0.55


@pytest.fixture(autouse=True)
def plain_figures(monkeypatch):
    """Figures as small images, which are quick to draw; notes what they are drawn of."""
    drawn = {}

    def note(name):
        def draw(*arguments, **named):
            drawn[name] = (*arguments, named)
            return Image.new("RGB", (4, 3))

        return draw

    for name in ("depth_figure", "fraction_figure", "overview"):
        monkeypatch.setattr(plotting, name, note(name))
    return drawn


def one_map(values) -> np.ndarray:
    return np.asarray(values)[0, :, :, 0]


def flying(depth_m: np.ndarray) -> np.ndarray:
    """Pixels of which fewer than three neighbours have their depth within 4 % of the nearer, one by one."""
    height, width = depth_m.shape
    found = np.zeros(depth_m.shape, bool)
    for v in range(height):
        for u in range(width):
            if not depth_m[v, u] > 0:
                continue
            near = 0
            for y in range(max(0, v - 1), min(height, v + 2)):
                for x in range(max(0, u - 1), min(width, u + 2)):
                    other = depth_m[y, x]
                    if (y, x) != (v, u) and other > 0:
                        near += abs(other - depth_m[v, u]) <= 0.04 * min(other, depth_m[v, u])
            found[v, u] = near < 3
    return found


@pytest.fixture(scope="module")
def run():
    """Of a depth with some pixels that hang in the air."""
    depth_m = made_runs.depth_map()
    depth_m[25, 20], depth_m[26, 40] = 1.4, 1.5
    return made_runs.run(made_runs.output(prediction=depth_m[None, ..., None]))


def test_maps_and_counts_are_those_of_the_output(run, tmp_path, plain_figures):
    output, left = run.output, run.inputs.left
    reported = write_maps(tmp_path, output, left, MIN_CONFIDENCE)
    depth_m, confidence = one_map(output.prediction), one_map(output.confidence)
    valid = (depth_m > 0) & (confidence > 0)
    np.testing.assert_array_equal(np.load(tmp_path / "depth.npy"), depth_m)
    for name in ("photometric_error", "uncertainty", "confidence", "sigma"):
        np.testing.assert_array_equal(np.load(tmp_path / f"{name}.npy"), one_map(getattr(output, name)), name)
    np.testing.assert_array_equal(np.load(tmp_path / "normals.npy"), output.extras["normals"][0])
    millimetres = np.asarray(Image.open(tmp_path / "depth_mm.png"))
    np.testing.assert_array_equal(millimetres, np.rint(np.where(valid, depth_m, 0) * 1000.0))
    sigma_m, sigma_mm = one_map(output.sigma), np.asarray(Image.open(tmp_path / "sigma_mm.png"))
    known = np.isfinite(sigma_m)
    np.testing.assert_array_equal(known, valid)
    assert (sigma_mm[~known] == 0).all() and (sigma_mm[known] / 1000.0 >= sigma_m[known] - 1e-6).all()
    assert (sigma_mm[known] / 1000.0 < sigma_m[known] + 0.0011).all()
    seen = one_map(output.visible)
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "visible.png")) == 255, seen)

    hang, doubtful = flying(depth_m), confidence < MIN_CONFIDENCE
    kept = valid & ~hang & ~doubtful
    assert hang.sum() >= 2 and 0 < kept.sum() < (valid & ~hang).sum() < valid.sum()
    assert reported == {
        "depth_mm_zero_pixels": (millimetres == 0).sum(),
        "cloud_points": kept.sum(),
        "flying_points": hang.sum(),
        "doubtful_points": (valid & doubtful).sum(),
        "points_out_of_reach": (~valid).sum(),
    }
    *_, (shown_left, _, _, error, _) = [plain_figures["overview"]]
    np.testing.assert_array_equal(shown_left, np.rint(left * 255).astype(np.uint8))
    assert np.isnan(error[~seen]).all()
    np.testing.assert_array_equal(error[seen], one_map(output.photometric_error)[seen])
    drawn, label, top, named = plain_figures["fraction_figure"]
    np.testing.assert_array_equal(drawn, confidence)
    assert (label, top, named) == ("confidence", 1.0, {})
    drawn, *ends, named = plain_figures["depth_figure"]
    np.testing.assert_array_equal(drawn, depth_m)
    assert named == {"unit": "m"} and tuple(ends) == plotting.depth_range(np.where(valid, depth_m, 0))


def test_colours_end_at_the_farthest_measured_depth(run):
    depth_m = run.output.prediction
    median_m = float(np.median(depth_m[depth_m > 0]))
    assert writing.figure_range(run.output)[1] > median_m
    output = replace(run.output, measurable_m=torch.tensor([median_m]))
    near, far = writing.figure_range(output)
    assert near < far <= median_m
    beyond = replace(run.output, measurable_m=torch.tensor([0.01]))
    assert writing.figure_range(beyond) == plotting.depth_range(one_map(depth_m)), "nothing was measured"


def test_the_cloud_holds_the_points_that_are_kept_with_their_colours(run, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    output, left = run.output, run.inputs.left
    write_maps(tmp_path, output, left, MIN_CONFIDENCE)
    depth_m, confidence, K = one_map(output.prediction), one_map(output.confidence), made_runs.K_LEFT
    v, u = np.nonzero((depth_m > 0) & (confidence >= MIN_CONFIDENCE) & ~flying(depth_m))
    z = depth_m[v, u].astype(float)
    expected = np.stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z], 1)
    cloud = trimesh.load(tmp_path / "cloud.ply")
    np.testing.assert_allclose(cloud.vertices, expected, atol=1e-5)
    np.testing.assert_array_equal(cloud.colors[:, :3], np.rint(left * 255)[v, u])
    raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_array_equal(raw["sigma"].ravel(), one_map(output.sigma)[v, u])


@pytest.mark.parametrize(
    ("kept", "limit", "count"), [(100, None, 100), (100, 100, 100), (100, 40, 40), (100, 1, 1)]
)
def test_a_mask_is_thinned_evenly_to_a_number_of_points(kept, limit, count):
    mask = np.zeros((20, 30), bool)
    mask.flat[np.random.default_rng(0).permutation(600)[:kept]] = True
    thinned = writing._thinned(mask, limit)
    assert thinned.sum() == count and not (thinned & ~mask).any()
    order = np.flatnonzero(mask)
    gaps = np.diff(np.searchsorted(order, np.flatnonzero(thinned)))
    assert count < 2 or gaps.max() - gaps.min() <= 1, "evenly in pixel order"


def test_an_output_without_a_second_view_writes_what_it_has(tmp_path, plain_figures):
    alone = made_runs.output(
        visible=None, photometric_error=None, confidence=None, uncertainty=None, extras={}, unit=None
    )
    reported = write_maps(tmp_path, alone, made_runs.run().inputs.left)
    depth_m = one_map(alone.prediction)
    assert {path.name for path in tmp_path.iterdir()} == {
        *("depth.npy", "depth_mm.png", "depth.png", "overview.png", "cloud.ply")
    }
    assert reported["doubtful_points"] == 0 and reported["points_out_of_reach"] == (depth_m == 0).sum()
    assert reported["cloud_points"] == ((depth_m > 0) & ~flying(depth_m)).sum()
    assert plain_figures["overview"][2:4] == (None, None)
    assert plain_figures["depth_figure"][-1] == {"unit": None}
    assert b"metre" not in (tmp_path / "cloud.ply").read_bytes()[:400]


def test_a_result_of_holes_only_is_written(run, tmp_path):
    empty = run.output.with_holes(max_sigma=1e-9)
    counts = write_maps(tmp_path, empty, run.inputs.left)
    assert counts["cloud_points"] == 0 and counts["points_out_of_reach"] == empty.prediction.size
    assert not np.load(tmp_path / "depth.npy").any() and np.isnan(np.load(tmp_path / "sigma.npy")).all()
    assert build_report(replace(run, output=empty))["sigma_median_m"] is None


def test_pixels_of_a_cloud_are_valid_confident_and_do_not_fly(run):
    depth_m, confidence = one_map(run.output.prediction), one_map(run.output.confidence)
    least = float(np.sort(confidence[confidence > 0])[300])
    shown = pixels_of(run.output, run.inputs.left, least)
    expected = (depth_m > 0) & (confidence >= least) & ~flying(depth_m)
    np.testing.assert_array_equal(shown.valid, expected)
    np.testing.assert_array_equal(shown.depth_m, depth_m)
    np.testing.assert_array_equal(shown.K, made_runs.K_LEFT)
    assert shown.image_01 is run.inputs.left and shown.K.dtype == np.float64
    v, u = np.argwhere(confidence == np.float32(least))[0]
    assert shown.valid[v, u] or flying(depth_m)[v, u] or not depth_m[v, u] > 0
    bare = replace(run.output, confidence=None)
    everything = pixels_of(bare, run.inputs.left)
    np.testing.assert_array_equal(everything.valid, (depth_m > 0) & ~flying(depth_m))
    assert not pixels_of(bare, run.inputs.left, 0.01).valid.any(), "no depth is known to be that sure"
    sigma_m = one_map(run.output.sigma)
    largest = float(np.nanmedian(sigma_m))
    precise = pixels_of(run.output, run.inputs.left, 0.0, largest)
    np.testing.assert_array_equal(precise.valid, (sigma_m <= largest) & ~flying(depth_m))


@pytest.mark.parametrize("rescaled", [1.0, 2.5])
def test_cameras_of_all_views_are_in_the_unit_of_the_depth(run, rescaled):
    refined = cameras_of(run.output, run.inputs.guidance)
    given = cameras_of(replace(run.output, poses=[], rescaled=rescaled), run.inputs.guidance)
    for cameras, poses, factor in ((refined, made_runs.REFINED, 1.0), (given, made_runs.POSES, rescaled)):
        assert [camera.size for camera in cameras] == list(made_runs.SIZES)
        np.testing.assert_array_equal(cameras[0].E, np.eye(4))
        Ks = (made_runs.K_LEFT, *made_runs.K_RIGHTS)
        for camera, K in zip(cameras, Ks, strict=True):
            np.testing.assert_allclose(camera.K, K)
        for camera, E in zip(cameras[1:], poses, strict=True):
            np.testing.assert_allclose(camera.E[:3, :3], E[:3, :3])
            np.testing.assert_allclose(camera.E[:3, 3], factor * E[:3, 3])
            np.testing.assert_array_equal(camera.E[3], [0, 0, 0, 1])


def write(run, folder: Path):
    with OutFolder(folder) as out:
        return write_pair(out, run)


@pytest.mark.parametrize("rescaled", [1.0, 2.5])
def test_a_colmap_model_puts_a_point_where_each_camera_sees_it(run, tmp_path, rescaled):
    """Read by pycolmap: cameras, poses and points of a posed pair, also where the prior gave the metres."""
    pycolmap = pytest.importorskip("pycolmap")
    run = replace(run, options=replace(run.options, export=("colmap",), min_confidence=MIN_CONFIDENCE))
    run = replace(run, output=replace(run.output, poses=[], rescaled=rescaled))
    write(run, tmp_path / "out")
    model = pycolmap.Reconstruction(tmp_path / "out")
    names = sorted(image.name for image in model.images.values())
    assert names == sorted(["left.png", "right.png", "third.png"]) and len(model.cameras) == 3
    by_name = {image.name: image for image in model.images.values()}
    views = zip(
        ("left.png", "right.png", "third.png"), cameras_of(run.output, run.inputs.guidance), strict=True
    )
    for (name, view), E in zip(views, (np.eye(4), *made_runs.POSES), strict=True):
        image = by_name[name]
        centre = image.cam_from_world().inverse().translation
        np.testing.assert_allclose(centre, rescaled * E[:3, 3], atol=1e-6)
        camera = model.cameras[image.camera_id]
        assert (camera.width, camera.height) == view.size
        point = E[:3, :3] @ np.array([0.2, -0.1, 2.0]) + rescaled * E[:3, 3]
        pixel = view.K @ [0.1, -0.05, 1.0]
        np.testing.assert_allclose(image.project_point(point), pixel[:2] + 0.5, atol=1e-4)
    shown = pixels_of(run.output, run.inputs.left, MIN_CONFIDENCE)
    assert len(model.points3D) == shown.valid.sum()


@pytest.mark.parametrize("kind", ["glb", "mesh"])
def test_a_scene_for_viewers_holds_the_kept_surface_and_all_cameras(run, tmp_path, kind):
    trimesh = pytest.importorskip("trimesh")
    run = replace(run, options=replace(run.options, export=(kind,), min_confidence=MIN_CONFIDENCE))
    write(run, tmp_path / "out")
    name = {"glb": "cloud.glb", "mesh": "mesh.glb"}[kind]
    assert [path.name for path in (tmp_path / "out").glob("*.glb")] == [name]
    scene = trimesh.load(tmp_path / "out" / name)
    sizes = [len(part.vertices) for part in scene.geometry.values()]
    shown = pixels_of(run.output, run.inputs.left, MIN_CONFIDENCE)
    if kind == "glb":
        assert shown.valid.sum() in sizes
    assert 0 < max(sizes) <= shown.valid.sum() and len(sizes) == 4


def test_undistorted_views_are_written_and_named_in_the_model(run, tmp_path):
    inputs = replace(run.inputs, undistorted=True)
    run = replace(run, inputs=inputs, options=replace(run.options, export=("colmap",)))
    write(run, tmp_path / "out")
    text = (tmp_path / "out/images.txt").read_text()
    views = [inputs.left, *(image.permute(1, 2, 0).numpy() for image in inputs.guidance.rights)]
    for number, image in enumerate(views, 1):
        name = "undistorted.png" if number == 1 else f"undistorted-{number}.png"
        assert f" {number} {name}\n" in text
        written = np.asarray(Image.open(tmp_path / "out" / name)) / 255
        np.testing.assert_allclose(written, image, atol=0.5 / 255 + 1e-6)


def target(folder: Path) -> Path:
    """A camera 0.1 m to the right of the left one."""
    E = made_runs.pose((1, -2, 0.5), (0.1, 0.02, -0.05))
    camera = {"K": [[30, 0, 13], [0, 32, 11], [0, 0, 1]], "E": E.tolist(), "width": 28, "height": 24}
    (folder / "camera.json").write_text(json.dumps(camera))
    return folder / "camera.json"


def test_depth_in_another_camera_is_that_of_the_same_points(tmp_path):
    """Of a plane, whose depth in any camera is known."""
    path, K = target(tmp_path), made_runs.K_LEFT
    camera = json.loads(path.read_text())
    normal, offset = np.array([0.1, -0.05, 1.0]), 2.5  # n . x = d
    v, u = np.mgrid[:60, :80]
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(u.shape)], -1)
    depth_m = (offset / (rays @ normal)).astype(np.float32)
    reported = write_reprojected(tmp_path, depth_m, 0.02 * depth_m, Camera(K), read_target_camera(path))
    E, K_into = np.array(camera["E"]), np.array(camera["K"], float)
    v, u = np.mgrid[:24, :28]
    rays = np.stack([u, v, np.ones(u.shape)], -1) @ np.linalg.inv(K_into).T @ E[:3, :3].T
    expected = (offset - normal @ E[:3, 3]) / (rays @ normal)
    seen_m = np.load(tmp_path / "depth_reprojected.npy")
    assert seen_m.shape == (24, 28) and (seen_m > 0).mean() > 0.6
    np.testing.assert_allclose(seen_m[seen_m > 0], expected[seen_m > 0], rtol=5e-3)
    millimetres = np.asarray(Image.open(tmp_path / "depth_reprojected_mm.png"))
    np.testing.assert_array_equal(millimetres, np.rint(seen_m.astype(float) * 1000))
    sigma_m = np.load(tmp_path / "sigma_reprojected.npy")
    assert sigma_m.dtype == np.float32 and (np.isfinite(sigma_m) == (seen_m > 0)).all()
    # The camera is 5 cm behind, so points are farther from it than from the left camera.
    relative = sigma_m[seen_m > 0] / seen_m[seen_m > 0]
    assert relative.min() > 0.019 and relative.max() < 0.02
    sigma_mm = np.asarray(Image.open(tmp_path / "sigma_reprojected_mm.png"))
    np.testing.assert_array_equal(sigma_mm, np.nan_to_num(np.ceil(sigma_m.astype(float) * 1000)))
    known = round((seen_m > 0).sum() / seen_m.size, 4)
    np.testing.assert_allclose(reported.pop("E"), E, atol=1e-9)  # its rotation is made exactly orthogonal
    assert reported == {"K": K_into.tolist(), "size": [28, 24], "known_fraction": known}


def test_a_pair_is_written_with_all_that_its_options_ask_for(run, tmp_path):
    options = replace(run.options, reproject=target(tmp_path), min_confidence=MIN_CONFIDENCE)
    origin = PairOrigin("a", 7, {"a.png": "digest"})
    result = write(replace(run, options=options, origin=origin), tmp_path / "out")
    assert result.folder == tmp_path / "out" and result.run.output is run.output
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert report == json.loads(json.dumps(result.report))
    assert report["pair"] == {"name": "a", "frame": 7, "sha256": {"a.png": "digest"}}
    assert sorted(report["files"]["names"]) == sorted(path.name for path in (tmp_path / "out").iterdir())
    confidence = one_map(run.output.confidence)
    doubtful = one_map(run.output.valid) & (confidence < MIN_CONFIDENCE)
    assert report["files"]["doubtful_points"] == doubtful.sum()
    assert list(report["seconds"]) == ["calibration", "guided call", "write"]
    assert report["seconds"]["calibration"] == 0.125 and report["seconds"]["guided call"] == 2.5
    assert not (tmp_path / "out/undistorted.png").exists()
    valid = one_map(run.output.valid)
    maps = one_map(run.output.prediction) * valid, one_map(run.output.sigma)
    camera = Camera(made_runs.K_LEFT)
    expected = write_reprojected(tmp_path, *maps, camera, options.target_camera())
    assert report["reproject"] == expected
    for name in ("depth", "sigma"):
        into = [np.load(folder / f"{name}_reprojected.npy") for folder in (tmp_path, tmp_path / "out")]
        np.testing.assert_array_equal(*into)


def test_a_pair_without_confidence_has_no_sigma_in_another_camera(run, tmp_path):
    options = replace(run.options, reproject=target(tmp_path))
    write(replace(run, options=options, output=made_runs.output(confidence=None)), tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert set(writing.DEPTH_REPROJECTED) <= names and not any(name.startswith("sigma") for name in names)


def test_the_row_of_a_pair_is_that_of_the_report_which_is_written(run, tmp_path):
    with OutFolder(tmp_path / "out") as out:
        row = write_row(out, run)
    report = json.loads((tmp_path / "out/report.json").read_text())
    assert "pair" not in report
    assert (row["near_m"], row["median_m"], row["far_m"]) == tuple(
        report["depth"][f"{name}_m"] for name in ("min", "median", "max")
    )
    assert row["seconds"] == pytest.approx(sum(report["seconds"].values()), abs=1e-3)
    assert row["verdict"] == "not trusted" and row["message"] == f"{made_runs.REMARK} {made_runs.WARNED}"
    assert writing.DEPTH_REPROJECTED == ("depth_reprojected.npy", "depth_reprojected_mm.png")
    assert writing.SIGMA_REPROJECTED == ("sigma_reprojected.npy", "sigma_reprojected_mm.png")
