"""Fixtures of the unit tests."""

import pytest

from geodiff_plugin._internal import kernels as _kernels


@pytest.fixture
def asked_kernels(monkeypatch) -> list[str]:
    """Stages run their kernels if these can; a kernel only notes its dotted name and returns it."""
    asked: list[str] = []

    def kernel(name: str):
        return lambda *given, **named: asked.append(name) or name

    monkeypatch.setattr(_kernels, "use_kernel", lambda tensor: True)
    monkeypatch.setattr(_kernels, "imported", kernel)
    return asked
