"""100,000 steps, almost 5 minutes of hair at rest and in wind: nothing drifts."""

import itertools
from functools import partial

import jax
import numpy as np
import pytest
from hard_cases.catalogue import SOLVERS, Setting, blown, helix, moved, through
from mechanics import stepped, stretch

CHUNK, CHUNKS = 20_000, 5
UNIT = {"float64": 1e-14, "float32": 1e-6}  # of quaternions' norms
SPEED = {"float64": 1e-4, "float32": 1e-4}  # of what has settled, or nearly so [m/s]
PLACE = {"float64": 1e-12, "float32": 3e-6}  # rounding of a point's place [m]
LENGTH = {"float64": 1e-12, "float32": 1e-6}  # of an edge's length over its length
SETTLING = 0.8  # what changes otherwise must fade at least so from one chunk to the next

LATER = pytest.mark.slow  # float64: the same in more digits


chunk = jax.jit(partial(stepped, steps=CHUNK))


@pytest.mark.parametrize("wind", [0.0, 30.0], ids=["at rest", "in wind"])
@pytest.mark.parametrize(
    ("solver", "dtype"),
    [
        pytest.param(s, d, marks=[LATER] if d == "float64" or s == "sequential" else [])
        for s in SOLVERS
        for d in UNIT
    ],
)
def test_nothing_drifts(solver: str, dtype: str, wind: float) -> None:
    """What changes is rounding or fades: places, lengths, speeds, norms of quaternions.

    XPBD's sweeps take 50,000 steps to settle; all others have after 20,000.
    """
    effects = blown((0.3, 0.05, 0.1), (-0.3, 0.05, -0.2), wind)
    scene = Setting(solver, dtype).scene(through(helix(radius=0.015)), *effects)
    arrays, state = scene.as_arrays(), moved(scene).state
    places, lengths = [], []
    for _ in range(CHUNKS):
        state = chunk(arrays, state)
        norms = np.linalg.norm(np.asarray(state.orientations, float), axis=1)
        assert np.abs(norms - 1).max() < UNIT[dtype]
        assert np.abs(state.velocities).max() < SPEED[dtype]
        assert np.all((state.fractions >= 0) & (state.fractions <= 1))
        places.append(np.asarray(state.positions, float))
        lengths.append(stretch(state, scene.strands))
    for values, rounding in ((places, PLACE[dtype]), (lengths, LENGTH[dtype])):
        changes = [np.abs(b - a).max() for a, b in itertools.pairwise(values)]
        for before, after in itertools.pairwise(changes):
            assert after < max(SETTLING * before, rounding)
