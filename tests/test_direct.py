"""The direct solver: its linear algebra, its derivatives, its stability, the forces it keeps."""

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from mechanics import FIBRE, LINEAR_DENSITY, after, speed, stretch
from test_oracle import random_hair

import jaxhair as jh
from jaxhair import direct, hessian
from jaxhair import quaternion as quat
from jaxhair.block_tridiagonal import Blocks, solve, solve_again
from jaxhair.bonds import springs
from jaxhair.hessian import Units
from jaxhair.simulate import prepare, start
from jaxhair.strands import State
from jaxhair.treatments import AT_ONCE

SOLUTION = {"float64": 1e-12, "float32": 1e-4}
GRADIENT = 1e-6  # against central differences, float64
MODES = 1e-10
STRETCH = 1e-4  # float32, hanging at rest
NOISE = 1e-4  # m/s


def system(edges: int, strands: int, dtype: str) -> tuple[Blocks, Any]:
    """A random quasi-definite matrix and right side."""
    rng = np.random.default_rng(edges)

    def normal(*shape: int) -> Any:
        return jnp.asarray(rng.normal(size=(*shape, strands)), dtype)

    a = rng.normal(size=(edges, 3, 3, strands))
    k = np.einsum("eijs,ekjs->eiks", a, a) + 2 * np.eye(3)[None, :, :, None]
    blocks = Blocks(
        jnp.asarray(rng.uniform(2, 3, (edges, 1, 1)), dtype),
        normal(edges, 3, 3),
        jnp.asarray(k, dtype),
        jnp.full((edges - 1, 1, 1), 0.9, dtype),
        0.2 * normal(edges - 1, 3, 3),
    )
    return blocks, (normal(edges, 3), normal(edges, 3))


@jax.jit
def product(blocks: Blocks, x: Any) -> Any:
    """The matrix times x."""
    n, phi = x
    above = -blocks.compliance * n + jnp.einsum("eijs,ejs->eis", blocks.coupling, phi)
    below = jnp.einsum("ejis,ejs->eis", blocks.coupling, n)
    below = below + jnp.einsum("eijs,ejs->eis", blocks.stiffness, phi)
    t, s = blocks.next_compliance, blocks.next_stiffness
    above = above.at[:-1].add(t * n[1:]).at[1:].add(t * n[:-1])
    below = below.at[:-1].add(-jnp.einsum("eijs,ejs->eis", s, phi[1:]))
    return above, below.at[1:].add(-jnp.einsum("ejis,ejs->eis", s, phi[:-1]))


def dense(blocks: Blocks, strand: int) -> np.ndarray:
    """The matrix of one strand, unknowns of an edge together, by columns of unit vectors."""
    edges, strands = blocks.coupling.shape[0], blocks.coupling.shape[-1]
    columns = []
    for e in range(edges):
        for k in range(6):
            unit = np.zeros((edges, 6, strands))
            unit[e, k] = 1
            n, phi = product(blocks, (jnp.asarray(unit[:, :3]), jnp.asarray(unit[:, 3:])))
            columns.append(np.concatenate([n, phi], 1)[:, :, strand].ravel())
    return np.array(columns).T


@pytest.mark.parametrize("dtype", SOLUTION)
@pytest.mark.parametrize("edges", [1, 2, 3, 12])
def test_solutions_agree_with_numpy(edges: int, dtype: str) -> None:
    blocks, right = system(edges, 2, dtype)
    x, factors = jax.jit(solve)(blocks, right)
    again = jax.jit(solve_again)(factors, right)
    for strand in range(2):
        matrix = dense(jax.tree.map(lambda a: a.astype("float64"), blocks), strand)
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12)
        b = np.concatenate([np.asarray(r, float) for r in right], 1)[:, :, strand].ravel()
        wanted = np.linalg.solve(matrix, b).reshape(edges, 6)
        for found in (x, again):
            both = np.concatenate(found, 1)[:, :, strand]
            np.testing.assert_allclose(both, wanted, atol=SOLUTION[dtype] * np.abs(wanted).max())


