"""A search that ended on the edge of its range is unusual only together with something else."""

import pytest
import torch

from geodiff_plugin.findings import Finding
from geodiff_plugin.trust import CHECKS, measure_result
from geodiff_plugin.trust.result_vs_matches import Deviation
from geodiff_plugin.trust.search_edge import Edge, SearchEdge
from geodiff_plugin.trust.search_range import Ends
from geodiff_plugin.trust.tearing import Tear
from tests.unit.trust.made_stages import made_result
from tests.unit.trust.sheets import codes, good


@pytest.mark.parametrize("on_edge", [True, False])
def test_it_is_known_if_a_search_was_made(on_edge):
    assert measure_result(made_result(on_edge=torch.tensor(on_edge)))[SearchEdge] == Edge(on_edge)
    assert measure_result(made_result())[SearchEdge] is None


@pytest.mark.parametrize(
    ("records", "expected"),
    [
        ([], []),  # a street's sky
        ([Ends(0.05)], []),
        ([Ends(0.051)], ["depth.search-edge"]),
        ([Deviation(0.4)], ["depth.off-matches", "depth.search-edge"]),
        ([Tear(1, 9, 9)], ["views.tearing", "depth.search-edge"]),
    ],
)
def test_an_end_on_the_edge_is_a_remark_next_to_a_reason_or_matches_at_an_end(records, expected):
    assert codes(good(Edge(True), *records)) == expected
    assert "depth.search-edge" not in codes(good(Edge(False), *records))


def test_reasons_of_the_input_count_too():
    doubt = Finding("camera.principal-point", "K is for another image.")
    assert codes(good(Edge(True), findings=(doubt,))) == [doubt.code, "depth.search-edge"]


def test_it_comes_after_all_checks_with_reasons():
    assert CHECKS[-1] is SearchEdge
