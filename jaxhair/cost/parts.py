"""The parts of a step, and the programs with and without each of them."""

from dataclasses import dataclass, replace
from typing import Any

from jax import Array

from jaxhair.cost import operations
from jaxhair.effects import Effect, PoseEffect, of_kind
from jaxhair.effects import names as names_of
from jaxhair.pytree import pytree, static
from jaxhair.rods import Rod
from jaxhair.scene import Scene
from jaxhair.solvers import Solver
from jaxhair.strands import State

ITSELF, REST_SHAPE, ELASTICITY = "the step itself", "bonds' rest shape", "elasticity"


@dataclass(frozen=True)
class Variant:
    """A phase of which something may have been left out.

    Arguments:
        scene: as arrays, without phases, with a solver or a stand-in.
    """

    scene: Scene
    effects: tuple[Effect, ...]


@pytree
class StandIn(Solver):
    """Takes a solver's place in a step of which a part is left out.

    Arguments:
        solver: that it stands for.
        solves: the solver solves, for a rest shape that is at hand, the frames as they are, so
            that nothing computes it; otherwise the strands stay as predicted.
    """

    solver: Any
    solves: bool = static()
    compliant: bool = static()  # type: ignore[misc]
    substeps: int = static()

    def solve(
        self, rod: Rod, state: State, positions: Array, orientations: Array, rest: Any, dt: float
    ) -> tuple[Array, Array, Array | None]:
        """See `Solver.solve`."""
        if not self.solves:
            return positions, orientations, state.forces
        q = state.orientations[1:]
        at_hand = (q, state.fractions[:, :1]) if self.compliant else q
        found: tuple[Array, Array, Array | None] = self.solver.solve(
            rod, state, positions, orientations, at_hand, dt
        )
        return found


@pytree
class StillPose(PoseEffect):
    """Takes a pose's place where it is left out: the hair stays as it is, without the solver."""

    def pose(self, rod: Rod, state: State) -> tuple[Array, Array]:
        """Positions and orientations as they are."""
        return state.positions, state.orientations


@dataclass(frozen=True)
class Plan:
    """What is measured of a phase, and how its parts follow from it.

    Arguments:
        variants: by name; "whole" and `rest` are among them.
        parts: for each part the variant with it and the one without it; without is "" for what is
            left when all else is left out.
        first: the effect that makes more than half of the operations, or "". It is left out from
            the whole, and all others from the rest, which is the whole without it, because
            differences of a few per cent would drown in its noise.
        rest: "rest", or "whole" where there is no first.
        operations: of the whole, and what each part adds to it.
    """

    variants: dict[str, Variant]
    parts: dict[str, tuple[str, str]]
    first: str
    rest: str
    operations: dict[str, float]


def plan(scene: Scene, effects: tuple[Effect, ...], state: State) -> Plan:
    """The variants and parts of a phase.

    Arguments:
        scene: as arrays, without phases. state: that its steps take.
    """
    names = names_of(effects)
    posed = bool(of_kind(effects, PoseEffect))  # a pose takes the solver's place
    idle = replace(scene, solver=_stand_in(scene.solver, solves=False))
    given = replace(scene, solver=_stand_in(scene.solver, solves=True))

    def variant(*left_out: str, scene: Scene = scene) -> Variant:
        kept: list[Effect] = []
        for effect, name in zip(effects, names, strict=True):
            if name not in left_out:
                kept.append(effect)
            elif isinstance(effect, PoseEffect):
                kept.append(StillPose())
        return Variant(scene, tuple(kept))

    def count(variant: Variant) -> float:
        return operations.of_a_step(variant.scene, variant.effects, state)

    none = variant(*names, scene=idle)
    whole = count(variant())
    counts = {ITSELF: count(none)}
    if not posed:
        shape_given = count(variant(scene=given))
        counts[REST_SHAPE] = whole - shape_given
        counts[ELASTICITY] = shape_given - count(variant(scene=idle))
    counts |= {name: whole - count(variant(name)) for name in names}
    first = next((name for name in names if counts[name] > whole / 2), "")

    rest = "rest" if first else "whole"

    variants = {"whole": variant(), rest: variant(first), ITSELF: none}
    parts = {ITSELF: (ITSELF, "")}
    if not posed:
        variants[REST_SHAPE] = variant(first, scene=given)
        variants[ELASTICITY] = variant(first, scene=idle)
        parts |= {REST_SHAPE: (rest, REST_SHAPE), ELASTICITY: (REST_SHAPE, ELASTICITY)}
    for name in names:
        if name == first:
            parts[name] = ("whole", rest)
        else:
            variants[name] = variant(first, name)
            parts[name] = (rest, name)
    return Plan(variants, parts, first, rest, counts | {"whole": whole})


def _stand_in(solver: Solver, *, solves: bool) -> StandIn:
    return StandIn(solver, solves, solver.compliant, solver.substeps)