def known(ragged: bool, damping: float | None = 0.01) -> tuple[direct.Known, float, State]:
    """A Newton step of wild strands: curved, twisted, moving, loaded, one edge held."""
    hair, state = random_hair(3, 7, ragged)
    fibre = jh.PhysicalFibre(radius=60e-6, minor_radius=40e-6, damping_time=damping)
    scene = jh.Scene(hair, fibre, phases=(jh.Phase("a", 0.1, (jh.Hold(),)),), solver=jh.Direct())
    scene = scene.as_arrays()
    rod = prepare(scene, scene.phases[0].effects).rod
    rng = np.random.default_rng(3)
    unit = Units.of(rod, scene.dt)
    forces = jnp.asarray(rng.normal(0, 2.0, (6, 3, 3)))
    rest = springs(state.shapes, state.fractions, rod.influence)
    turned = quat.unit(state.orientations + jnp.asarray(rng.normal(0, 0.1, (6, 4, 3))))
    p = state.positions / unit.length
    return direct.Known(rod, rest, turned, p, state.orientations, forces), scene.dt, state


@pytest.mark.parametrize("ragged", [False, True])
def test_the_matrix_and_the_equations_are_the_same(ragged: bool) -> None:
    """`linearised` builds with matrices what `residual` computes with vectors."""
    at, dt, _ = known(ragged)
    rng = np.random.default_rng(8)
    inertia = jnp.asarray(1e-3)
    n, phi = (jnp.asarray(rng.normal(size=(6, 3, 3))) for _ in range(2))
    x = jnp.where(at.rod.edge_exists(), n, 0), jnp.where(at.rod.edge_weights > 0, phi, 0)
    blocks, right = jax.jit(direct.linearised, static_argnums=2)(at, inertia, dt)
    wanted = jax.tree.map(jnp.subtract, product(blocks, x), right)
    found = jax.jit(direct.residual, static_argnums=2)(at, inertia, dt, x)
    if ragged:  # behind a strand's tip nothing is asked of the equations but a solution of 0
        there = at.rod.edge_exists()
        wanted, found = (tuple(jnp.where(there, a, 0) for a in pair) for pair in (wanted, found))
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-11 * float(jnp.abs(b).max()))
    solved, _ = jax.jit(solve)(blocks, right)
    for part in solved:
        missing = np.broadcast_to(~np.asarray(at.rod.edge_exists()), part.shape)
        assert not np.any(np.asarray(part)[missing])


def test_the_matrix_bounds_the_true_second_derivative() -> None:
    """matrix - true second derivative of the energy has no negative eigenvalue, nor has matrix."""
    at, dt, _ = known(False, damping=None)
    rod, unit = at.rod, Units.of(at.rod, dt)
    blocks, _ = jax.jit(direct.linearised, static_argnums=2)(at, jnp.asarray(1e-3), dt)
    shape, share = at.rest
    length = rod.lengths / unit.length

    def energy(phi: Any) -> Any:
        """Bend, twist, and the work of the forces, in units, of each strand."""
        q = quat.multiply(at.orientations, quat.from_rotation_vector(phi))
        r = quat.relative(q[:-1], q[1:])
        sign = quat.same_hemisphere(quat.relative(at.orientations[:-1], at.orientations[1:]), shape)
        c = (sign * r - shape)[:, 1:]
        spring = share * rod.bending() / (unit.force * unit.length)
        free = rod.edge_weights > 0
        pull = jnp.where(free, length * quat.dot(at.forces, quat.tangent(q)), 0)
        return jnp.sum(spring * c**2 / 2, axis=(0, 1)) - jnp.sum(pull, axis=(0, 1))

    def of_strand(phi: Any, strand: Any) -> Any:
        whole = jnp.zeros((6, 3, 3)).at[1:, :, strand].set(phi.reshape(5, 3))
        return energy(whole)[strand]

    second = jax.jit(jax.hessian(of_strand))
    for strand in range(3):
        true = np.asarray(second(jnp.zeros(15), strand))
        whole = dense(blocks, strand).reshape(6, 6, 6, 6)
        matrix = whole[1:, 3:, 1:, 3:].reshape(15, 15)
        scale = np.abs(matrix).max()
        assert np.linalg.eigvalsh(matrix).min() > -1e-12 * scale
        assert np.linalg.eigvalsh(matrix - true).min() > -2e-3 * scale


