"""Clouds and meshes against a pixel-by-pixel reference, and as trimesh reads their files back."""

import json
import struct

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal import strips as _strips
from geodiff_plugin.cameras import PosedCamera
from geodiff_plugin.formats import clouds
from geodiff_plugin.formats.clouds import (
    Cloud,
    camera_pyramid,
    flying_points,
    in_8_bits,
    make_cloud,
    make_mesh,
    write_glb,
    write_ply,
    write_vertices,
)

trimesh = pytest.importorskip("trimesh")

H, W = 13, 17
K = np.array([[21.0, 0, 7.25], [0, 18.5, 5.5], [0, 0, 1]])
RNG = np.random.default_rng(11)
DEPTH = RNG.uniform(1.0, 5.0, (H, W))
DEPTH[2, 3], DEPTH[4, 9], DEPTH[7, 0], DEPTH[12, 16] = np.nan, 0.0, -2.0, np.inf
IMAGE = RNG.random((H, W, 3))
VALID = RNG.random((H, W)) > 0.2


def reference(depth_m, image, valid):
    """Points and colours pixel by pixel."""
    points, colours = [], []
    for v in range(depth_m.shape[0]):
        for u in range(depth_m.shape[1]):
            z = depth_m[v, u]
            if np.isfinite(z) and z > 0 and (valid is None or valid[v, u]):
                points.append(((u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z))
                colours.append(np.round(image[v, u] * 255))
    return np.array(points), np.array(colours)


@pytest.mark.parametrize("valid", [None, VALID], ids=["all", "masked"])
@pytest.mark.parametrize("strip", [3, 1 << 20])
def test_a_cloud_has_the_point_and_the_colour_of_every_known_pixel_in_order(
    valid, strip, monkeypatch, tmp_path
):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", strip * W, raising=True)
    points, colours = reference(DEPTH, IMAGE, valid)
    cloud = make_cloud(DEPTH, IMAGE, K, valid)
    np.testing.assert_allclose(cloud.points_m, points, rtol=1e-12)
    np.testing.assert_array_equal(cloud.colours, colours)
    assert cloud.points_m.dtype == np.float64 and cloud.colours.dtype == np.uint8
    bytes_01 = (IMAGE * 255).astype(np.uint8)
    np.testing.assert_array_equal(
        make_cloud(DEPTH, bytes_01, K, valid).colours, reference(DEPTH, bytes_01 / 255, valid)[1]
    )
    assert write_ply(tmp_path / "c.ply", DEPTH, IMAGE, K, valid) == len(points)
    read = trimesh.load(tmp_path / "c.ply", process=False)
    np.testing.assert_allclose(read.vertices, points, rtol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], colours)


def test_a_ply_states_its_frame_and_its_unit(tmp_path):
    for unit, word in (("m", "metres"), (None, "no unit")):
        write_ply(tmp_path / "c.ply", DEPTH, IMAGE, K, unit=unit)
        head = (tmp_path / "c.ply").read_bytes().partition(b"end_header")[0].decode()
        assert head.splitlines()[2] == f"comment camera frame: x right, y down, z forward, {word}"
    assert write_ply(tmp_path / "c.ply", DEPTH, IMAGE, K) == len(reference(DEPTH, IMAGE, None)[0])
    assert b"metres" in (tmp_path / "c.ply").read_bytes()[:120], "metres unless told otherwise"


def test_vertices_with_further_numbers_come_back_part_after_part(tmp_path):
    """Normals between points and colours, in parts of several lengths."""
    points, normals = RNG.normal(size=(2, 9, 3))
    colours = RNG.integers(0, 255, (9, 3), np.uint8)
    parts = [(points[a:b], normals[a:b], colours[a:b]) for a, b in ((0, 4), (4, 4), (4, 9))]
    names = ("x", "y", "z", "nx", "ny", "nz", "red", "green", "blue")
    write_vertices(tmp_path / "v.ply", "world", "m", 9, names, parts)
    read = trimesh.load(tmp_path / "v.ply", process=False)
    np.testing.assert_allclose(read.vertices, points, rtol=1e-6)
    np.testing.assert_array_equal(read.colors[:, :3], colours)
    raw = read.metadata["_ply_raw"]["vertex"]["data"]
    np.testing.assert_allclose(
        np.stack([raw[name] for name in ("nx", "ny", "nz")], axis=-1), normals, rtol=1e-6
    )


