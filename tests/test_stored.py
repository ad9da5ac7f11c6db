"""`stored` changes no value and no derivative, and is there in the compiled program."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhair import quaternion as quat
from jaxhair.kernels import allowed
from jaxhair.stored import once, stored
from jaxhair.sums import ONE_BY_ONE

X = np.linspace(0.1, 1.5, 12).reshape(3, 4)


def chain(x: Any, keep: Any = stored) -> Any:
    """Something of what was taken apart."""
    first, second = jnp.split(keep(jnp.sin(x) * x[::-1]), 2, axis=-1)
    return jnp.concatenate([first * second, first + second**2], axis=-1)


DTYPES = pytest.mark.parametrize("dtype", ["float32", "float64"])


@DTYPES
@pytest.mark.parametrize(
    "derived",
    [
        lambda f: f,
        jax.jit,
        jax.vmap,
        jax.jacfwd,
        jax.jacrev,
        lambda f: jax.jit(jax.jacfwd(jax.jacrev(f))),
        lambda f: jax.jit(jax.vmap(jax.grad(lambda x: jnp.sum(f(x[None]))))),
        lambda f: jax.grad(jax.checkpoint(lambda x: jnp.sum(f(x)))),
        lambda f: lambda x: jax.linearize(f, x)[1](jnp.ones_like(x)),
    ],
)
def test_values_and_derivatives_are_those_without(derived: Any, dtype: str) -> None:
    x = jnp.asarray(X, dtype)
    with_it, without = derived(chain)(x), derived(lambda x: chain(x, keep=lambda x: x))(x)
    assert with_it.dtype == dtype
    np.testing.assert_allclose(with_it, without, rtol=10 * np.finfo(dtype).eps)


@DTYPES
def test_whole_numbers_and_zero_tangents_pass(dtype: str) -> None:
    numbers = jnp.arange(3)
    np.testing.assert_array_equal(jax.jit(stored)(numbers), numbers)
    x = jnp.asarray(X, dtype)
    gradient = jax.grad(lambda x: jnp.sum(stored(jax.lax.stop_gradient(x)) * x))(x)
    np.testing.assert_allclose(gradient, X, rtol=1e-6)


def products(q: Any, r: Any, keep: Any) -> Any:
    """A chain of products of quaternions, each made unit."""
    for _ in range(4):
        q = keep(quat.unit(keep(quat.multiply(q, r))))
    return q


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="other platforms choose by themselves")
@pytest.mark.parametrize("derived", [lambda f: f, jax.grad], ids=["value", "gradient"])
def test_compiled_programs_store(derived: Any) -> None:
    """XLA has inlined none of the calls. Sums have calls of their own with JAX 0.12."""
    rng = np.random.default_rng(0)
    q, r = (quat.unit(jnp.asarray(rng.normal(size=(5, 4, 7)), jnp.float32)) for _ in range(2))

    def compiled(keep: Any) -> str:
        function = derived(lambda q, r: jnp.sum(products(q, r, keep) ** 2))
        return jax.jit(function).lower(q, r).compile().as_text()

    times = 8 if derived is not jax.grad else 16  # and once more each cotangent
    of_sums = compiled(lambda x: x).count(" call(")
    assert (of_sums > 0) == ONE_BY_ONE
    assert compiled(stored).count(" call(") == times + of_sums


def test_kernels_store_by_themselves() -> None:
    x = jnp.asarray(X, jnp.float32)
    small = once(lambda x: 2 * x)

    def program() -> str:
        return str(jax.make_jaxpr(lambda x: stored(small(x)))(x))

    outside = program()
    with allowed():
        inside = program()
    assert " stored " in outside
    if jax.default_backend() == "cpu" and "results_of_kernel" in inside:
        assert " stored " not in inside
