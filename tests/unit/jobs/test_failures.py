"""Failures of many items: each cause is reported once, with the affected items."""

import errno

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.failures import DiskFull, Failures, full_disk
from geodiff_plugin.jobs.journal import Item


def failures(total: int = 9):
    reported = []
    return Failures(total, "pair", reported.append), reported


def test_the_first_failure_waits_until_another_item_passes_or_fails_otherwise():
    found, reported = failures()
    assert found.add(Item("a"), InputError("a is torn")) == "a is torn"
    assert reported == []
    found.passed()
    assert reported == ["geodiff: a: a is torn"]
    found.add(Item("b"), InputError("b is torn"))
    assert len(reported) == 1, "the same cause"
    found.add(Item("c"), OSError("other"))
    assert reported[1:] == ["geodiff: c: other"]
    found.report()
    assert reported[2:] == ["geodiff: 2 of 9 pairs failed for the same reason: a, b."]


def test_two_causes_are_reported_without_waiting():
    found, reported = failures()
    found.add(Item("a"), InputError("one"))
    found.add(Item("b"), InputError("two"))
    assert reported == ["geodiff: a: one", "geodiff: b: two"]


def test_an_error_of_all_items_is_raised_and_of_one_item_is_reported():
    found, reported = failures(2)
    for name in "ab":
        found.add(Item(name, name=f"item {name}"), InputError(f"item {name} is torn"))
    with pytest.raises(InputError) as caught:
        found.report()
    said = "item a: item a is torn All 2 pairs failed for this reason; nothing was computed."
    assert str(caught.value) == said and reported == []
    found, reported = failures(1)
    found.add(Item("a"), InputError("torn"))
    found.report()
    assert reported == ["geodiff: a: torn"]
    found, reported = failures(3)
    for name in "ab":
        found.add(Item(name), InputError("torn"))
    found.report()
    assert reported == ["geodiff: a: torn", "geodiff: 2 of 3 pairs failed for the same reason: a, b."]


def test_at_most_five_items_of_a_cause_are_named():
    for count, names in ((5, "i0, i1, i2, i3, i4."), (6, "i0, i1, i2, i3, i4 and 1 more.")):
        found, reported = failures()
        for number in range(count):
            found.add(Item(f"i{number}"), InputError("torn"))
        found.report()
        assert reported[-1] == f"geodiff: {count} of 9 pairs failed for the same reason: {names}"


def test_words_of_an_item_are_no_part_of_its_cause():
    found, reported = failures()
    found.passed()
    found.add(Item("a", words=("in/a", "in/a/left.png")), InputError("in/a/left.png of in/a is torn"))
    found.add(Item("b", words=("in/b", "in/b/left.png")), InputError("in/b/left.png of in/b is torn"))
    assert len(reported) == 1
    found.add(Item("c", words=("in/c",)), InputError("in/c/left.png of in/c is torn"))
    assert len(reported) == 2, "another cause: its picture is no word of it"


def test_longer_words_are_left_out_before_the_shorter_ones_in_them():
    found, reported = failures()
    found.passed()
    found.add(Item("1", words=("z", "az")), InputError("az is torn"))
    found.add(Item("2", words=("z", "bz")), InputError("bz is torn"))
    assert len(reported) == 1


def test_a_bug_is_reported_with_its_traceback_and_type():
    found, reported = failures()
    assert found.add(Item("a"), KeyError("x")) == "KeyError: 'x'"
    assert len(reported) == 1 and reported[0].endswith("KeyError: 'x'") and not reported[0].endswith("\n")
    found.add(Item("b"), KeyError("x"))
    assert len(reported) == 1
    found.passed()
    assert reported[1] == "geodiff: a: KeyError: 'x'"


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
        assert str(found).startswith("The disk of --out is full (it is full). Finished pairs are kept;")
        assert full_disk(found) is found
    for other in (OSError(errno.EACCES, "no"), ValueError("full"), KeyError(errno.ENOSPC)):
        assert full_disk(other) is None
    odd = ValueError("not of the system")
    odd.errno = errno.ENOSPC
    assert full_disk(odd) is None
