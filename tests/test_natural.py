"""Natural strands: what they must remember, and what can be fitted of them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from benchmarks.natural_intervals import coverage

import fitting
import jaxhair as jh
from fitting import hanging
from fitting.constraints import Scale, Share
from fitting.hanging import held_up, without_weight
from fitting.many import FitEach, fit_each
from fitting.natural import STATE, UNLOADED, natural
from fitting.polylines import evenly
from jaxhair.checkpoints import Checkpoints


def helix(diameter: float, length: float, points: int = 60) -> np.ndarray:
    """A curl that climbs down by 0.9 rad, from a root at which it points there too."""
    angle = np.linspace(0, 2 * length * np.cos(0.9) / diameter, points)
    x = diameter / 2 * np.stack([np.cos(angle) - 1, np.sin(angle)], axis=1)
    return np.concatenate([x, -np.linspace(0, length * np.sin(0.9), points)[:, None]], axis=1)


CURLS = [helix(14e-3, 0.06), helix(20e-3, 0.05), helix(26e-3, 0.07)]
BAD: dict[int, tuple[Any, str]] = {
    0: (np.zeros((1, 3)), "fewer than 3"),
    2: (np.ones((5, 3)), "no length"),
    3: (np.array([[0.0, 0, 0], [0, 0, 0], [0, 0, -0.1]]), "2 different points"),
    5: (np.array([[0.0, 0, 0], [0, 0, np.nan], [0, 0, -0.1]]), "not finite"),
    6: (np.array([[0.0, 0, 0], [0, 0, -0.1], [0.01, 0, -0.02]]), "too far apart"),
    8: (np.zeros((4, 2)), "(4, 2)"),
}


def test_what_weight_bends_is_a_cantilevers_moment() -> None:
    """Seen straight and level: m = q (L - s)^2 / 2 at the middle of a root's half edge is B / h
    times the turn that the strand remembers."""
    points, length = 41, 0.05
    x = np.zeros((1, points, 3))
    x[0, :, 0] = np.linspace(0, length, points)
    fibre = jh.PhysicalFibre(peeling_rate=0.0)
    shape = without_weight(jh.Strands.from_points(x), fibre)
    turn = 2 * np.linalg.norm(shape[0], axis=-1)
    weight = 9.8 * float(fibre.density * fibre.area)
    bending = float(fibre.bending_stiffness[0])
    edge = length / (points - 1)
    left = length - edge * np.arange(1, points - 1)
    wanted = edge * weight * left**2 / 2 / bending
    assert turn == pytest.approx(wanted, rel=0.05, abs=0.05 * wanted[0])
    assert turn[0] == pytest.approx(wanted[0], rel=0.03)
    half = without_weight(jh.Strands.from_points(x), fibre, hydrogen=0.5)
    assert half == pytest.approx(2 * shape)


def test_strands_hang_as_they_were_seen_and_others_are_listed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hanging, "STAYS", 1e-3)
    good = iter(CURLS)
    strands = [BAD[i][0] if i in BAD else next(good) for i in range(9)]
    hair = natural(strands, points=17, seconds=0.1)
    assert list(hair.used) == [1, 4, 7]  # they stay within a thousandth of their length
    assert list(hair.stiffer) == [1, 1, 1]
    assert set(hair.left) == set(BAD)
    for i, (_, words) in BAD.items():
        assert words in hair.left[i]
    # what is remembered is curled more than what hangs
    seen = jh.Strands.from_points(np.asarray(hair.targets[STATE].strands)).natural_shape
    remembered = hair.scene.strands.natural_shape
    assert float(jnp.mean(remembered**2)) > float(jnp.mean(seen**2))

    assert hair.lengths == pytest.approx([0.06, 0.05, 0.07], rel=0.02)
    ones, reasons = np.ones(3), (None, "lost", None)
    found = FitEach({}, {}, {}, {}, ones, ones > 0, reasons, ones, 1.0)
    table = hair.table(found)
    assert table.startswith("2 of 9 strands fitted")
    assert "strand 4: lost\nstrand 5: not finite" in table


def test_the_search_for_stiffness_goes_on_from_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of long hair that stands out level: it needs more stiffness than a hair has, and gets it."""
    x = np.zeros((3, 17, 3))
    x[:, :, 0] = np.linspace(0, 1, 17) * np.array([[0.02], [0.1], [0.25]])
    phases = jh.treatments.wash(name=STATE, seconds=0.05, unload=False)
    hair = jh.Strands.from_points(jnp.asarray(x, "float32"))
    scene = jh.Scene(hair, jh.PhysicalFibre(), phases=phases, solver=jh.Direct())
    told: list[tuple[int, int]] = []
    shape, stiffer = held_up(scene, STATE, progress=lambda *counts: told.append(counts))
    assert list(stiffer) == [1, 1, 4]
    # the third would have to remember too sharp a bend at first: it is not even simulated
    assert told == [(2, 3), (3, 0)]
    true = Checkpoints.add

    def add(self: Checkpoints, *arguments: Any, **more: Any) -> None:
        true(self, *arguments, **more)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "add", add)
        with pytest.raises(KeyboardInterrupt):
            held_up(scene, STATE, checkpoint=tmp_path)
    again: list[tuple[int, int]] = []
    found = held_up(
        scene, STATE, checkpoint=tmp_path, progress=lambda *counts: again.append(counts)
    )
    np.testing.assert_array_equal(found[0], shape)
    np.testing.assert_array_equal(found[1], stiffer)
    assert again == [(1, 0)]  # the first round was kept
    with pytest.raises(ValueError, match="other work"):
        held_up(replace(scene, fibre=jh.PhysicalFibre(radius=5e-5)), STATE, checkpoint=tmp_path)


