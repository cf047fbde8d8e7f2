"""Maps, clouds, GLB and COLMAP files: written whole, and read back by code of others or of the test."""

import io
import json
import struct
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image

from geodiff_plugin.formats import (
    Cloud,
    atomic_path,
    flying_points,
    make_mesh,
    read_calibration,
    read_depth_png,
    read_pfm,
    read_points,
    write_colmap,
    write_depth_mm,
    write_depth_npy,
    write_glb,
    write_pfm,
    write_ply,
)
from tests.contracts.calibrations import SAMPLES, choice

TAKE = settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
SIDES = st.integers(1, 9)
SHAPES = st.tuples(SIDES, SIDES)
FLOATS = st.floats(width=32, allow_nan=False)
K = np.array([[10.0, 0, 2], [0, 20.0, 1], [0, 0, 1]])

K_60 = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
C, S = np.cos(0.1), np.sin(0.1)
E = np.array([[C, 0, S, 0.12], [0, 1, 0, 0], [-S, 0, C, 0], [0, 0, 0, 1]])
LEFT, EMPTY = (K_60, np.eye(4), (64, 48)), Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_atomic_path_appears_whole_as_a_plain_file_or_leaves_the_old_one(tmp_path, error):
    (tmp_path / "a.png").write_text("old")
    mode = (tmp_path / "a.png").stat().st_mode
    with pytest.raises(error) if error else nullcontext(), atomic_path(tmp_path / "a.png") as temporary:
        assert temporary.parent == tmp_path and temporary.suffix == ".png"
        temporary.write_text("new")
        assert (tmp_path / "a.png").read_text() == "old"
        if error is not None:
            raise error
    assert names(tmp_path) == ["a.png"] and (tmp_path / "a.png").stat().st_mode == mode
    assert (tmp_path / "a.png").read_text() == ("new" if error is None else "old")


@TAKE
@given(values=SHAPES.flatmap(lambda shape: arrays(np.float32, shape, elements=FLOATS)))
def test_pfm_comes_back_as_opencv_has_it(tmp_path, values):
    path = tmp_path / "a.pfm"
    write_pfm(path, values)
    np.testing.assert_array_equal(read_pfm(path), values)
    np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), values)
    cv2.imwrite(str(path), values)
    np.testing.assert_array_equal(read_pfm(path), values)
    head = f"Pf\n{values.shape[1]} {values.shape[0]}\n1.0\n".encode()
    path.write_bytes(head + values[::-1].astype(">f4").tobytes())
    np.testing.assert_array_equal(read_pfm(path), values)


def test_depth_in_metres_and_millimetres_comes_back(tmp_path):
    depth = np.array([[0.0004, 1.2344, 65.535], [65.536, np.nan, -np.inf], [np.inf, -1.0, 0.001]])
    write_depth_npy(tmp_path / "d.npy", depth)
    np.testing.assert_array_equal(np.load(tmp_path / "d.npy", allow_pickle=False), depth.astype(np.float32))
    zeros = write_depth_mm(tmp_path / "d.png", depth)
    read, known = read_depth_png(tmp_path / "d.png")
    np.testing.assert_allclose(read, [[0, 1.234, 65.535], [0, 0, 0], [0, 0, 0.001]], atol=1e-6)
    np.testing.assert_array_equal(known, read > 0)
    assert zeros == 6 == int((~known).sum()) and names(tmp_path) == ["d.npy", "d.png"]
    np.testing.assert_array_equal(read_depth_png(tmp_path / "d.png", 500.0)[0], 2 * read)


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda f: write_pfm(f / "a.pfm", np.zeros(3)), "shape"),
        (lambda f: write_ply(f / "d.ply", np.ones((3, 4)), np.zeros((4, 3, 3)), K), "image_01"),
        (lambda f: write_ply(f / "d.ply", np.ones((3, 4)), np.zeros((3, 4, 3)), 0 * K), "focal"),
        (lambda f: write_depth_npy(f, np.zeros((2, 3))), "folder"),
        (lambda f: write_colmap(f, [("my left.png", *LEFT)], EMPTY), "without blanks"),
    ],
)
def test_what_cannot_be_written_leaves_nothing(tmp_path, write, said):
    with pytest.raises(ValueError, match=said):
        write(tmp_path)
    assert names(tmp_path) == []


