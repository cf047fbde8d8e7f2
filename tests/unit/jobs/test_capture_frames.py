"""The frames of a capture by several processes, by shards and by Ray."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.jobs import capture_frames as module
from geodiff_plugin.jobs import capture_poses
from geodiff_plugin.jobs.capture_poses import RunKeys, load_solved, reopened_capture
from geodiff_plugin.jobs.journal import Done, Item, Journal, Shard
from geodiff_plugin.jobs.lengths import KnownScale
from tests.unit.jobs.made_captures import MOVED, NAMES, options


@pytest.mark.parametrize(
    ("asked", "device", "cores", "gigabytes", "left", "count"),
    [
        (None, "cpu", 4, 100.0, 9, 4),
        (None, "cpu", 4, 100.0, 3, 3),
        (None, "cpu", 4, 3.1, 9, 2),
        (None, "cpu", 4, 0.5, 9, 1),
        (None, "cuda", 4, 100.0, 9, 1),
        (6, "cpu", 4, 100.0, 9, 6),
        (6, "cuda", 4, 100.0, 5, 5),
        (None, "cpu", 4, 100.0, 0, 1),
    ],
)
def test_on_a_cpu_a_process_a_core_works_as_far_as_memory_goes(
    monkeypatch, tmp_path, asked, device, cores, gigabytes, left, count
):
    memory = SimpleNamespace(available=gigabytes * 1e9)
    monkeypatch.setattr(module.psutil, "virtual_memory", lambda: memory)
    monkeypatch.setattr(module, "available_cores", lambda: cores)
    monkeypatch.setattr(module, "pick_device", torch.device)
    assert module._processes(options(tmp_path, processes=asked, device=device), left) == count


def test_a_process_that_may_have_no_workers_works_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "can_have_workers", lambda: False)
    assert module._processes(options(tmp_path, processes=6, device="cpu"), 9) == 1


def test_another_process_opens_the_capture_with_the_scale_of_the_first(run, monkeypatch):
    (run.folder / "out").mkdir()
    given, keys = options(run.folder, metres_per_unit=9.0), RunKeys("poses", "frames", KnownScale(2.0))
    opened = reopened_capture(given, keys)
    assert opened.metres_per_unit == 2.0 and load_solved(run.folder / "out/poses.npz", "poses") is not None
    made = module._frame_by_name(given, keys)("f1")
    assert made["made_from"] == "frames" and made["frame"] == "f1" and made["unit"] == "m"
    np.testing.assert_allclose(np.array(made["T_world_from_camera"])[:3, 3], 2.0 * MOVED[1, :3, 3])


def test_frames_by_ray_are_made_where_they_are_not_there(run, monkeypatch):
    (run.folder / "out").mkdir()
    asked = []

    def items_on_actors(make, given, items):
        asked.append(([item.key for item in items], make.args, given.engine))
        yield from (Done(item.key, {"by": "Ray"}, None) for item in items)

    monkeypatch.setattr(module, "on_ray", lambda name: items_on_actors)
    given, keys = options(run.folder, engine="ray"), RunKeys("poses", "frames", None)
    with Journal(run.folder / "out" / module.JOURNAL) as journal:
        for name in ("f0", "f1"):
            journal.put(Item(name, inputs="frames", head={"frame": name}), {})
    made = run.folder / "out/f0"
    made.mkdir()
    (made / "report.json").write_text(json.dumps({"made_from": "frames"}))
    for name in ("depth_alone.npy", "confidence_alone.npy", "sigma_alone.npy"):
        (made / name).write_bytes(b"map")
    records = module.run_frames(capture_poses.open_capture(given), given, NAMES, keys, False)
    assert [(record["frame"], record.get("by")) for record in records[1:]] == [("f1", "Ray"), ("f2", "Ray")]
    assert asked == [(["f1", "f2"], (given, keys), "ray")]


def test_overwriting_forgets_the_records_of_all_shards_or_of_its_own(run):
    keys, given = RunKeys("poses", "frames", None), options(run.folder, overwrite=True, processes=1)
    capture = capture_poses.open_capture(given)
    path = run.folder / "out" / module.JOURNAL
    (run.folder / "out").mkdir()
    for shard, left in (("1/2", {"frames.jsonl", "frames.0-of-2.jsonl"}), (None, set())):
        for each in (Shard(), Shard(0, 2), Shard(1, 2)):
            each.path(path).write_text("old\n")
        module.run_frames(capture, replace(given, shard=shard), [], keys, False)
        old = {each.name for each in path.parent.glob("frames*") if each.read_text() == "old\n"}
        assert old == left
