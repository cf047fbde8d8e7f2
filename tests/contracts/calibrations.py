"""Calibrations of any rig in every format, by the conventions of the tools that write them."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from geodiff_plugin.formats import read_calibration
from geodiff_plugin.types import Rig

#: Names in a COLMAP model and a transforms.json, and the metres of their unit.
NAMES = "rig/left.jpg", "rig/right.jpg"
UNIT_M = 0.24


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

    def projections(self, shift: float = 0.0) -> list[list[float]]:
        """Both in the frame of a camera further left, row by row."""
        places = (np.array([shift, 0, 0]), self.T[:3, 3] + [shift, 0, 0])
        matrices = (K @ np.column_stack([np.eye(3), t]) for K, t in zip(self.K, places, strict=True))
        return [matrix.ravel().tolist() for matrix in matrices]


def rigid(rotvec, place) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), place
    return T


def words(values) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def storage(**matrices) -> str:
    text = "%YAML:1.0\n---\n"
    for name, values in matrices.items():
        rows, columns = np.shape(values)
        text += f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n"
        text += f"   data: [ {words(values).replace(' ', ', ')} ]\n"
    return text


def opencv(rig: Drawn) -> tuple[str, ...]:
    left, right = ([lens] for lens in rig.lenses)
    cameras = {"M1": rig.K[0], "D1": left, "M2": rig.K[1], "D2": right}
    return (storage(**cameras, R=rig.T[:3, :3], T=rig.T[:3, 3:], image_size=[rig.size]),)


def opencv_projections(rig: Drawn) -> tuple[str, ...]:
    P1, P2 = (np.reshape(P, (3, 4)) for P in rig.projections())
    return (storage(P1=P1, P2=P2, D1=[rig.lenses[0]], image_size=[rig.size]),)


def kalibr(rig: Drawn, model: str = "radtan") -> tuple[str, ...]:
    chain: dict[str, Any] = {}
    for n in range(2):
        chain[f"cam{n}"] = {"camera_model": "pinhole", "intrinsics": rig.numbers(n), "cam_overlaps": [1 - n]}
        chain[f"cam{n}"] |= {"distortion_model": model, "distortion_coeffs": rig.lenses[n]}
        chain[f"cam{n}"] |= {"resolution": list(rig.size), "rostopic": f"/cam{n}/image_raw"}
    chain["cam1"]["T_cn_cnm1"] = rig.T.tolist()
    return (yaml.safe_dump(chain),)


def kalibr_fisheye(rig: Drawn) -> tuple[str, ...]:
    return kalibr(rig, "equidistant")


def kalibr_openvins(rig: Drawn, key: str = "T_imu_cam") -> tuple[str, ...]:
    """OpenVINS' chain: cameras state their pose relative to the IMU, not to each other."""
    chain = yaml.safe_load(kalibr(rig)[0])
    del chain["cam1"]["T_cn_cnm1"]
    for n, T in enumerate(rig.worlds):
        chain[f"cam{n}"][key] = (np.linalg.inv(T) if key == "T_imu_cam" else T).tolist()
    return ("%YAML:1.0\n\n" + yaml.safe_dump(chain),)


def kalibr_cam_imu(rig: Drawn) -> tuple[str, ...]:
    return kalibr_openvins(rig, "T_cam_imu")


def kalibr_below(rig: Drawn) -> tuple[str, ...]:
    """The chain of D-Robotics' stereo cameras."""
    return ("%YAML:1.0\n" + yaml.safe_dump({"stereo0": yaml.safe_load(kalibr(rig)[0])}),)


def kalibr_mins(rig: Drawn) -> tuple[str, ...]:
    """MINS' config_camera.yaml: OpenVINS' chain without models of cameras, below its own settings."""
    chain = yaml.safe_load(kalibr_openvins(rig)[0].partition("\n")[2])
    for camera in chain.values():
        del camera["camera_model"]
    return ("%YAML:1.0\n\ncam:\n  max_n: 2\n" + yaml.safe_dump(chain),)


def basalt(rig: Drawn, kind: str = "pinhole-radtan8", keys: str = "k1 k2 p1 p2") -> tuple[str, ...]:
    poses, cameras = [], []
    for n, T in enumerate(rig.worlds):
        E = np.linalg.inv(T)
        quaternion = zip(
            ("qx", "qy", "qz", "qw"), Rotation.from_matrix(E[:3, :3]).as_quat().tolist(), strict=True
        )
        poses.append(dict(zip(("px", "py", "pz"), E[:3, 3].tolist(), strict=True)) | dict(quaternion))
        values = dict(zip(("fx", "fy", "cx", "cy"), rig.numbers(n), strict=True))
        values |= dict.fromkeys(("k3", "k4", "k5", "k6"), 0.0) | dict(
            zip(keys.split(), rig.lenses[n], strict=True)
        )
        cameras.append({"camera_type": kind, "intrinsics": values})
    entries = {"T_imu_cam": poses, "intrinsics": cameras, "resolution": [list(rig.size)] * 2, "vignette": []}
    return (json.dumps({"value0": entries}, indent=4),)


