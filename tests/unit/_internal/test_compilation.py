"""What is compiled ahead of a first guided call: every kernel of the table, on the right device."""

import json
import logging
import sys
import threading
from types import ModuleType, SimpleNamespace

import pytest
import torch

from geodiff_plugin._internal import compilation as _compilation
from geodiff_plugin._internal.compilation import FIRST_LAUNCHES, Launch, compile_kernels, read_launches

DEVICE = torch.device("cuda", 1)


@pytest.fixture
def warmed(monkeypatch) -> list[tuple]:
    """Compilations of made-up kernels, each with the current device of its thread."""
    made, current = [], threading.local()

    class Current:
        def __init__(self, device: torch.device) -> None:
            self.device = device

        def __enter__(self) -> None:
            current.device = self.device

        def __exit__(self, *error: object) -> None:
            current.device = None

    def warmup(*arguments, grid, **options):
        if options.get("FAILS"):
            raise RuntimeError("no compiler")
        made.append((arguments, grid, options, getattr(current, "device", None)))

    module = ModuleType("geodiff_plugin.made_up")
    module.one_kernel = SimpleNamespace(warmup=warmup)
    monkeypatch.setitem(sys.modules, "geodiff_plugin.made_up", module)
    monkeypatch.setattr(torch.cuda, "device", Current)
    return made


def test_a_launch_is_compiled_for_its_types_numbers_and_options(warmed):
    options = {"BLOCK": 512, "SIDES": [3, 4]}
    Launch("made_up", "one_kernel", ["float32", 336, 0.5, "int64"], options).compile()
    assert warmed == [((torch.float32, 336, 0.5, torch.int64), (1,), {"BLOCK": 512, "SIDES": (3, 4)}, None)]
    assert options["SIDES"] == [3, 4]


def test_the_table_of_launches_is_read_row_by_row():
    rows = json.loads(FIRST_LAUNCHES.read_text())
    found = read_launches()
    assert len(found) == len(rows) > 10
    for launch, row in zip(found, rows, strict=True):
        assert {name: getattr(launch, name) for name in row} == row and len(row) == 4
        assert ".kernels." in launch.module


def test_kernels_are_compiled_by_threads_after_a_notice_and_failures_are_left_to_the_call(
    warmed, monkeypatch, caplog
):
    reported, workers, pool = [], [], _compilation.ThreadPoolExecutor
    launches = [Launch("made_up", "one_kernel", [number], {"FAILS": number == 7}) for number in range(20)]
    monkeypatch.setattr(_compilation, "read_launches", lambda: launches)
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: f"compiles on {device}")
    monkeypatch.setattr(
        _compilation, "ThreadPoolExecutor", lambda count: workers.append(count) or pool(count)
    )
    for cores in (3, 64, 1):
        monkeypatch.setattr(_compilation, "available_cores", lambda cores=cores: cores)
        with caplog.at_level(logging.DEBUG, _compilation.__name__):
            compile_kernels(DEVICE, lambda line: reported.append((line, len(warmed))))
    assert workers == [3, 16, 1] and reported == [("compiles on cuda:1", made) for made in (0, 19, 38)]
    assert sorted(arguments[0] for arguments, *_ in warmed[:19]) == [n for n in range(20) if n != 7]
    assert {device for *_, device in warmed} == {DEVICE}
    assert [record.getMessage() for record in caplog.records] == [
        "one_kernel was not compiled in advance"
    ] * 3


def test_nothing_is_compiled_if_the_cache_has_the_kernels(warmed, monkeypatch):
    monkeypatch.setattr(_compilation, "compilation_ahead", lambda device: None)
    compile_kernels(DEVICE, pytest.fail)
    assert warmed == []