def released(numbers: dict[str, Any], solver: Any, steps: int = 100) -> jax.Array:
    """Final points of two strands that were permed, cut to a part and released into wind."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0], [0, 0.01, 0]], (0.0, 0.1, -1.0), length=0.12, points=13, dtype="float64"
    )
    rod = jh.Wound(numbers["diameter"], 0.1)
    free = (jh.Hold(), jh.Gravity(), jh.Drag(0.1), jh.Wind((0, -0.3, 0), (0, 0.3, -0.1), 30.0))
    phases = (
        jh.Phase("wound", AT_ONCE, (rod, jh.Cut(hydrogen=0.2, ionic=0.0, disulfide=0.8))),
        jh.Phase("set", AT_ONCE, (rod, jh.Reform(ionic=1.0, disulfide=1.0))),
        jh.Phase("released", steps / 360, free),
    )
    fibre = jh.PhysicalFibre(
        numbers["young_modulus"],
        damping_time=numbers["damping_time"],
        peeling_rate=numbers["peeling_rate"],
    )
    bonds = jh.Bonds(numbers["influence"])
    return jh.run(jh.Scene(hair, fibre, bonds, phases, solver))["released"].points


NUMBERS: dict[str, Any] = {
    "diameter": 0.03,
    "young_modulus": 3.89e9,
    "damping_time": 0.002,
    "peeling_rate": 0.9,
    "influence": np.array([0.33, 0.30, 0.20, 0.17]),
}


@pytest.mark.parametrize(
    "solver",
    [
        jh.Direct(),
        pytest.param(jh.Direct(newton_steps=2, substeps=2), marks=pytest.mark.slow),
        pytest.param(jh.Compliant(iterations=3), marks=pytest.mark.slow),
    ],
)
def test_gradients_agree_with_central_differences_and_between_modes(solver: Any) -> None:
    start = {name: jnp.asarray(value) for name, value in NUMBERS.items()}

    @jax.jit
    def f(logs: dict[str, Any]) -> jax.Array:
        points = released({k: start[k] * jnp.exp(logs[k]) for k in start}, solver)
        weights = jnp.arange(1.0, 1.0 + points.size).reshape(points.shape) / points.size
        return jnp.sum(jnp.sin(20 * points) * weights)

    zero = jax.tree.map(jnp.zeros_like, start)
    reverse, forward = jax.jit(jax.grad(f))(zero), jax.jit(jax.jacfwd(f))(zero)
    for name in start:
        scale = float(jnp.abs(reverse[name]).max())
        assert scale > 0, name
        assert np.abs(forward[name] - reverse[name]).max() < MODES * scale
        for place in np.ndindex(np.shape(start[name])):

            def at(h: float, name: str = name, place: tuple = place) -> float:
                return float(f({**zero, name: jnp.asarray(zero[name]).at[place].set(h)}))

            h = 1e-4
            found = (8 * (at(h) - at(-h)) - (at(2 * h) - at(-2 * h))) / (12 * h)
            assert found == pytest.approx(float(reverse[name][place]), abs=GRADIENT * scale), name


@pytest.mark.parametrize(
    ("points", "edge"),
    [
        *((points, None) for points in (2, 33, 129)),
        *((points, 5e-3) for points in (9, 65)),
        *(pytest.param(points, None, marks=pytest.mark.slow) for points in (9, 65)),
        *(pytest.param(points, 5e-3, marks=pytest.mark.slow) for points in (2, 33, 129)),
    ],
)
def test_real_hair_hangs_still_and_unstretched_in_float32(points: int, edge: float | None) -> None:
    """From a horizontal start, real hair's stiffness and weight, the paper's time step."""
    length = 0.24 if edge is None else edge * (points - 1)
    hair = jh.Strands.straight(
        [[0.0, 0, 0]], (1.0, 0.2, 0.3), length=length, points=points, dtype="float32"
    )
    effects = jh.Hold(), jh.Gravity(), jh.Drag(0.1)
    state = after(6.0, hair, *effects, fibre=jh.PhysicalFibre(), dt=1 / 360)
    assert state.positions.dtype == jnp.float32
    assert stretch(state, hair) < STRETCH
    assert speed(state) < NOISE


def test_forces_at_rest_are_the_weight_below() -> None:
    """Each edge of a hanging hair carries what hangs from it, straight down."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0]], (0.0, 0, -1.0), length=0.1, points=11, dtype="float64"
    )
    state = after(4.0, hair, jh.Hold(), jh.Gravity(), jh.Drag(0.05))
    below = LINEAR_DENSITY * 9.8 * (0.1 - 0.01 * (np.arange(10) + 0.5))
    found = np.asarray(state.forces)[:, :, 0]
    np.testing.assert_allclose(found, below[:, None] * [0, 0, -1], atol=1e-9 * below[0])


