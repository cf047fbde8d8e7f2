"""Which tests execute which lines of the package.

The records are stored per test file in ``.mutation/coverage/``. A record is renewed when the test file
changes, or a package file that its tests execute. Changes of shared helpers (``conftest.py``, ``tiny.py``,
``scenes``) go unnoticed: remove the folder after one.
"""

import ast
import gzip
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import or_
from pathlib import Path

import coverage

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "geodiff_plugin"
#: The tests that are run, as an expression of markers.
TESTS = "not slow"
#: Tests that drive other programs, or that check the repository and not the package.
LEFT_OUT = tuple(
    f"tests/{name}" for name in "browser kernels benchmarks mutation test_docs test_packaging".split()
)

Masks = dict[str, int]  # lines of each package file, as bits


@dataclass(frozen=True)
class RecordedTest:
    """A test that passes on the code as it is."""

    name: str
    seconds: float
    lines: Masks

    @cached_property
    def breadth(self) -> int:
        """How many lines of the package it executes."""
        return sum(mask.bit_count() for mask in self.lines.values())


class CoverageMap:
    """The recorded tests of a checkout."""

    def __init__(self, folder: Path, renew: Sequence[str] | None = None) -> None:
        """Records in a folder. With ``renew``, only test files whose path contains a word go stale."""
        self.folder, self.renew = folder, renew
        self.tests: list[RecordedTest] = []

    def update(self, processes: int) -> None:
        """Run the test files whose record is missing or stale, and load all records."""
        self.folder.mkdir(parents=True, exist_ok=True)
        files = _test_files()
        for stored in self.folder.glob("*.gz"):
            if stored.name not in {_stored_name(file) for file in files}:
                stored.unlink(missing_ok=True)
        stale = [file for file in files if not self._is_fresh(file)]
        if stale:
            print(f"Recording which lines {len(stale)} test files execute ...", flush=True)
            self._record(stale, processes)
        self.tests = [
            RecordedTest(name, test["seconds"], {file: int(mask, 16) for file, mask in test["lines"].items()})
            for file in files
            for name, test in self._load(file)["tests"].items()
        ]

    def covering(self, module: str, lines: Masks) -> list[RecordedTest]:
        """The tests that execute one of these lines, and the module's own; the most specific ones first.

        What runs when a module or a test file is imported counts for no test, or for the first one that
        imports it. Tests in files named after the module are therefore always included, and if no test
        executes the lines, those that execute anything else of the module.
        """
        own = f"/test_{Path(module).stem}.py::"
        found = [
            test
            for test in self.tests
            if own in test.name or any(test.lines.get(file, 0) & mask for file, mask in lines.items())
        ]
        found = found or [test for test in self.tests if module in test.lines]
        return sorted(found, key=lambda test: (test.breadth, test.name))

    def _load(self, file: Path) -> dict:
        path = self.folder / _stored_name(file)
        if not path.exists():
            return {"hashes": {}, "tests": {}}
        return json.loads(gzip.decompress(path.read_bytes()))

    def _is_fresh(self, file: Path) -> bool:
        hashes = self._load(file)["hashes"]
        if self.renew is not None:
            if not any(word in file.as_posix() for word in self.renew):
                return True
            hashes = {name: stored for name, stored in hashes.items() if name == file.as_posix()}
        return file.as_posix() in hashes and all(_hash(name) == stored for name, stored in hashes.items())

    def _record(self, files: list[Path], processes: int) -> None:
        with tempfile.TemporaryDirectory() as name:
            settings = os.environ | {"GEODIFF_MUTATION_RECORD": name, "PYTHONPATH": str(ROOT)}
            command = [sys.executable, *"-m pytest -q -p tests.mutation.record -m".split(), TESTS]
            command += ["-n", str(processes), *map(str, files)]
            with open(Path(name) / "log.txt", "w") as log:
                subprocess.run(command, cwd=ROOT, env=settings, stdout=log, stderr=log, check=False)
            print(Path(name, "log.txt").read_text().strip().splitlines()[-1])
            self._store(files, Path(name))

    def _store(self, files: list[Path], recorded: Path) -> None:
        seconds: dict[str, float] = {}
        for path in recorded.glob("seconds-*.json"):
            seconds |= json.loads(path.read_text())
        lines = _lines_by_test(recorded)
        tests = defaultdict(dict)
        for test, duration in seconds.items():
            masks = {file: f"{mask:x}" for file, mask in lines.get(test, {}).items()}
            tests[test.split("::")[0]][test] = {"seconds": duration, "lines": masks}
        for file in files:
            found = tests.get(file.as_posix(), {})
            if not found:  # all its tests failed or were lost with their process; recorded again next time
                continue
            executed = {name for test in found.values() for name in test["lines"]}
            hashes = {name: _hash(name) for name in [file.as_posix(), *sorted(executed)]}
            content = json.dumps({"hashes": hashes, "tests": found})
            written = self.folder / f"{_stored_name(file)}.{os.getpid()}"
            written.write_bytes(gzip.compress(content.encode(), 1))
            written.replace(self.folder / _stored_name(file))