def basalt_fisheye(rig: Drawn) -> tuple[str, ...]:
    return basalt(rig, "kb4", "k1 k2 k3 k4")


def vins(rig: Drawn, kind: str = "PINHOLE") -> tuple[str, ...]:
    """A configuration, and the two files that it names next to itself."""
    K_names, lens_names = {
        "PINHOLE": ("fx fy cx cy", "k1 k2 p1 p2"),
        "KANNALA_BRANDT": ("mu mv u0 v0", "k2 k3 k4 k5"),
    }[kind]
    config = storage(**{f"body_T_cam{n}": np.linalg.inv(T) for n, T in enumerate(rig.worlds)})
    texts = [config + 'imu: 1\nnum_of_cam: 2\ncam0_calib: "file1.dat"\ncam1_calib: "file2.dat"\n']
    for n in range(2):
        K = dict(zip(K_names.split(), rig.numbers(n), strict=True))
        lens = dict(zip(lens_names.split(), rig.lenses[n], strict=True))
        head = {"model_type": kind, "image_width": rig.size[0], "image_height": rig.size[1]}
        parts = {"distortion_parameters": lens, "projection_parameters": K}
        if kind != "PINHOLE":
            parts = {"projection_parameters": lens | K}
        texts.append("%YAML:1.0\n---\n" + yaml.safe_dump(head | parts))
    return tuple(texts)


def vins_fisheye(rig: Drawn) -> tuple[str, ...]:
    return vins(rig, "KANNALA_BRANDT")


def matlab(rig: Drawn) -> tuple[str, ...]:
    """jsonencode(toStruct(stereoParams)): matrices that multiply rows, pixels from 1, millimetres."""
    entries: dict[str, Any] = {}
    for n in range(2):
        K = rig.K[n] + [[0, 0, 1], [0, 0, 1], [0, 0, 0]]
        k1, k2, p1, p2 = rig.lenses[n]
        camera = {"IntrinsicMatrix": K.T.tolist(), "RadialDistortion": [k1, k2], "WorldUnits": "mm"}
        camera |= {"TangentialDistortion": [p1, p2], "ImageSize": [rig.size[1], rig.size[0]]}
        entries[f"CameraParameters{n + 1}"] = camera
    entries["RotationOfCamera2"] = rig.T[:3, :3].T.tolist()
    entries["TranslationOfCamera2"] = (1000 * rig.T[:3, 3]).tolist()
    return (json.dumps(entries),)


def matlab_pose(rig: Drawn) -> tuple[str, ...]:
    """Since R2022b: matrices that multiply columns."""
    entries = json.loads(matlab(rig)[0])
    entries["PoseCamera2"] = {"R": rig.T[:3, :3].tolist(), "Translation": entries["TranslationOfCamera2"]}
    for n in range(2):
        camera = entries[f"CameraParameters{n + 1}"]
        camera["K"] = np.transpose(camera.pop("IntrinsicMatrix")).tolist()
    return (json.dumps(entries),)


def named(rig: Drawn) -> tuple[str, ...]:
    """Plain JSON of lists of lists, by the names of OpenCV's tutorials."""
    cameras = {"camera_matrix_left": rig.K[0], "camera_matrix_right": rig.K[1], "R": rig.T[:3, :3]}
    entries = {name: matrix.tolist() for name, matrix in cameras.items()} | {"T": rig.T[:3, 3:].tolist()}
    entries |= {"dist_left": rig.lenses[0], "dist_right": [rig.lenses[1]], "image_size": list(rig.size)}
    return (json.dumps(entries),)


def named_by_side(rig: Drawn) -> tuple[str, ...]:
    """An object a camera, and the pose as our own options take it."""
    sides = {
        side: {"K": rig.K[n].tolist(), "dist": rig.lenses[n]} for n, side in enumerate(("left", "right"))
    }
    return (json.dumps(sides | {"E": np.linalg.inv(rig.T).tolist(), "image_size": list(rig.size)}),)


def cityscapes(rig: Drawn) -> tuple[str, ...]:
    intrinsic = dict(zip(("fx", "fy", "u0", "v0"), rig.numbers(0), strict=True))
    extrinsic = {
        "baseline": float(-rig.T[0, 3]),
        "pitch": 0.03,
        "roll": 0.0,
        "x": 1.7,
        "y": 0.1,
        "yaw": -0.01,
    }
    return (json.dumps({"extrinsic": extrinsic, "intrinsic": intrinsic}),)


def spring(rig: Drawn) -> tuple[str, ...]:
    return (f"{words(rig.numbers(0))}\n{words(rig.numbers(0))}\n",)


def sceneflow(rig: Drawn) -> tuple[str, ...]:
    """camera_data.txt of Driving: camera-to-world poses in Blender's axes, a block a frame."""
    poses = [np.linalg.inv(T) @ np.diag([1.0, -1, -1, 1]) for T in rig.worlds]
    return ("".join(f"Frame {n}\nL {words(poses[0])}\nR {words(poses[1])}\n\n" for n in (5, 6)),)


