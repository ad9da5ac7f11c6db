"""The settings that are measured."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from jaxhair.accuracy.problem import Problem
from jaxhair.direct import Direct
from jaxhair.solvers import Compliant, PositionBased, Solver

SOLVERS: dict[str, Any] = {"PositionBased": PositionBased, "Compliant": Compliant, "Direct": Direct}

COUNTS = ("iterations", "newton_steps", "substeps")
WEIGHTS = ("orientation_weight", "frame_inertia")
"""Of solvers, where they have them."""

TURNED = (
    "base",
    "iterations",
    "Newton steps",
    "substeps",
    "time step",
    "points",
    "frames",
    "dtype",
    "both",
)
"""What a setting changes from its solver's base; "both" are combinations.

"frames" is `orientation_weight` or `frame_inertia`, by which frames resist turning.
"""


@dataclass(frozen=True)
class Setting:
    """What a user can turn.

    Arguments:
        solver: with its iterations or Newton steps, and substeps.
        points: on a strand, 8 m + 1. steps_per_second: 1 / dt. dtype: "float32" or "float64".
        turned: from the solver's base, one of `TURNED`.
        gradient: it is measured too.
    """

    solver: Solver
    points: int = 33
    steps_per_second: int = 360
    dtype: str = "float32"
    turned: str = "base"
    gradient: bool = False

    def __str__(self) -> str:
        return (
            f"{expression(self.solver)}, {self.points} points, {self.steps_per_second} steps/s, "
            f"{self.dtype}"
        )


def expression(solver: Any) -> str:
    """The solver as one types it: "jh.Direct(newton_steps=2, substeps=4)"."""
    usual = type(solver)()
    inside = [
        f"{name}={getattr(solver, name)}"
        for name in (*COUNTS, *WEIGHTS)
        if hasattr(solver, name)
        and (name in COUNTS[:2] or getattr(solver, name) != getattr(usual, name))
    ]
    return f"jh.{type(solver).__name__}({', '.join(inside)})"


@dataclass(frozen=True)
class Plan:
    """All that is measured.

    Arguments:
        problem: to solve. settings: with which.
        points, steps_per_second, levels: of the reference, see `problem.reference`.
        iterations, substeps: with which a hanging strand's stretch is measured.
    """

    problem: Problem
    settings: Sequence[Setting]
    points: int
    steps_per_second: int
    levels: int
    iterations: Sequence[int]
    substeps: Sequence[int]


def plan(*, strands: int = 64, quick: bool = False) -> Plan:
    """What the command measures: everything, or little in less than two minutes."""
    problem = Problem(strands=strands)
    if quick:
        return Plan(problem, quick_grid(), 129, 1440, 2, (1, 5, 20), (4,))
    return Plan(problem, full_grid(), 257, 5760, 3, (1, 2, 5, 10, 20, 50, 100), (1, 2, 4, 8, 16))


def quick_grid() -> list[Setting]:
    """The bases, and a setting or two that is more accurate; two gradients, as they are compiled
    for long."""
    grid = [Setting(SOLVERS[name](), gradient=name != "Compliant") for name in SOLVERS]
    for sweeping in (PositionBased, Compliant):
        heavy = sweeping(iterations=20, orientation_weight=3.0)
        grid.append(Setting(heavy, points=9, turned="both"))
    direct = Setting(Direct())
    grid.append(replace(direct, points=17, turned="points"))
    grid.append(replace(direct, points=65, steps_per_second=1440, turned="both"))
    return grid


def full_grid() -> list[Setting]:
    """One thing at a time from each solver's base, and the combinations that promise most."""
    grid: list[Setting] = []
    for sweeping in (PositionBased, Compliant):
        grid += _around(Setting(sweeping(), gradient=True))
        grid += [
            Setting(sweeping(iterations=n), turned="iterations", gradient=n == 20)
            for n in (1, 2, 10, 20, 50, 100)
        ]
        for weight in (0.3, 3.0, 30.0):
            solver = sweeping(orientation_weight=weight)
            grid.append(Setting(solver, turned="frames", gradient=weight == 3))
        for n, substeps, weight, points, rate in (
            (1, 16, 0.03, 33, 360),
            (5, 16, 0.03, 9, 360),
            (20, 1, 3.0, 9, 360),
            (20, 1, 30.0, 9, 360),
            (5, 4, 30.0, 9, 360),
            (20, 1, 3.0, 17, 360),
            (20, 1, 30.0, 17, 360),
            (5, 16, 30.0, 17, 360),
            (100, 1, 30.0, 17, 360),
        ):
            solver = sweeping(iterations=n, substeps=substeps, orientation_weight=weight)
            wanted = (n, weight, points) == (20, 30.0, 9)
            grid.append(Setting(solver, points, rate, turned="both", gradient=wanted))
    direct = Setting(Direct(), gradient=True)
    grid += _around(direct)
    two = Direct(newton_steps=2)
    grid.append(replace(direct, solver=two, turned="Newton steps", gradient=False))
    for inertia in (1e-2, 1e-3, 1e-6):
        grid.append(Setting(Direct(frame_inertia=inertia), turned="frames"))
    for points in (9, 17, 65, 129):
        for rate in (90, 180, 720, 1440):
            wanted = (points, rate) in ((17, 90), (65, 1440))
            grid.append(replace(direct, points=points, steps_per_second=rate, turned="both",
                                gradient=wanted))  # fmt: skip
    for points, rate in ((65, 2880), (129, 2880)):
        grid.append(Setting(Direct(), points, rate, turned="both"))
    for points, rate in ((65, 1440), (129, 2880)):
        grid.append(Setting(Direct(newton_steps=2), points, rate, "float64", turned="both"))
    return grid


def _around(base: Setting) -> list[Setting]:
    """The base, and its substeps, time step, points and dtype turned one at a time."""
    direct = isinstance(base.solver, Direct)
    grid = [base]
    for n in (2, 4, 16):
        solver = replace(base.solver, substeps=n)  # type: ignore[type-var]
        grid.append(replace(base, solver=solver, turned="substeps", gradient=False))
    for rate in (90, 180, 720, 1440, 2880):
        wanted = direct and rate in (90, 1440)
        grid.append(replace(base, steps_per_second=rate, turned="time step", gradient=wanted))
    for points in (9, 17, 65, 129):
        wanted = direct and points in (9, 17, 65)
        grid.append(replace(base, points=points, turned="points", gradient=wanted))
    grid.append(replace(base, dtype="float64", turned="dtype", gradient=False))
    return grid
