from __future__ import annotations

import pytest
import torch

from geodiff_plugin.algorithm.gradients import RULES, Adam, NormMatched, Plain


def test_plain_is_algorithm_1():
    gradient = torch.randn(2, 3)
    torch.testing.assert_close(Plain(1e-2).step(gradient), -1e-2 * gradient)


def test_adam_equals_torch_adam():
    target = torch.randn(3, 4)
    ours, theirs = torch.zeros(3, 4), torch.nn.Parameter(torch.zeros(3, 4))
    rule = Adam(0.05)
    optimiser = torch.optim.Adam([theirs], lr=0.05, betas=rule.betas, eps=1e-10)
    for _ in range(7):
        ours = ours + rule.step(2 * (ours - target))
        optimiser.zero_grad()
        (theirs - target).pow(2).sum().backward()
        optimiser.step()
    torch.testing.assert_close(ours, theirs.detach())


def test_norm_matched_length_is_a_share_of_the_reference_per_sample():
    gradient, reference = torch.randn(2, 4, 3, 3) * 1e-6, torch.randn(2, 4, 3, 3)
    step = NormMatched(0.05).step(gradient, reference)
    torch.testing.assert_close(step.flatten(1).norm(dim=1), 0.05 * reference.flatten(1).norm(dim=1))
    assert ((step * gradient).flatten(1).sum(1) < 0).all()


@pytest.mark.parametrize("name", RULES)
def test_samples_do_not_see_each_other(name):
    gradient, reference = torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2)
    together, alone = RULES[name](0.1), RULES[name](0.1)
    for _ in range(3):
        a, b = together.step(gradient, reference), alone.step(gradient[1:2], reference[1:2])
    torch.testing.assert_close(a[1:2], b)


@pytest.mark.parametrize("name", RULES)
def test_zero_gradient_moves_nothing(name):
    zero = torch.zeros(2, 4, 3, 3)
    assert RULES[name](0.1).step(zero, torch.randn(2, 4, 3, 3)).abs().max() == 0


@pytest.mark.parametrize("name", RULES)
def test_scalars_per_sample(name):
    step = RULES[name](0.1).step(torch.tensor([1.0, -2.0]))
    assert step.shape == (2,) and step[0] < 0 < step[1]
