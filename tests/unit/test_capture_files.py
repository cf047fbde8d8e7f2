"""Readers of captures: every layout gives the same frames, and bad input a sentence."""

import json
import shutil
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from geodiff_plugin import GeometryGuidance, InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.evidence.inputs import left_images
from geodiff_plugin.formats import layouts, read_calibration
from geodiff_plugin.formats.clouds import Cloud
from geodiff_plugin.formats.colmap import MODELS, write_colmap
from geodiff_plugin.formats.images import in_stored_pixels
from geodiff_plugin.formats.lenses import undistorted_pixels
from geodiff_plugin.formats.transforms import named_in_transforms, transforms_of
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.reading import read_pair
from geodiff_plugin.jobs.telling import say
from tests.unit.capture_room import SIZE, K, render, walk, write_transforms

TRUE = walk(4)
IMAGES = [render(E)[0] for E in TRUE]


def save(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def transforms(folder: Path) -> Path:
    return write_transforms(folder, TRUE, TRUE)


def colmap_text(folder: Path) -> Path:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    views = [(f"f{i:02d}.png", K, E, SIZE) for i, E in enumerate(TRUE)]
    for (name, *_), image in zip(views, IMAGES, strict=True):
        save(folder / "images" / name, image)
    cloud = Cloud(np.array([[0.5, 0.25, 2.6]]), np.full((1, 3), 9, np.uint8))
    seen = [(np.full((1, 2), 10.0), np.zeros(1, int))] * 2 + [(np.zeros((0, 2)), np.zeros(0, int))]
    write_colmap(model, views, cloud, [*seen, seen[0]])
    return folder


def colmap_binary(folder: Path) -> Path:
    model = colmap_text(folder) / "sparse" / "0"
    pytest.importorskip("pycolmap").Reconstruction(str(model)).write_binary(str(model))
    for name in ("cameras", "images", "points3D"):
        (model / f"{name}.txt").unlink()
    return folder


def seven_scenes(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / f"frame-{i:06d}.color.png", image)
        np.savetxt(folder / f"frame-{i:06d}.pose.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsics.txt", K)
    return folder


def scannet(folder: Path) -> Path:
    for i, (E, image) in enumerate(zip(TRUE, IMAGES, strict=True)):
        save(folder / "color" / f"{10 * i}.png", image)  # 30 comes after 0, 10, 20
        save(folder / "depth" / f"{10 * i}.png", image)
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{10 * i}.txt", E, fmt="%.9f")
    np.savetxt(folder / "intrinsic_color.txt", np.pad(K, (0, 1)) + np.diag([0, 0, 0, 1]))
    return folder


def trajectory(E: np.ndarray, times: np.ndarray) -> str:
    rows = np.c_[times, E[:, :3, 3], Rotation.from_matrix(E[:, :3, :3]).as_quat()]
    return "# timestamp tx ty tz qx qy qz qw\n" + "\n".join(" ".join(f"{v:.9f}" for v in row) for row in rows)


def tum(folder: Path) -> Path:
    for i, image in enumerate(IMAGES):
        save(folder / "rgb" / f"{i}.png", image)
    names = "".join(f"{i}.5 rgb/{i}.png\n" for i in range(4))
    (folder / "rgb.txt").write_text("# timestamp filename\n" + names)
    (folder / "depth.txt").write_text(names.replace(".5", ".51"))
    (folder / "groundtruth.txt").write_text(trajectory(TRUE, np.arange(4) + 0.5))
    np.savetxt(folder / "K.txt", K)
    return folder


LAYOUTS = [transforms, colmap_text, colmap_binary, seven_scenes, scannet, tum]


@pytest.mark.parametrize("write", LAYOUTS, ids=lambda write: write.__name__)
def test_every_layout_gives_the_same_frames(write, tmp_path):
    capture = Capture.open(write(tmp_path / "scan"))
    assert len(capture.frames) == 4 and not capture.notes
    for frame, E in zip(capture.frames, TRUE, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.K, K, atol=1e-9)
        assert frame.size == SIZE and frame.lens is None and frame.image.is_file()
    assert capture.unit == (None if "colmap" in write.__name__ else "m")
    assert (capture.frames[3].depth is not None) == (write in (transforms, scannet, tum))
    points = [None if frame.points is None else frame.points.tolist() for frame in capture.frames]
    seen = [[0.5, 0.25, 2.6]] if "colmap" in write.__name__ else None
    assert points == [seen, seen, None, seen]


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_models_are_calibrations_and_a_cut_off_file_is_named(tmp_path, name):
    path = colmap_binary(tmp_path) / "sparse" / "0" / name
    rig = read_calibration(path.parent, image_names=("f00.png", "f03.png"), baseline_m=0.3)
    np.testing.assert_allclose(rig.K_right, K)
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(InputError, match=rf"{name} must be a binary COLMAP file; got less.*cut off"):
        Capture.open(tmp_path)


@pytest.mark.parametrize("line", ["{t} rgb/{i}.png {t} depth/{i}.png", "{t} depth/{i}.png {t} rgb/{i}.png"])
def test_associations_of_tum_name_images_and_depth_maps_in_either_order(line, tmp_path):
    folder = tum(tmp_path / "scan")
    (folder / "depth").mkdir()
    for i in range(4):
        shutil.copy(folder / "rgb" / f"{i}.png", folder / "depth")
    (folder / "rgb.txt").unlink()
    (folder / "depth.txt").unlink()
    lines = "".join(f"{line.format(t=i + 0.5, i=i)}\n" for i in range(4))
    (folder / "associations.txt").write_text(lines)
    capture = Capture.open(folder)
    np.testing.assert_allclose([frame.E for frame in capture.frames], TRUE, atol=1e-6)
    assert [frame.image for frame in capture.frames] == [folder / f"rgb/{i}.png" for i in range(4)]
    assert [frame.depth for frame in capture.frames] == [folder / f"depth/{i}.png" for i in range(4)]
    (folder / "associations.txt").write_text("0.5 rgb/0.png\n")
    with pytest.raises(InputError, match="seconds and file names, twice a line"):
        Capture.open(folder)


def test_a_video_takes_its_poses_from_a_trajectory(tmp_path):
    writer = cv2.VideoWriter(str(tmp_path / "v.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10, SIZE)
    for image in IMAGES:
        writer.write(image[..., ::-1])
    writer.release()
    (tmp_path / "t.txt").write_text(trajectory(TRUE[:3], np.arange(3) / 10))
    np.savetxt(tmp_path / "K.txt", K)
    capture = Capture.open(tmp_path / "v.mp4", K=K, trajectory=tmp_path / "t.txt")
    assert [frame.index for frame in capture.frames] == [0, 1, 2] and "000003" in capture.notes[0]
    np.testing.assert_allclose([frame.E for frame in capture.frames], TRUE[:3], atol=1e-6)
    with pytest.raises(InputError, match="--fov"):
        Capture.open(tmp_path / "v.mp4")


def test_images_without_poses_take_a_field_of_view(tmp_path):
    for i, image in enumerate(IMAGES):
        save(tmp_path / f"i{i}.png", image)
    capture = Capture.open(tmp_path, fov=60.0)
    assert all(frame.E is None for frame in capture.frames) and capture.unit is None
    np.testing.assert_allclose(capture.frames[0].K[0, 0], 120 / np.tan(np.radians(30)))
    with pytest.raises(InputError, match="K"):
        Capture.open(tmp_path)


def test_units_and_lenses_of_transforms(tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE, k1=-0.1)
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace('"transform_matrix"', '"colmap_im_id": 1, "transform_matrix"'))
    capture = Capture.open(folder)
    assert capture.unit is None and capture.frames[0].lens.coefficients[0] == -0.1
    assert capture.frames[0].depth == folder / "depth/f00.png"


def test_lengths_of_transforms_without_depth_maps_are_said_to_be_taken_as_metres(tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    said = [note.code for note in Capture.open(folder).notes]
    assert "capture.assumed-metres" not in said
    shutil.rmtree(folder / "depth")
    without = Capture.open(folder)
    assert without.unit == "m" and [note.code for note in without.notes] == ["capture.assumed-metres"]
    path = folder / "transforms.json"
    path.write_text(path.read_text().replace('"transform_matrix"', '"sharpness": 9, "transform_matrix"'))
    solved = Capture.open(folder)
    assert solved.unit is None and not solved.notes


def test_focal_lengths_of_each_frame_and_a_divisor_of_depth_maps_are_read(tmp_path):
    """As dense_depth_priors_nerf has them."""
    folder = write_transforms(tmp_path, TRUE, TRUE)
    path = folder / "transforms.json"
    data = json.loads(path.read_text())
    shared = {new: data.pop(old) for new, old in (("fx", "fl_x"), ("fy", "fl_y"))}
    data["frames"] = [frame | shared for frame in data["frames"]]
    path.write_text(json.dumps(data | {"depth_scaling_factor": 4000.0}))
    frame = Capture.open(folder).frames[1]
    np.testing.assert_allclose(frame.K, K)
    assert frame.depth_per_m == 4000


def lose(folder: Path, data: dict) -> None:
    for i in range(3):
        (folder / f"images/f{i:02d}.png").unlink()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lose, "at least two frames"),
        (lambda _, data: [data.pop(key) for key in ("fl_x", "fl_y")], "no focal length.*--fov"),
        (lambda _, data: data.pop("frames"), "an object with a list 'frames'; got with fl_x"),
        (lambda _, data: data.update(Frames=data.pop("frames")), "Names are in small letters"),
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
        (lambda _, frame: frame.update(w="wide"), "entries do not read"),
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
    assert (why in capture.notes[0] and "1 skipped" in capture.notes[0]) if why else not capture.notes


def test_missing_images_and_lost_poses_are_named(tmp_path):
    folder = write_transforms(tmp_path / "a", TRUE, TRUE)
    (folder / "images/f01.png").unlink()
    capture = Capture.open(folder)
    assert len(capture.frames) == 3 and "f01" in capture.notes[0]
    lost = seven_scenes(tmp_path / "b")
    (lost / "frame-000002.pose.txt").write_text("-inf " * 16)
    capture = Capture.open(lost)
    assert len(capture.frames) == 3 and "frame-000002" in capture.notes[0]
    with pytest.raises(FileNotFoundError):
        Capture.open(tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="none of these"):
        Capture.open(tmp_path / "empty")


ORIENTATION = 0x0112
TURNED = pytest.mark.parametrize("orientation", [3, 6, 8])


def turn(image: Path, orientation: int) -> None:
    """Say in an image's EXIF data that it is shown turned; its pixels stay as they are."""
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
    assert "f00, f01, f02, f03: their EXIF data say" in capture.notes[0] and len(capture.notes) == 1
    for frame, E, image in zip(capture.frames, TRUE, IMAGES, strict=True):
        np.testing.assert_allclose(frame.E, E, atol=1e-6)
        np.testing.assert_allclose(frame.K, K, atol=1e-9)
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
    assert not capture.notes and capture.frames[0].size == SIZE[::-1]
    quarter = {6: -1, 8: 1}[orientation]
    np.testing.assert_allclose(capture.image("f01"), np.rot90(IMAGES[1], quarter) / 255, atol=1e-6)


@TURNED
def test_photographs_without_cameras_are_taken_as_they_are_shown(orientation, tmp_path):
    for i, image in enumerate(IMAGES):
        save(tmp_path / f"i{i}.png", image)
        turn(tmp_path / f"i{i}.png", orientation)
    capture = Capture.open(tmp_path, fov=60.0)
    shown = np.rot90(IMAGES[0], {3: 2, 6: -1, 8: 1}[orientation])
    assert capture.frames[0].size == shown.shape[1::-1] and not capture.notes
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
def test_nobody_is_told_to_turn_an_image_whose_camera_is_of_stored_pixels(write, orientation, tmp_path):
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
    say(left.notes[0])
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
    for note in capture.notes:
        say(note)
    said = capsys.readouterr().err
    assert all(len(line) < 1000 and line.isprintable() for line in said.splitlines())
    file = transforms_of(tmp_path) if write is hostile_transforms else None
    assert file is None or named_in_transforms(file, name) is None  # nothing of it is copied


def test_images_of_one_name_in_two_folders_stay_apart(tmp_path):
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


def test_the_largest_of_several_models_is_taken_and_said(tmp_path):
    folder = colmap_text(tmp_path)
    (folder / "sparse" / "1").mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        text = (folder / "sparse" / "0" / name).read_text()
        (folder / "sparse" / "1" / name).write_text(text)
        if name == "images.txt":
            (folder / "sparse" / "0" / name).write_text("\n".join(text.splitlines()[:5]))
    capture = Capture.open(folder)
    assert len(capture) == 4
    assert capture.notes == [
        "sparse/1, with 4 images, is used, the largest of 2 models; left out: sparse/0 with 2. "
        "To take another, give its folder."
    ]
    assert len(Capture.open(folder / "sparse" / "0")) == 2


def test_what_is_left_out_beside_the_largest_part_of_a_file_is_said():
    (note,) = layouts.largest_part_notes("component", [41, 12, 0, 3])
    assert note.code == "capture.part"
    assert note == (
        "The largest component, of 41 images, is used. Others are left out, as each has a frame of its own: "
        "those of 12, 3 images."
    )
    assert layouts.largest_part_notes("component", [41]) == ()
    assert layouts.largest_part_notes("component", [41, 0]) == ()


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


FILE_PATHS = {
    "C:\\Users\\me\\scan\\images\\f0{}.png": "transforms.json",
    "/home/me/scan/images/f0{}.png": "transforms.json",
    "images\\f0{}.png": "transforms.json",
    "./images/f0{}": "transforms.json",
    "images/f0{}.JPG": "transforms_train.json",
}


@pytest.mark.parametrize("form", FILE_PATHS)
def test_paths_of_other_machines_and_suffixes_are_found(form, tmp_path):
    folder = write_transforms(tmp_path, TRUE, TRUE)
    data = json.loads((folder / "transforms.json").read_text())
    for i, frame in enumerate(data["frames"]):
        frame["file_path"] = form.format(i)
    (folder / "transforms.json").unlink()
    (folder / FILE_PATHS[form]).write_text(json.dumps(data))
    for place in (folder, folder / FILE_PATHS[form]):
        capture = Capture.open(place)
        assert capture.names == ["f00", "f01", "f02", "f03"] and not capture.notes
        assert capture.frames[3].image == folder / "images/f03.png"


def test_images_that_are_nowhere_are_named_with_the_places_searched(tmp_path):
    folder = write_transforms(tmp_path / "a/b/scan", TRUE, TRUE)
    (folder / "images").rename(tmp_path / "pictures")
    said = r"got 0 in .*f00.png, .*: no image file in its folder or elsewhere near it.*--images.*4 skipped"
    with pytest.raises(InputError, match=said):
        Capture.open(folder)
    capture = Capture.open(folder, images=tmp_path / "pictures")
    assert capture.frames[3].image == tmp_path / "pictures/f03.png" and not capture.notes
    with pytest.raises(InputError, match=r"images \(--images\) must be a folder"):
        Capture.open(folder, images=tmp_path / "pictures/f00.png")


def test_scannetpp_keeps_images_of_two_lenses_apart(tmp_path):
    folder = tmp_path / "dslr"
    write_transforms(tmp_path / "made", TRUE, TRUE)
    data = json.loads((tmp_path / "made/transforms.json").read_text())
    for frame in data["frames"]:
        frame["file_path"] = Path(frame["file_path"]).name
    (folder / "nerfstudio").mkdir(parents=True)
    (folder / "nerfstudio/transforms_undistorted.json").write_text(json.dumps(data))
    fisheye = data | {"camera_model": "OPENCV_FISHEYE", "k1": 0.1}
    (folder / "nerfstudio/transforms.json").write_text(json.dumps(fisheye))
    (tmp_path / "made/images").rename(folder / "undistorted_images")
    assert Capture.open(tmp_path).frames[0].lens is None
    with pytest.raises(InputError, match="no image file"):  # not the undistorted ones
        Capture.open(folder / "nerfstudio/transforms.json")


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
    assert capture.names == ["f00", "f01", "f02", "f03"] and not capture.notes
    np.testing.assert_allclose(capture.frames[2].E, TRUE[2], atol=1e-6)
    np.testing.assert_allclose(capture.frames[2].K, K)


def test_a_camera_that_cannot_be_used_leaves_out_its_images(tmp_path):
    model = colmap_text(tmp_path) / "sparse" / "0"
    text = (model / "cameras.txt").read_text()
    (model / "cameras.txt").write_text(text.replace("2 PINHOLE", "2 FISHY") + "9 EQUIRECTANGULAR 8 4 8 4\n")
    capture = Capture.open(tmp_path)
    assert capture.names == ["f00", "f02", "f03"]
    assert "f01: the model of camera 2 must be one of SIMPLE_PINHOLE" in capture.notes[0]


def test_an_image_without_a_pose_leaves_out_itself(tmp_path):
    images = colmap_text(tmp_path) / "sparse" / "0" / "images.txt"
    lines = images.read_text().splitlines()
    row = next(number for number, line in enumerate(lines) if "f02.png" in line)
    lines[row] = "3 0 0 0 0 1 2 3 3 f02.png"
    images.write_text("\n".join(lines))
    capture = Capture.open(tmp_path)
    assert capture.names == ["f00", "f01", "f03"] and "f02" in capture.notes[0]


#: Coefficients that bend a picture by several pixels, of every model with a focal length.
BENDS = {
    "FOV": [0.6],
    "EUCM": [0.6, 1.1],
    "SIMPLE_DIVISION": [-0.1],
    "DIVISION": [-0.1],
    "RAD_TAN_THIN_PRISM_FISHEYE": [0.02, 0.01, 0, 0, 0, 0, 0.001, -0.001, 0.001, 0, 0.001, 0],
    "THIN_PRISM_FISHEYE": [0.05, 0.01, 0.001, -0.001, 0.01, 0, 0.001, 0.001],
}


@pytest.mark.parametrize("model", [name for name, form in MODELS.items() if form.focals])
def test_every_camera_model_of_colmap_is_straightened_as_pycolmap_says(model, tmp_path):
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
    pinhole = rays @ frame.K[:2, :2].T + frame.K[:2, 2]
    if frame.lens is None:
        np.testing.assert_allclose(taken, pinhole, atol=1e-6)
    else:
        assert np.abs(taken - pinhole).max() > 0.5
        np.testing.assert_allclose(undistorted_pixels(taken, frame.K, frame.lens), pinhole, atol=0.02)
        assert capture.image("f00").shape == (*SIZE[::-1], 3)


@pytest.mark.parametrize("factor", [1.0, 0.002])
def test_lengths_of_a_matrix_that_somebody_scaled_have_no_unit(factor, tmp_path):
    folder = transforms(tmp_path / "scan")
    data = json.loads((folder / "transforms.json").read_text())
    for frame in data["frames"]:
        frame["transform_matrix"] = (factor * np.array(frame["transform_matrix"])).tolist()
    (folder / "transforms.json").write_text(json.dumps(data))
    capture = Capture.open(folder)
    assert capture.unit == ("m" if factor == 1.0 else None)
    np.testing.assert_allclose(capture.frames[1].E, TRUE[1], atol=1e-6)


def test_the_folder_of_models_alone_is_enough(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    assert len(Capture.open(folder / "sparse")) == len(Capture.open(folder)) == 4


def test_commas_may_divide_the_numbers_of_an_image_of_colmap(tmp_path):
    """As kapture's export of rigs writes them."""
    file = colmap_text(tmp_path / "scan") / "sparse" / "0" / "images.txt"
    lines = file.read_text().splitlines()
    file.write_text("\n".join(x.replace(" ", ", ") if x.endswith("png") else x for x in lines))
    np.testing.assert_allclose(Capture.open(tmp_path / "scan").frames[2].E, TRUE[2], atol=1e-6)


def test_a_heading_of_tum_may_lack_its_mark(tmp_path):
    folder = tum(tmp_path / "scan")
    for name, heading in (("rgb.txt", "timestamp filename"), ("groundtruth.txt", "timestamp tx ty tz qx qy")):
        file = folder / name
        file.write_text(f"{heading}\n{file.read_text()}")
    np.testing.assert_allclose(Capture.open(folder).frames[2].E, TRUE[2], atol=1e-6)


@pytest.mark.parametrize(
    ("number", "centre", "bent"),
    [("1", (318.6, 255.3), True), ("3", (320.1, 247.6), False), ("", (319.5, 239.5), False)],
)
def test_a_sequence_of_tum_is_of_the_camera_that_it_is_named_after(number, centre, bent, tmp_path):
    folder = tum(tmp_path / "scan")
    (folder / "K.txt").unlink()
    for i in range(4):
        save(folder / "rgb" / f"{i}.png", np.zeros((480, 640, 3), np.uint8))
    head = f"# color images\n# file: 'rgbd_dataset_freiburg{number}_xyz.bag'\n" if number else ""
    (folder / "rgb.txt").write_text(head + (folder / "rgb.txt").read_text())
    capture = Capture.open(folder)
    assert ("capture.assumed-k" in [note.code for note in capture.notes]) == (not number)
    assert tuple(capture.frames[0].K[:2, 2]) == centre
    assert (capture.frames[0].lens is not None) == bent


def test_four_numbers_beside_a_sequence_are_its_camera(tmp_path):
    """ETH3D's sequences are in TUM's layout, with fx, fy, cx and cy in calibration.txt."""
    folder = tum(tmp_path / "scan")
    (folder / "K.txt").unlink()
    (folder / "calibration.txt").write_text(f"{K[0, 0]} {K[1, 1]} {K[0, 2]} {K[1, 2]}\n")
    np.testing.assert_allclose(Capture.open(folder).frames[0].K, K)


def test_a_project_that_kept_its_undistorted_images_alone_is_read_by_their_model(tmp_path):
    folder = colmap_text(tmp_path / "scan")
    (folder / "dense" / "0").mkdir(parents=True)
    shutil.copytree(folder / "sparse" / "0", folder / "dense" / "0" / "sparse")
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("PINHOLE", "OPENCV").replace("91.5\n", "91.5 0.1 0 0 0\n"))
    assert Capture.open(folder).frames[0].lens is not None
    (folder / "images").rename(folder / "dense" / "0" / "images")
    capture = Capture.open(folder)
    assert len(capture) == 4 and all(frame.lens is None for frame in capture.frames)
    shutil.rmtree(folder / "dense" / "0" / "images")
    with pytest.raises(InputError, match="no image file in sparse/0"):
        Capture.open(folder)


def test_hidden_files_that_macos_leaves_beside_images_are_none(tmp_path):
    folder = seven_scenes(tmp_path / "scan")
    for image in list(folder.glob("*.color.png")):
        image.with_name(f"._{image.name}").write_bytes(b"Mac OS X")
    capture = Capture.open(folder)
    assert len(capture) == 4 and "capture.skipped" not in [note.code for note in capture.notes]


def test_a_transforms_json_without_a_focal_length_takes_a_typed_one(tmp_path):
    folder = transforms(tmp_path / "scan")
    data = json.loads((folder / "transforms.json").read_text())
    for entries in (data, *data["frames"]):
        for key in ("fl_x", "fl_y", "camera_angle_x", "camera_angle_y"):
            entries.pop(key, None)
    (folder / "transforms.json").write_text(json.dumps(data))
    with pytest.raises(InputError, match=r"no focal length in its EXIF.*--K.*--fov"):
        Capture.open(folder)
    frames = Capture.open(folder, K=K).frames
    assert len(frames) == 4
    np.testing.assert_allclose(frames[1].K, K)
    np.testing.assert_allclose(frames[1].E, TRUE[1], atol=1e-6)
