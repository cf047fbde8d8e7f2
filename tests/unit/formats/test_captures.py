"""Captures as a whole: which camera a frame gets, which frames are skipped, and what is reported."""

import inspect
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin._internal.checks import InputError, MissingFileError
from geodiff_plugin.findings import Finding
from geodiff_plugin.formats import captures
from geodiff_plugin.formats.captures import read_capture
from geodiff_plugin.formats.layouts import Candidate, CaptureFrame, Layout
from geodiff_plugin.formats.rigs import RawCamera

#: Non-square pixels, and a centre that is off the middle.
K = np.array([[50.0, 0, 21.0], [0, 47.0, 16.5], [0, 0, 1]])
SIZE = (48, 36)


def pose(number: int) -> np.ndarray:
    E = np.eye(4)
    E[:3, :3] = Rotation.from_rotvec([0.1 * number, -0.2, 0.05]).as_matrix()
    E[:3, 3] = 0.3 * number, -0.1, 0.2
    return E


def image(path: Path, size=SIZE, orientation: int | None = None, focal: int | None = None) -> Path:
    exif = Image.Exif()
    if orientation is not None:
        exif[0x0112] = orientation
    if focal is not None:
        exif.get_ifd(0x8769)[0xA405] = focal
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (9, 99, 199)).save(path, exif=exif)
    return path


@pytest.fixture
def read(tmp_path, monkeypatch):
    """``read(candidates, **more)``: the capture of a made-up format, whose reader returns the candidates."""

    def call(candidates, unit="m", findings=(), as_stored=True, has_poses=True, **options):
        layout = Layout("made", unit, candidates, as_stored=as_stored, findings=findings)
        found = captures.CaptureFormat("made", ("*",), lambda path: layout, has_poses=has_poses)
        monkeypatch.setattr(captures, "LAYOUTS", (found,))
        (tmp_path / "scan").mkdir(exist_ok=True)
        return read_capture(tmp_path / "scan", **options)

    return call


def candidate(path: Path, number: int = 0, camera=RawCamera(K, SIZE), E=True, **more) -> Candidate:  # noqa: B008
    frame = CaptureFrame(path.stem, path, pose(number) if E else None, **more)
    return Candidate(frame, camera)


def test_every_frame_has_the_camera_of_its_own_image_at_the_images_size(read, tmp_path):
    sizes = ((48, 36), (96, 72), (24, 18), (144, 108))
    lenses = (np.zeros(4), np.array([0.1, 0, 0, 0]), np.zeros(4), np.array([0.1, 0.2, 0, 0]))
    made = []
    for number, (size, lens) in enumerate(zip(sizes, lenses, strict=True)):
        path = image(tmp_path / f"f{number}.png", size)
        matrix = K + np.array([[number, 0, 0], [0, 0, number], [0, 0, 0]])
        made.append(candidate(path, number, RawCamera(matrix, SIZE, lens), points=np.full((2, 3), number)))
    (tmp_path / "d2.npy").touch()
    made[2] = replace(made[2], frame=replace(made[2].frame, depth=tmp_path / "d2.npy", depth_per_m=5.0))
    made[3] = replace(made[3], frame=replace(made[3].frame, depth=tmp_path / "gone.npy"))
    found = read(made)
    assert (found.kind, found.unit, found.findings) == ("made", "m", [])
    for number, (frame, size) in enumerate(zip(found.frames, sizes, strict=True)):
        scale = size[0] / 48
        matrix = K + np.array([[number, 0, 0], [0, 0, number], [0, 0, 0]])
        expected = np.diag([scale, scale, 1]) @ matrix
        expected[:2, 2] += 0.5 * scale - 0.5
        np.testing.assert_allclose(frame.camera.K, expected)
        np.testing.assert_array_equal(frame.E, pose(number))
        np.testing.assert_array_equal(frame.points, np.full((2, 3), number))
        assert frame.size == size and frame.name == f"f{number}" and frame.as_stored
        assert (frame.camera.lens is None) == (number % 2 == 0)
    np.testing.assert_array_equal(found.frames[3].camera.lens.coefficients, [0.1, 0.2, 0, 0])
    assert [f.depth for f in found.frames] == [None, None, tmp_path / "d2.npy", None]
    assert found.frames[2].depth_per_m == 5.0


