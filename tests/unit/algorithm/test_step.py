"""One guided step with linear decoder and encoder and a quadratic loss, against formulas by hand."""

from itertools import product
from types import SimpleNamespace

import pytest
import torch

from geodiff_plugin.algorithm import step
from geodiff_plugin.algorithm.schedule import Round
from geodiff_plugin.algorithm.step import MatchFit, Update, gradient_step, guided_step, match_fit_step
from geodiff_plugin.algorithm.terms import Loss
from geodiff_plugin.scale.affine import AffineState


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed)) - 0.5


#: Weights of the latent's channels in the map, and of the map in the loss.
CHANNELS, SLOPE = torch.tensor([0.5, -2.0, 3.0]).view(1, 3, 1, 1), drawn(2, 1, 4, 5, seed=1)
TWEEDIE, ENCODED = 0.8, torch.tensor([1.0, 4.0, -2.0]).view(1, 3, 1, 1)


class LinearEstimate:
    """``x = sum(CHANNELS z0)``, ``z0 = TWEEDIE z``, encoded as ``ENCODED x``; notes what it is asked for."""

    def __init__(self, latent_is_read: bool = True) -> None:
        self.latent, self.eps = drawn(2, 3, 4, 5, seed=2), drawn(2, 3, 4, 5, seed=3)
        self.latent_is_read = latent_is_read
        self.finals: list[bool] = []
        self.encoded: list[torch.Tensor] = []

    def z0(self, latent):
        return TWEEDIE * latent

    def decode(self, z0, final=False):
        self.finals.append(final)
        return (CHANNELS * z0).sum(1, keepdim=True)

    def encode(self, x):
        self.encoded.append(x)
        return ENCODED * x


class Optimizer:
    """Moves against the gradient by a rate, and notes what it was given."""

    def __init__(self, rate: float) -> None:
        self.rate, self.given = rate, []

    def step(self, gradient, reference=None):
        self.given.append((gradient, reference))
        return -self.rate * gradient


class State:
    """A trajectory that records what is done with it.

    Its loss is ``sum(SLOPE x) + |z0 - anchor|^2 / 2 + 3 s_hat + 5 t_hat^2``.
    """

    def __init__(
        self, updates_latents: bool = True, refine_edges: bool = False, fits_matches: bool = True
    ) -> None:
        self.config = SimpleNamespace(optimize_latents=updates_latents, refine_edges=refine_edges)
        self.affine = AffineState(
            torch.tensor([0.3, -1.0]), torch.tensor([2.0, 0.5]), torch.tensor([4.0, 9.0])
        )
        self.latent_optimizer, self.scale_optimizer, self.shift_optimizer = (
            Optimizer(0.1),
            Optimizer(0.2),
            Optimizer(0.4),
        )
        self.fits_matches = fits_matches
        self.done: list[tuple] = []

    def prepare(self, x, z0):
        self.done.append(("prepare", x, z0))

    def find_occluded(self, x):
        self.done.append(("find_occluded", x))

    def record(self, name, tensor):
        self.done.append((name, tensor))

    def report(self, loss):
        self.done.append(("report", loss))

    def fitted(self, x):
        return 2.0 * x + 1.0 if self.fits_matches else x

    def loss(self, x, affine, z0, anchor):
        pulled = 3.0 * affine.s_hat + 5.0 * affine.t_hat**2
        total = (SLOPE * x).flatten(1).sum(1) + 0.5 * (z0 - anchor).square().flatten(1).sum(1) + pulled
        return Loss(total, {}, torch.ones(2))

    def of(self, name):
        return [each[1:] for each in self.done if each[0] == name]