def read_ply(path: Path) -> np.ndarray:
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines, kinds = head.decode("ascii").split("\n"), {"float": "<f4", "uchar": "u1"}
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    properties = [line.split()[1:] for line in lines if line.startswith("property")]
    rows = np.frombuffer(body, dtype=[(name, kinds[kind]) for kind, name in properties])
    assert f"element vertex {len(rows)}" in lines
    return rows


def test_convention_ply_camera_frame(tmp_path):
    """x right, y down, z forward, metres, and back through K to the pixel it came from."""
    depth = np.linspace(1, 3, 12).reshape(3, 4)
    image = np.random.default_rng(0).random((3, 4, 3))
    valid = np.ones((3, 4), dtype=bool)
    valid[0, 0], depth[2, 3], depth[2, 2] = False, np.nan, 0
    assert write_ply(tmp_path / "c.ply", depth, image, K, valid) == 9
    points = read_ply(tmp_path / "c.ply")
    u, v = points["x"] / points["z"] * 10 + 2, points["y"] / points["z"] * 20 + 1
    rows, columns = np.rint(v).astype(int), np.rint(u).astype(int)
    np.testing.assert_allclose(np.stack([u, v]), np.stack([columns, rows]), atol=1e-5)
    np.testing.assert_allclose(points["z"], depth[rows, columns], rtol=1e-6)
    for channel, name in enumerate(("red", "green", "blue")):
        np.testing.assert_array_equal(points[name], np.rint(image[rows, columns, channel] * 255))


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


def parse_glb(path) -> tuple[dict, bytes]:
    raw = path.read_bytes()
    magic, version, length, count, kind = struct.unpack_from("<4sIII4s", raw)
    assert (magic, version, length, kind) == (b"glTF", 2, len(raw), b"JSON") and count % 4 == 0
    binary = raw[20 + count :]
    assert binary[:8] == (struct.pack("<I4s", len(binary) - 8, b"BIN\0") if binary else b"")
    return json.loads(raw[20 : 20 + count]), binary[8:]


def accessor(scene: dict, data: bytes, number: int) -> np.ndarray:
    entry = scene["accessors"][number]
    begin, size = (scene["bufferViews"][entry["bufferView"]][key] for key in ("byteOffset", "byteLength"))
    assert begin % 4 == 0
    kind = {5126: "<f4", 5121: "u1", 5125: "<u4"}[entry["componentType"]]
    return np.frombuffer(data[begin : begin + size], kind).reshape(entry["count"], -1)


def test_glb_turns_the_axes_and_its_cameras_look_at_the_cloud(tmp_path):
    cloud = Cloud(np.array([[1.0, -1.0, 1.0], [0, 0, 2]]), np.array([[255, 0, 9], [1, 2, 3]], np.uint8))
    write_glb(tmp_path / "a.glb", cloud, [LEFT, (K_60, E, (64, 48))])
    scene, data = parse_glb(tmp_path / "a.glb")
    assert [mesh["name"] for mesh in scene["meshes"]] == ["cloud", "camera 0", "camera 1"]
    points, lines = (scene["meshes"][i]["primitives"][0] for i in (0, 2))
    assert (points["mode"], lines["mode"]) == (0, 1)
    positions, colours = (points["attributes"][name] for name in ("POSITION", "COLOR_0"))
    assert accessor(scene, data, positions).tolist() == [[1, 1, -1], [0, 0, -2]]
    assert accessor(scene, data, colours).tolist() == [[255, 0, 9, 255], [1, 2, 3, 255]]
    assert [scene["accessors"][positions][key] for key in ("min", "max")] == [[0, 0, -2], [1, 1, -1]]
    corners = np.unique(accessor(scene, data, lines["attributes"]["POSITION"]).round(6), axis=0)
    centre = np.linalg.norm(corners - [0.12, 0, 0], axis=1) < 1e-6
    middle = corners[~centre].mean(0) - corners[centre][0]
    np.testing.assert_allclose(middle / np.linalg.norm(middle), [S, 0, -C], atol=1e-5)
    write_glb(tmp_path / "a.glb", EMPTY, [LEFT])
    assert [mesh["name"] for mesh in parse_glb(tmp_path / "a.glb")[0]["meshes"]] == ["camera 0"]