def test_a_typed_camera_goes_before_the_files_and_the_files_before_exif(read, tmp_path):
    paths = [image(tmp_path / f"f{n}.jpg", (48, 36), focal=30 + n) for n in range(2)]
    typed = K + 3
    typed[2] = 0, 0, 1
    assumed = Finding("capture.assumed-k", "K is assumed.")
    other = Finding("capture.images-found", "Found elsewhere.")
    with_camera = [candidate(path, n) for n, path in enumerate(paths)]
    without = [candidate(path, n, None) for n, path in enumerate(paths)]
    fov = 2 * np.degrees(np.arctan(24 / 60))
    for made in (with_camera, without):
        for options, focal in (({"K": typed}, 53.0), ({"fov": fov}, 60.0), ({"K": typed, "fov": fov}, 53.0)):
            found = read(made, findings=(assumed, other), **options)
            assert [frame.camera.K[0, 0] for frame in found.frames] == pytest.approx([focal] * 2)
            assert found.findings == [other], "nothing is assumed where the user gave a camera"
    assert [frame.camera.K[0, 0] for frame in read(with_camera).frames] == [50, 50]
    found = read(without, findings=(assumed,))
    diagonal = np.hypot(48, 36) / np.hypot(36, 24)
    assert [frame.camera.K[0, 0] for frame in found.frames] == pytest.approx([30 * diagonal, 31 * diagonal])
    assert found.findings == [assumed]


@pytest.mark.parametrize("as_stored", [True, False])
@pytest.mark.parametrize("camera_size", [(48, 36), (36, 48), None])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_an_image_is_turned_unless_its_camera_is_one_of_the_stored_pixels(
    as_stored, camera_size, orientation, read, tmp_path
):
    paths = [image(tmp_path / f"f{n}.jpg", (48, 36), orientation) for n in range(2)]
    made = [candidate(path, n, RawCamera(K, camera_size)) for n, path in enumerate(paths)]
    sideways = orientation == 6
    stored = as_stored and not (sideways and camera_size == (36, 48))
    size = (48, 36) if stored or not sideways else (36, 48)
    if camera_size is not None and camera_size != size:
        with pytest.raises(InputError, match=r"f0.jpg must be of the aspect ratio.*For a crop, pass --K"):
            read(made, as_stored=as_stored)
        return
    found = read(made, as_stored=as_stored)
    assert all((frame.size, frame.as_stored) == (size, stored) for frame in found.frames)
    assert [finding.code for finding in found.findings] == ["capture.stored-pixels"] * (
        stored and orientation > 1
    )
    if found.findings:
        assert found.findings[0].startswith("f0, f1: their EXIF orientation is ignored, because")


def test_frames_of_a_video_have_their_size_and_need_a_camera(read, tmp_path):
    path = tmp_path / "v.mp4"
    path.touch()
    made = [candidate(path, n, RawCamera(None, (64, 40)), index=n) for n in range(2)]
    assert all(frame.size == (64, 40) for frame in read(made, K=K).frames)
    found = read([replace(each, camera=RawCamera(K, (64, 40))) for each in made])
    np.testing.assert_array_equal(found.frames[1].camera.K, K)
    assert found.findings == []
    with pytest.raises(InputError, match=r"K must be set by --K or --fov; got none. A video has no focal"):
        read(made)


def test_frames_that_cannot_be_used_are_left_out_with_their_reasons(read, tmp_path):
    good = [candidate(image(tmp_path / f"g{n}.png"), n) for n in range(3)]
    bad = [candidate(tmp_path / f"{'n' * 70}{n}.png", n) for n in range(7)]
    cropped = candidate(image(tmp_path / "crop.png", (48, 20)))
    lens = candidate(image(tmp_path / "lens.png"), camera=RawCamera(K, SIZE, (), "omni"))
    lost = [candidate(image(tmp_path / f"lost{n}.png"), E=False) for n in range(2)]
    said = replace(good[0], problem="named twice.")
    found = read([*bad, good[0], cropped, *lost, lens, said, good[1], good[2]])
    assert [frame.name for frame in found.frames] == ["g0", "g1", "g2"]
    assert [finding.code for finding in found.findings] == ["capture.skipped"] * 4
    name = "n" * 60 + "..."
    assert found.findings[0] == f"{', '.join([name] * 5)} and 2 more: no image file; 7 skipped."
    assert found.findings[1].startswith(
        "crop: crop.png must be of the aspect ratio of its camera's images (48x36)"
    )
    assert found.findings[1].endswith("For a crop, pass --K; 1 skipped.")
    assert found.findings[2] == "lost0, lost1: no pose; 2 skipped."
    assert found.findings[3] == "2 more skipped for similar reasons."
    few = read([bad[0], *good, *lost]).findings
    assert [str(finding) for finding in few] == [
        f"{name}: no image file; 1 skipped.",
        "lost0, lost1: no pose; 2 skipped.",
    ]


def test_without_any_pose_all_frames_stay_and_have_no_unit(read, tmp_path):
    paths = [image(tmp_path / f"f{n}.png") for n in range(3)]
    found = read([candidate(path, E=False) for path in paths])
    assert len(found.frames) == 3 and found.unit is None
    assert [finding.code for finding in found.findings] == ["capture.no-poses"]
    assert found.findings[0] == "No frame of made has a pose. Poses are estimated, without a unit."
    assert read([candidate(path, E=False) for path in paths], has_poses=False).findings == []
    tracked = candidate(paths[0])
    lost = [candidate(path, E=False) for path in paths[1:]]
    found = read([replace(tracked, problem="bad"), *lost])
    assert len(found.frames) == 2 and found.unit is None, (
        "a pose of a frame that is left out counts for nothing"
    )
    with pytest.raises(InputError, match=r"at least two frames; got 1 in .*f1, f2: no pose; 2 skipped"):
        read([tracked, *lost])


