"""Quaternion algebra on arrays of shape (..., 4, strands): component order w x y z, strands last.

Vectors have shape (..., 3, strands). A quaternion and its negative are the same rotation.
All functions work in any floating dtype and are safe in value and derivative at zero.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair.kernels import one_kernel
from jaxhair.stored import stored
from jaxhair.sums import spread, summed


def components(x: Array) -> Sequence[Array]:
    """The 3 or 4 components, each with an axis of size 1.

    In reverse mode they are joined again, where slices of x would be padded with zeros and added
    up.
    """
    return lax.split(x, (1,) * x.shape[-2], axis=x.ndim - 2)


def joined(*parts: Array) -> Array:
    """What `components` takes apart."""
    return jnp.concatenate(parts, axis=-2)


def dot(a: Array, b: Array) -> Array:
    """a . b over the component axis, which is kept with size 1."""
    return summed(a * b)


def scaled(x: Array, factor: Array) -> Array:
    """factor x, with a factor for each vector, component axis of size 1, or for each component.

    In reverse mode the factor's derivative is a `dot`; see `jaxhair.sums`.
    """
    if factor.ndim > 1 and factor.shape[-2] == 1:
        shape = jnp.broadcast_shapes(factor.shape, x.shape)
        factor = spread(jnp.broadcast_to(factor, (*shape[:-2], 1, shape[-1])), shape[-2])
    return factor * x


def safe_norm(x: Array) -> Array:
    """|x| over the component axis (kept with size 1); its derivative at x = 0 is 0, not NaN."""
    square = dot(x, x)
    zero = square == 0
    return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))


@jax.custom_jvp
def unit(x: Array) -> Array:
    """x / |x| over the component axis; 0 where x = 0, with derivative 0 there."""
    return x * _inverse_norm(x)


@unit.defjvp
def _unit_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    """d(x / |x|) = (dx - u (u . dx)) / |x|."""
    (x,), (dx,) = primals, tangents
    inverse = _inverse_norm(x)
    u, turned = x * inverse, dx * inverse
    return u, turned - scaled(u, dot(u, turned))


@one_kernel
def _inverse_norm(x: Array) -> Array:
    square = dot(x, x)
    zero = square == 0
    return jnp.where(zero, 0, lax.rsqrt(jnp.where(zero, 1, square)))


def cross(a: Array, b: Array) -> Array:
    """a x b over the component axis."""
    a1, a2, a3 = components(a)
    b1, b2, b3 = components(b)
    return joined(a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product a b: the rotation b followed by the rotation a."""
    aw, ax, ay, az = components(a)
    bw, bx, by, bz = components(b)
    return joined(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def multiply_vector(q: Array, v: Array) -> Array:
    """Hamilton product q (0, v)."""
    w, x, y, z = components(q)
    a, b, c = components(v)
    return joined(
        -x * a - y * b - z * c,
        w * a + y * c - z * b,
        w * b - x * c + z * a,
        w * c + x * b - y * a,
    )


def conjugate(q: Array) -> Array:
    """(w, -x, -y, -z): the inverse of a unit quaternion."""
    return jnp.concatenate([q[..., :1, :], -q[..., 1:, :]], axis=-2)


def relative(q1: Array, q2: Array) -> Array:
    """conj(q1) q2: the rotation from the frame of q1 to the frame of q2, seen in q1."""
    aw, ax, ay, az = components(q1)
    bw, bx, by, bz = components(q2)
    return joined(
        aw * bw + ax * bx + ay * by + az * bz,
        aw * bx - ax * bw - ay * bz + az * by,
        aw * by + ax * bz - ay * bw - az * bx,
        aw * bz - ax * by + ay * bx - az * bw,
    )


def tangent(q: Array) -> Array:
    """R(q) e3, the direction of an edge whose frame is q, with e3 = (0, 0, 1)."""
    w, x, y, z = components(q)
    return joined(2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z)


def axes(q: Array) -> tuple[Array, Array, Array]:
    """R(q) e1, R(q) e2 and R(q) e3, the columns of the rotation matrix of a unit quaternion."""
    w, x, y, z = components(q)
    columns = [
        [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
        [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    ]
    d1, d2 = (joined(*column) for column in columns)
    return d1, d2, tangent(q)


def rotate(q: Array, v: Array) -> Array:
    """R(q) v for a unit quaternion."""
    axis = q[..., 1:, :]
    twice = 2 * cross(axis, v)
    return v + scaled(twice, q[..., :1, :]) + cross(axis, twice)


def from_rotation_vector(v: Array) -> Array:
    """exp(v / 2): the rotation by |v| radians about v, exact and smooth at v = 0.

    cos and sinc of |v| / 2 are smooth in its square x; near 0 their series are taken, so that
    second derivatives are right too, which a norm would lose.
    """
    x = dot(v, v) / 4
    small = x < 0.01
    half = jnp.sqrt(jnp.where(small, 1, x))
    cosine = 1 - x / 2 * (1 - x / 12 * (1 - x / 30 * (1 - x / 56 * (1 - x / 90))))
    sinc = 1 - x / 6 * (1 - x / 20 * (1 - x / 42 * (1 - x / 72 * (1 - x / 110))))
    w = jnp.where(small, cosine, jnp.cos(half))
    part = scaled(v / 2, jnp.where(small, sinc, jnp.sin(half) / half))
    return jnp.concatenate([w, part], axis=-2)


def between(a: Array, b: Array) -> Array:
    """Shortest rotation that takes the unit vector a to the unit vector b.

    Where b = -a any half turn will do; one about an axis perpendicular to a is taken.
    """
    middle = a + b
    w = dot(middle, middle) / 2  # 1 + a . b, without its cancellation where b is near -a
    opposite = w < np.finfo(a.dtype).eps / 2  # nearer, rounding would choose the axis
    q = jnp.concatenate([w, cross(a, b)], axis=-2)
    half_turn = jnp.concatenate([jnp.zeros_like(w), perpendicular(a)], axis=-2)
    return unit(stored(jnp.where(opposite, half_turn, q)))


def perpendicular(a: Array) -> Array:
    """Some unit vector perpendicular to a."""
    x, y, z = components(jnp.abs(a))
    first = (x <= y) & (x <= z)  # the smallest one, without `argmin`, which is slow
    second = ~first & (y <= z)
    helper = joined(first, second, ~(first | second)).astype(a.dtype)
    return unit(cross(a, helper))


def vector_multiply(v: Array, q: Array) -> Array:
    """Hamilton product (0, v) q."""
    w, x, y, z = components(q)
    a, b, c = components(v)
    return joined(
        -x * a - y * b - z * c,
        w * a + b * z - c * y,
        w * b + c * x - a * z,
        w * c + a * y - b * x,
    )


def from_vector_part(vector: Array) -> Array:
    """The unit quaternion with a given vector part v and real part sqrt(1 - |v|^2) >= 0.

    |v| may pass 1 by rounding. No derivative is taken through the real part: it only serves to
    compare hemispheres.
    """
    real = jnp.sqrt(jnp.maximum(1 - dot(vector, vector), 0))
    return jnp.concatenate([lax.stop_gradient(real), vector], axis=-2)


def same_hemisphere(a: Array, b: Array) -> Array:
    """+1 or -1: the sign that brings the unit quaternion a to the hemisphere of b.

    Piecewise constant, so its derivative is 0.
    """
    along = dot(lax.stop_gradient(a), lax.stop_gradient(b))
    return jnp.where(along >= 0, 1, -1).astype(a.dtype)


def swept_products(first: Array, factors: Array) -> Array:
    """first, first f_0, first f_0 f_1, ...: frames along a strand from its relative rotations.

    first: shape (4, strands); factors: shape (edges - 1, 4, strands). Returns (edges, 4, strands).
    """

    def advance(q: Array, factor: Array) -> tuple[Array, Array]:
        q = unit(multiply(q, factor))
        return q, q

    _, rest = jax.lax.scan(advance, first, factors)
    return jnp.concatenate([first[None], rest])
