"""Quaternion algebra against hand values and plain NumPy matrices."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhair import quaternion as quat

TOLERANCE = {"float64": 1e-14, "float32": 2e-6}
DTYPES = pytest.mark.parametrize("dtype", TOLERANCE)
AXES = np.eye(3)
between = jax.jit(quat.between)


def pure(v: np.ndarray) -> np.ndarray:
    """The quaternions (0, v) of vectors on the last axis."""
    return np.concatenate([np.zeros_like(v[..., :1]), v], -1)


def matrix(q: np.ndarray) -> np.ndarray:
    """The rotation matrix of one unit quaternion w x y z, from the textbook."""
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def column(*numbers: float) -> jax.Array:
    """One vector or quaternion as a column, shape (components, 1)."""
    return jnp.asarray(numbers, float)[:, None]


def assert_column(actual: jax.Array, *wanted: float) -> None:
    np.testing.assert_allclose(np.asarray(actual)[:, 0], wanted, rtol=0, atol=1e-14)


@cache
def inputs() -> dict[str, np.ndarray]:
    """Random unit quaternions a, b and vectors u, v, one on each row, exact in float32."""
    rng = np.random.default_rng(0)
    rows = {
        name: rng.normal(size=(40, size)) for name, size in zip("abuv", (4, 4, 3, 3), strict=True)
    }
    for name in "ab":
        rows[name] /= np.linalg.norm(rows[name], axis=1, keepdims=True)
    return rows


@jax.jit
def everything(a: jax.Array, b: jax.Array, u: jax.Array, v: jax.Array) -> dict[str, jax.Array]:
    """Every function of the module, so that one compilation serves all tests."""
    ab, e3 = quat.multiply(a, b), jnp.zeros_like(u).at[2].set(1)
    return {
        "ab": ab,
        "cross": quat.cross(u, v),
        "dot": quat.dot(u, v),
        "norm": quat.safe_norm(u),
        "unit": quat.unit(u),
        "conjugate": quat.conjugate(a),
        "a conj(a)": quat.multiply(a, quat.conjugate(a)),
        "(ab)a": quat.multiply(ab, a),
        "a(ba)": quat.multiply(a, quat.multiply(b, a)),
        "conj(ab)": quat.conjugate(ab),
        "conj(b) conj(a)": quat.multiply(quat.conjugate(b), quat.conjugate(a)),
        "conj(a) b": quat.multiply(quat.conjugate(a), b),
        "relative": quat.relative(a, b),
        "multiply_vector": quat.multiply_vector(a, v),
        "vector_multiply": quat.vector_multiply(v, a),
        "rotate": quat.rotate(a, v),
        "rotate by -a": quat.rotate(-a, v),
        "rotate by b, then a": quat.rotate(a, quat.rotate(b, v)),
        "rotate by ab": quat.rotate(ab, v),
        "tangent": quat.tangent(a),
        "tangent of -a": quat.tangent(-a),
        "rotate e3": quat.rotate(a, e3),
        "exp": quat.from_rotation_vector(u),
        "perpendicular": quat.perpendicular(u),
        "between": quat.between(quat.unit(u), quat.unit(v)),
        "from_vector_part": quat.from_vector_part(a[1:]),
        "hemisphere": quat.same_hemisphere(a, b),
        "hemisphere of -a": quat.same_hemisphere(-a, b),
        "swept": quat.swept_products(a[:, :1], jnp.moveaxis(b, -1, 0)[:5, :, None]),
    }


@cache
def results(dtype: str) -> dict[str, np.ndarray]:
    """The results of `everything`, with the random items first."""
    columns = [jnp.asarray(x.T, dtype) for x in inputs().values()]
    found = everything(*columns)
    assert all(x.dtype == dtype for x in found.values())
    return {name: np.moveaxis(np.asarray(x, float), -1, 0) for name, x in found.items()}


def assert_same(dtype: str, first: str | np.ndarray, second: str | np.ndarray) -> None:
    one, two = (results(dtype)[x] if isinstance(x, str) else x for x in (first, second))
    assert one.shape == two.shape
    np.testing.assert_allclose(one, two, rtol=0, atol=5 * TOLERANCE[dtype])


def test_products_of_the_units() -> None:
    """i j = k, j k = i, k i = j, and i i = -1."""
    i, j, k = column(0, 1, 0, 0), column(0, 0, 1, 0), column(0, 0, 0, 1)
    assert_column(quat.multiply(i, j), 0, 0, 0, 1)
    assert_column(quat.multiply(j, k), 0, 1, 0, 0)
    assert_column(quat.multiply(k, i), 0, 0, 1, 0)
    assert_column(quat.multiply(j, i), 0, 0, 0, -1)
    assert_column(quat.multiply(i, i), -1, 0, 0, 0)


def test_hand_values() -> None:
    """A quarter turn about y takes e3 to e1; (1 2 3 4)(5 6 7 8) as in any table."""
    quarter = column(np.sqrt(0.5), 0, np.sqrt(0.5), 0)
    assert_column(quat.tangent(quarter), 1, 0, 0)
    assert_column(quat.rotate(quarter, column(1, 0, 0)), 0, 0, -1)
    assert_column(quat.rotate(quarter, column(0, 1, 0)), 0, 1, 0)
    assert_column(quat.multiply(column(1, 2, 3, 4), column(5, 6, 7, 8)), -60, 12, 30, 24)
    assert_column(quat.relative(column(1, 2, 3, 4), column(5, 6, 7, 8)), 70, 0, -16, -8)
    assert_column(quat.cross(column(1, 2, 3), column(4, 5, 6)), -3, 6, -3)


@DTYPES
def test_algebra(dtype: str) -> None:
    """Associativity, inverses, and the short products against the full one."""
    identity = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    assert_same(dtype, "a conj(a)", identity)
    assert_same(dtype, "(ab)a", "a(ba)")
    assert_same(dtype, "conj(ab)", "conj(b) conj(a)")
    assert_same(dtype, "relative", "conj(a) b")
    a, v = inputs()["a"], inputs()["v"]
    left = list(pure(v))
    assert_same(dtype, "multiply_vector", np.array(list(map(product, a, left))))
    assert_same(dtype, "vector_multiply", np.array(list(map(product, left, a))))
    assert_same(dtype, "cross", np.cross(inputs()["u"], v))
    assert_same(dtype, "dot", np.sum(inputs()["u"] * v, 1, keepdims=True))


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product by the vector formula."""
    real = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([real, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


@DTYPES
def test_rotations_against_matrices(dtype: str) -> None:
    a, b, v = (inputs()[name] for name in "abv")
    turned = np.stack([matrix(q) @ x for q, x in zip(a, v, strict=True)])
    assert_same(dtype, "rotate", turned)
    twice = np.stack([matrix(p) @ matrix(q) @ x for p, q, x in zip(a, b, v, strict=True)])
    assert_same(dtype, "rotate by ab", twice)
    assert_same(dtype, "rotate by b, then a", twice)
    assert_same(dtype, "tangent", np.stack([matrix(q)[:, 2] for q in a]))
    assert_same(dtype, "tangent", "rotate e3")


@DTYPES
def test_q_and_minus_q_are_the_same_rotation(dtype: str) -> None:
    assert_same(dtype, "rotate", "rotate by -a")
    assert_same(dtype, "tangent", "tangent of -a")


@DTYPES
def test_norms(dtype: str) -> None:
    u = inputs()["u"]
    norm = np.linalg.norm(u, axis=1, keepdims=True)
    assert_same(dtype, "norm", norm)
    assert_same(dtype, "unit", u / norm)


@DTYPES
def test_perpendicular(dtype: str) -> None:
    p = results(dtype)["perpendicular"]
    assert_same(dtype, np.sum(p * inputs()["u"], 1), np.zeros(40))
    assert_same(dtype, np.linalg.norm(p, axis=1), np.ones(40))


@DTYPES
def test_exponential(dtype: str) -> None:
    """exp(u / 2) = (cos |u|/2, sin |u|/2 u/|u|)."""
    u = inputs()["u"]
    half = np.linalg.norm(u, axis=1, keepdims=True) / 2
    assert_same(dtype, "exp", np.concatenate([np.cos(half), np.sin(half) * u / (2 * half)], 1))


@DTYPES
def test_between(dtype: str) -> None:
    """It takes one vector to the other about their common normal: the shortest way."""
    u, v = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (inputs()["u"], inputs()["v"]))
    q = results(dtype)["between"]
    turned = np.stack([matrix(one) @ x for one, x in zip(q, u, strict=True)])
    np.testing.assert_allclose(turned, v, atol=20 * TOLERANCE[dtype])
    np.testing.assert_allclose(np.sum(q[:, 1:] * u, 1), 0, atol=20 * TOLERANCE[dtype])
    assert np.all(q[:, 0] >= 0)


@DTYPES
@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-5, 1e-4, 5e-4, 2e-3, 1e-2])
def test_between_opposite_and_nearly_opposite_vectors(dtype: str, angle: float) -> None:
    """From e3 to a hair that hangs down at a small angle: the usual root of a strand."""
    for axis in ("e3", "oblique"):
        a = AXES[2] if axis == "e3" else np.array([0.48, 0.6, 0.64])
        side = np.cross(a, AXES[0]) / np.linalg.norm(np.cross(a, AXES[0]))
        b = np.sin(angle) * side - np.cos(angle) * a
        q = quat.between(jnp.asarray(a, dtype)[:, None], jnp.asarray(b, dtype)[:, None])
        assert np.linalg.norm(q) == pytest.approx(1, abs=TOLERANCE[dtype])
        # A rotation from nearly opposite vectors loses half the digits at most.
        turned = matrix(np.asarray(q, float)[:, 0]) @ a
        np.testing.assert_allclose(turned, b, rtol=0, atol=TOLERANCE[dtype] ** 0.5 / 2)


