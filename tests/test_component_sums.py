"""Components added one by one: the same values and derivatives as sums along an axis."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxhair.component_sums import one_by_one

CLOSE = {"float32": 1e-6, "float64": 1e-14}


def summed(x: Array) -> Array:
    return jnp.sum(x, axis=-2, keepdims=True)


def squared(total: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda x: jnp.sum(total(jnp.sin(x)) ** 2)


@pytest.mark.parametrize("dtype", CLOSE)
@pytest.mark.parametrize(
    "derived",
    [
        lambda f: f,
        lambda f: lambda x: jax.jvp(f, (x,), (jnp.cos(x),)),
        lambda f: jax.grad(squared(f)),
        lambda f: jax.hessian(lambda x: squared(f)(x[:1])),
        lambda f: jax.vmap(f, in_axes=1, out_axes=-1),
        lambda f: jax.vmap(jax.grad(squared(f)), in_axes=3),
        lambda f: jax.grad(lambda x: jnp.sum(jax.vmap(f, in_axes=3)(x) ** 2)),
    ],
    ids=["value", "jvp", "grad", "hessian", "vmap", "vmap of grad", "grad of vmap"],
)
@pytest.mark.parametrize("shape", [(5, 3, 7, 2), (2, 4, 4, 3)])
def test_it_is_the_sum(derived: Any, dtype: str, shape: tuple[int, ...]) -> None:
    x = jnp.asarray(np.random.default_rng(0).normal(size=shape), dtype)
    for compiled in (lambda f: f, jax.jit):
        found, wanted = (compiled(derived(f))(x) for f in (one_by_one, summed))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            assert one.shape == other.shape
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=0, atol=10 * CLOSE[dtype])


def test_a_cpu_is_given_no_sum_along_an_axis() -> None:
    lowered = jax.jit(one_by_one).lower(jnp.ones((5, 3, 7)))
    assert ("reduce" in lowered.as_text()) == (jax.default_backend() != "cpu")
