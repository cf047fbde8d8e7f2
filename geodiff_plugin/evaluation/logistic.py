"""Logistic regression with coefficients of known sign, and its calibration table.

Data flow: evidence, right or wrong, weights -> coefficients -> deciles.
Paper: none.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

__all__ = ["Decile", "deciles", "fit_log_odds", "promised"]


def promised(evidence: np.ndarray, coefficients: Sequence[float]) -> np.ndarray:
    """Probability ``(N,)`` of evidence ``(N, F)`` under coefficients ``(F,)``."""
    return expit(evidence @ np.asarray(coefficients, np.float64))


def fit_log_odds(
    evidence: np.ndarray, right: np.ndarray, weights: np.ndarray, signs: Sequence[int]
) -> np.ndarray:
    """Coefficients of greatest weighted likelihood, each within its sign.

    Args:
        evidence: ``(N, F)`` float; a column that never varies beside the constant gets 0.
        right: ``(N,)`` bool.
        weights: ``(N,)`` >= 0.
        signs: ``(F,)``: 1 for a coefficient >= 0, -1 for <= 0, 0 for any.

    Returns:
        ``(F,)`` float64.
    """
    x, y = np.asarray(evidence, np.float64), np.asarray(right, np.float64)
    w = np.asarray(weights, np.float64) / np.sum(weights)
    scale = np.maximum(np.sqrt(w @ x**2), 1e-12)
    unit = x / scale

    def loss(c: np.ndarray) -> tuple[float, np.ndarray]:
        z = unit @ c
        value = w @ (np.logaddexp(0.0, z) - y * z)
        return float(value), unit.T @ (w * (expit(z) - y))

    bounds = [{1: (0.0, None), -1: (None, 0.0), 0: (None, None)}[sign] for sign in signs]
    found = minimize(loss, np.zeros(x.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds)
    return found.x / scale


@dataclass(frozen=True)
class Decile:
    """One tenth of the promises: their mean ``promised``, the part ``kept``, their ``share`` of all."""

    promised: float
    kept: float
    share: float


def deciles(probability: np.ndarray, right: np.ndarray, weights: np.ndarray) -> list[Decile]:
    """Promised against kept, by tenths of the probability (0 to .1, .1 to .2, ...) that are not empty."""
    found, total = [], weights.sum()
    index = np.minimum((probability * 10).astype(int), 9)
    for tenth in range(10):
        own = index == tenth
        mass = weights[own].sum()
        if mass > 0:
            found.append(
                Decile(
                    float(weights[own] @ probability[own] / mass),
                    float(weights[own] @ right[own] / mass),
                    float(mass / total),
                )
            )
    return found
