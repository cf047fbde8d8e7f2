"""The stages of the package that have a kernel, as their source names it."""

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

PACKAGE = Path(__file__).resolve().parents[1] / "geodiff_plugin"


class Stage(NamedTuple):
    """A reference that has a kernel."""

    path: Path  # of its file
    name: str  # of the reference, or ``Class.method``
    reference: ast.FunctionDef
    kernel: str  # its dotted name below the package


def stages() -> list[Stage]:
    """All of them, file by file."""
    return [
        Stage(path, prefix + function.name, function, decorator.args[0].value)
        for path in sorted(PACKAGE.rglob("*.py"))
        for prefix, function in _functions(ast.parse(path.read_text(encoding="utf-8")))
        for decorator in function.decorator_list
        if isinstance(decorator, ast.Call) and ast.unparse(decorator.func) == "has_kernel"
    ]


def _functions(tree: ast.Module) -> Iterator[tuple[str, ast.FunctionDef]]:
    """Functions of a module, and methods with the name of their class and a dot."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef):
            yield "", node
        elif isinstance(node, ast.ClassDef):
            yield from ((f"{node.name}.", each) for each in node.body if isinstance(each, ast.FunctionDef))
