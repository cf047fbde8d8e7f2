"""Banned words in identifiers, messages, help texts, docstrings, comments and documentation pages.

The few exceptions are ``IDENTIFIER_EXCEPTIONS`` and ``PHRASE_EXCEPTIONS``. A shorter list
applies to names of tests, docstrings and comments in tests and examples.
"""

import ast
import io
import re
import tokenize
from collections import defaultdict
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]

#: Words of identifiers, after splitting at underscores and capitals -> the standard term.
IDENTIFIER_WORDS = {
    "anew": "again",
    "apart": "residual, distance or deviation",
    "bars": "letterbox",
    "beside": "next to, neighbours, offsets",
    "crisp": "refine_edges",
    "cure": "hint",
    "cures": "hints",
    "exchangeable": "ambiguity",
    "exchanged": "inverted_order",
    "grounds": "features",
    "inertia": "tikhonov",
    "knob": "parameter",
    "knobs": "parameters",
    "mistake": "error",
    "mistakes": "errors",
    "noted": "reported",
    "photograph": "image",
    "photographs": "images",
    "picture": "image",
    "pictures": "images",
    "pilot": "coarse sweep",
    "refuse": "raise_input_error",
    "refused": "rejected",
    "refuses": "rejects",
    "respace": "trailing_spacing",
    "said": "message",
    "says": "states",
    "share": "fraction",
    "shares": "fractions",
    "standing": "trust summary",
    "steady": "temporal_smoothing",
    "straightened": "warp",
    "tell": "notify",
    "telling": "notices",
    "tells": "notifies",
    "told": "reported",
    "truth": "ground_truth",
    "truths": "ground_truths",
    "uncollected": "gc_frozen",
    "undisturbed": "defer_signals",
    "uprights": "vertical lines",
    "votes": "weighted median",
    "voting": "median",
}
#: Patterns of whole identifiers -> the standard term.
IDENTIFIER_PATTERNS = {
    r"_?(MOST|LEAST|FEWEST|FARTHEST|LONGEST)_.*": "MAX_ or MIN_",
    r".*runner_?up.*": "second best",
    r".*behind_infinity.*": "negative_disparity",
    r"(match_noise|outlier_width|step_latents|step_affine|inner_steps|z_test)": "the new parameter",
    r"(prior_pull|pull_to|no_kernels)": "the new parameter",
    r"(scale_spread|from_photographs|clean_photographs)": "the new name",
}
#: Identifiers of progress bars, which are not letterbox bars.
IDENTIFIER_EXCEPTIONS = {"no_bars", "are_progress_bars_disabled", "disable_progress_bars"}