def test_a_ply_has_the_sigma_of_every_point_after_its_colours(tmp_path):
    sigma_m = RNG.uniform(0.01, 0.2, DEPTH.shape).astype(np.float32)
    count = write_ply(tmp_path / "c.ply", DEPTH, IMAGE, K, VALID, sigma_m=sigma_m)
    vertex = plyfile_like(tmp_path / "c.ply")
    assert vertex.dtype.names == ("x", "y", "z", "red", "green", "blue", "sigma") and len(vertex) == count
    known = np.isfinite(DEPTH) & (DEPTH > 0) & VALID
    np.testing.assert_array_equal(vertex["sigma"], sigma_m[known])
    np.testing.assert_array_equal(vertex["z"], DEPTH[known].astype(np.float32))
    read = trimesh.load(tmp_path / "c.ply", process=False)
    np.testing.assert_allclose(read.vertices[:, 2], DEPTH[known], rtol=1e-6)
    np.testing.assert_array_equal(
        read.metadata["_ply_raw"]["vertex"]["data"]["sigma"].ravel(), sigma_m[known]
    )


def plyfile_like(path):
    """The vertices as a record array, from the header's own types and order, as plyfile reads them."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    types = {"float": "<f4", "uchar": "u1"}
    words = [line.split() for line in head.decode().splitlines()]
    row = np.dtype([(name, types[kind]) for first, kind, name in (w for w in words if w[0] == "property")])
    return np.frombuffer(body, row)


def test_colours_in_8_bits_are_rounded_and_clipped():
    levels = np.arange(256)
    image = np.stack([levels / 255, (levels + 0.4) / 255, (levels - 0.4) / 255], axis=-1)[None]
    np.testing.assert_array_equal(in_8_bits(image), np.clip(np.stack([levels] * 3, axis=-1), 0, 255)[None])
    outside = np.array([[[-0.5, 1.5, 0.5]]])
    assert in_8_bits(outside).tolist() == [[[0, 255, 128]]]


@pytest.mark.parametrize(
    ("count", "most", "expected"), [(10, 4, [0, 3, 6, 9]), (10, 10, range(10)), (3, 9, range(3))]
)
def test_a_thinned_cloud_keeps_both_ends_and_every_point_its_colour(count, most, expected):
    cloud = Cloud(
        np.arange(3.0 * count).reshape(count, 3), np.arange(3 * count, dtype=np.uint8).reshape(count, 3)
    )
    thinned = cloud.thinned(most)
    np.testing.assert_array_equal(thinned.points_m, cloud.points_m[list(expected)])
    np.testing.assert_array_equal(thinned.colours, cloud.colours[list(expected)])


def test_flying_points_have_fewer_than_three_neighbours_within_four_per_cent_of_the_nearer(monkeypatch):
    monkeypatch.setattr(_strips, "STRIP_PIXELS", 20)
    depth = np.exp(np.cumsum(RNG.normal(0, 0.03, (9, 14)), axis=1)).astype(np.float32)
    depth[3, 5], depth[0, 0], depth[6, 2] = np.nan, 0, -1
    expected = np.zeros(depth.shape, bool)
    known = np.isfinite(depth) & (depth > 0)
    for v, u in np.argwhere(known):
        around = [
            depth[y, x]
            for y in range(max(v - 1, 0), min(v + 2, 9))
            for x in range(max(u - 1, 0), min(u + 2, 14))
            if (y, x) != (v, u) and known[y, x]
        ]
        near = [abs(z - depth[v, u]) <= 0.04 * min(z, depth[v, u]) for z in around]
        expected[v, u] = sum(near) < 3
    assert 20 < expected.sum() < 100
    np.testing.assert_array_equal(flying_points(depth), expected)


def pose(vector, place) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), place
    return E


E_RIGHT = pose((0.3, -0.2, 0.5), (0.4, -0.1, 0.2))


def test_a_pyramid_ends_at_the_outer_edges_of_the_corner_pixels():
    corners = camera_pyramid(PosedCamera(K, (W, H), E=E_RIGHT), 0.7)
    in_camera = (corners - E_RIGHT[:3, 3]) @ E_RIGHT[:3, :3]
    np.testing.assert_allclose(in_camera[0], 0, atol=1e-12)
    np.testing.assert_allclose(in_camera[1:, 2], 0.7)
    px = in_camera[1:] @ K.T / 0.7
    np.testing.assert_allclose(
        px[:, :2], [(-0.5, -0.5), (W - 0.5, -0.5), (W - 0.5, H - 0.5), (-0.5, H - 0.5)], atol=1e-9
    )


def smooth_depth(h: int, w: int, slope: float) -> np.ndarray:
    v, u = np.mgrid[:h, :w]
    return 2.0 + slope * u + 0.5 * slope * v


def expected_faces(depth_m, valid, stride) -> set[tuple[tuple[int, int], ...]]:
    """Triangles, as corner pixels ``(u, v)``, of cells in which no neighbouring pixels are a step apart."""
    h, w = depth_m.shape
    known = np.isfinite(depth_m) & (depth_m > 0) & (True if valid is None else valid)

    def joined(v, u, y, x):
        a, b = depth_m[v, u], depth_m[y, x]
        return known[v, u] and known[y, x] and abs(a - b) <= 0.04 * min(a, b)

    faces = set()
    for v in range(0, h - stride, stride):
        for u in range(0, w - stride, stride):
            cell = [(y, x) for y in range(v, v + stride + 1) for x in range(u, u + stride + 1)]
            whole = all(
                joined(y, x, y + dy, x + dx)
                for y, x in cell
                for dy, dx in ((0, 1), (1, 0))
                if (y + dy, x + dx) in set(cell)
            )
            if whole:
                a, b, c, d = ((u, v), (u + stride, v), (u, v + stride), (u + stride, v + stride))
                faces |= {tuple(sorted((a, c, b))), tuple(sorted((b, c, d)))}
    return faces


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_a_mesh_joins_pixels_of_one_surface_and_no_others(stride, monkeypatch):
    h, w = 25, 34
    depth_m = smooth_depth(h, w, 0.02)
    depth_m[:, 20:] *= 1.1
    depth_m[15:, :9] *= 0.9
    depth_m[4, 6], depth_m[11, 28] = np.nan, 0
    valid = np.ones((h, w), bool)
    valid[18, 15] = False
    monkeypatch.setattr(clouds, "MESH_POINTS", -(-h * w // stride**2))
    image = RNG.random((h, w, 3))
    mesh = make_mesh(depth_m, image, K, valid)
    x, y, z = mesh.vertices.T
    px = np.stack([x / z * K[0, 0] + K[0, 2], y / z * K[1, 1] + K[1, 2]], axis=1)
    whole = np.rint(px).astype(int)
    np.testing.assert_allclose(px, whole, atol=1e-9)
    np.testing.assert_allclose(z, depth_m[whole[:, 1], whole[:, 0]])
    np.testing.assert_allclose(
        mesh.visual.uv, np.stack([(px[:, 0] + 0.5) / w, 1 - (px[:, 1] + 0.5) / h], 1), atol=1e-9
    )
    got = {tuple(sorted((int(u), int(v)) for u, v in whole[face])) for face in mesh.faces}
    expected = expected_faces(depth_m, valid, stride)
    assert got == expected and len(got) == len(mesh.faces) > 50
    facing = np.cross(
        *(mesh.vertices[mesh.faces][:, [k]] - mesh.vertices[mesh.faces][:, [0]] for k in (1, 2))
    )[:, 0]
    towards = np.einsum("ij,ij->i", facing, mesh.vertices[mesh.faces].mean(axis=1))
    assert (towards < 0).all(), "every triangle faces the camera"
    assert set(np.unique(mesh.faces)) == set(range(len(mesh.vertices))), "no point is left over"


def test_a_mesh_has_at_most_the_points_that_it_may_have(monkeypatch):
    for most in (400, 850, 849):
        monkeypatch.setattr(clouds, "MESH_POINTS", most)
        depth_m = smooth_depth(25, 34, 0.001)
        mesh = make_mesh(depth_m, np.zeros((25, 34, 3)), K)
        stride = 1 if most == 850 else 2
        assert len(mesh.vertices) == len(range(0, 25, stride)) * len(range(0, 34, stride)) <= most


def parsed(path) -> tuple[dict, bytes]:
    """The JSON part and the binary part of a GLB file."""
    raw = path.read_bytes()
    (length,) = struct.unpack_from("<I", raw, 12)
    return json.loads(raw[20 : 20 + length]), raw[28 + length :]


def attribute(path, mesh_name: str, name: str) -> np.ndarray:
    """Positions or colours of a mesh; trimesh joins lines and drops their colours when it reads them."""
    tree, data = parsed(path)
    (mesh,) = (mesh for mesh in tree["meshes"] if mesh["name"] == mesh_name)
    entry = tree["accessors"][mesh["primitives"][0]["attributes"][name]]
    view, kind = tree["bufferViews"][entry["bufferView"]], {5121: "u1", 5126: "<f4"}[entry["componentType"]]
    values = np.frombuffer(data[view["byteOffset"] :][: view["byteLength"]], kind)
    return values.reshape(entry["count"], -1)


def in_opencv(points: np.ndarray) -> np.ndarray:
    return points * (1, -1, -1)


@pytest.mark.parametrize("kind", ["cloud", "mesh"])
def test_a_glb_read_by_trimesh_has_the_surface_and_a_pyramid_a_camera(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(clouds, "GLB_POINTS", 100)
    depth_m, image = smooth_depth(H, W, 0.02), IMAGE
    cloud = make_cloud(depth_m, image, K)
    shape = cloud.thinned(100) if kind == "cloud" else make_mesh(depth_m, image, K)
    cameras = [(K + n, pose((0.1 * n, -0.2, 0.05 * n), (0.3 * n, 0.1, -0.2)), (W + n, H)) for n in range(5)]
    cameras = [(K * np.array([[1 + n / 9], [1], [1]]), E, size) for n, (_, E, size) in enumerate(cameras)]
    write_glb(tmp_path / "a.glb", cloud if kind == "cloud" else shape, cameras)
    scene = trimesh.load(tmp_path / "a.glb")
    assert sorted(scene.geometry) == sorted([kind, *(f"camera {n}" for n in range(5))])
    points = shape.points_m if kind == "cloud" else shape.vertices
    np.testing.assert_allclose(in_opencv(scene.geometry[kind].vertices), points, atol=1e-5)
    if kind == "cloud":
        np.testing.assert_array_equal(scene.geometry[kind].colors[:, :3], shape.colours)
    else:
        np.testing.assert_array_equal(scene.geometry[kind].faces, shape.faces)
        material = scene.geometry[kind].visual.material
        assert material.doubleSided and material.metallicFactor == 0
        assert material.baseColorTexture.size == (W, H)
        np.testing.assert_allclose(
            scene.geometry[kind].vertex_normals, shape.vertex_normals * (1, -1, -1), atol=1e-4
        )
    length = 0.08 * np.median(points[:, 2])
    colours = [(255, 255, 255), (255, 170, 0), (0, 200, 255), (160, 255, 120), (255, 255, 255)]
    for number, ((k, E, size), colour) in enumerate(zip(cameras, colours, strict=True)):
        drawn = scene.geometry[f"camera {number}"]
        corners = np.unique(in_opencv(np.asarray(drawn.vertices)).round(5), axis=0)
        expected = camera_pyramid(PosedCamera(k, size, E=E), length)
        assert len(corners) == 5
        for corner in expected:
            assert np.abs(corners - corner).max(axis=1).min() < 2e-5
        written = attribute(tmp_path / "a.glb", f"camera {number}", "COLOR_0")[:, :3]
        assert np.unique(written, axis=0).tolist() == [list(colour)]
        ends = in_opencv(attribute(tmp_path / "a.glb", f"camera {number}", "POSITION")).reshape(8, 2, 3)
        edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
        wanted = [np.linalg.norm(expected[a] - expected[b]) for a, b in edges]
        drawn_lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
        np.testing.assert_allclose(np.sort(drawn_lengths), np.sort(wanted), atol=1e-5)


def test_a_glb_is_shown_without_lights_and_cameras_alone_have_a_metre(tmp_path):
    empty = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    write_glb(tmp_path / "a.glb", empty, [(K, E_RIGHT, (W, H))])
    scene = trimesh.load(tmp_path / "a.glb")
    (drawn,) = scene.geometry.values()
    depths = (in_opencv(np.asarray(drawn.vertices)) - E_RIGHT[:3, 3]) @ E_RIGHT[:3, 2]
    np.testing.assert_allclose(np.unique(depths.round(5)), [0, 1])
    write_glb(tmp_path / "m.glb", make_mesh(smooth_depth(H, W, 0.02), IMAGE, K))
    tree, _ = parsed(tmp_path / "m.glb")
    assert tree["extensionsUsed"] == ["KHR_materials_unlit"]
    assert [material["extensions"] for material in tree["materials"]] == [{"KHR_materials_unlit": {}}]
    assert "NORMAL" in tree["meshes"][0]["primitives"][0]["attributes"]
    assert tree["images"][0]["mimeType"] == "image/jpeg"


def test_the_texture_of_a_mesh_is_the_image(tmp_path):
    image = np.mgrid[:H, :W].transpose(1, 2, 0)[..., [0, 1, 1]] / W
    texture = make_mesh(smooth_depth(H, W, 0.02), image, K).visual.material.baseColorTexture
    assert isinstance(texture, Image.Image) and texture.format == "JPEG"
    np.testing.assert_array_equal(np.asarray(texture), np.rint(image * 255))


def test_flying_points_keep_planes_and_clean_edges():
    v, u = np.mgrid[0:30, 0:40]
    box = (u > 10) & (u < 25) & (v > 8) & (v < 20)
    for depth in (1.0 / (0.5 - 0.004 * u - 0.003 * v), np.where(u < 20, 1.0, 3.0), np.where(box, 1.0, 3.0)):
        assert not flying_points(depth).any()


@pytest.mark.parametrize("angle", [0, 30, 90])
def test_flying_points_find_a_ramp_between_two_surfaces(angle):
    v, u = np.mgrid[0:60, 0:60]
    across = np.cos(np.deg2rad(angle)) * (u - 30) + np.sin(np.deg2rad(angle)) * (v - 30)
    flying = flying_points(np.interp(across, [-1.5, 1.5], [1.0, 4.0]))
    assert flying[np.abs(across) < 1.4].mean() > 0.95 and not flying[np.abs(across) > 3].any()
