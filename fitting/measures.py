"""Numbers of a curl, from the points of its strands: diameter, pitch, waves, index, retention.

All functions take points [m] of shape (..., points, 3) and give one number a strand, shape (...,),
or one at each inner point. They are differentiable, and finite in value and slope where hair is
straight, folded or has points in the same place; points that repeat the one before are missing
ones, as at the end of a shorter strand.

A strand is taken as a chain of straight edges. With the mean bend b between edges and the mean
twist c between the planes of bends, a regular chain turns about its axis by phi an edge and climbs
at an angle a:

    sin(phi / 2) cos(a) = sin(b / 2),    sin(phi / 2) sin(a) = cos(b / 2) sin(c / 2),

so that its points lie on a cylinder of diameter l cos(a) / sin(phi / 2), exactly. In noisy points
bends are too large, as norms are: thin out such strands first (`fitting.resampled`).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from jaxhair import check
from jaxhair import quaternion as quat


class _Chain(NamedTuple):
    """Edges of strands, with the strands last.

    lengths: shape (points - 1, 1, strands). bends, twists: angles at the inner points and at the
    inner edges [rad], shape (points - 2, 1, strands) and (points - 3, 1, strands). has_bend,
    has_twist: 1 where the edges that make one are there.
    """

    lengths: Array
    bends: Array
    twists: Array
    has_bend: Array
    has_twist: Array


@jax.jit
def _chain(x: Array) -> _Chain:
    edges = x[1:] - x[:-1]
    lengths, t = quat.safe_norm(edges), quat.unit(edges)
    there = (lengths > 0).astype(x.dtype)
    normals = quat.cross(t[:-1], t[1:])
    bends = _angle(quat.safe_norm(normals), quat.dot(t[:-1], t[1:]))
    over = quat.dot(quat.cross(normals[:-1], normals[1:]), t[1:-1])
    twists = _angle(over, quat.dot(normals[:-1], normals[1:]))
    has_bend = there[:-1] * there[1:]
    return _Chain(lengths, bends * has_bend, twists, has_bend, has_bend[:-1] * has_bend[1:])


def _angle(sine: Array, cosine: Array) -> Array:
    """atan2, and 0 with slope 0 where neither says anything: where both are 0."""
    none = (sine == 0) & (cosine == 0)
    return jnp.where(none, 0, jnp.arctan2(sine, jnp.where(none, 1, cosine)))


class Curl(NamedTuple):
    """Of each strand, taken as a regular curl; each of shape (...,).

    curvature: 2 / diameter of the circle of the same bends [1/m], 0 for straight hair.
    torsion: turn of the bends' plane over the length [1/m], above 0 for a right-handed curl.
    curliness: 1 / diameter [1/m], 0 for straight hair. diameter [m]: infinite for straight hair.
    pitch: rise in a turn [m]. waves: number of turns.
    """

    curvature: Array
    torsion: Array
    curliness: Array
    diameter: Array
    pitch: Array
    waves: Array


def curl(points: Any) -> Curl:
    """What helix the strands are, see the module's text. Raises ValueError for wrong shapes."""
    x, leading = _columns(points, least=3)
    return Curl(*(value.reshape(leading) for value in _curl(x)))