def _lines_by_test(recorded: Path) -> dict[str, Masks]:
    lines: dict[str, Masks] = defaultdict(lambda: defaultdict(int))
    for path in recorded.glob(".coverage*"):
        data = coverage.CoverageData(str(path))
        try:
            data.read()
        except coverage.exceptions.DataError:
            continue  # left by a process that a test killed while it wrote
        for measured in data.measured_files():
            name = f"{PACKAGE}/{measured.rpartition(f'/{PACKAGE}/')[2]}"
            for line, contexts in data.contexts_by_lineno(measured).items():
                for context in contexts:
                    # In a process that a test started, the context is "name (call)".
                    test = context.rpartition(" (")[0] if context.endswith(")") else context
                    lines[test][name] |= 1 << line
    return lines


def _test_files() -> list[Path]:
    tops = ROOT / "tests", ROOT / "examples/training"
    found = [path.relative_to(ROOT) for top in tops for path in top.rglob("test_*.py")]
    return sorted(path for path in found if not path.as_posix().startswith(LEFT_OUT))


def _stored_name(file: Path) -> str:
    return file.as_posix().replace("/", "-") + ".json.gz"


def _hash(name: str) -> str:
    path = ROOT / name
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.exists() else "gone"


class LineIndex:
    """The lines that execute what stands on a line: its statement, or the uses of what it defines."""

    def __init__(self, root: Path) -> None:
        self.trees = {
            path.relative_to(root).as_posix(): ast.parse(path.read_text(encoding="utf-8"))
            for path in (root / PACKAGE).rglob("*.py")
        }

    def lines_executing(self, file: str, line: int) -> Masks:
        """Lines by file.

        A line in a function counts with its whole statement. A default, a decorator or a signature counts as
        the body of its function. A constant or a field counts wherever a function uses its name.
        """
        tree = self.trees[file]
        around = [each for each in _functions(tree) if _first_line(each) <= line <= each.end_lineno]
        if around:
            function = max(around, key=_first_line)
            if line >= function.body[0].lineno:
                return {file: _mask(*_statement(function, line))}
            return {file: _body(function)}
        names = _defined_names(tree, line)
        uses = {name: mask for name, other in self.trees.items() if (mask := _uses(other, names))}
        return uses or {file: reduce(or_, map(_body, _functions(tree)), 0)}


def _functions(tree: ast.AST) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]


def _body(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    return _mask(function.body[0].lineno, function.end_lineno)


def _first_line(node: ast.AST) -> int:
    return min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", ()))])


def _statement(function: ast.AST, line: int) -> tuple[int, int]:
    """First and last line of the smallest statement around a line; of a compound one, its head."""
    spans = [(line, line)]
    for node in ast.walk(function):
        if isinstance(node, ast.stmt) and node is not function and _first_line(node) <= line:
            body = getattr(node, "body", None)
            last = max(node.lineno, body[0].lineno - 1) if isinstance(body, list) else node.end_lineno
            if line <= last:
                spans.append((node.lineno, last))
    return min(spans[1:] or spans, key=lambda span: span[1] - span[0])


def _defined_names(tree: ast.AST, line: int) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.lineno <= line <= node.end_lineno:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            names |= {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}
        if isinstance(node, ast.ClassDef) and _first_line(node) <= line < node.body[0].lineno:
            names.add(node.name)
    return names


def _uses(tree: ast.AST, names: set[str]) -> int:
    mask = 0
    for function in _functions(tree):
        for node in ast.walk(function):
            # An ``ast.Name`` has an ``id``, an ``ast.Attribute`` an ``attr``.
            if {getattr(node, "id", None), getattr(node, "attr", None)} & names:
                mask |= _mask(node.lineno, node.end_lineno)
    return mask


def _mask(first: int, last: int) -> int:
    return (1 << (last + 1)) - (1 << first)
