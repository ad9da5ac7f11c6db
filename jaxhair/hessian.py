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
import numpy as np
from jax import Array

from jaxhair import quaternion as quat
from jaxhair import rods
from jaxhair.block_tridiagonal import matrix_product
from jaxhair.kernels import one_kernel
from jaxhair.rods import Rod
from jaxhair.stored import stored


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
    """Bend and twist at the inner points, in units.

    turn: r, shape (points - 2, 4, strands). spring: 4 B / h, against small further turns.
    moment: m = (4 B / h) (Omega - shape), shape (points - 2, 3, strands), as spring.
    cover: X, see `joint_matrices`, shape (points - 2, 1, strands).
    """

    turn: Array
    spring: Array
    moment: Array
    cover: Array


def joints(rod: Rod, unit: Units, before: Array, q: Array, rest: Any, dt: float) -> Joints:
    """What the bends and twists of orientations q are.

    Arguments:
        before: orientations at the start of the step, for the material's damping.
        q: orientations now, shape (points - 1, 4, strands).
        rest: shape and share of `jaxhair.bonds.springs`.
    """
    shape, share = rest
    whole = rod.bending() / (unit.force * unit.length)  # of all bonds, and without damping
    share, shape = rods.damped(rod, share, shape, before, dt)
    spring = quat.scaled(whole, share)
    r = rods.joints(q)
    r = stored(quat.same_hemisphere(r, shape) * r)
    moment = stored(spring * (r - shape)[:, 1:])
    weakest, strongest = (share * f(whole, axis=1, keepdims=True) for f in (jnp.min, jnp.max))
    return Joints(r, spring, moment, _cover(r, moment, weakest, strongest))


@one_kernel
def _cover(r: Array, moment: Array, weakest: Array, strongest: Array) -> Array:
    """X, see `joint_matrices`; of the springs at each joint, the weakest and the strongest."""
    bent = jnp.where(weakest > 0, quat.dot(moment, moment) / jnp.where(weakest > 0, weakest, 1), 0)
    rounding = 32 * np.finfo(r.dtype).eps * strongest
    # |m| |Omega|, rounded off at its tip: at rest m is rounding, and so would be its direction
    across = quat.scaled(moment, quat.safe_norm(r[:, 1:]))
    return bent / 4 + quat.safe_norm(jnp.concatenate([across, rounding], axis=1))


def joint_moments(joints: Joints, phi1: Array, phi2: Array) -> tuple[Array, Array]:
    """Derivatives of the joints' energy after rotations phi_1 of the edges before them and phi_2
    of those after them, by these rotations; to first order in them, `joint_matrices` times them.

    All of shape (points - 2, 3, strands).
    """
    w, v = joints.turn[:, :1], joints.turn[:, 1:]
    both = phi1 + phi2
    change = (quat.scaled(phi2 - phi1, w) + quat.cross(v, both)) / 2
    m = joints.moment + joints.spring * change
    first, second = acting(joints, m)
    held, twisted = quat.scaled(both, joints.cover) / 4, quat.scaled(joints.moment, w) / 4
    return (
        first + held + quat.cross(twisted, phi2),
        second + held - quat.cross(twisted, phi1),
    )


def acting(joints: Joints, moment: Array) -> tuple[Array, Array]:
    """What moments m at the joints do to the edges before and after them, -a m and a' m."""
    w, v = joints.turn[:, :1], joints.turn[:, 1:]
    direct, across = quat.scaled(moment, w) / 2, quat.cross(v, moment) / 2
    return -direct - across, direct - across


