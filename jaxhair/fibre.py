"""The fibre: how stiff a hair is, and how its cuticle's wear softens it from the root on."""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxhair import check
from jaxhair.effects import StiffnessEffect
from jaxhair.pytree import pytree
from jaxhair.strands import per_strand


@pytree
class Fibre:
    """Stiffness of a hair as the paper has it.

    Arguments:
        stiffness: k_o of an intact hair, the share of the shape error that one time step takes
            away, in [0, 1].
        cuticle_share: the cuticle's part of it, k_cut / k_o, in [0, 1].
        peeling_rate: s [1/m], the share of the cuticle that is lost for each metre from the root.

    Each is one number, or has shape (strands,) to differ between strands.
    Raises ValueError outside these ranges.
    """

    stiffness: Any = 0.05
    cuticle_share: Any = 0.5764
    peeling_rate: Any = 0.33

    def __post_init__(self) -> None:
        check.fraction("fibre.stiffness", self.stiffness)
        check.fraction("fibre.cuticle_share", self.cuticle_share)
        check.not_negative("fibre.peeling_rate", self.peeling_rate)


def cuticle_left(peeling_rate: Array, distance: Array) -> Array:
    """c = max(1 - s d, 0) (Eq. 14).

    Arguments:
        peeling_rate: s [1/m]. distance: d from the root along the strand [m].
    """
    return jnp.maximum(1 - peeling_rate * distance, 0)


def stiffness(fibre: Fibre, distance: Array) -> Array:
    """k = k_o - k_cut (1 - c), with k_cut = cuticle_share k_o (Eq. 13).

    Arguments:
        distance: d from the root along the strand [m], shape (inner points, 1, strands or 1).
    Returns k, of that shape.
    """
    k_o = per_strand(fibre.stiffness)
    k_cut = per_strand(fibre.cuticle_share) * k_o
    c = cuticle_left(per_strand(fibre.peeling_rate), distance)
    return k_o - k_cut * (1 - c)


@pytree
class Soften(StiffnessEffect):
    """Makes the fibre softer while it acts, as water does: k becomes factor k.

    Arguments:
        factor: in [0, 1]; wet hair has about 0.4 of the dry hair's stiffness (Robbins).
    """

    factor: Any = 0.4

    def __post_init__(self) -> None:
        check.fraction("Soften.factor", self.factor)

    def scaled(self, stiffness: Array) -> Array:
        """factor k."""
        return stiffness * self.factor
