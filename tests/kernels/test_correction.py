"""Kernels of the fit to matches against their references in ``algorithm.correction``."""

import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._kernels import without_kernels
from geodiff_plugin.algorithm import correction
from geodiff_plugin.algorithm.correction import edge_links, local_error, off_edges, prior_error
from geodiff_plugin.config import DEFAULT
from geodiff_plugin.matching import Matches
from tests.kernels.drawn import drawn

SIZES = st.tuples(st.integers(2, 40), st.integers(2, 40))


class Scene:
    """Maps, images and matches of two thirds of the pixels, ``(B, 1, h, w)`` each."""

    def __init__(self, seed: int, batch: int, size: tuple[int, int], device: torch.device) -> None:
        generator = torch.Generator().manual_seed(seed)

        def drawn(channels: int) -> torch.Tensor:
            return torch.rand(batch, channels, *size, generator=generator).to(device)

        self.left, self.log_depth = drawn(3), (1.0 + 4.0 * drawn(1)).log()
        confidence = torch.where(drawn(1) > 0.3, drawn(1), 0.0)
        inverse = torch.exp(-self.log_depth + 0.2 * drawn(1) - 0.1)
        steps = torch.linspace(1e-3, 2e-3, batch, device=device)
        self.matches, self.error = Matches(inverse, confidence, steps), 0.02 + 0.2 * drawn(1)


def assert_same(call, tolerance: float = 1e-5):
    """Every tensor of kernel and reference within a share of its largest value; those of the kernel."""
    found = call()
    with without_kernels():
        expected = call()
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.shape == theirs.shape
        assert (ours - theirs).abs().max() <= tolerance * theirs.abs().max()
    return found


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES)
@example(seed=0, batch=2, size=(31, 37))
def test_links_and_residuals(device, seed, batch, size):
    scene = Scene(seed, batch, size, device)
    assert_same(lambda: edge_links(scene.left, scene.log_depth))
    assert_same(lambda: correction._residuals(scene.log_depth, scene.matches, 0.02))


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES, local=st.booleans())
@example(seed=0, batch=2, size=(31, 37), local=True)
def test_levels_and_matches_off_edges(device, seed, batch, size, local):
    scene = Scene(seed, batch, size, device)
    error = scene.error if local else scene.error[..., :1, :1]
    assert_same(lambda: correction._levels(error, DEFAULT))
    assert_same(lambda: [off_edges(scene.matches, scene.log_depth.exp(), error).confidence])


def observed(scene: Scene) -> correction._Observations:
    return correction._observations(scene.log_depth.exp(), scene.matches, scene.left, DEFAULT)


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES)
@example(seed=0, batch=2, size=(31, 37))
def test_the_spread_of_residuals(device, seed, batch, size):
    seen = observed(Scene(seed, batch, size, device))
    assert_same(lambda: [correction._spread(seen.residual, seen)])


def test_the_spread_of_sampled_residuals_and_of_none(device, monkeypatch):
    from geodiff_plugin.algorithm import correction_kernels
    from geodiff_plugin.scale import points

    for module in (correction_kernels, points):
        monkeypatch.setattr(module, "MOST_SORTED", 200)
    seen = observed(Scene(1, 2, (31, 37), device))
    assert_same(lambda: [correction._spread(seen.residual, seen)])
    none = seen._replace(weight=0.0 * seen.weight)
    assert torch.equal(correction._spread(none.residual, none), torch.full((2, 1, 1, 1), 0.5, device=device))


def test_the_error_of_a_prior(device, monkeypatch):
    """Both colours of the cross-validation are solved as one batch."""
    monkeypatch.setattr("geodiff_plugin.algorithm.solver.COARSEST_STEPS", 6)
    monkeypatch.setattr(correction, "SOLVER_STEPS", 2)
    scene = Scene(2, 2, (26, 29), device)
    depth_m = scene.log_depth.exp()
    (together,) = assert_same(lambda: [prior_error(depth_m, scene.matches, scene.left)], 1e-4)
    alone = [
        prior_error(depth_m[k : k + 1], _sample(scene.matches, k), scene.left[k : k + 1]) for k in (0, 1)
    ]
    torch.testing.assert_close(together, torch.cat(alone), rtol=1e-5, atol=0)


def _sample(matches: Matches, k: int) -> Matches:
    parts = (matches.inverse_depth, matches.confidence, matches.plane_step)
    return Matches(*(part[k : k + 1] for part in parts))


def test_an_error_where_the_prior_gives_no_depth_is_local(device):
    scene = Scene(3, 1, (19, 23), device)
    error = local_error(scene.error[..., :1, :1], (scene.log_depth > 1.0).float())
    assert error is not None and error.shape == scene.log_depth.shape
    assert_same(lambda: correction._levels(error, DEFAULT))
