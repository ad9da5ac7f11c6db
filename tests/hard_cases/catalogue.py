"""What a hard case is, and the list of all of them.

A case is a function that builds a scene for a solver and a precision. The decorator says what
could break in it and what must hold. `README.md` beside this file is a table made from the list.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import jaxhair as jh
from jaxhair.simulate import start

SWEEPING = ("paper", "sequential", "compliant")
SOLVERS: dict[str, Any] = {
    "paper": jh.PositionBased(),
    "sequential": jh.PositionBased(sweep="sequential"),
    "compliant": jh.Compliant(),
    "direct": jh.Direct(),
}
DOWN = (0.0, 0.0, -1.0)
LENGTH = 0.24  # of most strands [m], with 9 points
STEP = 1 / 360


class Start(NamedTuple):
    """A scene of one phase, and the state it starts from."""

    scene: jh.Scene
    state: jh.State


@dataclass(frozen=True)
class Setting:
    """A solver by its name in `SOLVERS`, and a precision."""

    solver: str
    dtype: str

    @property
    def physical(self) -> bool:
        """Whether the solver needs a physical fibre."""
        return bool(SOLVERS[self.solver].compliant)

    def scene(
        self,
        hair: jh.Strands,
        *effects: Any,
        k: Any = 0.05,
        physical: jh.PhysicalFibre | None = None,
        **options: Any,
    ) -> jh.Scene:
        """A scene of one phase, in this precision.

        Arguments:
            k: the paper's stiffness, or a whole Fibre; for the paper's solver.
            physical: the fibre for the others, dry hair if not given.
            options: of Scene.
        """
        solver = options.pop("solver", SOLVERS[self.solver])
        fibre: Any = physical or jh.PhysicalFibre()
        if not solver.compliant:
            fibre = k if isinstance(k, jh.Fibre) else jh.Fibre(k)
        phases = (jh.Phase("only", 1.0, effects),)
        scene = jh.Scene(hair, fibre, phases=phases, solver=solver, **options)
        return jax.tree.map(lambda x: np.asarray(x, self.dtype), scene)


@dataclass(frozen=True)
class Case:
    """A hard case.

    Arguments:
        build: gives the scene and, where it is not at rest in the scene's pose, the state.
        breaks: what could break. holds: what must hold besides the common bounds.
        stretch: largest relative change of an edge's length at the end.
        speed: largest speed of a point at any time [m/s].
        end_speed: largest speed at the end [m/s].
        steps: of the run.
        smooth: a derivative exists and central differences must agree with it; if not, why not.
        fixed: leaves (ends of their names) that are not varied in derivatives, since they are at
            the end of their range.
        slopes: steps over which derivatives are taken.
        modes: largest difference between forward and reverse mode in float32, relative to the
            terms that are summed; 1e-5 of it in float64.
        except_for: what a solver, or "solver-precision", does not keep, and why; the other bounds
            still hold.
        check: whatever else must hold of the last state.
    """

    build: Callable[[Setting], jh.Scene | Start]
    breaks: str
    holds: str = ""
    stretch: float = 0.02
    speed: float = 5.0
    end_speed: float = np.inf
    steps: int = 360
    smooth: bool | str = True
    fixed: tuple[str, ...] = ()
    slopes: int = 8
    modes: float = 1e-4
    except_for: dict[str, dict[str, Any]] = field(default_factory=dict)
    check: Callable[[Start, jh.State], None] | None = None

    def __post_init__(self) -> None:
        known = {"why", *(f.name for f in fields(self))} - {"build", "except_for"}
        for solver, own in self.except_for.items():
            assert solver.split("-")[0] in SOLVERS
            assert own.keys() <= known
            assert "why" in own, "no exception without a reason"

    @property
    def name(self) -> str:
        return self.build.__name__

    def start(self, setting: Setting) -> Start:
        built = self.build(setting)
        return built if isinstance(built, Start) else Start(built, start(built.as_arrays()))

    def within(self, setting: Setting) -> "Case":
        """The case with the bounds of one solver, in one precision."""
        names = setting.solver, f"{setting.solver}-{setting.dtype}"
        own = {k: v for n in names for k, v in self.except_for.get(n, {}).items() if k != "why"}
        return replace(self, **own)


CASES: dict[str, Case] = {}


def hard(**options: Any) -> Callable[[Callable[[Setting], Any]], Callable[[Setting], Any]]:
    """Decorator that puts a case on the list."""

    def add(build: Callable[[Setting], Any]) -> Callable[[Setting], Any]:
        assert build.__name__ not in CASES, build.__name__
        CASES[build.__name__] = Case(build, **options)
        return build

    return add


def swept(why: str, **bounds: Any) -> dict[str, dict[str, Any]]:
    """The same exception for all solvers that sweep."""
    return {solver: {**bounds, "why": why} for solver in SWEEPING}


# What acts. Scenes alike in effects and shapes share one compiled program, so that cases differ in
# numbers where they can: a case without a ball has it far away.

HANGING = (jh.Hold(), jh.Gravity(), jh.Drag(0.2))
WEIGHTLESS = (jh.Hold(), jh.Gravity((0.0, 0.0, 0.0)), jh.Drag(0.2))
FAR = (0.0, 0.0, 1e3)
WET = jh.Bonds(fraction=(0.5, 1.0, 1.0, 1.0))


def blown(blower: Any, target: Any, strength: float) -> tuple[Any, ...]:
    """Hair hanging in a drying wind."""
    return (*HANGING, jh.DryingWind(blower, target, strength))


def treated(cut: float, formed: float, rate: float = 1e9, softened: float = 1.0) -> tuple[Any, ...]:
    """Hair hanging while hydrogen bonds are cut and formed and its stiffness is scaled."""
    return (
        *HANGING,
        jh.Cut(hydrogen=cut, rate=rate),
        jh.Reform(hydrogen=formed, rate=rate),
        jh.Soften(softened),
    )


def among(
    *,
    floor: tuple[float, float] = (-1e3, 0.0),
    ball: tuple[Any, float] = (FAR, 1.0),
    rod: tuple[Any, Any, float] = (FAR, (0.0, 1.0, 0.0), 1.0),
    rod_moves: tuple[Any, Any] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    friction: float = 0.3,
    root_moves: tuple[Any, Any] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
) -> tuple[Any, ...]:
    """Hair hanging from roots that move, with a floor, a ball and a rod.

    Arguments:
        floor: height, friction. ball: centre, radius. rod: centre, axis, radius; it is 1 m long.
        rod_moves, root_moves: velocity and angular velocity.
    """
    hold = jh.Hold(velocity=root_moves[0], angular_velocity=root_moves[1], centre=(0, 0, 0))
    things = (
        jh.Floor(*floor),
        jh.Sphere(*ball, friction),
        jh.Cylinder(*rod, friction, 1.0, velocity=rod_moves[0], angular_velocity=rod_moves[1]),
    )
    return (hold, *HANGING[1:], *things)


def straight(direction: Any = DOWN, *, strands: int = 2, points: int = 9) -> jh.Strands:
    """Straight strands 1 cm apart."""
    roots = np.zeros((strands, 3))
    roots[:, 1] = 0.01 * np.arange(strands)
    return jh.Strands.straight(roots, direction, length=LENGTH, points=points, dtype="float64")


_from_points = jax.jit(jh.Strands.from_points)


def through(points: Any) -> jh.Strands:
    """Two strands through the same points [m], shape (points, 3), 1 cm apart; free of stress."""
    one = np.asarray(points, float)
    return _from_points(np.stack([one, one + np.array([0.0, 0.01, 0.0])]))


def helix(*, radius: float = 0.01, pitch: float = 0.01, points: int = 9) -> np.ndarray:
    """Points of a helix about -z, 3 cm apart along it at 9 points, shape (points, 3)."""
    turn = LENGTH / np.hypot(2 * np.pi * radius, pitch) * np.linspace(0, 1, points)
    angle = 2 * np.pi * turn
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), -pitch * turn], 1)


def moved(scene: jh.Scene, **parts: Any) -> Start:
    """The scene's start with some arrays of the state replaced."""
    state = start(scene.as_arrays())
    cast = {k: jnp.asarray(v, scene.dtype) for k, v in parts.items()}
    for name, value in cast.items():
        assert value.shape == getattr(state, name).shape, name
    return Start(scene, replace(state, **cast))
