"""Out-of-memory errors are reported with the size; every other error is unchanged."""

import pytest

from geodiff_plugin._internal.checks import InputError
from geodiff_plugin.jobs.memory import MEMORY_HINT, fitting_memory, is_out_of_memory


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
def test_out_of_memory_errors_of_libraries_are_recognised(words):
    assert is_out_of_memory(RuntimeError(words)) and is_out_of_memory(MemoryError())
    caused = ValueError("behind it")
    caused.__cause__ = RuntimeError(words)
    assert is_out_of_memory(caused)
    assert not is_out_of_memory(ValueError("shapes differ")) and not is_out_of_memory(None)
    with pytest.raises(InputError) as caught, fitting_memory("A pair", (4000, 3025), ", or sleep"):
        raise caused
    said = "A pair of 4000x3025 pixels (12.1 megapixels) does not fit in memory."
    assert str(caught.value) == f"{said} {MEMORY_HINT}, or sleep."
    assert caught.value.__cause__ is caused


def test_other_errors_and_those_already_reported_are_unchanged():
    for error in (KeyError("a"), InputError("out of memory.png is torn"), ValueError("shapes")):
        with pytest.raises(type(error)) as caught, fitting_memory("A pair", (4, 3)):
            raise error
        assert caught.value is error
    with fitting_memory("A pair", (4, 3)):
        pass
