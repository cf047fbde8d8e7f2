"""Settings are declared once, as fields: how each is typed, described and checked follows from that."""

from dataclasses import MISSING, dataclass, field
from pathlib import Path

import pytest

from geodiff_plugin._internal.checks import InputError, check_range
from geodiff_plugin.settings import Affects, Setting, check_settings, names_affecting, setting, settings_of


@dataclass(frozen=True)
class Some:
    """A setting for every rule; ``plain`` and ``other`` are none."""

    plain: int = 3
    source: Path = setting(None, "A source.", "", affects=Affects.INPUTS)
    first_side: float = setting(1.0, "A number.", low=0.5, high=2.0, affects=Affects.RESULT)
    whole: int | None = setting(None, "A whole number.", low=1, high=9, unset="as many as fit")
    length: float | None = setting(None, "A length.", above_0="metres", affects=Affects.RESULT)
    kinds: tuple[str, ...] = setting((), "Kinds.", "--kind", "-k", choices=("a", "b"))
    sizes: tuple[int, ...] = setting((), "Sizes.", low=2, high=4)
    ends: tuple[float, float] = setting((1.0, 2.0), "Ends.", own_check=check_range, own_values="a pair")
    loud: bool = setting(False, "Loud.")
    word: str = setting("word", "A word.")
    other: int = field(default=4, metadata={"unit": "m"})


SETTINGS = settings_of(Some)


def test_only_declared_fields_are_settings_and_they_know_their_fields():
    assert list(SETTINGS) == "source first_side whole length kinds sizes ends loud word".split()
    kinds = {name: (each.kind, each.several) for name, each in SETTINGS.items()}
    assert kinds == {
        "source": (Path, False),
        "first_side": (float, False),
        "whole": (int, False),
        "length": (float, False),
        "kinds": (str, True),
        "sizes": (int, True),
        "ends": (tuple[float, float], False),
        "loud": (bool, False),
        "word": (str, False),
    }
    assert all(name == each.name and getattr(Some(), name) == each.default for name, each in SETTINGS.items())


def test_a_flag_is_that_of_the_declaration_or_the_name_with_dashes():
    flags = {name: each.flag for name, each in SETTINGS.items()}
    assert flags["first_side"] == "--first-side" and flags["kinds"] == "--kind"
    assert flags["source"] == "SOURCE" and SETTINGS["source"].is_argument
    assert not SETTINGS["kinds"].is_argument and not SETTINGS["word"].is_argument


def test_a_declaration_keeps_what_it_is_given():
    rules = {"section": "Section", "low": 1.0, "high": 9.0, "metavar": "WORD", "comma_separated": True}
    made = setting(5, "Help.", "--flag", "-f", **rules)
    assert made.default == 5
    assert made.metadata["setting"] == Setting("Help.", ("--flag", "-f"), **rules)
    bare = setting(MISSING, "Help.")
    assert bare.default is MISSING and bare.metadata["setting"] == Setting("Help.")
    assert Setting("Help.").section == "Options" and Setting("Help.").affects is None
    with pytest.raises(TypeError):
        setting(5, "Help.", lowest=3)


def test_values_are_described_in_words():
    values = {name: each.values for name, each in SETTINGS.items()}
    assert values["first_side"] == "[0.5, 2]" and values["whole"] == "integer, [1, 9], or `None`"
    assert values["kinds"] == "`a`, `b`" and values["loud"] == "bool" and values["ends"] == "a pair"
    assert values["word"] == values["source"] == ""


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"first_side": 0.49}, "--first-side must be between 0.5 and 2"),
        ({"first_side": 2.01}, "--first-side must be between 0.5 and 2"),
        ({"first_side": "1"}, "--first-side must be a number"),
        ({"first_side": None}, "--first-side must be a number"),
        ({"whole": 0}, "--whole must be between 1 and 9"),
        ({"whole": 2.0}, "--whole must be an integer"),
        ({"length": 0.0}, "--length must be a finite number of metres above 0"),
        ({"kinds": ("a", "c")}, "--kind must be one of a, b"),
        ({"kinds": "a"}, "--kind must be a tuple"),
        ({"sizes": (3, 5)}, "--sizes must be between 2 and 4"),
        ({"ends": (2.0, 1.0)}, "--ends must be a pair"),
        ({"loud": "yes"}, "--loud must be True or False"),
    ],
)
def test_values_are_held_against_what_is_declared(given, said):
    with pytest.raises(InputError, match=said):
        check_settings(Some(**given))
    with pytest.raises(InputError, match="^<"):
        check_settings(Some(**given), lambda each: f"<{each.name}>")


def test_values_within_the_rules_pass():
    check_settings(Some())
    check_settings(Some(3, "anything", 2, 9, 1e-9, ("b", "a"), [2, 4], (1, 2), True, "x", None))


def test_a_check_returns_the_value_to_keep():
    kept = SETTINGS["first_side"].check(1, "side")
    assert kept == 1.0 and isinstance(kept, float)
    assert SETTINGS["sizes"].check([2, 3], "sizes") == (2, 3)
    assert SETTINGS["ends"].check([1, 2], "ends") == (1.0, 2.0)
    assert SETTINGS["whole"].check(None, "whole") is None


def test_settings_are_found_by_what_they_affect():
    assert names_affecting(Some, Affects.RESULT) == ["first_side", "length"]
    assert names_affecting(Some, Affects.INPUTS) == ["source"] and not names_affecting(Some, Affects.POSES)
