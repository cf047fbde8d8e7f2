"""Devices, versions, time and memory."""

import platform
import time
from importlib.metadata import version

import numpy as np
import pytest
import torch

from geodiff_plugin.runtime import machine
from geodiff_plugin.runtime.machine import PeakMemory, pick_device, timed, versions


@pytest.fixture
def found(monkeypatch):
    """Sets what PyTorch finds on this machine."""

    def find(cards: int, apple: bool) -> None:
        monkeypatch.setattr(torch.cuda, "device_count", lambda: cards)
        monkeypatch.setattr(torch.backends.mps, "is_available", lambda: apple)

    return find


@pytest.mark.parametrize(
    ("cards", "apple", "name", "device"),
    [
        (2, True, "auto", "cuda"),
        (0, True, "auto", "mps"),
        (0, False, "auto", "cpu"),
        (2, True, "cpu", "cpu"),
        (2, False, "cuda:1", "cuda:1"),
        (1, False, "cuda", "cuda"),
        (0, True, "mps", "mps"),
    ],
)
def test_a_device_of_this_machine_is_picked(found, cards, apple, name, device):
    found(cards, apple)
    assert pick_device(name) == torch.device(device)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("cuda:2", "got 'cuda:2'. PyTorch finds 2 cuda devices"),
        ("mps", "got 'mps'. PyTorch finds no mps devices"),
        ("cpu:1", "got 'cpu:1'. PyTorch finds 1 cpu devices"),
        ("cpu:200", "got 'cpu:200'. PyTorch finds 1 cpu devices"),  # torch would read -56
        ("cuda:256", "got 'cuda:256'. PyTorch finds 2 cuda devices"),  # torch would read 0
        ("cuda:01", "must be auto, cpu, cuda, cuda:N or mps; got 'cuda:01'"),
        ("gpu", "must be auto, cpu, cuda, cuda:N or mps; got 'gpu'"),
        ("meta", "must be auto, cpu, cuda, cuda:N or mps; got 'meta'"),
    ],
)
def test_what_is_not_there_is_rejected(found, name, message):
    found(2, False)
    with pytest.raises(ValueError, match=message):
        pick_device(name)


def test_versions_are_those_of_the_installed_packages(monkeypatch):
    monkeypatch.setattr(machine, "PACKAGES", ("torch", "numpy", "no-such-package"))
    assert versions() == {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "torch": version("torch"),
        "numpy": version("numpy"),
        "no-such-package": "not installed",
    }


def test_time_is_that_of_the_call_and_of_what_it_has_asked_of_a_card(monkeypatch):
    assert 0.02 <= timed(lambda: time.sleep(0.02), torch.device("cpu")) < 5.0
    order = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda device: order.append(device) or time.sleep(0.03))
    card = torch.device("cuda", 1)
    assert timed(lambda: order.append("called"), card) >= 0.03
    assert order == ["called", card]
    timed(lambda: None, torch.device("cpu"))
    assert len(order) == 2


def test_peak_memory_is_the_increase_over_the_start_also_after_it_was_freed():
    with PeakMemory(torch.device("cpu")) as memory:
        block = np.ones(15_000_000)
        del block
        held = np.ones(10_000_000)  # 80 MB, which are still there at the end
    assert 60e6 < memory.peak_bytes < 400e6 and held[0] == 1
    assert not memory._sampler.is_alive()


def test_a_short_peak_between_start_and_end_is_sampled(monkeypatch):
    monkeypatch.setattr(machine, "SAMPLING_INTERVAL_S", 0.001)
    resident = iter([100, 700, *[300] * 100_000])
    memory = PeakMemory(torch.device("cpu"))
    memory._process = type("P", (), {"memory_info": lambda _: type("M", (), {"rss": next(resident)})()})()
    with memory:
        deadline = time.monotonic() + 5
        while len(memory._resident) < 3 and time.monotonic() < deadline:
            time.sleep(0.001)
    assert memory.peak_bytes == 600


def test_peak_memory_of_a_card_is_torchs_own_count(monkeypatch):
    asked = []
    monkeypatch.setattr(torch.cuda, "reset_peak_memory_stats", lambda device: asked.append(("reset", device)))
    monkeypatch.setattr(
        torch.cuda, "max_memory_allocated", lambda device: asked.append(("read", device)) or 77
    )
    card = torch.device("cuda", 1)
    with PeakMemory(card) as memory:
        assert asked == [("reset", card)]
    assert memory.peak_bytes == 77 and asked[1:] == [("read", card)]
    assert not memory._sampler.is_alive()
