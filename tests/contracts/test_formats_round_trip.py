"""Any rig, written in every format by its conventions, is read as that rig: poses, pixels, lenses, sizes."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats import CALIBRATION_FORMATS, read_calibration

NAMES = "rig/left.jpg", "rig/right.jpg"


@dataclass(frozen=True)
class Drawn:
    """A rig, and a frame that both cameras may be given in."""

    K: tuple[np.ndarray, np.ndarray]
    T: np.ndarray  # right from left, metres
    size: tuple[int, int]
    lenses: tuple[list[float], list[float]]
    left_from_world: np.ndarray

    def numbers(self, side: int) -> list[float]:
        """fx, fy, cx, cy."""
        K = self.K[side]
        return [float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])]

    @property
    def worlds(self) -> tuple[np.ndarray, np.ndarray]:
        """World-to-camera of both."""
        return self.left_from_world, self.T @ self.left_from_world


def rigid(rotvec, place) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), place
    return T


@st.composite
def rigs(draw, turned: bool = True) -> Drawn:
    number = lambda low, high: draw(st.floats(low, high))  # noqa: E731
    size = draw(st.integers(64, 4000)), draw(st.integers(48, 3000))
    focal, Ks = number(100, 3000), []
    for side in range(2):
        f = focal if side == 0 or not turned else number(100, 3000)
        cx, cy = (number(0.3, 0.7) * along for along in size)
        cy = Ks[0][1, 2] if side and not turned else cy
        fy = f * number(0.8, 1.25) if turned else f
        Ks.append(np.array([[f, 0, cx], [0, fy, cy], [0, 0, 1]]))
    turn = [number(-0.5, 0.5) for _ in range(3)] if turned else [0, 0, 0]
    T = rigid(turn, [-number(0.02, 3.0), *((number(-0.5, 0.5), number(-0.5, 0.5)) if turned else (0, 0))])
    lenses = tuple([round(number(-0.3, 0.3), 6) or 0.01 for _ in range(4)] for _ in range(2))
    world = rigid([number(-1, 1) for _ in range(3)], [number(-5, 5) for _ in range(3)])
    return Drawn(tuple(Ks), T, size, lenses, world)


def storage(**matrices) -> str:
    text = "%YAML:1.0\n---\n"
    for name, values in matrices.items():
        rows, columns = np.shape(values)
        data = ", ".join(repr(float(v)) for v in np.ravel(values))
        text += (
            f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"
        )
    return text


def words(values) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def opencv(rig: Drawn):
    left, right = ([lens] for lens in rig.lenses)
    cameras = {"M1": rig.K[0], "D1": left, "M2": rig.K[1], "D2": right}
    return (storage(**cameras, R=rig.T[:3, :3], T=rig.T[:3, 3:], image_size=[rig.size]),), {}


def kalibr(rig: Drawn, model: str = "radtan"):
    chain: dict[str, Any] = {}
    for n in range(2):
        chain[f"cam{n}"] = {"camera_model": "pinhole", "intrinsics": rig.numbers(n)}
        chain[f"cam{n}"] |= {"distortion_model": model, "distortion_coeffs": rig.lenses[n]}
        chain[f"cam{n}"] |= {"resolution": list(rig.size)}
    chain["cam1"]["T_cn_cnm1"] = rig.T.tolist()
    return (yaml.safe_dump(chain),), {}


def euroc(rig: Drawn):
    texts = []
    for n, T in enumerate(rig.worlds):
        pose = {"rows": 4, "cols": 4, "data": np.linalg.inv(T).ravel().tolist()}
        entries = {"T_BS": pose, "camera_model": "pinhole", "intrinsics": rig.numbers(n)}
        entries |= {"distortion_model": "radial-tangential", "distortion_coefficients": rig.lenses[n]}
        texts.append(yaml.safe_dump(entries | {"resolution": list(rig.size)}))
    return tuple(texts), {}


def orb_slam(rig: Drawn, kind: str = "PinHole", keys: str = "k1 k2 p1 p2"):
    text = f'%YAML:1.0\nCamera.type: "{kind}"\nCamera.width: {rig.size[0]}\nCamera.height: {rig.size[1]}\n'
    for n in range(2):
        entries = zip(("fx fy cx cy " + keys).split(), [*rig.numbers(n), *rig.lenses[n]], strict=True)
        text += "".join(f"Camera{n + 1}.{key}: {value!r}\n" for key, value in entries)
    pose = storage(**{"Stereo.T_c1_c2": np.linalg.inv(rig.T)}).partition("---\n")[2]
    return (text + pose,), {}


def mvsnet(rig: Drawn):
    texts = (
        f"extrinsic\n{words(T)}\n\nintrinsic\n{words(K)}\n\n0.5 0.01\n"
        for T, K in zip(rig.worlds, rig.K, strict=True)
    )
    return tuple(texts), {}


def zed(rig: Drawn):
    rotvec = Rotation.from_matrix(rig.T[:3, :3]).as_rotvec()
    text = ""
    for n, side in enumerate(("LEFT", "RIGHT")):
        entries = zip("fx fy cx cy k1 k2 p1 p2".split(), [*rig.numbers(n), *rig.lenses[n]], strict=True)
        text += f"[{side}_CAM_HD]\n" + "".join(f"{key}={value!r}\n" for key, value in entries) + "k3=0\n"
    shift = zip(("Baseline", "TY", "TZ"), -1000 * rig.T[:3, 3], strict=True)
    turn = zip(("RX_HD", "CV_HD", "RZ_HD"), rotvec, strict=True)
    text += "[STEREO]\n" + "".join(f"{key}={float(value)!r}\n" for key, value in (*shift, *turn))
    return (text,), {"image_size": (1280, 720)}


def realsense(rig: Drawn):
    def camera(n: int) -> dict:
        entries = dict(zip(("fx", "fy", "ppx", "ppy"), rig.numbers(n), strict=True))
        entries |= {"width": rig.size[0], "height": rig.size[1], "model": "Brown Conrady"}
        return entries | {"coeffs": [*rig.lenses[n], 0.0]}

    between = {"rotation": rig.T[:3, :3].T.ravel().tolist(), "translation": rig.T[:3, 3].tolist()}
    return (json.dumps({"infra1": camera(0), "infra2": camera(1), "extrinsics": between}),), {}


def realsense_printed(rig: Drawn):
    text = ""
    for n in range(2):
        fx, fy, cx, cy = rig.numbers(n)
        text += f' Intrinsic of "Infrared {n + 1}" / {rig.size[0]}x{rig.size[1]} / {{Y8}}\n'
        text += f"  Width: {rig.size[0]}\n  Height: {rig.size[1]}\n  PPX: {cx}\n  PPY: {cy}\n"
        text += f"  Fx: {fx}\n  Fy: {fy}\n"
        text += f"  Distortion: Brown Conrady\n  Coeffs: {words([*rig.lenses[n], 0])}\n\n"
    rows = "\n".join(words(row) for row in rig.T[:3, :3])
    text += f' Extrinsic from "Infrared 1"  To  "Infrared 2" :\n Rotation Matrix:\n{rows}\n'
    return (text + f"\n Translation Vector: {words(rig.T[:3, 3])}\n",), {}


def oak(rig: Drawn):
    links = {1: (2, rig.T), 2: (-1, np.eye(4))}
    cameras = []
    for n, socket in enumerate((1, 2)):
        to, T = links[socket]
        shift = dict(zip("xyz", (100 * T[:3, 3]).tolist(), strict=True))
        extrinsics = {"toCameraSocket": to, "rotationMatrix": T[:3, :3].tolist(), "translation": shift}
        entries = {"cameraType": 0, "distortionCoeff": rig.lenses[n] + [0.0] * 10, "extrinsics": extrinsics}
        entries |= {"intrinsicMatrix": rig.K[n].tolist(), "width": rig.size[0], "height": rig.size[1]}
        cameras.append([socket, entries])
    return (json.dumps({"cameraData": cameras}),), {}


def colmap(rig: Drawn):
    cameras, images = "# Camera list with one line\n", "# Image list with two lines\n"
    for n, T in enumerate(rig.worlds):
        fx, fy, cx, cy = rig.numbers(n)  # the first pixel's centre lies at half a pixel
        numbers = words([fx, fy, cx + 0.5, cy + 0.5, *rig.lenses[n]])
        cameras += f"{n + 1} OPENCV {rig.size[0]} {rig.size[1]} {numbers}\n"
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        images += f"{n + 1} {words([w, x, y, z, *T[:3, 3]])} {n + 1} {NAMES[n]}\n1.5 2.5 -1\n"
    return (cameras, images), {"image_names": NAMES, "baseline_m": float(np.linalg.norm(rig.T[:3, 3]))}


def nerf(rig: Drawn):
    frames = []
    for n, T in enumerate(rig.worlds):
        fx, fy, cx, cy = rig.numbers(n)
        pose = np.linalg.inv(T) @ np.diag([1.0, -1, -1, 1])  # y up, looking along -z
        frame = {"file_path": f"./{NAMES[n]}", "transform_matrix": pose.tolist()}
        frame |= {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": rig.size[0], "h": rig.size[1]}
        frames.append(frame | dict(zip(("k1", "k2", "p1", "p2"), rig.lenses[n], strict=True)))
    return (json.dumps({"frames": frames}),), colmap(rig)[1]


def fisheye_kalibr(rig: Drawn):
    return kalibr(rig, "equidistant")


def fisheye_orb_slam(rig: Drawn):
    return orb_slam(rig, "KannalaBrandt8", "k1 k2 k3 k4")


#: Formats of any pose, and whether they have lenses and sizes.
ANY_POSE = [opencv, kalibr, euroc, orb_slam, mvsnet, zed, realsense, realsense_printed, oak, colmap, nerf]
ANY_POSE += [fisheye_kalibr, fisheye_orb_slam]


def middlebury(rig: Drawn):
    K = ["[" + "; ".join(words(row) for row in K) + "]" for K in rig.K]
    doffs = rig.K[1][0, 2] - rig.K[0][0, 2]
    text = f"cam0={K[0]}\ncam1={K[1]}\ndoffs={doffs!r}\nbaseline={-1000 * rig.T[0, 3]!r}\n"
    return (text + f"width={rig.size[0]}\nheight={rig.size[1]}\n").replace("np.float64(", "").replace(")", "")


def projections(rig: Drawn, shift: float = 0.0) -> list[np.ndarray]:
    """Both in the frame of a camera further left."""
    places = (np.array([shift, 0, 0]), rig.T[:3, 3] + [shift, 0, 0])
    return [K @ np.column_stack([np.eye(3), t]) for K, t in zip(rig.K, places, strict=True)]


def kitti_cam_to_cam(rig: Drawn):
    P = projections(rig, 0.7)
    rows = [f"S_rect_0{n}: {words(rig.size)}\nP_rect_0{n}: {words(P[n - 2])}\n" for n in (2, 3)]
    return "calib_time: 09-Jan-2012 13:57:47\n" + "".join(rows)


def kitti_projections(rig: Drawn):
    return "".join(f"P{n}: {words(P)}\n" for n, P in enumerate(projections(rig, -0.4)))


def booster(rig: Drawn):
    P = dict(zip(("proj_matL", "proj_matR"), projections(rig), strict=True))
    kind = "<rows>3</rows><cols>4</cols><dt>d</dt>"
    matrices = "".join(
        f'<{name} type_id="opencv-matrix">{kind}<data>{words(values)}</data></{name}>'
        for name, values in P.items()
    )
    baseline = f"<baselineLR>{float(-1000 * rig.T[0, 3])!r}</baselineLR>"
    return f"<opencv_storage>{matrices}{baseline}</opencv_storage>"


def stereodemo(rig: Drawn):
    fx, fy, cx, cy = rig.numbers(0)
    entries = {"fx": fx, "fy": fy, "cx0": cx, "cx1": rig.numbers(1)[2], "cy": cy}
    entries |= {"baseline_meters": float(-rig.T[0, 3]), "width": rig.size[0], "height": rig.size[1]}
    return json.dumps(entries)


def opencv_projections(rig: Drawn):
    return storage(P1=projections(rig)[0], P2=projections(rig)[1], D1=[rig.lenses[0]], image_size=[rig.size])


def ros(rig: Drawn):
    size = {"image_width": rig.size[0], "image_height": rig.size[1]}
    matrices = ({"projection_matrix": {"data": P.ravel().tolist()}} for P in projections(rig, 0.2))
    return tuple(yaml.safe_dump(matrix | size) for matrix in matrices)


#: Formats of rectified pairs.
RECTIFIED = [middlebury, kitti_cam_to_cam, kitti_projections, booster, stereodemo, opencv_projections, ros]
TAKE = settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))


def read(folder, texts, **choice):
    paths = [folder / f"{number}.dat" for number in range(len(texts))]
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return read_calibration(paths[0] if len(paths) == 1 else paths, distorted=True, **choice)


def check(rig, drawn: Drawn) -> None:
    for K, expected in zip((rig.K_left, rig.K_right), drawn.K, strict=True):
        np.testing.assert_allclose(K, expected, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(rig.T_right_from_left, drawn.T, atol=1e-6)


@pytest.mark.parametrize("write", ANY_POSE, ids=lambda write: write.__name__)
@TAKE
@given(drawn=rigs())
def test_a_rig_of_any_pose(tmp_path, write, drawn) -> None:
    texts, choice = write(drawn)
    rig = read(tmp_path, texts, **choice)
    check(rig, drawn)
    assert not rig.rectified and rig.unit == "m"
    if write is mvsnet:
        assert rig.size_left is None and rig.distortion == (None, None)
        return
    assert rig.size_left == rig.size_right == choice.get("image_size", drawn.size)
    for lens, expected in zip(rig.distortion, drawn.lenses, strict=True):
        assert lens.model == ("fisheye" if write.__name__.startswith("fisheye") else "opencv")
        numbers = lens.coefficients.tolist()
        assert numbers[:4] == expected and not any(numbers[4:])


@pytest.mark.parametrize("write", RECTIFIED, ids=lambda write: write.__name__)
@TAKE
@given(drawn=rigs(turned=False))
def test_a_rectified_rig(tmp_path, write, drawn) -> None:
    written = write(drawn)
    rig = read(tmp_path, (written,) if isinstance(written, str) else written)
    check(rig, drawn)
    assert rig.rectified == (write is not stereodemo) and rig.distortion == (None, None)
    sized = write not in (kitti_projections, booster)
    assert rig.size_left == rig.size_right == (drawn.size if sized else None)


def test_no_format_is_left_out() -> None:
    written = {write.__name__.removeprefix("fisheye_") for write in (*ANY_POSE, *RECTIFIED)}
    written -= {"realsense_printed", "opencv_projections"}
    assert written | {"foundation_stereo"} == set(CALIBRATION_FORMATS)  # K.txt has one K for both
