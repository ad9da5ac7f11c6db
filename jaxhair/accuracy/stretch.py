"""How much too long the paper's solver lets a strand hang, measured and in theory.

A hanging strand of N edges gains g dt^2 at its root edge in every step, and nothing elsewhere. A
projection leaves a part of an edge's stretch, gives the rest to the edges beside it in equal
parts, and at the tip it is lost: n iterations let the stretch diffuse towards the tip.
Successive over-relaxation with w = 1 / (1 + 2 W), where W is `orientation_weight`, diffuses by
w / (2 - w) = 1 / (1 + 4 W) edges^2 an iteration. At rest the stretch falls linearly from root to
tip, with a sum over the length L of

    (1 + 4 W) N^2 g dt^2 / (2 n L),

so it is of order -1 in the iterations n and, dt being a substep, of order -2 in the substeps.
"""

from dataclasses import dataclass

import jax
import numpy as np

from jaxhair.accuracy.problem import precision
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import run
from jaxhair.solvers import PositionBased
from jaxhair.strands import Strands
from jaxhair.treatments import HANGING

GRAVITY = 9.8


@dataclass(frozen=True)
class Stretch:
    """Of a hanging strand.

    Arguments:
        iterations, substeps: of the solver.
        measured: how much too long the strand is after 2 s, over its length.
        theory: what it should be.
    """

    iterations: int
    substeps: int
    measured: float
    theory: float


def stretch(
    iterations: int,
    substeps: int = 1,
    *,
    points: int = 33,
    edge: float = 5e-3,
    steps_per_second: int = 360,
    seconds: float = 2.0,
) -> Stretch:
    """The stretch of one strand of edges of `edge` [m] after it has hung for some seconds."""
    solver = PositionBased(iterations=iterations, substeps=substeps)
    edges = points - 1
    with precision("float64"):
        hair = Strands.straight(
            np.zeros((1, 3)), (0.0, 0.0, -1.0), length=edge * edges, points=points, dtype="float64"
        )
        hang = Phase("hang", seconds, HANGING)
        scene = Scene(hair, phases=(hang,), solver=solver, dt=1 / steps_per_second)
        x = np.asarray(jax.jit(run)(scene)["hang"].positions[:, :, 0])
    length = edge * edges
    found = np.linalg.norm(np.diff(x, axis=0), axis=1).sum() / length - 1
    dt = 1 / (steps_per_second * substeps)
    factor = 1 + 4 * float(np.asarray(solver.orientation_weight))
    theory = factor * edges**2 * GRAVITY * dt**2 / (2 * iterations * length)
    return Stretch(iterations, substeps, float(found), theory)
