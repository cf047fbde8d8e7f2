"""Gradient rules, and gradients through networks of half precision."""

import pytest
import torch

from geodiff_plugin.algorithm.gradients import RULES, Adam, FiniteWatch, pull_back


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


@pytest.mark.parametrize("name", RULES)
def test_a_rule_goes_downhill_sample_by_sample_and_a_zero_gradient_moves_nothing(name):
    gradient, reference = torch.randn(3, 4, 2, 2), torch.randn(3, 4, 2, 2)
    together, alone = RULES[name](0.1), RULES[name](0.1)
    for _ in range(3):
        a, b = together.step(gradient, reference), alone.step(gradient[1:2], reference[1:2])
    torch.testing.assert_close(a[1:2], b)
    assert ((a * gradient).flatten(1).sum(1) < 0).all()
    assert RULES[name](0.1).step(torch.zeros_like(gradient), reference).abs().max() == 0
    step = RULES[name](0.1).step(torch.tensor([1.0, -2.0]))  # scalars per sample
    assert step.shape == (2,) and step[0] < 0 < step[1]


@pytest.mark.parametrize("sizes", [(1e-12, 1e-12), (1.0, 1.0), (1e-9, 1e9)])
def test_a_gradient_of_any_size_passes_float16_and_comes_out_at_its_own(sizes):
    z = torch.randn(2, 4, 3, 3, requires_grad=True)
    gradient = torch.randn(2, 4, 3, 3) * torch.tensor(sizes).view(2, 1, 1, 1)
    pulled = pull_back((z.half() * 3.0).float(), z, gradient)
    torch.testing.assert_close(pulled / gradient, torch.full_like(pulled, 3.0), rtol=0.02, atol=0.0)


def test_the_first_that_is_not_finite_is_named_with_its_step_and_the_cure():
    watch = FiniteWatch()
    watch.note("the decoded map", 0, torch.ones(3))
    watch.check(torch.float16)
    watch.note("the encoded correction", 1, torch.tensor([1.0, torch.nan]))
    watch.note("the decoded map", 1, torch.tensor([torch.inf]))
    with pytest.raises(ValueError, match=r"encoded correction of denoising step 2 .* float16.*bfloat16"):
        watch.check(torch.float16)
    with pytest.raises(ValueError, match="weights"):
        watch.check(torch.float32)
