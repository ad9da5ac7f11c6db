"""The kinds of effects a phase can have, by what they change.

A phase of a scene lists its effects in a tuple. The step asks each for what its kind gives; what
is not in the tuple is not traced and leaves no operation behind. To add an effect, make a frozen
dataclass with `jaxhair.pytree` that derives from one or more of these classes. If it works on each
strand alone, let it say so (`Effect.each_strand_alone`): many strands are then simulated faster.
"""

from abc import abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from jax import Array

from jaxhair.pytree import pytree

if TYPE_CHECKING:
    from jaxhair.rods import Rod
    from jaxhair.strands import State


T = TypeVar("T")


class Effect:
    """Anything a phase can list.

    each_strand_alone: what it gives for a strand depends on no other strand, so that strands may be
        simulated in tiles and on several devices. Arrays of a value for each strand must then
        have the strands on the last axis, as `State` has, and may have no other axis last that
        happens to be as long. Each class says it of itself; a class that derives from it, and
        may do anything, says it again.
    """

    each_strand_alone: ClassVar[bool] = False


def of_kind(effects: Iterable[Effect], kind: type[T]) -> tuple[T, ...]:
    """The effects of one kind, in their order."""
    return tuple(effect for effect in effects if isinstance(effect, kind))


def names(effects: Iterable[Effect]) -> list[str]:
    """What effects of a phase go by: their classes; the second of one class is "Hold2"."""
    kinds = [type(effect).__name__ for effect in effects]
    return [
        kind + (str(n + 1) if (n := kinds[:i].count(kind)) else "") for i, kind in enumerate(kinds)
    ]


class VelocityEffect(Effect):
    """Changes velocities: gravity, wind, drag, hair against hair."""

    @abstractmethod
    def velocity_change(self, rod: "Rod", state: "State", dt: float) -> Array:
        """Change of velocity [m/s] over a step, shape (points, 3, strands)."""


class RememberingEffect(VelocityEffect):
    """Keeps from step to step what it can make anew from any state: lists of neighbours.

    A memory saves time and changes no result but by rounding. It belongs to the loop over steps,
    which starts without one, and not to a State.
    """

    @abstractmethod
    def blank(self, rod: "Rod", state: "State") -> Any:
        """The memory before the first step, which serves in no state; same shapes as any other."""

    @abstractmethod
    def remembered(self, rod: "Rod", state: "State", memory: Any) -> Any:
        """The memory that serves in a state: the one given, if it still does, or a new one."""

    @abstractmethod
    def recalled_change(self, rod: "Rod", state: "State", dt: float, memory: Any) -> Array:
        """The change of velocity [m/s] over a step, by a memory that serves in its state."""

    def velocity_change(self, rod: "Rod", state: "State", dt: float) -> Array:
        """The change of velocity [m/s] over a step, without a memory from before."""
        memory = self.remembered(rod, state, self.blank(rod, state))
        return self.recalled_change(rod, state, dt, memory)

    def fault(self, rod: "Rod", state: "State") -> str:
        """What of the effect does not go with a state, and what to change; "" if nothing."""
        return ""


@pytree
class Recalled(VelocityEffect):
    """What an effect with a memory changes in a step.

    Arguments:
        change: of velocity [m/s], shape (points, 3, strands).
    """

    change: Any

    def velocity_change(self, rod: "Rod", state: "State", dt: float) -> Array:
        """The change."""
        given: Array = self.change
        return given


class PositionEffect(Effect):
    """Changes predicted positions: obstacles."""

    @abstractmethod
    def projected(
        self, rod: "Rod", positions: Array, previous: Array, time: Array, dt: float
    ) -> Array:
        """Predicted positions [m] made admissible, shape (points, 3, strands).

        Arguments:
            previous: positions before the step. time: of the step's start, within the phase [s].
        """


class HoldingEffect(Effect):
    """Takes points and edges out of the solver's hands and moves them itself."""

    @abstractmethod
    def held_points(self, rod: "Rod") -> Array:
        """True at held points, shape (points, 1, strands or 1)."""

    @abstractmethod
    def held_edges(self, rod: "Rod") -> Array:
        """True at held edges, shape (edges, 1, strands or 1)."""

    @abstractmethod
    def moved(
        self, rod: "Rod", positions: Array, orientations: Array, time: Array, dt: float
    ) -> tuple[Array, Array]:
        """Positions and orientations after a step, with the held ones where they belong."""


class PoseEffect(Effect):
    """Prescribes the whole pose, so that nothing moves by itself: hair fixed on a rod."""

    @abstractmethod
    def pose(self, rod: "Rod", state: "State") -> tuple[Array, Array]:
        """The prescribed positions and orientations, given the state after bonds broke."""


class BondEffect(Effect):
    """Breaks or re-forms bonds."""

    @property
    @abstractmethod
    def kinds_cut(self) -> tuple[str, ...]:
        """The kinds of bonds whose fraction it may lower."""

    @property
    @abstractmethod
    def kinds_formed(self) -> tuple[str, ...]:
        """The kinds of bonds whose fraction it may raise."""

    @abstractmethod
    def fraction_change(
        self, kind: str, fraction: Array, rod: "Rod", state: "State", dt: float
    ) -> Array:
        """Change of one kind's bonded fraction over a step, shape (inner points, strands)."""


class StiffnessEffect(Effect):
    """Changes the fibre's stiffness while it acts."""

    @abstractmethod
    def scaled(self, stiffness: Array) -> Array:
        """The stiffness under this effect, same shape."""
