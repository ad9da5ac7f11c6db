"""A direct solver for one strand's linear system: block-tridiagonal, symmetric, 6 x 6 blocks.

The unknowns of an edge are the force in it, n, and the rotation of its frame, phi. The blocks are

    D_e = [[-N_e I, C_e], [C_e', K_e]]  on the diagonal,  O_e = [[t_e I, 0], [0, -S_e]]  beside it,

with N a scalar above 0 and K positive definite. Such a matrix is quasi-definite: elimination in
any order meets no zero pivot (Vanderbei 1995, DOI 10.1137/0805005), with no pivoting, whether the
stiffness K is tiny or large. Forces stay unknowns, because eliminating them would need their
compliance, about 0, inverted. Blocks are eliminated from root to tip: a clamped root keeps every
pivot away from 0, where the free tip's own would be lost in rounding.

Arrays have the edges first and the strands last; the 3 x 3 products stand between. Products are
kernels of their own, so that XLA on the CPU computes each once and keeps it, and sums written out:
with `jnp.sum` they would pass through arrays three times as large.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxhair import quaternion as quat
from jaxhair.kernels import one_kernel
from jaxhair.pytree import pytree
from jaxhair.stored import once


@pytree
class Blocks:
    """The matrix.

    Arguments:
        compliance: N, shape (edges, 1, strands or 1), above 0.
        coupling: C, shape (edges, 3, 3, strands).
        stiffness: K, shape (edges, 3, 3, strands).
        next_compliance: t, shape (edges - 1, 1, strands or 1).
        next_stiffness: S, shape (edges - 1, 3, 3, strands).
    """

    compliance: Any
    coupling: Any
    stiffness: Any
    next_compliance: Any
    next_stiffness: Any


Pair = tuple[Array, Array]
"""What belongs to forces and what to rotations, each of shape (edges, 3, strands)."""


@one_kernel
def solve(blocks: Blocks, right: Pair) -> tuple[Pair, "Factors"]:
    """x with blocks x = right, and the factors, which `solve_again` uses."""
    factors, reduced = _eliminated(blocks, right)
    return _back(factors, reduced), factors


@one_kernel
def solve_again(factors: "Factors", right: Pair) -> Pair:
    """x for another right side, in which it is linear."""
    return _back(factors, _forward(factors, right))


@pytree
class Factors:
    """Of each edge's reduced diagonal block: N^-1, G = N^-1 C, (K + C' G)^-1, the last one with G
    to its left and with S to its right; and t and S themselves."""

    inverse_compliance: Any
    g: Any
    inverse_stiffness: Any
    g_inverse: Any
    inverse_s: Any
    t: Any
    s: Any


def _eliminated(blocks: Blocks, right: Pair) -> tuple[Factors, Pair]:
    """Factors, and the right side after elimination from root to tip, solved for block by block."""
    n, phi = right
    strands = n.shape[-1]
    eye = jnp.eye(3, dtype=n.dtype)[None, :, :, None]
    # The last block has no next one: zeros beside it let all edges take the same step.
    t, s = (
        jnp.concatenate([x, jnp.zeros((1, *x.shape[1:]), x.dtype)])
        for x in (blocks.next_compliance, blocks.next_stiffness)
    )
    rows = (blocks.compliance[:, None] * eye, blocks.coupling, blocks.stiffness, n, phi)
    following = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), rows)

    def edge(reduced: Any, at: Any) -> Any:
        compliance, c, k, n, phi = reduced
        t, s, (next_compliance, next_c, next_k, next_n, next_phi) = at
        inverse_compliance = _inverse(compliance)
        g = matrix_product(inverse_compliance, c)
        inverse = _inverse(k + _tm(c, g))
        g_inverse, inverse_s = matrix_product(g, inverse), matrix_product(inverse, s)
        n, phi = _block(inverse_compliance, g, inverse, n, phi)
        after = (
            next_compliance - t * t * (inverse_compliance - _mt(g_inverse, g)),
            next_c + t * matrix_product(g_inverse, s),
            next_k - _tm(s, inverse_s),
            next_n - t[0] * n,
            next_phi + _tv(s, phi),
        )
        return after, (inverse_compliance, g, inverse, g_inverse, inverse_s, n, phi)

    first = jax.tree.map(lambda x: jnp.broadcast_to(x[0], (*x.shape[1:-1], strands)), rows)
    _, found = lax.scan(edge, first, (t[:, None], s, following))
    inverse_compliance, g, inverse, g_inverse, inverse_s, n, phi = found
    factors = Factors(inverse_compliance, g, inverse, g_inverse, inverse_s, t, s)
    return factors, (n, phi)


def _forward(factors: Factors, right: Pair) -> Pair:
    """What `_eliminated` does to a right side, for another one."""
    n, phi = right

    def edge(reduced: Pair, at: Any) -> tuple[Pair, Pair]:
        f, next_n, next_phi = at
        n, phi = _block(f.inverse_compliance, f.g, f.inverse_stiffness, *reduced)
        return (next_n - f.t * n, next_phi + _tv(f.s, phi)), (n, phi)

    following = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), right)
    return lax.scan(edge, (n[0], phi[0]), (factors, *following), unroll=_unroll(n))[1]


def _back(factors: Factors, reduced: Pair) -> Pair:
    """From tip to root: what each edge's solution is once the next edge's is known."""

    def edge(after: Pair, at: Any) -> tuple[Pair, Pair]:
        f, n, phi = at
        t_n = f.t * after[0]
        turn = _mv(f.inverse_s, after[1]) - _tv(f.g_inverse, t_n)
        x = n + _mv(f.g, turn) + _mv(f.inverse_compliance, t_n), phi + turn
        return x, x

    tip = jax.tree.map(lambda x: jnp.zeros_like(x[0]), reduced)
    return lax.scan(edge, tip, (factors, *reduced), reverse=True, unroll=_unroll(tip[0]))[1]


def _unroll(x: Array) -> int:
    """Edges that a sweep takes at once: with two, Jacobians at 64 strands take a third less time,
    and forward runs of a single strand a half more."""
    return 2 if x.shape[-1] >= 16 else 1


def _block(inverse_compliance: Array, g: Array, inverse: Array, n: Array, phi: Array) -> Pair:
    """The solution of one diagonal block for the right side (n, phi)."""
    phi = _mv(inverse, phi + _tv(g, n))
    return _mv(g, phi) - _mv(inverse_compliance, n), phi


@once
def _inverse(a: Array) -> Array:
    """Inverse of a symmetric 3 x 3 matrix, by cofactors."""
    first, second, third = a[0], a[1], a[2]
    cofactors = jnp.stack(
        [quat.cross(second, third), quat.cross(third, first), quat.cross(first, second)]
    )
    return cofactors / jnp.sum(first * cofactors[0], axis=0)[None, None]


# Products of a matrix (..., 3, 3, strands) with a matrix or a vector (..., 3, strands), of which
# "t" is transposed.


@once
def matrix_product(a: Array, b: Array) -> Array:
    """a b."""
    return _over_three(lambda k: a[..., :, k, None, :] * b[..., None, k, :, :])


def _over_three(term: Callable[[int], Array]) -> Array:
    return term(0) + term(1) + term(2)


@once
def _tm(a: Array, b: Array) -> Array:
    return _over_three(lambda k: a[..., k, :, None, :] * b[..., k, None, :, :])


@once
def _mt(a: Array, b: Array) -> Array:
    return _over_three(lambda k: a[..., :, None, k, :] * b[..., None, :, k, :])


@once
def _mv(a: Array, v: Array) -> Array:
    return _over_three(lambda k: a[..., :, k, :] * v[..., k, None, :])


@once
def _tv(a: Array, v: Array) -> Array:
    return _over_three(lambda k: a[..., k, :, :] * v[..., k, None, :])
