"""Nothing between the first denoising step and the last waits for the device.

torch has no second device on every machine that runs the tests. ``meta`` is the device whose name needs no
driver, so tensors claim to lie there; what they hold is computed by the CPU, operation by operation.
"""

from __future__ import annotations

import copy
import traceback
from collections import Counter
from contextlib import contextmanager, nullcontext
from dataclasses import fields, is_dataclass

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from geodiff_plugin import GeometryGuidance, enable_geometry_guidance

THERE = torch.device("meta")
#: Operations whose result has a size, or is a number, that only the device knows.
READ_BACK = (
    "aten::_local_scalar_dense",
    "aten::equal",
    "aten::is_nonzero",
    "aten::masked_select",
    "aten::nonzero",
    "aten::repeat_interleave.Tensor",
    "aten::_linalg_check_errors",
    "aten::_unique2",
    "aten::unique_dim",
)
HOSTS = ("geodiff_plugin", "diffusers", "transformers", "kornia")


class There(Tensor):
    """A tensor that says it lies on ``THERE``; ``here`` is what it holds."""

    @staticmethod
    def __new__(cls, here):
        layout = here.size(), here.stride(), here.storage_offset()
        return Tensor._make_wrapper_subclass(cls, *layout, dtype=here.dtype, device=THERE)

    def __init__(self, here):
        self.here = here

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        raise AssertionError(f"{func} outside of the mode that counts")


class Waits(TorchDispatchMode):
    """Runs what is asked of tensors over there; counts, while ``counts``, the waits by kind and line.

    ``"read back"`` is a number or a size, ``"to here"`` a copy from the device, ``"to there"`` a copy to it,
    which is a constant made anew. A copy either way waits for all that the device was told before.
    """

    def __init__(self):
        super().__init__()
        self.found: Counter = Counter()
        self.counts = False

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        given = [t for t in tree_leaves((args, kwargs)) if isinstance(t, There)]
        asked = kwargs.get("device")
        there = bool(given) if asked is None else torch.device(asked).type == THERE.type
        tensors = [t for t in tree_leaves(args) if isinstance(t, Tensor)]
        if any(t.device == THERE and not isinstance(t, There) for t in tensors):
            raise AssertionError(f"a constant made of a list over there, before {func}, at {self.line()}")
        if self.counts:
            self._notice(func.name(), args, bool(given), there)
        if asked is not None:
            kwargs["device"] = torch.device("cpu")
        args, kwargs = tree_map(lambda t: t.here if isinstance(t, There) else t, (args, kwargs))
        known = {id(t.here): t for t in given}  # an operation in place gives what it was given

        def put(t):
            return known.get(id(t), There(t)) if isinstance(t, Tensor) else t

        result = func(*args, **kwargs)
        return tree_map(put, result) if there else result

    def _notice(self, name, args, given, there):
        if given and (name in READ_BACK or (name.startswith("aten::index") and by_mask(args))):
            self.found["read back", self.line()] += 1
        elif name in ("aten::_to_copy", "aten::copy_"):
            is_new = name == "aten::_to_copy"
            source, target = args[0] if is_new else args[1], there if is_new else isinstance(args[0], There)
            if isinstance(source, There) != target:
                self.found["to there" if target else "to here", self.line()] += 1

    @staticmethod
    def line():
        """The innermost line of the package or of its hosts."""
        stack = reversed(traceback.extract_stack())
        where = next((f for f in stack if any(f"/{name}/" in f.filename for name in HOSTS)), None)
        return where and f"{where.filename.rpartition('/')[2]}: {where.line}"


def by_mask(args):
    return any(t.dtype in (torch.bool, torch.uint8) for t in tree_leaves(args[1]) if isinstance(t, Tensor))


def put_there(value):
    """A tensor, or a copy of what holds tensors, on the pretended device."""
    if isinstance(value, Tensor):
        return There(value)
    if is_dataclass(value) and not isinstance(value, type):
        twin = copy.copy(value)
        for part in fields(value):
            object.__setattr__(twin, part.name, put_there(getattr(value, part.name)))
        return twin
    if isinstance(value, tuple):
        parts = [put_there(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    if isinstance(value, dict):
        return {key: put_there(part) for key, part in value.items()}
    return value


class Reached(Exception):
    """The loop is over."""


@contextmanager
def pretended(pipe, guidance, monkeypatch):
    """A pipeline whose networks lie over there; its call raises ``Reached`` where its steps are over.

    Counted from the first call of the network to there. Evidence is made here and put there: it is made once
    a call, and its constants come from lists, which torch copies to no device that is none.
    """
    waits, prepare = Waits(), guidance.prepare

    def over(*_):
        raise Reached

    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no such device
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)
    monkeypatch.setattr(torch, "get_autocast_dtype", lambda *_: torch.float32)
    monkeypatch.setattr(guidance, "prepare", lambda lefts: [put_there(e) for e in prepare(lefts.here)])
    monkeypatch.setattr(type(pipe), "decode_prediction", over)
    pipe.unet.register_forward_pre_hook(lambda *_: setattr(waits, "counts", True))
    with waits:
        modules = [m for m in pipe.components.values() if isinstance(m, torch.nn.Module)]
        for part in (part for module in modules for part in module.modules()):
            for name, tensor in part._parameters.items():
                if tensor is not None:
                    part._parameters[name] = torch.nn.Parameter(There(tensor.detach()), False)
            for name, tensor in part._buffers.items():
                part._buffers[name] = None if tensor is None else There(tensor)
        yield waits


@pytest.mark.parametrize(
    "knobs",
    [
        {"inner_steps": 1},
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"gradient": "full", "inner_steps": 1}, marks=pytest.mark.slow),
    ],
)
def test_no_step_waits(make_pipeline, textured_plane, monkeypatch, knobs):
    pair, pipe = textured_plane, enable_geometry_guidance(make_pipeline())
    guidance = GeometryGuidance(pair.right, pair.K, pair.E, **knobs)
    with pretended(pipe, guidance, monkeypatch) as waits, pytest.raises(Reached):
        pipe(pair.left, guidance=guidance, num_inference_steps=2)
    assert waits.counts and not waits.found


def test_what_waits_is_found():
    """A read-back, a mask and a copy, as a step may come to hold them."""
    with Waits() as waits:
        x = There(torch.rand(4, 4))
        waits.counts = True
        float(x.mean())
        x[x > 0.5]
        x.cpu()
    assert waits.found == {("read back", None): 2, ("to here", None): 1}
