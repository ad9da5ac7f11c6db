"""First and second derivatives of a rod's energy in the rotations of its frames, for the direct
solver.

The second derivatives are made to bound the true ones from above: what is negative in them is left
out or covered. So the matrix of a Newton step is positive whatever the load, and the step never
raises the energy of an implicit Euler step; without the second-order terms (Gauss and Newton) a
loaded coil spins itself up and never comes to rest, and with them exact, a dropped one blows up.
At rest they change nothing, and in motion what a smaller time step changes too.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array

from jaxhair import quaternion as quat
from jaxhair import rods
from jaxhair.rods import Rod


class Units(NamedTuple):
    """Units in which a rod's numbers are near 1: its mean edge, that edge's mass, the time step.

    length [m], force [N], and the unit of force over E A.
    """

    length: Array
    force: Array
    compliance: Array

    @classmethod
    def of(cls, rod: Rod, dt: float) -> "Units":
        mass, material = rod.unit_mass(), rod.material
        assert material is not None
        force = mass * material.unit_length / dt**2
        return cls(material.unit_length, force, force / material.axial_stiffness)


class Joints(NamedTuple):
    """Stiffness of each inner point's bend and twist against rotations of the edge before it
    (first), of the edge after it (second), and between both, each of shape (points - 2, 3, 3,
    strands); and the moments on the two edges, shape (points - 2, 3, strands)."""

    of_first: Array
    of_second: Array
    between: Array
    on_first: Array
    on_second: Array


def joints(rod: Rod, unit: Units, before: Array, q: Array, rest: Any, dt: float) -> Joints:
    """Derivatives of sum_i (4 B / h) |c|^2 / 2, c = Omega - shape, in units.

    With rotations phi_1, phi_2 of the two edges in their own axes and a = (r_w I + [Omega]x) / 2,
    c changes by a phi_2 - a' phi_1 to first order. To second order, with the moment m = (4 B / h) c
    and the mean s and difference d of the rotations, the energy has the term -(r_w / 4) m . (s x d)
    besides, which is taken as it is, and terms in |m| |Omega| |s|^2. Both are bounded by
    X |s|^2 / 2, X = |m|^2 / (4 min 4 B / h) + |m| |Omega|.

    Arguments:
        before: orientations at the start of the step, for the material's damping.
        q: orientations now, shape (points - 1, 4, strands).
        rest: shape and share of `jaxhair.bonds.springs`.
    """
    shape, share = rest
    spring = share * rod.bending() / (unit.force * unit.length)
    r = rods.darboux(q[:-1], q[1:])
    r = quat.same_hemisphere(r, shape) * r
    c = (r - shape)[:, 1:]
    moment = spring * c
    if rod.material is not None and rod.material.damping_time is not None:
        rate = rod.material.damping_time / dt
        old = rods.darboux(before[:-1], before[1:])
        old = quat.same_hemisphere(old, r) * old
        moment = moment + spring * rate * (r - old)[:, 1:]
        spring = spring * (1 + rate)
    weakest = jnp.min(spring, axis=1, keepdims=True)
    bent = jnp.where(weakest > 0, quat.dot(moment, moment) / jnp.where(weakest > 0, weakest, 1), 0)
    cover = bent / 4 + quat.safe_norm(moment) * quat.safe_norm(r[:, 1:])
    held = cover[:, None] / 4 * jnp.eye(3, dtype=q.dtype)[None, :, :, None]
    a = _matrix(r[:, 0], r[:, 1:]) / 2
    a_t = jnp.swapaxes(a, 1, 2)
    spring = spring[:, :, None]
    return Joints(
        of_first=_product(a, spring * a_t) + held,
        of_second=_product(a_t, spring * a) + held,
        between=_product(a, spring * a) - _matrix(0 * r[:, 0], r[:, :1] * moment) / 4 - held,
        on_first=jnp.sum(a * moment[:, None], axis=2),
        on_second=-jnp.sum(a_t * moment[:, None], axis=2),
    )


def of_force(n: Array, d1: Array, d2: Array, d3: Array) -> Array:
    """Second derivative of -n . d3 in a rotation of its frame, without the negative part.

    In the frame's axes it is A = [[n3, 0, -n1/2], [0, n3, -n2/2], [-n1/2, -n2/2, 0]]. Across
    (n1, n2) its eigenvalue is n3; in the plane of (n1, n2) and d3 they are (n3 +- |n|) / 2, so that
    |A| has a closed form, and (A + |A|) / 2 is returned.

    Arguments: n: shape (edges, 3, strands); d1, d2, d3: of the same shape.
    Returns shape (edges, 3, 3, strands).
    """
    n1, n2, n3 = (quat.dot(n, d) for d in (d1, d2, d3))
    size = quat.safe_norm(n)
    none = size == 0
    inverse = jnp.where(none, 0, 1 / jnp.where(none, 1, size))
    along = jnp.abs(n3)
    in_plane = (size - along) * inverse / (4 * (size + along) + none)
    pulled, turning = jnp.maximum(n3, 0), -(1 + n3 * inverse) / 4
    across = (n1 * n1 + n2 * n2) * inverse / 4
    rows = [
        [pulled + in_plane * n1 * n1, in_plane * n1 * n2, turning * n1],
        [in_plane * n1 * n2, pulled + in_plane * n2 * n2, turning * n2],
        [turning * n1, turning * n2, across],
    ]
    return jnp.stack([jnp.concatenate(row, axis=1) for row in rows], axis=1)


def _matrix(w: Array, v: Array) -> Array:
    """w I + [v]x, shape (..., 3, 3, strands), from (..., strands) and (..., 3, strands)."""
    x, y, z = (v[:, i] for i in range(3))
    rows = [[w, -z, y], [z, w, -x], [-y, x, w]]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def _product(a: Array, b: Array) -> Array:
    return jnp.sum(a[:, :, :, None] * b[:, None], axis=2)


def padded(x: Array, before: int, after: int) -> Array:
    """Rows of zeros before and after."""
    return jnp.pad(x, ((before, after), *((0, 0),) * (x.ndim - 1)))
