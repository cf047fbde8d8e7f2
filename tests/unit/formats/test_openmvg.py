"""OpenMVG and AliceVision: three images from three cameras, linked by ids."""

import json
import sys

import numpy as np
import pytest

from geodiff_plugin.formats import openmvg
from tests.unit.formats.posed_images import KS, POSES, SIZES, assert_is_read, write_images

NAMES = ["a.png", "b.png", "c.png"]
#: k1 k2 k3 t1 t2, in the order of both programs.
LENSES = [[0.1, -0.2, 0.03, 0.004, -0.005], [0.11, 0.2, -0.03, 0.006, 0.007], [-0.1, 0.1, 0.2, 0.01, 0.03]]


def opencv_order(values):
    k1, k2, k3, p1, p2 = [*values, 0, 0, 0, 0, 0][:5]
    return [k1, k2, p1, p2, k3]


# OpenMVG


def mvg_camera(n: int, entry: str, count: int, nested: bool = True) -> dict:
    base = {"width": SIZES[n][0], "height": SIZES[n][1], "focal_length": float(KS[n][0, 0])}
    base |= {"principal_point": KS[n][:2, 2].tolist()}
    lens = {entry: LENSES[n][:count]} if entry else {}
    return {"ptr_wrapper": {"data": {"value0": base, **lens} if nested else base | lens}}


def write_openmvg(folder, kinds, entries, counts):
    """cereal writes the class name on first use and only its number afterwards."""
    names, cameras = [], []
    for n, kind in enumerate(kinds):
        if kind in names:
            of_class = {"polymorphic_id": names.index(kind) + 1}
        else:
            names.append(kind)
            of_class = {"polymorphic_id": 0x80000000 + len(names), "polymorphic_name": kind}
        cameras.append(
            {"key": 70 + n, "value": of_class | mvg_camera(n, entries[n], counts[n], nested=n != 1)}
        )
    views, poses = [], []
    for n, name in enumerate(NAMES):
        data = {
            "local_path": "/set/" if n == 1 else "",
            "filename": name,
            "id_pose": 30 - n,
            "id_intrinsic": 70 + n,
        }
        views.append({"key": n, "value": {"ptr_wrapper": {"data": data}}})
        pose = {"rotation": POSES[n][:3, :3].T.tolist(), "center": POSES[n][:3, 3].tolist()}
        poses.append({"key": 30 - n, "value": pose})
    data = {"sfm_data_version": "0.3", "views": views, "intrinsics": cameras}
    (folder / "sfm_data_a.json").write_text(json.dumps(data | {"extrinsics": poses[:1]}))
    (folder / "sfm_data_b.json").write_text(json.dumps(data | {"extrinsics": poses}))
    (folder / "sfm_data_c.json").write_text(json.dumps(data | {"extrinsics": poses[:2]}))
    (folder / "sfm_data_d.json").write_text("[1]")
    (folder / "sfm_data_e.json").write_text('{"sfm_data_version": 1}')
    return folder / "sfm_data_b.json"


MVG = {
    "pinhole": ("opencv", "", 0),
    "pinhole_radial_k1": ("opencv", "disto_k1", 1),
    "pinhole_radial_k3": ("opencv", "disto_k3", 3),
    "pinhole_brown_t2": ("opencv", "disto_t2", 5),
    "fisheye": ("fisheye", "fisheye", 4),
}