def test_missing_edges_change_nothing() -> None:
    """Strands of 5 and 8 points in one scene move as each does alone."""
    rng = np.random.default_rng(0)
    x = np.cumsum(rng.normal(0, 3e-3, (2, 8, 3)) + [8e-3, 0, -5e-3], axis=1)
    both = jh.Strands.from_points(x, counts=[5, 8])
    alone = [jh.Strands.from_points(x[i : i + 1, :n]) for i, n in enumerate((5, 8))]
    effects = jh.Hold(), jh.Gravity(), jh.Drag(0.2), jh.TipForce((0, 1e-6, 0))
    found = np.asarray(after(0.2, both, *effects, dt=1 / 360).points)
    for i, (hair, n) in enumerate(zip(alone, (5, 8), strict=True)):
        wanted = np.asarray(after(0.2, hair, *effects, dt=1 / 360).points)[0]
        np.testing.assert_allclose(found[i, :n], wanted, atol=1e-10)


def test_free_strands_keep_momentum_and_fall_as_one() -> None:
    """Nothing held: the mass's centre falls by g t^2 / 2, whatever bends and twists."""
    hair, state = random_hair(3, 9, False)
    scene = jh.Scene(hair, FIBRE, phases=(jh.Phase("fall", 0.1, (jh.Gravity(),)),))
    scene = replace(scene, solver=jh.Direct()).as_arrays()
    rod = prepare(scene, scene.phases[0].effects).rod
    mass = np.asarray(1 / rod.point_weights)
    centre = [np.sum(mass * np.asarray(state.positions), 0) / mass.sum(0)]
    speeds = np.sum(mass * np.asarray(state.velocities), 0) / mass.sum(0)
    start = replace(state, forces=jnp.zeros((8, 3, 3)))
    end = after(0.1, hair, jh.Gravity(), state=start, dt=1 / 360)
    centre.append(np.sum(mass * np.asarray(end.positions), 0) / mass.sum(0))
    n, dt = 36, 1 / 360
    fall = np.array([0, 0, -9.8])[:, None] * dt**2 * n * (n + 1) / 2
    np.testing.assert_allclose(centre[1], centre[0] + speeds * n * dt + fall, atol=1e-9)


def test_a_loaded_coil_comes_to_rest() -> None:
    """Without the second-order terms of `hessian` it spins itself up for ever."""
    angle = 2 * np.pi * np.arange(12 * 16 + 1) / 16
    x = 0.01 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    hair = jh.Strands.from_points(x[None])
    fibre = jh.PhysicalFibre(shear_modulus=FIBRE.young_modulus / 2, peeling_rate=0.0)
    effects = jh.Hold(), jh.Gravity((0, 0, -15.7)), jh.Drag(0.1)
    assert speed(after(60.0, hair, *effects, fibre=fibre)) < 1e-4


def test_wild_motion_keeps_lengths_in_bounds_and_numbers_finite() -> None:
    """A root jerked by 5 m/s, no drag, one Newton step: lengths to a few percent at any time."""
    hair = jh.Strands.straight(
        [[0.0, 0, 0]], (1.0, 0, 0.3), length=0.24, points=33, dtype="float32"
    )
    state = after(0.05, hair, jh.Hold(velocity=(0, 5.0, 0)), dt=1 / 360)
    for _ in range(12):
        state = after(1 / 30, hair, jh.Hold(), jh.Gravity(), state=state, dt=1 / 360)
        assert stretch(state, hair) < 0.05
        assert np.abs(np.linalg.norm(np.asarray(state.orientations), axis=1) - 1).max() < 1e-5


def test_pull_matrix_is_the_positive_part() -> None:
    """(A + |A|) / 2 of `Pulls` by NumPy's eigenvectors, and its product with vectors."""
    rng = np.random.default_rng(5)
    n = rng.normal(size=(6, 3, 1))
    n[0], n[1, :2], n[2, :2, 0], n[3, 2] = 0, 0, (1e-9, 0), 0
    n[2, 2] = -1
    eye = [jnp.tile(jnp.eye(3)[k][None, :, None], (6, 1, 1)) for k in range(3)]
    pulls = hessian.pulls(jnp.asarray(n), *eye)
    found = np.asarray(hessian.pull_matrix(pulls))[..., 0]
    phi = jnp.asarray(rng.normal(size=(6, 3, 1)))
    moments = np.asarray(hessian.pull_moments(pulls, phi))
    np.testing.assert_allclose(moments[..., 0], np.einsum("eij,ej->ei", found, phi[..., 0]))
    for i, (n1, n2, n3) in enumerate(n[..., 0]):
        values, vectors = np.linalg.eigh(
            [[n3, 0, -n1 / 2], [0, n3, -n2 / 2], [-n1 / 2, -n2 / 2, 0]]
        )
        wanted = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        np.testing.assert_allclose(found[i], wanted, atol=1e-12)
    slope = jax.jacrev(lambda n: hessian.pull_matrix(hessian.pulls(n, *eye)))(jnp.zeros((6, 3, 1)))
    assert np.all(np.isfinite(slope))