@pytest.mark.parametrize("is_first", [True, False])
def test_an_update_moves_latent_scale_and_shift_down_their_own_gradients(is_first):
    state, estimate, anchor = State(), LinearEstimate(), drawn(2, 3, 4, 5, seed=4)
    before, z = state.affine, estimate.latent + 0.1
    update = gradient_step(state, estimate, z, anchor, is_first)
    z0 = TWEEDIE * z
    to_z = TWEEDIE * (CHANNELS * SLOPE + z0 - anchor)
    torch.testing.assert_close(update.latent, z - 0.1 * to_z)
    torch.testing.assert_close(update.relative, (CHANNELS * z0).sum(1, keepdim=True))
    torch.testing.assert_close(state.affine.s_hat, before.s_hat - 0.2 * 3.0)
    torch.testing.assert_close(state.affine.t_hat, before.t_hat - 0.4 * 10.0 * before.t_hat)
    assert torch.equal(state.affine.g_s, before.g_s)
    torch.testing.assert_close(update.loss.total, state.loss(update.relative, before, z0, anchor).total)
    ((gradient, reference),) = state.latent_optimizer.given
    torch.testing.assert_close(gradient, to_z)
    assert reference is estimate.eps
    assert [name for name, *_ in state.done] == ["prepare", "find_occluded"] * is_first + [
        "the gradient in the latent"
    ]
    if is_first:
        ((x, its_z0),) = state.of("prepare")
        torch.testing.assert_close(x, update.relative)
        torch.testing.assert_close(its_z0, z0)
        assert state.of("find_occluded")[0][0] is not None and not x.requires_grad
    results = update.latent, update.relative, state.affine.s_hat, state.affine.t_hat
    assert not any(result.requires_grad for result in results)


def test_a_correction_keeps_no_graph():
    z0 = drawn(2, 3, 4, 5, seed=5).requires_grad_()
    found = match_fit_step(State(), LinearEstimate(), z0, False)
    assert not found.latent.requires_grad and not found.relative.requires_grad


def test_without_moves_only_scale_and_shift_are_updated():
    state, estimate = State(updates_latents=False), LinearEstimate()
    before = state.affine
    update = gradient_step(state, estimate, estimate.latent, estimate.latent, True)
    assert torch.equal(update.latent, estimate.latent) and not state.latent_optimizer.given
    torch.testing.assert_close(state.affine.s_hat, before.s_hat - 0.6)
    torch.testing.assert_close(state.affine.t_hat, before.t_hat * (1.0 - 4.0))


def test_what_the_loss_does_not_depend_on_stays():
    state, estimate = State(), LinearEstimate()
    state.loss = lambda x, affine, z0, anchor: Loss(2.0 * affine.t_hat, {}, torch.ones(2))
    before = state.affine
    update = gradient_step(state, estimate, estimate.latent, estimate.latent, False)
    assert torch.equal(update.latent, estimate.latent) and torch.equal(state.affine.s_hat, before.s_hat)
    torch.testing.assert_close(state.affine.t_hat, before.t_hat - 0.8)


@pytest.mark.parametrize(
    ("is_result", "read", "refine_edges", "fits_matches"), list(product((True, False), repeat=4))
)
def test_a_correction_encodes_the_change_where_the_latent_is_read(
    is_result, read, refine_edges, fits_matches
):
    """The result of a sharp call is corrected later; a map that is the result needs no latent."""
    state, estimate = State(refine_edges=refine_edges, fits_matches=fits_matches), LinearEstimate(read)
    z0 = drawn(2, 3, 4, 5, seed=5)
    x = (CHANNELS * z0).sum(1, keepdim=True)
    found = match_fit_step(state, estimate, z0, is_result)
    assert estimate.finals == [is_result]
    ((prepared, its_z0),) = state.of("prepare")
    assert torch.equal(prepared, x) and its_z0 is z0
    needless = is_result and not read
    fitted = 2.0 * x + 1.0 if fits_matches else x
    encodes = fits_matches and not needless
    assert len(estimate.encoded) == encodes
    torch.testing.assert_close(found.latent, z0 + ENCODED * (fitted - x) if encodes else z0)
    torch.testing.assert_close(found.relative, x if is_result and refine_edges else fitted)
    assert bool(state.of("the fitted map")) == (not (needless and refine_edges))
    assert bool(state.of("the encoded match fit")) == encodes
    if encodes:
        ((captured_warnings,),) = state.of("the encoded match fit")
        assert torch.equal(captured_warnings, found.latent)


