"""The commands: which function each runs with which options, and what they default to."""

import io
import os
import sys
from dataclasses import MISSING, FrozenInstanceError, fields
from pathlib import Path

import pytest
from PIL import Image

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cli import app as module
from geodiff_plugin.cli.app import COMMANDS, main
from geodiff_plugin.evaluation.options import COMMANDS as EVALUATIONS


@pytest.fixture
def called(monkeypatch):
    """What would be imported and called, with its arguments."""
    calls = []

    def imported(where):
        def function(*arguments, **named):
            calls.append((where, arguments, named))

        return function

    monkeypatch.setattr(module, "_imported", imported)
    return calls


def run(*words) -> int:
    with pytest.raises(SystemExit) as leaving:
        main([str(word) for word in words])
    return leaving.value.code or 0


@pytest.fixture
def pair(tmp_path, monkeypatch):
    """A pair in the working directory, and folders with two."""
    monkeypatch.chdir(tmp_path)
    for number, side in enumerate(("left", "right")):
        image = Image.new("RGB", (40, 36), (90 * number, 40, 0))
        image.save(f"{side}.png")
        Path(side).mkdir()
        for name in "ab":
            image.save(f"{side}/{name}.png")
    return tmp_path


CAMERA = ["--fx", "500", "--baseline", "0.1"]


def test_depth_of_one_pair_holds_its_folder_while_it_runs(pair, called):
    assert run("depth", "left.png", "right.png", *CAMERA, "--seed", 3) == 0
    ((where, (options, folder, started), named),) = called
    assert where == "cli.run.run_depth" and named == {}
    assert (options.left, options.right, options.seed) == (Path("left.png"), Path("right.png"), 3)
    assert options.out == folder.path == Path("geodiff-out") and isinstance(started, float)
    Path("geodiff-out").mkdir()
    Path("geodiff-out/file").write_text("text")
    assert run("depth", "left.png", "right.png", *CAMERA) == 0
    assert called[-1][1][0].out not in (Path("geodiff-out"), None)


@pytest.mark.parametrize(
    ("words", "where"),
    [
        ([], "cli.run.run_many"),
        (["--engine", "ray"], "cli.run.run_parquet"),
        (["--engine", "ray", "--format", "parquet"], "cli.run.run_parquet"),
        (["--engine", "ray", "--format", "folders"], "cli.run.run_many"),
    ],
)
def test_depth_of_folders_is_that_of_many_pairs(pair, called, words, where, capsys):
    assert run("depth", "left", "right", *CAMERA, *words) == 0
    ((found, (options, refs), _),) = called
    assert found == where and options.out == Path("geodiff-out")
    assert [ref.name for ref in refs] == ["a", "b"]
    assert run("depth", "left", "right", *CAMERA, *words, "-o", "mine") == 0
    assert called[-1][1][0].out == Path("mine")


def test_assumed_pairing_is_reported_unless_quiet(pair, called, capsys):
    for path in Path("right").iterdir():
        path.rename(path.with_name(f"r{path.name}"))
    assert run("depth", "left", "right", *CAMERA) == 0
    assert "paired by position" in capsys.readouterr().err
    assert run("depth", "left", "right", *CAMERA, "--quiet") == 0
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["left.png", "right.png", "--tolerance", "0.1"], "--tolerance needs a bag as LEFT"),
        (["left.png", "right.png", "--left-topic", "/a"], "--left-topic needs a bag as LEFT"),
        (["left.png", "right.png", "--encoding", "32FC1"], "--encoding needs a bag as LEFT"),
        (["left", "right", "--right-topic", "/a"], "--right-topic needs a bag as LEFT"),
        (
            ["left.png", "right.png", "--temporal-smoothing"],
            "--temporal-smoothing needs a sequence of frames",
        ),
        (["left.png", "right.png", "--shard", "0/2"], "--shard needs many pairs"),
        (["left.png", "right.png", "--engine", "ray"], "--engine needs many pairs"),
    ],
)
def test_options_of_other_inputs_are_rejected(pair, called, words, said, capsys):
    assert run("depth", *words, *CAMERA) == 2
    assert said in capsys.readouterr().err and called == []


def test_a_bag_is_recognised_by_its_name(pair, called):
    Path("run.mcap").write_bytes(b"bag")
    assert run("depth", "run.mcap", "--left-topic", "/a", "--right-topic", "/b", "--tolerance", "0.1") == 0
    ((where, (options,), _),) = called
    assert where == "cli.run.run_bag" and (options.left_topic, options.tolerance) == ("/a", 0.1)


def test_the_demo_runs_on_the_bundled_pairs(tmp_path, monkeypatch, called):
    monkeypatch.chdir(tmp_path)
    assert run("demo") == 0
    where, (options, folder), _ = called[-1]
    bundled = Path(module.__file__).resolve().parents[1] / "bundled"
    assert where == "cli.demo.run_demo" and folder.path == Path("geodiff-demo")
    assert (options.left, options.right) == (bundled / "pair/left.png", bundled / "pair/right.png")
    assert options.calib == (bundled / "pair/calib.txt",) and options.device == "cpu"
    assert not options.quiet and not options.overwrite
    assert run("demo", "--real", "--quiet", "--overwrite", "-o", "mine") == 0
    where, (pairs, out), _ = called[-1]
    assert where == "cli.demo.run_real_demo" and out == Path("mine")
    assert len(pairs) == 3 and [each.left.parent for each in pairs] == sorted(
        path for path in (bundled / "real").iterdir() if path.is_dir()
    )
    assert all(
        each.quiet and each.overwrite and each.left.is_file() and each.calib[0].is_file() for each in pairs
    )


