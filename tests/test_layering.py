"""A lower layer never imports a higher one, and nothing imports itself in a circle."""

from __future__ import annotations

import ast
import graphlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "geodiff_plugin"

LAYER = {
    "_checks": 0,
    "types": 0,
    "geometry": 1,
    "metric": 2,
    "denoising": 2,
    "matching": 2,
    "terms": 2,
    "formats": 2,
    "algorithm": 3,
    "objective": 3,
    "scale_search": 3,
    "updates": 3,
    "confidence": 3,
    "evidence": 3,
    "guidance": 3,
    "guidance_doors": 3,
    "guidance_inputs": 3,
    "knobs": 3,
    "point_scale": 3,
    "presets": 3,
    "refinement": 3,
    "trajectory": 3,
    "priors": 4,
    "integration": 4,
    "ensembling": 5,
    "output": 5,
    "pipeline": 5,
    "left_right": 5,
    "evaluation": 6,
    "synthetic": 6,
    "bundled": 6,
    "plotting": 6,
    "commands": 6,
    "cli": 6,
    "__main__": 6,
}
#: Where diffusers may be imported below L4, and what of it.
DIFFUSERS_BELOW = {"types": {"BaseOutput"}, "guidance": {"ConfigMixin"}}
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def _module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _part(module: str) -> str:
    """``geodiff_plugin.terms.base`` -> ``terms``."""
    return module.split(".")[1]


def _imports(tree: ast.AST) -> list[tuple[str, tuple[str, ...]]]:
    """Every imported module with the names taken from it."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [(alias.name, ()) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "write imports from the package's root, so that this test can read them"
            found.append((node.module, tuple(alias.name for alias in node.names)))
    return found


def _own_modules(module: str, names: tuple[str, ...], known: set[str]) -> list[str]:
    """Modules of the package that one import statement reaches."""
    inside = [f"{module}.{name}" for name in names if f"{module}.{name}" in known]
    return inside if inside and len(inside) == len(names) else [module, *inside]


@pytest.mark.parametrize("path", FILES, ids=[_module_name(path) for path in FILES])
def test_no_import_of_a_higher_layer(path: Path) -> None:
    module = _module_name(path)
    part = _part(module)
    assert part in LAYER, f"give {part} a layer here and in docs/contributing.md"
    for target, names in _imports(ast.parse(path.read_text(encoding="utf-8"))):
        if target.split(".")[0] == "diffusers" and LAYER[part] < 4:
            assert set(names) <= DIFFUSERS_BELOW.get(part, set()), f"{module} imports {names} of diffusers"
        if target == "geodiff_plugin":
            assert LAYER[part] == 6, f"{module} imports the package's root, which imports everything"
        elif target.startswith("geodiff_plugin."):
            assert LAYER[_part(target)] <= LAYER[part], f"{module} (L{LAYER[part]}) imports {target}"


def test_no_circle_of_imports() -> None:
    known = {_module_name(path) for path in FILES}
    graph = {}
    for path in FILES:
        module = _module_name(path)
        top_level = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(top_level):
            if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
                node.body = [ast.Pass()]  # what a call imports makes no circle at import time
        reached = {
            found
            for target, names in _imports(top_level)
            if target.startswith("geodiff_plugin.")
            for found in _own_modules(target, names, known)
        }
        graph[module] = reached - {module}
    graphlib.TopologicalSorter(graph).prepare()
