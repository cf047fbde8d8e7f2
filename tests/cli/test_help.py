"""Help and ``geodiff info`` as a terminal shows them."""

import re

import pytest

from geodiff_plugin.cli.app import COMMANDS, main
from geodiff_plugin.evaluation.options import COMMANDS as EVALUATIONS
from geodiff_plugin.options import rules_of

#: Lines of a terminal that has 80 columns, with some to spare.
SCREEN_LINES = 30
WORDS = [[], *([name] for name in COMMANDS), *(["eval", name] for name in EVALUATIONS)]


def _help(words, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", str(columns))
    with pytest.raises(SystemExit) as ended:
        main([*words, "--help"])
    assert not ended.value.code
    return capsys.readouterr().out


@pytest.mark.parametrize("words", WORDS, ids=" ".join)
def test_every_group_of_options_fits_one_screen(words, capsys, monkeypatch):
    lines = _help(words, 80, capsys, monkeypatch).splitlines()
    assert max(map(len, lines)) <= 80
    starts = [number for number, line in enumerate(lines) if line.startswith("╭")]
    ends = [number for number, line in enumerate(lines) if line.startswith("╰")]
    assert starts and len(starts) == len(ends)
    assert max(end - start + 1 for start, end in zip(starts, ends, strict=True)) <= SCREEN_LINES
    assert "…" not in "".join(lines)


def test_help_of_depth_begins_with_what_is_given_most_and_has_every_option(capsys, monkeypatch):
    text = _help(["depth"], 80, capsys, monkeypatch)
    titles = re.findall(r"^╭─ (.*?) ─+╮$", text, re.MULTILINE)
    assert titles[:3] == ["Arguments", "Cameras", "Output"]
    assert len(titles) == len(set(titles))
    for field in COMMANDS["depth"].options.__dataclass_fields__.values():
        rules = rules_of(field)
        if rules and not rules.is_argument:
            flags = rules.flags or (f"--{field.name.replace('_', '-')}",)
            assert len(re.findall(rf"^│ {flags[0]}(?= )", text, re.MULTILINE)) == 1, flags


def test_defaults_of_lists_are_in_the_sentence_and_switches_have_no_type(capsys, monkeypatch):
    said = {words: _help(words.split(), 80, capsys, monkeypatch) for words in ("", "eval", "eval pairs")}
    sentence = " ".join(said["eval pairs"].replace("│", " ").split())
    assert "names them (default: prior-aligned, search-only, paper, guided, sgbm)." in sentence
    assert "<bool>" not in said[""] + said["eval"]


@pytest.mark.parametrize("words", [[], ["--prior", "bundled"], ["--knobs"]], ids=" ".join)
def test_info_fits_eighty_columns_of_a_terminal(words, capsys, monkeypatch):
    from geodiff_plugin.cli import info

    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # as a terminal answers
    long_name = f"{'organisation' * 4}/{'model' * 10}"
    monkeypatch.setattr(info, "_cached_models", lambda: [long_name])
    main_ended_well(["info", *words])
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    if "--knobs" not in words:
        values = "".join(line[16:].strip() for line in lines)
        assert long_name in values


def main_ended_well(words):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
