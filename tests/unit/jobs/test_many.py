"""A run over many pairs: what each stage is given, what counts as finished, and the rows of its table."""

import csv
import json
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.findings import Finding
from geodiff_plugin.jobs import many
from geodiff_plugin.jobs.journal import BROKEN, Done, Item, Journal, Shard
from geodiff_plugin.jobs.notices import silent
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import COLUMNS, PairRef
from geodiff_plugin.jobs.records import JobLog, ReadPair

ROW = {
    "near_m": 1.0,
    "median_m": 2.0,
    "far_m": 3.0,
    "verdict": "trusted",
    "confidence": 0.5,
    "seconds": 4.0,
    "message": None,
    "reasons": "",
    "codes": "pose.refined",
}


def options(**more) -> DepthOptions:
    return DepthOptions(**{"left": Path("l"), "right": Path("r"), "out": Path("out"), "device": "cpu"} | more)


def test_a_row_states_the_result_of_its_pair():
    reported = []
    done = many._final({"key": "a", **ROW}, None, options(), reported.append)
    expected = {name: ROW.get(name) for name in COLUMNS} | {"pair": "a"}
    assert done == expected | {"result": "done"} and list(done) == list(COLUMNS)
    there = many._final({"key": "a"}, ROW, options(), reported.append)
    assert there == expected | {"result": "kept"}
    broken = {"key": "b", "status": BROKEN, "error": "torn"}
    empty = dict.fromkeys(COLUMNS)
    failed = empty | {"pair": "b", "result": "failed", "message": "torn"}
    assert many._final(broken, None, options(), reported.append) == failed
    assert reported == []
    doubted = ROW | {"verdict": "not trusted", "reasons": "E is wrong."}
    assert many._final({"key": "c", **doubted}, None, options(), reported.append)["result"] == "done"
    assert many._final({"key": "c", **ROW}, None, options(strict=True), reported.append)["result"] == "done"
    row = many._final({"key": "c", **doubted}, None, options(strict=True), reported.append)
    reason = f"The depth in {Path('out/c')} is not trusted: E is wrong."
    assert row == empty | {"pair": "c", "result": "failed", "message": reason, "codes": "pose.refined"}
    assert reported == [f"geodiff: c: {reason}"]


@pytest.mark.parametrize(
    ("device", "pairs", "cores", "processes", "count"),
    [
        ("cuda", 9, 20, 1, 3),
        ("cuda", 9, 5, 1, 2),
        ("cuda", 9, 4, 1, 1),
        ("cuda", 9, 2, 1, 1),
        ("cuda", 1, 20, 1, 1),
        ("cuda", 9, 20, 4, 2),
        ("cpu", 9, 20, 1, 0),
        ("cuda", 100, 16, 1, 3),
        ("cuda", 100, 5, 1, 2),
        ("cuda", 100, 1, 1, 1),
        ("cuda", 2, 16, 1, 2),
        ("cuda", 100, 40, 8, 2),  # eight GPUs of one machine, 5 cores each
        ("cuda", 100, 16, 8, 1),
        ("cpu", 9, 16, 1, 0),
    ],
)
def test_with_a_gpu_the_cores_that_its_stages_leave_write(
    monkeypatch, device, pairs, cores, processes, count
):
    monkeypatch.setattr(many, "available_cores", lambda: cores)
    assert many.count_writers(torch.device(device), pairs, processes) == count


def test_each_shard_takes_the_gpu_of_its_number(monkeypatch):
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    for name, index, found in (("cuda", 4, "cuda:1"), ("cuda", 3, "cuda:0"), ("cuda:2", 4, "cuda:2")):
        monkeypatch.setattr(many, "pick_device", torch.device)
        assert many._device_of(options(device=name), Shard(index, 8)) == torch.device(found)
    assert many._device_of(options(device="cpu"), Shard(1, 2)) == torch.device("cpu")


def items(*names: str) -> list[Item]:
    return [Item(name, PairRef(name, Path(f"{name}.png"), Path("r.png"))) for name in names]


