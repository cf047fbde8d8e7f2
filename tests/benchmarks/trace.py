"""How many modules, functions and records of the package one guided call passes.

    python -m tests.benchmarks.trace [--list]

The call is that of the demo pair with the bundled prior and default settings, on the CPU.
"""

from __future__ import annotations

import argparse
import sys
import threading
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import CodeType
from typing import Any

import torch

import geodiff_plugin
from geodiff_plugin import GeometryGuidance, enable_geometry_guidance, load_bundled_prior
from geodiff_plugin.bundled.demo_pair import read_demo_pair

ROOT = f"{Path(geodiff_plugin.__file__).parent}/"
#: Code that Python compiles next to the functions that somebody wrote.
NOT_FUNCTIONS = ("<module>", "<genexpr>", "<listcomp>", "<setcomp>", "<dictcomp>", "<lambda>")


def traced(call: Callable[[], Any]) -> set[CodeType]:
    """The code of every function of the package that a call enters, in any thread."""
    entered = set[CodeType]()

    def follow(frame: Any, event: str, _: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(ROOT):
            entered.add(frame.f_code)

    threading.setprofile(follow)
    sys.setprofile(follow)
    try:
        call()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return entered


def records_of(modules: set[str]) -> list[str]:
    """Dataclasses and named tuples that these modules of the package define."""
    found = []
    for name in modules:
        module = sys.modules[f"geodiff_plugin.{name}"]
        for each in vars(module).values():
            own = isinstance(each, type) and each.__module__ == module.__name__
            if own and (hasattr(each, "__dataclass_fields__") or hasattr(each, "_fields")):
                found.append(f"{name}.{each.__name__}")
    return sorted(found)


def guided_call() -> Callable[[], Any]:
    """One guided call of the demo pair, after a first one that imports and loads what is needed."""
    pipe, pair = enable_geometry_guidance(load_bundled_prior()), read_demo_pair()
    pipe.set_progress_bar_config(disable=True)

    def call() -> Any:
        guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
        return pipe(pair.left, guidance=guidance, generator=torch.Generator().manual_seed(0))

    call()
    return call


def main() -> None:
    parser = argparse.ArgumentParser(description="How much of the package one guided call passes.")
    parser.add_argument("--list", action="store_true", help="print the functions by module")
    listed = parser.parse_args().list
    code = [each for each in traced(guided_call()) if each.co_name not in NOT_FUNCTIONS]
    functions = Counter(
        each.co_filename.removeprefix(ROOT).removesuffix(".py").removesuffix("/__init__").replace("/", ".")
        for each in code
    )
    records = records_of(set(functions) - {"__init__"})
    print(f"{len(functions)} modules, {functions.total()} functions, {len(records)} records defined in them")
    for module, count in sorted(functions.items()):
        path = f"{ROOT}{module.replace('.', '/')}"
        names = sorted(
            each.co_qualname for each in code if each.co_filename.startswith((f"{path}.", f"{path}/_"))
        )
        print(f"{count:5d} {module}", *([f"({', '.join(names)})"] if listed else []))


if __name__ == "__main__":
    main()
