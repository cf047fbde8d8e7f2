"""A capture: poses that are saved and read again, frames that count as made, and its report."""

import json
import math
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._checks import InputError
from geodiff_plugin.capture.frames import Capture
from geodiff_plugin.formats.layouts import CaptureFrame
from geodiff_plugin.jobs import capture as module
from geodiff_plugin.jobs.capture import RunKeys, depth_capture, load_solved, solved_poses
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal, Shard
from geodiff_plugin.jobs.lengths import KnownScale
from geodiff_plugin.jobs.options import CaptureOptions
from geodiff_plugin.messages import Message
from geodiff_plugin.pose.multiview import SolvedCapture
from tests.unit.jobs import made_runs
from tests.unit.jobs.made_runs import pose

NOTE = Message("capture.scale", "The scale is uncertain.")
NAMES = ["f0", "f1", "f2"]
GIVEN = np.stack([pose((n, -n, 2 * n), (0.3 * n, 0.1, -0.2 * n)) for n in range(3)])
MOVED = np.stack([E @ pose((0, 0, n), (0.0, 0.03 * n, 0.04 * n)) for n, E in enumerate(GIVEN)])


def solved(**changes) -> SolvedCapture:
    rng = np.random.default_rng(2)
    seen = tuple((rng.random((n, 2)), np.arange(n)) for n in (4, 0, 3))
    values = {
        "status": "solved",
        "E": MOVED,
        "E_given": GIVEN,
        "K": np.stack([np.diag([50.0 + n, 51.0, 1.0]) for n in range(3)]),
        "connected": np.array([True, False, True]),
        "points": rng.random((5, 3)),
        "seen": seen,
        "residual_px_given": 3.14159,
        "residual_px": 0.27183,
        "scale_trajectory": 1.12345,
        "scale_depth": 0.98765,
        "scale_spread": 0.04321,
        "notes": (NOTE, Message("capture.kept", "The poses are kept.")),
    }
    return SolvedCapture(**values | changes)


@pytest.fixture
def capture(tmp_path) -> Capture:
    """Three frames, solved in the unit of their poses."""
    frames = []
    for n, name in enumerate(NAMES):
        (tmp_path / f"{name}.png").write_text(name)
        frames.append(
            CaptureFrame(name, tmp_path / f"{name}.png", E=GIVEN[n], size=(50 + n, 36), K=np.eye(3))
        )
    return Capture(frames, "test", None, [Message("capture.part", "One part.")])


def options(tmp_path, **more) -> CaptureOptions:
    return CaptureOptions(**{"path": tmp_path, "out": tmp_path / "out", "device": "cpu"} | more)


