"""Pairs on Ray, without Ray: a stand-in of its data sets calls each stage, and notes what is asked for."""

import importlib
import inspect
import os
import pickle
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType, SimpleNamespace
from unittest.mock import MagicMock

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.failures import DiskFull, Failures
from geodiff_plugin.jobs.journal import BROKEN, Item, Journal
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.jobs.pairs import PairRef
from geodiff_plugin.jobs.runner import Runner

OURS = ("jobs.ray", "jobs.cluster", "jobs.parquet")
OPTIONS = DepthOptions(
    left=Path("left"), out=Path("out"), engine="ray", workers=2, gpus=0.5, format="folders"
)


class LocalDataset:
    """Rows that every stage turns into others at once."""

    def __init__(self, rows, asked):
        self.rows, self.asked = list(rows), asked

    def map(self, stage, fn_constructor_args=(), **arguments):
        self.asked.append((stage, arguments))
        stage = stage(*fn_constructor_args) if isinstance(stage, type) else stage
        return LocalDataset(map(stage, self.rows), self.asked)

    def map_batches(self, stage, **arguments):
        self.asked.append((stage, arguments))
        return self if arguments["batch_format"] == "pyarrow" else None

    def iter_rows(self):
        return iter([dict(row) for row in self.rows])


class RayError(Exception):
    pass


@dataclass
class Context:
    enable_progress_bars: bool = True
    print_on_execution_start: bool = True
    raise_original_map_exception: bool = False


@pytest.fixture
def ray(monkeypatch):
    """The modules of Ray that are imported, and what was asked of them."""
    fake, data, asked, context = ModuleType("ray"), ModuleType("ray.data"), [], Context()
    started = []
    data.from_items = lambda rows, override_num_blocks: (
        asked.append(override_num_blocks) or LocalDataset(rows, asked)
    )
    data.ActorPoolStrategy = lambda **size: ("actors", size)
    data.TaskPoolStrategy = lambda most: ("tasks", most)
    data.DataContext = SimpleNamespace(get_current=lambda: context)
    fake.data, fake.cluster_resources = data, lambda: fake.resources
    fake.resources, fake.exceptions = {"CPU": 8.0}, SimpleNamespace(RayError=RayError)
    fake.is_initialized = lambda: bool(started)
    fake.init = lambda **settings: started.append(settings)
    fake.shutdown = lambda: started.append("shutdown")
    fake.asked, fake.started, fake.context = asked, started, context
    modules = {"ray": fake, "ray.data": data}
    if importlib.util.find_spec("pyarrow") is None:
        names = ("pyarrow", "pyarrow.compute", "pyarrow.dataset", "pyarrow.parquet", "fsspec")
        modules |= {name: MagicMock() for name in names if name not in sys.modules}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    for name in OURS:
        monkeypatch.delitem(sys.modules, f"geodiff_plugin.{name}", raising=False)
    for name in ("RANK", "WORLD_SIZE", "RAY_ADDRESS", "RAY_BACKEND_LOG_LEVEL"):
        monkeypatch.delenv(name, raising=False)
    fake.ours = importlib.import_module("geodiff_plugin.jobs.ray")
    fake.cluster = importlib.import_module("geodiff_plugin.jobs.cluster")
    yield fake
    for name in OURS:
        sys.modules.pop(f"geodiff_plugin.{name}", None)


@pytest.mark.parametrize(
    ("count", "gpus", "resources", "most"),
    [
        (3, None, {"CPU": 8.0, "GPU": 4.0}, 3),
        (None, None, {"CPU": 8.0, "GPU": 4.0}, 4),
        (None, 0.5, {"CPU": 8.0, "GPU": 4.0}, 8),
        (None, 2.0, {"CPU": 8.0, "GPU": 5.0}, 2),
        (None, 8.0, {"CPU": 8.0, "GPU": 4.0}, 1),
        (None, None, {"CPU": 8.0}, 8),
        (None, 0.0, {"CPU": 5.0, "GPU": 4.0}, 5),
        (None, None, {"CPU": 6.0, "GPU": 0.5}, 6),
        (None, None, {"CPU": 0.5}, 1),
        (None, None, {}, 1),
    ],
)
def test_there_are_as_many_actors_as_the_cluster_has_room_for(ray, count, gpus, resources, most):
    """An actor with its GPU; on CPUs half of one, and two tasks of a quarter next to it."""
    ray.resources = resources
    workers = ray.ours.Workers(count, gpus)
    assert workers.max_count() == most
    assert workers.for_rows(most) is workers and workers.for_rows(most + 5) is workers
    if most > 1:
        assert workers.for_rows(most - 1) == ray.ours.Workers(most - 1, gpus)
    assert workers.for_rows(0).count == 1
    on_gpu = gpus if gpus is not None else float(resources.get("GPU", 0) >= 1)
    arguments = workers.arguments()
    size = {"size": count} if count else {"min_size": 1, "max_size": most}
    expected = {"compute": ("actors", size), "num_cpus": 0.5, "num_gpus": on_gpu or None}
    assert arguments == expected
    beside = workers.task_arguments()
    assert beside == {"num_cpus": 0.25, "compute": ("tasks", None if on_gpu else most)}


