"""The mutation tool itself: what its operators make, which tests it chooses, and how a run ends."""

import ast
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="extra dev")

from tests.mutation.__main__ import choose
from tests.mutation.coverage_map import CoverageMap, LineIndex, RecordedTest
from tests.mutation.operators import mutated, positions
from tests.mutation.sampling import ROOT, draw, equivalents, package_files
from tests.mutation.worker import KILLED, SURVIVED, TIMED_OUT, Checkout


@pytest.mark.parametrize(
    ("before", "after", "operator"),
    [
        ("f(K_left, K_right)", "f(K_right, K_right)", "ConfuseNames"),
        ("x = min(a, b)", "x = max(a, b)", "ConfuseNames"),
        ("r = new / old", "r = old / new", "InvertRatio"),
        ("p = R @ q", "p = q @ R", "InvertRatio"),
        ("f(a, b, c=1)", "f(b, a, c=1)", "ExchangeArguments"),
        ("f(a, b=1, c=2)", "f(a, c=2)", "DropKeyword"),
        ("f(b=1, c=2)", "f(c=2)", "DropKeyword"),
        ("p = R.T @ q", "p = R @ q", "DropTranspose"),
        ("y = a[0]", "y = a[ 1]", "NumberReplacer"),
    ],
)
def test_an_operator_makes_the_fault_it_describes(before, after, operator):
    made = [mutated(before, name, at) for name, at, _ in positions(before) if name == operator]
    assert after in [text.replace("( ", "(") for text in made]


def test_the_order_of_a_minimum_is_no_fault():
    made = {name for name, _, _ in positions("x = torch.minimum(a, b)")}
    assert "ExchangeArguments" not in made


def test_annotations_and_logging_are_left_alone():
    source = textwrap.dedent(
        """
        __all__ = ["a", "b"]
        def f(size: tuple[1, 2] | None, *, key: int) -> dict[0, 1]:
            _log.info("%d of %d", size, 3)
        """
    )
    assert list(positions(source)) == []


def test_every_mutant_of_a_sample_is_another_valid_file():
    for mutant in draw(package_files(["geometry", "scale/space"]), 12, 3):
        before = (ROOT / mutant.file).read_text(encoding="utf-8")
        assert ast.dump(ast.parse(mutant.code)) != ast.dump(ast.parse(before)), mutant
        assert mutant.change[0] in before


def test_the_same_seed_draws_the_same_mutants():
    files = package_files(["geodiff_plugin/geometry"])
    first, again = (draw(files, 5, 1) for _ in range(2))
    assert first == again != draw(files, 5, 2)


def test_lines_that_execute_a_constant_are_its_uses(tmp_path: Path):
    package = tmp_path / "geodiff_plugin"
    package.mkdir()
    (package / "a.py").write_text(
        "LIMIT = 3\n\ndef f(x, y=2):\n    if x:\n        return (\n            LIMIT)\n"
    )
    (package / "b.py").write_text("from a import LIMIT\n\ndef g():\n    return LIMIT\n")
    index = LineIndex(tmp_path)
    assert index.lines_executing("geodiff_plugin/a.py", 1) == {
        "geodiff_plugin/a.py": 1 << 6,
        "geodiff_plugin/b.py": 1 << 4,
    }
    body = (1 << 4) | (1 << 5) | (1 << 6)
    assert index.lines_executing("geodiff_plugin/a.py", 3) == {"geodiff_plugin/a.py": body}
    assert index.lines_executing("geodiff_plugin/a.py", 4) == {"geodiff_plugin/a.py": 1 << 4}
    assert index.lines_executing("geodiff_plugin/a.py", 6) == {"geodiff_plugin/a.py": (1 << 5) | (1 << 6)}


def test_the_tests_of_a_line_are_those_that_execute_it_and_the_modules_own(tmp_path: Path):
    recorded = CoverageMap(tmp_path)
    a, b = "geodiff_plugin/a.py", "geodiff_plugin/b.py"
    recorded.tests = [
        RecordedTest("tests/test_wide.py::t", 1.0, {a: 0b1110, b: 0b10}),
        RecordedTest("tests/test_narrow.py::t", 1.0, {a: 0b0100}),
        RecordedTest("tests/test_other.py::t", 1.0, {b: 0b0100}),
        RecordedTest("tests/unit/test_a.py::t", 1.0, {}),
    ]
    found = [test.name.split("::")[0] for test in recorded.covering(a, {a: 0b0100})]
    assert found == ["tests/unit/test_a.py", "tests/test_narrow.py", "tests/test_wide.py"]


def test_tests_are_chosen_in_order_within_the_time():
    tests = [RecordedTest(name, seconds, {}) for name, seconds in (("a", 2.0), ("b", 9.0), ("c", 3.0))]
    assert [test.name for test in choose(tests, 6.0)] == ["a", "c"]


def test_equivalent_mutants_name_a_line_that_exists():
    for (file, before, after), reason in equivalents().items():
        lines = [line.strip() for line in (ROOT / file).read_text(encoding="utf-8").splitlines()]
        assert before in lines, f"{file} has no line {before!r} any more: remove the entry"
        assert reason.endswith(".") and before != after


@pytest.mark.slow
def test_a_fault_is_killed_and_a_harmless_change_survives(tmp_path: Path):
    checkout, file = Checkout(tmp_path), "geodiff_plugin/geometry.py"
    tests = [
        f"tests/unit/test_geometry.py::{node.name}"
        for node in ast.parse((ROOT / "tests/unit/test_geometry.py").read_text(encoding="utf-8")).body
        if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
    ]
    code = (ROOT / file).read_text(encoding="utf-8")
    assert checkout.run(file, code + "\n# harmless\n", tests, 10.0).status == SURVIVED
    assert checkout.run(file, code + "\nraise RuntimeError\n", tests, 10.0).status == KILLED
    assert checkout.run(file, code + "\nwhile True: pass\n", tests, 0.1).status == TIMED_OUT
    assert (checkout.root / file).read_text(encoding="utf-8") == code
