"""A scene: strands, their fibre and bonds, and the phases that they go through. Plain data."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhair import check
from jaxhair.bonds import Bonds
from jaxhair.effects import Effect, names, of_kind
from jaxhair.fibre import Fibre, PhysicalFibre
from jaxhair.forces import TipForce
from jaxhair.holding import Wound
from jaxhair.pytree import pytree, static
from jaxhair.solvers import PositionBased, Solver
from jaxhair.strands import Strands

MOST_STEPS = 10**7
"""Of a phase."""


@pytree
class Phase:
    """A stretch of time in which the same effects act.

    Arguments:
        name: by which the phase's end is found in results, and its numbers in `named_leaves`.
        duration: [s]; rounded to whole time steps, at least one.
        effects: what acts on the hair. What is not listed here is not computed.
    """

    name: str = static()
    duration: float = static()
    effects: tuple[Effect, ...] = ()

    def __post_init__(self) -> None:
        check.text("phase.name", self.name)
        duration = check.constant(f"phase {self.name!r}.duration", self.duration)
        object.__setattr__(self, "duration", duration)
        effects = check.several(f"phase {self.name!r}.effects", self.effects, Effect)
        object.__setattr__(self, "effects", effects)

    def steps(self, dt: float) -> int:
        """Number of time steps."""
        return max(1, round(self.duration / dt))


@pytree
class Scene:
    """All that a simulation needs.

    Arguments:
        strands: the hair as it starts. bonds: their influence.
        fibre: its stiffness. None, which stands for the fibre of the solver's kind: a `Fibre` for
            `PositionBased`, a `PhysicalFibre` for the compliant solvers.
        phases: what happens, in order; names must differ.
        solver: of the strands' elasticity. `Compliant` and `Direct` need a `PhysicalFibre`.
        dt: time step [s].

    Every number is a leaf of the pytree, to be traced, differentiated and fitted; counts and
    choices are static. Computation is done in the dtype of `strands.positions`.
    """

    strands: Strands
    fibre: Any = None
    bonds: Bonds = Bonds()
    phases: tuple[Phase, ...] = ()
    solver: Solver = PositionBased()
    dt: float = static(default=1 / 360)

    def __post_init__(self) -> None:
        check.instance("scene.strands", self.strands, Strands)
        check.instance("scene.bonds", self.bonds, Bonds)
        check.instance("scene.solver", self.solver, Solver)
        if self.fibre is None:
            fitting = PhysicalFibre() if self.solver.compliant else Fibre()
            object.__setattr__(self, "fibre", fitting)
        if self.solver.compliant and isinstance(self.fibre, Fibre):
            raise ValueError(
                f"scene.fibre is a Fibre, whose k has no unit; with {type(self.solver).__name__} "
                "it must be a PhysicalFibre"
            )
        damping = getattr(self.fibre, "damping_time", None)
        if not self.solver.compliant and damping is not None:
            raise ValueError(
                f"fibre.damping_time is {check.short(damping)}; with "
                f"{type(self.solver).__name__}, which does not compute it, it must be None"
            )
        if not isinstance(self.fibre, PhysicalFibre):
            check.instance("scene.fibre", self.fibre, Fibre)
        object.__setattr__(self, "phases", check.several("scene.phases", self.phases, Phase))
        object.__setattr__(self, "dt", check.constant("scene.dt", self.dt))
        names = [phase.name for phase in self.phases]
        for phase in self.phases:
            if names.count(phase.name) > 1:
                raise ValueError(f"scene.phases has {phase.name!r} twice; names must differ")
            if (steps := phase.steps(self.dt)) > MOST_STEPS:
                raise ValueError(
                    f"phase {phase.name!r}.duration is {phase.duration:g} s, {steps:.3g} steps of "
                    f"scene.dt, {self.dt:g} s; a phase must have at most {MOST_STEPS:.0e}"
                )
        self._check_bonds()
        self._check_forces()
        self._check_rods()

    def _check_bonds(self) -> None:
        strands, inner = self.strands.count, self.strands.points - 2
        for name in ("influence", "fraction"):
            value = getattr(self.bonds, name)
            if len(np.shape(value)) > 1:
                allowed = (strands, 4) if len(np.shape(value)) == 2 else (strands, inner, 4)
                check.shape(f"bonds.{name}", value, allowed)
        for name, value in vars(self.fibre).items():
            if value is not None and check.size(name, value) not in ((), (1,), (strands,)):
                check.shape(f"fibre.{name}", value, (strands,))

    def _check_forces(self) -> None:
        for phase in self.phases:
            if of_kind(phase.effects, TipForce) and isinstance(self.fibre, Fibre):
                raise ValueError(
                    f"phase {phase.name!r} has a TipForce, in newton, and scene.fibre is a Fibre, "
                    "which has no mass; it must be a PhysicalFibre"
                )

    def _check_rods(self) -> None:
        longest = check.known(self.strands.lengths)
        for phase in self.phases:
            for wound in of_kind(phase.effects, Wound):
                diameter = check.known(wound.diameter)
                if longest is not None and diameter is not None and longest.max() >= diameter:
                    raise ValueError(
                        f"phase {phase.name!r}: Wound.diameter is {float(diameter):g} m and the "
                        f"longest edge {longest.max():g} m; the edges must be shorter than the "
                        "rod is thick: take more points on a strand"
                    )

    @property
    def dtype(self) -> Any:
        """Of the computation: that of the strands' positions."""
        return jnp.asarray(self.strands.positions).dtype

    @property
    def duration(self) -> float:
        """Simulated time of all phases [s]."""
        return sum(phase.steps(self.dt) for phase in self.phases) * self.dt

    def then(self, *phases: Phase) -> "Scene":
        """This scene with further phases behind its own."""
        return replace(self, phases=(*self.phases, *phases))

    def first(self, seconds: float) -> "Scene":
        """This scene up to a simulated time [s], above 0."""
        seconds = check.constant("seconds", seconds)
        kept: list[Phase] = []
        left = round(seconds / self.dt)
        if left == 0:
            raise ValueError(f"seconds is {seconds}; it must be at least a time step, {self.dt:g}")
        for phase in self.phases:
            if (steps := min(left, phase.steps(self.dt))) > 0:
                kept.append(replace(phase, duration=steps * self.dt))
            left -= steps
        return replace(self, phases=tuple(kept))

    def phase(self, name: str) -> Phase:
        """The phase of a name. Raises ValueError if there is none."""
        names = [phase.name for phase in self.phases]
        if not names:
            raise ValueError(f"phase is {check.short(name)}; the scene has no phases")
        check.choice("phase", name, names)
        return self.phases[names.index(name)]

    def as_arrays(self) -> "Scene":
        """This scene with every number as an array of the scene's dtype."""
        return jax.tree.map(lambda x: jnp.asarray(x, self.dtype), self)

    def __str__(self) -> str:
        size = f"{self.strands.count} strands of {self.strands.points} points"
        lines = [
            f"{size}, dt {self.dt:g} s",
            f"  {self.fibre}",
            f"  {self.bonds}",
            f"  {self.solver}",
        ]
        for phase in self.phases:
            lines.append(f"  {phase.name}: {phase.steps(self.dt)} steps")
            lines += [f"    {effect}" for effect in phase.effects]
        return "\n".join(lines)


