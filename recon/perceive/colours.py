"""Colour mixtures: what colours a garment, the skin or the hair of one photo has."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

SPREAD = np.array([30.0, 8.0, 8.0])
"""Variance added to every component, (L, a, b) in OpenCV's 8-bit units: wide enough for shading that no seed shows."""
SHADED = np.array([160.0, 14.0, 14.0])
"""The same for skin learned from the face alone: arms and legs are lit otherwise."""
ITERATIONS = 12
FLOOR = -18.0
"""Log-likelihoods stop here: an odd button or stripe must not outvote its place on the body."""


def lab(rgb: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB -> (H, W, 3) float32 CIE Lab in OpenCV's 8-bit units, with sensor noise smoothed away."""
    return cv2.cvtColor(cv2.bilateralFilter(rgb, 5, 20, 3), cv2.COLOR_RGB2LAB).astype(np.float32)


@dataclass(frozen=True)
class Mixture:
    """A mixture of K Gaussians over Lab colours."""

    weights: np.ndarray
    """(K,)"""
    means: np.ndarray
    """(K, 3)"""
    covariances: np.ndarray
    """(K, 3, 3), ``SPREAD`` included"""

    def log_likelihood(self, colours: np.ndarray) -> np.ndarray:
        """(..., 3) Lab -> (...) log density up to the constant that all mixtures share, not below ``FLOOR``."""
        x = colours.reshape(-1, 3).astype(np.float32)
        out = np.full(len(x), FLOOR, np.float32)
        for w, m, c in zip(self.weights, self.means, self.covariances):
            root = np.linalg.inv(np.linalg.cholesky(c)).astype(np.float32)
            d = ((x - m.astype(np.float32)) @ root.T) ** 2
            out = np.logaddexp(out, np.float32(np.log(w + 1e-9) - 0.5 * np.linalg.slogdet(c)[1]) - 0.5 * d.sum(1))
        return out.reshape(colours.shape[:-1])


def fit_mixture(colours: np.ndarray, count: int = 4, spread: np.ndarray = SPREAD) -> Mixture:
    """Expectation-maximisation on (N, 3) Lab colours, N > 0, from a k-means++ start; deterministic.

    ``spread`` (3,) is the variance that every component gets on top of its own.
    """
    r = np.random.default_rng(0)
    x = colours.reshape(-1, 3).astype(np.float64)
    x = x[r.permutation(len(x))[:2500]]
    count = min(count, max(1, len(x) // 60))
    means = x[:1]
    while len(means) < count:
        d = ((x[:, None] - means) ** 2).sum(-1).min(1) + 1e-9
        means = np.vstack([means, x[r.choice(len(x), p=d / d.sum())]])
    nearest = ((x[:, None] - means) ** 2).sum(-1).argmin(1)
    p = np.eye(count)[nearest] * 0.9 + 0.1 / count
    for _ in range(ITERATIONS):
        n = p.sum(0) + 1e-9
        weights, means = n / n.sum(), p.T @ x / n[:, None]
        d = x[:, None] - means
        cov = np.einsum("nk,nki,nkj->kij", p, d, d) / n[:, None, None] + np.eye(3)
        q = -0.5 * np.einsum("nki,kij,nkj->nk", d, np.linalg.inv(cov), d)
        q += np.log(weights) - 0.5 * np.linalg.slogdet(cov)[1]
        p = np.exp(q - q.max(1, keepdims=True))
        p /= p.sum(1, keepdims=True)
    return Mixture(weights, means, cov + np.diag(spread))
