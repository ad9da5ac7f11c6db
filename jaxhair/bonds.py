"""Side-chain bonds: the rest shape they make, what they remember, how they break and re-form."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.effects import BondEffect
from jaxhair.pytree import pytree
from jaxhair.rods import Rod
from jaxhair.stored import once, stored
from jaxhair.strands import BONDS, State
from jaxhair.sums import spread, summed

TINY = 2.0**-60
"""Below it the slope of 1 / x, which is x^-2, comes near what float32 holds."""


@pytree
class Bonds:
    """Influence and first state of the four kinds: hydrogen, ionic, disulfide, peptide.

    Arguments:
        influence: f_j, what each kind holds when all of it is bonded; only ratios matter. Shape
            (4,), or (strands, 4), or (strands, points - 2, 4).
        fraction: b_j at the start, in [0, 1]; of the same shapes.

    The defaults are the paper's table 1: hydrogen 33 %, with ionic 63 %, disulfide 20 %, peptide
    17 %. Raises ValueError for influences below 0 or all next to 0, and fractions outside [0, 1].
    """

    influence: Any = (0.33, 0.30, 0.20, 0.17)
    fraction: Any = (1.0, 1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        for name in ("influence", "fraction"):
            shape = check.size(f"bonds.{name}", getattr(self, name))
            if shape[-1:] != (len(BONDS),) or len(shape) > 3:
                check.shape(f"bonds.{name}", getattr(self, name), (len(BONDS),))
        check.not_negative("bonds.influence", self.influence, many=True)
        check.fraction("bonds.fraction", self.fraction, many=True)
        f = check.known(self.influence)
        if f is not None and np.any(few := f.max(axis=-1, initial=0) < TINY):
            raise ValueError(
                f"bonds.influence is {f[few][0].tolist()}; one must be at least {TINY:.0e}"
            )


def per_inner_point(x: Any) -> Array:
    """Shape (4,), (strands, 4) or (strands, inner, 4) to (inner or 1, 4, strands or 1)."""
    x = jnp.asarray(x)
    x = x.reshape((1,) * (2 - x.ndim) + x.shape) if x.ndim < 2 else x
    x = x[:, None] if x.ndim == 2 else x
    return jnp.moveaxis(x, 0, -1)


@once
def rest_shape(shapes: Array, fractions: Array, influence: Array, r: Array) -> Array:
    """Omega_o = sum_j f_j {Omega_j + (1 - b_j)(Omega - Omega_j)} / sum_j f_j (Eq. 15).

    Springs in parallel: Omega - Omega_o = sum_j f_j b_j (Omega - Omega_j) / sum_j f_j. For each
    kind the present shape is first brought to the hemisphere of what that kind remembers.

    Arguments:
        shapes: Omega_j, shape (inner points, 4, 3, strands).
        fractions: b_j, shape (inner points, 4, strands).
        influence: f_j, shape (inner points or 1, 4, strands or 1).
        r: conj(q1) q2, whose vector part is Omega, shape (inner points, 4, strands).
    Returns Omega_o, shape (inner points, 3, strands).
    """
    share = influence / spread(summed(influence), len(BONDS))
    r = stored(r)
    held = []
    shape, fraction, part = map(_of_kind, (shapes, fractions, share))
    for j in range(len(BONDS)):
        kept, cut = shape(j), 1 - fraction(j)[:, None]
        bent = stored(present_shape(r, kept)) - kept
        held.append(quat.scaled(kept + quat.scaled(bent, cut), part(j)[:, None]))
    return sum(held[1:], held[0])


@once
def springs(shapes: Array, fractions: Array, influence: Array) -> tuple[Array, Array]:
    """(Eq. 15) as one spring: Omega - Omega_o = share (Omega - shape).

    shape = sum_j f_j b_j Omega_j / sum_j f_j b_j, free of stress, and
    share = sum_j f_j b_j / sum_j f_j, the part of the whole stiffness that is bonded. Where all
    bonds are cut, or but for next to nothing, the share is 0 and the shape straight.

    Arguments: as in `rest_shape`.
    Returns shape as unit quaternions, shape (inner points, 4, strands), and share, shape (inner
    points, 1, strands).
    """
    bonded = influence * fractions
    whole = summed(bonded)
    share = whole / summed(influence)
    cut = share <= _nothing(share)
    share = share - jnp.where(cut, lax.stop_gradient(share), 0)  # 0 if cut, with its slope
    part, one = _of_kind(bonded), _of_kind(shapes)
    each = [quat.scaled(one(j), part(j)[:, None]) for j in range(len(BONDS))]
    shape = sum(each[1:], each[0]) / spread(jnp.where(cut, 1, whole), 3)
    return quat.from_vector_part(shape), share


def _of_kind(x: Array) -> Callable[[int], Array]:
    """Each kind's part of x, of shape (inner points, 4, ..., strands), by its place in `BONDS`."""
    parts = lax.split(x, (1,) * len(BONDS), axis=1)
    return lambda j: stored(jnp.squeeze(parts[j], 1))


def _nothing(x: Array) -> float:
    """A share of bonds that holds nothing, below rounding by as much again. Divided by less, shapes
    have slopes that overflow."""
    return float(np.finfo(x.dtype).eps) ** 2


def present_shape(r: Array, remembered: Array) -> Array:
    """Omega, the vector part of r or of -r, whichever is nearer to a remembered shape.

    Arguments:
        r: conj(q1) q2, shape (..., 4, strands). remembered: Omega_j, shape (..., 3, strands).
    """
    return quat.same_hemisphere(r, quat.from_vector_part(remembered)) * r[..., 1:, :]


