"""Help and ``geodiff info`` as a terminal shows them."""

import re

import pytest

from geodiff_plugin.cli.app import COMMANDS, main
from geodiff_plugin.evaluation.options import COMMANDS as EVALUATIONS
from geodiff_plugin.settings import settings_of

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
    sections = "\n".join(lines).split("\n\n")
    assert len(sections) > 2 and max(len(section.splitlines()) for section in sections) <= SCREEN_LINES
    assert not [line for line in lines if re.search(r"--\S*-$", line)], "an option is divided"


def test_help_of_depth_begins_with_what_is_given_most_and_has_every_option(capsys, monkeypatch):
    text = _help(["depth"], 80, capsys, monkeypatch)
    titles = re.findall(r"^(\w.*):$", text, re.MULTILINE)
    assert titles[:3] == ["Positional arguments", "Cameras", "Output"]
    assert len(titles) == len(set(titles))
    for option in settings_of(COMMANDS["depth"].options).values():
        flag = f"(?:-., )?{option.flag}|\\[{option.flag}\\]"
        assert len(re.findall(rf"^  (?:{flag})(?=\s)", text, re.MULTILINE)) == 1, flag


def test_help_of_live_describes_its_own_inputs_and_poses(capsys, monkeypatch):
    """It has neither LEFT nor RIGHT, and refines poses with every preset."""
    text = " ".join(_help(["live"], 80, capsys, monkeypatch).split())
    assert not re.search(r"\b(LEFT|RIGHT)\b", text) and "poses used as given" not in text


def test_defaults_of_lists_follow_the_sentence(capsys, monkeypatch):
    sentence = " ".join(_help(["eval", "pairs"], 80, capsys, monkeypatch).split())
    assert "shows them. [default: prior-aligned, search-only, paper, guided, sgbm]" in sentence


@pytest.mark.parametrize("words", [[], ["--prior", "bundled"], ["--parameters"]], ids=" ".join)
def test_info_fits_eighty_columns_of_a_terminal(words, capsys, monkeypatch):
    from geodiff_plugin.cli import info

    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TTY_COMPATIBLE", "1")  # as a terminal answers
    long_name = f"{'organisation' * 4}/{'model' * 10}"
    monkeypatch.setattr(info, "_cached_models", lambda: [long_name])
    main_ended_well(["info", *words])
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line.rstrip()) for line in lines) <= 80
    if "--parameters" not in words:
        values = "".join(line[16:].strip() for line in lines)
        assert long_name in values


def main_ended_well(words):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert not ended.value.code
