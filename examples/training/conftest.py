"""Fixtures of the package's tests, used by the training's tests."""

from tests.conftest import textured_plane

__all__ = ["textured_plane"]
