"""``--export``, ``--show`` and ``geodiff video``."""

from __future__ import annotations

import importlib.util
import json
import shutil
import sys
import types
import weakref
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.formats import read_calibration
from geodiff_plugin.formats.distortion import distortion_from_text, undistorted
from geodiff_plugin.formats.files import read_npy
from geodiff_plugin.plotting import write_depth_video


@pytest.fixture
def quick(pair_files, prior):
    return [*pair_files.command, "--prior", prior, "--device", "cpu", "--steps", 1, "--preset", "paper"]


def never(*_, **__):
    raise AssertionError("the work was begun")


class Recorder(types.ModuleType):
    """A module whose every function notes its calls."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.calls: list[tuple] = []
        self.__spec__ = importlib.util.spec_from_loader(name, None)

    def __getattr__(self, name: str):
        if name.startswith("__"):
            raise AttributeError(name)

        def call(*args, **kwargs):
            self.calls.append((name, args, kwargs))
            return self

        call.RDF = "RDF"
        return call

    @property
    def scene(self):
        return self

    def of(self, name: str) -> list[tuple]:
        return [call for call in self.calls if call[0] == name]


def test_exports_stand_beside_the_ply(geodiff, result, textured_plane, quick, pair_files):
    out = result / "geodiff-out"
    assert (out / "cloud.glb").read_bytes()[:4] == b"glTF"
    rig = read_calibration(out, image_names=("left.png", "right.png"), baseline_m=0.12)
    np.testing.assert_allclose(rig.E, textured_plane.E, atol=1e-6)
    # A later run without them leaves none of them behind.
    again = pair_files.folder / "geodiff-out"
    shutil.copytree(out, again)
    assert geodiff(*quick, "-q", "--overwrite").code == 0
    assert not (again / "cloud.glb").exists() and not (again / "cameras.txt").exists()


LENS = "-0.2,0.05,0,0"


@pytest.fixture
def bent(pair_files, prior):
    """The pair as if its lenses had distortion, the camera by numbers."""
    camera = "--fx 60 --fy 60 --cx 31.5 --cy 23.5 --baseline 0.12".split()
    run = ["--prior", prior, "--device", "cpu", "--steps", 1, "--knob", "inner_steps=0", "-q"]
    return [*pair_files.images, *camera, *run, "--distortion", LENS]


def test_images_of_one_name_are_named_with_their_folders(geodiff, quick, pair_files):
    command, *photographs = pair_files.images
    images = []
    for side, path in zip(("image_2", "image_3"), photographs, strict=True):
        (pair_files.folder / side).mkdir()
        images.append(shutil.copy(path, pair_files.folder / side / "000000.png"))
    answer = geodiff(command, *images, *quick[3:], "--export", "colmap", "-q")
    assert answer.code == 0, answer.err
    lines = Path("geodiff-out", "images.txt").read_text().splitlines()
    assert [line.split()[-1] for line in lines[3::2]] == ["image_2/000000.png", "image_3/000000.png"]


def test_a_colmap_model_names_what_its_cameras_took(geodiff, bent, pair_files):
    third, pose = pair_files.folder / "third.png", pair_files.folder / "pose.txt"
    Image.fromarray(255 - np.asarray(Image.open(pair_files.right))).save(third)
    np.savetxt(pose, np.eye(4) + 0.12 * np.eye(4, k=3))
    view = ["--view", third, "--view-E", pose, "--view-distortion", "0,0,0,0"]
    answer = geodiff(*bent, *view, "--export", "colmap")
    assert answer.code == 0, answer.err
    out = pair_files.folder / "geodiff-out"
    written = ["undistorted.png", "undistorted-2.png", "undistorted-3.png"]
    lines = (out / "images.txt").read_text().splitlines()
    assert [line.split()[9] for line in lines if line and line[0] != "#"] == written
    rig = read_calibration(out, image_names=tuple(written[:2]), baseline_m=0.12)
    assert rig.size_right == (64, 48) and rig.K_left[0, 0] == 60
    for name, path, lens in ((written[1], pair_files.right, LENS), (written[2], third, "0,0,0,0")):
        image_01 = np.asarray(Image.open(path), np.float32) / 255
        expected = undistorted(image_01, rig.K_left, distortion_from_text(lens))
        image = np.asarray(Image.open(out / name), np.float32) / 255
        assert np.abs(image - expected).mean() < 0.01, "but for cleaning"
    report = json.loads((out / "report.json").read_text())
    assert set(report["files"]["names"]) == {path.name for path in out.iterdir()}
    # Its video shows the photograph without distortion.
    Image.new("RGB", (64, 48), "red").save(out / "undistorted.png")
    assert geodiff("video", "geodiff-out", "--photographs", "--out", "both.webp").code == 0
    red, green, blue = first_frame("both.webp").transpose(2, 0, 1)
    assert ((red > 200) & (green < 60) & (blue < 60)).mean() > 0.3


def test_exported_cameras_are_those_that_the_cloud_fits(geodiff, prior, tmp_path, monkeypatch):
    """Of refined poses: the given ones leave the cloud beside what the right photograph shows."""
    monkeypatch.chdir(tmp_path)
    pair, turn = read_demo_pair(), np.radians(1.0)
    moved = pair.rig.E.copy()
    moved[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    np.savetxt("K.txt", pair.rig.K_left)
    np.savetxt("E.txt", moved)
    views = [DEMO_PAIR_FOLDER / "left.png", DEMO_PAIR_FOLDER / "right.png", "--K", "K.txt", "--E", "E.txt"]
    run = ["--prior", prior, "--device", "cpu", "--steps", 1, "--resolution", 64, "--export", "colmap"]
    answer = geodiff("depth", *views, *run)
    assert answer.code == 0, answer.err
    pose = json.loads((tmp_path / "geodiff-out" / "report.json").read_text())["pose"]
    assert pose["status"] == "refined"
    rig = read_calibration("geodiff-out", image_names=("left.png", "right.png"), baseline_m=0.12)
    np.testing.assert_allclose(rig.E[:3, :3], np.array(pose["E"][0])[:3, :3], atol=1e-5)
    assert not np.allclose(rig.E[:3, :3], moved[:3, :3], atol=3e-3)


def test_a_name_that_colmap_cannot_hold_is_refused_before_the_work(geodiff, pair_files, monkeypatch):
    monkeypatch.setattr("geodiff_plugin.cli.depth.load_guided_prior", never)
    monkeypatch.setattr("geodiff_plugin.cli.many.Stages.guide", never)
    left = pair_files.left.rename(pair_files.folder / "left one.png")
    command = [*pair_files.command[3:], "--prior", "bundled", "--export", "colmap"]
    answer = geodiff("depth", left, pair_files.right, *command)
    assert answer.code == 2 and "without blanks; got 'left one.png'" in answer.err
    (pair_files.folder / "pairs.txt").write_text("left one.png,right.png\n")
    answer = geodiff("depth", "pairs.txt", *command)
    assert answer.code == 4 and "without blanks; got 'left one.png'" in answer.err


def test_show_in_rerun(geodiff, quick, monkeypatch):
    rerun = Recorder("rerun")
    monkeypatch.setitem(sys.modules, "rerun", rerun)
    assert geodiff(*quick, "--show", "rerun", "-q").code == 0
    (_, _, cloud), *_ = rerun.of("Points3D")
    assert len(cloud["colors"]) > 0
    pinholes = [call[2] for call in rerun.of("Pinhole")]
    assert [(p["width"], p["height"]) for p in pinholes] == [(64, 48)] * 2
    np.testing.assert_allclose(rerun.of("Transform3D")[1][2]["translation"], [0.12, 0, 0])


def test_show_in_viser(geodiff, quick, monkeypatch):
    viser = Recorder("viser")
    monkeypatch.setitem(sys.modules, "viser", viser)
    assert geodiff(*quick, "--show", "viser", "-q").code == 0
    frusta = [call[2] for call in viser.of("add_camera_frustum")]
    assert frusta[0]["fov"] == pytest.approx(2 * np.arctan(24 / 60))
    np.testing.assert_allclose(frusta[0]["wxyz"], (1, 0, 0, 0))
    assert viser.of("sleep_forever")


def test_show_without_a_viewer_says_what_to_install(geodiff, quick, monkeypatch):
    spec, hidden = importlib.util.find_spec, ("rerun", "viser")
    monkeypatch.setattr(importlib.util, "find_spec", lambda n, *a: None if n in hidden else spec(n, *a))
    answer = geodiff(*quick, "--show", "auto")
    assert answer.code == 2 and "pip install rerun-sdk or viser" in answer.err


# Videos


@pytest.fixture
def maps(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for number in range(3):
        values = np.linspace(1 + number, 4 + number, 48 * 64, dtype=np.float32)
        np.save(f"{number}.npy", values.reshape(48, 64))
    return ["0.npy", "1.npy", "2.npy"]


def first_frame(name: str) -> np.ndarray:
    with Image.open(name) as video:
        return np.asarray(video.convert("RGB")).astype(int)


@pytest.mark.parametrize("name", ["depth.webp", "depth.gif", "depth.mp4"])
def test_video(geodiff, maps, name):
    answer = geodiff("video", *maps, "--out", name, "--fps", 4)
    assert answer.code == 0 and "3 frames, 0.8 s" in answer.out, answer.err
    if name.endswith("mp4"):
        cv2 = pytest.importorskip("cv2")
        video = cv2.VideoCapture(name)
        assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3 and video.get(cv2.CAP_PROP_FPS) == 4
        assert video.read()[0]
        return
    with Image.open(name) as video:
        video.load()
        assert video.n_frames == 3 and video.info["duration"] == 250
        frames = []
        for index in range(3):
            video.seek(index)
            frames.append(np.asarray(video.convert("RGB")).astype(int))
    assert np.abs(frames[0] - frames[2]).mean() > 10  # one range: later frames are farther


def test_video_of_results_without_a_unit(geodiff, maps):
    """The legend says what the reports say; a video of both kinds would show one of them wrongly."""
    for number, unit in enumerate(("m", None)):
        folder = Path(f"result-{number}")
        folder.mkdir()
        shutil.copy(maps[0], folder / "depth.npy")
        (folder / "report.json").write_text(json.dumps({"unit": unit}))
    for name in ("result-0", "result-1", "result-1/depth.npy"):
        assert geodiff("video", name, "--out", f"{name.replace('/', '-')}.gif").code == 0
    metres, without = first_frame("result-0.gif"), first_frame("result-1.gif")
    changed = (np.abs(metres - without).sum(axis=2) > 300).any(axis=1)  # beyond what the palettes change
    assert changed.any() and not changed[len(changed) // 8 :].any()  # the heading of the legend alone
    assert np.array_equal(first_frame("result-1-depth.npy.gif"), without)
    answer = geodiff("video", "result-0", "result-1")
    assert answer.code == 2 and "all in metres, or all without a unit; got result-0 with" in answer.err


def test_a_long_video_is_never_in_memory_as_a_whole(geodiff, maps, tmp_path, monkeypatch):
    most, alive, drawn, most_drawn = [], [], [], []

    def counted(path, *rest):
        depth_m = read_npy(path, *rest)
        alive.append(weakref.ref(depth_m))
        most.append(sum(ref() is not None for ref in alive))
        return depth_m

    def pictures():
        for shade in range(12):
            picture = Image.new("RGB", (64, 48), (shade, 0, 0))
            drawn.append(weakref.ref(picture))
            most_drawn.append(sum(ref() is not None for ref in drawn))
            yield picture

    monkeypatch.setattr("geodiff_plugin.cli.video.read_npy", counted)
    assert geodiff("video", *maps * 4, "--out", "depth.mp4").code == 0
    assert len(most) >= 12 and max(most) <= 3
    write_depth_video(tmp_path / "x.mp4", pictures())
    assert len(most_drawn) == 12 and max(most_drawn) <= 3


class Interrupted:
    """A frame at which the user presses Ctrl-C."""

    def __getattr__(self, name: str):
        raise KeyboardInterrupt


@pytest.mark.parametrize("name", ["depth.webp", "depth.gif", "depth.mp4"])
def test_video_is_whole_or_as_it_was(tmp_path, name):
    (tmp_path / name).write_bytes(b"older")
    frames = [Image.new("RGB", (64, 48), shade) for shade in ("red", "green")]
    with pytest.raises(KeyboardInterrupt):
        write_depth_video(tmp_path / name, [*frames, Interrupted()])
    assert (tmp_path / name).read_bytes() == b"older" and len(list(tmp_path.iterdir())) == 1


def test_video_shows_photographs_as_they_were_read(geodiff, quick, pair_files):
    """16 bits are no white picture, and a photograph that was damaged since is a sentence."""
    for path in (pair_files.left, pair_files.right):
        grey = np.asarray(Image.open(path).convert("L"))
        Image.fromarray(grey.astype(np.uint16) * 257).save(path)
    assert geodiff(*quick, "-q").code == 0
    video = ["video", "geodiff-out", "--photographs", "--out", "both.webp"]
    assert geodiff(*video).code == 0
    with Image.open("both.webp") as both, Image.open(pair_files.left) as left:
        shown = np.asarray(both.convert("L"), float)[:, : both.height]
        assert abs(shown.mean() - np.asarray(left).mean() / 257) < 20
        assert both.width > 1.5 * both.height
    pair_files.left.write_bytes(b"damaged")
    answer = geodiff(*video)
    assert answer.code == 2 and "the left image of geodiff-out must be an image file" in answer.err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["0.npy", "--out", "depth.avi"], "ends in .mp4, .webp, .gif"),
        (["0.npy", "--out", "no/depth.gif"], "Make the folder no first."),
        (["0.npy", "--out", "folder.gif"], "got the folder folder.gif"),
        (["0.npy", "--out", "x" * 300 + ".webp"], "that can be written"),
        (["0.npy", "nothing.npy"], "nothing.npy, which does not exist"),
        (["0.npy", "other.npy"], "all of one shape, 64x48 pixels as 0.npy; got other.npy of 4x4"),
        (["0.npy", "--near", "3", "--far", "2"], "near < far"),
        (["0.npy", "--fps", "0"], "fps must be between"),
        (["integers.npy"], "of floats in metres"),
        (["empty.npy"], "FRAME must be a depth map"),
        (["picture.png"], "which numpy cannot load (pickled objects, which are never loaded)"),
        (["result", "--photographs"], "report.json, which is damaged"),
    ],
)
def test_video_bad_input(geodiff, maps, arguments, said):
    np.save("other.npy", np.ones((4, 4), np.float32))
    np.save("integers.npy", np.ones((4, 4), np.int32))
    np.save("empty.npy", np.ones((0, 5), np.float32))
    Image.new("I;16", (4, 4)).save("picture.png")
    for folder in ("folder.gif", "result"):
        Path(folder).mkdir()
    shutil.copy("0.npy", "result/depth.npy")
    Path("result/report.json").write_text('{"a"')
    answer = geodiff("video", *arguments)
    assert answer.code == 2 and answer.err.startswith("geodiff: ") and said in answer.err