@once
def remembered(shape: Array, fraction: Array, rise: Array, r: Array) -> Array:
    """Omega_j <- (b_j Omega_j + db_j Omega) / (b_j + db_j) where db_j > 0 (Eq. 16).

    Where b_j + db_j is next to nothing, what is remembered does not count yet and stays.

    Arguments:
        shape: Omega_j of one kind, shape (inner points, 3, strands).
        fraction: b_j before the rise. rise: db_j; both of shape (inner points, strands).
        r: conj(q1) q2, whose vector part is Omega, shape (inner points, 4, strands).
    """
    rises = (rise > 0) & (fraction + rise > _nothing(fraction))
    new = jnp.where(rises, rise / jnp.where(rises, fraction + rise, 1), 0)[:, None]
    return shape + quat.scaled(present_shape(r, shape) - shape, new)


def changes(
    effects: Sequence[BondEffect], rod: Rod, state: State, dt: float
) -> tuple[Array, dict[int, Array]]:
    """Fractions after this step's cutting, and the rises that its re-forming will add.

    Falls come first and rises are kept for the end of the step, so that the stress of a bond
    never jumps when it forms.

    Returns fractions of shape (inner points, 4, strands), and for each kind (its place in
    `BONDS`) that may rise, the rise, shape (inner points, strands).
    """
    fallen: dict[int, Array] = {}
    rises: dict[int, Array] = {}
    for j, kind in enumerate(BONDS):
        cutting = [e for e in effects if kind in e.kinds_cut]
        forming = [e for e in effects if kind in e.kinds_formed]
        if not cutting and not forming:
            continue
        before = state.fractions[:, j]

        def change(effect: BondEffect, kind: str = kind, before: Array = before) -> Array:
            return effect.fraction_change(kind, before, rod, state, dt)

        after = before
        if cutting:
            after = before + sum(jnp.minimum(change(e), 0) for e in cutting)
            after = jnp.maximum(after, 0)
            fallen[j] = after
        if forming:
            rise = sum(
                (jnp.maximum(change(e), 0) for e in forming[1:]), jnp.maximum(change(forming[0]), 0)
            )
            rises[j] = jnp.minimum(rise, 1 - after)
    return _with_kinds(state.fractions, fallen), rises


def reformed(state: State, rises: dict[int, Array], r: Array) -> State:
    """The state after its bonds re-formed and remember the present shape."""
    shapes, fractions = state.shapes, state.fractions
    shape, fraction = _of_kind(shapes), _of_kind(fractions)
    new, risen = {}, {}
    for j, rise in rises.items():
        new[j] = remembered(shape(j), fraction(j), rise, r)
        risen[j] = fraction(j) + rise
    return replace(state, shapes=_with_kinds(shapes, new), fractions=_with_kinds(fractions, risen))


def _with_kinds(x: Array, changed: dict[int, Array]) -> Array:
    """x, of shape (inner points, 4, ..., strands), with some kinds' values replaced."""
    if not changed:
        return x
    part = _of_kind(x)
    kinds = range(len(BONDS))
    return jnp.stack([changed[j] if j in changed else part(j) for j in kinds], axis=1)


class _Toward(BondEffect):
    """Moves the fractions of the named kinds toward a value, at once or at a rate."""

    hydrogen: Any
    ionic: Any
    disulfide: Any
    peptide: Any
    rate: Any

    def __post_init__(self) -> None:
        name = type(self).__name__
        for kind in self._kinds():
            check.fraction(f"{name}.{kind}", getattr(self, kind))
        if not self._kinds():
            raise ValueError(f"{name} names no bond; it must name one of {', '.join(BONDS)}")
        if self.rate is not None:
            check.not_negative(f"{name}.rate", self.rate)

    def _kinds(self) -> tuple[str, ...]:
        return tuple(kind for kind in BONDS if getattr(self, kind) is not None)

    def fraction_change(
        self, kind: str, fraction: Array, rod: Rod, state: State, dt: float
    ) -> Array:
        """What is missing to the wanted fraction, limited by the rate."""
        change = getattr(self, kind) - fraction
        return change if self.rate is None else jnp.clip(change, -self.rate * dt, self.rate * dt)


@pytree
class Cut(_Toward):
    """Breaks bonds: fractions above the given ones fall to them.

    Arguments:
        hydrogen, ionic, disulfide, peptide: fraction that stays, in [0, 1]; None leaves a kind
            alone, and then nothing of it is computed.
        rate: largest fall in a second [1/s]; None cuts at once.
    """

    each_strand_alone = True
    hydrogen: Any = None
    ionic: Any = None
    disulfide: Any = None
    peptide: Any = None
    rate: Any = None

    @property
    def kinds_cut(self) -> tuple[str, ...]:
        return self._kinds()

    @property
    def kinds_formed(self) -> tuple[str, ...]:
        return ()


@pytree
class Reform(_Toward):
    """Re-forms bonds: fractions below the given ones rise to them and remember the present shape.

    Arguments:
        hydrogen, ionic, disulfide, peptide: fraction to reach, in [0, 1]; None leaves a kind
            alone, and then nothing of it is computed.
        rate: largest rise in a second [1/s]; None re-forms at once.
    """

    each_strand_alone = True
    hydrogen: Any = None
    ionic: Any = None
    disulfide: Any = None
    peptide: Any = None
    rate: Any = None

    @property
    def kinds_cut(self) -> tuple[str, ...]:
        return ()

    @property
    def kinds_formed(self) -> tuple[str, ...]:
        return self._kinds()
