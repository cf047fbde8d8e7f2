"""Many pairs on a real Ray of two workers: the files of one process, whatever breaks on the way."""

import contextlib
import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from PIL import Image

ray = pytest.importorskip("ray", reason="ray is in the extra ray")
psutil = pytest.importorskip("psutil")
pq = pytest.importorskip("pyarrow.parquet")
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("default")]

from geodiff_plugin import InputError  # noqa: E402
from geodiff_plugin.cli.app import main  # noqa: E402
from geodiff_plugin.formats.depth import depth_mm  # noqa: E402
from geodiff_plugin.jobs.options import DepthOptions  # noqa: E402
from geodiff_plugin.jobs.ray import Workers, depth_dataset  # noqa: E402
from geodiff_plugin.jobs.rows import COLUMNS  # noqa: E402
from tests.benchmarks.engines import folders_done, rows_done  # noqa: E402
from tests.evaluating import write_scenes  # noqa: E402
from tests.tiny import plane_pair  # noqa: E402
from tests.unit.capture_room import render, walk, write_transforms  # noqa: E402

#: With 16 pairs a task of two workers reads more than one.
PAIRS, FEW, SIZE = 16, 8, (64, 96)
FRAMES = walk(10)[3:7]
QUICK = "--steps 1 --preset paper --device cpu -q".split()
RAY, RAY_OF_ONE = (["--engine", "ray", "--workers", count] for count in "21")
DONE = {"folders": folders_done, "parquet": rows_done}
LAYOUTS = tuple(DONE)
#: Of every process that computes. Ray's own are nice by 15, and would starve where the machine is busy; and
#: they would end when idle, where here the next command uses them again, without importing torch again.
ENVIRONMENT = {"OMP_NUM_THREADS": "1", "RAY_worker_niceness": "0", "RAY_kill_idle_workers_interval_ms": "0"}
#: Begins what a process of Ray that holds the prior calls itself.
ACTOR = "ray::MapWorker"


class Answer(NamedTuple):
    """Of a command: its exit code and what it printed."""

    code: int
    out: str
    err: str


class Pairs(NamedTuple):
    """Pairs of planes in ``left`` and ``right``, and in ``one`` what one process makes of them."""

    folder: Path
    cameras: dict[str, float]

    @property
    def one(self) -> Path:
        return self.folder / "one"

    def words(self) -> list[str]:
        camera = [word for name, value in self.cameras.items() for word in (f"--{name}", str(value))]
        return ["depth", str(self.folder / "left"), str(self.folder / "right"), *camera, *QUICK]


def start(words: list[str], address: str | None) -> subprocess.Popen:
    """A command in a process of its own, which uses the Ray of this address, or starts one of its own."""
    environment = {name: value for name, value in os.environ.items() if name != "RAY_ADDRESS"}
    environment |= ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(sys.path)}
    environment |= {} if address is None else {"RAY_ADDRESS": address}
    command = [sys.executable, "-m", "geodiff_plugin", *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env=environment, process_group=0, **pipes)


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """The address of a Ray with two CPUs, which the commands of this process share."""
    ours = ENVIRONMENT | {"PYTHONPATH": os.pathsep.join(sys.path)}
    before = {name: os.environ.get(name) for name in ours}
    os.environ |= ours
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield ray.get_runtime_context().gcs_address
    ray.shutdown()
    for name, value in before.items():
        os.environ.pop(name)
        if value is not None:
            os.environ[name] = value


