"""Failures of many items: each cause is told once, with the items that it struck."""

import errno

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.jobs.failures import DiskFull, Failures, full_disk
from geodiff_plugin.jobs.journal import Item


def failures(total: int = 9):
    told = []
    return Failures(total, "pair", told.append), told


def test_the_first_failure_waits_until_another_item_passes_or_fails_otherwise():
    found, told = failures()
    assert found.add(Item("a"), InputError("a is torn")) == "a is torn"
    assert told == []
    found.passed()
    assert told == ["geodiff: a: a is torn"]
    found.add(Item("b"), InputError("b is torn"))
    assert len(told) == 1, "the same cause"
    found.add(Item("c"), OSError("other"))
    assert told[1:] == ["geodiff: c: other"]
    found.report()
    assert told[2:] == ["geodiff: 2 of 9 pairs failed for one reason: a, b."]


def test_two_causes_are_told_without_waiting():
    found, told = failures()
    found.add(Item("a"), InputError("one"))
    found.add(Item("b"), InputError("two"))
    assert told == ["geodiff: a: one", "geodiff: b: two"]


def test_what_fails_all_items_is_raised_and_one_item_alone_is_told():
    found, told = failures(2)
    for name in "ab":
        found.add(Item(name, name=f"item {name}"), InputError(f"item {name} is torn"))
    with pytest.raises(InputError) as caught:
        found.report()
    said = "item a: item a is torn The same holds for all 2 pairs; nothing was computed."
    assert str(caught.value) == said and told == []
    found, told = failures(1)
    found.add(Item("a"), InputError("torn"))
    found.report()
    assert told == ["geodiff: a: torn"]
    found, told = failures(3)
    for name in "ab":
        found.add(Item(name), InputError("torn"))
    found.report()
    assert told == ["geodiff: a: torn", "geodiff: 2 of 3 pairs failed for one reason: a, b."]


def test_at_most_five_items_of_a_cause_are_named():
    for count, names in ((5, "i0, i1, i2, i3, i4."), (6, "i0, i1, i2, i3, i4, ....")):
        found, told = failures()
        for number in range(count):
            found.add(Item(f"i{number}"), InputError("torn"))
        found.report()
        assert told[-1] == f"geodiff: {count} of 9 pairs failed for one reason: {names}"


def test_words_of_an_item_are_no_part_of_its_cause():
    found, told = failures()
    found.passed()
    found.add(Item("a", words=("in/a", "in/a/left.png")), InputError("in/a/left.png of in/a is torn"))
    found.add(Item("b", words=("in/b", "in/b/left.png")), InputError("in/b/left.png of in/b is torn"))
    assert len(told) == 1
    found.add(Item("c", words=("in/c",)), InputError("in/c/left.png of in/c is torn"))
    assert len(told) == 2, "another cause: its picture is no word of it"


def test_a_defect_is_told_with_its_traceback_and_type():
    found, told = failures()
    assert found.add(Item("a"), KeyError("x")) == "KeyError: 'x'"
    assert len(told) == 1 and told[0].endswith("KeyError: 'x'") and not told[0].endswith("\n")
    found.add(Item("b"), KeyError("x"))
    assert len(told) == 1
    found.passed()
    assert told[1] == "geodiff: a: KeyError: 'x'"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_a_full_disk_is_found_behind_other_errors(number):
    full = OSError(number, "it is full")
    try:
        try:
            raise full
        except OSError:
            raise ValueError("while writing")  # noqa: B904 - the context counts too
    except ValueError as error:
        by_context = error
    by_cause = RuntimeError("behind")
    by_cause.__cause__ = by_context
    for error in (full, by_context, by_cause):
        found = full_disk(error)
        assert isinstance(found, DiskFull)
        assert str(found).startswith("The disk of --out is full (it is full). Finished pairs stay;")
        assert full_disk(found) is found
    for other in (OSError(errno.EACCES, "no"), ValueError("full"), KeyError(errno.ENOSPC)):
        assert full_disk(other) is None
    odd = ValueError("not of the system")
    odd.errno = errno.ENOSPC
    assert full_disk(odd) is None