#: Patterns in messages, help texts, docstrings, comments and pages -> the standard term.
PHRASES = {
    r"knobs?": "parameter",
    r"cures?": "hint, remedy",
    r"refus(e|es|ed|ing)": "raise an error, reject",
    r"(say|says|said|tell|tells|told)": "report, state, warn, print",
    r"photograph(s|ed)?": "image",
    r"pictures?": "image",
    r"anew": "again",
    r"beside": "next to, along with, and",
    r"(a|the|this|these|those|as|by|in|of|equal|largest|same) shares?": "fraction",
    r"shares of": "fractions",
    r"behind infinity": "negative disparity",
    r"(uprights|upright lines)": "vertical lines",
    r"exchanged": "swapped, inverted",
    r"crisp": "sharp, refined edges",
    r"steady": "temporally smooth",
    r"runners?-up": "second best",
    r"inertia": "Tikhonov weight",
    r"pilot": "coarse sweep",
    r"(undisturbed|uncollected)": "the standard term",
    r"python's lock": "the GIL",
    r"(?<!ground )(?<!ground-)truths?": "ground truth",
    r"mistakes?": "error",
    r"things?": "object",
    r"(those|that) of": "for, from, in, or a possessive",
    r"(pairs|frames|images|calls|views|times|steps|updates) a (second|frame|view|pair|step)": "per",
    r"(once too often|as it comes|there already)": "plain English",
    r"--(knob|knobs|steady|graphs|no-kernels|into)(?![\w-])": "the new option",
    r"(match_noise|outlier_width|step_latents|step_affine|inner_steps|z_test|prior_pull|pull_to)": (
        "the new name of the parameter"
    ),
    r"(scale_spread|straightened_px|behind_infinity|from_photographs)": "the new name",
}
#: File -> patterns that it may contain: the changelog lists renamed options and parameters.
PHRASE_EXCEPTIONS = {
    "docs/changelog.md": {key for key in PHRASES if "_" in key or key.startswith("--") or key == "knobs?"},
}
#: Words of names of tests, of docstrings and of comments in tests and examples.
TEST_WORDS = {
    "anew",
    "beside",
    "cure",
    "cures",
    "exchanged",
    "knob",
    "knobs",
    "mistake",
    "mistakes",
    "photograph",
    "photographs",
    "picture",
    "pictures",
    "refuse",
    "refused",
    "refuses",
    "said",
    "says",
    "steady",
    "tells",
    "told",
}
_PHRASE = {key: re.compile(rf"(?<![\w`/.-]){key}(?![\w/-])", re.IGNORECASE) for key in PHRASES}
#: Matches wherever one of the phrases does; most texts have none, and one search is faster than one for each.
_ANY_PHRASE = re.compile(rf"(?<![\w`/.-])(?:{'|'.join(PHRASES)})(?![\w/-])", re.IGNORECASE)
_TEST_WORD = re.compile(rf"(?<![\w`/.-])(?:{'|'.join(sorted(TEST_WORDS))})(?![\w/-])", re.IGNORECASE)
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def code_files() -> list[Path]:
    """Every module of the package."""
    return sorted((ROOT / "geodiff_plugin").rglob("*.py"))


def modules_of_tests() -> list[Path]:
    """Every module of the tests and examples, except this one."""
    folders = (ROOT / "tests", ROOT / "examples")
    return sorted(path for folder in folders for path in folder.rglob("*.py") if path != Path(__file__))


