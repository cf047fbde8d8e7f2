"""``geodiff depth`` on a bag, resumed, and ``geodiff submit``, read back by others' code."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader

from tests.unit.formats import bags

pytestmark = pytest.mark.end_to_end

TOPICS = ("--left-topic", bags.TOPICS[0], "--right-topic", bags.TOPICS[1])


def depth_images(path: Path, topic: str = "/depth/image") -> list[tuple[int, np.ndarray]]:
    with AnyReader([path]) as reader:
        images = [c for c in reader.connections if c.topic == topic]
        read = [(at, reader.deserialize(raw, c.msgtype)) for c, at, raw in reader.messages(images)]
    return [(at, image.data.view(np.uint16).reshape(image.height, image.width)) for at, image in read]


def test_a_bag_becomes_a_bag_and_goes_on(geodiff, prior, textured_plane, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bags, "K", textured_plane.K)
    bags.write_bag(tmp_path / "drive.mcap", images=(textured_plane.left, textured_plane.right))
    words = ["depth", "drive.mcap", *TOPICS, "--prior", prior, "--steps", "2", "-q", "--out", "depth.mcap"]
    answer = geodiff(*words)
    assert answer.code == 0, answer.err
    images = depth_images(Path("depth.mcap"))
    assert [at for at, _ in images] == [10**12 + 5, 10**12 + 10**8 + 5]
    for number, (_, image) in enumerate(images):
        depth_m = np.load(f"depth-frames/{number:06d}/depth.npy")
        np.testing.assert_allclose(image / 1000.0, np.where(depth_m < 65.5, depth_m, 0), atol=6e-4)
    assert "which exists" in geodiff(*words).err
    Path("depth.mcap").unlink()
    shutil.rmtree("depth-frames/000001")
    kept = Path("depth-frames/000000/depth.npy").stat().st_mtime_ns
    assert geodiff(*words).code == 0
    assert Path("depth-frames/000000/depth.npy").stat().st_mtime_ns == kept
    for (_, first), (_, second) in zip(images, depth_images(Path("depth.mcap")), strict=True):
        np.testing.assert_array_equal(first, second)


def test_removed_depths_are_unknown_in_every_message_of_a_bag(
    geodiff, prior, textured_plane, tmp_path, monkeypatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bags, "K", textured_plane.K)
    bags.write_bag(tmp_path / "drive.mcap", images=(textured_plane.left, textured_plane.right))
    words = ["depth", "drive.mcap", *TOPICS, "--prior", prior, "--steps", "1", "-q", "--out"]
    assert geodiff(*words, "all.mcap").code == 0
    limit_m = float(np.nanquantile(np.load("all-frames/000000/sigma.npy"), 0.5))
    answer = geodiff(*words, "holes.mcap", "--max-sigma", limit_m, "--holes")
    assert answer.code == 0, answer.err
    topics = ("/depth/image", "/depth/sigma")
    for (_, depth), (_, sigma) in zip(*(depth_images(Path("holes.mcap"), at) for at in topics), strict=True):
        np.testing.assert_array_equal(depth > 0, sigma > 0)
        assert 0.1 < (depth > 0).mean() < 0.9 and sigma.max() <= np.ceil(1000 * limit_m)


FILES = {
    "middlebury": ("trainingH/Plane/disp0Ours.pfm", "trainingH/Plane/timeOurs.txt"),
    "eth3d": ("low_res_two_view/Plane.pfm", "low_res_two_view/Plane.txt"),
}


def test_submissions_are_what_the_benchmarks_read(geodiff, prior, pair_files) -> None:
    scene = pair_files.folder / "trainingH" / "Plane"
    scene.mkdir(parents=True)
    for file in (pair_files.left, pair_files.right):
        shutil.move(file, scene / file.name)
    images = scene / "left.png", scene / "right.png"
    command = ["depth", *images, "--calib", pair_files.calib, "--prior", prior, "--steps", "2", "-q"]
    assert geodiff(*command, "--out", "result").code == 0
    shift = 60.0 * 0.12 / np.load("result/depth.npy")
    for benchmark, (disparities, times) in FILES.items():
        sent = Path(benchmark)
        assert geodiff("submit", "result", "--to", benchmark, "--out", sent, "--method", "Ours").code == 0
        assert sum(path.is_file() for path in sent.rglob("*")) == 2
        disparity = cv2.imread(str(sent / disparities), cv2.IMREAD_UNCHANGED)
        np.testing.assert_allclose(disparity, shift, rtol=1e-5)
        words = (sent / times).read_text().split()
        assert float(words[-1]) > 0 and words[:-1] == ["runtime"] * (benchmark == "eth3d")
    shutil.copytree("result", "again")
    answer = geodiff("submit", "result", "again", "--to", "eth3d", "--out", "twice")
    assert answer.code == 2 and "result and again are both results of scene" in answer.err
    assert not Path("twice").exists()


def test_masked_pixels_of_a_bag_have_no_depth(geodiff, prior, textured_plane, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(bags, "K", textured_plane.K)
    bags.write_bag(tmp_path / "drive.mcap", images=(textured_plane.left, textured_plane.right))
    height, width = textured_plane.left.shape[:2]
    valid = np.arange(width)[None].repeat(height, 0) < width // 2
    cv2.imwrite("mask.png", valid * np.uint8(255))
    words = ["depth", "drive.mcap", *TOPICS, "--prior", prior, "--steps", "2", "-q", "--mask", "mask.png"]
    answer = geodiff(*words, "--out", "depth.mcap")
    assert answer.code == 0, answer.err
    for _, image in depth_images(Path("depth.mcap")):
        assert not image[~valid].any() and (image[valid] > 0).mean() > 0.9