def test_pairs_count_as_finished_by_their_folder_alone(tmp_path, monkeypatch):
    asked = []

    def finished_row(own):
        asked.append(own)
        return ROW if own.out.name in ("a", "b") else None

    monkeypatch.setattr(many, "finished_row", finished_row)
    a, b, c = items("a", "b", "c")
    with Journal(tmp_path / "job.jsonl") as journal:
        journal.put(a, {"near_m": 9.0})
        journal.put(c, {"near_m": 9.0})
        there = many._finished_rows([a, b, c], options(), journal)
        assert there == {"a": ROW, "b": ROW}
        assert journal.get(a)["near_m"] == 9.0 and journal.get(b)["near_m"] == 1.0
        assert journal.get(c) is None, "its folder is gone"
        assert [own.out for own in asked] == [Path("out/a"), Path("out/b"), Path("out/c")]
        assert [own.left.name for own in asked] == ["a.png", "b.png", "c.png"]
        assert many._finished_rows([a, b], options(overwrite=True), journal) == {}
        assert journal.get(a) is journal.get(b) is None and len(asked) == 3


def test_one_baseline_for_all_pairs_of_a_model_is_rejected(monkeypatch):
    asked = []

    def has_pose_per_image(calib):
        asked.append(calib)
        return calib == Path("model")

    monkeypatch.setattr(many, "has_pose_per_image", has_pose_per_image)
    refs = [PairRef(name, Path(name), Path("r"), Path("model")) for name in "ab"]
    with pytest.raises(InputError, match="every pair of model has its own baseline"):
        many._raise_one_length(options(baseline=0.1), refs)
    many._raise_one_length(options(), refs)
    many._raise_one_length(options(baseline=0.1), refs[:1])
    assert asked == [Path("model")]
    plain = [PairRef(name, Path(name), Path("r")) for name in "ab"]
    many._raise_one_length(options(baseline=0.1), plain)
    many._raise_one_length(options(baseline=0.1, calib=(Path("one"),)), plain)
    many._raise_one_length(options(baseline=0.1, calib=(Path("one"), Path("two"))), plain)
    assert asked[1:] == [Path("one"), (Path("one"), Path("two"))]


class Folder:
    """A held folder."""

    def __init__(self, path):
        self.path, self.place, self.held = path, f"place of {path.name}", 0

    def __enter__(self):
        self.held += 1
        return self

    def __exit__(self, *_):
        self.held -= 1


@pytest.fixture
def stages(monkeypatch):
    """The stages, with what they call noted."""
    asked = SimpleNamespace(started=[], read=[], prior=[], run=[], written=[], reported=[])
    found = [
        Finding("camera.assumed-intrinsics", "cy is assumed."),
        Finding("calibration.unrectified", "As taken."),
    ]
    guidance = SimpleNamespace(
        findings=found,
        evidence_store=None,
        prefetch=lambda left, device: asked.run.append((left, device)),
    )
    inputs = SimpleNamespace(guidance=guidance, left=torch.zeros(3, 40, 50))
    pipe = SimpleNamespace(_execution_device=torch.device("cpu"))

    def start_pair(own, images):
        asked.started.append((own, images))
        return Folder(own.out)

    class Reader:
        def __init__(self, _):
            self.closed = False

        def read(self, ref, own):
            asked.read.append((ref.name, own))
            return ReadPair(own, inputs, JobLog({"calibration": 1.0}))

        def close(self):
            self.closed = True

    def prior_of_options(own, device, notify):
        asked.prior.append((own, device, notify))
        return pipe

    def run_read_pair(*given):
        asked.run.append(given)
        return "run"

    monkeypatch.setattr(many, "start_pair", start_pair)
    monkeypatch.setattr(many, "PairReader", Reader)
    monkeypatch.setattr(many, "prior_of_options", prior_of_options)
    monkeypatch.setattr(many, "run_read_pair", run_read_pair)
    monkeypatch.setattr(many, "write_row", lambda *given: asked.written.append(given) or dict(ROW))
    asked.inputs, asked.pipe = inputs, pipe
    return asked


