"""Codes of messages: one table, a page made of it, and every code in use."""

import ast
import copy
import json
import os
import pickle
import re
import warnings
from pathlib import Path

import pytest

import geodiff_plugin
from geodiff_plugin._checks import noted, warn
from geodiff_plugin.messages import GROUPS, MESSAGES, Message, as_records, distinct
from geodiff_plugin.result.verdict import EXPLAINING, ON_EDGE, REASONS, REMARKS, SAME_PICTURE

PACKAGE = Path(geodiff_plugin.__file__).parent
DOCS = PACKAGE.parent / "docs"
PAGE = DOCS / "reference" / "messages.md"
#: What is called with a code as its first argument.
MAKERS = ("Message", "Rule")
BEGIN, END = "<!-- made by tests/unit/test_message_codes.py -->\n", "<!-- end -->"


def test_a_message_is_its_sentence_with_a_code():
    message = Message("pose.inverse", "Turn it.")
    assert message == "Turn it." and f"- {message}" == "- Turn it." and " ".join([message]) == "Turn it."
    assert json.loads(json.dumps([message])) == ["Turn it."]
    for same in (copy.deepcopy(message), copy.copy(message), pickle.loads(pickle.dumps(message))):
        assert same == message and same.code == "pose.inverse" and same.forbids_trust
    labelled = message.labelled("Image 2: ")
    assert (labelled, labelled.code) == ("Image 2: Turn it.", "pose.inverse")
    assert as_records([message], [message]) == [
        {"code": "pose.inverse", "text": "Turn it.", "forbids_trust": True}
    ]
    with pytest.raises(KeyError, match="pose.upside-down"):
        Message("pose.upside-down", "Turn it.")
    with pytest.raises(AttributeError):
        message.code = "pose.opengl"


def test_what_is_warned_is_noted_once_inside_and_outside():
    alpha, turned = Message("image.alpha", "Dropped."), Message("image.turned", "Turned.")

    def check(*messages: Message) -> None:
        for message in messages:
            warn(message)

    with warnings.catch_warnings(record=True) as heard, noted() as outer:
        warnings.simplefilter("always")
        check(alpha)
        with noted() as inner:
            check(turned, alpha, turned)
    assert inner == [turned, alpha] and outer == [alpha, turned] == list(distinct(outer, inner))
    assert [warning.message.args[0].code for warning in heard][:2] == ["image.alpha", "image.turned"]
    assert heard[0].filename == __file__  # where the checking function was called


def _codes_in_use() -> set[str]:
    """First arguments of ``Message`` and ``Rule`` everywhere, where they are written out."""
    calls = [
        node
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in MAKERS
    ]
    return {call.args[0].value for call in calls if isinstance(call.args[0], ast.Constant)}


def test_every_code_is_used_and_every_used_one_is_in_the_table():
    assert _codes_in_use() == set(MESSAGES)


def test_every_code_says_what_it_means_and_what_to_do():
    assert {code.partition(".")[0] for code in MESSAGES} == set(GROUPS)
    for code, kind in MESSAGES.items():
        assert re.fullmatch(r"[a-z]+\.[a-z]+(-[a-z]+)*", code), code
        assert not kind.title.endswith("."), code
        assert kind.cause.endswith(".") and kind.cure.endswith("."), code
    assert len({kind.title for kind in MESSAGES.values()}) == len(MESSAGES)


def test_reasons_forbid_trust_and_remarks_do_not():
    assert SAME_PICTURE.forbids_trust and not ON_EDGE.forbids_trust
    assert all(MESSAGES[rule.code].forbids_trust for rule in (*EXPLAINING, *REASONS))
    assert not any(MESSAGES[rule.code].forbids_trust for rule in REMARKS)


def _tables() -> str:
    """A table of every group of codes."""
    lines = []
    for group, heading in GROUPS.items():
        lines += [
            "",
            f"## {heading}",
            "",
            "| code | what it says | cause | cure |",
            "| --- | --- | --- | --- |",
        ]
        for code, kind in MESSAGES.items():
            if code.partition(".")[0] == group:
                mark = " **Not trusted.**" if kind.forbids_trust else ""
                lines.append(f"| `{code}` | {kind.title}.{mark} | {kind.cause} | {kind.cure} |")
    return "\n".join([*lines, "", ""])


def test_the_page_of_messages_is_up_to_date():
    """``GEODIFF_WRITE=1 pytest tests/unit/test_message_codes.py`` makes its tables anew."""
    page = PAGE.read_text(encoding="utf-8")
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    assert begin and end
    made = f"{before}{begin}{_tables()}{end}{after}"
    if os.environ.get("GEODIFF_WRITE"):
        PAGE.write_text(made, encoding="utf-8")
    assert PAGE.read_text(encoding="utf-8") == made


def test_troubleshooting_names_codes_that_exist():
    """A word in code style that begins with a group, followed by a dot, is a code if it is no file."""
    text = (DOCS / "how-to" / "troubleshooting.md").read_text(encoding="utf-8")
    named = set(re.findall(rf"`((?:{'|'.join(GROUPS)})\.(?!npy|csv)[a-z-]+)`", text))
    assert len(named) > 10 and named <= set(MESSAGES), named - set(MESSAGES)