def pages() -> list[Path]:
    """The README and every documentation page."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


class Content(NamedTuple):
    """What is checked in a module.

    Attributes:
        identifiers: every name that it defines, uses or passes as a keyword.
        docstrings: of the module, its classes and functions.
        messages: strings of several words that are not docstrings: messages, help texts, errors, labels.
    """

    identifiers: set[str]
    docstrings: list[str]
    messages: list[str]


@cache
def content(path: Path) -> Content:
    """Collect what is checked in one walk, because the trees of all modules take seconds and much memory."""
    identifiers: set[str] = set()
    texts: dict[int, str] = {}
    docstrings: dict[int, str] = {}
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        names = (getattr(node, field, None) for field in ("id", "attr", "arg", "name", "asname"))
        identifiers.update(part for name in names if isinstance(name, str) for part in name.split("."))
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) and node.body:
            first = node.body[0]
            if isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant):
                docstrings[id(first.value)] = first.value.value
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            texts[id(node)] = node.value
    messages = [text for key, text in texts.items() if key not in docstrings and " " in text.strip()]
    return Content(identifiers, [text for text in docstrings.values() if isinstance(text, str)], messages)


def comments(path: Path) -> Iterator[str]:
    """Docstrings and comments; consecutive comment lines are one text."""
    yield from content(path).docstrings
    text, last = "", 0
    for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
        if token.type == tokenize.COMMENT:
            if token.start[0] != last + 1:
                yield text
                text = ""
            text, last = f"{text} {token.string.lstrip('#: ')}", token.start[0]
    yield text


def page_text(path: Path) -> Iterator[str]:
    """A page without code blocks and links' targets."""
    text = re.sub(r"^```.*?^```", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    yield re.sub(r"\]\([^)]*\)", "]", text)


def bad_identifiers(path: Path) -> list[str]:
    """``word: standard term`` of every banned identifier of a module."""
    names = sorted(content(path).identifiers - IDENTIFIER_EXCEPTIONS)
    return [found for name in names for found in bad_words(name)]


@cache
def bad_words(name: str) -> list[str]:
    """``word: standard term`` of one identifier."""
    rest = re.sub("ground_?truth", "", name, flags=re.IGNORECASE)
    words = [word.lower() for word in _WORD.findall(rest)]
    found = [f"{name}: {IDENTIFIER_WORDS[word]}" for word in words if word in IDENTIFIER_WORDS]
    return found + [f"{name}: {term}" for key, term in IDENTIFIER_PATTERNS.items() if re.fullmatch(key, name)]


def bad_phrases(path: Path, texts: Iterable[str]) -> list[str]:
    """``phrase: standard term`` of every banned phrase of texts."""
    allowed = PHRASE_EXCEPTIONS.get(path.relative_to(ROOT).as_posix(), set())
    found = []
    for text in texts:
        line = " ".join(text.split())
        if not _ANY_PHRASE.search(line):
            continue
        for key, pattern in _PHRASE.items():
            if key not in allowed:
                found += [
                    f"{hit[0]!r} in {around(line, hit)!r}: {PHRASES[key]}" for hit in pattern.finditer(line)
                ]
    return found


def around(text: str, hit: re.Match[str]) -> str:
    return text[max(0, hit.start() - 30) : hit.end() + 30]


def bad_words_of_tests(path: Path) -> list[str]:
    """Banned words in names of tests, docstrings and comments of a module."""
    source = path.read_text(encoding="utf-8")
    names = set(re.findall(r"def (test_\w+)", source))
    found = [f"{word} in {name}" for name in sorted(names) for word in name.split("_") if word in TEST_WORDS]
    if not _TEST_WORD.search(source):
        return found
    for text in comments(path):
        line = " ".join(text.split())
        found += [f"{hit[0]} in {around(line, hit)!r}" for hit in _TEST_WORD.finditer(line)]
    return found


@cache
def violations() -> dict[tuple[str, str], list[str]]:
    """``(kind, path)`` -> what is banned there."""
    found: dict[tuple[str, str], list[str]] = defaultdict(list)
    for path in code_files():
        name = path.relative_to(ROOT).as_posix()
        found["identifier", name] = bad_identifiers(path)
        found["message", name] = bad_phrases(path, content(path).messages)
        found["comment", name] = bad_phrases(path, comments(path))
    for path in modules_of_tests():
        found["test", path.relative_to(ROOT).as_posix()] = bad_words_of_tests(path)
    for path in pages():
        found["page", path.relative_to(ROOT).as_posix()] = bad_phrases(path, page_text(path))
    return {key: words for key, words in found.items() if words}


def test_there_are_no_banned_words():
    report = "\n".join(
        f"{kind} {path}\n    " + "\n    ".join(words[:20]) for (kind, path), words in violations().items()
    )
    assert not report, f"\n{report}"


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("the given knob and the others", 1),
        ("errors relative to ground truth", 0),
        ("errors relative to the truth", 1),
        ("a share of the image", 1),
        ("frames share a camera; shared frames", 0),
        ("beside the left image, that of the right one", 2),
        ("2 pairs a second, but wait a second", 1),
        ("`beside` in code style", 0),
    ],
)
def test_phrases_are_found_as_words(text, count):
    assert len(bad_phrases(ROOT / "README.md", iter([text]))) == count


def test_every_message_of_a_finding_is_among_the_checked_texts():
    """They are declared as plain strings."""
    from geodiff_plugin.trust import KINDS

    checked = {" ".join(text.split()) for path in code_files() for text in content(path).messages}
    for kind in KINDS.values():
        assert {kind.title, kind.cause, kind.hint} <= checked, kind.code