def test_vmap_over_whole_scenes() -> None:
    """Two moduli at once as one after the other."""
    moduli = jnp.asarray([3e9, 5e9])

    def end(young: Any) -> jax.Array:
        return released({**NUMBERS, "young_modulus": young}, jh.Direct(), steps=20)

    together = jax.jit(jax.vmap(end))(moduli)
    for i in range(2):
        np.testing.assert_allclose(together[i], end(moduli[i]), atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["perm", "bed-hair", "blow-dry"])
def test_the_papers_scenes_with_the_direct_solver(name: str) -> None:
    """Contact, obstacles, wind and winding, real hair's stiffness, float32: hair stays hair."""
    scene = jh.scenes.by_name(name, strands=8, solver=jh.Direct())
    assert isinstance(scene.fibre, jh.PhysicalFibre)
    movie = jh.simulate(scene, fps=10)
    edges = np.linalg.norm(np.diff(movie.positions, axis=2), axis=-1)
    length = np.asarray(scene.strands.lengths)[None]
    assert np.abs(edges.sum(-1) / length.sum(-1) - 1).max() < 0.05
    assert np.abs(edges[-1] / length[0] - 1).max() < 1e-2


def test_at_rest_the_cover_has_no_slope() -> None:
    """Its tip is rounded: where the moment is rounding, so would be the direction of its slope."""
    rng = np.random.default_rng(0)
    q = jnp.asarray(rng.normal(size=(9, 4, 2)))
    q = q / jnp.linalg.norm(q, axis=1, keepdims=True)
    hair = jh.Strands.straight(np.zeros((2, 3)), (1.0, 0, 0), length=0.24, points=10)
    scene = jh.Scene(hair, jh.PhysicalFibre()).as_arrays()
    rod = prepare(scene, ()).rod
    unit = Units.of(rod, scene.dt)
    shape = quat.unit(quat.relative(q[:-1], q[1:]))
    share = jnp.ones((8, 1, 2))

    def cover(q: jax.Array) -> jax.Array:
        return hessian.joints(rod, unit, q, q, (shape, share), scene.dt).cover

    spring = float(hessian.joints(rod, unit, q, q, (shape, share), scene.dt).spring.max())
    slopes = jax.jit(jax.jacfwd(cover))(q)
    assert float(jnp.abs(slopes).max()) < 0.2 * spring


def two_edges() -> tuple[Any, jax.Array, jax.Array, jax.Array]:
    """A rod of two edges along z: rod, points, lengths and frames, in units of an edge."""
    hair = jh.Strands.straight([(0.0, 0, 0)], (0, 0, 1.0), length=0.02, points=3)
    scene = jh.Scene(hair, jh.PhysicalFibre()).as_arrays()
    state = start(scene)
    rod = prepare(scene, ()).rod
    return rod, state.positions / 0.01, rod.lengths / 0.01, state.orientations


def test_edges_that_shrink_fast_do_not_turn_around() -> None:
    """Points that would pass each other along an edge leave its frame; across, they turn it."""
    rod, p, length, q = two_edges()
    turned = jax.jit(direct._turned)
    back = jnp.zeros_like(p).at[1, 2].set(-3.0)
    np.testing.assert_allclose(turned(rod, p, back, length, q), q, atol=1e-12)
    across = turned(rod, p, jnp.zeros_like(p).at[1, 0].set(1.0), length, q)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(quat.tangent(across)[0, :, 0], (half, 0, half), atol=1e-12)


def test_short_edges_say_little_of_their_direction() -> None:
    """Points a millionth of an edge apart turn frames by that much, at a slope of 2 an edge."""
    rod, p, length, q = two_edges()
    near = p.at[:, 0].set(jnp.asarray([0, 1e-6, 0])[:, None]).at[:, 2].set(0.0)
    still = jnp.zeros_like(p)
    turned = jax.jit(direct._turned)(rod, near, still, length, q)
    assert float(jnp.abs(turned - q).max()) < 2e-6
    slope = jax.jit(jax.jacfwd(direct._turned, argnums=1))(rod, near, still, length, q)
    assert float(jnp.abs(slope).max()) < 2.1