class Recorded:
    """Stands in for corrections (latent + 100) and updates (latent + 1), and notes their arguments."""

    def __init__(self, monkeypatch) -> None:
        self.calls: list[tuple] = []
        self.count = 0

        def correct(state, estimate, z, is_result):
            self.calls.append(("correct", z, is_result))
            self.count += 1
            return MatchFit(z + 100.0, torch.tensor(float(self.count)))

        def update(state, estimate, z, anchor, is_first):
            self.calls.append(("update", z, anchor, is_first))
            self.count += 1
            return Update(z + 1.0, torch.tensor(float(self.count)), f"loss {self.count}")

        monkeypatch.setattr(step, "match_fit_step", correct)
        monkeypatch.setattr(step, "gradient_step", update)


@pytest.mark.parametrize("is_last", [True, False])
def test_rounds_follow_each_other(monkeypatch, is_last):
    """Two updates, a correction with two updates, a correction with none: latents, anchors, reports."""
    recorded, state, estimate = Recorded(monkeypatch), State(), LinearEstimate()
    z, anchor = estimate.latent, TWEEDIE * estimate.latent
    rounds = (Round(False, 2), Round(True, 2), Round(True, 0))
    found = guided_step(state, estimate, rounds, is_last)
    expected = [
        ("update", z, anchor, True),
        ("update", z + 1, anchor, False),
        ("correct", z + 2, False),
        ("update", z + 102, anchor + 100, True),
        ("update", z + 103, anchor + 100, False),
        ("correct", z + 104, is_last),
    ]
    for call, wanted in zip(recorded.calls, expected, strict=True):
        for got, value in zip(call, wanted, strict=True):
            if torch.is_tensor(value):
                torch.testing.assert_close(got, value)
            else:
                assert got == value
    torch.testing.assert_close(found.offset, torch.full_like(z, 204.0))
    assert found.relative.item() == 6.0 and found.is_current
    assert state.of("report") == [("loss 1",), ("loss 4",), (None,)]


def test_the_anchor_of_a_first_correction_is_its_result(monkeypatch):
    recorded, estimate = Recorded(monkeypatch), LinearEstimate()
    guided_step(State(), estimate, (Round(True, 1), Round(True, 1)), True)
    anchors = [call[2] for call in recorded.calls if call[0] == "update"]
    torch.testing.assert_close(anchors[0], estimate.latent + 100)
    torch.testing.assert_close(anchors[1], estimate.latent + 200)
    assert [call[2] for call in recorded.calls if call[0] == "correct"] == [False, False]


@pytest.mark.parametrize(
    ("rounds", "is_current", "results"),
    [
        ((Round(True, 0),), True, [True]),
        ((Round(True, 0), Round(True, 0)), True, [False, True]),
        ((Round(True, 2),), False, [False]),
        ((Round(True, 0), Round(False, 1)), False, [False]),
        ((Round(False, 1), Round(True, 0)), True, [True]),
        ((Round(False, 0),), False, []),
    ],
)
def test_the_map_of_a_last_correction_without_updates_is_current(monkeypatch, rounds, is_current, results):
    recorded, state, estimate = Recorded(monkeypatch), State(), LinearEstimate()
    found = guided_step(state, estimate, rounds, True)
    assert found.is_current == is_current
    assert [call[2] for call in recorded.calls if call[0] == "correct"] == results
    assert len(state.of("report")) == len(rounds)
    if rounds == (Round(False, 0),):  # only the scale is found
        z0 = TWEEDIE * estimate.latent
        ((x, its_z0),) = state.of("prepare")
        torch.testing.assert_close(its_z0, z0)
        torch.testing.assert_close(x, (CHANNELS * z0).sum(1, keepdim=True))
        assert found.offset.abs().max() == 0 and torch.equal(found.relative, x)