def test_one_frame_alone_has_no_second_view(read, tmp_path):
    alone = candidate(image(tmp_path / "a.png"))
    with pytest.raises(InputError, match="at least two frames; got 1 in .*A single frame has no second view"):
        read([alone])
    with pytest.raises(InputError, match="at least two frames; got 0 in .*Its file lists no images"):
        read([])
    assert len(read([alone, replace(alone, frame=replace(alone.frame, name="b"))]).frames) == 2


@pytest.mark.parametrize(
    ("size", "said"),
    [
        ((480, 360), ""),
        ((481, 361), ""),  # rounded
        ((482, 360), "an image of 482x360, a camera for 480x360"),
        ((480, 362), "an image of 480x362, a camera for 480x360"),
        ((478, 359), "an image of 478x359, a camera for 480x360"),
        ((527, 395), "an image of 527x395, a camera for 480x360"),
        ((528, 396), ""),  # a copy of another size
        ((433, 325), "an image of 433x325, a camera for 480x360"),
        ((432, 324), ""),
        ((240, 180), ""),
    ],
)
def test_an_image_of_nearly_the_size_of_its_camera_is_reported(size, said, read, tmp_path):
    plain = candidate(image(tmp_path / "f0.png"))
    made = [
        plain,
        *(candidate(image(tmp_path / f"f{n}.png", size), n, RawCamera(K, (480, 360))) for n in (1, 2)),
    ]
    found = read(made)
    assert [finding.code for finding in found.findings] == (["capture.size-mismatch"] if said else [])
    if said:
        assert found.findings[0].startswith(
            f"f1, f2: {said}. If these are images before undistortion, pass the folder of"
        )
        assert read(made, K=K).findings == read(made, fov=50.0).findings == []


def test_names_of_frames_are_unique(read, tmp_path):
    paths = [image(tmp_path / side / "f.png") for side in ("a", "b")]
    assert [frame.name for frame in read([candidate(path) for path in paths]).frames] == ["a-f", "b-f"]


def test_what_does_not_belong_to_a_capture_is_rejected(read, tmp_path):
    with pytest.raises(MissingFileError, match="PATH must be a capture; got .*none, which does not exist"):
        read_capture(tmp_path / "none")
    (tmp_path / "poses.txt").write_text("0 0 0 0 0 0 0 1\n")
    folder = tmp_path / "two"
    for n in range(2):
        image(folder / f"f{n}.jpg")
    with pytest.raises(
        InputError, match=r"trajectory \(--trajectory\) must be omitted unless the capture is"
    ):
        read_capture(folder, trajectory=tmp_path / "poses.txt")
    with pytest.raises(
        InputError, match=r"images \(--images\) must be omitted unless a file lists the images"
    ):
        read_capture(folder, fov=60.0, images=folder)
    with pytest.raises(TypeError):
        read_capture(folder, K)  # settings are given by name
    found = read_capture(folder, fov=60.0)
    assert (
        found.kind == "images without poses"
        and found.unit is None
        and [f.name for f in found.frames] == ["f0", "f1"]
    )
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"\A.*empty"):
        read_capture(tmp_path / "empty")


def test_a_video_with_a_trajectory_has_poses_in_metres(tmp_path):
    path = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (64, 48))
    for n in range(4):
        writer.write(np.full((48, 64, 3), 40 * n, np.uint8))
    writer.release()
    rows = [[0.1 * n, *pose(n)[:3, 3], *Rotation.from_matrix(pose(n)[:3, :3]).as_quat()] for n in range(4)]
    np.savetxt(tmp_path / "t.txt", rows)
    found = read_capture(path, fov=60.0, trajectory=tmp_path / "t.txt")
    assert found.unit == "m" and len(found.frames) == 4
    for number, frame in enumerate(found.frames):
        np.testing.assert_allclose(frame.E, pose(number), atol=1e-9)
        assert frame.index == number and frame.size == (64, 48)


@pytest.mark.parametrize("layout", captures.LAYOUTS, ids=lambda layout: layout.summary)
def test_a_format_that_names_its_images_takes_the_folder_that_the_user_gives_for_them(layout):
    """What the table declares is what the reader itself takes."""
    assert ("images_at" in inspect.signature(layout.read).parameters) is layout.names_images


@pytest.mark.parametrize("layout", captures.LAYOUTS, ids=lambda layout: layout.summary)
def test_no_format_reads_an_empty_folder(layout, tmp_path):
    given = (tmp_path,) if layout.names_images else ()
    assert layout.read(tmp_path, *given) is None
    assert all(isinstance(mark, str) for marks in layout.patterns for mark in marks)
