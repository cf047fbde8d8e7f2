"""Selection of kernels, and the notice that kernels are compiled."""

import ast
import importlib.util
import logging
import sys
from contextlib import contextmanager
from dataclasses import dataclass
from types import ModuleType, SimpleNamespace
from typing import NamedTuple

import pytest
import torch

from geodiff_plugin._internal import kernels as _kernels
from geodiff_plugin._internal.kernels import (
    ALWAYS_LAUNCHED,
    compilation_ahead,
    has_kernel,
    kernels_in_use,
    launch_bound,
    launched_on,
    use_kernel,
    without_kernels,
)
from geodiff_plugin.jobs import prior as jobs_prior
from geodiff_plugin.jobs.options import DepthOptions
from geodiff_plugin.runtime import guided_call
from tests.stages import PACKAGE, stages
from tests.tiny import guided_call as call_guided

CUDA = torch.device("cuda")


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """The cache of Triton, which has compiled nothing yet."""
    monkeypatch.setattr(_kernels, "has_triton", lambda: True)
    monkeypatch.setattr(torch.version, "hip", None)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    return tmp_path


def test_kernels_that_triton_has_not_compiled_are_reported(cache, monkeypatch):
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
    kernels = pytest.importorskip(
        "geodiff_plugin.matching.kernels.aggregation", reason="Triton is not installed"
    )
    assert getattr(kernels, ALWAYS_LAUNCHED).__name__ == ALWAYS_LAUNCHED


@pytest.mark.parametrize("off", [False, True])
def test_a_command_reports_it_before_its_first_image(off, cache, monkeypatch):
    monkeypatch.setattr(jobs_prior, "load_quiet_prior", lambda *_: None)
    monkeypatch.setattr(jobs_prior, "enable_geometry_guidance", lambda pipe, **_: pipe)
    reported, options = [], DepthOptions(left="left.png", right="right.png", no_triton=off)
    jobs_prior.prior_of_options(options, CUDA, reported.append)
    assert len(reported) == (not off)
    jobs_prior.prior_of_options(options, CUDA)  # a quiet one


def test_a_call_logs_it(pipe, textured_plane, monkeypatch, caplog):
    monkeypatch.setattr(
        guided_call, "compile_kernels", lambda device, notify: notify(f"compiles on {device}")
    )
    with caplog.at_level(logging.INFO, "geodiff_plugin"):
        call_guided(pipe, textured_plane, num_inference_steps=1)
    assert [(r.levelno, r.message) for r in caplog.records if r.name.startswith("geodiff_plugin")] == [
        (logging.INFO, "compiles on cpu")
    ]


@pytest.mark.parametrize("spec", [None, object()])
def test_triton_is_there_if_it_can_be_imported(spec, monkeypatch):
    asked = []
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: asked.append(name) or spec)
    assert _kernels.has_triton.__wrapped__() is (spec is not None) and asked == ["triton"]


@pytest.mark.parametrize(
    ("value", "interpreted"), [(None, False), ("0", False), ("true", False), ("1", True)]
)
def test_triton_interprets_by_its_environment_variable(value, interpreted, monkeypatch):
    """Then stages take the way of a device, on which launches take the time of small operations."""
    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    if value is not None:
        monkeypatch.setenv("TRITON_INTERPRET", value)
    assert _kernels.interpreting() is interpreted
    for kind, bound in (("cpu", interpreted), ("cuda", True), ("mps", True)):
        assert launch_bound(SimpleNamespace(device=torch.device(kind))) is bound


@pytest.mark.parametrize(
    ("triton", "interpreted", "cuda", "hip", "words"),
    [
        (False, True, True, None, "plain PyTorch: Triton is not installed"),
        (True, True, True, None, "Triton's interpreter on the CPU"),
        (True, True, False, None, "Triton's interpreter on the CPU"),
        (True, False, False, None, "plain PyTorch: kernels need CUDA"),
        (True, False, True, "6.2", "plain PyTorch: kernels need CUDA"),
        (True, False, True, None, "Triton on CUDA, compiled on the first call on a machine"),
    ],
)
def test_what_stages_run_by_is_put_in_words(triton, interpreted, cuda, hip, words, monkeypatch):
    monkeypatch.setattr(_kernels, "has_triton", lambda: triton)
    monkeypatch.setattr(_kernels, "interpreting", lambda: interpreted)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    monkeypatch.setattr(torch.version, "hip", hip)
    assert kernels_in_use() == words


