"""Where kernels run in these tests: Triton's interpreter on CPU tensors, or a card.

``TRITON_INTERPRET=1 python -m pytest tests/kernels`` runs them in the interpreter; Triton reads the variable
when it is imported. Without the variable they run on a card, and without a card they are skipped.
"""

import pytest
import torch

from geodiff_plugin._internal.kernels import has_triton, interpreting

_INTERPRETER = pytest.param("cpu", id="interpreter")
_CARD = pytest.param("cuda", id="card", marks=pytest.mark.gpu)


def _why_not(device: str) -> str | None:
    """Why kernels cannot run on this device in this process; ``None`` if they can."""
    if not has_triton():
        return "Triton is not installed"
    if device == "cpu":
        return None if interpreting() else "the interpreter needs TRITON_INTERPRET=1"
    if interpreting():
        return "TRITON_INTERPRET=1 keeps kernels off the card"
    return None if torch.cuda.is_available() else "no CUDA device"


@pytest.fixture(scope="session", autouse=True)
def _language_interpreted_once():
    """The interpreter's functions stand in for the language's until the end.

    It puts them there again at every launch, and at every call of a function of a kernel, which takes it two
    fifths of its time.
    """
    if not (has_triton() and interpreting()):
        yield
        return
    from triton.runtime import interpreter

    stand_in, done = interpreter._patch_lang, set()

    def stand_in_once(function):
        module = id(function.__globals__)
        if module not in done:
            stand_in(function)
            done.add(module)
        return interpreter._LangPatchScope()  # nothing to be taken back

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(interpreter, "_patch_lang", stand_in_once)
        yield


@pytest.fixture(scope="session", params=[_INTERPRETER, _CARD])
def device(request) -> torch.device:
    """The device of the tensors on which a kernel and its reference are compared."""
    reason = _why_not(request.param)
    if reason is not None:
        pytest.skip(reason)
    return torch.device(request.param)
