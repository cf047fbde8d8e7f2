"""A mutant whose text is no longer in the package is never applied, and tests nothing."""

from tests.mutants import MUTANTS, ROOT


def test_every_mutant_points_at_one_place_of_the_package():
    sources = {mutant.file: (ROOT / "geodiff_plugin" / mutant.file).read_text("utf-8") for mutant in MUTANTS}
    assert [m for m in MUTANTS if sources[m.file].count(m.text) != 1 or m.text == m.instead] == []