def vkitti(rig: Drawn) -> tuple[str, ...]:
    """intrinsic.txt and extrinsic.txt: a line for each camera in each frame, poses world-to-camera."""
    K = "frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]\n"
    T = "frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1\n"
    for frame in range(3):
        for n, pose in enumerate(rig.worlds):
            K += f"{frame} {n} {words(rig.numbers(n))}\n"
            T += f"{frame} {n} {words(pose)}\n"
    return K, T


def euroc(rig: Drawn) -> tuple[str, ...]:
    texts = []
    for n, T in enumerate(rig.worlds):
        pose = {"rows": 4, "cols": 4, "data": np.linalg.inv(T).ravel().tolist()}
        entries = {"T_BS": pose, "camera_model": "pinhole", "intrinsics": rig.numbers(n), "rate_hz": 20}
        entries |= {"distortion_model": "radial-tangential", "distortion_coefficients": rig.lenses[n]}
        entries = yaml.safe_dump(entries | {"resolution": list(rig.size)})
        texts.append(f"# General sensor definitions.\nsensor_type: camera\n{entries}")
    return tuple(texts)


def okvis(rig: Drawn, model: str = "radialtangential") -> tuple[str, ...]:
    """OKVIS' settings, a flow mapping a camera, behind OpenCV's head."""
    cameras = []
    for n, T in enumerate(rig.worlds):
        fx, fy, cx, cy = rig.numbers(n)
        entries = {"T_SC": np.linalg.inv(T).ravel().tolist(), "image_dimension": list(rig.size)}
        entries |= {"distortion_coefficients": rig.lenses[n], "distortion_type": model}
        cameras.append(entries | {"focal_length": [fx, fy], "principal_point": [cx, cy]})
    return ("%YAML:1.0\n" + yaml.safe_dump({"cameras": cameras, "imu_rate": 200}, default_flow_style=None),)


def okvis_fisheye(rig: Drawn) -> tuple[str, ...]:
    return okvis(rig, "equidistant")


