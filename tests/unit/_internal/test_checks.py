"""Checks of user input: a table of what passes, what is rejected, and the error message."""

import inspect
import warnings
from functools import partial

import numpy as np
import pytest

from geodiff_plugin._internal import checks as c
from geodiff_plugin.findings import Finding

INFINITY, NAN = float("inf"), float("nan")


@pytest.mark.parametrize(
    ("check", "passing", "failing"),
    [
        (
            partial(c.check_number, name="x", low=1, high=32, integer=True),
            [1, 2, 32, np.int64(7)],
            [0, 33, 1.0, True, "1", None],
        ),
        (
            partial(c.check_number, name="x", low=-0.5, high=2.5),
            [-0.5, 0, 2.5, np.float32(1)],
            [-0.6, 2.6, INFINITY, NAN, True, "1"],
        ),
        (partial(c.check_number, name="x", low=0, high=INFINITY), [0, 1e300], [INFINITY, -1e-9, NAN]),
        (partial(c.check_number, name="x", low=-INFINITY, high=0), [0, -1e300], [-INFINITY, 1e-9]),
        (
            partial(c.check_positive, name="x", unit="metres"),
            [1e-300, 3, np.float64(2)],
            [0, -1, INFINITY, NAN, True, "2"],
        ),
        (partial(c.check_flag, name="x"), [True, False, np.True_], [0, 1, "yes", None]),
        (
            partial(c.check_size, name="x"),
            [None, (1, 1 << 24), [5, 3]],
            [(0, 5), (5, 0), (1 << 24) + 1, (5, (1 << 24) + 1), (1,), (1, 2, 3), (1.0, 2), "12", {1, 2}],
        ),
        (
            partial(c.check_choice, name="x", choices=("b", "a", 2)),
            ["a", "b", 2],
            ["c", 3, None, ["a"], 2.0, np.array(["a", "b"])],
        ),
        (
            partial(c.check_range, name="x"),
            [(1, 2), [1e-12, 1e12]],
            [(2, 1), (1, 1), (0, 1), (1, 2e12), (1,), (1, 2, 3), "12", (1, INFINITY)],
        ),
    ],
)
def test_values_within_their_limits_pass_unchanged_and_others_are_rejected(check, passing, failing):
    for value in passing:
        found = check(value)
        expected = tuple(value) if isinstance(value, list) else value
        assert found == expected and isinstance(
            found, type(expected) if not isinstance(value, np.bool_) else bool
        )
    for value in failing:
        with pytest.raises(c.InputError, match=r"^x must be .*; got .*\."):
            check(value)


def test_ranges_become_floats_and_flags_become_pythons():
    low, high = c.check_range([1, 2], "x")
    assert (type(low), type(high)) == (float, float) and (low, high) == (1.0, 2.0)
    assert c.check_flag(np.False_, "x") is False


