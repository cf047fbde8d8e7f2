"""One pair: what the pipeline is called with, what is kept of the call, and the prior that runs."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin._internal import kernels as _kernels
from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.config import PRESETS
from geodiff_plugin.jobs import actor, pair, prior
from geodiff_plugin.jobs.notices import silent
from geodiff_plugin.jobs.options import CaptureOptions, DepthOptions
from geodiff_plugin.jobs.pair import depth_pair, run_pair
from geodiff_plugin.jobs.records import JobLog, PairOrigin, ReadPair
from tests.unit.jobs import made_runs


class Pipe:
    """A pipeline that notes its calls."""

    def __init__(self, error: Exception | None = None):
        self.calls, self.bars, self.error = [], [], error
        self.scheduler, self._execution_device = SimpleNamespace(), torch.device("meta")

    def set_progress_bar_config(self, **settings):
        self.bars.append(settings)

    def __call__(self, left, **given):
        self.calls.append((left, given))
        if self.error:
            raise self.error
        return made_runs.output()


@pytest.fixture
def inputs():
    return made_runs.run().inputs


@pytest.mark.filterwarnings("ignore:Only 2 points")
def test_the_pipeline_is_called_with_the_options(inputs):
    pipe, log = Pipe(), JobLog()
    given = {
        "seed": 5,
        "steps": 7,
        "ensemble": 3,
        "resolution": 64,
        "option": ("domain=a=b",),
        "strict": True,
    }
    options = DepthOptions(left=Path("a"), dtype="float16", prior="a/b", **given)
    run = run_pair(pipe, options, inputs, log, ssim_weight=0.5)
    ((left, call),) = pipe.calls
    assert left is inputs.left and call.pop("guidance") is inputs.guidance
    expected = torch.rand(4, generator=torch.Generator().manual_seed(5))
    assert torch.equal(torch.rand(4, generator=call.pop("generator")), expected)
    assert call == {
        "domain": "a=b",
        "num_inference_steps": 7,
        "processing_resolution": 64,
        "ensemble_size": 3,
        "output_uncertainty": True,
        "strict": True,
        "ssim_weight": 0.5,
    }
    assert (run.options, run.inputs, run.log) == (options, inputs, log)
    assert run.prior == {
        "name": "a/b",
        "pipeline": "Pipe",
        "scheduler": "SimpleNamespace",
        "device": "meta",
        "dtype": "float16",
    }
    assert list(log.seconds) == ["guided call"] and log.findings == [made_runs.REMARK]
    assert pipe.bars[0]["disable"] is True and pipe.bars[-1] == {"disable": True}
    once = Pipe()
    run = run_pair(once, replace(options, ensemble=1), inputs, progress=True, num_inference_steps=2)
    assert once.calls[0][1]["output_uncertainty"] is False and once.calls[0][1]["num_inference_steps"] == 2
    assert "depth_map" not in once.calls[0][1] and once.bars[0]["disable"] is False
    assert list(run.log.seconds) == ["guided call"]
    mapped = replace(inputs, prior_map=np.ones((2, 3), np.float32))
    run_pair(once, options, mapped)
    assert once.calls[1][1]["depth_map"] is mapped.prior_map


@pytest.mark.filterwarnings("ignore:Only 2 points")
def test_what_is_not_given_is_left_to_the_pipeline(inputs):
    pipe = Pipe()
    run = run_pair(pipe, DepthOptions(left=Path("a")), inputs)
    _, call = pipe.calls[0]
    assert call.pop("guidance") is inputs.guidance
    assert call.pop("generator").initial_seed() == 0
    assert call == {
        "num_inference_steps": None,
        "processing_resolution": None,
        "ensemble_size": 1,
        "output_uncertainty": False,
        "strict": False,
    }
    assert (run.prior["name"], run.prior["dtype"]) == ("bundled", "float32")
    assert run.options.config() == PRESETS["default"]


@pytest.mark.filterwarnings("ignore:Only 2 points")
def test_the_ends_of_ranges_can_be_run_and_what_lies_beyond_cannot_be_asked_for(inputs):
    ends = {"seed": (0, 2**63 - 1), "steps": (1, 1000), "ensemble": (1, 1000), "resolution": (0, 8192)}
    for at in (0, 1):
        options, pipe = DepthOptions(left=Path("a"), **{name: end[at] for name, end in ends.items()}), Pipe()
        options.check()
        run_pair(pipe, options, inputs)
        _, call = pipe.calls[0]
        assert call["generator"].initial_seed() == ends["seed"][at]
        assert call["num_inference_steps"] == ends["steps"][at]
        assert call["ensemble_size"] == ends["ensemble"][at]
        assert call["processing_resolution"] == ends["resolution"][at]
    for name, (low, high) in ends.items():
        for value in (low - 1, high + 1):
            with pytest.raises(InputError, match=f"--{name} must be"):
                DepthOptions(left=Path("a"), **{name: value}).check()


def test_a_failed_call_leaves_no_progress_bar_and_out_of_memory_is_reported_with_the_size(inputs):
    pipe = Pipe(RuntimeError("CUDA out of memory"))
    with pytest.raises(InputError, match="A pair of 50x36 pixels"):
        run_pair(pipe, DepthOptions(left=Path("a")), inputs, progress=True)
    assert [bar["disable"] for bar in pipe.bars] == [False, True]


@pytest.mark.filterwarnings("ignore:Only 2 points")
def test_a_pair_is_read_run_and_written(inputs, monkeypatch, tmp_path):
    reported, asked, pipe = [], {}, Pipe()
    inputs.guidance.findings = [made_runs.ASSUMED, made_runs.WARNED]
    monkeypatch.setattr(pair, "read_pair", lambda options: asked.update(read=options) or inputs)
    monkeypatch.setattr(pair, "write_pair", lambda folder, run: (folder, run))

    def loads(options, device, notify):
        asked.update(load=(options, device, notify))
        return pipe

    monkeypatch.setattr(pair, "prior_of_options", loads)
    options, log = DepthOptions(left=Path("a"), device="cpu", out=tmp_path / "out"), JobLog()
    folder, run = depth_pair(options, folder="held", log=log, notify=reported.append)
    assert (
        folder == "held"
        and asked["read"] is options
        and asked["load"]
        == (
            options,
            torch.device("cpu"),
            reported.append,
        )
    )
    assert reported == [f"assumed: {made_runs.ASSUMED}"]
    assert list(log.seconds) == ["calibration", "load", "guided call"] and run.log is log
    given = Pipe()
    _, run = depth_pair(options, given, folder="held", progress=True)
    assert list(run.log.seconds) == ["calibration", "guided call"] and len(given.calls) == 1
    assert given.bars[0]["disable"] is False
    depth_pair(options, folder="held")
    assert asked["load"][2] is None, "in silence a download shows no bar"


def test_a_folder_that_is_not_given_is_taken_by_the_options(monkeypatch):
    class Held:
        def __enter__(self):
            return "held"

        def __exit__(self, *_):
            pass

    asked, inner = [], pair.depth_pair
    monkeypatch.setattr(pair, "with_folder", lambda options, default: replace(options, out=Path(default)))
    monkeypatch.setattr(pair, "start_pair", lambda options: asked.append(options) or Held())
    monkeypatch.setattr(pair, "depth_pair", lambda *given, **named: (given, named))
    log = JobLog()
    given, named = inner(DepthOptions(left=Path("a")), "pipe", log=log, notify=print, progress=True)
    assert given == (asked[0], "pipe") and asked[0].out == Path("geodiff-out")
    assert named == {"folder": "held", "log": log, "notify": print, "progress": True}


class Loaded:
    def __init__(self):
        self.bars = []

    def set_progress_bar_config(self, **settings):
        self.bars.append(settings)


@pytest.fixture
def priors(monkeypatch):
    """The prior that is found by a name, and what it is loaded with."""
    asked = SimpleNamespace(bars=[], name=None, load=None, enabled=None)

    class NoBars:
        def __enter__(self):
            asked.bars.append("off")

        def __exit__(self, *_):
            asked.bars.append("on")

    def load(device, dtype, space):
        asked.load = (device, dtype, space, list(asked.bars))
        return Loaded()

    def find(name):
        asked.name, asked.found = name, list(asked.bars)
        return SimpleNamespace(key="marigold", licence="Apache", load=load)

    monkeypatch.setattr(prior, "no_bars", NoBars)
    monkeypatch.setattr(prior, "find_prior", find)
    return asked


def test_a_prior_is_loaded_silently_and_a_download_is_reported(priors, tmp_path):
    reported = []
    loaded = prior.load_quiet_prior("a/b", torch.device("cpu"), "log", "bfloat16", (), reported.append)
    assert priors.name == "a/b" and priors.found == []
    assert priors.load == (torch.device("cpu"), torch.bfloat16, "log", ["off"])
    assert reported == ["prior: a/b (marigold; Apache)"] and loaded.bars == [{"disable": True}]
    for name, notify in (
        ("a/b", None),
        ("bundled", reported.append),
        (str(tmp_path), reported.append),
        (f"marigold:{tmp_path}", reported.append),
    ):
        priors.bars.clear()
        prior.load_quiet_prior(name, torch.device("cpu"), notify=notify)
        assert priors.found == ["off"], name
    assert priors.load[1] == torch.float32 and priors.load[2] is None
    with pytest.raises(InputError, match="--option must be an option of marigold \\(none\\); got 'domain'"):
        prior.load_quiet_prior("a/b", torch.device("cpu"), options=["domain=a"])


def test_options_of_the_call_are_those_that_the_prior_takes(priors, monkeypatch):
    class Taking(prior.DepthDiffusionPipeline):
        def __init__(self):
            pass

        def call_options(self):
            return ["domain", "mode"]

        def set_progress_bar_config(self, **settings):
            pass

    found = SimpleNamespace(key="k", licence="l", load=lambda *_: Taking())
    monkeypatch.setattr(prior, "find_prior", lambda name: found)
    prior.load_quiet_prior("a", torch.device("cpu"), options=["domain=a", "mode=b=c"])
    with pytest.raises(InputError, match="an option of k \\(domain, mode\\); got 'speed'"):
        prior.load_quiet_prior("a", torch.device("cpu"), options=["domain=a", "speed=1"])


def test_guidance_is_enabled_according_to_the_options(priors, monkeypatch):
    asked = {}

    def enable(pipe, **given):
        asked["enable"] = given
        return "guided"

    monkeypatch.setattr(prior, "enable_geometry_guidance", enable)
    compiled = []

    def compile_kernels(device, notify):

        compiled.append((device, notify, _kernels._switched_on.get()))

    monkeypatch.setattr(prior, "compile_kernels", compile_kernels)
    cpu = torch.device("cpu")
    assert prior.load_guided_prior("a/b", cpu, "sqrt_disparity", "float16") == "guided"
    assert asked["enable"] == {} and priors.load[:3] == (cpu, torch.float16, "sqrt_disparity")
    options = DepthOptions(left=Path("a"), prior="c/d", space="log", dtype="bfloat16", no_triton=True)
    assert prior.prior_of_options(options, cpu) == "guided"
    assert priors.name == "c/d" and priors.load[:3] == (cpu, torch.bfloat16, "log")
    assert asked["enable"] == {"cuda_graphs": False, "kernels": False} and compiled == [(cpu, silent, False)]
    prior.prior_of_options(replace(options, no_triton=False, cuda_graphs=True), cpu, print)
    assert asked["enable"] == {"cuda_graphs": True, "kernels": True} and compiled[1] == (cpu, print, True)
    with pytest.raises(InputError, match="'domain'"):
        prior.prior_of_options(replace(options, option=("domain=a",)), cpu)


def test_many_images_are_recorded_as_graphs_on_a_gpu():
    for graphs, device, expected in ((False, "cpu", False), (True, "cpu", True), (False, "cuda", True)):
        options = DepthOptions(left=Path("a"), cuda_graphs=graphs)
        assert prior.graphs_for_many(options, torch.device(device)) is expected


def test_an_actor_loads_its_prior_once_and_guides_with_it(monkeypatch, inputs):
    asked = []
    monkeypatch.setattr(actor, "pick_device", torch.device)
    monkeypatch.setattr(
        actor, "prior_of_options", lambda options, device: asked.append((options, device)) or "pipe"
    )
    monkeypatch.setattr(actor, "run_read_pair", lambda *given: given)
    options = DepthOptions(left=Path("a"), device="cuda")
    held = actor.PriorOfJob(options)
    assert asked == [(replace(options, cuda_graphs=True), torch.device("cuda"))]
    read = ReadPair(replace(options, seed=3), inputs, JobLog())
    assert held.guide(read) == held.guide(read) == ("pipe", read) and len(asked) == 1


def test_the_run_of_a_pair_of_many_has_its_origin(monkeypatch, inputs):
    run = made_runs.run()
    monkeypatch.setattr(pair, "run_pair", lambda *given: replace(run, prior={"name": given[0]}))
    origin = PairOrigin("a", 3, {"a.png": "digest"})
    found = pair.run_read_pair("pipe", ReadPair(run.options, run.inputs, run.log, origin))
    assert found.origin is origin and found.prior == {"name": "pipe"} and found.output is run.output


def test_the_prior_of_a_capture_is_that_of_the_options_with_graphs_on_a_gpu(tmp_path, monkeypatch):
    asked = {}
    monkeypatch.setattr(prior, "pick_device", torch.device)
    monkeypatch.setattr(prior, "load_quiet_prior", lambda *given: asked.update(load=given) or "pipe")
    monkeypatch.setattr(
        prior, "enable_geometry_guidance", lambda pipe, **given: asked.update(enable=(pipe, given))
    )
    prior.prior_of_capture(
        CaptureOptions(path=tmp_path, device="cpu", prior="a/b", space="log", dtype="float16")
    )
    assert asked["load"] == ("a/b", torch.device("cpu"), "log", "float16")
    assert asked["enable"] == ("pipe", {"cuda_graphs": False, "kernels": True})
    prior.prior_of_capture(CaptureOptions(path=tmp_path, prior_map=tmp_path, device="cuda", no_triton=True))
    assert asked["load"] == ("map", torch.device("cuda"), None, "float32")
    assert asked["enable"] == ("pipe", {"cuda_graphs": True, "kernels": False})
