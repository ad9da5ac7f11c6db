"""The paper's equations (15) to (19), bonds and forces, against values derived by hand."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxhair import bonds
from jaxhair import quaternion as quat
from jaxhair.bonds import Cut
from jaxhair.contact import HairContact
from jaxhair.forces import DryingWind, Wind
from jaxhair.rods import Rod
from jaxhair.strands import State

TOLERANCE = {"float64": 1e-13, "float32": 1e-6}
DTYPES = pytest.mark.parametrize("dtype", TOLERANCE)
DT = 1 / 360

rest_shape, remembered = jax.jit(bonds.rest_shape), jax.jit(bonds.remembered)
slopes = jax.jit(jax.jacrev(bonds.remembered, argnums=(0, 1, 2, 3)))


def close(actual: object, wanted: object, dtype: str = "float64") -> None:
    np.testing.assert_allclose(np.squeeze(actual), wanted, rtol=0, atol=TOLERANCE[dtype])


def shape(*numbers: float, dtype: str = "float64") -> jax.Array:
    """Omega of one inner point of one strand, shape (1, 3, 1)."""
    return jnp.asarray(numbers, dtype)[None, :, None]


def whole(omega: jax.Array) -> jax.Array:
    """The unit quaternion of a positive real part, shape (1, 4, 1)."""
    return quat.from_vector_part(omega)


def random_bonds(dtype: str, seed: int = 0) -> tuple[jax.Array, ...]:
    """Omega_j, b_j, f_j and r of 5 inner points of 2 strands."""
    rng = np.random.default_rng(seed)
    r = rng.normal(size=(5, 4, 2))
    r /= np.linalg.norm(r, axis=1, keepdims=True)
    parts = (rng.uniform(-0.4, 0.4, (5, 4, 3, 2)), *rng.uniform(0.1, 0.9, (2, 5, 4, 2)), r)
    return tuple(jnp.asarray(x, dtype) for x in parts)


def nearer(r: np.ndarray, shapes: np.ndarray) -> np.ndarray:
    """Omega or -Omega for each kind, whichever quaternion is nearer, shape (5, 4, 3, 2)."""
    real = np.sqrt(1 - np.sum(shapes**2, 2, keepdims=True))
    other = np.concatenate([real, shapes], 2)
    plus, minus = (np.sum((s * r[:, None] - other) ** 2, 2, keepdims=True) for s in (1, -1))
    return np.where(plus <= minus, 1, -1) * r[:, None, 1:]


def test_15_hand_value() -> None:
    """f = 3, 1, 0, 0 with b = 1/2, 1: (3 (O1 + (O - O1) / 2) + O2) / 4."""
    shapes = jnp.concatenate([shape(0.2, 0, 0), shape(0, 0.4, 0), shape(9, 9, 9) / 20] * 2)[
        None, :4
    ]
    f, b = jnp.asarray([3.0, 1, 0, 0])[None, :, None], jnp.asarray([0.5, 1, 1, 1])[None, :, None]
    r = whole(shape(0, 0, 0.1))
    close(rest_shape(shapes, b, f, r), (0.075, 0.1, 0.0375))
    close(rest_shape(shapes, b, 7 * f, r), (0.075, 0.1, 0.0375))  # only ratios matter


@DTYPES
def test_15_is_springs_in_parallel(dtype: str) -> None:
    """Omega - Omega_o = sum f b (Omega - Omega_j) / sum f, Omega in the hemisphere of its j."""
    arrays = random_bonds(dtype)
    shapes, b, f, r = (np.asarray(x, float) for x in arrays)
    omega, share = nearer(r, shapes), (f / f.sum(1, keepdims=True))[:, :, None]
    stress = np.sum(share * b[:, :, None] * (omega - shapes), 1)
    close(np.sum(share * omega, 1) - np.asarray(rest_shape(*arrays)), stress, dtype)
    assert len(set(np.sign(np.sum(omega * r[:, None, 1:], 2)).ravel())) == 2  # both signs occur


@DTYPES
def test_15_all_cut_or_all_bonded(dtype: str) -> None:
    """Cut hair wants the shape that it has; bonded hair the weighted mean."""
    shapes, b, f, r = random_bonds(dtype)
    omega = shapes[:, 3] / 2
    r = whole(omega) * jnp.where(r[:, :1] > 0, 1, -1).astype(dtype)
    close(rest_shape(shapes, 0 * b, f, r), omega, dtype)
    mean = np.sum(np.asarray(f[:, :, None] * shapes), 1) / np.sum(np.asarray(f), 1, keepdims=True)
    close(rest_shape(shapes, 0 * b + 1, f, r), mean, dtype)


@DTYPES
def test_15_and_16_do_not_see_the_sign_of_a_frame(dtype: str) -> None:
    shapes, b, f, r = random_bonds(dtype)
    close(rest_shape(shapes, b, f, -r), rest_shape(shapes, b, f, r), dtype)
    one = shapes[:, 0], b[:, 0], f[:, 0]
    close(remembered(*one, -r), remembered(*one, r), dtype)


def test_16_weighted_mean() -> None:
    """b = 1/4 and db = 1/2: (0.25 Omega_j + 0.5 Omega) / 0.75; r and -r alike."""
    old, r = shape(0.3, 0, 0.06), whole(shape(0, 0.3, 0.06))
    b, db = jnp.full((1, 1), 0.25), jnp.full((1, 1), 0.5)
    close(remembered(old, b, db, r), (0.1, 0.2, 0.06))
    close(remembered(old, b, db, -r), (0.1, 0.2, 0.06))


@DTYPES
@pytest.mark.parametrize(("b", "db"), [(0.0, 0.0), (0.7, 0.0), (0.0, 0.3), (0.4, 0.6)])
def test_16_no_rise_and_no_bonds(dtype: str, b: float, db: float) -> None:
    """db = 0 changes nothing and b = 0 takes the present shape; slopes are finite at b + db = 0."""
    old, omega = shape(0.3, 0, 0.06, dtype=dtype), shape(0, 0.3, 0.06, dtype=dtype)
    arrays = (old, jnp.full((1, 1), b, dtype), jnp.full((1, 1), db, dtype), whole(omega))
    new = remembered(*arrays)
    if db == 0:
        np.testing.assert_array_equal(new, old)
    share = db / (b + db) if db > 0 else 0.0
    close(new, np.squeeze(old + share * (omega - old)), dtype)
    for slope in slopes(*arrays):
        assert np.isfinite(slope).all()


def test_cuts_at_once_leave_no_less_than_0() -> None:
    """Three that fall by 0.4 in the same step, from 0.7."""
    rod, state = strands_at([ACROSS])
    state = replace(state, fractions=jnp.full_like(state.fractions, 0.7))
    cuts = [Cut(ionic=0.0, rate=0.4 / DT)] * 3
    after, rises = bonds.changes(cuts, rod, state, DT)
    assert not rises
    np.testing.assert_array_equal(after[:, 1], 0.0)
    np.testing.assert_array_equal(after[:, 2:], 0.7)


@DTYPES
def test_16_stress_does_not_jump(dtype: str) -> None:
    """b' (O - O_j') = b' O - (b O_j + db O) = b (O - O_j): new bonds are free of stress."""
    shapes, b, f, r = random_bonds(dtype)
    rises = {j: (1 - b[:, j]) * f[:, j] for j in (0, 2)}
    state = State(r, r, r, shapes, b)
    after = bonds.reformed(state, rises, r)

    def stress(state: State) -> np.ndarray:
        omega = nearer(np.asarray(r, float), np.asarray(shapes, float))
        pull = (state.fractions * f)[:, :, None] * (omega.astype(dtype) - state.shapes)
        return np.sum(np.asarray(pull), 1)

    close(stress(after), stress(state), dtype)
    assert np.all(np.asarray(after.fractions - b)[:, [0, 2]] > 0)
    for kind in (1, 3):
        np.testing.assert_array_equal(after.shapes[:, kind], shapes[:, kind])
        np.testing.assert_array_equal(after.fractions[:, kind], b[:, kind])


