"""The demo and what guidance costs: the pair that is measured, the scores, and where seconds go."""

import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from geodiff_plugin.bundled.demo_pair import DEMO_PAIR_FOLDER, read_demo_pair
from geodiff_plugin.cli import demo
from geodiff_plugin.jobs.options import DepthOptions
from tests.unit.cli.test_run import Result

REPORT = Result.report


def one(depth_m: np.ndarray) -> np.ndarray:
    return depth_m[None, ..., None]


@pytest.fixture
def pair():
    return read_demo_pair()


@pytest.fixture
def made(monkeypatch, pair):
    """A prior whose plain map is the inverse of the true depth; guided depth is 4 % too far."""
    asked = SimpleNamespace(priors=[], plain=[], pairs=[], sheet=None)
    ground_truth = np.where(pair.valid, pair.depth_m, 5.0)

    def plain(left, generator):
        asked.plain.append((left, generator.initial_seed()))
        return SimpleNamespace(prediction=one(2.0 / ground_truth + 0.5))

    plain.config = SimpleNamespace(prediction_type="disparity")

    def prior_of_options(options, device, notify):
        asked.priors.append((options, device, notify))
        return plain

    def depth_pair(options, pipe, *, folder, notify, progress):
        asked.pairs.append((options, pipe, folder, notify, progress))
        left = np.full((4, 5, 3), len(asked.pairs) / 10, np.float32)
        depth_m = one(ground_truth * 1.04)
        output = SimpleNamespace(prediction=depth_m, valid=depth_m > 0, measurable_m=asked.measurable_m)
        run = SimpleNamespace(output=output, inputs=SimpleNamespace(left=left))
        return SimpleNamespace(report=REPORT, run=run)

    def grid(images, titles, *, columns, cell_width, depth_ranges):
        asked.sheet = (images, titles, columns, cell_width)
        asked.ranges = depth_ranges
        return Image.new("RGB", (4, 3))

    monkeypatch.setattr(demo, "prior_of_options", prior_of_options)
    monkeypatch.setattr(demo, "depth_pair", depth_pair)
    monkeypatch.setattr(demo, "grid", grid)
    asked.ground_truth, asked.measurable_m = ground_truth, None
    return asked


def options(**more) -> DepthOptions:
    return DepthOptions(**{"left": Path("left.png"), "device": "cpu", "seed": 6} | more)


def test_the_demo_scores_the_aligned_prior_and_the_guided_depth(made, pair, tmp_path, capsys):
    folder = SimpleNamespace(path=tmp_path)
    demo.run_demo(options(), folder)
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    valid = pair.valid & (pair.depth_m > 0)
    ground_truth = pair.depth_m[valid]
    rmse = np.sqrt(np.mean((0.04 * ground_truth) ** 2))
    guided = next(line for line in lines if line[:1] == ["guided"])
    assert guided[-3:] == ["0.040", "1.000", f"{rmse:.3f}"]
    aligned = next(line for line in lines if line[:1] == ["prior,"])
    assert aligned[-3:] == ["0.000", "1.000", "0.000"], "it is right up to scale and shift"
    left, seed = made.plain[0]
    np.testing.assert_array_equal(left, pair.left)
    assert seed == 6 and made.priors[0][1] == torch.device("cpu") and made.priors[0][2] is demo.say
    ((asked, _, held, notify, progress),) = made.pairs
    assert (asked, held, notify, progress) == (options(), folder, demo.say, True)

    images, titles, columns, width = made.sheet
    assert columns is None and width == demo.CELL_WIDTH and (tmp_path / "comparison.png").is_file()
    near, far = demo.depth_range(pair.depth_m)
    assert titles == [
        "left image",
        "prior, aligned to ground truth",
        "guided",
        "ground truth",
    ]
    assert made.ranges == [(near, far)], "the colours have a bar in metres"
    np.testing.assert_array_equal(images[0], pair.left)
    expected = demo.colour_depth(pair.depth_m, near=near, far=far)
    np.testing.assert_array_equal(images[3], expected)
    np.testing.assert_array_equal(images[2], demo.colour_depth(made.ground_truth * 1.04, near=near, far=far))
    difference = np.abs(images[1].astype(float) - expected)[valid]
    assert difference.mean() < np.abs(images[2].astype(float) - expected)[valid].mean()
    demo.run_demo(options(quiet=True), folder)
    assert made.priors[1][2] is None and made.pairs[1][3:] == (demo.silent, False)


def test_real_pairs_have_a_folder_each_and_one_sheet(made, tmp_path, capsys, monkeypatch):
    taken = []

    class Held:
        def __init__(self, given):
            self.path = given.out

        def __enter__(self):
            taken.append(self.path)
            return self

        def __exit__(self, *_):
            pass

    monkeypatch.setattr(demo, "start_pair", Held)
    pairs = [options(left=Path(f"{name}/left.png")) for name in ("cycles", "hall")]
    demo.run_real_demo(pairs, tmp_path)
    assert taken == [tmp_path / "hallway", tmp_path / "hall"] and len(made.priors) == 1
    assert [asked.out for asked, *_ in made.pairs] == taken
    images, titles, columns, _ = made.sheet
    near, far = demo.depth_range(made.ground_truth * 1.04)
    assert titles == ["Hallway", "depth", "hall", "depth"] and made.ranges == [(near, far)] * 2
    assert columns == 2 and len(images) == 4
    np.testing.assert_allclose(images[0], 0.1)
    np.testing.assert_allclose(images[2], 0.2)
    np.testing.assert_array_equal(images[1], demo.colour_depth(made.ground_truth * 1.04))
    made.measurable_m = np.array([2.0])
    demo.run_real_demo(pairs, tmp_path)
    assert all(near < far <= 2.0 for near, far in made.ranges), "what is too far does not set the colours"
    said = capsys.readouterr().out
    assert f"{taken[0]}/" in said and str(tmp_path / "comparison.png") in said