def test_resampling_says_what_it_loses() -> None:
    """Of a circle: chords of half the turn fall short by r (1 - cos) at their middles."""
    angle = np.linspace(0, 2 * np.pi, 2001)
    circle = 0.01 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    shapes, off = evenly([circle, circle[:2], circle[:1001]], 21)
    sagitta = 10 * (1 - np.cos(np.pi / 20))
    assert off[0] == pytest.approx(sagitta * np.sqrt(8 / 15), rel=0.01)  # of a parabola
    assert off[1] < 1e-12
    assert off[2] == pytest.approx(off[0] / 4, rel=0.02)
    assert np.linalg.norm(shapes[:, 0] - circle[0], axis=1).max() < 1e-15


@pytest.mark.slow
def test_strands_seen_with_and_without_weight_show_hydrogen_and_wear() -> None:
    hair = natural(CURLS[:2], unloaded=CURLS[:2], points=17, seconds=0.3, dtype="float64")
    influence, rates = np.array([[0.5, 0.2, 0.2, 0.1], [0.2, 0.3, 0.3, 0.2]]), np.array([3.0, 6.0])
    truth = replace(
        hair.scene,
        bonds=jh.Bonds(influence),
        fibre=jh.PhysicalFibre(radius=25e-6, peeling_rate=rates),
    )
    ends = jax.jit(jh.run)(truth)
    scene = replace(hair.scene, fibre=jh.PhysicalFibre(radius=25e-6, peeling_rate=1.0))
    targets = {name: fitting.Shape(np.asarray(ends[name].points)) for name in (UNLOADED, STATE)}
    found = fit_each(scene, targets, hair.free, noise_mm=0.01)
    assert found.fitted.all()
    assert found.values["bonds.influence"][:, 0] == pytest.approx(influence[:, 0], abs=0.01)
    assert found.values["fibre.peeling_rate"] == pytest.approx(rates, rel=0.05)


@pytest.mark.slow
def test_intervals_of_noisy_strands_hold_the_truth() -> None:
    """Of 24 strands with noise of 0.1 mm, 95 % intervals miss at most 4: fewer than one time in a
    hundred would they miss more. They say more than the truths' range does."""
    inside, widths, left = coverage(24, 1e-4, points=33)
    assert left == 0
    assert (inside.sum(axis=1) >= 20).all()
    assert (np.median(widths, axis=1) < 0.6).all()


@pytest.mark.slow
def test_straight_strands_leave_hydrogen_and_wear_open() -> None:
    """They hang straight down, loaded and not: nothing shows in them."""
    line = np.linspace(0, 0.1, 30)[:, None] * np.array([0.0, 0.0, -1.0])
    rng = np.random.default_rng(0)
    seen = [[line + rng.normal(0, 2e-5, line.shape)] for _ in range(2)]
    hair = natural(seen[0], unloaded=seen[1], points=17, seconds=0.1)
    found = hair.fit()
    assert found.fitted.all()
    assert found.intervals is not None
    low, high = found.intervals["bonds.influence[hydrogen]"][0]
    assert low < 0.1
    assert high > 0.9
    low, high = found.intervals["fibre.peeling_rate"][0]
    assert low == 0
    assert high > 30


def test_without_weight_the_seen_shape_is_the_remembered_one() -> None:
    hair = natural(jh.Curves.from_list(CURLS), weight=False, strands=2)
    assert list(hair.used) == [0, 2]
    assert 17 <= hair.scene.strands.points <= 65
    assert list(hair.free) == ["strands.natural_shape"]
    seen = jh.Strands.from_points(jnp.asarray(hair.targets[STATE].strands, "float32"))
    assert np.asarray(hair.scene.strands.natural_shape) == pytest.approx(seen.natural_shape)


def test_constraints() -> None:
    shape = np.array([[0.1, 0.0, 0.2], [0.0, 0.6, 0.0]])
    assert Scale().value(jnp.asarray(Scale().free(shape)), shape) == pytest.approx(shape)
    doubled = np.array([[0.2, 0.0, 0.4], [0.0, 0.8, 0.0]])
    assert Scale().value(jnp.log(jnp.array([2.0])), shape) == pytest.approx(doubled)
    f = np.array([0.33, 0.30, 0.20, 0.17])
    assert Share(0).value(jnp.asarray(Share(0).free(f)), f) == pytest.approx(f)
    half = Share(0).value(jnp.zeros(1), f)
    assert half == pytest.approx(np.array([0.5, *(f[1:] / f[1:].sum() / 2)]))
    for bad in ([1.0, 0.0], [-1.0, 2.0], 1.0):
        with pytest.raises(ValueError):
            Share(0).free(np.asarray(bad))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"curves": []}, ["no strand", "there is none"]),
        ({"curves": [np.zeros((1, 3))]}, ["no strand", "fewer than 3"]),
        ({"curves": [helix(1e-3, 0.3, 500)]}, ["no strand", "rad between the edges of 65"]),
        ({"unloaded": CURLS[:1]}, ["3 strands", "1 unloaded"]),
        ({"unloaded": CURLS, "weight": False}, ["weight", "must be True"]),
        ({"points": 3}, ["points", "3", "at least 4"]),
        ({"strands": 0}, ["strands", "0", "at least 1"]),
        ({"influence": (1.0, 1.0)}, ["influence", "(4"]),
        ({"fibre": jh.PhysicalFibre(radius=np.full(3, 4e-5))}, ["fibre.radius", "(3,)"]),
        ({"curves": 3}, ["curves", "3", "Sequence"]),
    ],
)
def test_bad_requests_are_refused(change: dict[str, Any], words: list[str]) -> None:
    with pytest.raises(ValueError) as error:
        natural(**{"curves": CURLS, **change})
    for word in words:
        assert word in str(error.value)