def test_no_kernels_are_compiled_for_rocm_and_a_cache_is_looked_into_until_it_is_filled(cache, monkeypatch):
    (cache / "hash").mkdir()
    filled = cache / f"hash/{ALWAYS_LAUNCHED}.cubin"
    filled.touch()
    assert compilation_ahead(CUDA) is None
    filled.unlink()
    assert compilation_ahead(CUDA) is None, "once filled it is not looked into again"
    monkeypatch.setenv("TRITON_CACHE_DIR", str(cache / "another"))
    assert compilation_ahead(CUDA)
    monkeypatch.setattr(torch.version, "hip", "6.2")
    assert compilation_ahead(CUDA) is None


@pytest.mark.parametrize("is_cuda", [True, False])
def test_a_kernel_is_launched_on_the_device_of_its_tensor(is_cuda, monkeypatch):
    """The interpreter does not know a cooperative launch."""
    said, tensor = [], SimpleNamespace(is_cuda=is_cuda)

    @contextmanager
    def device_of(other):
        said.append(("enters", other))
        yield
        said.append(("leaves", other))

    monkeypatch.setattr(torch.cuda, "device_of", device_of)
    launched_on(tensor, lambda *given, **options: said.append((given, options)))(
        1, 2, BLOCK=3, launch_cooperative_grid=True
    )
    options = {"BLOCK": 3, "launch_cooperative_grid": True} if is_cuda else {"BLOCK": 3}
    assert said == [("enters", tensor), ((1, 2), options), ("leaves", tensor)]


def test_the_switch_is_turned_back_after_an_error():
    with pytest.raises(KeyError), without_kernels():
        raise KeyError
    assert _kernels._switched_on.get()


class Pair(NamedTuple):
    """A record whose first tensor is not its first field."""

    name: str
    values: torch.Tensor


@dataclass
class System:
    values: torch.Tensor


@has_kernel("made_up.kernels.total", when=lambda values, *, scale=1: scale < 3)
def total(values, *, scale=1):
    """The sum, scaled."""
    return "reference", values, scale


@pytest.fixture
def asked(monkeypatch):
    """Tensors for which a kernel may run; it does if they are above 0."""
    module, tensors = ModuleType("geodiff_plugin.made_up.kernels"), []
    module.total = lambda values, *, scale=1: ("kernel", values, scale)
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(_kernels, "use_kernel", lambda tensor: tensors.append(tensor) or bool(tensor > 0))
    return tensors


def test_a_stage_runs_its_kernel_where_kernels_are_used_and_it_can(asked):
    one, zero = torch.tensor(1.0), torch.tensor(0.0)
    assert total(one) == ("kernel", one, 1) and total(values=one, scale=2) == ("kernel", one, 2)
    assert total(one, scale=3) == ("reference", one, 3)
    assert total(zero, scale=2) == ("reference", zero, 2)
    assert (total.__name__, total.__doc__) == ("total", "The sum, scaled.")


def test_the_first_tensor_decides_also_one_of_a_record(asked):
    one, zero = torch.tensor(1.0), torch.tensor(0.0)
    for values, tensor in ((Pair("a", one), one), (System(zero), zero), (System(one), one)):
        asked.clear()
        assert total(values)[0] == ("kernel" if tensor is one else "reference")
        assert len(asked) == 1 and asked[0] is tensor
    with pytest.raises(TypeError, match="needs a tensor"):
        total("none")


@pytest.mark.parametrize("stage", stages(), ids=lambda stage: stage.name)
def test_a_kernel_has_the_parameters_of_its_reference(stage):
    module, _, name = stage.kernel.rpartition(".")
    tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
    (kernel,) = [each for each in tree.body if isinstance(each, ast.FunctionDef) and each.name == name]
    expected, found = stage.reference.args, kernel.args
    is_method = "." in stage.name  # whose first parameter has a name of its own in the kernel
    assert [each.arg for each in expected.args][is_method:] == [each.arg for each in found.args][is_method:]
    assert [each.arg for each in expected.kwonlyargs] == [each.arg for each in found.kwonlyargs]
    for defaults in ("defaults", "kw_defaults"):
        both = ([each and ast.unparse(each) for each in getattr(one, defaults)] for one in (expected, found))
        assert next(both) == next(both)