@pytest.mark.parametrize("frame", [None, 4])
def test_a_pair_goes_through_all_stages(stages, frame):
    cpu = torch.device("cpu")
    line = many.Stages(options(seed=3), cpu, notify=stages.reported.append)
    item = Item("a", PairRef("a", Path("a.png"), Path("b.png"), frame=frame))
    begun = line.read(item)
    ((own, images),) = stages.started
    assert (own.left, own.out, own.seed, images) == (Path("a.png"), Path("out/a"), 3, frame is None)
    assert stages.read == [("a", own)] and stages.reported == ["cy is assumed."]
    assert begun.folder.held == 1

    assert line.evidence(begun) is begun
    ((asked, device, notify),) = stages.prior
    assert asked == options(seed=3) and device == cpu and notify == stages.reported.append
    assert stages.run == [(stages.inputs.left, cpu)]
    stages.run.clear()
    stages.inputs.guidance.evidence_store = "of the call"
    assert list(begun.pair.log.seconds) == ["calibration", "evidence"]

    assert line.guide(begun) is begun and begun.run == "run"
    assert stages.run == [(stages.pipe, begun.pair)]
    assert stages.inputs.guidance.evidence_store is None
    assert line.write(begun) == ROW and stages.written == [(begun.folder, "run")]
    line.release(item)
    line.release(item)
    assert begun.folder.held == 0
    line.evidence(begun)
    assert len(stages.prior) == 1, "the prior is loaded once"
    assert [getattr(stage, "threads", 1) for stage in line.all] == [1, 1, 1, 1]
    line.close()
    assert line._reader.closed


def test_on_a_gpu_the_networks_of_many_pairs_are_recorded_as_graphs(stages):
    line = many.Stages(options(), torch.device("cuda"), among=2)
    pair = line.read(items("a")[0])
    line.evidence(pair)
    ((asked, _, notify),) = stages.prior
    assert asked == options(cuda_graphs=True) and notify is None, "silence shows no bar of a download"
    line.close()


def test_processes_write_where_there_are_any(stages, monkeypatch):
    calls = []

    class Processes:
        def __init__(self, module, count):
            calls.append((module, count))

        def call(self, *given):
            calls.append(given)
            return ROW

        def close(self):
            calls.append("close")

    monkeypatch.setattr(many, "WorkerProcesses", Processes)
    line = many.Stages(options(), torch.device("cpu"), "pipe", writers=2)
    assert line.all[3].threads == 2
    pair = line.read(items("a")[0])
    pair.run = "run"
    assert line.write(pair) == ROW
    line.close()
    assert calls[0][1] == 2 and calls[1] == (many.write_row, "place of a", "run")
    assert calls[2] == "close" and stages.prior == []


def test_what_would_fail_every_pair_ends_the_run(stages, monkeypatch):
    line = many.Stages(options(), torch.device("cpu"))
    pair = line.read(items("a")[0])

    def fails(error):
        def function(*_, **__):
            raise error

        return function

    monkeypatch.setattr(many, "prior_of_options", fails(InputError("no such prior")))
    with pytest.raises(many._EndsRun) as ended:
        line.evidence(pair)
    assert str(ended.value.__cause__) == "no such prior"
    pair.run = "run"
    for error, words in (
        (OSError(28, "No space left"), "The disk of --out is full"),
        (many.ProcessEnded("A worker process ended."), "ended. Finished pairs are kept"),
    ):
        monkeypatch.setattr(many, "write_row", fails(error))
        with pytest.raises(many._EndsRun) as ended:
            line.write(pair)
        assert words in str(ended.value.__cause__)
    monkeypatch.setattr(many, "write_row", fails(KeyError("defect")))
    with pytest.raises(KeyError):
        line.write(pair)


def depth_pairs(tmp_path, monkeypatch, stage, **more):
    """``depth_pairs`` with stages that do ``stage``; smoothed frames and the table are real."""
    made = {}

    class Stages:
        def __init__(self, asked, device, pipe, *, notify, writers):
            made.update(options=asked, device=device, pipe=pipe, writers=writers)
            self.all = (stage,)

        def release(self, item):
            made.setdefault("released", []).append(item.key)

        def close(self):
            made["closed"] = True

    monkeypatch.setattr(many, "Stages", Stages)
    asked = options(out=tmp_path / "out", **more)
    refs = [item.payload for item in items("a", "b", "c")]
    return many.depth_pairs(asked, refs, pipe="pipe"), made


