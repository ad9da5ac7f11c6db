"""Functions compiled as one kernel: the same values and derivatives, and what fits inside."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array, lax

import jaxhair as jh
from jaxhair import kernels
from jaxhair.kernels import LARGEST, one_kernel
from jaxhair.simulate import phase_end, start

CLOSE = {"float32": 2e-6, "float64": 1e-14}
MARK = "xla_cpu_small_call"

with kernels.allowed():
    pytestmark = pytest.mark.skipif(not kernels.used(), reason="none on this platform or jaxlib")


@pytest.fixture(autouse=True)
def _allowed() -> Iterator[None]:
    with kernels.allowed():
        yield


def chain(pair: dict[str, Array], scale: Array) -> dict[str, Array]:
    """A loop over rows in a loop, with a square root, a branch and a sum."""
    a, b = pair["a"], pair["b"]

    def row(carry: Array, here: Array) -> tuple[Array, Array]:
        carry = jnp.where(here > 0, carry * here, jnp.sqrt(1 + here**2)) / (1 + jnp.abs(carry))
        return carry, carry

    def again(a: Array, _: None) -> tuple[Array, None]:
        last, rows = lax.scan(row, a[0], a)
        return rows * scale + last[None] + jnp.sum(b, axis=0, keepdims=True), None

    a = lax.scan(again, a, None, length=3)[0]
    return {"a": a, "b": jnp.concatenate([b[1:], a[:1]])}


def inputs(dtype: Any = "float32") -> tuple[dict[str, Array], Array]:
    rng = np.random.default_rng(0)
    a, b = (jnp.asarray(rng.normal(size=(n, 3, 20)), dtype) for n in (5, 4))
    return {"a": a, "b": b}, jnp.asarray(0.5, dtype)


def many_times(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function in a loop, as a step is."""

    def repeated(pair: Any, scale: Array) -> Any:
        return lax.scan(lambda x, _: (function(x, scale), None), pair, None, length=4)[0]

    return repeated


def lowered(function: Callable[..., Any], *arguments: Any) -> str:
    return str(jax.jit(function).lower(*arguments).as_text())


def squares(function: Callable[..., Any]) -> Callable[..., Array]:
    return lambda *x: sum(jnp.sum(y**2) for y in jax.tree.leaves(function(*x)))


