"""One walk through the room of ``capture_room`` as every reader's program writes it."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation

from tests.unit.capture_room import FLIP, SIZE, K, render, walk

TRUE = walk(4)
#: Cameras whose formats put the principal point in the middle, or are of one camera in the world.
CENTRAL = np.array([[200.0, 0, (SIZE[0] - 1) / 2], [0, 200.0, (SIZE[1] - 1) / 2], [0, 0, 1]])
TARTAN = np.array([[320.0, 0, 320], [0, 320.0, 240], [0, 0, 1]])
TARTAN_SIZE = (640, 480)


@dataclass(frozen=True)
class Twin:
    """A written capture and what must be read of it, next to the poses ``TRUE``."""

    path: Path
    K: np.ndarray = field(default_factory=K.copy)
    unit: str | None = "m"
    has_depth: bool = False
    typed: np.ndarray | None = None  # K that the user has to type
    size: tuple[int, int] = SIZE
    file: str = ""  # that describes the cameras, below ``path``


def images(folder: Path, names, matrix=K, size=SIZE) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, E in zip(names, TRUE, strict=True):
        Image.fromarray(render(E, size, matrix)[0]).save(folder / name)


def depths(folder: Path, names, per_m: float = 1000.0) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, E in zip(names, TRUE, strict=True):
        Image.fromarray(np.rint(render(E)[1] * per_m).astype(np.uint16)).save(folder / name)


def quaternion(E: np.ndarray) -> list[float]:
    """x, y, z, w."""
    return Rotation.from_matrix(E[:3, :3]).as_quat().tolist()


def words(values) -> str:
    return " ".join(repr(float(v)) for v in np.ravel(values))


def polycam(folder: Path) -> Twin:
    keyframes = folder / "keyframes"
    stems = [f"16680000{i}0" for i in range(4)]
    images(keyframes / "corrected_images", [f"{stem}.png" for stem in stems])
    images(keyframes / "images", [f"{stem}.png" for stem in stems])  # before Polycam's own adjustment
    depths(keyframes / "depth", [f"{stem}.png" for stem in stems])
    for place, off in (("corrected_cameras", 0.0), ("cameras", 0.3)):
        (keyframes / place).mkdir()
        for stem, E in zip(stems, TRUE, strict=True):
            pose = E @ FLIP
            entries = {f"t_{i}{j}": float(pose[i, j]) + off * (j == 3) for i in range(3) for j in range(4)}
            entries |= {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2] + 0.5, "cy": K[1, 2] + 0.5}
            entries |= {"width": SIZE[0], "height": SIZE[1], "blur_score": 100.0}
            (keyframes / place / f"{stem}.json").write_text(json.dumps(entries))
    (folder / "mesh_info.json").write_text("{}")
    return Twin(folder, has_depth=True, file="keyframes/corrected_cameras/1668000000.json")


def record3d(folder: Path) -> Twin:
    images(folder / "rgb", [f"{i}.png" for i in range(4)])
    poses = [[*quaternion(E @ FLIP), *E[:3, 3].tolist()] for E in TRUE]
    by_columns = (K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).T.ravel().tolist()
    entries = {"K": by_columns, "poses": poses, "w": SIZE[0], "h": SIZE[1], "dw": 192, "dh": 144, "fps": 60}
    (folder / "metadata.json").write_text(json.dumps(entries))
    return Twin(folder, file="metadata.json")


def stray(folder: Path) -> Twin:
    folder.mkdir(parents=True)
    writer = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 60, SIZE)
    for E in TRUE:
        writer.write(render(E)[0][..., ::-1])
    writer.release()
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(repr(float(v)) for v in row) for row in K))
    text = "timestamp, frame, x, y, z, qx, qy, qz, qw\n"
    for i, E in enumerate(TRUE):
        numbers = ", ".join(repr(float(v)) for v in (*E[:3, 3], *quaternion(E)))
        text += f"{17.5 + i / 60:.6f}, {i:06d}, {numbers}\n"
    (folder / "odometry.csv").write_text(text)
    depths(folder / "depth", [f"{i:06d}.png" for i in range(4)])
    return Twin(folder, has_depth=True, file="odometry.csv")


def euroc(folder: Path) -> Twin:
    T_body_camera = np.eye(4)
    T_body_camera[:3, :3] = Rotation.from_rotvec([0.1, -1.5, 0.2]).as_matrix()
    T_body_camera[:3, 3] = -0.02, -0.06, 0.01
    cam, ground_truth = folder / "mav0" / "cam0", folder / "mav0" / "state_groundtruth_estimate0"
    stamps = [1403636579763555584 + 50_000_000 * i for i in range(4)]
    images(cam / "data", [f"{ns}.png" for ns in stamps])
    pose = {"rows": 4, "cols": 4, "data": T_body_camera.ravel().tolist()}
    sensor = {"sensor_type": "camera", "T_BS": pose, "rate_hz": 20, "resolution": list(SIZE)}
    sensor |= {"camera_model": "pinhole", "intrinsics": [200.0, 205.0, 118.0, 91.0]}
    sensor |= {"distortion_model": "radial-tangential", "distortion_coefficients": [0.0] * 4}
    (cam / "sensor.yaml").write_text(yaml.safe_dump(sensor))
    listed = "".join(f"{ns},{ns}.png\n" for ns in stamps)
    (cam / "data.csv").write_text("#timestamp [ns],filename\n" + listed)
    ground_truth.mkdir()
    rows = (
        "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []\n"
    )
    for ns, E in zip(stamps, TRUE, strict=True):
        body = E @ np.linalg.inv(T_body_camera)
        x, y, z, w = quaternion(body)
        rows += f"{ns}," + words([*body[:3, 3], w, x, y, z, 0.1, 0.2, 0.3]).replace(" ", ",") + "\n"
    (ground_truth / "data.csv").write_text(rows)
    return Twin(folder, file="mav0/state_groundtruth_estimate0/data.csv")


def tartanair(folder: Path) -> Twin:
    images(folder / "image_left", [f"{i:06d}_left.png" for i in range(4)], TARTAN, TARTAN_SIZE)
    ned_from_opencv = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])
    rows = []
    for E in TRUE:
        turn = Rotation.from_matrix(E[:3, :3] @ ned_from_opencv.T)
        rows.append(words([*E[:3, 3], *turn.as_quat()]))
    (folder / "pose_left.txt").write_text("\n".join(rows) + "\n")
    (folder / "depth_left").mkdir()
    for i, E in enumerate(TRUE):
        depth = render(E, TARTAN_SIZE, TARTAN)[1].astype(np.float32)
        np.save(folder / "depth_left" / f"{i:06d}_left_depth.npy", depth)
    return Twin(folder, TARTAN, has_depth=True, size=TARTAN_SIZE, file="pose_left.txt")


def kitti_odometry(folder: Path) -> Twin:
    sequence = folder / "sequences" / "04"
    images(sequence / "image_2", [f"{i:06d}.png" for i in range(4)])
    place = np.array([0.06, -0.002, 0.004])  # of camera 2 in camera 0's frame
    P0, P2 = (words(K @ np.column_stack([np.eye(3), -t])) for t in (np.zeros(3), place))
    (sequence / "calib.txt").write_text(
        f"P0: {P0}\nP1: {P0}\nP2: {P2}\nP3: {P2}\nTr: {words(np.eye(4)[:3])}\n"
    )
    shift = np.eye(4)
    shift[:3, 3] = place
    (folder / "poses").mkdir()
    rows = [words((E @ np.linalg.inv(shift))[:3]) for E in TRUE]
    (folder / "poses" / "04.txt").write_text("\n".join(rows) + "\n")
    return Twin(sequence, file="calib.txt")


def mvsnet(folder: Path) -> Twin:
    images(folder / "images", [f"{i:08d}.png" for i in range(4)])
    (folder / "cams").mkdir()
    for i, E in enumerate(TRUE):
        rows = ["extrinsic", *(words(row) for row in np.linalg.inv(E)), "", "intrinsic", *map(words, K)]
        (folder / "cams" / f"{i:08d}_cam.txt").write_text("\n".join([*rows, "", "425.0 2.5"]))
    return Twin(folder, unit=None, file="cams/00000002_cam.txt")


def metashape(folder: Path) -> Twin:
    """Three sensors' worth of structure in one: groups, a component's scale, a label with folders."""
    images(folder / "images", [f"IMG_{i}.JPG.png" for i in range(4)])
    scale = 2.5
    f, cx, cy = (float(v) for v in (K[1, 1], K[0, 2] + 0.5 - SIZE[0] / 2, K[1, 2] + 0.5 - SIZE[1] / 2))
    size = f'<resolution width="{SIZE[0]}" height="{SIZE[1]}"/>'
    cameras = ""
    for i, E in enumerate(TRUE):
        local = E.copy()
        local[:3, 3] /= scale
        cameras += f'<camera id="{i}" sensor_id="0" component_id="0" label="/data/set/IMG_{i}.JPG.png">'
        cameras += f"<transform>{words(local)}</transform></camera>\n"
    cameras += '<camera id="9" sensor_id="0" label="IMG_9"/>\n'
    (folder / "cameras.xml").write_text(
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="2.0.0">\n<chunk label="Chunk 1">\n'
        f'<sensors next_id="1"><sensor id="0" label="unknown" type="frame">{size}'
        f'<calibration type="frame" class="initial">{size}<f>1</f></calibration>'
        f'<calibration type="frame" class="adjusted">{size}<f>{f!r}</f><cx>{cx!r}</cx><cy>{cy!r}</cy>'
        f"<b1>{float(K[0, 0] - f)!r}</b1></calibration></sensor></sensors>\n"
        f'<components next_id="1" active_id="0"><component id="0"><transform><scale locked="true">{scale}'
        f'</scale></transform></component></components>\n<cameras next_id="4"><group id="0">{cameras}</group>'
        f"</cameras>\n</chunk>\n</document>\n"
    )
    return Twin(folder, file="cameras.xml")


def opensfm(folder: Path) -> Twin:
    images(folder / "images", [f"i{i}.png" for i in range(4)])
    longer = max(SIZE)
    camera = {
        "projection_type": "brown",
        "width": SIZE[0],
        "height": SIZE[1],
        "k1": 0.0,
        "k2": 0.0,
        "k3": 0.0,
    }
    camera |= {"p1": 0.0, "p2": 0.0, "focal_x": K[0, 0] / longer, "focal_y": K[1, 1] / longer}
    camera |= {"c_x": (K[0, 2] - (SIZE[0] - 1) / 2) / longer, "c_y": (K[1, 2] - (SIZE[1] - 1) / 2) / longer}
    shots = {}
    for i, E in enumerate(TRUE):
        T = np.linalg.inv(E)
        turn = Rotation.from_matrix(T[:3, :3]).as_rotvec().tolist()
        shots[f"i{i}.png"] = {"rotation": turn, "translation": T[:3, 3].tolist(), "camera": "v2 brown"}
    few = {"cameras": {}, "shots": {}, "points": {}}
    whole = {"cameras": {"v2 brown": camera}, "shots": shots, "points": {}}
    (folder / "reconstruction.json").write_text(json.dumps([few, whole]))
    return Twin(folder, unit=None, file="reconstruction.json")


def bundler(folder: Path) -> Twin:
    images(folder / "images", [f"i{i}.png" for i in range(4)], CENTRAL)
    text = "# Bundle file v0.3\n4 1\n"
    for E in TRUE:
        T = FLIP @ np.linalg.inv(E)
        text += f"200.0 0 0\n{words(T[0, :3])}\n{words(T[1, :3])}\n{words(T[2, :3])}\n{words(T[:3, 3])}\n"
    (folder / "bundle").mkdir()
    (folder / "bundle" / "bundle.out").write_text(text + "0 0 2\n9 9 9\n2 0 1 2.5 3.5 1 1 2.5 3.5\n")
    (folder / "list.txt").write_text("".join(f"./images/i{i}.png 0 200.0\n" for i in range(4)))
    return Twin(folder, CENTRAL, unit=None, file="bundle/bundle.out")


def nvm(folder: Path) -> Twin:
    images(folder, [f"i{i}.png" for i in range(4)], CENTRAL)
    text = "NVM_V3 \n \n4  \n"
    for i, E in enumerate(TRUE):
        x, y, z, w = quaternion(np.linalg.inv(E))
        text += f"i{i}.png\t200.0 {words([w, x, y, z, *E[:3, 3]])} 0 0\n"
    (folder / "model.nvm").write_text(text + "\n0\n")
    return Twin(folder, CENTRAL, unit=None, file="model.nvm")


def log(folder: Path) -> Twin:
    images(folder / "images", [f"{i:06d}.png" for i in range(4)])
    rows = [line for i, E in enumerate(TRUE) for line in (f"{i} {i} 0", *(words(row) for row in E))]
    (folder / "Barn_COLMAP_SfM.log").write_text("\n".join(rows) + "\n")
    return Twin(folder, unit=None, typed=K, file="Barn_COLMAP_SfM.log")


def replica(folder: Path) -> Twin:
    """A scene of NICE-SLAM's Replica; the file of its camera lies next to the scenes."""
    scene = folder / "room0"
    images(scene / "results", [f"frame00000{i}.png" for i in range(4)])
    depths(scene / "results", [f"depth00000{i}.png" for i in range(4)], 6553.5)
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera | {"scale": 6553.5}}))
    (scene / "traj.txt").write_text("".join(f"{words(E)}\n" for E in TRUE))
    return Twin(scene, has_depth=True, file="traj.txt")


