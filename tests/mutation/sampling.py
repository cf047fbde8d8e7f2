"""Which mutants are drawn, and which are known to be equivalent."""

import ast
import io
import random
import re
import subprocess
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from tests.mutation.coverage_map import PACKAGE, ROOT
from tests.mutation.operators import mutated, positions

#: Files that are not mutated, each with the reason. Strings and log messages are not mutated in any file.
EXCLUDED = {
    r"/kernels/": "Triton kernels, which are compared with their references on their own",
    r"/findings\.py$": "wording",
    r"/cli/(terminal|info)\.py$": "wording and layout of the terminal",
    r"/__main__\.py$": "one call",
}
#: Of these one is, because tests run it with all others.
INCLUDED = ("geodiff_plugin/runtime/kernels/group_norm.py",)
#: Tokens that are no code.
LAYOUT = {getattr(tokenize, name) for name in "COMMENT NL NEWLINE INDENT DEDENT ENDMARKER".split()}
EQUIVALENT = Path(__file__).with_name("equivalent.toml")


@dataclass(frozen=True)
class Mutant:
    """One mutation of one file."""

    file: str
    line: int
    operator: str
    occurrence: int

    @cached_property
    def code(self) -> str:
        """The mutated file."""
        return mutated((ROOT / self.file).read_text(encoding="utf-8"), self.operator, self.occurrence)

    @cached_property
    def change(self) -> tuple[str, str]:
        """The first line that differs, before and after, without indentation."""
        before = (ROOT / self.file).read_text(encoding="utf-8").splitlines()
        for old, new in zip(before, self.code.splitlines(), strict=False):
            if old != new:
                return old.strip(), re.sub(r"\s+", " ", new.strip())
        return before[-1].strip(), ""

    @property
    def package(self) -> str:
        """The package it lies in, or ``root``."""
        parts = self.file.split("/")
        return parts[1] if len(parts) > 2 else "root"


def package_files(words: list[str]) -> list[str]:
    """The files that are mutated; with words, those whose path contains one."""
    paths = sorted((ROOT / PACKAGE).rglob("*.py"))
    names = [path.relative_to(ROOT).as_posix() for path in paths]
    kept = [name for name in names if name in INCLUDED or not any(re.search(p, f"/{name}") for p in EXCLUDED)]
    return [name for name in kept if not words or any(word in name for word in words)]


def every_line(file: str, line: int) -> bool:
    """Draw from all lines."""
    return True


def draw(
    files: list[str], sample: int, seed: int, keep: Callable[[str, int], bool] = every_line
) -> list[Mutant]:
    """A random sample: a line of code, one of the operators that fit it, one of its occurrences there."""
    rng = random.Random(seed)
    lines = [(file, line) for file in files for line in _code_lines(file) if keep(file, line)]
    rng.shuffle(lines)
    drawn: list[Mutant] = []
    by_line: dict[str, dict[int, dict[str, list[int]]]] = {}
    for file, line in lines:
        if len(drawn) == sample:
            break
        if file not in by_line:
            by_line[file] = _mutants_by_line(file)
        operators = by_line[file].get(line)
        if operators:
            operator = rng.choice(sorted(operators))
            drawn.append(Mutant(file, line, operator, rng.choice(operators[operator])))
    return drawn


def changed_lines(reference: str) -> Callable[[str, int], bool]:
    """Whether a line differs from a commit."""
    command = ["git", "diff", "-U0", "--relative", reference, "--", PACKAGE]
    diff = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    changed: dict[str, set[int]] = defaultdict(set)
    file = ""
    for text in diff.splitlines():
        if text.startswith("+++ b/"):
            file = text.removeprefix("+++ b/")
        elif hunk := re.match(r"@@ -\S+ \+(\d+)(?:,(\d+))? @@", text):
            first, count = int(hunk[1]), int(hunk[2] or 1)
            changed[file] |= set(range(first, first + count))
    return lambda name, line: line in changed[name]


def equivalents() -> dict[tuple[str, str, str], str]:
    """Reasons why a mutant changes nothing that matters, by file, line before and line after."""
    listed = tomllib.loads(EQUIVALENT.read_text(encoding="utf-8"))["mutant"]
    return {(entry["file"], entry["before"], entry["after"]): entry["reason"] for entry in listed}


def _mutants_by_line(file: str) -> dict[int, dict[str, list[int]]]:
    found: dict[int, dict[str, list[int]]] = defaultdict(lambda: defaultdict(list))
    for operator, occurrence, line in positions((ROOT / file).read_text(encoding="utf-8")):
        found[line][operator].append(occurrence)
    return found


def _code_lines(file: str) -> Iterator[int]:
    """Lines that hold code: no blank line, comment or docstring."""
    source = (ROOT / file).read_text(encoding="utf-8")
    documentation: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            documentation |= set(range(node.lineno, node.end_lineno + 1))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    yield from sorted({token.start[0] for token in tokens if token.type not in LAYOUT} - documentation)
