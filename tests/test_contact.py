"""Hair against hair by lists of neighbours: the same as all pairs, whatever the hair does."""

from dataclasses import replace
from functools import partial
from typing import Any

import all_pairs
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

import jaxhair as jh
from jaxhair.neighbours import IN_CACHE, WIDE, Batch, _along_the_curve, near_pairs
from jaxhair.simulate import Setup, advance, blank, prepare, remembering_step, start

# Relative to the largest push. Float32 rounds the direction between hairs that nearly coincide.
AGREES = {"float64": 1e-12, "float32": 5e-5}
SLOPES = 1e-6  # against central differences, relative to the largest
SUMS = 1e-6  # the same pushes of float32, summed in another order
DT = 1 / 360


def hair(
    strands: int = 60, points: int = 7, seed: int = 0, ragged: bool = False, dtype: str = "float64"
) -> jh.Strands:
    """A tangle of strands of 10 cm with roots on 3 cm."""
    rng = np.random.default_rng(seed)
    roots = rng.uniform(0, 0.03, (strands, 1, 3))
    edges = rng.normal(0, 0.3, (strands, points - 1, 3)) + [0.0, 0.0, -1.0]
    edges *= 0.1 / (points - 1) / np.linalg.norm(edges, axis=-1, keepdims=True)
    x = np.concatenate([roots, edges], 1).cumsum(1).astype(dtype)
    counts = rng.integers(2, points + 1, strands) if ragged else None
    return jh.Strands.from_points(x, counts=counts)


def prepared(
    strands: jh.Strands, contact: jh.HairContact, *effects: Any
) -> tuple[Setup, jh.State, jh.HairContact]:
    """Setup, state and the effect as it is in use."""
    phase = jh.Phase("only", DT, (*effects, contact))
    scene = jh.Scene(strands, phases=(phase,)).as_arrays()
    setup = prepare(scene, scene.phases[0].effects)
    return setup, start(scene), setup.effects[-1]


@jax.jit
def both(setup: Setup, state: jh.State) -> tuple[jax.Array, jax.Array]:
    """Pushes by lists and by all pairs, at points that are there."""
    contact = setup.effects[-1]
    there = setup.rod.point_exists()
    ours = contact.velocity_change(setup.rod, state, DT)
    theirs = all_pairs.velocity_change(contact, setup.rod, state, DT)
    return jnp.where(there, ours, 0), jnp.where(there, theirs, 0)


@jax.jit
def renewed(contact: jh.HairContact, setup: Setup, state: jh.State, lists: Any = None) -> Any:
    """The lists after those given, or the first ones."""
    lists = contact.blank(setup.rod, state) if lists is None else lists
    return contact.remembered(setup.rod, state, lists)


def assert_same(ours: Any, theirs: Any) -> None:
    ours, theirs = np.asarray(ours), np.asarray(theirs)
    most = np.abs(theirs).max()
    assert most > 0
    assert np.abs(ours - theirs).max() <= AGREES[str(ours.dtype)] * most