def jvp(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *x: jax.jvp(function, x, x)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(
    "derived",
    [
        lambda f: f,
        lambda f: jvp(f),
        lambda f: jax.grad(squares(f), argnums=(0, 1)),
        lambda f: jax.jacfwd(f, argnums=1),
        lambda f: jax.jacfwd(jax.grad(squares(f), argnums=1), argnums=1),
        lambda f: jax.vmap(f, in_axes=(None, 0)),
        lambda f: jax.grad(squares(jax.vmap(f, in_axes=(None, 0))), argnums=1),
        lambda f: jax.grad(squares(jax.checkpoint(f)), argnums=0),
    ],
    ids=["value", "jvp", "grad", "jacfwd", "second", "vmap", "grad of vmap", "checkpoint"],
)
def test_values_and_derivatives_are_those_of_the_function(derived: Any, dtype: str) -> None:
    with jax.enable_x64(dtype == "float64"):
        pair, scale = inputs(dtype)
        if "vmap" in derived.__code__.co_names:
            scale = jnp.stack([scale, 2 * scale])
        compiled = derived(many_times(one_kernel(chain)))
        found = jax.jit(compiled)(pair, scale)
        wanted = jax.jit(derived(many_times(chain)))(pair, scale)
        differentiated = {"jvp", "grad", "jacfwd"} & {*derived.__code__.co_names}
        assert (MARK in lowered(compiled, pair, scale)) == (not differentiated)
        for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
            size = float(jnp.max(jnp.abs(y)))
            np.testing.assert_allclose(x, y, rtol=0, atol=100 * CLOSE[dtype] * (1 + size))


def test_a_kernel_in_a_kernel_and_one_beside_what_does_not_fit() -> None:
    inner = one_kernel(lambda x: jnp.sin(x) / (1 + x**2))
    x = jnp.linspace(0, 1, 60).reshape(5, 12)
    both = one_kernel(lambda x: inner(x) + inner(2 * x))
    assert lowered(both, x).count(MARK) == 3
    sorting = one_kernel(lambda x: jnp.sort(inner(x), axis=0) + inner(2 * x))
    assert lowered(sorting, x).count(MARK) == 2
    for function in (both, sorting):
        np.testing.assert_allclose(jax.jit(function)(x), function(x), rtol=1e-6)


@pytest.mark.parametrize(
    "outside",
    [
        lambda x: jnp.sort(x, axis=0),
        lambda x: x.at[jnp.array([1, 0])].add(x[:2]),
        lambda x: x[jnp.argmax(x, axis=0)][:, 0],
        lambda x: x @ x.T @ x,
        lambda x: jnp.linalg.svd(x, full_matrices=False)[0],
        lambda x: x + jax.random.uniform(jax.random.key(0), x.shape),
        lambda x: jnp.broadcast_to(x[0, 0], (LARGEST + 1,))[: x.size].reshape(x.shape) * 2,
    ],
    ids=["sort", "scatter", "gather", "product", "decomposition", "random", "large"],
)
def test_what_does_not_fit_is_left_as_it_was(outside: Any) -> None:
    x = jnp.linspace(0, 1, 60).reshape(5, 12)
    text = lowered(one_kernel(lambda x: 2 * outside(x)), x)
    assert MARK not in text
    found = jax.jit(one_kernel(outside))(x)
    np.testing.assert_allclose(found, jax.jit(outside)(x), rtol=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2, None])
def test_arrays_of_the_largest_size_compile(axis: int | None) -> None:
    x = jnp.linspace(0.1, 1, LARGEST).reshape(-1, 4, 64)

    def sums(x: Array) -> Array:
        y = jnp.concatenate([x[1:] * jnp.sin(x[:-1]), x[:1]])
        return y + jnp.sum(y, axis=axis, keepdims=True) + jnp.max(y, axis=0, keepdims=True)

    assert MARK in lowered(one_kernel(sums), x)
    np.testing.assert_allclose(jax.jit(one_kernel(sums))(x), jax.jit(sums)(x), rtol=1e-4)


EFFECTS: dict[str, tuple[Any, ...]] = {
    "gravity, drag": (jh.Gravity(), jh.Drag(), jh.Hold()),
    "wind": (jh.Wind((0, 0, 0), (1, 0, 0), 3.0), jh.Hold(clamped=False)),
    "drying wind": (jh.DryingWind((0, 0, 0), (1, 0, 0), 3.0), jh.Hold(part="tip")),
    "moving hold": (jh.Hold(velocity=(0, 0, 1.0), angular_velocity=(0, 0, 1.0)),),
    "obstacles": (jh.Floor(-0.1, friction=0.3), jh.Sphere((0, 0, -0.1), 0.05, friction=0.4)),
    "cylinder": (jh.Cylinder((0, 0, -0.1), (0, 1, 0), 0.02, angular_velocity=(0, 1, 0)),),
    "bonds": (jh.Cut(hydrogen=0.1, rate=2.0), jh.Reform(disulfide=0.9), jh.Soften(0.5)),
    "pose": (jh.Wound(0.1),),
    "unloaded": (jh.Unloaded(),),
}


def lowered_phase(
    effects: Any, solver: Any, strands: int, points: int, dtype: Any = "float32"
) -> Any:
    roots = jnp.zeros((strands, 3), dtype)
    hair = jh.Strands.straight(roots, (0, 0, -1), length=0.02 * (points - 1), points=points)
    phase = jh.Phase("phase", 0.1, effects)
    scene = jh.Scene(hair, phases=(phase,), solver=solver).as_arrays()
    bare = replace(scene, phases=())
    return phase_end.lower(bare, scene.phases[0].effects, start(scene), steps=4, kernels=True)


