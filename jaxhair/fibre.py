"""The fibre: how stiff a hair is, and how its cuticle's wear softens it from the root on.

`Fibre` is the paper's, a number without a unit that depends on the time step. `PhysicalFibre` has
moduli and a cross-section, from which follow stiffnesses in SI units.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxhair import check
from jaxhair.effects import StiffnessEffect
from jaxhair.pytree import pytree
from jaxhair.rods import Material
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
        check.fraction("fibre.stiffness", self.stiffness, many=True)
        check.fraction("fibre.cuticle_share", self.cuticle_share, many=True)
        check.not_negative("fibre.peeling_rate", self.peeling_rate, many=True)


@pytree
class PhysicalFibre:
    """A hair as an elastic rod with an elliptical cross-section.

    Arguments:
        young_modulus: E of an intact hair [Pa]. shear_modulus: G [Pa].
        radius: semi-axis of the section [m], along the frame's first axis d1.
        minor_radius: the other semi-axis [m], along d2; None for a round section.
        density: [kg/m^3].
        cuticle_share: the cuticle's part of the bending and twisting stiffness, in [0, 1].
        peeling_rate: s [1/m], the share of the cuticle that is lost for each metre from the root.
        damping_time: T [s] of the material's own damping (Kelvin and Voigt): its moments are
            those of the shape it would have a time T later at the present rate. A mode of
            angular frequency w is damped at the ratio w T / 2, whatever dt. None: not computed.

    Each is one number, or has shape (strands,) to differ between strands. The defaults are dry
    hair (Robbins, Chemical and Physical Behavior of Human Hair, appendix), 80 um thick.
    Raises ValueError for shares outside [0, 1], a negative rate or time, or others not above 0.
    """

    young_modulus: Any = 3.89e9
    shear_modulus: Any = 0.89e9
    radius: Any = 40e-6
    minor_radius: Any = None
    density: Any = 1320.0
    cuticle_share: Any = 0.5764
    peeling_rate: Any = 0.33
    damping_time: Any = None

    def __post_init__(self) -> None:
        for name in ("young_modulus", "shear_modulus", "radius", "minor_radius", "density"):
            if name != "minor_radius" or self.minor_radius is not None:
                check.positive(f"fibre.{name}", getattr(self, name), many=True)
        check.fraction("fibre.cuticle_share", self.cuticle_share, many=True)
        check.not_negative("fibre.peeling_rate", self.peeling_rate, many=True)
        if self.damping_time is not None:
            check.not_negative("fibre.damping_time", self.damping_time, many=True)

    @property
    def area(self) -> Any:
        """Of the cross-section, pi a b [m^2]."""
        return jnp.pi * self._a * self._b

    @property
    def bending_stiffness(self) -> tuple[Any, Any]:
        """E I about d1 and about d2, with I = pi a b^3 / 4 and pi a^3 b / 4 [N m^2]."""
        a, b = self._a, self._b
        quarter = jnp.pi * self.young_modulus / 4
        return quarter * a * b**3, quarter * a**3 * b

    @property
    def twisting_stiffness(self) -> Any:
        """G J with J = pi a^3 b^3 / (a^2 + b^2) [N m^2]."""
        a, b = self._a, self._b
        return jnp.pi * self.shear_modulus * a**3 * b**3 / (a**2 + b**2)

    @property
    def _a(self) -> Any:
        return jnp.asarray(self.radius)

    @property
    def _b(self) -> Any:
        return jnp.asarray(self.radius if self.minor_radius is None else self.minor_radius)


def cuticle_left(peeling_rate: Array, distance: Array) -> Array:
    """c = max(1 - s d, 0) (Eq. 14).

    Arguments:
        peeling_rate: s [1/m]. distance: d from the root along the strand [m].
    """
    return jnp.maximum(1 - peeling_rate * distance, 0)


def stiffness(fibre: Fibre | PhysicalFibre, distance: Array) -> Array:
    """k = k_o - k_cut (1 - c), with k_cut = cuticle_share k_o (Eq. 13).

    Arguments:
        distance: d from the root along the strand [m], shape (inner points, 1, strands or 1).
    Returns k, of that shape; for a physical fibre, of which k_o is the stiffness about d1 and d2
    and the twisting one, of shape (inner points, 3, strands or 1) [N m^2].
    """
    if isinstance(fibre, PhysicalFibre):
        whole = (*fibre.bending_stiffness, fibre.twisting_stiffness)
        k_o = jnp.concatenate(jnp.broadcast_arrays(*(per_strand(x) for x in whole)), axis=1)
    else:
        k_o = per_strand(fibre.stiffness)
    k_cut = per_strand(fibre.cuticle_share) * k_o
    c = cuticle_left(per_strand(fibre.peeling_rate), distance)
    return k_o - k_cut * (1 - c)


def material(fibre: PhysicalFibre, lengths: Array) -> Material:
    """What a rod of this fibre has besides its bending and twisting stiffness.

    lengths: rest lengths of the edges [m], shape (points - 1, 1, strands or 1).
    """
    exists = lengths > 0
    return Material(
        unit_length=jnp.sum(lengths, axis=0, keepdims=True)
        / jnp.sum(exists, axis=0, keepdims=True, dtype=lengths.dtype),
        linear_density=per_strand(fibre.density * fibre.area),
        axial_stiffness=per_strand(fibre.young_modulus * fibre.area),
        damping_time=None if fibre.damping_time is None else per_strand(fibre.damping_time),
    )


@pytree
class Soften(StiffnessEffect):
    """Makes the fibre softer while it acts, as water does: k, or E and G, times a factor.

    Arguments:
        factor: in [0, 1]; wet hair has about 0.4 of the dry hair's stiffness (Robbins).
    """

    each_strand_alone = True
    factor: Any = 0.4

    def __post_init__(self) -> None:
        check.fraction("Soften.factor", self.factor)

    def scaled(self, stiffness: Array) -> Array:
        """factor k."""
        return stiffness * self.factor
