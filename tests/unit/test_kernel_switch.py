"""Whoever waits for kernels to be compiled is told so, and nobody else."""

import logging
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin import _kernels
from geodiff_plugin._kernels import ALWAYS_LAUNCHED, compilation_ahead, use_kernel, without_kernels
from geodiff_plugin.jobs import prior as jobs_prior
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.runtime import guided_call
from tests.tiny import guided_call as call_guided

CUDA = torch.device("cuda")


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """The cache of Triton, which has compiled nothing yet."""
    monkeypatch.setattr(_kernels, "has_triton", lambda: True)
    monkeypatch.setattr(torch.version, "hip", None)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_kernels_that_triton_has_not_compiled_are_told_of(cache, monkeypatch):
    assert "compiles its Triton kernels" in compilation_ahead(CUDA)
    assert compilation_ahead(torch.device("cpu")) is None
    with without_kernels():
        assert compilation_ahead(CUDA) is None
    (cache / "hash").mkdir()
    (cache / "hash/another_kernel.cubin").touch()
    assert compilation_ahead(CUDA)
    (cache / f"hash/{ALWAYS_LAUNCHED}.cubin").touch()
    assert compilation_ahead(CUDA) is None
    monkeypatch.delenv("TRITON_CACHE_DIR")
    monkeypatch.setenv("TRITON_HOME", str(cache))
    assert compilation_ahead(CUDA)
    (cache / ".triton/cache").mkdir(parents=True)
    (cache / "hash").rename(cache / ".triton/cache/hash")
    assert compilation_ahead(CUDA) is None
    monkeypatch.setattr(_kernels, "has_triton", lambda: False)
    assert compilation_ahead(CUDA) is None


@pytest.mark.parametrize(
    ("is_cuda", "hip", "triton", "interpreted", "used"),
    [
        (True, None, True, False, True),
        (True, "6.2", True, False, False),  # ROCm
        (True, None, False, False, False),
        (False, None, True, False, False),
        (False, None, True, True, True),
        (False, None, False, True, False),
    ],
)
def test_kernels_run_on_cuda_or_in_the_interpreter_unless_they_are_switched_off(
    is_cuda, hip, triton, interpreted, used, monkeypatch
):
    monkeypatch.setattr(torch.version, "hip", hip)
    monkeypatch.setattr(_kernels, "has_triton", lambda: triton)
    monkeypatch.setattr(_kernels, "interpreting", lambda: interpreted)
    tensor = SimpleNamespace(is_cuda=is_cuda)
    assert use_kernel(tensor) is used
    with without_kernels():
        assert use_kernel(tensor) is False
        with without_kernels(False):  # as of a call with kernels within one without
            assert use_kernel(tensor) is False
        assert use_kernel(tensor) is False
    assert use_kernel(tensor) is used


def test_that_kernel_is_one(cache):
    kernels = pytest.importorskip("geodiff_plugin.matching.kernels", reason="Triton is not installed")
    assert getattr(kernels, ALWAYS_LAUNCHED).__name__ == ALWAYS_LAUNCHED


@pytest.mark.parametrize("off", [False, True])
def test_a_command_tells_it_before_its_first_picture(off, cache, monkeypatch):
    monkeypatch.setattr(jobs_prior, "load_quiet_prior", lambda *_: None)
    monkeypatch.setattr(jobs_prior, "enable_geometry_guidance", lambda pipe, **_: pipe)
    told, options = [], DepthOptions(left="left.png", right="right.png", no_kernels=off)
    jobs_prior.prior_of_options(options, CUDA, told.append)
    assert len(told) == (not off)
    jobs_prior.prior_of_options(options, CUDA)  # a quiet one


def test_a_call_logs_it(pipe, textured_plane, monkeypatch, caplog):
    monkeypatch.setattr(guided_call, "compile_kernels", lambda device, tell: tell(f"compiles on {device}"))
    with caplog.at_level(logging.INFO, "geodiff_plugin"):
        call_guided(pipe, textured_plane, num_inference_steps=1)
    assert [(r.levelno, r.message) for r in caplog.records if r.name.startswith("geodiff_plugin")] == [
        (logging.INFO, "compiles on cpu")
    ]
