"""What ``geodiff eval`` prints of its pages, and the list of data sets and methods."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.cli import eval as module
from geodiff_plugin.cli.eval import eval_app, run_and_show
from geodiff_plugin.evaluation import baselines, datasets
from geodiff_plugin.evaluation.options import COMMANDS


class Table:
    title, note, rows = "Errors", "smaller is better", [("a", "0.1"), ("b", "0.2")]

    def full_header(self):
        return ["method", "AbsRel"]


def page(*broken: str) -> SimpleNamespace:
    return SimpleNamespace(
        title="A page",
        facts={"command": "geodiff eval zero"},
        origin=lambda: "today",
        remarks=["A remark."],
        tables=[Table()],
        broken=broken,
    )


def options(out, quiet=False) -> SimpleNamespace:
    return SimpleNamespace(out=out, quiet=quiet)


def test_a_page_is_printed_with_its_tables_and_its_folder(tmp_path, capsys):
    asked = []
    given = options(tmp_path / "out")
    run_and_show(lambda made: asked.append(made) or page(), given)
    lines = [" ".join(line.split()) for line in capsys.readouterr().out.splitlines() if line.strip()]
    assert asked == [given]
    assert lines[:4] == ["A page", "geodiff eval zero", "today", "A remark."]
    for line in ("Errors", "method AbsRel", "a 0.1", "b 0.2", "smaller is better"):
        assert line in lines
    assert lines[-1] == f"-> {tmp_path / 'out'}/"


def test_a_figure_is_its_path_and_quiet_prints_nothing(tmp_path, capsys):
    run_and_show(lambda made: Path("figure.pdf"), options(tmp_path))
    assert capsys.readouterr().out == "figure.pdf\n"
    for result in (Path("figure.pdf"), page(), None):
        run_and_show(lambda made, result=result: result, options(tmp_path, quiet=True))
        assert capsys.readouterr().out == ""
    run_and_show(lambda made: None, options(tmp_path))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("count", "words"),
    [
        (1, "1 broken sample was left out: s0. The same"),
        (9, "9 broken samples were left out: s0, s1, s2, s3, s4, s5, s6, s7, s8. The same"),
        (10, "s7, s8, .... The same"),
    ],
)
def test_samples_that_were_left_out_are_said_and_end_with_code_4(tmp_path, capsys, count, words):
    broken = [f"s{n}" for n in range(count)]
    with pytest.raises(SystemExit) as leaving:
        run_and_show(lambda made: page(*broken), options(tmp_path, quiet=True))
    assert leaving.value.code == 4 and words in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(tmp_path):
    (tmp_path / "file").write_text("text")
    with pytest.raises(InputError):
        run_and_show(lambda made: pytest.fail("the work was begun"), options(tmp_path / "file"))


def run(*words) -> int:
    try:
        return eval_app([str(word) for word in words], standalone_mode=False) or 0
    except SystemExit as leaving:
        return leaving.code


def test_every_command_measures_and_shows(monkeypatch):
    asked = []
    for name, command in module._COMMANDS.items():
        assert command.run.func is run_and_show and command.run.args == (COMMANDS[name].run,)
        assert command.options is COMMANDS[name].options and command.about == COMMANDS[name].about
        asked.append(name)
    assert asked == list(COMMANDS) and "list" not in COMMANDS


def test_the_list_says_what_is_there_and_how_to_get_the_rest(monkeypatch, capsys, tmp_path):
    counts = {"one": 1, "two": 2, "none": 0, "made": 0}
    monkeypatch.setattr(
        datasets,
        "DATASETS",
        {name: SimpleNamespace(needs_folder=name != "made", obtain=f"Get {name}.") for name in counts},
    )
    asked = []

    def find_pairs(folder, names):
        asked.append(folder)
        return ["sample"] * counts[names[0]]

    def plane(prior):
        """Fits a plane; the simplest."""

    class Alone:
        """Alone. Nothing else."""

    monkeypatch.setattr(datasets, "find_pairs", find_pairs)
    monkeypatch.setattr(baselines, "METHODS", {"ours": SimpleNamespace(summary="the method")})
    monkeypatch.setattr(baselines, "FAMILIES", {"plane": plane, "alone": Alone})
    assert run("list", "--data", tmp_path) == 0
    text = " ".join(capsys.readouterr().out.split())
    for part in (
        "one 1 sample Get one.",
        "two 2 samples Get two.",
        "none not found Get none.",
        "made any number of samples Get made.",
        "ours the method",
        "plane:... fits a plane",
        "alone:... alone",
        "METHOD@PRIOR",
        "METHOD#SEED",
    ):
        assert part in text, text
    assert asked == [tmp_path] * 4 and "the simplest" not in text and "Nothing else" not in text
    assert run("list") == 0
    text = " ".join(capsys.readouterr().out.split())
    assert "one no --data given Get one." in text and len(asked) == 4
    assert "made any number of samples" in text
