"""Natural strands, as files have them: what shape they remember, and what of it may be fitted.

    hair = natural(jh.read_curves("head.hair", unit=0.01))
    print(hair.table(fit_each(hair.scene, hair.targets, hair.free)))

A strand that hangs is drawn out by its weight: the shape that its bonds remember is curled more
than what is seen. The moments that weight puts on a strand of known stiffness follow from its
shape alone, so that the remembered shape can be computed, tip to root, without a fit
(`without_weight`; after Derouet-Jourdan, Bertails-Descoubes and Thollot, Stable inverse dynamic
curves, 2010, DOI 10.1145/1882261.1866159). Hydrogen bonds, which every wash makes anew while the
hair hangs, remember less of it.

**Hanging hair alone does not determine f_j and s:** for any of them, and any stiffness, there is a
remembered shape with which it hangs just so. They are taken as they are given, and the shape's
scale is fitted. Seen without weight too (`unloaded`), each strand shows its remembered shape, and
how its weight draws it out shows f_hydrogen and s, for the stiffness given.

A strand of a head stands out farther than a single hair could, held by its neighbours. Where a
hair's stiffness does not keep it as it was seen, the least of some multiples is taken that does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.constraints import Constraint, Positive
from fitting.many import TILE, FitEach
from fitting.targets import Shape, Target, resampled
from jaxhair import Bonds, Curves, Direct, PhysicalFibre, Scene, Strands, check, run, treatments
from jaxhair import quaternion as quat
from jaxhair.fibre import stiffness
from jaxhair.forces import Gravity
from jaxhair.holding import Hold, Unloaded
from jaxhair.scene import Phase
from jaxhair.strands import BONDS, strands_last

STATE, UNLOADED = "natural", "unloaded"
"""Phases at whose ends the strands are as they were observed, hanging or not, and unloaded."""

LEAST_POINTS, MOST_POINTS = 17, 65
TURN = 0.5
"""Largest mean turn between the edges of a simulated strand [rad], 12 edges a curl; where the most
points do not reach it, strands may turn twice as far."""

SHARPEST = np.pi / 2
"""Turn [rad] at a point of a file's strand from which on the points do not say what the curl is."""

STIFFER = (1.0, 4.0, 16.0, 64.0)
"""Multiples of a single hair's stiffness that a strand may have."""

STAYS = 0.01
"""Root mean square distance from the observed points, in lengths, up to which a strand stays."""

LARGEST_SHAPE = 0.8
"""Of |Omega|, half the sine of a turn, that a strand may remember: a turn of 106 degrees."""


@dataclass(frozen=True)
class Scale(Constraint):
    """The starting value times one number above 0, k = exp(x): for `strands.natural_shape`.

    Shapes Omega stay at most `LARGEST_SHAPE` in size, or as large as they start.
    """

    def free(self, value: np.ndarray) -> np.ndarray:
        return np.zeros(1)

    def value(self, free: Array, start: Any) -> Array:
        start = jnp.asarray(start, free.dtype)
        scaled = start * jnp.exp(free[0])
        square = jnp.sum(scaled**2, axis=-1, keepdims=True)
        most = jnp.maximum(jnp.sum(start**2, axis=-1, keepdims=True), LARGEST_SHAPE**2)
        over = square > most
        return scaled * jnp.where(over, jnp.sqrt(most / jnp.where(over, square, 1)), 1)