@pytest.mark.parametrize(
    ("call", "sentence", "error"),
    [
        (lambda: c.bad_value("K", "a matrix", 3), "K must be a matrix; got 3.", c.InputError),
        (
            lambda: c.bad_value("K", "a matrix", 3, "Read it."),
            "K must be a matrix; got 3. Read it.",
            c.InputError,
        ),
        (
            lambda: c.bad_value("K", "a", "b\n  c\td", error=c.MissingFileError),
            "K must be a; got b c d.",
            FileNotFoundError,
        ),
        (lambda: c.bad_value("K", "a", "x" * 400), f"K must be a; got {'x' * 400}.", c.InputError),
        (lambda: c.bad_value("K", "a", "x" * 401), f"K must be a; got {'x' * 400}....", c.InputError),
        (
            lambda: c.bad_type("n", "an integer", 1.5, "Round it."),
            "n must be an integer; got float. Round it.",
            TypeError,
        ),
        (
            lambda: c.bad_type("n", "an integer", "two"),
            "n must be an integer; got the string 'two'.",
            c.InputTypeError,
        ),
        (lambda: c.raise_input_error("Both are wrong."), "Both are wrong.", c.InputError),
        (lambda: c.check_number(1.5, "n", 1, 4, integer=True), "n must be an integer; got float.", TypeError),
        (lambda: c.check_number("1", "n", 1, 4), "n must be a number; got the string '1'.", TypeError),
        (lambda: c.check_number(5, "n", 1, 1 << 32), None, None),
        (
            lambda: c.check_number(0, "n", 1, 1 << 32),
            "n must be between 1 and 4294967296; got 0.",
            c.InputError,
        ),
        (
            lambda: c.check_number(0.5, "n", 1e-12, 0.25),
            "n must be between 1e-12 and 0.25; got 0.5.",
            c.InputError,
        ),
        (
            lambda: c.check_number(1 << 128, "n", 1, 9),
            "n must be between 1 and 9; got an integer of more than 128 bits.",
            c.InputError,
        ),
        (
            lambda: c.check_number((1 << 128) - 1, "n", 1, 9),
            f"n must be between 1 and 9; got {(1 << 128) - 1}.",
            c.InputError,
        ),
        (
            lambda: c.check_positive(0, "near", "metres"),
            "near must be a finite number of metres above 0; got 0.",
            c.InputError,
        ),
        (
            lambda: c.check_positive("1", "near", "metres"),
            "near must be a number; got the string '1'.",
            TypeError,
        ),
        (lambda: c.check_flag(1, "graphs"), "graphs must be True or False; got int.", TypeError),
        (
            lambda: c.check_size("12", "size"),
            "size must be None or a pair (width, height); got the string '12'.",
            TypeError,
        ),
        (lambda: c.check_size((640, 0), "size"), "size must be between 1 and 16777216; got 0.", c.InputError),
        (
            lambda: c.check_choice("x", "kind", {"b": 1, "a": 2}),
            "kind must be one of a, b; got 'x'.",
            c.InputError,
        ),
        (
            lambda: c.check_range((2, 1), "r"),
            "r must be a pair with 0 < low < high; got (2.0, 1.0).",
            c.InputError,
        ),
        (lambda: c.check_range(3, "r"), "r must be a pair of numbers (low, high); got int.", TypeError),
    ],
)
def test_a_sentence_names_what_was_expected_and_what_came(call, sentence, error):
    if sentence is None:
        assert call() == 5
        return
    with pytest.raises(error) as caught:
        call()
    assert str(caught.value) == sentence and isinstance(caught.value, ValueError)


@pytest.mark.parametrize(
    ("kind", "bases"),
    [
        (c.InputTypeError, (c.InputError, TypeError)),
        (c.UnknownFormatError, (c.InputError,)),
        (c.InputFileError, (c.InputError, OSError)),
        (c.MissingFileError, (c.InputFileError, FileNotFoundError)),
    ],
)
def test_errors_can_be_caught_as_those_of_python(kind, bases):
    assert all(issubclass(kind, base) for base in (*bases, ValueError))


def test_messages_are_noted_once_in_every_block_around_and_warned_of_each_time():
    one, two, three = (
        Finding(f"capture.{name}", f"The {name} is said.") for name in ("kept", "components", "scale")
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        c.warn(one)  # in no block
        with c.captured_warnings() as outer:
            c.warn(one)
            with c.captured_warnings() as inner:
                c.warn(two)
                c.warn(two)
                c.warn(one)
            c.warn(three)
            with pytest.raises(KeyError), c.captured_warnings() as failed:
                c.warn(two)
                raise KeyError
    assert inner == [two, one] and failed == [two] and outer == [one, two, three]
    assert [str(warning.message) for warning in caught] == [one, one, two, two, one, three, two]


def test_a_warning_points_at_the_line_that_calls_the_function_that_warns():
    message = Finding("capture.kept", "Sentence.")

    def inner(*level: int) -> None:
        c.warn(message, **({"stacklevel": level[0]} if level else {}))

    def outer() -> None:
        inner(3)

    first = inspect.currentframe().f_lineno
    with pytest.warns(UserWarning, match="Sentence") as caught:
        inner()
        outer()
    assert [(w.filename, w.lineno - first) for w in caught] == [(__file__, 2), (__file__, 3)]


def test_numbers_are_written_as_people_write_them():
    numbers = {4294967296: "4294967296", 1e-12: "1e-12", 0.1: "0.1", 2.50: "2.5", 1 << 24: "16777216"}
    assert {number: c.number_text(number) for number in numbers} == numbers
