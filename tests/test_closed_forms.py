"""Set, curl diameter and wash against their closed forms, in hair without weight.

After winding with the Darboux vector Omega_w, cutting the bonds j to c_j and re-forming them,
Omega_j = c_j Omega_0 + (1 - c_j) Omega_w; free of load the hair then takes
Omega = sum_j f_j Omega_j / sum_j f_j.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import jaxhair as jh
from jaxhair import quaternion as quat
from jaxhair import treatments
from jaxhair.strands import State, strands_first
from jaxhair.treatments import AT_ONCE

TOLERANCE = {"relaxed": 1e-6, "at once": 1e-12}
LENGTH, POINTS, ROD = 0.24, 9, 0.1
EDGE = LENGTH / (POINTS - 1)
WOUND = np.array([EDGE / ROD, 0, 0])  # Omega_w: a turn by phi crosses D sin(phi / 2)
FREE = (jh.Hold(), jh.Drag(0.1))  # no gravity
STIFF = jh.Fibre(stiffness=1.0, peeling_rate=0.0)
SECONDS = 3.0

INFLUENCES = {
    "table 1": (0.33, 0.30, 0.20, 0.17),
    "equal": (1.0, 1.0, 1.0, 1.0),
    "uneven": (0.1, 2.0, 0.7, 0.3),
}


def shape(state: State) -> dict[str, np.ndarray]:
    """Darboux vectors (points - 2, 3), remembered shapes (points - 2, 4, 3), points (points, 3)."""
    q = state.orientations
    r = quat.relative(q[:-1], q[1:])
    omega = quat.same_hemisphere(r, jnp.zeros_like(r).at[:, 0].set(1)) * r
    return {
        "omega": strands_first(omega[:, 1:])[0],
        "shapes": strands_first(state.shapes)[0],
        "points": state.points[0],
    }


def ends(influence: tuple, *phases: jh.Phase, start: Any = None) -> dict[str, dict[str, Any]]:
    """What `shape` says of one strand at the end of each phase."""
    if start is None:
        down = (0.0, 0.0, -1.0)
        start = jh.Strands.straight([(0.0, 0, 0)], down, length=LENGTH, points=POINTS)
    scene = jh.Scene(start, STIFF, jh.Bonds(influence), phases)
    movie = jh.simulate(scene, fps=0.1, observe=shape)
    assert movie.complete
    return {
        phase.name: {k: v[movie.end_of(phase.name)] for k, v in movie.observed.items()}
        for phase in phases
    }


def curl_diameter(points: np.ndarray) -> np.ndarray:
    """Diameter of the circle through each three neighbouring points, abc / 2A."""
    a, b = np.diff(points, axis=0)[:-1], np.diff(points, axis=0)[1:]
    sides = [np.linalg.norm(x, axis=1) for x in (a, b, a + b)]
    return np.prod(sides, axis=0) / np.linalg.norm(np.cross(a, b), axis=1)


def treatment(name: str, left: float, unload: bool) -> tuple[tuple[jh.Phase, ...], np.ndarray]:
    """Its phases, and the fractions c_j that it leaves bonded."""
    options: dict[str, Any] = {"rod_diameter": ROD, "free": FREE, "seconds": SECONDS}
    options |= {"name": "end", "unload": unload}
    if name == "water set":
        return treatments.water_set(**options), np.array([0, 1, 1, 1])
    if name == "acid set":
        return treatments.acid_set(**options), np.array([0, 0, 1, 1])
    return treatments.perm(disulfide_left=left, **options), np.array([0, 0, left, 1])


@pytest.mark.parametrize("influence", INFLUENCES.values(), ids=INFLUENCES)
@pytest.mark.parametrize(
    ("name", "left"), [("water set", 1.0), ("acid set", 1.0), ("perm", 0.8), ("perm", 0.3)]
)
def test_set_and_curl(name: str, left: float, influence: tuple) -> None:
    """The set is sum f_j (1 - c_j) / sum f_j, and the curl's diameter that of the rod over it."""
    phases, c = treatment(name, left, unload=False)
    found, f = ends(influence, *phases), np.array(influence)
    np.testing.assert_allclose(found["end, wound"]["omega"], np.tile(WOUND, (7, 1)), atol=1e-12)
    share = np.sum(f * (1 - c)) / np.sum(f)
    relaxed = TOLERANCE["relaxed"]
    np.testing.assert_allclose(
        found["end"]["omega"] / EDGE * ROD, np.tile((share, 0, 0), (7, 1)), atol=relaxed
    )
    np.testing.assert_allclose(curl_diameter(found["end, wound"]["points"]), ROD, rtol=1e-9)
    np.testing.assert_allclose(
        curl_diameter(found["end"]["points"]), ROD / share, rtol=relaxed / share
    )


