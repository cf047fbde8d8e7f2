"""Rules of gradients against their formulas in NumPy, for samples of very different size."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from geodiff_plugin.algorithm.optimizers import OPTIMIZERS, FiniteWatch, backpropagate

SIZES = np.array([1.0, 1e-3, 40.0])


def adam(gradients, references, rate, betas, eps, to_norm):
    """Steps of Adam (Kingma and Ba 2015, Algorithm 1) on gradients ``(N, B, P)``."""
    m = v = np.zeros_like(gradients[0])
    for t, (g, reference) in enumerate(zip(gradients, references, strict=True), 1):
        if to_norm:
            g = g * np.linalg.norm(reference, axis=1)[:, None] / np.linalg.norm(g, axis=1)[:, None]
        m, v = betas[0] * m + (1 - betas[0]) * g, betas[1] * v + (1 - betas[1]) * g**2
        fitted = m / (1 - betas[0] ** t), v / (1 - betas[1] ** t)
        yield -rate * fitted[0] / (np.sqrt(fitted[1]) + eps)


@pytest.mark.parametrize(
    ("name", "betas", "eps", "to_norm"),
    [("adam", (0.9, 0.99), 1e-10, False), ("adam-norm", (0.9, 0.999), 1e-8, True)],
)
def test_adam_updates_every_sample_independently_as_in_its_paper(name, betas, eps, to_norm):
    rng = np.random.default_rng(0)
    gradients = rng.normal(size=(6, 3, 24)) * SIZES[None, :, None]
    references = rng.normal(size=(6, 3, 24)) * [[[3.0], [0.5], [7.0]]]
    expected = adam(gradients, references, 0.07, betas, eps, to_norm)
    rule = OPTIMIZERS[name](0.07)
    for gradient, reference, step in zip(gradients, references, expected, strict=True):
        given = (torch.from_numpy(each).view(3, 2, 3, 4) for each in (gradient, reference))
        found = rule.step(*given)
        np.testing.assert_allclose(found.reshape(3, 24).numpy(), step, rtol=1e-5)


def test_adam_of_numbers_scales_each_to_the_size_of_its_reference():
    rule = OPTIMIZERS["adam-norm"](0.5)
    found = rule.step(torch.tensor([2.0, -1e-4]), torch.tensor([-3.0, 0.2]))
    torch.testing.assert_close(found, torch.tensor([-0.5, 0.5]))
    second = rule.step(torch.tensor([2.0, 1e-4]), torch.tensor([6.0, 0.4])).double().numpy()
    m = 0.9 * 0.1 * np.array([3.0, -0.2]) + 0.1 * np.array([6.0, 0.4])
    v = 0.999 * 0.001 * np.array([9.0, 0.04]) + 0.001 * np.array([36.0, 0.16])
    expected = -0.5 * (m / (1 - 0.9**2)) / np.sqrt(v / (1 - 0.999**2))
    np.testing.assert_allclose(second, expected, rtol=1e-4)


@pytest.mark.parametrize("name", ["plain", "summed"])
def test_the_plain_rule_is_the_rate_times_the_gradient_whatever_the_reference(name):
    gradient, rule = torch.randn(3, 5), OPTIMIZERS[name](0.3)
    for reference in (None, 9.0 * gradient):
        torch.testing.assert_close(rule.step(gradient, reference), -0.3 * gradient)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_a_gradient_goes_back_through_a_linear_map_by_its_transpose(dtype):
    """Sample by sample, though one is a millionth of another; the graph is used up."""
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(6, 4, generator=generator)
    source = torch.randn(3, 4, generator=generator, requires_grad=True)
    output = (source @ matrix.T).to(dtype)
    gradient = torch.randn(3, 6, generator=generator) * torch.tensor([1.0, 1e-6, 3e4])[:, None]
    found = backpropagate(output, source, gradient)
    expected = gradient @ matrix
    off = (found - expected).abs() / expected.abs().amax(1, keepdim=True)
    assert off.max() < (1e-6 if dtype == torch.float32 else 2e-3)
    with pytest.raises(RuntimeError, match="second time|freed"):
        backpropagate(output, source, gradient)


def test_the_first_tensor_that_is_not_finite_is_named():
    for bad in (torch.nan, torch.inf, -torch.inf):
        watch, pipe = FiniteWatch(), SimpleNamespace(dtype=torch.bfloat16)
        watch.record("one", 0, torch.tensor([-3.0, 4.0]))
        watch.record("two", 3, torch.tensor([[2.0, bad], [1.0, 0.0]], requires_grad=True))
        watch.record("three", 4, torch.tensor([bad]))
        with pytest.raises(
            ValueError,
            match=r"^two of denoising step 4 must be finite in bfloat16; got NaN or infinity\. "
            "Check that all weights",
        ):
            watch.check(pipe)
    fine = FiniteWatch()
    fine.check(pipe)
    for step in range(3):
        fine.record("any", step, torch.tensor([-1e30, 1e30]))
    fine.check(pipe)