def call(words: list[str]) -> Answer:
    """A command in this process."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(words)
        except SystemExit as leaving:
            code = int(leaving.code or 0)
    return Answer(code, out.getvalue(), err.getvalue())


@pytest.fixture(scope="module")
def many(tmp_path_factory) -> Pairs:
    folder = tmp_path_factory.mktemp("many")
    for side in ("left", "right"):
        (folder / side).mkdir()
    for number in range(PAIRS):
        pair = plane_pair(SIZE, seed=number, normal=(0.25, 0.03 * number - 0.35, 1.0))
        for side in ("left", "right"):
            Image.fromarray(getattr(pair, side)).save(folder / side / f"{number:06}.png")
    (fx, _, cx), (_, fy, cy) = pair.K[:2].tolist()
    pairs = Pairs(folder, {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "baseline": float(pair.E[0, 3])})
    answer = call([*pairs.words(), "--out", str(pairs.one)])
    assert answer.code == 0, answer.err
    return pairs


@pytest.fixture(scope="module")
def few(many, tmp_path_factory) -> Pairs:
    """The first of ``many``."""
    folder = tmp_path_factory.mktemp("few")
    for name in (f"{n:06}" for n in range(FEW)):
        shutil.copytree(many.one / name, folder / "one" / name)
        for side in ("left", "right"):
            (folder / side).mkdir(exist_ok=True)
            shutil.copy(many.folder / side / f"{name}.png", folder / side)
    return many._replace(folder=folder)


def contents(folder: Path) -> dict[str, object]:
    """Files of pairs by their names: the bytes, and of reports what does not change from run to run."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.parent != folder:
            found[str(path.relative_to(folder))] = path.read_bytes()
            if path.name == "report.json":
                found[str(path.relative_to(folder))] = unchanging(json.loads(path.read_text()))
    return found


def unchanging(report: dict) -> dict:
    """Without times and places."""
    del report["seconds"]
    for name in ("out", "left", "right"):
        del report["arguments"][name]
    report["pair"]["sha256"] = sorted(report["pair"]["sha256"].values())
    return report | {"inputs": None}


def table_of(out: Path) -> list[dict]:
    """The rows of ``pairs.csv`` without seconds."""
    with open(out / "pairs.csv", newline="") as file:
        return [
            {name: value for name, value in row.items() if name != "seconds"} for row in csv.DictReader(file)
        ]


def rows_of(out: Path) -> dict[str, dict]:
    """Rows of all Parquet files, no two of one key."""
    rows = [row for path in sorted(out.glob("*.parquet")) for row in pq.read_table(path).to_pylist()]
    assert len({row["key"] for row in rows}) == len(rows), "nothing twice"
    return {row["key"]: row for row in rows}


def check_rows(rows: dict[str, dict], pairs: Pairs) -> None:
    """Rows hold what one process wrote into folders."""
    assert sorted(rows) == sorted(path.name for path in pairs.one.iterdir() if path.is_dir())
    for key, row in rows.items():
        depth_m = np.load(pairs.one / key / "depth.npy")
        np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(row["depth_mm"]))), depth_mm(depth_m))
        report = json.loads((pairs.one / key / "report.json").read_text())
        assert row["verdict"] == report["verdict"]["status"] and row["error"] is None
        assert (row["height"], row["width"]) == depth_m.shape and row["fx"] == report["K"][0][0][0]


def check_whole(out: Path, layout: str, pairs: Pairs) -> None:
    """A folder of results holds those of one process, once each."""
    if layout == "folders":
        assert contents(out) == contents(pairs.one)
    else:
        check_rows(rows_of(out), pairs)
        assert not list(out.glob(".*")), "files that are not whole"


def results(out: Path, layout: str) -> dict[Path, int]:
    """When every result was written."""
    pattern = "*/report.json" if layout == "folders" else "part-*"
    return {path: path.stat().st_mtime_ns for path in out.glob(pattern)}


def test_folders_are_those_of_one_process_byte_for_byte(many, cluster, tmp_path):
    out = tmp_path / "out"
    words = [*many.words(), *RAY, "--format", "folders", "--out", str(out)]
    answer = call(words)
    assert answer.code == 0, answer.err
    assert contents(out) == contents(many.one) and table_of(out) == table_of(many.one)
    made = results(out, "folders")
    shutil.rmtree(out / "000003")
    answer = call(words)
    assert answer.code == 0, answer.err
    again = results(out, "folders")
    assert [path.parent.name for path in again if again[path] != made[path]] == ["000003"]
    assert contents(out) == contents(many.one)


def test_parquet_holds_the_same_depth_and_a_second_run_does_what_is_missing(few, cluster, tmp_path):
    out = tmp_path / "out"
    words = [*few.words(), *RAY_OF_ONE, "--out", str(out), "--json"]
    answer = call(words)
    assert answer.code == 0, answer.err
    assert json.loads(answer.out)["done"] == FEW
    check_whole(out, "parquet", few)
    lost = sorted(out.glob("part-*"))[0]
    missing = pq.read_table(lost)["key"].to_pylist()
    lost.unlink()
    made = results(out, "parquet")
    answer = call(words)
    assert answer.code == 0, answer.err
    reported = json.loads(answer.out)
    assert (reported["done"], reported["kept"]) == (len(missing), FEW - len(missing))
    assert made.items() <= results(out, "parquet").items()
    check_whole(out, "parquet", few)
    answer = call([*words, "--seed", "3"])
    assert answer.code == 2 and "made with --seed 0 instead of 3" in answer.err