def refs(count: int) -> list[PairRef]:
    return [PairRef(f"p{n}", Path(f"l{n}.png"), Path(f"r{n}.png")) for n in range(count)]


@dataclass
class Guided:
    """What an actor makes of a pair."""

    options: DepthOptions
    name: str
    run: object = None
    entries: object = None


@pytest.fixture
def stages(ray, monkeypatch):
    """The work of the stages: pairs whose name ends in 3 cannot be read, and in 5 not be guided."""
    made = []

    def read_ref(options, ref):
        if ref.name.endswith("3"):
            raise InputError(f"{ref.name} is torn")
        return Guided(options, ref.name)

    class Prior:
        def __init__(self, options):
            made.append(options)

        def guide(self, pair):
            if pair.name.endswith("5"):
                raise KeyError(pair.name)
            return pair

    def result_columns(pair):
        return {"unit": "m", "verdict": "trusted", "error": None}

    known = {
        "jobs.rows.read_ref": read_ref,
        "jobs.rows.read_columns": lambda base, row: Guided(base, row["key"]),
        "jobs.actor.PriorOfJob": Prior,
        "jobs.rows.result_columns": result_columns,
        "jobs.rows.COLUMNS": {"unit": "string", "verdict": "string", "error": "string"},
        "jobs.rows.IMAGES": ("left", "right"),
        "jobs.rows.check_names": lambda names: None,
    }
    monkeypatch.setattr(ray.ours, "imported", known.__getitem__)
    return made


@pytest.mark.parametrize(
    ("pairs", "workers", "blocks"), [(40, 2, 8), (200, 2, 25), (7, 2, 7), (1, 2, 1), (400, 40, 200)]
)
def test_pairs_are_read_in_blocks_that_keep_the_actors_busy(ray, stages, pairs, workers, blocks):
    """Four blocks an actor, of one pair to eight."""
    ray.ours.guided_refs(refs(pairs), OPTIONS, ray.ours.Workers(workers, 0.0))
    assert ray.asked[0] == blocks
    (_, reading), (_, guiding) = ray.asked[1:]
    assert reading == {"num_cpus": 0.25, "compute": ("tasks", min(workers, pairs))}
    assert guiding["compute"] == ("actors", {"size": min(workers, pairs)})
    assert stages == [OPTIONS]


def test_a_pair_that_cannot_be_read_or_guided_becomes_an_error_and_the_others_go_on(ray, stages, capsys):
    rows = list(ray.ours.guided_refs(refs(7), OPTIONS, ray.ours.Workers(1, 0.0)).iter_rows())
    assert [row["key"] for row in rows] == [f"p{n}" for n in range(7)]
    errors = {row["key"]: row["error"] for row in rows if row["error"] is not None}
    assert errors == {"p3": "p3 is torn", "p5": "KeyError: 'p5'"}
    assert capsys.readouterr().err.count("Traceback") == 1, "a defect is in the log of the worker"
    for row in rows:
        kept, state = ray.ours.attempt(row, lambda pair: pair.name)
        assert state == (None if row["key"] in errors else row["key"])
        assert "geodiff_state" not in kept and kept["key"] == row["key"]
        encoded = ray.ours._encode(row)
        if row["key"] in errors:
            assert encoded == {"key": row["key"], "unit": None, "verdict": None, "error": errors[row["key"]]}
        else:
            assert encoded == {"key": row["key"], "unit": "m", "verdict": "trusted", "error": None}


def test_a_dataset_of_rows_keeps_its_other_columns_and_not_its_images(ray, stages):
    rows = [{"key": f"p{n}", "left": b"l", "right": b"r", "city": "Mainz"} for n in range(2)]
    ds = ray.ours.depth_dataset(LocalDataset(rows, ray.asked), workers=ray.ours.Workers(2), prior="a/b")
    result = {"unit": "m", "verdict": "trusted", "error": None}
    assert ds.rows == [{"key": f"p{n}", "city": "Mainz"} | result for n in range(2)]
    assert stages[0].prior == "a/b"
    assert len(ray.asked) == 4 and ray.asked[-1][1]["batch_format"] == "pyarrow"