def step_call(lowered: Any) -> str:
    (step,) = [line for line in lowered.as_text().split("\n") if "call @step" in line]
    return str(step)


@pytest.mark.parametrize("solver", [jh.PositionBased(), jh.Compliant(), jh.Direct()], ids=str)
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
def test_a_step_with_any_effect_but_contact_is_one_kernel(effects: Any, solver: Any) -> None:
    lowered = lowered_phase(effects, solver, strands=16, points=9)
    assert MARK in step_call(lowered)


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize(("points", "strands"), [(9, 290), (33, 64), (100, 20)])
@pytest.mark.parametrize("solver", [jh.PositionBased(), jh.Compliant(), jh.Direct()], ids=str)
@pytest.mark.parametrize("effects", EFFECTS.values(), ids=EFFECTS)
def test_steps_of_the_largest_size_compile(
    effects: Any, solver: Any, points: int, strands: int, dtype: str
) -> None:
    """XLA splits costly work between threads as it grows, which it cannot do in a kernel."""
    with jax.enable_x64(dtype == "float64"):
        lowered_phase(effects, solver, strands, points, dtype).compile()


@jh.pytree
class FromOutside(jh.Drag):
    """An effect that the library does not know."""


def test_what_others_add_stays_outside() -> None:
    text = lowered_phase((FromOutside(),), jh.PositionBased(), strands=16, points=9).as_text()
    assert "call @step" not in text
    assert MARK in text


@pytest.mark.parametrize("kind", ["carried", "computed", "constant"])
def test_an_argument_that_xla_finds_not_needed(kind: str) -> None:
    """XLA aborts on kernels with such arguments unless something keeps them in use."""
    kernel = one_kernel(lambda x, i: x * 2 + (i * 0).astype(x.dtype)[None])
    ones, whole = jnp.ones((8, 16)), jnp.arange(16)

    @jax.jit
    def repeated(ones: Array, whole: Array) -> Array:
        def one(carry: Any, _: None) -> tuple[Any, None]:
            x, i = carry
            given = {"carried": i, "computed": i * 3 + 1, "constant": jnp.arange(16)}[kind]
            return (kernel(x, given), i + 1), None

        return lax.scan(one, (ones, whole), None, length=3)[0][0]

    assert MARK in repeated.lower(ones, whole).as_text()
    np.testing.assert_array_equal(repeated(ones, whole), 8 * ones)


def test_programs_of_users_have_none() -> None:
    """A loop around a simulation, for which XLA would abort, and anything else that is traced."""
    scene = jh.scenes.perm(strands=4, winding=False, contact=False).first(0.05)

    def total(x: Array) -> Array:
        changed = jh.replace_leaves(scene, {"bonds.influence": x * jnp.array([0.3, 0.3, 0.2, 0.2])})
        return jnp.sum(jh.run(changed)["released"].positions)

    @jax.jit
    def looped(x: Array, n: Array) -> Array:
        def more(carry: Any) -> Any:
            return carry[0] + 1, total(x * (1 + 0 * carry[0]))

        return lax.while_loop(lambda carry: carry[0] < n, more, (0, jnp.zeros_like(x)))[1]

    one = jnp.asarray(1.0, scene.dtype)
    with kernels.allowed(False):
        assert MARK not in looped.lower(one, jnp.asarray(3)).as_text()
        assert MARK not in jax.jit(lambda: jh.run(scene)).lower().as_text()
        found = float(looped(one, jnp.asarray(3)))
    assert found == pytest.approx(float(total(one)), rel=1e-5)


def test_kernels_can_be_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    pair, scale = inputs()
    monkeypatch.setenv("JAXHAIR_KERNELS", "off")
    assert MARK not in lowered(one_kernel(chain), pair, scale)
    monkeypatch.delenv("JAXHAIR_KERNELS")
    monkeypatch.setattr(kernels, "TESTED", ())
    assert MARK not in lowered(one_kernel(chain), pair, scale)
