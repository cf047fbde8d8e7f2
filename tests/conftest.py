"""Fixtures, which import what they need when they are asked for.

The process of pytest-xdist that hands out tests loads this file too, and would wait for torch in vain.
"""

import gc
import os
from pathlib import Path

import pytest

# Networks and images are tiny here: a second thread costs more than it brings, above all where several
# processes share the cores. Torch reads this when it is imported, also in processes that a test starts.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Half a million objects of torch and its relatives stay to the end. The collector would look through them
# while they are imported and then again in every test.
gc.disable()


def pytest_collection_finish():
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def make_pipeline():
    """Factory of tiny random Marigold pipelines; the same seed gives the same weights."""
    from tests.tiny import make_marigold

    return make_marigold


@pytest.fixture
def pipe(make_pipeline):
    from geodiff_plugin import enable_geometry_guidance

    return enable_geometry_guidance(make_pipeline())


@pytest.fixture(scope="session")
def prior(make_pipeline, tmp_path_factory) -> Path:
    """Folder of a tiny random Marigold."""
    folder = tmp_path_factory.mktemp("prior")
    make_pipeline().save_pretrained(folder)
    return folder


@pytest.fixture(scope="session")
def textured_plane():
    """A rectified pair of a tilted plane between about 1.4 m and 3.4 m."""
    from tests.tiny import plane_pair

    return plane_pair()


@pytest.fixture
def make_oracle():
    """Factory of a Marigold whose denoiser knows the relative depth ``(H, W)`` up to an affine map."""
    from tests.tiny import make_oracle

    return make_oracle
