"""The poses of a capture: solved once, stored and read again, and scaled."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs import capture_poses as module
from geodiff_plugin.jobs.capture_poses import load_solved, solved_poses
from geodiff_plugin.jobs.lengths import KnownScale
from geodiff_plugin.pose.multiview import SolvedCapture
from tests.unit.jobs.made_captures import MOVED, again, options, solved


@pytest.mark.parametrize(
    "changes", [{}, {"E_given": None, "status": "estimated"}, {"findings": (), "scale_rel_std": math.nan}]
)
def test_solved_poses_come_back_as_they_were(tmp_path, changes):
    made = solved(**changes)
    module._save_solved(tmp_path / "poses.npz", made, "key")
    assert load_solved(tmp_path / "poses.npz", "other") is None
    assert load_solved(tmp_path / "none.npz", "key") is None
    read = load_solved(tmp_path / "poses.npz", "key")
    for field in fields(SolvedCapture):
        was, found = getattr(made, field.name), getattr(read, field.name)
        if field.name == "seen":
            assert len(found) == len(was)
            for (px, rows), (other_px, other_rows) in zip(was, found, strict=True):
                np.testing.assert_array_equal(px, other_px)
                np.testing.assert_array_equal(rows, other_rows)
        elif field.name == "findings":
            assert [(note.code, str(note)) for note in found] == [(note.code, str(note)) for note in was]
        elif isinstance(was, np.ndarray):
            np.testing.assert_array_equal(was, found)
        else:
            assert found == was or (math.isnan(found) and math.isnan(was)), field.name


@pytest.mark.parametrize("damage", ["other content", "empty", "start", "half", "end missing", "changed"])
def test_poses_of_a_damaged_file_are_not_read(tmp_path, damage):
    file = tmp_path / "poses.npz"
    module._save_solved(file, solved(), "key")
    content = file.read_bytes()
    half = len(content) // 2
    damaged = {
        "other content": b"cut off",
        "empty": b"",
        "start": content[:10],
        "half": content[:half],
        "end missing": content[:-5],
        "changed": content[:120] + bytes(40) + content[160:],
    }
    file.write_bytes(damaged[damage])
    assert load_solved(file, "key") is None


def test_poses_are_solved_once_for_each_key_and_by_no_shard(capture, tmp_path, solving):
    (tmp_path / "out").mkdir()
    given = options(tmp_path, poses="given")
    with pytest.raises(InputError, match="Run geodiff capture with --poses-only first"):
        solved_poses(again(capture), options(tmp_path, shard="0/2"), "key")
    assert solved_poses(again(capture), given, "key") is None and solving == [("given", 7)]
    solved_poses(again(capture), given, "key")
    solved_poses(again(capture), options(tmp_path, shard="0/2", overwrite=True), "key")
    assert len(solving) == 1
    solved_poses(again(capture), given, "another")
    assert len(solving) == 2
    solved_poses(again(capture), replace(given, overwrite=True), "another")
    assert len(solving) == 3


def test_the_scale_that_is_given_is_applied_once_and_a_doubted_one_is_not_measured(
    capture, tmp_path, solving, monkeypatch
):
    (tmp_path / "out").mkdir()
    doubt = Finding("capture.length", "It is uncertain.")
    for scale, typed, measured in (
        (KnownScale(2.5, 0.01), {"distance": "f0,f1,2"}, True),
        (KnownScale(2.5, 0.2, doubt), {"known_length": "f0:1,2,3,4,5"}, False),
        (KnownScale(2.5), {"metres_per_unit": 2.5}, False),
    ):
        asked = []
        monkeypatch.setattr(module, "known_scale", lambda *given, scale=scale: asked.append(given) or scale)  # noqa: B023
        fresh = again(capture)
        assert solved_poses(fresh, options(tmp_path, **typed), "key") is scale and len(asked) == 1
        np.testing.assert_allclose(fresh.solved.E[:, :3, 3], 2.5 * MOVED[:, :3, 3])
        assert fresh.unit == "m" and fresh.metres_per_unit == 2.5 and fresh.scale_measured == measured
        assert (doubt in fresh.findings) == (scale.doubt is not None)
        fresh = again(capture)
        solved_poses(fresh, options(tmp_path, **typed), "key", KnownScale(4.0))
        assert fresh.metres_per_unit == 4.0 and len(asked) == 1, "another process has found it"
    monkeypatch.setattr(module, "known_scale", lambda *_: None)
    fresh = again(capture)
    assert solved_poses(fresh, options(tmp_path), "key") is None and fresh.unit is None


def test_a_capture_is_opened_with_what_the_options_name(tmp_path, monkeypatch, capture):
    asked = {}

    def opened(path, **given):
        asked.update(path=path, **given)
        return capture

    np.savetxt(tmp_path / "K.txt", np.diag([50.0, 51.0, 1.0]))
    monkeypatch.setattr(module.Capture, "open", opened)
    extra = {
        "trajectory": Path("t"),
        "images": Path("i"),
        "mask": Path("m"),
        "k": tmp_path / "K.txt",
        "fov": 61.0,
    }
    assert module.open_capture(options(tmp_path, **extra)) is capture
    K = asked.pop("K")
    np.testing.assert_array_equal(K, np.diag([50.0, 51.0, 1.0]))
    assert asked == {
        "path": tmp_path,
        "fov": 61.0,
        "trajectory": Path("t"),
        "images": Path("i"),
        "mask": Path("m"),
    }
    with pytest.raises(InputError, match="--points.*known depths of the capture"):
        module.open_capture(options(tmp_path, points="model"))
    with pytest.raises(InputError, match="--measure"):
        module.open_capture(options(tmp_path, measure=("f0:1,2",)))
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="pip install open3d"):
        module.open_capture(options(tmp_path, export=("mesh",)))
    module.open_capture(options(tmp_path, export=("colmap",), poses="given"))
    capture.frames[1] = replace(capture.frames[1], E=None)
    with pytest.raises(InputError, match="--poses given must be used with a capture that has poses"):
        module.open_capture(options(tmp_path, poses="given"))
    module.open_capture(options(tmp_path))
