"""Options of dataclasses on a command line: what can be typed, what help shows, and what a command gets."""

import errno
from dataclasses import MISSING, dataclass
from pathlib import Path

import pytest
from click.testing import CliRunner

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.cli.commands import new_group
from geodiff_plugin.jobs.stopping import Terminated
from geodiff_plugin.options import OUTPUT, SPEED, Command
from geodiff_plugin.settings import setting


@dataclass(frozen=True, kw_only=True)
class Options:
    """One option of every kind."""

    source: Path = setting(MISSING, "The source.", "", metavar="SRC")
    count: int = setting(3, "A count.", low=1, high=9)
    fraction: float | None = setting(None, "A share.", "--part", "-p")
    names: tuple[str, ...] = setting(("a", "b"), "Names.", comma_separated=True, choices=("a", "b", "c"))
    numbers: tuple[int, ...] = setting((), "Numbers.", comma_separated=True)
    files: tuple[Path, ...] = setting((), "Files; repeat it.")
    loud: bool = setting(False, "Be loud.", section=SPEED)
    out: str | None = setting(None, "Where to.", section=OUTPUT)
    hidden: int = 7


@pytest.fixture
def typed():
    """What the commands got; a group with one of them and a group of its own inside."""
    got = []
    command = Command(Options, got.append, "Does something.")
    leaf = Command(Options, lambda made: got.append(("leaf", made)), "A leaf.")
    inner = new_group("Inner.", {"leaf": leaf, "twig": leaf})
    return got, new_group("Outer.", {"run": command, "more": Command(None, lambda _: inner, "More.")}, True)


def call(group, *words) -> tuple[int, str]:
    ran = CliRunner().invoke(group, [str(word) for word in words], prog_name="outer")
    if ran.exception and not isinstance(ran.exception, SystemExit):
        raise ran.exception
    return ran.exit_code, ran.output


def test_what_is_typed_is_given_in_the_types_of_the_fields(typed):
    got, group = typed
    words = ["run", "src", "--count", 5, "-p", "0.25", "--names", " b , c ", "--numbers", "3,1"]
    code, said = call(group, *words, "--files", "x", "--files", "y", "--loud", "--out", "o")
    assert code == 0, said
    (made,) = got
    assert made == Options(
        source=Path("src"),
        count=5,
        fraction=0.25,
        names=("b", "c"),
        numbers=(3, 1),
        files=(Path("x"), Path("y")),
        loud=True,
        out="o",
    )
    assert isinstance(made.count, int) and isinstance(made.fraction, float)


def test_what_is_not_typed_is_the_default_of_its_field(typed):
    got, group = typed
    assert call(group, "run", "src") == (0, "")
    assert got == [Options(source=Path("src"))]
    assert call(group, "more", "leaf", "src", "--names", "")[0] == 0
    assert got[1] == ("leaf", Options(source=Path("src"), names=()))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--count", "2.5"], "--count must be an integer; got '2.5'. Enter only the number"),
        (["--count", "x"], "--count must be an integer; got 'x'."),
        (["-p", "0,12"], "--part must be a number; got '0,12'. Use a decimal point: 0.12."),
        (["-p", "3m"], "--part must be a number; got '3m'. Enter only the number; --help states its unit."),
        (["--count", "10"], "--count must be between 1 and 9; got 10"),
        (["--names", "a,d"], "--names must be one of a, b, c; got 'd'"),
        (["--numbers", "1,x"], "--numbers must be comma-separated integers; got '1,x'."),
        (["--numbers", "1,2.5"], "--numbers must be comma-separated integers"),
    ],
)
def test_what_an_option_cannot_be_is_one_line_and_code_2(typed, words, said, capsys):
    got, group = typed
    with pytest.raises(SystemExit) as leaving:
        group.main(["run", "src", *words])
    assert leaving.value.code == 2 and got == []
    err = capsys.readouterr().err
    assert err.startswith(f"geodiff: {said}") and err.count("\n") == 1


def test_help_shows_every_declared_option_in_its_group_with_its_default(typed):
    _, group = typed
    code, text = call(group, "run", "--help")
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert code == 0 and "hidden" not in text
    for part in (
        "Usage: outer run [OPTIONS] SRC",
        "SRC The source.",
        "--count NUMBER A count. [default: 3]",
        "-p, --part NUMBER A share.",
        "--names TEXT Names. [default: a, b]",
        "--numbers NUMBER Numbers.",
        "--files PATH Files; repeat it.",
        "--loud Be loud.",
        "--out TEXT Where to.",
        "-h, --help Show this message and exit.",
    ):
        assert part in lines, (part, text)
    places = [text.index(f"\n{title}:") for title in ("Positional arguments", "Options", OUTPUT, SPEED)]
    assert places == sorted(places)
    between = text[text.index(f"\n{OUTPUT}") : text.index(f"\n{SPEED}")]
    assert "--out" in between and "--help" in between and "--loud" not in between
    code, text = call(group, "--help")
    assert "Outer." in text and "Does something." in text and "More." in text
    assert "A leaf." in call(group, "more", "-h")[1] and call(group, "nothing")[0] == 2


def test_all_choices_together_are_called_all():
    @dataclass(frozen=True, kw_only=True)
    class All:
        names: tuple[str, ...] = setting(("a", "b"), "Names.", comma_separated=True, choices=("b", "a"))

    group = new_group(
        "G.", {"x": Command(All, lambda made: None, "X."), "y": Command(All, print, "Y.")}, True
    )
    assert "Names. [default: all]" in call(group, "x", "--help")[1]


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("it is torn"), 2, "geodiff: it is torn\n"),
        (
            KeyboardInterrupt(),
            130,
            "geodiff: interrupted. Run the same command again to resume or restart.\n",
        ),
        (Terminated(), 143, "geodiff: terminated. Run the same command again to resume or restart.\n"),
        (MemoryError(), 2, "geodiff: out of memory. Downscale the images"),
        (RuntimeError("CUDA out of memory"), 2, "geodiff: out of memory."),
    ],
)
def test_what_ends_a_command_is_a_line_and_an_exit_code(error, code, said, capsys):
    def fails(_):
        raise error

    group = new_group("G.", {"x": Command(Options, fails, "X."), "y": Command(Options, fails, "Y.")}, True)
    with pytest.raises(SystemExit) as leaving:
        group.main(["x", "src"])
    assert leaving.value.code == code and capsys.readouterr().err.startswith(said)


def test_a_defect_keeps_its_traceback():
    def fails(_):
        raise OSError(errno.EIO, "a defect")

    group = new_group("G.", {"x": Command(Options, fails, "X."), "y": Command(Options, fails, "Y.")}, True)
    with pytest.raises(OSError, match="a defect"):
        group.main(["x", "src"])
