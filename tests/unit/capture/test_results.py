"""What a capture writes, read back by COLMAP, trimesh and NumPy, from cameras of different sizes."""

import json
import sys
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin import Capture, plotting
from geodiff_plugin._internal.checks import InputError, InputFileError
from geodiff_plugin.cameras import Camera
from geodiff_plugin.capture import results
from geodiff_plugin.capture.agreement import agreed
from geodiff_plugin.capture.frames import choose_neighbours
from geodiff_plugin.capture.results import (
    FinishedFrame,
    Thresholds,
    fuse,
    kept,
    normals_of,
    write_map,
    write_mesh,
)
from geodiff_plugin.formats.clouds import flying_points
from geodiff_plugin.pose.multiview import SolvedCapture
from geodiff_plugin.types import DepthFrame
from tests.unit.capture.cameras import ES, KS, NAMES, SIZES, depth_of, frame_of, image_of, write_capture
from tests.unit.capture_room import HALF, render
from tests.views import posed_frame

K = np.array([[31.0, 0.0, 9.3], [0.0, 26.0, 12.1], [0.0, 0.0, 1.0]])


def test_normals_of_a_plane_are_its_own_towards_the_camera():
    v, u = np.mgrid[:22, :17]
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    for normal in ([0.3, -0.2, -1.0], [-0.5, 0.4, -0.8], [0.1, 0.7, -0.6]):
        unit = np.array(normal) / np.linalg.norm(normal)
        found = normals_of((-2.5 * np.linalg.norm(normal) / (rays @ normal)).astype(np.float64), Camera(K))
        assert found.dtype == np.float32 and found.shape == (22, 17, 3)
        np.testing.assert_allclose(found, np.broadcast_to(unit, found.shape), atol=1e-5)


def test_normals_and_points_reach_up_to_unknown_depth():
    """Only a pixel without a known neighbour along its row or its column has none."""
    v, u = np.mgrid[:22, :17]
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    depth = -2.5 / (rays @ normal)
    depth[10:14, 4:9] = 0
    depth[:4, 12:] = 0
    depth[1, 14] = -2.5 / (rays @ normal)[1, 14]  # alone
    known = depth > 0
    known[1, 14] = False
    found = normals_of(depth, Camera(K))
    np.testing.assert_allclose(found[known], np.broadcast_to(normal, found.shape)[known], atol=1e-5)
    assert not found[1, 14].any()
    frame = posed_frame("", depth.astype(np.float32), np.ones_like(depth), K, np.eye(4))
    np.testing.assert_array_equal(kept(frame), known & ~flying_points(depth))


def test_kept_pixels_are_sure_or_confirmed_and_never_contradicted_nor_flying():
    confidence = np.repeat(np.float32([0.49, 0.5, 0.9]), 4).reshape(3, 4)
    confirmed, observers = np.uint8([[0, 0, 1, 3]] * 3), np.uint8([[0, 2, 1, 3]] * 3)
    frame = posed_frame("", np.ones((3, 4), np.float32), confidence, K, np.eye(4))
    sure = confidence >= 0.5
    np.testing.assert_array_equal(kept(frame), sure)
    np.testing.assert_array_equal(kept(replace(frame, confirmed=confirmed)), sure)
    agreed_on = np.array([True, False, True, True])
    np.testing.assert_array_equal(
        kept(replace(frame, confirmed=confirmed, observers=observers)), sure & agreed_on
    )
    spike = np.ones((7, 9), np.float32)
    spike[3, 4] = 0.5
    found = kept(posed_frame("", spike, np.ones_like(spike), K, np.eye(4)))
    np.testing.assert_array_equal(found, spike == 1)


def doubted(number: int) -> DepthFrame:
    """A frame of which some pixels are unsure, contradicted or flying."""
    rng, frame = np.random.default_rng(number), frame_of(number)
    shape = frame.depth.shape
    frame.depth[rng.random(shape) < 0.02] *= 0.5
    confidence = rng.uniform(0.3, 1, shape).astype(np.float32)
    confirmed, observers = (rng.integers(0, 3, shape).astype(np.uint8) for _ in range(2))
    observers = np.maximum(observers, confirmed)
    sigma = (frame.depth * rng.uniform(0.01, 0.3, shape)).astype(np.float32)
    return replace(frame, confidence=confidence, confirmed=confirmed, observers=observers, sigma=sigma)


def mean_by_cell(rows: list[np.ndarray], cell: float) -> dict[tuple[int, ...], np.ndarray]:
    groups = {}
    for row in rows:
        groups.setdefault(tuple(np.floor(row[:3] / cell).astype(int)), []).append(row)
    return {at: np.mean(group, 0) for at, group in groups.items()}


def expected_cloud(frames: list[DepthFrame], every: list[int], factor: float) -> list[np.ndarray]:
    """Mean position, normal, colour and sigma of each cell, over the means of each frame."""
    cell = factor * np.median([np.median(frame.depth) for frame in frames])
    means = []
    for frame, step in zip(frames, every, strict=True):
        image, rows = image_of(NAMES.index(frame.name)), []
        normals = normals_of(frame.depth, frame.camera)
        good = (frame.confidence >= 0.5) & ~flying_points(frame.depth)
        good &= (frame.confirmed > 0) | (frame.observers == 0)
        for v, u in np.argwhere(good)[::step]:
            point = frame.camera.E @ [*np.linalg.solve(frame.camera.K, [u, v, 1]) * frame.depth[v, u], 1]
            normal = np.linalg.solve(frame.camera.E[:3, :3].T, normals[v, u])
            rows.append(np.r_[point[:3], normal, 255 * image[v, u], frame.sigma[v, u]])
        means += mean_by_cell(rows, cell).values()
    return list(mean_by_cell(means, cell).values())


def in_order(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(np.round(rows[:, :3], 6).T)]


