"""Fixtures of tests of readers."""

import pytest


@pytest.fixture
def scan(tmp_path):
    """A folder deep enough that the search for moved images does not reach other tests."""
    folder = tmp_path / "far below" / "scan"
    folder.mkdir(parents=True)
    return folder