def test_a_mesh_wears_the_image_and_stops_at_steps_and_unknown_depths(tmp_path):
    depth_m = np.where(np.arange(64) < 40, 2.0, 4.0) * np.ones((48, 1))
    depth_m[:5, :5] = np.nan
    image = np.mgrid[0:48, 0:64].transpose(1, 2, 0)[..., [0, 1, 1]] / 64
    mesh = make_mesh(depth_m, image, K_60)
    assert np.ptp(mesh.vertices[mesh.faces][..., 2], axis=1).max() == 0
    assert len(mesh.faces) == 2 * 47 * (39 + 23) - 50 and np.allclose(mesh.vertex_normals, [0, 0, -1])
    fine = make_mesh(np.where(np.arange(900) < 500, 2.0, 2.2) * np.ones((800, 1)), np.zeros((800, 900, 3)), K)
    assert len(fine.faces) > 200_000 and np.ptp(fine.vertices[:, 2][fine.faces], axis=1).max() == 0
    write_glb(tmp_path / "a.glb", mesh, [LEFT])
    scene, data = parse_glb(tmp_path / "a.glb")
    surface, at = scene["meshes"][0]["primitives"][0], scene["bufferViews"][scene["images"][0]["bufferView"]]
    positions, uv, normals = (
        accessor(scene, data, surface["attributes"][name]) for name in ("POSITION", "TEXCOORD_0", "NORMAL")
    )
    assert surface["mode"] == 4 and np.allclose(normals, [0, 0, 1])
    px = np.stack([positions[:, 0], -positions[:, 1]], 1) / -positions[:, 2:] * 60 + K_60[:2, 2]
    np.testing.assert_allclose(uv * [64, 48] - 0.5, px, atol=1e-4)
    texture = Image.open(io.BytesIO(data[at["byteOffset"] : at["byteOffset"] + at["byteLength"]]))
    assert texture.format == "JPEG" and np.abs(np.asarray(texture) / 255 - image).mean() < 0.02


CAMERAS, IMAGES = SAMPLES["colmap"]


def test_a_model_of_many_images_is_read_without_its_points(tmp_path, monkeypatch):
    """The points of a hundred images exceed what any other calibration has, and no pair needs them."""
    (tmp_path / "images.bin").write_bytes(b"\0")
    with pytest.raises(OSError, match="got the folder"):
        read_calibration(tmp_path)
    monkeypatch.setattr("geodiff_plugin.formats.files.LARGEST_TEXT_BYTES", 20_000)
    points = " ".join(["512.25 40.5 7", "3 200 -1"] * 3000)
    (tmp_path / "cameras.txt").write_text(CAMERAS)
    (tmp_path / "images.txt").write_text(IMAGES.replace("320.5 240.25 17", points))
    assert read_calibration(tmp_path, **choice("colmap")).E[0, 3] == pytest.approx(0.12)
    (tmp_path / "images.txt").write_text(points)
    with pytest.raises(ValueError, match="calibration must be images.txt of a COLMAP model; got .* without"):
        read_calibration(tmp_path, **choice("colmap"))


CLOUD = np.random.default_rng(3).uniform(0.5, 5.0, (20, 3))
PCD_HEAD = (
    "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z intensity\nSIZE 4 4 8 2\nTYPE F F F U\nCOUNT 1 1 1 1\n"
    "WIDTH 21\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 21\nDATA {}\n"
)


