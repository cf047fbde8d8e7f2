"""``Beside``: what its answer holds, and that it is the function's own."""

from __future__ import annotations

import gc

import pytest
import torch

from geodiff_plugin import GeometryGuidance
from geodiff_plugin._threads import Beside, tensors_of
from geodiff_plugin.bundled.demo_pair import read_demo_pair
from geodiff_plugin.evidence.evidence import Evidence


def _reachable(evidence: Evidence) -> dict[int, torch.Tensor]:
    """All tensors that an evidence refers to, however, without what its rows are still working on."""
    seen, found, queue = set[int](), dict[int, torch.Tensor](), [evidence]
    while queue:
        value = queue.pop()
        if id(value) in seen or isinstance(value, (type, Beside)) or callable(value):
            continue
        seen.add(id(value))
        if isinstance(value, torch.Tensor):
            found[id(value)] = value
        else:
            queue += gc.get_referents(value)
    return found


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    pair = read_demo_pair()
    guidance = GeometryGuidance(pair.right, (pair.rig.K_left, pair.rig.K_right), pair.rig.E)
    left_01 = torch.from_numpy(pair.left).movedim(-1, 0)[None].float() / 255.0
    (made,) = guidance.prepare(left_01)
    return made


def test_every_tensor_of_an_evidence_is_kept_for_the_stream_that_reads_it(evidence: Evidence):
    found = {id(tensor) for tensor in tensors_of([evidence])}
    assert len(found) > 10
    assert found >= set(_reachable(evidence))


def test_the_answer_is_worked_out_at_once_where_the_caller_needs_the_same_cores():
    calls: list[int] = []
    answer = Beside(lambda: calls.append(1) or "answer", torch.device("cpu"), own_stream=True)
    assert calls == [1]
    assert (answer.result(), answer.result(), calls) == ("answer", "answer", [1])
    answer.close()


def test_what_the_function_raises_at_once_reaches_the_caller():
    with pytest.raises(ZeroDivisionError):
        Beside(lambda: 1 / 0, torch.device("cpu"))
