"""Kernels of the fit to matches against their references in ``algorithm.match_fitting``."""

import torch
from hypothesis import example, given
from hypothesis import strategies as st

from geodiff_plugin._internal.kernels import without_kernels
from geodiff_plugin.algorithm import match_fitting
from geodiff_plugin.algorithm.match_fitting import edge_affinities, local_error, off_edges, prior_error
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
    """Compare every tensor of kernel and reference, relative to its largest value; return the kernel's."""
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
    assert_same(lambda: edge_affinities(scene.left, scene.log_depth))
    assert_same(lambda: match_fitting._residuals(scene.log_depth, scene.matches, 0.02))


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES, local=st.booleans())
@example(seed=0, batch=2, size=(31, 37), local=True)
def test_levels_and_matches_off_edges(device, seed, batch, size, local):
    scene = Scene(seed, batch, size, device)
    error = scene.error if local else scene.error[..., :1, :1]
    assert_same(lambda: match_fitting._levels(error, DEFAULT))
    assert_same(lambda: [off_edges(scene.matches, scene.log_depth.exp(), error).confidence])


def observed(scene: Scene) -> match_fitting._Observations:
    return match_fitting._observations(scene.log_depth.exp(), scene.matches, scene.left, DEFAULT)


@drawn(6)
@given(seed=st.integers(0, 999), batch=st.integers(1, 2), size=SIZES)
@example(seed=0, batch=2, size=(31, 37))
def test_the_spread_of_residuals(device, seed, batch, size):
    seen = observed(Scene(seed, batch, size, device))
    assert_same(lambda: [match_fitting._spread(*seen[:4])])


def test_the_spread_of_sampled_residuals_and_of_none(device, monkeypatch):
    from geodiff_plugin.algorithm.kernels import match_fitting as kernels
    from geodiff_plugin.scale import points

    for module in (kernels, points):
        monkeypatch.setattr(module, "MAX_SORTED", 200)
    seen = observed(Scene(1, 2, (31, 37), device))
    assert_same(lambda: [match_fitting._spread(*seen[:4])])
    none = seen._replace(weight=0.0 * seen.weight)
    assert torch.equal(match_fitting._spread(*none[:4]), torch.full((2, 1, 1, 1), 0.5, device=device))


def test_the_error_of_a_prior(device, monkeypatch):
    """Both colours of the cross-validation are solved as one batch."""
    from geodiff_plugin.algorithm import solver
    from geodiff_plugin.algorithm.kernels import solver as kernels

    for module in (kernels, solver):
        monkeypatch.setattr(module, "COARSEST_STEPS", 6)
    monkeypatch.setattr(match_fitting, "SOLVER_STEPS", 2)
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
    assert_same(lambda: match_fitting._levels(error, DEFAULT))
