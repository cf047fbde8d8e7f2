"""Every kind of bad input ends in one line, the one in ``bad_input.txt``; nothing loads or is written.

After a message was changed on purpose: ``GEODIFF_WRITE=1 pytest tests/cli/test_bad_input.py``, and read what
differs.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.cli.bad_inputs import KINDS

TABLE = Path(__file__).with_name("bad_input.txt")
WRITE = bool(os.environ.get("GEODIFF_WRITE"))


def read_table() -> dict[str, str]:
    lines = TABLE.read_text(encoding="utf-8").splitlines() if TABLE.is_file() else []
    return dict(line.split(": ", 1) for line in lines)


MESSAGES = read_table()


def test_there_are_many_kinds_and_each_has_its_message():
    assert len(KINDS) >= 80
    assert WRITE or list(MESSAGES) == list(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_bad_input(kind, geodiff, pair_files, monkeypatch):
    def load(*_args, **_kwargs):
        raise AssertionError("weights were loaded before the input was checked")

    monkeypatch.setattr("geodiff_plugin.cli.depth.load_guided_prior", load)
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    words = KINDS[kind](pair_files.folder)
    before = sorted(pair_files.folder.rglob("*"))
    answer = geodiff("depth", *words)
    assert (answer.code, answer.out) == (2, ""), answer
    *warned, line = answer.err.strip().splitlines()
    assert all(each.startswith("warning: ") for each in warned), answer.err
    assert line.startswith("geodiff: ") and len(line) < 2000, line
    assert sorted(pair_files.folder.rglob("*")) == before
    message = line.removeprefix("geodiff: ").replace(str(pair_files.folder), "DIR")
    if WRITE:
        MESSAGES[kind] = message
        kept = {name: MESSAGES[name] for name in KINDS if name in MESSAGES}
        TABLE.write_text("".join(f"{name}: {text}\n" for name, text in kept.items()), encoding="utf-8")
    assert message == MESSAGES[kind]
