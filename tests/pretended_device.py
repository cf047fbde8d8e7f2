"""A device that is none: tensors say they lie elsewhere, compute on the CPU, and waits are counted.

torch has no second device on every machine that runs the tests. ``meta`` is the one whose name needs no
driver, so tensors claim to lie there; what they hold is computed by the CPU, operation by operation.
"""

from __future__ import annotations

import copy
import traceback
from collections import Counter
from contextlib import contextmanager, nullcontext
from dataclasses import fields, is_dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

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


class There(Tensor):
    """A tensor that says it lies on ``THERE``; ``here`` is what it holds."""

    here: Tensor

    @staticmethod
    def __new__(cls, here: Tensor) -> There:
        return Tensor._make_wrapper_subclass(
            cls, here.size(), here.stride(), here.storage_offset(), dtype=here.dtype, device=THERE
        )

    def __init__(self, here: Tensor) -> None:
        self.here = here

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        raise AssertionError(f"{func} outside of the mode that counts")


class Waits(TorchDispatchMode):
    """Runs what is asked of tensors over there, and counts, while ``counts``, what is waited for.

    Attributes:
        found: (kind, line of the package or of its host) -> how often: ``"read back"`` a number or a size,
            ``"to here"`` a copy from the device, ``"to there"`` a copy to it, which is a constant made anew.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[tuple[str, str]] = Counter()
        self.counts = False

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        given = [t for t in tree_leaves((args, kwargs)) if isinstance(t, There)]
        asked = kwargs.get("device")
        there = bool(given) if asked is None else torch.device(asked).type == THERE.type
        if any(
            t.device == THERE and not isinstance(t, There) for t in tree_leaves(args) if isinstance(t, Tensor)
        ):
            raise AssertionError(f"a constant made of a list over there, before {func}, at {self._line()}")
        self._notice(func.name(), args, given, there)
        if asked is not None:
            kwargs["device"] = torch.device("cpu")
        args, kwargs = tree_map(lambda t: t.here if isinstance(t, There) else t, (args, kwargs))
        result = func(*args, **kwargs)
        known = {id(t.here): t for t in given}  # an operation in place gives what it was given

        def put(t: Any) -> Any:
            return (There(t) if known.get(id(t)) is None else known[id(t)]) if isinstance(t, Tensor) else t

        return tree_map(put, result) if there else result

    def _notice(self, name: str, args: Any, given: list[There], there: bool) -> None:
        if not self.counts:
            return
        if given and (name in READ_BACK or (name.startswith("aten::index") and _by_mask(args))):
            self._add("read back")
        elif name in ("aten::_to_copy", "aten::copy_"):
            source = args[0] if name == "aten::_to_copy" else args[1]
            target = there if name == "aten::_to_copy" else isinstance(args[0], There)
            if isinstance(source, There) != target:
                self._add("to there" if target else "to here")

    def _add(self, kind: str) -> None:
        self.found[kind, self._line()] += 1

    @staticmethod
    def _line() -> str:
        """The innermost line of the package or of its hosts."""
        stack = traceback.extract_stack()
        known = ("geodiff_plugin", "diffusers", "transformers", "kornia")
        where = next(f for f in reversed(stack) if any(f"/{name}/" in f.filename for name in known))
        return f"{where.filename.rpartition('/')[2]}: {where.line}"

    def of_kind(self, *kinds: str) -> dict[str, int]:
        """Lines and how often, for some kinds."""
        return {line: n for (kind, line), n in self.found.items() if kind in kinds}


def _by_mask(args: Any) -> bool:
    return any(t.dtype in (torch.bool, torch.uint8) for t in tree_leaves(args[1]) if isinstance(t, Tensor))


def put_there(value: Any) -> Any:
    """A tensor, or a copy of what holds tensors, on the pretended device."""
    if isinstance(value, Tensor):
        return There(value)
    if is_dataclass(value) and not isinstance(value, type):
        twin = copy.copy(value)
        for one in fields(value):
            object.__setattr__(twin, one.name, put_there(getattr(value, one.name)))
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
def pretended(pipe: Any, guidance: Any, monkeypatch: Any) -> Any:
    """A pipeline whose networks lie over there; its call raises ``Reached`` where its steps are over.

    Counted from the first call of the network to there. Evidence is made here and put there: it is made once
    a call, and its constants come from lists, which torch copies to no device that is none.

    Yields:
        ``Waits``.
    """
    waits, prepare = Waits(), guidance.prepare

    def over(*_: Any) -> None:
        raise Reached

    def start(*_: Any) -> None:
        waits.counts = True

    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # knows no such device
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)
    monkeypatch.setattr(torch, "get_autocast_dtype", lambda *_: torch.float32)
    monkeypatch.setattr(guidance, "prepare", lambda lefts: [put_there(e) for e in prepare(lefts.here)])
    monkeypatch.setattr(type(pipe), "decode_prediction", over)
    handle = pipe.unet.register_forward_pre_hook(start)
    try:
        with waits:
            _move(pipe)
            yield waits
    finally:
        handle.remove()


def _move(pipe: Any) -> None:
    for module in (m for m in pipe.components.values() if isinstance(m, torch.nn.Module)):
        for part in module.modules():
            for name, tensor in part._parameters.items():
                if tensor is not None:
                    part._parameters[name] = torch.nn.Parameter(There(tensor.detach()), False)
            for name, tensor in part._buffers.items():
                part._buffers[name] = None if tensor is None else There(tensor)
