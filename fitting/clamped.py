"""Chains of edges in the place of smooth strands that are clamped at their roots.

A held edge counts as clamped at its middle. So that this is the root, the first edge begins half an
edge before it, in the strand's direction there; otherwise a chain of n edges hangs like a strand
that is shorter by a share of 1 / (2 n).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.smoothing import Curve, smoothed
from fitting.targets import MM

LEAST_NOISE_MM = 2e-3
"""Below it other errors count: of numbers in files, and of what has not come to rest."""


@dataclass(frozen=True)
class Seen:
    """The same strands as they hang and without weight.

    Arguments:
        hanging, unloaded: the curves of each.
        noise_mm: standard error of the distance between the two in a coordinate of a point [mm].
    """

    hanging: tuple[Curve, ...]
    unloaded: tuple[Curve, ...]
    noise_mm: float

    @staticmethod
    def of(hanging: Sequence[np.ndarray], unloaded: Sequence[np.ndarray]) -> "Seen":
        """From points [m], each of shape (points, 3)."""
        one, other = smoothed(hanging), smoothed(unloaded)
        noise = max(MM * float(np.hypot(one[1], other[1])), LEAST_NOISE_MM)
        return Seen(tuple(one[0]), tuple(other[0]), noise)

    def take(self, which: Sequence[int]) -> "Seen":
        """Some of the strands."""
        hanging, unloaded = (tuple(x[i] for i in which) for x in (self.hanging, self.unloaded))
        return Seen(hanging, unloaded, self.noise_mm)

    def chains(self, points: int, draws: int = 0, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Hanging and unloaded `chains`, with their roots in one place."""
        rng = np.random.default_rng(seed)
        hanging, unloaded = (chains(x, points, draws, rng) for x in (self.hanging, self.unloaded))
        return hanging + rooted(unloaded)[..., :1, :] - rooted(hanging)[..., :1, :], unloaded


def chains(
    curves: Sequence[Curve], points: int, draws: int = 0, rng: np.random.Generator | None = None
) -> np.ndarray:
    """Chains through the likeliest curve of each strand and random likely ones, at equal steps of
    arc length, with their roots all in one place: that of the strand, but for (curvature edge^2) /
    8, by which the strand bends away from the first edge.

    Returns points [m], shape (1 + draws, strands, points, 3).
    """
    rng = np.random.default_rng(0) if rng is None else rng
    step = 1 / (points - 1.5)
    shares = np.concatenate([[0, 1e-4], step * (np.arange(1, points) - 0.5)])
    out = np.empty((1 + draws, len(curves), points, 3))
    for i, curve in enumerate(curves):
        root, near, *_ = x = np.moveaxis(curve.at(shares, curve.likely(draws, rng)), 1, 0)
        along = (near - root) / np.linalg.norm(near - root, axis=-1, keepdims=True)
        edge = np.linalg.norm(x[3] - x[2], axis=-1, keepdims=True)
        out[:, i] = np.moveaxis(np.concatenate([[x[2] - edge * along], x[2:]]), 0, 1)
    return out - rooted(out)[..., :1, :] + rooted(out)[:1, :, :1]


def rooted(x: np.ndarray) -> np.ndarray:
    """Chains that begin at the root, in the middle of the first edge; shape (..., points, 3)."""
    return np.concatenate([(x[..., :1, :] + x[..., 1:2, :]) / 2, x[..., 1:, :]], axis=-2)


def off_mm(strands: Sequence[np.ndarray], chains: np.ndarray) -> np.ndarray:
    """Root mean square distance of each strand's points from its chain [mm], shape (strands,)."""
    out = np.empty(len(strands))
    for i, (x, chain) in enumerate(zip(strands, rooted(chains), strict=True)):
        edges = np.diff(chain, axis=0)
        apart = x[:, None] - chain[:-1]
        share = (apart * edges).sum(axis=-1) / (edges**2).sum(axis=-1)
        apart = apart - np.clip(share, 0, 1)[..., None] * edges
        out[i] = MM * np.sqrt((apart**2).sum(axis=-1).min(axis=1).mean())
    return out
