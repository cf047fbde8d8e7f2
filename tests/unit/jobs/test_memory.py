"""What does not fit the memory is said with its size; every other error stays as it is."""

import pytest

from geodiff_plugin._checks import InputError
from geodiff_plugin.jobs.memory import CURE, fitting_memory, is_out_of_memory


@pytest.mark.parametrize(
    "words",
    [
        "CUDA out of memory. Tried",
        "you can't allocate 3 bytes",
        "Cannot allocate memory",
        "(-4:Insufficient memory)",
        "std::bad_alloc",
    ],
)
def test_what_libraries_say_of_too_little_memory_is_recognised(words):
    assert is_out_of_memory(RuntimeError(words)) and is_out_of_memory(MemoryError())
    caused = ValueError("behind it")
    caused.__cause__ = RuntimeError(words)
    assert is_out_of_memory(caused)
    assert not is_out_of_memory(ValueError("shapes differ")) and not is_out_of_memory(None)
    with pytest.raises(InputError) as caught, fitting_memory("A pair", (4000, 3025), ", or sleep"):
        raise caused
    said = "A pair of 4000x3025 pixels (12.1 megapixels) does not fit the memory."
    assert str(caught.value) == f"{said} {CURE}, or sleep."
    assert caught.value.__cause__ is caused


def test_other_errors_and_those_that_are_told_already_stay_as_they_are():
    for error in (KeyError("a"), InputError("out of memory.png is torn"), ValueError("shapes")):
        with pytest.raises(type(error)) as caught, fitting_memory("A pair", (4, 3)):
            raise error
        assert caught.value is error
    with fitting_memory("A pair", (4, 3)):
        pass
