"""Time, operations and memory of a scene's step, and what each part adds to them."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhair import check
from jaxhair.cost.parts import Plan, Variant, plan
from jaxhair.progress import each
from jaxhair.recording import simulate
from jaxhair.scene import Phase, Scene
from jaxhair.simulate import phase_end, start
from jaxhair.strands import State
from jaxhair.tiles import couples

BAR = 0.15
"""Within this part of it, the parts must add up to the measured whole."""

ENOUGH = 2.0
"""Seconds after which a program has been timed enough."""


@dataclass(frozen=True)
class Part:
    """What something takes, or adds to what the rest takes; a difference can be below 0.

    Arguments:
        name: such as "HairContact".
        seconds: wall time of one step [s].
        operations: on floating-point numbers in one step, as traced; NaN where nothing counts them.
        memory: temporaries of the program [bytes]; None where the compiler does not say.
        compile_seconds: of the program, tracing included; measured once.
    """

    name: str
    seconds: float
    operations: float
    memory: int | None
    compile_seconds: float


@dataclass(frozen=True)
class PhaseCost:
    """Cost of a step in phases that were measured as one, the first.

    Arguments:
        phases: their names. steps: of all of them.
        whole: the step. parts: what each part of it adds.
        first: the effect that makes more than half of the operations, or "". It is left out from
            the whole, and all others from the rest, in whose noise they do not drown.
        rest: seconds of a step without the first.
        noise: how much the rest's time differed when it was measured twice [s]. Programs that
            do the same in another order differ by a little more.
        derivatives: of all the steps measured, over a step, in forward mode along one direction
            and in reverse mode in all numbers of the scene; empty where they were not asked for.
    """

    phases: tuple[str, ...]
    steps: int
    whole: Part
    parts: tuple[Part, ...]
    first: str
    rest: float
    noise: float
    derivatives: tuple[Part, ...] = ()

    @property
    def total_seconds(self) -> float:
        """Sum over the parts [s]."""
        return sum(part.seconds for part in self.parts)

    @property
    def total_operations(self) -> float:
        """Sum over the parts."""
        return sum(part.operations for part in self.parts)

    @property
    def share(self) -> float:
        """The parts' sum of seconds over the measured whole."""
        return self.total_seconds / self.whole.seconds

    @property
    def share_of_rest(self) -> float:
        """The same without the first."""
        first = sum(part.seconds for part in self.parts if part.name == self.first)
        return (self.total_seconds - first) / self.rest

    @property
    def adds_up(self) -> bool:
        """Both are within `BAR` of 1."""
        return abs(self.share - 1) <= BAR and abs(self.share_of_rest - 1) <= BAR


@dataclass(frozen=True, eq=False)
class SceneCost:
    """Cost of a step in all phases of a scene.

    Arguments:
        scene: that was measured. phases: their costs.
        measured_steps: in each timed call. repeat: most calls, of which the fastest counts.
    """

    scene: Scene
    phases: tuple[PhaseCost, ...]
    measured_steps: int
    repeat: int

    @property
    def seconds(self) -> float:
        """Wall time of the whole scene [s], without compilation."""
        return sum(phase.whole.seconds * phase.steps for phase in self.phases)

    @property
    def times_real_time(self) -> float:
        """Simulated time over wall time."""
        return self.scene.duration / self.seconds

    def __str__(self) -> str:
        from jaxhair.cost.table import text

        return text(self)


def measured(
    scene: Scene,
    *,
    steps: int = 16,
    repeat: int = 200,
    gradients: bool = False,
    progress: bool = False,
) -> SceneCost:
    """Time, operations and memory of a step of each phase, and what each part adds to them.

    A part's cost is the step's with it less the step's without it. Each is a compiled loop of
    steps; the loops of a phase take turns, and of each the fastest of several calls counts.
    Hair against hair takes longer where hair is denser or moves faster: a scene with an effect
    that couples strands is simulated first, and each phase measured from its own start. Otherwise
    where hair is changes no time: all start from the scene's first state, and phases with the
    same kinds of effects are measured once.

    Arguments:
        steps: of a loop.
        repeat: how often each is called; one that has taken `ENOUGH` seconds and was called five
            times is called no more.
        gradients: measure derivatives of the whole too.
        progress: show a progress bar on stderr.

    Raises ValueError for a scene without phases, and NotFinite where simulating it gives values
    that are NaN or infinite.
    """
    check.instance("scene", scene, Scene)
    check.whole("steps", steps, least=1, most=100_000)
    check.whole("repeat", repeat, least=1)
    check.flag("gradients", gradients)
    check.flag("progress", progress)
    if not scene.phases:
        raise ValueError("scene.phases is (); it must have at least one phase")
    numbers = scene.as_arrays()
    coupled = any(couples(phase.effects) is not None for phase in numbers.phases)
    groups = [[phase] for phase in numbers.phases] if coupled else _alike(numbers.phases)
    states = _starts(numbers, progress) if coupled else [start(numbers)] * len(groups)
    bare, programs = replace(numbers, phases=()), dict[Any, _Program]()
    costs = tuple(
        _phase_cost(_Bench(state, steps, repeat, programs), bare, phases, gradients)
        for phases, state in each(
            list(zip(groups, states, strict=True)),
            "measuring",
            unit="phase",
            shown=progress,
            said=lambda of: of[0][0].name,
        )
    )
    return SceneCost(scene, costs, steps, repeat)