def test_a_full_disk_ends_the_run_in_any_stage(ray, stages):
    import errno

    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    row = {"key": "a", "error": None, "geodiff_state": pickle.dumps(1)}
    with pytest.raises(DiskFull):
        ray.ours.attempt(row, full)
    with pytest.raises(DiskFull):
        ray.ours._read(full, {"key": "a"})
    failed = row | {"error": "before"}
    assert ray.ours.attempt(failed, full) == ({"key": "a", "error": "before"}, None)
    assert ray.ours.attempt(row, lambda value: value + 1) == ({"key": "a", "error": None}, 2)
    for error, said in ((OSError("gone"), "gone"), (ValueError("bad"), "bad"), (InputError("no"), "no")):
        assert ray.ours._message(error) == said


def test_actors_do_the_work_of_every_key(ray):
    made = []

    def make():
        made.append(1)

        def work(key):
            if key == "b":
                raise InputError("b is torn")
            return {"square": ord(key) ** 2}

        return work

    done = list(ray.ours.on_actors(["a", "b", "c"], make, ray.ours.Workers(9, 0.0)))
    assert done == [
        ("a", {"square": 97**2}, None),
        ("b", None, "b is torn"),
        ("c", {"square": 99**2}, None),
    ]
    assert len(made) == 1 and ray.asked[0] == 3
    assert ray.asked[1][1]["compute"] == ("actors", {"size": 3})


def test_a_cluster_is_started_quietly_and_left_as_it_was(ray, monkeypatch):
    cluster, before = ray.cluster, replace(ray.context)
    monkeypatch.setattr(cluster, "available_cores", lambda: 5)
    with cluster.connected():
        assert os.environ["RAY_BACKEND_LOG_LEVEL"] == "fatal"
        assert ray.started[0]["num_cpus"] == 5 and ray.started[0]["log_to_driver"] is False
        assert ray.started[0]["include_dashboard"] is False
        assert not ray.context.enable_progress_bars and not ray.context.print_on_execution_start
        assert ray.context.raise_original_map_exception
    assert ray.started[1:] == ["shutdown"] and ray.context == before
    assert "RAY_BACKEND_LOG_LEVEL" not in os.environ
    with cluster.connected():  # it is there already
        assert len(ray.started) == 2
    assert len(ray.started) == 2
    ray.started.clear()
    monkeypatch.setenv("RAY_ADDRESS", "auto")
    monkeypatch.setenv("RAY_BACKEND_LOG_LEVEL", "info")
    with cluster.connected():
        assert "num_cpus" not in ray.started[0] and os.environ["RAY_BACKEND_LOG_LEVEL"] == "info"
    assert os.environ["RAY_BACKEND_LOG_LEVEL"] == "info"


def test_what_ends_a_run_on_ray_is_an_input_error(ray, monkeypatch):
    cluster = ray.cluster
    caused = RayError("task failed")
    caused.cause = InputError("no such prior")
    full = RayError("task failed")
    full.__cause__ = OSError(28, "No space left on device")
    for error, said in (
        (RayError("first\nthe worker died\n"), r"Ray ended the run \(the worker died\)"),
        (caused, "^no such prior$"),
        (full, "The disk of --out is full"),
    ):
        with pytest.raises(InputError, match=said), cluster.connected():
            raise error
    with pytest.raises(ValueError, match="a defect"), cluster.connected():
        raise ValueError("a defect")
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="Start it once, without RANK"), cluster.connected():
        pass


def test_records_of_items_are_made_where_they_are_missing(ray, tmp_path):
    items, reported, asked = [Item(key) for key in "abcd"], [], []

    def make():
        def work(key):
            asked.append(key)
            if key == "c":
                raise InputError("c is torn")
            return {"made": key}

        return work

    with Journal(tmp_path / "job.jsonl") as journal:
        journal.put(items[0], {"made": "before"})
        work = partial(ray.cluster.items_on_actors, make, SimpleNamespace(workers=2, gpus=0.0))
        records = Runner(items, journal, progress=False).run_elsewhere(work, reported.append)
        assert asked == ["b", "c", "d"]
        assert [record.get("made") for record in records] == ["before", "b", None, "d"]
        assert records[2] == {"key": "c", "status": BROKEN, "error": "c is torn"}
        assert reported == ["geodiff: c: c is torn"]
        again = Runner(items[:2], journal, progress=False).run_elsewhere(work, reported.append)
        assert [record["made"] for record in again] == ["before", "b"] and asked == ["b", "c", "d"]


