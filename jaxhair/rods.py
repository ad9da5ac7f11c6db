"""Cosserat rods in position-based dynamics: the constraints of one strand, (Eq. 1) to (Eq. 11).

After Kugelstadt and Schoemer, Position and Orientation Based Cosserat Rods, 2016
(DOI 10.2312/sca.20161234). Arrays have the strands last; component axes have size 3 or 4, and
weights have size 1 there.
"""

from typing import Any

import jax.numpy as jnp
from jax import Array

from jaxhair import quaternion as quat
from jaxhair.kernels import one_kernel
from jaxhair.pytree import pytree, static
from jaxhair.stored import once, stored


@pytree
class Material:
    """What a rod of a physical fibre is made of; each of shape (1, 1, strands or 1).

    Arguments:
        unit_length: mean rest length of the edges [m], by which solvers make numbers without units.
        linear_density: [kg/m]. axial_stiffness: E A [N].
        damping_time: of the material's own damping [s]; None where it has none.
    """

    unit_length: Array
    linear_density: Array
    axial_stiffness: Array
    damping_time: Any = None


@pytree
class Rod:
    """What stays the same of all strands during a phase.

    Arguments:
        lengths: rest lengths of the edges [m], shape (points - 1, 1, strands or 1).
        point_weights: inverse masses, shape (points, 1, strands or 1); 0 where a point is held or
            missing. Relative: 1 for the paper's fibre; for a physical one, the mass of an edge of
            mean length over the point's own.
        edge_weights: 1 where an edge may turn, 0 where it is held or missing; shape
            (points - 1, 1, strands or 1).
        stiffness: at the inner points: k, shape (points - 2, 1, strands or 1), or with a material
            the stiffness about d1, d2 and d3 [N m^2], shape (points - 2, 3, strands or 1).
        influence: f_j, shape (inner points or 1, 4, strands or 1).
        material: of a physical fibre; None for the paper's.
        ragged: some strands have fewer points; their missing edges have rest length 0.
    """

    lengths: Array
    point_weights: Array
    edge_weights: Array
    stiffness: Array
    influence: Array
    material: Material | None = None
    ragged: bool = static(default=False)

    def edge_exists(self) -> Array:
        """True at edges that are there, shape (points - 1, 1, strands or 1)."""
        return self.lengths > 0

    def point_exists(self) -> Array:
        """True at points that are there, shape (points, 1, strands or 1)."""
        there = self.edge_exists()
        return jnp.concatenate([jnp.ones_like(there[:1]), there])

    def distance(self) -> Array:
        """Arc length from the root to each inner point [m], shape (points - 2, 1, ...)."""
        return jnp.cumsum(self.lengths, axis=0)[:-1]

    def point_lengths(self) -> Array:
        """Length of rod that belongs to each point [m]: half of each edge beside it."""
        none = jnp.zeros((1, *self.lengths.shape[1:]), self.lengths.dtype)
        return (jnp.concatenate([none, self.lengths]) + jnp.concatenate([self.lengths, none])) / 2

    def unit_mass(self) -> Array:
        """Mass of an edge of mean length [kg], that of a point of weight 1. Needs a material."""
        assert self.material is not None, "a Scene sees to a physical fibre where one is needed"
        return self.material.linear_density * self.material.unit_length

    def bending(self) -> Array:
        """Spring constants 4 B / h of |Omega - Omega_o|^2 / 2 [J], shape (points - 2, 3, ...).

        Omega is half the sine of the angle, and h the length of rod that the point stands for, so
        that this is a rod's (B / h) theta^2 / 2. Needs a material.
        """
        h = self.point_lengths()[1:-1]
        if not self.ragged:
            return 4 * self.stiffness / h
        exists = self.edge_exists()[1:]
        return jnp.where(exists, 4 * self.stiffness / jnp.where(exists, h, 1), 0)

    def tangents(self, positions: Array) -> Array:
        """Unit vector of the edge that starts at each point; the tip has its last edge's.

        positions [m] and the result: shape (points, 3, strands).
        """
        t = quat.unit(positions[1:] - positions[:-1])
        tip = jnp.concatenate([t, t[-1:]])
        if not self.ragged:
            return tip
        before = jnp.concatenate([t[:1], t])
        missing = ~jnp.concatenate([self.edge_exists(), self.edge_exists()[-1:]])
        return jnp.where(missing, before, tip)


def _share(part: Array, whole: Array) -> Array:
    """part / whole, and 0 where the whole is 0 because everything is held."""
    none = whole == 0
    return jnp.where(none, 0, part / jnp.where(none, 1, whole))


def stretch_shear_whole(
    w1: Array, w2: Array, wq: Array, length: Array, compliance: Array | float = 0.0
) -> Array:
    """D = w1 + w2 + 4 wq l^2, the denominator of `stretch_shear_factors`, and the compliance."""
    return w1 + w2 + 4 * wq * length**2 + compliance


def stretch_shear_factors(
    w1: Array, w2: Array, wq: Array, length: Array, compliance: Array | float = 0.0
) -> tuple[Array, ...]:
    """The factors of gamma in the corrections of p1 (Eq. 2), p2 (Eq. 3) and q (Eq. 4).

    w1 l / D, w2 l / D and 2 wq l^2 / D with D = w1 + w2 + 4 wq l^2. The 2 of the last is missing
    in print; it comes from the derivative of R(q) e3, and with it one projection takes a small
    violation away to second order.

    Arguments:
        w1, w2: inverse masses of the two points. wq: of the edge's frame [1/m^2].
        length: l [m].
        compliance: of a constraint that gives way, added to D.
    """
    whole = stretch_shear_whole(w1, w2, wq, length, compliance)
    return (
        _share(w1 * length, whole),
        _share(w2 * length, whole),
        _share(2 * wq * length**2, whole),
    )


