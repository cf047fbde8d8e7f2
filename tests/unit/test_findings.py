"""Codes of findings: one table, the page that is generated from it, and every code in use."""

import ast
import copy
import json
import math
import pickle
import re
import warnings
from pathlib import Path

import pytest

import geodiff_plugin
from geodiff_plugin._internal.checks import captured_warnings, warn
from geodiff_plugin.findings import FINDINGS, GROUPS, Finding, Severity, as_records, dedupe, some_names
from geodiff_plugin.pose.fit import FITS_PX
from geodiff_plugin.trust import KINDS, Epipolar
from geodiff_plugin.trust.known_points import KnownPoints
from geodiff_plugin.trust.prior_scale import PriorScale
from tests.pages import check_generated

PACKAGE = Path(geodiff_plugin.__file__).parent
DOCS = PACKAGE.parent / "docs"
PAGE = DOCS / "reference" / "messages.md"
BEGIN, END = "<!-- made by tests/unit/test_findings.py -->\n", "<!-- end -->"


@pytest.mark.parametrize("kind", ["scale.none", KINDS["views.tearing"]], ids=["by its code", "of a check"])
def test_a_finding_is_its_sentence_with_a_code(kind):
    finding = Finding(kind, "Look.")
    expected = KINDS[kind] if isinstance(kind, str) else kind
    assert finding == "Look." and f"- {finding}" == "- Look." and " ".join([finding]) == "Look."
    assert json.loads(json.dumps([finding])) == ["Look."]
    for same in (copy.deepcopy(finding), copy.copy(finding), pickle.loads(pickle.dumps(finding))):
        assert same == finding and same.kind == expected
        assert same.is_reason is (expected.severity is Severity.REASON)
    labelled = finding.labelled("Image 2: ")
    assert (labelled, labelled.code) == ("Image 2: Look.", expected.code)
    assert as_records([finding], [finding]) == [
        {"code": expected.code, "severity": expected.severity.value, "text": "Look."}
    ]
    with pytest.raises(AttributeError):
        finding.code = "views.moved"


@pytest.mark.parametrize("code", ["pose.upside-down", "views.tearing"])
def test_only_codes_of_readers_and_jobs_stand_for_their_kinds(code):
    """The codes of checks are declared above this layer: a check passes its kind."""
    with pytest.raises(KeyError, match=code):
        Finding(code, "Look.")


def test_a_sentence_has_a_few_names_of_limited_length():
    names = [f"f{n}" for n in range(7)]
    assert some_names(names[:1]) == "f0" and some_names(names[:5]) == "f0, f1, f2, f3, f4"
    assert some_names(names) == "f0, f1, f2, f3, f4 and 2 more"
    assert some_names(["n" * 60, "m" * 61]) == f"{'n' * 60}, {'m' * 60}..."


def test_what_is_warned_is_noted_once_inside_and_outside():
    alpha, turned = Finding("image.alpha", "Dropped."), Finding("image.rotated", "Turned.")

    def check(*messages: Finding) -> None:
        for message in messages:
            warn(message)

    with warnings.catch_warnings(record=True) as heard, captured_warnings() as outer:
        warnings.simplefilter("always")
        check(alpha)
        with captured_warnings() as inner:
            check(turned, alpha, turned)
    assert inner == [turned, alpha] and outer == [alpha, turned] == list(dedupe(outer, inner))
    assert [warning.message.args[0].code for warning in heard][:2] == ["image.alpha", "image.rotated"]
    assert heard[0].filename == __file__  # where the checking function was called


def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _found(tree: ast.Module, node_type: type) -> list:
    return [node for node in ast.walk(tree) if isinstance(node, node_type)]


def _calls(tree: ast.Module, name: str) -> list[ast.Call]:
    return [
        call for call in _found(tree, ast.Call) if isinstance(call.func, ast.Name) and call.func.id == name
    ]


def _codes_in_use() -> set[str]:
    """First arguments of ``Finding`` everywhere, if they are written out."""
    firsts = [call.args[0] for path in PACKAGE.rglob("*.py") for call in _calls(_tree(path), "Finding")]
    return {first.value for first in firsts if isinstance(first, ast.Constant)}


def test_every_code_is_used_and_every_used_one_is_in_the_table():
    assert _codes_in_use() == set(FINDINGS)


def test_every_kind_that_a_check_declares_is_listed_and_used():
    trees = {path.stem: _tree(path) for path in (PACKAGE / "trust").glob("*.py")}
    imported = {
        (node.module, alias.name)
        for tree in trees.values()
        for node in _found(tree, ast.ImportFrom)
        for alias in node.names
    }
    codes: list[str] = []
    for module, tree in trees.items():
        kinds = {
            node.targets[0].id: node.value.args[0].value
            for node in tree.body
            if isinstance(node, ast.Assign) and node.value in _calls(tree, "FindingKind")
        }
        codes += kinds.values()
        loads = [node.id for node in _found(tree, ast.Name) if isinstance(node.ctx, ast.Load)]
        for name, code in kinds.items():
            is_imported = (f"geodiff_plugin.trust.{module}", name) in imported
            assert loads.count(name) > 1 or is_imported, f"{code} is only listed"
    assert sorted(codes) == sorted(set(KINDS) - set(FINDINGS))


def test_every_code_has_a_group_a_title_a_cause_and_a_hint():
    assert {code.partition(".")[0] for code in KINDS} == set(GROUPS)
    for code, kind in KINDS.items():
        assert kind.code == code and re.fullmatch(r"[a-z]+\.[a-z]+(-[a-z]+)*", code), code
        assert not kind.title.endswith("."), code
        assert kind.cause.endswith(".") and kind.hint.endswith("."), code
    assert len({kind.title for kind in KINDS.values()}) == len(KINDS)


def _tables() -> str:
    """A table of every group of codes."""
    lines = []
    for group, heading in GROUPS.items():
        lines += [
            "",
            f"## {heading}",
            "",
            "| code | meaning | likely cause | what to do |",
            "| --- | --- | --- | --- |",
        ]
        for code, kind in KINDS.items():
            if code.partition(".")[0] == group:
                mark = " **Not trusted.**" if kind.severity is Severity.REASON else ""
                lines.append(f"| `{code}` | {kind.title}.{mark} | {kind.cause} | {kind.hint} |")
    return "\n".join([*lines, "", ""])


def test_the_page_of_messages_is_up_to_date():
    """``GEODIFF_WRITE=1 pytest tests/unit/test_findings.py`` regenerates its tables."""
    check_generated(PAGE, BEGIN, _tables(), END)


def test_titles_state_the_limits_of_their_checks():
    assert f"above {Epipolar.WARNS_PX:g} px ({FITS_PX:g} px for" in KINDS["pose.refined"].title
    percent = 100 * (math.exp(KnownPoints.MAX_LOG_RATIO) - 1)
    assert f"more than {percent:.0f} %" in KINDS["points.factor"].title
    remarked, most = map(math.exp, (PriorScale.REMARKED_LOG_RATIO, PriorScale.MAX_LOG_RATIO))
    assert KINDS["prior.metres"].title.endswith(f"by a factor of {remarked:.3g} to {most:.3g}")


def test_debugging_page_names_codes_that_exist():
    """A word in code style that begins with a group, followed by a dot, is a code if it is no file."""
    text = (DOCS / "how-to" / "debugging-a-pair.md").read_text(encoding="utf-8")
    named = set(re.findall(rf"`((?:{'|'.join(GROUPS)})\.(?!npy|csv|png)[a-z-]+)`", text))
    assert len(named) > 10 and named <= set(KINDS), named - set(KINDS)