def strands_at(points: object) -> tuple[Rod, State]:
    """A rod and a state at given points (strands, points, 3), all free."""
    x = jnp.moveaxis(jnp.asarray(points, float), 0, -1)
    one = jnp.ones((len(x), 1, 1))
    rod = Rod(quat.safe_norm(x[1:] - x[:-1]), one, one[1:], one[2:], jnp.ones((1, 4, 1)))
    none = jnp.zeros((len(x) - 2, 4, 3, x.shape[-1]))
    return rod, State(x, 0 * x, jnp.ones((len(x) - 1, 4, 1)), none, none[:, :, 0])


@jax.jit
def wind_on(points: object, wind: Wind) -> jax.Array:
    """Velocity change of the points of one strand, shape (points, 3)."""
    rod, state = strands_at([points])
    return wind.velocity_change(rod, state, DT)[..., 0]


wind_slopes = jax.jit(jax.jacrev(wind_on))
ALONG_X = Wind(blower=(-1, 0, 0), target=(-0.9, 0, 0), strength=12.0)


def test_17_wind() -> None:
    """alpha = 12: 12 dt on the axis and across it, 6 dt at 1 cm; sin(30 degrees) = 1/2."""
    across = wind_on([(0.0, 0, 0), (0, 0, 0.01), (0, 0, 0.03)], ALONG_X)
    close(across, np.outer([12, 6, 3], (1, 0, 0)) * DT)
    x = np.sqrt(0.75)
    slant = wind_on([(0.0, 0, -0.5), (x, 0, 0), (2 * x, 0, 0.5)], ALONG_X)
    close(slant, np.outer([6 / 51, 6, 6 / 51], (1, 0, 0)) * DT)  # the tip has its last edge's angle
    wide = Wind((-1, 0, 0), (5, 0, 0), 12.0, width=0.02)
    close(wind_on([(0.0, 0, 0.02), (0, 1, 0.02), (0, 1, 0)], wide)[0], (6 * DT, 0, 0))


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_17_an_edge_parallel_to_the_wind(offset: float) -> None:
    """No wind, and a finite slope, on the axis too."""
    points = [(0.0, 0, offset), (0.01, 0, offset), (0.02, 0, offset)]
    assert not np.any(wind_on(points, ALONG_X))
    assert np.isfinite(wind_slopes(jnp.asarray(points), ALONG_X)).all()


