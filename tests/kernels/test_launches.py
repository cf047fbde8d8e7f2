"""How many operations the host sends to a device in a guided call, counted without one."""

import pytest
import torch

from geodiff_plugin._internal.kernels import has_triton, launched_on

#: Operations of a guided call outside its networks that are no views, and kernels, which a GPU is sent one by
#: one (``python -m tests.benchmarks.launches`` shows them by stage).
MAX_OPERATIONS, MAX_LAUNCHES = 760, 90


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_a_guided_call_sends_few_operations():
    from tests.benchmarks.launches import count_guided_call

    found = count_guided_call(resolution=128, side=224)
    assert 500 < found.operations.total() - found.views.total() <= MAX_OPERATIONS
    assert 10 < found.launches.total() <= MAX_LAUNCHES
    references = count_guided_call(resolution=128, side=224, without="result.kernels.confidence")
    assert references.launches.total() == found.launches.total() - 2
    assert references.operations.total() > found.operations.total() + 50


@pytest.mark.skipif(not has_triton(), reason="Triton is not installed")
def test_the_hosts_time_is_that_of_all_stages():
    from tests.benchmarks.launches import ELSEWHERE, STAGES, host_milliseconds

    found = host_milliseconds(side=96, repeats=1)
    assert list(found) == [*STAGES, ELSEWHERE]
    assert min(found.values()) >= 0 and all(
        found[stage] > 0 for stage in ("match_volume", "finish", ELSEWHERE)
    )


def test_a_kernel_is_launched_on_the_device_of_its_tensor(monkeypatch):
    """Triton launches on the current device, which need not be that of the pipeline."""
    tensor, seen = torch.zeros(1), []

    class Current:
        def __init__(self, of):
            self.of = of

        def __enter__(self):
            seen.append(self.of)

        def __exit__(self, *error):
            seen.append("left")

    monkeypatch.setattr(torch.cuda, "device_of", Current)
    launched_on(tensor, lambda *args, **kwargs: seen.append((args, kwargs)))(1, BLOCK=2)
    assert seen[0] is tensor and seen[1:] == [((1,), {"BLOCK": 2}), "left"]