def _alike(phases: Sequence[Phase]) -> list[list[Phase]]:
    """Phases by the classes of their effects."""
    groups: dict[tuple[type, ...], list[Phase]] = {}
    for phase in phases:
        groups.setdefault(tuple(type(e) for e in phase.effects), []).append(phase)
    return list(groups.values())


def _starts(scene: Scene, progress: bool) -> list[State]:
    """The state that each phase starts from.

    By `simulate` and not by `run`, which compiles a program for each number of steps, shows no
    progress and does not tell of NaN.
    """
    longest = max(phase.steps(scene.dt) for phase in scene.phases)
    rare = 0.5 / (longest * scene.dt)  # frames a second: only at the ends of phases
    before = replace(scene, phases=scene.phases[:-1])
    recording = simulate(before, fps=rare, observe=lambda state: state, progress=progress)
    if not recording.complete:
        raise KeyboardInterrupt
    of_phase = [
        jax.tree.map(lambda x, i=i: x[i], recording.observed) for i in range(len(scene.phases))
    ]
    return jax.tree.map(jnp.asarray, of_phase)


@dataclass(frozen=True)
class _Program:
    """A compiled loop of steps."""

    call: Callable[..., Any]
    memory: int | None
    compile_seconds: float


@dataclass(frozen=True)
class _Bench:
    """Where programs are compiled, once each, and timed.

    Arguments:
        state: before the first step. steps: of a loop. repeat: most calls of it.
        programs: compiled so far, by what they compute and their arguments' structure and shapes.
    """

    state: State
    steps: int
    repeat: int
    programs: dict[Any, _Program]

    def program(self, variant: Variant) -> _Program:
        return self.compiled("steps", phase_end.lower, variant, steps=self.steps, kernels=True)

    def compiled(
        self, name: str, lower: Callable[..., Any], variant: Variant, **options: int
    ) -> _Program:
        leaves, tree = jax.tree.flatten((variant.scene, variant.effects))
        key = name, tree, tuple(np.shape(leaf) for leaf in leaves)
        if key not in self.programs:
            begin = time.perf_counter()
            program = lower(variant.scene, variant.effects, self.state, **options).compile()
            taken = time.perf_counter() - begin
            analysis = program.memory_analysis()
            memory = None if analysis is None else int(analysis.temp_size_in_bytes)
            self.programs[key] = _Program(program, memory, taken)
        return self.programs[key]

    def seconds(self, calls: dict[str, tuple[_Program, Variant]]) -> dict[str, float]:
        """Shortest time of a step of each program, but for the first call; they take turns."""
        taken: dict[str, list[float]] = {name: [] for name in calls}
        order = list(calls)
        for _ in range(self.repeat + 1):
            for name in order:
                if len(taken[name]) > 5 and sum(taken[name]) > ENOUGH:
                    continue
                program, variant = calls[name]
                begin = time.perf_counter()
                end = program.call(variant.scene, variant.effects, self.state)
                jax.block_until_ready(end)  # type: ignore[no-untyped-call]
                taken[name].append(time.perf_counter() - begin)
            order.reverse()
        return {name: min(times[1:]) / self.steps for name, times in taken.items()}

    def derivatives(self, variant: Variant) -> dict[str, tuple[_Program, Variant]]:
        """Programs of the loop's derivatives, in forward and in reverse mode."""

        def end(*arguments: Any) -> Any:
            return phase_end(*arguments, steps=self.steps)

        def forward(*arguments: Any) -> Any:
            return jax.jvp(end, arguments, arguments)

        def reverse(*arguments: Any) -> Any:
            return jax.grad(lambda *x: end(*x).positions.mean(), argnums=(0, 1))(*arguments)

        return {
            name: (self.compiled(name, jax.jit(function).lower, variant), variant)
            for name, function in (("forward mode", forward), ("reverse mode", reverse))
        }


def _phase_cost(bench: _Bench, scene: Scene, phases: Sequence[Phase], gradients: bool) -> PhaseCost:
    made: Plan = plan(scene, phases[0].effects, bench.state)
    calls = {name: (bench.program(variant), variant) for name, variant in made.variants.items()}
    derivatives = bench.derivatives(made.variants["whole"]) if gradients else {}
    again = "measured again"
    # What leaves few caches as they were must not come before what is a hundred times as fast.
    long = {"whole": calls["whole"]} if made.first else {}
    short = {name: call for name, call in calls.items() if name not in long}
    taken = bench.seconds(short | {again: calls[made.rest]})
    taken |= bench.seconds(long) | bench.seconds(derivatives)

    def part(name: str, with_it: str, without: str = "") -> Part:
        program = (calls | derivatives)[with_it][0]
        operations = made.operations.get(name, float("nan"))
        seconds, memory, compiled = taken[with_it], program.memory, program.compile_seconds
        if without:
            other = calls[without][0]
            seconds, compiled = seconds - taken[without], compiled - other.compile_seconds
            known = memory is not None and other.memory is not None
            memory = memory - other.memory if known else None  # type: ignore[operator]
        return Part(name, seconds, operations, memory, compiled)

    return PhaseCost(
        phases=tuple(phase.name for phase in phases),
        steps=sum(phase.steps(scene.dt) for phase in phases),
        whole=part("whole", "whole"),
        parts=tuple(part(name, *pair) for name, pair in made.parts.items()),
        first=made.first,
        rest=taken[made.rest],
        noise=abs(taken[made.rest] - taken[again]),
        derivatives=tuple(part(name, name) for name in derivatives),
    )
