"""The common scene of the peer programs: N strands of P points under gravity, bonds that change.

Written from the scene's published rules (strands of 3 cm edges, clamped root, remembered shapes
and fractions drawn at random). The bonds' fractions stay as they are while a part of two kinds
is exchanged in each step: it breaks, and re-forms remembering the present shape.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair import pytree
from jaxhair.effects import BondEffect
from jaxhair.strands import BONDS, State

EDGE = 0.03


@pytree
class Exchange(BondEffect):
    """Breaks a part of the bonds of each kind and re-forms it, in every step.

    amount: shape (inner points, 4, strands).
    """

    amount: Any

    kinds_cut = BONDS  # type: ignore[assignment]
    kinds_formed = BONDS  # type: ignore[assignment]
    sign = 1


@pytree
class ExchangeOut(Exchange):
    """The part that breaks."""

    kinds_formed = ()  # type: ignore[assignment]

    def fraction_change(
        self, kind: str, fraction: Array, rod: Any, state: State, dt: float
    ) -> Array:
        return -self.amount[:, BONDS.index(kind)]


@pytree
class ExchangeIn(Exchange):
    """The part that re-forms."""

    kinds_cut = ()  # type: ignore[assignment]

    def fraction_change(
        self, kind: str, fraction: Array, rod: Any, state: State, dt: float
    ) -> Array:
        return self.amount[:, BONDS.index(kind)]


def numbers(strands: int, points: int, seed: int = 0) -> dict[str, np.ndarray]:
    """The numbers of the scene, strands first; quaternions are w x y z."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(strands)))
    index = np.arange(strands)
    root = np.stack([np.zeros(strands), (index % side) * 0.012, (index // side) * 0.012], -1)
    root += rng.normal(0, 0.001, (strands, 3))
    toward = np.array([1.0, 0, 0]) + rng.normal(0, 0.15, (strands, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    q = np.zeros((strands, points - 1, 4))
    q[:, 0] = np.concatenate([1 + toward[:, 2:], np.cross([0.0, 0.0, 1.0], toward)], axis=1)
    q[:, 0] /= np.linalg.norm(q[:, 0], axis=-1, keepdims=True)
    p = np.zeros((strands, points, 3))
    p[:, 0] = root
    shape = rng.normal(0, 0.04, (strands, points - 2, 3)) + np.array([0.05, 0, 0.01])
    for e in range(points - 1):
        if e > 0:
            vector = shape[:, e - 1]
            real = np.sqrt(1 - (vector**2).sum(-1, keepdims=True))
            q[:, e] = product(q[:, e - 1], np.concatenate([real, vector], -1))
        p[:, e + 1] = p[:, e] + EDGE * tangent(q[:, e])
    inner = (strands, points - 2)
    shapes = shape[:, :, None] * (1 + rng.normal(0, 0.1, (*inner, 4, 1)))
    influence = np.array([1, 0.5, 0.3, 0.2]) * (1 + 0.1 * rng.random((*inner, 4)))
    fractions = np.array([0.9, 0.5, 0.99, 0.8]) * (1 - 0.05 * rng.random((*inner, 4)))
    exchange = np.array([0.002, 0, 0.001, 0]) * np.ones((*inner, 4))
    arrays = {
        "positions": p,
        "orientations": q,
        "shapes": shapes,
        "influence": influence,
        "fractions": fractions,
        "exchange": exchange,
    }
    return {name: x.astype(np.float32).astype(float) for name, x in arrays.items()}


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product of w x y z quaternions on the last axis."""
    w1, v1, w2, v2 = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    real = w1 * w2 - (v1 * v2).sum(-1, keepdims=True)
    return np.concatenate([real, w1 * v2 + w2 * v1 + np.cross(v1, v2)], -1)


def tangent(q: np.ndarray) -> np.ndarray:
    """R(q) e3 of w x y z quaternions on the last axis."""
    w, x, y, z = np.moveaxis(q, -1, 0)
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z], -1)


def as_state(numbers: dict[str, np.ndarray], dtype: Any) -> State:
    """The start of the scene as a state, fractions raised by what the first step breaks."""

    def last(x: np.ndarray) -> Array:
        return jnp.moveaxis(jnp.asarray(x, dtype), 0, -1)

    return State(
        last(numbers["positions"]),
        jnp.zeros_like(last(numbers["positions"])),
        last(numbers["orientations"]),
        last(numbers["shapes"]),
        last(numbers["fractions"] + numbers["exchange"]),
    )