def broken(few: Pairs, folder: Path) -> list[str]:
    """Words for a list with a torn image (1), a pair of another size (2) and one without cameras (3)."""
    for side in ("left", "right"):
        shutil.copytree(few.folder / side, folder / side)
        other = folder / side / "000002.png"
        Image.open(other).resize((160, 128)).save(other)
    torn = folder / "left" / "000001.png"
    torn.write_bytes(torn.read_bytes()[:500])
    camera = "[{fx} 0 {cx}; 0 {fy} {cy}; 0 0 1]".format(**few.cameras)
    calibration = f"cam0={camera}\ncam1={camera}\ndoffs=0\nbaseline={1000 * few.cameras['baseline']}\n"
    (folder / "calib.txt").write_text(calibration)
    lines = [f"left/{n:06}.png,right/{n:06}.png" + ("" if n == 3 else ",calib.txt") for n in range(FEW)]
    (folder / "list.csv").write_text("\n".join(lines))
    return ["depth", str(folder / "list.csv"), *QUICK]


def test_broken_rows_are_rows_with_an_error_and_the_rest_is_done(few, cluster, tmp_path):
    words = broken(few, tmp_path)
    one = call([*words, "--out", str(tmp_path / "one")])
    for layout in LAYOUTS:
        answer = call([*words, *RAY_OF_ONE, "--format", layout, "--out", str(tmp_path / layout)])
        assert answer.code == one.code == 4, answer.err
        assert "000001: LEFT must be a whole image file" in answer.err
    assert contents(tmp_path / "folders") == contents(tmp_path / "one")
    table = table_of(tmp_path / "folders")
    failed = {row["pair"]: row["message"] for row in table if row["result"] == "failed"}
    assert failed == {r["pair"]: r["message"] for r in table_of(tmp_path / "one") if r["result"] == "failed"}
    rows = rows_of(tmp_path / "parquet")
    assert {key: row["error"] for key, row in rows.items() if row["error"]} == failed
    assert list(failed) == ["000001", "000003"] and len(rows) == FEW and rows["000002"]["width"] == 160
    shutil.copy(few.folder / "left" / "000001.png", tmp_path / "left")  # mended, both are done
    listed = (tmp_path / "list.csv").read_text()
    (tmp_path / "list.csv").write_text(listed.replace("right/000003.png\n", "right/000003.png,calib.txt\n"))
    answer = call([*words, *RAY_OF_ONE, "--out", str(tmp_path / "parquet"), "--json"])
    assert json.loads(answer.out)["done"] == 2, answer.err
    rows = rows_of(tmp_path / "parquet")
    assert len(rows) == FEW and not any(row["error"] for row in rows.values())


def test_an_error_common_to_all_pairs_is_reported_once_and_leaves_no_folder(few, cluster, tmp_path):
    words = few._replace(cameras=few.cameras | {"cx": 5000.0}).words()
    answer = call([*words, *RAY_OF_ONE, "--format", "folders", "--out", str(tmp_path / "out")])
    assert answer.code == 2 and "The same holds for all 8 pairs" in answer.err, answer.err
    assert not (tmp_path / "out").exists()


def actors(driver: int) -> list[psutil.Process]:
    """The processes below a driver that hold the prior."""
    below = [(each, _words_of(each)) for each in psutil.Process(driver).children(recursive=True)]
    return [each for each, words in below if words and words[0].startswith(ACTOR)]