@pytest.fixture
def alone(monkeypatch):
    for name in ("RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)


def test_every_pair_is_a_row_and_a_failed_one_does_not_stop_the_others(tmp_path, monkeypatch, alone):
    def stage(item):
        if item.key == "b":
            raise ValueError(f"{tmp_path / 'out' / 'b'} is torn")
        return dict(ROW)

    rows, made = depth_pairs(tmp_path, monkeypatch, stage)
    assert [row["result"] for row in rows] == ["done", "failed", "done"]
    assert made["closed"] and made["released"] == ["a", "b", "c"] and made["writers"] == 0
    assert made["pipe"] == "pipe" and made["device"] == torch.device("cpu")
    lines = (tmp_path / "out/pairs.csv").read_text().splitlines()
    assert len(lines) == 4 and lines[0] == ",".join(COLUMNS) and lines[2].startswith("b,failed,")
    records = (tmp_path / "out/.pairs.jsonl").read_text().splitlines()
    assert [json.loads(line)["key"] for line in records] == ["a", "b", "c"]


def test_a_shard_has_its_part_and_a_table_of_its_own(tmp_path, monkeypatch, alone):
    rows, _ = depth_pairs(tmp_path, monkeypatch, lambda item: dict(ROW), shard="1/2")
    assert [row["pair"] for row in rows] == ["b"]
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        ".pairs.1-of-2.jsonl",
        "pairs.1-of-2.csv",
    ]
    with pytest.raises(InputError, match="--temporal-smoothing needs all frames"):
        depth_pairs(tmp_path, monkeypatch, lambda item: dict(ROW), shard="1/2", temporal_smoothing=True)


def test_a_run_that_fails_as_a_whole_leaves_nothing(tmp_path, monkeypatch, alone):
    def stage(item):
        raise ValueError("no camera")

    with pytest.raises(InputError, match="All 3 pairs failed for this reason"):
        depth_pairs(tmp_path, monkeypatch, stage)
    assert not (tmp_path / "out").exists()

    def ends(item):
        raise many._EndsRun from InputError("no such prior")

    (tmp_path / "out").mkdir()
    (tmp_path / "out/other").write_text("text")
    with pytest.raises(InputError, match="no such prior"):
        depth_pairs(tmp_path, monkeypatch, ends)
    assert (tmp_path / "out/other").exists()


def test_smoothed_frames_are_those_that_did_not_fail(tmp_path, monkeypatch, alone):
    temporal_smoothing = []

    def note(asked, refs, views, notify):
        temporal_smoothing.append((asked.temporal_smoothing, [ref.name for ref in refs], notify))
        assert (tmp_path / "out/pairs.csv").is_file(), "it remains if this fails"
        depths = [{"min_m": n, "median_m": n + 1, "max_m": n + 2} for n in (5, 7)]
        return [{"depth": depth, "verdict": verdict} for depth in depths]

    verdict = {"status": "trusted", "facts": {"matched_fraction": {"confidence": 0.125}}}
    monkeypatch.setattr(many, "write_smoothed_frames", note)

    def stage(item):
        if item.key == "b":
            raise ValueError("torn")
        return dict(ROW)

    rows, _ = depth_pairs(tmp_path, monkeypatch, stage, temporal_smoothing=True)
    assert temporal_smoothing == [(True, ["a", "c"], silent)]
    names = ("near_m", "median_m", "far_m", "confidence", "result")
    figures = [tuple(row[name] for name in names) for row in rows]
    assert figures == [(5, 6, 7, 0.125, "done"), (*[None] * 4, "failed"), (7, 8, 9, 0.125, "done")]
    with open(tmp_path / "out/pairs.csv", newline="") as file:
        table = [tuple(row[name] for name in names) for row in csv.DictReader(file)]
    assert table == [tuple("" if value is None else str(value) for value in each) for each in figures]


def test_ray_makes_the_records_where_it_is_the_engine(tmp_path, monkeypatch, alone):
    asked = []

    def on_ray(name):
        def function(given, found):
            asked.append((name, given.engine, [item.key for item in found]))
            yield from (Done(item.key, dict(ROW), None) for item in found)

        return function

    monkeypatch.setattr(many, "on_ray", on_ray)
    rows, made = depth_pairs(tmp_path, monkeypatch, None, engine="ray", format="folders")
    assert asked == [("pairs_to_folders", "ray", ["a", "b", "c"])] and made == {}
    assert [row["result"] for row in rows] == ["done"] * 3