@jax.jit
def _curl(x: Array) -> Curl:
    """`curl` of points of shape (points, 3, strands), each number of shape (strands,)."""
    chain = _chain(x)
    count = jnp.maximum(jnp.sum(chain.lengths > 0, axis=0, dtype=x.dtype), 1)
    edge = jnp.sum(chain.lengths, axis=0) / count
    bend = jnp.sum(chain.bends, axis=0) / jnp.maximum(jnp.sum(chain.has_bend, axis=0), 1)
    # Each twist counts as the bends beside it: where hair is straight its plane means nothing.
    weight = chain.bends[:-1] * chain.bends[1:] * chain.has_twist
    twist = _ratio(jnp.sum(weight * chain.twists, axis=0), jnp.sum(weight, axis=0))
    # Hair that turns less than a radian in all has no visible torsion, only its points' noise.
    twist = twist * -jnp.expm1(-(jnp.sum(chain.bends, axis=0) ** 4))
    across, along = jnp.sin(bend / 2), jnp.cos(bend / 2) * jnp.sin(twist / 2)
    half_turn = quat.safe_norm(jnp.concatenate([across, along]))  # sin(phi / 2)
    turn = 2 * jnp.arcsin(jnp.clip(half_turn, 0, 0.999999))
    climb = _angle(along, across)
    curliness = _ratio(half_turn, edge * jnp.cos(climb))
    straight = curliness == 0
    rise = edge * jnp.sin(climb)
    found = (
        _ratio(2 * across, edge),
        _ratio(twist, edge),
        curliness,
        jnp.where(straight, jnp.inf, 1 / jnp.where(straight, 1, curliness)),
        _ratio(2 * jnp.pi * rise, turn),
        count * turn / (2 * jnp.pi),
    )
    return Curl(*(value[0] for value in found))


def curl_diameter(points: Any) -> Array:
    """Diameter of the curl [m], shape (...,); infinite for straight hair."""
    return curl(points).diameter


def length(points: Any) -> Array:
    """Contour length [m], shape (...,)."""
    x, leading = _columns(points, least=2)
    return jnp.sum(quat.safe_norm(x[1:] - x[:-1]), axis=0)[0].reshape(leading)


def extent(points: Any) -> Array:
    """Distance between root and tip [m], shape (...,)."""
    x, leading = _columns(points, least=2)
    return quat.safe_norm(x[-1] - x[0])[0].reshape(leading)


def curl_index(points: Any) -> Array:
    """Contour length over the distance of root and tip, at least 1; infinite where they meet."""
    apart = extent(points)
    meet = apart == 0
    return jnp.where(meet, jnp.inf, length(points) / jnp.where(meet, 1, apart))


def retention(before: Any, after: Any) -> Array:
    """(L - H_after) / (L - H_before): how much of a curl is left, by heights H of hair of length L.

    The classical measure of a curl's retention; 1 where nothing was lost, 0 for hair that hangs
    straight. Where it was straight before too, 1.

    Arguments:
        before, after: points [m] of the same strands, each of shape (..., points, 3).
    """
    whole = length(before)
    curled = whole - extent(before)
    none = curled <= 0
    return jnp.where(none, 1, (whole - extent(after)) / jnp.where(none, 1, curled))


def curvature(points: Any) -> Array:
    """Curvature 2 b / (l_1 + l_2) at the inner points [1/m], shape (..., points - 2)."""
    x, leading = _columns(points, least=3)
    chain = _chain(x)
    around = chain.lengths[:-1] + chain.lengths[1:]
    return _along(_ratio(2 * chain.bends, around), leading)


def torsion(points: Any) -> Array:
    """Torsion c / l at the inner edges [1/m], shape (..., points - 3); 0 beside straight places.

    Above 0 for right-handed curls.
    """
    x, leading = _columns(points, least=4)
    chain = _chain(x)
    return _along(_ratio(chain.twists * chain.has_twist, chain.lengths[1:-1]), leading)


def _columns(points: Any, least: int) -> tuple[Array, tuple[int, ...]]:
    """Points as (points, 3, strands), and the shape of the strands."""
    x = jnp.asarray(points)
    if x.ndim < 2 or x.shape[-1] != 3 or x.shape[-2] < least or not x.size:
        raise ValueError(
            f"points has shape {x.shape}; it must have shape (..., points, 3) with {least} points "
            "or more"
        )
    check.finite("points", points)
    return jnp.moveaxis(x.reshape(-1, *x.shape[-2:]), 0, -1), x.shape[:-2]


def _along(values: Array, leading: tuple[int, ...]) -> Array:
    """(n, 1, strands) as (..., n)."""
    return jnp.moveaxis(values[:, 0], -1, 0).reshape(*leading, values.shape[0])


def _ratio(part: Array, whole: Array) -> Array:
    """part / whole, and 0 where the whole is 0."""
    none = whole == 0
    return jnp.where(none, 0, part / jnp.where(none, 1, whole))