@DTYPES
def test_swept_products(dtype: str) -> None:
    a, b = inputs()["a"], inputs()["b"]
    frames = [a[0]]
    for factor in b[:5]:
        frames.append(product(frames[-1], factor))
    assert_same(dtype, results(dtype)["swept"][0], np.array(frames))


@DTYPES
def test_same_hemisphere(dtype: str) -> None:
    a, b = inputs()["a"], inputs()["b"]
    sign = np.sign(np.sum(a * b, 1, keepdims=True))
    np.testing.assert_array_equal(results(dtype)["hemisphere"], sign)
    np.testing.assert_array_equal(results(dtype)["hemisphere of -a"], -sign)


def test_same_hemisphere_of_orthogonal_quaternions_is_a_sign() -> None:
    """At the border +1 is taken; 0 would switch a bond off. Its derivative is 0."""
    i, j = column(0, 1, 0, 0), column(0, 0, 1, 0)
    assert float(quat.same_hemisphere(i, j)[0, 0]) == 1
    assert not np.any(jax.jacfwd(quat.same_hemisphere)(i, j))


@DTYPES
def test_from_vector_part(dtype: str) -> None:
    """The real part is made non-negative, and 0 where rounding makes the vector too long."""
    a = inputs()["a"]
    assert_same(dtype, "from_vector_part", np.concatenate([np.abs(a[:, :1]), a[:, 1:]], 1))
    too_long = quat.from_vector_part(column(0, 0, 1 + 1e-12))
    assert float(too_long[0, 0]) == 0
    assert np.all(np.isfinite(jax.jacrev(quat.from_vector_part)(column(0, 0, 1.0))))