@pytest.mark.parametrize(("most", "names"), [(200_000, ["d", "a"]), (150, NAMES)])
def test_a_fused_cloud_has_the_mean_of_every_cell(most, names, monkeypatch):
    """Also of every so many points of a frame, where it has more than a bound."""
    monkeypatch.setattr(results, "CELL_FRACTION", 0.03)
    monkeypatch.setattr(results, "MAX_POINTS", most)
    frames = {name: doubted(NAMES.index(name)) for name in names}
    counts = [int(kept(frame).sum()) for frame in frames.values()]
    every = [max(1, count // most) for count in counts]
    assert (most > 1000) == (max(every) == 1)
    cloud, normals, sigma = fuse(names, frames.__getitem__, lambda name: image_of(NAMES.index(name)))
    expected = in_order(np.array(expected_cloud(list(frames.values()), every, 0.03)))
    found = in_order(np.hstack([cloud.points_m, normals, cloud.colours, sigma[:, None]]))
    assert len(found) == len(expected) and cloud.colours.dtype == np.uint8
    np.testing.assert_allclose(found[:, :3], expected[:, :3], atol=1e-6)
    directions = expected[:, 3:6] / np.linalg.norm(expected[:, 3:6], axis=1, keepdims=True)
    np.testing.assert_allclose(found[:, 3:6], directions, atol=1e-5)
    assert np.abs(found[:, 6:9] - expected[:, 6:9]).max() < 0.51
    np.testing.assert_allclose(found[:, 9], expected[:, 9], rtol=1e-6)


@pytest.mark.parametrize("correlation", [0.0, 0.5, 1.0])
def test_the_sigma_of_a_fused_point_bounds_its_spread_for_every_correlation(correlation, monkeypatch):
    """One cell with four depths of unlike precision, fused again and again with other errors."""
    monkeypatch.setattr(results, "CELL_FRACTION", 10.0)
    monkeypatch.setattr(results, "kept", lambda frame: frame.depth > 0)
    sigma = np.float32([[0.01, 0.04], [0.02, 0.09]])
    rng, camera = np.random.default_rng(0), np.diag([50.0, 50.0, 1.0])
    together, alone = rng.normal(size=(2000, 1, 1)), rng.normal(size=(2000, 2, 2))
    errors = sigma * (np.sqrt(correlation) * together + np.sqrt(1 - correlation) * alone)
    fused = []
    for error in errors:
        frame = posed_frame("a", (3.0 + error).astype(np.float32), np.ones((2, 2)), camera, np.eye(4))
        frame = replace(frame, sigma=sigma)
        fused.append(fuse(["a"], lambda name, frame=frame: frame, lambda name: np.ones((2, 2, 3))))
    assert {len(each.cloud.points_m) for each in fused} == {1}
    np.testing.assert_allclose([each.sigma[0] for each in fused], sigma.mean(), rtol=1e-6)
    spread = np.std([each.cloud.points_m[0, 2] for each in fused])
    assert spread < 1.05 * sigma.mean() and (spread > 0.95 * sigma.mean()) == (correlation == 1)
    assert spread > 1.2 * sigma.min(), "the least sigma of a cell is no bound of a mean"


def test_a_cloud_of_the_room_lies_on_its_walls_with_their_normals_and_paint(monkeypatch):
    """However often the points of frames are merged, and in any unit."""
    frames = {name: frame_of(number, confidence=0.9) for number, name in enumerate(NAMES)}
    counts = []
    for merged_after, factor in ((20, 1.0), (1, 1.0), (3, 1.0), (20, 16.0)):
        monkeypatch.setattr(results, "MERGED_AFTER", merged_after)
        longer = np.array([[1, 1, 1, factor]] * 3 + [[1] * 4])
        scaled = {
            n: replace(f, depth=f.depth * np.float32(factor), camera=replace(f.camera, E=f.camera.E * longer))
            for n, f in frames.items()
        }
        cloud, normals, _ = fuse(NAMES, scaled.__getitem__, lambda name: image_of(NAMES.index(name)))
        points = cloud.points_m / factor
        off = np.abs(np.abs(points) - HALF)
        wall = off.argmin(1)
        assert np.median(off.min(1)) < 1e-3 and len(np.unique(wall)) == 3
        inwards = -np.sign(np.take_along_axis(points, wall[:, None], 1)[:, 0])
        right = inwards * np.take_along_axis(normals, wall[:, None], 1)[:, 0]
        assert (right > 0.99).mean() > 0.9
        counts.append(len(points))
    kept_pixels = sum(int(kept(frame).sum()) for frame in frames.values())
    assert 0.5 * kept_pixels < counts[0] <= kept_pixels
    assert max(counts) - min(counts) < 0.03 * counts[0]


def test_points_closer_than_a_cell_are_one_in_every_direction_and_on_either_side_of_0():
    """0.4 % of the median of the frames' median depths, here of 1 m."""
    rng = np.random.default_rng(0)
    rows = rng.uniform((-1, -3, 0), (1, 1, 9), (3000, 3))
    found = results._thinned(np.hstack([rows, rows**2]), 0.5)
    expected = np.array(list(mean_by_cell(np.hstack([rows, rows**2]), 0.5).values()))
    np.testing.assert_allclose(in_order(found), in_order(expected), rtol=1e-9)
    assert results._thinned(rows[:0], 0.5).shape == (0, 3)
    depth = np.full((9, 11), 1.0, np.float32)
    sizes = []
    for nearness in (1.0, 4.0):
        camera = np.diag(
            [260 * nearness, 260 * nearness, 1.0]
        )  # neighbouring pixels are 3.8 or 0.96 mm apart
        frame = posed_frame("a", depth, np.ones_like(depth), camera, np.eye(4))
        cloud, *_ = fuse(["a"], lambda name, frame=frame: frame, lambda name: np.ones((9, 11, 3)))
        sizes.append(cloud.points_m[:, :2].max(0) // 0.004 + 1)
        assert len(cloud.points_m) == len(np.unique(np.floor(cloud.points_m[:, :2] / 0.004), axis=0))
    assert (sizes[0] >= [10, 8]).all() and (sizes[1] <= [3, 3]).all()


def observed_points(count: int) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]:
    """Points of the frames' surfaces, and the pixels at which each frame sees some, with their rows."""
    rng, points, seen = np.random.default_rng(0), [], [[] for _ in NAMES]
    for row, number in enumerate(rng.integers(0, 4, count)):
        height, width = depth_of(number).shape
        u, v = rng.integers(0, width), rng.integers(0, height)
        point = ES[number] @ [*np.linalg.solve(KS[number], [u, v, 1]) * depth_of(number)[v, u], 1]
        points.append(point[:3])
        for other in range(4):
            x, y, z = KS[other] @ np.linalg.solve(ES[other], point)[:3]
            if z > 0 and 0 <= x / z <= SIZES[other][0] - 1 and 0 <= y / z <= SIZES[other][1] - 1:
                seen[other].append((row, x / z, y / z))
    observations = [(np.array(each)[:, 1:], np.array(each)[:, 0].astype(int)) for each in seen]
    observations[2][0][:2] = [
        [-0.5, -0.5],
        [SIZES[2][0] - 0.5, SIZES[2][1] - 0.5],
    ]  # outer corners of the image
    return np.array(points), observations


@pytest.fixture
def workspace(tmp_path):
    """Frames, points, observations and the folder that is written of them."""
    frames = [doubted(number) for number in range(4)]
    points, seen = observed_points(60)
    results.write_workspace(tmp_path, iter(frames), lambda name: image_of(NAMES.index(name)), points, seen)
    return frames, points, seen, tmp_path


def test_cameras_of_a_workspace_are_read_by_colmap(workspace):
    model = pytest.importorskip("pycolmap").Reconstruction(str(workspace[-1] / "sparse"))
    images = {image.name: image for image in model.images.values()}
    assert sorted(images) == [f"{name}.png" for name in NAMES]
    for name, size, K_true, E in zip(NAMES, SIZES, KS, ES, strict=True):
        found = images[f"{name}.png"]
        camera = model.cameras[found.camera_id]
        assert (camera.width, camera.height) == size
        np.testing.assert_allclose(camera.params, [*K_true.diagonal()[:2], *K_true[:2, 2] + 0.5], rtol=1e-7)
        pose = found.cam_from_world() if callable(found.cam_from_world) else found.cam_from_world
        np.testing.assert_allclose(pose.matrix(), np.linalg.inv(E)[:3], atol=1e-9)


def test_depth_for_brush_is_float32_of_the_size_of_the_image(workspace):
    frames, *_, folder = workspace
    for frame in frames:
        stored = cv2.imread(str(folder / f"depth/{frame.name}.tiff"), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.float32
        expected = np.where(results.kept(frame), frame.depth, 0).astype(np.float32)
        np.testing.assert_array_equal(stored, expected)
        assert 0 < (stored > 0).mean() < 1
        with Image.open(folder / f"images/{frame.name}.png") as image:
            assert image.size == stored.shape[::-1]


def test_points_that_two_frames_of_a_workspace_see_have_their_tracks_and_colours(workspace):
    """Points that only one frame sees are left out. The others keep their order."""
    _, points, seen, folder = workspace
    model = pytest.importorskip("pycolmap").Reconstruction(str(folder / "sparse"))
    shared = np.flatnonzero(np.bincount(np.concatenate([rows for _, rows in seen]), minlength=60) > 1)
    assert 10 < len(shared) < 55
    found = [model.points3D[number] for number in sorted(model.points3D)]
    np.testing.assert_allclose([point.xyz for point in found], points[shared], atol=1e-5)
    colours = {}
    for number, (px, rows) in enumerate(seen):
        (image,) = (image for image in model.images.values() if image.name == f"{NAMES[number]}.png")
        noticed = np.isin(rows, shared)
        observed = [point for point in image.points2D if point.has_point3D()]
        np.testing.assert_allclose([point.xy for point in observed], px[noticed] + 0.5, atol=1e-3)
        places = [model.points3D[point.point3D_id].xyz for point in observed]
        np.testing.assert_allclose(places, points[rows[noticed]], atol=1e-5)
        last = np.array(SIZES[number][::-1]) - 1
        for (x, y), row in zip(px, rows, strict=True):
            colours[row] = 255 * image_of(number)[tuple(np.clip([round(y), round(x)], 0, last))]
    for point, row in zip(found, shared, strict=True):
        assert np.abs(point.color - colours[row]).max() < 0.51
        images = [element.image_id for element in point.track.elements]
        assert len(set(images)) == len(images) == sum(row in rows for _, rows in seen)


def test_gsplat_finds_the_depth_of_points_in_every_image(workspace):
    """As ``examples/datasets/colmap.py`` of gsplat reads a folder: sparse model, images by name, tracks."""
    frames, _, _, folder = workspace
    model = pytest.importorskip("pycolmap").Reconstruction(str(folder / "sparse"))
    images = {number: model.images[number] for number in model.reg_image_ids()}
    assert sorted(image.name for image in images.values()) == sorted(
        p.name for p in (folder / "images").iterdir()
    )
    seen = {number: [] for number in images}
    for point in model.points3D.values():
        for element in point.track.elements:
            seen[element.image_id].append(point.xyz)
    for number, points in seen.items():
        image, frame = images[number], next(f for f in frames if images[number].name == f"{f.name}.png")
        T = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(T, np.linalg.inv(frame.camera.E), atol=1e-6)
        inside = T[:3, :3] @ np.reshape(points, (-1, 3)).T + T[:3, 3:]
        assert (inside[2] > 0).all()
        assert len(points) > 0


def test_maps_and_lists_of_a_workspace_are_those_of_its_frames(workspace):
    frames, _, _, folder = workspace
    for number, (name, frame) in enumerate(zip(NAMES, frames, strict=True)):
        with Image.open(folder / "images" / f"{name}.png") as rgb:
            np.testing.assert_array_equal(rgb, np.rint(255 * image_of(number)))
        depth, normals = (
            folder / f"stereo/{kind}_maps/{name}.png.geometric.bin" for kind in ("depth", "normal")
        )
        np.testing.assert_array_equal(read_colmap_map(depth), np.where(kept(frame), frame.depth, 0))
        np.testing.assert_array_equal(read_colmap_map(normals), normals_of(frame.depth, frame.camera))
    assert (folder / "stereo/fusion.cfg").read_text().split() == [f"{name}.png" for name in NAMES]
    lines = (folder / "stereo/patch-match.cfg").read_text().splitlines()
    assert lines == [line for name in NAMES for line in (f"{name}.png", "__auto__, 20")]
    assert (folder / "stereo/consistency_graphs").is_dir()


def test_a_workspace_has_no_files_of_frames_of_an_earlier_export(workspace):
    frames, points, seen, folder = workspace
    others = [folder / "images/notes.txt", folder / f"stereo/depth_maps/{NAMES[3]}.png.photometric.bin"]
    for path in others:
        path.touch()
    images = dict(zip(NAMES, map(image_of, range(4)), strict=True))
    results.write_workspace(folder, iter(frames[:2]), images.__getitem__, points, seen[:2])
    files = [path for path in folder.rglob("*") if path.is_file() and path.parent != folder / "sparse"]
    of_frames = [
        folder / file
        for name in NAMES[:2]
        for file in (
            *(f"images/{name}.png", f"depth/{name}.tiff"),
            *(f"stereo/{kind}_maps/{name}.png.geometric.bin" for kind in ("depth", "normal")),
        )
    ]
    lists = [folder / "stereo/fusion.cfg", folder / "stereo/patch-match.cfg"]
    assert sorted(files) == sorted(others + of_frames + lists)


def read_colmap_map(path) -> np.ndarray:
    """As ``scripts/python/read_write_dense.py`` of COLMAP."""
    content = path.read_bytes()
    width, height, channels, data = content.split(b"&", 3)
    shape = int(width), int(height), int(channels)
    values = np.frombuffer(data, np.float32).reshape(shape, order="F")
    return np.transpose(values, (1, 0, 2)).squeeze()


def test_maps_are_read_by_the_script_of_colmap(tmp_path):
    values = np.random.default_rng(0).normal(size=(5, 7, 3))
    write_map(tmp_path / "map.bin", values)
    np.testing.assert_array_equal(read_colmap_map(tmp_path / "map.bin"), values.astype(np.float32))


@pytest.fixture
def finished(tmp_path) -> Capture:
    """A capture whose frames have depth by their own runs in ``out``, each with errors of its own."""
    capture = Capture.open(write_capture(tmp_path / "scan"))
    off = np.diag([1.02, 0.97, 1.0]), np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 0.1
    capture.frames = [
        replace(f, camera=replace(f.camera, K=off[0] @ f.camera.K), E=off[1] @ f.E)  # before the solve
        for f in capture.frames
    ]
    points = np.random.default_rng(3).uniform((-1, -1, 1.5), (1.5, 1, 2.6), (60, 3))
    rows = [np.arange(0, 45), np.arange(10, 60), np.arange(20, 60), np.arange(5, 40)]
    seen = tuple((np.full((len(each), 2), 7.0), each) for each in rows)
    capture.solved = SolvedCapture("given", ES, ES, KS, np.ones(4, bool), points, seen)
    for number, name in enumerate(NAMES):
        rng = np.random.default_rng(number)
        depth = depth_of(number) * rng.normal(1, 0.01, depth_of(number).shape)
        depth[5:12, 6:15] *= 0.6 + 0.3 * number
        confidence = rng.uniform(0, 1, depth.shape)
        confidence[:3] = 0
        (tmp_path / "out" / name).mkdir(parents=True)
        sigma = np.where(confidence > 0, depth * rng.uniform(0.01, 0.4, depth.shape), np.nan)
        results.save_alone(tmp_path / "out" / name, depth, confidence, sigma)
    return capture


DRAW_DEPTH = plotting.depth_figure


def range_of(out) -> tuple[float, float]:
    """Ends of the colours of all frames, by every eighth pixel of each row and column."""
    maps = [[each[::8, ::8] for each in maps_of(out, name)] for name in NAMES]
    values = np.concatenate([depth[confidence > 0] for depth, confidence, *_ in maps])
    return tuple(np.percentile(values, (2, 98)))


@pytest.fixture
def plain_figures(monkeypatch):
    """Figures of depth take most of the time of a run. Other tests look at them."""
    monkeypatch.setattr(plotting, "depth_figure", lambda depth, *_, **__: Image.new("RGB", (8, 6)))


def alone(out, number: int) -> DepthFrame:
    depth, confidence, sigma = (
        np.load(out / NAMES[number] / f"{kind}_alone.npy") for kind in ("depth", "confidence", "sigma")
    )
    return replace(posed_frame(NAMES[number], depth, confidence, KS[number], ES[number]), sigma=sigma)


def test_agreement_of_finished_frames_is_written_and_its_fractions_match_the_files(finished, tmp_path):
    """Only frames of the run take part."""
    out, run = tmp_path / "out", ["d", "a", "c"]
    fractions = results.write_agreement(finished, out, run)
    assert list(fractions) == run
    for name in run:
        number = NAMES.index(name)
        near = choose_neighbours(finished.solved, number, 9, [NAMES.index(other) for other in run])
        expected = agreed(alone(out, number), [alone(out, other) for other in near])
        maps = [
            np.load(out / name / f"{kind}.npy") for kind in ("depth", "confidence", "confirmed", "observers")
        ]
        for found, values in zip(
            maps, (expected.depth, expected.confidence, expected.confirmed, expected.observers), strict=True
        ):
            np.testing.assert_array_equal(found, values)
        _, _, confirmed, observers = maps
        np.testing.assert_array_equal(np.load(out / name / "sigma.npy"), expected.sigma)
        sigma_mm = np.asarray(Image.open(out / name / "sigma_mm.png"))
        np.testing.assert_array_equal(sigma_mm == 0, np.isnan(expected.sigma))
        assert fractions[name]["checked_against"] == len(near) == 2
        assert fractions[name]["confirmed"] == pytest.approx(np.mean(confirmed > 0), abs=6e-5)
        assert fractions[name]["unconfirmed"] == pytest.approx(
            np.mean((observers > 0) & (confirmed == 0)), abs=6e-5
        )
        assert all(round(fraction, 4) == fraction for fraction in fractions[name].values())
        assert 0.001 < fractions[name]["unconfirmed"] < fractions[name]["confirmed"] < 0.95
        whole = np.asarray(Image.open(out / name / "depth_mm.png"))
        np.testing.assert_array_equal(whole == 0, maps[1] == 0)
        assert np.abs(whole - 1000.0 * maps[0])[whole > 0].max() < 0.51 and (whole == 0).any()
        drawn = plotting.depth_figure(maps[0], *np.percentile(maps[0][maps[1] > 0], (2, 98)), unit="m")
        np.testing.assert_array_equal(np.asarray(Image.open(out / name / "depth.png")), np.asarray(drawn))
    assert not (out / "b" / "depth.npy").exists()


def test_a_frame_is_checked_against_six_others_at_most(finished, tmp_path, monkeypatch):
    counts = []
    monkeypatch.setattr(
        results,
        "choose_neighbours",
        lambda solved, frame, most, among: counts.append((frame, most, among)) or [],
    )
    assert results.write_agreement(finished, tmp_path / "out", ["b", "c"])["c"]["checked_against"] == 0
    assert counts == [(1, 6, {1, 2}), (2, 6, {1, 2})]


def test_depth_without_a_confidence_is_half_sure(tmp_path):
    depth = np.random.default_rng(0).uniform(1, 2, (4, 6))
    results.save_alone(tmp_path, depth, None, None)
    assert np.isnan(np.load(tmp_path / "sigma_alone.npy")).all()
    np.testing.assert_array_equal(np.load(tmp_path / "depth_alone.npy"), depth.astype(np.float32))
    assert (np.load(tmp_path / "confidence_alone.npy") == 0.5).all()
    assert np.load(tmp_path / "confidence_alone.npy").dtype == np.float32


def test_a_cleared_frame_keeps_the_files_of_others(tmp_path):
    ours = "depth_alone confidence_alone sigma_alone depth confidence sigma confirmed observers"
    for extra, left in (("notes.txt", True), (None, False)):
        folder = tmp_path / "a"
        folder.mkdir(exist_ok=True)
        for name in [
            *(f"{file}.npy" for file in ours.split()[: 8 if left else 7]),
            "sigma_mm.png",
            "depth_mm.png",
            "depth.png",
            "cloud.ply",
            *filter(None, [extra]),
        ]:
            (folder / name).write_text("")
        (folder / "report.json").write_text(json.dumps({"files": {"names": ["cloud.ply"]}}))
        results.clear_frame(folder)
        assert folder.exists() == left
        if left:
            assert [path.name for path in folder.iterdir()] == [extra]
            (folder / extra).unlink()


def finished_video(folder):
    """Five finished frames of the room in two scenes, their images, and their true depth."""
    camera, size = np.array([[150.0, 0, 84.0], [0, 132.0, 68.0], [0, 0, 1]]), (170, 128)
    images, frames, ground_truths = [], [], []
    for i in range(5):
        turn, E = [10 + i, 15 - 2 * i + 180 * (i > 1), 20 + 3 * i], np.eye(4)
        E[:3, :3] = Rotation.from_euler("xyz", turn, degrees=True).as_matrix()
        E[:3, 3] = 0.07 * i - 0.1, 0.04 * (i % 2), -0.3
        image, depth = render(E, size, camera)
        images.append(image.astype(np.float32) / 255)
        ground_truths.append(depth)
        frames.append(FinishedFrame(folder / f"f{i}", camera, "m"))
        frames[-1].folder.mkdir()
        np.save(frames[-1].folder / "depth.npy", (depth * (1 + 0.01 * (-1) ** i)).astype(np.float32))
        if i:
            confidence = np.full(depth.shape, 0.1 + 0.2 * i, np.float32)
            np.save(frames[-1].folder / "confidence.npy", confidence)
    return frames, images, ground_truths


def test_finished_frames_of_a_video_are_smoothed_and_the_same_call_again_changes_nothing(
    plain_figures, tmp_path
):
    """Depth by a run is kept on first use. The second scene has a frame more than the first."""
    frames, images, ground_truths = finished_video(tmp_path)
    before = [np.load(frame.folder / "depth.npy") for frame in frames]
    written_maps = []
    for i, (scene, maps) in enumerate(results.write_smoothed(frames, images.__getitem__)):
        assert scene == (i > 1)
        written_maps.append(maps)
    temporal_smoothing = [np.load(frame.folder / "depth.npy") for frame in frames]
    for i, frame in enumerate(frames):
        for name in ("depth", "confidence", "sigma", "confirmed", "observers"):
            np.testing.assert_array_equal(
                np.load(frame.folder / f"{name}.npy"), getattr(written_maps[i], name)
            )
        np.testing.assert_array_equal(np.load(frame.folder / "depth_alone.npy"), before[i])
        sure = np.load(frame.folder / "confidence_alone.npy")
        np.testing.assert_array_equal(sure, np.full(sure.shape, 0.1 + 0.2 * i if i else 0.5, np.float32))
        middle = slice(40, 90), slice(50, 120)
        off = [
            np.abs(depth / ground_truths[i] - 1)[middle].mean()
            for depth in (temporal_smoothing[i], before[i])
        ]
        assert off[0] < 0.8 * off[1]
        assert np.median(np.load(frame.folder / "observers.npy")[middle]) == (1 if i < 2 else 2)
    list(results.write_smoothed(frames, images.__getitem__))
    for frame, depth in zip(frames, temporal_smoothing, strict=True):
        np.testing.assert_array_equal(np.load(frame.folder / "depth.npy"), depth)


def test_depths_that_are_not_reliable_after_smoothing_are_removed(plain_figures, tmp_path):
    """A wrong depth with a small sigma is replaced by its neighbours', whose sigma is above the limit."""
    frames, images, _ = finished_video(tmp_path)
    limits = Thresholds(min_confidence=0.2, max_sigma=0.05)
    blob = slice(50, 80), slice(60, 100)
    for frame in frames:
        depth = np.load(frame.folder / "depth.npy")
        np.save(frame.folder / "sigma.npy", np.full_like(depth, 0.04))
        np.save(frame.folder / "confidence.npy", np.full_like(depth, 0.6))
    depth = np.load(frames[3].folder / "depth.npy")
    depth[blob] *= 1.5
    confidence = np.full_like(depth, 0.6)
    confidence[blob] = 0.4  # the neighbours have more weight
    np.save(frames[3].folder / "depth.npy", depth)
    np.save(frames[3].folder / "confidence.npy", confidence)

    def above(frame):
        depth, sigma = (np.load(frame.folder / f"{name}.npy") for name in ("depth", "sigma"))
        return (depth > 0) & ~(sigma <= limits.max_sigma)

    list(results.write_smoothed(frames, images.__getitem__))
    assert above(frames[3])[blob].mean() > 0.9, "smoothing alone violates the limit"
    kept = [~above(frame) for frame in frames]
    list(results.write_smoothed(frames, images.__getitem__, limits))
    for frame, mask in zip(frames, kept, strict=True):
        maps = {name: np.load(frame.folder / f"{name}.npy") for name in ("depth", "confidence", "sigma")}
        np.testing.assert_array_equal(maps["depth"] > 0, mask)
        np.testing.assert_array_equal(maps["confidence"] > 0, mask)
        np.testing.assert_array_equal(np.isnan(maps["sigma"]), ~mask)
        assert (maps["confidence"][mask] >= limits.min_confidence).all()
        for name in ("depth_mm", "sigma_mm"):
            assert not np.asarray(Image.open(frame.folder / f"{name}.png"))[~mask].any()
        assert (np.load(frame.folder / "depth_alone.npy") > 0).all(), "it is read again"


def written(capture: Capture, tmp_path, export=(), not_trusted=()):
    out = tmp_path / "out"
    results.write_agreement(capture, out, NAMES)
    return out, results.write_results(capture, out, NAMES, export, not_trusted, None)


@pytest.mark.parametrize("not_trusted", [["b"], NAMES])
def test_the_cloud_of_a_capture_is_read_by_trimesh_with_its_cameras(
    not_trusted, finished, plain_figures, tmp_path
):
    """Of a frame that is not trusted only confirmed pixels count, unless no frame is trusted."""
    out, counts = written(finished, tmp_path, (), not_trusted)
    frames = {}
    for number, name in enumerate(NAMES):
        depth, confidence, confirmed, observers, sigma = (
            np.load(out / name / f"{m}.npy")
            for m in ("depth", "confidence", "confirmed", "observers", "sigma")
        )
        observers = np.ones_like(observers) if not_trusted == [name] else observers
        frame = posed_frame(name, depth, confidence, KS[number], ES[number], confirmed, observers)
        frames[name] = replace(frame, sigma=sigma)
    cloud, normals, sigma = fuse(NAMES, frames.__getitem__, finished.image)
    read = trimesh.load(out / "cloud.ply", process=False)
    assert counts == {"cloud_points": len(cloud.points_m)}
    np.testing.assert_allclose(read.vertices, cloud.points_m, atol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], cloud.colours)
    data = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(np.stack([data[n] for n in ("nx", "ny", "nz")], -1), normals, atol=1e-6)
    assert np.isfinite(sigma).all() and np.array_equal(data["sigma"], sigma.astype(np.float32))
    assert b"comment world frame, metres" in (out / "cloud.ply").read_bytes()[:200]
    scene = trimesh.load(out / "cloud.glb")
    shown = [g for g in scene.dump() if isinstance(g, trimesh.PointCloud)]
    assert sum(len(g.vertices) for g in shown) == len(cloud.points_m)
    pyramids = {name: g for name, g in scene.geometry.items() if not isinstance(g, trimesh.PointCloud)}
    assert sorted(pyramids) == [f"camera {number}" for number in range(4)]
    for number in range(4):
        pyramid = pyramids[f"camera {number}"]
        # OpenGL's axes. The corners at one depth are those of the image, (-0.5, -0.5) to (W - 0.5, H - 0.5).
        corners = np.unique(np.round(np.asarray(pyramid.vertices) * [1, -1, -1], 6), axis=0)
        seen = np.c_[corners, np.ones(5)] @ np.linalg.inv(ES[number]).T[:, :3]
        apex = np.argmin(np.abs(seen).sum(1))
        assert np.abs(seen[apex]).max() < 1e-4
        pixels = np.delete(seen, apex, 0) @ KS[number].T
        pixels = pixels[:, :2] / pixels[:, 2:]
        width, height = SIZES[number]
        expected = [[-0.5, -0.5], [-0.5, height - 0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5]]
        np.testing.assert_allclose(sorted(pixels.round(2).tolist()), expected, atol=0.02)


def test_exports_are_written_on_demand_from_the_agreed_frames(finished, plain_figures, tmp_path):
    out, _ = written(finished, tmp_path, ("colmap", "nerfstudio"))
    assert (out / "colmap/sparse/points3D.txt").is_file() and not (out / "mesh.ply").exists()
    data = json.loads((out / "nerfstudio/transforms.json").read_text())
    for number, (name, entry) in enumerate(zip(NAMES, data["frames"], strict=True)):
        maps = [np.load(out / name / f"{m}.npy") for m in ("depth", "confidence", "confirmed", "observers")]
        use = kept(posed_frame(name, *maps[:2], KS[number], ES[number], *maps[2:]))
        units = np.asarray(Image.open(out / "nerfstudio" / entry["depth_file_path"]))
        np.testing.assert_array_equal(units > 0, use)
        np.testing.assert_allclose(units[use], 1000 * maps[0][use], atol=0.51)
        depth = read_colmap_map(out / "colmap/stereo/depth_maps" / f"{name}.png.geometric.bin")
        np.testing.assert_array_equal(depth, np.where(use, maps[0], 0))


THRESHOLDS = Thresholds(0.6, 0.3)
OF_A_FRAME = ("depth", "confidence", "sigma", "confirmed", "observers")


def maps_of(out, name: str) -> list[np.ndarray]:
    return [np.load(out / name / f"{file}.npy") for file in OF_A_FRAME]


def test_holes_are_where_the_agreed_depth_is_not_reliable(finished, plain_figures, tmp_path):
    """A depth that others confirm is kept, although its frame alone was not sure of it."""
    out = tmp_path / "out"
    whole_fractions = results.write_agreement(finished, out, NAMES)
    whole = {name: maps_of(out, name) for name in NAMES}
    fractions = results.write_agreement(finished, out, NAMES, THRESHOLDS)
    rescued = 0
    for number, name in enumerate(NAMES):
        depth, confidence, sigma, *counts = whole[name]
        mask = (confidence >= 0.6) & (sigma <= 0.3)
        assert 0.1 < mask.mean() < 0.9
        rescued += (mask & (alone(out, number).confidence < 0.6)).sum()
        found = maps_of(out, name)
        for values, before in zip(found, (depth, confidence, None, *counts), strict=True):
            if before is not None:
                np.testing.assert_array_equal(values, np.where(mask, before, 0))
        np.testing.assert_array_equal(found[2], np.where(mask, sigma, np.nan))
        for file in ("depth_mm.png", "sigma_mm.png"):
            assert not np.asarray(Image.open(out / name / file))[~mask].any()
        assert fractions[name]["confirmed"] < whole_fractions[name]["confirmed"]
        assert [values.dtype for values in found] == [values.dtype for values in whole[name]]
    assert rescued > 100


def in_frame(points: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of points in a frame, for those inside."""
    seen = (points - ES[number][:3, 3]) @ ES[number][:3, :3] @ KS[number].T
    column, row = np.rint(seen[:, :2] / seen[:, 2:]).astype(int).T
    width, height = SIZES[number]
    inside = (seen[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
    return row[inside], column[inside]


@pytest.mark.parametrize("holes", [None, THRESHOLDS])
def test_clouds_and_exports_have_reliable_depths_only(holes, finished, plain_figures, tmp_path):
    out = tmp_path / "out"
    results.write_agreement(finished, out, ["b"], holes)
    exports = ("colmap", "nerfstudio")
    every = results.write_results(finished, out, ["b"], exports, [], None)["cloud_points"]
    counts = results.write_results(finished, out, ["b"], exports, [], None, THRESHOLDS)
    assert counts["cloud_points"] > 100 and (counts["cloud_points"] < every or holes is not None)
    depth, confidence, sigma, *_ = maps_of(out, "b")
    mask = (confidence >= 0.6) & (sigma <= 0.3)
    number = NAMES.index("b")
    at = in_frame(trimesh.load(out / "cloud.ply", process=False).vertices, number)
    assert len(at[0]) > 100 and mask[at].mean() > 0.9  # a point is the mean of a cell
    written_depth = read_colmap_map(out / "colmap/stereo/depth_maps/b.png.geometric.bin")
    units = np.asarray(Image.open(out / "nerfstudio/depths/b.png"))
    for values in (written_depth, units):
        assert (values > 0).sum() > 100 and not values[~mask].any()


@pytest.mark.filterwarnings("error")
def test_a_capture_without_any_reliable_depth_has_an_empty_cloud(finished, plain_figures, tmp_path):
    out, none = tmp_path / "out", Thresholds(max_sigma=1e-6)
    results.write_agreement(finished, out, NAMES, none)
    exports = ("colmap", "nerfstudio")
    assert results.write_results(finished, out, NAMES, exports, [], None, none) == {"cloud_points": 0}
    assert not np.load(out / "b/depth.npy").any() and (out / "sheet.jpg").is_file()


def test_the_sheet_has_every_frame_and_its_depth_and_marks_those_that_are_not_trusted(
    finished, tmp_path, monkeypatch
):
    """All depth is drawn in the colours of one range, also if frames have different sizes."""
    sheets, grid = [], plotting.grid
    monkeypatch.setattr(
        plotting,
        "grid",
        lambda cells, titles, **how: sheets.append((cells, titles)) or grid(cells, titles, **how),
    )
    out, _ = written(finished, tmp_path, not_trusted=["c"])
    ((cells, titles),) = sheets
    assert titles == ["a", "depth", "b", "depth", "c", "depth, not trusted", "d", "depth"]
    for number, name in enumerate(NAMES):
        np.testing.assert_allclose(cells[2 * number], image_of(number), atol=1e-6)
        drawn = plotting.depth_figure(np.load(out / name / "depth.npy"), *range_of(out), unit="m")
        np.testing.assert_array_equal(np.asarray(cells[2 * number + 1]), np.asarray(drawn))
    with Image.open(out / "sheet.jpg") as sheet:
        assert sheet.size == grid(cells, titles, columns=4, cell_width=360).size
    results._sheet(finished, out, ["b"], [], (1.0, 2.0))
    with Image.open(out / "sheet.jpg") as sheet:
        assert sheet.size == grid(*sheets[-1], columns=2, cell_width=360).size
    drawn, names, ends = [], [f"{i:02d}" for i in range(60)], (1.5, 300.0)
    depths = np.random.default_rng(0).uniform(1, 9, (60, 8, 10)).astype(np.float32)
    for name, depth in zip(names, depths, strict=True):
        (tmp_path / name).mkdir()
        np.save(tmp_path / name / "depth.npy", depth * (1 + int(name)))
    monkeypatch.setattr(finished, "image", lambda name: np.full((8, 10, 3), int(name) / 60))
    monkeypatch.setattr(
        plotting,
        "depth_figure",
        lambda *given, unit: drawn.append((*given, unit)) or Image.new("RGB", (8, 6)),
    )
    results._sheet(finished, tmp_path, names, [], ends)
    shown = sheets[-1][1][::2]
    assert len(shown) == 24 and shown[0] == "00" and shown[-1] == "59"
    assert set(np.diff([int(name) for name in shown])) == {2, 3}
    assert len(sheets[-1][0]) == 48 and {given[1:] for given in drawn} == {(*ends, "m")}
    for name, (depth, *_) in zip(shown, drawn, strict=True):
        np.testing.assert_array_equal(depth, np.load(tmp_path / name / "depth.npy"))


def test_the_video_shows_images_next_to_depth_in_the_colours_of_one_range(
    finished, plain_figures, tmp_path, monkeypatch
):
    """All frames have one size, whatever the size of their images, and a bar in metres."""
    videos = []
    monkeypatch.setattr(plotting, "depth_figure", DRAW_DEPTH)
    monkeypatch.setattr(
        plotting, "write_depth_video", lambda path, frames, fps: videos.append((path, list(frames), fps))
    )
    out, _ = written(finished, tmp_path)
    ((path, frames, fps),) = videos
    assert path == out / "video.mp4" and fps == 5 and len(frames) == 4
    maps = [np.load(out / name / "depth.npy") for name in NAMES]
    near, far = range_of(out)
    for number, frame in enumerate(frames):
        assert frame.size == (1280, 480)
        drawn = DRAW_DEPTH(maps[number], near, far, unit=finished.unit)
        width, height = SIZES[number]
        photo = Image.fromarray(np.rint(255 * image_of(number)).astype(np.uint8))
        photo = photo.resize((round(width * drawn.height / height), drawn.height))
        pair = np.hstack([photo, drawn])
        assert pair.shape[1] > 2 * photo.width, "with a bar"
        scale = min(1280 / pair.shape[1], 480 / pair.shape[0])
        size = round(pair.shape[1] * scale), round(pair.shape[0] * scale)
        shown = np.asarray(Image.fromarray(pair).resize(size, Image.BICUBIC))
        left, top = (1280 - shown.shape[1]) // 2, (480 - shown.shape[0]) // 2
        inside = np.asarray(frame)[top : top + shown.shape[0], left : left + shown.shape[1]]
        assert np.abs(inside.astype(int) - shown).mean() < 4


def test_colours_of_all_frames_end_at_the_farthest_measured_depth(finished, plain_figures, tmp_path):
    """A sky, which is too far to be measured, and depths without confidence do not stretch them."""
    out = tmp_path / "out"
    for number, name in enumerate(NAMES):
        (out / name / "report.json").write_text(json.dumps({"measurable_m": 20.0 + number}))
        depth, confidence = (np.load(out / name / f"{kind}_alone.npy") for kind in ("depth", "confidence"))
        depth[:20], confidence[:20] = 500.0, 0.2
        depth[20:24], confidence[20:24] = 20.0 + number + 0.5, 0.9
        results.save_alone(out / name, depth, confidence, np.full_like(depth, 0.1))
    results.write_agreement(finished, out, NAMES)
    near, far = results.common_range([out / name for name in NAMES])
    measured = []
    for number, name in enumerate(NAMES):
        depth, confidence, *_ = (each[::8, ::8] for each in maps_of(out, name))
        measured.append(depth[(confidence > 0) & (depth < 20.0 + number)])
    assert far < 10 and (np.load(out / "d/depth.npy") > 400).mean() > 0.3
    np.testing.assert_allclose((near, far), np.percentile(np.concatenate(measured), (2, 98)))
    assert results.common_range([out / name for name in NAMES], near=0.5) == (0.5, far)
    for report in ("{}", '{"measurable_m": "far"}'):  # by an earlier version, or by another program
        for name in NAMES:
            (out / name / "report.json").write_text(report)
        assert results.common_range([out / name for name in NAMES])[1] > 400
    path = out / NAMES[1] / "confidence.npy"
    np.save(path, np.ones((3, 4), np.float32))
    with pytest.raises(InputError, match=r"confidence.npy must be of shape .* like depth.npy; got \(3, 4\)"):
        results.common_range([out / name for name in NAMES])
    path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(InputError, match=r"confidence.npy cannot be read \(.*\). Delete its folder"):
        results.common_range([out / name for name in NAMES])


def test_the_colours_of_a_frame_end_at_its_farthest_measured_depth(finished, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        plotting, "depth_figure", lambda *given, unit: drawn.append(given) or Image.new("RGB", (8, 6))
    )
    depth = np.full((40, 50), 3.0, np.float32)
    depth[:10], depth[10:14], depth[14:30] = 600.0, 80.0, np.linspace(1, 5, 50)
    confidence = np.full_like(depth, 0.8)
    confidence[:10] = 0.0
    folder = tmp_path / "f0"
    folder.mkdir()
    (folder / "report.json").write_text('{"measurable_m": 70.0}')
    results.save_alone(folder, depth, confidence, np.full_like(depth, 0.1))
    image = np.random.default_rng(0).random((40, 50, 3), np.float32)
    list(results.write_smoothed([FinishedFrame(folder, KS[0], "m")], lambda i: image))
    ((_, near, far),) = drawn
    np.testing.assert_allclose((near, far), np.percentile(depth[14:], (2, 98)))
    (folder / "report.json").write_text('{"measurable_m": 0.5}')  # nothing can be measured
    list(results.write_smoothed([FinishedFrame(folder, KS[0], "m")], lambda i: image))
    np.testing.assert_allclose(drawn[-1][1:], np.percentile(depth, (2, 98)))


class StandInGrid:
    """Stands in for ``VoxelBlockGrid`` of Open3D: its mesh has the points of the depth maps.

    As there, poses are world-to-camera, depth is divided by a scale, and what is beyond a bound is left out.
    """

    made = []

    def __init__(self, names, types, channels, voxel, block, blocks):
        assert (names, channels) == (("tsdf", "weight", "color"), ((1,), (1,), (3,)))
        assert len(types) == 3 and block == 16 and blocks >= 1000
        self.voxel, self.points, self.colours = voxel, [], []
        StandInGrid.made.append(self)

    def compute_unique_block_coordinates(self, depth, K, T, scale, most):
        return depth.tobytes(), K.tobytes(), T.tobytes(), scale, most

    def integrate(self, blocks, depth, colour, K_depth, K_colour, T, scale, most):
        assert blocks == (depth.tobytes(), K_depth.tobytes(), T.tobytes(), scale, most)
        assert depth.dtype == colour.dtype == np.float32 and K_depth.dtype == T.dtype == np.float64
        np.testing.assert_array_equal(K_depth, K_colour)
        rows, columns = np.nonzero((depth[..., 0] > 0) & (depth[..., 0] / scale < most))
        for v, u in zip(rows, columns, strict=True):
            point = np.linalg.solve(K_depth, [u, v, 1]) * depth[v, u, 0] / scale
            self.points.append(np.linalg.solve(T, [*point, 1])[:3])
            self.colours.append(colour[v, u])

    def extract_triangle_mesh(self, weight_threshold):
        assert 0 < weight_threshold < 1  # what one frame has seen counts
        return self

    def to_legacy(self):
        return self

    def compute_vertex_normals(self):
        self.has_normals = True


def test_a_mesh_is_made_of_the_kept_pixels_of_all_frames_by_their_own_cameras(tmp_path, monkeypatch):
    """By a stand-in for Open3D, which is large."""
    core = SimpleNamespace(Tensor=np.asarray, float32=np.float32)
    tensors = SimpleNamespace(geometry=SimpleNamespace(VoxelBlockGrid=StandInGrid, Image=np.asarray))

    def write(path: str, mesh: StandInGrid) -> None:
        assert path.endswith(".ply") and mesh.has_normals
        trimesh.PointCloud(mesh.points, np.rint(255 * np.array(mesh.colours)).astype(np.uint8)).export(path)

    io = SimpleNamespace(write_triangle_mesh=write)
    monkeypatch.setitem(sys.modules, "open3d", SimpleNamespace(core=core, t=tensors, io=io))
    frames = {name: doubted(number) for number, name in enumerate(NAMES)}
    frames[NAMES[0]].confidence[:] = 0  # a frame without depth, which Open3D would reject
    write_mesh(tmp_path / "mesh.ply", NAMES, frames.__getitem__, lambda name: image_of(NAMES.index(name)))
    points, colours = [], []
    for number, frame in enumerate(frames.values()):
        points.append(frame.world()[kept(frame)])
        colours.append(255 * image_of(number)[kept(frame)])
    found = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_allclose(found.vertices, np.concatenate(points), atol=1e-5)
    assert np.abs(found.colors[:, :3] - np.concatenate(colours)).max() < 0.51
    median = np.median([np.median(frame.depth) for frame in frames.values()])
    assert StandInGrid.made[-1].voxel == pytest.approx(0.004 * median, rel=1e-6)


def test_a_video_that_cannot_be_written_is_warned_of(finished, plain_figures, tmp_path, monkeypatch):
    """Everything else is there."""

    def raise_input_error(*_: object) -> None:
        raise InputFileError("No codec.")

    monkeypatch.setattr(plotting, "write_depth_video", raise_input_error)
    with pytest.warns(UserWarning, match="No codec") as caught:
        out, counts = written(finished, tmp_path)
    assert [warning.message.args[0].code for warning in caught] == ["capture.no-video"]
    assert counts["cloud_points"] > 0 and (out / "sheet.jpg").is_file()


def test_a_mesh_of_different_cameras_lies_on_the_walls(tmp_path):
    open3d = pytest.importorskip("open3d")
    frames = {name: frame_of(number, confidence=0.9) for number, name in enumerate(NAMES)}
    write_mesh(tmp_path / "mesh.ply", NAMES, frames.__getitem__, lambda name: image_of(NAMES.index(name)))
    corners = np.asarray(open3d.io.read_triangle_mesh(str(tmp_path / "mesh.ply")).vertices)
    off = np.abs(np.abs(corners) - HALF).min(1)
    assert len(corners) > 1000 and np.median(off) < 0.01 and np.quantile(off, 0.9) < 0.05
