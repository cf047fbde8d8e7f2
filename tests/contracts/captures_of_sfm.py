"""The walk of ``captures`` as kapture, OpenMVG, AliceVision and RealityScan write it."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tests.contracts.captures import TRUE, Twin, images, quaternion, words
from tests.unit.capture_room import SIZE, K

#: OpenMVG has one focal length.
ROUND = np.array([[200.0, 0, 118.0], [0, 200.0, 91.0], [0, 0, 1]])
#: AliceVision 1.2.6: millimetres on a sensor of this width.
SENSOR_MM = 6.4


def _pose(T: np.ndarray) -> str:
    x, y, z, w = quaternion(T)
    return ", ".join(repr(float(v)) for v in (w, x, y, z, *T[:3, 3]))


def kapture(folder: Path) -> Twin:
    """One image has a pose of its own, the others that of the rig which the camera is part of."""
    sensors = folder / "sensors"
    images(sensors / "records_data" / "walk one", [f"{i:03d}.png" for i in range(4)])
    T_camera_from_rig = np.eye(4)
    T_camera_from_rig[:3, :3] = Rotation.from_rotvec([0.02, -0.4, 0.1]).as_matrix()
    T_camera_from_rig[:3, 3] = 0.05, -0.01, 0.02
    poses = [np.linalg.inv(E) for E in TRUE]
    rows = [f"0, cam, {_pose(poses[0])}"]
    rows += [f"{i}, rig, {_pose(np.linalg.inv(T_camera_from_rig) @ poses[i])}" for i in (1, 2, 3)]
    rows.append("7, cam, , , , , , , ")
    numbers = ", ".join(map(str, (*SIZE, K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5)))
    files = {
        "sensors": f"cam, a phone, camera, PINHOLE, {numbers}\nwifi, , wifi",
        "records_camera": "\n".join(f"{i}, cam, walk one/{i:03d}.png" for i in range(4)),
        "trajectories": "\n".join(rows),
        "rigs": f"rig, cam, {_pose(T_camera_from_rig)}",
    }
    for name, text in files.items():
        (sensors / f"{name}.txt").write_text(f"# kapture format: 1.1\n# columns\n{text}\n")
    return Twin(folder, unit=None, file="sensors/trajectories.txt")


def openmvg(folder: Path) -> Twin:
    """Next to it lies the file without poses that the program begins with."""
    images(folder / "images" / "set", [f"M_{i}.png" for i in range(4)], ROUND)
    views, poses = [], []
    for i, E in enumerate(TRUE):
        view = {"local_path": "set", "filename": f"M_{i}.png", "width": SIZE[0], "height": SIZE[1]}
        view |= {"id_view": i, "id_intrinsic": 5 + i % 2, "id_pose": 10 + i}
        views.append({"key": i, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": i, "data": view}}})
        pose = {"rotation": E[:3, :3].T.tolist(), "center": E[:3, 3].tolist()}
        poses.append({"key": 10 + i, "value": pose})
    camera = {"width": SIZE[0], "height": SIZE[1], "focal_length": 200.0, "principal_point": [118.0, 91.0]}
    first = {"polymorphic_id": (1 << 31) + 1, "polymorphic_name": "pinhole_brown_t2"}
    wrapped = {"ptr_wrapper": {"id": 1, "data": {"value0": camera, "disto_t2": [0.0] * 5}}}
    cameras = [
        {"key": 5, "value": first | wrapped},
        {"key": 6, "value": {"polymorphic_id": 1} | wrapped},
    ]
    data = {"sfm_data_version": "0.3", "root_path": "/old", "views": views, "intrinsics": cameras}
    (folder / "sfm_data.json").write_text(json.dumps(data | {"extrinsics": []}))
    (folder / "sfm_data_final.json").write_text(json.dumps(data | {"extrinsics": poses}))
    return Twin(folder, ROUND, unit=None, file="sfm_data_final.json")


def alicevision(folder: Path) -> Twin:
    """Numbers are text, rotations columns first, the principal point an offset from the middle."""
    images(folder / "images", [f"A_{i}.png" for i in range(4)])
    views, poses = [], []
    for i, E in enumerate(TRUE):
        view = {"viewId": f"{i}", "poseId": f"{20 + i}", "intrinsicId": "3", "path": f"D:/set/A_{i}.png"}
        views.append(view | {"width": str(SIZE[0]), "height": str(SIZE[1])})
        rotation = [repr(float(v)) for v in E[:3, :3].T.ravel(order="F")]
        centre = [repr(float(v)) for v in E[:3, 3]]
        pose = {"transform": {"rotation": rotation, "center": centre}, "locked": "0"}
        poses.append({"poseId": f"{20 + i}", "pose": pose})
    views.append(views[0] | {"viewId": "9", "poseId": "99", "path": "D:/set/A_9.png"})
    offset = [repr(float(K[i, 2] - SIZE[i] / 2)) for i in range(2)]
    camera = {"intrinsicId": "3", "width": str(SIZE[0]), "height": str(SIZE[1]), "type": "radial3"}
    camera |= {"sensorWidth": str(SENSOR_MM), "focalLength": repr(float(K[0, 0] * SENSOR_MM / SIZE[0]))}
    camera |= {"pixelRatio": repr(float(K[1, 1] / K[0, 0])), "principalPoint": offset}
    camera |= {"distortionParams": ["0", "0", "0"], "undistortionParams": ""}
    data = {"version": ["1", "2", "6"], "views": views, "intrinsics": [camera], "poses": poses}
    (folder / "cameras.sfm").write_text(json.dumps(data))
    return Twin(folder, unit=None, file="cameras.sfm")


def realityscan(folder: Path) -> Twin:
    """A sidecar next to each image, its numbers as attributes and as elements."""
    images(folder, [f"R_{i}.png" for i in range(4)], ROUND)
    longer = max(SIZE)
    u, v = ((ROUND[i, 2] + 0.5 - SIZE[i] / 2) / longer for i in range(2))
    for i, E in enumerate(TRUE):
        (folder / f"R_{i}.xmp").write_text(
            '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
            '<rdf:Description xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#" xcr:Version="3" '
            f'xcr:DistortionModel="perspective" xcr:FocalLength35mm="{200.0 / longer * 36}" xcr:Skew="0" '
            f'xcr:AspectRatio="1" xcr:PrincipalPointU="{u}" xcr:PrincipalPointV="{v}">'
            f"<xcr:Rotation>{words(E[:3, :3].T)}</xcr:Rotation><xcr:Position>{words(E[:3, 3])}</xcr:Position>"
            "<xcr:DistortionCoeficients>0 0 0 0 0 0</xcr:DistortionCoeficients>"
            "</rdf:Description></rdf:RDF></x:xmpmeta>"
        )
    return Twin(folder, ROUND, unit=None, file="R_2.xmp")


WRITERS = (kapture, openmvg, alicevision, realityscan)
