"""Depth of a bag: its pairs, its cameras unless others are given, and the depth images that are written."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs import bag
from geodiff_plugin.jobs.bag import depth_bag
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from tests.unit.jobs import made_runs
from tests.unit.jobs.test_writing import target


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A bag with three pairs, of which the second fails; what is asked for and what is written."""
    asked = SimpleNamespace(texts=("left camera", "right camera"), written=None, pairs=None)

    def stereo_calibration(path, topics):
        asked.cameras = (path, topics)
        return asked.texts, "optical"

    def start_many(options, notify):
        asked.started = options
        return [PairRef(f"00000{n}", options.left, None, frame=n) for n in range(3)]

    def depth_pairs(options, refs, *, notify, progress):
        asked.pairs = (options, refs, notify, progress)
        for n in (0, 2):
            folder = options.out / refs[n].name
            folder.mkdir(parents=True, exist_ok=True)
            np.save(folder / "depth.npy", made_runs.depth_map() + n)
            np.save(folder / "depth_reprojected.npy", np.full((24, 28), 1.5 + n, np.float32))
            if n:
                np.save(folder / "sigma_reprojected.npy", np.full((24, 28), 0.5, np.float32))
            (folder / "report.json").write_text(f'{{"K": [{(made_runs.K_LEFT + n).tolist()}]}}')
        confidence = np.ones((36, 50), np.float32)
        confidence[4] = 0.0
        np.save(options.out / "000002/confidence.npy", confidence)
        np.save(options.out / "000002/sigma.npy", 0.25 * confidence)
        return ["row"] * 3

    def write_depth_bag(path, frames, frame_id, encoding):
        asked.written = (path, list(frames), frame_id, encoding)
        return len(asked.written[1])

    monkeypatch.setattr(bag.recordings, "stereo_calibration", stereo_calibration)
    monkeypatch.setattr(
        bag.recordings,
        "list_pairs",
        lambda *given: asked.__dict__.update(listed=given) or [(n, "pair") for n in range(3)],
    )
    monkeypatch.setattr(bag.recordings, "write_depth_bag", write_depth_bag)
    monkeypatch.setattr(bag, "start_many", start_many)
    monkeypatch.setattr(bag, "depth_pairs", depth_pairs)
    topics = {"left_topic": "/l", "right_topic": "/r", "tolerance": 0.25}
    asked.options = DepthOptions(left=tmp_path / "run.mcap", out=tmp_path / "depth.bag", **topics)
    return asked


def test_every_finished_pair_is_an_image_with_its_time_and_camera(run, tmp_path):
    reported = []
    result = depth_bag(replace(run.options, encoding="32FC1"), notify=reported.append, progress=True)
    frames_folder = tmp_path / "depth-frames"
    assert (result.path, result.frames, result.images, result.rows) == (
        tmp_path / "depth.bag",
        frames_folder,
        2,
        ["row"] * 3,
    )
    assert run.listed == (tmp_path / "run.mcap", ("/l", "/r"), 0.25) and run.cameras == run.listed[:2]
    path, frames, frame_id, encoding = run.written
    assert (path, frame_id, encoding) == (tmp_path / "depth.bag", "optical", "32FC1")
    assert [frame[0] for frame in frames] == [0, 2]
    np.testing.assert_array_equal(frames[0][1], made_runs.depth_map())
    expected = made_runs.depth_map() + 2
    expected[4] = 0.0
    np.testing.assert_array_equal(frames[1][1], expected)
    for n, frame in zip((0, 2), frames, strict=True):
        np.testing.assert_allclose(frame[2], made_runs.K_LEFT + n)
    assert frames[0].sigma_m is None, "of a preset without confidence"
    np.testing.assert_array_equal(frames[1].sigma_m, np.load(frames_folder / "000002/sigma.npy"))
    options, _, notify, progress = run.pairs
    calib = tuple(frames_folder / f"camera_info_{n}.yaml" for n in range(2))
    assert options == replace(run.options, encoding="32FC1", out=frames_folder, calib=calib) == run.started
    assert (
        [file.read_text() for file in calib] == list(run.texts)
        and notify == reported.append
        and progress is True
    )
    before = [file.stat().st_mtime_ns for file in calib]
    run.texts = ("left camera", "another")
    depth_bag(replace(run.options, overwrite=True))
    assert [file.stat().st_mtime_ns == time for file, time in zip(calib, before, strict=True)] == [
        True,
        False,
    ]
    assert calib[1].read_text() == "another"


@pytest.mark.parametrize(
    "given",
    [
        {"calib": (Path("c"),)},
        {"fx": 500.0},
        {"baseline": 0.1},
        {"k": Path("k")},
        {"e": Path("e")},
        {"cy": 1.0},
    ],
)
def test_cameras_that_are_given_take_the_place_of_those_of_the_bag(run, given):
    depth_bag(replace(run.options, **given))
    assert run.started.calib == given.get("calib", ()) and not hasattr(run, "cameras")
    assert run.written[2] == "left"


def test_images_of_another_camera_have_its_frame_and_its_k(run, tmp_path):
    path = target(tmp_path)
    depth_bag(replace(run.options, reproject=path))
    _, frames, frame_id, _ = run.written
    assert frame_id == "reprojected"
    for n, frame in zip((0, 2), frames, strict=True):
        np.testing.assert_array_equal(frame[1], np.full((24, 28), 1.5 + n))
        if n:
            np.testing.assert_array_equal(frame.sigma_m, np.full((24, 28), 0.5))
        else:
            assert frame.sigma_m is None, "of a preset without confidence"
        np.testing.assert_allclose(frame[2], [[30, 0, 13], [0, 32, 11], [0, 0, 1]])


def test_a_bag_is_written_as_one_new_bag(run, tmp_path, monkeypatch):
    for more, said in (
        ({"out": tmp_path / "depth.png"}, "--out must be a file name ending in"),
        ({"out": tmp_path}, "--out must be a file name ending in"),
        ({"shard": "0/2"}, "--shard cannot be used with a bag"),
        ({"engine": "ray"}, "--engine cannot be used with a bag"),
        ({"left_topic": None}, "--left-topic is missing"),
    ):
        with pytest.raises(InputError, match=said):
            depth_bag(replace(run.options, **more))
    (tmp_path / "depth.bag").write_text("a bag")
    with pytest.raises(InputError, match="depth.bag"):
        depth_bag(run.options)
    assert run.written is None
    depth_bag(replace(run.options, overwrite=True))
    monkeypatch.chdir(tmp_path)
    assert depth_bag(replace(run.options, out=None)).path == Path("depth.mcap")
