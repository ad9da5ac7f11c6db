"""The residuals of a fit, and their derivatives, as functions of the free numbers."""

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.parameters import Parameters
from fitting.targets import PointTarget, Target
from jaxhair import Scene, State, check, run
from jaxhair.checkpoints import Checkpoints
from jaxhair.strands import strands_last

States = dict[str, dict[str, Any]]
"""Of each state what was simulated: "residuals", and "points" [m], shape (points, 3, strands)."""


class Problem:
    """Residuals in standard errors, and their Jacobian.

    Arguments:
        parameters: the freed numbers.
        targets: of each experiment, from a phase to what is wanted at its end.
        noise: standard error of points whose target gives none [m].
        prior_width: standard deviation of every free number about its start.
        prior: of a parameter's values, by its name: mean and standard deviation, each of the
            value's shape or one number.

    Attributes:
        states: the targets by name, "experiment/phase" or the phase of the only experiment.
    """

    def __init__(
        self,
        parameters: Parameters,
        targets: Mapping[str, Mapping[str, Target]],
        *,
        noise: float,
        prior_width: float = np.inf,
        prior: Mapping[str, tuple[Any, Any]] | None = None,
    ) -> None:
        self.parameters = parameters
        self.noise, self.prior_width = noise, prior_width
        self.places = {
            f"{experiment}/{phase}" if experiment else phase: (experiment, phase)
            for experiment, phases in targets.items()
            for phase in phases
        }
        self.states = {s: targets[at][phase] for s, (at, phase) in self.places.items()}
        self.prior = dict(prior or {})
        self.start = parameters.packed()
        self._evaluate = jax.jit(self._residuals_and_jacobian)
        self._last: tuple[bytes, Any] = (b"", None)
        self._journal: Checkpoints | None = None
        self._known: dict[bytes, Any] = {}
        shapes = jax.eval_shape(self.simulated, self.start, self.states)
        self.size = sum(s["residuals"].size for s in shapes.values())
        """Number of residuals that come from the data; the others are the prior's."""

    def keep_in(self, journal: Checkpoints) -> None:
        """Keeps every evaluation, and takes those that were kept before instead of simulating."""
        self._journal = journal
        for part in journal.parts:
            states = {
                name: {key: part[f"{key} {name}"] for key in ("residuals", "points")}
                for name in self.states
            }
            self._known[part["point"].tobytes()] = (part["residuals"], part["jacobian"], states)

    def program(self) -> str:
        """The compiled program, as text."""
        return str(self._evaluate.lower(self.start, self.states).as_text())

    def with_targets(self, targets: Mapping[str, Mapping[str, Target]]) -> "Problem":
        """The same problem with other numbers wanted, which shares the compiled program.

        Raises ValueError for targets of other states or kinds.
        """
        states = {name: targets[at][phase] for name, (at, phase) in self.places.items()}
        number = sum(len(phases) for phases in targets.values())
        kinds: Any = jax.tree.structure(states)
        if number != len(states) or kinds != jax.tree.structure(self.states):
            raise ValueError("targets are of other states or kinds; they must be as in the fit")
        other = copy(self)
        other.states, other._last, other._journal, other._known = states, (b"", None), None, {}
        return other

    def lengths(self, experiment: str) -> Array:
        """Rest lengths [m], shape (points - 1, 1, strands or 1)."""
        scene = self.parameters.scenes[experiment]
        return strands_last(jnp.asarray(scene.strands.lengths, scene.dtype))[:, None]

    def simulated(self, free: Array, targets: Mapping[str, Target]) -> States:
        """Every state, with its residuals in standard errors."""
        ends = ends_of(self.parameters.apply(free))
        found = {}
        for name, target in targets.items():
            experiment, phase = self.places[name]
            state = ends[experiment][phase]
            error = self.noise if target.error is None else target.error
            residuals = target.residuals(state, self.lengths(experiment))
            found[name] = {
                "residuals": residuals / jnp.asarray(error, residuals.dtype),
                "points": state.positions,
            }
        return found

    def residuals(self, free: Array, targets: Mapping[str, Target]) -> tuple[Array, States]:
        """All residuals in standard errors, shape (n,), and the states.

        The last ones are the prior's: the distances of free numbers from their start, and of
        values from what was known of them.
        """
        states = self.simulated(free, targets)
        parts = [s["residuals"].ravel() for s in states.values()]
        if np.isfinite(self.prior_width):
            parts.append((free - self.start) / self.prior_width)
        if self.prior:
            values = self.parameters.values(free)
            for name, (mean, deviation) in self.prior.items():
                mean, deviation = (jnp.asarray(x, free.dtype) for x in (mean, deviation))
                parts.append(jnp.ravel((values[name] - mean) / deviation))
        return jnp.concatenate(parts), states

    def _residuals_and_jacobian(self, free: Array, targets: Mapping[str, Target]) -> Any:
        """One primal run, and its derivative in all directions at once.

        `jax.linearize` takes a fifth longer to compile.
        """

        def residuals_at(free: Array) -> tuple[Array, States]:
            return self.residuals(free, targets)

        def along(direction: Array) -> Any:
            return jax.jvp(residuals_at, (free,), (direction,), has_aux=True)

        directions = jnp.eye(free.size, dtype=free.dtype)
        return jax.vmap(along, out_axes=(None, -1, None))(directions)

    def evaluate(self, free: np.ndarray) -> tuple[np.ndarray, np.ndarray, States]:
        """Residuals, their Jacobian, shape (n, free numbers), and the states.

        One compiled program for all; the last result is kept, since optimisers ask for the
        residuals and for the Jacobian of the same point one after the other.
        """
        point = jnp.asarray(free, self.start.dtype)
        key = np.asarray(point).tobytes()
        if self._last[0] != key:
            self._last = (key, self._known.get(key) or self._new(point))
        found: tuple[np.ndarray, np.ndarray, States] = self._last[1]
        return found

    def _new(self, point: Array) -> tuple[Any, Any, Any]:
        """What `evaluate` gives, simulated, and kept if there is a journal."""
        residuals, jacobian, states = jax.tree.map(np.asarray, self._evaluate(point, self.states))
        residuals, jacobian = residuals.astype(float), jacobian.astype(float)
        if self._journal is not None:
            arrays = {"point": np.asarray(point), "residuals": residuals, "jacobian": jacobian}
            for name, state in states.items():
                arrays |= {f"{key} {name}": value for key, value in state.items()}
            self._journal.add(arrays)
        return residuals, jacobian, states

    def wanted(self, name: str) -> Array | None:
        """Points that a state's target wants [m], shape (points, 3, strands); None if it wants
        other numbers."""
        target, (experiment, _) = self.states[name], self.places[name]
        if not isinstance(target, PointTarget):
            return None
        count = self.parameters.scenes[experiment].strands.count
        points = target.points(self.lengths(experiment), count)
        return points - jnp.mean(points, axis=0, keepdims=True) if target.align else points


