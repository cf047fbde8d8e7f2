"""A lower layer never imports a higher one, and no files import each other, however late and indirectly."""

import ast
import graphlib
import importlib
import os
import re
from pathlib import Path

import pytest

from tests.stages import PACKAGE, stages

#: A module that lies in another layer than its package.
OF_ITS_OWN = "evidence.guidance"


def _layer_of(path: Path) -> int | None:
    """The layer that the docstring of a module or package states."""
    stated = re.search(r"^Layer (\d+): ", ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "", re.M)
    return int(stated[1]) if stated else None


def _layers() -> dict[str, int]:
    """The layer of every package and of every module that is in none."""
    parts = {path.stem: path for path in PACKAGE.glob("*.py") if path.stem != "__init__"}
    parts |= {path.parent.name: path for path in PACKAGE.glob("*/__init__.py")}
    parts[OF_ITS_OWN] = PACKAGE / f"{OF_ITS_OWN.replace('.', '/')}.py"
    layers = {part: _layer_of(path) for part, path in parts.items()}
    assert None not in layers.values(), [part for part, layer in layers.items() if layer is None]
    return layers


LAYER = _layers()

#: From here up diffusers may be imported, and the root of the package, which imports everything.
DIFFUSERS_FROM, ROOT_FROM = LAYER["priors"], LAYER["capture"]
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def _module_name(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


KNOWN = {_module_name(path) for path in FILES}
#: Functions that import what their first argument names, below the package.
BY_NAME = {"has_kernel", "imported"}


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


def _imported_by_name(tree: ast.AST) -> list[str]:
    """Modules of the package that are imported by a string, or by how an f-string begins."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and ast.unparse(node.func).lstrip("_") in BY_NAME:
            (text, *_) = getattr(node.args[0], "values", [node.args[0]])
            parts = ["geodiff_plugin", *str(getattr(text, "value", "")).split(".")]
            prefixes = (".".join(parts[:count]) for count in range(len(parts), 1, -1))
            found += [name for name in prefixes if name in KNOWN][:1]
    return found


def _reached(module: str, tree: ast.AST) -> set[str]:
    """Modules of the package that a module imports, also within functions and by name."""
    reached = {
        found
        for target, names in _imports(tree)
        if target.startswith("geodiff_plugin.")
        for found in _own_modules(target, names, KNOWN)
    }
    reached |= set(_imported_by_name(tree))
    return reached - {module}


@pytest.mark.parametrize("path", FILES, ids=[_module_name(path) for path in FILES])
def test_no_import_of_a_higher_layer(path: Path) -> None:
    module, tree = _module_name(path), ast.parse(path.read_text(encoding="utf-8"))
    part = _part(module)
    assert part in LAYER, f"state the layer of {part} in its docstring"
    for target, names in _imports(tree):
        if target.split(".")[0] == "diffusers":
            assert LAYER[part] >= DIFFUSERS_FROM, f"{module} imports {names} of diffusers"
        if target == "geodiff_plugin":
            assert LAYER[part] >= ROOT_FROM, f"{module} imports the package's root, which imports everything"
    for reached in _reached(module, tree):
        assert LAYER[_part(reached)] <= LAYER[part], f"{module} (L{LAYER[part]}) imports {reached}"


@pytest.mark.parametrize("package", ["formats", "jobs"])
def test_other_packages_import_the_public_names_of_a_package_from_it(package: str) -> None:
    public = importlib.import_module(f"geodiff_plugin.{package}").__all__
    for path in FILES:
        module = _module_name(path)
        if _part(module) == package:
            continue
        for target, names in _imports(ast.parse(path.read_text(encoding="utf-8"))):
            deep = target.startswith(f"geodiff_plugin.{package}.") and [n for n in names if n in public]
            assert not deep, f"{module}: import {', '.join(deep or ())} from geodiff_plugin.{package}"


def test_no_files_import_each_other() -> None:
    """Not even in functions: a file is understood after those that it imports. Strings name files as well."""
    trees = {_module_name(path): ast.parse(path.read_text(encoding="utf-8")) for path in FILES}
    graph = {module: _reached(module, tree) for module, tree in trees.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_a_file_that_a_string_names_is_reached() -> None:
    tree = ast.parse("@has_kernel('algorithm.kernels.edges.sharpen_edges')\ndef f():\n imported(f'cli.{x}')")
    assert set(_imported_by_name(tree)) == {"geodiff_plugin.cli", "geodiff_plugin.algorithm.kernels.edges"}


@pytest.mark.parametrize("stage", stages(), ids=lambda stage: stage.name)
def test_a_kernel_is_in_a_folder_of_kernels_next_to_its_reference(stage) -> None:
    """mypy, the mutation tests and the table of launches know kernels by their folder."""
    folder, kernels, *_ = stage.kernel.split(".")
    assert kernels == "kernels" and stage.path.parent == PACKAGE / folder


def test_only_kernels_import_triton() -> None:
    """It need not be installed, and takes time to import."""
    for path in FILES:
        imports = _imports(ast.parse(path.read_text(encoding="utf-8")))
        if any(target.split(".")[0] == "triton" for target, _ in imports):
            assert path.parent.name == "kernels", path


def _table() -> str:
    """The table of layers, from the docstrings of packages and modules."""
    rows = []
    for part, layer in sorted(LAYER.items(), key=lambda item: (item[1], item[0])):
        path = PACKAGE / part.replace(".", "/")
        path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        first = (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").split("\n\n")[0]
        rows.append(f"| {layer} | `{part}` | {' '.join(first.split()).replace('``', '`')} |")
    return "\n".join(["| layer | package or module | purpose |", "| ---: | --- | --- |", *rows])


def test_architecture_page_has_the_packages_as_they_describe_themselves() -> None:
    """``GEODIFF_WRITE=1 pytest tests/test_layering.py`` writes the table."""
    page = PACKAGE.parent / "docs" / "explanation" / "architecture.md"
    text = page.read_text(encoding="utf-8")
    before, rest = text.split("| layer |", 1)
    made = before + _table() + "\n\n" + rest.split("\n\n", 1)[1]
    if os.environ.get("GEODIFF_WRITE"):
        page.write_text(made, encoding="utf-8")
    assert page.read_text(encoding="utf-8") == made


def test_few_modules_are_in_no_package() -> None:
    assert len(list(PACKAGE.glob("*.py"))) <= 12


#: Unit tests of several modules of a package, or of what they have in common.
OF_SEVERAL_MODULES = {
    "algorithm/test_kernels_in_use.py",
    "algorithm/test_records.py",
    "matching/test_conventions.py",
    "priors/test_declared_facts.py",
    "priors/test_outputs.py",
    "priors/test_recognition.py",
    "scale/test_kernels_in_use.py",
    "test_api_page.py",
    "trust/test_contracts.py",
}


def test_unit_tests_have_the_name_and_place_of_their_module():
    unit = Path(__file__).parent / "unit"
    without_module = set()
    for test in unit.rglob("test_*.py"):
        place, name = test.parent.relative_to(unit), test.stem.removeprefix("test_")
        files = [PACKAGE / place / f"{name}.py", PACKAGE / place / "kernels" / f"{name}.py"]
        if not any(file.is_file() for file in files) and not (PACKAGE / place / name).is_dir():
            without_module.add(test.relative_to(unit).as_posix())
    assert without_module == OF_SEVERAL_MODULES
