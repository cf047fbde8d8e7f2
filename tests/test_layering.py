"""A lower layer never imports a higher one, and nothing imports itself in a circle."""

import ast
import graphlib
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "geodiff_plugin"

LAYER = {
    "_camera_checks": 0,
    "_certain": 0,
    "_checks": 0,
    "_compilation": 0,
    "_kernels": 0,
    "_lazy": 0,
    "_reprojection": 0,
    "_signals": 0,
    "_strips": 0,
    "_threads": 0,
    "messages": 0,
    "types": 0,
    "geometry": 1,
    "config": 1,
    "options": 1,
    "matching": 3,
    "formats": 3,
    "plotting": 3,
    "pose": 4,
    "scale": 4,
    "evidence": 5,
    "algorithm": 6,
    "evidence.guidance": 6,
    "priors": 7,
    "runtime": 8,
    "result": 7,
    "bundled": 8,
    "capture": 9,
    "jobs": 10,
    "evaluation": 11,
    "app": 12,
    "cli": 12,
    "__main__": 13,
}
"""By part of the package, or by module where a folder lies in two layers: the configuration is below all
that reads it, what takes images and cameras as a user gives them is above."""

#: From here up diffusers may be imported, and the root of the package, which imports everything.
DIFFUSERS_FROM, ROOT_FROM = LAYER["priors"], LAYER["capture"]
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def _module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


KNOWN = {_module_name(path) for path in FILES}


def _part(module: str) -> str:
    """``geodiff_plugin.algorithm.terms.base`` -> ``algorithm``; a module may have an entry of its own."""
    parts = module.split(".")[1:]
    own = ".".join(parts[:2])
    return own if own in LAYER else parts[0]


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
    assert part in LAYER, f"give {part} a layer here and in docs/explanation/architecture.md"
    for target, names in _imports(ast.parse(path.read_text(encoding="utf-8"))):
        if target.split(".")[0] == "diffusers":
            assert LAYER[part] >= DIFFUSERS_FROM, f"{module} imports {names} of diffusers"
        if target == "geodiff_plugin":
            assert LAYER[part] >= ROOT_FROM, f"{module} imports the package's root, which imports everything"
        elif target.startswith("geodiff_plugin."):
            for reached in _own_modules(target, names, KNOWN):
                assert LAYER[_part(reached)] <= LAYER[part], f"{module} (L{LAYER[part]}) imports {reached}"


def test_no_circle_of_imports() -> None:
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
            for found in _own_modules(target, names, KNOWN)
        }
        graph[module] = reached - {module}
    graphlib.TopologicalSorter(graph).prepare()


def test_architecture_page_names_every_folder() -> None:
    page = (PACKAGE.parent / "docs" / "explanation" / "architecture.md").read_text(encoding="utf-8")
    table = page.split("## Layers", 1)[1]
    for part in LAYER:
        assert f"`{part}`" in table, f"docs/explanation/architecture.md lacks {part}"