def ends_of(scenes: Mapping[str, Scene]) -> dict[str, dict[str, State]]:
    """`jaxhair.run` of each scene; those that differ in numbers alone are simulated together."""
    alike: dict[Any, list[str]] = {}
    unnamed = {}
    for name, scene in scenes.items():
        phases = tuple(replace(p, name=str(i)) for i, p in enumerate(scene.phases))
        unnamed[name] = replace(scene, phases=phases).as_arrays()
        leaves, structure = jax.tree.flatten(unnamed[name])
        shapes = tuple((jnp.shape(x), jnp.result_type(x)) for x in leaves)
        alike.setdefault((structure, shapes), []).append(name)
    ends: dict[str, dict[str, State]] = {}
    for names in alike.values():
        if len(names) == 1:
            found = [run(unnamed[names[0]])]
        else:
            together = jax.tree.map(lambda *x: jnp.stack(x), *(unnamed[name] for name in names))
            all_ends = jax.vmap(run)(together)
            found = [jax.tree.map(lambda x, i=i: x[i], all_ends) for i in range(len(names))]
        for name, states in zip(names, found, strict=True):
            phases = scenes[name].phases
            ends[name] = {p.name: states[str(i)] for i, p in enumerate(phases)}
    return ends


def checked(scenes: Mapping[str, Scene], targets: Any) -> dict[str, dict[str, Target]]:
    """Targets by experiment and phase; those of a single scene may be by phase alone.

    Raises ValueError for experiments, phases and targets that are none.
    """
    check.instance("targets", targets, Mapping)
    if not targets:
        raise ValueError("targets is empty; it must name at least one phase")
    by_experiment = {"": targets} if list(scenes) == [""] else targets
    found: dict[str, dict[str, Target]] = {}
    for experiment, phases in by_experiment.items():
        check.choice("an experiment of targets", experiment, tuple(scenes))
        check.instance(f"targets[{experiment!r}]", phases, Mapping)
        found[experiment] = {}
        for phase, target in phases.items():
            scenes[experiment].phase(phase)
            check.instance(f"targets[{phase!r}]", target, Target)
            if any(leaf is target for leaf in jax.tree.leaves(target)):
                wanted = "its class must be decorated with jaxhair.pytree"
                raise ValueError(f"targets[{phase!r}] is no pytree; {wanted}")
            found[experiment][phase] = target
    if not any(found.values()):
        raise ValueError("targets names no phase; it must name at least one")
    return found
