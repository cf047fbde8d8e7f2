"""The kernels of a first guided call are compiled before it, by all cores."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin._internal import compilation as _compilation
from geodiff_plugin._internal.compilation import Launch, compile_kernels, read_launches
from geodiff_plugin._internal.kernels import has_triton

CUDA = torch.device("cuda")


@pytest.fixture
def compiled(monkeypatch):
    """What is compiled, in place of compiling it."""
    done: list[tuple[str, int]] = []
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: f"compiles on {device}")
    monkeypatch.setattr(torch.cuda, "device", lambda device: _CurrentDevice(device))
    monkeypatch.setattr(Launch, "compile", lambda self: done.append((self.kernel, _CurrentDevice.now)))
    return done


class _CurrentDevice:
    """The device that is the current one inside."""

    now = None

    def __init__(self, device):
        self._device = device

    def __enter__(self):
        _CurrentDevice.now = self._device

    def __exit__(self, *error):
        _CurrentDevice.now = None


def test_all_are_compiled_on_the_device_of_the_call_after_the_user_was_notified(compiled, monkeypatch):
    monkeypatch.setattr(_compilation, "available_cores", lambda: 1)
    reported = []
    compile_kernels(torch.device("cuda", 1), lambda line: reported.append((line, len(compiled))))
    assert reported == [("compiles on cuda:1", 0)]
    assert sorted(compiled, key=str) == sorted(
        ((launch.kernel, torch.device("cuda", 1)) for launch in read_launches()), key=str
    )


def test_nothing_is_compiled_where_triton_has_done_so(compiled, monkeypatch):
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: None)
    compile_kernels(CUDA, lambda line: pytest.fail(line))
    assert compiled == []


def test_a_kernel_that_does_not_compile_is_left_to_the_call(compiled, monkeypatch):
    kept = Launch.compile

    def failing(self):
        if self.kernel == "solve_kernel":
            raise RuntimeError("out of registers")
        kept(self)

    monkeypatch.setattr(Launch, "compile", failing)
    compile_kernels(CUDA, lambda line: None)
    names = {launch.kernel for launch in read_launches()}
    assert {name for name, _ in compiled} == names - {"solve_kernel"} and "solve_kernel" in names


def test_a_launch_gives_triton_types_numbers_and_options(monkeypatch):
    asked = []
    kernel = SimpleNamespace(warmup=lambda *arguments, **options: asked.append((arguments, options)))
    monkeypatch.setattr(_compilation, "imported", {"matching.kernels.paths_kernel": kernel}.__getitem__)
    Launch(
        "matching.kernels", "paths_kernel", ["float32", 16, 0.5], {"DOWN": [1, 0], "num_warps": 4}
    ).compile()
    assert asked == [((torch.float32, 16, 0.5), {"grid": (1,), "DOWN": (1, 0), "num_warps": 4})]


def _run(*arguments: str) -> str:
    """The benchmark in a process without Triton's interpreter."""
    environment = {name: value for name, value in os.environ.items() if name != "TRITON_INTERPRET"}
    command = [sys.executable, "-m", "tests.benchmarks.first_launches", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_the_list_is_what_a_guided_call_launches():
    assert _run().split()[0] == str(len(read_launches()))


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_all_compile_in_threads_without_a_card():
    assert f" {len(read_launches())} kernels in " in _run("--compile", "2")