@pytest.mark.parametrize(
    "changes", [{}, {"E_given": None, "status": "estimated"}, {"notes": (), "scale_spread": math.nan}]
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
        elif field.name == "notes":
            assert [(note.code, str(note)) for note in found] == [(note.code, str(note)) for note in was]
        elif isinstance(was, np.ndarray):
            np.testing.assert_array_equal(was, found)
        else:
            assert found == was or (math.isnan(found) and math.isnan(was)), field.name
    (tmp_path / "poses.npz").write_bytes(b"cut off")
    assert load_solved(tmp_path / "poses.npz", "key") is None


@pytest.fixture
def solving(monkeypatch):
    """How often poses are solved, and in which way."""
    asked = []

    def solve(self, poses=None, *, threads=None):
        if self.solved is None:
            asked.append((poses, threads))
            self.solved = solved()
        return self.solved

    monkeypatch.setattr(Capture, "solve", solve)
    monkeypatch.setattr(module, "available_cores", lambda: 7)
    for name in ("RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    return asked


def again(capture: Capture) -> Capture:
    return Capture(capture.frames, capture.kind, capture.unit, capture.notes)


def test_poses_are_solved_once_for_each_key_and_by_no_shard(capture, tmp_path, solving):
    (tmp_path / "out").mkdir()
    given = options(tmp_path, poses="given")
    with pytest.raises(InputError, match="run geodiff capture with --poses-only first"):
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
    doubt = Message("capture.length", "It is uncertain.")
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
        assert (doubt in fresh.notes) == (scale.doubt is not None)
        fresh = again(capture)
        solved_poses(fresh, options(tmp_path, **typed), "key", KnownScale(4.0))
        assert fresh.metres_per_unit == 4.0 and len(asked) == 1, "another process has found it"
    monkeypatch.setattr(module, "known_scale", lambda *_: None)
    fresh = again(capture)
    assert solved_poses(fresh, options(tmp_path), "key") is None and fresh.unit is None


def test_the_report_of_the_poses_says_how_far_each_camera_moved(capture):
    capture.solved = solved()
    told = module._pose_report(capture)
    assert told["status"] == "solved" and told["notes"] == list(capture.solved.notes)
    assert told["residual_px_given"] == 3.1416 and told["residual_px"] == 0.2718
    assert told["scale_by_positions"] == pytest.approx(1.12345, abs=6e-5)
    assert told["scale_by_depth"] == pytest.approx(0.98765, abs=6e-5)
    assert told["scale_spread"] == 0.0432
    for n, name in enumerate(NAMES):
        frame = told["frames"][name]
        assert frame["connected"] is (n != 1)
        assert frame["moved"] == pytest.approx(0.05 * n, abs=1e-5)
        assert frame["turned_deg"] == pytest.approx(n, abs=1e-3)
    unknown = MOVED.copy()
    unknown[1] = np.nan
    capture.solved = solved(E=np.where(np.isnan(unknown), np.eye(4), unknown), scale_spread=math.nan)
    assert module._pose_report(capture)["scale_spread"] is None


def test_failed_and_doubted_frames_are_named():
    frames = [
        {"key": "f0", "frame": "f0", "verdict": {"status": "trusted"}},
        {"key": "f1", "frame": "f1", "status": BROKEN, "error": "torn"},
        {"key": "f2", "frame": "f2", "verdict": {"status": "not trusted"}},
        {"key": "f3", "frame": "f3", "verdict": {"status": "not judged"}},
    ]
    outcome = module._outcome(frames)
    assert outcome == {"failed": ["f1"], "not_trusted": ["f2", "f3"], "frames": frames}


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


def test_a_frame_is_made_where_its_maps_and_its_key_are_there(tmp_path):
    item, folder = Item("f0", inputs="key"), tmp_path / "f0"
    assert not module._is_made(item, folder)
    folder.mkdir()
    (folder / "report.json").write_text(json.dumps({"made_from": "key"}))
    for name in ("depth_alone.npy", "confidence_alone.npy"):
        assert not module._is_made(item, folder)
        (folder / name).write_bytes(b"map")
    assert module._is_made(item, folder)
    assert not module._is_made(Item("f0", inputs="other"), folder)


def test_a_frame_is_asked_for_as_the_options_say(capture, tmp_path, monkeypatch):
    asked = []

    def depth(self, pipe, name, neighbours, **call):
        asked.append((pipe, name, neighbours, call, torch.is_grad_enabled()))
        return "output"

    monkeypatch.setattr(Capture, "depth", depth)
    assert module._depth(capture, "pipe", "f1", options(tmp_path, neighbours=4, seed=9)) == "output"
    assert asked == [("pipe", "f1", 4, {"seed": 9, "points": "none"}, False)]
    module._depth(capture, "pipe", "f1", CaptureOptions(path=tmp_path), CaptureOptions(path=tmp_path).points)
    assert asked[1] == ("pipe", "f1", 5, {"seed": 0, "points": "tracks"}, False)
    values = np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)
    maps = tmp_path / "maps"
    maps.mkdir()
    np.save(maps / "f2.npy", values)
    module._depth(capture, "pipe", "f2", options(tmp_path, steps=3, prior_map=maps), "tracks")
    *_, (_, _, _, call, _) = asked
    assert (call["num_inference_steps"], call["points"]) == (3, "tracks")
    np.testing.assert_array_equal(call["depth_map"], values)
    with pytest.raises(InputError, match=r"--prior-map of f1 must be .*f1\.npy"):
        module._depth(capture, "pipe", "f1", options(tmp_path, prior_map=maps))


def test_the_prior_is_that_of_the_options_with_graphs_on_a_gpu(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(module, "pick_device", torch.device)
    monkeypatch.setattr(module, "load_quiet_prior", lambda *given: asked.update(load=given) or "pipe")
    monkeypatch.setattr(
        module, "enable_geometry_guidance", lambda pipe, **given: asked.update(enable=(pipe, given))
    )
    module._pipe(options(tmp_path, prior="a/b", space="log"))
    assert asked["load"] == ("a/b", torch.device("cpu"), "log")
    assert asked["enable"] == ("pipe", {"graphs": False, "kernels": True})
    module._pipe(options(tmp_path, prior_map=tmp_path, device="cuda", no_kernels=True))
    assert asked["load"] == ("map", torch.device("cuda"), None)
    assert asked["enable"] == ("pipe", {"graphs": True, "kernels": False})


@pytest.fixture
def run(capture, tmp_path, solving, monkeypatch):
    """What a run over the capture calls, with outputs that are made up; ``f1`` fails if it is to."""
    asked = SimpleNamespace(fails=set(), pipes=[], depths=[])
    capture.solved = None

    def depth(found, pipe, name, given, points="none"):
        asked.depths.append((name, points))
        if name in asked.fails:
            raise InputError(f"{name} is torn")
        return made_runs.output(unit=found.unit)

    monkeypatch.setattr(module, "_depth", depth)
    monkeypatch.setattr(module, "_pipe", lambda given: asked.pipes.append(given) or "pipe")
    monkeypatch.setattr(module, "open_capture", lambda given: again(capture))
    monkeypatch.setattr(Capture, "neighbours", lambda self, name, count: [f"{name}'s {count}"])
    monkeypatch.setattr(Capture, "image", lambda self, name: np.zeros((36, 50, 3), np.float32))
    monkeypatch.setattr(module, "write_maps", lambda *given: asked.__dict__.update(maps=given) or {"n": 1})
    monkeypatch.setattr(module, "compile_for", lambda *given: None)
    asked.agreed = []
    monkeypatch.setattr(
        module, "write_agreement", lambda found, out, names: asked.agreed.append(names) or {"share": 1}
    )

    def write_results(found, out, names, export, doubted, original):
        asked.results = (names, export, doubted, original)
        return {"cloud.ply": 3}

    monkeypatch.setattr(module, "write_results", write_results)
    asked.folder = tmp_path
    return asked


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_every_frame_has_a_folder_with_its_maps_and_report(run):
    told = []
    given = options(run.folder, processes=1, neighbours=4, export=("mesh",))
    report = depth_capture(given, tell=told.append)
    assert [name for name, _ in run.depths] == NAMES and {points for _, points in run.depths} == {"tracks"}
    depth_m = made_runs.depth_map()
    low, middle, high = np.percentile(depth_m, (2, 50, 98))
    for n, name in enumerate(NAMES):
        folder = run.folder / "out" / name
        np.testing.assert_array_equal(np.load(folder / "depth_alone.npy"), depth_m)
        confidence = np.load(folder / "confidence_alone.npy")
        np.testing.assert_array_equal(confidence, made_runs.output().confidence[0, ..., 0])
        frame = json.loads((folder / "report.json").read_text())
        assert frame["frame"] == name and frame["neighbours"] == [f"{name}'s 4"] and frame["unit"] is None
        np.testing.assert_allclose(frame["K"], made_runs.K_LEFT)
        np.testing.assert_allclose(frame["T_world_from_camera"], MOVED[n])
        assert frame["connected"] is (n != 1) and frame["scale_spread"] == 0.0432
        assert frame["depth"] == pytest.approx({"p02": low, "median": middle, "p98": high})
        assert frame["poses"] == ["refined"] and frame["warnings"] == [made_runs.OF_CALL]
        assert frame["verdict"]["status"] == "not trusted" and frame["made_from"] == report["made_from"]
        assert {message["text"] for message in frame["messages"]} >= {made_runs.REASON, made_runs.OF_CALL}
        assert frame["files"]["n"] == 1 and frame["seconds"] >= 0
        names = {path.name for path in folder.iterdir()}
        assert set(frame["files"]["names"]) == names
        shown = report["frames"][n]
        assert {key: shown[key] for key in frame} == frame and shown["key"] == name
    assert json.loads((run.folder / "out/capture.json").read_text()) == report
    assert run.agreed == [NAMES] and run.results == (NAMES, ("mesh",), NAMES, None)
    assert report["agreement"] == {"share": 1} and report["files"] == {"cloud.ply": 3}
    assert report["not_trusted"] == NAMES and report["failed"] == [] and report["measured"] == []
    assert (report["kind"], report["unit"], report["path"]) == ("test", None, str(run.folder))
    assert list(report["seconds"]) == ["poses", "frames", "agreement and cloud"]
    assert all(0 <= seconds < 60 for seconds in report["seconds"].values())
    assert report["notes"] == ["One part."] == told[:1]
    assert [message["code"] for message in report["messages"]] == [
        "capture.part",
        "capture.scale",
        "capture.kept",
    ]
    assert "0.27 px off their epipolar lines" in told[1] and told[2] == "The poses are kept."

    assert len(run.pipes) == 1 and depth_capture(given)["frames"] == report["frames"]
    assert len(run.depths) == 3 and len(run.pipes) == 1, "all frames were there"
    (run.folder / "out/f1/depth_alone.npy").unlink()
    depth_capture(given)
    assert [name for name, _ in run.depths[3:]] == ["f1"]
    depth_capture(replace(given, overwrite=True))
    assert [name for name, _ in run.depths[4:]] == NAMES


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_a_failed_frame_is_left_out_and_the_frames_that_are_chosen_are_made(run):
    run.fails = {"f1"}
    report = depth_capture(options(run.folder, processes=1, frames="f1,f2"))
    assert report["failed"] == ["f1"] and run.agreed == [["f2"]]
    assert report["frames"][0]["error"] == "f1 is torn" and report["frames"][0]["frame"] == "f1"
    run.fails = {"f0", "f2"}
    with pytest.raises(InputError, match=r"No frame got depth: f0 is torn|f0 is torn The same holds"):
        depth_capture(options(run.folder, processes=1, frames="f0", out=run.folder / "other"))


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_what_does_not_fit_the_memory_is_named_with_its_size(run, monkeypatch):
    def full(*_, **__):
        raise MemoryError

    monkeypatch.setattr(module, "_depth", full)
    with pytest.raises(InputError, match=r"A frame of 52x36 pixels .*, or give a lower --processes\."):
        depth_capture(options(run.folder, processes=1, frames="f2"))
    monkeypatch.setattr(module, "solved_poses", full)
    with pytest.raises(InputError, match=r"A capture of 51x36 pixels .*, or give a lower --processes\."):
        depth_capture(options(run.folder, processes=1, frames="f0,f1", out=run.folder / "other"))


@pytest.mark.filterwarnings("ignore:The scale is uncertain")
def test_poses_alone_are_for_shards_which_make_their_part(run):
    report = depth_capture(options(run.folder, poses_only=True))
    assert report["poses"]["status"] == "solved" and report["frames"] == [] and run.depths == []
    assert report["unit"] is None and not (run.folder / "out/capture.json").exists()
    shard = depth_capture(options(run.folder, shard="1/2"))
    assert [frame["frame"] for frame in shard["frames"]] == ["f1"] and set(shard) == {
        *("unit", "failed", "not_trusted", "frames")
    }
    assert run.agreed == []
    whole = depth_capture(options(run.folder, processes=1))
    assert [name for name, _ in run.depths] == ["f1", "f0", "f2"] and len(whole["frames"]) == 3


def test_another_process_opens_the_capture_with_the_scale_of_the_first(run, monkeypatch):
    (run.folder / "out").mkdir()
    given, keys = options(run.folder, metres_per_unit=9.0), RunKeys("poses", "frames", KnownScale(2.0))
    opened = module._opened_again(given, keys)
    assert opened.metres_per_unit == 2.0 and load_solved(run.folder / "out/poses.npz", "poses") is not None
    made = module._frame_by_name(given, keys)("f1")
    assert made["made_from"] == "frames" and made["frame"] == "f1" and made["unit"] == "m"
    np.testing.assert_allclose(np.array(made["T_world_from_camera"])[:3, 3], 2.0 * MOVED[1, :3, 3])


def test_frames_by_ray_are_made_where_they_are_not_there(run, monkeypatch):
    (run.folder / "out").mkdir()
    asked = []

    def items_on_actors(items, journal, make, given, failures, progress):
        asked.append(([item.key for item in items if journal.get(item) is None], make.args, given.engine))
        return "records"

    monkeypatch.setattr(module, "on_ray", lambda name: items_on_actors)
    given, keys = options(run.folder, engine="ray", overwrite=True), RunKeys("poses", "frames", None)
    with Journal(run.folder / "out" / module.JOURNAL) as journal:
        for name in ("f0", "f1"):
            journal.put(Item(name, inputs="frames"), {})
    made = run.folder / "out/f0"
    made.mkdir()
    (made / "report.json").write_text(json.dumps({"made_from": "frames"}))
    for name in ("depth_alone.npy", "confidence_alone.npy"):
        (made / name).write_bytes(b"map")
    items = [Item(name, inputs="frames") for name in NAMES]
    assert module._frames_on_ray(given, items, keys, False) == "records"
    assert asked == [(["f1", "f2"], (replace(given, overwrite=False), keys), "ray")]


def test_overwriting_forgets_the_records_of_all_shards_or_of_its_own(run):
    keys, given = RunKeys("poses", "frames", None), options(run.folder, overwrite=True, processes=1)
    capture = module.open_capture(given)
    path = run.folder / "out" / module.JOURNAL
    (run.folder / "out").mkdir()
    for shard, left in (("1/2", {"frames.jsonl", "frames.0-of-2.jsonl"}), (None, set())):
        for each in (Shard(), Shard(0, 2), Shard(1, 2)):
            each.path(path).write_text("old\n")
        module._run_frames(capture, replace(given, shard=shard), [], keys, False)
        old = {each.name for each in path.parent.glob("frames*") if each.read_text() == "old\n"}
        assert old == left


@pytest.mark.parametrize("spread", [math.nan, -1.0, 0.03])
def test_lengths_are_measured_with_the_spread_of_the_scale(capture, tmp_path, monkeypatch, spread):
    asked = []
    capture.solved = solved(scale_spread=spread)
    monkeypatch.setattr(module, "spans_to_measure", lambda *_: [SimpleNamespace(frame=n) for n in NAMES])
    monkeypatch.setattr(module, "measure", lambda *given: asked.append(given) or "measured")
    outcome = {"failed": ["f1"], "not_trusted": ["f2"]}
    given = options(tmp_path)
    assert module._measured(capture, given, outcome, None) == "measured"
    found, spans, out, doubted, used = asked[0]
    assert found is capture and [span.frame for span in spans] == ["f0", "f2"]
    assert (out, doubted, used) == (given.out, ["f2"], max(0.0, 0.0 if math.isnan(spread) else spread))
    module._measured(capture, given, outcome, KnownScale(2.0, 0.07))
    assert asked[1][-1] == 0.07


def test_a_capture_is_opened_with_what_the_options_name(tmp_path, monkeypatch, capture):
    asked = {}

    def opened(path, **given):
        asked.update(path=path, **given)
        return capture

    np.savetxt(tmp_path / "K.txt", np.diag([50.0, 51.0, 1.0]))
    monkeypatch.setattr(module.Capture, "open", opened)
    extra = {"trajectory": Path("t"), "images": Path("i"), "k": tmp_path / "K.txt", "fov": 61.0}
    assert module.open_capture(options(tmp_path, **extra)) is capture
    K = asked.pop("K")
    np.testing.assert_array_equal(K, np.diag([50.0, 51.0, 1.0]))
    assert asked == {"path": tmp_path, "fov": 61.0, "trajectory": Path("t"), "images": Path("i")}
    with pytest.raises(InputError, match="--points.*known depths that the capture has"):
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