@DTYPES
@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev], ids=["forward", "reverse"])
def test_values_and_gradients_at_zero(dtype: str, mode: object) -> None:
    """Norm and unit vector are 0 with slope 0; the exponential is 1 with slope 1/2."""
    zero_and_not = jnp.asarray([[0.0, 3.0], [0.0, 0.0], [0.0, 4.0]], dtype)

    def together(x: jax.Array) -> tuple[jax.Array, ...]:
        return quat.safe_norm(x), quat.unit(x), quat.from_rotation_vector(x)

    norm, unit, exp = jax.jit(together)(zero_and_not)
    assert [float(x) for x in norm[0]] == [0, 5]
    np.testing.assert_allclose(np.asarray(unit), [[0, 0.6], [0, 0], [0, 0.8]], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(exp)[:, 0], [1, 0, 0, 0])
    slopes = jax.jit(mode(together))(zero_and_not)  # type: ignore[operator]
    d_norm, d_unit, d_exp = (np.asarray(s)[:, 0, :, 0] for s in slopes)
    assert not d_norm.any()
    assert not d_unit.any()
    np.testing.assert_array_equal(d_exp, np.concatenate([np.zeros((1, 3)), np.eye(3) / 2]))
    # The row beside the zero keeps its own slope: x / |x|, and (1 - u u^T) / |x|.
    u = np.array([0.6, 0.0, 0.8])
    tolerance = TOLERANCE[dtype]
    np.testing.assert_allclose(np.asarray(slopes[0])[0, 1, :, 1], u, atol=tolerance)
    across = (np.eye(3) - np.outer(u, u)) / 5
    np.testing.assert_allclose(np.asarray(slopes[1])[:, 1, :, 1], across, atol=tolerance)


@DTYPES
def test_second_gradients_at_zero(dtype: str) -> None:
    """They are finite: 0 of norm and unit vector, and -1/4 of the exponential's real part."""

    def together(x: jax.Array) -> tuple[jax.Array, ...]:
        return quat.safe_norm(x), quat.unit(x), quat.from_rotation_vector(x)

    twice = jax.jit(jax.jacrev(jax.jacrev(together)))(jnp.zeros((3, 1), dtype))
    norm, unit, exp = (np.asarray(x)[:, 0, :, 0, :, 0] for x in twice)
    assert not norm.any()
    assert not unit.any()
    np.testing.assert_allclose(exp[0], -np.eye(3) / 4, atol=TOLERANCE[dtype])
    assert not exp[1:].any()


def test_rotation_vectors_have_second_derivatives_at_zero() -> None:
    """cos(|v| / 2) is 1 - |v|^2 / 8: a norm guarded at 0 would give 0 in place of -1/4."""
    real = jax.jit(jax.hessian(lambda v: quat.from_rotation_vector(v[:, None])[0, 0]))
    np.testing.assert_allclose(real(jnp.zeros(3)), -np.eye(3) / 4, atol=1e-15)
    axis = np.array([0.6, 0.0, 0.8])
    for size in (0.0, 1e-9, 0.19, 0.2, 0.21, 3.0):  # the series ends at 0.2
        found = np.asarray(quat.from_rotation_vector(jnp.asarray(size * axis)[:, None]))[:, 0]
        wanted = np.append(np.cos(size / 2), axis * np.sin(size / 2))
        np.testing.assert_allclose(found, wanted, atol=1e-15)
