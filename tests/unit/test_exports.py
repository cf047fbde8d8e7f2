"""GLB and COLMAP exports: read back by code that shares nothing with the writers."""

import json
import struct

import numpy as np
import pytest

from geodiff_plugin.formats import Cloud, make_cloud, read_calibration, write_colmap, write_glb

K = np.array([[60.0, 0, 31.5], [0, 60.0, 23.5], [0, 0, 1]])
C, S = np.cos(0.1), np.sin(0.1)
E = np.array([[C, 0, S, 0.12], [0, 1, 0, 0], [-S, 0, C, 0], [0, 0, 0, 1]])
LEFT, EMPTY = (K, np.eye(4), (64, 48)), Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8))


def parse_glb(path) -> tuple[dict, bytes]:
    raw = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", raw)
    assert (magic, version, length) == (b"glTF", 2, len(raw))
    count, kind = struct.unpack_from("<I4s", raw, 12)
    assert kind == b"JSON" and count % 4 == 0
    scene = json.loads(raw[20 : 20 + count])
    if length == 20 + count:
        return scene, b""
    size, kind = struct.unpack_from("<I4s", raw, 20 + count)
    assert kind == b"BIN\0" and 28 + count + size == length
    return scene, raw[28 + count :]


def accessor(scene: dict, data: bytes, number: int) -> np.ndarray:
    entry = scene["accessors"][number]
    view = scene["bufferViews"][entry["bufferView"]]
    assert view["byteOffset"] % 4 == 0
    kind = {5126: "<f4", 5121: "u1", 5125: "<u4"}[entry["componentType"]]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry["type"]]
    raw = data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return np.frombuffer(raw, kind).reshape(entry["count"], width)


def test_glb_turns_the_axes_and_keeps_colours(tmp_path):
    cloud = Cloud(np.array([[1.0, -1.0, 1.0], [0, 0, 2]]), np.array([[255, 0, 9], [1, 2, 3]], np.uint8))
    write_glb(tmp_path / "a.glb", cloud)
    scene, data = parse_glb(tmp_path / "a.glb")
    primitive = scene["meshes"][0]["primitives"][0]
    positions, colours = (primitive["attributes"][name] for name in ("POSITION", "COLOR_0"))
    assert primitive["mode"] == 0
    assert accessor(scene, data, positions).tolist() == [[1, 1, -1], [0, 0, -2]]
    assert accessor(scene, data, colours).tolist() == [[255, 0, 9, 255], [1, 2, 3, 255]]
    bounds = scene["accessors"][positions]
    assert bounds["min"] == [0, 0, -2] and bounds["max"] == [1, 1, -1]
    write_glb(tmp_path / "a.glb", EMPTY)
    scene, data = parse_glb(tmp_path / "a.glb")
    assert scene["scenes"] == [{}] and data == b""


def test_glb_cameras_look_at_the_cloud(tmp_path):
    cloud = make_cloud(np.full((48, 64), 2.0), np.zeros((48, 64, 3)), K)
    write_glb(tmp_path / "a.glb", cloud, [LEFT, (K, E, (64, 48))])
    scene, data = parse_glb(tmp_path / "a.glb")
    assert [mesh["name"] for mesh in scene["meshes"]] == ["cloud", "camera 0", "camera 1"]
    lines = scene["meshes"][2]["primitives"][0]
    assert lines["mode"] == 1 and accessor(scene, data, lines["indices"]).max() == 4
    corners = accessor(scene, data, lines["attributes"]["POSITION"])
    np.testing.assert_allclose(corners[0], [0.12, 0, 0], atol=1e-6)
    assert (corners[1:, 2] < 0).all()  # before the camera is -z
    middle = corners[1:].mean(0) - corners[0]
    np.testing.assert_allclose(middle / np.linalg.norm(middle), [S, 0, -C], atol=1e-6)


def test_colmap_comes_back_through_the_reader(tmp_path):
    cloud = make_cloud(np.full((48, 64), 2.0), np.full((48, 64, 3), 0.5), K)
    write_colmap(tmp_path, [("left.png", *LEFT), ("right.png", K, E, (64, 48))], cloud)
    rig = read_calibration(tmp_path, image_names=("left.png", "right.png"), baseline_m=0.12)
    np.testing.assert_allclose(rig.K_left, K)
    np.testing.assert_allclose(rig.E, E, atol=1e-9)
    assert rig.size_right == (64, 48)
    lines = [line for line in (tmp_path / "points3D.txt").read_text().splitlines() if line[0] != "#"]
    assert len(lines) == 48 * 64
    assert lines[0].split()[3:] == ["2.00000", "128", "128", "128", "0"]
    with pytest.raises(ValueError, match="without blanks"):
        write_colmap(tmp_path, [("my left.png", *LEFT)], EMPTY)