@jax.jit
def contact(strands: object) -> jax.Array:
    """Velocity changes in units of alpha dt for r = 1 mm, shape (strands, points, 3)."""
    rod, state = strands_at(strands)
    dv = HairContact(radius=1e-3, strength=30.0).velocity_change(rod, state, DT)
    return jnp.moveaxis(dv, -1, 0) / (30 * DT)


UP = ((0.0, 0, 0), (0, 0, 0.1))  # an edge along z
NONE = ((0, 0, 0), (0, 0, 0))


def test_18_contact() -> None:
    """(2r - D) / 2r away from the other edge's nearest point, with 2r = 2 mm."""
    # 1 mm beside the middle of the edge: half the strength along x. All other points are far.
    close(contact((UP, ((1e-3, 0, 0.05), (1.0, 0, 0.05)))), (NONE, ((0.5, 0, 0), (0, 0, 0))))
    # 0.5 mm above its end, where the foot must be clamped: both ends are pushed apart.
    pushed = contact((UP, ((0.0, 0, 0.1005), (1, 0, 0.1005))))
    close(pushed, (((0, 0, 0), (0, 0, -0.75)), ((0, 0, 0.75), (0, 0, 0))))
    # At 2 mm: nothing.
    close(contact((UP, ((2e-3, 0, 0.05), (1.0, 0, 0.05)))), (NONE, NONE))


def test_18_no_strand_pushes_itself() -> None:
    close(contact([[(0.0, 0, 0), (0, 0, 0.1), (1e-3, 0, 0.1), (1e-3, 0, 0)]]), np.zeros((4, 3)))


def test_18_a_point_on_an_edge() -> None:
    """It has no direction to go: no push, and finite slopes."""
    crossing = jnp.asarray([UP, ((0.0, 0, 0.05), (1, 0, 0.05))])
    close(contact(crossing), (NONE, NONE))
    assert np.isfinite(jax.jit(jax.jacrev(contact))(crossing)).all()


def test_18_an_edge_without_length() -> None:
    """It is a point, 1 mm away from the other strand's edge and its first point."""
    point = ((1e-3, 0, 0.0), (1e-3, 0, 0.0))
    strands = jnp.asarray([UP, point])
    close(contact(strands), (((-0.5, 0, 0), (0, 0, 0)), ((0.5, 0, 0), (0.5, 0, 0))))
    assert np.isfinite(jax.jit(jax.jacrev(contact))(strands)).all()


@partial(jax.jit, static_argnums=2)
def dried(points: object, fractions: jax.Array, dt: float, dryer: DryingWind) -> tuple:
    """The change of the hydrogen fraction by a step, and all fractions after it."""
    rod, state = strands_at([points])
    full = jnp.broadcast_to(fractions, state.fractions.shape)
    state = State(state.positions, state.velocities, state.orientations, state.shapes, full)
    _, rises = bonds.changes([dryer], rod, state, dt)
    assert set(rises) == {0}
    r = jnp.zeros((len(points) - 2, 4, 1)).at[:, 0].set(1)
    change = dryer.fraction_change("hydrogen", full[:, 0], rod, state, dt)
    return change, bonds.reformed(state, rises, r).fractions


ACROSS = [(0.0, 0, -0.01), (0, 0, 0), (0, 0, 0.01), (0, 0, 0.02)]


@pytest.mark.parametrize("dt", [DT, 4 * DT])
def test_19_drying(dt: float) -> None:
    """0.003 |dv|: 12 dt across on the axis gives 0.036 a second, half at 1 cm, at any dt."""
    dryer = DryingWind((-1, 0, 0), (1, 0, 0), 12.0)
    assert dryer.drying == 0.003
    change, after = dried(ACROSS, jnp.asarray(0.5), dt, dryer)
    close(change[:, 0] / dt, (0.036, 0.018))
    close((after[:, 0, 0] - 0.5) / dt, (0.036, 0.018))
    np.testing.assert_array_equal(after[:, 1:], 0.5)


@pytest.mark.parametrize("fraction", [0.0, 0.1, 0.3, 0.9999, 1.0])
def test_19_stops_at_exactly_1(fraction: float) -> None:
    dryer = DryingWind((-1, 0, 0), (1, 0, 0), 12.0, drying=1000.0)
    _, after = dried(ACROSS, jnp.asarray(fraction), DT, dryer)
    np.testing.assert_array_equal(after[:, 0], 1.0)
    np.testing.assert_array_equal(after[:, 1:], fraction)