@pytest.mark.parametrize(
    "kinds",
    [
        ("pinhole_brown_t2", "pinhole_brown_t2", "fisheye"),
        ("pinhole", "pinhole_radial_k3", "pinhole_radial_k1"),
        ("fisheye", "pinhole_radial_k1", "fisheye"),
    ],
)
def test_openmvg_views_are_linked_by_ids(scan, kinds):
    models, entries, counts = zip(*(MVG[kind] for kind in kinds), strict=True)
    file = write_openmvg(scan, kinds, entries, counts)
    files = write_images(scan / "images", ["a.png", "set/b.png", "c.png"])
    Ks = [np.diag([K[0, 0], K[0, 0], 1]) + [[0, 0, K[0, 2]], [0, 0, K[1, 2]], [0, 0, 0]] for K in KS]
    lenses = [
        LENSES[n][:4] if model == "fisheye" else opencv_order(LENSES[n][: counts[n]])
        for n, model in enumerate(models)
    ]
    for path in (scan, file):
        assert_is_read(
            openmvg.read_openmvg(path), "OpenMVG", None, files, Ks=Ks, lenses=lenses, models=models
        )
    moved = write_images(scan / "away", ["a.png", "set/b.png", "c.png"])
    given = openmvg.read_openmvg(scan, scan / "away")
    assert [each.frame.image for each in given.candidates] == moved
    few = openmvg.read_openmvg(scan / "sfm_data_c.json").candidates
    assert few[2].frame.E is None and few[2].camera is not None and few[1].frame.E is not None


def test_unsupported_openmvg_lenses_exclude_their_images(scan):
    write_openmvg(scan, ("pinhole", "spherical", "pinhole"), ("",) * 3, (0,) * 3)
    write_images(scan, ["a.png", "set/b.png", "c.png"])
    candidates = openmvg.read_openmvg(scan).candidates
    assert candidates[1].problem.startswith("the camera must be one of pinhole, pinhole_radial_k1, ")
    assert "; got spherical. Undistort the images" in candidates[1].problem and not candidates[2].problem
    for file in scan.glob("*.json"):
        file.unlink()
    assert openmvg.read_openmvg(scan) is None


# AliceVision


def alice_camera(n: int, version: tuple[int, ...], **changes) -> dict:
    """As ``sfmDataIO/jsonIO.cpp`` writes it: since 1.2.1 the principal point is an offset from the middle."""
    K, (width, height) = KS[n], SIZES[n]
    middle = np.zeros(2) if version < (1, 2, 1) else np.array([width, height]) / 2
    entries = {"intrinsicId": f"{70 + n}", "width": str(width), "height": str(height), "type": "radial3"}
    entries |= {"principalPoint": [repr(float(v)) for v in K[:2, 2] - middle]}
    entries |= {"distortionParams": [repr(v) for v in LENSES[n][:3]]}
    if version < (1, 2, 2):
        entries["pxFocalLength"] = [repr(float(K[0, 0])), repr(float(K[1, 1]))]
    else:
        fx, fy = float(K[0, 0]), float(K[1, 1])
        along, ratio = (
            (fy, fy / fx) if version >= (1, 2, 11) else (fx, fx / fy if version < (1, 2, 5) else fy / fx)
        )
        entries |= {
            "sensorWidth": "23.5",
            "focalLength": repr(along / width * 23.5),
            "pixelRatio": repr(ratio),
        }
    return {key: value for key, value in (entries | changes).items() if value is not None}


def write_alicevision(folder, version, cameras=None, name="b.sfm", count=3, size=None):
    views, poses = [], []
    for n, image in enumerate(NAMES):
        views.append({"poseId": f"{30 - n}", "intrinsicId": f"{70 + n}", "path": f"D:/set/{image}"})
        rotation = [repr(float(v)) for v in POSES[n][:3, :3].T.ravel(order="F")]
        transform = {"rotation": rotation, "center": [repr(float(v)) for v in POSES[n][:3, 3]]}
        poses.append({"poseId": f"{30 - n}", "pose": {"transform": transform}})
    data = {"version": [str(part) for part in version], "views": views, "poses": poses[:count]}
    data["intrinsics"] = cameras or [alice_camera(n, version) for n in range(3)]
    (folder / name).write_text(json.dumps(data))
    return folder / name


WIDE = [SIZES[0], SIZES[1], (96, 91)]
VERSIONS = [
    (1, 1, 9),
    (1, 2, 0),
    (1, 2, 1),
    (1, 2, 2),
    (1, 2, 4),
    (1, 2, 5),
    (1, 2, 10),
    (1, 2, 11),
    (2, 0, 0),
]