def three_rscan(folder: Path) -> Twin:
    """A sequence of 3RScan, or an older one of ScanNet, whose camera is that of ``_info.txt``."""
    images(folder, [f"frame-00000{i}.color.png" for i in range(4)])
    depths(folder, [f"frame-00000{i}.depth.png" for i in range(4)], 5000.0)
    for i, E in enumerate(TRUE):
        (folder / f"frame-00000{i}.pose.txt").write_text("\n".join(words(row) for row in E))
    matrix = np.eye(4)
    matrix[:3, :3] = K
    info = f"m_versionNumber = 4\nm_sensorName = Tango\nm_colorWidth = {SIZE[0]}\nm_colorHeight = {SIZE[1]}\n"
    info += f"m_depthWidth = {SIZE[0]}\nm_depthHeight = {SIZE[1]}\nm_depthShift = 5000\n"
    for which in ("Color", "Depth"):
        info += f"m_calibration{which}Intrinsic = {words(matrix)}\n"
        info += f"m_calibration{which}Extrinsic = {words(np.eye(4))}\n"
    (folder / "_info.txt").write_text(info + "m_frames.size = 4\n")
    return Twin(folder, has_depth=True, file="_info.txt")


def scanner_app(folder: Path) -> Twin:
    """All data of 3D Scanner App, whose matrices stand in rows; one frame was recorded without its image."""
    images(folder, [f"frame_{i:05d}.png" for i in range(4)])
    depths(folder, [f"depth_{i:05d}.png" for i in range(4)])
    for i, E in enumerate([*TRUE, TRUE[0]]):
        entries = {"cameraPoseARFrame": (E @ FLIP).ravel().tolist(), "frame_index": i, "motionQuality": 0.9}
        entries["intrinsics"] = (K + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]).ravel().tolist()
        (folder / f"frame_{i:05d}.json").write_text(json.dumps(entries))
    return Twin(folder, has_depth=True, file="frame_00002.json")