#: Commands: what is typed, the function that runs, and the values that it gets.
TYPED = {
    "info": ([], "cli.info.run_info", {"prior": None, "space": None, "parameters": False}),
    "video": (
        ["a", "b.npy"],
        "cli.results.run_video",
        {
            "frames": (Path("a"), Path("b.npy")),
            "out": Path("depth.webp"),
            "fps": 10.0,
            "near": None,
            "far": None,
            "overwrite": False,
        },
    ),
    "merge": (["out"], "cli.results.run_merge", {"folder": Path("out"), "json": False}),
    "submit": (
        ["a", "--to", "eth3d", "-o", "z"],
        "cli.results.run_submit",
        {"results": (Path("a"),), "to": "eth3d", "out": Path("z"), "method": "GeoDiff"},
    ),
    "app": (
        [],
        "app.launch.run_app",
        {
            "prior": ("bundled",),
            "device": "auto",
            "dtype": "float32",
            "host": "127.0.0.1",
            "port": None,
            "browser": False,
        },
    ),
    "convert": (
        ["a", "b"],
        "cli.results.run_convert",
        {"paths": (Path("a"), Path("b")), "part": None, "space": None},
    ),
}


@pytest.mark.parametrize("name", TYPED)
def test_a_command_passes_its_options_by_name_with_their_defaults(called, name):
    words, where, values = TYPED[name]
    assert run(name, *words) == 0
    assert called == [(where, (), values)]


@pytest.mark.parametrize(
    ("words", "name", "value"),
    [
        (["info", "--prior", "a/b"], "prior", "a/b"),
        (["info", "--space", "log"], "space", "log"),
        (["info", "--parameters"], "parameters", True),
        (["video", "a", "--near", "1.5"], "near", 1.5),
        (["video", "a", "--far", "9"], "far", 9.0),
        (["video", "a", "--fps", "25", "--overwrite"], "overwrite", True),
        (["merge", "a", "--json"], "json", True),
        (["submit", "a", "--to", "middlebury", "-o", "z", "--method", "Mine"], "method", "Mine"),
        (["app", "--prior", "a", "--prior", "b"], "prior", ("a", "b")),
        (["app", "--port", "65535"], "port", 65535),
        (["app", "--port", "1", "--host", "0.0.0.0", "--browser"], "port", 1),
        (["convert", "a", "b", "--with", "c"], "part", "c"),
        (["convert", "a", "b", "--space", "depth"], "space", "depth"),
    ],
)
def test_what_is_typed_takes_the_place_of_a_default(called, words, name, value):
    assert run(*words) == 0
    assert called[0][2][name] == value


@pytest.mark.parametrize(
    "words",
    [
        ["app", "--port", "0"],
        ["app", "--port", "65536"],
        ["submit", "a", "--to", "kitti", "-o", "z"],
        ["info", "--space", "metres"],
        ["submit", "a", "--to", "eth3d"],
        ["video"],
    ],
)
def test_what_an_option_cannot_be_ends_with_code_2_before_the_work(called, words, capsys):
    assert run(*words) == 2
    assert called == [] and capsys.readouterr().err


def test_bench_and_capture_get_their_options_as_one(called):
    assert run("bench", "--prior", "a/b", "--steps", 3, "--cuda-graphs") == 0
    where, (options,), _ = called[-1]
    assert where == "cli.demo.run_bench"
    assert (options.prior, options.steps, options.cuda_graphs, options.no_triton) == ("a/b", 3, True, False)
    assert run("capture", "scan", "--neighbours", 3) == 0
    where, (options,), _ = called[-1]
    assert where == "cli.run.run_capture" and (options.path, options.neighbours) == (Path("scan"), 3)


CLASSES = [command.options for command in (*COMMANDS.values(), *EVALUATIONS.values()) if command.options]


@pytest.mark.parametrize("kind", sorted(set(CLASSES), key=lambda kind: kind.__name__))
def test_options_are_given_by_name_and_do_not_change(kind):
    """A new option does not shift those of a class that has it from another."""
    needed = {field.name: Path("x") for field in fields(kind) if field.default is MISSING}
    needed |= {"to": "eth3d"} if "to" in needed else {}
    with pytest.raises(TypeError):
        kind(*needed.values(), None)
    try:
        made = kind(**needed)
    except (InputError, TypeError):
        return  # it needs more than paths
    for field in fields(kind):
        with pytest.raises(FrozenInstanceError):
            setattr(made, field.name, None)


def test_a_command_imports_with_threads_that_sleep(monkeypatch):
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert module._imported("jobs.options.DepthOptions").__name__ == "DepthOptions"
    assert os.environ["OMP_WAIT_POLICY"] == "PASSIVE"
    monkeypatch.setenv("OMP_WAIT_POLICY", "ACTIVE")
    module._imported("jobs.options.DepthOptions")
    assert os.environ["OMP_WAIT_POLICY"] == "ACTIVE"


def test_the_version_is_that_of_the_package(capsys):
    from importlib.metadata import version

    assert run("--version") == 0
    assert capsys.readouterr().out == f"geodiff-plugin {version('geodiff-plugin')}\n"


def test_a_name_that_the_terminal_cannot_show_is_written_out(monkeypatch):
    """In a terminal of ASCII."""
    shown = {name: io.TextIOWrapper(io.BytesIO(), encoding="ascii") for name in ("stdout", "stderr")}
    for name, stream in shown.items():
        monkeypatch.setattr(sys, name, stream)
    assert run("depth", "ümlaut.png", "right.png", *CAMERA) == 2
    shown["stderr"].flush()
    assert b"\\xfcmlaut.png" in shown["stderr"].buffer.getvalue()