@pytest.mark.parametrize("version", VERSIONS)
def test_alicevision_intrinsics_depend_on_the_version(scan, version, monkeypatch):
    """Since 1.2.2 the focal length is only unambiguous for landscape images."""
    monkeypatch.setattr(sys.modules[__name__], "SIZES", WIDE)
    file = write_alicevision(scan, version)
    write_alicevision(scan, version, name="a.sfm", count=1)
    write_alicevision(scan, version, name="sfm_c.json", count=2)
    files = write_images(scan / "images", NAMES, WIDE)
    lenses = [opencv_order(lens[:3]) for lens in LENSES]
    for path in (scan, file):
        layout = openmvg.read_alicevision(path)
        assert_is_read(layout, "AliceVision", None, files, sizes=WIDE, lenses=lenses)
    few = openmvg.read_alicevision(scan / "a.sfm").candidates
    assert few[1].frame.E is None and few[1].camera is not None
    moved = write_images(scan / "away", NAMES)
    given = openmvg.read_alicevision(scan, scan / "away")
    assert [each.frame.image for each in given.candidates] == moved


@pytest.mark.parametrize(
    ("changes", "model", "count"),
    [
        ({"distortionParams": None}, "opencv", 0),
        ({"type": "pinhole", "distortionParams": []}, "opencv", 0),
        ({"type": "RadialK1"}, "opencv", 1),
        ({"type": "pinhole", "distortionType": "brown"}, "opencv", 5),
        ({"type": "fisheye4"}, "fisheye", 4),
        ({"type": "pinhole", "distortionType": "none", "undistortionType": "none"}, "opencv", 0),
    ],
)
def test_alicevision_lenses_have_old_and_new_names(scan, changes, model, count):
    lens = {"distortionParams": [repr(v) for v in LENSES[0][:count]]} | changes
    cameras = [alice_camera(0, (1, 2, 6), **lens)]
    write_images(scan, NAMES)
    camera = openmvg.read_alicevision(write_alicevision(scan, (1, 2, 6), cameras)).candidates[0].camera
    expected = LENSES[0][:count] if model == "fisheye" else opencv_order(LENSES[0][:count])
    assert (camera.model, list(camera.coefficients)) == (model, expected)


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"type": "equidistant", "distortionType": "none"}, "; got none. Run: aliceVision_exportColmap."),
        ({"distortionType": "3deradial4"}, "; got 3deradial4. Run: aliceVision_exportColmap."),
        ({"undistortionType": "3deanamorphic4"}, "; got 3deanamorphic4. Run: aliceVision_exportColmap."),
        (
            {"width": "61", "height": "62"},
            "a landscape image, whose focal length is unambiguous; got 61x62. Run: aliceVision",
        ),
        ({"focalLength": None}, "its entries cannot be read (KeyError: 'focalLength')"),
    ],
)
def test_unsupported_alicevision_cameras_exclude_their_images(scan, changes, problem):
    cameras = [alice_camera(0, (1, 2, 6), **changes), alice_camera(1, (1, 2, 6))]
    write_images(scan, NAMES)
    candidates = openmvg.read_alicevision(write_alicevision(scan, (1, 2, 6), cameras)).candidates
    assert problem in candidates[0].problem and not candidates[1].problem
    assert candidates[2].camera is None and not candidates[2].problem


def test_alicevision_defaults_to_a_full_frame_sensor(scan):
    square = alice_camera(
        0, (1, 2, 6), sensorWidth=None, pixelRatio=None, focalLength="36", width="61", height="61"
    )
    older = alice_camera(1, (1, 2, 0), pxFocalLength="88.5")
    write_images(scan, NAMES)
    new = openmvg.read_alicevision(write_alicevision(scan, (1, 2, 6), [square])).candidates[0].camera
    np.testing.assert_allclose(new.K[(0, 1), (0, 1)], 61.0)
    old = openmvg.read_alicevision(write_alicevision(scan, (1, 2, 0), [older])).candidates[1].camera
    np.testing.assert_allclose(old.K[(0, 1), (0, 1)], 88.5)
    for name in ("b.sfm",):
        (scan / name).write_text('{"version": [1], "other": 1}')
    assert openmvg.read_alicevision(scan) is None
