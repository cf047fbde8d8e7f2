"""How many operations the host sends to a device in a guided call, counted without one."""

import pytest

from geodiff_plugin._kernels import has_triton

#: Operations of a guided call outside its networks that are no views, and kernels, which a GPU is sent one by
#: one (``python -m tests.benchmarks.launches`` shows them by stage).
MOST_OPERATIONS, MOST_LAUNCHES = 3500, 200


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_a_guided_call_sends_few_operations():
    from tests.benchmarks.launches import count_guided_call

    found = count_guided_call(resolution=128, side=224)
    assert 1000 < found.operations.total() - found.views.total() <= MOST_OPERATIONS
    assert 50 < found.launches.total() <= MOST_LAUNCHES