@pytest.mark.parametrize(
    ("ragged", "dtype"),
    [
        pytest.param(True, "float64", id="ragged-float64"),
        pytest.param(False, "float32", id="equal-float32"),
        pytest.param(True, "float32", id="ragged-float32", marks=pytest.mark.slow),
        pytest.param(False, "float64", id="equal-float64", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("radius", [5e-4, 2e-3, 2e-2])
def test_the_same_as_all_pairs(radius: float, ragged: bool, dtype: str) -> None:
    """With few neighbours, and with nearly all hair near."""
    contact = jh.HairContact(radius, 20.0, capacity=400)
    for seed in range(3):
        strands = hair(seed=seed, ragged=ragged, dtype=dtype)
        assert_same(*both(*prepared(strands, contact)[:2]))


def test_nothing_but_the_order_of_sums_differs_from_all_pairs_in_float32() -> None:
    setup, state, contact = prepared(
        hair(60, dtype="float32"), jh.HairContact(2e-3, 20.0, capacity=64)
    )
    pushed = jax.jit(contact.recalled_change)
    ours = pushed(setup.rod, state, DT, renewed(contact, setup, state))
    theirs = pushed(setup.rod, state, DT, all_pairs.listed(state, np.arange(60)))
    most = np.abs(theirs).max()
    assert most > 0
    assert np.abs(ours - theirs).max() <= SUMS * most


def test_many_strands() -> None:
    """Of more than one group of blocks, in which boxes are left out."""
    setup, state, _ = prepared(hair(500, 9), jh.HairContact(1e-3, 20.0, capacity=64))
    spread = 0.3 * np.random.default_rng(1).normal(size=(1, 3, 500))
    assert_same(*both(setup, replace(state, positions=state.positions + spread)))


@pytest.mark.parametrize(
    ("reach", "batch"),
    [(0.0, IN_CACHE), (1e-3, IN_CACHE), (1e-2, IN_CACHE), (1.0, IN_CACHE)]
    + [(1e-2, WIDE), (1e-3, Batch(3, 7, 50, 1)), (1e-2, Batch(4, 100, 1000, 1))],
)
def test_pairs_are_those_of_a_search_by_brute_force(reach: float, batch: Batch) -> None:
    """Each once, and none too many; also with points and edges that are missing."""
    rng = np.random.default_rng(3)
    starts = rng.uniform(0, 0.1, (3, 1500))
    ends = starts + rng.normal(0, 0.01, starts.shape)
    strands = rng.integers(0, 200, 1500).astype("int32")
    starts[:, ::7], ends[:, ::5] = np.nan, np.nan
    p, a, along = starts.T[:, None], starts.T[None], (ends - starts).T[None]
    place = np.clip(np.sum((p - a) * along, -1) / np.sum(along**2, -1), 0, 1)
    near = np.linalg.norm(p - a - place[..., None] * along, axis=-1) < reach
    near &= strands[:, None] != strands
    room = max(int(near.sum()), 1)
    given = (jnp.asarray(x) for x in (starts, ends, strands, reach))
    found = near_pairs(*given, room, batch)
    assert int(found.number) == near.sum()
    pairs = np.asarray(found.order)[np.stack([found.points, found.edges])[:, : near.sum()]]
    np.testing.assert_array_equal(np.unique(pairs, axis=1), np.argwhere(near).T)


def test_the_curve_visits_every_place_in_steps_of_one() -> None:
    """Which is what makes it Hilbert's, and blocks of its points compact."""
    grid = np.array(np.meshgrid(*3 * [np.arange(16.0)])).reshape(3, -1)
    order = np.argsort(np.asarray(jax.jit(_along_the_curve)(jnp.asarray(grid))))
    np.testing.assert_array_equal(np.abs(np.diff(grid[:, order])).sum(axis=0), 1)


@partial(jax.jit, static_argnames="steps")
def along(setup: Setup, state: jh.State, steps: int) -> Any:
    """Pushes by lists and by all pairs in each step of a run, and how often lists were made."""
    contact, rod = setup.effects[-1], setup.rod

    def one(carry: Any, number: jax.Array) -> tuple[Any, Any]:
        before = carry[0]
        state, memories = remembering_step(setup, *carry, number * DT)
        ours = contact.recalled_change(rod, before, DT, memories[0])
        there = rod.point_exists()
        theirs = all_pairs.velocity_change(contact, rod, before, DT)
        return (state, memories), (jnp.where(there, ours, 0), jnp.where(there, theirs, 0))

    carry = state, blank(setup, state)
    carry, pushes = lax.scan(one, carry, jnp.arange(steps, dtype=state.positions.dtype))
    return pushes, carry[1][0].builds


@pytest.mark.parametrize(("speed", "least", "most"), [(0.02, 1, 8), (1.0, 3, 20), (1000.0, 20, 40)])
@pytest.mark.parametrize(
    "ragged", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["equal", "ragged"]
)
def test_hair_that_moves(speed: float, least: int, most: int, ragged: bool) -> None:
    """The lists serve until hair has moved, and are made again when it has."""
    strands = hair(40, 6, ragged=ragged)
    contact = jh.HairContact(2e-3, 200.0, capacity=64)
    setup, state, _ = prepared(strands, contact, jh.Hold(), jh.Gravity(), jh.Drag(0.1))
    velocities = speed * np.random.default_rng(5).normal(size=state.velocities.shape)
    velocities = velocities * np.asarray(setup.rod.point_weights > 0)
    (ours, theirs), builds = along(setup, replace(state, velocities=jnp.asarray(velocities)), 40)
    assert least <= builds <= most
    assert np.any(theirs[-1] != 0) or speed == 1000
    assert_same(ours, theirs)


@pytest.mark.parametrize("velocity", [(0.0, 0.0, 0.0), (30.0, 0.0, -30.0)])
def test_lists_of_hair_that_moves_as_a_whole_are_made_once(velocity: tuple) -> None:
    setup, state, contact = prepared(hair(20, 5), jh.HairContact(2e-3))
    lists = renewed(contact, setup, state)
    for _ in range(5):
        moved = state.positions + jnp.asarray(velocity)[None, :, None] * DT
        state = replace(state, positions=moved)
        lists = renewed(contact, setup, state, lists)
    assert lists.builds == 1
    lists = renewed(
        contact, setup, replace(state, positions=moved.at[-1, 0, 3].add(lists.skin * 1.01)), lists
    )
    assert lists.builds == 2


def test_lists_that_are_full_have_a_smaller_skin() -> None:
    """And still all pairs that touch."""
    skins = []
    for capacity in (1, 100):
        setup, state, contact = prepared(hair(), jh.HairContact(5e-4, capacity=capacity))
        skins.append(float(renewed(contact, setup, state).skin))
        assert_same(*both(setup, state))
    assert 0 <= skins[0] < skins[1]


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_hairs_that_coincide(dtype: str) -> None:
    """They push each other nowhere, others as ever, and slopes are finite."""
    strands = hair(12, 5, dtype=dtype)
    x = np.array(strands.positions)
    x[5] = x[0]
    setup, state, contact = prepared(
        jh.Strands.from_points(x), jh.HairContact(4e-3, 20.0, capacity=64)
    )
    ours, theirs = both(setup, state)
    assert_same(ours, theirs)
    np.testing.assert_array_equal(ours[..., 5], ours[..., 0])

    def total(x: jax.Array) -> jax.Array:
        return jnp.sum(contact.velocity_change(setup.rod, replace(state, positions=x), DT) ** 2)

    assert np.isfinite(jax.jit(jax.grad(total))(state.positions)).all()


@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
def test_hairs_that_coincide_but_for_rounding(dtype: str) -> None:
    """A difference of a last digit is no direction: no push, where a hundredth of the radius
    apart there is nearly the greatest."""
    one = np.asarray(hair(1, 5, dtype=dtype).positions)[0]
    for apart, pushed in ((np.nextafter(one, one + 1) - one, False), (2e-5 + 0 * one, True)):
        strands = jh.Strands.from_points(np.stack([one, (one + apart).astype(dtype)]))
        setup, state, _ = prepared(strands, jh.HairContact(2e-3, 20.0))
        ours, theirs = both(setup, state)
        most = 20.0 * DT
        assert (float(jnp.abs(ours).max()) > 0.5 * most) == pushed
        np.testing.assert_allclose(ours, theirs, atol=1e-3 * most)


def test_derivatives() -> None:
    """Of the pushes themselves: forward as reverse mode, and as central differences."""
    setup, state, contact = prepared(hair(30, 5), jh.HairContact(3e-3, 20.0, capacity=64))
    rng = np.random.default_rng(2)
    weights, direction = (jnp.asarray(rng.normal(size=state.positions.shape)) for _ in range(2))

    @jax.jit
    def total(x: jax.Array, radius: Any) -> jax.Array:
        change = replace(contact, radius=radius).velocity_change(
            setup.rod, replace(state, positions=x), DT
        )
        return jnp.sum(weights * change)

    at = state.positions, jnp.asarray(3e-3)
    reverse = jax.jit(jax.grad(total, argnums=(0, 1)))(*at)
    _, forward = jax.jit(partial(jax.jvp, total))(at, (direction, jnp.asarray(1e-3)))
    slope = jnp.sum(reverse[0] * direction) + 1e-3 * reverse[1]
    np.testing.assert_allclose(slope, forward, rtol=1e-10)
    h = 1e-8
    ends = (float(total(at[0] + s * h * direction, 3e-3 + s * h * 1e-3)) for s in (1, -1))
    np.testing.assert_allclose((next(ends) - next(ends)) / (2 * h), forward, rtol=SLOPES)


def test_a_run_does_not_depend_on_how_its_steps_are_split() -> None:
    """But by rounding: the lists, which it starts with anew, are not part of its state."""
    setup, state, _ = prepared(
        hair(20, 5), jh.HairContact(3e-3, 20.0), jh.Hold(), jh.Gravity(), jh.Drag(0.1)
    )
    go = jax.jit(advance, static_argnames="steps")
    whole = go(setup, state, 0, steps=24).positions
    for steps in (8, 1):
        at = state
        for first in range(0, 24, steps):
            at = go(setup, at, first, steps=steps)
        np.testing.assert_allclose(at.positions, whole, rtol=0, atol=1e-11)


@pytest.mark.slow
def test_over_scenes_at_once() -> None:
    """`jax.vmap` over runs, and derivatives of all of them."""
    strands = hair(8, 5)

    def end(strength: jax.Array) -> jax.Array:
        phase = jh.Phase("only", 10 * DT, (jh.Hold(), jh.HairContact(4e-3, strength)))
        return jh.run(jh.Scene(strands, phases=(phase,)))["only"].points[:, -1, 1].sum()

    strengths = jnp.asarray([5.0, 20.0, 80.0])
    alone = jax.jit(jax.value_and_grad(end))
    many, slopes = jax.jit(jax.vmap(alone))(strengths)
    for strength, value, slope in zip(strengths, many, slopes, strict=True):
        one, its_slope = alone(strength)
        np.testing.assert_allclose((value, slope), (one, its_slope), rtol=1e-9)
        assert slope != 0


def test_not_a_number_is_passed_on() -> None:
    """As all pairs do: one hair without a place pushes all others nowhere."""
    setup, state, _ = prepared(hair(10, 5), jh.HairContact(3e-3))
    bad = replace(state, positions=state.positions.at[2, 1, 3].set(jnp.nan))
    assert np.isnan(both(setup, bad)[0]).all()


def crowded(capacity: int) -> jh.Scene:
    """Sixty hairs within two radii of each other."""
    rng = np.random.default_rng(0)
    roots = rng.normal(0, 1e-4, (60, 3))
    strands = jh.Strands.straight(roots, (0.0, 0.0, -1.0), length=0.1, points=4, dtype="float32")
    phases = (
        jh.Phase("free", 6 * DT, (jh.Hold(), jh.Drag(0.1))),
        jh.Phase("touching", 6 * DT, (jh.Hold(), jh.HairContact(1e-3, 1.0, capacity=capacity))),
    )
    return jh.Scene(strands, phases=phases)


def test_more_contacts_than_there_is_room_for() -> None:
    """No run is silently wrong: values are NaN, and the error says what to set."""
    scene = crowded(20)
    ends = jh.run(scene)
    assert np.isfinite(ends["free"].positions).all()
    assert np.isnan(ends["touching"].positions[1:]).all()
    with pytest.raises(jh.NotFinite) as caught:
        jh.simulate(scene)
    text = str(caught.value)
    assert "phase 'touching'" in text
    assert "edges within two radii of a point, in the mean" in text
    assert "HairContact.capacity is 20; set it to" in text
    needed = int(text.split("set it to ")[1].split()[0])
    assert np.isfinite(jh.run(crowded(needed))["touching"].positions).all()


def test_a_capacity_that_is_no_number_of_edges() -> None:
    for capacity in (0, 2.5, "many"):
        with pytest.raises(ValueError, match=r"HairContact.capacity is .* at least 1"):
            jh.HairContact(capacity=capacity)  # type: ignore[arg-type]
