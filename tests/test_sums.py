"""Sums added one by one, and what is spread: values and derivatives of the plain functions."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from jaxhair import sums
from jaxhair.sums import COMPONENTS, POINTS, one_by_one

CLOSE = {"float32": 1e-6, "float64": 1e-14}
SIZE = 5


def plain_sum(x: Array, axis: int) -> Array:
    return jnp.sum(x, axis=axis, keepdims=True)


def plain_spread(x: Array, axis: int) -> Array:
    return jnp.repeat(plain_sum(x, axis), SIZE, axis=axis)


def spread(x: Array, axis: int) -> Array:
    return sums.spread(one_by_one(x, axis), SIZE, axis)


def squared(total: Callable[[Array], Array]) -> Callable[[Array], Array]:
    return lambda x: jnp.sum(total(jnp.sin(x)) ** 2)


@pytest.fixture(autouse=True)
def with_every_version(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sums, "ONE_BY_ONE", True)


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
@pytest.mark.parametrize("axis", [COMPONENTS, POINTS])
@pytest.mark.parametrize(
    ("ours", "plain"), [(one_by_one, plain_sum), (spread, plain_spread)], ids=["summed", "spread"]
)
@pytest.mark.parametrize("shape", [(5, 3, 7, 2), (2, 4, 4, 3)])
def test_it_is_the_plain_function(
    ours: Any, plain: Any, axis: int, derived: Any, dtype: str, shape: tuple[int, ...]
) -> None:
    x = jnp.asarray(np.random.default_rng(0).normal(size=shape), dtype)
    for compiled in (lambda f: f, jax.jit):
        found, wanted = (compiled(derived(partial(f, axis=axis)))(x) for f in (ours, plain))
        for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            assert one.shape == other.shape
            assert one.dtype == other.dtype
            np.testing.assert_allclose(one, other, rtol=0, atol=10 * CLOSE[dtype])


def test_an_axis_counted_from_the_front_stays_there_under_vmap() -> None:
    x = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3, 7, 2)))
    for ours, plain in ((one_by_one, plain_sum), (spread, plain_spread)):
        for axis in (0, 1):
            gradients = []
            for f in (partial(ours, axis=axis), partial(plain, axis=axis)):
                together = jax.jit(lambda x, f=f: jax.vmap(f, in_axes=1, out_axes=-1)(x))
                gradients.append(jax.grad(squared(together))(x))
            np.testing.assert_allclose(*gradients, rtol=0, atol=10 * CLOSE["float64"])


@pytest.mark.parametrize("size", [1, 2, 3, 4, 7, 32, 33])
def test_any_number_is_added(size: int) -> None:
    x = np.random.default_rng(0).normal(size=(3, size, 2))
    np.testing.assert_allclose(one_by_one(x), x.sum(axis=1, keepdims=True), rtol=0, atol=1e-14)


def lowered(function: Any, components: int) -> str:
    return jax.jit(function).lower(jnp.ones((5, components, 7))).as_text()


def test_a_cpu_is_given_no_sum_along_an_axis() -> None:
    def squares(x: Array, repeated: Callable[[Array], Array]) -> Array:
        return jnp.sum(repeated(x) ** 2)

    ours = jax.grad(partial(squares, repeated=lambda x: sums.spread(x, SIZE)))
    plain = jax.grad(partial(squares, repeated=lambda x: jnp.broadcast_to(x, (5, SIZE, 7))))
    along = "across dimensions = [1]"
    assert along in lowered(partial(plain_sum, axis=COMPONENTS), 3)
    assert along in lowered(plain, 1)
    on_cpu = jax.default_backend() == "cpu"
    assert (along in lowered(one_by_one, 3)) != on_cpu
    assert (along in lowered(ours, 1)) != on_cpu