@once
def stretch_shear_violation(p1: Array, p2: Array, q: Array, length: Array) -> Array:
    """C_s = gamma = (p2 - p1) / l - R(q) e3 (Eq. 1, Eq. 5)."""
    return (p2 - p1) / length - quat.tangent(q)


def stretch_shear(
    p1: Array, p2: Array, q: Array, length: Array, factors: tuple[Array, ...]
) -> tuple[Array, Array, Array]:
    """One projection of stretch-shear: p1 + g1 gamma, p2 - g2 gamma, unit(q + gq gamma q conj(e)).

    Arguments:
        p1, p2: ends of an edge [m], shape (..., 3, strands). q: its frame, (..., 4, strands).
        length: l [m]. factors: of `stretch_shear_factors`.
    """
    gamma = stretch_shear_violation(p1, p2, q, length)
    return stretch_shear_moved(p1, p2, q, gamma, factors)


def stretch_shear_moved(
    p1: Array, p2: Array, q: Array, gamma: Array, factors: tuple[Array, ...]
) -> tuple[Array, Array, Array]:
    """The corrections of `stretch_shear` for a given gamma."""
    g1, g2, gq = factors
    w, x, y, z = quat.components(q)
    q_conj_e = quat.joined(z, -y, x, -w)
    turn = quat.vector_multiply(quat.scaled(gamma, gq), q_conj_e)
    moved1, moved2 = quat.scaled(gamma, g1), quat.scaled(gamma, g2)
    return p1 + moved1, p2 - moved2, quat.unit(stored(q + turn))


def bend_twist_factors(w1: Array, w2: Array, stiffness: Array) -> tuple[Array, Array]:
    """The factors of (Omega - s Omega_o) in the corrections of q1 (Eq. 9) and q2 (Eq. 10).

    k' w1 / (w1 + w2) and k' w2 / (w1 + w2).

    Arguments:
        w1, w2: inverse inertias of the two frames. stiffness: k', of one iteration.
    """
    return _share(stiffness * w1, w1 + w2), _share(stiffness * w2, w1 + w2)


@one_kernel
def darboux(q1: Array, q2: Array) -> Array:
    """conj(q1) q2 (Eq. 8), whose vector part is Omega. The real part is kept for (Eq. 7)."""
    return quat.relative(q1, q2)


def joints(q: Array) -> Array:
    """`darboux` at each inner point of strands with frames q, shape (points - 1, 4, strands)."""
    return stored(darboux(stored(q[:-1]), stored(q[1:])))


def damped(rod: Rod, spring: Array, shape: Array, before: Array, dt: Any) -> tuple[Array, Array]:
    """The moment spring (Omega - shape) + spring (T / dt) (Omega - Omega_before) as one spring.

    Its constant is spring (1 + T / dt), and its shape what lies between both in those parts.
    Without a damping time T, spring and shape as they are. Needs a material.

    Arguments:
        spring: shape (points - 2, 3 or 1, strands or 1). shape: unit quaternions, (points - 2, 4,
            strands or 1).
        before: orientations at the start of the step, shape (points - 1, 4, strands).
    """
    time = None if rod.material is None else rod.material.damping_time
    if time is None:
        return spring, shape
    rate = time / dt
    old = joints(before)
    old = quat.same_hemisphere(old, shape) * old
    between = (shape + rate * old)[:, 1:] / (1 + rate)
    return spring * (1 + rate), quat.from_vector_part(between)


@once
def bend_twist_violation(r: Array, rest: Array) -> Array:
    """C_b = Omega - s Omega_o (Eq. 6), with s = +1 or -1, whichever is nearer (Eq. 7, Eq. 11).

    s compares the whole relative quaternion, real part included. By vector parts alone, as
    printed, a rest shape of +0.05 and a present one of -0.05 would need no correction.

    Arguments:
        r: conj(q1) q2, shape (..., 4, strands).
        rest: the unit quaternion whose vector part is Omega_o, shape (..., 4, strands).
    """
    return (r - quat.same_hemisphere(r, rest) * rest)[..., 1:, :]


def bend_twist(
    q1: Array, q2: Array, rest: Array, factors: tuple[Array, Array]
) -> tuple[Array, Array]:
    """One projection of bend and twist: unit(q1 + h1 q2 C), unit(q2 - h2 q1 C).

    Arguments:
        q1, q2: frames of neighbouring edges, shape (..., 4, strands).
        rest: the unit quaternion whose vector part is Omega_o, shape (..., 4, strands).
        factors: of `bend_twist_factors`.
    """
    c = bend_twist_violation(darboux(q1, q2), rest)
    return bend_twist_moved(q1, q2, c, factors)


def bend_twist_moved(
    q1: Array, q2: Array, c: Array, factors: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The corrections of `bend_twist` for a given violation."""
    h1, h2 = factors
    new1 = quat.unit(stored(q1 + quat.multiply_vector(q2, quat.scaled(c, h1))))
    new2 = quat.unit(stored(q2 - quat.multiply_vector(q1, quat.scaled(c, h2))))
    return new1, new2
