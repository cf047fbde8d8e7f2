"""The page of troubleshooting has every sentence that the program warns or judges with."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "how-to" / "troubleshooting.md"
#: Modules whose sentences all are warnings, reasons or remarks about a result.
WHOLE = (
    "runtime/judgement.py",
    "runtime/output.py",
    "algorithm/evidence.py",
    "pose/mistakes.py",
    "pose/refine.py",
    "pose/estimate.py",
    "pose/scale.py",
    "formats/exif.py",
)


def template(node: ast.expr) -> str | None:
    """A literal as it is printed, with N for what is filled in; ``None`` for anything else."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"\{[^{}]*\}", "N", node.value)
    if isinstance(node, ast.JoinedStr):
        parts = ("N" if isinstance(part, ast.FormattedValue) else part.value for part in node.values)
        return "".join(parts)
    return None


def is_sentence(text: str) -> bool:
    return len(text.split()) > 4 and bool(re.match(r"[A-Z]", text)) and text.rstrip()[-1] in ".?)N"


def _literals(tree: ast.AST) -> list[str]:
    docs = {
        id(node.body[0].value)
        for node in ast.walk(tree)
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef))
        and node.body
        and isinstance(node.body[0], ast.Expr)
    }
    within = {
        id(part) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in ast.walk(node)
    } - {id(node) for node in ast.walk(tree) if isinstance(node, ast.JoinedStr)}
    nodes = (node for node in ast.walk(tree) if isinstance(node, (ast.Constant, ast.JoinedStr)))
    found = (template(node) for node in nodes if id(node) not in docs | within)
    return [text for text in found if text is not None]


def sentences() -> list[str]:
    found = []
    for path in sorted((ROOT / "geodiff_plugin").rglob("*.py")):
        name = path.relative_to(ROOT / "geodiff_plugin").as_posix()
        if name.startswith("evaluation/"):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if name in WHOLE:
            found += [text for text in _literals(tree) if is_sentence(text)]
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and ast.unparse(call.func) == "warnings.warn":
                text = template(call.args[0])
                found += [] if text is None else [text]
    return list(dict.fromkeys(found))


def opening(text: str) -> str:
    """What a reader would search for: the first sentence, or what stands before a colon, of some words."""
    clauses = re.split(r"(?<=\w)[.?:;](?=\s|$)", " ".join(text.split()))
    while len(clauses) > 1 and len(clauses[0].split()) < 4:
        clauses[:2] = [f"{clauses[0]}{text[len(clauses[0])]}{clauses[1]}"]
    return clauses[0]


def _rows() -> list[list[str]]:
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    rows = [line.strip().strip("|").split(" | ") for line in lines if line.startswith("| ")]
    return [[cell.strip().replace("`", "") for cell in row] for row in rows]


def test_there_are_sentences_to_look_for():
    assert len(sentences()) > 40


@pytest.mark.parametrize("text", sentences(), ids=lambda text: "-".join(text.split()[:5]))
def test_the_page_has_it_with_a_cause(text):
    beside = [row[1] for row in _rows() if len(row) == 2 and opening(text) in row[0]]
    assert beside, f"docs/how-to/troubleshooting.md lacks a row for: {opening(text)}"
    assert all(len(cell.split()) > 2 for cell in beside), "a sentence stands beside its cause and cure"