def arkitscenes(folder: Path) -> Twin:
    frames = folder / f"{folder.name}_frames"
    times = [f"{305.377 + 0.1 * i:.3f}" for i in range(4)]
    names = [f"{folder.name}_{t}" for t in times]
    images(frames / "lowres_wide", [f"{name}.png" for name in names])
    depths(frames / "lowres_depth", [f"{name}.png" for name in names])
    (frames / "lowres_wide_intrinsics").mkdir()
    rows = []
    for t, E in zip(times, TRUE, strict=True):
        T = np.linalg.inv(E)
        rows.append(f"{t} {words([*Rotation.from_matrix(T[:3, :3]).as_rotvec(), *T[:3, 3]])}")
        near = f"{float(t) - 0.001:.3f}"  # its clock is off by a millisecond
        numbers = words([*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        (frames / "lowres_wide_intrinsics" / f"{folder.name}_{near}.pincam").write_text(numbers)
    (frames / "lowres_wide.traj").write_text("\n".join(rows) + "\n")
    return Twin(folder, has_depth=True, file=f"{frames.name}/lowres_wide.traj")


WRITERS = (
    replica,
    three_rscan,
    scanner_app,
    arkitscenes,
    *(polycam, record3d, stray, euroc, tartanair, kitti_odometry, mvsnet),
    *(metashape, opensfm, bundler, nvm, log),
)