def test_pairs_become_folders_with_the_options_of_a_run_without_ray(ray, stages, tmp_path, monkeypatch):
    cluster, written = ray.cluster, []
    monkeypatch.setattr(cluster, "imported", lambda where: lambda prior: written.append((where, prior)))

    def folder_of(pair):
        written.append(pair.options)
        return {"verdict": "trusted", "near_m": 1.5}

    monkeypatch.setattr(cluster, "_write_once", folder_of)
    items = [Item(ref.name, ref) for ref in refs(4)]
    with Journal(tmp_path / "job.jsonl") as journal:
        runner = Runner(items, journal, progress=False)
        records = runner.run_elsewhere(partial(cluster.pairs_to_folders, OPTIONS))
    assert written[0] == ("priors.find_prior", "bundled")
    alone = replace(OPTIONS, engine="local", format=None, workers=None, gpus=None)
    assert written[1:] == [alone] * 3 and stages == [alone]
    assert [record["key"] for record in records] == ["p0", "p1", "p2", "p3"]
    assert records[0]["verdict"] == "trusted" and records[3]["status"] == BROKEN
    assert not {"error", "geodiff_state"} & set(records[0])


def test_a_folder_that_a_lost_attempt_has_written_stays(ray, tmp_path, monkeypatch):
    cluster, asked = ray.cluster, []
    monkeypatch.setattr(cluster, "finished_row", lambda options: asked.append(options) or {"near_m": 1.0})
    monkeypatch.setattr(cluster, "write_row", lambda folder, run: {"near_m": 2.0, "of": run})
    options = replace(OPTIONS, out=tmp_path / "out", left=tmp_path / "left.png")
    run = SimpleNamespace(options=options)
    assert cluster._write_once(run) == {"near_m": 1.0} and asked == [options]
    run.options = replace(options, overwrite=True)
    assert cluster._write_once(run) == {"near_m": 2.0, "of": run} and len(asked) == 1
    monkeypatch.setattr(cluster, "finished_row", lambda options: None)
    run.options = options
    assert cluster._write_once(run)["near_m"] == 2.0


@pytest.mark.parametrize(("pairs", "workers", "size"), [(6, 2, 4), (100, 2, 13), (520, 1, 64), (5, 9, 4)])
def test_rows_of_parquet_files_are_counted_as_they_are_written(
    ray, stages, monkeypatch, pairs, workers, size
):
    cluster, begun = ray.cluster, []

    class Store:
        uri = "s3://out"

        @classmethod
        def of(cls, options):
            return cls()

        def begin(self, options):
            begun.append(options)
            return {"p0", "p2", "other"}

        def put(self, table):
            return table

    monkeypatch.setattr(cluster, "imported", lambda where: lambda prior: None)
    monkeypatch.setattr(cluster, "Store", Store)
    options = replace(OPTIONS, workers=workers, gpus=0.0, format="parquet")
    result = cluster.pairs_to_parquet(options, refs(pairs))
    failed = {f"p{n}" for n in range(pairs) if n % 10 in (3, 5)}
    assert set(result.failed) == failed and result.failed["p3"] == "p3 is torn"
    assert (result.uri, result.kept, result.done) == ("s3://out", 2, pairs - 2 - len(failed))
    assert result.not_trusted == 0
    assert begun == [replace(options, engine="local", format=None, workers=None, gpus=None)]
    assert ray.asked[-1][1]["batch_size"] == size

    result = cluster.ParquetResult("uri", 0)
    for verdict in ("trusted", "not trusted", "not judged"):
        cluster._count({"key": "a", "error": None, "verdict": verdict}, result, Failures(3, "pair", print))
    assert (result.done, result.not_trusted) == (3, 2)


def test_nothing_is_shown_nor_fixed_unless_the_caller_asks_for_it(ray, stages, monkeypatch, tmp_path):
    """The declared defaults: no bar, and as many actors, with as many GPUs, as the cluster has."""
    cluster, bars = ray.cluster, []
    assert inspect.signature(cluster.pairs_to_parquet).parameters["progress"].default is False
    own = cluster.tqdm
    monkeypatch.setattr(
        cluster, "tqdm", lambda **reported: bars.append(reported) or own(**reported | {"disable": True})
    )
    monkeypatch.setattr(cluster, "imported", lambda where: lambda prior: None)
    for disable in (True, False):
        with cluster._bar(3, 1, not disable):
            pass
    assert [bar["disable"] for bar in bars] == [True, False]
    assert all((bar["total"], bar["initial"], bar["file"]) == (3, 1, sys.stderr) for bar in bars)
    workers = ray.ours.Workers()
    assert (workers.count, workers.gpus) == (None, None)
    assert inspect.signature(ray.ours.depth_dataset).parameters["workers"].default == workers
    result = cluster.ParquetResult("uri", 4)
    assert (result.kept, result.done, result.not_trusted, result.failed) == (4, 0, 0, {})
    assert cluster.ParquetResult("uri", 4).failed is not result.failed