def joint_matrices(joints: Joints) -> tuple[Array, Array, Array]:
    """Second derivatives of sum (4 B / h) |Omega - shape|^2 / 2 by phi_1, by phi_2 and, with the
    sign turned, by both; each of shape (points - 2, 3, 3, strands).

    With a = (r_w I + [Omega]x) / 2, Omega changes by a phi_2 - a' phi_1 to first order. To second
    order, with the mean s and the difference d of the rotations, the energy has the term
    -(r_w / 4) m . (s x d), which is taken as it is, and terms in |m| |Omega| |s|^2. Both are
    bounded by X |s|^2 / 2 with the cover X = |m|^2 / (4 min 4 B / h) + |m| |Omega|. It is at least
    what rounding may take from 4 B / h, so that a strand that nothing keeps from spinning about
    itself can be solved for.
    """
    w, v = joints.turn[:, :1], joints.turn[:, 1:]
    held = joints.cover[:, None] / 4 * jnp.eye(3, dtype=v.dtype)[None, :, :, None]
    a = _matrix(w[:, 0], v) / 2
    a_t, spring = jnp.swapaxes(a, 1, 2), joints.spring[:, :, None]
    twisted = _matrix(jnp.zeros_like(w[:, 0]), w * joints.moment / 4)
    return (
        matrix_product(a, spring * a_t) + held,
        matrix_product(a_t, spring * a) + held,
        matrix_product(a, spring * a) - twisted - held,
    )


class Pulls(NamedTuple):
    """Forces n on frames: along d1, d2 and d3, |n|, and what makes the second derivative of
    -n . d3, A = [[n3, 0, -n1/2], [0, n3, -n2/2], [-n1/2, -n2/2, 0]], lose its negative part.

    Across (n1, n2) the eigenvalue of A is n3; in the plane of (n1, n2) and d3 they are
    (n3 +- |n|) / 2, so that |A| has a closed form, and so has (A + |A|) / 2.
    """

    n1: Array
    n2: Array
    pulled: Array
    in_plane: Array
    turning: Array
    along: Array


def pulls(n: Array, d1: Array, d2: Array, d3: Array) -> Pulls:
    """n, and the frame's axes, each of shape (edges, 3, strands)."""
    n1, n2, n3 = (quat.dot(n, d) for d in (d1, d2, d3))
    size, along = quat.safe_norm(n), jnp.abs(n3)
    none = size == 0
    inverse = jnp.where(none, 0, 1 / jnp.where(none, 1, size))
    return Pulls(
        n1,
        n2,
        pulled=jnp.maximum(n3, 0),
        in_plane=(size - along) * inverse / (4 * jnp.where(none, 1, size + along)),
        turning=-(1 + n3 * inverse) / 4,
        along=(n1 * n1 + n2 * n2) * inverse / 4,
    )


def pull_moments(pulls: Pulls, phi: Array) -> Array:
    """`pull_matrix` times rotations phi, shape (edges, 3, strands)."""
    n1, n2, pulled, in_plane, turning, along = pulls
    x, y, z = (phi[:, i : i + 1] for i in range(3))
    on_plane = n1 * x + n2 * y
    both = in_plane * on_plane + turning * z
    return jnp.concatenate(
        [pulled * x + both * n1, pulled * y + both * n2, turning * on_plane + along * z], axis=1
    )


def pull_matrix(pulls: Pulls) -> Array:
    """(A + |A|) / 2 of `Pulls`, shape (edges, 3, 3, strands)."""
    n1, n2, pulled, in_plane, turning, along = pulls
    rows = [
        [pulled + in_plane * n1 * n1, in_plane * n1 * n2, turning * n1],
        [in_plane * n1 * n2, pulled + in_plane * n2 * n2, turning * n2],
        [turning * n1, turning * n2, along],
    ]
    return jnp.stack([jnp.concatenate(row, axis=1) for row in rows], axis=1)


def _matrix(w: Array, v: Array) -> Array:
    """w I + [v]x, shape (..., 3, 3, strands), from (..., strands) and (..., 3, strands)."""
    x, y, z = (v[:, i] for i in range(3))
    rows = [[w, -z, y], [z, w, -x], [-y, x, w]]
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def padded(x: Array, before: int, after: int) -> Array:
    """Rows of zeros before and after."""
    return jnp.pad(stored(x), ((before, after), *((0, 0),) * (x.ndim - 1)))
