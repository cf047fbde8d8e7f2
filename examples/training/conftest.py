"""Fixtures of the package's tests that the tests of the training use."""

from tests.conftest import textured_plane

__all__ = ["textured_plane"]