def test_a_contact_sheet_that_cannot_be_written_is_reported_and_no_error(monkeypatch, capsys, tmp_path):
    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(demo, "grid", full)
    demo._write_comparison(tmp_path, [], [], [])
    assert "comparison.png could not be written (No space left on device)" in capsys.readouterr().err


@pytest.fixture
def bench(monkeypatch):
    """Calls with simulated durations: plain ones 2, 1.5 and 3 s, guided ones twice as long."""
    asked = SimpleNamespace(calls=[], enabled=None, counted=None)
    clock = iter([2.0, 1.5, 3.0, 4.0, 3.5, 3.0, 8.0, 5.0])

    def pipe(left, **given):
        asked.calls.append(given)
        return SimpleNamespace(prediction=np.ones((1, 3, 4, 1)))

    monkeypatch.setattr(demo, "load_guided_prior", lambda *given: asked.__dict__.update(load=given) or pipe)
    monkeypatch.setattr(
        demo, "enable_geometry_guidance", lambda given, **more: asked.__dict__.update(enabled=(given, more))
    )

    def count_guided_steps(given, guidance, steps):
        asked.counted = (guidance, steps)
        return 5, None

    monkeypatch.setattr(demo, "count_guided_steps", count_guided_steps)
    monkeypatch.setattr(demo, "timed", lambda call, place: (call(), next(clock))[1])
    monkeypatch.setattr(
        demo, "start_many", lambda many: asked.__dict__.update(many=many, files=files(many)) or "refs"
    )
    monkeypatch.setattr(
        demo, "depth_pairs", lambda *given, **more: asked.__dict__.update(guided=(given, more))
    )
    asked.pipe = pipe
    return asked


def files(many) -> dict[str, list[str]]:
    return {side: sorted(path.name for path in getattr(many, side).iterdir()) for side in ("left", "right")}


def test_the_bench_reports_the_fastest_calls_their_ratio_and_pairs_per_second(bench, monkeypatch, capsys):
    monkeypatch.setattr(demo, "_command_timings", lambda options, place: f"command on {place}")
    given = {"prior": "a/b", "space": "log", "steps": 3, "seed": 6, "cuda_graphs": True, "no_triton": True}
    demo.run_bench(SimpleNamespace(device="cpu", dtype="float16", **given))
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert ["plain", "1.50", "1.00"] in lines and ["guided", "3.00", "2.00"] in lines
    text = "\n".join(" ".join(line) for line in lines)
    assert "prior a/b, 5 steps" in text and "command on cpu" in text
    assert "guided 0.50 pairs/s, plain 0.80 pairs/s (ratio 0.62)" in text
    assert bench.load == ("a/b", torch.device("cpu"), "log", "float16")
    assert bench.enabled == (bench.pipe, {"cuda_graphs": True, "kernels": False})
    pair, (guidance, steps) = read_demo_pair(), bench.counted
    (rig,) = guidance.rigs
    np.testing.assert_allclose(rig.K_left, pair.rig.K_left)
    np.testing.assert_allclose(rig.E, pair.rig.E)
    assert steps == 3
    plain, guided = bench.calls[:3], bench.calls[3:6]
    assert all(call["guidance"] is None for call in plain)
    assert all(call["guidance"] is guidance for call in guided)
    assert {call["num_inference_steps"] for call in plain + guided} == {5}
    assert {call["generator"].initial_seed() for call in plain + guided} == {6}
    assert bench.calls[6:] == [{"num_inference_steps": 5}] * 4, "the plain calls on the folder"
    names = [f"{number}.png" for number in range(4)]
    assert bench.files == {"left": names, "right": names}
    many = bench.many
    assert (many.steps, many.device, many.overwrite, many.quiet) == (3, "cpu", True, True)
    assert many.calib == (DEMO_PAIR_FOLDER / "calib.txt",)
    assert bench.guided == ((many, "refs"), {"pipe": bench.pipe})


def test_the_seconds_of_a_command_are_those_of_its_report_and_the_rest(monkeypatch):
    asked, clock = [], iter([100.0, 110.5])

    def run(words, **settings):
        asked.append((words, settings))
        return SimpleNamespace(stdout=json.dumps({"seconds": {"start": 2.0, "guided call": 5.25}}))

    monkeypatch.setattr(demo.subprocess, "run", run)
    monkeypatch.setattr(demo.time, "perf_counter", lambda: next(clock))
    given = {"prior": "a/b", "space": None, "steps": 3, "seed": 0, "cuda_graphs": True, "no_triton": False}
    line = demo._command_timings(SimpleNamespace(**given), torch.device("cpu"))
    assert line == "geodiff depth: 10.5 s (start 2.0, guided call 5.2, python 3.2)"
    (words, settings) = asked[0]
    assert settings["check"] and settings["text"] and settings["capture_output"]
    assert words[1:6] == [
        "-m",
        "geodiff_plugin",
        "depth",
        *(str(DEMO_PAIR_FOLDER / f"{s}.png") for s in ("left", "right")),
    ]
    typed = " ".join(words[6:])
    assert f"--calib {DEMO_PAIR_FOLDER / 'calib.txt'} --device cpu --json --quiet --out" in typed
    assert typed.endswith("--prior a/b --steps 3 --seed 0 --cuda-graphs")
    clock = iter([0.0, 9.0])
    demo._command_timings(
        SimpleNamespace(**given | {"cuda_graphs": False, "no_triton": True, "space": "log"}), "cpu"
    )
    assert " ".join(asked[1][0]).endswith("--prior a/b --space log --steps 3 --seed 0 --no-triton")