def named_leaves(scene: Scene) -> dict[str, Any]:
    """Every number of a scene by its name, such as "phases.wind.Gravity.acceleration".

    An effect goes by its class; where a phase has several of one class, the second is "Hold2".
    """
    check.instance("scene", scene, Scene)
    leaves, _ = jax.tree_util.tree_flatten_with_path(scene)
    return {_name(path, scene): leaf for path, leaf in leaves}


def replace_leaves(scene: Scene, values: Mapping[str, Any]) -> Scene:
    """The scene with some leaves, by name, replaced. Their ranges are not checked.

    Raises ValueError for a name that the scene does not have, or a value of another shape.
    """
    check.instance("values", values, Mapping)
    names = named_leaves(scene)
    for name, value in values.items():
        if name not in names:
            raise ValueError(
                f"leaf is {check.short(name)}; it must be one of {check.listed(names)}"
            )
        check.shape(name, value, np.shape(names[name]))
        check.numbers(name, value)
    return jax.tree_util.tree_map_with_path(
        lambda path, leaf: values.get(_name(path, scene), leaf), scene
    )


def matching(name: Any, leaves: Iterable[str]) -> list[str]:
    """The leaf of a name, or all that it matches with a `*`."""
    names = list(leaves)
    if name in names or not isinstance(name, str):
        return [name] if name in names else []
    return [leaf for leaf in names if fnmatchcase(leaf, name)]


def _name(path: tuple[Any, ...], scene: Scene) -> str:
    return ".".join(_parts(path, scene))


def _parts(path: tuple[Any, ...], scene: Scene) -> Iterator[str]:
    """Names along a path into a scene; tuples are entered by phase name and effect class."""
    here: Any = scene
    inside_phase: Phase | None = None
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            here = getattr(here, key.name)
            if key.name != "effects":
                yield key.name
            continue
        item = here[key.idx] if isinstance(here, list | tuple) else None
        if isinstance(item, Phase):
            inside_phase = item
            yield item.name
        elif isinstance(item, Effect) and inside_phase is not None:
            yield names(inside_phase.effects)[key.idx]
        else:
            yield str(key.idx)
        here = item