def test_unloading_gives_the_same_at_once() -> None:
    """`Unloaded` is where the hair comes to by itself, and then it stays there."""
    influence = INFLUENCES["uneven"]
    phases, c = treatment("perm", 0.4, unload=True)
    found, f = ends(influence, *phases), np.array(influence)
    share = np.sum(f * (1 - c)) / np.sum(f)
    for phase in ("end, unloaded", "end"):
        np.testing.assert_allclose(
            found[phase]["omega"], np.tile(share * WOUND, (7, 1)), atol=1e-12
        )


@pytest.mark.parametrize("influence", INFLUENCES.values(), ids=INFLUENCES)
def test_a_wash_takes_the_water_set_and_leaves_the_perm(influence: tuple) -> None:
    """After a perm and a wash (f_I + (1 - c) f_S) / (f_I + f_S + f_P) is left, after a set 0."""
    f, left = np.array(influence), 0.8
    wash = treatments.wash(free=FREE, seconds=SECONDS, unload=False)
    phases, _ = treatment("water set", 1.0, unload=False)
    found = ends(influence, *phases, *wash)
    assert found["end"]["omega"][:, 0].min() > 0.02 * WOUND[0]
    np.testing.assert_allclose(found["washed"]["omega"] / WOUND[0], 0, atol=TOLERANCE["relaxed"])
    phases, _ = treatment("perm", left, unload=False)
    found = ends(influence, *phases, *wash)
    share = (f[1] + (1 - left) * f[2]) / f[1:].sum()
    wanted = np.tile((share, 0, 0), (7, 1))
    np.testing.assert_allclose(
        found["washed"]["omega"] / WOUND[0], wanted, atol=TOLERANCE["relaxed"]
    )


def test_what_each_kind_remembers() -> None:
    """Omega_j = c_j Omega_0 + (1 - c_j) Omega_w, for curly hair and every kind of bond."""
    turn = np.linspace(0, 3.0, POINTS)
    coil = np.stack([0.07 * np.cos(turn), 0.07 * np.sin(turn), 0.02 * turn], 1)
    start = jh.Strands.from_points(coil[None])
    c = {"hydrogen": 0.0, "ionic": 0.35, "disulfide": 0.8, "peptide": 1.0}
    rod = jh.Wound(ROD, climb=0.3)
    reform = jh.Reform(**dict.fromkeys(c, 1.0))
    phases = (
        jh.Phase("cut", AT_ONCE, (rod, jh.Cut(**c))),
        jh.Phase("form", AT_ONCE, (rod, reform)),
    )
    found = ends(INFLUENCES["equal"], *phases, start=start)
    natural = np.asarray(start.natural_shape)[0, :, None]
    wound = found["form"]["omega"][:, None]
    assert np.abs(wound - natural).min(1).max() > 0.01
    left = np.array(list(c.values()))[None, :, None]
    tolerance = TOLERANCE["at once"]
    wanted = left * natural + (1 - left) * wound
    np.testing.assert_allclose(found["form"]["shapes"], wanted, atol=tolerance)
    kept = np.broadcast_to(natural, wanted.shape)
    np.testing.assert_allclose(found["cut"]["shapes"], kept, atol=tolerance)
    # The rod has the climb and the diameter that were asked for.
    climb = np.arctan2(wound[:, 0, 2], wound[:, 0, 0])
    np.testing.assert_allclose(climb, 0.3, atol=tolerance)
    size = np.linalg.norm(wound[:, 0], axis=1)
    lengths = np.asarray(start.lengths)[0]
    middle = (lengths[:-1] + lengths[1:]) / 2
    np.testing.assert_allclose(size, middle * np.cos(0.3) / ROD, atol=tolerance)
