"""Where kernels run, and what is compiled before a first guided call; with a card that is made up."""

import logging
from contextlib import contextmanager
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin import _compilation, _kernels
from geodiff_plugin._compilation import Launch, compile_kernels, read_launches
from geodiff_plugin._kernels import interpreting, kernels_in_use, launch_bound, launched_on

CUDA = torch.device("cuda", 1)


def test_the_interpreter_is_switched_on_by_one_value(monkeypatch):
    for value, on in (("1", True), ("0", False), ("true", False)):
        monkeypatch.setenv("TRITON_INTERPRET", value)
        assert interpreting() is on
    monkeypatch.delenv("TRITON_INTERPRET")
    assert interpreting() is False


def test_few_large_operations_pay_on_a_device_and_in_the_interpreter(monkeypatch):
    on = {kind: SimpleNamespace(device=torch.device(kind)) for kind in ("cpu", "cuda", "mps")}
    monkeypatch.setattr(_kernels, "interpreting", lambda: False)
    assert not launch_bound(on["cpu"]) and launch_bound(on["cuda"]) and launch_bound(on["mps"])
    monkeypatch.setattr(_kernels, "interpreting", lambda: True)
    assert launch_bound(on["cpu"])


@pytest.mark.parametrize(
    ("triton", "interpreted", "cuda", "hip", "said"),
    [
        (False, True, True, None, "Triton is not installed"),
        (True, True, False, None, "Triton's interpreter"),
        (True, False, False, None, "kernels need CUDA"),
        (True, False, True, "6.2", "kernels need CUDA"),
        (True, False, True, None, "Triton on CUDA"),
    ],
)
def test_it_is_said_whether_stages_run_by_kernels(monkeypatch, triton, interpreted, cuda, hip, said):
    monkeypatch.setattr(_kernels, "has_triton", lambda: triton)
    monkeypatch.setattr(_kernels, "interpreting", lambda: interpreted)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    assert said in kernels_in_use()


@pytest.mark.parametrize("is_cuda", [True, False])
def test_a_kernel_is_launched_on_the_device_of_its_tensor(monkeypatch, is_cuda):
    calls, current = [], []

    @contextmanager
    def device_of(tensor):
        current.append(tensor)
        yield
        current.pop()

    monkeypatch.setattr(torch.cuda, "device_of", device_of)
    tensor = SimpleNamespace(is_cuda=is_cuda)
    launch = launched_on(tensor, lambda *given, **named: calls.append((given, named, list(current))))
    launch(1, 2, width=3, launch_cooperative_grid=True)
    named = {"width": 3} | ({"launch_cooperative_grid": True} if is_cuda else {})
    assert calls == [((1, 2), named, [tensor])] and current == []


@pytest.fixture
def card(monkeypatch):
    """The device that is the current one in each thread, and what is compiled on it."""
    compiled, now = [], []

    @contextmanager
    def device(chosen):
        now.append(chosen)
        yield
        now.pop()

    monkeypatch.setattr(torch.cuda, "device", device)
    monkeypatch.setattr(_compilation, "available_cores", lambda: 1)  # one after the other
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: f"compiles on {device}")
    monkeypatch.setattr(Launch, "compile", lambda self: compiled.append((self.kernel, list(now))))
    return compiled


def test_all_launches_are_compiled_on_the_device_after_it_was_told(card, monkeypatch):
    told = []
    launches = read_launches()
    assert len(launches) > 5 and all(launch.module.endswith("kernels") for launch in launches)
    compile_kernels(CUDA, lambda line: told.append((line, len(card))))
    assert told == [("compiles on cuda:1", 0)]
    assert sorted(name for name, _ in card) == sorted(launch.kernel for launch in launches)
    assert all(now == [CUDA] for _, now in card)
    card.clear()
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: None)
    compile_kernels(CUDA, lambda line: told.append(line))
    assert card == [] and len(told) == 1


def test_no_more_threads_compile_than_there_are_cores_or_kernels_to_share(card, monkeypatch):
    counts, pool = [], _compilation.ThreadPoolExecutor

    def counted(count):
        counts.append(count)
        return pool(1)

    monkeypatch.setattr(_compilation, "ThreadPoolExecutor", counted)
    for cores in (3, 64):
        monkeypatch.setattr(_compilation, "available_cores", lambda cores=cores: cores)
        compile_kernels(CUDA, lambda line: None)
    assert counts == [3, 16]


def test_a_kernel_that_does_not_compile_is_left_to_the_call(card, monkeypatch, caplog):
    def fails(self):
        raise RuntimeError("no such card")

    monkeypatch.setattr(Launch, "compile", fails)
    with caplog.at_level(logging.DEBUG):
        compile_kernels(CUDA, lambda line: None)
    assert len(caplog.records) == len(read_launches())


def test_a_launch_has_types_for_tensors_values_for_numbers_and_tuples_for_lists(monkeypatch):
    asked = {}

    class Kernel:
        def warmup(self, *arguments, grid, **options):
            asked.update(arguments=arguments, grid=grid, options=options)

    def imported(where):
        asked["where"] = where
        return Kernel()

    monkeypatch.setattr(_compilation, "imported", imported)
    Launch(
        "matching.kernels", "paths_kernel", ["float32", 3, 0.5, "int64"], {"sizes": [1, 2], "warps": 4}
    ).compile()
    assert asked == {
        "where": "matching.kernels.paths_kernel",
        "arguments": (torch.float32, 3, 0.5, torch.int64),
        "grid": (1,),
        "options": {"sizes": (1, 2), "warps": 4},
    }