def pcd(path: Path, how: str) -> None:
    """The cloud and an unknown point, with an intensity between other columns' sizes."""
    rows = np.vstack([CLOUD, [np.nan] * 3])
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f8"), ("intensity", "<u2")])
    table = np.array([(*row, 7) for row in rows], kind)
    text = "\n".join(" ".join(map(repr, (*map(float, row), 7))) for row in rows)
    body = table.tobytes() if how == "binary" else text.encode()
    path.write_bytes(PCD_HEAD.format(how).encode() + body)


def las(path: Path) -> None:
    laspy = pytest.importorskip("laspy")
    file = laspy.create()
    file.header.scales = [1e-5] * 3
    file.x, file.y, file.z = CLOUD.T
    file.write(str(path))


@pytest.mark.parametrize("kind", ["ascii.pcd", "binary.pcd", "a.las"])
def test_points_of_other_programs(kind, tmp_path):
    path = tmp_path / kind
    las(path) if kind == "a.las" else pcd(path, path.stem)
    np.testing.assert_allclose(read_points(path), CLOUD, atol=1e-4)
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(ValueError, match="points must be a (whole (PCD|LAS)|PCD) file"):
        read_points(path)


def test_what_points_are_not_read_names_what_converts_them(tmp_path):
    (tmp_path / "000000.bin").write_bytes(bytes(160))
    with pytest.raises(ValueError, match="KITTI's velodyne.*calib_velo_to_cam"):
        read_points(tmp_path / "000000.bin")
    (tmp_path / "maps.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(90))
    with pytest.raises(ValueError, match="an HDF5 or MATLAB file. Save its map as .npy"):
        read_points(tmp_path / "maps.h5")


def lzf(data: bytes) -> bytes:
    """LZF by its description: copies of what came at most 8192 bytes before, and runs of literals between."""
    packed, literals, at = bytearray(), bytearray(), 0

    def flush() -> None:
        for start in range(0, len(literals), 32):
            run = literals[start : start + 32]
            packed.extend(bytes([len(run) - 1]) + run)
        literals.clear()

    while at < len(data):
        for length in (264, 40, 9, 8, 5, 3):  # with and without a byte of length
            piece = data[at : at + length]
            found = data.rfind(piece, max(0, at - 8192), at + length - 1) if len(piece) == length else -1
            if 0 <= found < at:
                break
        else:
            literals.append(data[at])
            at += 1
            continue
        flush()
        distance, code = at - found - 1, length - 2
        head = min(code, 7) << 5 | distance >> 8
        packed.extend([head, *([code - 7] if code >= 7 else []), distance & 0xFF])
        at += length
    flush()
    return bytes(packed)


def compressed_pcd(path: Path, points: np.ndarray) -> None:
    """PCL's savePCDFileBinaryCompressed: one field after the other, with padding between them."""
    head = (
        "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z _ rgb\nSIZE 4 4 4 1 4\nTYPE F F F U F\nCOUNT 1 1 1 4 1\n"
        f"WIDTH {len(points)}\nHEIGHT 1\nPOINTS {len(points)}\nDATA binary_compressed\n"
    )
    body = b"".join(points[:, axis].astype("<f4").tobytes() for axis in range(3))
    body += bytes(4 * len(points)) + np.full(len(points), 0.5, "<f4").tobytes()
    packed = lzf(body)
    assert len(packed) < len(body)
    path.write_bytes(head.encode() + np.array([len(packed), len(body)], "<u4").tobytes() + packed)


def test_compressed_points_of_pcl(tmp_path):
    points = np.random.default_rng(5).integers(-300, 300, (500, 3)) / 64.0
    points[40:200] = points[40]  # copies that overlap themselves
    compressed_pcd(tmp_path / "c.pcd", points)
    np.testing.assert_array_equal(read_points(tmp_path / "c.pcd"), points.astype(np.float32))
    whole = (tmp_path / "c.pcd").read_bytes()
    for damaged in (whole[:-20], whole.replace(b"POINTS 500", b"POINTS 499"), whole[:-400] + b"\xff" * 400):
        (tmp_path / "d.pcd").write_bytes(damaged)
        with pytest.raises(ValueError, match="whole PCD file"):
            read_points(tmp_path / "d.pcd")


def test_points_in_coordinates_of_a_map_are_refused(tmp_path):
    survey = CLOUD + [431_200.0, 5_412_700.0, 340.0]
    np.save(tmp_path / "survey.npy", survey)
    with pytest.raises(ValueError, match="the frame of the left camera .* a map's. Move them there"):
        read_points(tmp_path / "survey.npy")
    np.save(tmp_path / "mm.npy", 1000 * CLOUD)
    np.testing.assert_allclose(read_points(tmp_path / "mm.npy", scale=1000), CLOUD, atol=1e-4)


def test_a_png_of_the_bytes_of_floats_is_a_map(tmp_path):
    """As TartanAir V2 keeps depth: OpenCV writes blue, green, red, alpha of an array of float32."""
    depth = np.random.default_rng(2).uniform(0.7, 90, (6, 9)).astype("<f4")
    cv2.imwrite(str(tmp_path / "depth.png"), depth.view(np.uint8).reshape(6, 9, 4))
    np.testing.assert_array_equal(read_points(tmp_path / "depth.png"), depth)
    picture = np.random.default_rng(2).integers(0, 255, (6, 9, 4), np.uint8)
    picture[..., 3] = 255
    Image.fromarray(picture).save(tmp_path / "picture.png")
    with pytest.raises(ValueError, match="16-bit grey PNG.*got .*RGBA"):
        read_points(tmp_path / "picture.png")


def test_depth_of_sintel(tmp_path):
    depth = np.random.default_rng(2).uniform(0.7, 90, (5, 8)).astype("<f4")
    head = np.array([202021.25], "<f4").tobytes() + np.array([8, 5], "<i4").tobytes()
    (tmp_path / "frame.dpt").write_bytes(head + depth.tobytes())
    np.testing.assert_array_equal(read_points(tmp_path / "frame.dpt"), depth)
    for damaged in (head + depth.tobytes()[:-3], head[:9], b"PIEH" + bytes(80)):
        (tmp_path / "frame.dpt").write_bytes(damaged)
        with pytest.raises(ValueError, match="whole .dpt of MPI Sintel.*cut off"):
            read_points(tmp_path / "frame.dpt")


def test_a_colour_picture_in_exr_is_no_map(tmp_path):
    openexr = pytest.importorskip("OpenEXR")
    grey = np.random.default_rng(2).uniform(0.7, 9, (5, 8)).astype(np.float32)
    head = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    for name, rgb in (("map", [grey] * 3), ("picture", [grey, 2 * grey, grey])):
        with openexr.File(head, {"RGB": np.stack(rgb, axis=-1)}) as file:
            file.write(str(tmp_path / f"{name}.exr"))
    np.testing.assert_array_equal(read_points(tmp_path / "map.exr"), grey)
    with pytest.raises(ValueError, match="a map of depths; got .*picture.exr, a colour picture"):
        read_points(tmp_path / "picture.exr")


def test_laz_without_its_decoder_names_it(tmp_path, monkeypatch):
    laspy = pytest.importorskip("laspy")
    las(tmp_path / "a.las")
    monkeypatch.setattr(laspy.LazBackend, "detect_available", lambda: ())
    (tmp_path / "a.laz").write_bytes((tmp_path / "a.las").read_bytes())

    def without(path):
        raise laspy.LaspyException("No LazBackend selected, cannot decompress data")

    monkeypatch.setattr(laspy, "read", without)
    with pytest.raises(ValueError, match="pip install 'laspy.lazrs.'"):
        read_points(tmp_path / "a.laz")


@pytest.mark.parametrize(("kind", "units"), [("float32", 1.0), ("uint16", 1000.0)])
def test_a_tiff_of_known_depths_is_a_map(kind, units, tmp_path):
    depth = np.arange(12.0).reshape(3, 4) / 4
    Image.fromarray((depth * units).astype(kind)).save(tmp_path / "d.tiff")
    np.testing.assert_allclose(read_points(tmp_path / "d.tiff"), depth)
