"""Captures of ``transforms.json`` and COLMAP as users have them: turned, hostile, of other programs."""

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin import GeometryGuidance, InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.colmap import MODELS
from geodiff_plugin.formats.images import in_stored_pixels
from geodiff_plugin.jobs.notices import say
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from tests.contracts.captures import TRUE
from tests.contracts.captures_in_folders import IMAGES, colmap_binary, colmap_text, save, transforms
from tests.unit.capture_room import SIZE, K, render, write_transforms


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_models_are_calibrations_and_a_cut_off_file_is_named(tmp_path, name):
    path = colmap_binary(tmp_path) / "sparse" / "0" / name
    rig = read_calibration(path.parent, image_names=("f00.png", "f03.png"), baseline_m=0.3)
    np.testing.assert_allclose(rig.K_right, K)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got too few.*truncated"):
        Capture.open(tmp_path)


def lose(folder: Path, data: dict) -> None:
    for i in range(3):
        (folder / f"images/f{i:02d}.png").unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lose, "at least two frames"),
        (lambda _, data: [data.pop(key) for key in ("fl_x", "fl_y")], "no focal length.*--fov"),
        (lambda _, data: data.pop("frames"), "an object with a list 'frames'; got with fl_x"),
        (lambda _, data: data.update(Frames=data.pop("frames")), "Names are lower case"),
        (lambda _, data: data.update(frames={}), "an object with a list 'frames'"),
    ],
)
def test_bad_captures_get_a_sentence(change, words, tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    change(folder, data)
    (folder / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=words):
        Capture.open(folder)


def crop(folder: Path, frame: dict) -> None:
    Image.fromarray(IMAGES[1][:90]).save(folder / "images/f01.png")


def scaled(_: Path, frame: dict) -> None:
    """The same pose as a homogeneous matrix whose last number is 2."""
    frame["transform_matrix"] = (2 * np.array(frame["transform_matrix"])).tolist()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (
            lambda _, frame: frame.update(transform_matrix=[[1, 2]]),
            "transform_matrix must be 16 finite numbers",
        ),
        (lambda _, frame: frame.update(transform_matrix=None), "no pose"),
        (lambda _, frame: frame["transform_matrix"].__setitem__(0, [float("nan")] * 4), "no pose"),
        (lambda _, frame: frame.pop("transform_matrix"), "no pose"),
        (lambda _, frame: frame.update(camera_model="EQUIRECTANGULAR"), "got EQUIRECTANGULAR"),
        (lambda _, frame: frame.update(w="wide"), "entries cannot be read"),
        (lambda _, frame: frame.update(file_path="images/f00.png"), "named twice"),
        (lambda folder, _: (folder / "images/f01.png").write_bytes(b"?"), "f01.png must be an image file"),
        (crop, "crop"),
        (scaled, ""),
    ],
)
def test_what_is_wrong_with_a_frame_leaves_out_that_frame_alone(change, why, tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    change(folder, data["frames"][1])
    (folder / "transforms.json").write_text(json.dumps(data))
    capture = Capture.open(folder)
    assert capture.names == ["f00", *["f01"] * (not why), "f02", "f03"]
    np.testing.assert_allclose(capture.frames[-1].E, TRUE[3], atol=1e-6)
    assert (
        (why in capture.findings[0] and "1 skipped" in capture.findings[0]) if why else not capture.findings
    )


ORIENTATION = 0x0112
TURNED = pytest.mark.parametrize("orientation", [3, 6, 8])


def turn(image: Path, orientation: int) -> None:
    """Set a rotation in an image's EXIF data; its pixels are unchanged."""
    exif = Image.Exif()
    exif[ORIENTATION] = orientation
    with Image.open(image) as opened:
        opened.save(image, exif=exif)


@TURNED
@pytest.mark.parametrize("write", [transforms, colmap_text], ids=lambda write: write.__name__)
def test_cameras_of_stored_pixels_leave_images_as_they_are_stored(write, orientation, tmp_path):
    folder = write(tmp_path / "scan")
    for image in (folder / "images").iterdir():
        turn(image, orientation)
    capture = Capture.open(folder)
    assert (
        "f00, f01, f02, f03: their EXIF orientation is ignored" in capture.findings[0]
        and len(capture.findings) == 1
    )
    for frame, E, image in zip(capture.frames, TRUE, IMAGES, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.camera.K, K, atol=1e-9)
        assert frame.size == SIZE
        np.testing.assert_allclose(capture.image(frame.name), image / 255, atol=1e-6)
    if write is transforms:
        depth, known = capture.measured_depth("f02")
        np.testing.assert_allclose(depth, render(TRUE[2])[1], atol=1e-3)
        assert known.all()


@pytest.mark.parametrize("orientation", [6, 8])
def test_a_camera_whose_size_is_that_of_the_turned_image_turns_it(orientation, tmp_path):
    """An exporter that turned the pixels' camera but not the pixels: the sizes leave no doubt."""
    folder = write_transforms(tmp_path, TRUE, TRUE, w=SIZE[1], h=SIZE[0], cx=90.5, cy=120.5)
    for image in (folder / "images").iterdir():
        turn(image, orientation)
    capture = Capture.open(folder)
    assert not capture.findings and capture.frames[0].size == SIZE[::-1]
    quarter = {6: -1, 8: 1}[orientation]
    np.testing.assert_allclose(capture.image("f01"), np.rot90(IMAGES[1], quarter) / 255, atol=1e-6)


@TURNED
def test_images_without_cameras_are_used_as_displayed(orientation, tmp_path):
    for i, image in enumerate(IMAGES):
        save(tmp_path / f"i{i}.png", image)
        turn(tmp_path / f"i{i}.png", orientation)
    capture = Capture.open(tmp_path, fov=60.0)
    shown = np.rot90(IMAGES[0], {3: 2, 6: -1, 8: 1}[orientation])
    assert capture.frames[0].size == shown.shape[1::-1] and not capture.findings
    np.testing.assert_allclose(capture.image("i0"), shown / 255, atol=1e-6)


@TURNED
def test_a_pair_of_a_colmap_model_is_read_as_it_is_stored(orientation, tmp_path):
    folder = colmap_text(tmp_path)
    for image in (folder / "images").iterdir():
        turn(image, orientation)
    left, right = (folder / "images" / f"f0{i}.png" for i in (0, 3))
    options = DepthOptions(left=left, right=right, calib=(folder / "sparse" / "0",), baseline=0.33)
    inputs = read_pair(options)
    np.testing.assert_allclose(inputs.left, IMAGES[0] / 255, atol=1e-6)
    np.testing.assert_allclose(inputs.rig.K_left, K)


@TURNED
@pytest.mark.parametrize("write", [transforms, colmap_text], ids=lambda write: write.__name__)
def test_no_hint_to_rotate_an_image_whose_camera_refers_to_stored_pixels(write, orientation, tmp_path):
    folder = write(tmp_path)
    for image in (folder / "images").iterdir():
        turn(image, orientation)
    cameras = folder / ("transforms.json" if write is transforms else "sparse/0")
    names = tuple(f"{'images/' if write is transforms else ''}f0{i}.png" for i in (0, 3))
    with Image.open(folder / "images/f00.png") as left, Image.open(folder / "images/f03.png") as right:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            guidance = GeometryGuidance.from_calibration(right, cameras, image_names=names, baseline_m=0.33)
            lefts_01 = left_images(in_stored_pixels(left))
        assert guidance.as_stored and right.getexif()[ORIENTATION] == orientation
        with pytest.warns(UserWarning, match="exif_transpose"):  # by K and E nobody knows it
            GeometryGuidance(right, K, TRUE[0] @ np.linalg.inv(TRUE[3]))
    np.testing.assert_allclose(guidance.rights[0].permute(1, 2, 0), IMAGES[3] / 255, atol=1e-6)
    np.testing.assert_allclose(lefts_01[0].permute(1, 2, 0), IMAGES[0] / 255, atol=1e-6)


@pytest.mark.parametrize("stem", ["..", ".hidden", "a\nb", "\x1b[31mred"])
def test_a_hostile_name_stays_inside_the_output_and_out_of_the_terminal(stem, tmp_path, capsys):
    folder = write_transforms(tmp_path / "scan", TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    (folder / "images/f01.png").rename(folder / f"images/{stem}.png")
    data["frames"][1]["file_path"] = f"images/{stem}.png"
    (folder / "transforms.json").write_text(json.dumps(data))
    names = Capture.open(folder).names
    assert len(names) == 4
    assert all(name.isprintable() and not name.startswith(".") and "/" not in name for name in names)
    data["frames"][1]["file_path"] = f"../../../{stem}\x1b[2J.png"  # nothing there
    (folder / "transforms.json").write_text(json.dumps(data))
    left = Capture.open(folder)
    assert len(left) == 3
    say(left.findings[0])
    assert "\x1b" not in capsys.readouterr().err


def hostile_transforms(folder: Path, name: str) -> None:
    data = json.loads((transforms(folder) / "transforms.json").read_text())
    data["frames"][1]["file_path"] = name
    data["frames"][2]["depth_file_path"] = name
    (folder / "transforms.json").write_text(json.dumps(data))


def hostile_text(folder: Path, name: str) -> None:
    file = colmap_text(folder) / "sparse/0/images.txt"
    file.write_bytes(file.read_bytes().replace(b"f01.png", name.encode()))


def hostile_binary(folder: Path, name: str) -> None:
    file = colmap_binary(folder) / "sparse/0/images.bin"
    file.write_bytes(file.read_bytes().replace(b"f01.png", name.encode()))


HOSTILE = {
    "above": "../../../../../../../../etc/passwd",
    "absolute": "/etc/passwd",
    "device": "/dev/zero",
    "null": "a\0b.png",
    "line": "a\nb.png",
    "long": "x" * 5000 + ".png",
    "deep": "a/" * 3000 + "b.png",
    "windows": "C:\\..\\..\\x.png",
    "share": "//server/share/x.png",
    "folder": "images/",
    "dots": "..",
    "empty": "",
    "escape": "\x1b[2J.png",
}


@pytest.mark.parametrize(
    "write", [hostile_transforms, hostile_text, hostile_binary], ids=lambda w: w.__name__
)
@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_name_in_a_file_of_cameras_leaves_out_its_frame_alone(write, name, tmp_path, capsys):
    if write is hostile_binary and "\0" in name:
        pytest.skip("there a zero ends the name")
    write(tmp_path, name)
    capture = Capture.open(tmp_path)
    assert capture.names == ["f00", "f02", "f03"]
    for frame in capture.frames:
        assert frame.image.resolve().parent == (tmp_path / "images").resolve()
    for note in capture.findings:
        say(note)
    said = capsys.readouterr().err
    assert all(len(line) < 1000 and line.isprintable() for line in said.splitlines())


def test_images_of_one_name_in_two_folders_stay_separate(tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        frame["file_path"] = f"{'ab'[i // 2]}/rgb/{i % 2}.png"
        save(folder / frame["file_path"], IMAGES[i])
    (folder / "transforms.json").write_text(json.dumps(data))
    capture = Capture.open(folder)
    assert capture.names == ["a-rgb-0", "a-rgb-1", "b-rgb-0", "b-rgb-1"]
    for name, image in zip(capture.names, IMAGES, strict=True):
        np.testing.assert_allclose(capture.image(name), image / 255, atol=1e-6)
    (folder / "b/rgb/1.png").unlink()  # a file of this name in another folder is not taken for it
    assert Capture.open(folder).names == ["a-rgb-0", "a-rgb-1", "b-rgb-0"]


DEPTH_KINDS = [
    ("png", {}, 1000, np.uint16),
    ("png", {"depth_unit_scale_factor": 1 / 256}, 256, np.uint16),
    ("png", {"integer_depth_scale": 10 / 65535}, 6553.5, np.uint16),
    ("npy", {}, 1, np.float32),
    ("npy", {}, 1000, np.uint16),
    ("npy", {"depth_unit_scale_factor": 1e-3}, 1000, np.float32),
    ("tiff", {}, 1, np.float32),
    ("exr", {}, 1, np.float32),
]


@pytest.mark.parametrize("key", ["depth_file_path", "depth_path", None])
@pytest.mark.parametrize(("suffix", "more", "per_m", "kind"), DEPTH_KINDS)
def test_depth_maps_of_every_kind_and_unit(suffix, more, per_m, kind, key, tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE, **more)
    depth = render(TRUE[1])[1] * per_m
    depth = np.rint(depth).astype(kind) if np.issubdtype(kind, np.integer) else depth.astype(kind)
    for file in (folder / "depth").iterdir():
        file.unlink()
    path = folder / "depth" / f"f01.{suffix}"
    if suffix == "npy":
        np.save(path, depth)
    elif suffix == "exr":
        exr = pytest.importorskip("OpenEXR")
        exr.File({"compression": exr.ZIP_COMPRESSION}, {"Y": depth}).write(str(path))
    else:
        Image.fromarray(depth).save(path)
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        del frame["depth_file_path"]
        if key:
            frame[key] = f"depth\\f01.{suffix}"  # as programs of Windows write it
    (folder / "transforms.json").write_text(json.dumps(data))
    read, known = Capture.open(folder).measured_depth("f01")
    np.testing.assert_allclose(read, render(TRUE[1])[1], atol=0.6 / per_m if per_m > 1 else 1e-5)
    assert known.all()


TEXT_FORMS = {
    "whole keypoints": lambda text: text,
    "tabs": lambda text: text.replace(" ", "\t"),
    "no last newline": lambda text: text.rstrip(),
    "blank lines": lambda text: text.replace("\n1 ", "\n\n\n1 "),
    "no head": lambda text: "\n".join(line for line in text.splitlines() if line[:1] != "#"),
    "Windows' line ends": lambda text: text.replace("\n", "\r\n"),
}


@pytest.mark.parametrize("form", TEXT_FORMS)
def test_text_of_colmap_as_other_programs_write_it(form, tmp_path):
    """Every image sees points at whole pixels, so that lines of keypoints look much like those of images."""
    model = colmap_text(tmp_path) / "sparse" / "0"
    lines = [line for line in (model / "images.txt").read_text().splitlines() if "png" in line]
    keypoints = " ".join(f"{10 * n} {n} {n}" for n in range(1, 9))
    text = "# Image list with two lines of data per image:\n" + "".join(f"{x}\n{keypoints}\n" for x in lines)
    (model / "images.txt").write_bytes(TEXT_FORMS[form](text).encode())
    cameras = model / "cameras.txt"
    cameras.write_bytes(TEXT_FORMS[form](cameras.read_text()).encode())
    capture = Capture.open(tmp_path)
    assert capture.names == ["f00", "f01", "f02", "f03"] and not capture.findings
    np.testing.assert_allclose(capture.frames[2].E, TRUE[2], atol=1e-6)
    np.testing.assert_allclose(capture.frames[2].camera.K, K)


def test_an_image_without_a_pose_leaves_out_itself(tmp_path):
    images = colmap_text(tmp_path) / "sparse" / "0" / "images.txt"
    lines = images.read_text().splitlines()
    row = next(number for number, line in enumerate(lines) if "f02.png" in line)
    lines[row] = "3 0 0 0 0 1 2 3 3 f02.png"
    images.write_text("\n".join(lines))
    capture = Capture.open(tmp_path)
    assert capture.names == ["f00", "f01", "f03"] and "f02" in capture.findings[0]


#: Coefficients that bend an image by several pixels, of every model with a focal length.
BENDS = {
    "FOV": [0.6],
    "EUCM": [0.6, 1.1],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [-0.1],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, 0.01, 0, 0, 0, 0, 0.001, -0.001, 0.001, 0, 0.001, 0],
    "THIN_PRISM_FISHEYE": [0.05, 0.01, 0.001, -0.001, 0.01, 0, 0.001, 0.001],
}


@pytest.mark.parametrize("model", [name for name, form in MODELS.items() if form.focals])
def test_every_camera_model_of_colmap_is_undistorted_as_by_pycolmap(model, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera.create_from_model_name(1, model, 200.0, *SIZE)
    form = MODELS[model]
    bend = BENDS.get(model, [0.05, 0.01, 0.002, -0.001, 0.01, 0, 0, 0][: form.behind])
    camera.params = [*(200.0, 205.0)[: form.focals], 118.5, 91.5, *bend]
    folder = colmap_text(tmp_path)
    numbers = " ".join(f"{value:.17g}" for value in camera.params)
    lines = [f"{n} {model} {SIZE[0]} {SIZE[1]} {numbers}" for n in range(1, 5)]
    (folder / "sparse/0/cameras.txt").write_text("\n".join(lines))
    capture = Capture.open(folder)
    frame = capture.frames[0]
    rays = np.random.default_rng(0).uniform(-0.35, 0.35, (50, 2))
    taken = camera.img_from_cam(np.c_[rays, np.ones(50)]) - 0.5
    pinhole = rays @ frame.camera.K[:2, :2].T + frame.camera.K[:2, 2]
    if frame.camera.lens is None:
        np.testing.assert_allclose(taken, pinhole, atol=1e-6)
    else:
        assert np.abs(taken - pinhole).max() > 0.5
        np.testing.assert_allclose(frame.camera.undistorted_px(taken), pinhole, atol=0.02)
        assert capture.image("f00").shape == (*SIZE[::-1], 3)


def test_the_folder_of_models_alone_is_enough(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    assert len(Capture.open(folder / "sparse")) == len(Capture.open(folder)) == 4


def test_commas_may_divide_the_numbers_of_an_image_of_colmap(tmp_path):
    """As kapture's export of rigs writes them."""
    file = colmap_text(tmp_path / "scan") / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(x.replace(" ", ", ") if x.endswith("png") else x for x in lines))
    np.testing.assert_allclose(Capture.open(tmp_path / "scan").frames[2].E, TRUE[2], atol=1e-6)


def test_a_project_that_kept_its_undistorted_images_alone_is_read_by_their_model(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    (folder / "dense" / "0").mkdir(parents=True)
    shutil.copytree(folder / "sparse" / "0", folder / "dense" / "0" / "sparse")
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("PINHOLE", "OPENCV").replace("91.5\n", "91.5 0.1 0 0 0\n"))
    assert Capture.open(folder).frames[0].camera.lens is not None
    (folder / "images").rename(folder / "dense" / "0" / "images")
    capture = Capture.open(folder)
    assert len(capture) == 4 and all(frame.camera.lens is None for frame in capture.frames)
    shutil.rmtree(folder / "dense" / "0" / "images")
    with pytest.raises(InputError, match="no image file in sparse/0"):
        Capture.open(folder)