def svo(rig: Drawn, name: str = "T_B_C", model: str = "radial-tangential") -> tuple[str, ...]:
    """A rig of SVO: matrices with rows and columns, the camera next to its pose."""

    def matrix(values, columns: int) -> dict[str, Any]:
        data = np.ravel(values).tolist()
        return {"cols": columns, "rows": len(data) // columns, "data": data}

    cameras = []
    for n, T in enumerate(rig.worlds):
        lens = {"type": model, "parameters": matrix(rig.lenses[n], 1)}
        camera = {"label": f"cam{n}", "type": "pinhole", "intrinsics": matrix(rig.numbers(n), 1)}
        camera |= {"image_width": rig.size[0], "image_height": rig.size[1], "distortion": lens}
        cameras.append({"camera": camera, name: matrix(np.linalg.inv(T) if name == "T_B_C" else T, 4)})
    return (yaml.safe_dump({"label": "rig", "cameras": cameras, "imu_params": {"delay_imu_cam": 0.0}}),)


def svo_inverse(rig: Drawn) -> tuple[str, ...]:
    return svo(rig, "T_C_B")


def svo_fisheye(rig: Drawn) -> tuple[str, ...]:
    return svo(rig, model="equidistant")


def svo_sensors(rig: Drawn) -> tuple[str, ...]:
    """maplab's file of all sensors, of which one is the rig."""
    ncamera = yaml.safe_load(svo(rig)[0]) | {"sensor_type": "NCAMERA", "topic": ""}
    return (yaml.safe_dump({"sensors": [{"id": "a1", "sensor_type": "IMU"}, ncamera]}, sort_keys=False),)


def stella(rig: Drawn) -> tuple[str, ...]:
    fx, fy, cx, cy = rig.numbers(0)
    camera = {
        "name": "pair",
        "setup": "stereo",
        "model": "perspective",
        "fx": fx,
        "fy": fy,
        "cx": cx,
        "cy": cy,
    }
    camera |= {"cols": rig.size[0], "rows": rig.size[1], "focal_x_baseline": float(-fx * rig.T[0, 3])}
    return (yaml.safe_dump({"Camera": camera, "Mapping": {"backend": "g2o"}}),)


def airslam(rig: Drawn, kind: int = 1) -> tuple[str, ...]:
    """The pose of the left camera as Kalibr has it, that of the right one as EuRoC."""
    left, right = rig.worlds
    content: dict[str, Any] = {
        "image_width": rig.size[0],
        "image_height": rig.size[1],
        "distortion_type": kind,
    }
    for n, (T, of_type) in enumerate(((left, 1), (np.linalg.inv(right), 0))):
        entries = {"intrinsics": rig.numbers(n), "distortion_coeffs": [*rig.lenses[n], 0]}
        content[f"cam{n}"] = entries | {"T_type": of_type, "T": T.tolist()}
    return ("%YAML:1.0\n" + yaml.safe_dump(content),)


def airslam_fisheye(rig: Drawn) -> tuple[str, ...]:
    return airslam(rig, 2)


def stvo(rig: Drawn) -> tuple[str, ...]:
    """Four numbers a camera, and the pose as stereoCalibrate gives it."""
    entries = {"Kl": rig.numbers(0), "Kr": rig.numbers(1), "Dl": rig.lenses[0], "Dr": rig.lenses[1]}
    entries |= {"Rl": np.eye(3).ravel().tolist(), "Rr": np.eye(3).ravel().tolist(), "cam_bl": 0.12}
    entries |= {"R": rig.T[:3, :3].ravel().tolist(), "t": rig.T[:3, 3].tolist(), "cam_model": "Pinhole"}
    entries |= {"cam_width": rig.size[0], "cam_height": rig.size[1]}
    return (yaml.safe_dump({"cam0": entries, "images_subfolder_l": "cam0/data/"}),)


def stvo_rectified(rig: Drawn) -> tuple[str, ...]:
    numbers = dict(zip(("cam_fx", "cam_fy", "cam_cx", "cam_cy"), rig.numbers(0), strict=True))
    entries = (
        numbers
        | {"cam_bl": float(-rig.T[0, 3]), "cam_model": "Pinhole"}
        | {f"cam_d{n}": 0.0 for n in range(4)}
    )
    entries |= {"cam_width": rig.size[0], "cam_height": rig.size[1]}
    return (yaml.safe_dump({"cam0": entries}),)


def anipose(rig: Drawn, fisheye: bool = False) -> tuple[str, ...]:
    text = ""
    for n, T in enumerate(rig.worlds):
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()
        text += f'[cam_{n}]\nname = "cam{n}"\nsize = {list(rig.size)}\nmatrix = {rig.K[n].tolist()}\n'
        text += f"distortions = {rig.lenses[n]}\nrotation = {turn}\ntranslation = {T[:3, 3].tolist()}\n"
        text += "fisheye = true\n" if fisheye else ""
    return (text + "[metadata]\nadjusted = false\n",)


def anipose_fisheye(rig: Drawn) -> tuple[str, ...]:
    return anipose(rig, fisheye=True)


def anipose_caliscope(rig: Drawn) -> tuple[str, ...]:
    """caliscope's camera_array.toml: a table of cameras, rotations of nine numbers."""
    text = ""
    for n, T in enumerate(rig.worlds):
        text += f"[cameras.{n}]\ncam_id = {n}\nrotation_count = 0\nsize = {list(rig.size)}\n"
        text += f"matrix = {rig.K[n].tolist()}\ndistortions = {rig.lenses[n]}\n"
        text += f"translation = {T[:3, 3].tolist()}\nrotation = {T[:3, :3].tolist()}\n\n"
    return (text,)


def mc_calib(rig: Drawn, kind: int = 0) -> tuple[str, ...]:
    """calibrated_cameras_data.yml: poses are those of the cameras in the frame of the first of a group."""
    text = "%YAML:1.0\n---\nnb_camera: 2\n"
    for n, T in enumerate(rig.worlds):
        matrices = {"camera_matrix": rig.K[n], "distortion_vector": [rig.lenses[n]]}
        body = storage(**matrices).partition("---\n")[2] + f"distortion_type: {kind}\ncamera_group: 0\n"
        body += f"img_width: {rig.size[0]}\nimg_height: {rig.size[1]}\n"
        body += storage(camera_pose_matrix=np.linalg.inv(T)).partition("---\n")[2]
        text += f"camera_{n}:\n" + "".join(f"   {line}\n" for line in body.splitlines())
    return (text,)


def mc_calib_fisheye(rig: Drawn) -> tuple[str, ...]:
    return mc_calib(rig, 1)


def multical(rig: Drawn, relative: bool = False) -> tuple[str, ...]:
    """calibration.json: world-to-camera, or with a master the pose of the other next to it."""
    names = ("left_00123", "right_00124")
    cameras = {
        name: {"model": "standard", "image_size": list(rig.size), "K": K.tolist(), "dist": [lens]}
        for name, K, lens in zip(names, rig.K, rig.lenses, strict=True)
    }
    Ts = (np.eye(4), rig.T) if relative else rig.worlds
    keys = (names[0], f"{names[1]}_to_{names[0]}" if relative else names[1])
    poses = {key: {"R": T[:3, :3].tolist(), "T": T[:3, 3].tolist()} for key, T in zip(keys, Ts, strict=True)}
    return (json.dumps({"cameras": cameras, "image_sets": {"rgb": []}, "camera_poses": poses}, indent=2),)


def multical_relative(rig: Drawn) -> tuple[str, ...]:
    return multical(rig, relative=True)


def bouguet(rig: Drawn) -> tuple[str, ...]:
    """What the stereo part of Bouguet's toolbox prints, without its uncertainties."""
    text = "Stereo calibration parameters after optimization:\n"
    for n, side in enumerate(("left", "right")):
        (fx, fy, cx, cy), lens = rig.numbers(n), [*rig.lenses[n], 0.0]
        text += f"\nIntrinsic parameters of {side} camera:\n\n"
        text += f"Focal Length:          fc_{side} = [ {words([fx, fy])} ]\n"
        text += f"Principal point:       cc_{side} = [ {words([cx, cy])} ]\n"
        text += f"Skew:             alpha_c_{side} = [ 0.00000 ]\n"
        text += f"Distortion:            kc_{side} = [ {words(lens)} ]\n"
    turn = Rotation.from_matrix(rig.T[:3, :3]).as_rotvec()
    text += "\nExtrinsic parameters (position of right camera wrt left camera):\n\n"
    text += f"Rotation vector:             om = [ {words(turn)} ]\n"
    return (text + f"Translation vector:           T = [ {words(1000 * rig.T[:3, 3])} ]\n",)


def mrcal(rig: Drawn) -> tuple[str, ...]:
    """One .cameramodel a view: a dictionary of Python's with comments."""
    texts = []
    for n, T in enumerate(rig.worlds):
        pose = [*Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist(), *T[:3, 3].tolist()]
        texts.append(
            f"# generated by mrcal-calibrate-cameras\n{{\n    'lensmodel':  'LENSMODEL_OPENCV4',\n\n"
            f"    # intrinsics are fx,fy,cx,cy,distortion0,distortion1,....\n"
            f"    'intrinsics': {[*rig.numbers(n), *rig.lenses[n]]},\n"
            f"    'extrinsics': [ {', '.join(map(repr, pose))}, ],\n    'imagersize': {list(rig.size)}\n}}\n"
        )
    return tuple(texts)


def robotcar(rig: Drawn) -> tuple[str, ...]:
    """The pose of the images' axes in a frame of x forward, y right, z down."""
    axes = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    poses = (axes, axes @ np.linalg.inv(rig.T))
    rows = [[rig.numbers(n), *poses[n].tolist()] for n in range(2)]
    return tuple("".join(f"{words(row)}\n" for row in each) for each in rows)


def argoverse(rig: Drawn) -> tuple[str, ...]:
    names = ("focal_length_x_px_", "focal_length_y_px_", "focal_center_x_px_", "focal_center_y_px_")
    cameras = []
    for n, side in enumerate(("left", "right")):
        numbers = dict(zip(names, rig.numbers(n), strict=True))
        place = [1.6, 0.15 + float(rig.T[0, 3]) * n, 1.36]
        raw = {name: 1.1 * value for name, value in numbers.items()}
        pose = {"rotation": {"coefficients": [0.5, -0.5, 0.5, -0.5]}, "translation": place}
        cameras.append(
            {"key": f"image_raw_stereo_front_{side}", "value": raw | {"vehicle_SE3_camera_": pose}}
        )
        pose = {"rotation": {"coefficients": [1, 0, 0, 0]}, "translation": [0, 0, 0]}
        name = f"image_raw_stereo_front_{side}_rect"
        cameras.append({"key": name, "value": numbers | {"vehicle_SE3_camera_": pose}})
    return (json.dumps({"camera_data_": cameras}, indent=4),)


def ros_ini(rig: Drawn) -> tuple[str, ...]:
    """left.ini and right.ini of camera_calibration."""
    texts = []
    for P in rig.projections(0.25):
        rows = [
            "\n".join(words(row) for row in matrix) for matrix in (rig.K[0], np.eye(3), np.reshape(P, (3, 4)))
        ]
        texts.append(
            f"# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n{rig.size[0]}\n\nheight\n{rig.size[1]}\n\n"
            f"[narrow_stereo/left]\n\ncamera matrix\n{rows[0]}\n\ndistortion\n-0.28 0.09 0.0 0.0 0.0\n\n"
            f"rectification\n{rows[1]}\n\nprojection\n{rows[2]}\n\n"
        )
    return tuple(texts)


def orb_slam(rig: Drawn, kind: str = "PinHole", keys: str = "k1 k2 p1 p2") -> tuple[str, ...]:
    text = f'%YAML:1.0\n\nFile.version: "1.0"\nCamera.type: "{kind}"\n'
    text += f"Camera.width: {rig.size[0]}\nCamera.height: {rig.size[1]}\nCamera.fps: 20\n"
    for n in range(2):
        entries = zip(("fx fy cx cy " + keys).split(), [*rig.numbers(n), *rig.lenses[n]], strict=True)
        text += "".join(f"Camera{n + 1}.{key}: {value!r} # pixels\n" for key, value in entries)
    return (text + storage(**{"Stereo.T_c1_c2": np.linalg.inv(rig.T)}).partition("---\n")[2],)


def orb_slam_fisheye(rig: Drawn) -> tuple[str, ...]:
    return orb_slam(rig, "KannalaBrandt8", "k1 k2 k3 k4")


def orb_slam_rectified(rig: Drawn) -> tuple[str, ...]:
    fx, fy, cx, cy = rig.numbers(0)
    text = f"%YAML:1.0\nCamera.fx: {fx}\nCamera.fy: {fy}\nCamera.cx: {cx}\nCamera.cy: {cy}\n"
    text += "".join(f"Camera.{key}: 0.0\n" for key in ("k1", "k2", "p1", "p2"))
    text += f"Camera.width: {rig.size[0]}\nCamera.height: {rig.size[1]}\n\n# stereo baseline times fx\n"
    return (text + f"Camera.bf: {float(-fx * rig.T[0, 3])!r}\nThDepth: 35 # times the baseline\n",)


def mvsnet(rig: Drawn) -> tuple[str, ...]:
    pairs = zip(rig.worlds, rig.K, strict=True)
    return tuple(f"extrinsic\n{words(T)}\n\nintrinsic\n{words(K)}\n\n0.5 0.01\n" for T, K in pairs)


def zed(rig: Drawn) -> tuple[str, ...]:
    text = ""
    for n, side in enumerate(("LEFT", "RIGHT")):
        entries = zip("fx fy cx cy k1 k2 p1 p2".split(), [*rig.numbers(n), *rig.lenses[n]], strict=True)
        text += f"[{side}_CAM_HD]\n" + "".join(f"{key}={value!r}\n" for key, value in entries) + "k3=0\n\n"
        text += f"[{side}_CAM_2K]\nfx=1400\nfy=1400\ncx=1100\ncy=620\nk1=0\n\n"
    shift = zip(("Baseline", "TY", "TZ"), -1000 * rig.T[:3, 3], strict=True)
    turn = Rotation.from_matrix(rig.T[:3, :3]).as_rotvec()
    keys = (f"{key}_{size}" for size in ("HD", "2K") for key in ("RX", "CV", "RZ"))
    turns = zip(keys, [*turn] * 2, strict=True)
    text += "[STEREO]\n" + "".join(f"{key}={float(value)!r}\n" for key, value in (*shift, *turns))
    return (text,)


def realsense(rig: Drawn) -> tuple[str, ...]:
    def camera(n: int) -> dict:
        entries = dict(zip(("fx", "fy", "ppx", "ppy"), rig.numbers(n), strict=True))
        entries |= {"width": rig.size[0], "height": rig.size[1], "model": "distortion.brown_conrady"}
        return entries | {"coeffs": [*rig.lenses[n], 0.0]}

    between = {"rotation": rig.T[:3, :3].T.ravel().tolist(), "translation": rig.T[:3, 3].tolist()}
    entries = {"intrinsics": {"infra1": camera(0), "infra2": camera(1)}, "extrinsics": between}
    return (json.dumps({"serial": "1"} | entries, indent=1),)


def realsense_printed(rig: Drawn) -> tuple[str, ...]:
    """What rs-enumerate-devices -c prints, behind its list of modes."""
    text = "Intrinsic Parameters:\n\n"
    for n in range(2):
        fx, fy, cx, cy = rig.numbers(n)
        text += f' Intrinsic of "Infrared {n + 1}" / {rig.size[0]}x{rig.size[1]} / {{Y8}}\n'
        text += f"  Width: \t{rig.size[0]}\n  Height: \t{rig.size[1]}\n  PPX: \t{cx}\n  PPY: \t{cy}\n"
        text += f"  Fx: \t{fx}\n  Fy: \t{fy}\n  Distortion: \tBrown Conrady\n"
        text += f"  Coeffs: \t{words([*rig.lenses[n], 0])}\n  FOV (deg): \t49.13 x 37.85\n\n"
    text += "Extrinsic Parameters:\n\n"
    for target, T in (("1", np.eye(4)), ("2", rig.T)):
        rows = "\n".join(words(row) for row in T[:3, :3])
        text += f' Extrinsic from "Infrared 1"  To  "Infrared {target}" :\n Rotation Matrix:\n{rows}\n'
        text += f"\n Translation Vector: {words(T[:3, 3])}\n\n"
    return (text,)


def oak(rig: Drawn) -> tuple[str, ...]:
    """The left camera (socket 1) is linked to the right one (2), that to the colour camera (0)."""
    affinities = {1: (2, rig.T), 2: (0, rigid([0, 0, 0], [0.04, 0, 0])), 0: (-1, np.eye(4))}
    cameras = []
    for n, socket in ((1, 2), (0, 1), (1, 0)):
        to, T = affinities[socket]
        shift = dict(zip("xyz", (100 * T[:3, 3]).tolist(), strict=True))
        extrinsics = {"toCameraSocket": to, "rotationMatrix": T[:3, :3].tolist(), "translation": shift}
        entries = {"cameraType": 0, "distortionCoeff": rig.lenses[n] + [0.0] * 10, "extrinsics": extrinsics}
        entries |= {"intrinsicMatrix": rig.K[n].tolist(), "width": rig.size[0], "height": rig.size[1]}
        cameras.append([socket, entries])
    return (json.dumps({"boardName": "OAK-D", "cameraData": cameras, "version": 6}, indent=1),)


def _sfm(rig: Drawn) -> list[np.ndarray]:
    """World-to-camera of left, another and right image, in units."""
    left, right = (T.copy() for T in rig.worlds)
    poses = [left, rigid([0.1, 3.0, 0.2], [5, 6, 7]), right]
    for T in (left, right):
        T[:3, 3] /= UNIT_M
    return poses


def colmap(rig: Drawn) -> tuple[str, ...]:
    cameras = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, PARAMS[]\n"
    for n in range(2):
        fx, fy, cx, cy = rig.numbers(n)  # the first pixel's centre lies at half a pixel
        numbers = words([fx, fy, cx + 0.5, cy + 0.5, *rig.lenses[n]])
        cameras += f"{n + 1} OPENCV {rig.size[0]} {rig.size[1]} {numbers}\n"
    images = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ\n"
    for T, n, name in zip(_sfm(rig), (0, 0, 1), (NAMES[0], "rig/other.jpg", NAMES[1]), strict=True):
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        number = images.count("jpg") + 1
        images += f"{number} {words([w, x, y, z, *T[:3, 3]])} {n + 1} {name}\n320.5 240.25 17\n"
    return cameras, images


def nerf(rig: Drawn) -> tuple[str, ...]:
    frames = []
    for T, n, name in zip(_sfm(rig), (0, 0, 1), (NAMES[0], "rig/other.jpg", NAMES[1]), strict=True):
        fx, fy, cx, cy = rig.numbers(n)
        pose = np.linalg.inv(T) @ np.diag([1.0, -1, -1, 1])  # y up, looking along -z
        frame = {"file_path": f"./{name}", "transform_matrix": pose.tolist(), "colmap_im_id": n}
        frame |= {"fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": rig.size[0], "h": rig.size[1]}
        frames.append(frame | dict(zip(("k1", "k2", "p1", "p2"), rig.lenses[n], strict=True)))
    return (json.dumps({"camera_model": "OPENCV", "frames": frames}),)


def middlebury(rig: Drawn) -> tuple[str, ...]:
    cam0, cam1 = ("[" + "; ".join(words(row) for row in K) + "]" for K in rig.K)
    doffs, baseline = float(rig.K[1][0, 2] - rig.K[0][0, 2]), float(-1000 * rig.T[0, 3])
    text = f"cam0={cam0}\ncam1={cam1}\ndoffs={doffs!r}\nbaseline={baseline!r}\n"
    return (text + f"width={rig.size[0]}\nheight={rig.size[1]}\nndisp=64\n",)


def middlebury_blanks(rig: Drawn) -> tuple[str, ...]:
    """The same with blanks around everything."""
    text = middlebury(rig)[0].replace("[", "[ ").replace("]", " ] ").replace("=", "= ")
    return ("\n ".join(text.splitlines()) + "\n",)


def kitti_cam_to_cam(rig: Drawn) -> tuple[str, ...]:
    text = "calib_time: 09-Jan-2012 13:57:47\ncorner_dist: 9.950000e-02\n"
    for n, P in zip((2, 3), rig.projections(0.7), strict=True):
        text += f"D_0{n}: -3.6e-01 2.0e-01\nS_rect_0{n}: {words(rig.size)}\nR_rect_0{n}: 1 0 0 0 1 0 0 0 1\n"
        text += f"P_rect_0{n}: {words(P)}\n"
    return (text,)


def kitti_projections(rig: Drawn) -> tuple[str, ...]:
    return ("".join(f"P{n}: {words(P)}\n" for n, P in enumerate(rig.projections(-0.4))) + "R0_rect: 1 0 0\n",)


def booster(rig: Drawn) -> tuple[str, ...]:
    matrices = "".join(
        f'<{name} type_id="opencv-matrix"><rows>3</rows><cols>4</cols><dt>d</dt><data>\n{words(P)}'
        f"</data></{name}>\n"
        for name, P in zip(("proj_matL", "proj_matR"), rig.projections(), strict=True)
    )
    baseline = f"<baselineLR>{float(-1000 * rig.T[0, 3])!r}</baselineLR>"
    return (f'<?xml version="1.0"?>\n<opencv_storage>\n{matrices}{baseline}</opencv_storage>\n',)


def quest(rig: Drawn) -> tuple[str, ...]:
    """MrukIntrinsicsMetadata of QuestRealityCapture: the images are the middle of a larger sensor, halved.

    Unity's camera sees X right, Y up and Z forward; rows of the sensor are counted from the bottom.
    """
    texts, (width, height) = [], rig.size
    for side, name in enumerate(("Left", "Right")):
        fx, fy, cx, cy = rig.numbers(side)
        head = np.linalg.inv(rig.worlds[side])
        right, down, forward = head[:3, :3].T
        axes = np.stack([right, -down, forward], -1) * [[1], [-1], [1]]
        x, y, z, w = map(float, Rotation.from_matrix(axes).as_quat())
        place = dict(zip("xyz", map(float, head[:3, 3] * [1, -1, 1]), strict=True))
        from_bottom = 2 * (height - 0.5 - cy) + (3 * height - 2 * height) / 2
        entries = {
            **{"backend": "MRUK", "cameraPosition": name, "imageFormat": "RGBA32"},
            "focalLength": {"x": 2 * fx, "y": 2 * fy},
            "principalPoint": {"x": 2 * (cx + 0.5), "y": from_bottom},
            "resolution": {"width": width, "height": height},
            "sensorResolution": {"width": 2 * width, "height": 3 * height},
            "currentResolution": {"width": width, "height": height},
            "lensOffset": {"position": place, "rotation": {"x": x, "y": y, "z": z, "w": w}},
            "error": "",
        }
        texts.append(json.dumps(entries, indent=4))
    return tuple(texts)


def spatial_photo(rig: Drawn) -> tuple[str, ...]:
    """What is read of a HEIC file; pixels are counted from the corner of the first one."""
    cameras = []
    for side, x_um in enumerate((0, float(-1e6 * rig.T[0, 3]))):
        fx, fy, cx, cy = rig.numbers(side)
        entries = {"size": list(rig.size), "focal": [fx, fy], "centre": [cx + 0.5, cy + 0.5], "x_um": x_um}
        cameras.append(entries)
    return (json.dumps({"spatial_photo": cameras}),)


def stereodemo(rig: Drawn) -> tuple[str, ...]:
    fx, fy, cx, cy = rig.numbers(0)
    entries = {"fx": fx, "fy": fy, "cx0": cx, "cx1": rig.numbers(1)[2], "cy": cy}
    entries |= {"baseline_meters": float(-rig.T[0, 3]), "width": rig.size[0], "height": rig.size[1]}
    return (json.dumps(entries | {"depth_range": [1.0, 100.0]}),)


def foundation_stereo(rig: Drawn) -> tuple[str, ...]:
    return (f"{words(rig.K[0])}\n{float(-rig.T[0, 3])!r}\n",)


def ros(rig: Drawn) -> tuple[str, ...]:
    """left.yaml and right.yaml of camera_calibration."""
    texts = []
    for P in rig.projections(0.25):
        entries = {"image_width": rig.size[0], "image_height": rig.size[1], "distortion_model": "plumb_bob"}
        entries |= {"distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.28, 0.09, 0.0, 0.0, 0.0]}}
        texts.append(yaml.safe_dump(entries | {"projection_matrix": {"rows": 3, "cols": 4, "data": P}}))
    return tuple(texts)


def ros_echo(rig: Drawn) -> tuple[str, ...]:
    """What ros2 topic echo --once /left/camera_info prints."""
    head = f"header:\n  stamp:\n    sec: 17\nheight: {rig.size[1]}\nwidth: {rig.size[0]}\n"
    return tuple(
        f"{head}distortion_model: plumb_bob\nd: [-0.28, 0.09]\np: {P}\n---\n" for P in rig.projections()
    )


#: Formats of any pose and of rectified pairs, and those with one camera for both images: the function's name
#: begins with that of the format.
ANY_POSE = (
    *(opencv, kalibr, euroc, orb_slam, mvsnet, zed, realsense, realsense_printed, oak, quest, colmap, nerf),
    *(kalibr_fisheye, orb_slam_fisheye, kalibr_openvins, kalibr_cam_imu, basalt, basalt_fisheye),
    *(vins, vins_fisheye, matlab, matlab_pose, named, named_by_side),
    *(okvis, okvis_fisheye, svo, svo_inverse, svo_fisheye, airslam, airslam_fisheye),
    *(anipose, anipose_fisheye, anipose_caliscope, mrcal, stvo),
    *(mc_calib, mc_calib_fisheye, multical, multical_relative, bouguet, svo_sensors),
    *(kalibr_mins, kalibr_below),
)
RECTIFIED = (
    *(middlebury, middlebury_blanks, kitti_cam_to_cam, kitti_projections, booster, stereodemo, ros, ros_echo),
    *(opencv_projections, vkitti, argoverse, ros_ini, robotcar, spatial_photo),
)
ONE_CAMERA = (stella, stvo_rectified, foundation_stereo, orb_slam_rectified, cityscapes, spring, sceneflow)

#: A rig of 0.12 m in every format, by the name of the function.
K = np.array([[700.0, 0, 300], [0, 700.0, 200], [0, 0, 1]])
SHIFT, WORLD = rigid([0, 0, 0], [-0.12, 0, 0]), rigid([0, 0, 0], [1, 2, 3])
RIG = Drawn((K, K), SHIFT, (640, 480), ([0.0] * 4, [0.0] * 4), WORLD)
SAMPLES = {w.__name__: w(RIG) for w in ANY_POSE + RECTIFIED + ONE_CAMERA if "fisheye" not in w.__name__}


def choice(sample: str, baseline_m: float = 0.12) -> dict[str, Any]:
    """What ``read_calibration`` needs next to the text."""
    by_name = {"image_names": NAMES, "baseline_m": baseline_m}
    needed = {"zed": {"image_size": (1280, 720)}, "colmap": by_name, "nerf": by_name}
    needed |= {"vkitti": {"image_names": ("Camera_0/rgb_00002.jpg", "Camera_1/rgb_00002.jpg")}}
    needed |= {"spring": {"baseline_m": baseline_m}}
    by_frame = tuple(f"35mm_focallength/fast/{side}/0006.png" for side in ("left", "right"))
    return (needed | {"sceneflow": by_name | {"image_names": by_frame}}).get(sample, {})


def written(folder: Path, texts: tuple[str, ...]) -> Path | tuple[Path, ...]:
    """Files with arbitrary names: formats are recognised by content."""
    paths = tuple(folder / f"file{i}.dat" for i in range(len(texts)))
    for path, text in zip(paths, texts, strict=True):
        path.write_text(text)
    return paths[0] if len(paths) == 1 or "cam0_calib" in texts[0] else paths


def read_texts(folder: Path, *texts: str, **given: Any) -> Rig:
    """The rig of texts that are written to files first, ``given`` as ``read_calibration`` takes it."""
    return read_calibration(written(folder, texts), **given)
