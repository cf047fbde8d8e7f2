"""Every stage that has a kernel hands it the values that its parameters are named after."""

import ast
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

import geodiff_plugin.result
from geodiff_plugin.matching import Matches
from geodiff_plugin.result import confidence, flattening, indicators, voting
from geodiff_plugin.result.confidence import Grounds

A, B, C, D, E = (torch.full((1, 1, 6, 8), float(value)) for value in (1, 2, 3, 4, 5))
ONE = torch.full((1, 1, 1, 1), 0.1)
MATCHES = Matches(0.5 * A, 0.7 * A, torch.tensor([0.01]), B)
GROUNDS = Grounds(A, B, C, D)
LINKS = (D[..., 1:], D[..., 1:, :])

#: Stage, its arguments, the file and the function of its kernel, and the value of each parameter of that.
STAGES = [
    (confidence._grounds_on_grid, (A, B, MATCHES), "grounds_kernels", "grounds_on_grid", (A, B, MATCHES)),
    (confidence.depth_confidence, (GROUNDS, B, ONE), "kernels", "confidence_of", (GROUNDS, B, ONE)),
    (confidence.depth_confidence, (GROUNDS, None, None), "kernels", "confidence_of", (GROUNDS, None, None)),
    (confidence._photometric_error, (A, B, C), "exposure_kernels", "photometric_error", (A, B, C)),
    (confidence._warped, (A, B, C, D, E), "kernels", "warped", (A, B, C, D, E)),
    (flattening._known_of, (MATCHES, A, C, D), "flattening_kernels", "known_of", (MATCHES, B, A, C, D)),
    (flattening._slopes, (A, B, LINKS), "flattening_kernels", "slopes", (A, B, LINKS)),
    (flattening._forces, (A, B, LINKS), "flattening_kernels", "forces", (A, B, LINKS)),
    (indicators._of_matches_and_depth, (MATCHES, A), "indicator_kernels", "of_matches", (MATCHES, A)),
    (voting._voted, ("voters", A, B, C), "kernels", "voted", ("voters", A, B, C)),
    (voting._step_shares, (A,), "kernels", "step_shares", (A,)),
    (voting._enlarged, (A, B, C), "kernels", "enlarged", (A, B, C)),
]
#: Parameters of the kernels' functions that are called otherwise in the stages.
NAMES = {
    "grounds_on_grid": "log_depth denoised target",
    "confidence_of": "grounds spread prior_error",
    "photometric_error": "warped left_01 seen",
    "warped": "right_01 depth_m K_left K_right T_right_from_left",
    "known_of": "target deviation log_depth unit good",
    "slopes": "inverse known links",
    "forces": "inverse smoothed links",
    "of_matches": "matches depth_m",
    "voted": "given left error crispness",
    "step_shares": "depth_m",
    "enlarged": "votes left whole",
}


@pytest.fixture
def kernels(monkeypatch):
    """Modules of kernels that note what they are given, without Triton."""
    calls = []

    def install(file: str, name: str):
        def kernel(*given):
            calls.append(given)
            return {"made by": name} if name == "of_matches" else (A,) * 4 if name == "known_of" else E

        fake = SimpleNamespace(**{name: kernel})
        monkeypatch.setitem(sys.modules, f"geodiff_plugin.result.{file}", fake)
        monkeypatch.setattr(geodiff_plugin.result, file, fake, raising=False)
        return calls

    return install


@pytest.mark.parametrize(("stage", "given", "file", "name", "expected"), STAGES)
def test_a_stage_asks_its_kernel_where_kernels_are_used(
    monkeypatch, kernels, stage, given, file, name, expected
):
    calls = kernels(file, name)
    module = sys.modules[stage.__module__]
    monkeypatch.setattr(module, "use_kernel", lambda tensor: True)
    found = stage(*given)
    (asked,) = calls
    assert len(asked) == len(expected) and all(
        one is other for one, other in zip(asked, expected, strict=True)
    )
    if name == "of_matches":
        assert found == {"made by": name}
    elif name == "known_of":
        assert found == flattening._Known(A, A, A, A)
    else:
        assert found is E


@pytest.mark.parametrize("name", NAMES)
def test_the_kernels_take_these_values_in_this_order(name):
    folder = Path(geodiff_plugin.result.__file__).parent
    (file,) = {file for _, _, file, function, _ in STAGES if function == name}
    tree = ast.parse((folder / f"{file}.py").read_text(encoding="utf-8"))
    (function,) = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name]
    assert [argument.arg for argument in function.args.args] == NAMES[name].split()


def test_what_a_kernel_cannot_do_is_done_by_the_reference(monkeypatch, kernels):
    """Matches without a deviation, and more values than the kernel sorts."""
    for module in (flattening, indicators):
        monkeypatch.setattr(module, "use_kernel", lambda tensor: True)
    calls = kernels("flattening_kernels", "known_of")
    bare = Matches(0.5 * A, 0.7 * A, torch.tensor([0.01]))
    known = flattening._known_of(bare, A, torch.tensor(1.0), torch.tensor(1.0))
    assert (known.inverse == 1.0).all() and not calls
    calls = kernels("indicator_kernels", "of_matches")
    monkeypatch.setattr(indicators, "MOST_SORTED", A.numel() // 2 + 1)
    indicators._of_matches_and_depth(MATCHES, A[0])
    assert len(calls) == 1
    monkeypatch.setattr(indicators, "MOST_SORTED", A.numel() // 2)
    assert indicators._of_matches_and_depth(MATCHES, A[0])["matched"] == 1.0 and len(calls) == 1