def _words_of(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:  # it has just ended
        return []


def when(happened: Callable[[], Any], running: Callable[[], bool], seconds: float = 900.0) -> Any:
    """What ``happened`` returns, as soon as it is something; nothing where what is running ends before."""
    end, result = time.monotonic() + seconds, happened()
    while not result and time.monotonic() < end and running():
        time.sleep(0.05)
        result = happened()
    return result


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_worker_that_is_killed_in_the_middle_costs_nothing(few, cluster, tmp_path, layout):
    out, over = tmp_path / "out", threading.Event()

    def kill() -> int:
        """Kill a process that holds the prior when the first results are there; how many those are."""
        done = when(lambda: DONE[layout](out), lambda: not over.is_set())
        actors(os.getpid())[0].send_signal(signal.SIGKILL)
        return done

    with ThreadPoolExecutor(1) as beside:
        killed = beside.submit(kill)
        try:
            answer = call([*few.words(), *RAY, "--format", layout, "--out", str(out)])
        finally:
            over.set()
    assert answer.code == 0, answer.err
    assert 0 < killed.result() < FEW
    check_whole(out, layout, few)


@pytest.mark.parametrize(("layout", "shared"), [("folders", False), ("parquet", True)])
def test_a_driver_that_is_killed_and_started_again_does_what_is_missing(
    few, cluster, tmp_path, layout, shared
):
    out = tmp_path / "out"
    words = [*few.words(), *RAY_OF_ONE, "--format", layout, "--out", str(out)]
    process = start(words, cluster if shared else None)
    begun = when(lambda: DONE[layout](out), lambda: process.poll() is None)
    left = [*actors(os.getpid()), *psutil.Process(process.pid).children(recursive=True)] if begun else []
    process.send_signal(signal.SIGKILL)
    _, err = process.communicate()
    assert begun, err
    _, alive = psutil.wait_procs(left, timeout=120)  # they end with their driver
    assert not alive
    before = results(out, layout)
    answer = call(words)
    assert answer.code == 0, answer.err
    after = results(out, layout)
    assert before.items() <= after.items() and len(after) > len(before)
    check_whole(out, layout, few)


@contextlib.contextmanager
def small_disk(folder: Path, kilobytes: int) -> Iterator[Path]:
    """A disk of its own, of this size."""
    folder.mkdir()
    size = f"size={kilobytes}k"
    if os.geteuid() != 0 or subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder]).returncode:
        pytest.skip("no file system can be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


#: A folder is not begun with less than 8 MB free.
@pytest.mark.parametrize(("layout", "kilobytes"), [("folders", 8 * 1024 + 400), ("parquet", 64)])
def test_a_full_disk_ends_the_run_with_a_sentence_and_what_is_done_stays(
    few, cluster, tmp_path, layout, kilobytes
):
    with small_disk(tmp_path / "disk", kilobytes) as disk:
        words = [*few.words(), *RAY_OF_ONE, "--format", layout, "--out", str(disk / "out")]
        answer = call(words)
        assert answer.code == 2 and "The disk of --out is full" in answer.err, answer.err
        before = results(disk / "out", layout)
        assert before and not list((disk / "out").glob(".part*"))
        subprocess.run(["mount", "-o", "remount,size=64m", str(disk)], check=True)
        answer = call(words)
        assert answer.code == 0, answer.err
        assert before.items() <= results(disk / "out", layout).items()
        check_whole(disk / "out", layout, few)


def test_a_dataset_of_bytes_and_matrices_gives_the_same_depth(few, cluster):
    size = few.cameras
    K = [[size["fx"], 0, size["cx"]], [0, size["fy"], size["cy"]], [0, 0, 1]]
    E = np.eye(4)
    E[0, 3] = size["baseline"]
    camera = {"K_left": np.ravel(K).tolist(), "E": E.ravel().tolist(), "city": "Mainz"}

    def images(key: str) -> dict[str, bytes]:
        return {side: (few.folder / side / f"{key}.png").read_bytes() for side in ("left", "right")}

    keys = ["000000", "000005"]
    rows = [{"key": key, **images(key), **camera} for key in keys]
    rows.append({"key": "torn", **images("000001"), **camera, "left": b"no image"})
    rows.append({"key": "bare", **images("000001"), "city": "Mainz"})
    how = {"steps": 1, "preset": "paper", "device": "cpu"}
    with pytest.raises(InputError, match="an option must be one of"):
        depth_dataset(ray.data.from_items(rows), tempo=3)
    ds = ray.data.from_items(rows, override_num_blocks=len(rows))
    made = {row["key"]: row for row in depth_dataset(ds, workers=Workers(1), **how).take_all()}
    for key in keys:
        millimetres = np.asarray(Image.open(io.BytesIO(made[key]["depth_mm"])))
        np.testing.assert_array_equal(millimetres, depth_mm(np.load(few.one / key / "depth.npy")))
        assert made[key]["city"] == "Mainz" and made[key]["error"] is None and "left" not in made[key]
    assert "LEFT must be" in made["torn"]["error"] and "cameras are missing" in made["bare"]["error"]
    for key in ("torn", "bare"):
        assert all(made[key][name] is None for name in set(COLUMNS) - {"error"})


def test_the_job_is_not_divided_twice(few, cluster, monkeypatch, tmp_path):
    monkeypatch.setenv("WORLD_SIZE", "2")
    answer = call([*few.words(), *RAY, "--out", str(tmp_path / "out")])
    assert answer.code == 2 and "--engine ray divides the work by itself" in answer.err


def test_cells_of_an_evaluation_are_those_of_one_process(cluster, tmp_path):
    scenes = str(write_scenes(tmp_path / "scenes", "hall", "yard"))
    words = ["eval", "pairs", scenes, *"--methods sgbm,search-only --steps 1 --device cpu -q".split()]
    records = []
    for engine in ([], RAY):
        out = tmp_path / f"{len(records)}"
        answer = call([*words, *engine, "--out", str(out)])
        assert answer.code == 0, answer.err
        lines = (out / "samples.jsonl").read_text().splitlines()
        records.append({(r := json.loads(line))["key"]: r["all_pixels"] for line in lines})
    assert records[0] == records[1] and len(records[0]) == 4


def test_frames_of_a_capture_are_those_of_one_process(cluster, tmp_path):
    pytest.importorskip("pycolmap")
    write_transforms(tmp_path / "scan", FRAMES, FRAMES)
    (tmp_path / "maps").mkdir()
    for number, E in enumerate(FRAMES):
        np.save(tmp_path / f"maps/f{number:02d}.npy", render(E)[1].astype(np.float32))
    words = ["capture", str(tmp_path / "scan"), "--prior-map", str(tmp_path / "maps"), "--frames", "f01,f02"]
    words += ["--poses", "given", *"--steps 1 --neighbours 1 --device cpu -q".split()]
    for name, engine in {"one": ["--processes", "1"], "ray": RAY_OF_ONE}.items():
        answer = call([*words, *engine, "--out", str(tmp_path / name)])
        assert answer.code in (0, 4), answer.err
    made = {path: path.stat().st_mtime_ns for path in (tmp_path / "ray").glob("*/depth_alone.npy")}
    assert len(made) == 2
    for path in made:
        assert path.read_bytes() == (tmp_path / "one" / path.relative_to(tmp_path / "ray")).read_bytes()
    (tmp_path / "ray" / "f02" / "depth_alone.npy").unlink()
    answer = call([*words, *RAY_OF_ONE, "--out", str(tmp_path / "ray")])
    assert answer.code in (0, 4), answer.err
    again = [path.parent.name for path, time_ns in made.items() if path.stat().st_mtime_ns != time_ns]
    assert again == ["f02"]


def test_options_of_a_pair_are_those_of_a_run_without_ray(few):
    from geodiff_plugin.jobs.cluster import _alone

    plain = DepthOptions(left=few.folder / "left", right=few.folder / "right", out=few.folder / "out")
    assert _alone(replace(plain, engine="ray", format="folders", workers=2, gpus=0.5)) == plain


def test_masks_of_many_pairs_are_those_of_one_process(few, cluster, tmp_path):
    masks = tmp_path / "masks"
    masks.mkdir()
    for number in range(FEW):
        valid = np.arange(SIZE[1])[None].repeat(SIZE[0], 0) < SIZE[1] // 2 + number
        Image.fromarray(np.uint8(255) * valid).save(masks / f"{number:06}.png")
    words = [*few.words(), "--mask", str(masks)]
    for name, more in (("one", []), ("ray", [*RAY, "--format", "folders"])):
        answer = call([*words, *more, "--out", str(tmp_path / name)])
        assert answer.code == 0, answer.err
    assert contents(tmp_path / "ray") == contents(tmp_path / "one")
    depth = np.load(tmp_path / "ray/000003/depth.npy")
    assert not depth[:, SIZE[1] // 2 + 3 :].any() and (depth[:, : SIZE[1] // 2 + 3] > 0).all()
