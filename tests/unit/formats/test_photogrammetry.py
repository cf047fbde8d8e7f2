"""Metashape, OpenSfM, Bundler and VisualSFM: three images from three cameras."""

import json

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.formats import photogrammetry
from tests.unit.formats.calibrated_pair import quaternion, vector, words
from tests.unit.formats.posed_images import (
    KS,
    POSES,
    SIZES,
    assert_is_an_immutable_record,
    assert_is_read,
    central,
    write_images,
)

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
#: k1 k2 p1 p2 k3 in OpenCV's order.
LENSES = [
    [0.11, -0.02, 0.003, -0.004, 0.05],
    [0.12, -0.03, -0.002, 0.006, -0.01],
    [-0.2, 0.1, 0.001, 0.002, 0.3],
]
SKEWS = [0.25, -0.5, 0.75]


# Metashape


def sensor(n: int, where: str = "adjusted", **changes) -> str:
    """P1 and P2 are OpenCV's p2 and p1, b1 and b2 are affinity and skew, and the image centre is (0, 0)."""
    K, (width, height), (k1, k2, p1, p2, k3) = KS[n], SIZES[n], LENSES[n]
    f = float(K[1, 1])
    values = {"f": f, "cx": K[0, 2] + 0.5 - width / 2, "cy": K[1, 2] + 0.5 - height / 2, "b1": K[0, 0] - f}
    values |= {"b2": SKEWS[n], "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1} | changes
    entries = "".join(f"<{k}>{float(v)!r}</{k}>" for k, v in values.items() if v is not None)
    size = f'<resolution width="{width}" height="{height}"/>'
    initial = f'<calibration class="initial">{size}<f>1</f></calibration>'
    inner = {
        "adjusted": f'{initial}<calibration class="adjusted">{size}{entries}</calibration>',
        "only": f'<calibration class="initial">{size}{entries}</calibration>',
        "size outside": f"{size}<calibration>{entries}</calibration>",
        "no size": f"<calibration>{entries}</calibration>",
        "none": size,
    }[where]
    return f'<sensor id="s{n}">{inner}</sensor>'


def camera(
    n: int, scale: float = 1.0, component: str = "", label: str | None = None, placed: bool = True
) -> str:
    local = POSES[n].copy()
    local[:3, 3] /= scale
    transform = f"<transform>{words(local)}</transform>" if placed else ""
    name = f'label="{label or f"D:/set/{n}.png"}"'
    return f'<camera sensor_id="s{n}" {component} {name}>{transform}</camera>'


def chunk(inner: str, sensors: str | None = None) -> str:
    sensors = "".join(sensor(n) for n in range(3)) if sensors is None else sensors
    return f"<chunk><sensors>{sensors}</sensors>{inner}</chunk>"


def metashape(folder, text: str):
    (folder / "cameras.xml").write_text(f"<document>{text}</document>")
    return photogrammetry.read_metashape(folder)


def expected_Ks(skews=SKEWS):
    return [K + [[0, skew, 0], [0, 0, 0], [0, 0, 0]] for K, skew in zip(KS, skews, strict=True)]


def scale_of(scale) -> str:
    return f"<transform><scale>{scale}</scale></transform>"


@pytest.mark.parametrize(
    ("where", "scale"),
    [("adjusted", "component"), ("only", "chunk"), ("size outside", "both"), ("adjusted", "none")],
)
def test_metashape_poses_are_camera_to_world_in_component_scale(tmp_path, where, scale):
    files = write_images(tmp_path, ["0.png", "1.png", "2.png"])
    factor = 1.0 if scale == "none" else 2.5
    of_component = scale_of(2.5) if scale in ("component", "both") else ""
    of_chunk = {"chunk": scale_of(2.5), "both": scale_of(7)}.get(scale, "")
    parts = (
        f'<component id="4">{scale_of(9)}</component><component id="3">{of_component}</component>{of_chunk}'
    )
    cameras = "".join(camera(n, factor, 'component_id="3"') for n in range(3))
    sensors = "".join(sensor(n, where) for n in range(3))
    layout = metashape(tmp_path, chunk(parts + cameras, sensors))
    unit = None if scale == "none" else "m"
    assert_is_read(layout, "Metashape", unit, files, Ks=expected_Ks(), lenses=LENSES)


def test_metashape_chunks_without_components_use_their_first_scale(tmp_path):
    files = write_images(tmp_path, ["0.png", "1.png", "2.png"])
    cameras = "".join(camera(n, 2.5) for n in range(3))
    layout = metashape(
        tmp_path, chunk(f"<components><component>{scale_of(2.5)}</component></components>{cameras}")
    )
    assert_is_read(layout, "Metashape", "m", files, Ks=expected_Ks(), lenses=LENSES)
    empty = "".join(camera(n) for n in range(3)) + "<transform><scale/></transform>"
    assert metashape(tmp_path, chunk(empty)).unit is None


def test_metashape_part_with_most_placed_cameras_is_read(tmp_path):
    files = write_images(tmp_path, ["0.png", "1.png", "2.png"])
    few = chunk("".join(camera(n, placed=n == 0, label=f"x{n}") for n in range(3)))
    two = "".join(camera(n, component='component_id="1"') for n in (0, 1))
    mixed = f'{two}{camera(2, component="")}<camera sensor_id="s0"/>'  # without label or component
    one = "".join(camera(n, component='component_id="0"', label=f"y{n}", placed=n == 0) for n in (0, 1, 2))
    layout = metashape(tmp_path, few + chunk(one + mixed))
    assert_is_read(
        layout, "Metashape", None, files, Ks=expected_Ks(), lenses=LENSES, findings=["capture.part"]
    )
    reported = layout.findings[0]
    assert "largest chunk or component, with 3 images" in reported and reported.endswith(
        "Others (with 2, 1 images) are ignored, as each has a separate coordinate frame."
    )


def test_unplaced_metashape_cameras_have_no_pose(tmp_path):
    files = write_images(tmp_path, ["0.png", "1.png", "2.png"])
    layout = metashape(tmp_path, chunk("".join(camera(n, placed=n != 1) for n in range(3))))
    poses = [POSES[0], None, POSES[2]]
    assert_is_read(layout, "Metashape", None, files, Ks=expected_Ks(), lenses=LENSES, poses=poses)


@pytest.mark.parametrize(
    ("broken", "problem"),
    [
        (
            sensor(1, k4=0.1, p3=0.2, p4=0.0),
            "the lens of a sensor must be without k4, p3; got {'k4': 0.1, 'p3': 0.2}. Undistort in Metashape",
        ),
        (sensor(1, p4=0.2), "the lens of a sensor must be without p4; got {'p4': 0.2}. Undistort"),
        (
            sensor(1, "none"),
            "a sensor of Metashape must be calibrated; got no calibration. Align the cameras",
        ),
        (sensor(1, "no size"), "a sensor of Metashape must be with a resolution; got none."),
        (
            sensor(1).replace('id="s1"', 'id="s1" type="fisheye"'),
            "a sensor of Metashape must be of type frame; got fisheye. Undistort",
        ),
        ("", "its sensor is not in the file"),
    ],
)
def test_unusable_metashape_sensors_exclude_their_images(tmp_path, broken, problem):
    write_images(tmp_path, ["0.png", "1.png", "2.png"])
    text = chunk("".join(camera(n) for n in range(3)), sensor(0) + broken + sensor(2))
    candidates = metashape(tmp_path, text).candidates
    assert [bool(each.problem) for each in candidates] == [False, True, False]
    assert candidates[1].problem.startswith(problem)


def test_older_metashape_entries_are_read(tmp_path):
    files = write_images(tmp_path, ["0.png", "1.png", "2.png"])
    older = [sensor(n, f=None, fy=KS[n][1, 1], b2=None, k3=None, p1=None) for n in range(3)]
    older[0] = older[0].replace("<k1>0.11</k1>", "<k1></k1><k4>0.0</k4>")
    lenses = [[k1 * (n != 0), k2, p1, 0, 0] for n, (k1, k2, p1, _, _) in enumerate(LENSES)]
    layout = metashape(tmp_path, chunk("".join(camera(n) for n in range(3)), "".join(older)))
    assert_is_read(layout, "Metashape", None, files, Ks=KS, lenses=lenses)
    with pytest.raises(
        InputError,
        match=r"\APATH must be Metashape's cameras; got .*cameras\.xml without a camera\. "
        r"Align the photos",
    ):
        metashape(tmp_path, "<chunk></chunk><cameras></cameras>")
    assert metashape(tmp_path, "<chunk></chunk>") is None
    assert metashape(tmp_path, "<camera/>") is None


# OpenSfM


OPENSFM = {
    "perspective": ("opencv", ("k1", "k2", None, None)),
    "simple_radial": ("opencv", ("k1", None, None, None)),
    "radial": ("opencv", ("k1", "k2", None, None)),
    "brown": ("opencv", ("k1", "k2", "p1", "p2", "k3")),
    "fisheye": ("fisheye", ("k1", "k2", None, None)),
    "fisheye_opencv": ("fisheye", ("k1", "k2", "k3", "k4")),
}


def opensfm_camera(n: int, kind: str | None) -> dict:
    longer, (width, height) = max(SIZES[n]), SIZES[n]
    entries = {"width": width, "height": height, "k1": 0.1 + n, "k2": 0.2 + n, "k3": 0.3, "k4": 0.4 + n}
    entries |= {"p1": 0.5, "p2": 0.6 + n, "projection_type": kind, "focal": 9.0}
    entries |= {"focal_x": KS[n][0, 0] / longer, "focal_y": KS[n][1, 1] / longer}
    # In OpenSfM the image centre is (0, 0).
    entries |= {
        "c_x": (KS[n][0, 2] - (width - 1) / 2) / longer,
        "c_y": (KS[n][1, 2] - (height - 1) / 2) / longer,
    }
    return {key: value for key, value in entries.items() if value is not None}


def opensfm_part(names, kinds=("brown", "brown", "brown")) -> dict:
    shots = {}
    for n, name in names.items():
        T = np.linalg.inv(POSES[n])
        shots[name] = {"rotation": vector(T), "translation": T[:3, 3].tolist(), "camera": f"c{n}"}
    return {"cameras": {f"c{n}": opensfm_camera(n, kind) for n, kind in enumerate(kinds)}, "shots": shots}


NAMES = {2: "c.png", 0: "a.png", 1: "b.png"}


@pytest.mark.parametrize("kind", [*OPENSFM, None])
def test_opensfm_cameras_are_normalized_by_the_longer_side(tmp_path, kind):
    files = write_images(tmp_path / "images", ["a.png", "b.png", "c.png"])
    parts = [
        opensfm_part({0: "x.png"}),
        opensfm_part(NAMES, (kind, kind, kind)),
        opensfm_part({1: "y", 2: "z"}),
    ]
    (tmp_path / "reconstruction.json").write_text(json.dumps(parts))
    layout = photogrammetry.read_opensfm(tmp_path)
    model, names = OPENSFM[kind or "perspective"]
    lenses = [[opensfm_camera(n, kind).get(name, 0.0) for name in names] for n in range(3)]
    assert_is_read(
        layout, "OpenSfM", None, files, lenses=lenses, models=[model] * 3, findings=["capture.part"]
    )
    assert (
        "largest part, with 3 images" in layout.findings[0]
        and "Others (with 2, 1 images)" in layout.findings[0]
    )


def test_opensfm_may_have_a_single_focal_length(tmp_path):
    files = write_images(tmp_path / "opensfm" / "images", ["a.png", "b.png", "c.png"])
    part = opensfm_part(NAMES)
    for n, entries in enumerate(part["cameras"].values()):
        entries |= {"focal": entries.pop("focal_x")}
        del entries["focal_y"], entries["c_x"], entries["c_y"]
        assert n < 3
    (tmp_path / "opensfm" / "reconstruction.json").write_text(json.dumps([part]))
    (tmp_path / "opensfm" / "reference_lla.json").write_text("{}")
    layout = photogrammetry.read_opensfm(tmp_path)
    assert layout.findings[0].code == "capture.gps-scale" and len(layout.findings) == 1
    expected = [central(n, KS[n][0, 0]) for n in range(3)]
    for each, file, K in zip(layout.candidates, files, expected, strict=True):
        assert each.frame.image == file
        np.testing.assert_allclose(each.camera.K, K, atol=1e-9)


def test_opensfm_rejects_other_files_and_excludes_unknown_lenses(tmp_path):
    files = write_images(tmp_path, ["a.png", "b.png", "c.png"])
    (tmp_path / "0_reconstruction.json").write_text("{}")
    (tmp_path / "1_reconstruction.json").write_text('[{"shots": {}}]')
    (tmp_path / "2_reconstruction.json").write_text(
        json.dumps([opensfm_part(NAMES, ("brown", "dual", "brown"))])
    )
    candidates = photogrammetry.read_opensfm(tmp_path).candidates
    assert [each.frame.image for each in candidates] == files
    assert candidates[1].problem.startswith("projection_type must be one of perspective, simple_radial, ")
    assert candidates[1].problem.endswith("; got dual. Run opensfm undistort.") and not candidates[0].problem
    (tmp_path / "2_reconstruction.json").write_text("[]")
    with pytest.raises(
        InputError,
        match=r"\Areconstruction\.json must be with aligned images; got .*"
        r"2_reconstruction\.json with none\.",
    ):
        photogrammetry.read_opensfm(tmp_path)
    (tmp_path / "2_reconstruction.json").unlink()
    assert photogrammetry.read_opensfm(tmp_path) is None


def test_undistorted_opensfm_models_ignore_the_distorted_images(tmp_path):
    scan = tmp_path / "far below" / "scan"  # images are searched up to two folders above
    above = write_images(scan / "images", ["a.png", "b.png", "c.png"])
    inside = scan / "undistorted"
    inside.mkdir()
    (inside / "reconstruction.json").write_text(json.dumps([opensfm_part(NAMES)]))
    assert all(each.problem for each in photogrammetry.read_opensfm(inside).candidates)
    given = photogrammetry.read_opensfm(inside, scan / "images")
    assert [each.frame.image for each in given.candidates] == above
    below = scan / "model"
    below.mkdir()
    (below / "reconstruction.json").write_text(json.dumps([opensfm_part(NAMES)]))
    assert [each.frame.image for each in photogrammetry.read_opensfm(below).candidates] == above


# Bundler and VisualSFM


def bundler_text(head: str = "# Bundle file v0.3", lost: int | None = None) -> str:
    lines = [head, "3 1"]
    for n, E in enumerate(POSES):
        T = FLIP @ np.linalg.inv(E)
        f = 0 if n == lost else 60.5 + 10 * n
        lines += [f"{f} {0.1 + n} {0.02 * n - 0.03}", *(words(row) for row in T[:3, :3]), words(T[:3, 3])]
    return "\n".join([*lines, "0 0 2", "9 9 9", ""])


LISTS = [
    "list.txt",
    "pictures.txt",
    "bundle.out.list.txt",
    "prepare/list.txt",
    "list_tmp.txt",
    "b.out.list.txt",
    "b.list.txt",
]


@pytest.mark.parametrize(("listed", "above"), [(name, n % 2 == 0) for n, name in enumerate(LISTS)])
def test_bundler_poses_are_world_to_camera_in_opengl_axes(tmp_path, listed, above):
    files = write_images(tmp_path / "images", ["a.png", "b.png", "c.png"])
    folder = tmp_path / "bundle"
    folder.mkdir()
    (folder / "b.out").write_text(bundler_text())
    at = (tmp_path if above else folder) / listed
    at.parent.mkdir(exist_ok=True)
    at.write_text("./images/a.png 0 60.5\n\nimages/b.png\nimages/c.png 0\n")
    Ks = [central(n, 60.5 + 10 * n) for n in range(3)]
    lenses = [(0.1 + n, 0.02 * n - 0.03, 0, 0) for n in range(3)]
    assert_is_read(photogrammetry.read_bundler(tmp_path), "Bundler", None, files, Ks=Ks, lenses=lenses)
    assert_is_read(photogrammetry.read_bundler(folder), "Bundler", None, files, Ks=Ks, lenses=lenses)


def test_unregistered_bundler_images_have_no_camera_and_counts_must_match(tmp_path):
    write_images(tmp_path, ["a.png", "b.png", "c.png"])
    (tmp_path / "b.out").write_text(bundler_text(lost=1))
    (tmp_path / "a.out").write_text(bundler_text("# Other"))
    with pytest.raises(
        InputError,
        match=r"\APATH must be b\.out with its list of images \(list\.txt, pictures\.txt\); "
        r"got .*b\.out without\. Bundler refers to images by number\. Put its ",
    ):
        photogrammetry.read_bundler(tmp_path)
    (tmp_path / "list.txt").write_text("a.png\nb.png\nc.png\n")
    candidates = photogrammetry.read_bundler(tmp_path).candidates
    assert candidates[1].camera is None and candidates[1].frame.E is None and not candidates[1].problem
    np.testing.assert_allclose(candidates[2].frame.E, POSES[2], atol=1e-9)
    (tmp_path / "list.txt").write_text("a.png\nb.png\n")
    with pytest.raises(InputError, match=r"\Alist\.txt must be a list of the 3 images in b\.out; got 2\.\Z"):
        photogrammetry.read_bundler(tmp_path)
    (tmp_path / "b.out").write_text("x")
    assert photogrammetry.read_bundler(tmp_path) is None


def test_visualsfm_poses_are_a_quaternion_and_a_camera_centre(tmp_path):
    names = ["a.png", "my set/b.png", "c.png"]
    files = write_images(tmp_path, names)
    rows, bends = [], (0.0, 0.04, -0.02)
    for n, (name, k) in enumerate(zip(names, bends, strict=True)):
        x, y, z, w = quaternion(np.linalg.inv(POSES[n]))
        between = "\t" if n != 2 else "   "
        rows.append(f"{name}{between}{60.5 + 10 * n} {words([w, x, y, z, *POSES[n][:3, 3]])} {k} 0")
    (tmp_path / "m.nvm").write_text("\n".join(["NVM_V3 ", "", "3", *rows, "", "0", ""]))
    (tmp_path / "a.nvm").write_text("other\n")
    layout = photogrammetry.read_nvm(tmp_path)
    Ks = [central(n, 60.5 + 10 * n) for n in range(3)]
    lenses = [each.camera.coefficients for each in layout.candidates]
    assert_is_read(layout, "VisualSFM", None, files, Ks=Ks, lenses=lenses)
    # VisualSFM maps a pixel at radius r to a ray at r (1 + k r^2); OpenCV maps rays to pixels.
    for (k1, k2, p1, p2, k3), k in zip(lenses, bends, strict=True):
        r = np.linspace(0.05, 0.3, 9)
        ray = r * (1 + k * r**2)
        np.testing.assert_allclose(ray * (1 + k1 * ray**2 + k2 * ray**4 + k3 * ray**6), r, rtol=0, atol=8e-9)
        assert p1 == p2 == 0
    (tmp_path / "m.nvm").unlink()
    assert photogrammetry.read_nvm(tmp_path) is None


def test_metashape_parts_count_only_their_own_cameras():
    root = photogrammetry.parse_xml(chunk(camera(0, component='component_id="1"')))
    (part,) = photogrammetry._parts(root)
    assert len(part.cameras()) == part.placed() == 1
    assert_is_an_immutable_record(part)
    other = photogrammetry.ChunkPart(root, "2")
    assert other.cameras() == [] and other.placed() == 0 and other.scale() == 1.0