@dataclass(frozen=True)
class Share(Constraint):
    """One of several numbers against all others: their sum stays, and the others' ratios.

    For influences: a single state rarely shows more than one. v = sum / (1 + exp(-x)).

    Arguments:
        place: of the number.
    """

    place: int

    def free(self, value: np.ndarray) -> np.ndarray:
        if value.ndim != 1 or not 0 <= self.place < value.size or np.any(value < 0):
            raise ValueError(f"value is {check.short(value)}; it must be a list of numbers >= 0")
        own, whole = value[self.place], value.sum()
        if own == whole:
            raise ValueError(f"value is {check.short(value)}; another number must be above 0")
        share = np.clip(own / whole, 1e-6, 1 - 1e-6)
        return np.array([np.log(share / (1 - share))])

    def value(self, free: Array, start: Any) -> Array:
        start = jnp.asarray(start, free.dtype)
        whole, others = jnp.sum(start), start.at[self.place].set(0)
        share = jax.nn.sigmoid(free[0])
        rest = others * ((1 - share) * whole / jnp.sum(others))
        return rest.at[self.place].set(share * whole)

    def bounds(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.zeros(start.shape), np.full(start.shape, start.sum())


@dataclass(frozen=True)
class Natural:
    """Strands to be fitted, each by itself.

    Arguments:
        scene, targets, free: for `fit_each`.
        used: places of the scene's strands among those given, shape (strands,).
        stiffer: by how much each is stiffer than a single hair, one of `STIFFER`.
        left: from the place of a strand that is not in the scene to the reason.
    """

    scene: Scene
    targets: dict[str, Target]
    free: dict[str, Constraint]
    used: np.ndarray
    stiffer: np.ndarray
    left: dict[int, str]

    def reasons(self, found: FitEach) -> dict[int, str]:
        """Why strands could not be fitted, by their places among those given."""
        failed = zip(self.used, found.reasons, strict=True)
        whole = {**self.left, **{int(i): reason for i, reason in failed if reason is not None}}
        return dict(sorted(whole.items()))

    def table(self, found: FitEach, *, most: int = 10) -> str:
        """What a fit of them found, and the strands that could not be fitted, by file order."""
        reasons = self.reasons(found)
        total = len(self.used) + len(self.left)
        lines = [f"{total - len(reasons)} of {total} strands fitted", *found.summary()]
        counts = [f"{(self.stiffer == x).sum()} of {x:g}" for x in np.unique(self.stiffer)]
        lines.append(f"strands by their stiffness over a single hair's: {', '.join(counts)}")
        lines += [f"strand {i}: {reason}" for i, reason in list(reasons.items())[:most]]
        if len(reasons) > most:
            lines.append(f"and {len(reasons) - most} more could not be fitted")
        return "\n".join(lines)


def natural(
    curves: Curves | Sequence[Any],
    *,
    unloaded: Curves | Sequence[Any] | None = None,
    points: int | None = None,
    weight: bool = True,
    fibre: PhysicalFibre | None = None,
    influence: Sequence[float] = (0.33, 0.30, 0.20, 0.17),
    strands: int | None = None,
    seconds: float = 0.5,
    dt: float = 1 / 180,
    dtype: str = "float32",
) -> Natural:
    """Scene and targets for natural strands, which are held at their roots.

    Arguments:
        curves: from `jaxhair.read_curves`, or a list of points [m], each of shape (points, 3).
        unloaded: the same strands seen without weight, such as floating in water.
        points: on a simulated strand; if not given, 17 to 65, so that all but a twentieth of the
            strands turn by at most half a radian an edge.
        weight: `curves` were observed hanging, washed and dried under gravity. Otherwise they are
            without weight, as hair is often modelled.
        fibre: hair's, if not given. influence: of the bonds, to start from.
        strands: at most this many, spread evenly.
        seconds: that the hair hangs wet, and again dry. It starts in the observed shape, without
            weight if that is given, from which it needs a second or more to come to rest.
        dt: time step [s]. dtype: of the computation.

    A strand that cannot be simulated is left out with the reason: fewer than 3 different points, a
    coordinate that is not finite, points too far apart for its curls, too soft for its weight.
    Raises ValueError where no strand can be simulated.
    """
    check.flag("weight", weight)
    fibre = PhysicalFibre() if fibre is None else fibre
    check.instance("fibre", fibre, PhysicalFibre)
    for name, value in vars(fibre).items():
        if value is not None:
            check.number(f"fibre.{name}", value)
    bonds = Bonds(influence)
    check.shape("influence", bonds.influence, (len(BONDS),))
    if unloaded is not None and not weight:
        raise ValueError("weight is False; with unloaded strands it must be True")
    seen = [_listed(x) for x in ((curves,) if unloaded is None else (curves, unloaded))]
    if len({len(x) for x in seen}) > 1:
        sizes = f"{len(seen[0])} strands and {len(seen[1])} unloaded ones"
        raise ValueError(f"curves has {sizes}; they must be as many")
    total = len(seen[0])
    if strands is not None:
        check.whole("strands", strands, least=1)
    chosen = np.unique(np.linspace(0, total - 1, min(strands or total, total)).round().astype(int))
    left: dict[int, str] = {}
    kept: dict[int, list[np.ndarray]] = {}
    for i in chosen.tolist():
        cleaned = [_cleaned(x[i]) for x in seen]
        if bad := [x for x in cleaned if isinstance(x, str)]:
            left[i] = bad[0]
        else:
            kept[i] = [x for x in cleaned if not isinstance(x, str)]
    turns = np.array([max(_turns(x).sum() for x in several) for several in kept.values()])
    if points is None:
        wanted = np.quantile(turns, 0.95) / TURN + 2 if kept else LEAST_POINTS
        points = int(np.clip(np.ceil(wanted), LEAST_POINTS, MOST_POINTS))
    check.whole("points", points, least=4, most=100_000)
    for i, turn in zip(list(kept), turns / (points - 2), strict=True):
        if turn > 2 * TURN:
            left[i] = f"turns by {turn:.1f} rad between the edges of {points} points"
            del kept[i]
    _refuse_none(kept, left)
    shapes = [_resampled(list(x), points) for x in zip(*kept.values(), strict=True)]
    hair = Strands.from_points(jnp.asarray(shapes[-1], dtype))
    phases: tuple[Phase, ...] = (Phase(STATE, seconds, (Hold(),)),)
    stiffer = np.ones(len(kept))
    free: dict[str, Constraint] = {"strands.natural_shape": Scale()}
    targets: dict[str, Target] = {}
    if weight:
        phases = treatments.wash(name=STATE, seconds=seconds, unload=False)
    if unloaded is not None:
        phases = (Phase(UNLOADED, treatments.AT_ONCE, (Unloaded(),)), *phases)
        targets[UNLOADED] = Shape(shapes[1])
        shapes[0] += shapes[1][:, :1] - shapes[0][:, :1]  # roots in the same place
        free["bonds.influence"] = Share(BONDS.index("hydrogen"))
        free["fibre.peeling_rate"] = Positive()
    elif weight:
        shape, stiffer = _held_up(Scene(hair, fibre, bonds, phases, Direct(), dt))
        fits = stiffer > 0
        for i in np.array(list(kept))[~fits].tolist():
            left[i] = f"does not stay as it was seen, at {STIFFER[-1]:g} times the stiffness"
            del kept[i]
        _refuse_none(kept, left)
        shapes, stiffer = [shapes[0][fits]], stiffer[fits]
        hair = _some(replace(hair, natural_shape=shape), np.flatnonzero(fits))
        fibre = _times(fibre, jnp.asarray(stiffer, dtype))
    targets[STATE] = Shape(shapes[0])
    return Natural(
        Scene(hair, fibre, bonds, phases, Direct(), dt),
        targets,
        free,
        np.array(list(kept)),
        stiffer,
        dict(sorted(left.items())),
    )


def _some(strands: Strands, which: np.ndarray) -> Strands:
    return jax.tree.map(lambda leaf: leaf[which], strands)


def _times(fibre: PhysicalFibre, factor: Any) -> PhysicalFibre:
    """A fibre that is stiffer by a factor, of shape (strands,)."""
    young, shear = (factor * float(x) for x in (fibre.young_modulus, fibre.shear_modulus))
    return replace(fibre, young_modulus=young, shear_modulus=shear)


def _held_up(scene: Scene) -> tuple[Array, np.ndarray]:
    """What strands must remember to stay as they are, and how stiff they must be for that.

    Returns the shape, as `without_weight`, and the factor of `STIFFER`, 0 where none is enough.
    """
    hair, fibre, dtype = scene.strands, scene.fibre, scene.dtype
    influence = np.asarray(scene.bonds.influence)
    hydrogen = float(influence[0] / influence.sum())

    @jax.jit
    def off(hair: Strands, factor: Array) -> Array:
        """Distance from the start in lengths, shape (strands,)."""
        moved = replace(scene, strands=hair, fibre=_times(fibre, factor))
        away = run(moved)[STATE].points - hair.positions
        square = jnp.mean(jnp.sum(away**2, axis=-1), axis=-1)
        return jnp.sqrt(square) / jnp.sum(hair.lengths, axis=-1)

    shape, found = np.array(hair.natural_shape), np.zeros(hair.count)
    tile = min(TILE, hair.count)
    for factor in STIFFER:
        left = np.flatnonzero(found == 0)
        if not left.size:
            break
        some = _some(hair, left)
        wanted = without_weight(some, _times(fibre, factor), hydrogen=hydrogen)
        bears = np.linalg.norm(wanted, axis=-1).max(axis=1) < LARGEST_SHAPE
        left, wanted = left[bears], wanted[bears].astype(dtype)
        for first in range(0, left.size, tile):
            # the last strand fills up the last tile, so that all share a program
            at = np.minimum(np.arange(first, first + tile), left.size - 1)
            part = replace(_some(hair, left[at]), natural_shape=jnp.asarray(wanted[at]))
            stays = np.asarray(off(part, jnp.full(tile, factor, dtype))) < STAYS
            found[left[at[stays]]] = factor
            shape[left[at]] = wanted[at]
    return jnp.asarray(shape), found


def without_weight(
    strands: Strands, fibre: PhysicalFibre, *, hydrogen: float = 0.0, gravity: Any = None
) -> np.ndarray:
    """The shape that strands must remember to hang at rest as they are; (strands, points - 2, 3).

    At rest the edge i is in balance: the moments of its joints and that of the force n_i = g times
    the mass below it, l d3 x n, add up to 0. From the tip on each joint's moment m follows, and
    from it Omega - m / (4 B / h), by (Eq. 6) of a physical fibre.

    Arguments:
        hydrogen: share f_H / sum f of bonds that were made while the wet hair hung. Held by the
            others alone it hung lower, by m / (4 B / h) / (1 - f_H) to first order, and what
            all remember together is as much nearer to that: by 1 / (1 - f_H) in all.
        gravity: g [m/s^2], shape (3,); the effect's own if not given.
    """
    g = np.asarray(Gravity().acceleration if gravity is None else gravity, float)
    length = np.asarray(strands_last(strands.lengths), float)[:, None]
    d1, d2, _ = (np.asarray(d, float) for d in quat.axes(strands_last(strands.orientations)))
    v = np.asarray(strands_last(strands.natural_shape), float)
    w = np.sqrt(np.maximum(1 - (v**2).sum(axis=1, keepdims=True), 0))
    none = np.zeros_like(length[:1])
    own = (np.concatenate([none, length]) + np.concatenate([length, none])) / 2
    mass = own * float(fibre.density * fibre.area)
    below = mass[::-1].cumsum(axis=0)[::-1][1:]
    n = below * g[None, :, None]
    load = length * np.stack([(n * d2).sum(axis=1), -(n * d1).sum(axis=1), 0 * n[:, 0]], axis=1)
    distance = jnp.asarray(length.cumsum(axis=0)[:-1])
    spring = 4 * np.asarray(stiffness(fibre, distance), float) / own[1:-1]
    shape, first = np.empty_like(v), np.zeros_like(load[0])
    eye = np.eye(3)
    for k in reversed(range(len(v))):
        # what the moment m does to the edge behind the joint, (w m - v x m) / 2, as a matrix
        cross = np.cross(v[k].T[:, None], eye).swapaxes(1, 2)
        behind = (w[k].T[..., None] * eye - cross) / 2
        m = np.linalg.solve(behind, -(load[k + 1] + first).T[..., None])[..., 0].T
        first = -(w[k] * m + np.cross(v[k].T, m.T).T) / 2
        shape[k] = v[k] - m / spring[k] / (1 - hydrogen)
    return np.moveaxis(shape, -1, 0)


def _listed(curves: Any) -> list[Any]:
    if isinstance(curves, Curves):
        return list(curves.to_list())
    check.instance("curves", curves, Sequence)
    return list(curves)


def _refuse_none(kept: Mapping[int, Any], left: dict[int, str]) -> None:
    if not kept:
        first = next(iter(left.items()), None)
        why = "there is none" if first is None else f"strand {first[0]}: {first[1]}"
        raise ValueError(f"curves has no strand that can be simulated; {why}")


def _cleaned(given: Any) -> np.ndarray | str:
    """Points without those that repeat the one before, or why they are no strand."""
    try:
        x = np.asarray(given, float)
    except (TypeError, ValueError):
        return "no points"
    if x.ndim != 2 or x.shape[1] != 3:
        return f"points of shape {x.shape}, not (points, 3)"
    if not np.all(np.abs(x) < check.LARGEST):
        return "not finite"
    edges = np.linalg.norm(np.diff(x, axis=0), axis=1)
    if edges.sum() < check.SMALLEST:
        return "no length" if len(x) > 2 else f"{len(x)} points, fewer than 3"
    x = x[np.append(True, edges > 1e-6 * edges.sum())]
    if len(x) < 3:
        return f"{len(x)} different points, fewer than 3"
    turns = _turns(x)
    if turns.max() > SHARPEST:
        place = int(np.argmax(turns)) + 1
        return (
            f"turns by {np.degrees(turns.max()):.0f} degrees at its point {place}: "
            "points too far apart"
        )
    return x


def _turns(x: np.ndarray) -> np.ndarray:
    """Angles between the edges of one strand [rad]."""
    t = np.diff(x, axis=0)
    across = np.linalg.norm(np.cross(t[:-1], t[1:]), axis=1)
    return np.arctan2(across, (t[:-1] * t[1:]).sum(axis=1))


def _resampled(strands: list[np.ndarray], points: int) -> np.ndarray:
    curves = Curves.from_list(strands)
    return resampled(curves.points, curves.counts, points)
